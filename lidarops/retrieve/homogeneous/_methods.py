"""Solvers of the homogeneous path on top of the compiled direct fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.background.cubic_and_tail import BackgroundResult, solve_cubic, solve_tail
from lidarops.retrieve.homogeneous import _direct, _linearized, _masked, _propagation
from lidarops.retrieve.homogeneous._estimate import COLUMNS, CONSTANT, FITTED, PathEstimate
from lidarops.retrieve.homogeneous._fit_quality import judge_fit
from lidarops.retrieve.homogeneous._problem import Array, Flags, PathProblem, PathSolution
from lidarops.retrieve.homogeneous._projection import make_grid

_NOTHING: Final = np.zeros(1, dtype=np.int32)


@dataclass(frozen=True, slots=True)
class _AddedVariances:
    """Variances from sources other than the noise of the fit, in absolute terms."""

    background: Array
    amplitude_relative: Array
    extinction: Array


def solve_by_direct_fit(problem: PathProblem) -> PathSolution:
    """Solve by least squares for all three unknowns."""
    return _solution(_estimate(problem), problem)


def solve_by_masked_fit(problem: PathProblem) -> PathSolution:
    """Solve as `solve_by_direct_fit`, in fewer passes over the bins; the range must be uniform."""
    tables = _masked.make_masked_tables(problem.range, problem.bounds)
    count = problem.power.shape[0]
    table, solved = np.empty((count, len(COLUMNS))), np.empty(count, np.bool_)
    with np.errstate(divide="ignore"):
        weights = 1.0 / problem.noise if problem.known_variance else problem.noise
    _masked.solve_masked(
        problem.power,
        weights,
        not problem.known_variance,
        problem.rounding,
        tables,
        table,
        solved,
    )
    others = np.flatnonzero(~solved)
    if others.size:
        rest = problem.select(others, problem.power[others])
        table[others] = _table(rest, np.full(1, np.nan), _direct.FREE, np.full(1, np.nan))
    return _solution(PathEstimate(**dict(zip(COLUMNS, table.T, strict=True))), problem)


def solve_by_linearization(problem: PathProblem) -> PathSolution:
    """Solve by one linear step from the prior extinction."""
    prior = np.zeros(1) if problem.extinction is None else problem.extinction
    fit = _estimate(problem, kind=_direct.STEP, extinction=prior)
    shifts = _linearized.neglected_shifts(problem, prior, fit.extinction, fit.amplitude)
    with np.errstate(over="ignore", invalid="ignore"):
        added = _AddedVariances(*(shift**2 for shift in shifts))
    return _solution(fit, problem, added=added)


def solve_with_known_extinction(problem: PathProblem) -> PathSolution:
    """Solve for background and amplitude at the given extinction."""
    fit = _estimate(problem, kind=_direct.GIVEN, extinction=problem.extinction)
    return _solution(fit, problem, unknowns=2)


def solve_with_known_background(problem: PathProblem) -> PathSolution:
    """Solve for amplitude and extinction above the given background."""
    background = np.zeros(1) if problem.background is None else problem.background
    variance = np.zeros(1) if problem.background_variance is None else problem.background_variance
    fit = _estimate(problem, background=background)
    spread = _propagated(problem, fit, np.zeros((1, problem.range.size)))
    with np.errstate(over="ignore", invalid="ignore"):
        added = _AddedVariances(
            variance, variance * spread[:, 3] ** 2, variance * spread[:, 4] ** 2
        )
    return _solution(fit, problem, unknowns=2, added=added)


def solve_by_cubic(problem: PathProblem) -> PathSolution:
    """Take the background from the cubic and propagate its error into the other parameters."""
    with np.errstate(divide="ignore"):
        variance = problem.noise if problem.known_variance else 1.0 / problem.noise
    estimate, gradients = solve_cubic(
        problem.power,
        problem.range,
        None,
        variance,
        known_variance=problem.known_variance,
        want_gradients=True,
    )
    return _fit_above(problem, estimate, gradients)


def solve_by_tail_mean(problem: PathProblem) -> PathSolution:
    """Take the background from the tail mean and propagate its noise into the other parameters."""
    return _fit_above(problem, *solve_tail(problem.power, problem.range, None, problem.noise))


def _fit_above(problem: PathProblem, estimate: BackgroundResult, gradients: Array) -> PathSolution:
    """Fit amplitude and extinction above a background that depends on the same power."""
    background = estimate.background
    fit = _estimate(problem, background=background)
    spread = _propagated(problem, fit, gradients)
    fit = replace(
        fit,
        status=np.where(np.isnan(background), np.nan, fit.status),
        background=background,
        background_variance=spread[:, 0],
        amplitude_relative_variance=spread[:, 1],
        extinction_variance=spread[:, 2],
        background_bend=spread[:, 5],
        extinction_bend=fit.extinction_bend + spread[:, 4] * spread[:, 5],
    )
    return _solution(fit, problem, quality=estimate.quality)


def _propagated(problem: PathProblem, fit: PathEstimate, gradients: Array) -> Array:
    out = np.empty((fit.extinction.size, 6))
    _propagation.propagate(
        problem.power,
        problem.noise,
        problem.known_variance,
        np.ascontiguousarray(fit.extinction),
        np.ascontiguousarray(fit.amplitude),
        problem.range,
        gradients,
        out,
    )
    return out


def _estimate(
    problem: PathProblem,
    *,
    background: Array | None = None,
    kind: int = _direct.FREE,
    extinction: Array | None = None,
) -> PathEstimate:
    """Run the kernel; the background is fitted where none is given."""
    free = np.full(1, np.nan)
    table = _table(
        problem,
        free if background is None else background,
        kind,
        free if extinction is None else extinction,
    )
    return PathEstimate(**dict(zip(COLUMNS, table.T, strict=True)))


def _table(problem: PathProblem, background: Array, kind: int, extinction: Array) -> Array:
    table = np.full((problem.power.shape[0], len(COLUMNS)), np.nan)
    _direct.solve_direct(
        problem.power,
        problem.noise,
        problem.known_variance,
        background,
        kind,
        extinction,
        problem.rounding,
        make_grid(problem.range, problem.bounds),
        table,
    )
    return table


def _solution(
    fit: PathEstimate,
    problem: PathProblem,
    *,
    unknowns: int = 3,
    quality: Flags = _NOTHING,
    added: _AddedVariances | None = None,
) -> PathSolution:
    """Judge an estimate and return the solution."""
    if added is None:
        added = _AddedVariances(np.zeros(1), np.zeros(1), np.zeros(1))
    verdict = judge_fit(fit, known_variance=problem.known_variance, unknowns=unknowns)
    fitted, constant = fit.status == FITTED, fit.status == CONSTANT
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        level = verdict.noise * verdict.widening**2
        background_error = np.sqrt(fit.background_variance * level + added.background)
        relative_error = np.sqrt(fit.amplitude_relative_variance * level + added.amplitude_relative)
        extinction_error = np.sqrt(fit.extinction_variance * level + added.extinction)
        signal_to_noise = np.copysign(np.sqrt(fit.signal_energy / verdict.noise), fit.amplitude)
        amplitude_error = np.abs(fit.amplitude) * relative_error

    def masked(values: Array, valid: npt.NDArray[np.bool_]) -> Array:
        return np.where(valid, values, np.nan)

    known = constant & problem.known_variance
    return PathSolution(
        background=masked(fit.background, fitted | constant),
        background_standard_error=masked(background_error, fitted | known),
        amplitude=np.where(constant, 0.0, masked(fit.amplitude, fitted)),
        amplitude_standard_error=masked(amplitude_error, fitted),
        extinction=masked(fit.extinction, fitted),
        extinction_standard_error=masked(extinction_error, fitted),
        signal_to_noise=masked(signal_to_noise, fitted),
        reduced_chi2=masked(verdict.reduced_chi2, fitted),
        curvature_misfit=np.full(fit.status.shape, np.nan),
        mean_range=masked(fit.mean_range, fitted),
        background_bend=masked(fit.background_bend, fitted),
        extinction_bend=masked(fit.extinction_bend, fitted),
        valid_bins=np.nan_to_num(fit.bins).astype(np.int32),
        quality=verdict.quality | quality,
    )
