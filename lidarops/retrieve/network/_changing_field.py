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
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.network import _matrices
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


def precision(covariance: Array) -> tuple[Array, Array]:
    """Return (..., crossing, crossing) precisions of covariances with a free level.

    The second array is ln of their determinants in the other directions, without a constant.
    """
    inverse, determinant = _matrices.inverse_and_determinant(covariance)
    sums = inverse.sum(axis=-1)
    total = sums.sum(axis=-1)
    free = sums[..., np.newaxis] * sums[..., np.newaxis, :] / total[..., np.newaxis, np.newaxis]
    return np.asarray(inverse - free), np.asarray(-determinant - np.log(total))


@dataclass(frozen=True, slots=True, eq=False)
class MeanPriors:
    """Priors of the mean field that are tried: by size, then by length."""

    covariance: Array
    """(prior, crossing, crossing)."""
    precision: Array
    """(prior, crossing, crossing)."""
    determinant: Array
    """(prior,) ln of the determinants of the precisions, without the free level."""
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
        return cls(single + shared, *precision(single + shared), deviations)

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
        (normal,), (side,) = first.linear.normal(beams)
        weak = THRESHOLDS.weak_precision * np.eye(len(normal))
        covariance, determinant = _matrices.inverse_and_determinant(normal + self.precision + weak)
        side = side - level * normal.sum(axis=1)
        x = _matrices.product(covariance, side[:, np.newaxis])[..., 0]
        cost = determinant - self.determinant - (x * side).sum(axis=1)
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
        return precision(np.einsum("k,kcd->cd", self.weight, priors.covariance))[0]

    def deviation(self, priors: MeanPriors) -> float:
        """Return the deviation of the likeliest prior."""
        return float(priors.deviation[np.argmax(self.weight)])

    def square_error(self, logarithm: Array) -> Array:
        """Return (crossing,) mean squares of the relative deviation of extinction from a field."""
        x, variance = self.logarithm - logarithm, self.variance
        square = np.exp(2.0 * (x + variance)) - 2.0 * np.exp(x + 0.5 * variance) + 1.0
        return np.asarray(np.einsum("k,kc->c", self.weight, square))


# Changes -----------------------------------------------------------------------------------------


class Change(NamedTuple):
    """How a field changes with time."""

    covariance: Array
    """(crossing, crossing) of ln extinction."""
    correlation: float
    """From one profile to the next."""


@lru_cache(maxsize=256)
def _modes(places: tuple[int, ...], correlation: float) -> tuple[Array, Array]:
    """Return variances and (profile, mode) vectors of deviations from the mean of a block."""
    place = np.array(places)
    matrix = correlation ** np.abs(place[:, np.newaxis] - place)
    centred = matrix - matrix.mean(axis=0) - matrix.mean(axis=1)[:, np.newaxis] + matrix.mean()
    size, vector = _matrices.eigenvectors(centred)
    return np.maximum(size, 0.0), vector


def likeliest_change(
    normal: Array, side: Array, position: Array, places: tuple[int, ...]
) -> Change | None:
    """Return the change of the largest marginal likelihood, None where it is no better than none.

    Parameters
    ----------
    normal : (crossing, crossing) float64
        Of a typical profile.
    side : (profile, crossing) float64
        Right sides less those of the mean field.
    position : (crossing, 3) float64
        m.
    places : (profile,) int
        Numbers of the profiles, in order of time.
    """
    unit = np.eye(len(position))
    amplitude = np.array(THRESHOLDS.changes)[:, np.newaxis, np.newaxis] ** 2
    best, least = None, -THRESHOLDS.least_change
    for shape in correlations(position):
        root = _matrices.lower_root(shape + _ROUNDING * unit)
        size, vector = _matrices.eigenvectors(_turned(normal, root))
        along = _matrices.product(_matrices.product(side, root), vector)
        for rho in THRESHOLDS.correlations:
            variance, modes = _modes(places, rho)
            square = _matrices.product(modes.T, along) ** 2
            each = amplitude * variance[:, np.newaxis]
            scaled = each * np.maximum(size, 0.0)
            costs = (np.log1p(scaled) - each * square / (1.0 + scaled)).sum(axis=(1, 2))
            k = int(np.argmin(costs))
            if costs[k] < least:
                least = costs[k]
                best = Change(float(amplitude[k, 0, 0]) * shape, rho)
    return best


def _turned(matrices: Array, root: Array) -> Array:
    """Return (..., crossing, crossing) matrices of the unknowns that a root makes those of x."""
    return _matrices.product(_matrices.product(root.T, matrices), root)


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
        unit = np.eye(len(self.prior))
        prior = self.prior + THRESHOLDS.weak_precision * unit
        of_change = self.change.covariance
        root = _matrices.lower_root(of_change + _ROUNDING * np.trace(of_change) * unit)
        cases = side.shape[2]
        sides = _matrices.product(root.T, np.concatenate([side, self.normal], axis=2))
        solved, spread = _solve_chain(_turned(self.normal, root), sides, self.change.correlation)
        solved, spread = _matrices.product(root, solved), _turned(spread, root.T)
        by_side, left = solved[..., :cases], unit - solved[..., cases:]
        known = _matrices.product(self.normal, left).sum(axis=0)
        covariance = _matrices.inverse((known + known.T) / 2.0 + prior)
        rest = (side - _matrices.product(self.normal, by_side)).sum(axis=0) + pull
        field = by_side + _matrices.product(left, _matrices.product(covariance, rest))
        of_mean = _matrices.product(_matrices.product(left, covariance), left.swapaxes(1, 2))
        return field, np.asarray(spread + of_mean)


def _solve_chain(normal: Array, side: Array, rho: float) -> tuple[Array, Array]:
    """Return deviations of unit variance in a chain of profiles, and their covariances.

    The precision of the chain is tridiagonal in time; elimination from both ends meets in each
    profile.
    """
    profiles, size = normal.shape[:2]
    link = rho / (1.0 - rho**2)
    diagonal = np.full(profiles, (1.0 + rho**2) / (1.0 - rho**2))
    diagonal[[0, -1]] = 1.0 / (1.0 - rho**2)
    own = normal + diagonal[:, np.newaxis, np.newaxis] * np.eye(size)
    both, sides = np.stack([own, own[::-1]], axis=1), np.stack([side, side[::-1]], axis=1)
    for t in range(1, profiles):
        before = link * _matrices.inverse(both[t - 1])
        both[t] -= link * before
        sides[t] += _matrices.product(before, sides[t - 1])
    covariance = _matrices.inverse(both[:, 0] + both[::-1, 1] - own)
    return _matrices.product(covariance, sides[:, 0] + sides[::-1, 1] - side), covariance
