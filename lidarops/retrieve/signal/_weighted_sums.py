"""Compiled weighted sums of profiles with gaps, in time order."""

from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HUGE: Final = 1e300

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _add(
    values: Any,
    variance: Array,
    shared: Array,
    weight: float,
    sums: tuple[Array, Array, Array, Array],
    count: npt.NDArray[np.int64],
) -> None:
    total, value, noise, systematic = sums
    for i in range(values.size):
        x = np.float64(values[i])
        valid = abs(x) < HUGE
        total[i] += weight if valid else 0.0
        value[i] += weight * x if valid else 0.0
        noise[i] += weight * weight * variance[i] if valid else 0.0
        systematic[i] += weight * math.sqrt(shared[i]) if valid else 0.0
        count[i] += 1 if valid else 0


@_compiled
def add_profiles(
    values: Any,
    variance: Array,
    shared: Array,
    weights: Array,
    group: npt.NDArray[np.intp],
    sums: Array,
    count: npt.NDArray[np.int64],
) -> None:
    """Add each profile to the sums of its group.

    Parameters
    ----------
    values : (outer, time, inner) float32 or float64
        Values that are not finite are skipped.
    variance, shared : (outer or 1, time or 1, inner) float64
    weights : (outer or 1, time or 1) float64
        A profile is skipped where it is not positive.
    group : (time,) int
        A profile is skipped where it is negative.
    sums : (4, outer, group, inner) float64
        Input and output: sums of weights, of weighted values, of squared weights times variance,
        and of weighted roots of the shared variance.
    count : (outer, group, inner) int64
        Input and output: number of finite values.
    """
    for k in range(values.shape[0]):
        for t in range(values.shape[1]):
            weight, g = weights[k % weights.shape[0], t % weights.shape[1]], group[t]
            if g < 0 or not 0.0 < weight < HUGE:
                continue
            group_sums = (sums[0, k, g], sums[1, k, g], sums[2, k, g], sums[3, k, g])
            profile_variance = variance[k % variance.shape[0], t % variance.shape[1]]
            profile_shared = shared[k % shared.shape[0], t % shared.shape[1]]
            _add(values[k, t], profile_variance, profile_shared, weight, group_sums, count[k, g])
