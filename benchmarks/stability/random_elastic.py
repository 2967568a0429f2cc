"""Random skies above a vertical lidar, and skies that violate the model of the inversion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr

from benchmarks.accuracy import elastic_cases
from benchmarks.accuracy.elastic_cases import LIDAR_RATIO
from benchmarks.harness.figure import Array, Random
from benchmarks.stability.random_scenes import Failure, ScoredValues
from lidarops.netcdf.variables import ErrorKind
from lidarops.products.elastic.variables import sources
from lidarops.retrieve.air import MolecularProfile
from lidarops.retrieve.clouds.labeled import Reference
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.labeled import constant_ratio
from lidarops.settings import ReferenceSettings

_RATIO_ERROR: Final = 0.2
"""Stated relative standard error of the lidar ratio."""
_AIR_ERROR: Final = 0.02
"""Stated relative standard error of the air density."""
_REFERENCE: Final = Reference(**dict(ReferenceSettings()))
"""That of products."""
_ASSUMED: Final[dict[str, Any]] = {
    "lidar_ratio": constant_ratio(LIDAR_RATIO, _RATIO_ERROR * LIDAR_RATIO),
    "molecular_relative_error": _AIR_ERROR,
    "reference": _REFERENCE,
}
_CLEAN_FROM: Final = 6000.0
"""m; no particles above."""
_COMPARED: Final = (500.0, 6000.0)
"""m; ranges whose values are compared with the truth."""
_CLOUD_RATIO: Final = 20.0
"""sr, lidar ratio of clouds."""
_SHOTS: Final = elastic_cases.SHOTS


@dataclass(frozen=True, slots=True)
class RandomSky:
    """True sky and instrument; the retrieval knows none of it. Arrays are (range,)."""

    particles: Array
    """m-1 sr-1."""
    lidar_ratio: float
    """sr."""
    density: float = 1.0
    """Density of the air over the assumed one."""
    background: float = 0.0
    """Counts of a baseline that falls slowly with range."""
    cloud: float = 0.0
    """Optical depth of a cloud at 9 km."""
    overlap: float = 0.0
    """m, scale of an overlap that the retrieval does not know."""
    gaps: float = 0.0
    """Share of missing bins."""
    outlying: float = 0.0
    """Share of isolated outlying bins."""


def _sky(rng: Random) -> RandomSky:
    """Return a sky with haze in a mixed layer and a layer aloft, none above 6 km."""
    z = elastic_cases.RANGE
    top, amount = rng.uniform(500.0, 3000.0), np.exp(rng.uniform(np.log(1e-7), np.log(1e-5)))
    mixed = amount / (1.0 + np.exp((z - top) / rng.uniform(50.0, 200.0)))
    middle, half = rng.uniform(3500.0, 5000.0), rng.uniform(200.0, 900.0)
    aloft = rng.uniform(0.0, 1.0) * amount * np.exp(-0.5 * ((z - middle) / (0.3 * half)) ** 2)
    particles = np.where(z < _CLEAN_FROM, mixed + aloft, 0.0)
    return RandomSky(particles, LIDAR_RATIO)


_Change = Callable[[RandomSky, Random], RandomSky]


def _hazy(least: float) -> _Change:
    """Return the change that adds haze of `least` to 100 times as much, m-1 sr-1 at the ground."""

    def change(sky: RandomSky, rng: Random) -> RandomSky:
        haze = np.exp(rng.uniform(np.log(least), np.log(100.0 * least)))
        return replace(sky, particles=sky.particles + haze * np.exp(-elastic_cases.RANGE / 5000.0))

    return change


def _clean(sky: RandomSky, _: Random) -> RandomSky:
    """Return the sky without particles at the heights of possible reference windows."""
    z, lowest = elastic_cases.RANGE, _REFERENCE.lowest
    # Smoothly, as in air: 1e-7 of them are left there.
    left = 1.0 / (1.0 + np.exp((z - lowest + 1000.0) / 60.0))
    return replace(sky, particles=np.where(z < lowest, left * sky.particles, 0.0))


def _off(rng: Random, error: float) -> float:
    """Return a factor that deviates by this standard error, at most by 3 of them."""
    return 1.0 + error * float(np.clip(rng.normal(), -3.0, 3.0))


FAILURES: Final[tuple[tuple[Failure, _Change], ...]] = (
    (Failure("none", satisfied=True), _clean),
    (
        Failure("gaps", satisfied=True),
        lambda sky, rng: replace(_clean(sky, rng), gaps=rng.uniform(0.0, 0.2)),
    ),
    (
        Failure("lidar ratio off as stated"),
        lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * _off(rng, _RATIO_ERROR)),
    ),
    (
        Failure("lidar ratio off by a factor of 2"),
        lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * float(rng.choice([0.5, 2.0]))),
    ),
    (
        Failure("density of the air off as stated"),
        lambda sky, rng: replace(sky, density=_off(rng, _AIR_ERROR)),
    ),
    (Failure("haze at all heights"), _hazy(1e-9)),
    (Failure("slow baseline"), lambda sky, rng: replace(sky, background=rng.uniform(0.0, 3.0))),
    (
        Failure("cloud in the far range"),
        lambda sky, rng: replace(sky, cloud=float(np.exp(rng.uniform(np.log(0.01), np.log(3.0))))),
    ),
    (
        Failure("overlap error"),
        lambda sky, rng: replace(sky, overlap=rng.uniform(50.0, 300.0)),
    ),
    (Failure("more haze than stated"), _hazy(1e-8)),
    (Failure("outliers"), lambda sky, rng: replace(sky, outlying=rng.uniform(0.0, 0.02))),
    (Failure("particles in the reference window"), lambda sky, _: sky),
)


def _signal(sky: RandomSky) -> Array:
    """Return the noise-free signal, 1 in the brightest bin that the inversion uses."""
    air, r = MolecularProfile.us_standard(), elastic_cases.RANGE

    def haze(z: Array) -> Array:
        return np.interp(z, r, sky.particles)

    def cirrus(z: Array) -> Array:
        return sky.cloud * np.exp(-0.5 * ((z - 9000.0) / 150.0) ** 2) / (150.0 * 2.5066282746)

    def extinction(z: Array) -> Array:
        molecules = sky.density * air.extinction(z, elastic_cases.WAVELENGTH)
        return molecules + sky.lidar_ratio * haze(z) + cirrus(z)

    def backscatter(z: Array) -> Array:
        molecules = sky.density * air.backscatter(z, elastic_cases.WAVELENGTH)
        return np.asarray(haze(z) + cirrus(z) / _CLOUD_RATIO + molecules)

    signal = elastic_cases.clean_signal(extinction, backscatter)
    if sky.overlap:
        signal = signal * (1.0 - np.exp(-((r / sky.overlap) ** 2)))
    return np.asarray(signal / signal[r > elastic_cases.OVERLAP].max())


def score_elastic(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield the scored values of profiles of one random sky, class by class."""
    base = elastic_cases.simulated_sky()
    for number, (failure, change) in enumerate(FAILURES):
        rng = np.random.default_rng((74, cluster, number))
        sky = change(_sky(rng), rng)
        brightest = np.exp(rng.uniform(np.log(1e4), np.log(1e8)))
        level = np.exp(rng.uniform(np.log(1.0), np.log(1e5)))
        signal = brightest * np.minimum(_signal(sky), 1.0)
        fading = sky.background * np.exp(-base.range / 8000.0)
        mean = _SHOTS * (signal + level + fading)
        counts = rng.poisson(np.broadcast_to(mean, (profiles, mean.size))) / _SHOTS
        if sky.gaps:
            counts = np.where(rng.random(counts.shape) < sky.gaps, np.nan, counts)
        noise = elastic_cases.count_variance(counts)
        if sky.outlying:
            counts = counts + np.sqrt(noise) * _deviations(rng, counts.shape, sky.outlying)
        product = elastic_cases.invert(counts, base, noise=noise, **_ASSUMED)
        yield _scored(failure, sky, product)


def _deviations(rng: Random, shape: tuple[int, ...], share: float) -> Array:
    """Return the deviations of bins in standard deviations of the noise: 0, or 3 to 1000."""
    size = np.exp(rng.uniform(np.log(3.0), np.log(1e3), shape)) * rng.choice([-1.0, 1.0], shape)
    return np.where(rng.random(shape) < share, size, 0.0)


def _scored(failure: Failure, sky: RandomSky, product: xr.Dataset) -> ScoredValues:
    r = elastic_cases.RANGE
    inside = (r >= _COMPARED[0]) & (r <= _COMPARED[1])

    def values(name: str) -> Any:
        return product[name].to_numpy()[:, inside]

    def error(kind: ErrorKind) -> Array:
        parts = [values(f"aerosol_backscatter_error_{cause}") for cause in sources(kind)]
        return np.asarray(np.sqrt(sum(part**2 for part in parts)))

    bits = values("quality_flag")
    # As products average them: what is independent between profiles is random.
    return ScoredValues(
        failure, "backscatter", values("aerosol_backscatter") - sky.particles[inside],
        error(ErrorKind.RANDOM), error(ErrorKind.SYSTEMATIC), bits, ElasticQuality,
        uncertain=(bits & int(ElasticQuality.CLOUD)) != 0,
    )  # fmt: skip
