"""Correlation of the air along altitude, from residuals of beams, and the resulting precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True)
class AltitudeNoise:
    """Noise of optical depths of single altitudes beside their variance."""

    correlation: float
    """Of the air at neighbouring altitudes."""
    shared: Array
    """(profile, altitude - 1): correlation of the errors at an altitude and the next if the air
    were the same at both; its correlation is that of the air times this."""
    freedom: Array
    """(altitude,): residual degrees of freedom from which the variance is known."""

    def of(self, profiles: Integers) -> AltitudeNoise:
        """Return the noise of some profiles."""
        return AltitudeNoise(self.correlation, self.shared[profiles], self.freedom)


def correlation_of_air(
    residual: Array, noise: Array, leverage: Array, variance: Array, columns: Array
) -> float:
    r"""Return the correlation of the air at neighbouring altitudes, 0 to 0.98.

    One step of scoring towards the largest restricted likelihood of a stationary autoregressive
    process, of which the variance is known: products of neighbouring residuals, weighted by the
    share of the air in them, over their expectation for equal air. Where noise dominates, the
    products show errors along a beam, such as those of the background, not the air.

    Parameters
    ----------
    residual, noise : (profile, beam, altitude) float64
        Logarithm of the signal minus its fit, and the variance of its noise; NaN and infinite where
        a beam was not used.
    leverage : (profile, beam, altitude) float64
        Diagonal of the hat matrix, 1 where a beam was not used.
    variance : (altitude,) float64
        Of the air, :math:`s^2`.
    columns : (column, beam, altitude) float64
        Of the fit: ones, slant path, and horizontal distances.
    """
    scatter, free = np.sqrt(variance), np.sqrt(np.maximum(1.0 - leverage, 0.0))
    weight = scatter * free / (noise + variance)
    value, expected = np.nan_to_num(residual) * weight, scatter * free * weight
    products = (value[..., 1:] * value[..., :-1]).sum(axis=1)
    norms = (expected[..., 1:] * expected[..., :-1]).sum(axis=1)
    on = noise < np.inf
    pairs = (on[..., 1:] != on[..., :-1]).any(axis=1) & (norms > 0.0)
    spare = on.sum(axis=1) - np.where(on, leverage, 0.0).sum(axis=1)
    pairs &= np.minimum(spare[:, 1:], spare[:, :-1]) > 0.5
    if pairs.any():
        norms[pairs] *= _common_share(on, leverage, columns, *np.nonzero(pairs))
    norm = float(norms.sum())
    return min(max(float(products.sum()) / norm, 0.0), THRESHOLDS.most_correlated) if norm else 0.0


def _common_share(on: Booleans, leverage: Array, columns: Array, t: Indices, k: Indices) -> Array:
    """Return the trace of the product of what the fits of altitudes k and k + 1 leave.

    Over the sum of the roots of what they leave of each beam: 1 if they use the same beams. For
    beams of equal weight. A fit has the first columns, as many as its leverages add up to.
    """
    bases = []
    for j in (k, k + 1):
        basis: list[Array] = []
        used = np.where(on[t, :, j], leverage[t, :, j], 0.0).sum(axis=1, keepdims=True)
        for number, column in enumerate(columns):
            own = np.where(on[t, :, j] & (number + 0.5 < used), column[:, j].T, 0.0)
            for other in basis:
                own = own - (own * other).sum(axis=1, keepdims=True) * other
            length = np.sqrt((own**2).sum(axis=1, keepdims=True))
            basis.append(np.divide(own, length, out=np.zeros_like(own), where=length > 0.0))
        bases.append(np.stack(basis))
    left = 1.0 - leverage[t, :, k], 1.0 - leverage[t, :, k + 1]
    both = on[t, :, k] & on[t, :, k + 1]
    trace = np.where(both, left[0] + left[1] - 1.0, 0.0).sum(axis=1)
    trace += np.square(np.einsum("ipb,jpb->pij", *bases)).sum(axis=(1, 2))
    free = np.sqrt(np.maximum(left[0] * left[1], 0.0)).sum(axis=1)
    return np.asarray(np.clip(trace / free, 0.0, 1.0))


@compiled
def decayed_sums(values: Array, linked: Booleans, decay: float) -> Array:
    """Return the sums of the values before, less by a factor for each step; 0 across a gap.

    Parameters
    ----------
    values : (altitude, profile) float
    linked : (altitude - 1, profile) bool
        Whether an altitude is linked with the next.
    decay : float
    """
    out = np.zeros_like(values)
    for k in range(1, len(values)):
        for t in range(values.shape[1]):
            along = decay * (out[k - 1, t] + values[k - 1, t])
            out[k, t] = along if linked[k - 1, t] else 0.0
    return out


def _mean_covariances(information: Array, shared: Array) -> Array:
    """Return the covariances of neighbours in equal air, means over 15 altitudes.

    Weighted by information: where samples are missing, neighbours see the air along different
    beams, but altitudes a few steps apart do not see less of it in common.
    """
    both = information[1:] * information[:-1]
    total, weight = (windowed(values) for values in (np.maximum(shared, 0.0) * np.sqrt(both), both))
    return np.asarray(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.0))


def windowed(values: Array) -> Array:
    """Return sums over the window around each altitude, the first axis, cut at the ends."""
    half, out = THRESHOLDS.pooled // 2, values.copy()
    for step in range(1, half + 1):
        out[step:] += values[:-step]
        out[:-step] += values[step:]
    return out


def correlated_precision(information: Array, shared: Array, correlation: float) -> Array:
    """Return the precision of the estimates as a chain along altitude.

    Formula 1 of ``docs/algorithms/vertical.md``. A missing estimate breaks the chain.

    Parameters
    ----------
    information : (altitude, profile) float64
        0 where there is no estimate.
    shared : (altitude - 1, profile) float64
        See `AltitudeNoise`.
    correlation : float
        Of the air at neighbouring altitudes.

    Returns
    -------
    (2, altitude, profile) float64
        Diagonal, and the off-diagonal (of an altitude with the one above it).
    """
    known = information > 0.0
    own = np.where(known, 1.0 / np.where(known, information, 1.0), 0.0)
    links = known[1:] & known[:-1]
    joint = np.where(links, _mean_covariances(information, shared), 0.0)
    around = np.pad(np.stack([links, joint]), ((0, 0), (1, 1), (0, 0)))
    count, both = around[:, 1:] + around[:, :-1]
    air = np.sqrt(np.minimum(both / np.maximum(count, 1.0), own))
    along = decayed_sums(air, links, correlation)
    along += decayed_sums(air[::-1].copy(), links[::-1].copy(), correlation)[::-1]
    sums = own + air * along
    variance = np.where(links, 0.5 * (own[1:] + own[:-1]), 1.0)
    both = np.minimum(joint, variance)
    slow = 1.0 / (variance + both * 2.0 * correlation / (1.0 - correlation))
    product = 2.0 * (variance - both * correlation) * slow
    u = 0.125 * (product + np.sqrt(product * (product + 16.0)))
    link = np.where(links, 0.25 * slow * (1.0 / (u * u) - 1.0), 0.0)
    bands = np.zeros((2, *own.shape))
    bands[0] = known
    bands[0, :-1] += link * sums[1:]
    bands[0, 1:] += link * sums[:-1]
    bands[0] /= np.where(known, sums, 1.0)
    bands[1, :-1] = -link
    return bands
