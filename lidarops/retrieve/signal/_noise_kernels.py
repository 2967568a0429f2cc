"""Compiled noise model of analog signals, one profile at a time.

The noise is measured by third differences along range of bins `DISTANCE` apart, in blocks of
`BLOCK` of them. Blocks far above the others are left out, so that clouds, spikes and the structure
of the near range do not count as noise.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal import _signal_kernels as kernels
from lidarops.retrieve.signal.thresholds import THRESHOLDS

DISTANCE: Final = 4
"""Bins between the values of a third difference. The electronics correlate neighbouring bins by
0.1 to 0.4 in real archives, which differences of neighbours do not show, and hardly any others."""
BLOCK: Final = 16
"""Differences in a block."""
_REACH: Final = 3 * DISTANCE
"""Bins from the first to the last value of a difference."""
CENTRE: Final = (BLOCK - 1 + _REACH) // 2
"""Bins from the first bin of a block to its centre."""
_BLOCK_ERROR: Final = 0.49
"""Standard deviation of the mean square of a block of white noise, over its mean. Simulated."""
_FEWEST: Final = 4
"""Blocks of which a mean is taken."""


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
    usable: Booleans
    """Whether all bins are known, and the fall of the signal is negligible."""


class _Line(NamedTuple):
    """Noise variance as a function of light."""

    dark: float
    """At the level of the far half."""
    slope: float
    """Per unit of light."""
    least: float
    """Light from which the slope holds."""


def block_count(bins: int) -> int:
    """Return the number of blocks in a profile."""
    return max(bins - _REACH, 0) // BLOCK


@compiled
def _mean_square(power: Array, first: int, count: int, distance: int) -> float:
    total = 0.0
    for i in range(first, first + count):
        outer = power[i + 3 * distance] - power[i]
        third = outer - 3.0 * (power[i + 2 * distance] - power[i + distance])
        total += third * third
    return total / (20.0 * count)


@compiled
def _constant(power: Array) -> float:
    """Return the mean square of third differences of neighbours; NaN without any."""
    total, count = 0.0, 0
    for i in range(power.size - 3):
        square = _mean_square(power, i, 1, 1)
        if square < math.inf:
            total += square
            count += 1
    return total / count


@compiled
def _clipped_mean(values: Array) -> float:
    """Return the mean without outliers; NaN of fewer than `_FEWEST` values."""
    if values.size < _FEWEST:
        return math.nan
    limit = THRESHOLDS.outlying_block * np.median(values)
    # A quiet digitiser: few bins depart from the others by a step.
    return float(np.mean(values[values <= limit]) if limit > 0.0 else np.mean(values))


@compiled
def _far_level(mean: Array, far: int) -> tuple[float, float]:
    """Return the level of the signal in the far half, and how far its baseline departs from it."""
    levels = mean[far::BLOCK]
    levels = levels[np.isfinite(levels)]
    level = np.median(levels) if levels.size else math.nan
    departures = np.sort(np.abs(levels - level))
    return level, departures[int(0.9 * departures.size)] if departures.size else math.nan


@compiled
def _squares(power: Array, count: int) -> Array:
    squares = np.empty(count)
    for k in range(count):
        squares[k] = _mean_square(power, k * BLOCK, BLOCK, DISTANCE)
    return squares


@compiled
def _blocks(squares: Array, mean: Array, level: float, fall: Array, dark: float) -> _Blocks:
    light, usable = np.empty(squares.size), np.empty(squares.size, dtype=np.bool_)
    for k in range(squares.size):
        light[k] = mean[k * BLOCK + CENTRE] - level
        # Against the least noise, so that the noise of a block does not select it.
        leak = fall[k] * light[k]
        usable[k] = (squares[k] < math.inf) & (leak * leak <= dark)
    return _Blocks(squares, light, usable)


@compiled
def _fit(light: Array, square: Array, dark: float) -> float:
    """Return the noise variance per unit of light; 0 within its standard error."""
    if light.size < _FEWEST:
        return 0.0
    line = dark + max(float(np.median((square - dark) / light)), 0.0) * light
    weights = np.where(square <= THRESHOLDS.outlying_block * line, light / (line * line), 0.0)
    leverage = np.sum(weights * light)
    slope = float(np.sum(weights * (square - dark)) / leverage)
    # A slope within its error would make constant noise follow the light.
    return slope if slope > _BLOCK_ERROR / math.sqrt(leverage) else 0.0


@compiled
def _line(blocks: _Blocks, dark: float, drift: float) -> _Line:
    """Return the noise as a function of light."""
    # Windows of the smoothed signal hold a block or more.
    clear = COMMON.first_order * max(drift, math.sqrt(dark / BLOCK))
    bright = (blocks.light > clear) & (blocks.square < math.inf)
    known = bright & blocks.usable
    if np.sum(known) >= _FEWEST or np.sum(bright) < _FEWEST:
        slope = _fit(blocks.light[known], blocks.square[known], dark)
        return _Line(_dark_noise(blocks, _Line(dark, slope, -math.inf)), slope, -math.inf)
    # As before an opaque cloud: the structure of the signal bounds the noise of its light.
    return _Line(dark, _fit(blocks.light[bright], blocks.square[bright], dark), clear)


@compiled
def _dark_noise(blocks: _Blocks, line: _Line) -> float:
    """Return the noise in the far half, from all blocks."""
    total = weights = 0.0
    for k in range(blocks.square.size):
        variance = _variance(line, blocks.light[k])
        if blocks.usable[k] and blocks.square[k] <= THRESHOLDS.outlying_block * variance:
            weight = (line.dark / variance) ** 2
            total += weight * (line.dark + blocks.square[k] - variance)
            weights += weight
    return total / weights if total > 0.0 else line.dark


@compiled
def _variance(line: _Line, light: float) -> float:
    # Light is missing where no bin of its window is known.
    if math.isnan(light) or light < line.least:
        return line.dark
    return max(line.dark + line.slope * light, THRESHOLDS.darkest * line.dark)


@compiled
def _bands(blocks: _Blocks, line: _Line) -> tuple[Array, Array, bool]:
    """Return centres of bands, logarithms of their noise over the line, and their significance."""
    count = blocks.square.size
    ratio = np.empty(count)
    for k in range(count):
        ratio[k] = blocks.square[k] / _variance(line, blocks.light[k])
    centres, excesses = np.empty(count), np.empty(count)
    found, significant = 0, False
    bands = max(count // THRESHOLDS.noise_sample, 1)
    for band in range(bands):
        start = band * THRESHOLDS.noise_sample
        end = start + THRESHOLDS.noise_sample if band < bands - 1 else count
        places = np.flatnonzero(blocks.usable[start:end])
        # Without noise above zero, nothing is known of the band.
        excess = _clipped_mean(ratio[start + places])
        if excess > 0.0:
            centres[found] = (start + places.mean()) * BLOCK + CENTRE
            excesses[found] = math.log(excess)
            # The line rests on the blocks of the far half.
            error = _BLOCK_ERROR * math.sqrt(1.0 / places.size + 2.0 / count)
            significant |= abs(excesses[found]) > THRESHOLDS.significant_band * error
            found += 1
    return centres[:found], excesses[:found], significant


@compiled
def _measure(power: Array, noise: NoiseModel, s: kernels.SignalScratch, out: Array) -> None:
    complete = kernels.load_values(power, s.sums)
    kernels.write_averages(s.sums, noise.narrow, complete, s.mean)
    far = power.size // 2
    squares = _squares(power, noise.leak.size)
    far_squares = squares[far // BLOCK :]
    dark = _clipped_mean(far_squares[far_squares < math.inf])
    if not dark > 0.0:
        out[:] = _constant(power)
        return
    level, drift = _far_level(s.mean, far)
    blocks = _blocks(squares, s.mean, level, noise.leak, dark)
    line = _line(blocks, dark, drift)
    for i in range(power.size):
        out[i] = _variance(line, s.mean[i] - level)
    centres, excesses, significant = _bands(blocks, line)
    if significant:
        out *= np.exp(np.interp(np.arange(power.size), centres, excesses))


@compiled
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
        _measure(power[k], noise, s, out[k])
