"""Compiled least squares of the homogeneous path, one profile at a time.

The objective of `lidarops.retrieve.homogeneous._projection`, a function of extinction alone, is
evaluated at fixed nodes, mostly on sums over groups of bins. Newton steps over all bins improve the
best node until they are negligible. Every sum runs over the bins of one profile in a fixed order: a
result does not depend on the rest of the batch. From a given extinction there is no search.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.homogeneous._misfit import describe_bend_given, judge_residuals
from lidarops.retrieve.homogeneous._problem import CONSTANT, EMPTY, FITTED, TOO_SHORT
from lidarops.retrieve.homogeneous._projection import (
    BLOCK,
    GROUPED,
    NODES,
    Grid,
    Point,
    ProjectionScratch,
    Sums,
    evaluate,
    fusing,
    inlined,
    largest_of,
    make_scratch,
    power_of_two,
    product,
    scale_in_place,
    summing,
    total_of,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_MOST_STEPS: Final = 12
"""Newton steps; most profiles need two."""
_SMALL: Final = 1e-7
"""Step over extinction after which the search ends."""
_NEGLIGIBLE: Final = 1e-5
"""Standard errors of the extinction that a step may leave. Of 7000 simulated profiles of 7 paths,
the last step left at most 1.4e-5."""
_DETERMINED: Final = 0.3
"""Standard error of the extinction over its scale, above which only a step of `_SMALL` is the last:
twice the limit of `POORLY_DETERMINED`."""
BACKGROUND, EXTINCTION, PRIOR = 0, 1, 2
"""What is given to a fit."""
TINY: Final = 1e-280
_FLAT: Final = 1e-13
"""Squared share of a shape besides its mean, below which it is flat within rounding."""


@inlined
def weigh(noise: Array, is_variance: bool, s: ProjectionScratch) -> float:
    """Fill the weights of a row of noise, and return their unit, a power of two."""
    for i in range(noise.size):
        weight = 1.0 / noise[i] if is_variance else noise[i]
        s.given[i] = weight if (weight > 0.0) & (weight < HUGE) else 0.0
    unit: float = power_of_two(largest_of(s.given))
    scale_in_place(s.given, 1.0 / unit)
    return unit


@inlined
def _last_valid(power: Any, s: ProjectionScratch) -> int:
    for i in range(power.size - 1, -1, -1):
        if abs(np.float64(power[i])) < HUGE and s.given[i] > 0.0:
            return i
    return -1


@summing
def _load(power: Any, reference: float, s: ProjectionScratch) -> tuple[float, float]:
    """Copy a profile less its reference, 0 where not usable; return valid bins and weight."""
    count = total = 0.0
    for i in range(power.size):
        value = np.float64(power[i])
        usable = (abs(value) < HUGE) & (s.given[i] > 0.0)
        s.w[i] = s.given[i] if usable else 0.0
        s.z[i] = value - reference if usable else 0.0
        s.used[i] = 1.0 if usable else 0.0
        count += s.used[i]
        total += s.w[i]
    return count, total


@summing
def _scale(s: ProjectionScratch, factor: float) -> tuple[float, float]:
    """Scale a profile, and return the weighted sums of its values and of their squares."""
    total = squares = 0.0
    for i in range(s.z.size):
        s.z[i] *= factor
        s.wz[i] = s.w[i] * s.z[i]
        total += s.wz[i]
        squares += s.wz[i] * s.z[i]
    return total, squares


@inlined
def _fold(values: Array, out: Array) -> None:
    """Fill the sums over the groups of bins, of which the first `BLOCK` are single bins."""
    for i in range(BLOCK):
        out[i] = values[i]
    for k in range(BLOCK, out.size):
        i = GROUPED * k - (GROUPED - 1) * BLOCK
        out[k] = values[i] + values[i + 1] + values[i + 2] + values[i + 3]


@fusing
def _multiply(values: Array, shapes: Array, out: Array) -> None:
    """Fill the products of values with the shapes of all nodes."""
    for j in range(NODES):
        out[j] = 0.0
    for i in range(values.size):
        value = values[i]
        for j in range(NODES):
            out[j] += value * shapes[i, j]


@inlined
def _multiply_all(rows: Array, shapes: Array, out: Array) -> None:
    """Fill the products of weights and values with the shapes of all nodes, and their squares."""
    _multiply(rows[0], shapes[0], out[0])
    _multiply(rows[1], shapes[0], out[1])
    _multiply(rows[0], shapes[1], out[2])


@inlined
def _take_lengths(s: ProjectionScratch, sums: Sums) -> None:
    """Overwrite the first products by the signed lengths of the profile along the shapes.

    The background is projected out.
    """
    lengths, values, squares = s.products[0], s.products[1], s.products[2]
    for j in range(NODES):
        mean = sums.free * lengths[j] / sums.weight
        norm = squares[j] - lengths[j] * mean
        # A shape that is flat over the valid bins, or gone before the first, holds no information.
        informed = (norm > _FLAT * squares[j]) & (squares[j] > TINY)
        along = values[j] - mean * sums.value
        lengths[j] = along / math.sqrt(norm if informed else 1.0) if informed else 0.0


@inlined
def _peak(f: Array, middle: int) -> float:
    """Return the offset of the extremum of a quartic through five values from the middle one.

    By one Newton step from that of the parabola through the inner three.
    """
    a, b, c, d, e = f[middle - 2], f[middle - 1], f[middle], f[middle + 1], f[middle + 2]
    offset = 0.5 * (b - d) / (b - 2.0 * c + d)
    first, second = (a - e + 8.0 * (d - b)) / 12.0, (16.0 * (b + d) - 30.0 * c - a - e) / 12.0
    third, fourth = 0.5 * (e - a) + b - d, a + e - 4.0 * (b + d) + 6.0 * c
    slope = first + offset * (second + offset * (0.5 * third + offset * fourth / 6.0))
    return float(offset - slope / (second + offset * (third + 0.5 * offset * fourth)))


@inlined
def _start(g: Grid, s: ProjectionScratch, sums: Sums) -> float:
    """Return tau at the largest of the projections on the nodes, interpolated."""
    # Opaque shapes differ in their first bins only, which groups cannot resolve.
    if s.groups.shape[1] < s.w.size and total_of(s.w[:BLOCK]) > 0.0:
        _fold(s.w, s.groups[0])
        _fold(s.wz, s.groups[1])
        _multiply_all(s.groups, g.group_shapes, s.products)
    else:
        _multiply_all(s.rows, g.shapes, s.products)
    _take_lengths(s, sums)
    lengths, best, largest = s.products[0], 0, 0.0
    for j in range(NODES):
        if abs(lengths[j]) > largest:
            best, largest = j, abs(lengths[j])
    # At an end of the grid, the peak is extrapolated from the last nodes.
    middle = min(max(best, 2), NODES - 3)
    offset = _peak(lengths, middle)
    if not abs(middle + offset - best) <= 1.0:
        return float(g.nodes[best])
    before, centre, after = g.nodes[middle - 1], g.nodes[middle], g.nodes[middle + 1]
    tau = centre + 0.5 * offset * (after - before + offset * (before + after - 2.0 * centre))
    return float(min(max(tau, g.nodes[0]), g.nodes[-1]))


@inlined
def _newton(tau: float, point: Point, g: Grid) -> float:
    """Return tau after one Newton step, of at most the distance to the next node."""
    curved = point.curvature > THRESHOLDS.least_curvature * point.gauss
    step = point.gradient / (point.curvature if curved else point.gauss)
    reach = g.spacing * math.sqrt(tau * tau + g.scale * g.scale)
    moved = tau + min(max(step, -reach), reach)
    return float(min(max(moved, g.nodes[0]), g.nodes[-1])) if math.isfinite(step) else tau


@inlined
def _is_last(step: float, tau: float, p: Point, g: Grid, sums: Sums) -> bool:
    """Return whether what a step leaves is negligible: about its square, by a Newton step.

    A small step says little where the noise is large, or where it is one of Gauss-Newton.
    """
    size = abs(tau) + g.scale
    if abs(step) <= _SMALL * size:
        return True
    variance = p.energy / ((sums.bins - 3.0) * p.gauss)
    if not (
        p.curvature > THRESHOLDS.least_curvature * p.gauss and variance < (_DETERMINED * size) ** 2
    ):
        return False
    return (step * step / size) ** 2 <= _NEGLIGIBLE * _NEGLIGIBLE * variance


@inlined
def find_extinction(g: Grid, s: ProjectionScratch, sums: Sums) -> tuple[float, Point]:
    """Return the best extinction of a loaded profile, and the linear fit there."""
    following, settled = _start(g, s, sums), False
    for _ in range(_MOST_STEPS):
        tau = following
        p = evaluate(tau, g, s, sums)
        if settled:
            break
        following = _newton(tau, p, g)
        settled = _is_last(following - tau, tau, p, g, sums)
    return tau, p


@inlined
def describe(
    g: Grid,
    s: ProjectionScratch,
    p: Point,
    tau: float,
    sums: Sums,
    row: Any,
) -> None:
    """Write parameters and variances of a least-squares fit, in the scaled variables."""
    w0, free = sums.weight, sums.free
    row.background = p.mean_z - p.b * p.mean_phi
    row.amplitude = p.b
    row.extinction = tau
    row.signal_energy = p.b * p.b * p.norm
    row.extinction_variance = 1.0 / (p.b * p.b * p.slope_norm)
    row.background_slope_variance = p.mean_t * p.mean_t / p.slope_norm
    row.background_variance = (
        free / w0 + p.mean_phi * p.mean_phi / p.norm + row.background_slope_variance
    )
    # Extinction moves the logarithm of B by twice the range of the centroid.
    lever = 2.0 * (g.start / g.length + p.centroid)
    row.amplitude_relative_variance = (
        1.0 / row.signal_energy + lever * lever * row.extinction_variance
    )
    row.mean_range = product(s.w, g.x) / w0
    row.bounded = tau <= g.nodes[0] or tau >= g.nodes[-1]


@inlined
def _polish(p: Point, w0: float, left: tuple[float, float, float], row: Any) -> None:
    """Take the step that the residuals leave, which in thin sections moments are too coarse for."""
    level, shape, slope = left[0] / w0, left[1] / p.norm, left[2] / p.slope_norm
    row.background += level - shape * p.mean_phi - slope * p.mean_t
    row.amplitude += shape + 2.0 * p.centroid * slope
    row.extinction += slope / p.b
    row.misfit -= left[0] * level + left[1] * shape + left[2] * slope


@inlined
def unscale(g: Any, reference: float, scale: float, unit: float, row: Any) -> None:
    """Convert a row from scaled variables to SI units; noise terms to units of the noise."""
    energy = scale * (scale * unit)
    sign = math.copysign(1.0, row.amplitude)
    logarithm = math.log(abs(row.amplitude)) + math.log(scale)
    logarithm += 2.0 * math.log(g.start) + 2.0 * row.extinction * g.start / g.length
    row.background_bend *= scale * row.amplitude * g.length
    row.background = reference + scale * row.background
    row.amplitude = sign * math.exp(logarithm)
    row.extinction /= g.length
    row.background_variance /= unit
    row.background_slope_variance /= unit
    row.amplitude_relative_variance /= energy
    row.extinction_variance /= energy * g.length * g.length
    row.signal_energy *= energy
    row.misfit *= energy
    row.second_differences *= energy
    row.trend *= energy
    row.largest *= math.sqrt(energy)
    row.mean_range = g.start + g.length * row.mean_range


@inlined
def begin(
    power: Any, mode: tuple[float, float, float], s: ProjectionScratch, row: Any
) -> tuple[float, float, Sums]:
    """Load a profile and write its status; return its reference, scale and sums.

    Parameters
    ----------
    power : (bin,) float
    mode : (float, float, float)
        The unit of the weights that `weigh` filled; the relative rounding error of the power; the
        given background, or NaN.
    s : ProjectionScratch
    row : `ROW`
    """
    unit, rounding, background = mode
    last = _last_valid(power, s)
    reference = np.float64(power[last]) if math.isnan(background) else background
    bins, total = _load(power, reference, s)
    free = 1.0 if math.isnan(background) else 0.0
    row.bins = bins
    if bins < THRESHOLDS.fewest_solved_bins:
        row.status = EMPTY if last < 0 else TOO_SHORT
        return reference, 1.0, Sums(bins, total, 0.0, 0.0, free)
    largest = largest_of(s.z)
    row.rounding = (rounding * (abs(reference) + largest)) ** 2 * unit * total / bins
    if largest < TINY:
        row.status = CONSTANT
        row.background = reference
        row.background_variance = 1.0 / (total * unit)
        return reference, 1.0, Sums(bins, total, 0.0, 0.0, free)
    row.status = FITTED
    scale = power_of_two(largest)
    value, square = _scale(s, 1.0 / scale)
    return reference, scale, Sums(bins, total, value, square, free)


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
def _solve(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    given: Array,
    kind: int,
    g: Grid,
    s: ProjectionScratch,
    out: Any,
) -> None:
    unit = 1.0
    for k in range(power.shape[0]):
        # A row of noise for each profile, or one for all.
        if k < noise.shape[0]:
            unit = weigh(noise[k], is_variance, s)
        row, value = out[k], given[k % given.size]
        mode = (unit, rounding, value if kind == BACKGROUND else math.nan)
        reference, scale, sums = begin(power[k], mode, s, row)
        if row.status == FITTED:
            if kind == BACKGROUND:
                tau, p = find_extinction(g, s, sums)
            else:
                tau = g.length * value
                p = evaluate(tau, g, s, sums)
            describe(g, s, p, tau, sums, row)
            if kind == PRIOR:
                _step(g, p, tau, row)
                tau = row.extinction
                row.bounded = tau <= g.nodes[0] or tau >= g.nodes[-1]
                p = _moved(evaluate(tau, g, s, sums), row)
            spacing = 0 if is_variance else g.noise_spacing[k % g.noise_spacing.size]
            left = judge_residuals(g, s, p, tau, sums, spacing, row)
            if kind == EXTINCTION:
                _describe_given(p, sums.weight, row)
                describe_bend_given(p, row)
            elif kind == BACKGROUND and sums.free > 0.0 and row.bounded == 0.0:
                _polish(p, sums.weight, left, row)
            unscale(g, reference, scale, unit, row)


@compiled
def solve_path(
    power: Any,
    noise: Array,
    is_variance: bool,
    rounding: float,
    given: Array,
    kind: int,
    g: Grid,
    out: Any,
) -> None:
    """Fit every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : (profile or 1, bin) float64
        Variances or weights; a bin is left out where its weight is not positive and finite.
    is_variance : bool
    rounding : float
        Relative rounding error of the power.
    given : (profile or 1,) float64
        Backgrounds, NaN where they are to be fitted; or extinctions, m-1.
    kind : int
        What is given: `BACKGROUND`, `EXTINCTION`, or `PRIOR`, an extinction from which one linear
        step leads to that of the profile.
    g : Grid
        Of `make_grid`.
    out : (profile,) `ROW`
        Filled with NaN; receives the fields of `PathEstimate`.
    """
    _solve(power, noise, is_variance, rounding, given, kind, g, make_scratch(g), out)
