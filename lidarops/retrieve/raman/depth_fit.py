r"""Fit the attenuation of a Raman signal: smooth, with the noise of counts.

A Raman signal over that of clean air is :math:`y = e^{-\theta}`, where :math:`\theta` is the
optical depth of particles at both wavelengths. With cells of length :math:`h` and variances
:math:`v`, the fit is the minimum of

.. math:: \sum_i \frac{(y_i - e^{-\theta_i})^2}{v_i(\theta)}
    + \lambda \sum_i (\theta_{i-1} - 2 \theta_i + \theta_{i+1})^2 ,

found by Fisher scoring: counts enter as they are, without a logarithm, so that few counts leave no
bias. Where signal is strong the data decide, where it is weak the smoothness does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman._smooth_solution import least_sum, restricted_scores, solve
from lidarops.retrieve.raman.thresholds import THRESHOLDS

_LEAST_WEIGHT: Final = 1e-2
"""Weight of smoothness over the mean information of a cell: a length of 0.3 cells."""
_PER_DECADE: Final = 2
_START: Final = 1e6
"""The same for the first fit: a length of about 30 cells."""
_ITERATIONS: Final = 200
"""Strong signals with jumps take more than 50."""
_CONVERGED: Final = 1e-9
_LONGEST_STEP: Final = 2.0
"""Largest change of the logarithm of the signal in one iteration."""
_CHOICES: Final = 2
"""Times that the weight is chosen, each with the information of the fit before."""


@dataclass(frozen=True, slots=True)
class SignalNoise:
    """Variance of a signal as a function of its mean: counts, or a given variance."""

    per_signal: Array
    """(cell,): variance per unit of the signal; 0 where it does not depend on the signal."""
    fixed: Array
    """(cell,): variance without signal; infinite where there are no data."""

    def of(self, signal: Array) -> Array:
        """Return the variance of a signal."""
        return np.asarray(self.per_signal * signal + self.fixed)


@dataclass(frozen=True, slots=True)
class DepthFit:
    """Smooth optical depth of particles along a Raman signal, up to a constant."""

    depth: Array
    """(cell,): at both wavelengths together."""
    information: Array
    """(cell,): reciprocal variance of the logarithm of the signal of a cell."""
    inverse: Array
    """(cell, cell): covariance of the depth as the smoothness that is used permits."""
    walk: float
    """Weight of smoothness that is likely: reciprocal variance of the second differences of the
    depth."""
    noise: Array
    """Response of the depth to independent unit noise, (cell, noise of a cell)."""
    standard_error: Array
    """Standard error of the depth by noise, (cell,)."""
    expected_error: Array
    """Standard error of the depth for clean air beyond the most certain cell, (cell,).

    What is decided by it is not decided by the noise of the cell: by its own standard error, cells
    that noise makes bright would be kept, and the depth there biased."""

    @classmethod
    def of(cls, depth: Array, information: Array, inverse: Array, walk: float) -> Self:
        """Return a fit with its errors."""
        noise = inverse * np.sqrt(information)
        error = root_of_squares(noise)
        nearer = depth[int(np.argmin(error))]
        expected = error * np.exp(-0.5 * (depth - nearer))
        return cls(depth, information, inverse, walk, noise, error, expected)

    def respond(self, relative: Array) -> Array:
        """Return the change of the depth when the signal changes by shares of it.

        Parameters
        ----------
        relative : (cell, change) float
        """
        return np.asarray(-self.inverse @ (self.information[:, np.newaxis] * relative))


def root_of_squares(rows: Array) -> Array:
    """Return the root of the sum of squares of each row."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", rows, rows)))


def fit_depth(signal: Array, noise: SignalNoise) -> DepthFit | None:
    """Fit the optical depth of particles to a Raman signal over that of clean air.

    Parameters
    ----------
    signal : (cell,) float
        Any value where `noise` is infinite.
    noise : SignalNoise

    Returns
    -------
    DepthFit or None
        None where fewer than 8 cells have data, the data hold no signal, or one that no smooth
        depth follows.

    References
    ----------
    `patterson1971` (restricted likelihood, by which the smoothness is chosen).
    """
    known = np.isfinite(signal) & np.isfinite(noise.fixed)
    if known.sum() < THRESHOLDS.fewest_cells:
        return None
    values = np.where(known, signal, 0.0)
    level = _level(values, noise, known)
    if not level > 0.0:
        return None
    depth = np.full(signal.size, -np.log(level))
    weight = _START
    for _ in range(_CHOICES):
        smooth = _scored(values, noise, depth, weight)
        if smooth is None:
            return None
        depth, (weight, walk) = smooth, _likely_weights(*_working(values, noise, smooth))
    used = _scored(values, noise, depth, weight)
    if used is None:
        return None
    information = _working(values, noise, used)[0]
    mean = float(information.mean())
    inverse = solve(information, weight * mean, np.eye(signal.size))
    return DepthFit.of(used, information, inverse, walk * mean)


def _level(signal: Array, noise: SignalNoise, known: Booleans) -> float:
    """Return the mean signal, weighted by the information of a signal of a first mean."""
    variance = np.where(known, np.where(known, noise.fixed, 1.0) + noise.per_signal, 1.0)
    weight = np.where(known, 1.0 / variance, 0.0)
    first = float((weight * signal).sum() / weight.sum())
    if not first > 0.0:
        return first
    weight = np.where(known, 1.0 / np.where(known, noise.of(np.full(signal.size, first)), 1.0), 0.0)
    return float((weight * signal).sum() / weight.sum())


def _working(signal: Array, noise: SignalNoise, depth: Array) -> tuple[Array, Array]:
    """Return information and response of the linearised problem at a depth."""
    mean = np.exp(-depth)
    information = mean**2 / noise.of(mean)
    return information, depth - (signal - mean) / mean


def _scored(signal: Array, noise: SignalNoise, depth: Array, weight: float) -> Array | None:
    """Return the depth of the least sum for a relative weight; None without convergence."""
    for _ in range(_ITERATIONS):
        information, response = _working(signal, noise, depth)
        absolute = weight * float(information.mean())
        step = least_sum(information, absolute, response) - depth
        longest = float(np.abs(step).max())
        if not np.isfinite(longest):
            return None
        depth = depth + step * min(1.0, _LONGEST_STEP / max(longest, _CONVERGED))
        if longest < _CONVERGED:
            return depth
    return None


def _likely_weights(information: Array, response: Array) -> tuple[float, float]:
    """Return relative weights of smoothness by restricted likelihood: to be used, and for errors.

    Both are at the rough end. With few counts, straight lines are as likely as structure; the most
    likely weight then often leaves no structure, with errors that are too small.
    """
    mean = float(information.mean())
    weights = _weights(information.size)
    scores = restricted_scores(information, response, weights * mean)
    share = np.exp(-0.5 * (scores - np.nanmin(scores)))
    below = np.cumsum(np.nan_to_num(share)) / np.nansum(share)
    shares = (THRESHOLDS.rougher_share, THRESHOLDS.walk_share)
    used, walk = np.exp(np.interp(shares, below, np.log(weights)))
    return float(used), float(walk)


def _weights(cells: int) -> Array:
    """Return the weights of smoothness that are compared, up to one that leaves a straight line."""
    decades = np.log10(10.0 * (cells / np.pi) ** 4 / _LEAST_WEIGHT)
    return np.asarray(_LEAST_WEIGHT * 10.0 ** np.arange(0.0, decades, 1.0 / _PER_DECADE))
