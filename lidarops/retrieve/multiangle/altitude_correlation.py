"""Correlation of noise along altitude, estimated from residuals, and the resulting precision."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

LAGS: Final = 3
"""Largest distance of residuals that are multiplied, in altitudes."""
_FARTHEST: Final = 2
"""Largest distance of linked altitudes."""
_CANDIDATES: Final = np.arange(98) / 100.0
"""Correlations to choose from; beyond `highest_correlation` they are flagged, and 1 is excluded
because its noise has no finite power at low frequencies (formula 1 of the page)."""


@dataclass(frozen=True, slots=True)
class ResidualMoments:
    """Sums over the residuals of beams, from which the noise of optical depths is estimated.

    The correlation along altitude and the standard errors depend on them.
    """

    lag_products: Array
    """(profile, 3): sums over beams and altitudes of products of weighted residuals 1, 2 and 3
    altitudes apart, weighted by the share of the inhomogeneity in them."""
    lag_norms: Array
    """(profile, 3): expectation of these sums if the inhomogeneity is fully correlated."""
    inhomogeneity_share: Array
    """(profile, altitude): share of the inhomogeneity in the variance of optical depth, 0..1."""
    degrees_of_freedom: Array
    """(profile, altitude): number of beams used minus 2, at least 0."""
    gaps: Booleans
    """(profile,): whether samples are missing between others, so that neighbouring altitudes come
    from different beams."""

    def of(self, profiles: Integers) -> ResidualMoments:
        """Return the moments of some profiles."""
        return ResidualMoments(*(getattr(self, field.name)[profiles] for field in fields(self)))


@compiled
def _lag_sums(
    residual: Array, weight: Array, leverage: Array, variance: Array
) -> tuple[Array, Array, Array]:
    profiles, beams, altitudes = residual.shape
    products, norms = np.zeros((profiles, LAGS)), np.zeros((profiles, LAGS))
    freedom = np.zeros((profiles, altitudes))
    weighted, spread = np.zeros(altitudes), np.zeros(altitudes)
    for t in range(profiles):
        for beam in range(beams):
            for k in range(altitudes):
                w = weight[t, beam, k]
                share = w * variance[k] * (1.0 - leverage[t, beam, k])
                u = residual[t, beam, k] * np.sqrt(w)
                used = w > 0.0 and np.isfinite(u) and share > 0.0
                freedom[t, k] += 1.0 if w > 0.0 and np.isfinite(u) else 0.0
                weighted[k] = u if used else 0.0
                spread[k] = np.sqrt(share) if used else 0.0
            for lag in range(1, LAGS + 1):
                product = norm = 0.0
                for k in range(altitudes - lag):
                    joint = spread[k] * spread[k + lag]
                    if joint > 0.0:
                        product += joint * weighted[k] * weighted[k + lag]
                        norm += joint * joint
                products[t, lag - 1] += product
                norms[t, lag - 1] += norm
        for k in range(altitudes):
            freedom[t, k] = max(freedom[t, k] - 2.0, 0.0)
    return products, norms, freedom


def residual_moments(
    residual: Array,
    weight: Array,
    leverage: Array,
    inhomogeneity_variance: Array,
    inhomogeneity_share: Array,
    gaps: Booleans,
) -> ResidualMoments:
    r"""Return sums over the residuals of a fit over beams.

    Each product is weighted by the share of the inhomogeneity in it: where noise dominates, the
    products show errors along a beam, such as those of the background, not the air.

    Parameters
    ----------
    residual : (profile, beam, altitude) float64
        Logarithm of the signal minus its fit.
    weight : (profile, beam, altitude) float64
        :math:`w = 1 / (v + s^2)`; zero or NaN where a beam was not used.
    leverage : (profile, beam, altitude) float64
        Diagonal of the hat matrix, :math:`h = w (1 / \sum w + (x - \bar x)^2 / S_{xx})`.
    inhomogeneity_variance : (altitude,) float64
        :math:`s^2`.
    inhomogeneity_share : (profile, altitude) float64
        :math:`f = s^2 \sum w^2 (x - \bar x)^2 / S_{xx}`, the share of :math:`s^2` in the
        variance of the optical depth.
    gaps : (profile,) bool
        Whether samples are missing between others, so that neighbouring altitudes come from
        different beams.
    """
    products, norms, freedom = _lag_sums(residual, weight, leverage, inhomogeneity_variance)
    share = np.clip(np.nan_to_num(inhomogeneity_share), 0.0, 1.0)
    return ResidualMoments(products, norms, share, freedom, gaps)


def fit_correlation(products: Array, norms: Array) -> tuple[float, float]:
    r"""Fit :math:`\phi \rho^h` to the pooled lag ratios of a block.

    Detector noise is not correlated along altitude, so :math:`\phi` may be less than 1.

    Parameters
    ----------
    products, norms : (profile, 3) float
        Of the profiles of one block.

    Returns
    -------
    correlation, amplitude : float
        :math:`\rho` within 0..0.97 and :math:`\phi` within 0.5..1.05.
    """
    norm = norms.sum(axis=0)
    if not np.all(norm > 0.0):
        return 0.0, 1.0
    ratio = products.sum(axis=0) / norm
    shape = _CANDIDATES[:, np.newaxis] ** np.arange(1, LAGS + 1)
    square = np.maximum((shape**2).sum(axis=1), np.finfo(np.float64).tiny)
    amplitude = np.clip(
        (shape * ratio).sum(axis=1) / square,
        THRESHOLDS.least_amplitude,
        THRESHOLDS.largest_amplitude,
    )
    misfit = ((ratio - amplitude[:, np.newaxis] * shape) ** 2).sum(axis=1)
    best = int(np.argmin(misfit))
    return (float(_CANDIDATES[best]), float(amplitude[best])) if best > 0 else (0.0, 1.0)


@compiled
def correlated_precision(information: Array, share: Array, correlation: float) -> Array:
    """Return the precision of the estimates as an autoregressive process along altitude.

    Formula 1 of ``docs/algorithms/vertical.md``. An altitude whose correlated share is less than
    half of that of one of the two on either side is not linked: most of its noise is its own and
    does not predict that of its neighbours. It is bridged like a single missing altitude; a longer
    gap breaks the chain.

    Parameters
    ----------
    information : (profile, altitude) float64
        0 where there is no estimate.
    share : (profile, altitude) float64
        Correlated share of the variance.
    correlation : float
        Of that noise at neighbouring altitudes.

    Returns
    -------
    (3, profile, altitude) float64
        Diagonal, and the first and second off-diagonals (of an altitude with those above it).
    """
    profiles, altitudes = information.shape
    bands = np.zeros((3, profiles, altitudes))
    decay = 2.0 * correlation / (1.0 - correlation)
    for t in range(profiles):
        last, joint = -1, 0.0
        for k in range(altitudes):
            q = share[t, k] * decay
            joint *= q / (q + 2.0)
            if not information[t, k] > 0.0:
                continue
            bands[0, t, k] = information[t, k]
            if share[t, k] < THRESHOLDS.linked * np.max(share[t, max(k - 2, 0) : k + 3]):
                continue
            step = k - last
            if last >= 0 and step <= 2 and joint > 0.0:
                rest = 1.0 - joint * joint
                bands[0, t, k] = information[t, k] / rest
                bands[0, t, last] += information[t, last] * joint * joint / rest
                across = np.sqrt(information[t, k]) * np.sqrt(information[t, last])
                bands[step, t, last] = -joint / rest * across
            last, joint = k, 1.0
    return bands


@compiled
def _link(information: Array, share: Array, linked: Booleans) -> None:
    """Fill which altitudes have at least half of the correlated share of those on either side."""
    for k in range(share.size):
        most = np.max(share[max(k - 2, 0) : k + 3])
        enough = share[k] > THRESHOLDS.least_correlated and share[k] >= THRESHOLDS.linked * most
        linked[k] = information[k] > 0.0 and enough


@compiled
def _own_noise(share: Array, linked: Booleans, k: int) -> float:
    """Return the mean over links around an altitude of own over correlated noise."""
    total = count = 0.0
    for j in range(
        max(k - THRESHOLDS.half_window, 0), min(k + THRESHOLDS.half_window + 1, share.size)
    ):
        if linked[j]:
            total += (1.0 - share[j]) / share[j]
            count += 1.0
    return total / count if count > 0.0 else 0.0


@compiled
def gap_precision(information: Array, share: Array, correlation: float) -> Array:
    """Return the precision of estimates whose neighbours come from different beams.

    Formula 2 of ``docs/algorithms/vertical.md``; parameters and shape as of
    `correlated_precision`.
    """
    profiles, altitudes = information.shape
    bands = np.zeros((3, profiles, altitudes))
    decay = 2.0 * correlation / (1.0 - correlation)
    linked = np.zeros(altitudes, np.bool_)
    for t in range(profiles):
        _link(information[t], share[t], linked)
        last, known = -1, 0.0
        for k in range(altitudes):
            own = information[t, k]
            if not (own > 0.0 and share[t, k] > THRESHOLDS.least_correlated):
                bands[0, t, k] = own
                continue
            usual = _own_noise(share[t], linked, k)
            q = decay / (1.0 + usual)
            r = q / (q + 2.0)
            if not linked[k]:
                left = (1.0 - r) * (1.0 - r) / (1.0 + r * r)
                bands[0, t, k] = left * own / (1.0 + share[t, k] * decay)
                continue
            ratio = (1.0 - share[t, k]) / share[t, k]
            level = 1.0 / (1.0 + usual + (1.0 - r) * (1.0 - r) * (ratio - usual))
            own *= level / share[t, k]
            step = k - last
            q = level * decay
            joint = (q / (q + 2.0)) ** step
            bands[0, t, k] = own
            if last >= 0 and step > _FARTHEST:
                bands[0, t, k] = own * (1.0 - joint) / (1.0 + joint)
            elif last >= 0:
                rest = 1.0 - joint * joint
                bands[0, t, k] = own / rest
                bands[0, t, last] += known * joint * joint / rest
                bands[step, t, last] = -joint / rest * np.sqrt(own) * np.sqrt(known)
            last, known = k, own
    return bands
