"""Profiles of a block, parted where many are far noisier than many others.

What is too weak, what is an unusual error and which field is likeliest is asked of a block as a
whole. Where most of it is noisy, by background light or by thick air, the rest would lose beams
that it hears well and state errors that it does not have; so each part is a block of its own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

FARTHER: Final = 5.0
"""Times the relative variance, from which on profiles are of another kind."""
_ENOUGH: Final = 8
"""Profiles of a part: as many as tell a mean (`lidarops.retrieve.network._empirical_prior`)."""
_SHARE: Final = 0.1
"""Of a block, which a part has at least: noise of levels alone parts none."""
_LEAST: Final = 1e-30


def split_by_noise(
    signal: Array,
    rows: Array,
    row: Indices,
    block: Indices,
    passages: tuple[Indices, Indices, int],
    loudest: float,
) -> Indices:
    """Return blocks, numbered anew, of profiles of like noise about every crossing.

    Parameters
    ----------
    signal : (profile, beam, bin) float64
    rows : (row, beam, bin) float64
        Variances as stated, in the signal's unit squared.
    row : (profile,) intp
        Of the variances of a profile.
    block : (profile,) intp
        0, 1, ... without a gap.
    passages : (passage,) intp, (passage,) intp, int
        Beams, first bins about the crossings, and how many bins there are.
    loudest : float
        Relative standard error of a bin, beyond which a signal is not used.

    Returns
    -------
    (profile,) intp
    """
    count = int(block.max(initial=-1)) + 1
    members = [np.flatnonzero(block == b) for b in range(count)]
    if all(mine.size < 2 * _enough(mine.size) for mine in members):
        return block
    noise = _relative(signal, rows, row, passages)
    # All that is not used is alike, and what its chance levels are does not matter.
    most = FARTHER * loudest**2
    out, number = np.empty_like(block), 0
    for mine in members:
        for some in _parts(mine, _known(noise[mine], most)):
            out[some] = number
            number += 1
    return out


def _enough(size: int) -> int:
    return max(_ENOUGH, int(np.ceil(_SHARE * size)))


def _relative(
    signal: Array, rows: Array, row: Indices, passages: tuple[Indices, Indices, int]
) -> Array:
    """Return (profile, passage) relative variances of a bin; inf of what is not positive.

    Of the median level of the bins, which no single wild bin moves.
    """
    beam = passages[0][:, np.newaxis]
    bin = passages[1][:, np.newaxis] + np.arange(passages[2])
    level, spread = np.median(signal[:, beam, bin], axis=2), np.median(rows[:, beam, bin], axis=2)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return np.where(level > 0.0, spread[row] / level**2, np.where(level <= 0.0, np.inf, np.nan))


def _known(noise: Array, most: float) -> Array:
    """Return relative variances of one block, within bounds; the median where there is none."""
    out = np.clip(noise, _LEAST, most)
    for c in np.flatnonzero(np.isnan(out).any(axis=0)):
        lost = np.isnan(out[:, c])
        out[lost, c] = most if lost.all() else np.median(out[~lost, c])
    return out


def _parts(mine: Indices, noise: Array) -> list[Indices]:
    """Part profiles between those that differ most, as long as enough are far from enough.

    Parameters
    ----------
    mine : (profile,) intp
    noise : (profile, passage) float64
    """
    least = _enough(mine.size)
    if mine.size < 2 * least:
        return [mine]
    ordered = np.sort(noise, axis=0)
    far = ordered[-least] / ordered[least - 1]
    c = int(np.argmax(far)) if far.size else 0
    if far.size == 0 or not far[c] > FARTHER:
        return [mine]
    column = ordered[:, c]
    steps = column[least : mine.size - least + 1] / column[least - 1 : mine.size - least]
    above = noise[:, c] > column[least - 1 + int(np.argmax(steps))]
    return [*_parts(mine[~above], noise[~above]), *_parts(mine[above], noise[above])]
