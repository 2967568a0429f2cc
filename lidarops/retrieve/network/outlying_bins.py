"""Compiled search for single outlying bins, and their interpolation from neighbours.

Air leaves almost no difference between a bin and a polynomial through the three bins on either
side: for a plume of 50 m, less than 1e-5 of the signal at bins of 7.5 m. A single bin that
deviates by more than noise is therefore no air. It is bridged: its logarithm is replaced by that
of the polynomial, and its derivatives go to the neighbours, so that variances are those of the
bins that were used.

Edges of layers and clouds are air. Several bins then deviate, or neighbours still deviate after
bridging; such a beam stays as it is. So do beams with bins wider than 10 m, where a layer may
fill a single bin. As adjacent bins may be outlying too, the change that bridging them would make
is added to the covariance of the beam. Where too many bins deviate, the stated noise is wrong, and
the beam is rejected.
"""

from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

OUTLYING_SIGMAS: Final = THRESHOLDS.outlier
REACH: Final = THRESHOLDS.reach
MARGIN: Final = THRESHOLDS.margin
NODES: Final = 6
"""Neighbours that a polynomial goes through."""
GOOD: Final = 0
LOST: Final = 1
"""Missing, or not positive."""
BRIDGED: Final = 2

LEFT_IN_PLACE: Final = -1
"""In place of the number of bridged bins: several outlying bins lie together and stay."""

_SIDE: Final = 3
_OTHER_SIDE: Final = (6, 3, 4, 3)
"""Neighbours on one side where the other side has 0, 1, 2 and 3."""
_ONE_SIDED_DEGREE: Final = 2
_AIR_DEVIATION: Final = THRESHOLDS.air_deviation
_REFERENCE_BINS: Final = 4
"""Neighbours on either side that decide which of several bins is the worst."""
_REFERENCE_DEGREE: Final = 3
_NOISY_BIN: Final = THRESHOLDS.noisy_bin
WIDEST_BIN: Final = THRESHOLDS.widest_bin
_SUSPECT_SIGMAS: Final = THRESHOLDS.suspect
_STEP: Final = THRESHOLDS.step
_EDGE_BINS: Final = THRESHOLDS.edge_bins
_OUTLYING_SHARE: Final = THRESHOLDS.outlying_share
_LARGEST_LOGARITHM: Final = 300.0

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _fit_weights(grid: Array, at: int, nodes: Indices, count: int, degree: int, out: Array) -> None:
    """Fill the weights of bins in a least-squares polynomial at another bin.

    It uses orthogonal polynomials (`forsythe1957`). With degree count - 1, the polynomial goes
    through the bins.
    """
    x, polynomial, polynomial_before = np.empty(NODES + 2), np.ones(NODES + 2), np.zeros(NODES + 2)
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


@_compiled
def _nearest_good_bins(
    codes: Codes, at: int, first: int, stop: int, sides: tuple[int, int], nodes: Indices
) -> int:
    """Fill the nearest good bins before and behind a bin, in order; return their number."""
    before = 0
    g = at - 1
    while before < sides[0] and g >= max(first, at - REACH):
        if codes[g] == GOOD:
            before += 1
            nodes[sides[0] - before] = g
        g -= 1
    for i in range(before):
        nodes[i] = nodes[sides[0] - before + i]
    count = before
    g = at + 1
    while count < before + sides[1] and g < min(stop, at + REACH + 1):
        if codes[g] == GOOD:
            nodes[count] = g
            count += 1
        g += 1
    return count


@_compiled
def _neighbour_counts(codes: Codes, at: int, first: int, stop: int) -> tuple[int, int]:
    """Return the numbers of good bins before and behind a bin for its polynomial."""
    before = after = 0
    for g in range(at - 1, max(first, at - REACH) - 1, -1):
        before += codes[g] == GOOD
    for g in range(at + 1, min(stop, at + REACH + 1)):
        after += codes[g] == GOOD
    if before >= _SIDE and after >= _SIDE:
        return _SIDE, _SIDE
    if before < after:
        return before, min(after, _OTHER_SIDE[before])
    return min(before, _OTHER_SIDE[after]), after


@_compiled
def find_neighbours(
    grid: Array, codes: Codes, at: int, first: int, stop: int, nodes: Indices, weights: Array
) -> tuple[int, float]:
    """Fill the neighbours that predict a bin, and their weights.

    Returns
    -------
    int
        Number of neighbours; 0 where they are too few.
    float
        Largest relative deviation by air.
    """
    sides = _neighbour_counts(codes, at, first, stop)
    if sides[0] + sides[1] < _SIDE:
        return 0, 0.0
    count = _nearest_good_bins(codes, at, first, stop, sides, nodes)
    fewer = min(sides[0], sides[1])
    degree = count - 1 if fewer > 0 else _ONE_SIDED_DEGREE
    _fit_weights(grid, at, nodes, count, degree, weights)
    return count, _AIR_DEVIATION[fewer]


@_compiled
def plan_neighbours(
    grid: Array, limits: Indices, nodes: Indices, weights: Array, air: Array
) -> None:
    """Fill the neighbours of each bin of each beam, if all bins are good.

    Parameters
    ----------
    grid : (beam, bin) float64
        m.
    limits : (beam, 2) intp
        First usable bin, and the one behind the last.
    nodes : (beam, bin, NODES) intp
        Padded with the last neighbour.
    weights : (beam, bin, NODES) float64
        Weights of the neighbours, padded with 0.
    air : (beam, bin) float64
        Largest relative deviation by air; NaN where neighbours are too few.
    """
    codes = np.zeros(grid.shape[1], dtype=np.uint8)
    for beam in range(grid.shape[0]):
        first, stop = limits[beam, 0], limits[beam, 1]
        for g in range(first, stop):
            count, allowed = find_neighbours(
                grid[beam], codes, g, first, stop, nodes[beam, g], weights[beam, g]
            )
            air[beam, g] = allowed if count > 0 else math.nan
            for i in range(count, NODES):
                nodes[beam, g, i] = nodes[beam, g, max(count - 1, 0)]
                weights[beam, g, i] = 0.0


def neighbour_plan(grid: Array, limits: Indices) -> tuple[Indices, Array, Array]:
    """Return the arrays that `plan_neighbours` fills."""
    shape = (*grid.shape, NODES)
    arrays = np.zeros(shape, dtype=np.intp), np.zeros(shape), np.full(grid.shape, np.nan)
    plan_neighbours(grid, limits, *arrays)
    return arrays


@_compiled
def scale_signal(
    logs: Array,
    noise: Array,
    exponent: float,
    codes: Codes,
    span: tuple[int, int, int, int],
    scaled: Array,
    scaled_variance: Array,
) -> None:
    """Fill the signal in units of a level that is robust against single bins.

    Parameters
    ----------
    logs, noise : (bin,) float64
    exponent : float
    codes : (bin,) uint8
    span : four int
        First of all bins, first and behind the last of those that are known to be good, behind
        the last of all.
    scaled, scaled_variance : (bin,) float64
        Out: the signal and its variances, where noise requires them.
    """
    first, low, stop, last = span
    noisy = False
    for g in range(first, last):
        noisy = noisy or (codes[g] == GOOD and not noise[g] < (_NOISY_BIN * exponent) ** 2)
    if not noisy:
        return
    ends = min(logs[low], logs[stop - 1]), max(logs[low], logs[stop - 1])
    level = min(max(logs[(low + stop) // 2], ends[0]), ends[1])
    for g in range(first, last):
        if codes[g] == GOOD:
            scaled[g] = math.exp(min((logs[g] - level) / exponent, _LARGEST_LOGARITHM))
            scaled_variance[g] = scaled[g] * scaled[g] * noise[g] / (exponent * exponent)


@_compiled
def _deviation(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    at: int,
    nodes: Indices,
    weights: Array,
    count: int,
    air: float,
) -> float:
    """Return the deviation of a bin from a polynomial beyond that by air, in standard errors.

    It is in logarithms where noise is low, otherwise in the signal, whose noise is normal.
    """
    logs, noise, scaled, scaled_variance = row
    largest_noise = noise[at]
    for i in range(count):
        largest_noise = max(largest_noise, noise[nodes[i]])
    prediction = spread = 0.0
    if largest_noise < (_NOISY_BIN * exponent) ** 2:
        for i in range(count):
            prediction += weights[i] * logs[nodes[i]]
            spread += weights[i] * weights[i] * noise[nodes[i]]
        gap = abs(logs[at] - prediction) - air * exponent
        spread += noise[at]
    else:
        for i in range(count):
            prediction += weights[i] * scaled[nodes[i]]
            spread += weights[i] * weights[i] * scaled_variance[nodes[i]]
        gap = abs(scaled[at] - prediction) - air * abs(prediction)
        spread += scaled_variance[at]
    return gap / math.sqrt(spread) if gap > 0.0 and spread > 0.0 else 0.0


@_compiled
def _measure_deviations(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    grid: Array,
    codes: Codes,
    span: tuple[int, int, int, int],
    neighbour_plan: tuple[Indices, Array, Array],
    deviations: Array,
) -> None:
    """Fill the deviations of bins from `start` to `end`."""
    first, stop, start, end = span
    nodes, weights = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    for g in range(start, end):
        deviations[g] = 0.0
        if codes[g] != GOOD:
            continue
        inside = first <= neighbour_plan[0][g, 0] and neighbour_plan[0][g, NODES - 1] < stop
        lost = 0
        for i in range(NODES):
            lost |= codes[neighbour_plan[0][g, i]]
        if inside and lost == GOOD:
            deviations[g] = _deviation(
                row,
                exponent,
                g,
                neighbour_plan[0][g],
                neighbour_plan[1][g],
                NODES,
                neighbour_plan[2][g],
            )
        else:
            count, air = find_neighbours(grid, codes, g, first, stop, nodes, weights)
            if count > 0:
                deviations[g] = _deviation(row, exponent, g, nodes, weights, count, air)


@_compiled
def _worst_bin(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    grid: Array,
    codes: Codes,
    suspect: int,
    first: int,
    stop: int,
) -> int:
    """Return the bin around a suspect that deviates most from a smoother curve.

    An outlying bin makes its neighbours deviate too; more neighbours reduce this effect.
    """
    nodes, weights = np.empty(NODES + 2, dtype=np.intp), np.empty(NODES + 2)
    worst, largest = suspect, 0.0
    for g in range(max(first, suspect - _SIDE), min(stop, suspect + _SIDE + 1)):
        if codes[g] != GOOD:
            continue
        count = _nearest_good_bins(codes, g, first, stop, (_REFERENCE_BINS, _REFERENCE_BINS), nodes)
        if count < _SIDE:
            continue
        _fit_weights(grid, g, nodes, count, min(_REFERENCE_DEGREE, count - 2), weights)
        deviation = _deviation(row, exponent, g, nodes, weights, count, 0.0)
        if deviation > largest:
            worst, largest = g, deviation
    return worst


@_compiled
def _jumps(
    logs: Array, noise: Array, exponent: float, codes: Codes, at: int, first: int, stop: int
) -> bool:
    """Return whether the signal jumps at a bin by more than the slope of air.

    A layer may then begin in the bin.
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
    return abs(step) > max(_STEP * exponent, OUTLYING_SIGMAS * math.sqrt(spread))


@_compiled
def _all_isolated(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    codes: Codes,
    deviations: Array,
    first: int,
    stop: int,
) -> bool:
    """Return whether every bridged bin is isolated, and the bins around it fit.

    Several adjacent bins, a remaining deviation beside one, or a jump across it may be the edge
    of a layer or a cloud.
    """
    for at in range(first, stop):
        if codes[at] != BRIDGED:
            continue
        for g in range(max(first, at - REACH), min(stop, at + REACH + 1)):
            near = g != at and abs(g - at) <= _SIDE
            if deviations[g] > _SUSPECT_SIGMAS or (near and codes[g] == BRIDGED):
                return False
        if _jumps(row[0], row[1], exponent, codes, at, first, stop):
            return False
    return True


@_compiled
def find_outliers(
    row: tuple[Array, Array, Array, Array],
    exponent: float,
    grid: Array,
    span: tuple[int, int, int, int],
    neighbour_plan: tuple[Indices, Array, Array],
    codes: Codes,
    marked: Codes,
    deviations: Array,
) -> tuple[int, int]:
    """Mark the bins of a beam that are bridged.

    The bin with the largest deviation is removed, and the others are tested again without it.

    Parameters
    ----------
    row : four (bin,) float64
        Logarithms times the exponent, their variances, the signal in any unit, and its variances.
    exponent : float
    grid : (bin,) float64
        m.
    span : four int
        First of all bins, first and behind the last of those that are used, behind the last of
        all.
    neighbour_plan : (bin, NODES) intp, (bin, NODES) float64, (bin,) float64
        From `plan_neighbours`.
    codes : (bin,) uint8
        In: GOOD or LOST. Out: also BRIDGED.
    marked : (bin,) uint8
        Out, where adjacent outlying bins stay: `codes` with these bridged.
    deviations : (bin,) float64
        Scratch.

    Returns
    -------
    int
        Number of bins to bridge; LEFT_IN_PLACE where several lie together.
    int
        End of the reliable bins.
    """
    first, low, used_stop, stop = span
    largest_number = _EDGE_BINS + int(_OUTLYING_SHARE * (stop - first))
    number = 0
    _measure_deviations(
        row, exponent, grid, codes, (first, stop, low, used_stop), neighbour_plan, deviations
    )
    # On most beams, no used bin is outlying.
    if not np.any(deviations[low:used_stop] > OUTLYING_SIGMAS):
        return number, stop
    _measure_deviations(
        row, exponent, grid, codes, (first, stop, first, stop), neighbour_plan, deviations
    )
    outlying = int(np.sum(deviations[first:stop] > OUTLYING_SIGMAS))
    if outlying > largest_number:
        codes[first:stop] = LOST
        return outlying, first
    while True:
        farthest = first + int(np.argmax(deviations[first:stop]))
        if number > largest_number or not deviations[farthest] > OUTLYING_SIGMAS:
            break
        worst = _worst_bin(row, exponent, grid, codes, farthest, first, stop)
        codes[worst] = BRIDGED
        number += 1
        affected = max(first, worst - REACH), min(stop, worst + REACH + 1)
        _measure_deviations(
            row,
            exponent,
            grid,
            codes,
            (first, stop, *affected),
            neighbour_plan,
            deviations,
        )
    if number > largest_number or (
        number > 0 and not _all_isolated(row, exponent, codes, deviations, first, stop)
    ):
        for g in range(first, stop):
            marked[g] = codes[g]
            codes[g] = GOOD if codes[g] == BRIDGED else codes[g]
        number = LEFT_IN_PLACE
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
    weights: Array,
) -> int:
    """Interpolate marked bins from their neighbours; return the first bin without any.

    The mean of a logarithm is low by half its variance, for one bin and for an interpolation.

    Parameters
    ----------
    logs, noise : (bin,) float64
    exponent : float
    grid : (bin,) float64
    span : int, int and int
        First bin for neighbours, the one behind the last, and the one behind the last bin to
        bridge.
    codes : (bin,) uint8
    nodes : (bin, NODES) intp
        Out, for bridged bins: their neighbours, padded with the first one.
    weights : (bin, NODES) float64
        Out: weights of the neighbours, padded with 0.
    """
    first, stop, end = span
    for g in range(first, end):
        if codes[g] != BRIDGED:
            continue
        count, _ = find_neighbours(grid, codes, g, first, stop, nodes[g], weights[g])
        if count == 0:
            return g
        for i in range(count, NODES):
            nodes[g, i], weights[g, i] = nodes[g, 0], 0.0
        value = spread = 0.0
        for i in range(count):
            k = nodes[g, i]
            value += weights[g, i] * (logs[k] + 0.5 * noise[k] / exponent)
            spread += weights[g, i] * weights[g, i] * noise[k]
        logs[g], noise[g] = value - 0.5 * spread / exponent, spread
    return end


@_compiled
def transfer_derivatives(
    gradients: Array,
    bounds: Indices,
    quantities: int,
    span: tuple[int, int],
    codes: Codes,
    nodes: Indices,
    weights: Array,
) -> None:
    """Transfer the derivatives by bridged bins to the neighbours they come from."""
    for g in range(span[0], span[1]):
        if codes[g] != BRIDGED:
            continue
        for q in range(quantities):
            if not bounds[q, 0] <= g < bounds[q, 1]:
                continue
            for i in range(NODES):
                k = nodes[g, i]
                gradients[q, k] += weights[g, i] * gradients[q, g]
                bounds[q, 0], bounds[q, 1] = min(bounds[q, 0], k), max(bounds[q, 1], k + 1)
            gradients[q, g] = 0.0
