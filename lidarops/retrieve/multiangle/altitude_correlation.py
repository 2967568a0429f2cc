"""Correlation of the air along altitude, from residuals of beams, and the resulting precision."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
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


@compiled
def _traces(sums: Array, joint: Array, sides: Array, k: int) -> float:
    """Return the trace of the product of what the fits of an altitude and the next leave.

    For beams of equal weight, of which some may be missing at one of both.

    Parameters
    ----------
    sums : (3, altitude) float
        Number of beams, and sums of their paths and squared paths.
    joint : (4, altitude) float
        The same of the beams at both, and the sum of 1 minus both leverages.
    sides : (altitude,) float
        Number of gradients that are fitted.
    k : int
    """
    n, after, both = sums[0, k], sums[0, k + 1], joint[0, k]
    mean, mean_after = sums[1, k] / n, sums[1, k + 1] / after
    square = sums[2, k] - n * mean * mean
    square_after = sums[2, k + 1] - after * mean_after * mean_after
    line = joint[1, k] - both * mean
    line_after = joint[1, k] - both * mean_after
    slope = joint[2, k] - (mean + mean_after) * joint[1, k] + both * mean * mean_after
    lost = both**2 / (n * after) + line_after**2 / (n * square_after)
    lost += line**2 / (after * square) + slope**2 / (square * square_after)
    return float(joint[3, k] + lost + min(sides[k], sides[k + 1]))


@compiled
def _neighbour_products(
    residual: Array, noise: Array, leverage: Array, variance: Array, path: Array, sides: Array
) -> tuple[float, float]:
    """Return the weighted sum of products of neighbours, and its expectation for equal air."""
    profiles, beams, altitudes = residual.shape
    value, free, weight = np.empty(altitudes), np.empty(altitudes), np.empty(altitudes)
    sums, joint, pairs = (
        np.empty((3, altitudes)),
        np.empty((4, altitudes)),
        np.empty((3, altitudes)),
    )
    scatter = np.sqrt(variance)
    product = norm = 0.0
    for t in range(profiles):
        sums[:], joint[:], pairs[:] = 0.0, 0.0, 0.0
        for beam in range(beams):
            x = path[beam]
            for k in range(altitudes):
                used = noise[t, beam, k] < np.inf and leverage[t, beam, k] < 1.0
                free[k] = math.sqrt(1.0 - leverage[t, beam, k]) if used else 0.0
                weight[k] = scatter[k] * free[k] / (noise[t, beam, k] + variance[k])
                value[k] = residual[t, beam, k] * weight[k] if weight[k] > 0.0 else 0.0
                on = 1.0 if used else 0.0
                sums[0, k] += on
                sums[1, k] += on * x[k]
                sums[2, k] += on * x[k] * x[k]
            for k in range(altitudes - 1):
                on = 1.0 if free[k] * free[k + 1] > 0.0 else 0.0
                joint[0, k] += on
                joint[1, k] += on * x[k]
                joint[2, k] += on * x[k] * x[k]
                joint[3, k] += on * (free[k] * free[k] + free[k + 1] * free[k + 1] - 1.0)
                pairs[0, k] += free[k] * free[k + 1]
                pairs[1, k] += value[k] * value[k + 1]
                expected = weight[k] * weight[k + 1] * free[k] * free[k + 1]
                pairs[2, k] += scatter[k] * scatter[k + 1] * expected
        for k in range(altitudes - 1):
            if pairs[2, k] > 0.0 and min(sums[0, k], sums[0, k + 1]) > 2.0:
                share = _traces(sums, joint, sides[t], k) / pairs[0, k]
                product += pairs[1, k]
                norm += pairs[2, k] * min(max(share, 0.0), 1.0)
    return product, norm


def correlation_of_air(
    residual: Array, noise: Array, leverage: Array, variance: Array, path: Array, sides: Array
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
        Diagonal of the hat matrix, :math:`h = w (1 / \sum w + (x - \bar x)^2 / S_{xx})`.
    variance : (altitude,) float64
        Of the air, :math:`s^2`.
    path : (beam, altitude) float64
        Slant over vertical path.
    sides : (profile, altitude) float64
        Number of gradients that are fitted.
    """
    product, norm = _neighbour_products(residual, noise, leverage, variance, path, sides)
    return min(max(product / norm, 0.0), THRESHOLDS.most_correlated) if norm > 0.0 else 0.0


@compiled
def _mean_covariances(information: Array, shared: Array, joint: Array) -> Booleans:
    """Fill the covariances of neighbours in equal air, and return where both are known.

    They are means over 15 altitudes, weighted by information: where samples are missing, neighbours
    see the air along different beams, but altitudes a few steps apart do not see less of it in
    common. The first and the last place are those of neighbours outside the grid.
    """
    links, half = np.zeros(joint.size, np.bool_), THRESHOLDS.pooled // 2
    both = np.zeros(joint.size)
    for k in range(1, joint.size - 1):
        both[k] = information[k - 1] * information[k]
        links[k] = both[k] > 0.0
    for k in range(joint.size):
        total = weight = 0.0
        for j in range(max(k - half, 1), min(k + half + 1, joint.size - 1)):
            total += shared[j - 1] * math.sqrt(both[j])
            weight += both[j]
        joint[k] = max(total / weight, 0.0) if links[k] else 0.0
    return links


@compiled
def _covariance_sums(
    information: Array, joint: Array, links: Booleans, correlation: float, sums: Array
) -> None:
    """Fill the sums over the covariances of each error with itself and all that it is linked to."""
    air, along = np.zeros(sums.size), 0.0
    for k in range(sums.size):
        n = (1.0 if links[k] else 0.0) + (1.0 if links[k + 1] else 0.0)
        sums[k] = 1.0 / information[k] if information[k] > 0.0 else 0.0
        air[k] = math.sqrt(min((joint[k] + joint[k + 1]) / max(n, 1.0), sums[k]))
    for k in range(1, sums.size):
        along = correlation * (along + air[k - 1]) if links[k] else 0.0
        sums[k] += air[k] * along
    along = 0.0
    for k in range(sums.size - 2, -1, -1):
        along = correlation * (along + air[k + 1]) if links[k + 1] else 0.0
        sums[k] += air[k] * along


@compiled
def correlated_precision(information: Array, shared: Array, correlation: float) -> Array:
    """Return the precision of the estimates as a chain along altitude.

    Formula 1 of ``docs/algorithms/vertical.md``. A missing estimate breaks the chain.

    Parameters
    ----------
    information : (profile, altitude) float64
        0 where there is no estimate.
    shared : (profile, altitude - 1) float64
        See `AltitudeNoise`.
    correlation : float
        Of the air at neighbouring altitudes.

    Returns
    -------
    (2, profile, altitude) float64
        Diagonal, and the off-diagonal (of an altitude with the one above it).
    """
    profiles, altitudes = information.shape
    bands, joint = np.zeros((2, profiles, altitudes)), np.empty(altitudes + 1)
    sums, far = np.empty(altitudes), 2.0 * correlation / (1.0 - correlation)
    for t in range(profiles):
        own = information[t]
        links = _mean_covariances(own, shared[t], joint)
        _covariance_sums(own, joint, links, correlation, sums)
        for k in range(altitudes):
            bands[0, t, k] = 1.0 if own[k] > 0.0 else 0.0
        for k in range(altitudes - 1):
            if links[k + 1]:
                variance = 0.5 / own[k] + 0.5 / own[k + 1]
                both = min(joint[k + 1], variance)
                slow = 1.0 / (variance + both * far)
                product = 2.0 * (variance - both * correlation) * slow
                u = 0.125 * (product + math.sqrt(product * (product + 16.0)))
                link = 0.25 * slow * (1.0 - u * u) / (u * u)
                bands[0, t, k] += link * sums[k + 1]
                bands[0, t, k + 1] += link * sums[k]
                bands[1, t, k] = -link
        for k in range(altitudes):
            bands[0, t, k] /= sums[k] if own[k] > 0.0 else 1.0
    return bands
