"""Compiled least squares of the homogeneous path, one profile at a time.

For profiles with gaps, weights of their own and any spacing of the bins. The objective of
`lidarops.retrieve.homogeneous._projection`, a function of extinction alone, is evaluated at fixed
nodes, mostly on sums over groups of bins. Newton steps over all bins, with explicit residuals,
improve the best node until they are negligible. Every sum runs over the bins of one profile in a
fixed order: a result does not depend on the rest of the batch.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._estimate import (
    AMPLITUDE,
    AMPLITUDE_RELATIVE_VARIANCE,
    BACKGROUND,
    BACKGROUND_BEND,
    BACKGROUND_SLOPE_VARIANCE,
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
from lidarops.retrieve.homogeneous._misfit import judge_residuals
from lidarops.retrieve.homogeneous._projection import (
    BLOCK,
    GROUPED,
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

_MOST_STEPS: Final = 12
"""Newton steps; most profiles need three or four."""
_SMALL: Final = 1e-7
"""Step over extinction after which the search ends: each step squares the error."""
HUGE: Final = 1e300
TINY: Final = 1e-280
_FLAT: Final = 1e-13
"""Squared share of a shape besides its mean, below which it is flat within rounding."""
_LEAST_CURVATURE: Final = THRESHOLDS.least_curvature
_FEWEST_BINS: Final = THRESHOLDS.fewest_solved_bins


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


@compiled
def _fold(values: Array, out: Array) -> None:
    """Fill the sums over the groups of bins, of which the first `BLOCK` are single bins."""
    for i in range(BLOCK):
        out[i] = values[i]
    for k in range(BLOCK, out.size):
        i = GROUPED * k - (GROUPED - 1) * BLOCK
        out[k] = values[i] + values[i + 1] + values[i + 2] + values[i + 3]


@summing
def _project(shape: Array, w: Array, wz: Array, sums: tuple[float, float, float]) -> float:
    """Return the signed length of the profile along a shape, background projected out."""
    total_weight, total_value, free = sums
    s1 = s2 = sz = 0.0
    for i in range(shape.size):
        weighted = w[i] * shape[i]
        s1 += weighted
        s2 += weighted * shape[i]
        sz += wz[i] * shape[i]
    norm = s2 - free * s1 * s1 / total_weight
    # A shape that is flat over the valid bins, or gone before the first, holds no information.
    if not (norm > _FLAT * s2 and s2 > TINY):
        return 0.0
    return float((sz - free * s1 * total_value / total_weight) / math.sqrt(norm))


@compiled
def _start(g: Grid, s: ProjectionScratch, sums: tuple[float, float, float]) -> float:
    """Return tau at the peak of a parabola through the best node."""
    shapes, lengths, weights, values = g.shapes, s.lengths, s.w, s.residual
    for i in range(values.size):
        values[i] = s.w[i] * s.z[i]
    # Opaque shapes differ in their first bins only, which groups cannot resolve.
    if s.values.size < values.size and total_of(s.w[:BLOCK]) > 0.0:
        _fold(s.w, s.weights)
        _fold(values, s.values)
        shapes, weights, values = g.group_shapes, s.weights, s.values
    best = 0
    for j in range(NODES):
        lengths[j] = _project(shapes[j], weights, values, sums)
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
    bend = before - 2.0 * centre + after
    if not bend < 0.0:
        return float(g.nodes[best])
    peak = g.scale * math.sinh(g.first + (middle + 0.5 * (before - after) / bend) * g.spacing)
    return float(min(max(peak, g.nodes[max(best - 1, 0)]), g.nodes[min(best + 1, NODES - 1)]))


@compiled
def _newton(tau: float, point: Point, g: Grid) -> float:
    """Return tau after one Newton step, of at most the distance to the next node."""
    gauss = point.b * point.b * point.slope_norm
    step = point.gradient / (
        point.curvature if point.curvature > _LEAST_CURVATURE * gauss else gauss
    )
    reach = g.spacing * math.sqrt(tau * tau + g.scale * g.scale)
    moved = tau + min(max(step, -reach), reach)
    return float(min(max(moved, g.nodes[0]), g.nodes[-1])) if math.isfinite(step) else tau


@compiled
def find_extinction(
    g: Grid, s: ProjectionScratch, sums: tuple[float, float, float]
) -> tuple[float, Point]:
    """Return the best extinction of a loaded profile, and the linear fit there."""
    following, settled = _start(g, s, sums), False
    for _ in range(_MOST_STEPS):
        tau = following
        p = evaluate(tau, g, s, sums)
        if settled:
            break
        following = _newton(tau, p, g)
        settled = abs(following - tau) <= _SMALL * (abs(tau) + g.scale)
    return tau, p


@compiled
def describe(
    g: Grid,
    s: ProjectionScratch,
    p: Point,
    tau: float,
    sums: tuple[float, float, float],
    row: Array,
) -> None:
    """Write parameters and variances of a least-squares fit, in the scaled variables."""
    w0, _, free = sums
    row[BACKGROUND] = p.mean_z - p.b * p.mean_phi
    row[AMPLITUDE] = p.b
    row[EXTINCTION] = tau
    row[SIGNAL_ENERGY] = p.b * p.b * p.norm
    row[EXTINCTION_VARIANCE] = 1.0 / (p.b * p.b * p.slope_norm)
    row[BACKGROUND_SLOPE_VARIANCE] = p.mean_t * p.mean_t / p.slope_norm
    row[BACKGROUND_VARIANCE] = (
        free / w0 + p.mean_phi * p.mean_phi / p.norm + row[BACKGROUND_SLOPE_VARIANCE]
    )
    # Extinction moves the logarithm of B by twice the range of the centroid.
    lever = 2.0 * (g.start / g.length + p.centroid)
    row[AMPLITUDE_RELATIVE_VARIANCE] = (
        1.0 / row[SIGNAL_ENERGY] + lever * lever * row[EXTINCTION_VARIANCE]
    )
    row[MEAN_RANGE] = product(s.w, g.x) / w0
    row[BOUNDED] = tau <= g.nodes[0] or tau >= g.nodes[-1]


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
    row[BACKGROUND_SLOPE_VARIANCE] /= unit
    row[AMPLITUDE_RELATIVE_VARIANCE] /= energy
    row[EXTINCTION_VARIANCE] /= energy * g.length * g.length
    row[SIGNAL_ENERGY] *= energy
    row[MISFIT] *= energy
    row[SECOND_DIFFERENCES] *= energy
    row[TREND] *= energy
    row[LARGEST] *= math.sqrt(energy)
    row[MEAN_RANGE] = g.start + g.length * row[MEAN_RANGE]


@compiled
def begin(
    power: Any,
    noise: Array,
    mode: tuple[bool, float, float],
    s: ProjectionScratch,
    row: Array,
) -> tuple[float, float, float]:
    """Load a profile and write its status; return its reference, scale and unit of the weights.

    Parameters
    ----------
    power, noise : (bin,) float
    mode : (bool, float, float)
        Whether the noise is a variance; the relative rounding error of the power; the given
        background, or NaN.
    s : ProjectionScratch
    row : (column,) float64
    """
    is_variance, rounding, background = mode
    last = _last_valid(power, noise, is_variance)
    reference = np.float64(power[last]) if math.isnan(background) else background
    row[BINS] = 0 if last < 0 else _load(power, noise, is_variance, reference, s)
    if row[BINS] < _FEWEST_BINS:
        row[STATUS] = EMPTY if last < 0 else TOO_SHORT
        return reference, 1.0, 1.0
    unit, largest = power_of_two(largest_of(s.w)), largest_of(s.z)
    scale_in_place(s.w, 1.0 / unit)
    row[ROUNDING] = (rounding * (abs(reference) + largest)) ** 2 * unit * total_of(s.w) / row[BINS]
    if largest < TINY:
        row[STATUS] = CONSTANT
        row[BACKGROUND] = reference
        row[BACKGROUND_VARIANCE] = 1.0 / (total_of(s.w) * unit)
        return reference, 1.0, unit
    row[STATUS] = FITTED
    scale = power_of_two(largest)
    scale_in_place(s.z, 1.0 / scale)
    return reference, scale, unit


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_direct(
    power: Any, noise: Array, is_variance: bool, rounding: float, g: Grid, out: Array
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
    g : Grid
        Of `make_grid`.
    out : (profile, column) float64
        Filled with NaN; receives the columns of `lidarops.retrieve.homogeneous._estimate`.
    """
    s = make_scratch(g.x.size, g.group_shapes.shape[1])
    for k in range(power.shape[0]):
        row = out[k]
        mode = (is_variance, rounding, math.nan)
        reference, scale, unit = begin(power[k], noise[k % noise.shape[0]], mode, s, row)
        if row[STATUS] == FITTED:
            sums = (total_of(s.w), product(s.w, s.z), 1.0)
            tau, p = find_extinction(g, s, sums)
            describe(g, s, p, tau, sums, row)
            spacing = 0 if is_variance else g.noise_spacing[k % g.noise_spacing.size]
            judge_residuals(g, s, p, tau, sums, spacing, row)
            unscale(g, reference, scale, unit, row)
