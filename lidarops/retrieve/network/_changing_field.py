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
from typing import NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.network import _beam_fit
from lidarops.retrieve.network._beam_fit import Solution, add_product, invert, product
from lidarops.retrieve.network._condensed_signals import Beams
from lidarops.retrieve.network.thresholds import THRESHOLDS

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
    inverse, determinant = _beam_fit.inverse_and_determinant(covariance)
    sums = inverse.sum(axis=-1)
    total = sums.sum(axis=-1)
    free = sums[..., np.newaxis] * sums[..., np.newaxis, :] / total[..., np.newaxis, np.newaxis]
    return np.asarray(inverse - free), np.asarray(-determinant - np.log(total))


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """Priors of the mean field that are tried, by size, then by length; and shapes of changes."""

    covariance: Array
    """(prior, crossing, crossing)."""
    precision: Array
    """(prior, crossing, crossing)."""
    determinant: Array
    """(prior,) ln of the determinants of the precisions, without the free level."""
    deviation: Array
    """(prior,) standard deviation over the crossings by single volumes of air."""
    roots: Array
    """(length, crossing, crossing) matrices R, with the correlations R R' of changes."""

    @classmethod
    def at(cls, position: Array) -> Priors:
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
        size, vectors = _beam_fit.eigenvectors(correlations(position))
        roots = vectors * np.sqrt(np.maximum(size, 0.0))[:, np.newaxis]
        return cls(single + shared, *precision(single + shared), deviations, roots)

    @property
    def widest(self) -> Array:
        """(crossing, crossing) precision of the largest size and the shortest length."""
        return np.asarray(self.precision[-len(THRESHOLDS.lengths)])

    def posterior(self, beams: Beams, first: Solution) -> Posterior:
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
        covariance, determinant = _beam_fit.inverse_and_determinant(normal + self.precision + weak)
        side = side - level * normal.sum(axis=1)
        x = product(covariance, side[:, np.newaxis])[..., 0]
        cost = determinant - self.determinant - (x * side).sum(axis=1)
        weight = np.exp(-0.5 * (cost - cost.min()))
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        return Posterior(weight / weight.sum(), x + level, variance)


class Posterior(NamedTuple):
    """Mean fields with each prior, and their probabilities."""

    weight: Array
    """(prior,)."""
    logarithm: Array
    """(prior, crossing) of extinction in m-1."""
    variance: Array
    """(prior, crossing)."""

    def expected(self, priors: Priors) -> Array:
        """Return the (crossing, crossing) precision of the expected covariance."""
        return precision(np.einsum("k,kcd->cd", self.weight, priors.covariance))[0]

    def square_error(self, logarithm: Array) -> Array:
        """Return (crossing,) mean squares of the relative deviation of extinction from a field."""
        x, variance = self.logarithm - logarithm, self.variance
        square = np.exp(2.0 * (x + variance)) - 2.0 * np.exp(x + 0.5 * variance) + 1.0
        return np.asarray(np.einsum("k,kc->c", self.weight, square))


# Changes -----------------------------------------------------------------------------------------


class Change(NamedTuple):
    """How a field changes with time."""

    root: Array
    """(crossing, crossing) R, with the covariance R R' of ln extinction."""
    correlation: float
    """From one profile to the next."""


@lru_cache(maxsize=64)
def _modes(places: tuple[int, ...], correlations: tuple[float, ...]) -> tuple[Array, Array]:
    """Return (correlation, mode) variances and (correlation, mode, profile) vectors.

    They are those of deviations from the mean of a block.
    """
    place, rho = np.array(places), np.array(correlations)[:, np.newaxis, np.newaxis]
    matrix = rho ** np.abs(place[:, np.newaxis] - place)
    mean = matrix.mean(axis=1, keepdims=True)
    centred = matrix - mean - mean.swapaxes(1, 2) + mean.mean(axis=2, keepdims=True)
    size, vectors = _beam_fit.eigenvectors(centred)
    return np.maximum(size, 0.0), np.ascontiguousarray(vectors.swapaxes(1, 2))


def likeliest_change(
    normal: Array, side: Array, roots: Array, places: tuple[int, ...]
) -> Change | None:
    """Return the change of the largest marginal likelihood, None where it is no better than none.

    Parameters
    ----------
    normal : (crossing, crossing) float64
        Of a typical profile.
    side : (profile, crossing) float64
        Right sides less those of the mean field.
    roots : (length, crossing, crossing) float64
        `Priors.roots`.
    places : (profile,) int
        Numbers of the profiles, in order of time.
    """
    variance, modes = _modes(places, THRESHOLDS.correlations)
    size, vectors = _beam_fit.eigenvectors(_turned(normal, roots))
    along = product(side, product(roots, vectors))
    square = product(modes, along[:, np.newaxis]) ** 2
    amplitude = np.array(THRESHOLDS.changes)
    each = amplitude[:, np.newaxis, np.newaxis, np.newaxis, np.newaxis] ** 2 * variance[..., None]
    scaled = each * np.maximum(size, 0.0)[:, np.newaxis, np.newaxis]
    costs = (np.log1p(scaled) - each * square / (1.0 + scaled)).sum(axis=(-2, -1))
    k, length, rho = np.unravel_index(int(np.argmin(costs)), costs.shape)
    if not costs[k, length, rho] < -THRESHOLDS.least_change:
        return None
    return Change(amplitude[k] * roots[length], THRESHOLDS.correlations[rho])


def _turned(matrices: Array, root: Array) -> Array:
    """Return (..., crossing, crossing) matrices R' N R of the unknowns that R makes those of x."""
    return product(product(root.swapaxes(-1, -2), matrices), root)


def solve_changing(
    normal: Array, side: Array, prior: Array, change: Change, pull: Array | float = 0.0
) -> tuple[Array, Array]:
    """Return (profile, crossing, case) fields, and (profile, crossing, crossing) covariances.

    Parameters
    ----------
    normal : (profile, crossing, crossing) float64
        N_t.
    side : (profile, crossing, case) float64
        Right sides h_t, of several cases.
    prior : (crossing, crossing) float64
        Precision of the mean field.
    change : Change
    pull : (crossing, case) float64
        Right side of the mean field by its prior.
    """
    root, unit, cases = change.root, np.eye(len(prior)), side.shape[2]
    sides = product(root.T, np.concatenate([side, normal], axis=2))
    chain, spread = _turned(normal, root), np.empty(normal.shape)
    _solve_chain(chain, sides, change.correlation, spread)
    solved, spread = product(root, sides), _turned(spread, root.T)
    by_side, left = solved[..., :cases], unit - solved[..., cases:]
    known = product(normal, left).sum(axis=0)
    known = (known + known.T) / 2.0 + prior + THRESHOLDS.weak_precision * unit
    covariance = _beam_fit.inverse(known)
    rest = (side - product(normal, by_side)).sum(axis=0) + pull
    field = by_side + product(left, product(covariance, rest))
    return field, spread + _turned(covariance, left.swapaxes(1, 2))


@compiled
def _solve_chain(normal: Array, side: Array, rho: float, covariance: Array) -> None:
    """Overwrite right sides by deviations of unit variance in a chain of profiles.

    The precision of the chain is tridiagonal in time: it is eliminated forwards, and solved
    backwards. `normal` is overwritten; `covariance` is filled.
    """
    profiles, size = normal.shape[:2]
    link = rho / (1.0 - rho * rho)
    work, carried = np.empty((size, size)), np.empty((size, size))
    for t in range(profiles):
        ends = (t == 0) + (t == profiles - 1)
        for c in range(size):
            normal[t, c, c] += (1.0 + (1 - ends) * rho * rho) / (1.0 - rho * rho)
        if t > 0:
            normal[t] -= link * link * covariance[t - 1]
            add_product(link, covariance[t - 1], side[t - 1], side[t])
        invert(normal[t], covariance[t], work)
    for t in range(profiles - 1, -1, -1):
        normal[t] = covariance[t]
        if t < profiles - 1:
            side[t] += link * side[t + 1]
            carried[:] = 0.0
            add_product(link, normal[t], covariance[t + 1], carried)
            add_product(link, carried, normal[t], covariance[t])
        carried_side = np.zeros(side.shape[1:])
        add_product(1.0, normal[t], side[t], carried_side)
        side[t] = carried_side
