r"""Least squares of the beams of a network: ln extinction at the crossings, and beam constants.

With the constant k of a beam, w_p = exp(k) + I_p + I_(p+1) + ... is the signal over extinction at
its passage p, so that ln extinction there is y_p = u_p - ln w_p. The equations are logarithmic,
because noise of the values is then additive. In rows that are linear in 1 / extinction, noise
multiplies the unknowns and biases long chains of rows.

Each pass linearises y in the constant, with g = exp(k) / w and the inverse W of the covariance of
y. M = W - W g g' W / (g' W g) is the information of a beam with its constant eliminated. The
crossings x follow from (sum A' M A + P) x = sum A' M y, where A selects the crossings of a beam
and P is the precision of the prior; then k changes by g' W (y - A x) / (g' W g).

Libraries share large products and factors between threads, with other last digits for each number
of them. The loops for small matrices do not, and take less time than a call of a library for each.
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
_CONSTANT_PASSES: Final = 3
_ROUNDING: Final = 1e-9
_SWEEPS: Final = 30
_SMALLEST_ROTATION: Final = 1e-15
"""Elements beside the diagonal over the sum of those on it, below which they are zero."""


# Small matrices ----------------------------------------------------------------------------------


def product(a: Array, b: Array) -> Array:
    """Return products of (..., row, inner) and (..., inner, column) matrices."""
    shape = a.shape[:-2]
    if shape != b.shape[:-2]:
        shape = np.broadcast_shapes(shape, b.shape[:-2])
        a, b = (np.broadcast_to(each, (*shape, *each.shape[-2:])) for each in (a, b))
    out = np.zeros((math.prod(shape), a.shape[-2], b.shape[-1]))
    _multiply(
        np.ascontiguousarray(a).reshape(-1, *a.shape[-2:]) if out.size else out,
        np.ascontiguousarray(b).reshape(-1, *b.shape[-2:]) if out.size else out,
        out,
    )
    return out.reshape(*shape, *out.shape[1:])


def inverse(matrices: Array) -> Array:
    """Return inverses of (..., row, row) positive definite matrices; NaN of others."""
    return inverse_and_determinant(matrices)[0]


def inverse_and_determinant(matrices: Array) -> tuple[Array, Array]:
    """Return inverses of (..., row, row) positive definite matrices, and (...) ln determinants.

    Both are NaN of other matrices.
    """
    flat = np.ascontiguousarray(matrices).reshape(-1, *matrices.shape[-2:])
    out, logarithm = np.empty(flat.shape), np.empty(len(flat))
    _invert_all(flat, out, logarithm)
    return out.reshape(matrices.shape), logarithm.reshape(matrices.shape[:-2])


def eigenvectors(matrices: Array) -> tuple[Array, Array]:
    """Return (..., mode) eigenvalues and (..., row, mode) eigenvectors of symmetric matrices.

    By Jacobi rotations, until all elements beside the diagonal are zero.
    """
    rotated = np.ascontiguousarray(matrices).reshape(-1, *matrices.shape[-2:]).copy()
    vectors = np.zeros(rotated.shape)
    _diagonalise(rotated, vectors)
    size = np.diagonal(rotated, axis1=1, axis2=2).reshape(matrices.shape[:-1])
    return size, vectors.reshape(matrices.shape)


@compiled
def add_product(factor: float, a: Array, b: Array, out: Array) -> None:
    """Add a multiple of the product of two matrices."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            share = factor * a[i, k]
            for j in range(b.shape[1]):
                out[i, j] += share * b[k, j]


@compiled
def _multiply(a: Array, b: Array, out: Array) -> None:
    for n in range(a.shape[0]):
        add_product(1.0, a[n], b[n], out[n])


@compiled
def factorise(matrix: Array) -> float:
    """Overwrite a lower triangle by its Cholesky factor; return ln determinant, NaN if none."""
    logarithm = 0.0
    for i in range(matrix.shape[0]):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i != j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 0.0:
                matrix[i, i] = math.sqrt(total)
                logarithm += math.log(total)
            else:
                return math.nan
    return logarithm


@compiled
def invert(matrix: Array, out: Array, work: Array) -> float:
    """Fill the inverse of a positive definite matrix; return ln determinant. Both NaN if none."""
    size = matrix.shape[0]
    work[:], out[:] = matrix, 0.0
    logarithm = factorise(work)
    if math.isnan(logarithm):
        out[:] = math.nan
        return logarithm
    for i in range(size):
        # Below the diagonal, the triangle becomes its inverse.
        for j in range(i):
            share = 0.0
            for k in range(j, i):
                share += work[i, k] * work[k, j]
            work[i, j] = -share / work[i, i]
        work[i, i] = 1.0 / work[i, i]
    for k in range(size):
        for i in range(k + 1):
            for j in range(i + 1):
                out[i, j] += work[k, i] * work[k, j]
    for i in range(size):
        for j in range(i):
            out[j, i] = out[i, j]
    return logarithm


@compiled
def _invert_all(matrices: Array, out: Array, logarithm: Array) -> None:
    work = np.empty(matrices.shape[1:])
    for n in range(matrices.shape[0]):
        logarithm[n] = invert(matrices[n], out[n], work)


@compiled
def _diagonalise(matrices: Array, vectors: Array) -> None:
    """Diagonalise symmetric matrices by Jacobi rotations, in place."""
    for n in range(matrices.shape[0]):
        matrix, vector, limit = matrices[n], vectors[n], 0.0
        size = matrix.shape[0]
        for p in range(size):
            vector[p, p] = 1.0
            limit += _SMALLEST_ROTATION * abs(matrix[p, p])
        for _ in range(_SWEEPS):
            rotations = 0
            for p in range(size - 1):
                for q in range(p + 1, size):
                    if abs(matrix[p, q]) > limit:
                        _rotate(matrix, vector, p, q)
                        rotations += 1
            if rotations == 0:
                break


@compiled
def _rotate(matrix: Array, vectors: Array, p: int, q: int) -> None:
    """Make one element beside the diagonal zero."""
    ratio = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
    tangent = 1.0 / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
    tangent = tangent if ratio >= 0.0 else -tangent
    cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(matrix.shape[0]):
        for each in (matrix, vectors):
            a, b = each[k, p], each[k, q]
            each[k, p], each[k, q] = cosine * a - sine * b, sine * a + cosine * b
    for k in range(matrix.shape[0]):
        a, b = matrix[p, k], matrix[q, k]
        matrix[p, k], matrix[q, k] = cosine * a - sine * b, sine * a + cosine * b
    matrix[p, q] = matrix[q, p] = 0.0


# Sums over the beams of a crossing ---------------------------------------------------------------


def normal_matrix(information: Array, beams: Beams) -> Array:
    """Return (profile, crossing, crossing) sum A' M A."""
    out = np.zeros((len(information), beams.crossings, beams.crossings))
    _gather_squares(information, beams.crossing, out)
    return out


def gathered(values: Array, beams: Beams) -> Array:
    """Return (profile, crossing, case) sums of (profile, beam, passage, case) values."""
    out = np.zeros((len(values), beams.crossings, values.shape[3]))
    _gather(np.ascontiguousarray(values), beams.crossing, out)
    return out


@compiled
def _gather(values: Array, place: Indices, out: Array) -> None:
    for n in range(values.shape[0]):
        for b in range(place.shape[0]):
            for i in range(place.shape[1]):
                for j in range(values.shape[3]):
                    out[n, place[b, i], j] += values[n, b, i, j]


@compiled
def _gather_squares(matrices: Array, place: Indices, out: Array) -> None:
    for n in range(matrices.shape[0]):
        for b in range(place.shape[0]):
            for i in range(place.shape[1]):
                for j in range(place.shape[1]):
                    out[n, place[b, i], place[b, j]] += matrices[n, b, i, j]


# Beams about constants ---------------------------------------------------------------------------


class Linear(NamedTuple):
    """Beams linearised about constants."""

    value: Array
    """(profile, beam, passage) y, ln extinction."""
    turn: Array
    """(profile, beam, passage, 2 passage) derivatives of y by u and I."""
    information: Array
    """(profile, beam, passage, passage) M."""
    gain: Array
    """(profile, beam, passage) W g / (g' W g), derivative of the constant by y."""

    @classmethod
    def empty(cls, profiles: int, beams: int, most: int) -> Linear:
        """Return arrays to fill."""
        shape = profiles, beams, most
        return cls(
            np.zeros(shape), np.zeros((*shape, 2 * most)), np.zeros((*shape, most)), np.zeros(shape)
        )

    def normal(self, beams: Beams) -> tuple[Array, Array]:
        """Return normal matrix sum A' M A, and right side sum A' M y, of each profile."""
        side = product(self.information, self.value[..., np.newaxis])
        return normal_matrix(self.information, beams), gathered(side, beams)[..., 0]

    def sides(self, beams: Beams, change: Array) -> Array:
        """Return (profile, crossing, case) changes of right sides.

        `change` is the (profile, beam, 2 passage, case) change of u and I.
        """
        return gathered(product(self.information, product(self.turn, change)), beams)


@compiled
def _linearise_beam(
    signal: tuple[Array, Array, Array], constant: float, reach: int,
    out: tuple[Array, Array, Array, Array], work: Array,
) -> None:  # fmt: skip
    """Fill y, its derivatives, M and the gain of one beam; 0 where it has no two passages."""
    (u, integral, noise), (value, turn, information, gain) = signal, out
    value[:], gain[:], turn[:], information[:] = 0.0, 0.0, 0.0, 0.0
    if reach < 2:
        return
    most, weight = u.size, math.exp(constant)
    lever, scale, carried = np.empty(reach), np.empty(reach), np.empty(2 * most)
    for p in range(most - 1, -1, -1):
        weight += integral[p]
        if p >= reach:
            continue
        value[p] = u[p] - math.log(weight)
        turn[p, p] = 1.0
        # The integral behind the last passage in use is part of the constant.
        turn[p, most + p : most + reach - 1] = -1.0 / weight
        lever[p] = 1.0 / weight
    lever /= lever[reach - 1]
    correlation, inverse = work[0, :reach, :reach], work[1, :reach, :reach]
    for p in range(reach):
        carried[:] = noise[p]
        for i in range(most + p, most + reach - 1):
            carried += turn[p, i] * noise[i]
        for q in range(p + 1):
            correlation[p, q] = (carried * turn[q]).sum()
        scale[p] = math.sqrt(correlation[p, p]) if correlation[p, p] > 0.0 else 1.0
    for p in range(reach):
        for q in range(p + 1):
            correlation[p, q] /= scale[p] * scale[q]
        correlation[p, p] += THRESHOLDS.smallest_pivot
    invert(correlation, inverse, work[2, :reach, :reach])
    known = 0.0
    for p in range(reach):
        for q in range(reach):
            inverse[p, q] /= scale[p] * scale[q]
            gain[p] += inverse[p, q] * lever[q]
        known += lever[p] * gain[p]
    for p in range(reach):
        for q in range(reach):
            information[p, q] = inverse[p, q] - gain[p] * gain[q] / known
    gain[:reach] /= known


@compiled
def _linearise(
    signals: tuple[Array, Array, Array], constants: Array, reach: Indices,
    out: tuple[Array, Array, Array, Array],
) -> None:  # fmt: skip
    """Linearise beams about constants; signals and constants may be those of one mean."""
    value, turn, information, gain = out
    u, integral, noise = signals
    work = np.empty((3, u.shape[2], u.shape[2]))
    for t in range(reach.shape[0]):
        n = t if u.shape[0] > 1 else 0
        for b in range(reach.shape[1]):
            filled = value[t, b], turn[t, b], information[t, b], gain[t, b]
            if n < t and reach[t, b] == reach[t - 1, b]:
                filled[0][:], filled[1][:] = value[t - 1, b], turn[t - 1, b]
                filled[2][:], filled[3][:] = information[t - 1, b], gain[t - 1, b]
            else:
                signal = u[n, b], integral[n, b], noise[n, b]
                _linearise_beam(signal, constants[n, b], reach[t, b], filled, work)


def linearise(beams: Beams, constants: Array, reach: Indices | None = None) -> Linear:
    """Linearise beams about constants.

    Parameters
    ----------
    beams : Beams
        Of each profile, or of one mean.
    constants : (profile or 1, beam) float64
        ln w at the last passage of each beam.
    reach : (profile, beam) intp, optional
        Number of passages in use, at most those of the beams.
    """
    reach = beams.reach if reach is None else np.minimum(reach, beams.reach)
    out = Linear.empty(len(reach), reach.shape[1], beams.value.shape[2])
    _linearise(beams[:3], constants, reach, out[:])
    return out


def start_constants(beams: Beams, lengths: Array) -> Array:
    """Return (profile, beam) constants of homogeneous air.

    Along all beams of a profile, the fall of the signal over the integral is its extinction.
    `lengths` are the (beam, passage) exponents times distances from the first passage, in m.
    """
    place = np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    usable = beams.reach > 1
    end = np.take_along_axis(beams.value, place, axis=2)[..., 0]
    fall = np.where(usable, -np.expm1(np.minimum(end, THRESHOLDS.thickest_beam)), 0.0)
    total = np.where(usable, beams.integral.sum(axis=2), 0.0)
    length = lengths[np.arange(len(lengths)), place[..., 0]]
    with np.errstate(all="ignore"):
        extinction = fall.sum(axis=1, keepdims=True) / total.sum(axis=1, keepdims=True)
        depths = 2.0 * extinction * length
        depths = np.fmin(np.fmax(depths, THRESHOLDS.thinnest_beam), THRESHOLDS.thickest_beam)
        constants = np.log(total / np.expm1(depths))
    return np.where(usable & np.isfinite(constants), constants, 0.0)


def constants_of(beams: Beams, x: Array) -> Array:
    """Return (profile, beam) constants that agree best with (profile, crossing) ln extinction."""
    along, last = x[:, beams.crossing], np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    constants = np.take_along_axis(beams.value - along, last, axis=2)[..., 0]
    for _ in range(_CONSTANT_PASSES):
        linear = linearise(beams, constants)
        step = (linear.gain * (linear.value - along)).sum(axis=2)
        constants = constants + np.clip(step, -THRESHOLDS.longest_step, THRESHOLDS.longest_step)
    return constants


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


def fit_beams(beams: Beams, precision: Array, constants: Array) -> Solution:
    """Solve each profile by Gauss-Newton steps of its constants.

    Parameters
    ----------
    beams : Beams
    precision : (crossing, crossing) float64
        Of the prior of ln extinction.
    constants : (profile, beam) float64
        Where to start.
    """
    profiles, number = beams.reach.shape
    constants, size = constants.copy(), beams.crossings
    linear = Linear.empty(profiles, number, beams.value.shape[2])
    x, covariance = np.empty((profiles, size)), np.empty((profiles, size, size))
    step = np.empty(profiles)
    # Each crossing is drawn to the level of the profile a little, where nothing else determines it.
    precision = precision + THRESHOLDS.weak_precision * np.eye(size)
    _fit(beams[:5], precision, constants, linear[:], (x, covariance, step))
    return Solution(x, covariance, constants, linear, step < THRESHOLDS.converged_step)


@compiled
def _fit(
    beams: tuple[Array, Array, Array, Indices, Indices], precision: Array, constants: Array,
    linear: tuple[Array, Array, Array, Array], out: tuple[Array, Array, Array],
) -> None:  # fmt: skip
    """Solve each profile; `out` are ln extinction, its covariance, and the last step of ln w."""
    (u, integral, noise, reach, crossing), (x, covariance, step) = beams, out
    value, turn, information, gain = linear
    most, size = u.shape[2], precision.shape[0]
    work, factor = np.empty((3, most, most)), np.empty((size, size))
    for n in range(u.shape[0]):
        largest = math.inf
        for _ in range(_PASSES):
            normal, side, level, number = precision.copy(), np.zeros(size), 0.0, 0
            for b in range(u.shape[1]):
                signal = u[n, b], integral[n, b], noise[n, b]
                filled = value[n, b], turn[n, b], information[n, b], gain[n, b]
                _linearise_beam(signal, constants[n, b], reach[n, b], filled, work)
                for p in range(reach[n, b]):
                    level += value[n, b, p]
                    number += 1
                    for q in range(reach[n, b]):
                        share = information[n, b, p, q]
                        normal[crossing[b, p], crossing[b, q]] += share
                        side[crossing[b, p]] += share * value[n, b, q]
            side += THRESHOLDS.weak_precision * level / max(number, 1)
            invert(normal, covariance[n], factor)
            x[n] = 0.0
            for c in range(size):
                for d in range(size):
                    x[n, c] += covariance[n, c, d] * side[d]
            if largest < THRESHOLDS.converged_step**3:
                break
            largest = step[n] = 0.0
            for b in range(u.shape[1]):
                change, slope = 0.0, math.exp(constants[n, b] + value[n, b, 0] - u[n, b, 0])
                for p in range(reach[n, b]):
                    change += gain[n, b, p] * (value[n, b, p] - x[n, crossing[b, p]])
                change = min(max(change, -THRESHOLDS.longest_step), THRESHOLDS.longest_step)
                constants[n, b] += change
                largest = max(largest, abs(change))
                if not abs(change) * slope <= step[n]:
                    step[n] = abs(change) * slope


# Tests -------------------------------------------------------------------------------------------


def compare(beams: Beams, linear: Linear, x: Array, reach: Indices) -> tuple[Array, Array]:
    """Return chi-squares of profiles, and their degrees of freedom.

    Returns
    -------
    (profile, 2) float64
        Chi-square of the beams alone, at their own best field, and about a field.
    (profile, 2) float64
    """
    residual = residuals(beams, linear, x, reach)
    weighted = product(linear.information, residual)
    about = (weighted * residual).sum(axis=(1, 2, 3))
    taken = taken_up(normal_matrix(linear.information, beams), gathered(weighted, beams)[..., 0])
    spare = reach.sum(axis=1) - (reach > 0).sum(axis=1)
    freedom = np.stack([spare - seen(beams, reach).sum(axis=1), spare], axis=1)
    return np.stack([about - taken, about], axis=1), freedom.astype(np.float64)


def residuals(beams: Beams, linear: Linear, x: Array, reach: Indices) -> Array:
    """Return (profile, beam, passage, 1) y - A x of the passages in use."""
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    return np.where(inside, linear.value - x[:, beams.crossing], 0.0)[..., np.newaxis]


def seen(beams: Beams, reach: Indices) -> Booleans:
    """Return (profile, crossing) whether a passage in use is there."""
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    return np.asarray(gathered(inside[..., np.newaxis].astype(np.float64), beams)[..., 0] > 0.0)


def taken_up(normal: Array, side: Array) -> Array:
    """Return side' normal+ side, the part of chi-square that a change of the field takes up."""
    # Directions that no beam determines have no side: a little information there does not count.
    size = np.diagonal(normal, axis1=1, axis2=2).max(axis=1)[:, np.newaxis, np.newaxis]
    little = np.where(size > 0.0, _ROUNDING * size, 1.0) * np.eye(normal.shape[1])
    part = product(inverse(normal + little), side[..., np.newaxis])[..., 0]
    return np.asarray((part * side).sum(axis=1))
