"""Outlying estimates of a profile: identified before and after the first solution."""

from __future__ import annotations

from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

USUAL_WEIGHT: Final = 1.0 - 2.0 / THRESHOLDS.bisquare**2 + 3.0 / THRESHOLDS.bisquare**4
"""Mean of the bisquare for normal deviates, by which weights are normalised."""


@compiled
def _jumps(depth: Array, information: Array, known: Integers, count: int) -> bool:
    for i in range(1, count):
        k, before = known[i], known[i - 1]
        variance = 1.0 / information[k] + 1.0 / information[before]
        if (depth[k] - depth[before]) ** 2 > THRESHOLDS.jump * THRESHOLDS.jump * variance:
            return True
    return False


@compiled
def screen_outliers(estimates: Array, information: Array) -> Array:
    """Return the information with less weight for estimates that are far from their neighbours.

    Estimates are compared with the median of a symmetric window, which is the middle value of any
    rising profile, however steep or curved. Without this screening, the first solution would
    follow gross outliers as if they were structure, and no residual would show them.

    Parameters
    ----------
    estimates, information : (profile, altitude) float64
        Information 0 where there is no estimate.

    Returns
    -------
    (profile, altitude) float64
    """
    profiles, altitudes = estimates.shape
    out = information.copy()
    known = np.empty(altitudes, dtype=np.int64)
    window = np.empty(2 * THRESHOLDS.half_window + 1)
    for t in range(profiles):
        count = 0
        for k in range(altitudes):
            if information[t, k] > 0.0:
                known[count] = k
                count += 1
        if not _jumps(estimates[t], information[t], known, count):
            continue
        for i in range(count):
            half = min(THRESHOLDS.half_window, i, count - 1 - i)
            for j in range(2 * half + 1):
                window[j] = estimates[t, known[i - half + j]]
            middle = np.median(window[: 2 * half + 1])
            k = known[i]
            variance = (1.0 + 0.5 * np.pi / (2 * half + 1)) / information[t, k]
            width = THRESHOLDS.bisquare * THRESHOLDS.bisquare * variance
            square = (estimates[t, k] - middle) ** 2 / width
            if square > 1.0:
                out[t, k] *= max(THRESHOLDS.least_kept / square, THRESHOLDS.smallest_kept)
    return out


def downweight_outliers(
    estimates: Array, information: Array, share: Array, depth: Array, variance: Array
) -> Array | None:
    """Return the information with less weight for outlying estimates; None if there is none.

    Parameters
    ----------
    estimates, information : (profile, altitude) float64
    share : (profile, altitude) float64
        Share of the variance that is correlated along altitude.
    depth, variance : (profile, altitude) float64
        The solution.
    """
    used = information > 0.0
    total = 1.0 / np.where(used, information, 1.0)
    # The fit follows an isolated estimate, whose residual is then too small to judge it.
    left = np.maximum(total - variance, THRESHOLDS.least_kept * total)
    # The three-band precision describes the noise at low frequencies: the solution absorbs the
    # correlated noise, not the rest.
    left = np.maximum(left, (1.0 - share) * total)
    deviation = np.where(used, np.abs(estimates - depth) / np.sqrt(left), 0.0)
    if not np.any(deviation > THRESHOLDS.outlying_estimate):
        return None
    square = (deviation / THRESHOLDS.bisquare) ** 2
    weight = (1.0 - np.minimum(square, 1.0)) ** 2 / USUAL_WEIGHT
    # The influence of an estimate stays bounded, however far off it is.
    tail = np.maximum(THRESHOLDS.least_kept / np.maximum(square, 1.0), THRESHOLDS.smallest_kept)
    return reduce_information(information, information * np.maximum(weight, tail))


def reduce_information(information: Array, reduced: Array) -> Array:
    """Return the reduced information, but the whole one if most of a profile would lose weight."""
    kept = (reduced > THRESHOLDS.majority * information).sum(axis=1)
    most = kept >= THRESHOLDS.majority * (information > 0.0).sum(axis=1)
    result: Array = np.where(most[:, np.newaxis], reduced, information)
    return result
