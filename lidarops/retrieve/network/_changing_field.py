"""A field of ln extinction that changes slowly: its prior, and its solution in all profiles.

ln extinction at the crossings of profile t is x_t = m + d_t. Along a beam, a gradient of extinction
looks like attenuation, so that the prior of the mean field m counts in thin air. It has a free
level, and deviations that are stratified (`stratified`) and of single volumes of air (`volumes`).

The deviations d_t are stationary, with the correlation rho^|t - s| and a covariance over the
crossings that falls with their distance. Size, length and rho are those of the largest marginal
likelihood. What a profile knows is its normal matrix N_t and right side h_t.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network._beam_fit import invert
from lidarops.retrieve.network.thresholds import THRESHOLDS

_LARGE: Final = 1e100
"""Size of a product, at which its logarithm is taken."""

# Prior -------------------------------------------------------------------------------------------


def field_precision(position: Array) -> Array:
    """Return the (crossing, crossing) precision of the mean field at (crossing, 3) places in m.

    Its level is free.
    """
    (layers, depth), (volumes, length) = THRESHOLDS.stratified, THRESHOLDS.volumes
    apart = (position[:, 2, np.newaxis] - position[:, 2]) / depth
    covariance = layers**2 * np.exp(-0.5 * apart**2)
    covariance += volumes**2 * correlations(position, (length,))[0]
    # Beams may meet at one place more than once.
    covariance += THRESHOLDS.least_deviation**2 * np.eye(len(position))
    inverse = np.linalg.inv(covariance)
    sums = inverse.sum(axis=0)
    return np.asarray(inverse - np.outer(sums, sums) / sums.sum())


def correlations(position: Array, lengths: tuple[float, ...]) -> Array:
    """Return (length, crossing, crossing) correlations exp(-distance / length) of ln extinction."""
    distance = np.linalg.norm(position[:, np.newaxis] - position, axis=2)
    return np.asarray(np.exp(-distance / np.array(lengths)[:, np.newaxis, np.newaxis]))


def change_roots(position: Array) -> Array:
    """Return (length, crossing, crossing) matrices R with the correlations R R' of changes."""
    size, vectors = np.linalg.eigh(correlations(position, THRESHOLDS.lengths))
    return np.asarray(vectors * np.sqrt(np.maximum(size, 0.0))[:, np.newaxis])


# Changes -----------------------------------------------------------------------------------------


class Change(NamedTuple):
    """How a field changes with time."""

    root: Array
    """(crossing, crossing) R, with the covariance R R' of ln extinction."""
    correlation: float
    """From one profile to the next."""


@lru_cache(maxsize=4)
def _modes(places: tuple[int, ...], correlations: tuple[float, ...]) -> tuple[Array, Array]:
    """Return (correlation, mode) variances and (correlation, mode, profile) vectors.

    They are those of deviations from the mean of a block.
    """
    place, rho = np.array(places), np.array(correlations)[:, np.newaxis, np.newaxis]
    matrix = rho ** np.abs(place[:, np.newaxis] - place)
    mean = matrix.mean(axis=1, keepdims=True)
    centred = matrix - mean - mean.swapaxes(1, 2) + mean.mean(axis=2, keepdims=True)
    size, vectors = np.linalg.eigh(centred)
    return np.maximum(size, 0.0), vectors.swapaxes(1, 2)


def likeliest_change(
    normal: Array, side: Array, roots: Array, places: tuple[int, ...]
) -> Change | None:
    """Return the change of the largest marginal likelihood, None where it is no better than none.

    `normal` is the (crossing, crossing) matrix of a typical profile, `side` the (profile, crossing)
    right sides less those of the mean field, `roots` those of `change_roots`, and `places` the
    numbers of the profiles, in order of time.
    """
    variance, modes = _modes(places, THRESHOLDS.correlations)
    size, vectors = np.linalg.eigh(roots.swapaxes(1, 2) @ normal @ roots)
    along = side @ roots @ vectors
    square = (modes @ along[:, np.newaxis]) ** 2
    amplitude = np.array(THRESHOLDS.changes)
    costs = np.zeros((len(amplitude), len(roots), len(variance)))
    _fill_costs(amplitude**2, variance, np.maximum(size, 0.0), square, costs)
    if not costs.min() < -(COMMON.significant**2):
        return None
    # The likelihood is that of small changes: of those about as likely, the largest is safe.
    likely = np.argwhere(costs <= costs.min() + COMMON.significant**2)
    largest = likely[likely[:, 0] == likely[-1, 0]]
    k, length, rho = largest[np.argmin(costs[tuple(largest.T)])]
    return Change(amplitude[k] * roots[length], THRESHOLDS.correlations[rho])


@compiled
def _fill_costs(power: Array, variance: Array, size: Array, square: Array, costs: Array) -> None:
    """Fill (amplitude, length, correlation) -2 ln likelihoods relative to no change."""
    for k, length, rho in np.ndindex(costs.shape):
        cost, product = 0.0, 1.0
        for mode in range(variance.shape[1]):
            each = power[k] * variance[rho, mode]
            for c in range(size.shape[1]):
                scaled = 1.0 + each * size[length, c]
                cost -= each * square[length, rho, mode, c] / scaled
                product *= scaled
                if product > _LARGE:
                    cost, product = cost + math.log(product), 1.0
        costs[k, length, rho] = cost + math.log(product)


def solve_changing(
    normal: Array, side: Array, prior: Array, change: Change | None, pull: Array | float = 0.0
) -> tuple[Array, Array]:
    """Return (profile, crossing, case) fields, and (profile, crossing, crossing) covariances.

    `normal` and `side` are the N_t and h_t of each profile and case, `prior` the precision of the
    mean field, and `pull` its (crossing, case) right side by the prior. Without a change, all
    profiles have the mean field.
    """
    unit, spread = np.eye(len(prior)), np.zeros(normal.shape)
    solved = np.zeros((*side.shape[:2], side.shape[2] + len(prior)))
    if change is not None:
        solved = np.concatenate([side, normal], axis=2)
        _solve_chain(normal, solved, change.root, change.correlation, spread)
    by_side, left = solved[..., : side.shape[2]], unit - solved[..., side.shape[2] :]
    known = (normal @ left).sum(axis=0)
    known = (known + known.T) / 2.0 + prior + THRESHOLDS.weak_precision * unit
    covariance = np.linalg.inv(known)
    rest = (side - normal @ by_side).sum(axis=0) + pull
    return by_side + left @ (covariance @ rest), spread + left @ covariance @ left.swapaxes(1, 2)


@compiled
def _solve_chain(normal: Array, side: Array, root: Array, rho: float, covariance: Array) -> None:
    """Overwrite right sides by deviations in a chain of profiles, and fill their covariances.

    Those of unit variance have a precision that is tridiagonal in time: it is eliminated forwards,
    and solved backwards.
    """
    profiles, size = normal.shape[:2]
    link, down = rho / (1.0 - rho * rho), np.ascontiguousarray(root.T)
    work, wide = np.empty((2, size, size)), np.empty(side.shape[1:])
    for t in range(profiles):
        _multiply(down, normal[t], work[0])
        _multiply(work[0], root, covariance[t])
        _multiply(down, side[t], wide)
        side[t] = wide
        ends = (t == 0) + (t == profiles - 1)
        for c in range(size):
            covariance[t, c, c] += (1.0 + (1 - ends) * rho * rho) / (1.0 - rho * rho)
        if t > 0:
            covariance[t] -= link * link * covariance[t - 1]
            _multiply(covariance[t - 1], side[t - 1], wide)
            side[t] += link * wide
        invert(covariance[t])
    for t in range(profiles - 1, -1, -1):
        if t < profiles - 1:
            side[t] += link * side[t + 1]
        _multiply(covariance[t], side[t], wide)
        side[t] = wide
        if t < profiles - 1:
            _multiply(covariance[t], covariance[t + 1], work[0])
            _multiply(work[0], covariance[t], work[1])
            covariance[t] += link * link * work[1]
    for t in range(profiles):
        _multiply(root, side[t], wide)
        side[t] = wide
        _multiply(root, covariance[t], work[0])
        _multiply(work[0], down, covariance[t])


@compiled
def _multiply(first: Array, second: Array, out: Array) -> None:
    """Fill a product of small matrices, for which a call of BLAS takes longer."""
    for i in range(out.shape[0]):
        out[i] = 0.0
        for k in range(first.shape[1]):
            for j in range(out.shape[1]):
                out[i, j] += first[i, k] * second[k, j]
