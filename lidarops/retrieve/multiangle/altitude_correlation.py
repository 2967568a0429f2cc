"""Correlation of the air along altitude, from residuals of beams, and the resulting precision."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_HALF: Final = THRESHOLDS.pooled // 2
"""Altitudes on either side over which is pooled."""


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
    sums = np.zeros((4, noise.shape[0], noise.shape[2]))
    _add_neighbours(residual, noise, leverage, variance, sums)
    products, norms, changed, spare = sums
    pairs = (changed > 0.0) & (norms > 0.0)
    pairs[:, :-1] &= np.minimum(spare[:, 1:], spare[:, :-1]) > 0.5
    if pairs.any():
        norms[pairs] *= _common_share(noise < np.inf, leverage, columns, *np.nonzero(pairs))
    norm = float(norms.sum())
    return min(max(float(products.sum()) / norm, 0.0), THRESHOLDS.most_correlated) if norm else 0.0


@compiled
def _add_neighbours(
    residual: Array, noise: Array, leverage: Array, variance: Array, sums: Array
) -> None:
    """Add over beams products at an altitude and the next, with their expectation in equal air.

    And the numbers of beams that begin or end, and of degrees of freedom: (4, profile, altitude).
    """
    altitudes = noise.shape[2]
    value, expected = np.empty(altitudes), np.empty(altitudes)
    for t in range(noise.shape[0]):
        for a in range(noise.shape[1]):
            for k in range(altitudes):
                free = variance[k] * max(1.0 - leverage[t, a, k], 0.0)
                expected[k] = free / (noise[t, a, k] + variance[k])
                weight = math.sqrt(free) / (noise[t, a, k] + variance[k])
                value[k] = residual[t, a, k] * weight if weight > 0.0 else 0.0
                sums[3, t, k] += 1.0 - leverage[t, a, k] if noise[t, a, k] < np.inf else 0.0
            for k in range(altitudes - 1):
                sums[0, t, k] += value[k] * value[k + 1]
                sums[1, t, k] += expected[k] * expected[k + 1]
                sums[2, t, k] += (noise[t, a, k] < np.inf) != (noise[t, a, k + 1] < np.inf)


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
def windowed(values: Array) -> Array:
    """Return sums over the window around each altitude, (altitude,), cut at the ends."""
    out = np.zeros(values.size)
    for k in range(values.size):
        for j in range(max(k - _HALF, 0), min(k + _HALF + 1, values.size)):
            out[k] += values[j]
    return out


@compiled
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
    altitudes, profiles = information.shape
    joint, bands = _mean_covariances(information, shared), np.zeros((2, altitudes, profiles))
    own, air, along = np.zeros(altitudes + 1), np.zeros(altitudes + 1), np.zeros(altitudes + 1)
    odds = 2.0 * correlation / (1.0 - correlation)
    for t in range(profiles):
        sums = 0.0
        for k in range(altitudes):
            down, up = joint[k, t], joint[k + 1, t]
            own[k] = 1.0 / information[k, t] if information[k, t] > 0.0 else 0.0
            pairs = max((1.0 if down >= 0.0 else 0.0) + (1.0 if up >= 0.0 else 0.0), 1.0)
            air[k] = math.sqrt(min((max(down, 0.0) + max(up, 0.0)) / pairs, own[k]))
            sums = correlation * (sums + air[k - 1]) if down >= 0.0 else 0.0
            along[k] = own[k] + air[k] * sums
        for k in range(altitudes - 1, -1, -1):
            sums = correlation * (sums + air[k + 1]) if joint[k + 1, t] >= 0.0 else 0.0
            along[k] += air[k] * sums
            bands[0, k, t] = 1.0 if own[k] > 0.0 else 0.0
        for k in range(altitudes - 1):
            if joint[k + 1, t] >= 0.0:
                variance = 0.5 * (own[k + 1] + own[k])
                both = min(joint[k + 1, t], variance)
                slow = 1.0 / (variance + both * odds)
                product = 2.0 * (variance - both * correlation) * slow
                u = 0.125 * (product + math.sqrt(product * (product + 16.0)))
                link = 0.25 * slow * (1.0 / (u * u) - 1.0)
                bands[0, k, t] += link * along[k + 1]
                bands[0, k + 1, t] += link * along[k]
                bands[1, k, t] = -link
        for k in range(altitudes):
            bands[0, k, t] /= along[k] if own[k] > 0.0 else 1.0
    return bands


@compiled
def _mean_covariances(information: Array, shared: Array) -> Array:
    """Return the covariances of neighbours in equal air, means over 15 altitudes.

    (altitude + 1, profile): of an altitude with the one below, -1 where either has no estimate.
    Weighted by information: where samples are missing, neighbours see the air along different
    beams, but altitudes a few steps apart do not see less of it in common.
    """
    pairs, profiles = shared.shape
    both, joint = information[1:] * information[:-1], np.zeros(shared.shape)
    for k in range(pairs):
        for t in range(profiles):
            joint[k, t] = max(shared[k, t], 0.0) * math.sqrt(both[k, t])
    out, weight = np.full((pairs + 2, profiles), -1.0), np.empty(profiles)
    for k in range(pairs):
        out[k + 1], weight[:] = 0.0, 0.0
        for j in range(max(k - _HALF, 0), min(k + _HALF + 1, pairs)):
            for t in range(profiles):
                out[k + 1, t] += joint[j, t]
                weight[t] += both[j, t]
        for t in range(profiles):
            out[k + 1, t] = out[k + 1, t] / weight[t] if both[k, t] > 0.0 else -1.0
    return out
