"""Solvers of the homogeneous path, one for each method.

Where a background comes from elsewhere, `propagate` carries its noise into the fit above it.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np

from lidarops.retrieve.background.cubic_and_tail import BackgroundResult, solve_cubic
from lidarops.retrieve.common.arrays import HUGE, Array, Block, Flags, frozen
from lidarops.retrieve.common.compiled_code import compiled
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
    shifts = _neglected_shifts(problem, prior, fit.extinction, fit.amplitude)
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
    spread = _propagated(problem, fit, np.zeros((1, problem.range.size)))
    with np.errstate(over="ignore", invalid="ignore"):
        by_slopes = (spread[f"{name}_slope"] for name in ("amplitude", "extinction"))
        added = (variance, *(variance * slope**2 for slope in by_slopes))
    return _solution(fit, problem, unknowns=2, added=added)


def solve_by_cubic(problem: PathProblem) -> HomogeneousResult:
    """Take the background from the cubic and propagate its error into the other parameters."""
    with np.errstate(divide="ignore"):
        variance = problem.noise if problem.known_variance else 1.0 / problem.noise
    estimate, gradients = solve_cubic(
        problem.power,
        problem.range,
        problem.lag,
        variance,
        known_variance=problem.known_variance,
        want_gradients=True,
    )
    return _fit_above(problem, estimate, gradients)


def _fit_above(
    problem: PathProblem, estimate: BackgroundResult, gradients: Array
) -> HomogeneousResult:
    """Fit amplitude and extinction above a background that depends on the same power."""
    background = estimate.background
    fit = _estimate(problem, background)
    spread = _propagated(problem, fit, gradients)
    fit = replace(
        fit,
        status=np.where(np.isnan(background), np.nan, fit.status),
        background=background,
        background_variance=spread["background_variance"],
        background_slope_variance=np.zeros(1),
        amplitude_relative_variance=spread["amplitude_relative_variance"],
        extinction_variance=spread["extinction_variance"],
        background_bend=spread["background_bend"],
        extinction_bend=fit.extinction_bend
        + spread["extinction_slope"] * spread["background_bend"],
    )
    return _solution(fit, problem, quality=estimate.quality)


def _propagated(problem: PathProblem, fit: PathEstimate, gradients: Array) -> Block:
    out = np.zeros(fit.extinction.size, PROPAGATED)
    propagate(
        frozen(problem.power),
        frozen(problem.noise),
        problem.known_variance,
        frozen(fit.extinction),
        frozen(fit.amplitude),
        frozen(problem.range),
        frozen(gradients),
        out,
    )
    return out


def _estimate(problem: PathProblem, given: Array, kind: int = _direct.BACKGROUND) -> PathEstimate:
    """Fit the profiles with what is given beside them."""
    table = np.full(problem.power.shape[0], np.nan, ROW)
    # Second differences over more than a twentieth of a section would hold its misfit.
    widest = min(SIGNAL.most_correlated_bins, problem.range.size // 20)
    spacing = np.where(problem.correlation_length > 1.0, max(widest, 1), 1).astype(np.int64)
    grid = make_grid(problem.range, problem.bounds, spacing)
    # Relative rounding of the power and of the kernels, as a standard deviation.
    rounding = 0.3 * float(np.finfo(problem.power.dtype).eps) + 8.0 * float(np.finfo(float).eps)
    noise = (frozen(problem.noise), problem.known_variance, rounding)
    _direct.solve_path(frozen(problem.power), *noise, frozen(given), kind, grid, table)
    return PathEstimate(**{name: table[name] for name in COLUMNS})


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
        valid_bins=np.nan_to_num(fit.bins).astype(np.int32),
        quality=verdict.quality | quality,
    )


def _neglected_shifts(
    problem: PathProblem, prior: Array, extinction: Array, amplitude: Array
) -> tuple[Array, Array, Array]:
    """Return the shifts of the parameters by the second-order term that one step neglects.

    With the step t in extinction and the coefficient b of the shape phi, the term is
    ``2 b t^2 (x - x_c)^2 phi``, x_c being the centroid of information.

    Parameters
    ----------
    problem : PathProblem
    prior : (profile or 1,) float
        m-1.
    extinction, amplitude : (profile,) float
        m-1, power times m2: the result of one step.

    Returns
    -------
    (profile,) float
        Shifts of the background, of the logarithm of the amplitude and of the extinction.
    """
    near, length = problem.range[0], max(float(problem.range[-1] - problem.range[0]), 1.0)
    x = (problem.range - near) / length
    with np.errstate(all="ignore"):
        weights = 1.0 / problem.noise if problem.known_variance else problem.noise
        usable = np.isfinite(problem.power) & (weights > 0.0) & np.isfinite(weights)
        weights = np.where(usable, weights, 0.0)
        total = weights.sum(axis=-1)

        def mean(values: Array) -> Array:
            return np.asarray((weights * values).sum(axis=-1) / total)

        def share(values: Array, of: Array) -> Array:
            return mean(values * of) / mean(of * of)

        shape = np.exp(-2.0 * prior[:, np.newaxis] * length * x) * (near / problem.range) ** 2
        shape_mean = mean(shape)
        centred = shape - shape_mean[:, np.newaxis]
        centroid = mean(centred * shape * x) / mean(centred * centred)
        distance = x - centroid[:, np.newaxis]
        slope = -2.0 * distance * shape
        slope_mean = mean(slope)
        slope = slope - slope_mean[:, np.newaxis]
        # The coefficient at the first bin, with the fitted extinction: of second order already.
        height = amplitude / near**2 * np.exp(-2.0 * extinction * near)
        step = (extinction - prior) * length
        neglected = (2.0 * height * step**2)[:, np.newaxis] * distance**2 * shape
        level = mean(neglected)
        neglected = neglected - level[:, np.newaxis]
        along_slope, along_shape = share(neglected, slope), share(neglected, centred)
        background = level - along_shape * shape_mean - along_slope * slope_mean
        shift = (along_slope - step * along_shape) / height
        logarithm = along_shape / height + 2.0 * (centroid + near / length) * shift
    return background, logarithm, shift / length


PROPAGATED: Final = np.dtype(
    [
        (name, np.float64)
        for name in (
            "background_variance",
            "amplitude_relative_variance",
            "extinction_variance",
            "amplitude_slope",
            "extinction_slope",
            "background_bend",
        )
    ]
)


@compiled
def fill_linear_weights(power: Any, noise: Array, is_variance: bool, weights: Array) -> None:
    for i in range(weights.size):
        weight = 1.0 / noise[i] if is_variance else noise[i]
        usable = abs(np.float64(power[i])) < HUGE and 0.0 < weight < HUGE
        weights[i] = weight if usable else 0.0


@compiled
def _propagate_profile(
    b: float,
    phi: Array,
    range_: Array,
    weights: Array,
    gradient: Array,
    row: Any,
) -> None:
    """Fill the random variances of one profile, and its derivatives by the background."""
    norm = moment = 0.0
    for i in range(phi.size):
        norm += phi[i] * phi[i] * weights[i]
        moment += phi[i] * phi[i] * weights[i] * range_[i]
    centroid = moment / norm
    slope = whole = tilted = 0.0
    for i in range(phi.size):
        lever = -2.0 * (range_[i] - centroid)
        slope += lever * lever * phi[i] * phi[i] * weights[i]
        whole += phi[i] * weights[i]
        tilted += lever * phi[i] * weights[i]
    row.extinction_slope = -tilted / (b * slope)
    row.amplitude_slope = -whole / (b * norm) + 2.0 * centroid * row.extinction_slope
    length, middle = range_[-1] - range_[0], 0.5 * (range_[0] + range_[-1])
    for i in range(phi.size):
        if weights[i] == 0.0:
            continue
        row.background_bend += gradient[i] * b * phi[i] * (range_[i] - middle) ** 2 / length
        weighted = phi[i] * weights[i]
        lever = -2.0 * (range_[i] - centroid)
        extinction_gradient = lever * weighted / (b * slope)
        logarithm_gradient = weighted / (b * norm) + 2.0 * centroid * extinction_gradient
        extinction_gradient += row.extinction_slope * gradient[i]
        logarithm_gradient += row.amplitude_slope * gradient[i]
        row.background_variance += gradient[i] * gradient[i] / weights[i]
        row.amplitude_relative_variance += logarithm_gradient * logarithm_gradient / weights[i]
        row.extinction_variance += extinction_gradient * extinction_gradient / weights[i]


@compiled
def propagate(
    power: Any,
    noise: Array,
    is_variance: bool,
    extinction: Array,
    amplitude: Array,
    range_: Array,
    gradients: Array,
    out: Any,
) -> None:
    """Propagate noise to first order, through a background that depends on the power too.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : (profile or 1, bin) float64
        Variances or weights, as in the fit.
    is_variance : bool
    extinction, amplitude : (profile,) float
        m-1, power times m2: from the weighted fit to the power less the background.
    range_ : (bin,) float
        m.
    gradients : (profile or 1, bin) float64
        Derivatives of the background with respect to the power.
    out : (profile,) `PROPAGATED`
        In: 0. Receives variances; the derivatives of the logarithm of the amplitude and of the
        extinction with respect to the background; and the change of the background by a signal
        bent by ``(x - 1/2)^2``, times the length of the section.
    """
    start, phi, weights = range_[0], np.empty(range_.size), np.empty(range_.size)
    for k in range(extinction.size):
        for i in range(phi.size):
            phi[i] = (start / range_[i]) ** 2 * math.exp(-2.0 * extinction[k] * (range_[i] - start))
        b = amplitude[k] * math.exp(-2.0 * extinction[k] * start) / start**2
        fill_linear_weights(power[k], noise[k % noise.shape[0]], is_variance, weights)
        _propagate_profile(b, phi, range_, weights, gradients[k % gradients.shape[0]], out[k])
