"""Compiled fits of the homogeneous path at a given background or from a given extinction."""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._direct import begin, describe, find_extinction, unscale
from lidarops.retrieve.homogeneous._estimate import (
    AMPLITUDE,
    AMPLITUDE_RELATIVE_VARIANCE,
    BACKGROUND,
    BACKGROUND_SLOPE_VARIANCE,
    BACKGROUND_VARIANCE,
    BOUNDED,
    EXTINCTION,
    EXTINCTION_VARIANCE,
    FITTED,
    SIGNAL_ENERGY,
    STATUS,
)
from lidarops.retrieve.homogeneous._misfit import describe_bend_given, judge_residuals
from lidarops.retrieve.homogeneous._projection import (
    Grid,
    Point,
    compiled,
    evaluate,
    make_scratch,
    product,
    total_of,
)

Array = npt.NDArray[np.float64]


@compiled
def _describe_given(p: Point, w0: float, row: Array) -> None:
    """Overwrite the variances for a given extinction, whose variance is 0."""
    row[EXTINCTION_VARIANCE] = 0.0
    row[BACKGROUND_SLOPE_VARIANCE] = 0.0
    row[BACKGROUND_VARIANCE] = 1.0 / w0 + p.mean_phi * p.mean_phi / p.norm
    row[AMPLITUDE_RELATIVE_VARIANCE] = 1.0 / row[SIGNAL_ENERGY]
    row[BOUNDED] = 0.0


@compiled
def _step(g: Grid, p: Point, tau: float, row: Array) -> None:
    """Write the linear step from a prior, with errors to first order in the two coefficients.

    About the centroid, the coefficients of shape and slope are independent.
    """
    slope = p.gradient / (p.b * p.slope_norm)
    step, lever = slope / p.b, 2.0 * (g.start / g.length + p.centroid)
    by_slope, by_shape = 1.0 / p.b, -step / p.b
    row[EXTINCTION_VARIANCE] = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    by_slope, by_shape = lever * by_slope, 1.0 / p.b + lever * by_shape
    row[AMPLITUDE_RELATIVE_VARIANCE] = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    row[BACKGROUND] -= slope * p.mean_t
    row[EXTINCTION] = tau + step
    row[AMPLITUDE] = p.b * math.exp(2.0 * step * p.centroid)


@compiled
def _moved(p: Point, row: Array) -> Point:
    """Return the point with the background and amplitude of a row."""
    return Point(
        row[AMPLITUDE],
        row[BACKGROUND] + row[AMPLITUDE] * p.mean_phi,
        p.mean_phi,
        p.mean_t,
        p.centroid,
        p.norm,
        p.slope_norm,
        p.gradient,
        p.curvature,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_above(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    background: Array,
    g: Grid,
    out: Array,
) -> None:
    """Fit amplitude and extinction above given backgrounds, (profile or 1,).

    The other parameters are those of `_direct.solve_direct`.
    """
    s = make_scratch(g.x.size, g.group_shapes.shape[1])
    for k in range(power.shape[0]):
        row = out[k]
        mode = (is_variance, rounding, background[k % background.size])
        reference, scale, unit = begin(power[k], noise[k % noise.shape[0]], mode, s, row)
        if row[STATUS] == FITTED:
            sums = (total_of(s.w), product(s.w, s.z), 0.0)
            tau, p = find_extinction(g, s, sums)
            describe(g, s, p, tau, sums, row)
            spacing = 0 if is_variance else g.noise_spacing[k % g.noise_spacing.size]
            judge_residuals(g, s, p, tau, sums, spacing, row)
            unscale(g, reference, scale, unit, row)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_from(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    extinction: Array,
    g: Grid,
    out: Array,
    is_prior: bool,
) -> None:
    """Fit background and amplitude at extinctions, (profile or 1,), m-1: given ones, or priors.

    From a prior, one linear step leads to the extinction. The other parameters are those of
    `_direct.solve_direct`.
    """
    s = make_scratch(g.x.size, g.group_shapes.shape[1])
    for k in range(power.shape[0]):
        row = out[k]
        mode = (is_variance, rounding, math.nan)
        reference, scale, unit = begin(power[k], noise[k % noise.shape[0]], mode, s, row)
        if row[STATUS] == FITTED:
            tau = g.length * extinction[k % extinction.size]
            sums = (total_of(s.w), product(s.w, s.z), 1.0)
            p = evaluate(tau, g, s, sums)
            describe(g, s, p, tau, sums, row)
            if is_prior:
                _step(g, p, tau, row)
                tau = row[EXTINCTION]
                row[BOUNDED] = tau <= g.nodes[0] or tau >= g.nodes[-1]
                p = _moved(evaluate(tau, g, s, sums), row)
            spacing = 0 if is_variance else g.noise_spacing[k % g.noise_spacing.size]
            judge_residuals(g, s, p, tau, sums, spacing, row)
            if not is_prior:
                _describe_given(p, sums[0], row)
                describe_bend_given(p, row)
            unscale(g, reference, scale, unit, row)
