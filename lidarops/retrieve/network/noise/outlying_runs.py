"""Runs of bins of a network's beams that lie off: what is between them if they are wild.

The bins in the middle of a run lie on one curve with their neighbours, as wild as these may be:
only the edges of the run show, where the signal jumps, and jumps back. A thin layer of air with
sharp edges looks the same. So what lies between two edges is bridged by a straight line, as one of
two readings of the beam. Single bins that lie off do not make the signal jump: a line across many
of them would take curved air away. Of a run that reaches beyond an end of the beam but one edge
shows: the other reading is the beam without the jump. Farther from the ends, such an edge is that
of a layer, for all that the beam tells.
"""

from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network.noise.outlying_bins import (
    BRIDGED,
    GOOD,
    LOST,
    MARGIN,
    NODES,
    OUTLYING,
    REACH,
    neighbours,
)

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]

_LONGEST: Final = 32
"""Bins between two edges that are taken for those of one run."""
_SHORT: Final = 6
"""Bins that a polynomial still bridges."""
_SIDE: Final = 3
"""Bins on either side that make a line."""
_MOST: Final = 5
"""Bins on either side that tell a jump, where so many are good."""
_STEP: Final = 0.05
"""Logarithm that the curvature of air may leave there."""
_SHARE: Final = 1 / 3
"""Of the bins of a beam, that may lie off where some of them lie together."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _side(
    logs: Array, noise: Array, grid: Array, codes: Codes, span: tuple[int, int, int]
) -> tuple[int, float, float, float]:
    """Return number, mean logarithm, its variance and mean range of the good bins on a side."""
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
    """Put bins on a line between the means of the good ones on either side.

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
def _jump(
    logs: Array, noise: Array, grid: Array, codes: Codes, at: int, ends: tuple[int, int]
) -> float:
    """Return by how much the signal rises at a bin; 0 where noise or air may have done it.

    Of two parallel lines through the good bins on either side, least squares: air's own slope is
    as steep as a run is high, where a layer begins.
    """
    count, x, y = np.zeros(2), np.zeros(2), np.zeros(2)
    nodes = np.empty((2, _MOST), dtype=np.intp)
    for side in range(2):
        way = 2 * side - 1
        g = at + way
        while ends[0] <= g < ends[1] and abs(g - at) <= REACH and count[side] < _MOST:
            if codes[g] == GOOD:
                nodes[side, int(count[side])] = g
                count[side] += 1.0
                x[side], y[side] = x[side] + grid[g], y[side] + logs[g]
            elif codes[g] == BRIDGED and count[side] > 0:
                # Behind the other edge of a run, it would be another level.
                break
            g += way
        if count[side] == 0:
            return 0.0
        x[side], y[side] = x[side] / count[side], y[side] / count[side]
    along = across = spread = 0.0
    for side in range(2):
        for i in range(int(count[side])):
            g = nodes[side, i]
            along += (grid[g] - x[side]) ** 2
            across += (grid[g] - x[side]) * (logs[g] - y[side])
            spread += noise[g] / (count[0] + count[1])
    if along == 0.0:
        return 0.0
    apart = x[1] - x[0]
    rise = y[1] - y[0] - apart * across / along
    spread *= 1.0 / count[0] + 1.0 / count[1] + apart * apart / along
    return rise if abs(rise) > max(_STEP, OUTLYING * math.sqrt(spread)) else 0.0


@_compiled
def _partner(
    logs: Array,
    noise: Array,
    grid: Array,
    codes: Codes,
    edge: tuple[int, float],
    ends: tuple[int, int],
) -> int:
    """Return the bin, if none that is marked, where the signal jumps back; -1 where it does not.

    By single bins, noise hides lower edges than by several on either side.
    """
    at, rise = edge
    found, most = -1, 0.0
    for g in range(max(ends[0], at - _LONGEST), min(ends[1], at + _LONGEST + 1)):
        if codes[g] == GOOD and abs(g - at) > _SIDE:
            step = _jump(logs, noise, grid, codes, g, ends)
            if step * rise < 0.0 and abs(step) > most:
                found, most = g, abs(step)
    return found


@_compiled
def _join(codes: Codes, steps: Array, ends: tuple[int, int]) -> None:
    """Mark what lies between two edges of a run that are marked: a jump, and one back.

    Spikes do not jump: any number of them, however close, is no run.

    Parameters
    ----------
    codes : (bin,) uint8
    steps : (bin,) float64
        How far the logarithm jumps at bins that are marked. Out: 0 where a run accounts for it.
    ends : two int
    """
    start, last, back = -1, -1, 0.0
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        # More than one bin may be marked at an edge.
        if last >= 0 and g - last <= _SIDE and steps[g] * back > 0.0:
            codes[last:g] = BRIDGED
            last, steps[g] = g, 0.0
        elif start < 0 or g - start > _LONGEST:
            start, last = g, -1
        elif steps[g] * steps[start] < 0.0:
            codes[start:g] = BRIDGED
            last, back = g, steps[g]
            steps[start : g + 1] = 0.0
            start = -1


@_compiled
def _complete(
    logs: Array, noise: Array, grid: Array, codes: Codes, steps: Array, ends: tuple[int, int]
) -> None:
    """Mark runs of which but one edge is marked, where the signal jumps back elsewhere."""
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        other = _partner(logs, noise, grid, codes, (g, steps[g]), ends)
        if other >= 0:
            # Either bin at a jump may be the last of the run.
            low, stop = min(g, other - 1), max(g + 1, other + 2)
            codes[low:stop] = BRIDGED
            steps[low:stop] = 0.0


@_compiled
def _level(logs: Array, steps: Array, ends: tuple[int, int]) -> None:
    """Move what lies between an end of the beam and a jump near it to where the rest of it is.

    The constant of a beam cancels: which side of the jump is wild makes no difference.
    """
    last = -1
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        # More than one bin may be marked at an edge.
        again = last >= 0 and g - last <= _SIDE and steps[g] * steps[last] > 0.0
        last = g
        if again:
            continue
        if g - ends[0] <= min(_LONGEST + MARGIN, ends[1] - g):
            logs[ends[0] : g] += steps[g]
        elif ends[1] - g <= _LONGEST + MARGIN:
            logs[g + 1 : ends[1]] -= steps[g]


@_compiled
def draw_lines(
    logs: Array,
    noise: Array,
    grid: Array,
    codes: Codes,
    ends: tuple[int, int],
) -> None:
    """Put straight lines across the runs of bins that lie off, and mark them as lost.

    What lies between a lone jump and an end of the beam near it is moved by the jump. All bins are
    left BRIDGED, by nothing, where so many lie off that the others may be wild too.

    Parameters
    ----------
    logs, noise : (bin,) float64
        Logarithms of the signal times the exponent, and their variances.
    grid : (bin,) float64
        m.
    codes : (bin,) uint8
        BRIDGED where bins lie off; what no polynomial can bridge, or lies between, gets LOST.
    ends : two int
        First of all bins, and behind the last.
    """
    marked = np.sum(codes[ends[0] : ends[1]] == BRIDGED)
    if marked > _SHARE * (marked + np.sum(codes[ends[0] : ends[1]] == GOOD)):
        codes[ends[0] : ends[1]] = BRIDGED
        return
    steps = np.zeros(codes.size)
    for g in range(ends[0], ends[1]):
        if codes[g] == BRIDGED:
            steps[g] = _jump(logs, noise, grid, codes, g, ends)
    _join(codes, steps, ends)
    _complete(logs, noise, grid, codes, steps, ends)
    _level(logs, steps, ends)
    start = ends[0]
    while start < ends[1]:
        stop = start
        while stop < ends[1] and codes[stop] == BRIDGED:
            stop += 1
        if stop - start > _SHORT:
            _draw(logs, noise, grid, codes, (start, stop), ends)
        start = stop + 1
    nodes, shares = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    for g in range(ends[0], ends[1]):
        # Beside a run at an end of the beam, too few are left for a polynomial.
        if codes[g] == BRIDGED and neighbours(grid, codes, g, *ends, nodes, shares)[0] == 0:
            _draw(logs, noise, grid, codes, (g, g + 1), ends)
