"""Compiled projection of a profile on background and amplitude at one extinction.

Background and amplitude are linear, so that least squares of a homogeneous path is a problem in
extinction alone: the variable projection of `golub1973`.

Everything is scaled: ``x = (R - R_0) / L`` with the length L of the section, extinction as
``tau = extinction * L``, the shape ``phi = exp(-2 tau x) (R_0 / R)^2``, the power less a reference
and divided by a power of two, the weights divided by a power of two.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.frozen_arrays import frozen

Array = npt.NDArray[np.float64]

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
# Forced inlining also saves reference counting of arrays passed between functions.
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
summing = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath=_SUMS)
finding = numba.njit(
    cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={*_SUMS, "nnan"}
)


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
    """(node, bin): phi of every node."""
    group_shapes: Array
    """(node, group): the same, averaged over groups of bins."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""
    noise_spacing: npt.NDArray[np.int64]
    """(profile or 1,): bins from one to the next of a second difference, which gives the noise."""


class ProjectionScratch(NamedTuple):
    z: Array
    w: Array
    phi: Array
    residual: Array
    used: Array
    fine: Array
    lengths: Array
    weights: Array
    """Sums over groups of bins."""
    values: Array


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
    curvature: float


_NEIGHBOURS: Final = np.ones(1, np.int64)


def make_grid(
    range_: Array,
    bounds: tuple[float, float],
    noise_spacing: npt.NDArray[np.int64] = _NEIGHBOURS,
) -> Grid:
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
    shapes = np.exp(-2.0 * nodes[:, np.newaxis] * x) * envelope
    groups = shapes
    if range_.size > _MOST_SINGLE:
        far = shapes[:, BLOCK:].reshape(NODES, -1, GROUPED).mean(axis=2)
        groups = np.concatenate([shapes[:, :BLOCK], far], axis=1)
    return Grid(
        x=x,
        envelope=envelope,
        step=step if uniform else 0.0,
        nodes=nodes,
        first=first,
        spacing=(last - first) / (NODES - 1),
        scale=scale,
        shapes=shapes,
        group_shapes=groups,
        start=float(range_[0]),
        length=length,
        noise_spacing=frozen(noise_spacing),
    )


@compiled
def make_scratch(n: int, groups: int) -> ProjectionScratch:
    return ProjectionScratch(
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(BLOCK),
        np.zeros(NODES),
        np.zeros(groups),
        np.zeros(groups),
    )


@finding
def largest_of(values: Array) -> float:
    largest = 0.0
    for i in range(values.size):
        largest = max(largest, abs(values[i]))
    return largest


@compiled
def power_of_two(value: float) -> float:
    return math.ldexp(1.0, math.frexp(value)[1])


@compiled
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


@compiled
def _shape(tau: float, x: Array, envelope: Array, step: float, phi: Array, fine: Array) -> None:
    n = phi.size
    if step == 0.0:
        for i in range(n):
            phi[i] = math.exp(-2.0 * tau * x[i]) * envelope[i]
        return
    # Two short geometric series instead of many exponentials: few roundings and no long chain.
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


@summing
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


@summing
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


@compiled
def evaluate(tau: float, g: Grid, s: ProjectionScratch, sums: tuple[float, float, float]) -> Point:
    w0, wz, free = sums
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
    return Point(
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
