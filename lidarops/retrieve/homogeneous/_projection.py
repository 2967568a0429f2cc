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

from lidarops.retrieve.common.arrays import Array, Integers, frozen

NODES: Final = 24
_WIDEST_SCALE: Final = 0.3
GROUPED: Final = 4
_MOST_SINGLE: Final = 128
"""Profiles with more bins are searched on the first `BLOCK` bins and on sums over groups of
`GROUPED` bins beyond."""
BLOCK: Final = 16
"""Profiles are padded with unused bins to whole blocks, so that loops have no remainder."""

# Reassociation lets sums vectorise; NaN and infinity keep their meaning. Functions that may be
# reassociated have to be inlined: see `lidarops.retrieve.background._shape_fit`.
_SUMS: Final = {"reassoc", "contract", "nsz"}
# Forced inlining lets functions share loops. Without the runtime they cannot allocate, and count no
# references to arrays, which takes longer than a loop.
_INLINED: Final[dict[str, Any]] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "forceinline": True,
}
_BARE: Final[dict[str, Any]] = {**_INLINED, "_nrt": False}
allocating = numba.njit(**_INLINED)
inlined = numba.njit(**_BARE)
fusing = numba.njit(**_BARE, fastmath={"contract"})
"""Compile a sum in the order of its terms, each added by one fused multiplication."""
summing = numba.njit(**_BARE, fastmath=_SUMS)
finding = numba.njit(**_BARE, fastmath={*_SUMS, "nnan"})


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
    """(2, bin, node): phi of every node, and its square."""
    group_shapes: Array
    """(2, group, node): phi averaged over groups of bins, and its square."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""
    noise_spacing: Integers
    """(profile or 1,): bins from one to the next of a second difference, which gives the noise."""


class ProjectionScratch(NamedTuple):
    given: Array
    """Weights by the noise alone, 0 where it is not usable."""
    rows: Array
    """(2, bin): weights, 0 where the power is not usable either, and weights times values."""
    w: Array
    """The first of them."""
    wz: Array
    """The second."""
    z: Array
    phi: Array
    shape: Array
    """phi, weighted."""
    square: Array
    """Its square, weighted."""
    signal: Array
    """phi times the weighted values."""
    lever: Array
    ones: Array
    residual: Array
    used: Array
    products: Array
    """(3, node)."""
    groups: Array
    """(2, group): sums of `rows` over groups of bins."""


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
    """The linear fit at one extinction, and the derivatives of its objective."""

    b: float
    mean_z: float
    mean_phi: float
    mean_t: float
    centroid: float
    norm: float
    slope_norm: float
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
    length = float(range_[-1] - range_[0]) if range_.size > 1 else 1.0
    x = (range_ - range_[0]) / length
    step = 1.0 / max(range_.size - 1, 1)
    rounding = 4.0 * np.finfo(np.float64).eps * range_[-1] / length
    uniform = bool(np.all(np.abs(x - step * np.arange(range_.size)) <= rounding))
    x = np.concatenate([x, np.ones(-range_.size % BLOCK)])
    lowest, highest = bounds[0] * length, bounds[1] * length
    # In a thin section the slope of the shape vanishes at tau = -L / R: nodes are finer there.
    scale = min(_WIDEST_SCALE, _WIDEST_SCALE * length / float(range_[0]))
    first, last = math.asinh(lowest / scale), math.asinh(highest / scale)
    nodes = scale * np.sinh(np.linspace(first, last, NODES))
    nodes[0], nodes[-1] = lowest, highest
    envelope = (range_[0] / (range_[0] + length * x)) ** 2
    shapes = np.exp(-2.0 * nodes * x[:, np.newaxis]) * envelope[:, np.newaxis]
    groups = shapes
    if range_.size > _MOST_SINGLE:
        far = shapes[BLOCK:].reshape(-1, GROUPED, NODES).mean(axis=1)
        groups = np.concatenate([shapes[:BLOCK], far])
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        nodes=nodes,
        first=first,
        spacing=(last - first) / (NODES - 1),
        scale=scale,
        shapes=np.stack([shapes, shapes**2]),
        group_shapes=np.stack([groups, groups**2]),
        start=float(range_[0]),
        length=length,
        noise_spacing=frozen(noise_spacing),
    )


@allocating
def make_scratch(g: Grid) -> ProjectionScratch:
    n, rows = g.x.size, np.zeros((2, g.x.size))
    return ProjectionScratch(
        np.zeros(n),
        rows,
        rows[0],
        rows[1],
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.ones(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros((3, NODES)),
        np.zeros((2, g.group_shapes.shape[1])),
    )


@finding
def largest_of(values: Array) -> float:
    """Return the largest absolute value of an array of whole blocks."""
    a = b = c = d = 0.0
    # Four maxima side by side do not wait for each other.
    step = values.size // 4
    second, third, fourth = values[step:], values[2 * step :], values[3 * step :]
    for i in range(step):
        a = max(a, abs(values[i]))
        b = max(b, abs(second[i]))
        c = max(c, abs(third[i]))
        d = max(d, abs(fourth[i]))
    return max(a, b, c, d)


@inlined
def power_of_two(value: float) -> float:
    return math.ldexp(1.0, math.frexp(value)[1])


@inlined
def scale_in_place(values: Array, factor: float) -> None:
    for i in range(values.size):
        values[i] *= factor


@summing
def product(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@summing
def total_of(values: Array) -> float:
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


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
    e8 = e4 * e4
    # Powers of the decay over the bins of half a block, each a product of the powers of two.
    powers = (1.0, decay, e2, decay * e2, e4, decay * e4, e2 * e4, decay * e2 * e4)
    factor = 1.0
    for start in range(0, phi.size, BLOCK):
        half = start + BLOCK // 2
        for i in range(BLOCK // 2):
            phi[start + i] = factor * powers[i] * g.envelope[start + i]
            phi[half + i] = factor * (powers[i] * e8) * g.envelope[half + i]
        factor *= e8 * e8


@fusing
def _in_lanes(a: Array, b: Array) -> float:
    """Return the product of two arrays of whole blocks, summed in eight lanes side by side."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
    for i in range(0, a.size, 8):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        s4 += a[i + 4] * b[i + 4]
        s5 += a[i + 5] * b[i + 5]
        s6 += a[i + 6] * b[i + 6]
        s7 += a[i + 7] * b[i + 7]
    return ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7))


@inlined
def _moments(term: Array, g: Grid, s: ProjectionScratch) -> tuple[float, float, float]:
    """Return the sums of an array, times 1, x and x^2."""
    for i in range(term.size):
        s.lever[i] = term[i] * g.x[i]
    return _in_lanes(term, s.ones), _in_lanes(s.lever, s.ones), _in_lanes(s.lever, g.x)


@inlined
def evaluate(tau: float, g: Grid, s: ProjectionScratch, sums: Sums) -> Point:
    """Return the linear fit at one extinction, from one pass over the bins."""
    w0, wz, free = sums.weight, sums.value, sums.free
    _fill_shape(tau, g, s.phi)
    for i in range(s.phi.size):
        s.shape[i] = s.phi[i] * s.w[i]
        s.square[i] = s.shape[i] * s.phi[i]
        s.signal[i] = s.phi[i] * s.wz[i]
    q0, q1, q2 = _moments(s.shape, g, s)
    p0, p1, p2 = _moments(s.square, g, s)
    y0, y1, y2 = _moments(s.signal, g, s)
    mean_phi, mean_z = free * q0 / w0, free * wz / w0
    norm = p0 - q0 * mean_phi
    # About the information centroid, amplitude and extinction are uncorrelated.
    centroid = (p1 - mean_phi * q1) / norm
    mean_t = -2.0 * free * (q1 - centroid * q0) / w0
    along = y0 - mean_phi * wz
    b = along / norm
    # Residuals have no product with level and shape.
    level = mean_z - b * mean_phi
    first = y1 - level * q1 - b * p1
    second = y2 - level * q2 - b * p2
    rt, rh = -2.0 * first, 4.0 * (second - 2.0 * centroid * first)
    tt = 4.0 * (p2 - centroid * (2.0 * p1 - centroid * p0)) - w0 * mean_t * mean_t
    return Point(
        b,
        mean_z,
        mean_phi,
        mean_t,
        centroid,
        norm,
        tt,
        b * rt,
        b * b * tt,
        b * b * tt - rt * rt / norm - b * rh,
        sums.square - mean_z * wz - b * along,
    )
