"""Random scans, each with one class of violated assumptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy import multiangle_cases
from benchmarks.accuracy.multiangle_cases import Scan, Scene
from benchmarks.harness.figure import Array
from benchmarks.harness.rates import Failure, ScoredValues, held_first
from lidarops.retrieve.multiangle import optical_depth
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

Random = np.random.Generator

_CALM: Final = (5e-3, 0.4)
"""Scatter of calm air, drawn uniformly in its logarithm."""
_UNCERTAIN: Final = MultiAngleQuality.NO_RESIDUAL | MultiAngleQuality.POOR_STRATIFICATION
"""Bits of values whose stated uncertainty may be too small."""
_LAYER_WIDTH: Final = (2.0, 4.0)
"""Standard deviation of a layer in altitude steps: 5 to 9 of them are its width at half maximum."""

_LAYER_CELLS: Final = (3, 11)
"""Least and most altitude steps of a layer with edges."""


def _level(scene: Scene, _: Random) -> Scene:
    return replace(scene, outliers=0.0, gradient=0.0, variation=0.0)


def _calm(scene: Scene, rng: Random) -> Scene:
    """Return level air with little scatter, which makes stated errors small."""
    return replace(_level(scene, rng), inhomogeneity=_logarithmic(rng, _CALM))


def _layer(scene: Scene, rng: Random, shape: Callable[[Random, Array], Array]) -> Scene:
    """Return calm clear air with a layer, of a shape by altitude steps from its centre."""
    height = 150.0 + 60.0 * np.arange(60, dtype=np.float64)
    air, haze = 1e-5 * np.exp(-height / 8000.0), np.exp(-height / rng.uniform(600.0, 3000.0))
    centre = rng.uniform(height[3], height[-4], (len(scene.extinction), 1))
    excess = rng.uniform(0.3, 3.0) * shape(rng, (height - centre) / 60.0)
    particles = _logarithmic(rng, (2e-5, 4e-4)) * (haze + excess)
    return replace(
        _calm(scene, rng), altitude=height, extinction=air + particles,
        backscatter=air / 8.4 + particles / 50.0,
    )  # fmt: skip


def _smooth(rng: Random, away: Array) -> Array:
    """Return a shape that several altitudes resolve."""
    return np.asarray(np.exp(-0.5 * (away / rng.uniform(*_LAYER_WIDTH)) ** 2))


def _with_edges(rng: Random, away: Array) -> Array:
    """Return a shape that begins and ends between two altitudes."""
    half = 0.5 * rng.integers(*_LAYER_CELLS, endpoint=True)
    return np.where((away >= -half) & (away < half), 1.0, 0.0)


def _logarithmic(rng: Random, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def _outliers(scene: Scene, rng: Random) -> Scene:
    return replace(_level(scene, rng), outliers=rng.uniform(0.01, 0.1))


def _gradient(scene: Scene, rng: Random, *, times: float = 1.0) -> Scene:
    slope = rng.uniform(0.2, 1.0) * optical_depth.LARGEST_GRADIENT * rng.choice([-1.0, 1.0])
    return replace(_level(scene, rng), gradient=times * float(slope))


def _two_sided(scene: Scene, rng: Random) -> Scene:
    largest = scene.zenith_angle[-1]
    angles = np.linspace(-largest, largest, scene.zenith_angle.size)
    return replace(_gradient(scene, rng, times=2.0), zenith_angle=angles)


def _variation(scene: Scene, rng: Random, *, two_sided: bool = False) -> Scene:
    scene = _two_sided(scene, rng) if two_sided else scene
    return replace(_level(scene, rng), variation=rng.uniform(0.3, 1.0))


def _as_drawn(scene: Scene, _: Random) -> Scene:
    return scene


def _with_gaps(scan: Scan, rng: Random) -> Scan:
    signal = scan.signal.copy()
    signal[rng.random(signal.shape) < rng.uniform(0.0, 0.4)] = np.nan
    first = rng.integers(0, signal.shape[-1])
    signal[..., first : first + rng.integers(0, 10)] = np.nan
    return replace(scan, signal=signal)


def _with_overlap(scan: Scan, rng: Random) -> Scan:
    distance = scan.scene.path[:, np.newaxis] * scan.scene.altitude
    overlap = 1.0 - rng.uniform(0.0, 0.2) * np.exp(-distance / rng.uniform(50.0, 1000.0))
    return replace(scan, signal=scan.signal * overlap)


def _with_background(scan: Scan, rng: Random) -> Scan:
    """Add to each beam a background error of a fraction of the noise of one altitude."""
    left = rng.normal(0.0, rng.uniform(0.0, 0.3), (*scan.signal.shape[:2], 1))
    return replace(scan, signal=scan.signal + left * np.sqrt(scan.variance))


def _plain(scan: Scan, _: Random) -> Scan:
    return scan


_Change = Callable[[Scene, Random], Scene]
_Damage = Callable[[Scan, Random], Scan]

FAILURES: Final[tuple[tuple[Failure, _Change, _Damage], ...]] = (
    (Failure("none", satisfied=True), _level, _plain),
    (Failure("gaps", satisfied=True), _level, _with_gaps),
    (Failure("outliers"), _outliers, _plain),
    (Failure("gradient within the declared one, one side"), _gradient, _plain),
    (
        Failure("gradient up to twice the declared one, one side"),
        partial(_gradient, times=2.0),
        _plain,
    ),
    (Failure("gradient up to twice the declared one, two sides"), _two_sided, _plain),
    (Failure("extinction that varies along the paths"), _variation, _plain),
    (Failure("the same, two sides"), partial(_variation, two_sided=True), _plain),
    (Failure("overlap error"), _level, _with_overlap),
    (Failure("background error of each beam"), _level, _with_background),
    (Failure("everything at once"), _as_drawn, _plain),
    (Failure("calm air", satisfied=True), _calm, _plain),
    (Failure("layer of a few altitudes", satisfied=True), partial(_layer, shape=_smooth), _plain),
    (Failure("layer with edges", satisfied=True), partial(_layer, shape=_with_edges), _plain),
)


def score_scans(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Solve random scans of one geometry, class by class."""
    for number, (failure, change, damage) in held_first(FAILURES):
        rng = np.random.default_rng((72, cluster, number))
        scene = change(multiangle_cases.random_scene(cluster, profiles), rng)
        scan = damage(scene.draw(profiles, cluster, number, 72), rng)
        result = multiangle_cases.retrieve(scan, multiangle_cases.AUTO)
        yield from _score_quantities(failure, scene, result)


def score_scan_methods(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Solve random scans with all violations at once, of any air and of calm air, by two methods.

    Little scatter makes stated errors small.
    """
    methods = (multiangle_cases.KANO_HAMILTON, multiangle_cases.JOINT)
    for calm, method in product((False, True), methods):
        failure = Failure(f"{'calm' if calm else 'any'} air, {method}")
        scene = multiangle_cases.random_scene(cluster, profiles, calm=calm)
        result = multiangle_cases.retrieve(scene.draw(profiles, cluster, 6), method)
        yield from _score_quantities(failure, scene, result)


def _score_quantities(
    failure: Failure,
    scene: Scene,
    result: optical_depth.MultiAngleResult,
) -> Iterator[ScoredValues]:
    truth: dict[str, Array] = {
        "optical depth": scene.optical_depth,
        "extinction": np.asarray(scene.extinction),
    }
    for quantity, true in truth.items():
        name = quantity.replace(" ", "_")
        error: Any = getattr(result, name) - true
        yield ScoredValues(
            failure, quantity, error, getattr(result, f"{name}_standard_error"),
            getattr(result, f"{name}_gradient_error"), result.quality, MultiAngleQuality,
            uncertain=result.raised(_UNCERTAIN), solvable=np.isfinite(error),
        )  # fmt: skip


# Other scans ------------------------------------------------------------------------------------


def score_short_scans(cluster: int, profiles: int, *, length: int) -> Iterator[ScoredValues]:
    """Solve random scans where the model holds, in blocks of `length` profiles."""
    for words, change in (
        ("", _level),
        ("calm air, ", _calm),
        ("layer of a few altitudes, ", partial(_layer, shape=_smooth)),
        ("layer with edges, ", partial(_layer, shape=_with_edges)),
    ):
        rng = np.random.default_rng((72, cluster, 0))
        scene = change(multiangle_cases.random_scene(cluster, profiles), rng)
        scan = scene.draw(profiles, cluster, 0, 87)
        failure = Failure(f"{words}blocks of {length}", satisfied=True)
        # Blocks of one geometry are one cluster.
        for first in range(0, profiles, length):
            some = slice(first, first + length)
            part = replace(
                scene, extinction=scene.extinction[some], backscatter=scene.backscatter[some]
            )
            block = Scan(part, scan.signal[some], scan.variance[some])
            result = multiangle_cases.retrieve(block, multiangle_cases.AUTO)
            yield from _score_quantities(failure, part, result)


def score_counted_scans(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Solve scans of photon counts, whose variance is stated in two ways."""
    rng = np.random.default_rng((84, cluster))
    angles = np.degrees(np.arccos(1.0 / np.linspace(1.0, 3.0, 9)))
    altitude = 150.0 + 30.0 * np.arange(60, dtype=np.float64)
    extinction = np.full(altitude.size, float(rng.uniform(2e-5, 2e-4)))
    depth = 30.0 * np.cumsum(extinction) + 120.0 * extinction
    distance = altitude / np.cos(np.radians(angles))[:, np.newaxis]
    bright = float(np.exp(rng.uniform(np.log(3e6), np.log(3e8))))
    air = 0.02 * rng.standard_normal((profiles, *distance.shape))
    mean = bright / distance**2 * np.exp(-2.0 * distance / altitude * depth + air)
    counts = rng.poisson(mean).astype(float)
    # Rates smoothed over 10 % of range, as `photon_signal` has them.
    smooth = _smoothed(counts, altitude)
    for name, holds, variance in (
        ("variance from single counts", False, counts),
        ("variance from smoothed counts, as in products", True, smooth),
    ):
        result = optical_depth.retrieve_optical_depth(
            counts * distance**2, angles, altitude, variance=variance * distance**4
        )
        yield _score_depth(Failure(name, satisfied=holds), depth, result)


def _score_depth(
    failure: Failure, depth: Array, result: optical_depth.MultiAngleResult
) -> ScoredValues:
    return ScoredValues(
        failure, "optical depth", result.optical_depth - depth,
        result.optical_depth_standard_error, result.optical_depth_gradient_error, result.quality,
        MultiAngleQuality, uncertain=result.raised(_UNCERTAIN),
    )  # fmt: skip


def _smoothed(counts: Array, altitude: Array) -> Array:
    low = np.searchsorted(altitude, 0.9 * altitude)
    high = np.searchsorted(altitude, 1.1 * altitude, side="right")
    sums = np.cumsum(counts, axis=-1)
    sums = np.concatenate([np.zeros_like(sums[..., :1]), sums], axis=-1)
    return np.asarray(np.maximum(sums[..., high] - sums[..., low], 1.0) / (high - low))
