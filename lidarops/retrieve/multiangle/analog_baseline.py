"""Beams that end at a tree, a building or the ground, and the analog baseline that they show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Block, Booleans, Indices, Integers, median
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_BEHIND: Final = 4
"""Blocks behind an obstruction that must be dark, after one that may hold its edge."""


def obstruction_range(power: Array, variance: Array, distance: Array) -> Array:
    """Return the range from which a beam is blocked.

    Behind it, the range-corrected signal is less than 2 percent of that before. A dense cloud
    that ends a beam is an obstruction too.

    Parameters
    ----------
    power, variance : (profile, range) float
        Without background; NaN where missing.
    distance : (range,) float
        m, rising.

    Returns
    -------
    (profile,) float
        m, the start of the last block before the darkness, which holds the obstruction itself; inf
        for a free beam.
    """
    bins = int(np.searchsorted(distance, distance[0] + THRESHOLDS.obstruction_block))
    count = distance.size // max(bins, 1)
    blocked = np.full(len(power), np.inf)
    if count < _BEHIND + 2:
        return blocked
    shape = (count, bins)
    known = np.isfinite(power) & np.isfinite(variance)
    square = distance[: count * bins].reshape(shape) ** 2

    def blocks(array: Block) -> Block:
        return array[:, : count * bins].reshape(-1, *shape)

    inside = np.count_nonzero(blocks(known), axis=2)
    # Summed as they are multiplied.
    values, spread = (
        np.einsum("pcb,cb->pc", blocks(np.where(known, array, 0.0)), factor)
        for array, factor in ((power, square), (variance, square**2))
    )
    samples = np.maximum(inside, 1.0)
    level, error = values / samples, np.sqrt(spread) / samples
    # Missing bins, such as saturated ones, do not show darkness.
    seen = np.where(inside > 0, level, np.inf)
    before = slice(0, count - _BEHIND - 1)
    behind, noise = (
        np.stack(
            [array[:, first : first + count - _BEHIND - 1] for first in range(2, _BEHIND + 2)]
        ).max(axis=0)
        for array in (seen, error)
    )
    # The echo of a target is rough, and so is the noise that is estimated from it.
    bright = level[:, before] > THRESHOLDS.obstruction_signal * noise
    dark = behind < THRESHOLDS.obstruction_drop * level[:, before]
    ends = bright & dark & (inside[:, before] > 0)
    rows = np.flatnonzero(ends.any(axis=1))
    blocked[rows] = distance[ends[rows].argmax(axis=1) * bins]
    return blocked


@dataclass(frozen=True, slots=True)
class AnalogBaseline:
    """Power without light over range, minus that of the far range."""

    range: Array
    """(block,) m, middles of the blocks and of the far range; rising."""
    power: Array
    """(block,) mV."""
    standard_error: Array
    """(block,) mV: of noise, and of the scatter between beams."""
    profile: Integers
    """(blocked,) numbers of the profiles in the scene."""
    obstruction: Array
    """(blocked,) m, range from which each of them is blocked."""

    def at(self, distance: Array) -> Array:
        """Return the baseline at ranges in m.

        Nearer than the first block, it is that of the block. The line to the middle of the far
        range goes on beyond, so that the mean of the far range is 0.
        """
        slope = (self.power[-1] - self.power[-2]) / (self.range[-1] - self.range[-2])
        beyond = np.maximum(distance - self.range[-1], 0.0)
        return np.asarray(np.interp(distance, self.range, self.power) + slope * beyond)

    def error_at(self, distance: Array) -> Array:
        """Return the standard error of `at` at ranges in m.

        Nearer than the first block, where no beam shows it, the baseline may change as fast as
        between the first two blocks: that slope, and its error, over the distance to the block. It
        is too small where the baseline falls to 1/e within 300 m: deviations up to 900 m have a
        root mean square of 2 errors.
        """
        (first, second), (power, other) = self.range[:2], self.power[:2]
        rise = np.hypot(other - power, np.hypot(*self.standard_error[:2]))
        nearer = np.maximum(first - distance, 0.0) * rise / (second - first)
        return np.asarray(np.hypot(np.interp(distance, self.range, self.standard_error), nearer))


class _Profile(NamedTuple):
    """Means of one profile over blocks; NaN where bins are missing."""

    number: int
    obstruction: float
    """m; inf for a free beam."""
    mean: Array
    variance: Array
    of_tail: float
    """Variance of the mean of the tail."""


class BlockedBeams:
    r"""Profiles of a scan that are blocked, and the baseline that they show.

    Behind an obstruction (`obstruction_range`, and a guard of 300 m for the echo of a
    strong target) there is no light, which is tested: the power in the first block is less than a
    tenth of the median of the free beams. Near the lidar, a photon counter of few shots sees echo
    and afterpulses as bright as what it sees before: a beam that is dark in all blocks from the
    second to the first in which free beams are not saturated is blocked within the first. The power
    behind minus that of the tail is averaged over blocks of 300 m or a fifth of the range, the last
    of which ends where the tail begins; in the middle of the tail the baseline is 0.
    With the variances :math:`v_{ib}` of profile :math:`i`
    in block :math:`b`, and a variance :math:`e^2` between profiles by the moments of
    `dersimonian1986`, pooled over blocks, the mean has weights :math:`1 / (v + e^2)`, and the
    variance :math:`1 / \sum w + e^2`: the baseline of a free beam differs from the mean too.

    Parameters
    ----------
    distance : (range,) float
        m, rising.
    tail : (float, float)
        m, far range, whose mean is subtracted.
    """

    def __init__(self, distance: Array, tail: tuple[float, float]) -> None:
        first = int(np.searchsorted(distance, 0.0, side="right"))
        self._front = slice(first, None)
        self._distance = distance[self._front]
        self._tail = (self._distance >= tail[0]) & (self._distance <= tail[1])
        self._edges = _block_edges(tail[0])
        self._places = np.searchsorted(self._distance, self._edges)
        self._profiles: list[_Profile] = []

    def add(self, power: Array, variance: Array, profile: Integers) -> None:
        """Take profiles.

        Parameters
        ----------
        power, variance : (profile, range) float
            mV, mV2; NaN where missing. The variance is that of means over many bins.
        profile : (profile,) int
            Numbers of the profiles in the scene.
        """
        values, spread = power[:, self._front], variance[:, self._front]
        sky, of_sky, _ = _means(values[:, self._tail], spread[:, self._tail], np.zeros(1, np.intp))
        net = values - sky
        ends = obstruction_range(net, spread, self._distance)
        means, of_means, full = (part[:, :-1] for part in _means(net, spread, self._places))
        means = np.where(full, means, np.nan)
        columns = zip(profile, ends, means, of_means + of_sky, of_sky[:, 0], strict=True)
        for number, end, mean, of_mean, of_tail in columns:
            part = _Profile(int(number), float(end), mean, of_mean, float(of_tail))
            self._profiles.append(part)

    def baseline(self) -> AnalogBaseline | None:
        """Return the baseline; None where no profile is blocked, or all are."""
        blocked = self._blocked()
        if not blocked:
            return None
        mean = np.stack([self._behind(profile) for profile in blocked])
        variance = np.stack([profile.variance for profile in blocked])
        known = np.isfinite(mean).any(axis=0)
        power, of_power = _combined(mean[:, known], variance[:, known])
        middles = 0.5 * (self._edges[:-1] + self._edges[1:])
        of_tail = 1.0 / sum(1.0 / profile.of_tail for profile in blocked)
        return AnalogBaseline(
            range=np.append(middles[known], self._distance[self._tail].mean()),
            power=np.append(power, 0.0),
            standard_error=np.sqrt(np.append(of_power, of_tail)),
            profile=np.array([profile.number for profile in blocked], dtype=np.int64),
            obstruction=np.array([profile.obstruction for profile in blocked]),
        )

    def obstructions(self) -> dict[int, float]:
        """Return the range in m from which each blocked profile is blocked, by its number."""
        return {profile.number: profile.obstruction for profile in self._blocked()}

    def _blocked(self) -> list[_Profile]:
        """Return the profiles that are dark behind an obstruction; none where none is free."""
        unblocked = [own.mean for own in self._profiles if not np.isfinite(own.obstruction)]
        if not unblocked:
            return []
        means = np.stack(unblocked)
        # Where most are saturated, the others are the dark ones.
        light = np.where(
            np.isfinite(means).mean(axis=0) > 0.5, median(means, np.isfinite(means)), np.nan
        )
        profiles = [
            own._replace(obstruction=float(self._edges[1])) if _never_lit(own, light) else own
            for own in self._profiles
        ]
        blocked = [
            own
            for own in profiles
            if np.isfinite(own.obstruction) and _is_dark(self._behind(own), light)
        ]
        return blocked if len(blocked) < len(profiles) else []

    def _behind(self, part: _Profile) -> Array:
        """Return the means of the blocks behind the obstruction, NaN in front."""
        dark = self._edges[:-1] >= part.obstruction + THRESHOLDS.baseline_guard
        return np.where(dark, part.mean, np.nan)


def _block_edges(end: float) -> Array:
    """Return the edges of the blocks up to `end`, m; the last one may be half as long as others."""
    edges = [0.0]
    while edges[-1] + 1.5 * _length(edges[-1]) < end:
        edges.append(edges[-1] + _length(edges[-1]))
    return np.array([*edges, end])


def _length(start: float) -> float:
    """Return the length of the block that begins at a range, m."""
    return max(THRESHOLDS.baseline_guard, THRESHOLDS.baseline_share * start)


def _is_dark(behind: Array, light: Array) -> bool:
    """Return whether the first block behind an obstruction holds no light."""
    known = np.flatnonzero(np.isfinite(behind) & np.isfinite(light))
    if known.size == 0:
        return False
    first = known[0]
    return bool(abs(behind[first]) < THRESHOLDS.baseline_light * light[first])


def _never_lit(profile: _Profile, light: Array) -> bool:
    """Return whether a profile without obstruction is dark from the second block to free beams.

    That is to the first block in which they are not saturated; nearer, they have more light.
    """
    known = np.flatnonzero(np.isfinite(light[1:])) + 1
    if np.isfinite(profile.obstruction) or known.size == 0:
        return False
    faint = THRESHOLDS.baseline_light * light[known[0]]
    return bool((np.abs(profile.mean[1 : known[0] + 1]) < faint).all())


def _means(values: Array, variance: Array, places: Indices) -> tuple[Array, Array, Booleans]:
    """Return means over blocks that begin at places, their variances, and which are complete."""
    known = np.isfinite(values) & np.isfinite(variance)
    sums = [
        np.add.reduceat(np.where(known, array, 0.0), places, axis=1)
        for array in (np.ones_like(values), values, variance)
    ]
    count = np.maximum(sums[0], 1.0)
    full = np.logical_and.reduceat(known, places, axis=1)
    return sums[1] / count, sums[2] / count**2, full


def _combined(mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return the mean over profiles, (block,), and its variance with that between profiles."""
    known = np.isfinite(mean)
    values = np.where(known, mean, 0.0)
    with np.errstate(divide="ignore"):
        weight = np.where(known, 1.0 / variance, 0.0)
    total = weight.sum(axis=0)
    centre = (weight * values).sum(axis=0) / total
    excess = (weight * (values - centre) ** 2).sum() - (known.sum(axis=0) - 1).sum()
    spare = (total - (weight**2).sum(axis=0) / total).sum()
    between = max(excess / spare, 0.0) if spare > 0.0 else 0.0
    weight = np.where(known, 1.0 / (variance + between), 0.0)
    total = weight.sum(axis=0)
    return (weight * values).sum(axis=0) / total, 1.0 / total + between
