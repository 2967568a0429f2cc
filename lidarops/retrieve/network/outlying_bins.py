"""Compiled search for single outlying bins of a beam, and the neighbours that replace them.

Air leaves almost no difference between a bin and a polynomial through the three bins on either
side. A bin that deviates by more than noise is therefore no air. A single one is bridged: its
logarithm becomes that of the polynomial.

Edges of layers and clouds are air. Several bins then deviate, or neighbours still deviate after
bridging; such bins stay in place. As they may be no air all the same, the change by their
deviations is part of the stated error. Beams with bins wider than 10 m are not searched, because a
layer may fill a single bin. Where too many bins deviate, the stated noise is wrong, and the beam is
rejected.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Codes, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network.thresholds import THRESHOLDS

GOOD: Final = 0
LOST: Final = 1
"""Missing, or not positive."""
BRIDGED: Final = 2
KEPT: Final = 3
"""Outlying, but left in place because it may be air."""
NODES: Final = 6
"""Most neighbours of a bin that is bridged."""

_SIDE: Final[int] = np.int64(3)  # type: ignore[assignment]
"""Neighbours on either side; no literal, for which numba would compile functions once more."""
MARGIN: Final[int] = np.int64(4)  # type: ignore[assignment]
"""Neighbours on either side that decide which of several bins is the worst; so many bins before and
behind the used ones of a beam help to test these."""
_REACH: Final = 2 * MARGIN
"""Bins on either side among which neighbours are searched."""
_SMOOTH_DEGREE: Final = 3
_ONE_SIDED_DEGREE: Final = 2
_LARGEST_LOGARITHM: Final = 300.0


@compiled
def fit_weights(grid: Array, at: int, nodes: Indices, count: int, degree: int, out: Array) -> None:
    """Fill the weights of bins in a least-squares polynomial at another bin.

    It uses orthogonal polynomials (`forsythe1957`). With degree count - 1, the polynomial goes
    through the bins.
    """
    x, polynomial, polynomial_before = np.empty(count), np.ones(count), np.zeros(count)
    scale = abs(grid[nodes[count - 1]] - grid[nodes[0]]) / count
    for i in range(count):
        x[i] = (grid[nodes[i]] - grid[at]) / scale
        out[i] = 0.0
    value, value_before, norm_before = 1.0, 0.0, 1.0
    for k in range(degree + 1):
        norm = middle = 0.0
        for i in range(count):
            norm += polynomial[i] * polynomial[i]
            middle += x[i] * polynomial[i] * polynomial[i]
        middle /= norm
        recursion = norm / norm_before if k > 0 else 0.0
        for i in range(count):
            out[i] += value * polynomial[i] / norm
            following = (x[i] - middle) * polynomial[i] - recursion * polynomial_before[i]
            polynomial_before[i], polynomial[i] = polynomial[i], following
        value, value_before = -middle * value - recursion * value_before, value
        norm_before = norm


@compiled
def _good_bins(codes: Codes, at: int, way: int, most: int, nodes: Indices, count: int) -> int:
    """Append the nearest good bins on one side of a bin; return the number of all."""
    g, end = at + way, count + most
    while count < end and 0 <= g < codes.size and abs(g - at) <= _REACH:
        if codes[g] == GOOD:
            nodes[count] = g
            count += 1
        g += way
    return count


@compiled
def _adjacent_weights(grid: Array) -> Array:
    """Return (bin, NODES) weights where all neighbours are good: the usual case."""
    out, nodes = np.zeros((grid.size, NODES)), np.zeros(NODES, dtype=np.intp)
    codes = np.zeros(grid.size, dtype=np.uint8)
    for g in range(_SIDE, grid.size - _SIDE):
        count = _good_bins(codes, g, 1, _SIDE, nodes, _good_bins(codes, g, -1, _SIDE, nodes, 0))
        fit_weights(grid, g, nodes, count, NODES - 1, out[g])
    return out


@compiled
def _predict(
    grid: Array, plan: Array, codes: Codes, at: int, side: int, nodes: Indices, weights: Array
) -> tuple[int, float]:
    """Fill the neighbours that predict a bin, and their weights.

    A polynomial goes through them. It is smoother through more neighbours than usual, and at an
    end of the good bins, where all are on one side.

    Returns
    -------
    int
        Number of neighbours; 0 where they are too few.
    float
        Largest relative deviation by air.
    """
    before = _good_bins(codes, at, -1, side, nodes, 0)
    count = _good_bins(codes, at, 1, side if before > 0 else 2 * side, nodes, before)
    one_sided = before in (0, count)
    if count == before:
        count = _good_bins(codes, at, -1, 2 * side, nodes, 0)
    if count < _SIDE:
        return 0, 0.0
    if count == NODES and nodes[2] == at - _SIDE and nodes[5] == at + _SIDE:
        weights[:NODES] = plan[at]
        return count, THRESHOLDS.air_deviation
    degree = _ONE_SIDED_DEGREE if one_sided else count - 1 if side == _SIDE else _SMOOTH_DEGREE
    fit_weights(grid, at, nodes, count, min(degree, count - 1), weights)
    return count, THRESHOLDS.air_deviation_beyond if one_sided else THRESHOLDS.air_deviation


@compiled
def _deviation(
    row: tuple[Array, Array, float, Array, Array],
    codes: Codes,
    at: int,
    side: int,
    work: tuple[Indices, Array],
) -> float:
    """Return the deviation of a bin from what its neighbours predict, in standard errors.

    It is the relative deviation of the signal, whose noise is normal, beyond the one by air.
    """
    logs, noise, exponent, grid, plan = row
    nodes, weights = work
    count, air = _predict(grid, plan, codes, at, side, nodes, weights)
    if count == 0:
        return 0.0
    prediction = spread = 0.0
    for i in range(count):
        prediction += weights[i] * logs[nodes[i]]
        spread += weights[i] * weights[i] * noise[nodes[i]]
    gap = min((logs[at] - prediction) / exponent, _LARGEST_LOGARITHM)
    ratio = math.exp(gap)
    spread += noise[at] * ratio * ratio
    size = exponent * (abs(ratio - 1.0) - air)
    return size / math.sqrt(spread) if size > 0.0 and spread > 0.0 else 0.0


@compiled
def _worst_bin(
    row: tuple[Array, Array, float, Array, Array],
    codes: Codes,
    suspect: int,
    work: tuple[Indices, Array],
) -> int:
    """Return the bin around a suspect that deviates most from a smoother curve.

    An outlying bin makes its neighbours deviate too; more neighbours reduce this effect.
    """
    worst, largest = suspect, 0.0
    for g in range(max(0, suspect - _SIDE), min(codes.size, suspect + _SIDE + 1)):
        if codes[g] == GOOD:
            deviation = _deviation(row, codes, g, MARGIN, work)
            if deviation > largest:
                worst, largest = g, deviation
    return worst


@compiled
def _jumps(logs: Array, noise: Array, exponent: float, codes: Codes, at: int) -> bool:
    """Return whether the signal jumps at a bin by more than the slope of air.

    A layer may then begin in the bin.
    """
    step = spread = 0.0
    nodes = np.empty(_SIDE, dtype=np.intp)
    for way in (-1, 1):
        count = _good_bins(codes, at, way, _SIDE, nodes, 0)
        for g in nodes[:count]:
            step += way * logs[g] / count
            spread += noise[g] / (count * count)
        if count == 0:
            return False
    return abs(step) > max(COMMON.largest_step * exponent, COMMON.outlier * math.sqrt(spread))


@compiled
def _all_isolated(
    logs: Array, noise: Array, exponent: float, codes: Codes, deviations: Array
) -> bool:
    """Return whether every bridged bin is isolated, and the bins around it fit.

    Several adjacent bins, a remaining deviation beside one, or a jump across it may be the edge
    of a layer or a cloud.
    """
    for at in range(codes.size):
        if codes[at] != BRIDGED:
            continue
        for g in range(max(0, at - _REACH), min(codes.size, at + _REACH + 1)):
            near = g != at and abs(g - at) <= _SIDE
            if deviations[g] > THRESHOLDS.suspect or (near and codes[g] == BRIDGED):
                return False
        if _jumps(logs, noise, exponent, codes, at):
            return False
    return True


@compiled
def _keep_in_place(logs: Array, codes: Codes, doubt: Array) -> None:
    """Fill the deviations of outlying bins from lines between good ones."""
    for at in range(codes.size):
        if codes[at] != BRIDGED:
            continue
        before, behind = at, at
        while before >= 0 and codes[before] != GOOD:
            before -= 1
        while behind < codes.size and codes[behind] != GOOD:
            behind += 1
        before = behind if before < 0 else before
        behind = before if behind == codes.size else behind
        if behind == codes.size:
            continue
        share = (at - before) / max(behind - before, 1)
        doubt[at] = logs[at] - logs[before] - share * (logs[behind] - logs[before])
    for at in range(codes.size):
        if codes[at] == BRIDGED:
            codes[at] = KEPT


@compiled
def _all_fit(
    row: tuple[Array, Array, float, Array, Array], used: tuple[int, int], codes: Codes
) -> bool:
    """Return whether all bins are good, and the used ones fit their neighbours without doubt."""
    logs, noise, exponent, _, plan = row
    if used[0] < _SIDE or used[1] + _SIDE > codes.size:
        return False
    for g in range(used[0] - _SIDE, used[1] + _SIDE):
        if codes[g] != GOOD:
            return False
    for g in range(used[0], used[1]):
        gap, spread = logs[g], 0.0
        for i in range(_SIDE):
            before, after = plan[g, i], plan[g, _SIDE + i]
            gap -= before * logs[g - 1 - i] + after * logs[g + 1 + i]
            spread += before * before * noise[g - 1 - i] + after * after * noise[g + 1 + i]
        ratio = math.exp(min(gap / exponent, _LARGEST_LOGARITHM))
        size = exponent * (ratio - 1.0)
        # A little less than what is outlying: rounding does not count.
        limit = 0.99 * COMMON.outlier**2 * (spread + noise[g] * ratio * ratio)
        if not size * size < limit:
            return False
    return True


@compiled
def _search_row(
    row: tuple[Array, Array, float, Array, Array],
    used: tuple[int, int],
    codes: Codes,
    doubt: Array,
    work: tuple[Indices, Array],
) -> bool:
    """Mark the outlying bins of one profile; return False where they are too many.

    The worst bin is removed, and the others are tested again without it.
    """
    size = codes.size
    deviations = np.zeros(size)
    most, number = THRESHOLDS.edge_bins + int(THRESHOLDS.outlying_share * np.sum(codes == GOOD)), 0
    low, high = 0, size
    while True:
        for g in range(low, high):
            deviations[g] = 0.0
            if codes[g] == GOOD:
                deviations[g] = _deviation(row, codes, g, _SIDE, work)
        if number == 0 and not np.any(deviations[used[0] : used[1]] > COMMON.outlier):
            return True
        if number == 0 and np.sum(deviations > COMMON.outlier) > most:
            return False
        farthest = int(np.argmax(deviations))
        if number > most or not deviations[farthest] > COMMON.outlier:
            break
        worst = _worst_bin(row, codes, farthest, work)
        codes[worst] = BRIDGED
        number += 1
        low, high = max(0, worst - _REACH), min(size, worst + _REACH + 1)
    if number > most or not _all_isolated(row[0], row[1], row[2], codes, deviations):
        _keep_in_place(row[0], codes, doubt)
    return True


@compiled
def search(
    logs: Array,
    noise: Array,
    exponent: float,
    grid: Array,
    low: int,
    stops: Indices,
    codes: Codes,
    doubt: Array,
) -> None:
    """Mark the outlying bins of a beam in each profile.

    Parameters
    ----------
    logs, noise : (profile, bin) float64
        Logarithms of the signal times the exponent, and their variances, with some bins before
        and behind the used ones.
    exponent : float
    grid : (bin,) float64
        m.
    low : int
        First used bin.
    stops : (profile,) intp
        In: the bin behind the last used one. Out: `low` where too many bins deviate.
    codes : (profile, bin) uint8
        In: GOOD or LOST. Out: also BRIDGED or KEPT.
    doubt : (profile, bin) float64
        In: 0. Out: deviations of the bins that are KEPT.
    """
    work = np.zeros(2 * MARGIN, dtype=np.intp), np.zeros(2 * MARGIN)
    plan = _adjacent_weights(grid)
    for n in range(logs.shape[0]):
        if stops[n] > low:
            codes[n, stops[n] + MARGIN :] = LOST
            row = logs[n], noise[n], exponent, grid, plan
            used = low, stops[n]
            # On most beams, no used bin is outlying.
            if not (
                _all_fit(row, used, codes[n]) or _search_row(row, used, codes[n], doubt[n], work)
            ):
                stops[n] = low


@compiled
def find_neighbours(
    grid: Array, codes: Codes, rows: Indices, bins: Indices, nodes: Indices, weights: Array
) -> None:
    """Fill the neighbours of bridged bins, and their weights; of no weight beyond the last.

    Parameters
    ----------
    grid : (bin,) float64
        m.
    codes : (profile, bin) uint8
    rows, bins : (bridged bin,) intp
    nodes, weights : (bridged bin, NODES) intp and float64
        In: 0.
    """
    plan = _adjacent_weights(grid)
    for k in range(rows.size):
        _predict(grid, plan, codes[rows[k]], bins[k], _SIDE, nodes[k], weights[k])
