"""Random homogeneous paths, and random violations of homogeneity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from benchmarks.accuracy.multiangle_cases import correlated
from benchmarks.harness.figure import Array, Mask
from benchmarks.stability.random_scenes import COVERED, Failure, ScoredValues
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.simulate.signal import relative_signal

Random = np.random.Generator

_EXTINCTIONS: Final = (1e-7, 6e-2)
"""m-1."""
_SIGNALS: Final = (1e-2, 1e6)
"""Over the noise, in the first bin."""
_BACKGROUNDS: Final = (1.0, 1e8)
_NO_BACKGROUND: Final = 0.1
_STARTS: Final = (200.0, 12e3)
"""m."""
_LENGTHS: Final = (100.0, 12e3)
_STEPS: Final = (3.75, 7.5, 15.0, 37.5)
_BINS: Final = (8, 800)
_SOLVABLE: Final = 0.075
"""Largest `least_relative_error` of a solvable path: 4 such errors of a thin path reach the lower
bound of the search, -0.3 / last range."""
_DEEPEST: Final = 600.0
"""Two-way optical depth from the lidar to the first bin above which the amplitude at range zero
leaves the range of floats."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Paths of one geometry; arrays are (profile, 1)."""

    range: Array
    """(bin,) m."""
    extinction: Array
    signal: Array
    background: Array

    @property
    def depth(self) -> Array:
        """(1, bin) m from the first bin."""
        return np.asarray(self.range - self.range[0])[np.newaxis]

    @property
    def clean(self) -> Array:
        """(profile, bin) without noise and background."""
        return self.with_plume(np.zeros(self.range.size))

    def with_plume(self, plume: Array) -> Array:
        """Return `clean` with more scattering: excess over that of the path, (profile, bin)."""
        air = np.broadcast_to(1.0 + plume, (len(self.signal), self.range.size))
        return self.signal * air[:, :1] * relative_signal(self.range, self.extinction * air, air)


@dataclass(frozen=True, slots=True)
class ViolatedPaths:
    """Signals of paths with a violation, and their true extinction."""

    signal: Array
    """(profile, bin) above the background."""
    extinction: Array
    """(profile,) m-1; the mean where it varies."""


Violation = Callable[[Paths, Random], ViolatedPaths]


def between(rng: Random, low: float, high: float, count: int) -> Array:
    """Return (count, 1) numbers, uniform in the logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high), (count, 1)))


def random_paths(cluster: int, profiles: int) -> tuple[Paths, Random]:
    """Return random paths of one geometry."""
    rng = np.random.default_rng((71, cluster))
    start = float(between(rng, *_STARTS, 1)[0, 0])
    length, step = float(between(rng, *_LENGTHS, 1)[0, 0]), float(rng.choice(_STEPS))
    bins = int(np.clip(round(length / step) + 1, *_BINS))
    background = between(rng, *_BACKGROUNDS, profiles)
    background[rng.random(profiles) < _NO_BACKGROUND] = 0.0
    paths = Paths(
        np.asarray(start + step * np.arange(bins, dtype=np.float64)),
        between(rng, *_EXTINCTIONS, profiles),
        between(rng, *_SIGNALS, profiles),
        background,
    )
    return paths, rng


def _none(paths: Paths, _: Random) -> ViolatedPaths:
    return ViolatedPaths(paths.clean, paths.extinction[:, 0])


def _sign(rng: Random, count: int) -> Array:
    return np.asarray(rng.choice([-1.0, 1.0], (count, 1)))


def _slope(paths: Paths, rng: Random) -> ViolatedPaths:
    count = len(paths.signal)
    scale = between(rng, 1e3, 1e5, count) * _sign(rng, count)
    return ViolatedPaths(paths.clean * np.exp(-paths.depth / scale), paths.extinction[:, 0])


def _curved(paths: Paths, rng: Random) -> ViolatedPaths:
    count = len(paths.signal)
    amount = between(rng, 1e-3, 1.0, count) * _sign(rng, count)
    position = paths.depth / paths.depth[:, -1:] - 0.5
    return ViolatedPaths(paths.clean * np.exp(amount * position**2), paths.extinction[:, 0])


def _plume(paths: Paths, rng: Random) -> ViolatedPaths:
    """Add a cloud to the path: backscatter and extinction increase by the same factor."""
    count = len(paths.signal)
    middle = rng.random((count, 1)) * paths.depth[:, -1:]
    width = between(rng, 0.01, 0.5, count) * paths.depth[:, -1:]
    plume = between(rng, 1e-2, 10.0, count) * np.exp(-0.5 * ((paths.depth - middle) / width) ** 2)
    truth = paths.extinction * (1.0 + plume.mean(axis=1, keepdims=True))
    return ViolatedPaths(paths.with_plume(plume), truth[:, 0])


def _overlap(paths: Paths, rng: Random) -> ViolatedPaths:
    count = len(paths.signal)
    lost = rng.uniform(0.0, 0.3, (count, 1))
    scale = between(rng, 0.02, 1.0, count) * paths.depth[:, -1:]
    return ViolatedPaths(
        paths.clean * (1.0 - lost * np.exp(-paths.depth / scale)), paths.extinction[:, 0]
    )


def _turbulent(paths: Paths, rng: Random) -> ViolatedPaths:
    amount = between(rng, 1e-3, 0.2, len(paths.signal))
    eddies = correlated(rng, paths.clean.shape, rng.uniform(0.0, 0.95))
    return ViolatedPaths(paths.clean * np.exp(amount * eddies), paths.extinction[:, 0])


def _afterpulse(paths: Paths, rng: Random) -> ViolatedPaths:
    count = len(paths.signal)
    share = between(rng, 1e-4, 0.1, count)
    scale = between(rng, 0.05, 1.0, count) * paths.depth[:, -1:]
    afterpulse = share * paths.signal * np.exp(-paths.depth / scale)
    return ViolatedPaths(paths.clean + afterpulse, paths.extinction[:, 0])


def _saturated(paths: Paths, rng: Random) -> ViolatedPaths:
    top = rng.uniform(0.3, 0.99, (len(paths.signal), 1)) * paths.signal
    return ViolatedPaths(np.minimum(paths.clean, top), paths.extinction[:, 0])


def _bent(paths: Paths, rng: Random) -> ViolatedPaths:
    """Make the detector nonlinear: it loses a share proportional to the signal."""
    lost = between(rng, 1e-3, 0.3, len(paths.signal))
    return ViolatedPaths(
        paths.clean * (1.0 - lost * paths.clean / paths.signal), paths.extinction[:, 0]
    )


def _with_gaps(power: Array, rng: Random) -> Array:
    missing = rng.random(power.shape) < rng.uniform(0.0, 0.4, (len(power), 1))
    first = rng.integers(0, power.shape[1], (len(power), 1))
    index = np.arange(power.shape[1])
    gap = (index >= first) & (index < first + rng.integers(0, 1 + power.shape[1] // 3))
    return np.where(missing | gap, np.nan, power)


def _with_outliers(power: Array, rng: Random) -> Array:
    hit = rng.random(power.shape) < rng.uniform(0.0, 0.02, (len(power), 1))
    size = between(rng, 3.0, 1e3, power.size).reshape(power.shape)
    return np.asarray(power + hit * size * rng.choice([-1.0, 1.0], power.shape))


_SAME_SHAPE: Final = (
    "an exponential of range has the shape of extinction itself: only the stated model error"
    " can cover it"
)
_SHORT_SCALE: Final = (
    "a change over the whole section has nearly the shape of extinction and background"
)
_WITH_GAPS: Final = Failure("gaps", satisfied=True)
_NOISE_NOT_STATED: Final = Failure("none, noise not stated", satisfied=True)
_OUTLIERS: Final = Failure("outliers")
FAILURES: Final[tuple[tuple[Failure, Violation], ...]] = (
    (Failure("none", satisfied=True), _none),
    (_NOISE_NOT_STATED, _none),
    (_WITH_GAPS, _none),
    (_OUTLIERS, _none),
    (Failure("slope of the backscatter along the section", unseen=_SAME_SHAPE), _slope),
    (Failure("bent backscatter"), _curved),
    (Failure("plume"), _plume),
    (Failure("overlap error", unseen=_SHORT_SCALE), _overlap),
    (Failure("eddies"), _turbulent),
    (Failure("afterpulse", unseen=_SHORT_SCALE), _afterpulse),
    (Failure("saturated"), _saturated),
    (Failure("detector not linear"), _bent),
)


def least_relative_error(paths: Paths) -> Array:
    """Return the least error of extinction over the scale on which the signal falls, (profile,).

    The scale is extinction + 1 / mean range, at most half of 1 / bin width: of a signal that dies
    within a bin, the transmission of one bin is what the data determine. The error is from the
    inverse information matrix of background, amplitude and extinction with unit noise,
    by elimination of the two linear unknowns.
    """
    shape = paths.clean
    middle = np.sum(shape**2 * paths.depth, axis=1, keepdims=True) / np.sum(
        shape**2, axis=1, keepdims=True
    )
    slope = 2.0 * shape * (paths.depth - middle)
    flat = shape - shape.mean(axis=1, keepdims=True)
    remainder = slope - slope.mean(axis=1, keepdims=True)
    norm = np.maximum(np.sum(flat**2, axis=1, keepdims=True), np.finfo(float).tiny)
    remainder = remainder - flat * np.sum(remainder * flat, axis=1, keepdims=True) / norm
    least = 1.0 / np.sqrt(np.maximum(np.sum(remainder**2, axis=1), np.finfo(float).tiny))
    bin_width = float(paths.range[1] - paths.range[0])
    scale = paths.extinction[:, 0] + 1.0 / float(paths.range.mean())
    return np.asarray(least / np.minimum(scale, 0.5 / bin_width))


def visible_misfit(range_: Array, signal: Array) -> Array:
    """Return the misfit of the model to signals without noise, over unit noise, (profile,).

    The norm of the residuals of the best fit: to first order, the departure of the signals from
    the model less its projections on the derivatives by background, amplitude and extinction.
    """
    fit = path_fit.fit_homogeneous_path(signal, range_, variance=1.0)
    # Of signals without misfit, rounding leaves a negative square.
    return np.sqrt(np.maximum(fit.reduced_chi2, 0.0) * (fit.valid_bins - 3))


def score_homogeneous(cluster: int, profiles: int) -> Iterator[tuple[ScoredValues, int]]:
    """Yield the scores of random paths of one geometry, for every class of violation."""
    paths, rng = random_paths(cluster, profiles)
    with np.errstate(under="ignore", over="ignore", invalid="ignore", divide="ignore"):
        least = least_relative_error(paths)
    highest = THRESHOLDS.highest_optical_depth / float(paths.depth[0, -1])
    within = paths.extinction[:, 0] < 0.9 * highest
    within &= 2.0 * paths.extinction[:, 0] * paths.range[0] < _DEEPEST
    for failure, violate in FAILURES:
        with np.errstate(under="ignore"):
            violated = violate(paths, rng)
        power = paths.background + violated.signal + rng.standard_normal(violated.signal.shape)
        if failure is _WITH_GAPS:
            power = _with_gaps(power, rng)
        elif failure is _OUTLIERS:
            power = _with_outliers(power, rng)
        noise = None if failure is _NOISE_NOT_STATED else 1.0
        wider = _widening(paths.range.size) if noise is None else 1.0
        solvable: Mask = within & (wider * least <= _SOLVABLE)
        misfit = None if violate is _none else visible_misfit(paths.range, violated.signal)
        yield from _solved(failure, paths, violated, power, (noise, solvable, misfit))


def _widening(bins: int) -> float:
    """Return the factor on standard errors where the noise is estimated from the bins.

    Calculated apart from the retrieval, whose errors must not decide which flags are needless.
    """
    freedom = 18.0 / 35.0 * (bins - 2)
    return float(stats.t.isf(stats.norm.sf(COVERED), freedom) / COVERED)


def _solved(
    failure: Failure,
    paths: Paths,
    violated: ViolatedPaths,
    power: Array,
    known: tuple[float | None, Mask, Array | None],
) -> Iterator[tuple[ScoredValues, int]]:
    noise, solvable, misfit = known
    fit = path_fit.fit_homogeneous_path(power, paths.range, variance=noise)
    bits = np.asarray(fit.quality)
    # Missing bins lose information.
    expected = solvable if failure.satisfied and failure is not _WITH_GAPS else None
    count = len(power)
    yield (
        ScoredValues(
            failure, "extinction", fit.extinction - violated.extinction,
            fit.extinction_standard_error, fit.extinction_model_error, bits,
            HomogeneousQuality, solvable=expected, misfit=misfit,
        ),
        count,
    )  # fmt: skip
    yield (
        ScoredValues(
            failure, "background", fit.background - paths.background[:, 0],
            fit.background_standard_error, fit.background_model_error, bits,
            HomogeneousQuality, solvable=expected, misfit=misfit,
        ),
        count,
    )  # fmt: skip
