"""Random homogeneous paths, and paths that are not homogeneous."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from lidarops.bench.accuracy.multiangle_cases import correlated
from lidarops.bench.stability.random_scenes import VISIBLE, Failure, Judged, Mask
from lidarops.bench.stability.stiff_cases import Array
from lidarops.retrieve.homogeneous import path_fit

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
"""Least standard error of extinction over extinction + 1 / mean range up to which a path counts as
solvable: 4 of them reach the lower bound of the search, -0.3 / last range."""
_DEEPEST: Final = 600.0
"""Optical depth, there and back, from the lidar to the first bin, above which the amplitude at
range zero leaves the numbers that a computer has."""


@dataclass(frozen=True, slots=True)
class Scenes:
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
        fall = np.exp(-2.0 * self.extinction * self.depth)
        return np.asarray(self.signal * (self.range[0] / self.range) ** 2 * fall)


@dataclass(frozen=True, slots=True)
class Seen:
    """What a violation makes of paths."""

    signal: Array
    """(profile, bin) above the background."""
    extinction: Array
    """(profile,) the truth: its mean where it varies."""


Violation = Callable[[Scenes, Random], Seen]


def between(rng: Random, low: float, high: float, count: int) -> Array:
    """Return (count, 1) numbers, uniform in the logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high), (count, 1)))


def random_paths(cluster: int, profiles: int) -> tuple[Scenes, Random]:
    """Return random paths of one geometry."""
    rng = np.random.default_rng((71, cluster))
    start = float(between(rng, *_STARTS, 1)[0, 0])
    length, step = float(between(rng, *_LENGTHS, 1)[0, 0]), float(rng.choice(_STEPS))
    bins = int(np.clip(round(length / step) + 1, *_BINS))
    background = between(rng, *_BACKGROUNDS, profiles)
    background[rng.random(profiles) < _NO_BACKGROUND] = 0.0
    found = Scenes(
        np.asarray(start + step * np.arange(bins, dtype=np.float64)),
        between(rng, *_EXTINCTIONS, profiles),
        between(rng, *_SIGNALS, profiles),
        background,
    )
    return found, rng


def _none(paths: Scenes, _: Random) -> Seen:
    return Seen(paths.clean, paths.extinction[:, 0])


def _sign(rng: Random, count: int) -> Array:
    return np.asarray(rng.choice([-1.0, 1.0], (count, 1)))


def _slope(paths: Scenes, rng: Random) -> Seen:
    count = len(paths.signal)
    scale = between(rng, 1e3, 1e5, count) * _sign(rng, count)
    return Seen(paths.clean * np.exp(-paths.depth / scale), paths.extinction[:, 0])


def _curved(paths: Scenes, rng: Random) -> Seen:
    count = len(paths.signal)
    amount = between(rng, 1e-3, 1.0, count) * _sign(rng, count)
    place = paths.depth / paths.depth[:, -1:] - 0.5
    return Seen(paths.clean * np.exp(amount * place**2), paths.extinction[:, 0])


def _plume(paths: Scenes, rng: Random) -> Seen:
    """Put a cloud into the path: backscatter and extinction by the same factor."""
    count = len(paths.signal)
    middle = rng.random((count, 1)) * paths.depth[:, -1:]
    width = between(rng, 0.01, 0.5, count) * paths.depth[:, -1:]
    more = between(rng, 1e-2, 10.0, count) * np.exp(-0.5 * ((paths.depth - middle) / width) ** 2)
    step = paths.range[1] - paths.range[0]
    added = paths.extinction * step * (np.cumsum(more, axis=1) - 0.5 * (more + more[:, :1]))
    truth = paths.extinction * (1.0 + more.mean(axis=1, keepdims=True))
    return Seen(paths.clean * (1.0 + more) * np.exp(-2.0 * added), truth[:, 0])


def _overlap(paths: Scenes, rng: Random) -> Seen:
    count = len(paths.signal)
    lost = rng.uniform(0.0, 0.3, (count, 1))
    scale = between(rng, 0.02, 1.0, count) * paths.depth[:, -1:]
    return Seen(paths.clean * (1.0 - lost * np.exp(-paths.depth / scale)), paths.extinction[:, 0])


def _turbulent(paths: Scenes, rng: Random) -> Seen:
    amount = between(rng, 1e-3, 0.2, len(paths.signal))
    eddies = correlated(rng, paths.clean.shape, rng.uniform(0.0, 0.95))
    return Seen(paths.clean * np.exp(amount * eddies), paths.extinction[:, 0])


def _afterpulse(paths: Scenes, rng: Random) -> Seen:
    count = len(paths.signal)
    part = between(rng, 1e-4, 0.1, count)
    scale = between(rng, 0.05, 1.0, count) * paths.depth[:, -1:]
    more = part * paths.signal * np.exp(-paths.depth / scale)
    return Seen(paths.clean + more, paths.extinction[:, 0])


def _saturated(paths: Scenes, rng: Random) -> Seen:
    top = rng.uniform(0.3, 0.99, (len(paths.signal), 1)) * paths.signal
    return Seen(np.minimum(paths.clean, top), paths.extinction[:, 0])


def _bent(paths: Scenes, rng: Random) -> Seen:
    """Bend the detector: it loses a part in proportion to the signal."""
    lost = between(rng, 1e-3, 0.3, len(paths.signal))
    return Seen(paths.clean * (1.0 - lost * paths.clean / paths.signal), paths.extinction[:, 0])


def _with_gaps(power: Array, rng: Random) -> Array:
    few = rng.random(power.shape) < rng.uniform(0.0, 0.4, (len(power), 1))
    first = rng.integers(0, power.shape[1], (len(power), 1))
    place = np.arange(power.shape[1])
    hole = (place >= first) & (place < first + rng.integers(0, 1 + power.shape[1] // 3))
    return np.where(few | hole, np.nan, power)


def _with_outliers(power: Array, rng: Random) -> Array:
    hit = rng.random(power.shape) < rng.uniform(0.0, 0.02, (len(power), 1))
    size = between(rng, 3.0, 1e3, power.size).reshape(power.shape)
    return np.asarray(power + hit * size * rng.choice([-1.0, 1.0], power.shape))


_SAME_SHAPE: Final = (
    "an exponential of range has the shape of extinction itself: only the declared model error"
    " can cover it"
)
_SHORT_SCALE: Final = (
    "where it changes over the whole section it has nearly the shape of extinction and background"
)
FAILURES: Final[tuple[tuple[Failure, Violation], ...]] = (
    (Failure("none", satisfied=True), _none),
    (Failure("none, noise not stated", satisfied=True), _none),
    (Failure("gaps", satisfied=True), _none),
    (Failure("outliers"), _none),
    (Failure("slope of the backscatter along the section", unseen=_SAME_SHAPE), _slope),
    (Failure("bent backscatter"), _curved),
    (Failure("plume"), _plume),
    (Failure("overlap error", unseen=_SHORT_SCALE), _overlap),
    (Failure("eddies"), _turbulent),
    (Failure("afterpulse", unseen=_SHORT_SCALE), _afterpulse),
    (Failure("saturated"), _saturated),
    (Failure("detector not linear"), _bent),
)


def least_relative_error(paths: Scenes) -> Array:
    """Return (profile,) the least error of extinction over extinction + 1 / mean range.

    The inverse of the information matrix of background, amplitude and extinction with unit
    noise, by elimination of the two linear unknowns.
    """
    shape = paths.clean
    middle = np.sum(shape**2 * paths.depth, axis=1, keepdims=True) / np.sum(
        shape**2, axis=1, keepdims=True
    )
    slope = 2.0 * shape * (paths.depth - middle)
    flat = shape - shape.mean(axis=1, keepdims=True)
    left = slope - slope.mean(axis=1, keepdims=True)
    norm = np.maximum(np.sum(flat**2, axis=1, keepdims=True), np.finfo(float).tiny)
    left = left - flat * np.sum(left * flat, axis=1, keepdims=True) / norm
    least = 1.0 / np.sqrt(np.maximum(np.sum(left**2, axis=1), np.finfo(float).tiny))
    scale = paths.extinction[:, 0] + 1.0 / float(paths.range.mean())
    return np.asarray(least / scale)


def visible_misfit(range_: Array, signal: Array) -> Array:
    """Return (profile,) what the model cannot take up of signals, over unit noise.

    The norm of what the best fit leaves over of the signals without noise: to first order their
    departure less its projections on what background, amplitude and extinction can change.
    """
    found = path_fit.fit_homogeneous_path(signal, range_, variance=1.0)
    return np.sqrt(found.reduced_chi2 * (found.valid_bins - 3))


def judge_homogeneous(cluster: int, profiles: int) -> Iterator[tuple[Judged, int]]:
    """Solve random paths of one geometry, class by class."""
    paths, rng = random_paths(cluster, profiles)
    with np.errstate(under="ignore", over="ignore", invalid="ignore", divide="ignore"):
        least = least_relative_error(paths)
    bounds = path_fit.HIGHEST_OPTICAL_DEPTH / float(paths.depth[0, -1])
    within = paths.extinction[:, 0] < 0.9 * bounds
    within &= 2.0 * paths.extinction[:, 0] * paths.range[0] < _DEEPEST
    for failure, violate in FAILURES:
        with np.errstate(under="ignore"):
            seen = violate(paths, rng)
        power = paths.background + seen.signal + rng.standard_normal(seen.signal.shape)
        if failure.name == "gaps":
            power = _with_gaps(power, rng)
        elif failure.name == "outliers":
            power = _with_outliers(power, rng)
        noise = None if "not stated" in failure.name else 1.0
        wider = _widening(paths.range.size) if noise is None else 1.0
        could: Mask = within & (wider * least <= _SOLVABLE)
        hidden = None if violate is _none else visible_misfit(paths.range, seen.signal) < VISIBLE
        yield from _solved(failure, paths, seen, power, (noise, could, hidden))


def _widening(bins: int) -> float:
    """Return how much wider 4 standard errors are where the noise is estimated from the bins."""
    freedom = 18.0 / 35.0 * (bins - 2)
    return float(stats.t.isf(stats.norm.sf(4.0), freedom) / 4.0)


def _solved(
    failure: Failure,
    paths: Scenes,
    seen: Seen,
    power: Array,
    known: tuple[float | None, Mask, Mask | None],
) -> Iterator[tuple[Judged, int]]:
    noise, could, hidden = known
    found = path_fit.fit_homogeneous_path(power, paths.range, variance=noise)
    bits = np.asarray(found.quality)
    # Where bins are missing, less can be told than of all of them.
    likely = could if failure.satisfied and failure.name != "gaps" else None
    count = len(power)
    yield (
        Judged(
            failure, "extinction", found.extinction - seen.extinction,
            found.extinction_standard_error, found.extinction_model_error, bits, solvable=likely,
            hidden=hidden,
        ),
        count,
    )  # fmt: skip
    yield (
        Judged(
            failure, "background", found.background - paths.background[:, 0],
            found.background_standard_error, found.background_model_error, bits, solvable=likely,
            hidden=hidden,
        ),
        count,
    )  # fmt: skip
