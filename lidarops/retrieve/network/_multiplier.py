"""The multiplier of a cycle that trades noise for a known systematic error."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _cycle_kernels

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

GRID: Final = np.linspace(0.0, 1.0, 41)
_PLAIN: Final = False
"""The estimate with a bias, not the one that is unbiased in a homogeneous field."""
LOUDEST_CLOSED: Final = 0.05
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
        starts, ends, integrals, multiplier, _PLAIN, value, determinant, out, codes
    )  # fmt: skip
    return value, out


def optimal(
    starts: Array, ends: Array, integrals: Array, covariances: Array, depths: Array,
    scale: Array, loud: Booleans,
) -> Array:  # fmt: skip
    r"""Return (cycle,) multipliers of the least sum of squared bias and variance.

    With :math:`\epsilon = 1 - \lambda`, sensitivities :math:`g = g_0 - \epsilon g_1` and the
    bias :math:`\epsilon B_1`, both to first order,

    .. math:: \epsilon^* = \frac{g_0 C g_1}{B_1^2 + g_1 C g_1}

    clipped to 0-1. Where noise is loud, the minimum on a grid of 41 takes its place.

    Parameters
    ----------
    starts, ends, integrals : (cycle, row) float64
    covariances : (cycle, row, 3, 3) float64
        Of their logarithms.
    depths : (cycle, row) float64
        Of a model of the field, as in `relative_bias`. Taken from the same noisy profile, the
        bias would be as noisy as what it is to correct.
    scale : (cycle,) float64
        Reciprocal extinction at the start crossing, of the model.
    loud : (cycle,) bool
        Where the grid is taken.
    """
    one = np.ones(starts.shape[0])
    attenuation = np.exp(-2.0 * np.cumsum(depths, axis=-1))
    bias = scale * _sum(attenuation[:, :-1]) / (1.0 - attenuation[:, -1])
    at_one = sensitivities(starts, ends, integrals, one)[1]
    slope = _slope_at_one(starts, ends, integrals)
    cross, square = _product(at_one, covariances, slope), _product(slope, covariances, slope)
    with np.errstate(divide="ignore", invalid="ignore"):
        closed = 1.0 - np.clip(cross / (bias**2 + square), 0.0, 1.0)
    closed = np.where(np.isfinite(closed), closed, 1.0)
    if not loud.any():
        return closed
    cost = np.full((GRID.size, one.size), np.inf)
    for i, multiplier in enumerate(GRID):
        _, gradient = sensitivities(starts, ends, integrals, multiplier * one)
        total = (scale * relative_bias(depths, multiplier * one)) ** 2
        total += _product(gradient, covariances, gradient)
        cost[i] = np.where(np.isfinite(total), total, np.inf)
    return np.where(loud, GRID[np.argmin(cost, axis=0)], closed)


def _slope_at_one(starts: Array, ends: Array, integrals: Array) -> Array:
    """Return the derivatives by the multiplier, at 1, of the sensitivities: closed form.

    They are the sensitivities of dS/dmu = (N' - S D') / D, where N and D are numerator and
    determinant of the solution: a product rule over the rows.
    """
    k = starts.shape[1]
    terms = integrals / starts
    ratios = ends / starts
    products = np.cumprod(ratios, axis=1)
    before = np.concatenate([np.ones((len(starts), 1)), products[:, :-1]], axis=1)
    order = np.arange(k)
    numerators = before * terms
    last = products[:, -1:]
    determinant = 1.0 - last
    value = _sum(numerators)[:, np.newaxis] / determinant
    tilted = _sum(order * numerators)[:, np.newaxis]
    # Derivatives by ln c_j and ln q_j: of N, of N' = sum (j - 1) N_j, and of the determinant.
    by_term, by_term_tilted = numerators, order * numerators
    by_ratio, by_ratio_tilted = _later(numerators), _later(order * numerators)
    slope = (tilted + (k - 1) * value * last) / determinant
    of_value_term = by_term / determinant
    of_value_ratio = (by_ratio + value * last) / determinant
    of_slope_term = (by_term_tilted + (k - 1) * last * of_value_term) / determinant
    of_slope_ratio = (
        by_ratio_tilted + (k - 1) * last * (value + of_value_ratio) + slope * last
    ) / determinant
    return np.stack([-of_slope_term - of_slope_ratio, of_slope_ratio, of_slope_term], axis=-1)


def _later(values: Array) -> Array:
    """Return for each row the sum over the rows behind it."""
    reverse = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([reverse[:, 1:], np.zeros((len(values), 1))], axis=1)


def _sum(values: Array) -> Array:
    """Sum over the last axis one by one, so that the digits do not depend on the other axes."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])


def _product(left: Array, covariances: Array, right: Array) -> Array:
    out = np.zeros(left.shape[0])
    for a in range(3):
        for b in range(3):
            out += _sum(left[:, :, a] * covariances[:, :, a, b] * right[:, :, b])
    return out
