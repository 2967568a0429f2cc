"""Which profiles hold no light of the laser, told by all channels that the files hold.

A channel tells where its profiles show light by far: one that shows none then has none. Noise of a
weak channel alone tells nothing, and would reject its profiles one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.signal.averaging import skewness_margin
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_WINDOWS: Final = 32
"""Windows of equal length into which the bins before the far range are cut."""
_FAR: Final = 10
"""The far range is the last of so many equal parts of the bins."""
FEWEST: Final = 5
"""Profiles; fewer tell nothing."""


class Light(NamedTuple):
    """How the counts of a channel vary along range."""

    excess: Array
    """(time,) greatest difference of a window from the far range, in standard errors of noise; NaN
    where there are too few bins to tell."""
    of_sum: float
    """That of the sum of all profiles."""
    measured: Booleans
    """(time,), False where there are no shots: a gap."""
    blank: Booleans
    """(time,), whether all counts are zero, as of a recorder that is off: a gap, unless others of
    the laser show that there was no light."""

    @property
    def dark(self) -> Booleans:
        """(time,), whether a profile shows no light."""
        return self.measured & (self.excess < THRESHOLDS.shows_light)

    @property
    def tells(self) -> bool:
        """Whether a profile that shows no light has none.

        Of the profiles that show light, at least a tenth of all, nine tenths show so much that a
        twentieth of it would do. They may be few: a laser may be off for most of a scene.
        """
        lit = self.excess[self.measured & (self.excess >= THRESHOLDS.shows_light)]
        share = THRESHOLDS.telling_share
        if lit.size < max(FEWEST, share * self.excess.size):
            return False
        return bool(np.quantile(lit, share) >= THRESHOLDS.tells_of_light)


def excess_over_far(counts: npt.NDArray[Any]) -> tuple[Array, Array, Booleans]:
    """Return counts of windows beyond those of the far range, with their variance; and the blank.

    Of each profile by itself, so that profiles may come in any parts.

    Parameters
    ----------
    counts : (time, range) int

    Returns
    -------
    excess : (time, window) float64
    variance : (time, 1) float64
        As the bins of the far range show it, and a count more: none there do not mean no noise.
    blank : (time,) bool
        Whether all counts are zero.
    """
    number, bins = counts.shape
    far = counts[:, bins - bins // _FAR :].astype(np.float64)
    length = (bins - far.shape[1]) // _WINDOWS
    blank = (counts == 0).all(axis=1)
    if length * far.shape[1] == 0 or far.shape[1] < _WINDOWS // 2:
        return np.full((number, _WINDOWS), np.nan), np.ones((number, 1)), blank
    near = counts[:, : _WINDOWS * length].reshape(number, _WINDOWS, length)
    level = far.mean(axis=1, keepdims=True)
    scatter = (((far - level) ** 2).sum(axis=1, keepdims=True) + 1.0) / (far.shape[1] - 1)
    excess = near.sum(axis=2, dtype=np.int64) - length * level
    return excess, scatter * (length * (1.0 + length / far.shape[1])), blank


def light_of(excess: Array, variance: Array, blank: Booleans, measured: Booleans) -> Light:
    """Return how the counts of a channel vary, from `excess_over_far` of all its profiles."""
    excess, variance = (np.vstack([part, part.sum(axis=0)]) for part in (excess, variance))
    # Beyond what few counts may show.
    beyond = np.maximum(np.abs(excess) - skewness_margin(THRESHOLDS.shows_light), 0.0)
    *greatest, of_sum = (beyond / np.sqrt(variance)).max(axis=-1)
    return Light(np.array(greatest), float(of_sum), measured, blank)


def lightless(found: Mapping[str, Light], lasers: Mapping[str, str]) -> dict[str, Booleans]:
    """Return the profiles of each channel that hold no light, (time,).

    A channel that tells is judged by its own counts; another one, or where it has none, by those of
    the same laser that tell, where all agree and one has counts. Where none shows light in the sum
    of all profiles, none has any.

    Parameters
    ----------
    found : mapping
        Channel of the files -> how its counts vary.
    lasers : mapping
        Channel -> its laser.
    """
    dark: dict[str, Booleans] = {}
    for laser in dict.fromkeys(lasers.values()):
        channels = [name for name in found if lasers[name] == laser]
        own = {name: found[name].dark for name in channels if found[name].tells}
        nothing = len(found[channels[0]].excess) >= FEWEST and all(
            found[name].of_sum < THRESHOLDS.shows_light for name in channels
        )
        unlit = np.full_like(found[channels[0]].measured, nothing)
        agreed = np.logical_and.reduce(list(own.values())) if own else unlit
        agreed = agreed & ~np.logical_and.reduce([found[name].blank for name in own or channels])
        for name in channels:
            known = found[name].measured & (agreed | ~found[name].blank)
            dark[name] = own.get(name, agreed) & known
    return dark
