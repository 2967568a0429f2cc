"""Effects of the causes of error on the values of one profile, with their signs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.backscatter import Backscatter
from lidarops.retrieve.raman.depth_fit import DepthFit, Extinction, slope
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.raman.signals import AirColumn, CellSignal
from lidarops.retrieve.raman.thresholds import THRESHOLDS

EXTINCTION_CAUSES: Final = (
    "noise", "resolution", "background", "dead_time", "baseline", "angstrom", "molecular",
    "overlap",
)  # fmt: skip
BACKSCATTER_CAUSES: Final = (
    "noise", "background", "dead_time", "baseline", "reference", "angstrom", "molecular", "overlap",
)  # fmt: skip
RANDOM: Final = frozenset({"noise", "resolution", "background"})
"""Causes whose errors change from profile to profile; those of all others are systematic."""


@dataclass(frozen=True, slots=True)
class Quotient:
    """A quotient with its errors, (cell,); NaN where the denominator is too uncertain."""

    value: Array
    random: Array
    """Standard error by random causes."""
    systematic: Array
    """Standard error by all others."""


@dataclass(frozen=True, slots=True)
class Profile:
    """One profile before its calibration."""

    raman: CellSignal
    elastic: CellSignal
    fit: DepthFit
    extinction: Extinction


@dataclass(frozen=True, slots=True)
class Cause:
    """Effect of one standard error of one cause on one profile, with signs, (cell,)."""

    name: str
    extinction: Array
    """m-1."""
    backscatter: Array
    """m-1 sr-1."""
    depth: Array
    """Of the fitted optical depth."""


@dataclass(frozen=True, slots=True)
class _Change:
    """What one standard error of one cause changes, (cell,)."""

    name: str
    raman: Array
    """Of the Raman signal, relative."""
    elastic: Array
    """Of the elastic signal, relative."""
    backscatter: Array
    """Of backscatter of particles beside that by the signals, m-1 sr-1."""


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects of all causes but noise on one profile."""

    profile: Profile
    calibrated: Backscatter | None
    """None without reference; backscatter is NaN then."""
    air: AirColumn
    """In cells, with an overlap of 1 where it is not known."""
    step: float
    """m, length of a cell."""
    settings: RamanSettings
    reference_error: float
    """Relative standard error of the scattering ratio in the reference window."""
    partial: Booleans

    def causes(self) -> Iterator[Cause]:
        """Yield the effect of one standard error of each cause but overlap."""
        yield from self._effects([*self._instrument(), *self._air()])
        yield from self._assumed()

    @property
    def knows_overlap(self) -> bool:
        """Whether the overlap is known; else it is stated to be full from a range on."""
        return bool((self.air.overlap != 1.0).any())

    def overlap(self) -> list[Cause]:
        """Return the effects of the overlap.

        A known one changes signals in proportion to what it lacks; one that is stated to be full
        may still lack something there, which falls with range at an unknown rate.
        """
        if self.knows_overlap:
            shares = [self.settings.overlap_relative_error * (1.0 / self.air.overlap - 1.0)]
        else:
            full = self.air.range[int(np.argmin(self.partial))]
            beyond = np.maximum(self.air.range / full - 1.0, 0.0)
            error, scales = self.settings.full_overlap_error, THRESHOLDS.overlap_scales
            shares = [error * np.exp(-beyond / scale) for scale in scales]
        return list(self._effects([_Change("overlap", one, one, self._none) for one in shares]))

    def _effects(self, changes: Sequence[_Change]) -> Iterator[Cause]:
        raman, elastic, beside = (
            np.stack([getattr(change, name) for change in changes], axis=-1)
            for name in ("raman", "elastic", "backscatter")
        )
        partial = self.partial[:, np.newaxis]
        depth = self.profile.fit.respond(np.where(partial, 0.0, raman))
        alpha = slope(depth, self.step) / (1.0 + self._ratio)
        beta = self._respond(elastic - np.where(partial, raman, 0.0), depth) + beside
        for change, *effects in zip(changes, alpha.T, beta.T, depth.T, strict=True):
            yield Cause(change.name, *effects)

    @property
    def _ratio(self) -> float:
        return self.air.particle_ratio(self.settings.angstrom_exponent)

    @property
    def _none(self) -> Array:
        return np.zeros(self.partial.size)

    @property
    def _total(self) -> Array:
        """Total backscatter; NaN without calibration."""
        if self.calibrated is None:
            return np.full(self.partial.size, np.nan)
        return self.calibrated.total

    def _instrument(self) -> Iterator[_Change]:
        """Yield the changes by backgrounds, dead times and baselines, which are subtracted."""
        raman, elastic = self.profile.raman, self.profile.elastic
        level, none = np.exp(-self.profile.fit.depth), self._none
        for name in ("background", "dead_time", "baseline"):
            of_raman = raman.relative(-getattr(raman, name), level)
            of_elastic = elastic.relative(-getattr(elastic, name), elastic.value)
            yield _Change(name, of_raman, none, none)
            yield _Change(name, none, of_elastic, none)

    def _air(self) -> Iterator[_Change]:
        """Yield the changes by the density of air and by its slope.

        Both also change the air that is assumed in the window, and that is subtracted.
        """
        error, depth = self.settings.molecular_relative_error, self.air.depth
        yield _Change(
            "molecular",
            error * (depth + self.air.raman_depth),
            2.0 * error * depth,
            error * (self._total - self.air.backscatter),
        )
        error = self.air.slope_error
        shares = self._none if self.calibrated is None else self.calibrated.shares
        away = self.air.range - shares @ self.air.range
        beside = -error * away * self.air.backscatter
        yield _Change("molecular", -error * self.air.range, self._none, beside)

    def _assumed(self) -> Iterator[Cause]:
        """Yield the effects of the scattering ratio and the Angstrom exponent."""
        none, ratio = self._none, self._ratio
        yield Cause("reference", none, self.reference_error * self._total, none)
        colour = abs(float(np.log(self.air.wavelength / self.air.raman_wavelength)))
        change = ratio * colour * self.settings.angstrom_standard_error / (1.0 + ratio)
        relative = -2.0 * self.profile.fit.depth * change / (1.0 + ratio)
        alpha = -change * self.profile.extinction.value
        yield Cause("angstrom", alpha, self._respond(relative, none), none)

    def _respond(self, relative: Array, depth: Array) -> Array:
        if self.calibrated is None:
            return np.full(depth.shape, np.nan)
        return self.calibrated.respond(relative, depth)


def summed(names: Sequence[str], causes: Sequence[tuple[str, Array]]) -> dict[str, Array]:
    """Return the absolute error from each cause, those of both signals together."""
    budget: dict[str, Array] = {}
    for name in names:
        parts = [error for known, error in causes if known == name]
        budget[name] = np.sqrt(sum((part**2 for part in parts), np.zeros(1)))
    return budget
