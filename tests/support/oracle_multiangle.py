"""Atmospheres, scans and least squares to test multi-angle retrievals against."""

from __future__ import annotations

import numpy as np

PER_KM = 1e-3
PATHS = np.linspace(1.0, 1 / np.cos(np.radians(75.0)), 12)
ANGLES = np.degrees(np.arccos(1 / PATHS))
"""Twelve beams from the zenith to 75 degrees, evenly spaced in slant path."""


def clear(bins=201):
    """Return heights (m), extinction (m-1) and relative backscatter of a clear atmosphere."""
    height = 150.0 + 30.0 * np.arange(bins)
    air = 0.0116 * PER_KM * np.exp(-height / 8000)
    haze = 0.07 * np.exp(-height / 1200) + 0.05 * np.exp(-0.5 * ((height - 3000) / 150) ** 2)
    backscatter = air / 8.4 + haze * PER_KM / 50
    return height, air + haze * PER_KM, backscatter / np.interp(1000.0, height, backscatter)


def cloud(bins=40):
    """Return heights above its base (m), extinction (m-1) and backscatter of a cloud."""
    height = 10.0 * np.arange(1, bins + 1)
    layers = np.array([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0]) * PER_KM
    extinction = np.interp(height - 5.0, 25.0 + 50.0 * np.arange(8), layers)
    return height, extinction, np.ones(bins)


def depth(height, extinction):
    """Return optical depths of layers that end at each height."""
    return np.cumsum(extinction * np.diff(height, prepend=0.0))


def correlated(rng, shape, correlation):
    """Return unit normal numbers, correlated along the last axis."""
    out = rng.normal(size=shape)
    for k in range(1, shape[-1] if correlation else 0):
        out[..., k] = correlation * out[..., k - 1] + np.sqrt(1 - correlation**2) * out[..., k]
    return out


def signals(
    rng,
    profiles,
    angles,
    atmosphere,
    *,
    ratio=np.inf,
    inhomogeneity=0.0,
    correlation=0.0,
    outliers=0.0,
    gradient=0.0,
):
    """Return range-corrected signals, their variance and the optical depth.

    `ratio` is the signal over noise at the zenith in 1 km, `gradient` in m-1.
    """
    height, extinction, backscatter = atmosphere
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    tau = depth(height, extinction)
    mean = np.log(backscatter) - 2 * path * tau
    shape = (profiles, len(angles), height.size)
    logarithm = mean + inhomogeneity * correlated(rng, shape, correlation)
    logarithm += gradient * height * np.tan(np.radians(angles))[:, np.newaxis]
    logarithm += rng.uniform(0.3, 1.0, shape) * (rng.random(shape) < outliers)
    noise = np.interp(1000.0, height, np.exp(mean[0])) / ratio * (path * height / 1000.0) ** 2
    signal = np.exp(logarithm) + noise * rng.normal(size=shape)
    return signal, np.broadcast_to(noise**2, shape), tau


def least_squares(columns, y, variance):
    """Return coefficients and covariance of weighted least squares by numpy."""
    root = 1 / np.sqrt(variance)
    design = np.stack(columns, axis=-1) * root[:, np.newaxis]
    solution = np.linalg.lstsq(design, y * root, rcond=None)[0]
    return solution, np.linalg.inv(design.T @ design)


def coverage(error, standard_error):
    """Return percents of finite errors within 1 and 1.96 standard errors."""
    ratio = np.abs(error / standard_error)
    ratio = ratio[np.isfinite(ratio)]
    return 100 * np.mean(ratio < 1), 100 * np.mean(ratio < 1.96)


def rms(values):
    """Return the root mean square of the finite values."""
    return float(np.sqrt(np.nanmean(np.square(values))))
