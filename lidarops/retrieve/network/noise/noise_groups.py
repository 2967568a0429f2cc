"""Groups of profiles with similar noise within a block.

Weak signals, unusual errors and the most likely field are decided for a block as a whole. Where
background light or dense air makes most of a block noisy, the quiet profiles would lose good beams
and state too large errors. So each group becomes a block of its own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

SPLIT_RATIO: Final = 5.0
"""Ratio of relative variances from which profiles belong to different groups."""
_FEWEST_PROFILES: Final = 8
"""Smallest group: the profiles that a mean needs (`lidarops.retrieve.network._empirical_prior`)."""
_SMALLEST_SHARE: Final = 0.1
"""Smallest fraction of a block in a group, so that noise of the levels alone splits none."""
_SMALLEST_VARIANCE: Final = 1e-30
"""Relative variance that stands for zero."""


def split_by_noise(
    signal: Array,
    rows: Array,
    row: Indices,
    block: Indices,
    passages: tuple[Indices, Indices, int],
    largest_error: float,
) -> Indices:
    """Return new block numbers of profiles with similar noise around every crossing.

    Parameters
    ----------
    signal : (profile, beam, bin) float64
    rows : (row, beam, bin) float64
        Stated variances, in the square of the unit of the signal.
    row : (profile,) intp
        Row of variances of each profile.
    block : (profile,) intp
        0, 1, ... without a gap.
    passages : (passage,) intp, (passage,) intp, int
        Beams, first bins around the crossings, and number of bins.
    largest_error : float
        Relative standard error of a bin, beyond which a signal is not used.

    Returns
    -------
    (profile,) intp
    """
    count = int(block.max(initial=-1)) + 1
    members = [np.flatnonzero(block == b) for b in range(count)]
    if all(profiles.size < 2 * _smallest_group(profiles.size) for profiles in members):
        return block
    noise = _relative_variances(signal, rows, row, passages)
    # Unusable signals count as equal, whatever their chance levels.
    largest = SPLIT_RATIO * largest_error**2
    numbers, number = np.empty_like(block), 0
    for profiles in members:
        for group in _split(profiles, _bounded_noise(noise[profiles], largest)):
            numbers[group] = number
            number += 1
    return numbers


def _smallest_group(size: int) -> int:
    """Return the smallest number of profiles in a group of a block of this size."""
    return max(_FEWEST_PROFILES, int(np.ceil(_SMALLEST_SHARE * size)))


def _relative_variances(
    signal: Array, rows: Array, row: Indices, passages: tuple[Indices, Indices, int]
) -> Array:
    """Return (profile, passage) relative variances of a bin; inf where it is not positive.

    They use the median level of the bins, which is robust against single outlying bins.
    """
    beam = passages[0][:, np.newaxis]
    bins = passages[1][:, np.newaxis] + np.arange(passages[2])
    level, spread = np.median(signal[:, beam, bins], axis=2), np.median(rows[:, beam, bins], axis=2)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return np.where(level > 0.0, spread[row] / level**2, np.where(level <= 0.0, np.inf, np.nan))


def _bounded_noise(noise: Array, largest: float) -> Array:
    """Return bounded relative variances of one block; the median where a value is missing."""
    bounded = np.clip(noise, _SMALLEST_VARIANCE, largest)
    for c in np.flatnonzero(np.isnan(bounded).any(axis=0)):
        missing = np.isnan(bounded[:, c])
        bounded[missing, c] = largest if missing.all() else np.median(bounded[~missing, c])
    return bounded


def _split(profiles: Indices, noise: Array) -> list[Indices]:
    """Split profiles at the largest step of noise, while both groups are large and distinct.

    Parameters
    ----------
    profiles : (profile,) intp
    noise : (profile, passage) float64
    """
    smallest = _smallest_group(profiles.size)
    if profiles.size < 2 * smallest:
        return [profiles]
    ordered = np.sort(noise, axis=0)
    ratio = ordered[-smallest] / ordered[smallest - 1]
    c = int(np.argmax(ratio)) if ratio.size else 0
    if ratio.size == 0 or not ratio[c] > SPLIT_RATIO:
        return [profiles]
    column = ordered[:, c]
    steps = (
        column[smallest : profiles.size - smallest + 1]
        / column[smallest - 1 : profiles.size - smallest]
    )
    above = noise[:, c] > column[smallest - 1 + int(np.argmax(steps))]
    return [*_split(profiles[~above], noise[~above]), *_split(profiles[above], noise[above])]
