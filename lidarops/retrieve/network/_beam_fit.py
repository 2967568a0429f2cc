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

import math
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.network._condensed_signals import Beams
from lidarops.retrieve.network.thresholds import THRESHOLDS

_PASSES: Final = 24
_ROUNDING: Final = 1e-9
_PIVOT: Final = 1e-13
"""Smallest pivot of a regular matrix over its diagonal."""
_TINY: Final = float(np.finfo(float).tiny)


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
        return _normal_equations(self.information, self.value, beams)[:2]

    def sides(self, beams: Beams, change: Array) -> Array:
        """Return (profile, crossing, case) changes of right sides.

        `change` is the (profile, beam, 2 passage, case) change of u and I.
        """
        return gathered(self.information @ (self.turn @ change), beams)


def gathered(values: Array, beams: Beams) -> Array:
    """Return (profile, crossing, case) sums of (profile, beam, passage, case) values."""
    select = beams.select.reshape(-1, beams.select.shape[2])
    return np.asarray(select.T @ values.reshape(len(values), len(select), -1))


def linearise(beams: Beams, constants: Array, reach: Indices) -> Linear:
    """Linearise the beams of each profile, or of a mean, about constants.

    The (profile or 1, beam) constants are ln w at the last passages of the beams, and `reach` the
    (profile or 1, beam) numbers of passages in use, at most those of the beams.
    """
    shape = max(len(beams.value), len(constants), len(reach)), *beams.value.shape[1:]
    most = shape[2]
    out = (
        np.zeros(shape), np.zeros((*shape, 2 * most)), np.zeros((*shape, most)), np.zeros(shape)
    )  # fmt: skip
    _linearise(beams[:3], constants, reach, out)
    return Linear(*out)


@compiled
def _linearise(
    signals: tuple[Array, Array, Array],
    constants: Array,
    reach: Indices,
    out: tuple[Array, Array, Array, Array],
) -> None:
    """Fill `Linear`, 0 where a passage is not in use."""
    (values, integrals, covariances), (value, turn, information, gain) = signals, out
    most = values.shape[2]
    weight, lever, half = np.empty(most), np.empty(most), np.empty((most, 2 * most))
    for t in range(len(value)):
        of_beam, of_constant, of_reach = (
            min(t, len(values) - 1), min(t, len(constants) - 1), min(t, len(reach) - 1)
        )  # fmt: skip
        for b in range(value.shape[1]):
            size, covariance = reach[of_reach, b], covariances[of_beam, b]
            matrix, levered = information[t, b, :size, :size], gain[t, b]
            total = end = math.exp(constants[of_constant, b])
            for p in range(most - 1, -1, -1):
                total += integrals[of_beam, b, p]
                weight[p], lever[p] = total, end / total
            for p in range(size):
                value[t, b, p] = values[of_beam, b, p] - math.log(weight[p])
                turn[t, b, p, p] = 1.0
                # The integral behind the last passage in use is part of the constant.
                turn[t, b, p, most + p : most + size - 1] = -1.0 / weight[p]
            _carry(covariance, weight, size, half)
            _carry(half.T, weight, size, matrix)
            for p in range(size):
                # A little more keeps it regular.
                matrix[p, p] *= 1.0 + _PIVOT
            invert(matrix)
            known = 0.0
            for p in range(size):
                for q in range(size):
                    levered[p] += matrix[p, q] * lever[q]
                known += lever[p] * levered[p]
            known = max(known, _TINY)
            for p in range(size):
                for q in range(size):
                    matrix[p, q] -= levered[p] * levered[q] / known
            levered /= known


@compiled
def _carry(covariance: Array, weight: Array, size: int, out: Array) -> None:
    """Fill rows of y from the rows of u and I."""
    most = len(weight)
    for k in range(out.shape[1]):
        behind = 0.0
        for p in range(size - 1, -1, -1):
            if p < size - 1:
                behind += covariance[most + p, k]
            out[p, k] = covariance[p, k] - behind / weight[p]


@compiled
def invert(matrix: Array) -> None:
    """Invert a positive definite matrix in place."""
    size = len(matrix)
    for k in range(size):
        pivot, matrix[k, k] = 1.0 / matrix[k, k], 1.0
        for j in range(size):
            matrix[k, j] *= pivot
        for i in range(size):
            if i != k:
                factor, matrix[i, k] = matrix[i, k], 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[k, j]


def _normal_equations(information: Array, value: Array, beams: Beams) -> tuple[Array, Array, Array]:
    """Return sum A' M A, sum A' M y and y' M y of each profile."""
    crossings = beams.select.shape[2]
    profiles = len(value)
    out = (
        np.zeros((profiles, crossings, crossings)),
        np.zeros((profiles, crossings)),
        np.zeros(profiles),
    )
    _add_beams(information, value, beams.crossing, out)
    return out


@compiled
def _add_beams(
    information: Array, value: Array, crossing: Indices, out: tuple[Array, Array, Array]
) -> None:
    """Add normal matrices, right sides and squares of all beams."""
    normal, side, square = out
    for t in range(len(value)):
        for b in range(value.shape[1]):
            for p in range(value.shape[2]):
                along, row = 0.0, crossing[b, p]
                for q in range(value.shape[2]):
                    normal[t, row, crossing[b, q]] += information[t, b, p, q]
                    along += information[t, b, p, q] * value[t, b, q]
                side[t, row] += along
                square[t] += along * value[t, b, p]


def start_constants(beams: Beams) -> Array:
    """Return (profile, beam) constants of homogeneous air.

    Along all beams of a profile, the fall of the signal over the integral is its extinction.
    """
    last = np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    end = np.take_along_axis(beams.value, last, axis=2)[..., 0]
    fall = -np.expm1(end).sum(axis=1, keepdims=True)
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
    residual = np.where(inside, linear.value - x[:, beams.crossing], 0.0)
    normal, side, about = _normal_equations(linear.information, residual, beams)
    # Directions that no beam determines have no side: a little information there does not count.
    size = np.diagonal(normal, axis1=1, axis2=2).max(axis=1)[:, np.newaxis, np.newaxis]
    little = np.where(size > 0.0, _ROUNDING * size, 1.0) * np.eye(normal.shape[1])
    solved = np.linalg.solve(normal + little, side[..., np.newaxis])[..., 0]
    taken = (side * solved).sum(axis=1)
    spare = reach.sum(axis=1) - (reach > 0).sum(axis=1)
    freedom = np.stack([spare - seen(beams, reach).sum(axis=1), spare], axis=1)
    return np.stack([about - taken, about], axis=1), freedom.astype(np.float64)


def seen(beams: Beams, reach: Indices) -> Booleans:
    """Return (profile, crossing) whether a passage in use is there."""
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    return np.asarray(gathered(inside[..., np.newaxis].astype(np.float64), beams)[..., 0] > 0.0)
