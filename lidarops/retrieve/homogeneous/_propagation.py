"""Compiled propagation of noise into a fit above a separately estimated background."""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array
from lidarops.retrieve.common.compiled_code import compiled

PROPAGATED: Final = np.dtype(
    [
        (name, np.float64)
        for name in (
            "background_variance",
            "amplitude_relative_variance",
            "extinction_variance",
            "amplitude_slope",
            "extinction_slope",
            "background_bend",
        )
    ]
)


@compiled
def fill_linear_weights(power: Any, noise: Array, is_variance: bool, weights: Array) -> None:
    for i in range(weights.size):
        weight = 1.0 / noise[i] if is_variance else noise[i]
        usable = abs(np.float64(power[i])) < HUGE and 0.0 < weight < HUGE
        weights[i] = weight if usable else 0.0


@compiled
def _propagate_profile(
    b: float,
    phi: Array,
    range_: Array,
    weights: Array,
    gradient: Array,
    row: Any,
) -> None:
    """Fill the random variances of one profile, and its derivatives by the background."""
    norm = moment = 0.0
    for i in range(phi.size):
        norm += phi[i] * phi[i] * weights[i]
        moment += phi[i] * phi[i] * weights[i] * range_[i]
    centroid = moment / norm
    slope = whole = tilted = 0.0
    for i in range(phi.size):
        lever = -2.0 * (range_[i] - centroid)
        slope += lever * lever * phi[i] * phi[i] * weights[i]
        whole += phi[i] * weights[i]
        tilted += lever * phi[i] * weights[i]
    row.extinction_slope = -tilted / (b * slope)
    row.amplitude_slope = -whole / (b * norm) + 2.0 * centroid * row.extinction_slope
    length, middle = range_[-1] - range_[0], 0.5 * (range_[0] + range_[-1])
    for i in range(phi.size):
        if weights[i] == 0.0:
            continue
        row.background_bend += gradient[i] * b * phi[i] * (range_[i] - middle) ** 2 / length
        weighted = phi[i] * weights[i]
        lever = -2.0 * (range_[i] - centroid)
        extinction_gradient = lever * weighted / (b * slope)
        logarithm_gradient = weighted / (b * norm) + 2.0 * centroid * extinction_gradient
        extinction_gradient += row.extinction_slope * gradient[i]
        logarithm_gradient += row.amplitude_slope * gradient[i]
        row.background_variance += gradient[i] * gradient[i] / weights[i]
        row.amplitude_relative_variance += logarithm_gradient * logarithm_gradient / weights[i]
        row.extinction_variance += extinction_gradient * extinction_gradient / weights[i]


@compiled
def propagate(
    power: Any,
    noise: Array,
    is_variance: bool,
    extinction: Array,
    amplitude: Array,
    range_: Array,
    gradients: Array,
    out: Any,
) -> None:
    """Propagate noise to first order, through a background that depends on the power too.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    noise : (profile or 1, bin) float64
        Variances or weights, as in the fit.
    is_variance : bool
    extinction, amplitude : (profile,) float
        m-1, power times m2: from the weighted fit to the power less the background.
    range_ : (bin,) float
        m.
    gradients : (profile or 1, bin) float64
        Derivatives of the background with respect to the power.
    out : (profile,) `PROPAGATED`
        In: 0. Receives variances; the derivatives of the logarithm of the amplitude and of the
        extinction with respect to the background; and the change of the background by a signal
        bent by ``(x - 1/2)^2``, times the length of the section.
    """
    start, phi, weights = range_[0], np.empty(range_.size), np.empty(range_.size)
    for k in range(extinction.size):
        for i in range(phi.size):
            phi[i] = (start / range_[i]) ** 2 * math.exp(-2.0 * extinction[k] * (range_[i] - start))
        b = amplitude[k] * math.exp(-2.0 * extinction[k] * start) / start**2
        fill_linear_weights(power[k], noise[k % noise.shape[0]], is_variance, weights)
        _propagate_profile(b, phi, range_, weights, gradients[k % gradients.shape[0]], out[k])
