"""Optimal multiplier of a cycle: less noise against a known systematic error."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _cycle_kernels

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

MULTIPLIER_GRID: Final = np.linspace(0.0, 1.0, 41)
"""Multipliers that are tried at high noise."""
_BIASED: Final = False
"""Selects the estimate with a bias, not the one that is unbiased in a homogeneous field."""
LARGEST_CLOSED_FORM_NOISE: Final = 0.05
"""Relative noise of a bin up to which the closed form is within 1 percent of the optimum."""


def relative_bias(depths: Array, multiplier: Array) -> Array:
    """Return (true - estimate) / true of the reciprocal extinction at the start crossing.

    Parameters
    ----------
    depths : (..., row) float64
        Exponent times optical depth of each row, negative where it runs towards its lidar.
    multiplier : (...) float64
    """
    k = depths.shape[-1]
    attenuation = np.exp(-2.0 * np.cumsum(depths, axis=-1))
    powers = multiplier[..., np.newaxis] ** np.arange(k)
    steps = powers[..., :-1] * (1.0 - multiplier[..., np.newaxis])
    neglected = _sum(steps * attenuation[..., :-1])
    determinant = 1.0 - powers[..., -1] * attenuation[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(determinant > 0, neglected / determinant, np.nan))


def sensitivities(
    starts: Array, ends: Array, integrals: Array, multiplier: Array
) -> tuple[Array, Array]:
    """Return (cycle,) solutions and (cycle, row, 3) derivatives by the logarithms of the data."""
    count, k = starts.shape
    value, determinant, codes = np.empty(count), np.empty(count), np.empty(count, dtype=np.uint8)
    out = np.empty((count, k, 3))
    _cycle_kernels.solve_with_sensitivities(
        starts, ends, integrals, multiplier, _BIASED, value, determinant, out, codes
    )  # fmt: skip
    return value, out


def optimal_multiplier(
    starts: Array, ends: Array, integrals: Array, covariances: Array, depths: Array,
    scale: Array, noisy: Booleans,
) -> Array:  # fmt: skip
    r"""Return (cycle,) multipliers with the smallest sum of squared bias and variance.

    With :math:`\epsilon = 1 - \lambda`, sensitivities :math:`g = g_0 - \epsilon g_1` and the
    bias :math:`\epsilon B_1`, both to first order,

    .. math:: \epsilon^* = \frac{g_0 C g_1}{B_1^2 + g_1 C g_1}

    clipped to 0-1. At high noise, the minimum on `MULTIPLIER_GRID` takes its place.

    Parameters
    ----------
    starts, ends, integrals : (cycle, row) float64
    covariances : (cycle, row, 3, 3) float64
        Covariances of their logarithms.
    depths : (cycle, row) float64
        From a model of the field, as in `relative_bias`. From the same noisy profile, the bias
        would be as noisy as the value itself.
    scale : (cycle,) float64
        Reciprocal extinction at the start crossing, of the model.
    noisy : (cycle,) bool
        Where the grid is used.
    """
    ones = np.ones(starts.shape[0])
    attenuation = np.exp(-2.0 * np.cumsum(depths, axis=-1))
    bias = scale * _sum(attenuation[:, :-1]) / (1.0 - attenuation[:, -1])
    sensitivity_at_one = sensitivities(starts, ends, integrals, ones)[1]
    slope = _slope_at_one(starts, ends, integrals)
    noise_slope, noise_curvature = (
        _product(sensitivity_at_one, covariances, slope),
        _product(slope, covariances, slope),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        closed = 1.0 - np.clip(noise_slope / (bias**2 + noise_curvature), 0.0, 1.0)
    closed = np.where(np.isfinite(closed), closed, 1.0)
    if not noisy.any():
        return closed
    cost = np.full((MULTIPLIER_GRID.size, ones.size), np.inf)
    for i, multiplier in enumerate(MULTIPLIER_GRID):
        _, gradient = sensitivities(starts, ends, integrals, multiplier * ones)
        total = (scale * relative_bias(depths, multiplier * ones)) ** 2
        total += _product(gradient, covariances, gradient)
        cost[i] = np.where(np.isfinite(total), total, np.inf)
    return np.where(noisy, MULTIPLIER_GRID[np.argmin(cost, axis=0)], closed)


def _slope_at_one(starts: Array, ends: Array, integrals: Array) -> Array:
    """Return the derivatives of the sensitivities by the multiplier at 1, in closed form.

    They are the sensitivities of dS/dmu = (N' - S D') / D, where N and D are numerator and
    determinant of the solution, by the product rule over the rows.
    """
    k = starts.shape[1]
    terms = integrals / starts
    ratios = ends / starts
    products = np.cumprod(ratios, axis=1)
    before = np.concatenate([np.ones((len(starts), 1)), products[:, :-1]], axis=1)
    order = np.arange(k)
    numerators = before * terms
    full_product = products[:, -1:]
    determinant = 1.0 - full_product
    value = _sum(numerators)[:, np.newaxis] / determinant
    tilted = _sum(order * numerators)[:, np.newaxis]
    # Derivatives by ln c_j and ln q_j: of N, of N' = sum (j - 1) N_j, and of the determinant.
    by_term, by_term_tilted = numerators, order * numerators
    by_ratio, by_ratio_tilted = (
        _sum_of_later_rows(numerators),
        _sum_of_later_rows(order * numerators),
    )
    slope = (tilted + (k - 1) * value * full_product) / determinant
    of_value_term = by_term / determinant
    of_value_ratio = (by_ratio + value * full_product) / determinant
    of_slope_term = (by_term_tilted + (k - 1) * full_product * of_value_term) / determinant
    of_slope_ratio = (
        by_ratio_tilted + (k - 1) * full_product * (value + of_value_ratio) + slope * full_product
    ) / determinant
    return np.stack([-of_slope_term - of_slope_ratio, of_slope_ratio, of_slope_term], axis=-1)


def _sum_of_later_rows(values: Array) -> Array:
    """Return, for each row, the sum over the rows after it."""
    reverse = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([reverse[:, 1:], np.zeros((len(values), 1))], axis=1)


def _sum(values: Array) -> Array:
    """Sum over the last axis in order, so that the digits do not depend on the other axes."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])


def _product(left: Array, covariances: Array, right: Array) -> Array:
    """Return (cycle,) sums over the rows of left' C right."""
    out = np.zeros(left.shape[0])
    for a in range(3):
        for b in range(3):
            out += _sum(left[:, :, a] * covariances[:, :, a, b] * right[:, :, b])
    return out
