"""Compiled projection of a profile on background and amplitude at one extinction.

Background and amplitude are linear, so that least squares of a homogeneous path is a problem in
extinction alone: the variable projection of `golub1973`.

Everything is scaled: ``x = (R - R_0) / L`` with the length L of the section, extinction as
``tau = extinction * L``, the shape ``phi = exp(-2 tau x) (R_0 / R)^2``, the power less a reference
and divided by a power of two, the weights divided by a power of two.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba
import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Integers, frozen
from lidarops.retrieve.common.compiled_code import inlined, summing

NODES: Final = 24
"""Extinctions of the search."""
_WIDEST_SCALE: Final = 0.3
BLOCK: Final = 8
"""Profiles are padded with unused bins to whole blocks, so that loops have no remainder."""
GROUP: Final = 4
"""The search runs on the bins of the first block and on sums over as many bins beyond."""


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
    group_shapes: Array
    """(2, node, group): phi averaged over groups of bins, and its square."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""
    noise_spacing: Integers
    """(profile or 1,): bins from one to the next of a second difference, which gives the noise."""


class Scratch(NamedTuple):
    """Arrays of one profile, (bin,) each but the last."""

    given: Array
    """Weights by the noise alone, 0 where it is not usable."""
    w: Array
    """Weights, 0 where the power is not usable either."""
    z: Array
    """Values, 0 where not usable."""
    phi: Array
    residual: Array
    groups: Array
    """(2, group): sums of weights, and of weights times values."""
    products: Array
    """(3, node)."""


class Sums(NamedTuple):
    """Weighted sums over a loaded profile."""

    bins: float
    weight: float
    value: float
    square: float
    """Of the squared values."""
    free: float
    """1 where the background is fitted, 0 where it is given."""


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


def make_grid(range_: Array, bounds: tuple[float, float], noise_spacing: Integers) -> Grid:
    """Return the tables common to the profiles of a call.

    Parameters
    ----------
    range_ : (bin,) float
        m, ascending.
    bounds : (float, float)
        Lowest and highest extinction, m-1.
    noise_spacing : (profile or 1,) int
        Bins; beyond it, noise is independent.
    """
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
    firsts = [*range(BLOCK), *range(BLOCK, x.size, GROUP)]
    real = (np.arange(x.size) < bins)[:, np.newaxis]
    shapes = np.exp(-2.0 * nodes * x[:, np.newaxis]) * envelope[:, np.newaxis] * real
    widths = np.maximum(np.add.reduceat(1.0 * real, firsts), 1.0)
    group_shapes = np.add.reduceat(shapes, firsts) / widths
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        nodes=nodes,
        first=first,
        spacing=(last - first) / (NODES - 1),
        scale=scale,
        shapes=np.ascontiguousarray([shapes.T, shapes.T**2]),
        group_shapes=np.ascontiguousarray([group_shapes.T, group_shapes.T**2]),
        start=float(range_[0]),
        length=length,
        noise_spacing=frozen(noise_spacing),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def make_scratch(g: Grid) -> Scratch:
    """Return the arrays of a profile."""
    bins = g.x.size
    return Scratch(
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros(bins),
        np.zeros((2, g.group_shapes.shape[2])),
        np.zeros((3, NODES)),
    )


@inlined
def power_of_two(value: float) -> float:
    """Return the power of two next above a value."""
    return math.ldexp(1.0, math.frexp(value)[1])


@summing
def weigh(noise: Array, is_variance: bool, s: Scratch) -> float:  # noqa: FBT001 - compiled
    """Fill the weights of a row of noise, and return their unit, a power of two."""
    total = 0.0
    for i in range(noise.size):
        weight = 1.0 / noise[i] if is_variance else noise[i]
        weight = weight if (weight > 0.0) & (weight < HUGE) else 0.0
        s.given[i] = weight
        total += weight
    unit: float = power_of_two(total / noise.size)
    for i in range(noise.size):
        s.given[i] *= 1.0 / unit
    return unit


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


@inlined
def largest_energy(w: Array, values: Array) -> float:
    """Return the largest weighted square of a profile."""
    a = b = c = d = 0.0
    # Four maxima side by side do not wait for each other.
    for i in range(0, w.size, 4):
        a = max(a, w[i] * values[i] * values[i])
        b = max(b, w[i + 1] * values[i + 1] * values[i + 1])
        c = max(c, w[i + 2] * values[i + 2] * values[i + 2])
        d = max(d, w[i + 3] * values[i + 3] * values[i + 3])
    return max(a, b, c, d)


@summing
def rescale(s: Scratch, factor: float) -> tuple[float, float]:
    """Scale a profile, and return the weighted sums of its values and of their squares."""
    total = squares = 0.0
    for i in range(s.z.size):
        s.z[i] *= factor
        weighted = s.w[i] * s.z[i]
        total += weighted
        squares += weighted * s.z[i]
    return total, squares


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
def _moments(g: Grid, s: Scratch) -> tuple[float, ...]:
    """Return the weighted sums of phi, phi^2 and phi z, each times 1, x and x^2."""
    q0 = q1 = q2 = p0 = p1 = p2 = y0 = y1 = y2 = 0.0
    for i in range(s.phi.size):
        x, phi, z = g.x[i], s.phi[i], s.z[i]
        shape = s.w[i] * phi
        lever = shape * x
        bend = lever * x
        q0 += shape
        q1 += lever
        q2 += bend
        p0 += shape * phi
        p1 += lever * phi
        p2 += bend * phi
        y0 += shape * z
        y1 += lever * z
        y2 += bend * z
    return q0, q1, q2, p0, p1, p2, y0, y1, y2


@inlined
def evaluate(tau: float, g: Grid, s: Scratch, sums: Sums) -> Point:
    """Return the linear fit at one extinction, from one pass over the bins."""
    w0, free = sums.weight, sums.free
    _fill_shape(tau, g, s.phi)
    q0, q1, q2, p0, p1, p2, y0, y1, y2 = _moments(g, s)
    mean_phi, mean_z = q0 / w0, free * sums.value / w0
    norm = p0 - free * q0 * mean_phi
    centroid = (p1 - free * mean_phi * q1) / norm
    mean_slope = -2.0 * (q1 - centroid * q0) / w0
    along = y0 - mean_z * q0
    b = along / norm
    # Residuals have no product with level and shape.
    level = mean_z - free * b * mean_phi
    first = y1 - level * q1 - b * p1
    second = y2 - level * q2 - b * p2
    rt, rh = -2.0 * first, 4.0 * (second - 2.0 * centroid * first)
    tt = 4.0 * (p2 - centroid * (2.0 * p1 - centroid * p0)) - free * w0 * mean_slope * mean_slope
    energy = sums.square - mean_z * sums.value - b * along
    gauss = b * b * tt
    curvature = gauss - rt * rt / norm - b * rh
    return Point(
        tau, level, b, mean_phi, mean_slope, centroid, norm, tt, b * rt, gauss, curvature, energy
    )


@inlined
def at(p: Point, level: float, b: float) -> Point:
    """Return a point with another background and amplitude."""
    return Point(
        p.tau,
        level,
        b,
        p.mean_phi,
        p.mean_slope,
        p.centroid,
        p.norm,
        p.slope_norm,
        p.gradient,
        p.gauss,
        p.curvature,
        p.energy,
    )


@summing
def mean_place(x: Array, w: Array, weight: float) -> float:
    """Return the weighted mean of x."""
    total = 0.0
    for i in range(x.size):
        total += w[i] * x[i]
    return total / weight


@summing
def total_of(values: Array) -> float:
    """Return the sum of an array."""
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total
