"""Which profiles hold no light of the laser, by counts that hardly vary along range.

A profile without light is told from weak light by the other profiles of its scene: its own noise
would reject profiles of weak channels one by one, and bias what is left.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans, frozen
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_FAR: Final = 10
"""The far range is the last of so many equal parts of the bins."""


class Variation(NamedTuple):
    """How the counts of profiles vary along range, (time,), in squares of counts per shot."""

    square: Array
    """Mean square deviation of the other bins from the mean of the far range."""
    noise: Array
    """Variance of a bin in the far range."""
    measured: Booleans
    """Whether there are shots and counts."""


def variation(counts: npt.NDArray[Any], shots: npt.NDArray[Any]) -> Variation:
    """Return how counts vary along range; of each profile by itself.

    Parameters
    ----------
    counts : (time, range) int
    shots : (time,) int
    """
    split = counts.shape[1] - max(counts.shape[1] // _FAR, 1)
    squares = np.empty((2, len(counts)))
    _fill_squares(frozen(counts), split, *squares)
    square, noise = squares / np.maximum(shots, 1.0) ** 2
    return Variation(square, noise, (shots > 0) & counts.any(axis=1))


@compiled
def _fill_squares(counts: npt.NDArray[Any], split: int, near: Array, far: Array) -> None:
    """Fill in the mean square deviations of near and far bins from the mean of the far ones."""
    bins = counts.shape[1]
    for t in range(counts.shape[0]):
        row = counts[t]
        total = square = 0.0
        for i in range(split, bins):
            total += row[i]
        mean = total / (bins - split)
        for i in range(split):
            square += (row[i] - mean) ** 2
        near[t] = square / split
        # A count more, as no counts in the far range say little of the noise.
        square = 1.0
        for i in range(split, bins):
            square += (row[i] - mean) ** 2
        far[t] = square / (bins - split)


class Teller(NamedTuple):
    """What tells profiles without light from others."""

    channel: str
    """Channel of the files."""
    square: float
    """Of the light of bright profiles (`Variation.square`); infinite where no channel of the scene
    shows light."""

    def lightless(self, found: Variation) -> Booleans:
        """Return the profiles without light, (time,): no more than noise, and far less than others.

        Weak light is neither: its noise exceeds the share of that of the other profiles.
        """
        few = found.square < THRESHOLDS.least_light**2 * self.square
        return found.measured & few & (found.square < THRESHOLDS.noise_like * found.noise)


def brightest(found: Mapping[str, Variation]) -> Teller | None:
    """Return the channel that tells best; None if noise would hide light in each of them.

    Parameters
    ----------
    found : mapping
        Channel -> variation of profiles from all over a scene, at least one.
    """
    best: Teller | None = None
    most = THRESHOLDS.noise_like / THRESHOLDS.least_light**2
    for channel, one in found.items():
        if not one.measured.any():
            continue
        square, noise = one.square[one.measured], one.noise[one.measured]
        # Most profiles may be without light.
        clear = float(np.quantile(square / noise, THRESHOLDS.bright_share))
        if clear > most:
            best, most = Teller(channel, float(np.quantile(square, THRESHOLDS.bright_share))), clear
    return best


def shows_light(total: Array) -> bool:
    """Return whether counts that were added over profiles, (range,), show light in near bins.

    The sum of the first bins, of any number, exceeds the far range by more than its error.
    """
    split = total.size - max(total.size // _FAR, 1)
    far = total[split:]
    number = np.arange(1.0, split + 1.0)
    excess = np.cumsum(total[:split] - far.mean())
    variance = (far.var() + 1.0 / far.size) * number * (1.0 + number / far.size)
    return bool((excess > THRESHOLDS.sees_light * np.sqrt(variance)).any())


def all_dark(totals: Iterable[Array]) -> bool:
    """Return whether no channel shows light; see `shows_light`."""
    return not any(shows_light(total) for total in totals)
