"""Random skies above a Raman lidar, by a forward model of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.harness.figure import Array
from benchmarks.stability.random_scenes import Failure, ScoredValues
from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.flags import RamanQuality, concerning
from lidarops.retrieve.raman.retrieval import RamanResult, retrieve_raman
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings
from lidarops.retrieve.raman.signals import (
    AirColumn,
    Cells,
    ChannelSignal,
    make_cells,
)

Random = np.random.Generator

_LASER: Final = 354.7e-9
_RAMAN: Final = 386.7e-9
_STEP: Final = 30.0
_RANGE: Final = _STEP * (np.arange(400, dtype=np.float64) + 0.5)
_CELL: Final = 60.0
_FULL_OVERLAP: Final = 300.0
"""That of products."""
_COMPARED: Final = 6000.0
"""m; values below are compared with the truth."""
_EXPONENT: Final = 1.2
_EXPONENT_ERROR: Final = 0.5
_REFERENCE_ERROR: Final = 0.02
_COUNTS: Final = (30.0, 5000.0)
"""Of a Raman bin at 1 km."""
_LIDAR_RATIOS: Final = (25.0, 90.0)
"""sr."""
_TOPS: Final = (2000.0, 5000.0)
"""m; no haze above."""


@dataclass(frozen=True, slots=True)
class _Sky:
    extinction: Array
    """m-1, (bin,)."""
    lidar_ratio: float
    exponent: float = _EXPONENT
    assumed_error: float = 0.0
    """Stated error of the exponent."""
    aloft: float = 0.0
    """Particle over molecular backscatter in the reference window."""
    reference_error: float = 0.0
    lacking: float = 0.0
    """Of the overlap where it is stated to be full."""
    scale: float = 1.0
    """m, over which that falls."""


def _hazy(rng: Random) -> _Sky:
    """Return haze that falls with height and ends smoothly."""
    amount, scale = np.exp(rng.uniform(np.log(2e-5), np.log(3e-4))), rng.uniform(800.0, 3000.0)
    top = 1.0 + np.exp((_RANGE - rng.uniform(*_TOPS)) / 300.0)
    return _Sky(amount * np.exp(-_RANGE / scale) / top, float(rng.uniform(*_LIDAR_RATIOS)))


def _of_other_colour(sky: _Sky, rng: Random) -> _Sky:
    off = _EXPONENT_ERROR * float(np.clip(rng.normal(), -3.0, 3.0))
    return replace(sky, exponent=_EXPONENT + off, assumed_error=_EXPONENT_ERROR)


def _with_particles_aloft(sky: _Sky, rng: Random) -> _Sky:
    return replace(sky, aloft=float(rng.uniform(0.0, 0.05)), reference_error=_REFERENCE_ERROR)


def _with_overlap(sky: _Sky, rng: Random) -> _Sky:
    return replace(sky, lacking=0.05, scale=float(rng.uniform(50.0, 300.0)))


_COLOUR: Final = "two wavelengths do not show the colour of extinction: the stated error covers it"
_ALIKE: Final = "particles that are mixed as air is look like air in the reference window"
_NEAR: Final = "what overlap lacks looks like extinction: the stated error covers it"
FAILURES: Final[tuple[tuple[Failure, Callable[[_Sky, Random], _Sky]], ...]] = (
    (Failure("none", satisfied=True), lambda sky, _: sky),
    (Failure("Angstrom exponent off as stated", unseen=_COLOUR), _of_other_colour),
    (Failure("particles in the reference window", unseen=_ALIKE), _with_particles_aloft),
    (Failure("overlap 5 percent off", unseen=_NEAR), _with_overlap),
)


def _along(values: Array) -> Array:
    """Return the integral from the lidar to the middle of each bin."""
    return np.asarray(np.cumsum(values) * _STEP - 0.5 * values * _STEP)


def _air() -> tuple[AirColumn, Cells]:
    molecules = MolecularProfile.us_standard()
    air = AirColumn(
        range=_RANGE,
        backscatter=molecules.backscatter(_RANGE, _LASER),
        depth=_along(molecules.extinction(_RANGE, _LASER)),
        raman_depth=_along(molecules.extinction(_RANGE, _RAMAN)),
        density=molecules.number_density(_RANGE),
        overlap=np.where(_RANGE >= _FULL_OVERLAP, 1.0, np.nan),
        wavelength=_LASER,
        raman_wavelength=_RAMAN,
    )
    return air, make_cells(_RANGE, _RANGE[-1] + _STEP, _CELL)


def _counts(sky: _Sky, air: AirColumn, light: float) -> tuple[Array, Array, Array]:
    """Return mean counts of the Raman and the elastic signal, and particle backscatter."""
    seen = np.minimum(_RANGE / _FULL_OVERLAP, 1.0) ** 2
    beyond = np.maximum(_RANGE - _FULL_OVERLAP, 0.0)
    seen = seen * (1.0 - sky.lacking * np.exp(-beyond / sky.scale))
    particles = _along(sky.extinction)
    longer = (_LASER / _RAMAN) ** sky.exponent
    raman = seen * air.density / _RANGE**2
    raman = raman * np.exp(-air.depth - air.raman_depth - (1.0 + longer) * particles)
    backscatter = sky.extinction / sky.lidar_ratio + sky.aloft * air.backscatter * (
        _RANGE > _COMPARED
    )
    elastic = seen * (air.backscatter + backscatter) / _RANGE**2
    elastic = elastic * np.exp(-2.0 * air.depth - 2.0 * particles)
    at = int(np.searchsorted(_RANGE, 1000.0))
    return light * raman / raman[at], 3.0 * light * elastic / elastic[at], backscatter


def _signal(counts: Array) -> ChannelSignal:
    rows, bins = counts.shape
    variance = np.broadcast_to(np.maximum(counts.mean(axis=0), 1e-3), counts.shape)
    zero = np.zeros(rows)
    return ChannelSignal(counts, variance, zero, zero, np.zeros((1, bins)), np.ones(rows))


def score_raman(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield extinctions, backscatters and lidar ratios of profiles of one random sky."""
    air, cells = _air()
    partial = np.isnan(cells.split(air.overlap)).any(axis=-1)
    quality = np.where(partial, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    for number, (failure, change) in enumerate(FAILURES):
        rng = np.random.default_rng((88, cluster, number))
        sky = change(_hazy(rng), rng)
        light = float(np.exp(rng.uniform(np.log(_COUNTS[0]), np.log(_COUNTS[1]))))
        raman, elastic, backscatter = _counts(sky, air, light)
        signals = [
            _signal(rng.poisson(mean, (profiles, mean.size)).astype(float))
            for mean in (raman, elastic)
        ]
        settings = RamanSettings(
            reference=RamanReference(relative_error=sky.reference_error),
            angstrom_exponent=_EXPONENT,
            angstrom_standard_error=sky.assumed_error,
            molecular_relative_error=0.0,
            overlap_relative_error=0.0,
        )
        bits = np.repeat(quality[np.newaxis], profiles, axis=0)
        result = retrieve_raman(signals[0], signals[1], air, cells, settings, quality=bits)
        yield from _scored(failure, sky, cells, cells.mean(backscatter), result)


def _scored(
    failure: Failure, sky: _Sky, cells: Cells, backscatter: Array, result: RamanResult
) -> Iterator[ScoredValues]:
    inside = cells.range < _COMPARED
    length = np.where(np.isnan(result.vertical_resolution), _CELL, result.vertical_resolution)
    whole = np.concatenate([[0.0], np.cumsum(sky.extinction)]) * _STEP
    edges = _STEP * np.arange(whole.size)
    low = np.maximum(cells.range - 0.5 * length, 0.0)
    high = np.minimum(cells.range + 0.5 * length, edges[-1])
    extinction = (np.interp(high, edges, whole) - np.interp(low, edges, whole)) / (high - low)
    none = np.zeros_like(result.quality)
    for quantity, name, error, stated in (
        (
            "extinction",
            "aerosol_extinction",
            result.extinction - extinction,
            result.extinction_standard_error,
        ),
        (
            "backscatter",
            "aerosol_backscatter",
            result.backscatter - backscatter,
            result.backscatter_standard_error,
        ),
        (
            "lidar ratio",
            "lidar_ratio",
            result.lidar_ratio - sky.lidar_ratio,
            result.lidar_ratio_standard_error,
        ),
    ):
        yield ScoredValues(
            failure, quantity, error[:, inside], stated[:, inside], 0.0,
            concerning(name, result.quality, none)[:, inside], RamanQuality,
        )  # fmt: skip
