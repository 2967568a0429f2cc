"""The product ``signal``: its decision, and its making."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import CUBIC_PAPER
from lidarops.flags import Quality
from lidarops.netcdf.variables import BACKGROUND_METHOD
from lidarops.products.signal import RangeCorrection, SignalSettings
from lidarops.products.signal.variables import LAYOUT
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.labeled import background_words, correct_for_range
from lidarops.scene.case import REQUESTED, ChannelCase, Entries
from lidarops.scene.profiles import ChannelSignal, Chunk, ProductStream, gluing
from lidarops.scene.retrieval import (
    BackgroundSettings,
    Retrieval,
    background,
    before_pulse,
    tail,
    with_low_signal_to_noise,
)
from lidarops.settings import SettingsModel


class SignalPlan(SettingsModel):
    """What a plan states of a product."""

    background: BackgroundSettings
    signal: RangeCorrection


def _needs(case: ChannelCase[SignalSettings]) -> Entries:
    """Subtract the background and correct for range, where its range holds enough bins."""
    limits = case.request.background_range
    start, stop = tail(case, limits)
    bins = (stop - start) / case.channel.bin_width
    if bins < COMMON.fewest_bins:
        stop = limits[1] if limits else case.last
        reason = (
            f"background_range {start:g}-{stop:g} m holds fewer than {COMMON.fewest_bins} bins;"
            f" the last bin ends at {case.last:g} m"
        )
        yield case.leave("signal", reason, number=bins)
        return
    if (reason := before_pulse(case)) and not limits:
        before = BackgroundSettings(method="before_pulse", range=(-case.channel.pre_trigger, 0.0))
        yield case.run("background", reason, before)
    else:
        yield background(case, case.request.background, limits)
    taken = ("overlap", "noise", "glue", "background")
    yield case.run("signal", REQUESTED, RangeCorrection.taken_from(case.request), needs=taken)


class _Signals(ProductStream):
    """Range-corrected signals of each profile."""

    def __init__(self, settings: SignalPlan, signal: ChannelSignal) -> None:
        self._least = settings.signal.least_signal_to_noise
        self._profiles = signal.profiles
        self._background = settings.background
        self._overlap = signal.overlap_at(signal.profiles.range)
        self._geometry = signal.source.geometry

    def add(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Yield the signals of profiles."""
        if chunk.rows.start == 0:
            yield self._frame()
        conditioned = chunk.profiles(self._profiles)
        signals = correct_for_range(
            conditioned, self._background.range, self._background.method
        ).assign(gluing(conditioned))
        if self._overlap is not None:
            signals = _without_overlap(signals, self._overlap)
        signals = with_low_signal_to_noise(signals, LAYOUT.weighed, self._least)
        shots = self._profiles.shots(chunk.counts)
        yield signals.assign(shots=shots).assign_coords(chunk.geometry.variables)

    def _frame(self) -> xr.Dataset:
        """Return times, pointing and ranges of all profiles."""
        words = background_words(self._background.method, self._background.range)
        frame = self._geometry.assign_coords(range=self._profiles.range).assign(
            background_method=BACKGROUND_METHOD.code(self._background.method)
        )
        cited = {"references": CUBIC_PAPER} if self._background.method == "cubic" else {}
        return frame.assign_attrs(steps=words, **cited)


def _without_overlap(signals: xr.Dataset, overlap: npt.NDArray[np.float64]) -> xr.Dataset:
    """Return signals divided by the overlap, and flagged where it is not known."""
    along = xr.DataArray(overlap.astype(np.float32), dims="range")
    lost = along.isnull().astype(np.int32) * np.int32(Quality.INCOMPLETE_OVERLAP)
    divided = ("signal", "signal_standard_error", "signal_dead_time_error", "signal_baseline_error")
    return signals.assign(
        {name: signals[name] / along for name in divided if name in signals}
    ).assign(quality_flag=signals["quality_flag"] | lost)


RETRIEVAL: Final = Retrieval(settings=SignalPlan, needs=_needs, stream=_Signals)
