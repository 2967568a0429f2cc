"""Runs of gates of a network's rays that lie off: what is between them if they are wild.

The gates in the middle of a run lie on one curve with their neighbours, as wild as these may be:
only the edges of the run show. A thin layer of air with sharp edges looks the same. So what lies
between two edges is bridged by a straight line, as one of two readings of the ray. A run of which
but one edge lies on the ray is a layer that begins there, for all that the ray tells.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve._gate_outliers import BRIDGED, GOOD, LOST

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]

_LONGEST: Final = 32
"""Gates between two edges that are taken for those of one run."""
_SHORT: Final = 6
"""Gates that a polynomial still bridges."""
_SIDE: Final = 3
"""Gates on either side that make a line."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _side(
    logs: Array, noise: Array, grid: Array, codes: Codes, span: tuple[int, int, int]
) -> tuple[int, float, float, float]:
    """Return number, mean logarithm, its variance and mean range of the good gates on a side."""
    start, stop, way = span
    count, value, spread, where = 0, 0.0, 0.0, 0.0
    for g in range(start, stop, way):
        if codes[g] == GOOD and count < _SIDE:
            count, value = count + 1, value + logs[g]
            spread, where = spread + noise[g], where + grid[g]
    share = 1.0 / max(count, 1)
    return count, share * value, share * share * spread, share * where


@_compiled
def _draw(
    logs: Array,
    noise: Array,
    grid: Array,
    codes: Codes,
    run: tuple[int, int],
    ends: tuple[int, int],
) -> None:
    """Put gates on a line between the means of the good ones on either side.

    Where there are none on the one side, on the mean of the other; nothing where on neither.
    """
    left = _side(logs, noise, grid, codes, (run[0] - 1, ends[0] - 1, -1))
    right = _side(logs, noise, grid, codes, (run[1], ends[1], 1))
    if left[0] + right[0] == 0:
        return
    for g in range(run[0], run[1]):
        share = 0.0 if right[0] == 0 else 1.0
        if left[0] > 0 and right[0] > 0:
            share = (grid[g] - left[3]) / (right[3] - left[3])
        logs[g] = (1.0 - share) * left[1] + share * right[1]
        noise[g] = (1.0 - share) ** 2 * left[2] + share**2 * right[2]
        codes[g] = LOST


@_compiled
def draw_lines(logs: Array, noise: Array, grid: Array, codes: Codes, ends: tuple[int, int]) -> None:
    """Put straight lines across the runs of gates that lie off, and mark them as lost.

    Parameters
    ----------
    logs, noise : (bin,) float64
    grid : (bin,) float64
        m.
    codes : (bin,) uint8
        BRIDGED where gates lie off; what no polynomial can bridge, or lies between, gets LOST.
    ends : two int
        First of all gates, and behind the last.
    """
    before = -1
    for g in range(ends[0], ends[1]):
        if codes[g] != BRIDGED:
            continue
        if before >= 0 and g - before <= _LONGEST:
            codes[before:g] = BRIDGED
        before = g
    start = ends[0]
    while start < ends[1]:
        stop = start
        while stop < ends[1] and codes[stop] == BRIDGED:
            stop += 1
        if stop - start > _SHORT:
            _draw(logs, noise, grid, codes, (start, stop), ends)
        start = stop + 1
