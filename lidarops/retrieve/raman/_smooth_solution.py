r"""Compiled solutions of :math:`(\mathrm{diag}(i) + \lambda D^\top D)\, x = b`.

:math:`D` takes second differences, so that the matrix has five diagonals. It is never formed: the
factor :math:`L\, \mathrm{diag}(d)\, L^\top` comes from rotations of the rows of
:math:`\sqrt i` and :math:`\sqrt\lambda D`. Weights exceed information by up to 16 orders of
magnitude; of the roots, doubles hold both. The order of every sum is fixed, so the bits of a
result do not depend on the library of linear algebra.
"""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled


@compiled
def _triangle(rows: Array) -> None:
    """Rotate rows in place until those below the diagonal are 0 in all columns but the last."""
    count, columns = rows.shape
    for j in range(columns - 1):
        for i in range(j + 1, count):
            if rows[i, j] == 0.0:
                continue
            length = np.hypot(rows[j, j], rows[i, j])
            cosine, sine = rows[j, j] / length, rows[i, j] / length
            for k in range(j, columns):
                upper, lower = rows[j, k], rows[i, k]
                rows[j, k] = cosine * upper + sine * lower
                rows[i, k] = cosine * lower - sine * upper
            rows[i, j] = 0.0


@compiled
def factor(
    information: Array, weight: float, response: Array
) -> tuple[Array, Array, Array, Array, float]:
    """Return d and both diagonals of L, the right-hand side of its transpose, and the misfit.

    Parameters
    ----------
    information, response : (cell,) float
        At least 4 cells.
    weight : float
        Of the sum of squared second differences.

    Returns
    -------
    (cell,) float64, (cell,) float64, (cell,) float64
        NaN where the matrix is singular.
    (cell,) float64
        Right-hand side: the solution of the transposed L is that of the least sum.
    float
        The least sum of squares: of responses by their information, and of smoothness.
    """
    cells = information.size
    pivot, near, far, target = np.empty(cells), np.zeros(cells), np.zeros(cells), np.zeros(cells)
    misfit, bend = 0.0, np.sqrt(weight)
    # Columns: this cell and the next two, and the right-hand side. Rows: two that the cells before
    # leave, the information of this cell, and its second difference.
    rows = np.zeros((4, 4))
    for i in range(cells):
        root = np.sqrt(information[i])
        rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3] = root, 0.0, 0.0, root * response[i]
        inside = bend if i < cells - 2 else 0.0
        rows[3, 0], rows[3, 1], rows[3, 2], rows[3, 3] = inside, -2.0 * inside, inside, 0.0
        _triangle(rows)
        misfit += rows[3, 3] ** 2
        first = rows[0, 0] if rows[0, 0] != 0.0 else np.nan
        pivot[i], target[i] = first * first, rows[0, 3] / first
        near[i], far[i] = rows[0, 1] / first, rows[0, 2] / first
        for row in range(2):
            rows[row, 0], rows[row, 1] = rows[row + 1, 1], rows[row + 1, 2]
            rows[row, 2], rows[row, 3] = 0.0, rows[row + 1, 3]
    return pivot, near, far, target, misfit


@compiled
def least_sum(information: Array, weight: float, response: Array) -> Array:
    """Return the solution of the least sum of squares, (cell,)."""
    _, near, far, solved, _ = factor(information, weight, response)
    for i in range(information.size - 2, -1, -1):
        solved[i] -= near[i] * solved[i + 1]
        if i < information.size - 2:
            solved[i] -= far[i] * solved[i + 2]
    return solved


@compiled
def _forward(near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by the solutions of L."""
    cells, sides = right.shape
    for i in range(1, cells):
        for k in range(sides):
            right[i, k] -= near[i - 1] * right[i - 1, k]
        if i > 1:
            for k in range(sides):
                right[i, k] -= far[i - 2] * right[i - 2, k]


@compiled
def _backward(pivot: Array, near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by the solutions of d and the transposed L."""
    cells, sides = right.shape
    for i in range(cells - 1, -1, -1):
        for k in range(sides):
            right[i, k] /= pivot[i]
        if i < cells - 1:
            for k in range(sides):
                right[i, k] -= near[i] * right[i + 1, k]
        if i < cells - 2:
            for k in range(sides):
                right[i, k] -= far[i] * right[i + 2, k]


@compiled
def _substitute(pivot: Array, near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by their solutions."""
    _forward(near, far, right)
    _backward(pivot, near, far, right)


@compiled
def solve(information: Array, weight: float, right: Array) -> Array:
    """Return the solutions of right-hand sides (cell, side), refined once.

    The refinement restores the digits that the squares of the roots lose.
    """
    pivot, near, far, _, _ = factor(information, weight, np.zeros(information.size))
    solved = right.copy()
    _substitute(pivot, near, far, solved)
    cells, sides = right.shape
    left = np.empty((cells, sides))
    for i in range(cells):
        for k in range(sides):
            left[i, k] = right[i, k] - information[i] * solved[i, k]
    for i in range(cells - 2):
        for k in range(sides):
            bend = weight * (solved[i, k] - 2.0 * solved[i + 1, k] + solved[i + 2, k])
            left[i, k] -= bend
            left[i + 1, k] += 2.0 * bend
            left[i + 2, k] -= bend
    _substitute(pivot, near, far, left)
    return np.asarray(solved + left)


@compiled
def restricted_scores(information: Array, response: Array, weights: Array) -> Array:
    """Return minus twice the logarithm of the restricted likelihood of weights, up to a constant.

    Parameters
    ----------
    information, response : (cell,) float
    weights : (weight,) float
        Of the sum of squared second differences.
    """
    scores = np.empty(weights.size)
    for number in range(weights.size):
        pivot, _, _, _, misfit = factor(information, weights[number], response)
        logarithm = np.log(pivot).sum()
        scores[number] = misfit + logarithm - (response.size - 2) * np.log(weights[number])
    return scores
