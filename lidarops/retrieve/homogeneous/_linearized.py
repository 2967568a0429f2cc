"""Compiled estimate of the second-order error of the linearised method."""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._propagation import fill_linear_weights

Array = npt.NDArray[np.float64]

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


class _Model(NamedTuple):
    """The linear model at the prior, x = (R - R_0) / L."""

    x: Array
    shape: Array
    slope: Array
    """-2 (x - centroid) times the shape, less its mean and orthogonal to the shape."""
    weights: Array


@_compiled
def _mean(values: Array, weights: Array) -> float:
    total = norm = 0.0
    for i in range(values.size):
        total += weights[i] * values[i]
        norm += weights[i]
    return total / norm


@_compiled
def _ratio(a: Array, b: Array, weights: Array) -> float:
    """Return the weighted least-squares coefficient of b in a."""
    product = norm = 0.0
    for i in range(a.size):
        product += weights[i] * a[i] * b[i]
        norm += weights[i] * b[i] * b[i]
    return product / norm


@_compiled
def _centroid(model: _Model, centred: Array) -> float:
    moment = norm = 0.0
    for i in range(centred.size):
        pull = model.weights[i] * centred[i]
        moment += pull * model.shape[i] * model.x[i]
        norm += pull * centred[i]
    return moment / norm


@_compiled
def _shift(model: _Model, tau: float, zero: float, about_zero: bool, b: float, row: Array) -> None:
    """Fill the shifts of the parameters by the neglected term ``2 b tau^2 (x - x_c)^2 phi``.

    Here tau is the step in extinction, b the coefficient of the shape and `zero` the x of range
    zero.
    """
    weights, slope = model.weights, model.slope
    mean_shape = _mean(model.shape, weights)
    centred = model.shape - mean_shape
    centroid = _centroid(model, centred)
    origin = zero if about_zero else centroid
    slope[:] = -2.0 * (model.x - centroid) * model.shape
    mean_slope = _mean(slope, weights)
    slope -= mean_slope
    neglected = 2.0 * b * tau * tau * (model.x - origin) ** 2 * model.shape
    mean = _mean(neglected, weights)
    neglected -= mean
    slope_coefficient = _ratio(neglected, slope, weights)
    shape_coefficient = _ratio(neglected, centred, weights)
    row[0] = mean - shape_coefficient * mean_shape - slope_coefficient * mean_slope
    # In terms of the expansion about the origin, tau = g / b.
    shape_coefficient += 2.0 * (centroid - origin) * slope_coefficient
    row[2] = (slope_coefficient - tau * shape_coefficient) / b
    row[1] = shape_coefficient / b + 2.0 * (origin - zero) * row[2]


@_compiled
def neglected(
    power: Any,
    noise: Array,
    is_variance: bool,
    range_: Array,
    prior: Array,
    about_zero: bool,
    extinction: Array,
    amplitude: Array,
    out: Array,
) -> None:
    """Estimate the shifts of the parameters by the second-order term of the step.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : (profile or 1, bin) float64
        Variances or weights, as in the fit.
    is_variance : bool
    range_ : (bin,) float
        m, ascending.
    prior : (profile or 1,) float
        m-1.
    about_zero : bool
        Whether the expansion is about range zero, else about the centroid of information.
    extinction, amplitude : (profile,) float
        m-1, power times m2: the result of one step.
    out : (profile, 3) float64
        Receives the shifts of the background, the logarithm of the amplitude and the extinction.
    """
    n, length = range_.size, max(range_[-1] - range_[0], 1.0)
    zero = -range_[0] / length
    model = _Model((range_ - range_[0]) / length, np.empty(n), np.empty(n), np.empty(n))
    for k in range(power.shape[0]):
        expansion = prior[k % prior.size]
        fill_linear_weights(power[k], noise[k % noise.shape[0]], is_variance, model.weights)
        for i in range(n):
            falling = math.exp(-2.0 * expansion * length * model.x[i])
            model.shape[i] = falling * (range_[0] / range_[i]) ** 2
        # At the first bin, with the fitted extinction: the shift is of second order already.
        b = amplitude[k] * math.exp(-2.0 * extinction[k] * range_[0]) / range_[0] ** 2
        _shift(model, (extinction[k] - expansion) * length, zero, about_zero, b, out[k])
        out[k, 2] /= length
