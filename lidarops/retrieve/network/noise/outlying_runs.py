"""Runs of outlying bins on the beams of a network: the beam without them, as a second reading.

Bins in the middle of a run fit their outlying neighbours. Only the edges of a run show, where the
signal jumps and jumps back. A thin layer of air with sharp edges looks the same, so a straight
line between two edges gives only one of two possible readings of the beam. Single outlying bins
make no jump: a line across many of them would remove curved air. A run that extends beyond an end
of the beam has only one edge, and the second reading is the beam without the jump. Farther from
the ends, the beam cannot distinguish such an edge from that of a layer.
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
    OUTLYING_SIGMAS,
    REACH,
    find_neighbours,
)

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]

_LONGEST: Final = 32
"""Largest number of bins between two edges of one run."""
_SHORT: Final = 6
"""Largest number of adjacent bins that a polynomial bridges."""
_LINE_BINS: Final = 3
"""Bins on either side for the mean at an end of a line."""
_JUMP_BINS: Final = 5
"""Bins on either side that measure a jump, if so many are good."""
_STEP: Final = 0.05
"""Jump of the logarithm that the curvature of air may cause."""
_LARGEST_SHARE: Final = 1 / 3
"""Fraction of the bins of a beam that may be outlying where some of them are adjacent."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _side_mean(
    logs: Array, noise: Array, grid: Array, codes: Codes, span: tuple[int, int, int]
) -> tuple[int, float, float, float]:
    """Return number, mean logarithm, its variance and mean range of the good bins on a side."""
    start, stop, step = span
    count, value, spread, range_sum = 0, 0.0, 0.0, 0.0
    for g in range(start, stop, step):
        if codes[g] == GOOD and count < _LINE_BINS:
            count, value = count + 1, value + logs[g]
            spread, range_sum = spread + noise[g], range_sum + grid[g]
    share = 1.0 / max(count, 1)
    return count, share * value, share * share * spread, share * range_sum


@_compiled
def _draw_line(
    logs: Array,
    noise: Array,
    grid: Array,
    codes: Codes,
    run: tuple[int, int],
    ends: tuple[int, int],
) -> None:
    """Put bins on a line between the means of the good ones on either side.

    With good bins on one side only, their mean is used; without any, nothing changes.
    """
    left = _side_mean(logs, noise, grid, codes, (run[0] - 1, ends[0] - 1, -1))
    right = _side_mean(logs, noise, grid, codes, (run[1], ends[1], 1))
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
def _jump_height(
    logs: Array, noise: Array, grid: Array, codes: Codes, at: int, ends: tuple[int, int]
) -> float:
    """Return the jump of the signal at a bin; 0 where it may be noise or air.

    It is the distance of two parallel least-squares lines through the good bins on either side,
    because the slope of air may be as large as a jump where a layer begins.
    """
    count, x, y = np.zeros(2), np.zeros(2), np.zeros(2)
    nodes = np.empty((2, _JUMP_BINS), dtype=np.intp)
    for side in range(2):
        way = 2 * side - 1
        g = at + way
        while ends[0] <= g < ends[1] and abs(g - at) <= REACH and count[side] < _JUMP_BINS:
            if codes[g] == GOOD:
                nodes[side, int(count[side])] = g
                count[side] += 1.0
                x[side], y[side] = x[side] + grid[g], y[side] + logs[g]
            elif codes[g] == BRIDGED and count[side] > 0:
                # Behind the other edge of a run, the level is another one.
                break
            g += way
        if count[side] == 0:
            return 0.0
        x[side], y[side] = x[side] / count[side], y[side] / count[side]
    range_square = product = spread = 0.0
    for side in range(2):
        for i in range(int(count[side])):
            g = nodes[side, i]
            range_square += (grid[g] - x[side]) ** 2
            product += (grid[g] - x[side]) * (logs[g] - y[side])
            spread += noise[g] / (count[0] + count[1])
    if range_square == 0.0:
        return 0.0
    distance = x[1] - x[0]
    rise = y[1] - y[0] - distance * product / range_square
    spread *= 1.0 / count[0] + 1.0 / count[1] + distance * distance / range_square
    return rise if abs(rise) > max(_STEP, OUTLYING_SIGMAS * math.sqrt(spread)) else 0.0


@_compiled
def _opposite_edge(
    logs: Array,
    noise: Array,
    grid: Array,
    codes: Codes,
    edge: tuple[int, float],
    ends: tuple[int, int],
) -> int:
    """Return the unmarked bin where the signal jumps back; -1 without one.

    Several bins on either side show lower edges than a test of single bins does.
    """
    edge_bin, rise = edge
    opposite, largest = -1, 0.0
    for g in range(max(ends[0], edge_bin - _LONGEST), min(ends[1], edge_bin + _LONGEST + 1)):
        if codes[g] == GOOD and abs(g - edge_bin) > _LINE_BINS:
            step = _jump_height(logs, noise, grid, codes, g, ends)
            if step * rise < 0.0 and abs(step) > largest:
                opposite, largest = g, abs(step)
    return opposite


@_compiled
def _mark_runs(codes: Codes, steps: Array, ends: tuple[int, int]) -> None:
    """Mark the bins between two marked edges of a run: a jump, and a jump back.

    Spikes make no jump: any number of them, however close, is no run.

    Parameters
    ----------
    codes : (bin,) uint8
    steps : (bin,) float64
        Jump of the logarithm at marked bins. Out: 0 where a run explains it.
    ends : two int
    """
    start, last, end_step = -1, -1, 0.0
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        # More than one bin may be marked at an edge.
        if last >= 0 and g - last <= _LINE_BINS and steps[g] * end_step > 0.0:
            codes[last:g] = BRIDGED
            last, steps[g] = g, 0.0
        elif start < 0 or g - start > _LONGEST:
            start, last = g, -1
        elif steps[g] * steps[start] < 0.0:
            codes[start:g] = BRIDGED
            last, end_step = g, steps[g]
            steps[start : g + 1] = 0.0
            start = -1


@_compiled
def _mark_half_open_runs(
    logs: Array, noise: Array, grid: Array, codes: Codes, steps: Array, ends: tuple[int, int]
) -> None:
    """Mark runs with only one marked edge, if the signal jumps back elsewhere."""
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        opposite = _opposite_edge(logs, noise, grid, codes, (g, steps[g]), ends)
        if opposite >= 0:
            # Either bin at a jump may be the last one of the run.
            low, stop = min(g, opposite - 1), max(g + 1, opposite + 2)
            codes[low:stop] = BRIDGED
            steps[low:stop] = 0.0


@_compiled
def _remove_end_jumps(logs: Array, steps: Array, ends: tuple[int, int]) -> None:
    """Shift the bins between an end of the beam and a jump near it to the level of the rest.

    The constant of a beam cancels, so it does not matter which side of the jump is outlying.
    """
    last = -1
    for g in range(ends[0], ends[1]):
        if steps[g] == 0.0:
            continue
        # More than one bin may be marked at an edge.
        same_edge = last >= 0 and g - last <= _LINE_BINS and steps[g] * steps[last] > 0.0
        last = g
        if same_edge:
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
    """Put straight lines across runs of outlying bins, and mark these as lost.

    Bins between a single jump and an end of the beam near it are shifted by the jump. Where so
    many bins are outlying that the others may be too, all bins become BRIDGED, without neighbours.

    Parameters
    ----------
    logs, noise : (bin,) float64
        Logarithms of the signal times the exponent, and their variances.
    grid : (bin,) float64
        m.
    codes : (bin,) uint8
        In: BRIDGED where bins are outlying. Out: LOST where no polynomial can bridge them.
    ends : two int
        First of all bins, and behind the last.
    """
    marked = np.sum(codes[ends[0] : ends[1]] == BRIDGED)
    if marked > _LARGEST_SHARE * (marked + np.sum(codes[ends[0] : ends[1]] == GOOD)):
        codes[ends[0] : ends[1]] = BRIDGED
        return
    steps = np.zeros(codes.size)
    for g in range(ends[0], ends[1]):
        if codes[g] == BRIDGED:
            steps[g] = _jump_height(logs, noise, grid, codes, g, ends)
    _mark_runs(codes, steps, ends)
    _mark_half_open_runs(logs, noise, grid, codes, steps, ends)
    _remove_end_jumps(logs, steps, ends)
    start = ends[0]
    while start < ends[1]:
        stop = start
        while stop < ends[1] and codes[stop] == BRIDGED:
            stop += 1
        if stop - start > _SHORT:
            _draw_line(logs, noise, grid, codes, (start, stop), ends)
        start = stop + 1
    nodes, weights = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    for g in range(ends[0], ends[1]):
        # Beside a run at an end of the beam, too few good bins are left for a polynomial.
        if codes[g] == BRIDGED and find_neighbours(grid, codes, g, *ends, nodes, weights)[0] == 0:
            _draw_line(logs, noise, grid, codes, (g, g + 1), ends)
