"""Compiled weighted sums of profiles with gaps, in the order of time."""

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
        good = abs(x) < HUGE
        total[i] += weight if good else 0.0
        value[i] += weight * x if good else 0.0
        noise[i] += weight * weight * variance[i] if good else 0.0
        systematic[i] += weight * math.sqrt(shared[i]) if good else 0.0
        count[i] += 1 if good else 0


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
    """Add every profile to the sums of its group.

    Parameters
    ----------
    values : (outer, time, inner) float32 or float64
        What is not finite is passed over.
    variance, shared : (outer or 1, time or 1, inner) float64
    weights : (outer or 1, time or 1) float64
        A profile is passed over where it is not positive.
    group : (time,) int
        A profile is passed over where it is negative.
    sums : (4, outer, group, inner) float64
        Gets the sums of weights, of weighted values, of squared weights times variance, and of
        weighted roots of the shared variance added.
    count : (outer, group, inner) int64
        Gets the number of finite values added.
    """
    for k in range(values.shape[0]):
        for t in range(values.shape[1]):
            weight, g = weights[k % weights.shape[0], t % weights.shape[1]], group[t]
            if g < 0 or not 0.0 < weight < HUGE:
                continue
            parts = (sums[0, k, g], sums[1, k, g], sums[2, k, g], sums[3, k, g])
            own = variance[k % variance.shape[0], t % variance.shape[1]]
            common = shared[k % shared.shape[0], t % shared.shape[1]]
            _add(values[k, t], own, common, weight, parts, count[k, g])


@_compiled
def add_bins(
    values: Any,
    variance: Array,
    shared: Array,
    weights: Array,
    group: npt.NDArray[np.intp],
    sums: Array,
    count: npt.NDArray[np.int64],
) -> None:
    """Do what `add_profiles` does, where the inner axis is 1 long: faster there."""
    for k in range(values.shape[0]):
        weight, x = weights[k % weights.shape[0]], values[k, :, 0]
        own, common = variance[k % variance.shape[0], :, 0], shared[k % shared.shape[0], :, 0]
        total, value, noise, systematic = sums[0, k], sums[1, k], sums[2, k], sums[3, k]
        counted = count[k]
        step = min(weight.size - 1, 1), min(own.size - 1, 1), min(common.size - 1, 1)
        for t in range(group.size):
            w, g = weight[t * step[0]], group[t]
            if g < 0 or not 0.0 < w < HUGE or not abs(x[t]) < HUGE:
                continue
            total[g, 0] += w
            value[g, 0] += w * x[t]
            noise[g, 0] += w * w * own[t * step[1]]
            systematic[g, 0] += w * math.sqrt(common[t * step[2]])
            counted[g, 0] += 1
