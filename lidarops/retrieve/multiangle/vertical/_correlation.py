"""Correlation of noise along altitude, estimated from residuals, and the resulting precision."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

LAGS: Final = 3
"""Largest distance of residuals that are multiplied, in altitudes."""
_LINKED: Final = THRESHOLDS.linked
_CANDIDATES: Final = np.arange(99) / 100.0
"""Correlations to choose from."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class ResidualMoments:
    """Sums over the residuals of beams, from which the noise of optical depths is estimated.

    Returned by `smooth_profile.residual_moments`. The correlation along altitude and the standard
    errors depend on them.
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


@_compiled
def lag_sums(
    residual: Array, weight: Array, leverage: Array, variance: Array
) -> tuple[Array, Array, Array]:
    """Return sums of products of residuals along altitude, and their values at full correlation.

    Each product is weighted by the share of the inhomogeneity in it: where noise dominates, the
    products show errors along a beam, such as those of the background, not the air.

    Parameters
    ----------
    residual, weight, leverage : (profile, beam, altitude) float64
    variance : (altitude,) float64
        Of the inhomogeneity.

    Returns
    -------
    products, norms : (profile, 3) float64
    freedom : (profile, altitude) float64
        Number of beams used minus 2, at least 0.
    """
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


def fit_correlation(products: Array, norms: Array) -> tuple[float, float]:
    r"""Fit :math:`\phi \rho^h` to the pooled lag ratios of a block.

    Detector noise is not correlated along altitude, so :math:`\phi` may be less than 1. With a
    ratio below 0.1 at the first lag, the decay cannot be estimated, and :math:`\phi` is 1.

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
    if ratio[0] < THRESHOLDS.simple_below:
        return (float(ratio[0]) if ratio[0] >= THRESHOLDS.none_below else 0.0), 1.0
    shape = _CANDIDATES[:, np.newaxis] ** np.arange(1, LAGS + 1)
    square = np.maximum((shape**2).sum(axis=1), np.finfo(np.float64).tiny)
    amplitude = np.clip(
        (shape * ratio).sum(axis=1) / square,
        THRESHOLDS.least_amplitude,
        THRESHOLDS.largest_amplitude,
    )
    misfit = ((ratio - amplitude[:, np.newaxis] * shape) ** 2).sum(axis=1)
    best = int(np.argmin(misfit))
    return min(float(_CANDIDATES[best]), THRESHOLDS.largest_correlation), float(amplitude[best])


@_compiled
def correlated_precision(information: Array, share: Array, correlation: float) -> Array:
    r"""Return the precision of the estimates as an autoregressive process along altitude.

    Noise of which only a share f is correlated is not such a process. The one used here has the
    same variance and the same power at low frequencies, which contain the smooth profile:
    :math:`q = 1 + 2 f \rho / (1 - \rho)`, :math:`r = (q - 1) / (q + 1)`. An altitude whose
    correlated share is less than half of that of one of the two on either side is not linked: most
    of its noise is its own and does not predict that of its neighbours. It is bridged like a single
    missing altitude; a longer gap breaks the chain.

    Parameters
    ----------
    information : (profile, altitude) float64
        0 where there is no estimate.
    share : (profile, altitude) float64
        Correlated share of the variance.
    correlation : float
        Correlation of that noise at neighbouring altitudes.

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
            if share[t, k] < _LINKED * np.max(share[t, max(k - 2, 0) : k + 3]):
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
