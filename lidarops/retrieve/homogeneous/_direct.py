"""Compiled least squares of the homogeneous path, one profile at a time.

The objective of `lidarops.retrieve.homogeneous._projection`, a function of extinction alone, is
compared at fixed nodes, on sums over runs of bins. From the best one, two passes over all bins give
a Newton step each; the second sums the residuals about what the first predicts, for errors, tests
and the last step. A test of this step gives a few profiles more. Every sum runs over the bins of
one profile in a fixed order: a result does not depend on the rest of the batch. From a given
extinction there is no search.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Integers
from lidarops.retrieve.common.compiled_code import compiled, inlined, summing
from lidarops.retrieve.homogeneous._fit_quality import judge_residuals
from lidarops.retrieve.homogeneous._problem import CONSTANT, EMPTY, FITTED, TOO_SHORT, UNKNOWNS
from lidarops.retrieve.homogeneous._projection import (
    BLOCK,
    NODES,
    Grid,
    Point,
    Scratch,
    Sums,
    evaluate,
    fill_shape,
    fit_linear,
    largest_energy,
    load,
    make_scratch,
    power_of_two,
    sum_points,
    sum_shape,
    weigh,
    weigh_squares,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_MOST_STEPS: Final = 12
"""Newton steps; most profiles need two."""
_SMALL: Final = 1e-7
"""Step over extinction after which the search ends."""
_NEGLIGIBLE: Final = 1e-4
"""Standard errors of the extinction that the last step may leave, and step over extinction by which
stated errors, which are those before it, may be off."""
_SEEN: Final = 0.1
"""Energy of the last step over the variance of a bin: tests see residuals before it."""
_ROUNDING: Final = float(np.finfo(np.float64).eps)
"""Rounding of a sum of squares, over the sum."""
_DETERMINED: Final = 0.3
"""Standard error of the extinction over its scale, above which only a step of `_SMALL` is the last:
twice the limit of `POORLY_DETERMINED`."""
BACKGROUND, EXTINCTION, PRIOR = 0, 1, 2
"""What is given to a fit."""
TINY: Final = 1e-280
_SCALED: Final = 1e60
"""Mean absolute value above which, or below whose inverse, profiles are scaled."""
_FLAT: Final = 1e-13
"""Squared share of a shape besides its mean, below which it is flat within rounding."""


@summing
def _products(weights: Array, values: Array, shape: Array, square: Array) -> Any:
    of_shape = of_value = of_square = 0.0
    for k in range(weights.size):
        of_shape += weights[k] * shape[k]
        of_value += values[k] * shape[k]
        of_square += weights[k] * square[k]
    return of_shape, of_value, of_square


@inlined
def _explained(weights: Array, values: Array, shapes: Array, j: int, sums: Sums) -> float:
    """Return the energy that the shape of a node explains, with the background projected out."""
    shape, value, square = _products(weights, values, shapes[0, j], shapes[1, j])
    mean = shape * (sums.free / sums.weight)
    norm = square - shape * mean
    along = value - mean * sums.value
    # A shape that is flat over the valid bins, or gone before the first, holds no information.
    informed = (norm > _FLAT * square) & (square > TINY)
    return along * along / norm if informed else 0.0


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
def _best_node(
    weights: Array, values: Array, shapes: Array, sums: Sums, explained: Array
) -> tuple[int, int]:
    """Return the node that explains most, of every third and the two at each side of the best.

    The second number is the middle of five nodes about it whose energies are known.

    Fills the energies that these nodes explain.
    """
    third, most = 1, -1.0
    for j in range(1, NODES, 3):
        explained[j] = _explained(weights, values, shapes, j, sums)
        if explained[j] > most:
            third, most = j, explained[j]
    best = third
    for j in range(max(third - 2, 0), min(third + 3, NODES)):
        if j != third:
            explained[j] = _explained(weights, values, shapes, j, sums)
        if explained[j] > most:
            best, most = j, explained[j]
    middle = min(max(best, third - 1), third + 1)
    return best, min(max(middle, 2), NODES - 3)


@inlined
def _start(g: Grid, s: Scratch, sums: Sums) -> float:
    """Return tau where the shape explains most of the profile.

    Among the nodes, and interpolated between the best one and its neighbours.
    """
    explained = s.explained
    # Opaque shapes differ in their first valid bins only, which runs of bins would not resolve.
    if s.w[:BLOCK].any():
        best, middle = _best_node(s.points[0], s.points[1], g.point_shapes, sums, explained)
    else:
        for i in range(s.w.size):
            s.residual[i] = s.w[i] * s.z[i]
        best, middle = _best_node(s.w, s.residual, g.shapes, sums, explained)
    offset = middle - best + _peak(explained, middle)
    if not abs(offset) <= 1.0:
        return float(g.nodes[best])
    tau = g.scale * math.sinh(g.first + (best + offset) * g.spacing)
    return float(min(max(tau, g.nodes[0]), g.nodes[-1]))


@inlined
def _is_curved(p: Point) -> bool:
    return p.curvature > THRESHOLDS.least_curvature * p.gauss


@inlined
def _newton(p: Point, g: Grid) -> float:
    """Return tau after one Newton step, of at most the distance to the next node."""
    step = p.gradient / (p.curvature if _is_curved(p) else p.gauss)
    reach = g.spacing * math.sqrt(p.tau * p.tau + g.scale * g.scale)
    moved = p.tau + min(max(step, -reach), reach)
    return float(min(max(moved, g.nodes[0]), g.nodes[-1])) if math.isfinite(step) else p.tau


@inlined
def _is_last(step: float, p: Point, g: Grid, sums: Sums) -> bool:
    """Return whether what a Newton step leaves is negligible.

    It leaves about its square. A small step says little where the noise is large, or where the
    curvature is that of Gauss-Newton.
    """
    size, energy = abs(p.tau) + g.scale, max(p.residuals.energy, _ROUNDING * sums.square)
    noise = energy / (sums.bins - 3.0)
    if abs(step) > _NEGLIGIBLE * size or not p.explained <= _SEEN * noise:
        return False
    if abs(step) <= _SMALL * size:
        return True
    variance, left = noise / p.gauss, step * step / size
    determined = _is_curved(p) and variance < (_DETERMINED * size) ** 2
    return determined and left * left <= _NEGLIGIBLE * _NEGLIGIBLE * variance


@inlined
def find_extinction(g: Grid, s: Scratch, sums: Sums) -> tuple[Point, float]:
    """Return the linear fit of a loaded profile and tau, to which one Newton step leads from it."""
    tau = _start(g, s, sums)
    fill_shape(tau, g, s.phi)
    shapes, values = sum_shape(g, s, sums)
    p: Point = fit_linear(tau, 0.0, 0.0, shapes, values, sums)
    tau = _newton(p, g)
    for _ in range(_MOST_STEPS):
        step = tau - p.tau
        level = p.level - sums.free * p.b * step * p.mean_slope
        p = evaluate(tau, level, p.b * math.exp(2.0 * step * p.centroid), g, s, sums)
        tau = _newton(p, g)
        if _is_last(tau - p.tau, p, g, sums):
            break
    return p, tau


@inlined
def _describe(g: Grid, p: Point, sums: Sums, row: Any) -> None:
    """Write parameters and variances of a least-squares fit, in the scaled variables."""
    free, weight = sums.free, sums.weight
    row.background = p.level
    row.amplitude = p.b
    row.extinction = p.tau
    row.signal_energy = p.b * p.b * p.norm
    row.extinction_variance = 1.0 / p.gauss
    row.background_slope_variance = free * p.mean_slope * p.mean_slope / p.slope_norm
    row.background_variance = row.background_slope_variance + free * (
        1.0 / weight + p.mean_phi * p.mean_phi / p.norm
    )
    # Extinction moves the logarithm of B by twice the range of the centroid.
    lever = 2.0 * (g.start / g.length + p.centroid)
    row.amplitude_relative_variance = (
        1.0 / row.signal_energy + lever * lever * row.extinction_variance
    )
    row.extinction_slope = -weight * p.mean_slope / (p.b * p.slope_norm)
    row.amplitude_slope = lever * row.extinction_slope - weight * p.mean_phi / (p.b * p.norm)
    row.mean_range = sums.place / weight
    row.bounded = p.tau <= g.nodes[0] or p.tau >= g.nodes[-1]


@inlined
def _describe_given(p: Point, weight: float, row: Any) -> None:
    """Overwrite what a given extinction changes, whose variance is 0."""
    row.extinction_variance = 0.0
    row.background_slope_variance = 0.0
    row.background_variance = 1.0 / weight + p.mean_phi * p.mean_phi / p.norm
    row.amplitude_relative_variance = 1.0 / row.signal_energy
    row.bounded = 0.0
    # It absorbs neither bend nor slope, as large as that of the bend at either end.
    bent = row.background_bend + row.extinction_bend * p.mean_slope
    row.background_bend = math.hypot(bent, 0.5 * p.mean_slope)
    row.extinction_bend = 0.0


@inlined
def _take_step(g: Grid, p: Point, row: Any) -> float:
    """Write the linear step from a prior, with errors to first order in the two coefficients.

    About the centroid, the coefficients of shape and slope are independent. Returns tau.
    """
    slope = p.gradient / (p.b * p.slope_norm)
    step, lever = slope / p.b, 2.0 * (g.start / g.length + p.centroid)
    by_slope, by_shape = 1.0 / p.b, -step / p.b
    row.extinction_variance = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    by_slope, by_shape = lever * by_slope, 1.0 / p.b + lever * by_shape
    row.amplitude_relative_variance = by_slope**2 / p.slope_norm + by_shape**2 / p.norm
    row.background -= slope * p.mean_slope
    row.extinction = p.tau + step
    row.amplitude = p.b * math.exp(2.0 * step * p.centroid)
    row.bounded = row.extinction <= g.nodes[0] or row.extinction >= g.nodes[-1]
    return float(row.extinction)


@inlined
def _polish(p: Point, tau: float, free: float, row: Any) -> None:
    """Take the last step."""
    step = tau - p.tau
    row.background -= free * p.b * step * p.mean_slope
    row.amplitude += 2.0 * p.centroid * p.b * step
    row.extinction = tau
    row.misfit -= step * (2.0 * p.gradient - p.curvature * step)


@inlined
def _note_shift(g: Grid, p: Point, level: float, b: float, row: Any) -> None:
    """Write by how much another linear step would change the parameters."""
    row.extinction_shift = p.gradient / p.gauss
    row.background_shift = p.level - level - p.b * row.extinction_shift * p.mean_slope
    lever = 2.0 * (g.start / g.length + p.centroid)
    row.amplitude_shift = (p.b - b) / p.b + lever * row.extinction_shift


@inlined
def _unscale(g: Any, reference: float, scale: float, unit: float, row: Any) -> None:
    """Convert a row from scaled variables to SI units; noise terms to units of the noise."""
    energy = scale * (scale * unit)
    sign = math.copysign(1.0, row.amplitude)
    logarithm = math.log(abs(row.amplitude)) + math.log(scale)
    logarithm += 2.0 * math.log(g.start) + 2.0 * row.extinction * g.start / g.length
    row.background_bend *= scale * row.amplitude * g.length
    row.background = reference + scale * row.background
    row.background_shift *= scale
    row.amplitude = sign * math.exp(logarithm)
    row.amplitude_slope /= scale
    row.extinction /= g.length
    row.extinction_slope /= scale * g.length
    row.extinction_shift /= g.length
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
def _last_usable(power: Any, s: Scratch) -> int:
    for i in range(power.size - 1, -1, -1):
        if abs(np.float64(power[i])) < HUGE and s.given[i] > 0.0:
            return i
    return -1


@inlined
def _begin(
    power: Any, mode: tuple[float, float, float], g: Grid, s: Scratch, row: Any
) -> tuple[float, float, Sums]:
    """Load a profile and write its status; return its reference, scale and sums.

    Parameters
    ----------
    power : (bin,) float
    mode : (float, float, float)
        The unit of the weights that `weigh` filled; the relative rounding error of the power, 0
        where it is of no account; the given background, or NaN.
    s : Scratch
    row : `ROW`
    """
    unit, rounding, background = mode
    last = _last_usable(power, s)
    reference = np.float64(power[last]) if math.isnan(background) else background
    scale, free = 1.0, 1.0 if math.isnan(background) else 0.0
    bins, size, total, place, value, square = load(power, reference, 1.0, g, s)
    row.bins = bins
    if bins <= UNKNOWNS:
        row.status = EMPTY if last < 0 else TOO_SHORT
        return reference, 1.0, Sums(bins, total, 0.0, 0.0, 0.0, free)
    if size < TINY:
        row.status = CONSTANT
        row.background = reference
        row.background_variance = 1.0 / (total * unit)
        return reference, 1.0, Sums(bins, total, 0.0, 0.0, 0.0, free)
    row.status = FITTED
    if not 1.0 / _SCALED < size / bins < _SCALED:
        scale = power_of_two(size / bins)
        bins, size, total, place, value, square = load(power, reference, 1.0 / scale, g, s)
    if rounding > 0.0:
        levels = reference * reference * total / bins
        weigh_squares(s)
        energy = levels + scale * scale * largest_energy(s)
        row.rounding = 2.0 * rounding * rounding * unit * energy
    return reference, scale, Sums(bins, total, place, value, square, free)


@inlined
def _fit(g: Grid, s: Scratch, sums: Sums, kind: int, given: float, spacing: int, row: Any) -> None:
    """Fit a loaded profile."""
    if kind == BACKGROUND:
        sum_points(g, s)
        p, tau = find_extinction(g, s, sums)
        _describe(g, p, sums, row)
        judge_residuals(s, p, sums, spacing, row)
        if row.bounded == 0.0:
            _polish(p, tau, sums.free, row)
        return
    p = evaluate(given, 0.0, 0.0, g, s, sums)
    _describe(g, p, sums, row)
    level, b, tau = p.level, p.b, given
    if kind == PRIOR:
        tau = _take_step(g, p, row)
        level, b = row.background, row.amplitude
    p = evaluate(tau, level, b, g, s, sums)
    judge_residuals(s, p, sums, spacing, row)
    if kind == PRIOR:
        row.misfit += p.explained
        _note_shift(g, p, level, b, row)
    else:
        _describe_given(p, sums.weight, row)


@inlined
def _solve(
    power: Any,
    noise: tuple[Array, bool, float, Integers],
    given: Array,
    kind: int,
    g: Grid,
    s: Scratch,
    out: tuple[Any, Array, Array],
) -> None:
    rows, known, rounding, spacings = noise
    records, fields, columns = out
    row, unit = records[0], 1.0
    for k in range(power.shape[0]):
        # A row of noise for each profile, or one for all.
        if k < rows.shape[0]:
            unit = weigh(rows[k], s)
        fields[:] = math.nan
        row.difference_count = row.trend_count = 0.0
        value = given[k % given.size]
        background = value if kind == BACKGROUND else math.nan
        mode = (unit, 0.0 if known else rounding, background)
        reference, scale, sums = _begin(power[k], mode, g, s, row)
        if row.status == FITTED:
            spacing = 0 if known else spacings[k % spacings.size]
            _fit(g, s, sums, kind, g.length * value, spacing, row)
            _unscale(g, reference, scale, unit, row)
        for j in range(fields.size):
            columns[j, k] = fields[j]


@compiled
def solve_path(
    power: Any,
    noise: tuple[Array, bool, float, Integers],
    given: Array,
    kind: int,
    g: Grid,
    out: tuple[Any, Array, Array],
) -> None:
    """Fit every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : ((profile or 1, bin) float64, bool, float, (profile or 1,) int)
        Variances, or relative ones, of which a bin is left out where its weight is not positive and
        finite; whether they are known; the relative rounding error of the power; the bins beyond
        which noise is independent.
    given : (profile or 1,) float64
        Backgrounds, NaN where they are to be fitted; or extinctions, m-1.
    kind : int
        What is given: `BACKGROUND`, `EXTINCTION`, or `PRIOR`, an extinction from which one linear
        step leads to that of the profile.
    g : Grid
        Of `make_grid`.
    out : ((1,) `ROW`, (field,) float64, (field, profile) float64)
        A record, its memory as an array, and the columns that receive the fields of `PathEstimate`
        of each profile, NaN where there is none.
    """
    _solve(power, noise, given, kind, g, make_scratch(g), out)
