"""Bins of a profile that lie off on their own: found, and bridged from their neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

OUTLYING: Final = 6.0
"""Standard deviations of the noise beyond all neighbours."""
LEAST_CONTRAST: Final = 6.0
"""How far the bin lies beyond its neighbours over what noise leaves of their spread: peaks of full
widths at half maximum of 1.5 bins or more have less."""
SPREAD_BY_NOISE: Final = 2.0
"""Standard deviations of the noise by which the neighbours are spread in any case."""
MOST_EQUAL: Final = 4
"""Neighbours of the same power: more are few counts, whose noise is not normal."""
LARGEST_STEP: Final = 0.1
"""Relative change of the signal across a bin: behind a cloud there is less."""
_STEP_BY_NOISE: Final = 4.0
"""Standard deviations of the noise of a bin, 5.7 of the difference of the means of 4."""
_HALF: Final = 4
"""Neighbours on either side."""
_FARTHEST: Final = 2 * _HALF
"""Bins away from which neighbours may come where some are missing."""
_WIDENED: Final = 1.25
"""Variance of a bridged bin over the sum of those of the two that it comes from: sums of the three
then have the variance that they have, which is 9/4 of that sum."""
_ROUNDING: Final = 1e-12
"""Of a signal: what lies off by less may lie off by rounding alone, where no noise is stated."""
_HUGE: Final = 1e300

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Bridged:
    """Profiles without lone bins."""

    power: npt.NDArray[np.floating]
    variance: Array
    found: Mask
    """Of the shape of the power: the bins that now have what their neighbours say."""


def bridge_outliers(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    background: npt.ArrayLike | None = None,
) -> Bridged:
    r"""Put what the neighbours say in place of bins that lie off on their own.

    With :math:`q = R^2 P` and its 4 neighbours to each side, less the line through the means of
    both sides, a bin is a lone one where

    - it lies more than 6 standard deviations of the noise beyond all of them,
    - and 6 times as far as they are spread, but for what noise spreads them: no edge of a cloud
      does, and no layer of two bins;
    - and the means of both sides differ by less than a tenth, or than what the noise allows: they
      do behind a cloud that is thick enough to count;
    - and no more than 4 neighbours are alike to the last digit: among bins that have no count, one
      with a count is nothing special.

    One neighbour, but of those next to the bin, may be off as well. A bin gets the mean of
    :math:`q` of the bins next to it, and a variance with which sums over the three have theirs.
    The 4 bins at either end are not looked at. None of 1e8 bins of normal noise was taken for a
    lone one; of those that lay off by 10 standard deviations 9 of 10 were found, by 20 or more 999
    of 1000 (simulations). Where air itself differs from bin to bin by more than the noise, as if by
    chance, up to 2 of 1000 bins are bridged. A cloud within one bin is one that lies off where its
    optical depth is below 0.05.

    Parameters
    ----------
    power : (..., range) float
        Any unit, not corrected for range; NaN where missing.
    range : (range,) float
        m.
    variance : (..., range) float
        Of the noise, in the square of the power's unit, broadcast against `power`.
    background : (...) float, optional
        Of the power, roughly; where not given, it has none.

    Returns
    -------
    Bridged
        With the arrays in the order of `range`.

    Raises
    ------
    RetrievalInputError
        For arguments that cannot be right.
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    shape = (*leading, grid.size)
    level = inputs.profile_values(background, "background", leading)
    noise = inputs.variance_rows(variance, grid, leading)
    free = rows if level is None else rows - level[:, np.newaxis]
    bridged, noise, found = bridge_rows(free, noise, grid)
    if level is not None:
        bridged = np.where(found, bridged + level[:, np.newaxis], rows)
    noise = np.broadcast_to(noise, rows.shape)
    return Bridged(*(grid.turn(part.reshape(shape)) for part in (bridged, noise, found)))


def bridge_rows(
    rows: inputs.Floats, noise: Array, grid: inputs.RangeGrid
) -> tuple[inputs.Floats, Array, Mask]:
    """Do the same with rows of profiles, ascending in range.

    Parameters
    ----------
    rows : (profile, bin) float
    noise : (profile or 1, bin) float64
    grid : RangeGrid

    Returns
    -------
    (profile, bin) float, (profile or 1, bin) float64, (profile, bin) bool
        As in `Bridged`.
    """
    found = np.zeros(rows.shape, dtype=np.bool_)
    work = np.empty((5, grid.size))
    count = _find(frozen(rows), frozen(noise), frozen(grid.values), work, found)
    if count == 0:
        return rows, noise, found
    power = rows.copy()
    variance = np.array(np.broadcast_to(noise, rows.shape))
    _fill(power, variance, frozen(grid.values), found)
    return power, variance, found


@_compiled
def _is_usable(power: float, variance: float) -> bool:
    return abs(power) < _HUGE and 0.0 <= variance < _HUGE


@_compiled
def _stands_alone(j: int, left_out: int, place: Array, q: Array, noise: Array) -> bool:
    """Compare a bin with its neighbours, one of which may be left out (-1: none)."""
    left = right = at_left = at_right = loudest = 0.0
    of_left = of_right = 0
    for k in range(j - _HALF, j + _HALF + 1):
        if k in (j, left_out):
            continue
        loudest = max(loudest, noise[k])
        if k < j:
            left, at_left, of_left = left + q[k], at_left + place[k], of_left + 1
        else:
            right, at_right, of_right = right + q[k], at_right + place[k], of_right + 1
    left, at_left = left / of_left, at_left / of_left
    right, at_right = right / of_right, at_right / of_right
    step = abs(right - left)
    allowed = max(_STEP_BY_NOISE * np.sqrt(loudest), LARGEST_STEP * max(abs(left), abs(right)))
    if not step <= allowed:
        return False
    slope = (right - left) / (at_right - at_left)
    low, high = np.inf, -np.inf
    for k in range(j - _HALF, j + _HALF + 1):
        if k not in (j, left_out):
            off = q[k] - left - slope * (place[k] - at_left)
            low, high = min(low, off), max(high, off)
    own = q[j] - left - slope * (place[j] - at_left)
    beyond = max(own - high, low - own)
    noisy = OUTLYING * np.sqrt(max(loudest, noise[j]))
    spread = high - low - SPREAD_BY_NOISE * np.sqrt(loudest)
    return bool(beyond > noisy and beyond > LEAST_CONTRAST * spread)


@_compiled
def _farthest(j: int, q: Array) -> int:
    """Return the neighbour, but of those next to a bin, that is farthest from their mean."""
    middle = 0.5 * (q[j - 1] + q[j + 1])
    found, most = -1, 0.0
    for k in range(j - _HALF, j + _HALF + 1):
        if abs(k - j) > 1 and abs(q[k] - middle) > most:
            found, most = k, abs(q[k] - middle)
    return found


@_compiled
def _most_equal(j: int, power: Array) -> int:
    """Return how many neighbours of a bin have the same power."""
    most = 0
    for k in range(j - _HALF, j + _HALF + 1):
        equal = 0
        for other in range(j - _HALF, j + _HALF + 1):
            if j not in (k, other) and power[other] == power[k]:
                equal += 1
        most = max(most, equal)
    return most


@_compiled
def _may_hold_one(power: Any, variance: Array, back: Array, ahead: Array) -> bool:
    """Tell whether a bin is missing, or beyond both bins next to it by more than noise."""
    seen = 0
    for i in range(1, power.size - 1):
        own = np.float64(power[i])
        below = own - back[i] * np.float64(power[i - 1])
        above = own - ahead[i] * np.float64(power[i + 1])
        off = (below * above > 0.0) & (below * below > OUTLYING**2 * variance[i])
        missing = not ((abs(own) < _HUGE) & (variance[i] >= 0.0) & (variance[i] < _HUGE))
        seen += 1 if off | missing else 0
    return seen > 0


@_compiled
def _find(power: Any, variance: Array, range_: Array, work: Array, found: Mask) -> int:
    """Mark the lone bins of all profiles, and return how many there are."""
    total = 0
    bins = range_.size
    back, ahead = np.zeros(bins), np.zeros(bins)
    back[1:] = (range_[:-1] / range_[1:]) ** 2
    ahead[:-1] = (range_[1:] / range_[:-1]) ** 2
    place, q, noise, index, given = work[0], work[1], work[2], work[3], work[4]
    for p in range(power.shape[0]):
        row = variance[p % variance.shape[0]]
        if not _may_hold_one(power[p], row, back, ahead):
            continue
        there = 0
        for i in range(bins):
            value, own = np.float64(power[p, i]), row[i]
            if _is_usable(value, own):
                square = range_[i] * range_[i]
                q[there], noise[there] = value * square, own * square * square
                noise[there] = max(noise[there], (_ROUNDING * q[there]) ** 2)
                place[there], index[there], given[there] = range_[i], i, value
                there += 1
        for j in range(_HALF, there - _HALF):
            below, above = q[j] - q[j - 1], q[j] - q[j + 1]
            if below * below <= OUTLYING**2 * noise[j] or not below * above > 0.0:
                continue
            farthest = max(index[j + _HALF] - index[j], index[j] - index[j - _HALF])
            if farthest > _FARTHEST or _most_equal(j, given) > MOST_EQUAL:
                continue
            if _stands_alone(j, -1, place, q, noise) or _stands_alone(
                j, _farthest(j, q), place, q, noise
            ):
                found[p, int(index[j])] = True
                total += 1
    return total


@_compiled
def _fill(power: Any, variance: Array, range_: Array, found: Mask) -> None:
    """Bridge the bins that were found from the nearest others that are there."""
    for p in range(power.shape[0]):
        before = -1
        for i in range(range_.size):
            if not _is_usable(np.float64(power[p, i]), variance[p, i]):
                continue
            if not found[p, i]:
                before = i
                continue
            after = i + 1
            while found[p, after] or not _is_usable(
                np.float64(power[p, after]), variance[p, after]
            ):
                after += 1
            near, far = (range_[before] / range_[i]) ** 2, (range_[after] / range_[i]) ** 2
            share = (range_[i] - range_[before]) / (range_[after] - range_[before])
            power[p, i] = (1.0 - share) * near * power[p, before] + share * far * power[p, after]
            variance[p, i] = _WIDENED * (
                near * near * variance[p, before] + far * far * variance[p, after]
            )
            before = i
