"""Beams that end at an obstruction: a tree, a building or the ground."""

from __future__ import annotations

from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Block
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_BEHIND: Final = 4
"""Blocks behind an obstruction that must be dark, after one that may hold its edge."""


def obstruction_range(power: Array, variance: Array, distance: Array) -> Array:
    """Return the range from which a beam is blocked.

    Behind it, the range-corrected signal is less than 2 percent of that before. A dense cloud
    that ends a beam is an obstruction too.

    Parameters
    ----------
    power, variance : (profile, range) float
        Without background; NaN where missing.
    distance : (range,) float
        m, rising.

    Returns
    -------
    (profile,) float
        m, the start of the last block before the darkness, which holds the obstruction itself; inf
        for a free beam.
    """
    bins = int(np.searchsorted(distance, distance[0] + THRESHOLDS.obstruction_block))
    count = distance.size // max(bins, 1)
    blocked = np.full(len(power), np.inf)
    if count < _BEHIND + 2:
        return blocked
    shape = (count, bins)
    known = np.isfinite(power) & np.isfinite(variance)
    square = distance[: count * bins].reshape(shape) ** 2

    def blocks(array: Block) -> Block:
        return array[:, : count * bins].reshape(-1, *shape)

    inside = np.count_nonzero(blocks(known), axis=2)
    # Summed as they are multiplied.
    values, spread = (
        np.einsum("pcb,cb->pc", blocks(np.where(known, array, 0.0)), factor)
        for array, factor in ((power, square), (variance, square**2))
    )
    samples = np.maximum(inside, 1.0)
    level, error = values / samples, np.sqrt(spread) / samples
    # Missing bins, such as saturated ones, do not show darkness.
    seen = np.where(inside > 0, level, np.inf)
    before = slice(0, count - _BEHIND - 1)
    behind, noise = (
        np.stack(
            [array[:, first : first + count - _BEHIND - 1] for first in range(2, _BEHIND + 2)]
        ).max(axis=0)
        for array in (seen, error)
    )
    # The echo of a target is rough, and so is the noise that is estimated from it.
    bright = level[:, before] > THRESHOLDS.obstruction_signal * noise
    dark = behind < THRESHOLDS.obstruction_drop * level[:, before]
    ends = bright & dark & (inside[:, before] > 0)
    rows = np.flatnonzero(ends.any(axis=1))
    blocked[rows] = distance[ends[rows].argmax(axis=1) * bins]
    return blocked
