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
    out: tuple[Array, Array, Array, Array],
) -> None:  # fmt: skip
    """Fill y, its derivatives, M and the gain of one beam; 0 where it has no two passages."""
    (u, integral, noise), (value, turn, information, gain) = signal, out
    value[:], gain[:], turn[:], information[:] = 0.0, 0.0, 0.0, 0.0
    if reach < 2:
        return
    most, weight, lever = u.size, math.exp(constant), np.empty(reach)
    for p in range(most - 1, -1, -1):
        weight += integral[p]
        if p < reach:
            value[p] = u[p] - math.log(weight)
            turn[p, p], lever[p] = 1.0, 1.0 / weight
            # The integral behind the last passage in use is part of the constant.
            turn[p, most + p : most + reach - 1] = -1.0 / weight
    lever /= lever[reach - 1]
    carried, covariance = np.zeros((reach, 2 * most)), np.zeros((reach, reach))
    add_product(1.0, turn[:reach], noise, carried)
    add_product(1.0, carried, turn[:reach].T, covariance)
    for p in range(reach):
        covariance[p, p] *= 1.0 + THRESHOLDS.smallest_pivot
    inverse = np.empty((reach, reach))
    invert(covariance, inverse, np.empty((reach, reach)))
    for p in range(reach):
        gain[p] = (inverse[p] * lever).sum()
    known = (lever * gain[:reach]).sum()
    for p in range(reach):
        information[p, :reach] = inverse[p] - gain[p] * gain[:reach] / known
    gain[:reach] /= known


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


def fit_beams(
    beams: Beams, precision: Array | None, constants: Array, x: Array | None = None,
    passes: int = _PASSES,
) -> Solution:  # fmt: skip
    """Solve each profile by Gauss-Newton steps of its constants.

    Parameters
    ----------
    beams : Beams
    precision : (crossing, crossing) float64, optional
        Of the prior of ln extinction.
    constants : (profile, beam) float64
        Where to start.
    x : (profile, crossing) float64, optional
        ln extinction where it is known, and only constants are fitted.
    passes : int
        Most steps.
    """
    (profiles, number), size = beams.reach.shape, beams.crossings
    shape = profiles, number, beams.value.shape[2]
    linear = Linear(
        np.zeros(shape), np.zeros((*shape, 2 * shape[2])), np.zeros((*shape, shape[2])),
        np.zeros(shape),
    )  # fmt: skip
    constants, moved = np.array(constants), np.zeros(profiles)
    covariance = np.zeros((0 if precision is None else profiles, size, size))
    # Each crossing is drawn to the level of the profile a little, where nothing else determines it.
    precision = (0.0 if precision is None else precision) + THRESHOLDS.weak_precision * np.eye(size)
    x = np.empty((profiles, size)) if x is None else x
    value, integral, noise = (np.ascontiguousarray(part) for part in beams[:3])
    signals = value, integral, noise, beams.reach, beams.crossing
    _fit(signals, precision, constants, linear[:], (x, covariance, moved), passes)
    return Solution(x, covariance, constants, linear, moved < THRESHOLDS.converged_step)


@compiled
def _fit(
    beams: tuple[Array, Array, Array, Indices, Indices], precision: Array, constants: Array,
    linear: tuple[Array, Array, Array, Array], out: tuple[Array, Array, Array], passes: int,
) -> None:  # fmt: skip
    """Fit each profile; `out` are ln extinction, its covariance, and the last step of ln w.

    Without profiles of covariances, ln extinction is known.
    """
    x, covariance, moved = out
    for n in range(x.shape[0]):
        step = math.inf
        for k in range(passes + 1):
            normal = precision.copy()
            side = _add_up(n, beams, constants, linear, normal)
            if covariance.shape[0] > 0:
                invert(normal, covariance[n], np.empty(normal.shape))
                for c in range(side.size):
                    x[n, c] = (covariance[n, c] * side).sum()
            if k == passes or step < THRESHOLDS.converged_step**3:
                break
            step, moved[n] = _step(n, beams, constants, linear, x[n])


@compiled
def _add_up(
    n: int, beams: tuple[Array, Array, Array, Indices, Indices], constants: Array,
    linear: tuple[Array, Array, Array, Array], normal: Array,
) -> Array:  # fmt: skip
    """Linearise a profile, add its information to a normal matrix, and return the right side."""
    (u, integral, noise, reach, crossing), (value, turn, information, gain) = beams, linear
    side, level, number = np.zeros(normal.shape[0]), 0.0, 0
    for b in range(u.shape[1]):
        filled = value[n, b], turn[n, b], information[n, b], gain[n, b]
        signal = u[n, b], integral[n, b], noise[n, b]
        _linearise_beam(signal, constants[n, b], reach[n, b], filled)
        for p in range(reach[n, b]):
            level += value[n, b, p]
            number += 1
            side[crossing[b, p]] += (information[n, b, p] * value[n, b]).sum()
            for q in range(reach[n, b]):
                normal[crossing[b, p], crossing[b, q]] += information[n, b, p, q]
    return side + THRESHOLDS.weak_precision * level / max(number, 1)


@compiled
def _step(
    n: int, beams: tuple[Array, Array, Array, Indices, Indices], constants: Array,
    linear: tuple[Array, Array, Array, Array], x: Array,
) -> tuple[float, float]:  # fmt: skip
    """Change the constants of a profile; return the largest step, and the largest one of ln w."""
    (u, _, _, reach, crossing), (value, _, _, gain) = beams, linear
    largest = moved = 0.0
    for b in range(u.shape[1]):
        change, slope = 0.0, math.exp(constants[n, b] + value[n, b, 0] - u[n, b, 0])
        for p in range(reach[n, b]):
            change += gain[n, b, p] * (value[n, b, p] - x[crossing[b, p]])
        change = min(max(change, -THRESHOLDS.longest_step), THRESHOLDS.longest_step)
        constants[n, b] += change
        largest = max(largest, abs(change))
        if not abs(change) * slope <= moved:
            moved = abs(change) * slope
    return largest, moved


def linearise(
    beams: Beams, constants: Array, reach: Indices | None = None, x: Array | None = None
) -> Solution:
    """Linearise beams about constants, or about those nearer to ln extinction by a step.

    Parameters
    ----------
    beams : Beams
        Of each profile, or of one mean.
    constants : (profile or 1, beam) float64
        ln w at the last passage of each beam.
    reach : (profile, beam) intp, optional
        Number of passages in use, at most those of the beams.
    x : (profile, crossing) float64, optional
        Ln extinction.
    """
    reach = beams.reach if reach is None else np.minimum(reach, beams.reach)
    value, integral, noise = (
        np.broadcast_to(part, (len(reach), *part.shape[1:])) for part in beams[:3]
    )
    each = Beams(value, integral, noise, reach, beams.crossing, beams.crossings)
    field = np.zeros((len(reach), beams.crossings)) if x is None else x
    constants = np.broadcast_to(constants, reach.shape)
    return fit_beams(each, None, constants, field, passes=0 if x is None else 1)


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
