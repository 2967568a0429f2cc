"""Random skies above a vertical lidar, and skies that violate the model of the inversion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.accuracy import elastic_cases
from benchmarks.harness.figure import Array, Mask
from benchmarks.stability.random_scenes import Failure, ScoredValues
from lidarops.flags import Quality
from lidarops.netcdf.variables import ErrorKind
from lidarops.products.elastic.variables import sources
from lidarops.retrieve.air import MolecularProfile, reference_window
from lidarops.retrieve.air.reference_window import THRESHOLDS as WINDOW_THRESHOLDS
from lidarops.retrieve.background import known_shape
from lidarops.retrieve.clouds import outlying_bins
from lidarops.retrieve.elastic import inversion
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.settings import ReferenceSettings

Random = np.random.Generator

_RATIO_ERROR: Final = 0.2
"""Stated relative standard error of the lidar ratio."""
_AIR_ERROR: Final = 0.02
"""Stated relative standard error of the air density."""
_REFERENCE: Final = ReferenceSettings()
"""That of products."""
_WINDOWS: Final = reference_window.candidate_windows(
    _REFERENCE.lowest, _REFERENCE.highest, _REFERENCE.width,
    _REFERENCE.width / WINDOW_THRESHOLDS.steps_per_window,
)  # fmt: skip
_CLEAN_FROM: Final = 6000.0
"""m; no particles above."""
_COMPARED: Final = (500.0, 6000.0)
"""m; ranges whose values are compared with the truth."""
_CLOUD_RATIO: Final = 20.0
"""sr, lidar ratio of clouds."""
_STEPS: Final = 30
"""Most iterations of Newton's method."""
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
    return RandomSky(particles, elastic_cases.LIDAR_RATIO)


_STATED: Final = (
    "an elastic signal contains no information on the lidar ratio: the stated error has to cover it"
)
_ALIKE: Final = (
    "haze that falls with height nearly as air does looks like air in the window: only the stated"
    " error of the scattering ratio there can cover it"
)
_HIDDEN: Final = (
    "noise hides few particles in the window: only the stated error of the scattering ratio there"
    " can cover them"
)
_NEAR: Final = "a signal that is too low near the lidar looks like less haze"
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
        Failure("lidar ratio off as stated", unseen=_STATED),
        lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * _off(rng, _RATIO_ERROR)),
    ),
    (
        Failure("lidar ratio off by a factor of 2", unseen=_STATED),
        lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * float(rng.choice([0.5, 2.0]))),
    ),
    (
        Failure("density of the air off as stated"),
        lambda sky, rng: replace(sky, density=_off(rng, _AIR_ERROR)),
    ),
    (Failure("haze at all heights", unseen=_ALIKE), _hazy(1e-9)),
    (Failure("slow baseline"), lambda sky, rng: replace(sky, background=rng.uniform(0.0, 3.0))),
    (
        Failure("cloud in the far range"),
        lambda sky, rng: replace(sky, cloud=float(np.exp(rng.uniform(np.log(0.01), np.log(3.0))))),
    ),
    (
        Failure("overlap error", unseen=_NEAR),
        lambda sky, rng: replace(sky, overlap=rng.uniform(50.0, 300.0)),
    ),
    (Failure("more haze than stated", unseen=_ALIKE), _hazy(1e-8)),
    (Failure("outliers"), lambda sky, rng: replace(sky, outlying=rng.uniform(0.0, 0.02))),
    (Failure("particles in the reference window", unseen=_HIDDEN), lambda sky, _: sky),
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


@dataclass(frozen=True, slots=True)
class _Processed:
    """Results of all steps for the profiles of one sky."""

    background: known_shape.KnownShapeResult
    clouds: Mask
    window: reference_window.ReferenceWindow
    solved: inversion.ElasticResult


def _process(counts: Array, noise: Array, base: elastic_cases.SimulatedSky) -> _Processed:
    r = base.range
    with np.errstate(invalid="ignore"):
        rough = np.nanmedian(counts[:, -r.size // 10 :], axis=1)
    bridged = outlying_bins.bridge_outliers(counts, r, noise, background=rough)
    counts, noise = np.asarray(bridged.power, dtype=np.float64), bridged.variance
    fit = known_shape.fit_known_shape(counts, r, base.shape, variance=noise)
    power = elastic_cases.subtract_background(counts, base, fit.background)
    clouds = elastic_cases.find_clouds(power, noise, base)
    window = elastic_cases.choose_window(
        power, noise, base, clouds, background_error=fit.background_standard_error,
        candidates=_WINDOWS,
    )  # fmt: skip
    return _Processed(fit, clouds, window, _solve(power, noise, base, fit, window))


def _solve(
    power: Array,
    noise: Array,
    base: elastic_cases.SimulatedSky,
    fit: known_shape.KnownShapeResult,
    window: reference_window.ReferenceWindow,
    rows: Any = slice(None),
) -> inversion.ElasticResult:
    """Return the inversion with the background errors and windows of some rows."""
    bottom, top = window.edges
    return elastic_cases.invert_particles(
        power, base, (bottom[rows], top[rows]), noise=noise,
        background_error=np.nan_to_num(fit.background_standard_error)[rows],
        reference_error=window.relative_error(_REFERENCE.relative_error)[rows],
        assumed_errors=(_RATIO_ERROR, _AIR_ERROR),
    )  # fmt: skip


def visible_misfit_of_sky(
    mean: Array, noise: Array, base: elastic_cases.SimulatedSky, processed: _Processed
) -> Array:
    """Return the misfit of noise-free signals that the model cannot absorb, (profile,).

    The assumptions can be tested in three ways: the bins of the background fit and those of the
    reference window have the shape of air, and backscatter is not below that of air. So the
    result is the norm of three misfits: of the fit of the background, of air in the window, and
    of negative backscatter after the stated causes of error have raised it as far as possible,
    with each of their standard errors counted like one of noise. The first two share bins, which
    overestimates the misfit, so fewer violations count as hidden.

    Parameters
    ----------
    mean, noise : (range,) float
        Noise-free signal with its background, and the variance of the noise.
    base : elastic_cases.SimulatedSky
    processed : _Processed
        Results for (profile, range) noisy signals, with their reference windows.
    """
    # Profiles with the same windows have the same misfit.
    chosen = np.stack(
        [processed.background.start, processed.background.stop, *processed.window.edges], -1
    )
    _, first, index = np.unique(
        np.nan_to_num(chosen), axis=0, return_index=True, return_inverse=True
    )
    starts, stops, bottom, top = chosen[first].T
    rows = np.broadcast_to(mean, (first.size, mean.size))
    fit = known_shape.fit_known_shape(
        rows, base.range, base.shape, variance=noise, start=starts, stop=stops
    )
    power = elastic_cases.subtract_background(rows, base, fit.background)
    inside = (base.range >= bottom[:, np.newaxis]) & (base.range <= top[:, np.newaxis])
    inside &= base.inverted
    weight = np.where(inside, 1.0 / noise, 0.0)
    signal = np.where(inside, power, 0.0)
    norm = np.maximum(np.sum(weight * base.shape**2, axis=1), np.finfo(float).tiny)
    scale = np.sum(weight * base.shape * signal, axis=1) / norm
    misfit = np.sum(weight * (signal - scale[:, np.newaxis] * base.shape) ** 2, axis=1)
    noises = np.broadcast_to(noise, rows.shape)
    solved = _solve(power, noises, base, processed.background, processed.window, first)
    misfits = np.sqrt(fit.chi2 + misfit + _negative_chi_square(solved, power, noise))
    return np.asarray(misfits[index.reshape(-1)])


def _negative_chi_square(solved: inversion.ElasticResult, power: Array, noise: Array) -> Array:
    """Return the chi-square of negative backscatter and of the causes that raise it, (profile,).

    With B, the change of backscatter over its noise by one standard error of each cause, it is
    the minimum of |k|^2 + sum min(0, y - B k)^2 over the deviates k, by Newton's method.
    """
    total = solved.backscatter + solved.molecular_backscatter
    with np.errstate(invalid="ignore", divide="ignore"):
        noise_error = np.abs(total) * np.sqrt(noise) / np.abs(power)
        usable = solved.valid & (noise_error > 0.0) & np.isfinite(noise_error)
        y = np.where(usable, solved.backscatter / noise_error, 1.0)
    budget = solved.budget
    causes = [budget[name] for name in ("background", "reference", "lidar_ratio", "molecular")]
    change = np.stack(
        [np.where(usable, c, 0.0) / np.where(usable, noise_error, 1.0) for c in causes], -1
    )
    deviates = np.zeros((len(y), len(causes)))
    before = np.zeros_like(usable)
    for _ in range(_STEPS):
        below = y - (change @ deviates[..., np.newaxis])[..., 0] < 0.0
        if np.array_equal(below, before):
            break
        before = below
        active = np.where(below[..., np.newaxis], change, 0.0)
        matrix = np.eye(len(causes)) + np.swapaxes(active, 1, 2) @ active
        side = np.sum(active * np.where(below, y, 0.0)[..., np.newaxis], axis=1)
        deviates = np.linalg.solve(matrix, side[..., np.newaxis])[..., 0]
    remainder = np.minimum(y - (change @ deviates[..., np.newaxis])[..., 0], 0.0)
    return np.asarray(np.sum(deviates**2, axis=1) + np.sum(remainder**2, axis=1))


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
        noise = np.broadcast_to(_mean_variance(counts), counts.shape)
        if sky.outlying:
            counts = counts + np.sqrt(noise) * _deviations(rng, counts.shape, sky.outlying)
        processed = _process(counts, noise, base)
        misfit = None
        if not failure.satisfied:
            misfit = visible_misfit_of_sky(mean / _SHOTS, noise[0], base, processed)
        if sky.outlying:
            # The misfit of noise-free signals does not include outlying bins.
            misfit = np.full(profiles, np.inf)
        yield _scored(failure, sky, processed, base, misfit)


def _deviations(rng: Random, shape: tuple[int, ...], share: float) -> Array:
    """Return the deviations of bins in standard deviations of the noise: 0, or 3 to 1000."""
    size = np.exp(rng.uniform(np.log(3.0), np.log(1e3), shape)) * rng.choice([-1.0, 1.0], shape)
    return np.where(rng.random(shape) < share, size, 0.0)


def _scored(
    failure: Failure,
    sky: RandomSky,
    processed: _Processed,
    base: elastic_cases.SimulatedSky,
    misfit: Array | None,
) -> ScoredValues:
    r = base.range
    window, clouds, solved = processed.window, processed.clouds, processed.solved
    inside = (r >= _COMPARED[0]) & (r <= _COMPARED[1])
    bits = np.where(solved.valid, np.int32(0), np.int32(ElasticQuality.UNSTABLE_INVERSION))
    bits |= np.where(window.chosen, np.int32(0), np.int32(ElasticQuality.NO_REFERENCE))[
        :, np.newaxis
    ]
    bits |= np.where(clouds, np.int32(ElasticQuality.CLOUD), np.int32(0))
    # Values with an uncertain background are rejected.
    uncertain = np.asarray(processed.background.quality) & int(Quality.NOT_HOMOGENEOUS)
    bits |= uncertain[:, np.newaxis]
    # As in the product: bins below a cloud were inverted through it.
    with np.errstate(invalid="ignore"):
        base_of_cloud = np.where(clouds.any(axis=-1), r[np.argmax(clouds, axis=-1)], np.nan)
        behind_cloud = (window.top > base_of_cloud)[:, np.newaxis]
    bits |= np.where(behind_cloud, np.int32(ElasticQuality.CLOUD), np.int32(0))
    # As products average them: what is independent between profiles is random.
    random = _error(solved.budget, sources(ErrorKind.RANDOM))
    systematic = _error(solved.budget, sources(ErrorKind.SYSTEMATIC))
    error = (solved.backscatter - sky.particles)[:, inside]
    return ScoredValues(
        failure, "backscatter", error, random[:, inside], systematic[:, inside],
        bits[:, inside], ElasticQuality,
        uncertain=(bits[:, inside] & int(ElasticQuality.CLOUD)) != 0,
        misfit=None if misfit is None else np.broadcast_to(misfit[:, np.newaxis], error.shape),
    )  # fmt: skip


def _error(budget: dict[str, Array], causes: Iterable[str]) -> Array:
    """Return the error by these causes together."""
    return np.asarray(np.sqrt(sum(budget[cause] ** 2 for cause in causes)))


def _mean_variance(counts: Array) -> Array:
    """Return the variance of mean counts from the mean of the profiles."""
    with np.errstate(invalid="ignore"):
        mean = np.nanmean(counts, axis=0)
    return np.asarray(np.maximum(mean, 1.0 / _SHOTS) / _SHOTS)
