"""Linear algebra of small symmetric matrices, whose bits do not depend on the number of threads.

Libraries share large products and factors between threads, with other last digits for each number.
These loops also take less time than a call of a library for each small matrix.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Indices
from lidarops.retrieve.common.compiled_code import compiled

_SWEEPS: Final = 30
_SMALLEST_ROTATION: Final = 1e-15
"""Elements beside the diagonal over the sum of those on it, below which they are zero."""


def product(a: Array, b: Array) -> Array:
    """Return products of (..., row, inner) and (..., inner, column) matrices."""
    shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    left, right = (
        np.ascontiguousarray(np.broadcast_to(each, (*shape, *each.shape[-2:]))).reshape(
            math.prod(shape), *each.shape[-2:]
        )
        for each in (a, b)
    )
    out = np.zeros((len(left), left.shape[1], right.shape[2]))
    _multiply(left, right, out)
    return out.reshape(*shape, *out.shape[1:])


def inverse(matrices: Array) -> Array:
    """Return inverses of (..., row, row) positive definite matrices; NaN of others."""
    return inverse_and_determinant(matrices)[0]


def inverse_and_determinant(matrices: Array) -> tuple[Array, Array]:
    """Return inverses of (..., row, row) positive definite matrices, and (...) ln determinants.

    Both are NaN of other matrices.
    """
    size = matrices.shape[-1]
    flat = np.ascontiguousarray(matrices).reshape(-1, size, size)
    out, logarithm = np.empty(flat.shape), np.empty(len(flat))
    _invert(flat, out, logarithm)
    return out.reshape(matrices.shape), logarithm.reshape(matrices.shape[:-2])


def lower_root(matrix: Array) -> Array:
    """Return the (row, row) lower triangle L of a positive definite matrix L L'."""
    out = np.tril(matrix)
    _factorise(out)
    return out


def eigenvectors(matrix: Array) -> tuple[Array, Array]:
    """Return (mode,) eigenvalues and (row, mode) eigenvectors of a symmetric matrix.

    By Jacobi rotations, until all elements beside the diagonal are zero.
    """
    rotated, vectors = matrix.copy(), np.eye(len(matrix))
    _rotate(rotated, vectors)
    return np.diagonal(rotated).copy(), vectors


@compiled
def _multiply(a: Array, b: Array, out: Array) -> None:
    for n in range(a.shape[0]):
        for i in range(a.shape[1]):
            for k in range(a.shape[2]):
                factor = a[n, i, k]
                for j in range(b.shape[2]):
                    out[n, i, j] += factor * b[n, k, j]


@compiled
def _factorise(matrix: Array) -> float:
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
def _invert(matrices: Array, out: Array, logarithm: Array) -> None:
    factor, root = np.empty(matrices.shape[1:]), np.empty(matrices.shape[1:])
    for n in range(matrices.shape[0]):
        factor[:] = matrices[n]
        logarithm[n] = _factorise(factor)
        if math.isnan(logarithm[n]):
            out[n] = math.nan
            continue
        _invert_triangle(factor, root)
        _square(root, out[n])


@compiled
def _invert_triangle(factor: Array, out: Array) -> None:
    """Fill the inverse of a lower triangle."""
    out[:] = 0.0
    for i in range(factor.shape[0]):
        for k in range(i):
            share = factor[i, k]
            for j in range(k + 1):
                out[i, j] -= share * out[k, j]
        out[i, i] += 1.0
        for j in range(i + 1):
            out[i, j] /= factor[i, i]


@compiled
def _square(root: Array, out: Array) -> None:
    """Fill L' L of a lower triangle L."""
    out[:] = 0.0
    size = root.shape[0]
    for k in range(size):
        for i in range(k + 1):
            share = root[k, i]
            for j in range(i + 1):
                out[i, j] += share * root[k, j]
    for i in range(size):
        for j in range(i):
            out[j, i] = out[i, j]


@compiled
def _rotate(matrix: Array, vectors: Array) -> None:
    """Diagonalise a symmetric matrix by Jacobi rotations, in place."""
    size, limit = matrix.shape[0], 0.0
    for p in range(size):
        limit += _SMALLEST_ROTATION * abs(matrix[p, p])
    for _ in range(_SWEEPS):
        rotations = 0
        for p in range(size - 1):
            for q in range(p + 1, size):
                beside = matrix[p, q]
                if abs(beside) <= limit:
                    continue
                rotations += 1
                ratio = 0.5 * (matrix[q, q] - matrix[p, p]) / beside
                tangent = 1.0 / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    tangent = -tangent
                cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for k in range(size):
                    a, b = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = cosine * a - sine * b, sine * a + cosine * b
                for k in range(size):
                    a, b = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = cosine * a - sine * b, sine * a + cosine * b
                    a, b = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = cosine * a - sine * b, sine * a + cosine * b
                matrix[p, q] = matrix[q, p] = 0.0
        if rotations == 0:
            break


@compiled
def gather(values: Array, place: Indices, out: Array) -> None:
    """Add (profile, item, case) values to the (profile, place, case) of each item."""
    for n in range(values.shape[0]):
        for i in range(values.shape[1]):
            for j in range(values.shape[2]):
                out[n, place[i], j] += values[n, i, j]


@compiled
def gather_squares(matrices: Array, place: Indices, out: Array) -> None:
    """Add (profile, beam, row, row) matrices to the places of their rows and columns.

    `place` is (beam, row), `out` (profile, place, place).
    """
    for n in range(matrices.shape[0]):
        for b in range(matrices.shape[1]):
            for i in range(matrices.shape[2]):
                for j in range(matrices.shape[3]):
                    out[n, place[b, i], place[b, j]] += matrices[n, b, i, j]
