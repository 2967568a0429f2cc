"""Compiled search for steep rises of a profile above the shape of air."""

from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HUGE: Final = 1e300
_TOP: Final = 2.0
"""A layer has ended within this many standard errors of the level below its base."""
_DETECTED: Final = 3.0
"""Standard errors that a signal above a layer must exceed."""
_VISIBLE_SHARE: Final = 0.1
"""Opacity is tested only where noise would allow this share of the level below the layer to be
detected."""
_LEAST_SHARE: Final = 0.01
"""Share of that level below which there is no signal, however low the noise."""

_ROUNDING: Final = 1e-9
"""Relative rise that the rounding of sums can cause."""

BASE, TOP, CONTRAST, SIGNAL = 0, 1, 2, 3
FIELDS: Final = 4
POWER, SHAPE, VARIANCE, COUNT = 0, 1, 2, 3

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _usable(power: float, variance: float) -> bool:
    return abs(power) < HUGE and 0.0 <= variance < HUGE


@_compiled
def _accumulate(power: Any, variance: Array, shape: Array, sums: Array) -> None:
    """Sum from the far end, so that sums over far bins keep their digits."""
    signal = air = noise = count = 0.0
    sums[:, power.size] = 0.0
    for j in range(power.size):
        i = power.size - 1 - j
        if _usable(power[i], variance[i]):
            signal += np.float64(power[i])
            air += shape[i]
            noise += variance[i]
            count += 1.0
        sums[POWER, i], sums[SHAPE, i], sums[VARIANCE, i], sums[COUNT, i] = (
            signal,
            air,
            noise,
            count,
        )


@_compiled
def _mean(sums: Array, first: int, stop: int) -> tuple[float, float]:
    """Return the mean ratio to air and its variance; NaN with data in less than half the bins."""
    if first < 0 or stop >= sums.shape[1]:
        return np.nan, np.nan
    count = sums[COUNT, first] - sums[COUNT, stop]
    shape = sums[SHAPE, first] - sums[SHAPE, stop]
    if 2.0 * count < stop - first or not shape > 0.0:
        return np.nan, np.nan
    ratio = (sums[POWER, first] - sums[POWER, stop]) / shape
    return ratio, (sums[VARIANCE, first] - sums[VARIANCE, stop]) / (shape * shape)


@_compiled
def _rise(sums: Array, i: int, length: int, contrast: float) -> float:
    """Return by how many standard errors the rise of the ratio to air exceeds `contrast`."""
    first, stop = i - length, i + length
    if first < 0 or stop >= sums.shape[1]:
        return 0.0
    # Most bins end here, without a division.
    below = (sums[POWER, first] - sums[POWER, i]) * (sums[SHAPE, i] - sums[SHAPE, stop])
    above = (sums[POWER, i] - sums[POWER, stop]) * (sums[SHAPE, first] - sums[SHAPE, i])
    if not above > contrast * below:
        return 0.0
    low, low_variance = _mean(sums, first, i)
    high, high_variance = _mean(sums, i, stop)
    excess = high - contrast * low
    variance = high_variance + contrast * contrast * low_variance
    if not excess > _ROUNDING * high:
        return 0.0
    return excess / math.sqrt(variance) if variance > 0.0 else HUGE


@_compiled
def _steepest(
    sums: Array,
    start: int,
    reach: int,
    lengths: npt.NDArray[np.int64],
    contrast: float,
    threshold: float,
) -> tuple[int, int]:
    """Return the bin of the steepest rise for the shortest window that shows it, and its length."""
    stop = min(start + reach + 1, int(sums.shape[1]) - 1)
    for length in lengths:
        best, highest = start, 0.0
        for i in range(start, stop):
            rise = _rise(sums, i, length, contrast)
            if rise > highest:
                best, highest = i, rise
        if highest >= threshold:
            break
    return best, length


@_compiled
def _next_base(
    sums: Array, start: int, lengths: npt.NDArray[np.int64], contrast: float, threshold: float
) -> tuple[int, int]:
    """Return the bin where the next layer begins and the window length that shows it; or -1."""
    for i in range(start, sums.shape[1] - 1):
        for length in lengths:
            if _rise(sums, i, length, contrast) >= threshold:
                return _steepest(sums, i, length, lengths, contrast, threshold)
    return -1, 0


@_compiled
def _end(sums: Array, base: int, length: int) -> int:
    """Return the first bin from which the ratio to air is back at its level below the base."""
    level, level_variance = _mean(sums, base - length, base)
    bins = int(sums.shape[1]) - 1
    for i in range(base + 1, bins):
        ratio, variance = _mean(sums, i, min(i + length, bins))
        if not ratio > level + _TOP * math.sqrt(variance + level_variance):
            return i
    return bins


@_compiled
def _is_opaque(sums: Array, first: int, length: int, level: float) -> bool:
    """Return whether no signal of air is seen where it would be above the noise.

    The farthest of adjoining windows decides, because a signal may fade slowly within a layer.
    """
    for share in (_VISIBLE_SHARE, 1.0):
        visible, decided = False, False
        for i in range(first, sums.shape[1] - length, length):
            ratio, variance = _mean(sums, i, i + length)
            error = _DETECTED * math.sqrt(max(variance, 0.0))
            if share * level > error:
                visible, decided = ratio > max(error, _LEAST_SHARE * level), True
        if decided:
            return not visible
    return True


@_compiled
def detect_rises(
    power: Any,
    variance: Array,
    shape: Array,
    lengths: npt.NDArray[np.int64],
    contrast: float,
    threshold: float,
    layers: Any,
    out: Array,
    opaque: Any,
) -> None:
    """Find the layers of each profile.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    variance, shape : (profile or 1, bin) float64
    lengths : (scale,) int64
        Bins that are averaged below and above a base, ascending.
    contrast : float
        Least factor by which the ratio to air rises.
    threshold : float
        Standard errors by which the rise exceeds that factor.
    layers : (profile, bin) bool
        Output, False before: the bins between base and top of all layers.
    out : (profile, `FIELDS`) float64
        Output, NaN before: first bin of the lowest layer, first bin above it, ratio to air above
        its base over that below, and the standard errors of its rise.
    opaque : (profile,) bool
        Output: whether the air above the highest layer is hidden.
    """
    sums = np.empty((4, power.shape[1] + 1))
    for k in range(power.shape[0]):
        noise, air = variance[k % variance.shape[0]], shape[k % shape.shape[0]]
        _accumulate(power[k], noise, air, sums)
        end, level = 0, 0.0
        while True:
            base, length = _next_base(sums, end, lengths, contrast, threshold)
            if base < 0:
                break
            end = _end(sums, base, length)
            layers[k, base:end] = True
            if math.isnan(out[k, BASE]):
                level = _mean(sums, base - length, base)[0]
                ratio = _mean(sums, base, base + length)[0]
                out[k, BASE], out[k, TOP] = base, end
                out[k, CONTRAST] = ratio / level if level > 0.0 else np.inf
                out[k, SIGNAL] = _rise(sums, base, length, contrast)
        opaque[k] = end > 0 and _is_opaque(sums, end, lengths[-1], level)
