"""Compiled projection of a profile on background and amplitude at one extinction.

Background and amplitude are linear, so that least squares of a homogeneous path is a problem in
extinction alone: the variable projection of `golub1973`.

Everything is scaled: ``x = (R - R_0) / L`` with the length L of the section, extinction as
``tau = extinction * L``, the shape ``phi = exp(-2 tau x) (R_0 / R)^2``, the power less a reference
and divided by a power of two, the weights divided by a power of two.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numba
import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Integers
from lidarops.retrieve.common.compiled_code import inlined, summing

NODES: Final = 24
"""Extinctions of the search."""
_WIDEST_SCALE: Final = 0.3
BLOCK: Final = 8
"""Profiles are padded with unused bins to whole blocks, so that loops have no remainder. The search
runs on the bins of the first block and on the sums of each block beyond."""


class Grid(NamedTuple):
    """Tables common to the profiles of a call, in the scaled variables."""

    x: Array
    envelope: Array
    """``(R_0 / R)^2``."""
    step: float
    """Spacing of x where it is uniform, else 0."""
    nodes: Array
    """(node,): tau, uniform in ``asinh(tau / scale)`` from `first` in steps of `spacing`."""
    first: float
    spacing: float
    scale: float
    shapes: Array
    """(2, node, bin): phi of every node, and its square."""
    block_shapes: Array
    """(2, node, point): phi of the bins of the first block and averaged over each block beyond, and
    its square."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""


class Scratch(NamedTuple):
    """Arrays of one profile, (bin,) each but the last two."""

    given: Array
    """Weights by the noise alone, 0 where it is not usable."""
    w: Array
    """Weights, 0 where the power is not usable either."""
    z: Array
    """Values, 0 where not usable."""
    phi: Array
    residual: Array
    energy: Array
    energy_bits: Integers
    """The memory of `energy`."""
    points: Array
    """(2, point): sums of weights, and of weights times values."""
    explained: Array
    """(node,): energy that the shape explains."""


class Sums(NamedTuple):
    """Weighted sums over a loaded profile."""

    bins: float
    weight: float
    place: float
    """Of x."""
    value: float
    square: float
    """Of the squared values."""
    free: float
    """1 where the background is fitted, 0 where it is given."""


class ShapeSums(NamedTuple):
    """Weighted sums over the bins of powers of phi, each times powers of x."""

    phi: tuple[float, float, float]
    """Times 1, x, x^2; so for all but `square`."""
    square: tuple[float, float, float, float, float]
    """Of phi^2, up to x^4."""
    cube: tuple[float, float, float]
    fourth: float
    """Of phi^4."""
    value: tuple[float, float, float]
    """Of phi z."""


class Point(NamedTuple):
    """The linear fit at one extinction, and the derivatives of its objective.

    The slope is the derivative of the shape by tau about the centroid, ``-2 (x - centroid) phi``.
    """

    tau: float
    level: float
    """The background."""
    b: float
    mean_phi: float
    mean_slope: float
    centroid: float
    """Of the information: about it, amplitude and extinction are uncorrelated."""
    norm: float
    """Weighted square of the shape, without its mean where the background is fitted."""
    slope_norm: float
    """The same of the slope."""
    gradient: float
    gauss: float
    """The curvature but for what the residuals add."""
    curvature: float
    energy: float
    """Of the residuals, by differences: no better than the rounding of the squared values."""
    sums_of_shape: ShapeSums


@lru_cache(maxsize=8)
def make_grid(ranges: bytes, bounds: tuple[float, float]) -> Grid:
    """Return the tables common to the profiles of a section.

    They take as long as fifty profiles, and the calls for the blocks of a scene share them.

    Parameters
    ----------
    ranges : bytes
        Of (bin,) float64, m, ascending.
    bounds : (float, float)
        Lowest and highest extinction, m-1.
    """
    range_ = np.frombuffer(ranges)
    bins = range_.size
    length = float(range_[-1] - range_[0]) if bins > 1 else 1.0
    x = (range_ - range_[0]) / length
    step = 1.0 / max(bins - 1, 1)
    rounding = 4.0 * np.finfo(np.float64).eps * range_[-1] / length
    uniform = bool(np.all(np.abs(x - step * np.arange(bins)) <= rounding))
    x = np.concatenate([x, np.ones(-bins % BLOCK)])
    lowest, highest = bounds[0] * length, bounds[1] * length
    # In a thin section the slope of the shape vanishes at tau = -L / R: nodes are finer there.
    scale = min(_WIDEST_SCALE, _WIDEST_SCALE * length / float(range_[0]))
    first, last = math.asinh(lowest / scale), math.asinh(highest / scale)
    nodes = scale * np.sinh(np.linspace(first, last, NODES))
    nodes[0], nodes[-1] = lowest, highest
    envelope = (range_[0] / (range_[0] + length * x)) ** 2
    firsts = [*range(BLOCK), *range(BLOCK, x.size, BLOCK)]
    real = (np.arange(x.size) < bins)[:, np.newaxis]
    shapes = np.exp(-2.0 * nodes * x[:, np.newaxis]) * envelope[:, np.newaxis] * real
    widths = np.maximum(np.add.reduceat(1.0 * real, firsts), 1.0)
    block_shapes = np.add.reduceat(shapes, firsts) / widths
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        nodes=nodes,
        first=first,
        spacing=(last - first) / (NODES - 1),
        scale=scale,
        shapes=np.ascontiguousarray([shapes.T, shapes.T**2]),
        block_shapes=np.ascontiguousarray([block_shapes.T, block_shapes.T**2]),
        start=float(range_[0]),
        length=length,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def make_scratch(g: Grid) -> Scratch:
    """Return the arrays of a profile."""
    n = g.x.size
    given, w, z, phi = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    residual, energy = np.zeros(n), np.zeros(n)
    points, explained = np.zeros((2, g.block_shapes.shape[2])), np.zeros(NODES)
    return Scratch(
        given, w, z, phi, residual, energy, energy.view(np.int64), points, explained
    )  # fmt: skip


@inlined
def power_of_two(value: float) -> float:
    """Return the power of two next above a value."""
    return math.ldexp(1.0, math.frexp(value)[1])


@inlined
def _first_usable(variance: Array) -> float:
    for i in range(variance.size):
        if (variance[i] > 1.0 / HUGE) & (variance[i] < math.inf):
            return float(variance[i])
    return 1.0


@summing
def weigh(variance: Array, s: Scratch) -> float:
    """Fill the weights of a row of variances, and return their unit, a power of two."""
    scale: float = power_of_two(_first_usable(variance))
    for i in range(variance.size):
        usable = (variance[i] > 1.0 / HUGE) & (variance[i] < math.inf)
        s.given[i] = scale / variance[i] if usable else 0.0
    return 1.0 / scale


@summing
def load(power: Any, reference: float, s: Scratch) -> tuple[float, float, float]:
    """Copy a profile less its reference, 0 where not usable.

    Returns the number of usable bins, their weight and the sum of their absolute values.
    """
    count = total = size = 0.0
    for i in range(power.size):
        value = np.float64(power[i])
        usable = (abs(value) < HUGE) & (s.given[i] > 0.0)
        s.w[i] = s.given[i] if usable else 0.0
        s.z[i] = value - reference if usable else 0.0
        count += 1.0 if usable else 0.0
        total += s.w[i]
        size += abs(s.z[i])
    return count, total, size


@summing
def rescale(factor: float, g: Grid, s: Scratch) -> tuple[float, float, float]:
    """Scale a profile, and fill the points of the search.

    Returns the weighted sums of x, of the values and of their squares.
    """
    place = total = squares = 0.0
    for i in range(s.z.size):
        s.z[i] *= factor
        weighted = s.w[i] * s.z[i]
        place += s.w[i] * g.x[i]
        total += weighted
        squares += weighted * s.z[i]
    for i in range(BLOCK):
        s.points[0, i], s.points[1, i] = s.w[i], s.w[i] * s.z[i]
    for k in range(BLOCK, s.points.shape[1]):
        first = BLOCK * (k - BLOCK + 1)
        weight = value = 0.0
        for i in range(first, first + BLOCK):
            weight += s.w[i]
            value += s.w[i] * s.z[i]
        s.points[0, k], s.points[1, k] = weight, value
    return place, total, squares


@summing
def largest_energy(values: Array, s: Scratch) -> float:
    """Return the largest weighted square of an array."""
    for i in range(values.size):
        s.energy[i] = s.w[i] * values[i] * values[i]
    most = np.int64(0)
    # Floats that are not negative are ordered as their bits, whose maximum vectorises.
    for i in range(values.size):
        most = max(most, s.energy_bits[i])
    s.energy_bits[0] = most
    return float(s.energy[0])


@inlined
def _fill_shape(tau: float, g: Grid, phi: Array) -> None:
    """Fill the shape of a tau, over blocks of an even spacing by the decay within a block."""
    if g.step == 0.0:
        for i in range(phi.size):
            phi[i] = math.exp(-2.0 * tau * g.x[i]) * g.envelope[i]
        return
    decay = math.exp(-2.0 * tau * g.step)
    e2 = decay * decay
    e4 = e2 * e2
    powers = (1.0, decay, e2, decay * e2, e4, decay * e4, e2 * e4, decay * e2 * e4)
    factor = 1.0
    for start in range(0, phi.size, BLOCK):
        for i in range(BLOCK):
            phi[start + i] = factor * powers[i] * g.envelope[start + i]
        factor *= e4 * e4


@summing
def _sum_shape(g: Grid, s: Scratch) -> ShapeSums:
    """Return the sums of the shape over all bins."""
    q0 = q1 = q2 = p0 = p1 = p2 = p3 = p4 = c0 = c1 = c2 = f0 = y0 = y1 = y2 = 0.0
    for i in range(s.phi.size):
        x, phi, z = g.x[i], s.phi[i], s.z[i]
        shape = s.w[i] * phi
        square = shape * phi
        cube = square * phi
        xx = x * x
        q0 += shape
        q1 += shape * x
        q2 += shape * xx
        p0 += square
        p1 += square * x
        bend = square * xx
        p2 += bend
        p3 += bend * x
        p4 += bend * xx
        c0 += cube
        c1 += cube * x
        c2 += cube * xx
        f0 += cube * phi
        pull = shape * z
        y0 += pull
        y1 += pull * x
        y2 += pull * xx
    return ShapeSums((q0, q1, q2), (p0, p1, p2, p3, p4), (c0, c1, c2), f0, (y0, y1, y2))


@inlined
def evaluate(tau: float, g: Grid, s: Scratch, sums: Sums) -> Point:
    """Return the linear fit at one extinction, from one pass over the bins."""
    w0, free = sums.weight, sums.free
    _fill_shape(tau, g, s.phi)
    of_shape = _sum_shape(g, s)
    q0, q1, _ = of_shape.phi
    p0, p1, p2, _, _ = of_shape.square
    y0, y1, y2 = of_shape.value
    mean_phi, mean_z = q0 / w0, free * sums.value / w0
    norm = p0 - free * q0 * mean_phi
    centroid = (p1 - free * mean_phi * q1) / norm
    mean_slope = -2.0 * (q1 - centroid * q0) / w0
    along = y0 - mean_z * q0
    b = along / norm
    # Residuals have no product with level and shape.
    level = mean_z - free * b * mean_phi
    first = y1 - level * q1 - b * p1
    second = y2 - level * of_shape.phi[2] - b * p2
    rt, rh = -2.0 * first, 4.0 * (second - 2.0 * centroid * first)
    tt = 4.0 * (p2 - centroid * (2.0 * p1 - centroid * p0)) - free * w0 * mean_slope * mean_slope
    energy = sums.square - mean_z * sums.value - b * along
    gauss = b * b * tt
    curvature = gauss - rt * rt / norm - b * rh
    return Point(
        tau, level, b, mean_phi, mean_slope, centroid, norm, tt,
        b * rt, gauss, curvature, energy, of_shape,
    )  # fmt: skip


@inlined
def at(p: Point, level: float, b: float) -> Point:
    """Return a point with another background and amplitude."""
    return Point(
        p.tau, level, b, p.mean_phi, p.mean_slope, p.centroid, p.norm, p.slope_norm,
        p.gradient, p.gauss, p.curvature, p.energy, p.sums_of_shape,
    )  # fmt: skip
