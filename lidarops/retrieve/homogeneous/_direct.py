"""Compiled least squares of the homogeneous path, one profile at a time.

The objective of `lidarops.retrieve.homogeneous._projection`, a function of extinction alone, is
evaluated on fixed nodes. A fixed number of Newton steps, with explicit residuals, improves the
best node. Every sum runs over the bins of one profile in a fixed order: a result does not depend
on the rest of the batch.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._estimate import (
    AMPLITUDE,
    AMPLITUDE_RELATIVE_VARIANCE,
    BACKGROUND,
    BACKGROUND_BEND,
    BACKGROUND_VARIANCE,
    BINS,
    BOUNDED,
    CONSTANT,
    EMPTY,
    EXTINCTION,
    EXTINCTION_VARIANCE,
    FITTED,
    LARGEST,
    MEAN_RANGE,
    MISFIT,
    ROUNDING,
    SECOND_DIFFERENCES,
    SIGNAL_ENERGY,
    STATUS,
    TOO_SHORT,
    TREND,
)
from lidarops.retrieve.homogeneous._misfit import (
    describe_bend,
    describe_bend_given,
    judge_residuals,
)
from lidarops.retrieve.homogeneous._projection import (
    NODE_SCALE,
    NODES,
    Grid,
    Point,
    ProjectionScratch,
    compiled,
    evaluate,
    largest_of,
    make_scratch,
    power_of_two,
    product,
    scale_in_place,
    summing,
    total_of,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]

STEPS: Final = 7
"""Newton steps from a start that is off by some hundredths of the spacing of nodes."""
HUGE: Final = 1e300
TINY: Final = 1e-280
_FLAT: Final = 1e-13
"""Squared share of a shape besides its mean, below which it is flat within rounding."""
_LEAST_CURVATURE: Final = THRESHOLDS.least_curvature
_FEWEST_BINS: Final = THRESHOLDS.fewest_solved_bins

# Treatment of the extinction.
FREE: Final = 0
GIVEN: Final = 1
STEP: Final = 2
"""One linear step from a prior, expanded about the centroid of information."""


@compiled
def _weight(value: float, noise: float, is_variance: bool) -> float:
    """Return the weight of a bin, 0 where value or weight is not usable."""
    weight = 1.0 / noise if is_variance else noise
    return weight if abs(value) < HUGE and 0.0 < weight < HUGE else 0.0


@compiled
def _last_valid(power: Any, noise: Array, is_variance: bool) -> int:
    for i in range(noise.size - 1, -1, -1):
        if _weight(np.float64(power[i]), noise[i], is_variance) > 0.0:
            return i
    return -1


@compiled
def _load(
    power: Any, noise: Array, is_variance: bool, reference: float, s: ProjectionScratch
) -> int:
    """Copy one profile less its reference, 0 where not usable; return the number of valid bins."""
    count = 0
    for i in range(noise.size):
        value = np.float64(power[i])
        weight = _weight(value, noise[i], is_variance)
        count += weight > 0.0
        s.w[i] = weight
        s.used[i] = 1.0 if weight > 0.0 else 0.0
        s.z[i] = value - reference if weight > 0.0 else 0.0
    return count


@summing
def _project(shape: Array, w: Array, z: Array, w0: float, wz: float, free: float) -> float:
    """Return the signed length of the profile along a shape, background projected out."""
    s1 = s2 = sz = 0.0
    for i in range(shape.size):
        weighted = w[i] * shape[i]
        s1 += weighted
        s2 += weighted * shape[i]
        sz += weighted * z[i]
    norm = s2 - free * s1 * s1 / w0
    # A shape that is flat over the valid bins, or gone before the first, holds no information.
    if not (norm > _FLAT * s2 and s2 > TINY):
        return 0.0
    return float((sz - free * s1 * wz / w0) / math.sqrt(norm))


@compiled
def _start(
    g: Grid, s: ProjectionScratch, w0: float, wz: float, free: float
) -> tuple[float, float, float]:
    """Return tau at the peak of a parabola through the best node, and the nodes that bracket it."""
    shapes, nodes, w, z, lengths = g.shapes, g.nodes, s.w, s.z, s.lengths
    best = 0
    for j in range(NODES):
        lengths[j] = _project(shapes[j], w, z, w0, wz, free)
        if abs(lengths[j]) > abs(lengths[best]):
            best = j
    # At an end of the grid, the peak is extrapolated from the last three nodes.
    middle = min(max(best, 1), NODES - 2)
    sign = math.copysign(1.0, lengths[best])
    before, centre, after = (
        sign * lengths[middle - 1],
        sign * lengths[middle],
        sign * lengths[middle + 1],
    )
    low, high = nodes[max(best - 1, 0)], nodes[min(best + 1, NODES - 1)]
    start = nodes[best]
    bend = before - 2.0 * centre + after
    if bend < 0.0:
        peak = g.first + (middle + 0.5 * (before - after) / bend) * g.spacing
        start = min(max(NODE_SCALE * math.sinh(peak), low), high)
    return start, low, high


@compiled
def _newton(tau: float, point: Point, low: float, high: float) -> float:
    gauss = point.b * point.b * point.slope_norm
    step = point.gradient / (
        point.curvature if point.curvature > _LEAST_CURVATURE * gauss else gauss
    )
    moved = tau + step
    if not math.isfinite(moved):
        return tau
    return float(min(max(moved, low), high))


@compiled
def _describe(g: Grid, p: Point, tau: float, w0: float, free: float, row: Array) -> None:
    """Write parameters and variances of a least-squares fit, in the scaled variables."""
    row[BACKGROUND] = p.mean_z - p.b * p.mean_phi
    row[AMPLITUDE] = p.b
    row[EXTINCTION] = tau
    row[SIGNAL_ENERGY] = p.b * p.b * p.norm
    row[EXTINCTION_VARIANCE] = 1.0 / (p.b * p.b * p.slope_norm)
    row[BACKGROUND_VARIANCE] = (
        free / w0 + p.mean_phi * p.mean_phi / p.norm + p.mean_t * p.mean_t / p.slope_norm
    )
    # Extinction moves the logarithm of B by twice the range of the centroid.
    lever = 2.0 * (g.start / g.length + p.centroid)
    row[AMPLITUDE_RELATIVE_VARIANCE] = (
        1.0 / row[SIGNAL_ENERGY] + lever * lever * row[EXTINCTION_VARIANCE]
    )


@compiled
def _describe_given(p: Point, w0: float, free: float, row: Array) -> None:
    """Overwrite the variances for a given extinction, whose variance is 0."""
    row[EXTINCTION_VARIANCE] = 0.0
    row[BACKGROUND_VARIANCE] = free / w0 + p.mean_phi * p.mean_phi / p.norm
    row[AMPLITUDE_RELATIVE_VARIANCE] = 1.0 / row[SIGNAL_ENERGY]


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


@compiled
def _fit(g: Grid, s: ProjectionScratch, free: float, kind: int, tau: float, row: Array) -> None:
    """Fit one loaded profile and write its row, in the scaled variables."""
    w0, wz = total_of(s.w), product(s.w, s.z)
    if kind == FREE:
        tau, low, high = _start(g, s, w0, wz, free)
        for _ in range(STEPS):
            tau = _newton(tau, evaluate(tau, g, s, w0, wz, free), low, high)
    p = evaluate(tau, g, s, w0, wz, free)
    _describe(g, p, tau, w0, free, row)
    if kind == GIVEN:
        _describe_given(p, w0, free, row)
    elif kind != FREE:
        _step(g, p, tau, row)
        tau = row[EXTINCTION]
        p = _moved(evaluate(tau, g, s, w0, wz, free), row)
    describe_bend(g, s, p, w0, free, row)
    if kind == GIVEN:
        describe_bend_given(p, row)
    row[MEAN_RANGE] = product(s.w, g.x) / w0
    judge_residuals(g, s, p, tau, (w0, wz, free), row)
    if kind == GIVEN:
        row[BOUNDED] = 0.0


@compiled
def unscale(g: Any, reference: float, scale: float, unit: float, row: Array) -> None:
    """Convert a row from scaled variables to SI units; noise terms to units of the noise."""
    energy = scale * (scale * unit)
    sign = math.copysign(1.0, row[AMPLITUDE])
    logarithm = math.log(abs(row[AMPLITUDE])) + math.log(scale)
    logarithm += 2.0 * math.log(g.start) + 2.0 * row[EXTINCTION] * g.start / g.length
    row[BACKGROUND_BEND] *= scale * row[AMPLITUDE] * g.length
    row[BACKGROUND] = reference + scale * row[BACKGROUND]
    row[AMPLITUDE] = sign * math.exp(logarithm)
    row[EXTINCTION] /= g.length
    row[BACKGROUND_VARIANCE] /= unit
    row[AMPLITUDE_RELATIVE_VARIANCE] /= energy
    row[EXTINCTION_VARIANCE] /= energy * g.length * g.length
    row[SIGNAL_ENERGY] *= energy
    row[MISFIT] *= energy
    row[SECOND_DIFFERENCES] *= energy
    row[TREND] *= energy
    row[LARGEST] *= math.sqrt(energy)
    row[MEAN_RANGE] = g.start + g.length * row[MEAN_RANGE]


@compiled
def _solve_profile(
    power: Any,
    noise: Array,
    mode: tuple[bool, float, float, int, float],
    g: Grid,
    s: ProjectionScratch,
    row: Array,
) -> None:
    is_variance, background, rounding, kind, extinction = mode
    last = _last_valid(power, noise, is_variance)
    fixed = not math.isnan(background)
    reference = background if fixed else np.float64(power[last])
    row[BINS] = 0 if last < 0 else _load(power, noise, is_variance, reference, s)
    if row[BINS] < _FEWEST_BINS:
        row[STATUS] = EMPTY if last < 0 else TOO_SHORT
        return
    unit, largest = power_of_two(largest_of(s.w)), largest_of(s.z)
    scale_in_place(s.w, 1.0 / unit)
    row[ROUNDING] = (rounding * (abs(reference) + largest)) ** 2 * unit * total_of(s.w) / row[BINS]
    if largest < TINY:
        row[STATUS] = CONSTANT
        row[BACKGROUND] = reference
        row[BACKGROUND_VARIANCE] = 1.0 / (total_of(s.w) * unit)
        return
    scale = power_of_two(largest)
    scale_in_place(s.z, 1.0 / scale)
    row[STATUS] = FITTED
    _fit(g, s, 0.0 if fixed else 1.0, kind, extinction * g.length, row)
    unscale(g, reference, scale, unit, row)


@compiled
def solve_direct(
    power: Any,
    noise: Array,
    is_variance: bool,
    background: Array,
    kind: int,
    extinction: Array,
    rounding: float,
    g: Grid,
    out: Array,
) -> None:
    """Fit every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : (profile or 1, bin) float64
        Variances or weights; a bin is left out where its weight is not positive and finite.
    is_variance : bool
    background : (profile or 1,) float64
        Given backgrounds; NaN where the background is fitted.
    kind : int
        `FREE`, `GIVEN` or `STEP`.
    extinction : (profile or 1,) float64
        m-1; not used where it is free.
    rounding : float
        Relative rounding error of the power.
    g : Grid
        Of `make_grid`.
    out : (profile, column) float64
        Filled with NaN; receives the columns of `lidarops.retrieve.homogeneous._estimate`.
    """
    s = make_scratch(g.x.size)
    for k in range(power.shape[0]):
        prior = extinction[k % extinction.size]
        mode = (is_variance, background[k % background.size], rounding, kind, prior)
        _solve_profile(power[k], noise[k % noise.shape[0]], mode, g, s, out[k])
