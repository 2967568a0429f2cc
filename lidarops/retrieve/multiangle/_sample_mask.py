"""Compiled choice of the samples of a scan, and what their logarithms and variances are.

No choice here hangs on the sample that it admits: where the signal is weak, dropping low
samples and keeping high ones is the largest error of all.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ends = npt.NDArray[np.int32]

LOWEST_SNR: Final = 3.0
"""Signal over noise, as means over a wide window around a bin, below which a beam ends: the wider,
the less a single sample has a say in its own admission."""
AROUND: Final = 15
"""Bins of that window."""
SWALLOWED_SNR: Final = 2.0
"""The same over a window from the bin upwards, below which a beam ends: the wide one would admit
bins behind the point where a thick cloud has swallowed the beam."""
AHEAD: Final = 5
"""Bins of that window."""
LEAST_NOISE: Final = 1e-6
"""Noise over signal that no lidar undercuts; keeps variances of zero from infinite weights."""
_FARTHEST: Final = 3.0
_HUGE: Final = 1e300
_LARGEST_RATIO: Final = 1.0 / LOWEST_SNR**2

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _clean(signal: Any, variance: Any, row: Array) -> None:
    """Fill signal, variance and 1 of the bins that are given, zeros elsewhere."""
    values, spread, given = row[0], row[1], row[2]
    for k in range(signal.size):
        on = abs(signal[k]) < _HUGE and 0.0 <= variance[k] < _HUGE
        values[k] = signal[k] if on else 0.0
        spread[k] = variance[k] if on else 0.0
        given[k] = 1.0 if on else 0.0


@_compiled
def _window_sums(row: Array, size: int, sums: Array) -> None:
    """Fill the sums of rows over windows by the bin at which they start."""
    starts = row.shape[1] - size + 1
    for i in range(row.shape[0]):
        total = sums[i, :starts]
        total[:] = 0.0
        for shift in range(size):
            values = row[i, shift : shift + starts]
            for k in range(starts):
                total[k] += values[k]


@_compiled
def _first_loss(row: Array, before: int, size: int, lowest: float, sums: Array) -> int:
    """Return the first bin whose window has a mean of less than so much noise.

    The window begins `before` the bin, and is moved inside the grid.
    """
    bins = row.shape[1]
    size = min(size, bins)
    _window_sums(row, size, sums)
    for k in range(bins):
        j = max(min(k - before, bins - size), 0)
        lost = not sums[0, j] > lowest * math.sqrt(sums[1, j] * sums[2, j])
        if lost and sums[2, j] > 0.0:
            return k
    return int(bins)


@_compiled
def _levels(row: Array, levels: Array, roots: Array) -> None:
    """Fill the means of neighbours and their square roots, 0 where not positive.

    Entry k is that of the two bins below k, entry k + 3 that of the two above, as far as there
    are bins and they are given.
    """
    bins = row.shape[1]
    for j in range(bins + 3):
        total = count = 0.0
        if 2 <= j <= bins + 1:
            total, count = total + row[0, j - 2], count + row[2, j - 2]
        if 1 <= j <= bins:
            total, count = total + row[0, j - 1], count + row[2, j - 1]
        levels[j] = total / count if total > 0.0 else 0.0
        roots[j] = math.sqrt(levels[j])


@_compiled
def _expected(row: Array, levels: Array, roots: Array, k: int) -> float:
    """Return the signal at a bin as its neighbours tell it, unless its own noise forbids that.

    The geometric mean of both sides is right for an exponential decay.
    """
    guess = roots[k] * roots[k + 3]
    if guess == 0.0:
        guess = max(levels[k], levels[k + 3])
    own = float(row[0, k])
    slack = _FARTHEST * math.sqrt(row[1, k])
    return own if guess == 0.0 else min(max(guess, own - slack), own + slack)


@_compiled
def take_logarithms(
    signal: Any, variance: Any, usable: Any, logarithm: Array, noise: Array, ends: Ends
) -> None:
    r"""Take the logarithms of range-corrected signals, free of the bias that noise gives them.

    With the variance q of the signal over the square of its expectation, which the neighbouring
    bins tell, the logarithm of a normal signal has the mean :math:`-q/2 - 3q^2/4` and the
    variance :math:`q + 5q^2/2`, to second order.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    usable : (angle,) bool
    logarithm, noise : (profile, angle, altitude) float64
        Get the logarithms and their variances; 0 and inf where there is no sample.
    ends : (profile, angle) int32
        Gets the first bin of each beam that is lost in noise, the number of bins where none is.
    """
    count, angles, bins = signal.shape
    row, sums = np.empty((3, bins)), np.empty((3, bins))
    levels, roots = np.empty(bins + 3), np.empty(bins + 3)
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[t, a], row)
            end = 0
            if usable[a]:
                end = _first_loss(row, 0, AHEAD, SWALLOWED_SNR, sums)
                end = min(end, _first_loss(row, AROUND // 2, AROUND, LOWEST_SNR, sums))
            ends[t, a] = end
            _levels(row, levels, roots)
            for k in range(bins):
                logarithm[t, a, k] = 0.0
                noise[t, a, k] = np.inf
                if k < end and row[0, k] > 0.0:
                    ratio = (
                        max(math.sqrt(row[1, k]) / _expected(row, levels, roots, k), LEAST_NOISE)
                        ** 2
                    )
                    # The series of the logarithm's moments ends where it would diverge.
                    known = min(ratio, _LARGEST_RATIO)
                    noise[t, a, k] = ratio * (1.0 + 2.5 * known)
                    logarithm[t, a, k] = math.log(row[0, k]) + known * (0.5 + 0.75 * known)
