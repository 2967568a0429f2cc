"""Homogeneous paths with known truth, chosen and random: signals, bounds of accuracy, and solvers.

Random paths satisfy or violate homogeneity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from benchmarks.harness.figure import Array, Mask, Random, Scores, Target, correlated, log_uniform
from benchmarks.harness.rates import COVERED, Failure, Part, ScoredValues, shares
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, HomogeneousResult
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation
from lidarops.simulate.signal import optical_depth

BINS: Final = 225
BACKGROUND: Final = 370.0
"""In standard deviations of the noise, like all powers here."""
QUANTITIES: Final = ("extinction", "background")
"""The compared unknowns; the third, the amplitude, is the signal extrapolated to range zero."""
TAIL_MEAN: Final = "tail_mean"
"""Solver: the mean of the last tenth of the bins as the background, as is usual."""
WRONG_PRIOR: Final = 0.8
"""Prior extinction, where one is needed, as a share of the truth."""

_STARTS: Final = (2500.0, 10500.0)
_LENGTHS: Final = (1700.0, 8000.0)
_EXTINCTIONS: Final = (1e-5, 1e-4, 1e-3, 5e-3)
_AMPLITUDES: Final = (15.0, 1e2, 1e3, 1e4, 1e5)
_SOLVABLE: Final = 0.1
_QUICK: Final = 8
_SEED: Final = 20240915


def relative_signal(distance: Array, extinction: Array, backscatter: Array) -> Array:
    r"""Return the signal of backscatter beyond full overlap, over that of the first bin, 1.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Range of the bin centres, positive and ascending.
    extinction, backscatter : ndarray, shape (..., bins)
        m-1, and in any unit.

    Notes
    -----
    :math:`(\beta_i / \beta_0) (R_0 / R_i)^2 \exp(-2 (\tau_i - \tau_0))` is defined also where
    nothing of the signal itself is left in the first bin.
    """
    depth = optical_depth(distance, extinction)
    shape = backscatter / backscatter[..., :1] * (distance[0] / distance) ** 2
    signal: Array = shape * np.exp(-2.0 * (depth - depth[..., :1]))
    return signal


@dataclass(frozen=True, slots=True)
class Scenario:
    """One homogeneous path with white noise of unit variance."""

    start: float
    """m."""
    length: float
    """m."""
    extinction: float
    """m-1."""
    signal: float
    """Above the background, at the start."""
    background: float = BACKGROUND
    bins: int = BINS

    @property
    def range(self) -> Array:
        """Ranges in m, uniform from the start to the start plus the length."""
        return np.linspace(self.start, self.start + self.length, self.bins)

    @property
    def mean(self) -> Array:
        """Noise-free power."""
        air = np.ones(self.bins)
        signal = relative_signal(self.range, self.extinction * air, air)
        return np.asarray(self.background + self.signal * signal)

    @property
    def label(self) -> str:
        """Description, in km and km-1."""
        return (
            f"{self.start / 1e3:g} + {self.length / 1e3:g} km, "
            f"{1e3 * self.extinction:g} km-1, signal {self.signal:g}"
        )

    def powers(self, count: int, seed: int = 0, dtype: npt.DTypeLike = np.float64) -> Any:
        """Return `count` noisy profiles; the same seed gives the same noise."""
        noise = np.random.default_rng([_SEED, seed]).standard_normal((count, self.bins))
        return (self.mean + noise).astype(dtype)

    def least_errors(self) -> dict[str, float]:
        """Return the Cramér-Rao bound of the standard error of each of `QUANTITIES`."""
        bounds = least_errors(self.range, self.extinction, self.signal)
        return {name: float(bound[0]) for name, bound in bounds.items()}

    def difficulty(self) -> float:
        """Return the least standard error of extinction over extinction + 1 / mean range."""
        scale = self.extinction + 1.0 / float(self.range.mean())
        return self.least_errors()["extinction"] / scale


def least_errors(
    distance: Array, extinction: npt.ArrayLike, signal: npt.ArrayLike
) -> dict[str, Array]:
    r"""Return the Cramér-Rao bounds of the standard errors of paths, each (profile,).

    The inverse Fisher matrix of background, signal in the first bin and extinction with Gaussian
    noise of unit variance (kay1993),

    .. math:: F = J^T J, \quad J = [1, \; \phi, \; -2 (R - R_0) S \phi],
        \quad \phi = (R_0 / R)^2 e^{-2 \sigma (R - R_0)}

    The bound of an unknown is the reciprocal norm of what its column adds to the others: the last
    diagonal element of the triangular factor.

    Parameters
    ----------
    distance : (bin,) float
        m.
    extinction, signal : (profile, 1) float
        m-1, and the signal in the first bin over the noise.
    """
    depth = distance - distance[0]
    shape = (distance[0] / distance) ** 2 * np.exp(-2.0 * np.atleast_2d(extinction) * depth)
    slope = -2.0 * depth * signal * shape
    last = {"extinction": (np.ones_like(shape), shape, slope),
            "background": (shape, slope, np.ones_like(shape))}  # fmt: skip
    bounds = {}
    for name, columns in last.items():
        factor = np.asarray(np.linalg.qr(np.stack(columns, -1), mode="r"))
        bounds[name] = 1.0 / np.maximum(np.abs(factor[:, -1, -1]), np.finfo(float).tiny)
    return bounds


def scenarios(*, quick: bool = False) -> list[Scenario]:
    """Return the paths of the benchmark: those with a difficulty of at most 0.1, or 8 of them."""
    grid = product(_STARTS, _LENGTHS, _EXTINCTIONS, _AMPLITUDES)
    solvable = [s for values in grid if (s := Scenario(*values)).difficulty() <= _SOLVABLE]
    if not quick:
        return solvable
    selected = np.linspace(0, len(solvable) - 1, _QUICK).round().astype(int)
    return [solvable[k] for k in selected]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates of a solver, one value per profile, by `QUANTITIES`."""

    values: Mapping[str, Array]
    standard_errors: Mapping[str, Array]
    flagged: Mask
    """Any quality bit."""
    rejected: Mask
    """A rejecting quality bit."""


PathSolver = Callable[[Any, Scenario], Estimates]
"""Solver: returns estimates from powers (profile, range) and their scenario."""


def solve_by(
    method: HomogeneousMethod, power: Any, scenario: Scenario, variance: float | None = 1.0
) -> HomogeneousResult:
    """Return the fit of a method, given what it needs besides the power.

    Known values are exact; the prior of "linearized" is 20 percent low.
    """
    given: dict[str, Any] = {
        HomogeneousMethod.LINEARIZED: {"extinction": WRONG_PRIOR * scenario.extinction},
        HomogeneousMethod.KNOWN_EXTINCTION: {"extinction": scenario.extinction},
        HomogeneousMethod.KNOWN_BACKGROUND: {"background": scenario.background},
    }.get(method, {})
    return path_fit.fit_homogeneous_path(
        power, scenario.range, variance=variance, method=method.value, **given
    )


def methods() -> dict[str, PathSolver]:
    """Return a solver for every method of `fit_homogeneous_path` and for `TAIL_MEAN`, by name."""

    def by(method: HomogeneousMethod) -> PathSolver:
        return lambda power, scenario: _estimates(solve_by(method, power, scenario))

    return {method.value: by(method) for method in HomogeneousMethod} | {TAIL_MEAN: _fit_above_tail}


def _fit_above_tail(power: Any, scenario: Scenario) -> Estimates:
    tail = cubic_and_tail.tail_mean(power, scenario.range, variance=1.0)
    fit = path_fit.fit_homogeneous_path(
        power, scenario.range, variance=1.0, method="known_background", background=tail.background,
        background_standard_error=tail.background_standard_error,
    )  # fmt: skip
    return _estimates(fit)


def _estimates(fit: HomogeneousResult) -> Estimates:
    return Estimates(
        values={name: getattr(fit, name) for name in QUANTITIES},
        standard_errors={name: getattr(fit, f"{name}_standard_error") for name in QUANTITIES},
        flagged=fit.quality != 0,
        rejected=(fit.quality & rejecting((*Quality, *HomogeneousQuality))) != 0,
    )


# Random paths ---------------------------------------------------------------------------------

_RANDOM_EXTINCTIONS: Final = (1e-7, 6e-2)
"""m-1."""
_SIGNALS: Final = (1e-2, 1e6)
"""Over the noise, in the first bin."""
_BACKGROUNDS: Final = (1.0, 1e8)
_NO_BACKGROUND: Final = 0.1
_RANDOM_STARTS: Final = (200.0, 12e3)
"""m."""
_RANDOM_LENGTHS: Final = (100.0, 12e3)
_STEPS: Final = (3.75, 7.5, 15.0, 37.5)
RANDOM_BINS: Final = (8, 800)
_DETERMINED: Final = 0.075
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


Violation = Callable[[Paths, Random], Array]
"""Returns (profile, bin) signals above the background of paths with a violation."""


def random_paths(cluster: int, profiles: int) -> tuple[Paths, Random]:
    """Return random paths of one geometry."""
    rng = np.random.default_rng((71, cluster))
    start = log_uniform(rng, *_RANDOM_STARTS)
    length, step = log_uniform(rng, *_RANDOM_LENGTHS), float(rng.choice(_STEPS))
    bins = int(np.clip(round(length / step) + 1, *RANDOM_BINS))
    background = log_uniform(rng, *_BACKGROUNDS, (profiles, 1))
    background[rng.random(profiles) < _NO_BACKGROUND] = 0.0
    paths = Paths(
        np.asarray(start + step * np.arange(bins, dtype=np.float64)),
        log_uniform(rng, *_RANDOM_EXTINCTIONS, (profiles, 1)),
        log_uniform(rng, *_SIGNALS, (profiles, 1)),
        background,
    )
    return paths, rng


def _none(paths: Paths, _: Random) -> Array:
    return paths.clean


def _slope(paths: Paths, rng: Random) -> Array:
    of_path = paths.signal.shape
    scale = log_uniform(rng, 1e3, 1e5, of_path) * rng.choice([-1.0, 1.0], of_path)
    return np.asarray(paths.clean * np.exp(-paths.depth / scale))


def _curved(paths: Paths, rng: Random) -> Array:
    of_path = paths.signal.shape
    amount = log_uniform(rng, 1e-3, 1.0, of_path) * rng.choice([-1.0, 1.0], of_path)
    position = paths.depth / paths.depth[:, -1:] - 0.5
    return np.asarray(paths.clean * np.exp(amount * position**2))


def _excess(paths: Paths, rng: Random) -> Array:
    """Return the excess of a cloud in the path, (profile, bin), over the path's own scattering."""
    of_path, length = paths.signal.shape, paths.depth[:, -1:]
    middle = rng.random(of_path) * length
    width = log_uniform(rng, 0.01, 0.5, of_path) * length
    shape = np.exp(-0.5 * ((paths.depth - middle) / width) ** 2)
    return np.asarray(log_uniform(rng, 1e-2, 10.0, of_path) * shape)


def _overlap(paths: Paths, rng: Random) -> Array:
    lost = rng.uniform(0.0, 0.3, paths.signal.shape)
    scale = log_uniform(rng, 0.02, 1.0, paths.signal.shape) * paths.depth[:, -1:]
    return np.asarray(paths.clean * (1.0 - lost * np.exp(-paths.depth / scale)))


def _turbulent(paths: Paths, rng: Random) -> Array:
    amount = log_uniform(rng, 1e-3, 0.2, paths.signal.shape)
    eddies = correlated(rng, paths.clean.shape, rng.uniform(0.0, 0.95))
    return np.asarray(paths.clean * np.exp(amount * eddies))


def _afterpulse(paths: Paths, rng: Random) -> Array:
    share = log_uniform(rng, 1e-4, 0.1, paths.signal.shape)
    scale = log_uniform(rng, 0.05, 1.0, paths.signal.shape) * paths.depth[:, -1:]
    return np.asarray(paths.clean + share * paths.signal * np.exp(-paths.depth / scale))


def _saturated(paths: Paths, rng: Random) -> Array:
    return np.minimum(paths.clean, rng.uniform(0.3, 0.99, paths.signal.shape) * paths.signal)


def _bent(paths: Paths, rng: Random) -> Array:
    """Return signals of a detector that loses a share proportional to the signal."""
    lost = log_uniform(rng, 1e-3, 0.3, paths.signal.shape)
    return np.asarray(paths.clean * (1.0 - lost * paths.clean / paths.signal))


def _with_gaps(power: Array, rng: Random) -> Array:
    missing = rng.random(power.shape) < rng.uniform(0.0, 0.4, (len(power), 1))
    first = rng.integers(0, power.shape[1], (len(power), 1))
    index = np.arange(power.shape[1])
    gap = (index >= first) & (index < first + rng.integers(0, 1 + power.shape[1] // 3))
    return np.where(missing | gap, np.nan, power)


def _with_outliers(power: Array, rng: Random) -> Array:
    hit = rng.random(power.shape) < rng.uniform(0.0, 0.02, (len(power), 1))
    size = log_uniform(rng, 3.0, 1e3, power.shape)
    return np.asarray(power + hit * size * rng.choice([-1.0, 1.0], power.shape))


_WITH_GAPS: Final = Failure("gaps", satisfied=True)
_NOISE_NOT_STATED: Final = Failure("none, noise not stated", satisfied=True)
_OUTLIERS: Final = Failure("outliers")
_PLUME: Final = Failure("plume")
FAILURES: Final[tuple[tuple[Failure, Violation], ...]] = (
    (Failure("none", satisfied=True), _none),
    (_NOISE_NOT_STATED, _none),
    (_WITH_GAPS, _none),
    (_OUTLIERS, _none),
    (Failure("slope of the backscatter along the section"), _slope),
    (Failure("bent backscatter"), _curved),
    (_PLUME, _none),
    (Failure("overlap error"), _overlap),
    (Failure("eddies"), _turbulent),
    (Failure("afterpulse"), _afterpulse),
    (Failure("saturated"), _saturated),
    (Failure("detector not linear"), _bent),
)


def least_relative_error(paths: Paths) -> Array:
    """Return the least error of extinction over the scale on which the signal falls, (profile,).

    The scale is extinction + 1 / mean range, at most half of 1 / bin width: of a signal that dies
    within a bin, the transmission of one bin is what the data determine.
    """
    least = least_errors(paths.range, paths.extinction, paths.signal)["extinction"]
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


def score_homogeneous(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield the scores of random paths of one geometry, for every class of violation."""
    paths, rng = random_paths(cluster, profiles)
    with np.errstate(under="ignore", over="ignore", invalid="ignore", divide="ignore"):
        least = least_relative_error(paths)
    highest = THRESHOLDS.highest_optical_depth / float(paths.depth[0, -1])
    within = paths.extinction[:, 0] < 0.9 * highest
    within &= 2.0 * paths.extinction[:, 0] * paths.range[0] < _DEEPEST
    for failure, violate in FAILURES:
        truth = paths.extinction[:, 0]
        with np.errstate(under="ignore"):
            signal = violate(paths, rng)
            if failure is _PLUME:
                # Backscatter and extinction increase by the same factor.
                excess = _excess(paths, rng)
                signal = paths.with_plume(excess)
                truth = truth * (1.0 + excess.mean(axis=1))
        power = paths.background + signal + rng.standard_normal(signal.shape)
        if failure is _WITH_GAPS:
            power = _with_gaps(power, rng)
        elif failure is _OUTLIERS:
            power = _with_outliers(power, rng)
        noise = None if failure is _NOISE_NOT_STATED else 1.0
        wider = _widening(paths.range.size) if noise is None else 1.0
        # Missing bins lose information.
        expected = failure.satisfied and failure is not _WITH_GAPS
        solvable = within & (wider * least <= _DETERMINED) if expected else None
        known = violate is _none and failure is not _PLUME
        misfit = None if known else visible_misfit(paths.range, signal)
        fit = path_fit.fit_homogeneous_path(power, paths.range, variance=noise)
        for quantity, true in (("extinction", truth), ("background", paths.background[:, 0])):
            yield _scored(failure, quantity, true, fit, solvable=solvable, misfit=misfit)


def _scored(
    failure: Failure, quantity: str, truth: Array, fit: path_fit.HomogeneousResult, **known: Any
) -> ScoredValues:
    return ScoredValues(
        failure, quantity, getattr(fit, quantity) - truth,
        getattr(fit, f"{quantity}_standard_error"), getattr(fit, f"{quantity}_model_error"),
        np.asarray(fit.quality), HomogeneousQuality, **known,
    )  # fmt: skip


def _widening(bins: int) -> float:
    """Return the factor on standard errors where the noise is estimated from the bins.

    Calculated apart from the retrieval, whose errors must not decide which flags are needless.
    """
    freedom = 18.0 / 35.0 * (bins - 2)
    return float(stats.t.isf(stats.norm.sf(COVERED), freedom) / COVERED)


# Correlated noise, few bins, and hardly determined values -------------------------------------

_CORRELATIONS: Final = (0.6, 0.9)
"""Between neighbouring bins."""
_RECORDED: Final = 4000
"""Bins in the far half of a recorder's profiles, in which products measure the correlation."""
_NEAR_THE_CUT: Final = 0.10
"""Relative error of extinction, below the limit of 0.15 of POORLY_DETERMINED."""
_SHORT: Final = ((8, 10), (11, 15), (16, 23), (24, 32))
"""Least and most bins of short sections."""
_SHORT_STEP: Final = 37.5
"""m."""
_FALLS: Final = (1.0, 6.0)
"""Decades by which a signal falls from bin to bin."""


def _fitted(paths: Paths, deviations: Array, **options: Any) -> Any:
    """Return the fit of paths with unit noise."""
    with np.errstate(under="ignore"):
        power = paths.background + paths.clean + deviations
        return path_fit.fit_homogeneous_path(power, paths.range, **{"variance": 1.0, **options})


def score_correlated_noise(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield extinctions with noise that is correlated between bins."""
    for correlation in _CORRELATIONS:
        paths, rng = random_paths(cluster, profiles)
        noise = correlated(rng, (profiles, paths.range.size), correlation)
        recorded = correlated(rng, (profiles, _RECORDED), correlation)
        estimated = estimate_noise_correlation(recorded, np.ones_like(recorded)).length
        length = (1.0 + correlation) / (1.0 - correlation)
        for words, options in (
            ("not stated", {}),
            ("stated", {"noise": path_fit.Noise(correlation_length=length)}),
            ("estimated, as in products", {"noise": path_fit.Noise(correlation_length=estimated)}),
        ):
            name = f"AR(1) {correlation:g}, correlation {words}"
            failure = Failure(name, satisfied=bool(options))
            yield _scored(
                failure, "extinction", paths.extinction[:, 0], _fitted(paths, noise, **options)
            )


def score_near_the_cut(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield backgrounds of paths whose extinction is nearly too uncertain to be accepted."""
    paths, rng = random_paths(cluster, profiles)
    fit = _fitted(paths, rng.standard_normal((profiles, paths.range.size)))
    scale = fit.extinction + 1.0 / float(paths.range.mean())
    with np.errstate(invalid="ignore", divide="ignore"):
        near = fit.extinction_standard_error / scale > _NEAR_THE_CUT
    failure = Failure("near the limit of POORLY_DETERMINED", satisfied=True)
    values = _scored(failure, "background", paths.background[:, 0], fit)
    yield replace(values, error=np.where(near, values.error, np.nan))


def score_short_sections(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield extinctions and backgrounds of sections of 8 to 32 bins."""
    for least, most in _SHORT:
        paths, rng = random_paths(cluster, profiles)
        bins = int(rng.integers(least, most + 1))
        paths = replace(
            paths, range=paths.range[0] + _SHORT_STEP * np.arange(bins, dtype=np.float64)
        )
        noise = rng.standard_normal((profiles, bins))
        for words, variance in (("stated", 1.0), ("estimated", None)):
            failure = Failure(f"{least} to {most} bins, noise {words}", satisfied=True)
            fit = _fitted(paths, noise, variance=variance)
            yield _scored(failure, "extinction", paths.extinction[:, 0], fit)
            yield _scored(failure, "background", paths.background[:, 0], fit)


def score_dying_signals(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield extinctions where the signal falls by a factor of 10 to 1e6 from bin to bin."""
    paths, rng = random_paths(cluster, profiles)
    decades = rng.uniform(*_FALLS, (profiles, 1))
    paths = replace(
        paths, range=100.0 + _SHORT_STEP * np.arange(40, dtype=np.float64),
        extinction=np.log(10.0) * decades / (2.0 * _SHORT_STEP),
    )  # fmt: skip
    fit = _fitted(paths, rng.standard_normal((profiles, 40)))
    failure = Failure("signal that dies within a bin", satisfied=True)
    yield _scored(failure, "extinction", paths.extinction[:, 0], fit)


# Few photon counts ------------------------------------------------------------------------------

_FEW: Final = (1.0, 0.3, 0.1, 0.02)
"""Photon counts of a bin."""
_COUNTED: Final = 100
"""Profiles of a cluster."""
_NEEDLESS: Final = Target(1e-3, own=True)
"""Largest share of profiles that are flagged although the model holds."""


def few_counts(cluster: int, counts: float) -> Iterator[Part]:
    """Yield how many profiles of few photon counts are flagged although the model holds."""
    rng = np.random.default_rng((82, cluster))
    distance = 2500.0 + 37.5 * np.arange(225)
    signal = log_uniform(rng, 3.0, 100.0)
    fall = (distance[0] / distance) ** 2 * np.exp(-2e-4 * (distance - distance[0]))
    mean = counts * (1.0 + signal * fall)
    drawn = rng.poisson(mean, (_COUNTED, mean.size)).astype(float)
    for limits, exposure in (("normal limits", None), ("Poisson limits, as in products", 1.0)):
        fit = path_fit.fit_homogeneous_path(
            drawn, distance, variance=mean, noise=path_fit.Noise(exposure=exposure)
        )
        for bit in (Quality.OUTLIER, HomogeneousQuality.POOR_FIT):
            flagged = float(np.count_nonzero(fit.quality & np.int32(bit)))
            yield f"{bit.name}, {limits}", f"{counts:g} counts a bin", flagged, _COUNTED


def few_count_scores(clusters: int) -> Scores:
    """Return the shares of flagged profiles, by flag and counts of a bin."""
    parts = [
        part for few in _FEW for cluster in range(clusters) for part in few_counts(cluster, few)
    ]
    return shares(parts, lambda case, _: _NEEDLESS if "Poisson" in case else None)
