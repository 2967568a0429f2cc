"""Detection of isolated outlying bins, and their replacement from neighbouring bins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.clouds.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, frozen, usable
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON

_HALF: Final = 4
"""Neighbours on either side."""
_FARTHEST: Final = 2 * _HALF
"""Bins to the farthest neighbour where some bins are missing."""
_WIDENED: Final = 1.25
"""Variance of a bridged bin over the sum of those of its two neighbours. The stated variance of
the sum of the three is then right: 9/4 of the sum of the two."""
_ROUNDING: Final = 1e-12
"""Relative deviation that rounding can cause where the noise is stated as 0."""


@dataclass(frozen=True, slots=True)
class BridgedProfiles:
    """Profiles with outlying bins replaced."""

    power: Array
    variance: Array
    outlying: Booleans
    """The bins that were replaced, with the shape of the power."""


def bridge_outliers(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    background: npt.ArrayLike = 0.0,
) -> BridgedProfiles:
    r"""Replace isolated outlying bins by interpolation between their neighbours.

    Take :math:`q = R^2 P` of a bin and of its 4 neighbours on each side, and subtract the line
    through the means of both sides. The bin is outlying where

    - it lies more than 6 standard deviations of the noise beyond all neighbours;
    - it lies beyond them by more than 6 times their spread in excess of noise, which excludes
      edges of clouds and layers of two bins;
    - the means of both sides differ by less than a tenth, or by less than noise allows, which
      excludes clouds that attenuate noticeably;
    - at most 4 neighbours are equal to the last digit: among bins without counts, a bin with a
      count is no outlier.

    One neighbour that is not adjacent to the bin may be outlying as well. The bin gets :math:`q`
    interpolated between the adjacent bins, and a variance for which the sum over the three bins
    has its right variance. The 4 bins at either end are not tested.

    Parameters
    ----------
    power : (..., range) float
        Any unit, not range-corrected; NaN where missing.
    range : (range,) float
        m.
    variance : (..., range) float
        Noise variance in the square of the power's unit, broadcast against `power`.
    background : (...) float
        Rough background of the power.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    grid = inputs.range_grid(range)
    profiles, leading = inputs.profiles(power, grid)
    rows = profiles.astype(np.float64, copy=False)
    level = inputs.profile_values(background, "background", leading)
    noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    signal = rows - level[:, np.newaxis]
    outlying = np.zeros(rows.shape, dtype=np.bool_)
    work = np.empty((5, grid.size))
    _mark_outliers(frozen(signal), frozen(noise), frozen(grid), work, outlying)
    noise = np.broadcast_to(noise, rows.shape)
    if outlying.any():
        noise = noise.copy()
        _fill(signal, noise, frozen(grid), outlying)
        rows = np.where(outlying, signal + level[:, np.newaxis], rows)
    return inputs.with_leading_axes(BridgedProfiles(rows, noise, outlying), leading)


@compiled
def _is_outlying(j: int, left_out: int, ranges: Array, q: Array, noise: Array) -> bool:
    """Return whether a bin is outlying, with one neighbour left out of the test (-1: none)."""
    left = right = left_range = right_range = largest_variance = 0.0
    left_count = right_count = 0
    for k in range(j - _HALF, j + _HALF + 1):
        if k in (j, left_out):
            continue
        largest_variance = max(largest_variance, noise[k])
        if k < j:
            left, left_range, left_count = left + q[k], left_range + ranges[k], left_count + 1
        else:
            right, right_range, right_count = right + q[k], right_range + ranges[k], right_count + 1
    left, left_range = left / left_count, left_range / left_count
    right, right_range = right / right_count, right_range / right_count
    step = abs(right - left)
    allowed = max(
        THRESHOLDS.step_by_noise * np.sqrt(largest_variance),
        COMMON.largest_step * max(abs(left), abs(right)),
    )
    if not step <= allowed:
        return False
    slope = (right - left) / (right_range - left_range)
    low, high = np.inf, -np.inf
    for k in range(j - _HALF, j + _HALF + 1):
        if k not in (j, left_out):
            residual = q[k] - left - slope * (ranges[k] - left_range)
            low, high = min(low, residual), max(high, residual)
    own_residual = q[j] - left - slope * (ranges[j] - left_range)
    beyond = max(own_residual - high, low - own_residual)
    noise_limit = COMMON.outlier * np.sqrt(max(largest_variance, noise[j]))
    spread = high - low - COMMON.by_noise * np.sqrt(largest_variance)
    return bool(beyond > noise_limit and beyond > THRESHOLDS.least_contrast * spread)


@compiled
def _farthest(j: int, q: Array) -> int:
    """Return the non-adjacent neighbour that is farthest from the mean of the adjacent ones."""
    middle = 0.5 * (q[j - 1] + q[j + 1])
    farthest, largest_distance = -1, 0.0
    for k in range(j - _HALF, j + _HALF + 1):
        if abs(k - j) > 1 and abs(q[k] - middle) > largest_distance:
            farthest, largest_distance = k, abs(q[k] - middle)
    return farthest


@compiled
def _most_equal(j: int, power: Array) -> int:
    """Return the largest number of neighbours that have the same power."""
    largest_count = 0
    for k in range(j - _HALF, j + _HALF + 1):
        equal = 0
        for other in range(j - _HALF, j + _HALF + 1):
            if j not in (k, other) and power[other] == power[k]:
                equal += 1
        largest_count = max(largest_count, equal)
    return largest_count


@compiled
def _mark_outliers(
    power: Array, variance: Array, range_: Array, work: Array, outlying: Booleans
) -> None:
    """Mark the outlying bins of all profiles."""
    usable_range, q, noise, index, usable_power = work[0], work[1], work[2], work[3], work[4]
    for p in range(power.shape[0]):
        row = variance[p % variance.shape[0]]
        count = 0
        for i in range(range_.size):
            value, value_variance = power[p, i], row[i]
            if usable(value, value_variance):
                square = range_[i] * range_[i]
                q[count], noise[count] = value * square, value_variance * square * square
                noise[count] = max(noise[count], (_ROUNDING * q[count]) ** 2)
                usable_range[count], index[count], usable_power[count] = range_[i], i, value
                count += 1
        for j in range(_HALF, count - _HALF):
            below, above = q[j] - q[j - 1], q[j] - q[j + 1]
            if below * below <= COMMON.outlier**2 * noise[j] or not below * above > 0.0:
                continue
            farthest = max(index[j + _HALF] - index[j], index[j] - index[j - _HALF])
            if farthest > _FARTHEST or _most_equal(j, usable_power) > THRESHOLDS.most_equal:
                continue
            if _is_outlying(j, -1, usable_range, q, noise) or _is_outlying(
                j, _farthest(j, q), usable_range, q, noise
            ):
                outlying[p, int(index[j])] = True


@compiled
def _fill(power: Array, variance: Array, range_: Array, outlying: Booleans) -> None:
    """Interpolate the outlying bins between the nearest usable bins."""
    for p in range(power.shape[0]):
        before = -1
        for i in range(range_.size):
            if not usable(power[p, i], variance[p, i]):
                continue
            if not outlying[p, i]:
                before = i
                continue
            after = i + 1
            while outlying[p, after] or not usable(power[p, after], variance[p, after]):
                after += 1
            near, far = (range_[before] / range_[i]) ** 2, (range_[after] / range_[i]) ** 2
            weight = (range_[i] - range_[before]) / (range_[after] - range_[before])
            power[p, i] = (1.0 - weight) * near * power[p, before] + weight * far * power[p, after]
            variance[p, i] = _WIDENED * (
                near * near * variance[p, before] + far * far * variance[p, after]
            )
            before = i
