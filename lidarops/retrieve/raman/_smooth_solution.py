r"""Compiled solutions of :math:`(\mathrm{diag}(i) + \lambda D^\top D)\, x = b`.

:math:`D` takes second differences, so that the matrix has five diagonals. It is factored as
:math:`L\, \mathrm{diag}(d)\, L^\top`. The order of every sum is fixed, so the bits of a result do
not depend on the library of linear algebra.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def factor(information: Array, weight: float) -> tuple[Array, Array, Array]:
    """Return d and both diagonals of L, NaN from where the matrix is not positive definite.

    Parameters
    ----------
    information : (cell,) float
        At least 4 cells.
    weight : float
        Of the sum of squared second differences.
    """
    cells = information.size
    pivot, near, far = np.empty(cells), np.zeros(cells), np.zeros(cells)
    for i in range(cells):
        # The first and last two second differences are missing.
        edge = min(i, cells - 1 - i)
        bend = 1.0 if edge == 0 else 5.0 if edge == 1 else 6.0
        value = weight * bend + information[i]
        if i > 0:
            value -= near[i - 1] * near[i - 1] * pivot[i - 1]
        if i > 1:
            value -= far[i - 2] * far[i - 2] * pivot[i - 2]
        pivot[i] = value if value > 0.0 else np.nan
        if i < cells - 1:
            beside = -4.0 * weight if 0 < i < cells - 2 else -2.0 * weight
            if i > 0:
                beside -= far[i - 1] * near[i - 1] * pivot[i - 1]
            near[i] = beside / pivot[i]
        if i < cells - 2:
            far[i] = weight / pivot[i]
    return pivot, near, far


@_compiled
def _forward(near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by the solutions of L."""
    cells, sides = right.shape
    for i in range(1, cells):
        for k in range(sides):
            right[i, k] -= near[i - 1] * right[i - 1, k]
        if i > 1:
            for k in range(sides):
                right[i, k] -= far[i - 2] * right[i - 2, k]


@_compiled
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


@_compiled
def _substitute(pivot: Array, near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by their solutions."""
    _forward(near, far, right)
    _backward(pivot, near, far, right)


@_compiled
def solve(information: Array, weight: float, right: Array) -> Array:
    """Return the solutions of right-hand sides (cell, side), refined once.

    Information and smoothness differ by up to 14 orders of magnitude; the refinement restores the
    digits that the factor loses.
    """
    pivot, near, far = factor(information, weight)
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


@_compiled
def restricted_scores(information: Array, response: Array, weights: Array) -> Array:
    """Return minus twice the logarithm of the restricted likelihood of weights, up to a constant.

    Parameters
    ----------
    information, response : (cell,) float
    weights : (weight,) float
        Of the sum of squared second differences.
    """
    cells = response.size
    scores = np.empty(weights.size)
    solved = np.empty((cells, 1))
    for number in range(weights.size):
        pivot, near, far = factor(information, weights[number])
        for i in range(cells):
            solved[i, 0] = information[i] * response[i]
        _substitute(pivot, near, far, solved)
        misfit, logarithm = 0.0, 0.0
        for i in range(cells):
            misfit += information[i] * response[i] * (response[i] - solved[i, 0])
            logarithm += np.log(pivot[i])
        scores[number] = misfit + logarithm - (cells - 2) * np.log(weights[number])
    return scores
