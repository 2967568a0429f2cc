r"""Least squares of the beams of a network: ln extinction at the crossings, and beam constants.

With the constant k of a beam, w_p = exp(k) + I_p + I_(p+1) + ... is the signal over extinction at
its passage p, so that ln extinction there is y_p = u_p - ln w_p. The equations are logarithmic,
because noise of the values is then additive. In rows that are linear in 1 / extinction, noise
multiplies the unknowns and biases long chains of rows.

Each pass linearises y in the constant, with g = exp(k) / w and the inverse W of the covariance of
y. M = W - W g g' W / (g' W g) is the information of a beam with its constant eliminated. The
crossings x follow from (sum A' M A + P) x = sum A' M y, where A selects the crossings of a beam
and P is the precision of the prior; then k changes by g' W (y - A x) / (g' W g).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network._condensed_signals import Beams
from lidarops.retrieve.network.thresholds import THRESHOLDS

_PASSES: Final = 24
_ROUNDING: Final = 1e-9


class Linear(NamedTuple):
    """Beams linearised about constants; of each profile, or of a mean that all profiles share."""

    value: Array
    """(profile, beam, passage) y, ln extinction."""
    turn: Array
    """(profile, beam, passage, 2 passage) derivatives of y by u and I."""
    information: Array
    """(profile, beam, passage, passage) M."""
    gain: Array
    """(profile, beam, passage) W g / (g' W g), derivative of the constant by y."""

    def normal(self, beams: Beams) -> tuple[Array, Array]:
        """Return normal matrices sum A' M A, and right sides sum A' M y."""
        normal = gathered(self.information @ beams.select, beams)
        side = self.information @ self.value[..., np.newaxis]
        return normal, gathered(side, beams)[..., 0]

    def sides(self, beams: Beams, change: Array) -> Array:
        """Return (profile, crossing, case) changes of right sides.

        `change` is the (profile, beam, 2 passage, case) change of u and I.
        """
        return gathered(self.information @ (self.turn @ change), beams)


def gathered(values: Array, beams: Beams) -> Array:
    """Return (profile, crossing, case) sums of (profile, beam, passage, case) values."""
    return np.tensordot(values, beams.select, ((1, 2), (0, 1))).swapaxes(1, 2)


def linearise(beams: Beams, constants: Array, reach: Indices) -> Linear:
    """Linearise the beams of each profile, or of a mean, about constants.

    The (profile or 1, beam) constants are ln w at the last passages of the beams, and `reach` the
    (profile or 1, beam) numbers of passages in use, at most those of the beams.
    """
    place = np.arange(beams.value.shape[2])
    inside, before = (place < reach[..., np.newaxis] - k for k in (0, 1))
    end = np.exp(constants)[..., np.newaxis]
    weight = end + beams.integral[..., ::-1].cumsum(axis=-1)[..., ::-1]
    value = np.where(inside, beams.value - np.log(weight), 0.0)
    by_integral = -np.triu(np.ones(2 * place.shape)) / weight[..., np.newaxis]
    # The integral behind the last passage in use is part of the constant.
    by_integral = by_integral * before[..., np.newaxis, :]
    unit = np.broadcast_to(np.eye(place.size), by_integral.shape)
    turn = np.concatenate([unit, by_integral], axis=-1) * inside[..., np.newaxis]
    covariance = turn @ beams.covariance @ turn.swapaxes(-1, -2)
    # Without a passage there is no equation; a little more keeps the others regular.
    extra = np.diagonal(covariance, axis1=-2, axis2=-1) * THRESHOLDS.smallest_pivot + ~inside
    inverse = np.linalg.inv(covariance + extra[..., np.newaxis] * np.eye(place.size))
    lever = np.where(inside, end / weight, 0.0)
    gain = (inverse @ lever[..., np.newaxis])[..., 0]
    known = np.maximum((lever * gain).sum(axis=-1, keepdims=True), np.finfo(float).tiny)
    both = inside[..., np.newaxis] & inside[..., np.newaxis, :]
    taken = gain[..., np.newaxis] * gain[..., np.newaxis, :] / known[..., np.newaxis]
    return Linear(value, turn, np.where(both, inverse - taken, 0.0), gain / known)


def start_constants(beams: Beams) -> Array:
    """Return (profile, beam) constants of homogeneous air.

    Along all beams of a profile, the fall of the signal over the integral is its extinction.
    """
    last = np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    end = np.take_along_axis(beams.value, last, axis=2)[..., 0]
    fall = -np.expm1(np.minimum(end, THRESHOLDS.largest_rise)).sum(axis=1, keepdims=True)
    level = np.log(
        np.maximum(fall, THRESHOLDS.least_fall) / beams.integral.sum(axis=(1, 2))[:, None]
    )
    return np.where((beams.reach > 1) & np.isfinite(level), end - level, 0.0)


class Solution(NamedTuple):
    """Logarithms of extinction of profiles that are solved each alone."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1."""
    covariance: Array
    """(profile, crossing, crossing)."""
    constants: Array
    """(profile, beam)."""
    linear: Linear
    settled: Booleans
    """(profile,) True where the last pass changed no logarithm of w."""


def fit_beams(beams: Beams, precision: Array) -> Solution:
    """Solve each profile by Gauss-Newton steps, with a precision of ln extinction by a prior."""
    # Each crossing is drawn to the level of the profile a little, where nothing else determines it.
    weak, number = THRESHOLDS.weak_precision, np.maximum(beams.reach.sum(axis=1), 1)
    precision, constants = precision + weak * np.eye(len(precision)), start_constants(beams)
    for left in reversed(range(_PASSES)):
        linear = linearise(beams, constants, beams.reach)
        normal, side = linear.normal(beams)
        level = linear.value.sum(axis=(1, 2)) / number
        covariance = np.linalg.inv(normal + precision)
        x = (covariance @ (side + weak * level[:, np.newaxis])[..., np.newaxis])[..., 0]
        change, moved = step(beams, linear, x, constants)
        if left == 0 or not np.any(moved > _ROUNDING):
            break
        constants = constants + change
    return Solution(x, np.asarray(covariance), constants, linear, moved < THRESHOLDS.converged_step)


def step(beams: Beams, linear: Linear, x: Array, constants: Array) -> tuple[Array, Array]:
    """Return changes of constants towards a field, and the (profile,) largest ones of ln w."""
    apart = linear.value - x[:, beams.crossing]
    step = (linear.gain * apart).sum(axis=2)
    step = np.clip(step, -THRESHOLDS.longest_step, THRESHOLDS.longest_step)
    moved = np.abs(step) * np.exp(constants + linear.value[..., 0] - beams.value[..., 0])
    return step, moved.max(axis=1, initial=0.0)


# Tests -------------------------------------------------------------------------------------------


def compare(beams: Beams, linear: Linear, x: Array, reach: Indices) -> tuple[Array, Array]:
    """Return (profile, 2) chi-squares, and their degrees of freedom.

    They are those of the beams alone, at their own best field, and about a field.
    """
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    residual = np.where(inside, linear.value - x[:, beams.crossing], 0.0)[..., np.newaxis]
    weighted = linear.information @ residual
    about = (weighted * residual).sum(axis=(1, 2, 3))
    normal, side = gathered(linear.information @ beams.select, beams), gathered(weighted, beams)
    # Directions that no beam determines have no side: a little information there does not count.
    size = np.diagonal(normal, axis1=1, axis2=2).max(axis=1)[:, np.newaxis, np.newaxis]
    little = np.where(size > 0.0, _ROUNDING * size, 1.0) * np.eye(normal.shape[1])
    taken = (side * np.linalg.solve(normal + little, side)).sum(axis=(1, 2))
    spare = reach.sum(axis=1) - (reach > 0).sum(axis=1)
    freedom = np.stack([spare - seen(beams, reach).sum(axis=1), spare], axis=1)
    return np.stack([about - taken, about], axis=1), freedom.astype(np.float64)


def seen(beams: Beams, reach: Indices) -> Booleans:
    """Return (profile, crossing) whether a passage in use is there."""
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    return np.asarray(gathered(inside[..., np.newaxis].astype(np.float64), beams)[..., 0] > 0.0)
