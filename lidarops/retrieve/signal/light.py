"""Profiles without laser light, found from all channels of the files.

Where most profiles of a channel show strong light, one that shows none has none. A weak channel
cannot decide this by itself: its noise would reject single profiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.averaging import skewness_margin
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_WINDOWS: Final = 40
"""Windows of equal length into which the bins are cut, the last of which are the far range."""
_FAR: Final = 8
"""Windows of the far range, whose median is the level without light: a target in it is light."""
MEDIAN_OF_NORMAL: Final = 0.6745
"""Median of the absolute value of a standard normal number."""
_OF_MEDIAN: Final = 1.5
"""Variance of the median of the far windows over that of their mean."""
_SHORTEST: Final = 4
"""Bins of a window, of which fewer tell nothing."""
_SLOW: Final = 2.5
"""Scatter of half windows of the far range over that by the noise of bins, beyond which a baseline
varies slowly along range."""
_CLIPPED: Final = 6.0
"""Median steps between neighbouring bins beyond which a step counts as no larger."""
_WITNESSES: Final = 2
"""Other channels without light beside which a faint excess is pick-up of the electronics."""
_PICK_UP: Final = 2.0
"""Largest such excess over `outlier`. Dark files of Sao Paulo show up to 1.3."""
_NEAREST: Final = 60.0
_FARTHEST: Final = 3000.0
"""m; signals are expected to stop rising between these."""
_SMOOTH: Final = 60.0
"""m; length of the running mean."""
_FALL: Final = 200.0
"""m; a signal that no longer rises stays below its maximum so long."""
_LIGHT: Final = 10.0
"""Standard errors of a bin by which three bins in a row show light."""


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
        return self.measured & (self.excess < COMMON.outlier)

    @property
    def tells(self) -> bool:
        """Whether a profile that shows no light has none.

        Of the profiles that show light, at least a tenth of all, nine tenths show so much that a
        twentieth of it would do. They may be few: a laser may be off for most of a scene.
        """
        lit = self.excess[self.measured & (self.excess >= COMMON.outlier)]
        share = THRESHOLDS.telling_share
        if lit.size < max(COMMON.fewest_profiles, share * self.excess.size):
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
        As neighbouring bins of the far range show it, or its windows if they vary far more, which
        one bin or a target hardly changes, and a count more: none there do not mean no noise. NaN
        where there are too few bins, or all hold the same but not zero, as at full scale.
    blank : (time,) bool
        Whether all counts are zero.
    """
    number, bins = counts.shape
    blank = (counts == 0).all(axis=1)
    length = bins // _WINDOWS
    if length < _SHORTEST:
        return np.full((number, _WINDOWS), np.nan), np.ones((number, 1)), blank
    used = counts[:, : _WINDOWS * length].astype(np.float64)
    limits = np.iinfo(counts.dtype)
    missing = (used <= limits.min) | (used >= limits.max)
    if missing.any():
        used = np.where(missing, np.median(used, axis=1, keepdims=True), used)
    far = used[:, -_FAR * length :]
    level = np.median(far.reshape(number, _FAR, length).mean(axis=2), axis=1, keepdims=True)
    steps = np.abs(np.diff(far, axis=1))
    most = _CLIPPED * np.maximum(np.median(steps, axis=1, keepdims=True), 1.0)
    noise = 0.5 * np.square(np.minimum(steps, most)).mean(axis=1, keepdims=True)
    noise += 1.0 / far.shape[1]
    noise[(used == used[:, :1]).all(axis=1) & ~blank] = np.nan
    excess = used.reshape(number, _WINDOWS, length).sum(axis=2) - length * level
    halves = far[:, : 2 * _FAR * (length // 2)].reshape(number, 2 * _FAR, -1)
    away = np.median(np.abs(halves.mean(axis=2) - level), axis=1, keepdims=True) / MEDIAN_OF_NORMAL
    # Of white noise, one in ten thousand medians of sixteen is so large.
    slow = np.square(away) * halves.shape[2] > _SLOW**2 * noise
    of_sum = np.where(slow, np.square(length * away), noise * length)
    return excess, of_sum * (1.0 + _OF_MEDIAN * length / far.shape[1]), blank


def light_of(excess: Array, variance: Array, blank: Booleans, measured: Booleans) -> Light:
    """Return how the counts of a channel vary, from `excess_over_far` of all its profiles."""
    known = np.isfinite(variance)
    sums = (np.where(known, part, 0.0).sum(axis=0) for part in (excess, variance))
    excess, variance = (
        np.vstack([part, total]) for part, total in zip((excess, variance), sums, strict=True)
    )
    # Beyond what few counts may show.
    beyond = np.maximum(np.abs(excess) - skewness_margin(COMMON.outlier), 0.0)
    with np.errstate(invalid="ignore"):
        *greatest, of_sum = (beyond / np.sqrt(variance)).max(axis=-1)
    return Light(np.array(greatest), float(of_sum), measured, blank)


def lightless(found: Mapping[str, Light], lasers: Mapping[str, str]) -> dict[str, Booleans]:
    """Return the profiles of each channel that hold no light, (time,).

    A channel that tells is judged by its own counts, but for faint pick-up where two others of its
    laser show no light; another one, or where it has none, by those of
    the same laser that tell, where all agree and one has counts. Where no channel of any laser
    shows light in the sum of all profiles, none has any.

    Parameters
    ----------
    found : mapping
        Channel of the files -> how its counts vary.
    lasers : mapping
        Channel -> its laser, as headers number it.
    """
    nothing = all(
        len(one.excess) >= COMMON.fewest_profiles and one.of_sum < COMMON.outlier
        for one in found.values()
    )
    dark: dict[str, Booleans] = {}
    own = _dark_of_their_own(found, lasers)
    for name, one in found.items():
        same = [other for other in own if lasers[other] == lasers[name]]
        unlit = [own[other] for other in same] or [np.full_like(one.measured, nothing)]
        agreed: Booleans = np.logical_and.reduce(unlit)
        agreed = agreed & ~np.logical_and.reduce([found[other].blank for other in same or found])
        dark[name] = own.get(name, agreed) & one.measured & (agreed | ~one.blank)
    return dark


def _dark_of_their_own(
    found: Mapping[str, Light], lasers: Mapping[str, str]
) -> dict[str, Booleans]:
    """Return the profiles without light of each channel that tells, faint pick-up included."""
    shown = {name: one.dark for name, one in found.items() if one.tells}
    own = {}
    for name, dark in shown.items():
        others = [shown[o] for o in shown if o != name and lasers[o] == lasers[name]]
        faint = found[name].excess < _PICK_UP * COMMON.outlier
        if len(others) < _WITNESSES:
            faint = dark
        own[name] = dark | (found[name].measured & faint & np.logical_and.reduce([faint, *others]))
    return own


def rise_ends(ranges: Array, signal: Array) -> float | None:
    """Return where a range-corrected signal stops rising, m; None where it does not by 3 km.

    Below full overlap a signal rises, and in any air beyond it falls on the mean. It is the first
    place whose running mean no place in the next 200 m exceeds.

    Parameters
    ----------
    ranges : (range,) float
        m.
    signal : (range,) float
        NaN where missing or saturated.
    """
    step = ranges[1] - ranges[0]
    width, ahead = (max(round(float(length / step)), 1) for length in (_SMOOTH, _FALL))
    near = ranges < _FARTHEST + _SMOOTH + _FALL
    values, place = signal[near], ranges[near]
    known = np.isfinite(values)
    weight = np.convolve(known, np.ones(width), "same")
    smooth = np.convolve(np.where(known, values, 0.0), np.ones(width), "same")
    smooth = np.where(weight > 0.5 * width, smooth / np.maximum(weight, 1.0), -np.inf)
    for k in np.flatnonzero((place >= _NEAREST) & (place <= _FARTHEST)):
        beyond = smooth[k + 1 : k + 1 + ahead]
        if np.isfinite(smooth[k]) and smooth[k] > 0.0 and beyond.size and smooth[k] >= beyond.max():
            return float(place[k])
    return None


def light_begins(ranges: Array, signal: Array) -> float | None:
    """Return from where a range-corrected signal shows light, m; None where it shows none.

    Parameters
    ----------
    ranges : (range,) float
        m.
    signal : (range,) float
        NaN where missing or saturated, which is light.
    """
    power = signal / np.square(ranges)
    far = power[-power.size // 4 :]
    far = far[np.isfinite(far)]
    if not far.size:
        return None
    noise = np.median(np.abs(np.diff(far))) / (MEDIAN_OF_NORMAL * np.sqrt(2.0))
    light = ~(power <= np.median(far) + _LIGHT * noise)
    first = np.flatnonzero(light[:-2] & light[1:-1] & light[2:])
    return float(ranges[first[0]]) if first.size else None
