"""Scans of clear air and of a cloud, and optical depths of single altitudes.

The estimates come from plain NumPy (weighted Kano-Hamilton with the inhomogeneity variance of
DerSimonian and Laird), so that the vertical solution is tested on its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from lidarops.retrieve.multiangle import labeled
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlation_of_air
from lidarops.retrieve.multiangle.optical_depth import OpticalDepthSettings
from support.scan_arguments import altitude_cycles

WINDOW = 15
FEWEST_BEAMS = 3


@dataclass(frozen=True)
class Scene:
    """A scan of a known atmosphere; altitudes above the lidar (or the cloud base) in m."""

    altitude: np.ndarray
    truth: np.ndarray
    """(altitude,) or (profile, altitude) optical depth."""
    secant: np.ndarray
    inhomogeneity: float
    zenith_snr: np.ndarray
    """(altitude,): signal over noise of the vertical beam, without attenuation."""


@dataclass(frozen=True)
class Estimates:
    """Optical depths of single altitudes, and their noise."""

    optical_depth: np.ndarray
    information: np.ndarray
    noise: AltitudeNoise
    slope: np.ndarray
    """(profile, altitude): of the weighted regression of tan(zenith angle) on the secant."""


def clear_depth(altitude, aerosol=1.0, layer=3000.0):
    """Return the optical depth of air, haze and a layer aloft; 0.157 up to 6.15 km."""
    z = np.asarray(altitude, dtype=np.float64)
    molecules = 0.0131e-3 * 8000.0 * -np.expm1(-z / 8000.0)
    haze = 0.05e-3 * 1200.0 * -np.expm1(-z / 1200.0)
    width = 400.0
    aloft = 0.04e-3 * width * np.sqrt(0.5 * np.pi)
    aloft = aloft * (erf((z - layer) / (width * np.sqrt(2.0))) + erf(layer / width / np.sqrt(2.0)))
    return molecules + aerosol * (haze + aloft)


def clear(snr, *, inhomogeneity=0.03, largest=75.0, beams=12, aerosol=1.0, layer=3000.0):
    """Return 12 beams to 75 degree, uniform in the secant; `snr` is at the zenith in 1 km."""
    altitude = 150.0 + 30.0 * np.arange(201)
    fine = np.arange(0.0, 7000.0, 10.0)
    backscatter = np.gradient(clear_depth(fine), fine)
    relative = np.interp(altitude, fine, backscatter) / np.interp(1000.0, fine, backscatter)
    relative = relative * np.exp(2.0 * clear_depth(1000.0))
    per_profile = clear_depth(
        altitude, np.asarray(aerosol)[..., np.newaxis], np.asarray(layer)[..., np.newaxis]
    )
    zenith = snr * relative * (1000.0 / altitude) ** 2
    secant = np.linspace(1.0, 1.0 / np.cos(np.radians(largest)), beams)
    return Scene(altitude, per_profile, secant, inhomogeneity, zenith)


def cloud(*, largest=30.0, beams=6, inhomogeneity=0.144):
    """Return a cloud of eight layers of 50 m, optical depth 4.4, on 40 altitudes above the base."""
    extinction = np.repeat([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0], 5) * 1e-3
    altitude = 10.0 * np.arange(1, 41)
    return Scene(
        altitude,
        np.cumsum(extinction * 10.0),
        1.0 / np.cos(np.radians(np.linspace(0.0, largest, beams))),
        inhomogeneity,
        np.full(40, 1e9),
    )


def simulate(scene, profiles, rng, correlation=0.0, *, outliers=0.0):
    """Return noisy logarithms (profile, beam, altitude) and the variance of their detector noise.

    Altitudes are NaN from the first one with an expected signal over noise below 3 upwards.
    """
    x = scene.secant[:, np.newaxis]
    truth = np.broadcast_to(scene.truth, (profiles, scene.altitude.size))[:, np.newaxis, :]
    shape = (profiles, x.size, scene.altitude.size)
    noise = rng.normal(size=shape)
    for k in range(1, shape[2]):
        noise[..., k] *= np.sqrt(1.0 - correlation**2)
        noise[..., k] += correlation * noise[..., k - 1]
    deep = scene.zenith_snr[0] > 1e8
    # Detector noise is negligible in the cloud scene, which tests inhomogeneity.
    path = np.zeros(shape) if deep else 2.0 * x * truth
    snr = scene.zenith_snr * np.exp(-path) / x**2
    dark = np.maximum.accumulate(snr < 3.0, axis=2)
    snr = np.where(dark, np.nan, snr)
    ratio = 1.0 + rng.normal(size=shape) / snr
    with np.errstate(invalid="ignore"):
        logarithm = np.log(ratio) + 0.5 / snr**2 - 2.0 * x * truth + scene.inhomogeneity * noise
    if outliers:
        hit = rng.random(shape) < outliers
        logarithm += hit * rng.uniform(0.3, 1.0, shape)
    # Variance of the logarithm of a normal deviate, to second order.
    variance = np.broadcast_to(1.0 / snr**2 + 2.5 / snr**4, shape)
    return logarithm, np.where(np.isfinite(logarithm), variance, np.nan)


def _regress(y, x, w):
    """Fit lines over beams; return slope, residual, leverage, centred path and its square sum."""
    total = w.sum(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        centred = x - (w * x).sum(axis=1, keepdims=True) / total
        square = (w * centred**2).sum(axis=1, keepdims=True)
        slope = (w * centred * y).sum(axis=1, keepdims=True) / square
        mean = (w * y).sum(axis=1, keepdims=True) / total
        leverage = w * (1.0 / total + centred**2 / square)
    return slope, np.where(w > 0.0, y - mean - slope * centred, 0.0), leverage, centred, square


def _pooled(values):
    """Sum over the block and over a window of altitudes, cut at the ends of the grid."""
    return np.convolve(np.nansum(values, axis=(0, 1)), np.ones(WINDOW), "same")


def _weights(variance, inhomogeneity):
    w = 1.0 / (variance + inhomogeneity)
    w = np.where(np.isfinite(w), w, 0.0)
    return w * ((w > 0.0).sum(axis=1, keepdims=True) >= FEWEST_BEAMS)


def kano_hamilton(scene, logarithm, variance):
    """Return optical depth and information at single altitudes of one block."""
    x = scene.secant[np.newaxis, :, np.newaxis]
    y = np.where(np.isfinite(variance), logarithm, 0.0)
    start = scene.inhomogeneity**2
    w = _weights(variance, start)
    _, residual, leverage, _, _ = _regress(y, x, w)
    excess = _pooled(w * residual**2 - (w > 0.0) * (1.0 - leverage))
    between = start + excess / np.maximum(_pooled(w * (1.0 - leverage)), 1e-300)
    between = np.maximum(between, 0.0)
    w = _weights(variance, between)
    slope, residual, leverage, centred, square = _regress(y, x, w)
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = np.tan(np.arccos(1.0 / x))
        slant = (w * centred * tangent).sum(axis=1) / square[:, 0]
        lever = w * centred / np.sqrt(square)
    shared = np.nan_to_num((lever[..., 1:] * lever[..., :-1]).sum(axis=1))
    shared = np.clip(shared * np.sqrt(between[1:] * between[:-1]), 0.0, 1.0)
    used = w > 0.0
    residual, noise = np.where(used, residual, np.nan), np.where(used, variance, np.inf)
    leverage = np.where(used, np.nan_to_num(leverage, nan=1.0), 1.0)
    path = np.repeat(scene.secant[:, np.newaxis], between.size, axis=1)
    columns = np.stack([np.ones_like(path), path])
    correlation = correlation_of_air(residual, noise, leverage, between, columns)
    freedom = _pooled(np.maximum(used.sum(axis=1, keepdims=True) - 2.0, 0.0))
    noise_of_depth = AltitudeNoise(correlation, shared, freedom)
    return Estimates(-0.5 * slope[:, 0], 4.0 * square[:, 0], noise_of_depth, slant)


def retrieve_scan(conditioned, *, station_altitude, **arguments):
    """Return the multiangle product of conditioned profiles, in memory."""
    method = {
        name: arguments.pop(name)
        for name in ("method", "largest_gradient", "layers")
        if name in arguments
    }
    beams = on_altitudes(conditioned, station_altitude=station_altitude, **arguments)
    settings = OpticalDepthSettings(station_altitude=station_altitude, **method)
    return labeled.retrieve_optical_depth(beams, settings)


def on_altitudes(conditioned, **arguments):
    """Return the cycles of all profiles of a scan on common altitudes."""
    cycles = altitude_cycles(conditioned["range"].to_numpy(), **arguments)
    cycles.add(conditioned, 0)
    return cycles.result()


def estimates(scene, profiles, rng, correlation=0.0, *, outliers=0.0):
    """Return the estimates of a simulated scan."""
    return kano_hamilton(scene, *simulate(scene, profiles, rng, correlation, outliers=outliers))
