"""Noise along height: its correlation from residuals, and the precision that follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

LAGS: Final = 3
LARGEST: Final = 0.97
_NONE_BELOW: Final = 0.05
_SIMPLE_BELOW: Final = 0.1
_AMPLITUDES: Final = (0.5, 1.05)
_LINKED: Final = 0.5
_CANDIDATES: Final = np.arange(99) / 100.0

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class ResidualMoments:
    """What the residuals of the beams tell about the noise of the optical depths.

    Made by `lidarops.retrieve.multiangle.vertical.smooth_profile.residual_moments`. The correlation along height and the
    standard errors need it.
    """

    lag_products: Array
    """(profile, 3): sums over beams and heights of products of weighted residuals 1, 2 and 3
    heights apart, weighted by the share of the inhomogeneity in them."""
    lag_norms: Array
    """(profile, 3): the same sums, where the inhomogeneity is wholly correlated."""
    inhomogeneity_share: Array
    """(profile, height): share of the inhomogeneity in the variance of the optical depth, 0..1."""
    degrees_of_freedom: Array
    """(profile, height): beams used less 2, at least 0."""
    gaps: Booleans
    """(profile,): whether samples are missing between others, so that neighbouring heights come
    from other beams."""


@_compiled
def lag_sums(
    residual: Array, weight: Array, leverage: Array, variance: Array
) -> tuple[Array, Array, Array]:
    """Sum products of weighted residuals along height, and what they are for full correlation.

    Each product counts by the share of the inhomogeneity in it: where noise dominates, it tells
    of errors that beams have in common with themselves, as of a background, not of the air.

    Parameters
    ----------
    residual, weight, leverage : (profile, beam, height) float64
    variance : (profile, height) float64
        Of the inhomogeneity.

    Returns
    -------
    products, norms : (profile, 3) float64
    freedom : (profile, height) float64
        Beams used less 2, at least 0.
    """
    profiles, beams, heights = residual.shape
    products, norms = np.zeros((profiles, LAGS)), np.zeros((profiles, LAGS))
    freedom = np.zeros((profiles, heights))
    weighted, spread = np.zeros(heights), np.zeros(heights)
    for t in range(profiles):
        for beam in range(beams):
            for k in range(heights):
                w = weight[t, beam, k]
                share = w * variance[t, k] * (1.0 - leverage[t, beam, k])
                u = residual[t, beam, k] * np.sqrt(w)
                used = w > 0.0 and np.isfinite(u) and share > 0.0
                freedom[t, k] += 1.0 if w > 0.0 and np.isfinite(u) else 0.0
                weighted[k] = u if used else 0.0
                spread[k] = np.sqrt(share) if used else 0.0
            for lag in range(1, LAGS + 1):
                product = norm = 0.0
                for k in range(heights - lag):
                    joint = spread[k] * spread[k + lag]
                    if joint > 0.0:
                        product += joint * weighted[k] * weighted[k + lag]
                        norm += joint * joint
                products[t, lag - 1] += product
                norms[t, lag - 1] += norm
        for k in range(heights):
            freedom[t, k] = max(freedom[t, k] - 2.0, 0.0)
    return products, norms, freedom


def fit_correlation(products: Array, norms: Array) -> tuple[float, float]:
    r"""Fit :math:`\phi \rho^h` to the pooled lag ratios of a block.

    Detector noise is not correlated along height, so :math:`\phi` may be less than 1. Below a
    ratio of 0.1 at the first lag the decay cannot be told, and :math:`\phi` is 1.

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
    if ratio[0] < _SIMPLE_BELOW:
        return (float(ratio[0]) if ratio[0] >= _NONE_BELOW else 0.0), 1.0
    shape = _CANDIDATES[:, np.newaxis] ** np.arange(1, LAGS + 1)
    square = np.maximum((shape**2).sum(axis=1), np.finfo(np.float64).tiny)
    amplitude = np.clip((shape * ratio).sum(axis=1) / square, *_AMPLITUDES)
    misfit = ((ratio - amplitude[:, np.newaxis] * shape) ** 2).sum(axis=1)
    best = int(np.argmin(misfit))
    return min(float(_CANDIDATES[best]), LARGEST), float(amplitude[best])


@_compiled
def correlated_precision(information: Array, share: Array, correlation: float) -> Array:
    r"""Return the precision of the estimates as an autoregressive process along height.

    Noise of which only a share is correlated is no such process. The one here has its variance
    and its power at low frequencies, which is where the smooth profile lies:
    :math:`q = 1 + 2 f \rho / (1 - \rho)`, :math:`r = (q - 1) / (q + 1)`. A height that
    shares less than half as much as one of the two on either side is no link of the chain: its
    noise is its own, and would tell wrongly of that of its neighbours. It is bridged, as a single
    missing height is; a longer hole breaks the chain.

    Parameters
    ----------
    information : (profile, height) float64
        0 where there is no estimate.
    share : (profile, height) float64
        Correlated share of the variance.
    correlation : float
        At neighbouring heights.

    Returns
    -------
    (3, profile, height) float64
        Diagonal, and the first and second off-diagonals (of a height with those above it).
    """
    profiles, heights = information.shape
    bands = np.zeros((3, profiles, heights))
    decay = 2.0 * correlation / (1.0 - correlation)
    for t in range(profiles):
        last, joint = -1, 0.0
        for k in range(heights):
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
