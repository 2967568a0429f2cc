"""Selection of the samples of a scan, and their logarithms with variances.

The selection of a sample does not depend on its own value: where the signal is weak, dropping low
samples and keeping high ones would be the largest error of all.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Ends = npt.NDArray[np.int32]

_LARGEST_RATIO: Final = 1.0 / THRESHOLDS.lowest_snr**2
"""Largest variance over squared signal for which the moments of the logarithm are corrected."""


@compiled
def _clean(signal: Array, variance: Array, row: Array) -> None:
    """Fill signal, variance and 1 at altitudes with data, zeros elsewhere."""
    values, spread, count = row[0], row[1], row[2]
    for k in range(signal.size):
        on = abs(signal[k]) < HUGE and 0.0 <= variance[k] < HUGE
        values[k] = signal[k] if on else 0.0
        spread[k] = variance[k] if on else 0.0
        count[k] = 1.0 if on else 0.0


@compiled
def _window_sums(row: Array, size: int, sums: Array) -> None:
    """Fill the sums of rows over windows, by the altitude at which a window starts."""
    starts = row.shape[1] - size + 1
    for i in range(row.shape[0]):
        total = sums[i, :starts]
        total[:] = 0.0
        for shift in range(size):
            values = row[i, shift : shift + starts]
            for k in range(starts):
                total[k] += values[k]


@compiled
def _first_loss(row: Array, before: int, size: int, lowest: float, sums: Array) -> int:
    """Return the first altitude where the mean signal of the window is below `lowest` times noise.

    The window begins `before` altitudes below, and is moved inside the grid.
    """
    altitudes = row.shape[1]
    size = min(size, altitudes)
    _window_sums(row, size, sums)
    for k in range(altitudes):
        j = max(min(k - before, altitudes - size), 0)
        lost = not sums[0, j] > lowest * math.sqrt(sums[1, j] * sums[2, j])
        if lost and sums[2, j] > 0.0:
            return k
    return int(altitudes)


@compiled
def _levels(row: Array, levels: Array, roots: Array) -> None:
    """Fill the means of neighbours and their square roots, 0 where not positive.

    Entry k is the mean of the two altitudes below k, entry k + 3 that of the two above, of those
    that exist and have data.
    """
    altitudes = row.shape[1]
    for j in range(altitudes + 3):
        total = count = 0.0
        if 2 <= j <= altitudes + 1:
            total, count = total + row[0, j - 2], count + row[2, j - 2]
        if 1 <= j <= altitudes:
            total, count = total + row[0, j - 1], count + row[2, j - 1]
        levels[j] = total / count if total > 0.0 else 0.0
        roots[j] = math.sqrt(levels[j])


@compiled
def _expected(row: Array, levels: Array, roots: Array, k: int) -> float:
    """Return the signal expected from the neighbours, within 3 standard deviations of the sample.

    The geometric mean of both sides is exact for an exponential decay.
    """
    guess = roots[k] * roots[k + 3]
    if guess == 0.0:
        guess = max(levels[k], levels[k + 3])
    own = float(row[0, k])
    slack = THRESHOLDS.farthest_expected * math.sqrt(row[1, k])
    return own if guess == 0.0 else min(max(guess, own - slack), own + slack)


@compiled
def take_logarithms(
    signal: Array, variance: Array, usable: Booleans, logarithm: Array, noise: Array, ends: Ends
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
    ends : (profile, angle) int32
        Output: the first altitude of each beam that is lost in noise; the number of altitudes if
        none is.
    """
    count, angles, altitudes = signal.shape
    row, sums = np.empty((3, altitudes)), np.empty((3, altitudes))
    levels, roots = np.empty(altitudes + 3), np.empty(altitudes + 3)
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[t, a], row)
            end = 0
            if usable[a]:
                end = _first_loss(row, 0, THRESHOLDS.ahead, THRESHOLDS.swallowed_snr, sums)
                around, lowest = THRESHOLDS.around, THRESHOLDS.lowest_snr
                end = min(end, _first_loss(row, around // 2, around, lowest, sums))
            ends[t, a] = end
            _levels(row, levels, roots)
            for k in range(altitudes):
                logarithm[t, a, k] = 0.0
                noise[t, a, k] = np.inf
                if k < end and row[0, k] > 0.0:
                    ratio = (
                        max(
                            math.sqrt(row[1, k]) / _expected(row, levels, roots, k),
                            THRESHOLDS.least_noise,
                        )
                        ** 2
                    )
                    # The series of the moments of the logarithm diverges for larger ratios.
                    known = min(ratio, _LARGEST_RATIO)
                    noise[t, a, k] = ratio * (1.0 + 2.5 * known)
                    logarithm[t, a, k] = math.log(row[0, k]) + known * (0.5 + 0.75 * known)


def profiles_with_gaps(used: Booleans, signal: Array, variance: Array) -> Booleans:
    """Return which profiles miss samples between others of the same beam.

    A weak signal that noise made negative is not used, but does not count as missing.

    Parameters
    ----------
    used : (profile, beam, altitude) bool
        Samples that are used.
    signal, variance : (profile, beam, altitude) float
        NaN where missing.

    Returns
    -------
    (profile,) bool
    """
    gaps: Booleans = np.any(used[..., 1:] & ~used[..., :-1], axis=(1, 2))
    rows = np.flatnonzero(gaps)
    if rows.size:
        below = np.logical_or.accumulate(used[rows], axis=-1)
        above = np.logical_or.accumulate(used[rows, :, ::-1], axis=-1)[..., ::-1]
        measured = np.isfinite(signal[rows]) & np.isfinite(variance[rows])
        gaps[rows] = np.any(below & above & ~measured, axis=(1, 2))
    return gaps
