"""Random skies above a vertical lidar, and skies that are not as assumed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.stability.random_scenes import VISIBLE, Failure, Judged, Mask
from lidarops.bench.stability.stiff_cases import Array
from lidarops.campaign.product_settings import ReferenceSettings
from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.background import known_shape
from lidarops.retrieve.elastic import inversion, layers, outlying_bins, reference_window

Random = np.random.Generator

_RATIO_ERROR: Final = 0.2
"""Declared relative standard error of the lidar ratio."""
_AIR_ERROR: Final = 0.02
"""Declared, of the density of the air."""
_REFERENCE_ERROR: Final = ReferenceSettings().relative_error
"""Declared, of the scattering ratio of the reference window: as products do."""
_CARRIED: Final = 1.5
"""Standard errors of the window's mean that particles in it may add unseen."""
_CLEAN_FROM: Final = 6000.0
_COMPARED: Final = (500.0, 6000.0)
_STEPS: Final = 30
"""Of Newton's method."""
_SHOTS: Final = elastic_cases.SHOTS


@dataclass(frozen=True, slots=True)
class RandomSky:
    """What is there, (range,) each; the retrieval is told of none of it."""

    particles: Array
    """m-1 sr-1."""
    lidar_ratio: float
    """sr."""
    density: float = 1.0
    """Of the air, over that which is told."""
    background: float = 0.0
    """Counts that the far range shows more than the near one (a slow baseline)."""
    cloud: float = 0.0
    """Optical depth of a cloud at 9 km."""
    overlap: float = 0.0
    """m, scale of an overlap that is not told."""
    gaps: float = 0.0
    """Share of the bins that are missing."""
    wild: float = 0.0
    """Share of the bins that lie off, each on its own."""


def _sky(rng: Random) -> RandomSky:
    """Return haze in a mixed layer and a layer aloft, none from 6 km on."""
    z = elastic_cases.RANGE
    top, amount = rng.uniform(500.0, 3000.0), np.exp(rng.uniform(np.log(1e-7), np.log(1e-5)))
    mixed = amount / (1.0 + np.exp((z - top) / rng.uniform(50.0, 200.0)))
    middle, half = rng.uniform(3500.0, 5000.0), rng.uniform(200.0, 900.0)
    aloft = rng.uniform(0.0, 1.0) * amount * np.exp(-0.5 * ((z - middle) / (0.3 * half)) ** 2)
    found = np.where(z < _CLEAN_FROM, mixed + aloft, 0.0)
    return RandomSky(found, elastic_cases.LIDAR_RATIO)


def _ratio(sky: RandomSky, rng: Random) -> RandomSky:
    deviate = np.clip(rng.normal(), -3.0, 3.0)
    return replace(sky, lidar_ratio=sky.lidar_ratio * (1.0 + _RATIO_ERROR * deviate))


def _as_is(sky: RandomSky, _: Random) -> RandomSky:
    return sky


def _hazy(sky: RandomSky, rng: Random, *, least: float = 1e-9) -> RandomSky:
    haze = np.exp(rng.uniform(np.log(least), np.log(100.0 * least)))
    return replace(sky, particles=sky.particles + haze * np.exp(-elastic_cases.RANGE / 5000.0))


def _hazier(sky: RandomSky, rng: Random) -> RandomSky:
    return _hazy(sky, rng, least=1e-8)


def _dense(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, density=1.0 + _AIR_ERROR * float(np.clip(rng.normal(), -3.0, 3.0)))


def _drifting(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, background=rng.uniform(0.0, 3.0))


def _clouded(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, cloud=float(np.exp(rng.uniform(np.log(0.01), np.log(3.0)))))


def _partly_seen(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, overlap=rng.uniform(50.0, 300.0))


def _holed(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, gaps=rng.uniform(0.0, 0.2))


def _wild(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, wild=rng.uniform(0.0, 0.02))


def _bent_ratio(sky: RandomSky, rng: Random) -> RandomSky:
    return replace(sky, lidar_ratio=sky.lidar_ratio * float(rng.choice([0.5, 2.0])))


_DECLARED: Final = "no elastic signal tells the lidar ratio: the declared error has to cover it"
_ALIKE: Final = (
    "haze that falls off nearly as the air does looks like air in the window: only the declared"
    " error of the scattering ratio there can cover it"
)
_NEAR: Final = "a signal that is too low near the lidar is a signal of less haze"
FAILURES: Final[tuple[tuple[Failure, Callable[[RandomSky, Random], RandomSky]], ...]] = (
    (Failure("none", satisfied=True), _as_is),
    (Failure("gaps", satisfied=True), _holed),
    (Failure("lidar ratio off as declared", unseen=_DECLARED), _ratio),
    (Failure("lidar ratio off by a factor of 2", unseen=_DECLARED), _bent_ratio),
    (Failure("density of the air off as declared"), _dense),
    (Failure("haze at all heights", unseen=_ALIKE), _hazy),
    (Failure("slow baseline"), _drifting),
    (Failure("cloud in the far range"), _clouded),
    (Failure("overlap error", unseen=_NEAR), _partly_seen),
    (Failure("more haze than is declared", unseen=_ALIKE), _hazier),
    (Failure("outliers"), _wild),
)


def _signal(sky: RandomSky) -> Array:
    """Return counts of a shot without noise; optical depth by trapezoids of a fifth of a bin."""
    air = MolecularProfile.us_standard()
    r = elastic_cases.RANGE
    fine = np.linspace(0.0, r[-1], 5 * (2 * r.size - 1) + 1)
    wavelength = elastic_cases.WAVELENGTH
    molecules = sky.density * air.extinction(fine, wavelength)
    base = sky.cloud * np.exp(-0.5 * ((fine - 9000.0) / 150.0) ** 2) / (150.0 * 2.5066282746)
    haze = np.interp(fine, r, sky.particles)
    along = molecules + sky.lidar_ratio * haze + base
    depth = np.concatenate([[0.0], np.cumsum(0.5 * (along[1:] + along[:-1]) * np.diff(fine))])
    cloud = np.interp(r, fine, base) / 20.0
    scattered = sky.particles + cloud + sky.density * air.backscatter(r, wavelength)
    signal = scattered * np.exp(-2.0 * np.interp(r, fine, depth)) / r**2
    if sky.overlap:
        signal = signal * (1.0 - np.exp(-((r / sky.overlap) ** 2)))
    bright = signal[r > elastic_cases.OVERLAP].max()
    return np.asarray(signal / bright)


@dataclass(frozen=True, slots=True)
class _Found:
    """What is made of profiles of one sky."""

    background: known_shape.KnownShapeResult
    clouds: layers.Layers
    window: reference_window.ReferenceWindow
    solved: inversion.ElasticResult


def _process(counts: Array, noise: Array, base: elastic_cases.SimulatedSky) -> _Found:
    r = base.range
    with np.errstate(invalid="ignore"):
        rough = np.nanmedian(counts[:, -r.size // 10 :], axis=1)
    bridged = outlying_bins.bridge_outliers(counts, r, noise, background=rough)
    counts, noise = np.asarray(bridged.power, dtype=np.float64), bridged.variance
    found = known_shape.fit_known_shape(counts, r, base.shape, variance=noise)
    power = np.where(base.inverted, counts - found.background[:, np.newaxis], np.nan)
    clouds = layers.find_layers(power, r, noise, molecular_attenuated=base.shape)
    window = reference_window.choose_reference(
        power, r, noise, molecular_attenuated=base.shape,
        candidates=elastic_cases.CANDIDATES, exclude=clouds.mask,
    )  # fmt: skip
    solved = _solve(power, noise, base, window.edges, _doubts(found, window))
    return _Found(found, clouds, window, solved)


def _doubts(found: known_shape.KnownShapeResult, window: reference_window.ReferenceWindow) -> Array:
    """Return standard errors of the background and relative ones of the reference."""
    unseen = np.nan_to_num(_CARRIED * window.scale_standard_error / window.scale)
    background = np.nan_to_num(found.background_standard_error)
    return np.stack([background, np.hypot(_REFERENCE_ERROR, unseen)])


def _solve(
    power: Array,
    noise: Array,
    base: elastic_cases.SimulatedSky,
    edges: tuple[Array, Array],
    doubts: Array,
) -> inversion.ElasticResult:
    return inversion.invert_elastic(
        power, base.range, molecular_backscatter=base.molecular_backscatter,
        molecular_extinction=base.molecular_extinction, lidar_ratio=elastic_cases.LIDAR_RATIO,
        reference=edges, variance=noise, background_standard_error=doubts[0],
        lidar_ratio_standard_error=_RATIO_ERROR * elastic_cases.LIDAR_RATIO,
        reference_relative_error=doubts[1], molecular_relative_error=_AIR_ERROR,
    )  # fmt: skip


def visible_departure(
    mean: Array, noise: Array, base: elastic_cases.SimulatedSky, found: _Found
) -> Array:
    """Return (profile,) what the model cannot take up of signals without noise.

    What is assumed leaves few signs: the bins that give the background and those of the
    reference window have the shape of air, and nowhere is there less than air. So it is the norm
    of three misfits: that of the fit of the background, that of air in the window, and that of
    bins of negative backscatter after the declared causes have done what they can to raise them,
    each standard error of theirs counted as one of noise. The first two share bins, which makes
    more of it than there is: less is taken for hidden.

    Parameters
    ----------
    mean, noise : (range,) float
        Signals with their background, without noise, and the variance of it.
    base : elastic_cases.Sky
    found : _Found
        What was made of (profile, range) noisy signals: the windows that were chosen.
    """
    # Profiles of the same windows have the same misfits.
    chosen = np.stack([found.background.start, found.background.stop, *found.window.edges], -1)
    _, first, which = np.unique(
        np.nan_to_num(chosen), axis=0, return_index=True, return_inverse=True
    )
    starts, stops, bottom, top = chosen[first].T
    rows = np.broadcast_to(mean, (first.size, mean.size))
    fitted = known_shape.fit_known_shape(
        rows, base.range, base.shape, variance=noise, start=starts, stop=stops
    )
    power = np.where(base.inverted, rows - fitted.background[:, np.newaxis], np.nan)
    inside = (base.range >= bottom[:, np.newaxis]) & (base.range <= top[:, np.newaxis])
    inside &= base.inverted
    weight = np.where(inside, 1.0 / noise, 0.0)
    signal = np.where(inside, power, 0.0)
    norm = np.maximum(np.sum(weight * base.shape**2, axis=1), np.finfo(float).tiny)
    scale = np.sum(weight * base.shape * signal, axis=1) / norm
    misfit = np.sum(weight * (signal - scale[:, np.newaxis] * base.shape) ** 2, axis=1)
    doubts = _doubts(found.background, found.window)
    solved = _solve(
        power, np.broadcast_to(noise, rows.shape), base, (bottom, top), doubts[:, first]
    )
    seen = np.sqrt(fitted.chi2 + misfit + _negative(solved, power, noise))
    return np.asarray(seen[which.reshape(-1)])


def _negative(solved: inversion.ElasticResult, power: Array, noise: Array) -> Array:
    """Return (profile,) chi-square of negative backscatter and of what the causes do against it.

    With the changes B of backscatter over its noise that a standard error of each cause makes,
    it is the least of |k|^2 + sum min(0, y - B k)^2 over the deviates k: by Newton's method.
    """
    total = solved.backscatter + solved.molecular_backscatter
    with np.errstate(invalid="ignore", divide="ignore"):
        own = np.abs(total) * np.sqrt(noise) / np.abs(power)
        known = solved.valid & (own > 0.0) & np.isfinite(own)
        y = np.where(known, solved.backscatter / own, 1.0)
    budget = solved.budget
    causes = (budget.background, budget.reference, budget.lidar_ratio, budget.molecular)
    change = np.stack([np.where(known, c, 0.0) / np.where(known, own, 1.0) for c in causes], -1)
    deviates = np.zeros((len(y), len(causes)))
    before = np.zeros_like(known)
    for _ in range(_STEPS):
        below = y - (change @ deviates[..., np.newaxis])[..., 0] < 0.0
        if np.array_equal(below, before):
            break
        before = below
        active = np.where(below[..., np.newaxis], change, 0.0)
        matrix = np.eye(len(causes)) + np.swapaxes(active, 1, 2) @ active
        side = np.sum(active * np.where(below, y, 0.0)[..., np.newaxis], axis=1)
        deviates = np.linalg.solve(matrix, side[..., np.newaxis])[..., 0]
    left = np.minimum(y - (change @ deviates[..., np.newaxis])[..., 0], 0.0)
    return np.asarray(np.sum(deviates**2, axis=1) + np.sum(left**2, axis=1))


def judge_elastic(cluster: int, profiles: int) -> Iterator[tuple[Judged, int]]:
    """Invert profiles of one random sky, class by class."""
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
        noise = np.broadcast_to(_smoothed(counts), counts.shape)
        if sky.wild:
            counts = counts + np.sqrt(noise) * _deviations(rng, counts.shape, sky.wild)
        found = _process(counts, noise, base)
        hidden = None
        if not failure.satisfied:
            hidden = visible_departure(mean / _SHOTS, noise[0], base, found) < VISIBLE
        if sky.wild:
            # The misfit of signals without noise knows nothing of single bins.
            hidden = np.zeros(profiles, dtype=np.bool_)
        yield _judged(failure, sky, found, base, hidden), profiles


def _deviations(rng: Random, shape: tuple[int, ...], share: float) -> Array:
    """Return by how many standard deviations of the noise bins lie off: 3 to 1000, most by none."""
    size = np.exp(rng.uniform(np.log(3.0), np.log(1e3), shape)) * rng.choice([-1.0, 1.0], shape)
    return np.where(rng.random(shape) < share, size, 0.0)


def _judged(
    failure: Failure,
    sky: RandomSky,
    found: _Found,
    base: elastic_cases.SimulatedSky,
    hidden: Mask | None,
) -> Judged:
    r = base.range
    window, clouds, solved = found.window, found.clouds, found.solved
    inside = (r >= _COMPARED[0]) & (r <= _COMPARED[1])
    bits = np.where(solved.valid, np.int32(0), np.int32(Quality.UNSTABLE_INVERSION))
    bits |= np.where(window.chosen, np.int32(0), np.int32(Quality.NO_REFERENCE))[:, np.newaxis]
    bits |= np.where(clouds.mask, np.int32(Quality.CLOUD), np.int32(0))
    # What rests on a background that its own fit doubts is not to be relied on.
    doubted = np.asarray(found.background.quality) & int(Quality.NOT_HOMOGENEOUS)
    bits |= doubted[:, np.newaxis]
    # As in the product: what lies before a cloud was inverted through it.
    with np.errstate(invalid="ignore"):
        through = (window.top > clouds.cloud_base_range)[:, np.newaxis]
    bits |= np.where(through, np.int32(Quality.CLOUD), np.int32(0))
    budget = solved.budget
    systematic: Any = np.sqrt(
        budget.reference**2 + budget.lidar_ratio**2 + budget.molecular**2 + budget.background**2
    )
    error = (solved.backscatter - sky.particles)[:, inside]
    return Judged(
        failure, "backscatter", error, budget.noise[:, inside], systematic[:, inside],
        bits[:, inside], doubted=(bits[:, inside] & int(Quality.CLOUD)) != 0,
        hidden=None if hidden is None else np.broadcast_to(hidden[:, np.newaxis], error.shape),
    )  # fmt: skip


def _smoothed(counts: Array) -> Array:
    """Return the variance of mean counts from the mean of the profiles."""
    with np.errstate(invalid="ignore"):
        mean = np.nanmean(counts, axis=0)
    return np.asarray(np.maximum(mean, 1.0 / _SHOTS) / _SHOTS)
