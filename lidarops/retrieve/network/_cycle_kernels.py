"""Compiled closed form of a cycle of beams: start crossing, variance and sensitivities.

Row j of a cycle joins the crossings j and j + 1 by one beam, and the last row returns to the
first crossing: near_j s_j - far_j s_(j+1) = integral_j, where s is the reciprocal of extinction.
With c = integral / near and q = far / near, substitution around the cycle gives s_1.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]

NO_POLE: Final = 0
POLE: Final = 1
"""The multipliers make the determinant zero or change its sign: no value."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _prefix(
    starts: Array, ends: Array, integrals: Array, multiplier: float, unbiased: bool, work: Array
) -> tuple[float, float, bool]:
    """Fill `work` with the terms of a cycle; return solution, determinant and whether at a pole.

    Columns of work: the term mu_j Q_(j-1) c_j of the numerator, and the term of Q_j in the
    determinant.
    """
    k = starts.size
    mu = product = 1.0
    numerator = 0.0
    determinant = 1.0
    for j in range(k):
        inverse = 1.0 / starts[j]
        term = mu * product * integrals[j] * inverse
        work[j, 0] = term
        numerator += term
        product *= ends[j] * inverse
        determinant_term = 0.0
        if j == k - 1:
            determinant_term = mu * product
        elif unbiased:
            determinant_term = mu * (1.0 - multiplier) * product
        work[j, 1] = determinant_term
        determinant -= determinant_term
        if j < k - 1:
            mu *= multiplier
    return numerator / determinant, determinant, multiplier < 1.0 and mu * product >= 1.0


@_compiled
def _sensitivities(solution: float, determinant: float, work: Array, out: Array) -> None:
    """Fill (k, 3) derivatives of s_1 with respect to ln start, ln end and ln integral."""
    later = shares = 0.0
    for j in range(work.shape[0] - 1, -1, -1):
        shares += work[j, 1]
        of_end = (later + solution * shares) / determinant
        of_integral = work[j, 0] / determinant
        later += work[j, 0]
        out[j, 0] = -of_end - of_integral
        out[j, 1] = of_end
        out[j, 2] = of_integral


@_compiled
def solve_with_variance(
    starts: Array,
    ends: Array,
    integrals: Array,
    variances: Array,
    multipliers: Array,
    unbiased: bool,
    solution: Array,
    variance: Array,
    poles: Codes,
) -> None:
    """Solve cycles for their start crossing, with the variance of independent relative errors.

    Parameters
    ----------
    starts, ends, integrals : (cycle, row) float64
        Signal at the first and the second crossing of each row, and 2 m times the integral
        between them, negative where the row leads towards its lidar.
    variances : (cycle or 1, row, 3) float64
        Relative variances of the three.
    multipliers : (cycle or 1,) float64
        0 to 1; row j is multiplied by the power j - 1. 1 gives the exact solution.
    unbiased : bool
        Whether the terms that the multipliers neglect are assigned to the start crossing.
    solution, variance : (cycle,) float64
        Out: s_1 in the unit of integrals / starts, and its variance; NaN at a pole.
    poles : (cycle,) uint8
    """
    k = starts.shape[1]
    work = np.empty((k, 2))
    for n in range(starts.shape[0]):
        multiplier = multipliers[n % multipliers.size]
        value, determinant, pole = _prefix(
            starts[n], ends[n], integrals[n], multiplier, unbiased, work
        )
        row = n % variances.shape[0]
        later = shares = total = 0.0
        inverse = 1.0 / determinant
        for j in range(k - 1, -1, -1):
            shares += work[j, 1]
            of_end = (later + value * shares) * inverse
            of_integral = work[j, 0] * inverse
            later += work[j, 0]
            of_start = of_end + of_integral
            total += (
                of_start * of_start * variances[row, j, 0]
                + of_end * of_end * variances[row, j, 1]
                + of_integral * of_integral * variances[row, j, 2]
            )
        solution[n] = np.nan if pole else value
        variance[n] = np.nan if pole else total
        poles[n] = POLE if pole else NO_POLE


@_compiled
def solve_with_sensitivities(
    starts: Array,
    ends: Array,
    integrals: Array,
    multipliers: Array,
    unbiased: bool,
    solution: Array,
    determinants: Array,
    sensitivities: Array,
    poles: Codes,
) -> None:
    """Solve as `solve_with_variance`; fill determinants and (cycle, row, 3) sensitivities."""
    work = np.empty((starts.shape[1], 2))
    for n in range(starts.shape[0]):
        value, determinant, pole = _prefix(
            starts[n], ends[n], integrals[n], multipliers[n % multipliers.size], unbiased, work
        )
        _sensitivities(value, determinant, work, sensitivities[n])
        solution[n] = value
        determinants[n] = determinant
        poles[n] = POLE if pole else NO_POLE
        if pole:
            solution[n] = np.nan
            sensitivities[n, :, :] = np.nan
