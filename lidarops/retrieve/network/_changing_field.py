r"""A field of ln extinction that changes slowly: its prior, and its solution in all profiles.

ln extinction at the crossings of profile t is x_t = m + d_t. The mean field m has a free level,
and a covariance by gradient, curvature and single crossings. The deviations d_t are stationary,
with the correlation rho^|t - s| and a covariance over the crossings. Each size is that of the
largest marginal likelihood. What a profile knows is its normal matrix N_t and right side h_t.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.network.thresholds import THRESHOLDS

_ROUNDING: Final = 1e-9
"""Relative size of a field below which it is rounding."""


# The mean field ----------------------------------------------------------------------------------


def smooth_fields(position: Array) -> tuple[Array, Array]:
    """Return (crossing, crossing) covariances of linear and of quadratic fields of unit variance.

    Quadratic fields have neither level nor gradient. There are none where a gradient describes any
    field of so few crossings.

    Parameters
    ----------
    position : (crossing, 3) float64
        m.
    """
    centred = position - position.mean(axis=0)
    first, second = np.triu_indices(3)
    # The products of different axes count twice, as in r' H r with a random symmetric H.
    weight = np.where(first == second, 1.0, np.sqrt(2.0))
    # A single crossing has no size.
    centred = centred / max(float(np.sqrt(np.mean(centred**2))), np.finfo(float).tiny)
    fields = weight * centred[:, first] * centred[:, second]
    axes, size, _ = np.linalg.svd(np.insert(centred, 0, 1.0, axis=1), full_matrices=False)
    axes = axes[:, size > _ROUNDING * size[0]]
    fields = fields - axes @ (axes.T @ fields)
    fields[:, np.mean(fields**2, axis=0) <= _ROUNDING**2] = 0.0
    return _unit(centred @ centred.T), _unit(fields @ fields.T)


def _unit(covariance: Array) -> Array:
    """Return a covariance with a mean variance of 1; 0 where there is none."""
    return covariance * (len(covariance) / max(float(np.trace(covariance)), _ROUNDING))


def precision(covariance: Array) -> Array:
    """Return (..., crossing, crossing) precisions of covariances, with a free level."""
    inverse = np.linalg.inv(covariance)
    sums = inverse.sum(axis=-1)
    total = sums.sum(axis=-1)[..., np.newaxis, np.newaxis]
    return np.asarray(inverse - sums[..., np.newaxis] * sums[..., np.newaxis, :] / total)


@dataclass(frozen=True, slots=True, eq=False)
class MeanPrior:
    """Prior of the mean field."""

    precision: Array
    """(crossing, crossing)."""
    deviation: float
    """Standard deviation of ln extinction at single crossings."""
    smooth: float
    """That by gradient, and that by curvature."""


def mean_priors(position: Array) -> list[MeanPrior]:
    """Return the priors that are tried, by size of smooth fields, then of single crossings."""
    linear, quadratic = smooth_fields(position)
    sizes = list(product(THRESHOLDS.gradients, THRESHOLDS.deviations))
    unit = np.eye(len(position))
    precisions = precision(
        np.array([a * a * (linear + quadratic) + s * s * unit for a, s in sizes])
    )
    return [MeanPrior(matrix, s, a) for matrix, (a, s) in zip(precisions, sizes, strict=True)]


def likeliest_prior(
    normal: Array, side: Array, priors: list[MeanPrior], *, tested: bool
) -> MeanPrior:
    """Return the prior that the mean of a block supports.

    The smallest size of smooth fields that is not much less likely than the likeliest, because
    the beams hardly show these, and the largest one where beams are too few to test it; then the
    largest of single crossings.
    """
    matrices = np.array([prior.precision for prior in priors])
    # The level is free: the determinant of a precision is that of its other directions.
    values = np.linalg.eigvalsh(matrices)[:, 1:]
    cost = (
        np.linalg.slogdet(normal + matrices)[1]
        - np.log(values).sum(axis=1)
        - (side @ np.linalg.inv(normal + matrices) @ side)
    )
    shape = len(THRESHOLDS.gradients), len(THRESHOLDS.deviations)
    costs = cost.reshape(shape)
    likely = costs.min(axis=1) <= costs.min() + THRESHOLDS.likelihood_tolerance
    row = int(np.argmax(likely)) if tested else shape[0] - 1
    likely = costs[row] <= costs[row].min() + THRESHOLDS.likelihood_tolerance
    column = shape[1] - 1 - int(np.argmax(likely[::-1]))
    return priors[row * shape[1] + column]


# Changes -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Change:
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
    level = (1.0 + smooth_fields(position)[0]) / 2.0
    amplitude = np.array(THRESHOLDS.changes)[:, np.newaxis, np.newaxis] ** 2
    best, least = None, -THRESHOLDS.least_change
    for share, rho in product(THRESHOLDS.single_shares, THRESHOLDS.correlations):
        shape = (1.0 - share) * level + share * unit
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


# The solution ------------------------------------------------------------------------------------


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
