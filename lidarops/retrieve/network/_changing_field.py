"""A field of ln extinction that changes slowly: its priors, and its solution in all profiles.

ln extinction at the crossings of profile t is x_t = m + d_t. Along a beam, a gradient of extinction
looks like attenuation, so that the prior of the mean field m counts in thin air. It has a free
level, and deviations that are stratified (`stratified`) and of single volumes of air. The size and
the length of the latter are unknown: all of `deviations` and `lengths` are tried, with equal
weights. A block of few profiles shows little of them, and has the error of all.

The deviations d_t are stationary, with the correlation rho^|t - s| and a covariance over the
crossings that falls with their distance. Size, length and rho are those of the largest marginal
likelihood. What a profile knows is its normal matrix N_t and right side h_t.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.network._beam_fit import Beams, Solution
from lidarops.retrieve.network.thresholds import THRESHOLDS

_ROUNDING: Final = 1e-9
"""Relative size of a field below which it is rounding."""


# The mean field ----------------------------------------------------------------------------------


def correlations(position: Array) -> Array:
    """Return (length, crossing, crossing) correlations exp(-distance / length) of ln extinction.

    Parameters
    ----------
    position : (crossing, 3) float64
        m.
    """
    distance = np.linalg.norm(position[:, np.newaxis] - position, axis=2)
    lengths = np.array(THRESHOLDS.lengths)[:, np.newaxis, np.newaxis]
    return np.asarray(np.exp(-distance / lengths))


def precision(covariance: Array) -> Array:
    """Return (..., crossing, crossing) precisions of covariances, with a free level."""
    inverse = np.linalg.inv(covariance)
    sums = inverse.sum(axis=-1)
    total = sums.sum(axis=-1)[..., np.newaxis, np.newaxis]
    return np.asarray(inverse - sums[..., np.newaxis] * sums[..., np.newaxis, :] / total)


@dataclass(frozen=True, slots=True, eq=False)
class MeanPriors:
    """Priors of the mean field that are tried: by size, then by length."""

    covariance: Array
    """(prior, crossing, crossing)."""
    precision: Array
    """(prior, crossing, crossing)."""
    deviation: Array
    """(prior,) standard deviation over the crossings by single volumes of air."""

    @classmethod
    def at(cls, position: Array) -> MeanPriors:
        """Return the priors of crossings at a (crossing, 3) position in m."""
        height = position[:, 2]
        deviation, depth = THRESHOLDS.stratified
        apart = (height[:, np.newaxis] - height) / depth
        shared = deviation**2 * np.exp(-0.5 * apart**2)
        shared = shared + THRESHOLDS.least_deviation**2 * np.eye(len(height))
        size = np.array(THRESHOLDS.deviations)[:, np.newaxis, np.newaxis, np.newaxis]
        single = (size**2 * correlations(position)).reshape(-1, *shared.shape)
        deviations = np.sqrt(
            np.trace(single, axis1=1, axis2=2) / len(height) - single.mean(axis=(1, 2))
        )
        return cls(single + shared, precision(single + shared), deviations)

    @property
    def widest(self) -> Array:
        """(crossing, crossing) precision of the largest size and the shortest length."""
        return np.asarray(self.precision[-len(THRESHOLDS.lengths)])

    def posterior(self, beams: Beams, first: Solution) -> MeanPosterior:
        """Return the probabilities of the priors, given the mean of a block.

        Parameters
        ----------
        beams : Beams
            Of the mean.
        first : Solution
            With the widest prior.
        """
        level = first.logarithm[0].mean()
        (normal,), (side,) = first.linear.normal(beams.select)
        weak = THRESHOLDS.weak_precision * np.eye(len(normal))
        matrices = normal + self.precision + weak
        covariance = np.linalg.inv(matrices)
        side = side - level * normal.sum(axis=1)
        x = covariance @ side
        # The level is free: the determinant of a precision is that of its other directions.
        cost = (
            np.linalg.slogdet(matrices)[1]
            - np.log(np.linalg.eigvalsh(self.precision)[:, 1:]).sum(axis=1)
            - x @ side
        )
        weight = np.exp(-0.5 * (cost - cost.min()))
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        return MeanPosterior(weight / weight.sum(), x + level, variance)


class MeanPosterior(NamedTuple):
    """Mean fields with each prior, and their probabilities."""

    weight: Array
    """(prior,)."""
    logarithm: Array
    """(prior, crossing) of extinction in m-1."""
    variance: Array
    """(prior, crossing)."""

    def expected(self, priors: MeanPriors) -> Array:
        """Return the (crossing, crossing) precision of the expected covariance."""
        return precision(np.tensordot(self.weight, priors.covariance, axes=1))

    def deviation(self, priors: MeanPriors) -> float:
        """Return the deviation of the likeliest prior."""
        return float(priors.deviation[np.argmax(self.weight)])

    def square_error(self, logarithm: Array) -> Array:
        """Return (crossing,) mean squares of the relative deviation of extinction from a field."""
        x, variance = self.logarithm - logarithm, self.variance
        square = np.exp(2.0 * (x + variance)) - 2.0 * np.exp(x + 0.5 * variance) + 1.0
        return np.asarray(self.weight @ square)


# Changes -----------------------------------------------------------------------------------------


class Change(NamedTuple):
    """How a field changes with time."""

    covariance: Array
    """(crossing, crossing) of ln extinction."""
    correlation: float
    """From one profile to the next."""


@lru_cache(maxsize=32)
def _modes(profiles: int, correlation: float) -> tuple[Array, Array]:
    """Return variances and (profile, mode) vectors of deviations from the mean of a block."""
    place = np.arange(profiles)
    matrix = correlation ** np.abs(place[:, np.newaxis] - place)
    centred = matrix - matrix.mean(axis=0) - matrix.mean(axis=1)[:, np.newaxis] + matrix.mean()
    size, vector = np.linalg.eigh(centred)
    return np.maximum(size, 0.0), vector


def likeliest_change(normal: Array, side: Array, position: Array) -> Change | None:
    """Return the change of the largest marginal likelihood, None where it is no better than none.

    Parameters
    ----------
    normal : (crossing, crossing) float64
        Of a typical profile.
    side : (profile, crossing) float64
        Right sides less those of the mean field.
    position : (crossing, 3) float64
        m.
    """
    unit = np.eye(len(position))
    amplitude = np.array(THRESHOLDS.changes)[:, np.newaxis, np.newaxis] ** 2
    best, least = None, -THRESHOLDS.least_change
    for shape, rho in product(correlations(position), THRESHOLDS.correlations):
        root = np.linalg.cholesky(shape + _ROUNDING * unit)
        size, vector = np.linalg.eigh(root.T @ normal @ root)
        variance, modes = _modes(len(side), rho)
        square = (modes.T @ side @ root @ vector) ** 2
        scaled = amplitude * variance[:, np.newaxis] * np.maximum(size, 0.0)
        cost = np.log1p(scaled) - amplitude * variance[:, np.newaxis] * square / (1.0 + scaled)
        costs = cost.sum(axis=(1, 2))
        k = int(np.argmin(costs))
        if costs[k] < least:
            least = costs[k]
            best = Change(float(amplitude[k, 0, 0]) * shape, rho)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class ChangingField:
    """What all profiles of a block know about their field."""

    normal: Array
    """(profile, crossing, crossing) N_t."""
    prior: Array
    """(crossing, crossing) precision of the mean field."""
    change: Change

    def solve(self, side: Array, pull: Array | float = 0.0) -> tuple[Array, Array]:
        """Return (profile, crossing, case) fields, and (profile, crossing, crossing) covariances.

        Parameters
        ----------
        side : (profile, crossing, case) float64
            Right sides h_t, of several cases.
        pull : (crossing, case) float64
            Right side of the mean field by its prior.
        """
        prior = self.prior + THRESHOLDS.weak_precision * np.eye(len(self.prior))
        root = np.linalg.cholesky(
            self.change.covariance
            + _ROUNDING * np.trace(self.change.covariance) * np.eye(len(self.prior))
        )
        cases = side.shape[2]
        sides = root.T @ np.concatenate([side, self.normal], axis=2)
        solved, spread = _solve_chain(root.T @ self.normal @ root, sides, self.change.correlation)
        solved, spread = root @ solved, root @ spread @ root.T
        by_side, by_mean = solved[..., :cases], solved[..., cases:]
        left = np.eye(len(self.prior)) - by_mean
        known = (self.normal @ left).sum(axis=0)
        covariance = np.linalg.inv((known + known.T) / 2.0 + prior)
        mean = covariance @ ((side - self.normal @ by_side).sum(axis=0) + pull)
        field = by_side + left @ mean
        return field, np.asarray(spread + left @ covariance @ left.swapaxes(1, 2))


def _solve_chain(normal: Array, side: Array, rho: float) -> tuple[Array, Array]:
    """Return deviations of unit variance in a chain of profiles, and their covariances.

    The precision of the chain is tridiagonal in time; elimination from both ends meets in each
    profile.
    """
    profiles, size = normal.shape[:2]
    link = rho / (1.0 - rho**2)
    diagonal = np.full(profiles, (1.0 + rho**2) / (1.0 - rho**2))
    diagonal[[0, -1]] = 1.0 / (1.0 - rho**2)
    if profiles == 1:
        diagonal[0] = 1.0
    own = normal + diagonal[:, np.newaxis, np.newaxis] * np.eye(size)
    both, sides = np.stack([own, own[::-1]], axis=1), np.stack([side, side[::-1]], axis=1)
    for t in range(1, profiles):
        before = np.linalg.inv(both[t - 1])
        both[t] -= link**2 * before
        sides[t] += link * before @ sides[t - 1]
    covariance = np.linalg.inv(both[:, 0] + both[::-1, 1] - own)
    return covariance @ (sides[:, 0] + sides[::-1, 1] - side), np.asarray(covariance)
