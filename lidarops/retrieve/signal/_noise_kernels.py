"""Compiled noise model of analog signals, one profile at a time.

The noise is measured by third differences along range of bins `DISTANCE` apart, in blocks of
`BLOCK` of them. Blocks far above the others are left out, so that clouds, spikes and the structure
of the near range do not count as noise.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.signal import _signal_kernels as kernels

Array = npt.NDArray[np.float64]

DISTANCE: Final = 4
"""Bins between the values of a third difference. The filters of the electronics correlate bins up
to 3 apart in the real archives, which hides noise from differences of neighbours."""
BLOCK: Final = 16
"""Differences in a block."""
_REACH: Final = 3 * DISTANCE
"""Bins from the first to the last value of a difference."""
CENTRE: Final = (BLOCK - 1 + _REACH) // 2
"""Bins from the first bin of a block to its centre."""
_OUTLYING: Final = 8.0
"""Mean square of a block over the median, or over the line, from which it is left out. Steps of a
quiet digitiser come in bursts of up to 5; edges of clouds exceed the noise by more. Simulated."""
_BLOCK_ERROR: Final = 0.49
"""Standard deviation of the mean square of a block of white noise, over its mean. Simulated."""
_FEWEST: Final = 4
"""Blocks of which a mean is taken."""
_DARKEST: Final = 0.5
"""Least noise over that in the far half, where the signal lies below its level there. Assumed."""
_BAND: Final = 32
"""Blocks of a band, which give its noise within 5 %; more where that is less than `_GROWTH`."""
_GROWTH: Final = 0.25
"""Share of a band in the range from the first block to its end."""
_BRIGHT: Final = 5.0
"""Light over the drift of the baseline, and over the noise of its mean, from which the noise of
light is measured: they then change the slope by a fifth at most. Assumed."""
_SIGNIFICANT: Final = 3.5
"""Standard errors beyond which the noise of a band differs from the line: of white noise, one
profile in a hundred has such a band."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


class NoiseModel(NamedTuple):
    """Windows and limits of the noise model on a range grid."""

    narrow: kernels.Windows
    """For smoothing the signal."""
    leak: Array
    """(block,): least noise per unit of light at which differences may neglect its fall."""


class _Blocks(NamedTuple):
    """Blocks of third differences along one profile."""

    square: Array
    """Mean square, scaled to the variance of white noise; NaN where bins are missing."""
    light: Array
    """Signal over its level in the far half."""
    usable: npt.NDArray[np.bool_]
    """Whether all bins are known, and the fall of the signal is negligible."""


def block_count(bins: int) -> int:
    """Return the number of blocks in a profile."""
    return max(bins - _REACH, 0) // BLOCK


@_compiled
def _mean_square(power: Array, first: int, count: int, distance: int) -> float:
    total = 0.0
    for i in range(first, first + count):
        outer = power[i + 3 * distance] - power[i]
        third = outer - 3.0 * (power[i + 2 * distance] - power[i + distance])
        total += third * third
    return total / (20.0 * count)


@_compiled
def _constant(power: Array) -> float:
    """Return the mean square of third differences of neighbours; NaN without any."""
    total, count = 0.0, 0
    for i in range(power.size - 3):
        square = _mean_square(power, i, 1, 1)
        if square < math.inf:
            total += square
            count += 1
    return total / count


@_compiled
def _clipped_mean(values: Array) -> float:
    """Return the mean without outliers; NaN of fewer than `_FEWEST` values."""
    if values.size < _FEWEST:
        return math.nan
    limit = _OUTLYING * np.median(values)
    # A quiet digitiser: few bins depart from the others by a step.
    return float(np.mean(values[values <= limit]) if limit > 0.0 else np.mean(values))


@_compiled
def _far_level(mean: Array, far: int) -> tuple[float, float]:
    """Return the level of the signal in the far half, and how far its baseline departs from it."""
    levels = mean[far::BLOCK]
    levels = levels[np.isfinite(levels)]
    level = np.median(levels) if levels.size else math.nan
    departures = np.sort(np.abs(levels - level))
    return level, departures[int(0.9 * departures.size)] if departures.size else math.nan


@_compiled
def _blocks(power: Array, mean: Array, level: float, leak: Array) -> _Blocks:
    count = leak.size
    square, light = np.empty(count), np.empty(count)
    for k in range(count):
        square[k] = _mean_square(power, k * BLOCK, BLOCK, DISTANCE)
        light[k] = mean[k * BLOCK + CENTRE] - level
    return _Blocks(square, light, square < math.inf)


@_compiled
def _slope(blocks: _Blocks, dark: float, drift: float) -> float:
    """Return the noise variance per unit of light; 0 where it cannot be told from none."""
    # Windows of the smoothed signal hold a block or more.
    unclear = max(drift, math.sqrt(dark / BLOCK))
    bright = blocks.usable & (blocks.light > _BRIGHT * unclear)
    light, square = blocks.light[bright], blocks.square[bright]
    if light.size < _FEWEST:
        return 0.0
    line = dark + max(float(np.median((square - dark) / light)), 0.0) * light
    weights = np.where(square <= _OUTLYING * line, light / (line * line), 0.0)
    leverage = np.sum(weights * light)
    slope = float(np.sum(weights * (square - dark)) / leverage)
    # A slope within its error would make constant noise follow the light.
    return slope if slope > _BLOCK_ERROR / math.sqrt(leverage) else 0.0


@_compiled
def _line(dark: float, slope: float, light: float) -> float:
    noise = dark + slope * (0.0 if math.isnan(light) else light)
    return max(noise, _DARKEST * dark)


@_compiled
def _bands(blocks: _Blocks, dark: float, slope: float) -> tuple[Array, Array, bool]:
    """Return centres of bands, logarithms of their noise over the line, and their significance."""
    count = blocks.square.size
    ratio = np.empty(count)
    for k in range(count):
        ratio[k] = blocks.square[k] / _line(dark, slope, blocks.light[k])
    centres, excesses = np.empty(count), np.empty(count)
    found, significant = 0, False
    start = 0
    while start < count:
        end = start + max(_BAND, int(_GROWTH * start))
        if count - end < _BAND:
            end = count
        places = np.flatnonzero(blocks.usable[start:end])
        # Without noise above zero, nothing is known of the band.
        excess = _clipped_mean(ratio[start + places])
        if excess > 0.0:
            centres[found] = (start + places.mean()) * BLOCK + CENTRE
            excesses[found] = math.log(excess)
            # The line rests on the blocks of the far half.
            error = _BLOCK_ERROR * math.sqrt(1.0 / places.size + 2.0 / count)
            significant |= abs(excesses[found]) > _SIGNIFICANT * error
            found += 1
        start = end
    return centres[:found], excesses[:found], significant


@_compiled
def _dark_noise(blocks: _Blocks, dark: float, slope: float) -> float:
    """Return the noise in the far half, from all blocks."""
    total = weights = 0.0
    for k in range(blocks.square.size):
        line = _line(dark, slope, blocks.light[k])
        if blocks.usable[k] and blocks.square[k] <= _OUTLYING * line:
            weight = (dark / line) ** 2
            total += weight * (dark + blocks.square[k] - line)
            weights += weight
    return total / weights


@_compiled
def _estimate(power: Array, noise: NoiseModel, s: kernels.SignalScratch, out: Array) -> None:
    complete = kernels._load(power, s.sums)  # noqa: SLF001 - kernels of one package
    kernels._averages(s.sums, noise.narrow, complete, s.mean)  # noqa: SLF001
    far = power.size // 2
    level, drift = _far_level(s.mean, far)
    blocks = _blocks(power, s.mean, level, noise.leak)
    far_blocks = far // BLOCK
    dark = _clipped_mean(blocks.square[far_blocks:][blocks.usable[far_blocks:]])
    if not dark > 0.0:
        out[:] = _constant(power)
        return
    for k in range(blocks.usable.size):
        # Against the least noise, so that the noise of a block does not select it.
        fall = noise.leak[k] * blocks.light[k]
        blocks.usable[k] &= fall * fall <= dark
    slope = _slope(blocks, dark, drift)
    improved = _dark_noise(blocks, dark, slope)
    dark = improved if improved > _DARKEST * dark else dark
    for i in range(power.size):
        out[i] = _line(dark, slope, s.mean[i] - level)
    centres, excesses, significant = _bands(blocks, dark, slope)
    if significant:
        out *= np.exp(np.interp(np.arange(power.size), centres, excesses))


@_compiled
def noise_profiles(power: Array, noise: NoiseModel, s: kernels.SignalScratch, out: Array) -> None:
    """Estimate the noise variance of each profile from third differences.

    Parameters
    ----------
    power : (profile, bin) float64
    noise : NoiseModel
    s : SignalScratch
    out : (profile, bin) float64
        Output: the variance.
    """
    for k in range(power.shape[0]):
        _estimate(power[k], noise, s, out[k])
