"""A compiled Levenberg-Marquardt fit, one profile at a time: the usual fast solver."""

from __future__ import annotations

from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

UNKNOWNS: Final = 3
_MOST: Final = 60
"""Most iterations of a fit."""
_TOLERANCE: Final = 1e-10
"""Relative decrease of the sum of squares below which a fit has converged."""
_DAMPING: Final = 1e-3
_LARGEST_DAMPING: Final = 1e12


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _model(unknowns: Array, ratio: Array, depth: Array, shape: Array) -> None:
    for i in range(ratio.size):
        shape[i] = ratio[i] * np.exp(-2.0 * unknowns[2] * depth[i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _squares(power: Any, unknowns: Array, shape: Array) -> float:
    total = 0.0
    for i in range(shape.size):
        total += (power[i] - unknowns[0] - unknowns[1] * shape[i]) ** 2
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(
    power: Any, unknowns: Array, depth: Array, shape: Array, matrix: Array, side: Array
) -> None:
    s1 = s2 = s3 = s4 = s5 = r0 = r1 = r2 = 0.0
    for i in range(shape.size):
        first = shape[i]
        second = -2.0 * unknowns[1] * depth[i] * first
        residual = power[i] - unknowns[0] - unknowns[1] * first
        s1 += first
        s2 += second
        s3 += first * first
        s4 += first * second
        s5 += second * second
        r0 += residual
        r1 += first * residual
        r2 += second * residual
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = shape.size, s3, s5
    matrix[0, 1] = matrix[1, 0] = s1
    matrix[0, 2] = matrix[2, 0] = s2
    matrix[1, 2] = matrix[2, 1] = s4
    side[0], side[1], side[2] = r0, r1, r2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inverse(matrix: Array, damping: float, inverse: Array) -> None:
    """Invert the damped symmetric matrix by its cofactors."""
    grown = 1.0 + damping
    a, d, f = matrix[0, 0] * grown, matrix[1, 1] * grown, matrix[2, 2] * grown
    b, c, e = matrix[0, 1], matrix[0, 2], matrix[1, 2]
    inverse[0, 0] = d * f - e * e
    inverse[0, 1] = inverse[1, 0] = c * e - b * f
    inverse[0, 2] = inverse[2, 0] = b * e - c * d
    inverse[1, 1] = a * f - c * c
    inverse[1, 2] = inverse[2, 1] = b * c - a * e
    inverse[2, 2] = a * d - b * b
    inverse /= a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit(power: Any, ratio: Array, depth: Array, unknowns: Array, inverse: Array) -> int:
    matrix, side = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    shape, trial_shape, trial = np.empty(ratio.size), np.empty(ratio.size), np.empty(UNKNOWNS)
    _model(unknowns, ratio, depth, shape)
    squares = _squares(power, unknowns, shape)
    if not np.isfinite(squares):
        unknowns[:] = np.nan
        inverse[:] = np.nan
        return 0
    damping = _DAMPING
    iterations = 0
    done = False
    while iterations < _MOST and not done:
        iterations += 1
        _normal_equations(power, unknowns, depth, shape, matrix, side)
        while True:
            _inverse(matrix, damping, inverse)
            for j in range(UNKNOWNS):
                trial[j] = unknowns[j] + np.sum(inverse[j] * side)
            _model(trial, ratio, depth, trial_shape)
            trial_squares = _squares(power, trial, trial_shape)
            if trial_squares <= squares:
                damping *= 0.1
                break
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                trial_squares = squares
                trial[:] = unknowns
                trial_shape[:] = shape
                break
        done = squares - trial_squares <= _TOLERANCE * squares
        squares = trial_squares
        unknowns[:] = trial
        shape[:] = trial_shape
    _normal_equations(power, unknowns, depth, shape, matrix, side)
    _inverse(matrix, 0.0, inverse)
    return iterations


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_levenberg_marquardt(
    power: Any, ratio: Array, depth: Array, start: Array, unknowns: Array, covariance: Array
) -> int:
    """Fit background, signal at the start and extinction to profiles of unit variance.

    Parameters
    ----------
    power : (profile, range) float
    ratio : (range,) float64
        Square of the first range over the range.
    depth : (range,) float64
        Range less the first range, in the inverse unit of the extinction.
    start : (3,) float64
        Start values of every fit.
    unknowns : (profile, 3) float64
        Filled; NaN where a bin is not finite.
    covariance : (profile, 3, 3) float64
        Filled with the inverse normal matrix at the solution.

    Returns
    -------
    int
        Iterations of all profiles.
    """
    total = 0
    for k in range(power.shape[0]):
        unknowns[k] = start
        total += _fit(power[k], ratio, depth, unknowns[k], covariance[k])
    return total
