"""Compiled fits of the homogeneous path from a given extinction."""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.homogeneous._direct import (
    begin,
    describe,
    unscale,
    weigh,
)
from lidarops.retrieve.homogeneous._misfit import describe_bend_given, judge_residuals
from lidarops.retrieve.homogeneous._problem import FITTED
from lidarops.retrieve.homogeneous._projection import (
    Grid,
    Point,
    ProjectionScratch,
    evaluate,
    inlined,
    make_scratch,
)


@inlined
def _describe_given(p: Point, w0: float, row: Any) -> None:
    """Overwrite the variances for a given extinction, whose variance is 0."""
    row.extinction_variance = 0.0
    row.background_slope_variance = 0.0
    row.background_variance = 1.0 / w0 + p.mean_phi * p.mean_phi / p.norm
    row.amplitude_relative_variance = 1.0 / row.signal_energy
    row.bounded = 0.0


@inlined
def _step(g: Grid, p: Point, tau: float, row: Any) -> None:
    """Write the linear step from a prior, with errors to first order in the two coefficients.

    About the centroid, the coefficients of shape and slope are independent.
    """
    slope = p.gradient / (p.b * p.slope_norm)
    step, lever = slope / p.b, 2.0 * (g.start / g.length + p.centroid)
    by_slope, by_shape = 1.0 / p.b, -step / p.b
    row.extinction_variance = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    by_slope, by_shape = lever * by_slope, 1.0 / p.b + lever * by_shape
    row.amplitude_relative_variance = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    row.background -= slope * p.mean_t
    row.extinction = tau + step
    row.amplitude = p.b * math.exp(2.0 * step * p.centroid)


@inlined
def _moved(p: Point, row: Any) -> Point:
    """Return the point with the background and amplitude of a row."""
    return Point(
        row.amplitude,
        row.background + row.amplitude * p.mean_phi,
        p.mean_phi,
        p.mean_t,
        p.centroid,
        p.norm,
        p.slope_norm,
        p.gradient,
        p.gauss,
        p.curvature,
        p.energy,
    )


@inlined
def _solve_from(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    extinction: Array,
    g: Grid,
    s: ProjectionScratch,
    out: Any,
    is_prior: bool,
) -> None:
    unit = 1.0
    for k in range(power.shape[0]):
        if k < noise.shape[0]:
            unit = weigh(noise[k], is_variance, s)
        row = out[k]
        reference, scale, sums = begin(power[k], (unit, rounding, math.nan), s, row)
        if row.status == FITTED:
            tau = g.length * extinction[k % extinction.size]
            p = evaluate(tau, g, s, sums)
            describe(g, s, p, tau, sums, row)
            if is_prior:
                _step(g, p, tau, row)
                tau = row.extinction
                row.bounded = tau <= g.nodes[0] or tau >= g.nodes[-1]
                p = _moved(evaluate(tau, g, s, sums), row)
            spacing = 0 if is_variance else g.noise_spacing[k % g.noise_spacing.size]
            judge_residuals(g, s, p, tau, sums, spacing, row)
            if not is_prior:
                _describe_given(p, sums.weight, row)
                describe_bend_given(p, row)
            unscale(g, reference, scale, unit, row)


@compiled
def solve_from(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    extinction: Array,
    g: Grid,
    out: Any,
    is_prior: bool,
) -> None:
    """Fit background and amplitude at extinctions, (profile or 1,), m-1: given ones, or priors.

    From a prior, one linear step leads to the extinction. The other parameters are those of
    `_direct.solve_direct`.
    """
    _solve_from(power, noise, is_variance, rounding, extinction, g, make_scratch(g), out, is_prior)
