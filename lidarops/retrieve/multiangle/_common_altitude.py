"""Interpolation along beams, to the ranges at which they cross common altitudes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


def along_beam(
    signal: Array, variance: Array, distance: Array, target: Array
) -> tuple[Array, Array]:
    r"""Return signal and variance at the target ranges of a beam.

    The logarithm is a sum over the four bins beside,

    .. math:: \ln S(R) = \sum_j c_j \ln S_j, \qquad
              \sigma_S^2(R) = S^2 \sum_j c_j^2 \sigma_j^2 / S_j^2 ,

    with Lagrange's coefficients; over the two bins beside where one of the four is missing. This
    errs by 2e-6 on a layer of 50 m width (0.08 in ln S) in bins of 7.5 m. Ranges that share a bin
    have correlated noise. Where a bin is less than 30 times its noise, S itself is interpolated,
    so that its mean remains unbiased.

    Parameters
    ----------
    signal, variance : (..., range) float
        Range-corrected, without background.
    distance : (range,) float
        m, ascending; at least two.
    target : (altitude,) float
        m.

    Returns
    -------
    signal, variance : (..., altitude) float
        NaN where the beam does not reach the range, or a bin beside it is missing.
    """
    inside = (target >= distance[0]) & (target <= distance[-1])
    beside = np.clip(np.searchsorted(distance, target, side="right") - 1, 0, distance.size - 2)
    values = np.full((*signal.shape[:-1], target.size), np.nan)
    spread = values.copy()
    bins = [np.stack([beside, beside + 1])]
    if distance.size >= 4:
        bins.append(np.clip(beside - 1, 0, distance.size - 4) + np.arange(4)[:, np.newaxis])
    for nodes in bins:
        coefficients = _lagrange(distance[nodes], target)
        for interpolate in (_plain, _logarithmic):
            better, better_spread = interpolate(signal, variance, nodes, coefficients)
            good = np.isfinite(better)
            values[good] = better[good]
            spread[good] = better_spread[good]
    values[..., ~inside] = np.nan
    spread[..., ~inside] = np.nan
    return values, spread


def _lagrange(nodes: Array, target: Array) -> Array:
    """Return Lagrange's coefficients as (node, target)."""
    out = np.ones_like(nodes)
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                out[i] *= (target - other) / (node - other)
    return out


def _plain(values: Array, noise: Array, bins: Indices, coefficients: Array) -> tuple[Array, Array]:
    """Interpolate the signal itself."""
    used = coefficients != 0.0
    signal = np.where(used, coefficients * values[..., bins], 0.0).sum(axis=-2)
    spread = np.where(used, coefficients**2 * noise[..., bins], 0.0).sum(axis=-2)
    return signal, spread


def _logarithmic(
    values: Array, noise: Array, bins: Indices, coefficients: Array
) -> tuple[Array, Array]:
    """Interpolate the logarithm; NaN where a bin used is not well above its noise."""
    used = coefficients != 0.0
    nodes = values[..., bins]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        logarithm = np.where(used, coefficients * np.log(nodes), 0.0).sum(axis=-2)
        relative = np.where(used, coefficients**2 * noise[..., bins] / nodes**2, 0.0).sum(axis=-2)
        signal = np.exp(logarithm)
        spread = signal**2 * relative
    clear = (nodes > 0.0) & (nodes >= THRESHOLDS.clear_bin * np.sqrt(noise[..., bins]))
    good = (clear | ~used).all(axis=-2) & np.isfinite(spread)
    return np.where(good, signal, np.nan), np.where(good, spread, np.nan)
