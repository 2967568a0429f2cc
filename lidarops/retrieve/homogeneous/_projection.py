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
"""Profiles are padded with unused bins to whole blocks, so that loops have no remainder."""
_RUNS: Final = 16
"""The search runs on the bins of the first block, and on sums over so many runs of blocks beyond.
"""


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
    point_shapes: Array
    """(2, node, point): phi at the points of the search, and its square."""
    width: int
    """Bins of a run."""
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


class Residuals(NamedTuple):
    """Weighted sums of residuals, times powers of phi and of x."""

    energy: float
    level: float
    shape: float
    lever: float
    bend: float
    square: float


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
    explained: float
    """Energy by which the fit changed residuals about a former one."""
    shapes: ShapeSums
    residuals: Residuals
    """Of the fit."""


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
    width = BLOCK * max(-(-(x.size - BLOCK) // (BLOCK * _RUNS)), 1)
    firsts = [*range(BLOCK), *range(BLOCK, x.size, width)]
    real = (np.arange(x.size) < bins)[:, np.newaxis]
    shapes = np.exp(-2.0 * nodes * x[:, np.newaxis]) * envelope[:, np.newaxis] * real
    widths = np.maximum(np.add.reduceat(1.0 * real, firsts), 1.0)
    points = np.add.reduceat(shapes, firsts) / widths
    points = np.pad(points, ((0, -len(points) % BLOCK), (0, 0)))
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        nodes=nodes,
        first=first,
        spacing=(last - first) / (NODES - 1),
        scale=scale,
        shapes=np.ascontiguousarray([shapes.T, shapes.T**2]),
        point_shapes=np.ascontiguousarray([points.T, points.T**2]),
        width=width,
        start=float(range_[0]),
        length=length,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def make_scratch(g: Grid) -> Scratch:
    """Return the arrays of a profile."""
    n = g.x.size
    given, w, z, phi = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    residual, energy = np.zeros(n), np.zeros(n)
    points, explained = np.zeros((2, g.point_shapes.shape[2])), np.zeros(NODES)
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
def load(
    power: Any, reference: float, factor: float, g: Grid, s: Scratch
) -> tuple[float, float, float, float, float, float]:
    """Copy a profile less its reference times a factor, 0 where not usable.

    Returns the number of usable bins, the sum of their absolute values, their weight, and the
    weighted sums of x, of the values and of their squares.
    """
    count = size = total = place = values = squares = 0.0
    for i in range(power.size):
        value = np.float64(power[i])
        usable = (abs(value) < HUGE) & (s.given[i] > 0.0)
        w = s.given[i] if usable else 0.0
        z = (value - reference) * factor if usable else 0.0
        s.w[i], s.z[i] = w, z
        count += 1.0 if usable else 0.0
        size += abs(z)
        total += w
        place += w * g.x[i]
        values += w * z
        squares += w * z * z
    return count, size, total, place, values, squares


@summing
def _sum_run(w: Array, z: Array) -> tuple[float, float]:
    weight = value = 0.0
    for i in range(w.size):
        weight += w[i]
        value += w[i] * z[i]
    return weight, value


@inlined
def sum_points(g: Grid, s: Scratch) -> None:
    """Fill the points of the search."""
    for k in range(BLOCK):
        s.points[0, k], s.points[1, k] = s.w[k], s.w[k] * s.z[k]
    for k in range(BLOCK, s.points.shape[1]):
        run = slice(BLOCK + (k - BLOCK) * g.width, BLOCK + (k - BLOCK + 1) * g.width)
        s.points[0, k], s.points[1, k] = _sum_run(s.w[run], s.z[run])


@summing
def weigh_squares(s: Scratch) -> None:
    """Fill the weighted squares of the values."""
    for i in range(s.z.size):
        s.energy[i] = s.w[i] * s.z[i] * s.z[i]


@summing
def largest_energy(s: Scratch) -> float:
    """Return the largest weighted square."""
    most = np.int64(0)
    # Floats that are not negative are ordered as their bits, whose maximum vectorises.
    for i in range(s.energy.size):
        most = max(most, s.energy_bits[i])
    s.energy_bits[0] = most
    return float(s.energy[0])


@inlined
def fill_shape(tau: float, g: Grid, phi: Array) -> None:
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
def sum_shape(g: Grid, s: Scratch, sums: Sums) -> tuple[ShapeSums, Residuals]:
    """Return what the first step needs of `_sum_bins` about zero."""
    q0 = q1 = q2 = p0 = p1 = p2 = y0 = y1 = y2 = 0.0
    for i in range(s.phi.size):
        x, phi = g.x[i], s.phi[i]
        xx, shape = x * x, s.w[i] * phi
        square, pull = shape * phi, shape * s.z[i]
        q0 += shape
        q1 += shape * x
        q2 += shape * xx
        p0 += square
        p1 += square * x
        p2 += square * xx
        y0 += pull
        y1 += pull * x
        y2 += pull * xx
    shapes = ShapeSums((q0, q1, q2), (p0, p1, p2, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
    return shapes, Residuals(sums.square, sums.value, y0, y1, y2, 0.0)


@summing
def _sum_bins(level: float, b: float, g: Grid, s: Scratch) -> tuple[ShapeSums, Residuals]:
    """Fill residuals and their weighted squares; return their sums and those of the shape."""
    q0 = q1 = q2 = p0 = p1 = p2 = p3 = p4 = c0 = c1 = c2 = f0 = 0.0
    energy = r0 = r1 = y0 = y1 = y2 = 0.0
    for i in range(s.phi.size):
        x, phi = g.x[i], s.phi[i]
        residual = s.z[i] - level - b * phi
        weighted = s.w[i] * residual
        s.residual[i], s.energy[i] = residual, weighted * residual
        energy += weighted * residual
        r0 += weighted
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
        pull = shape * residual
        r1 += pull * phi
        y0 += pull
        y1 += pull * x
        y2 += pull * xx
    shapes = ShapeSums((q0, q1, q2), (p0, p1, p2, p3, p4), (c0, c1, c2), f0)
    return shapes, Residuals(energy, r0, y0, y1, y2, r1)


@inlined
def evaluate(tau: float, level: float, b: float, g: Grid, s: Scratch, sums: Sums) -> Point:
    """Return the linear fit at one extinction, from one pass over the bins.

    The residuals are those about a given background and amplitude, of which the fit is a change.
    """
    fill_shape(tau, g, s.phi)
    shapes, residuals = _sum_bins(level, b, g, s)
    p: Point = fit_linear(tau, level, b, shapes, residuals, sums)
    return p


@inlined
def fit_linear(
    tau: float, level: float, b: float, shapes: ShapeSums, r: Residuals, sums: Sums
) -> Point:
    """Return the linear fit by the sums of residuals about a given background and amplitude."""
    w0, free = sums.weight, sums.free
    q0, q1, q2 = shapes.phi
    p0, p1, p2, _, _ = shapes.square
    mean_phi, mean = q0 / w0, free * r.level / w0
    norm = p0 - free * q0 * mean_phi
    centroid = (p1 - free * mean_phi * q1) / norm
    mean_slope = -2.0 * (q1 - centroid * q0) / w0
    along = r.shape - mean * q0
    step = along / norm
    rise = mean - free * step * mean_phi
    left = Residuals(
        r.energy - mean * r.level - step * along,
        r.level - rise * w0 - step * q0,
        r.shape - rise * q0 - step * p0,
        r.lever - rise * q1 - step * p1,
        r.bend - rise * q2 - step * p2,
        r.square - rise * p0 - step * shapes.cube[0],
    )
    b += step
    # The residuals of the fit have no product with level and shape.
    rt, rh = -2.0 * left.lever, 4.0 * (left.bend - 2.0 * centroid * left.lever)
    tt = 4.0 * (p2 - centroid * (2.0 * p1 - centroid * p0)) - free * w0 * mean_slope * mean_slope
    gauss = b * b * tt
    curvature = gauss - rt * rt / norm - b * rh
    return Point(
        tau, level + rise, b, mean_phi, mean_slope, centroid, norm, tt,
        b * rt, gauss, curvature, r.energy - left.energy, shapes, left,
    )  # fmt: skip
