"""Compiled search for stretches whose optical depth of particles is negative."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.common.compiled_code import compiled


@compiled
def falling(
    depth: Array,
    covariance: Array,
    effects: Array,
    usable: Integers,
    least: float,
) -> Booleans:
    """Return the cells from which the depth falls to any other beyond, by more than its error.

    Parameters
    ----------
    depth : (cell,) float
    covariance : (cell, cell) float
        Of the depth, by noise and smoothness.
    effects : (cause, cell) float
        Change of the depth with one standard error of each other cause.
    usable : (usable cell,) int
        Cells that are compared, ascending.
    least : float
        Standard errors.
    """
    negative = np.zeros(depth.size, dtype=np.bool_)
    for number in range(usable.size):
        i = usable[number]
        for beyond in range(number + 1, usable.size):
            j = usable[beyond]
            if depth[i] <= depth[j]:
                continue
            square = (depth[i] - depth[j]) ** 2
            variance = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
            # Most differ by less than their noise.
            if square <= least**2 * variance:
                continue
            for effect in effects:
                variance += (effect[i] - effect[j]) ** 2
            if square > least**2 * variance:
                negative[i] = True
                break
    return negative
