"""The product ``integrated``: its decision, and its making."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import xarray as xr

from lidar_extras.integrated.integral import Window
from lidar_extras.integrated.settings import IntegratedSettings
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.labeled import background_words, correct_for_range
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, channel_ranges
from lidarops.scene.profiles import ChannelSignal, Chunk, ProductStream, gluing
from lidarops.scene.retrieval import BackgroundSettings, Retrieval, background, tail
from lidarops.settings import SettingsModel


class WindowSettings(SettingsModel):
    """Settings of the entry ``integrated``."""

    windows: tuple[tuple[float, float], ...]
    """m."""
    overlap_profile: str | None = None
    """File of the overlap, in place of that of the facts."""


class IntegratedPlan(SettingsModel):
    """What a plan states of a product."""

    background: BackgroundSettings
    integrated: WindowSettings


def needs(case: ChannelCase[IntegratedSettings]) -> Entries:
    """Integrate over the windows that hold a bin, where that of the background holds enough."""
    limits = case.request.background_range
    start, stop = tail(case, limits)
    bins = (stop - start) / case.channel.bin_width
    if bins < COMMON.fewest_bins:
        reason = f"background_range {start:g}-{stop:g} m holds fewer than {COMMON.fewest_bins} bins"
        yield case.leave("integrated", reason, number=bins)
        return
    centres = channel_ranges(case.channel, case.facts_of_channel)
    kept = []
    for near, far in case.request.windows:
        if ((near <= centres) & (centres < far)).any():
            kept.append((near, far))
        else:
            reason = f"window {near:g}-{far:g} m holds no bin; the last ends at {case.last:g} m"
            yield case.leave("integrated", reason, number=near, rule="window_inside")
    if kept:
        yield background(case, "tail_mean", limits)
        settings = WindowSettings(windows=tuple(kept), overlap_profile=case.request.overlap_profile)
        taken = ("overlap", "noise", "glue", "background")
        number = float(len(kept))
        yield case.run("integrated", REQUESTED, settings, needs=taken, number=number)


class _Integrals(ProductStream):
    """Integrals of each profile."""

    def __init__(self, settings: IntegratedPlan, signal: ChannelSignal) -> None:
        self._profiles, own = signal.profiles, settings.integrated
        self._background = settings.background.range, settings.background.method
        self._geometry = signal.source.geometry
        self._limits = np.array(own.windows)
        centres = self._profiles.range
        known = signal.overlap_at(centres)
        if own.overlap_profile:
            known = signal.source.ancillaries.overlaps[own.overlap_profile].at(centres)
        if known is None:
            known = np.ones(centres.size)
        self._windows = [Window.of(centres, known, limits) for limits in own.windows]

    def _frame(self) -> xr.Dataset:
        """Return times and pointing of all profiles, and the windows."""
        background_range, method = self._background
        frame = self._geometry.assign_coords(
            window=("window", np.arange(len(self._windows), dtype=np.int32)),
            window_range=("window", self._limits.mean(axis=1)),
            window_bounds=(("window", "nv"), self._limits),
        )
        bins = np.array([window.weights.size for window in self._windows], np.int32)
        words = background_words(method, background_range)
        return frame.assign(bins=("window", bins)).assign_attrs(steps=words)

    def add(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Yield the integrals of profiles."""
        if chunk.rows.start == 0:
            yield self._frame()
        conditioned = chunk.profiles(self._profiles)
        signals = correct_for_range(conditioned, *self._background)
        sky = signals[["background", "background_standard_error"]]
        integrals = [
            window.integrals(
                conditioned["power"].to_numpy(),
                conditioned["variance"].to_numpy(),
                (sky["background"].to_numpy(), sky["background_standard_error"].to_numpy()),
                signals["quality_flag"].to_numpy(),
            )
            for window in self._windows
        ]
        dims = ("time", "window")
        values = sky.assign(
            integral=(dims, np.stack([part.values for part in integrals], axis=1)),
            integral_standard_error=(
                dims,
                np.stack([part.standard_errors for part in integrals], axis=1),
            ),
            quality_flag=(dims, np.stack([part.flags for part in integrals], axis=1)),
            shots=self._profiles.shots(chunk.counts),
        )
        yield values.assign(gluing(conditioned)).assign_coords(chunk.geometry.variables)


RETRIEVAL: Final = Retrieval(settings=IntegratedPlan, needs=needs, stream=_Integrals)
