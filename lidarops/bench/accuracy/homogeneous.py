"""Measure the accuracy of the solvers of a homogeneous path against the least possible error.

The scores of the elastic retrieval are here too; `lidarops.bench.accuracy.elastic` uses them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy.homogeneous_cases import (
    QUANTITIES,
    Array,
    Estimates,
    PathSolver,
    Scenario,
    background_bias,
    difficulty,
    least_errors,
    methods,
    scenarios,
)
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.rows import MonteCarloFigure
from lidarops.bench.harness.timing import Machine, machine
from lidarops.retrieve.background.cubic_and_tail import cubic
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

PROFILES: Final = 10_000
QUICK_PROFILES: Final = 4_000
_SLOW: Final = "scipy"
"""Prefix of the names of solvers that are too slow for all profiles."""
_SLOW_SHARE: Final = 20
_WARM: Final = 64
_TWO_SIDED: Final = 1.959963984540054
"""Standard deviations that hold 95 percent of a normal distribution."""

_PAPER_LENGTHS: Final = ((2500.0, (1e3, 2e3, 4e3, 6e3, 8e3)), (10500.0, (1e3, 2e3, 2.5e3)))
_PAPER_STEP: Final = 15.0
_PAPER_SIGNAL: Final = 17.0
_PAPER_EXTINCTION: Final = 3e-5
_AVERAGED: Final = 100


@dataclass(frozen=True, slots=True)
class PathScore:
    """Errors of one unknown, over the profiles that are not rejected."""

    rmse: MonteCarloFigure
    """Over the Cramér-Rao bound."""
    bias: MonteCarloFigure
    """Over the Cramér-Rao bound."""
    coverage: MonteCarloFigure
    """Share of profiles whose truth is within 1.96 stated standard errors."""
    rmse_of_all: float
    """As `rmse`, over every profile with a value, rejected or not."""


@dataclass(frozen=True, slots=True)
class SolverOutcome:
    """Errors, flags and time of one solver on one scenario."""

    method: str
    profiles: int
    flagged: float
    """Share of profiles with any quality bit."""
    rejected: float
    """Share of profiles with a rejecting quality bit."""
    nanoseconds: float
    """CPU time per profile, of one run."""
    scores: Mapping[str, PathScore]
    """By unknown; without those that are given to the solver or always rejected."""
    distances: Mapping[str, float]
    """Largest difference from the direct method over the Cramér-Rao bound, by unknown, over the
    profiles that neither rejects; without those that are given to the solver."""


@dataclass(frozen=True, slots=True)
class AccuracyCase:
    """One scenario with the outcomes of all solvers."""

    scenario: Scenario
    difficulty: float
    """Least standard error of extinction over extinction + 1 / mean range."""
    least_errors: Mapping[str, float]
    outcomes: tuple[SolverOutcome, ...]


@dataclass(frozen=True, slots=True)
class Offset:
    """Mean error of the background on the signals of bobrovsky2024, tables 1 and 2."""

    start: float
    """m."""
    length: float
    """m."""
    averaged: int
    """Profiles averaged before they are solved."""
    lag_1: MonteCarloFigure
    """Of the cubic with a lag of one bin and no noise correction, in units of the noise."""
    compressed: MonteCarloFigure
    """Of the compressed method, in units of the noise; all profiles, flagged or not."""
    scatter: float
    """Standard deviation of the background of the compressed method, in units of the noise."""
    expected: float
    """Second-order bias of least squares."""
    flagged: float
    """Share of profiles that the compressed method flags."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Result of the accuracy benchmark."""

    date: str
    machine: Machine
    cases: tuple[AccuracyCase, ...]
    offsets: tuple[Offset, ...]


def measure_homogeneous(effort: Effort, *, profiles: int | None = None) -> Accuracy:
    """Solve simulated profiles by every method of `fit_homogeneous_path` and by iterative peers.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Per scenario; the peers of scipy get a twentieth of them, at least 16.
    """
    count = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    solvers = {**methods(), **iterative_peers()}
    cases = []
    for seed, scenario in enumerate(scenarios(quick=effort.quick)):
        cases.append(_case(scenario, solvers, scenario.powers(count, seed)))
        effort.progress(1)
    return Accuracy(effort.date, machine(), tuple(cases), tuple(offsets(count)))


def offsets(count: int) -> list[Offset]:
    """Return the errors of background for the signals of the published tables.

    The tables do not state the signal. A signal of 17 times the noise at 2.5 km, bins of 15 m and
    an extinction of 0.03 km-1 reproduce the decrease of the published background with length.
    """
    fade = np.exp(-2 * _PAPER_EXTINCTION * (10500.0 - 2500.0)) * (2500.0 / 10500.0) ** 2
    signals = {2500.0: _PAPER_SIGNAL, 10500.0: float(_PAPER_SIGNAL * fade)}
    paths = [
        Scenario(
            start,
            length,
            _PAPER_EXTINCTION,
            signals[start],
            bins=round(length / _PAPER_STEP) + 1,
        )
        for start, lengths in _PAPER_LENGTHS
        for length in lengths
    ]
    return [
        _offset(path, averaged, count, seed)
        for averaged in (1, _AVERAGED)
        for seed, path in enumerate(paths)
    ]


def _offset(path: Scenario, averaged: int, count: int, seed: int) -> Offset:
    # The mean of white noise is white noise: powers in units of its standard deviation.
    scale = float(np.sqrt(averaged))
    averaged_path = Scenario(
        path.start,
        path.length,
        path.extinction,
        path.signal * scale,
        background=path.background * scale,
        bins=path.bins,
    )
    power = averaged_path.powers(count, seed)
    # A variance of 0 means no noise, so that its bias is not subtracted, as published.
    published = cubic(power, averaged_path.range, lag=1, variance=0.0).background
    solution = methods()[HomogeneousMethod.COMPRESSED](power, averaged_path)
    background = solution.values["background"]
    return Offset(
        start=path.start,
        length=path.length,
        averaged=averaged,
        lag_1=mean((published - averaged_path.background) / scale),
        compressed=mean((background - averaged_path.background) / scale),
        scatter=float(np.nanstd(background)) / scale,
        expected=background_bias(averaged_path) / scale,
        flagged=float(solution.flagged.mean()),
    )


def _case(scenario: Scenario, solvers: Mapping[str, PathSolver], power: Any) -> AccuracyCase:
    least = least_errors(scenario)
    converged = solvers[HomogeneousMethod.DIRECT](power, scenario)
    outcomes = [
        _outcome(name, solver, scenario, power, least, converged)
        for name, solver in solvers.items()
    ]
    return AccuracyCase(scenario, difficulty(scenario), least, tuple(outcomes))


def _outcome(
    name: str,
    solver: PathSolver,
    scenario: Scenario,
    power: Any,
    least: Mapping[str, float],
    converged: Estimates,
) -> SolverOutcome:
    if name.startswith(_SLOW):
        power = power[: max(len(power) // _SLOW_SHARE, 16)]
    solver(power[:_WARM], scenario)
    begin = time.process_time()
    solution = solver(power, scenario)
    spent = time.process_time() - begin
    scores = {
        quantity: score
        for quantity in QUANTITIES
        if (score := _score(solution, quantity, scenario.truth[quantity], least[quantity]))
    }
    return SolverOutcome(
        method=name,
        profiles=len(power),
        flagged=float(solution.flagged.mean()),
        rejected=float(solution.rejected.mean()),
        nanoseconds=1e9 * spent / len(power),
        scores=scores,
        distances={
            quantity: _distance(solution, converged, quantity) / least[quantity]
            for quantity in scores
        },
    )


def _score(solution: Estimates, quantity: str, truth: float, least: float) -> PathScore | None:
    error = (solution.values[quantity] - truth) / least
    stated = solution.standard_errors[quantity] / least
    finite = np.isfinite(error)
    kept = finite & ~solution.rejected
    if kept.sum() < 2 or not np.any(stated[kept] > 0):
        return None
    squares = error[kept] ** 2
    rmse = float(np.sqrt(squares.mean()))
    inside = np.abs(error[kept]) <= _TWO_SIDED * stated[kept]
    return PathScore(
        rmse=MonteCarloFigure(rmse, mean(squares).error / (2 * rmse)),
        bias=mean(error[kept]),
        coverage=share_inside(inside),
        rmse_of_all=float(np.sqrt(np.mean(error[finite] ** 2))),
    )


def _distance(solution: Estimates, converged: Estimates, quantity: str) -> float:
    count = len(solution.rejected)
    kept = ~solution.rejected & ~converged.rejected[:count]
    distance = np.abs(solution.values[quantity] - converged.values[quantity][:count])[kept]
    return float(np.nanmax(distance, initial=0.0))


def mean(values: Array) -> MonteCarloFigure:
    """Return the mean of the finite values with its Monte Carlo error."""
    finite = values[np.isfinite(values)]
    return MonteCarloFigure(float(finite.mean()), float(finite.std() / np.sqrt(finite.size)))


def share_inside(inside: npt.NDArray[np.bool_]) -> MonteCarloFigure:
    """Return the share of independent profiles that are inside, with its Monte Carlo error."""
    # Where all or none are inside, half a profile keeps the error from being zero.
    probability = (inside.sum() + 0.5) / (inside.size + 1)
    return MonteCarloFigure(
        float(inside.mean()), float(np.sqrt(probability * (1 - probability) / inside.size))
    )


def outcomes_of(accuracy: Accuracy, method: str) -> Sequence[tuple[AccuracyCase, SolverOutcome]]:
    """Return the outcomes of one method, with their cases."""
    return [
        (case, outcome)
        for case in accuracy.cases
        for outcome in case.outcomes
        if outcome.method == method
    ]


# Elastic retrieval ---------------------------------------------------------------------------


SIGMAS: Final = (1.0, _TWO_SIDED)


@dataclass(frozen=True, slots=True)
class BackgroundScore:
    """Errors of one method, in counts, over the profiles that it does not reject."""

    profiles: int
    bias: MonteCarloFigure
    scatter: MonteCarloFigure
    rmse: MonteCarloFigure
    stated: float
    """Median of the stated standard errors."""
    deviation: MonteCarloFigure
    """Mean of error over stated standard error."""
    spread: MonteCarloFigure
    """Root mean square of the same; 1 where the stated errors are right."""
    coverage: tuple[MonteCarloFigure, MonteCarloFigure]
    """Share of profiles whose truth is within 1 and 1.96 stated standard errors."""


@dataclass(frozen=True, slots=True)
class InversionScore:
    """Errors of backscatter from 0.5 to 6 km, relative to its mean there."""

    profiles: int
    """Profiles with any value in these bins."""
    solved: float
    """Share of these bins, over all profiles, that have a value; the others are withheld."""
    bias: MonteCarloFigure
    """Mean error of a profile."""
    scatter: float
    """Standard deviation of the same."""
    rmse: MonteCarloFigure
    """Root mean square error of a bin."""
    stated: float
    """Root mean square of the stated standard errors of a bin."""
    coverage: tuple[MonteCarloFigure, MonteCarloFigure]
    """Share of bins whose truth is within 1 and 1.96 stated standard errors."""


def background_score(
    error: Array, stated: Array, rejected: npt.NDArray[np.bool_]
) -> BackgroundScore | None:
    """Return the errors of backgrounds; None where fewer than two are usable.

    Parameters
    ----------
    error, stated : (profile,) float
        Counts.
    rejected : (profile,) bool
    """
    kept = ~rejected & np.isfinite(error) & (stated > 0)
    if kept.sum() < 2:
        return None
    error, stated = error[kept], stated[kept]
    deviation = error / stated
    inside = [share_inside(np.abs(deviation) <= sigmas) for sigmas in SIGMAS]
    return BackgroundScore(
        profiles=int(kept.sum()),
        bias=mean(error),
        scatter=_root(mean((error - error.mean()) ** 2)),
        rmse=_root(mean(error**2)),
        stated=float(np.median(stated)),
        deviation=mean(deviation),
        spread=_root(mean(deviation**2)),
        coverage=(inside[0], inside[1]),
    )


def inversion_score(error: Array, stated: Array, scale: float) -> InversionScore | None:
    """Return the errors of backscatter; None where fewer than two of many profiles have a value.

    Parameters
    ----------
    error, stated : (profile, compared bin) float
        m-1 sr-1; NaN where withheld.
    scale : float
        Mean of the truth, m-1 sr-1.
    """
    valid = np.isfinite(error) & np.isfinite(stated)
    kept = np.any(valid, axis=1)
    if kept.sum() < min(2, kept.size) or not np.any(kept):
        return None
    error, stated, valid = error[kept], stated[kept], valid[kept]
    bins = valid.sum(axis=1)

    def over_bins(values: npt.NDArray[np.generic]) -> Array:
        return np.asarray(np.where(valid, values, 0.0).sum(axis=1) / bins)

    biases = over_bins(error) / scale
    inside = [mean(over_bins(np.abs(error) <= sigmas * stated)) for sigmas in SIGMAS]
    return InversionScore(
        profiles=int(kept.sum()),
        solved=float(bins.sum() / (kept.size * error.shape[1])),
        bias=mean(biases),
        scatter=float(biases.std()),
        rmse=_root(mean(over_bins((error / scale) ** 2))),
        stated=float(np.sqrt(over_bins((stated / scale) ** 2).mean())),
        coverage=(inside[0], inside[1]),
    )


def _root(square: MonteCarloFigure) -> MonteCarloFigure:
    value = float(np.sqrt(square.value))
    return MonteCarloFigure(value, square.error / (2.0 * value) if value > 0 else 0.0)
