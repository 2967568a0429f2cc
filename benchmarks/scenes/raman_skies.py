"""Skies above a Raman lidar by a forward model of their own, of benchmarks and of tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Array, Random, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues
from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.common.arrays import Flags
from lidarops.retrieve.raman.flags import RamanQuality, concerning
from lidarops.retrieve.raman.retrieval import RamanResult, retrieve_raman
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings
from lidarops.retrieve.raman.signals import AirColumn, Cells, ChannelSignal, make_cells

LASER: Final = 354.7e-9
RAMAN: Final = 386.7e-9
_STEP: Final = 30.0
_RANGE: Final = _STEP * (np.arange(400, dtype=np.float64) + 0.5)
_CELL: Final = 60.0
_FULL_OVERLAPS: Final = (200.0, 2500.0)
"""m."""
_SHORTEST: Final = 50.0
"""m, least length over which what overlap lacks falls; at most, the range of full overlap."""
_COMPARED: Final = 6000.0
"""m; values below are compared with the truth."""
_PRECISE: Final = 3.0
"""Stated errors above which a value beyond full overlap should not be doubted."""
_EXPONENT: Final = 1.2
_EXPONENT_ERROR: Final = 0.5
_REFERENCE_ERROR: Final = 0.02
_COUNTS: Final = (30.0, 5000.0)
"""Of a Raman bin at 1 km."""
_LIDAR_RATIOS: Final = (25.0, 90.0)
"""sr."""
_EXACT: Final[dict[str, Any]] = dict.fromkeys(
    ("angstrom_standard_error", "molecular_relative_error", "overlap_relative_error"), 0.0
)
_TOPS: Final = (2000.0, 5000.0)
"""m; no haze above."""


@dataclass(frozen=True, slots=True)
class Sky:
    """A particle profile over a standard atmosphere, with counts of both signals, (bin,)."""

    extinction: Array
    """m-1."""
    lidar_ratio: float
    raman: Array
    """Mean counts without background."""
    elastic: Array
    air: AirColumn
    cells: Cells
    settings: RamanSettings

    @property
    def backscatter(self) -> Array:
        """Backscatter of particles, m-1 sr-1."""
        return self.extinction / self.lidar_ratio

    @property
    def ratio(self) -> float:
        """Particle extinction at the Raman wavelength over that at the laser's."""
        return self.air.particle_ratio(self.settings.angstrom_exponent)

    @property
    def quality(self) -> Flags:
        """Bits of the cells of one profile: partial overlap where the overlap is not known."""
        partial = np.isnan(self.cells.split(self.air.overlap)).any(axis=-1)
        return np.where(partial, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))[np.newaxis]

    def signal(self, counts: Array) -> ChannelSignal:
        """Return counts (profile, bin) as a signal."""
        rows, bins = counts.shape
        mean, zero = np.maximum(counts.mean(axis=0), 1e-3), np.zeros(rows)
        variance = np.broadcast_to(mean, counts.shape)
        return ChannelSignal(counts, variance, zero, zero, np.zeros((1, bins)), np.ones(rows))

    def drawn(self, rng: Random, profiles: int) -> tuple[ChannelSignal, ChannelSignal]:
        """Return noisy profiles of the Raman and of the elastic signal."""
        raman, elastic = (
            self.signal(rng.poisson(mean, (profiles, mean.size)).astype(float))
            for mean in (self.raman, self.elastic)
        )
        return raman, elastic


def along(values: Array, step: float) -> Array:
    """Return the integral from the lidar to the middle of each bin."""
    return np.asarray(np.cumsum(values) * step - 0.5 * values * step)


def mean_over(
    profile: Array, step: float, middle: Array, length: Array, nearest: Array | float = 0.0
) -> Array:
    """Return means of a profile of bins over lengths around heights, from `nearest` on."""
    whole = np.concatenate([[0.0], np.cumsum(profile)]) * step
    edges = step * np.arange(profile.size + 1)
    low = np.maximum(middle - 0.5 * length, nearest)
    high = np.minimum(low + length, edges[-1])
    return np.asarray((np.interp(high, edges, whole) - np.interp(low, edges, whole)) / (high - low))


def make_sky(
    extinction: Array,
    step: float,
    light: float,
    *,
    lidar_ratio: float = 50.0,
    exponent: float = 1.2,
    cell: float = 60.0,
    full_overlap: float = 300.0,
    window: tuple[float, float, float] = (7000.0, 12_000.0, 5000.0),
    brightness: float = 3.0,
) -> Sky:
    """Return a sky of bins of `step` m; `light` is the mean count of the Raman bin at 1 km.

    `brightness` is that of the elastic bin over it.
    """
    r = step * (np.arange(extinction.size, dtype=np.float64) + 0.5)
    molecules = MolecularProfile.us_standard()
    ratio = (LASER / RAMAN) ** exponent
    backscatter = molecules.backscatter(r, LASER)
    depth, raman_depth = (along(molecules.extinction(r, x), step) for x in (LASER, RAMAN))
    density, particles = molecules.number_density(r), along(extinction, step)
    seen = np.minimum(r / max(full_overlap, step), 1.0) ** 2
    raman = seen * density / r**2 * np.exp(-depth - raman_depth - (1.0 + ratio) * particles)
    total = backscatter + extinction / lidar_ratio
    elastic = seen * total / r**2 * np.exp(-2.0 * depth - 2.0 * particles)
    known = np.where(r >= full_overlap, 1.0, np.nan)
    low, high, width = window
    at = int(np.searchsorted(r, 1000.0))
    return Sky(
        extinction,
        lidar_ratio,
        light * raman / raman[at],
        brightness * light * elastic / elastic[at],
        AirColumn(r, backscatter, depth, raman_depth, density, known, LASER, RAMAN),
        make_cells(r, r[-1] + step, cell),
        RamanSettings(
            highest=high,
            reference=RamanReference(lowest=low, highest=high, width=width, relative_error=0.0),
            angstrom_exponent=exponent,
            full_overlap_error=0.0,
            **_EXACT,
        ),
    )


def _hazy(rng: Random, exponent: float = _EXPONENT) -> Sky:
    """Return haze that falls with height and ends smoothly; the settings are those of products."""
    amount, scale = log_uniform(rng, 2e-5, 3e-4), rng.uniform(800.0, 3000.0)
    top = 1.0 + np.exp((_RANGE - rng.uniform(*_TOPS)) / 300.0)
    sky = make_sky(
        amount * np.exp(-_RANGE / scale) / top, _STEP, log_uniform(rng, *_COUNTS),
        lidar_ratio=float(rng.uniform(*_LIDAR_RATIOS)), exponent=exponent, cell=_CELL,
        full_overlap=log_uniform(rng, *_FULL_OVERLAPS),
    )  # fmt: skip
    reference = RamanReference(relative_error=0.0)
    settings = RamanSettings(reference=reference, angstrom_exponent=_EXPONENT, **_EXACT)
    return replace(sky, settings=settings)


def _of_other_colour(rng: Random) -> Sky:
    off = _EXPONENT_ERROR * float(np.clip(rng.normal(), -3.0, 3.0))
    sky = _hazy(rng, _EXPONENT + off)
    return replace(sky, settings=replace(sky.settings, angstrom_standard_error=_EXPONENT_ERROR))


def _with_particles_aloft(rng: Random) -> Sky:
    sky, share = _hazy(rng), rng.uniform(0.0, 0.05)
    more = share * sky.air.backscatter / (sky.air.backscatter + sky.backscatter)
    reference = RamanReference(relative_error=_REFERENCE_ERROR)
    return replace(
        sky,
        elastic=sky.elastic * (1.0 + more * (_RANGE > _COMPARED)),
        settings=replace(sky.settings, reference=reference),
    )


def _with_overlap(rng: Random) -> Sky:
    sky = _hazy(rng)
    full = float(_RANGE[np.isfinite(sky.air.overlap)][0])
    fall = np.exp(-np.maximum(_RANGE - full, 0.0) / log_uniform(rng, _SHORTEST, full))
    seen = 1.0 - 0.05 * fall
    return replace(sky, raman=seen * sky.raman, elastic=seen * sky.elastic)


FAILURES: Final[tuple[tuple[Failure, Callable[[Random], Sky]], ...]] = (
    (Failure("none", satisfied=True), _hazy),
    (Failure("Angstrom exponent off as stated"), _of_other_colour),
    (Failure("particles in the reference window"), _with_particles_aloft),
    (Failure("overlap 5 percent off"), _with_overlap),
)


def score_raman(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield extinctions, backscatters and lidar ratios of profiles of one random sky."""
    for number, (failure, draw) in enumerate(FAILURES):
        rng = np.random.default_rng((88, cluster, number))
        sky = draw(rng)
        quality = np.repeat(sky.quality, profiles, axis=0)
        result = retrieve_raman(
            *sky.drawn(rng, profiles), sky.air, sky.cells, sky.settings, quality=quality
        )
        yield from _scored(failure, sky, result)


def _scored(failure: Failure, sky: Sky, result: RamanResult) -> Iterator[ScoredValues]:
    """Yield the values of each quantity, which flags of others should not doubt."""
    inside = sky.cells.range < _COMPARED
    full = sky.quality == 0
    first = np.isfinite(result.extinction).argmax(axis=1)
    nearest = sky.cells.range[first, np.newaxis] - 0.5 * _CELL
    length = np.where(np.isnan(result.vertical_resolution), _CELL, result.vertical_resolution)
    none = np.zeros_like(result.quality)
    extinction = mean_over(sky.extinction, _STEP, sky.cells.range, length, nearest)
    for attribute, name, truth in (
        ("extinction", "aerosol_extinction", extinction),
        ("backscatter", "aerosol_backscatter", sky.cells.mean(sky.backscatter)),
        ("lidar_ratio", "lidar_ratio", np.full(full.shape, sky.lidar_ratio)),
    ):
        value, stated = getattr(result, attribute), getattr(result, f"{attribute}_standard_error")
        bits = concerning(name, result.quality, none)[:, inside]
        yield ScoredValues(
            failure, attribute.replace("_", " "), (value - truth)[:, inside], stated[:, inside],
            0.0, bits, RamanQuality, uncertain=bits != 0,
            solvable=(full & (value > _PRECISE * stated))[:, inside],
        )  # fmt: skip
