"""Calibration of the standard errors of a block, by the spread of a rougher solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import _banded

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

PILOT: Final = THRESHOLDS.pilot

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Calibration:
    """Inputs of the calibration of one block.

    The typical profile represents all profiles of the block in quantities that depend on weights
    only.
    """

    bands: Array
    """(3, altitude): precision of the typical profile."""
    information: Array
    """(altitude,): of the typical profile, 0 where there is no estimate."""
    share: Array
    """(altitude,): correlated share of its variance."""
    correlation: float
    """Correlation of the correlated noise at neighbouring altitudes."""
    stiffness: Array
    """(3, altitude): bands of the penalty on roughness."""
    smoothing: float
    """Weight of the penalty, in the unit of the system."""
    bias: Array
    """(profile, altitude): pilot solution minus its smoothed form; NaN beyond the reach."""
    scale: Array
    """(profile,): from `relative_squares`."""


@_compiled
def _factor(bands: Array, stiffness: Array, lam: float) -> Array:
    """Return reciprocal pivots and off-diagonals of L, (3, altitude)."""
    altitudes = bands.shape[1]
    f = np.zeros((3, altitudes))
    edge = far = farther = 0.0
    for k in range(altitudes):
        near_l = f[1, k - 1] if k > 0 else 0.0
        far_l = f[2, k - 2] if k > 1 else 0.0
        pivot = bands[0, k] + lam * stiffness[0, k] - near_l * edge - far_l * farther
        across = bands[1, k] + lam * stiffness[1, k] - near_l * far
        beyond = bands[2, k] + lam * stiffness[2, k]
        f[0, k], f[1, k], f[2, k] = 1.0 / pivot, across / pivot, beyond / pivot
        edge, farther, far = across, far, beyond
    return f


@_compiled
def _substitute(f: Array, x: Array) -> None:
    """Solve in place with the factors of `_factor`."""
    altitudes = x.size
    for k in range(altitudes):
        if k > 0:
            x[k] -= f[1, k - 1] * x[k - 1]
        if k > 1:
            x[k] -= f[2, k - 2] * x[k - 2]
    for k in range(altitudes - 1, -1, -1):
        x[k] *= f[0, k]
        if k < altitudes - 1:
            x[k] -= f[1, k] * x[k + 1]
        if k < altitudes - 2:
            x[k] -= f[2, k] * x[k + 2]


@_compiled
def _noise(y: Array, information: Array, share: Array, correlation: float) -> float:
    r"""Return y'Vy for noise of which a share is correlated, decaying with the distance."""
    total = tail = 0.0
    for k in range(y.size):
        tail *= correlation
        if information[k] > 0.0:
            square = y[k] * y[k] / information[k]
            g = y[k] * np.sqrt(share[k] / information[k])
            total += square * (1.0 - share[k]) + g * (g + 2.0 * tail)
            tail += g
    return total


@_compiled
def sandwich(
    bands: Array,
    information: Array,
    share: Array,
    correlation: float,
    stiffness: Array,
    lam: float,
    upper: Integers,
    lower: Integers,
) -> Array:
    r"""Return posterior variances of differences of optical depths, and their components.

    With :math:`a` the difference, :math:`C` the inverse of the system, :math:`C_q` that of the
    pilot and :math:`V` the covariance of the noise (equal to :math:`\Omega^{-1}` only at low
    frequencies), these are: the posterior variance :math:`c = a'Ca`, the variance from noise
    :math:`v = x'Vx, x = \Omega C a`, the expected square of the smoothing error
    :math:`c - a'C \Omega C a`, and the variance :math:`n = y'Vy, y = \Omega C_q (a - x)` of the
    smoothing error estimated from the pilot.

    Parameters
    ----------
    bands, information, share, correlation, stiffness
        As in `Calibration`.
    lam : float
    upper, lower : (difference,) int64
        Heights; -1 for the lidar.

    Returns
    -------
    (4, difference) float64
        :math:`c`, :math:`v`, the smoothing error, :math:`n`.
    """
    solution = _factor(bands, stiffness, lam)
    pilot = _factor(bands, stiffness, PILOT * lam)
    x, y = np.empty(information.size), np.empty(information.size)
    out = np.empty((4, upper.size))
    for i in range(upper.size):
        k, below = upper[i], lower[i]
        x[:] = 0.0
        x[k] = 1.0
        if below >= 0:
            x[below] = -1.0
        _substitute(solution, x)
        posterior = x[k] - (x[below] if below >= 0 else 0.0)
        _banded.multiply_banded(bands, x, y)
        inner = 0.0
        for j in range(x.size):
            inner += x[j] * y[j]
        out[0, i] = posterior
        out[1, i] = _noise(y, information, share, correlation)
        out[2, i] = max(posterior - inner, 0.0)
        x[:] = -y
        x[k] += 1.0
        if below >= 0:
            x[below] -= 1.0
        _substitute(pilot, x)
        _banded.multiply_banded(bands, x, y)
        out[3, i] = _noise(y, information, share, correlation)
    return out


def typical_profile(information: Array, share: Array) -> tuple[Array, Array]:
    """Return mean information and correlated share of the profiles of a block.

    Altitudes with estimates of few profiles (less than half of the largest number) count as
    missing.
    """
    used = information > 0.0
    count = used.sum(axis=0)
    kept = _common(count)
    divisor = np.maximum(count, 1)
    mean = np.where(kept, information.sum(axis=0) / divisor, 0.0)
    return mean, np.where(used, share, 0.0).sum(axis=0) / divisor


def _common(count: Integers) -> Booleans:
    """Return the altitudes with at least half of the largest number of profiles."""
    common: Booleans = count >= max(0.5 * count.max(), 1.0)
    return common


def relative_squares(depth: Array, variance: Array, within: Booleans) -> Array:
    r"""Return the squared optical depth of each profile over the usual one of its block.

    The smoothing error of a profile is proportional to its extinction. At the highest altitude
    within the reach of a profile that half of the block also reaches, with the variance V of its
    optical depth and the weighted mean R of the squares of all profiles that reach it,

    .. math:: \max\left(0.7, \frac{\tau^2 + V}{R + V}\right),

    which is 1 where noise exceeds the optical depth by far.

    Parameters
    ----------
    depth, variance : (profile, altitude) float64
    within : (profile, altitude) bool
        Altitudes within the reach, at least one of every profile.

    Returns
    -------
    (profile,) float64
    """
    # Above it, a profile would be compared with few others, or only with itself.
    shared = int(np.flatnonzero(_common(within.sum(axis=0)))[-1])
    tops, own = np.unique(np.minimum(within.sum(axis=1) - 1, shared), return_inverse=True)
    reached = within[:, tops]
    square = np.where(reached, depth[:, tops] ** 2, np.nan)
    noise = np.where(reached, variance[:, tops], np.nan)
    # The median, because the square of a single noisy profile may exceed all others.
    usual = np.maximum(np.nanmedian(square, axis=0), np.finfo(np.float64).tiny)
    weight = (usual / (usual + noise)) ** 2
    total = np.nansum(weight, axis=0)
    # Zero if no profile is known, or most have no optical depth at all.
    mean = np.nansum(weight * square, axis=0) / np.where(total > 0.0, total, 1.0)
    at_top = np.arange(len(own)), own
    own_square = (square + noise)[at_top]
    usual_square = (np.where(total > 0.0, mean, square) + noise)[at_top]
    known = np.isfinite(own_square) & np.isfinite(usual_square) & (usual_square > 0.0)
    relative = np.where(known, own_square, 1.0) / np.where(known, usual_square, 1.0)
    scale: Array = np.maximum(relative, THRESHOLDS.least_scale)
    return scale


def _smoothing_square(bias: Array, known: Array) -> Array:
    r"""Return the square of the smoothing error, estimated from the model and the pilot.

    The smoothing error common to the profiles appears in the mean of that of the pilot, with
    little noise; the rest appears in its spread. Each estimate is weighted by its certainty and
    complemented by the model. A significant mean error is never averaged away:

    .. math::
        B = \bar b^2 - n / T, \quad \beta = \max(0, B, u B + (1 - u) m), \quad
        b^2 = \beta + \max(0, (1 - w) (m - \beta)^+ + w [\overline{b^2} - \bar b^2 - n (1 - 1/T)])

    with the square :math:`m` of the model, the noise :math:`n` of the pilot, and the weights
    :math:`u, w` of the two estimates, from that square and their noise.

    Parameters
    ----------
    bias : (profile, difference) float64
        :math:`b`, NaN beyond the reach.
    known : (4, difference) float64
        From `sandwich`.

    Returns
    -------
    (difference,) float64
    """
    _, _, model, noise = known
    present = np.isfinite(bias)
    count = np.maximum(present.sum(axis=0), 1)
    limit = THRESHOLDS.largest_deviation * np.sqrt(noise + model)
    clipped = np.clip(np.where(present, bias, 0.0), -limit, limit)
    mean = clipped.sum(axis=0) / count
    square = (clipped**2).sum(axis=0) / count
    of_mean = noise / count
    common = mean**2 - of_mean
    certain = _trust(model, 4.0 * model * of_mean + 2.0 * of_mean**2)
    shared = np.maximum(np.maximum(common, 0.0), certain * common + (1.0 - certain) * model)
    own = square - mean**2 - (noise - of_mean)
    certain = _trust(model, 2.0 * (noise + model) ** 2 / count)
    rest = (1.0 - certain) * np.maximum(model - shared, 0.0) + certain * own
    result: Array = shared + np.maximum(rest, 0.0)
    return result


def _trust(signal: Array, variance: Array) -> Array:
    share: Array = signal**2 / np.maximum(signal**2 + variance, np.finfo(np.float64).tiny)
    return share


def variance_ratio(
    calibration: Calibration, upper: Integers, lower: Integers, bias: Array
) -> Array:
    """Return calibrated over posterior variance of differences of optical depths.

    Parameters
    ----------
    calibration : Calibration
    upper, lower : (difference,) int64
        Altitudes in ascending order; -1 for the lidar.
    bias : (profile, difference) float64
        Differences of `Calibration.bias`.

    Returns
    -------
    (profile, difference) float64
    """
    known = sandwich(
        calibration.bands,
        calibration.information,
        calibration.share,
        calibration.correlation,
        calibration.stiffness,
        calibration.smoothing,
        upper,
        lower,
    )
    smoothing_error = calibration.scale[:, np.newaxis] * _smoothing_square(bias, known)
    factor: Array = (known[1] + smoothing_error) / known[0]
    return factor
