"""Compiled least squares of the homogeneous path, one profile at a time.

The variable projection of `golub1973`: background and amplitude are linear, so the objective is
a function of extinction alone. It is evaluated on fixed nodes, and the best node is improved by
a fixed number of Newton steps, whose residuals are taken explicitly. Every sum runs over the
bins of one profile in a fixed order: a result does not depend on what else is in the batch.

Everything is scaled: ``x = (R - R_0) / L`` with the length L of the section, extinction as
``tau = extinction * L``, the shape ``phi = exp(-2 tau x) (R_0 / R)^2``, the power less a reference
and over a power of two, the weights over a power of two.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

STEPS: Final = 5
"""Newton steps after the start, which is good to some hundredths of the spacing of nodes."""
NODES: Final = 24
NODE_SCALE: Final = 0.3
"""Nodes are uniform in ``asinh(tau / NODE_SCALE)``."""
BLOCK: Final = 16
"""Profiles are padded with unused bins to whole blocks, so that loops have no remainder."""
HUGE: Final = 1e300
TINY: Final = 1e-280
DEPENDENT: Final = 1e-9
"""Squared part of a shape that other shapes must leave over for it to count as another."""

# Reassociation lets sums vectorise; NaN and infinity keep their meaning.
_SUMS: Final = {"reassoc", "contract", "nsz"}
# Inlining by force spares the reference counts of arrays that pass from function to function.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
_summing = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath=_SUMS)
_finding = numba.njit(
    cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={*_SUMS, "nnan"}
)

# What became of a profile.
FITTED: Final = 0
EMPTY: Final = 1
CONSTANT: Final = 2
TOO_SHORT: Final = 3

COLUMNS: Final = (
    "status",
    "bins",
    "background",
    "amplitude",
    "extinction",
    "background_variance",
    "amplitude_relative_variance",
    "extinction_variance",
    "signal_energy",
    "misfit",
    "bends",
    "bend_count",
    "largest",
    "trend",
    "trend_count",
    "rounding",
    "mean_range",
    "bounded",
)
"""Columns of the result; `lidarops.retrieve._quality.Estimate` says what they mean."""
(
    STATUS,
    BINS,
    BACKGROUND,
    AMPLITUDE,
    EXTINCTION,
    BACKGROUND_VARIANCE,
    AMPLITUDE_RELATIVE_VARIANCE,
    EXTINCTION_VARIANCE,
    SIGNAL_ENERGY,
    MISFIT,
    BENDS,
    BEND_COUNT,
    LARGEST,
    TREND,
    TREND_COUNT,
    ROUNDING,
    MEAN_RANGE,
    BOUNDED,
) = range(len(COLUMNS))


class Grid(NamedTuple):
    """What all profiles of a call share, in the scaled variables."""

    x: Array
    envelope: Array
    """``(R_0 / R)^2``."""
    step: float
    """Spacing of x where it is uniform, else 0."""
    first: float
    """First node as ``asinh(tau / NODE_SCALE)``."""
    spacing: float
    nodes: Array
    shapes: Array
    """phi of every node, (node, bin)."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""


class _Scratch(NamedTuple):
    z: Array
    w: Array
    phi: Array
    residual: Array
    pull: Array
    used: Array
    fine: Array
    lengths: Array
    tests: tuple[Array, Array, Array, Array]


class _Point(NamedTuple):
    """The linear fit at one extinction, and the derivatives of its objective."""

    b: float
    mean_z: float
    mean_phi: float
    mean_t: float
    centroid: float
    norm: float
    slope_norm: float
    gradient: float
    curvature: float


def make_grid(range_: Array, bounds: tuple[float, float]) -> Grid:
    """Tabulate what the profiles of a call share.

    Parameters
    ----------
    range_ : (bin,) float
        m, ascending.
    bounds : (float, float)
        Lowest and highest extinction, m-1.
    """
    length = float(range_[-1] - range_[0]) if range_.size > 1 else 1.0
    x = (range_ - range_[0]) / length
    step = 1.0 / max(range_.size - 1, 1)
    rounding = 4.0 * np.finfo(np.float64).eps * range_[-1] / length
    uniform = bool(np.all(np.abs(x - step * np.arange(range_.size)) <= rounding))
    x = np.concatenate([x, np.ones(-range_.size % BLOCK)])
    lowest, highest = bounds[0] * length, bounds[1] * length
    first, last = math.asinh(lowest / NODE_SCALE), math.asinh(highest / NODE_SCALE)
    nodes = NODE_SCALE * np.sinh(np.linspace(first, last, NODES))
    nodes[0], nodes[-1] = lowest, highest
    envelope = (range_[0] / (range_[0] + length * x)) ** 2
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        first=first,
        spacing=(last - first) / (NODES - 1),
        nodes=nodes,
        shapes=np.exp(-2.0 * nodes[:, np.newaxis] * x) * envelope,
        start=float(range_[0]),
        length=length,
    )


@_compiled
def _weight(value: float, noise: float, is_variance: bool) -> float:
    """Return the weight of a bin, 0 where value or weight cannot be used."""
    weight = 1.0 / noise if is_variance else noise
    return weight if abs(value) < HUGE and 0.0 < weight < HUGE else 0.0


@_compiled
def _last_valid(power: Any, noise: Array, is_variance: bool) -> int:
    for i in range(noise.size - 1, -1, -1):
        if _weight(np.float64(power[i]), noise[i], is_variance) > 0.0:
            return i
    return -1


@_compiled
def _load(power: Any, noise: Array, is_variance: bool, reference: float, s: _Scratch) -> int:
    """Copy one profile less its reference, 0 where it cannot be used; return the valid bins."""
    count = 0
    for i in range(noise.size):
        value = np.float64(power[i])
        weight = _weight(value, noise[i], is_variance)
        count += weight > 0.0
        s.w[i] = weight
        s.used[i] = 1.0 if weight > 0.0 else 0.0
        s.z[i] = value - reference if weight > 0.0 else 0.0
    return count


@_finding
def _largest(values: Array) -> float:
    largest = 0.0
    for i in range(values.size):
        largest = max(largest, abs(values[i]))
    return largest


@_compiled
def _power_of_two(value: float) -> float:
    return math.ldexp(1.0, math.frexp(value)[1])


@_compiled
def _multiply(values: Array, factor: float) -> None:
    for i in range(values.size):
        values[i] *= factor


@_summing
def _product(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@_summing
def _total(values: Array) -> float:
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


@_summing
def _project(shape: Array, w: Array, z: Array, w0: float, wz: float, free: float) -> float:
    """Return the signed length of the profile along a shape, background projected out."""
    s1 = s2 = sz = 0.0
    for i in range(shape.size):
        weighted = w[i] * shape[i]
        s1 += weighted
        s2 += weighted * shape[i]
        sz += weighted * z[i]
    norm = s2 - free * s1 * s1 / w0
    # A shape that is flat over the valid bins, or gone before the first, tells nothing.
    if not (norm > 1e-13 * s2 and s2 > TINY):
        return 0.0
    return float((sz - free * s1 * wz / w0) / math.sqrt(norm))


@_compiled
def _start(g: Grid, s: _Scratch, w0: float, wz: float, free: float) -> tuple[float, float, float]:
    """Return tau at the vertex about the best node, and the nodes that bracket it."""
    shapes, nodes, w, z, lengths = g.shapes, g.nodes, s.w, s.z, s.lengths
    best = 0
    for j in range(NODES):
        lengths[j] = _project(shapes[j], w, z, w0, wz, free)
        if abs(lengths[j]) > abs(lengths[best]):
            best = j
    # At an end of the grid, the vertex is extrapolated from the last three nodes.
    middle = min(max(best, 1), NODES - 2)
    sign = math.copysign(1.0, lengths[best])
    before, here, after = (
        sign * lengths[middle - 1],
        sign * lengths[middle],
        sign * lengths[middle + 1],
    )
    low, high = nodes[max(best - 1, 0)], nodes[min(best + 1, NODES - 1)]
    start = nodes[best]
    bend = before - 2.0 * here + after
    if bend < 0.0:
        vertex = g.first + (middle + 0.5 * (before - after) / bend) * g.spacing
        start = min(max(NODE_SCALE * math.sinh(vertex), low), high)
    return start, low, high


@_compiled
def _shape(tau: float, x: Array, envelope: Array, step: float, phi: Array, fine: Array) -> None:
    n = phi.size
    if step == 0.0:
        for i in range(n):
            phi[i] = math.exp(-2.0 * tau * x[i]) * envelope[i]
        return
    # Two short geometric series instead of many exponentials: few roundings, no long chain.
    ratio = math.exp(-2.0 * tau * step)
    fine[0] = 1.0
    for j in range(1, BLOCK):
        fine[j] = fine[j - 1] * ratio
    coarse = 1.0
    ratio = math.exp(-2.0 * BLOCK * tau * step)
    for k in range(0, n, BLOCK):
        block, falling = phi[k : k + BLOCK], envelope[k : k + BLOCK]
        for j in range(BLOCK):
            block[j] = coarse * fine[j] * falling[j]
        coarse *= ratio


@_summing
def _moments(x: Array, w: Array, z: Array, phi: Array) -> tuple[float, float, float, float, float]:
    s1 = s2 = sz = x1 = x2 = 0.0
    for i in range(z.size):
        weighted = w[i] * phi[i]
        square = weighted * phi[i]
        s1 += weighted
        s2 += square
        sz += weighted * z[i]
        x1 += weighted * x[i]
        x2 += square * x[i]
    return s1, s2, sz, x1, x2


@_summing
def _gradients(
    x: Array,
    w: Array,
    z: Array,
    phi: Array,
    mean_phi: float,
    mean_z: float,
    b: float,
    centroid: float,
    mean_t: float,
) -> tuple[float, float, float, float, float]:
    """Return the products of residual, shape and its slope that a Newton step needs."""
    rt = tt = rh = r0 = r1 = 0.0
    for i in range(z.size):
        lever = -2.0 * (x[i] - centroid)
        first = lever * phi[i]
        centred = phi[i] - mean_phi
        slope = first - mean_t
        residual = w[i] * (z[i] - mean_z - b * centred)
        rt += residual * slope
        tt += w[i] * slope * slope
        rh += residual * lever * first
        r0 += residual
        r1 += residual * centred
    return rt, tt, rh, r0, r1


@_compiled
def _evaluate(tau: float, g: Grid, s: _Scratch, w0: float, wz: float, free: float) -> _Point:
    x, w, z, phi = g.x, s.w, s.z, s.phi
    _shape(tau, x, g.envelope, g.step, phi, s.fine)
    s1, s2, sz, x1, x2 = _moments(x, w, z, phi)
    mean_phi, mean_z = free * s1 / w0, free * wz / w0
    norm = s2 - s1 * mean_phi
    # About the information centroid, amplitude and extinction are uncorrelated.
    centroid = (x2 - mean_phi * x1) / norm
    mean_t = -2.0 * free * (x1 - centroid * s1) / w0
    b = (sz - mean_phi * wz) / norm
    rt, tt, rh, r0, r1 = _gradients(x, w, z, phi, mean_phi, mean_z, b, centroid, mean_t)
    return _Point(
        b + r1 / norm,
        mean_z + free * r0 / w0,
        mean_phi,
        mean_t,
        centroid,
        norm,
        tt,
        b * rt,
        b * b * tt - rt * rt / norm - b * rh,
    )


@_compiled
def _newton(tau: float, point: _Point, low: float, high: float) -> float:
    gauss = point.b * point.b * point.slope_norm
    step = point.gradient / (point.curvature if point.curvature > 0.3 * gauss else gauss)
    moved = tau + step
    if not math.isfinite(moved):
        return tau
    return float(min(max(moved, low), high))


@_compiled
def _residuals(s: _Scratch, p: _Point) -> None:
    """Fill the residuals in units of the noise, and times weight; 0 for bins not used."""
    for i in range(s.z.size):
        residual = s.z[i] - p.mean_z - p.b * (s.phi[i] - p.mean_phi)
        s.residual[i] = math.sqrt(s.w[i]) * residual
        s.pull[i] = s.w[i] * residual


@_summing
def _bends(s: _Scratch) -> tuple[float, float]:
    """Sum the squared second differences of the residuals between neighbours; count them."""
    total = terms = 0.0
    # Slices, since an index that might be negative keeps a loop from vectorising.
    last, middle = s.residual[2:], s.residual[1:]
    used_last, used_middle = s.used[2:], s.used[1:]
    for i in range(last.size):
        bend = last[i] - 2.0 * middle[i] + s.residual[i]
        whole = used_last[i] * used_middle[i] * s.used[i]
        total += whole * bend * bend
        terms += whole
    return total, terms


@_summing
def _along(weighted: Array, g: Grid, phi: Array, p: _Point) -> tuple[float, float, float]:
    """Return the products of a weighted vector with the orthogonal shapes of the model."""
    one = shape = slope = 0.0
    for i in range(weighted.size):
        one += weighted[i]
        shape += weighted[i] * (phi[i] - p.mean_phi)
        slope += weighted[i] * (-2.0 * (g.x[i] - p.centroid) * phi[i] - p.mean_t)
    return one, shape, slope


@_compiled
def _left(
    product: float,
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    p: _Point,
    w0: float,
) -> float:
    """Return what the model leaves over of the product of two vectors."""
    return product - (a[0] * b[0] / w0 + a[1] * b[1] / p.norm + a[2] * b[2] / p.slope_norm)


@_compiled
def _trend(g: Grid, s: _Scratch, p: _Point, w0: float) -> tuple[float, float]:
    """Return the energy of the residuals in two shapes that the model lacks, and their number.

    One is backscatter that bends along the path, ``phi x^2``, the other a detector that is not
    linear, ``phi^2``; both are orthogonalised against the model.
    """
    bent, square, weighted_bent, weighted_square = s.tests
    for i in range(g.x.size):
        lever = g.x[i] - p.centroid
        bent[i] = lever * lever * s.phi[i]
        square[i] = s.phi[i] * s.phi[i]
        weighted_bent[i] = s.w[i] * bent[i]
        weighted_square[i] = s.w[i] * square[i]
    of_bent = _along(weighted_bent, g, s.phi, p)
    of_square = _along(weighted_square, g, s.phi, p)
    of_residual = _along(s.pull, g, s.phi, p)
    energy = count = shared = 0.0
    whole = _product(bent, weighted_bent)
    norm = _left(whole, of_bent, of_bent, p, w0)
    pulled = _left(_product(bent, s.pull), of_bent, of_residual, p, w0)
    if norm > DEPENDENT * whole:
        energy += pulled * pulled / norm
        count += 1.0
        shared = _left(_product(bent, weighted_square), of_bent, of_square, p, w0) / norm
    whole = _product(square, weighted_square)
    norm = _left(whole, of_square, of_square, p, w0) - shared * shared * norm
    if norm > DEPENDENT * whole:
        own = _left(_product(square, s.pull), of_square, of_residual, p, w0) - shared * pulled
        energy += own * own / norm
        count += 1.0
    return energy, count


@_compiled
def _judge(
    g: Grid, s: _Scratch, p: _Point, tau: float, sums: tuple[float, float, float], row: Array
) -> None:
    """Write the tests of the fit, in units of the scaled noise."""
    w0, wz, free = sums
    _residuals(s, p)
    row[MISFIT] = _product(s.residual, s.residual)
    row[BENDS], row[BEND_COUNT] = _bends(s)
    row[LARGEST] = _largest(s.residual)
    # The test shapes are clear of the background even where the background was given.
    full = p if free > 0.0 else _evaluate(tau, g, s, w0, wz, 1.0)
    row[TREND], row[TREND_COUNT] = _trend(g, s, full, w0)
    row[BOUNDED] = tau <= g.nodes[0] or tau >= g.nodes[-1]


@_compiled
def _fit(g: Grid, s: _Scratch, free: float, row: Array) -> None:
    """Fit one loaded profile and write what became of it, in the scaled variables."""
    w0, wz = _total(s.w), _product(s.w, s.z)
    tau, low, high = _start(g, s, w0, wz, free)
    for _ in range(STEPS):
        tau = _newton(tau, _evaluate(tau, g, s, w0, wz, free), low, high)
    p = _evaluate(tau, g, s, w0, wz, free)
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
    row[MEAN_RANGE] = _product(s.w, g.x) / w0
    _judge(g, s, p, tau, (w0, wz, free), row)


@_compiled
def _unscale(g: Grid, reference: float, scale: float, unit: float, row: Array) -> None:
    """Turn a row from the scaled variables into SI units; noise terms into units of the noise."""
    energy = scale * (scale * unit)
    sign = math.copysign(1.0, row[AMPLITUDE])
    logarithm = math.log(abs(row[AMPLITUDE])) + math.log(scale)
    logarithm += 2.0 * math.log(g.start) + 2.0 * row[EXTINCTION] * g.start / g.length
    row[BACKGROUND] = reference + scale * row[BACKGROUND]
    row[AMPLITUDE] = sign * math.exp(logarithm)
    row[EXTINCTION] /= g.length
    row[BACKGROUND_VARIANCE] /= unit
    row[AMPLITUDE_RELATIVE_VARIANCE] /= energy
    row[EXTINCTION_VARIANCE] /= energy * g.length * g.length
    row[SIGNAL_ENERGY] *= energy
    row[MISFIT] *= energy
    row[BENDS] *= energy
    row[TREND] *= energy
    row[LARGEST] *= math.sqrt(energy)
    row[MEAN_RANGE] = g.start + g.length * row[MEAN_RANGE]


@_compiled
def _scratch(n: int) -> _Scratch:
    return _Scratch(
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(BLOCK),
        np.zeros(NODES),
        (np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)),
    )


@_compiled
def _solve_profile(
    power: Any, noise: Array, mode: tuple[bool, float, float], g: Grid, s: _Scratch, row: Array
) -> None:
    is_variance, background, rounding = mode
    last = _last_valid(power, noise, is_variance)
    given = not math.isnan(background)
    reference = background if given else np.float64(power[last])
    row[BINS] = 0 if last < 0 else _load(power, noise, is_variance, reference, s)
    if row[BINS] < 4:
        row[STATUS] = EMPTY if last < 0 else TOO_SHORT
        return
    unit, largest = _power_of_two(_largest(s.w)), _largest(s.z)
    _multiply(s.w, 1.0 / unit)
    row[ROUNDING] = (rounding * (abs(reference) + largest)) ** 2 * unit * _total(s.w) / row[BINS]
    if largest < TINY:
        row[STATUS] = CONSTANT
        row[BACKGROUND] = reference
        row[BACKGROUND_VARIANCE] = 1.0 / (_total(s.w) * unit)
        return
    scale = _power_of_two(largest)
    _multiply(s.z, 1.0 / scale)
    row[STATUS] = FITTED
    _fit(g, s, 0.0 if given else 1.0, row)
    _unscale(g, reference, scale, unit, row)


@_compiled
def solve_profiles(
    power: Any,
    noise: Array,
    is_variance: bool,
    background: Array,
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
        Given backgrounds, NaN where the background is to be fitted.
    rounding : float
        Relative rounding error of the power.
    g : Grid
        Of `make_grid`.
    out : (profile, column) float64
        Filled with NaN; gets the `COLUMNS`.
    """
    s = _scratch(g.x.size)
    for k in range(power.shape[0]):
        mode = (is_variance, background[k % background.size], rounding)
        _solve_profile(power[k], noise[k % noise.shape[0]], mode, g, s, out[k])
