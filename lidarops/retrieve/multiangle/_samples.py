"""Samples of a scan: logarithms of signals without the bias by noise, and where beams end.

The selection of a sample does not depend on its own value: where the signal is weak, dropping low
samples and keeping high ones would be the largest error of all.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_AROUND: Final = 3
"""Windows ahead that make the window around an altitude."""
_LARGEST_RATIO: Final = 1.0 / THRESHOLDS.lowest_snr**2
"""Largest variance over squared signal for which the moments of the logarithm are corrected: their
series diverges for larger ones."""
_LEAST_NOISE: Final = 1e-6
"""Noise over signal where the stated variance is smaller, such as 0."""
_FARTHEST: Final = 3.0
"""Standard deviations by which the expected signal may differ from the sample."""
_PAD: Final = 2
"""Altitudes without data at either end of a row."""


@compiled
def _clean(signal: Array, variance: Array, row: Array) -> None:
    """Fill signal, variance and 1 at altitudes with data, zeros elsewhere."""
    values, spread, count = row[0], row[1], row[2]
    for k in range(signal.size):
        on = abs(signal[k]) < HUGE and 0.0 <= variance[k] < HUGE
        values[k + _PAD] = signal[k] if on else 0.0
        spread[k + _PAD] = variance[k] if on else 0.0
        count[k + _PAD] = 1.0 if on else 0.0


@compiled
def _window_sums(row: Array, size: int, step: int, sums: Array) -> int:
    """Fill the sums of every `step`-th value of windows, and return the number of windows."""
    starts = row.shape[1] - (size - 1) * step
    for i in range(row.shape[0]):
        total = sums[i, :starts]
        total[:] = 0.0
        for shift in range(0, size * step, step):
            values = row[i, shift : shift + starts]
            for k in range(starts):
                total[k] += values[k]
    return int(starts)


@compiled
def _first_loss(sums: Array, windows: int, before: int, altitudes: int, lowest: float) -> int:
    """Return the first altitude where the mean signal of the window is below `lowest` times noise.

    The window begins `before` altitudes below, and is moved inside the grid.
    """
    for k in range(altitudes):
        j = max(min(k - before, windows - 1), 0)
        lost = not sums[0, j] > lowest * math.sqrt(sums[1, j] * sums[2, j])
        if lost and sums[2, j] > 0.0:
            return k
    return int(altitudes)


@compiled
def _end(row: Array, ahead: Array, around: Array) -> int:
    """Return the first altitude of a beam that is lost in noise."""
    altitudes, size = row.shape[1], THRESHOLDS.ahead
    windows = _window_sums(row, min(size, altitudes), 1, ahead)
    end = _first_loss(ahead, windows, 0, altitudes, THRESHOLDS.swallowed_snr)
    if altitudes < _AROUND * size:
        windows = _window_sums(row, altitudes, 1, around)
    else:
        windows = _window_sums(ahead[:, :windows], _AROUND, size, around)
    before = _AROUND * size // 2
    return min(end, _first_loss(around, windows, before, altitudes, THRESHOLDS.lowest_snr))


@compiled
def _neighbours(row: Array, levels: Array, roots: Array) -> None:
    """Fill the means of pairs of neighbours that have data, 0 where not positive, and the roots."""
    for j in range(levels.size):
        total = row[0, j] + row[0, j + 1]
        levels[j] = total / (row[2, j] + row[2, j + 1]) if total > 0.0 else 0.0
        roots[j] = math.sqrt(levels[j])


@compiled
def _ratios(row: Array, levels: Array, roots: Array, ratio: Array) -> None:
    """Fill the variances over the squares of the signals expected from the neighbours.

    The geometric mean of both sides is exact for an exponential decay.
    """
    for k in range(ratio.size):
        own, spread = row[0, k + _PAD], math.sqrt(row[1, k + _PAD])
        guess = roots[k] * roots[k + 3]
        guess = guess if guess > 0.0 else max(levels[k], levels[k + 3])
        slack = _FARTHEST * spread
        guess = own if guess == 0.0 else min(max(guess, own - slack), own + slack)
        relative = max(spread / guess, _LEAST_NOISE)
        ratio[k] = relative * relative


@compiled
def take_logarithms(
    signal: Array, variance: Array, usable: Booleans, logarithm: Array, noise: Array, alive: Indices
) -> None:
    """Take the logarithms of range-corrected signals without the bias caused by noise.

    Formula 3 of ``docs/algorithms/multiangle.md``; the expectation of the signal is estimated from
    neighbouring altitudes.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    usable : (angle,) bool
    logarithm, noise : (profile, angle, altitude) float64
        Outputs: the logarithms and their variances; 0 and inf where there is no sample.
    alive : (profile, altitude) int
        Output: number of beams that are not yet lost in noise.
    """
    count, angles, altitudes = signal.shape
    row, ratio = np.zeros((3, altitudes + 2 * _PAD)), np.empty(altitudes)
    ahead, around = np.empty((3, altitudes)), np.empty((3, altitudes))
    levels, roots = np.empty(altitudes + 3), np.empty(altitudes + 3)
    inside = row[:, _PAD : altitudes + _PAD]
    alive[:] = 0
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[t, a], row)
            end = _end(inside, ahead, around) if usable[a] else 0
            alive[t, :end] += 1
            _neighbours(row, levels, roots)
            _ratios(row, levels, roots, ratio)
            for k in range(altitudes):
                logarithm[t, a, k] = 0.0
                noise[t, a, k] = np.inf
                if k < end and inside[0, k] > 0.0:
                    known = min(ratio[k], _LARGEST_RATIO)
                    noise[t, a, k] = ratio[k] * (1.0 + 2.5 * known)
                    logarithm[t, a, k] = math.log(inside[0, k]) + known * (0.5 + 0.75 * known)
