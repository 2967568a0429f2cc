"""Steps of the product ``signal``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import CUBIC_PAPER
from lidarops.flags import Quality
from lidarops.netcdf.variables import BACKGROUND_METHOD
from lidarops.products.signal.settings import SignalSettings
from lidarops.products.signal.variables import LAYOUT
from lidarops.retrieve.signal.labeled import background_words, correct_for_range
from lidarops.settings import SettingsModel
from lidarops.steps.case import ProductCase
from lidarops.steps.conditioning import OVERLAP, PROFILES
from lidarops.steps.data import Chunk, Data, RowProduct
from lidarops.steps.preparation import BACKGROUND, FEWEST_BINS, Background, tail
from lidarops.steps.profiles import gluing
from lidarops.steps.signal_to_noise import with_low_signal_to_noise
from lidarops.steps.step import (
    REQUESTED,
    Decisions,
    Leave,
    ProductStep,
    Run,
)


class RangeCorrection(SettingsModel):
    """Settings of the step ``signal``."""

    least_signal_to_noise: float


class Signal(ProductStep[SignalSettings, RangeCorrection]):
    """Subtract the background and correct for range."""

    name = "signal"
    settings = RangeCorrection
    inputs = (PROFILES, BACKGROUND, OVERLAP)
    parts = (Background(),)

    def decide(self, case: ProductCase[SignalSettings]) -> Decisions:
        """Run where the range of the background holds enough bins."""
        limits = case.request.background_range
        start, stop = tail(case, limits)
        bins = (stop - start) / case.channel.bin_width
        if bins >= FEWEST_BINS:
            least = case.request.least_signal_to_noise
            yield Run(REQUESTED, RangeCorrection(least_signal_to_noise=least))
            return
        stop = limits[1] if limits else case.last
        reason = (
            f"background_range {start:g}-{stop:g} m holds fewer than {FEWEST_BINS} bins;"
            f" the last bin ends at {case.last:g} m"
        )
        yield Leave(reason, number=bins)

    def stream(self, settings: RangeCorrection, data: Data) -> RowProduct:
        """Return the product, which is written as profiles come."""
        return _Signals(settings, data)


class _Signals(RowProduct):
    """Range-corrected signals of each profile."""

    def __init__(self, settings: RangeCorrection, data: Data) -> None:
        self._settings = settings
        self._profiles = data[PROFILES]
        self._background = data[BACKGROUND]
        overlap: Callable[..., npt.NDArray[np.float64]] | None = data.get(OVERLAP)
        self._overlap = None if overlap is None else overlap(self._profiles.range)
        self._geometry = data.source.geometry

    def rows(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Yield the signals of profiles."""
        if chunk.rows.start == 0:
            yield self._frame()
        conditioned = chunk.profiles(self._profiles)
        signals = correct_for_range(
            conditioned, self._background.range, self._background.method
        ).assign(gluing(conditioned))
        if self._overlap is not None:
            signals = _without_overlap(signals, self._overlap)
        least = self._settings.least_signal_to_noise
        signals = with_low_signal_to_noise(signals, LAYOUT.weighed, least)
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


STEP: Final = Signal()
