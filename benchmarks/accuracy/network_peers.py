"""Networks by `scipy.optimize.least_squares`, for comparison."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.optimize import least_squares

from benchmarks.harness.figure import Array
from benchmarks.scenes.lidar_networks import BLOCK, Signals
from lidarops.retrieve.network.thresholds import THRESHOLDS

_LEAST_SLOPE: Final = 1e-6
"""m-1, smallest extinction at the start of a fit."""


def network_by_scipy(power: Array, variance: Array, signals: Signals) -> Array:
    """Return (profile, crossing) extinction by `scipy.optimize.least_squares`, without errors.

    For each profile, the logarithms of extinction at the crossings and of one constant per beam
    are fitted to point values, weighted as if these were independent.
    """
    return np.stack(
        [
            _fit_network(*_point_values(profile, noise, signals), signals)
            for profile, noise in zip(power, variance, strict=True)
        ]
    )


def network_by_scipy_of_means(power: Array, variance: Array, signals: Signals) -> Array:
    """Return (profile, crossing) extinction of the mean of each block, for all its profiles."""
    first = np.arange(0, len(power), BLOCK)
    counts = np.diff(first, append=len(power))
    number = counts[:, np.newaxis, np.newaxis]
    mean = np.add.reduceat(power, first) / number
    variance_of_mean = np.add.reduceat(variance, first) / number**2
    return np.repeat(network_by_scipy(mean, variance_of_mean, signals), counts, axis=0)


def _point_values(power: Array, variance: Array, signals: Signals) -> tuple[Array, Array, Array]:
    """Return values, their relative errors, and integrals from the first crossing of each beam."""
    values, errors, integrals = [], [], []
    # A bin that is not positive has no logarithm and is replaced by half its noise.
    power = np.maximum(power, 0.5 * np.sqrt(variance))
    for beam in range(signals.network.beams):
        logarithm = np.log(power[beam] * signals.range**2)
        crossing_ranges, points = signals.network.on_beam(beam)[1], []
        for distance in crossing_ranges:
            middle = int(np.argmin(np.abs(signals.range - distance)))
            bins = slice(middle - THRESHOLDS.fit_bins // 2, middle + THRESHOLDS.fit_bins // 2 + 1)
            fit = np.polynomial.Polynomial.fit(signals.range[bins] - distance, logarithm[bins], 1)
            points.append(float(fit(0.0)))
            noise = np.sqrt(variance[beam, bins]) / power[beam, bins]
            errors.append(float(noise.mean() / np.sqrt(THRESHOLDS.fit_bins)))
        values += points
        total = 0.0
        for k, distance in enumerate(crossing_ranges):
            if k:
                inside = (signals.range > crossing_ranges[k - 1]) & (signals.range < distance)
                x = np.concatenate([[crossing_ranges[k - 1]], signals.range[inside], [distance]])
                y = np.concatenate([[points[k - 1]], logarithm[inside], [points[k]]])
                total += _log_trapezoid(x, y)
            integrals.append(total)
    return np.array(values), np.array(errors), np.array(integrals)


def _log_trapezoid(x: Array, logarithm: Array) -> float:
    """Return the integral of a function that is exponential between points."""
    rise = np.diff(logarithm)
    constant = np.abs(rise) < 1e-6
    mean = np.where(constant, 1.0, np.expm1(rise) / np.where(constant, 1.0, rise))
    return float(np.sum(np.diff(x) * np.exp(logarithm[:-1]) * mean))


def _fit_network(values: Array, errors: Array, integrals: Array, signals: Signals) -> Array:
    net = signals.network
    beam, crossing = net.passages.beam, net.passages.crossing
    first = np.searchsorted(beam, np.arange(net.beams))
    last = np.searchsorted(beam, np.arange(net.beams), side="right") - 1
    drop = np.exp(values[first]) - np.exp(values[last])
    slope = max(float(np.median(drop / (2.0 * integrals[last]))), _LEAST_SLOPE)
    start = np.concatenate([np.full(net.crossings, np.log(slope)), values[first] - np.log(slope)])

    def residuals(unknown: Array) -> Array:
        extinction, constant = unknown[crossing], np.exp(unknown[net.crossings + beam])
        remaining = np.maximum(constant - 2.0 * integrals, 1e-9 * constant)
        return np.asarray((np.log(remaining) + extinction - values) / errors)

    return np.asarray(np.exp(least_squares(residuals, start, x_scale="jac").x[: net.crossings]))
