"""Choice of the smoothness of a block: restricted likelihood and Mallows' Cp on a fixed grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import _banded

PER_DECADE: Final = 6
GRID: Final = 10.0 ** (np.arange(11 * PER_DECADE + 1) / PER_DECADE - 10.0)
"""Dimensionless weights of smoothness; a larger one would cost the solution its digits."""
_SCORED_PROFILES: Final = 64
_SCORED_VALUES: Final = 25_600
"""A block is scored on at most so many profiles, or profiles with so many values together."""


@dataclass(frozen=True, slots=True)
class SmoothingChoice:
    """Weights of smoothness of one block."""

    smoothing: Array
    """(candidate,): dimensionless; one weight, or several to be averaged over."""
    share: Array
    """(candidate,): share of each in the average, 1 in total."""
    effective_degrees_of_freedom: float
    """Mean over the scored profiles and the candidates."""
    saturated: bool
    """Whether the best weight leaves little more than a straight line."""
    limited: bool
    """Whether the best weight is the largest that is allowed, but leaves more than that."""


@dataclass(frozen=True, slots=True)
class Scores:
    """The criteria on the grid, summed over the scored profiles of a block."""

    likelihood: Array
    """(smoothing,): minus twice the restricted log-likelihood, up to a constant."""
    risk: Array
    """(smoothing,): Mallows' Cp, up to a constant."""
    freedom: Array
    """(smoothing,): mean effective degrees of freedom of a profile."""
    profiles: int
    """Profiles of the block, scored or not."""


def score_smoothing(bands: Array, estimates: Array, stiffness: Array, unit: float) -> Scores:
    """Score every weight on the grid for the profiles of one block, formula 3 of the page.

    A long block is scored on every n-th profile.

    Parameters
    ----------
    bands : (3, profile, altitude) float64
    estimates : (profile, altitude) float64
        0 where there is none.
    stiffness : (3, altitude) float64
    unit : float
        Factor of the dimensionless weights.
    """
    profiles, altitudes = estimates.shape
    most = max(_SCORED_PROFILES, _SCORED_VALUES // altitudes)
    scored = np.arange(0, profiles, -(-profiles // most))
    right = _banded.multiply_rows(bands, estimates)
    profile = np.repeat(scored, GRID.size)
    lam = np.tile(GRID * unit, scored.size)
    raw = _banded.banded_scores(bands, right, estimates, stiffness, profile, lam)
    fit, misfit, freedom, logarithm = raw.reshape(4, scored.size, GRID.size)
    likelihood = (fit + logarithm - (altitudes - 1) * np.log(GRID * unit)).sum(axis=0)
    # Where a pivot lost all its digits, the weight is too large.
    likelihood = np.where(np.isfinite(likelihood), likelihood, np.inf)
    risk = misfit + 2.0 * freedom
    return Scores(likelihood, risk.sum(axis=0), freedom.mean(axis=0), profiles)


def choose_smoothing(scores: Scores, largest: float) -> SmoothingChoice:
    """Choose the weight of a block, or the weights to average over.

    Weights above `largest` are not allowed: without a limit, smooth extinction below would deny
    the top of a layer above, where the data are too noisy to show it.

    Profiles of a block have similar shapes, but the likelihood treats them as independent; in
    clouds it then smooths too much. Cp uses the known noise, but is erratic. It is used only if it
    gives 1.2 times the degrees of freedom, and lowers the weight by at most a factor of 10.
    """
    admitted = np.flatnonzero(
        (scores.freedom >= THRESHOLDS.least_smooth_freedom) & np.isfinite(scores.likelihood)
    )
    straight = int(admitted[-1]) if admitted.size else 0
    last = min(straight, max(int(np.searchsorted(GRID, largest, side="right")) - 1, 0))
    likely = int(np.argmin(scores.likelihood[: last + 1]))
    if scores.profiles < THRESHOLDS.fewest_to_choose:
        return _average(scores, last, straight)
    risky = int(np.argmin(scores.risk[: last + 1]))
    risky = max(risky, likely - PER_DECADE)
    rougher = scores.freedom[risky] > THRESHOLDS.rougher * scores.freedom[likely]
    best = risky if rougher else likely
    return SmoothingChoice(
        GRID[best : best + 1],
        np.ones(1),
        float(scores.freedom[best]),
        saturated=best == straight,
        limited=best == last < straight,
    )


def _average(scores: Scores, last: int, straight: int) -> SmoothingChoice:
    likelihood = scores.likelihood[: last + 1]
    share = np.exp(-0.5 * (likelihood - likelihood.min()))
    kept = np.flatnonzero(share > THRESHOLDS.negligible_likelihood)
    share = share[kept] / share[kept].sum()
    freedom = float((share * scores.freedom[kept]).sum())
    best = int(kept[np.argmax(share)])
    return SmoothingChoice(
        GRID[kept], share, freedom, saturated=best == straight, limited=best == last < straight
    )
