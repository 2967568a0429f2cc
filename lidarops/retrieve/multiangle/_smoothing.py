"""Smooth profiles: penalised solutions of pentadiagonal systems, and the choice of their weight.

A system is the precision of the estimates of one profile plus a multiple of the penalty. Arrays are
(altitude, system): one sweep along altitude solves all systems, none of which depends on others.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Self

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_PAD: Final = 2
"""Rows of zeros at the end, in place of values beyond the grid."""
_LOGARITHM_EVERY: Final = 4
"""Pivots multiplied before a logarithm is taken; four of any allowed size do not overflow."""
_PER_DECADE: Final = 6
_ROUGHEST: Final = 1e-10
_SMOOTHEST: Final = 10.0
"""Dimensionless weights of smoothness; a larger one would cost the solution its digits."""
_NEGLIGIBLE: Final = 1e-6
"""Relative likelihood below which a weight is left out of the average: less than the 12 bits of a
stored value."""


def penalty(altitude: Array) -> Array:
    r"""Return :math:`\int (d\alpha/dz)^2 dz` as the bands of a quadratic form in optical depth.

    Extinction is the optical depth gained between neighbouring altitudes over their distance;
    the first one is gained from the lidar, where the optical depth is zero.

    Parameters
    ----------
    altitude : (altitude,) float
        m above the lidar, ascending.

    Returns
    -------
    (3, altitude) float64
        m-3: diagonal, first and second off-diagonal.
    """
    step = np.diff(altitude, prepend=0.0)
    root = np.sqrt(2.0 / (step[:-1] + step[1:]))
    # Each row acts on the optical depths below, at and above an altitude; that of the lidar is 0.
    below, above = root / step[:-1], root / step[1:]
    at = -root * (1.0 / step[:-1] + 1.0 / step[1:])
    bands = np.zeros((3, altitude.size))
    bands[0, 1:] += above**2
    bands[0, :-1] += at**2
    bands[0, :-2] += below[1:] ** 2
    bands[1, :-1] += at * above
    bands[1, :-2] += (below * at)[1:]
    bands[2, :-2] += (below * above)[1:]
    return bands


@compiled
def multiply(bands: Array, columns: Array) -> Array:
    """Multiply columns, (altitude, system), each by its own tridiagonal matrix.

    The second of the bands, (2, altitude, system), links an altitude with the one above it.
    """
    out = np.empty(columns.shape)
    last = len(columns) - 1
    for i in range(last + 1):
        for j in range(columns.shape[1]):
            value = bands[0, i, j] * columns[i, j]
            value += bands[1, i - 1, j] * columns[i - 1, j] if i > 0 else 0.0
            out[i, j] = value + (bands[1, i, j] * columns[i + 1, j] if i < last else 0.0)
    return out


@compiled
def factor_bands(bands: Array, stiffness: Array, weight: Array) -> Array:
    """Return the factors L D L' of the precision plus a multiple of the penalty.

    Parameters
    ----------
    bands : (2, altitude, system) float64
    stiffness : (3, altitude) float64
        Bands of the penalty.
    weight : (system,) float64
        Of the penalty.

    Returns
    -------
    (3, altitude + 2, system) float64
        Reciprocal pivots, and the two off-diagonals of L.
    """
    altitudes, systems = bands.shape[1:]
    f = np.zeros((3, altitudes + _PAD, systems))
    # Loops that write one array are vectorised.
    across = np.zeros(systems)
    for i in range(altitudes):
        # The last ones of the penalty are zero.
        far, farther = stiffness[2, i - 1], stiffness[2, i - 2]
        for j in range(systems):
            pivot = bands[0, i, j] + weight[j] * stiffness[0, i] - f[1, i - 1, j] * across[j]
            f[0, i, j] = 1.0 / (pivot - f[2, i - 2, j] * (weight[j] * farther))
        for j in range(systems):
            across[j] = bands[1, i, j] + weight[j] * (stiffness[1, i] - f[1, i - 1, j] * far)
        for j in range(systems):
            f[1, i, j] = across[j] * f[0, i, j]
        for j in range(systems):
            f[2, i, j] = weight[j] * stiffness[2, i] * f[0, i, j]
    return f


@compiled
def solve_bands(f: Array, right: Array) -> Array:
    """Return the solution of factored systems, (altitude, system)."""
    altitudes, systems = right.shape
    out = np.zeros((altitudes + _PAD, systems))
    for i in range(altitudes):
        for j in range(systems):
            earlier = f[1, i - 1, j] * out[i - 1, j] + f[2, i - 2, j] * out[i - 2, j]
            out[i, j] = right[i, j] - earlier
    for i in range(altitudes - 1, -1, -1):
        for j in range(systems):
            later = f[1, i, j] * out[i + 1, j] + f[2, i, j] * out[i + 2, j]
            out[i, j] = out[i, j] * f[0, i, j] - later
    return out[:altitudes]


@compiled
def invert_bands(f: Array) -> Array:
    """Return diagonal and first off-diagonal of the inverse (Takahashi's recursion).

    (2, altitude, system), of factored systems (`takahashi1973`).
    """
    altitudes, systems = f.shape[1] - _PAD, f.shape[2]
    out = np.zeros((2, altitudes + _PAD, systems))
    for i in range(altitudes - 1, -1, -1):
        for j in range(systems):
            near, far = f[1, i, j], f[2, i, j]
            second = -near * out[1, i + 1, j] - far * out[0, i + 2, j]
            first = -near * out[0, i + 1, j] - far * out[1, i + 1, j]
            out[1, i, j] = first
            out[0, i, j] = f[0, i, j] - near * first - far * second
    return out[:, :altitudes]


class Smoother(NamedTuple):
    """Systems of the profiles of a block, each with the weights of smoothness to average over."""

    bands: Array
    """(2, altitude, profile): precision of the estimates."""
    share: Array
    """(candidate,): share of each weight in the average, 1 in total."""
    factors: Array
    """Of profile times candidate systems."""

    @classmethod
    def of(cls, bands: Array, stiffness: Array, weight: Array, share: Array) -> Self:
        """Return the systems with weights (candidate,) of their shares."""
        weights = np.tile(weight, bands.shape[2])
        return cls(bands, share, factor_bands(_apart(bands, share), stiffness, weights))

    def solve(self, right: Array) -> Array:
        """Return the solutions of all systems for (altitude, profile) right-hand sides."""
        return np.asarray(solve_bands(self.factors, _apart(right, self.share)))

    def respond(self, columns: Array) -> Array:
        """Return the smoothed form of (altitude, profile) estimates."""
        return self.mean(self.solve(multiply(self.bands, columns)))

    def mean(self, values: Array) -> Array:
        """Average (altitude, profile times candidate) values into (altitude, profile)."""
        if self.share.size == 1:
            return values
        apart = values.reshape(len(values), -1, self.share.size)
        return np.asarray(np.einsum("ktc,c->kt", apart, self.share))

    def mixed(self, value: Array, variance: Array) -> tuple[Array, Array]:
        """Return mean and variance of the mixture of the solutions of each profile."""
        if self.share.size == 1:
            return value, variance
        mean = self.mean(value)
        return mean, self.mean(variance + (value - _apart(mean, self.share)) ** 2)


def _apart(values: Array, share: Array) -> Array:
    """Return values of profiles, the last axis, for the systems of each."""
    return values if share.size == 1 else np.repeat(values, share.size, axis=-1)


# Choice of the weight by restricted likelihood and Cp ---------------------------------------------


@compiled
def _misfits(
    bands: Array, right: Array, estimates: Array, stiffness: Array, weight: Array
) -> Array:
    """Return the weighted sums of squares of `score_smoothing`, the first with determinants."""
    altitudes, profiles = estimates.shape
    out = np.zeros((2, weight.size))
    for i in range(weight.size):
        f = factor_bands(bands, stiffness, np.full(profiles, weight[i]))
        away = estimates - solve_bands(f, right)
        both = multiply(bands, away)
        product, squares, risks = np.ones(profiles), np.zeros(profiles), np.zeros(profiles)
        for k in range(altitudes):
            for t in range(profiles):
                product[t] *= f[0, k, t]
            for t in range(profiles):
                squares[t] += right[k, t] * away[k, t]
            for t in range(profiles):
                risks[t] += both[k, t] * away[k, t]
            if k % _LOGARITHM_EVERY == 0 or k == altitudes - 1:
                squares -= np.log(product)
                product[:] = 1.0
        out[0, i], out[1, i] = squares.sum(), risks.sum()
    return out


class Scores(NamedTuple):
    """The criteria for some weights, summed over the scored profiles of a block."""

    weight: Array
    """(smoothing,): rising."""
    likelihood: Array
    """(smoothing,): minus twice the restricted log-likelihood, up to a constant."""
    risk: Array
    """(smoothing,): Mallows' Cp, up to a constant."""
    freedom: Array
    """(smoothing,): effective degrees of freedom of a typical profile."""


def score_smoothing(
    bands: Array, estimates: Array, typical: Array, stiffness: Array, weight: Array
) -> Scores:
    """Score weights for the profiles of one block, formula 2 of the page (`patterson1971`).

    Parameters
    ----------
    bands : (2, altitude, profile) float64
    estimates : (altitude, profile) float64
        0 where there is none.
    typical : (2, altitude, 1) float64
        Precision of a typical profile, whose degrees of freedom are those of all.
    stiffness : (3, altitude) float64
    weight : (smoothing,) float64
    """
    altitudes, profiles = estimates.shape
    right = multiply(bands, estimates)
    likelihood, risk = _misfits(bands, right, estimates, stiffness, weight)
    likelihood -= (altitudes - 1) * profiles * np.log(weight)
    # Where a pivot lost all its digits, the weight is too large.
    likelihood = np.where(np.isfinite(likelihood), likelihood, np.inf)
    left = freedom(typical, stiffness, weight)
    return Scores(weight, likelihood, risk + 2.0 * profiles * left, left)


def freedom(bands: Array, stiffness: Array, weight: Array) -> Array:
    """Return the effective degrees of freedom of one profile, (2, altitude, 1), by weight."""
    repeated = np.repeat(bands, weight.size, axis=2)
    diagonal, beside = invert_bands(factor_bands(repeated, stiffness, weight))
    return np.asarray((bands[0] * diagonal + 2.0 * bands[1] * beside).sum(axis=0))


def weights_up_to(largest: float, unit: float) -> Array:
    """Return the weights to choose from, in equal ratios up to the largest one.

    They hang from it, so that none enters abruptly where it moves. Without a limit, smooth
    extinction below would deny the top of a layer above, where the data are too noisy to show it.
    """
    largest = min(largest, _SMOOTHEST * unit)
    below = max(int(_PER_DECADE * np.log10(largest / (_ROUGHEST * unit))), 0)
    return np.asarray(largest * 10.0 ** (np.arange(-below, 1) / _PER_DECADE))


def choose_smoothing(scores: Scores, *, one: bool) -> tuple[Array, Array]:
    """Return the weight of a block, or without `one` the weights to average over, and their shares.

    Shares are integrals over the logarithm of the weight, up to the last one that is allowed.
    Profiles of a block have similar shapes, but the likelihood treats them as independent; in
    clouds it then smooths too much. Cp uses the known noise, but is erratic. The one weight is the
    mean by both: that of the least score would jump for a hair of noise.
    """
    place = np.arange(scores.weight.size)
    last = np.interp(-THRESHOLDS.least_smooth_freedom, -scores.freedom, place)
    within = np.clip(last - place + 0.5, 0.0, 1.0)
    score = scores.likelihood + scores.risk if one else scores.likelihood
    score = np.where(within > 0.0, score, np.inf)
    share = within * np.exp(-0.5 * (score - score.min()))
    share /= share.sum()
    if one:
        return np.exp([share @ np.log(scores.weight)]), np.ones(1)
    kept = share > _NEGLIGIBLE * share.max()
    return scores.weight[kept], share[kept] / share[kept].sum()
