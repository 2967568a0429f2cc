"""Least squares of profiles with gaps or weights of their own, in a few passes over the bins.

A faster form of `lidarops.retrieve.homogeneous._direct`. The best of a few extinctions is found on
sums over groups of bins; Newton steps for all three unknowns follow, each in one vectorised pass
over the bins. From a start within some percent each step squares the error, so that three or four
suffice. The result is that of converged least squares, judged by
`lidarops.retrieve.homogeneous._fit_quality`.

Everything is scaled as in `lidarops.retrieve.homogeneous._projection`. Profiles for which this
fails (nearly flat, or numbers at the limits of the float range) are left to the direct fit.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._direct import unscale
from lidarops.retrieve.homogeneous._estimate import (
    AMPLITUDE,
    AMPLITUDE_RELATIVE_VARIANCE,
    BACKGROUND,
    BACKGROUND_BEND,
    BACKGROUND_VARIANCE,
    BINS,
    BOUNDED,
    DIFFERENCE_COUNT,
    EXTINCTION,
    EXTINCTION_BEND,
    EXTINCTION_VARIANCE,
    FITTED,
    LARGEST,
    MEAN_RANGE,
    MISFIT,
    ROUNDING,
    SECOND_DIFFERENCES,
    SIGNAL_ENERGY,
    STATUS,
    TREND,
    TREND_COUNT,
)
from lidarops.retrieve.homogeneous._misfit import INDEPENDENT
from lidarops.retrieve.homogeneous._vector_loops import (
    LANES,
    STRIDE,
    bend_sums,
    project_1_16,
    project_1_32,
    residuals,
    step_sums,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]

MOST_PASSES: Final = 8
NODES: Final = 16
_SCALE: Final = 0.3
_HUGE: Final = 1e140
_LEAST: Final = 1e-3
"""Least share of the weight per bin that a shape keeps without its mean, to be tried as a start:
a shape that has decayed before the first valid bin would fit anything."""

_FEWEST_BINS: Final = THRESHOLDS.fewest_masked_bins
_LATEST: Final = THRESHOLDS.latest
_DEEPEST: Final = THRESHOLDS.deepest
_LEAST_CURVATURE: Final = THRESHOLDS.least_curvature
_STRAYED: Final = 0.1
"""Relative change of the centre by a step, above which the step says nothing on convergence."""
CONVERGED: Final = 1e-7
"""Step over extinction whose square is negligible: the iteration ends."""
CLOSE: Final = 1e-3
"""Limit of the step before it: with quadratic convergence, no step is small all at once."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
_finding = numba.njit(
    cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={"nnan", "nsz"}
)
_summing = numba.njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    forceinline=True,
    fastmath={"contract", "nsz", "reassoc"},
)


class MaskedTables(NamedTuple):
    """Tables common to the profiles of a call."""

    x: Array
    """Scaled range, padded to whole steps."""
    envelope: Array
    """``(R_0 / R)^2``, zero where padded."""
    step: float
    edges: npt.NDArray[np.int64]
    """Edges of the groups of bins, which widen along range."""
    shapes: Array
    """(group, node): phi at the middle of each group."""
    powers: Array
    """(group, 2 nodes): phi, then phi squared."""
    nodes: Array
    first: float
    scale: float
    """Nodes are uniform in ``asinh(tau / scale)``, from `first` in steps of `spacing`."""
    spacing: float
    start: float
    length: float


class _Scratch(NamedTuple):
    z: Array
    w: Array
    used: Array
    root: Array
    residual: Array
    weights: Array
    values: Array
    lengths: Array
    sums: Array


class _Fit(NamedTuple):
    level: float
    amplitude: float
    tau: float
    mean: float
    centre: float


def make_masked_tables(range_: Array, bounds: tuple[float, float]) -> MaskedTables:
    """Return the tables common to the profiles of a call.

    Parameters
    ----------
    range_ : (bin,) float
        m, ascending and uniform.
    bounds : (float, float)
        Lowest and highest extinction, m-1.
    """
    bins = range_.size
    length = float(range_[-1] - range_[0])
    padded = -(-bins // STRIDE) * STRIDE
    x = np.ones(padded)
    x[:bins] = (range_ - range_[0]) / length
    envelope = np.zeros(padded)
    envelope[:bins] = (range_[0] / range_) ** 2
    lowest, highest = bounds[0] * length, bounds[1] * length
    scale = min(_SCALE, _SCALE * length / float(range_[0]))
    first, last = math.asinh(lowest / scale), math.asinh(highest / scale)
    nodes = scale * np.sinh(np.linspace(first, last, NODES))
    edges = _edges(bins)
    middle = 0.5 * (x[edges[:-1]] + x[edges[1:] - 1])
    falling = (range_[0] / (range_[0] + length * middle)) ** 2
    shapes = np.exp(-2.0 * middle[:, np.newaxis] * nodes) * falling[:, np.newaxis]
    return MaskedTables(
        x=x,
        envelope=envelope,
        step=1.0 / (bins - 1),
        edges=edges,
        shapes=np.ascontiguousarray(shapes),
        powers=np.concatenate([shapes, shapes * shapes], axis=1),
        nodes=nodes,
        first=first,
        scale=scale,
        spacing=(last - first) / (NODES - 1),
        start=float(range_[0]),
        length=length,
    )


def _edges(bins: int) -> npt.NDArray[np.int64]:
    unit = max(bins // 256, 1)
    widths = np.repeat([1, 2, 4], 8) * unit
    near = np.concatenate([[0], np.cumsum(widths)])
    far = np.arange(near[-1] + 8 * unit, bins, 8 * unit)
    inside = np.concatenate([near, far])
    return np.append(inside[inside < bins], bins).astype(np.int64)


@_compiled
def _load(power: Any, weights: Array, s: _Scratch) -> tuple[float, float, float]:
    """Copy a profile; return its number of valid bins, reference and largest weight."""
    w, z, used = s.w[: weights.size], s.z[: weights.size], s.used[: weights.size]
    for i in range(weights.size):
        weight = weights[i]
        value = np.float64(power[i])
        valid = (abs(value) < _HUGE) & (weight > 0.0) & (weight < _HUGE)
        w[i] = weight if valid else 0.0
        z[i] = value if valid else 0.0
        used[i] = 1.0 if valid else 0.0
    reference = 0.0
    for i in range(weights.size - 1, -1, -1):
        if s.used[i] > 0.0:
            reference = s.z[i]
            break
    return _sum(used), reference, _largest(w)


@_summing
def _sum(values: Array) -> float:
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


@_finding
def _largest(values: Array) -> float:
    largest = 0.0
    for i in range(values.size):
        largest = max(largest, values[i])
    return largest


@_compiled
def _shift(z: Array, used: Array, reference: float) -> None:
    for i in range(z.size):
        z[i] = (z[i] - reference) * used[i]


@_compiled
def _multiply(values: Array, factor: float) -> None:
    for i in range(values.size):
        values[i] *= factor


@_compiled
def _take_roots(values: Array, roots: Array) -> None:
    for i in range(values.size):
        roots[i] = math.sqrt(values[i])


@_compiled
def _group(g: MaskedTables, s: _Scratch) -> tuple[float, float]:
    """Sum weights and weighted values over the groups; return both sums over all bins."""
    total_weight = value = 0.0
    for k in range(g.edges.size - 1):
        group_weight = group_value = 0.0
        for i in range(g.edges[k], g.edges[k + 1]):
            group_weight += s.w[i]
            group_value += s.w[i] * s.z[i]
        s.weights[k], s.values[k] = group_weight, group_value
        total_weight += group_weight
        value += group_value
    return total_weight, value


@_compiled
def _seek(g: MaskedTables, s: _Scratch, total_weight: float, value: float, count: float) -> _Fit:
    """Return the best node on the groups, moved to the peak of a parabola through it."""
    groups, out = g.edges.size - 1, s.sums.ctypes.data
    weights, values, after = s.weights.ctypes.data, s.values.ctypes.data, g.x.ctypes.data
    project_1_32(weights, 8, g.powers.ctypes.data, groups, out, after, 0)
    project_1_16(values, 8, g.shapes.ctypes.data, groups, out + 16 * NODES, after, 0)
    _energies(s.sums, s.lengths, value, total_weight, _LEAST * total_weight / count)
    best = 0
    for j in range(NODES):
        if s.lengths[j] > s.lengths[best]:
            best = j
    if best < NODES - 1 and s.lengths[best + 1] == 0.0:
        # The next node holds no information, or has decayed before the first valid bin.
        return _Fit(0.0, math.nan, math.nan, 0.0, 0.0)
    tau = _parabola_peak(g, s, best)
    mean, norm = (
        s.sums[0, best] / total_weight,
        s.sums[1, best] - s.sums[0, best] ** 2 / total_weight,
    )
    amplitude = (s.sums[2, best] - mean * value) / norm
    return _Fit(value / total_weight - amplitude * mean, amplitude, tau, mean, 0.0)


@_compiled
def _energies(
    sums: Array, energies: Array, value: float, total_weight: float, least: float
) -> None:
    """Fill the energy of the profile along the shape of each node."""
    ones, twos, products = sums[0], sums[1], sums[2]
    for j in range(energies.size):
        norm = twos[j] - ones[j] * ones[j] / total_weight
        length = products[j] - ones[j] * value / total_weight
        energies[j] = length * length / norm if norm > least else 0.0


@_compiled
def _parabola_peak(g: MaskedTables, s: _Scratch, best: int) -> float:
    """Return the tau at the peak of a parabola through the roots of three neighbouring energies."""
    middle = min(max(best, 1), NODES - 2)
    before, centre = math.sqrt(s.lengths[middle - 1]), math.sqrt(s.lengths[middle])
    after = math.sqrt(s.lengths[middle + 1])
    bend = before - 2.0 * centre + after
    if not bend < 0.0:
        return float(g.nodes[best])
    peak = g.first + (middle + 0.5 * (before - after) / bend) * g.spacing
    low, high = g.nodes[max(best - 1, 0)], g.nodes[min(best + 1, NODES - 1)]
    return float(min(max(g.scale * math.sinh(peak), low), high))


@_compiled
def _normal(
    sums: tuple[float, ...], total_weight: float
) -> tuple[float, float, float, float, float]:
    """Return the normal equation of the slope, with level and shape projected out.

    These are its norm and right-hand side, its products with level and shape, and the norm of
    the shape.
    """
    d, dd, g, gd, gg, _, _, rg, _ = sums
    shape = dd - d * d / total_weight
    slope_on_level = g / total_weight
    slope_on_shape = (gd - d * slope_on_level) / shape
    norm = gg - g * slope_on_level - slope_on_shape * slope_on_shape * shape
    right = rg - slope_on_level * sums[5] - slope_on_shape * (sums[6] - d * sums[5] / total_weight)
    return norm, right, slope_on_level, slope_on_shape, shape


@_compiled
def _step(
    fit: _Fit, sums: tuple[float, ...], total_weight: float, bounds: tuple[float, float]
) -> _Fit:
    """Return the fit after one Newton step."""
    d, dd, _, gd, _, r, rd, _, rgx = sums
    norm, right, slope_on_level, slope_on_shape, shape = _normal(sums, total_weight)
    linear = (rd - d * r / total_weight) / shape
    amplitude = fit.amplitude + linear
    curved = norm - rgx / amplitude
    slope = right / (curved if curved > _LEAST_CURVATURE * norm else norm)
    tau = min(max(fit.tau - 0.5 * slope / amplitude, bounds[0]), bounds[1])
    moved = tau - fit.tau
    slope = -2.0 * amplitude * moved
    along = linear - slope_on_shape * slope
    level = (r - d * along) / total_weight - slope_on_level * slope
    return _Fit(
        fit.level + level - along * fit.mean,
        (fit.amplitude + along) * math.exp(2.0 * fit.centre * moved),
        tau,
        fit.mean + d / total_weight,
        fit.centre + gd / (dd + fit.mean * d),
    )


@_compiled
def _decays(g: MaskedTables, tau: float) -> tuple[float, float]:
    e1 = math.exp(-2.0 * tau * g.step)
    return e1, (e1 * e1) * (e1 * e1)


@_compiled
def _describe(
    g: MaskedTables,
    before: _Fit,
    after: _Fit,
    sums: tuple[float, ...],
    total_weight: float,
    row: Array,
) -> None:
    """Write parameters and variances, in the scaled variables."""
    norm, _, slope_on_level, slope_on_shape, shape = _normal(sums, total_weight)
    energy = after.amplitude * after.amplitude * shape
    extinction = 1.0 / (4.0 * after.amplitude * after.amplitude * norm)
    mean = before.mean + sums[0] / total_weight
    # Effect of the slope on the level, with the shape adjusted.
    level = slope_on_level - slope_on_shape * mean
    lever = 2.0 * (g.start / g.length + before.centre + slope_on_shape)
    row[BACKGROUND] = after.level
    row[AMPLITUDE] = after.amplitude
    row[EXTINCTION] = after.tau
    row[SIGNAL_ENERGY] = energy
    row[EXTINCTION_VARIANCE] = extinction
    row[BACKGROUND_VARIANCE] = 1.0 / total_weight + mean * mean / shape + level * level / norm
    row[AMPLITUDE_RELATIVE_VARIANCE] = 1.0 / energy + lever * lever * extinction


@_compiled
def _remainder(
    product: float,
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    total_weight: float,
) -> float:
    """Return the part of a product orthogonal to level, shape and slope.

    `a` and `b` are the components of both vectors in units of their norms.
    """
    return product - (a[0] * b[0] / total_weight + a[1] * b[1] + a[2] * b[2])


@_compiled
def _components(
    constant: float, d: float, g: float, sums: tuple[float, ...], total_weight: float
) -> tuple[float, float, float]:
    """Return the products of a vector with level, and with normed shape and slope."""
    norm, _, slope_on_level, slope_on_shape, shape = _normal(sums, total_weight)
    along = d - sums[0] * constant / total_weight
    across = g - slope_on_level * constant - slope_on_shape * along
    return constant, along / math.sqrt(shape), across / math.sqrt(norm)


@_compiled
def _describe_bend(
    before: _Fit, sums: tuple[float, ...], bent: tuple[float, ...], total_weight: float, row: Array
) -> None:
    """Write the effect of a bent signal on the fit, as `_misfit.describe_bend`."""
    norm, _, slope_on_level, slope_on_shape, shape = _normal(sums, total_weight)
    constant, along, across = _components(bent[0], bent[1], bent[2], sums, total_weight)
    along, across = along / math.sqrt(shape), across / math.sqrt(norm)
    mean = before.mean + sums[0] / total_weight
    row[BACKGROUND_BEND] = (
        constant / total_weight - along * mean - across * (slope_on_level - slope_on_shape * mean)
    )
    row[EXTINCTION_BEND] = 0.5 - before.centre - 0.5 * across


@_compiled
def _trend(
    sums: tuple[float, ...], bent: tuple[float, ...], total_weight: float, row: Array
) -> None:
    """Write the misfit, and the energy of the residuals in two shapes that the model lacks.

    One is backscatter that bends along the path, the other a nonlinear detector, as in
    `lidarops.retrieve.homogeneous._misfit`.
    """
    p = _components(bent[0], bent[1], bent[2], sums, total_weight)
    q = _components(bent[3], bent[4], bent[5], sums, total_weight)
    # Components that the last step removed from the residuals.
    r = _components(sums[5], sums[6], sums[7], sums, total_weight)
    row[MISFIT], row[LARGEST] = _remainder(bent[11], r, r, total_weight), math.sqrt(bent[12])
    pulled = _remainder(bent[9], p, r, total_weight)
    energy = count = shared = 0.0
    norm = _remainder(bent[6], p, p, total_weight)
    if norm > INDEPENDENT * bent[6]:
        energy += pulled * pulled / norm
        count += 1.0
        shared = _remainder(bent[7], p, q, total_weight) / norm
    rest = _remainder(bent[8], q, q, total_weight) - shared * shared * norm
    if rest > INDEPENDENT * bent[8]:
        along = _remainder(bent[10], q, r, total_weight) - shared * pulled
        energy += along * along / rest
        count += 1.0
    row[TREND], row[TREND_COUNT] = energy, count


@_summing
def _second_differences(residual: Array, used: Array) -> tuple[float, float]:
    total = terms = 0.0
    last, middle = residual[2:], residual[1:]
    used_last, used_middle = used[2:], used[1:]
    for i in range(last.size):
        difference = last[i] - 2.0 * middle[i] + residual[i]
        valid = used_last[i] * used_middle[i] * used[i]
        total += valid * difference * difference
        terms += valid
    return total, terms


@_compiled
def _take_residuals(g: MaskedTables, s: _Scratch, fit: _Fit, row: Array) -> None:
    """Fill the second differences of the residuals, from which the noise is estimated."""
    decay, e4 = _decays(g, fit.tau)
    steps = g.x.size // STRIDE
    address = s.z.ctypes.data
    _take_roots(s.w, s.root)
    residuals(
        s.z,
        address,
        address + 8 * STRIDE * (steps - 1),
        steps,
        g.envelope.ctypes.data,
        s.root.ctypes.data,
        decay,
        decay * decay,
        e4,
        e4 * e4,
        fit.amplitude,
        fit.level,
        s.residual.ctypes.data,
    )
    row[SECOND_DIFFERENCES], row[DIFFERENCE_COUNT] = _second_differences(s.residual, s.used)


@_compiled
def _fit(g: MaskedTables, s: _Scratch, count: float, want_differences: bool, row: Array) -> bool:
    """Fit one loaded profile; return whether the fit succeeded."""
    total_weight, value = _group(g, s)
    after = _seek(g, s, total_weight, value, count)
    bounds = g.nodes[0], g.nodes[-1]
    before, sums = after, (0.0,) * 9
    arrays = g.x.ctypes.data, s.w.ctypes.data, s.z.ctypes.data, g.envelope.ctypes.data
    steps = g.x.size // LANES
    moved, settled = math.inf, False
    for k in range(MOST_PASSES):
        # The first steps may be small by chance, since they start from the amplitude of the node.
        if k > 2 and settled:
            break
        before, last = after, moved
        e1, e4 = _decays(g, before.tau)
        sums = step_sums(*arrays, steps, e1, e4, *before[:2], before.mean, before.centre)
        after = _step(before, sums, total_weight, bounds)
        moved = abs(after.tau - before.tau)
        size = abs(after.tau) + g.scale
        # A step about a stray centre is small at any distance from the solution.
        strayed = abs(after.centre - before.centre) > _STRAYED * (1.0 + abs(after.centre))
        settled = moved < CONVERGED * size and last < CLOSE * size and not strayed
    _describe(g, before, after, sums, total_weight, row)
    e1, e4 = _decays(g, before.tau)
    bent = bend_sums(*arrays, steps, e1, e4, *before[:2], before.mean, before.centre)
    _trend(sums, bent, total_weight, row)
    _describe_bend(before, sums, bent, total_weight, row)
    row[SECOND_DIFFERENCES], row[DIFFERENCE_COUNT] = 0.0, 0.0
    if want_differences:
        _take_residuals(g, s, after, row)
    row[MEAN_RANGE] = _mean_range(g, s, total_weight)
    row[ROUNDING] = total_weight
    row[BOUNDED] = 1.0 if after.tau <= bounds[0] or after.tau >= bounds[1] else 0.0
    first = 0
    while s.used[first] == 0.0:
        first += 1
    # Where the start of the section is missing, the shapes are too similar for these sums.
    if g.x[first] > _LATEST or after.tau * g.x[first] > _DEEPEST:
        return False
    return settled and math.isfinite(row[EXTINCTION_VARIANCE] + row[MISFIT] + row[TREND])


@_summing
def _mean_range(g: MaskedTables, s: _Scratch, total_weight: float) -> float:
    total = 0.0
    for i in range(s.w.size):
        total += s.w[i] * g.x[i]
    return total / total_weight


@_compiled
def _scratch(g: MaskedTables) -> _Scratch:
    bins, groups = g.x.size, g.edges.size - 1
    return _Scratch(
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(groups),
        np.zeros(groups),
        np.zeros(NODES),
        np.zeros((3, NODES)),
    )


@_compiled
def _solve_profile(
    power: Any,
    weights: Array,
    want_differences: bool,
    rounding: float,
    g: MaskedTables,
    s: _Scratch,
    row: Array,
) -> bool:
    count, reference, unit = _load(power, weights, s)
    row[BINS] = count
    if count < _FEWEST_BINS:
        return False
    _shift(s.z[: weights.size], s.used[: weights.size], reference)
    _multiply(s.w, 1.0 / unit)
    if not _fit(g, s, count, want_differences, row):
        return False
    row[STATUS] = FITTED
    largest = abs(reference) + abs(row[AMPLITUDE])
    row[ROUNDING] *= (rounding * largest) ** 2 * unit / count
    unscale(g, reference, 1.0, unit, row)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_masked(
    power: Any,
    weights: Array,
    want_differences: bool,
    rounding: float,
    g: MaskedTables,
    out: Array,
    solved: npt.NDArray[np.bool_],
) -> None:
    """Fit every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    weights : (profile or 1, bin) float64
        A bin is left out where its weight is not positive and finite.
    want_differences : bool
        Whether the second differences of the residuals are computed; 0 otherwise.
    rounding : float
        Relative rounding error of the power.
    g : MaskedTables
        Result of `make_masked_tables`.
    out : (profile, column) float64
        Receives the columns of `lidarops.retrieve.homogeneous._estimate`.
    solved : (profile,) bool
        False where a profile is left to the direct fit; its columns mean nothing.
    """
    s = _scratch(g)
    for k in range(power.shape[0]):
        solved[k] = _solve_profile(
            power[k], weights[k % weights.shape[0]], want_differences, rounding, g, s, out[k]
        )
