"""Accuracy of the solvers of a homogeneous path against the least possible error, and a peer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, Final

import numba
import numpy as np

from benchmarks.accuracy import comparison
from benchmarks.harness.figure import CPU_TIME, Array, Figure, Score, Work, cpu_time, share
from benchmarks.harness.results import Effort, Study
from benchmarks.scenes.homogeneous_paths import (
    QUANTITIES,
    TAIL_MEAN,
    Estimates,
    PathSolver,
    Scenario,
    methods,
    scenarios,
)

PROFILES: Final = 10_000
QUICK_PROFILES: Final = 4_000
_INFORMED: Final = frozenset({"linearized", "known_background", "known_extinction"})
"""Methods that are given more than the profile."""
_NOTE: Final = (
    "Paths of 225 bins through white noise, from 2.5 or 10.5 km over 1.7 or 8 km, extinction 0.01 "
    "to 5 per km, signal 15 to 100 000 times the noise. The bound is the inverse Fisher matrix of "
    "background, amplitude and extinction. Profiles that a method rejects do not count for its "
    "error. The peer starts from the fit of the mean of 64 profiles, and tests no residuals. "
    "Median over the paths of the comparison.RMSE over the bound; its largest value, and the "
    "largest mean error, each over all paths; mean shares of flagged and rejected profiles."
)


def measure_homogeneous(effort: Effort, *, profiles: int | None = None) -> Study:
    """Solve simulated profiles by every method of `fit_homogeneous_path` and by the peer.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Per scenario.
    """
    count = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    solvers = {**methods(), **PEERS}
    scores: dict[str, list[Score]] = {name: [] for name in solvers}
    for seed, scenario in enumerate(scenarios(quick=effort.quick)):
        power = scenario.powers(count, seed)
        for name, solver in solvers.items():
            scores[name].append(score_path(solver, scenario, power))
        effort.progress(1)
    return comparison.study("homogeneous path", list(_works(scores)), _NOTE)


def score_path(solver: PathSolver, scenario: Scenario, power: Any) -> Score:
    """Return errors over the Cramér-Rao bound, flags and time of one solver on one path.

    Parameters
    ----------
    solver : PathSolver
    scenario : Scenario
    power : (profile, bin) float
    """
    solver(power[:_START_PROFILES], scenario)
    spent, solution = comparison.time_profiles(
        partial(solver, power, scenario), len(power), comparison.ROUNDS
    )
    score: Score = {
        "flagged": share(float(solution.flagged.mean())),
        "rejected": share(float(solution.rejected.mean())),
        CPU_TIME: spent,
    }
    least = scenario.least_errors()
    for name in QUANTITIES:
        error = (solution.values[name] - getattr(scenario, name)) / least[name]
        stated = solution.standard_errors[name] / least[name]
        kept = np.isfinite(error) & ~solution.rejected
        # A value that is given has no score.
        if kept.sum() >= 2 and np.any(stated[kept] > 0):
            errors = comparison.score_errors(error, stated, kept)
            score |= {f"{name}: {quantity}": figure for quantity, figure in errors.items()}
    return score


def _works(scores: dict[str, list[Score]]) -> Iterator[Work]:
    """Yield the errors of extinction, then of background, on all paths together."""
    for quantity, (method, paths) in product(QUANTITIES, scores.items()):
        errors = _ranked(paths, f"{quantity}: {comparison.RMSE}")
        if errors:
            half = len(errors) // 2
            times = [figure.value for figure in _ranked(paths, CPU_TIME)]
            shares = {name: _ranked(paths, name) for name in ("flagged", "rejected")}
            worst = max(
                _ranked(paths, f"{quantity}: {comparison.BIAS}"), key=lambda f: abs(f.value)
            )
            means = {name: share(float(np.mean([figure.value for figure in figures])))
                     for name, figures in shares.items()}  # fmt: skip
            yield Work(
                f"median of {len(paths)} paths", f"{quantity}, RMSE over the Cramér-Rao bound",
                method, errors[half], _ranked(paths, f"{quantity}: {comparison.COVERAGE}")[half],
                cpu_time(float(np.median(times))), ours=method not in {*PEERS, TAIL_MEAN},
                informed=method in _INFORMED,
                more={"worst": errors[-1], comparison.BIAS: worst} | means,
            )  # fmt: skip


def _ranked(paths: Sequence[Score], quantity: str) -> list[Figure]:
    """Return the figures of a quantity on all paths that have one, the smallest first."""
    figures = [score[quantity] for score in paths if quantity in score]
    return sorted(figures, key=lambda figure: figure.value)


# Peer: iterative least squares, the strongest simple method -------------------------------------
#
# It fits background, signal at the first range and extinction in km-1, which suits it best. All
# fits of a call start from that of the mean of its first profiles, which suits profiles of the same
# air. At one extinction the model is linear in background and signal, so that only the extinction
# is iterated, by Gauss-Newton steps (golub1973). All fits begin at one extinction, whose sums over
# the shape are formed once. Even spacing makes the exponential a recurrence.

KILOMETRE: Final = 1e3
_START_PROFILES: Final = 64
_START_EXTINCTIONS: Final = np.geomspace(3e-3, 10.0, 40)
"""km-1. Steps of 23 %: the nearest one is close enough for Gauss-Newton steps."""


def solve_by_projection(power: Any, scenario: Scenario) -> Estimates:
    """Return background and extinction in SI units, by `fit_variable_projection`."""
    distance = scenario.range
    ratio, depth = (distance[0] / distance) ** 2, (distance - distance[0]) / KILOMETRE
    extinction = _start(power, ratio, depth)
    values, errors = fit_variable_projection(power, ratio, depth, extinction)
    failed = np.asarray(~np.isfinite(values).all(axis=0))
    units = {"background": 1.0, "extinction": KILOMETRE}
    of_values, of_errors = (
        {name: own / unit for own, (name, unit) in zip(both, units.items(), strict=True)}
        for both in (values, errors)
    )
    return Estimates(of_values, of_errors, flagged=failed, rejected=failed)


def _start(power: Any, ratio: Array, depth: Array) -> float:
    """Return the extinction at which the fits begin: that of the mean of the first profiles."""
    first = np.asarray(power[:_START_PROFILES], np.float64)
    mean = first[np.isfinite(first).all(axis=1)].mean(axis=0)
    shapes = ratio * np.exp(-2.0 * _START_EXTINCTIONS[:, np.newaxis] * depth)
    shapes -= shapes.mean(axis=1, keepdims=True)
    explained = (shapes @ mean) ** 2 / np.sum(shapes**2, axis=1)
    nearest = float(_START_EXTINCTIONS[np.argmax(explained)])
    (_, extinction), _ = fit_variable_projection(mean[np.newaxis], ratio, depth, nearest)
    return float(extinction[0])


PEERS: Final = {"variable projection, numba": solve_by_projection}
"""The peer by its name."""
_STEPS: Final = 30
"""Most steps of a fit."""
_CONVERGED: Final = 0.05
"""Last step in standard errors of the extinction: a further one would be a few hundredths of it."""
_LANES: Final = 8
"""Interleaved recurrences, which the compiler turns into vectors."""
_fast = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp"}
)


@_fast
def _start_sums(power: Any, first: Array, second: Array) -> Any:
    """Return the sum of a profile, and those of its products with shape and slope."""
    total = yf = yd = 0.0
    for i in range(power.size):
        total += power[i]
        yf += power[i] * first[i]
        yd += power[i] * second[i]
    return total, yf, yd


@_fast
def _sums(power: Any, ratio: Array, depth: Array, sigma: float, shape: Array) -> Any:
    """Return the sums of the shape, of its slope and of their products with the profile."""
    step = np.exp(-2.0 * sigma * _LANES * (depth[1] - depth[0]))
    for i in range(_LANES):
        shape[i] = np.exp(-2.0 * sigma * depth[i])
    for i in range(_LANES, depth.size):
        shape[i] = step * shape[i - _LANES]
    f = d = ff = fd = dd = yf = yd = 0.0
    for i in range(depth.size):
        first = ratio[i] * shape[i]
        second = depth[i] * first
        f += first
        d += second
        ff += first * first
        fd += first * second
        dd += second * second
        yf += power[i] * first
        yd += power[i] * second
    return f, d, ff, fd, dd, yf, yd


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_variable_projection(
    power: Any, ratio: Array, depth: Array, start: float
) -> tuple[Array, Array]:
    """Fit background, signal at the start and extinction to profiles of unit variance.

    Parameters
    ----------
    power : (profile, bin) float
        At least 8 bins.
    ratio, depth : (bin,) float
        Square of first over range; evenly spaced distances from the first.
    start : float
        Extinction in the unit of 1 / `depth`, of all profiles.

    Returns
    -------
    values, errors : (2, profile) float
        Background and extinction, NaN where the fit does not converge, and standard errors.
    """
    values, errors = np.empty((2, len(power))), np.empty((2, len(power)))
    bins, shape = depth.size, np.empty(depth.size)
    first = ratio * np.exp(-2.0 * start * depth)
    second = depth * first
    f0, d0 = first.sum(), second.sum()
    ff0, fd0, dd0 = (first**2).sum(), (first * second).sum(), (second**2).sum()
    for k in range(len(power)):
        total, yf, yd = _start_sums(power[k], first, second)
        f, d, ff, fd, dd = f0, d0, ff0, fd0, dd0
        sigma, step, error = start, np.inf, 0.0
        background = signal = of_signal = of_background = np.nan
        for iteration in range(_STEPS):
            if iteration:
                f, d, ff, fd, dd, yf, yd = _sums(power[k], ratio, depth, sigma, shape)
            # Without their means, and the slope without the shape.
            ff, fd, dd = ff - f * f / bins, fd - f * d / bins, dd - d * d / bins
            yf, yd = yf - f * total / bins, yd - d * total / bins
            signal = yf / ff
            background = (total - signal * f) / bins
            left = dd - fd * fd / ff
            error = 0.5 / (abs(signal) * np.sqrt(left))
            step = -0.5 * (yd - signal * fd) / (signal * left)
            sigma += step
            if not abs(step) > _CONVERGED * error:
                break
        # d signal / d extinction and d background / d extinction, at the minimum of the rest.
        of_signal = 2.0 * signal * fd / ff
        of_background = (2.0 * signal * d - of_signal * f) / bins
        values[0, k] = background + of_background * step
        values[1, k] = sigma
        if not abs(step) <= _CONVERGED * error:
            values[:, k] = np.nan
        background_variance = 1.0 / bins + (f / bins) ** 2 / ff + of_background**2 * error**2
        errors[0, k] = np.sqrt(background_variance)
        errors[1, k] = error
    return values, errors
