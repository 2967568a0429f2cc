"""Compiled search for single bins that lie off their neighbours, and what takes their place.

Air leaves next to nothing in what is left of a bin when a polynomial through the three bins on
either side is taken from it: a plume of 50 m less than 1e-5 of the signal at bins of 7.5 m. So a
bin that alone lies off by more than noise explains is no air. It is bridged: the logarithm of the
same polynomial takes its place, and its derivatives go to the bins that made it, so that
variances stay those of the bins that were used. Edges of layers and clouds are air: they leave
several bins off, or something beside the one that is taken out, and such a beam stays as it is.
So do beams of wider bins than 10 m, where a layer may fill a single one. As wild bins may lie
together too, what bridging them would change is added to the covariance of such a beam, straight
lines across long runs of them too (`lidarops.retrieve.network.noise.outlying_runs`). Where more bins lie off than
could be wild, noise is not what is stated, and the beam is not believed.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

OUTLYING: Final = 6.0
"""Standard errors off; chance goes beyond once in 5e8 bins."""
REACH: Final = 8
"""Bins to either side among which neighbours are sought."""
MARGIN: Final = 4
"""Bins before and behind those of a beam that are used, which judge them."""
NODES: Final = 6
"""Neighbours through which a polynomial goes."""
GOOD: Final = 0
LOST: Final = 1
"""Missing, or not positive."""
BRIDGED: Final = 2

LEFT: Final = -1
"""Number of bridged bins of a beam with some that lie off together, which stay as they are."""

_SIDE: Final = 3
_OTHER_SIDE: Final = (6, 3, 4, 3)
"""Neighbours on the one side where the other has 0, 1, 2 and 3."""
_ONE_SIDED_DEGREE: Final = 2
_AIR: Final = (5e-2, 1e-3, 5e-4, 5e-4)
"""Relative: what air may leave there, at most, by the neighbours on the side with fewer."""
_JUDGES: Final = 4
"""Neighbours on either side by which the worst of several bins is told."""
_JUDGES_DEGREE: Final = 3
_LOUD: Final = 0.02
"""Relative standard error of a bin from which on logarithms are not normal in their tails."""
_LOUD_ESTIMATED: Final = 0.05
"""The same of an estimated one, that tells nothing of a single bin: louder ones are not tested."""
WIDEST: Final = 10.0
"""m, of bins of which a single one is too narrow for a layer of air."""
_SUSPECT: Final = 4.5
"""Standard errors off, of bins about a bridged one, from which on it may be an edge."""
_STEP: Final = 0.1
"""Logarithm by which air may change over 4 bins: that of 2 km of visibility."""
_FEW: Final = 14
"""Bins that two edges of layers put off."""
_SHARE: Final = 0.2
"""Of the bins of a beam, that may lie off beside them."""
_LARGEST_LOGARITHM: Final = 300.0

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _fit_shares(grid: Array, at: int, nodes: Indices, count: int, degree: int, out: Array) -> None:
    """Fill the shares of some bins in a least-squares polynomial at another bin.

    By orthogonal polynomials (`forsythe1957`); of degree count - 1, it goes through the bins.
    """
    x, p, before = np.empty(NODES + 2), np.ones(NODES + 2), np.zeros(NODES + 2)
    scale = abs(grid[nodes[count - 1]] - grid[nodes[0]]) / count
    for i in range(count):
        x[i] = (grid[nodes[i]] - grid[at]) / scale
        out[i] = 0.0
    here, here_before, norm_before = 1.0, 0.0, 1.0
    for k in range(degree + 1):
        norm = middle = 0.0
        for i in range(count):
            norm += p[i] * p[i]
            middle += x[i] * p[i] * p[i]
        middle /= norm
        back = norm / norm_before if k > 0 else 0.0
        for i in range(count):
            out[i] += here * p[i] / norm
            following = (x[i] - middle) * p[i] - back * before[i]
            before[i], p[i] = p[i], following
        here, here_before = -middle * here - back * here_before, here
        norm_before = norm


@_compiled
def _gather(
    codes: Codes, at: int, first: int, stop: int, wanted: tuple[int, int], nodes: Indices
) -> int:
    """Fill the nearest good bins before and behind a bin, in order; return how many."""
    below = 0
    g = at - 1
    while below < wanted[0] and g >= max(first, at - REACH):
        if codes[g] == GOOD:
            below += 1
            nodes[wanted[0] - below] = g
        g -= 1
    for i in range(below):
        nodes[i] = nodes[wanted[0] - below + i]
    count = below
    g = at + 1
    while count < below + wanted[1] and g < min(stop, at + REACH + 1):
        if codes[g] == GOOD:
            nodes[count] = g
            count += 1
        g += 1
    return count


@_compiled
def _sides(codes: Codes, at: int, first: int, stop: int) -> tuple[int, int]:
    """Return how many good bins before and behind a bin make its polynomial."""
    below = above = 0
    for g in range(at - 1, max(first, at - REACH) - 1, -1):
        below += codes[g] == GOOD
    for g in range(at + 1, min(stop, at + REACH + 1)):
        above += codes[g] == GOOD
    if below >= _SIDE and above >= _SIDE:
        return _SIDE, _SIDE
    if below < above:
        return below, min(above, _OTHER_SIDE[below])
    return min(below, _OTHER_SIDE[above]), above


@_compiled
def neighbours(
    grid: Array, codes: Codes, at: int, first: int, stop: int, nodes: Indices, shares: Array
) -> tuple[int, float]:
    """Fill the bins that tell a bin, and their shares.

    Returns
    -------
    int
        How many; 0 where they are too few.
    float
        What air may leave, relative.
    """
    wanted = _sides(codes, at, first, stop)
    if wanted[0] + wanted[1] < _SIDE:
        return 0, 0.0
    count = _gather(codes, at, first, stop, wanted, nodes)
    fewer = min(wanted[0], wanted[1])
    degree = count - 1 if fewer > 0 else _ONE_SIDED_DEGREE
    _fit_shares(grid, at, nodes, count, degree, shares)
    return count, _AIR[fewer]


@_compiled
def plan_neighbours(
    grid: Array, limits: Indices, nodes: Indices, shares: Array, air: Array
) -> None:
    """Fill, for each beam and bin, its neighbours where all bins are good.

    Parameters
    ----------
    grid : (beam, bin) float64
        m.
    limits : (beam, 2) intp
        First bin that may be used, and the one behind the last.
    nodes : (beam, bin, NODES) intp
        Filled up with the last one.
    shares : (beam, bin, NODES) float64
        Filled up with 0.
    air : (beam, bin) float64
        NaN where neighbours are too few.
    """
    codes = np.zeros(grid.shape[1], dtype=np.uint8)
    for beam in range(grid.shape[0]):
        first, stop = limits[beam, 0], limits[beam, 1]
        for g in range(first, stop):
            count, allowed = neighbours(
                grid[beam], codes, g, first, stop, nodes[beam, g], shares[beam, g]
            )
            air[beam, g] = allowed if count > 0 else math.nan
            for i in range(count, NODES):
                nodes[beam, g, i] = nodes[beam, g, max(count - 1, 0)]
                shares[beam, g, i] = 0.0


def planned(grid: Array, limits: Indices) -> tuple[Indices, Array, Array]:
    """Return what `plan_neighbours` fills."""
    shape = (*grid.shape, NODES)
    out = np.zeros(shape, dtype=np.intp), np.zeros(shape), np.full(grid.shape, np.nan)
    plan_neighbours(grid, limits, *out)
    return out


@_compiled
def make_plain(
    logs: Array,
    noise: Array,
    exponent: float,
    codes: Codes,
    span: tuple[int, int, int, int],
    plain: Array,
    wide: Array,
) -> None:
    """Fill the signal, in units of a level along the beam that no single bin decides.

    Parameters
    ----------
    logs, noise : (bin,) float64
    exponent : float
    codes : (bin,) uint8
    span : four int
        First of all bins, first and behind the last of those that are surely good, behind the
        last of all.
    plain, wide : (bin,) float64
        The signal and its variances, filled where they may be asked for.
    """
    first, low, stop, last = span
    loud = False
    for g in range(first, last):
        loud = loud or (codes[g] == GOOD and not noise[g] < (_LOUD * exponent) ** 2)
    if not loud:
        return
    ends = min(logs[low], logs[stop - 1]), max(logs[low], logs[stop - 1])
    level = min(max(logs[(low + stop) // 2], ends[0]), ends[1])
    for g in range(first, last):
        if codes[g] == GOOD:
            plain[g] = math.exp(min((logs[g] - level) / exponent, _LARGEST_LOGARITHM))
            wide[g] = plain[g] * plain[g] * noise[g] / (exponent * exponent)


@_compiled
def _off(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    relative: bool,
    at: int,
    nodes: Indices,
    shares: Array,
    count: int,
    air: float,
) -> float:
    """Return by how many standard errors a bin lies off a polynomial, beyond what air does.

    In logarithms where noise is low; otherwise in the signal itself, whose noise is normal.
    """
    logs, noise, plain, wide = row
    loudest = noise[at]
    for i in range(count):
        loudest = max(loudest, noise[nodes[i]])
    told = spread = 0.0
    if loudest < ((_LOUD_ESTIMATED if relative else _LOUD) * exponent) ** 2:
        for i in range(count):
            told += shares[i] * logs[nodes[i]]
            spread += shares[i] * shares[i] * noise[nodes[i]]
        gap = abs(logs[at] - told) - air * exponent
        spread += noise[at]
    elif relative:
        # Such variances know nothing of a bin's own noise.
        return 0.0
    else:
        for i in range(count):
            told += shares[i] * plain[nodes[i]]
            spread += shares[i] * shares[i] * wide[nodes[i]]
        gap = abs(plain[at] - told) - air * abs(told)
        spread += wide[at]
    return gap / math.sqrt(spread) if gap > 0.0 and spread > 0.0 else 0.0


@_compiled
def _measure(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    relative: bool,
    grid: Array,
    codes: Codes,
    span: tuple[int, int, int, int],
    planned: tuple[Indices, Array, Array],
    off: Array,
) -> None:
    """Fill how far off bins lie, from one bin to another."""
    first, stop, start, end = span
    nodes, shares = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    for g in range(start, end):
        off[g] = 0.0
        if codes[g] != GOOD:
            continue
        whole = first <= planned[0][g, 0] and planned[0][g, NODES - 1] < stop
        lost = 0
        for i in range(NODES):
            lost |= codes[planned[0][g, i]]
        if whole and lost == GOOD:
            off[g] = _off(
                row, exponent, relative, g, planned[0][g], planned[1][g], NODES, planned[2][g]
            )
        else:
            count, air = neighbours(grid, codes, g, first, stop, nodes, shares)
            if count > 0:
                off[g] = _off(row, exponent, relative, g, nodes, shares, count, air)


@_compiled
def _worst(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    relative: bool,
    grid: Array,
    codes: Codes,
    hit: int,
    first: int,
    stop: int,
) -> int:
    """Return the bin about a hit that lies farthest off a smoother curve.

    A wild bin makes its neighbours look wild, the less so the more bins judge.
    """
    nodes, shares = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    found, most = hit, 0.0
    for g in range(max(first, hit - _SIDE), min(stop, hit + _SIDE + 1)):
        if codes[g] != GOOD:
            continue
        count = _gather(codes, g, first, stop, (_JUDGES, _JUDGES), nodes)
        if count < _SIDE:
            continue
        _fit_shares(grid, g, nodes, count, min(_JUDGES_DEGREE, count - 2), shares)
        off = _off(row, exponent, relative, g, nodes, shares, count, 0.0)
        if off > most:
            found, most = g, off
    return found


@_compiled
def _jumps(
    logs: Array, noise: Array, exponent: float, codes: Codes, at: int, first: int, stop: int
) -> bool:
    """Return whether the signal before a bin and that behind it differ by more than air's slope.

    The bin may then be the one in which a layer begins.
    """
    step = spread = 0.0
    for way in (-1, 1):
        count, total, variance, g = 0, 0.0, 0.0, at + way
        while count < _SIDE and first <= g < stop and abs(g - at) <= REACH:
            if codes[g] == GOOD:
                count, total, variance = count + 1, total + logs[g], variance + noise[g]
            g += way
        if count == 0:
            return False
        step += way * total / count
        spread += variance / (count * count)
    return abs(step) > max(_STEP * exponent, OUTLYING * math.sqrt(spread))


@_compiled
def _alone(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    codes: Codes,
    off: Array,
    first: int,
    stop: int,
) -> bool:
    """Return whether every bridged bin lies alone, and all bins about it are as they should be.

    Several together, what is left beside one, or a jump from one side to the other may be the
    edge of a layer or a cloud.
    """
    for at in range(first, stop):
        if codes[at] != BRIDGED:
            continue
        for g in range(max(first, at - REACH), min(stop, at + REACH + 1)):
            near = g != at and abs(g - at) <= _SIDE
            if off[g] > _SUSPECT or (near and codes[g] == BRIDGED):
                return False
        if _jumps(row[0], row[1], exponent, codes, at, first, stop):
            return False
    return True


@_compiled
def _exceeds(
    values: Array, variances: Array, at: int, shares: Array, air: tuple[float, float]
) -> bool:
    """Return whether a bin lies off the three on either side, without a square root.

    Of what air leaves, the first part is absolute, the second one of the value.
    """
    told = (
        shares[at, 0] * values[at - 3] + shares[at, 1] * values[at - 2]
        + shares[at, 2] * values[at - 1] + shares[at, 3] * values[at + 1]
        + shares[at, 4] * values[at + 2] + shares[at, 5] * values[at + 3]
    )  # fmt: skip
    spread = variances[at] + (
        shares[at, 0] * shares[at, 0] * variances[at - 3]
        + shares[at, 1] * shares[at, 1] * variances[at - 2]
        + shares[at, 2] * shares[at, 2] * variances[at - 1]
        + shares[at, 3] * shares[at, 3] * variances[at + 1]
        + shares[at, 4] * shares[at, 4] * variances[at + 2]
        + shares[at, 5] * shares[at, 5] * variances[at + 3]
    )
    gap = abs(values[at] - told) - (air[0] + air[1] * abs(told))
    return gap > 0.0 and not gap * gap <= OUTLYING * OUTLYING * spread


@_compiled
def _quiet(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    relative: bool,
    codes: Codes,
    span: tuple[int, int, int, int],
    planned: tuple[Indices, Array, Array],
) -> bool:
    """Return whether no bin that is used lies off, where all are good, as on most beams."""
    logs, noise, plain, wide = row
    first, low, stop, last = span
    loud = (_LOUD * exponent) ** 2
    lost = 0
    for g in range(first, last):
        lost |= codes[g]
    if lost != 0 or relative:
        return False
    for g in range(low, stop):
        left, right = planned[0][g, 0], planned[0][g, NODES - 1]
        if left < first or right >= last:
            return False
        if right - left != NODES or right - g != _SIDE:
            if _off(row, exponent, relative, g, planned[0][g], planned[1][g], NODES,
                    planned[2][g]) > OUTLYING:  # fmt: skip
                return False
            continue
        loudest = noise[g]
        for k in range(g - _SIDE, g + _SIDE + 1):
            loudest = max(loudest, noise[k])
        if loudest < loud:
            off = _exceeds(logs, noise, g, planned[1], (planned[2][g] * exponent, 0.0))
        else:
            off = _exceeds(plain, wide, g, planned[1], (0.0, planned[2][g]))
        if off:
            return False
    return True


@_compiled
def find_outliers(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    relative: bool,
    grid: Array,
    span: tuple[int, int, int, int],
    planned: tuple[Indices, Array, Array],
    codes: Codes,
    marked: Codes,
    off: Array,
) -> tuple[int, int]:
    """Mark the bins of a beam that are to be bridged.

    The one that lies farthest off is taken out, and the others are looked at again without it.

    Parameters
    ----------
    row : four (bin,) float64
        Logarithms times the exponent, their variances, the signal in any unit, and its variances.
    exponent, relative
        As of `lidarops.retrieve.network._condensed_signals.condense`.
    grid : (bin,) float64
        m.
    span : four int
        First of all bins, first and behind the last of those that are used, behind the last of
        all.
    planned : (bin, NODES) intp, (bin, NODES) float64, (bin,) float64
        Of `plan_neighbours`.
    codes : (bin,) uint8
        In: GOOD or LOST; out: also BRIDGED.
    marked : (bin,) uint8
        Where bins lie together that are left: `codes` as if they were wild.
    off : (bin,) float64
        Scratch.

    Returns
    -------
    int
        How many are to be bridged; LEFT where several lie together.
    int
        Behind the last bin to be believed.
    """
    first, _, _, stop = span
    most = _FEW + int(_SHARE * (stop - first))
    number = 0
    if stop <= first or _quiet(row, exponent, relative, codes, span, planned):
        return number, stop
    _measure(row, exponent, relative, grid, codes, (first, stop, first, stop), planned, off)
    wild = int(np.sum(off[first:stop] > OUTLYING))
    if wild > most:
        codes[first:stop] = LOST
        return wild, first
    while True:
        hit = first + int(np.argmax(off[first:stop]))
        if number > most or not off[hit] > OUTLYING:
            break
        worst = _worst(row, exponent, relative, grid, codes, hit, first, stop)
        codes[worst] = BRIDGED
        number += 1
        about = max(first, worst - REACH), min(stop, worst + REACH + 1)
        _measure(row, exponent, relative, grid, codes, (first, stop, *about), planned, off)
    if number > most or (number > 0 and not _alone(row, exponent, codes, off, first, stop)):
        for g in range(first, stop):
            marked[g] = codes[g]
            codes[g] = GOOD if codes[g] == BRIDGED else codes[g]
        number = LEFT
    return number, stop


@_compiled
def replace_outliers(
    logs: Array,
    noise: Array,
    exponent: float,
    grid: Array,
    span: tuple[int, int, int],
    codes: Codes,
    nodes: Indices,
    shares: Array,
) -> int:
    """Put what neighbours tell into bins that are marked; return where the first has none.

    The mean of a logarithm lies half its variance low, of one bin as of what several make.

    Parameters
    ----------
    logs, noise : (bin,) float64
    exponent : float
    grid : (bin,) float64
    span : int, int and int
        First bin that neighbours come from, that behind the last, and that behind the last
        bin to be bridged.
    codes : (bin,) uint8
    nodes : (bin, NODES) intp
        Filled for bridged bins; the first of them is -1 where neighbours are fewer.
    shares : (bin, NODES) float64
        0 where there is no neighbour.
    """
    first, stop, end = span
    for g in range(first, end):
        if codes[g] != BRIDGED:
            continue
        count, _ = neighbours(grid, codes, g, first, stop, nodes[g], shares[g])
        if count == 0:
            return g
        for i in range(count, NODES):
            nodes[g, i], shares[g, i] = nodes[g, 0], 0.0
        value = spread = 0.0
        for i in range(count):
            k = nodes[g, i]
            value += shares[g, i] * (logs[k] + 0.5 * noise[k] / exponent)
            spread += shares[g, i] * shares[g, i] * noise[k]
        logs[g], noise[g] = value - 0.5 * spread / exponent, spread
    return end


@_compiled
def hand_on(
    gradients: Array,
    bounds: Indices,
    quantities: int,
    span: tuple[int, int],
    codes: Codes,
    nodes: Indices,
    shares: Array,
) -> None:
    """Give the derivatives by bridged bins to the bins that made them."""
    for g in range(span[0], span[1]):
        if codes[g] != BRIDGED:
            continue
        for q in range(quantities):
            if not bounds[q, 0] <= g < bounds[q, 1]:
                continue
            for i in range(NODES):
                k = nodes[g, i]
                gradients[q, k] += shares[g, i] * gradients[q, g]
                bounds[q, 0], bounds[q, 1] = min(bounds[q, 0], k), max(bounds[q, 1], k + 1)
            gradients[q, g] = 0.0
