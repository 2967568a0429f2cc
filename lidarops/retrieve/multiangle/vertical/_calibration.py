"""Standard errors of a block calibrated height by height, by the spread of a rougher solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.vertical import _banded

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

PILOT: Final = 0.01
"""Weight of smoothness of the pilot solution over that of the solution."""
_MOST_ROWS: Final = 256
_LARGEST_DEVIATION: Final = 3.0
_LEAST_SCALE: Final = 0.7
"""A thin haze may have a sharp layer all the same. With 1, errors would be too large where profiles
differ by noise alone, and those of thin hazes more than those of thick ones."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Calibration:
    """What the calibration of one block rests on.

    The typical profile stands for all of the block in what depends on weights only.
    """

    bands: Array
    """(3, height): precision of the typical profile."""
    information: Array
    """(height,): of the typical profile, 0 where there is no estimate."""
    share: Array
    """(height,): correlated share of its variance."""
    correlation: float
    stiffness: Array
    """(3, height)."""
    smoothing: float
    """In the unit of the system."""
    bias: Array
    """(profile, height): pilot solution less its smoothed self; NaN beyond the reach."""
    scale: Array
    """(profile,): from `relative_squares`."""


@_compiled
def _factor(bands: Array, stiffness: Array, lam: float) -> Array:
    """Return reciprocal pivots and off-diagonals of L, (3, height)."""
    heights = bands.shape[1]
    f = np.zeros((3, heights))
    edge = far = farther = 0.0
    for k in range(heights):
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
    """Solve in place with what `_factor` gave."""
    heights = x.size
    for k in range(heights):
        if k > 0:
            x[k] -= f[1, k - 1] * x[k - 1]
        if k > 1:
            x[k] -= f[2, k - 2] * x[k - 2]
    for k in range(heights - 1, -1, -1):
        x[k] *= f[0, k]
        if k < heights - 1:
            x[k] -= f[1, k] * x[k + 1]
        if k < heights - 2:
            x[k] -= f[2, k] * x[k + 2]


@_compiled
def _noise(y: Array, information: Array, share: Array, correlation: float) -> float:
    r"""Return y'Vy for noise of which a share decays as the correlation to the distance."""
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
    r"""Return what the system says of differences of optical depths, and what the noise does.

    With :math:`a` the difference, :math:`C` the inverse of the system, :math:`C_q` that of the
    pilot and :math:`V` the covariance of the noise (which :math:`\Omega^{-1}` is only at low
    frequencies): the posterior variance :math:`c = a'Ca`, the variance from noise
    :math:`v = x'Vx, x = \Omega C a`, the expected square of the smoothing error
    :math:`c - a'C \Omega C a`, and the variance :math:`n = y'Vy, y = \Omega C_q (a - x)` of the
    smoothing error as the pilot shows it.

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
    """Return mean information and share of the profiles of a block.

    Heights that few profiles have (less than half of the most) count as missing.
    """
    used = information > 0.0
    count = used.sum(axis=0)
    kept = _common(count)
    divisor = np.maximum(count, 1)
    mean = np.where(kept, information.sum(axis=0) / divisor, 0.0)
    return mean, np.where(used, share, 0.0).sum(axis=0) / divisor


def _common(count: Integers) -> Booleans:
    """Return the heights that at least half as many profiles have as any height."""
    common: Booleans = count >= max(0.5 * count.max(), 1.0)
    return common


def relative_squares(depth: Array, variance: Array, within: Booleans) -> Array:
    r"""Return the square of each profile's optical depth over the usual one of its block.

    What smoothing takes from a profile is in proportion to its extinction: of a haze that is
    three times as thick, three times as much. At the highest altitude within the reach of a
    profile that half of the block reach too, with the variance V of its optical depth and the
    weighted mean R of the squares of all that reach it,

    .. math:: \max\left(0.7, \frac{\tau^2 + V}{R + V}\right),

    which is 1 where noise hides the optical depth.

    Parameters
    ----------
    depth, variance : (profile, height) float64
    within : (profile, height) bool
        The reach; of every profile at least one height.

    Returns
    -------
    (profile,) float64
    """
    # Beyond that, a profile would be compared with few others, or with itself.
    shared = int(np.flatnonzero(_common(within.sum(axis=0)))[-1])
    tops, own = np.unique(np.minimum(within.sum(axis=1) - 1, shared), return_inverse=True)
    reached = within[:, tops]
    square = np.where(reached, depth[:, tops] ** 2, np.nan)
    noise = np.where(reached, variance[:, tops], np.nan)
    # The median, as one profile of much noise may have the largest square of all.
    usual = np.maximum(np.nanmedian(square, axis=0), np.finfo(np.float64).tiny)
    weight = (usual / (usual + noise)) ** 2
    told = np.nansum(weight, axis=0)
    # Nothing where no profile is known, or most have no optical depth at all.
    mean = np.nansum(weight * square, axis=0) / np.where(told > 0.0, told, 1.0)
    each = np.arange(len(own)), own
    over, of = (square + noise)[each], (np.where(told > 0.0, mean, square) + noise)[each]
    known = np.isfinite(over) & np.isfinite(of) & (of > 0.0)
    relative = np.where(known, over, 1.0) / np.where(known, of, 1.0)
    scale: Array = np.maximum(relative, _LEAST_SCALE)
    return scale


def _observed(bias: Array, known: Array) -> Array:
    r"""Return the square of the smoothing error, from what the model and the pilot say of it.

    What the profiles share shows in the mean of the pilot's smoothing error, with little noise;
    what they do not share, in its spread. Each is taken as far as its noise allows, the rest
    from the model, and what is seen for certain is never averaged away:

    .. math::
        B = \bar b^2 - n / T, \quad \beta = \max(0, B, u B + (1 - u) m), \quad
        b^2 = \beta + \max(0, (1 - w) (m - \beta)^+ + w [\overline{b^2} - \bar b^2 - n (1 - 1/T)])

    with the model's square :math:`m`, the noise :math:`n` of the pilot's, and the weights
    :math:`u, w` of a signal of that square among the noise of the two estimates.

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
    there = np.isfinite(bias)
    count = np.maximum(there.sum(axis=0), 1)
    limit = _LARGEST_DEVIATION * np.sqrt(noise + model)
    clipped = np.clip(np.where(there, bias, 0.0), -limit, limit)
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
        Heights in ascending order; -1 for the lidar.
    bias : (profile, difference) float64
        The differences of `Calibration.bias`.

    Returns
    -------
    (profile, difference) float64
        Of many differences some are calculated and the rest interpolated between them.
    """
    every = -(-upper.size // _MOST_ROWS)
    chosen = np.unique(np.append(np.arange(0, upper.size, every), upper.size - 1))
    known = sandwich(
        calibration.bands,
        calibration.information,
        calibration.share,
        calibration.correlation,
        calibration.stiffness,
        calibration.smoothing,
        upper[chosen],
        lower[chosen],
    )
    if every > 1:
        known = _interpolated(known, chosen, upper.size)
    taken = calibration.scale[:, np.newaxis] * _observed(bias, known)
    factor: Array = (known[1] + taken) / known[0]
    return factor


def _interpolated(known: Array, chosen: Integers, size: int) -> Array:
    index = np.arange(size)
    logarithms = np.log(np.maximum(known, np.finfo(np.float64).tiny))
    rows: Array = np.exp(np.array([np.interp(index, chosen, row) for row in logarithms]))
    return rows
