r"""Fit the attenuation of a Raman signal: smooth, with the noise of counts.

A Raman signal over that of clean air is :math:`y = e^{-\theta}`, where :math:`\theta` is the
optical depth of particles at both wavelengths. With cells of length :math:`h` and variances
:math:`v`, the fit is the minimum of

.. math:: \sum_i \frac{(y_i - e^{-\theta_i})^2}{v_i(\theta)}
    + \lambda \sum_i (\theta_{i-1} - 2 \theta_i + \theta_{i+1})^2 ,

found by Fisher scoring: counts enter as they are, without a logarithm, so that few counts leave no
bias. Where signal is strong the data decide, where it is weak the smoothness does. Its slope is
the extinction of particles (`extinction_of`).

The compiled solutions are those of :math:`(\mathrm{diag}(i) + \lambda D^\top D)\, x = b`, where
:math:`D` takes second differences, so that the matrix has five diagonals. It is never formed: the
factor :math:`L\, \mathrm{diag}(d)\, L^\top` comes from rotations of the rows of :math:`\sqrt i` and
:math:`\sqrt\lambda D`. Weights exceed information by up to 16 orders of magnitude; of the roots,
doubles hold both. The order of every sum is fixed, so the bits of a result do not depend on the
library of linear algebra.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
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

    @property
    def certain(self) -> Booleans:
        """Whether first-order errors hold for the depth, (cell,)."""
        return np.asarray(self.expected_error <= 1.0 / COMMON.first_order)

    @property
    def first(self) -> int:
        """First cell with extinction: it has data, and its depth is certain.

        Nearer ones have none: the signal shows nothing of the air before its data.
        """
        return int(np.argmax(self.certain & (self.information > 0.0)))

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
    if known.sum() < COMMON.fewest_bins:
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
    of_noise = inverse * np.sqrt(information)
    error = root_of_squares(of_noise)
    expected = error * np.exp(-0.5 * (used - used[int(np.argmin(error))]))
    return DepthFit(used, information, inverse, walk * mean, of_noise, error, expected)


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


@compiled
def _triangle(rows: Array) -> None:
    """Rotate rows in place until those below the diagonal are 0 in all columns but the last."""
    count, columns = rows.shape
    for j in range(columns - 1):
        for i in range(j + 1, count):
            if rows[i, j] == 0.0:
                continue
            length = np.hypot(rows[j, j], rows[i, j])
            cosine, sine = rows[j, j] / length, rows[i, j] / length
            for k in range(j, columns):
                upper, lower = rows[j, k], rows[i, k]
                rows[j, k] = cosine * upper + sine * lower
                rows[i, k] = cosine * lower - sine * upper
            rows[i, j] = 0.0


@compiled
def factor(
    information: Array, weight: float, response: Array
) -> tuple[Array, Array, Array, Array, float]:
    """Return d and both diagonals of L, the right-hand side of its transpose, and the misfit.

    Parameters
    ----------
    information, response : (cell,) float
        At least 4 cells.
    weight : float
        Of the sum of squared second differences.

    Returns
    -------
    (cell,) float64, (cell,) float64, (cell,) float64
        NaN where the matrix is singular.
    (cell,) float64
        Right-hand side: the solution of the transposed L is that of the least sum.
    float
        The least sum of squares: of responses by their information, and of smoothness.
    """
    cells = information.size
    pivot, near, far, target = np.empty(cells), np.zeros(cells), np.zeros(cells), np.zeros(cells)
    misfit, bend = 0.0, np.sqrt(weight)
    # Columns: this cell and the next two, and the right-hand side. Rows: two that the cells before
    # leave, the information of this cell, and its second difference.
    rows = np.zeros((4, 4))
    for i in range(cells):
        root = np.sqrt(information[i])
        rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3] = root, 0.0, 0.0, root * response[i]
        inside = bend if i < cells - 2 else 0.0
        rows[3, 0], rows[3, 1], rows[3, 2], rows[3, 3] = inside, -2.0 * inside, inside, 0.0
        _triangle(rows)
        misfit += rows[3, 3] ** 2
        first = rows[0, 0] if rows[0, 0] != 0.0 else np.nan
        pivot[i], target[i] = first * first, rows[0, 3] / first
        near[i], far[i] = rows[0, 1] / first, rows[0, 2] / first
        for row in range(2):
            rows[row, 0], rows[row, 1] = rows[row + 1, 1], rows[row + 1, 2]
            rows[row, 2], rows[row, 3] = 0.0, rows[row + 1, 3]
    return pivot, near, far, target, misfit


@compiled
def least_sum(information: Array, weight: float, response: Array) -> Array:
    """Return the solution of the least sum of squares, (cell,)."""
    _, near, far, solved, _ = factor(information, weight, response)
    for i in range(information.size - 2, -1, -1):
        solved[i] -= near[i] * solved[i + 1]
        if i < information.size - 2:
            solved[i] -= far[i] * solved[i + 2]
    return solved


@compiled
def _substitute(pivot: Array, near: Array, far: Array, right: Array) -> None:
    """Replace right-hand sides (cell, side) by their solutions."""
    cells = len(right)
    for i in range(1, cells):
        right[i] -= near[i - 1] * right[i - 1]
        if i > 1:
            right[i] -= far[i - 2] * right[i - 2]
    for i in range(cells - 1, -1, -1):
        right[i] /= pivot[i]
        if i < cells - 1:
            right[i] -= near[i] * right[i + 1]
        if i < cells - 2:
            right[i] -= far[i] * right[i + 2]


@compiled
def solve(information: Array, weight: float, right: Array) -> Array:
    """Return the solutions of right-hand sides (cell, side), refined once.

    The refinement restores the digits that the squares of the roots lose.
    """
    pivot, near, far, _, _ = factor(information, weight, np.zeros(information.size))
    solved = right.copy()
    _substitute(pivot, near, far, solved)
    left = right - information.reshape(-1, 1) * solved
    for i in range(len(right) - 2):
        bend = weight * (solved[i] - 2.0 * solved[i + 1] + solved[i + 2])
        left[i] -= bend
        left[i + 1] += 2.0 * bend
        left[i + 2] -= bend
    _substitute(pivot, near, far, left)
    return np.asarray(solved + left)


@compiled
def restricted_scores(information: Array, response: Array, weights: Array) -> Array:
    """Return minus twice the logarithm of the restricted likelihood of weights, up to a constant.

    Parameters
    ----------
    information, response : (cell,) float
    weights : (weight,) float
        Of the sum of squared second differences.
    """
    scores = np.empty(weights.size)
    for number in range(weights.size):
        pivot, _, _, _, misfit = factor(information, weights[number], response)
        logarithm = np.log(pivot).sum()
        scores[number] = misfit + logarithm - (response.size - 2) * np.log(weights[number])
    return scores


@dataclass(frozen=True, slots=True)
class Extinction:
    """Particle extinction at the laser wavelength, (cell,) unless stated."""

    value: Array
    """m-1."""
    kernel: Array
    """(cell, cell): weights of the true extinction of each cell in the value, 1 in total."""
    vertical_resolution: Array
    """m along the beam: length over which a mean has the sum of squared weights of the kernel. The
    mean is centred on the cell, but begins at the first one with extinction where it would reach
    before it."""
    noise: Array
    """(cell, noise of a cell): response in m-1 to independent unit noise."""
    resolution_error: Array
    """m-1: of the value as the mean over `vertical_resolution`."""
    smoothing_error: Array
    """m-1: of the value as the extinction of the cell itself."""

    @property
    def noise_error(self) -> Array:
        """Standard error by noise, m-1."""
        return root_of_squares(self.noise)


def slope(depth: Array, step: float) -> Array:
    """Return the derivative along the first axis: central differences, one-sided at the ends."""
    change = np.empty(depth.shape)
    change[1:-1] = depth[2:] - depth[:-2]
    change[1:-1] *= 0.5 / step
    change[0] = (depth[1] - depth[0]) / step
    change[-1] = (depth[-1] - depth[-2]) / step
    return change


def extinction_of(fit: DepthFit, step: float, ratio: float) -> Extinction:
    r"""Return the extinction of a fit, with resolution and errors.

    .. math:: \alpha = \frac{1}{1 + \kappa} \frac{\mathrm{d}\theta}{\mathrm{d}R}

    The smoothness is also a model of extinction: a random walk, from which the errors by
    resolution follow.

    Parameters
    ----------
    fit : DepthFit
    step : float
        m, length of a cell.
    ratio : float
        :math:`\kappa`, particle extinction at the Raman wavelength over that at the laser's.

    References
    ----------
    `ansmann1990`; `iarlori2015` (resolution).
    """
    both = 1.0 + ratio
    response = slope(fit.inverse, step)
    weights = response * fit.information
    beyond = np.cumsum(weights[:, ::-1], axis=1)[:, ::-1]
    kernel = step * (beyond - 0.5 * weights)
    resolution = step / root_of_squares(kernel) ** 2
    walk = np.sqrt(1.0 / fit.walk) / (step * both)
    away = kernel - mean_weights(resolution, step, fit.first)
    return Extinction(
        value=slope(fit.depth, step) / both,
        kernel=kernel,
        vertical_resolution=resolution,
        noise=response * np.sqrt(fit.information) / both,
        resolution_error=walk * _summed(away),
        smoothing_error=walk * _summed(kernel - np.eye(kernel.shape[0])),
    )


def _summed(weights: Array) -> Array:
    """Return the response of weighted sums to a random walk with unit steps."""
    return root_of_squares(np.cumsum(weights[:, :0:-1], axis=1))


def mean_weights(length: Array, step: float, first: int = 0) -> Array:
    """Return the weights of cells in means over a length around each cell, within the profile.

    Means begin at the first cell with extinction where they would reach before it.

    Parameters
    ----------
    length : (cell,) float
        m.
    step : float
        m, length of a cell.
    first : int
        First cell with extinction.

    Returns
    -------
    (cell, cell) float64
        Rows have the sum 1.
    """
    edges = np.arange(length.size + 1) * step
    low = np.maximum(edges[:-1] + 0.5 * (step - length), edges[first])
    high = np.minimum((low + length)[:, np.newaxis], edges[1:])
    inside = np.maximum(high - np.maximum(low[:, np.newaxis], edges[:-1]), 0.0)
    return np.asarray(inside / inside.sum(axis=1, keepdims=True))
