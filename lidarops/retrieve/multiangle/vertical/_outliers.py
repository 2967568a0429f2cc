"""Estimates that lie off their profile: found before the first solution, and by it."""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

OUTLYING: Final = 4.5
BISQUARE: Final = 6.0
LEAST_WEIGHT: Final = 1e-3
"""Share of its information that an estimate at the end of the bisquare keeps."""
SMALLEST_WEIGHT: Final = 1e-9
"""The least share; less would cost the solution its digits."""
HALF: Final = 0.5
USUAL_WEIGHT: Final = 1.0 - 2.0 / BISQUARE**2 + 3.0 / BISQUARE**4
"""Mean of the bisquare for normal deviates: what the other estimates must not lose."""
_HALF_WINDOW: Final = 7
_JUMP: Final = 5.0

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _jumps(depth: Array, information: Array, there: npt.NDArray[np.int64], count: int) -> bool:
    for i in range(1, count):
        k, before = there[i], there[i - 1]
        variance = 1.0 / information[k] + 1.0 / information[before]
        if (depth[k] - depth[before]) ** 2 > _JUMP * _JUMP * variance:
            return True
    return False


@_compiled
def screen_outliers(estimates: Array, information: Array) -> Array:
    """Return the information with estimates weighted down that are far from their neighbours.

    They are compared with the median of a window. A profile that rises has its middle value in
    the middle of any symmetric window, however steep or bent it is. Without this, gross
    outliers look like structure: the first solution follows them, and none is left to be seen.

    Parameters
    ----------
    estimates, information : (profile, height) float64
        Information 0 where there is no estimate.

    Returns
    -------
    (profile, height) float64
    """
    profiles, heights = estimates.shape
    out = information.copy()
    there = np.empty(heights, dtype=np.int64)
    window = np.empty(2 * _HALF_WINDOW + 1)
    for t in range(profiles):
        count = 0
        for k in range(heights):
            if information[t, k] > 0.0:
                there[count] = k
                count += 1
        if not _jumps(estimates[t], information[t], there, count):
            continue
        for i in range(count):
            half = min(_HALF_WINDOW, i, count - 1 - i)
            for j in range(2 * half + 1):
                window[j] = estimates[t, there[i - half + j]]
            middle = np.median(window[: 2 * half + 1])
            k = there[i]
            variance = (1.0 + 0.5 * np.pi / (2 * half + 1)) / information[t, k]
            square = (estimates[t, k] - middle) ** 2 / (BISQUARE * BISQUARE * variance)
            if square > 1.0:
                out[t, k] *= max(LEAST_WEIGHT / square, SMALLEST_WEIGHT)
    return out


def downweight_outliers(
    estimates: Array, information: Array, share: Array, depth: Array, variance: Array
) -> Array | None:
    """Return the information with outlying estimates weighted down; None where there is none.

    Parameters
    ----------
    estimates, information : (profile, height) float64
    share : (profile, height) float64
        Of the variance that is correlated along height.
    depth, variance : (profile, height) float64
        The solution.
    """
    used = information > 0.0
    total = 1.0 / np.where(used, information, 1.0)
    # The fit follows an estimate that stands alone: what is left to it is no error of its own.
    left = np.maximum(total - variance, LEAST_WEIGHT * total)
    # A precision of three bands knows the noise at low frequencies; its solution takes away what
    # is correlated, not the rest.
    left = np.maximum(left, (1.0 - share) * total)
    deviation = np.where(used, np.abs(estimates - depth) / np.sqrt(left), 0.0)
    if not np.any(deviation > OUTLYING):
        return None
    square = (deviation / BISQUARE) ** 2
    weight = (1.0 - np.minimum(square, 1.0)) ** 2 / USUAL_WEIGHT
    # What an estimate does is bounded, however far off it is.
    tail = np.maximum(LEAST_WEIGHT / np.maximum(square, 1.0), SMALLEST_WEIGHT)
    return reduce_information(information, information * np.maximum(weight, tail))


def reduce_information(information: Array, reduced: Array) -> Array:
    """Return the reduced information, but the whole one where most of a profile is doubted."""
    kept = (reduced > HALF * information).sum(axis=1)
    most = kept >= HALF * (information > 0.0).sum(axis=1)
    result: Array = np.where(most[:, np.newaxis], reduced, information)
    return result
