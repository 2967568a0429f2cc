"""Solvers of the homogeneous path, one for each method."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, cast

import numpy as np

from lidarops.retrieve.background.cubic_and_tail import BackgroundResult, solve_cubic
from lidarops.retrieve.common.arrays import HUGE, Array, Flags, frozen
from lidarops.retrieve.homogeneous import _direct
from lidarops.retrieve.homogeneous._fit_quality import curved_widening, judge_fit
from lidarops.retrieve.homogeneous._problem import (
    COLUMNS,
    CONSTANT,
    FITTED,
    ROW,
    HomogeneousResult,
    PathEstimate,
    PathProblem,
)
from lidarops.retrieve.homogeneous._projection import make_grid
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.thresholds import THRESHOLDS as SIGNAL

_NOTHING: Final = np.zeros(1, dtype=np.int32)
_FITTED_BACKGROUND: Final = np.full(1, np.nan)


def solve_by_direct_fit(problem: PathProblem) -> HomogeneousResult:
    """Solve by least squares for all three unknowns."""
    return _solution(_estimate(problem, _FITTED_BACKGROUND), problem)


def solve_by_linearization(problem: PathProblem) -> HomogeneousResult:
    """Solve by one linear step from the prior extinction."""
    prior = np.zeros(1) if problem.extinction is None else problem.extinction
    fit = _estimate(problem, prior, _direct.PRIOR)
    # What one step neglects is about what another one would add.
    shifts = (fit.background_shift, fit.amplitude_shift, fit.extinction_shift)
    with np.errstate(over="ignore", invalid="ignore"):
        added = tuple(shift**2 for shift in shifts)
    return _solution(fit, problem, added=added)


def solve_with_known_extinction(problem: PathProblem) -> HomogeneousResult:
    """Solve for background and amplitude at the given extinction."""
    # `fit_homogeneous_path` has checked that it is given.
    extinction = cast("Array", problem.extinction)
    fit = _estimate(problem, extinction, _direct.EXTINCTION)
    return _solution(fit, problem, unknowns=2)


def solve_with_known_background(problem: PathProblem) -> HomogeneousResult:
    """Solve for amplitude and extinction above the given background."""
    background = np.zeros(1) if problem.background is None else problem.background
    variance = np.zeros(1) if problem.background_variance is None else problem.background_variance
    fit = _estimate(problem, background)
    with np.errstate(over="ignore", invalid="ignore"):
        by_slopes = (variance * slope**2 for slope in (fit.amplitude_slope, fit.extinction_slope))
        added = (variance, *by_slopes)
    return _solution(fit, problem, unknowns=2, added=added)


def solve_by_cubic(problem: PathProblem) -> HomogeneousResult:
    """Take the background from the cubic and propagate its error into the other parameters."""
    estimate, gradients = solve_cubic(
        problem.power,
        problem.range,
        problem.lag,
        problem.noise,
        known_variance=problem.known_variance,
        want_gradients=True,
    )
    return _fit_above(problem, estimate, gradients)


def _fit_above(
    problem: PathProblem, estimate: BackgroundResult, gradients: Array
) -> HomogeneousResult:
    """Fit amplitude and extinction above a background that depends on the same power.

    `gradients`, (profile or 1, bin), are the derivatives of the background by the power, through
    which noise is propagated to first order.
    """
    background, near = estimate.background, problem.range[0]
    fit = _estimate(problem, background)
    length, middle = np.ptp(problem.range), 0.5 * (near + problem.range[-1])
    with np.errstate(all="ignore"):
        weights = _weights(problem)
        decay = np.exp(-2.0 * fit.extinction[:, np.newaxis] * problem.range)
        signal = fit.amplitude[:, np.newaxis] * decay / problem.range**2
        pull = weights * signal
        norm, lever = _row_sum(pull * signal), -2.0 * problem.range
        lever = lever - (_row_sum(lever * pull * signal) / norm)[:, np.newaxis]
        centroid = np.asarray(near + 0.5 * lever[:, 0])
        # Without the background, then through it.
        extinction = lever * pull / _row_sum(lever**2 * pull * signal)[:, np.newaxis]
        logarithm = pull / norm[:, np.newaxis] + 2.0 * centroid[:, np.newaxis] * extinction
        extinction = extinction + fit.extinction_slope[:, np.newaxis] * gradients
        logarithm = logarithm + fit.amplitude_slope[:, np.newaxis] * gradients
        used = weights > 0.0
        bent = _row_sum(np.where(used, gradients * signal, 0.0) * (problem.range - middle) ** 2)
        variance = np.where(used, 1.0 / weights, 0.0)
    bend = bent / length
    fit = replace(
        fit,
        status=np.where(np.isnan(background), np.nan, fit.status),
        background=background,
        background_variance=_row_sum(gradients**2 * variance),
        background_slope_variance=np.zeros(1),
        amplitude_relative_variance=_row_sum(logarithm**2 * variance),
        extinction_variance=_row_sum(extinction**2 * variance),
        background_bend=bend,
        extinction_bend=fit.extinction_bend + fit.extinction_slope * bend,
    )
    return _solution(fit, problem, quality=estimate.quality)


def _weights(problem: PathProblem) -> Array:
    """Return the weights of all bins, 0 of those that are left out."""
    weights = 1.0 / problem.noise
    usable = (np.abs(problem.power) < HUGE) & (weights > 0.0) & (weights < HUGE)
    return np.where(usable, weights, 0.0)


def _row_sum(values: Array) -> Array:
    return np.asarray(values.sum(axis=-1))


def _estimate(problem: PathProblem, given: Array, kind: int = _direct.BACKGROUND) -> PathEstimate:
    """Fit the profiles with what is given beside them."""
    record = np.empty(1, ROW)
    columns = np.empty((len(COLUMNS), problem.power.shape[0]))
    # Second differences over more than a twentieth of a section would hold its misfit.
    widest = min(SIGNAL.most_correlated_bins, problem.range.size // 20)
    spacing = np.where(problem.correlation_length > 1.0, max(widest, 1), 1).astype(np.int64)
    grid = make_grid(problem.range.tobytes(), problem.bounds)
    # Relative rounding of the power and of the kernels, as a standard deviation.
    rounding = 0.3 * float(np.finfo(problem.power.dtype).eps) + 8.0 * float(np.finfo(float).eps)
    noise = (frozen(problem.noise), problem.known_variance, rounding, frozen(spacing))
    _direct.solve_path(
        frozen(problem.power),
        noise,
        frozen(given),
        kind,
        grid,
        (record, record.view(float), columns),
    )
    return PathEstimate(*columns)


def _solution(
    fit: PathEstimate,
    problem: PathProblem,
    *,
    unknowns: int = 3,
    quality: Flags = _NOTHING,
    added: tuple[Array, ...] = (np.zeros(1),) * 3,
) -> HomogeneousResult:
    """Judge an estimate and return the solution.

    `added` are variances from sources other than the noise of the fit: of the background, of the
    logarithm of the amplitude, and of the extinction.
    """
    of_background, of_amplitude, of_extinction = added
    verdict = judge_fit(fit, problem, unknowns=unknowns, added_variance=of_extinction)
    length = problem.correlation_length
    fitted, constant = fit.status == FITTED, fit.status == CONSTANT
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        level = verdict.noise * verdict.widening**2 * length
        curved = fit.background_slope_variance * (
            curved_widening(verdict.relative_error) ** 2 - 1.0
        )
        background_variance = fit.background_variance + np.where(fitted, curved, 0.0)
        background_error = np.sqrt(background_variance * level + of_background)
        relative_error = np.sqrt(fit.amplitude_relative_variance * level + of_amplitude)
        extinction_error = np.sqrt(fit.extinction_variance * level + of_extinction)
        signal_to_noise = np.copysign(
            np.sqrt(fit.signal_energy / verdict.noise / length), fit.amplitude
        )
        amplitude_error = np.abs(fit.amplitude) * relative_error

    known = constant & problem.known_variance
    departure = THRESHOLDS.model_error * (np.abs(fit.extinction) + 1.0 / fit.mean_range)
    # A signal bent by c (x - 1/2)^2 has slopes of -c and c over the length at its ends.
    background_model = 2.0 * departure * np.abs(fit.background_bend)
    extinction_model = departure * np.hypot(1.0, 2.0 * np.abs(fit.extinction_bend))
    return HomogeneousResult(
        background=np.where(fitted | constant, fit.background, np.nan),
        background_standard_error=np.where(fitted | known, background_error, np.nan),
        background_model_error=np.where(fitted, background_model, np.nan),
        amplitude=np.where(constant, 0.0, np.where(fitted, fit.amplitude, np.nan)),
        amplitude_standard_error=np.where(fitted, amplitude_error, np.nan),
        extinction=np.where(fitted, fit.extinction, np.nan),
        extinction_standard_error=np.where(fitted, extinction_error, np.nan),
        extinction_model_error=np.where(fitted, extinction_model, np.nan),
        signal_to_noise=np.where(fitted, signal_to_noise, np.nan),
        reduced_chi2=np.where(fitted, verdict.reduced_chi2, np.nan),
        valid_bins=fit.bins.astype(np.int32),
        quality=verdict.quality | quality,
    )
