"""Steps of the product ``integrated``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import xarray as xr

from lidar_extras.integrated.integral import Window
from lidar_extras.integrated.settings import IntegratedSettings
from lidarops.records import Role
from lidarops.retrieve.signal.labeled import background_words, correct_for_range
from lidarops.settings import SettingsModel
from lidarops.steps.case import ProductCase
from lidarops.steps.channels import channel_ranges
from lidarops.steps.conditioning import OVERLAP, PROFILES
from lidarops.steps.data import Chunk, Data, RowProduct
from lidarops.steps.preparation import BACKGROUND, FEWEST_BINS, Background, tail
from lidarops.steps.profiles import gluing
from lidarops.steps.step import REQUESTED, Decisions, Leave, ProductStep, Run


class WindowSettings(SettingsModel):
    """Settings of the step ``integrated``."""

    windows: tuple[tuple[float, float], ...]
    """m."""
    overlap_profile: str | None = None
    """File of the overlap, in place of that of the facts."""


class Integrated(ProductStep[IntegratedSettings, WindowSettings]):
    """Integrate the range-corrected signal over windows of range."""

    name = "integrated"
    settings = WindowSettings
    inputs = (PROFILES, BACKGROUND, OVERLAP)
    parts = (Background(),)

    def decide(self, case: ProductCase[IntegratedSettings]) -> Decisions:
        """Run for the windows that hold a bin, where the range of the background holds enough."""
        start, stop = tail(case, case.request.background_range)
        bins = (stop - start) / case.channel.bin_width
        if bins < FEWEST_BINS:
            reason = f"background_range {start:g}-{stop:g} m holds fewer than {FEWEST_BINS} bins"
            yield Leave(reason, number=bins)
            return
        centres = channel_ranges(case.channel, case.facts)
        kept = []
        for near, far in case.request.windows:
            if ((near <= centres) & (centres < far)).any():
                kept.append((near, far))
            else:
                reason = f"window {near:g}-{far:g} m holds no bin; the last ends at {case.last:g} m"
                yield Leave(reason, number=near, rule="window_inside")
        if kept:
            settings = WindowSettings(
                windows=tuple(kept), overlap_profile=case.request.overlap_profile
            )
            yield Run(REQUESTED, settings, number=float(len(kept)))

    def files(self, settings: WindowSettings) -> dict[str, Role]:
        """Return the file of the overlap."""
        return {settings.overlap_profile: Role.OVERLAP} if settings.overlap_profile else {}

    def stream(self, settings: WindowSettings, data: Data) -> RowProduct:
        """Return the product, which is written as profiles come."""
        return _Integrals(settings, data)


class _Integrals(RowProduct):
    """Integrals of each profile."""

    def __init__(self, settings: WindowSettings, data: Data) -> None:
        self._profiles = data[PROFILES]
        background = data[BACKGROUND]
        self._background = background.range, background.method
        self._geometry = data.source.geometry
        self._limits = np.array(settings.windows)
        centres, overlap = self._profiles.range, data.get(OVERLAP)
        if settings.overlap_profile:
            overlap = data.source.ancillaries.overlaps[settings.overlap_profile].at
        known = np.ones(centres.size) if overlap is None else overlap(centres)
        self._windows = [Window.of(centres, known, limits) for limits in settings.windows]

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

    def rows(self, chunk: Chunk) -> Iterator[xr.Dataset]:
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


STEP: Final = Integrated()
