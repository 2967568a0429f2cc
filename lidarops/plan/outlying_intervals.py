"""Find the granules whose interval does not fit their shots as those around them do."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Final, NamedTuple

from lidarops.plan.surroundings import Outlying, ReadHeader, granules_around
from lidarops.records import FEWEST_ALIKE, Granule

_RESOLUTION: Final = 2.0
"""s; two times in whole seconds may make an interval so much longer than another one."""


class _Interval(NamedTuple):
    """When a granule was recorded, s."""

    start: float
    stop: float

    @property
    def length(self) -> float:
        return self.stop - self.start

    def is_as_long_as(self, length: float) -> bool:
        return abs(self.length - length) <= _RESOLUTION

    def overlaps(self, other: _Interval) -> bool:
        return min(self.stop, other.stop) - max(self.start, other.start) > _RESOLUTION


def lone_intervals(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader
) -> Iterator[tuple[Granule, Outlying]]:
    """Yield granules that lasted longer or shorter than those around them for the same shots.

    One that lasted while another one was recorded cannot be used: its start or stop is wrong.

    Parameters
    ----------
    granules : sequence of Granule
        Good ones of one instrument and role, by start time.
    days : collection of int
        Days since 1970-01-01.
    read : callable
    """
    intervals = [_interval(granule) for granule in granules]
    for own, around in granules_around(granules, days):
        for index in own:
            near = _nearest(index, around)
            if not _is_lone(index, near, intervals):
                continue
            text = _compared(granules[index], [granules[other] for other in near], read)
            if text and any(intervals[index].overlaps(intervals[other]) for other in near):
                text += ", and one of them was recorded at the same time"
                yield granules[index], Outlying(text, "")
            elif text:
                yield granules[index], Outlying("", text)


def _interval(granule: Granule) -> _Interval:
    assert granule.start is not None  # noqa: S101 - good granules have both
    assert granule.stop is not None  # noqa: S101
    return _Interval(granule.start.timestamp(), granule.stop.timestamp())


def _nearest(index: int, around: range) -> list[int]:
    """Return the places of the nearest granules, as many as must agree."""
    first = max(min(index - FEWEST_ALIKE // 2, around.stop - FEWEST_ALIKE - 1), around.start)
    return [other for other in around[first - around.start :][: FEWEST_ALIKE + 1] if other != index]


def _is_lone(index: int, near: Sequence[int], intervals: Sequence[_Interval]) -> bool:
    """Return whether an interval is longer or shorter than those of granules that are alike."""
    if len(near) < FEWEST_ALIKE:
        return False
    length = intervals[near[0]].length
    return not intervals[index].is_as_long_as(length) and all(
        intervals[other].is_as_long_as(length) for other in near
    )


def _compared(granule: Granule, near: Sequence[Granule], read: ReadHeader) -> str:
    """Return in words that the interval of a granule does not follow from its shots, or nothing."""
    headers = [header for header in map(read, (granule, *near)) if header is not None]
    if len(headers) <= len(near):
        return ""
    shots = [max((channel.shots for channel in header.channels), default=0) for header in headers]
    if not all(shots) or len(set(shots[1:])) > 1:
        return ""
    own, other = _interval(granule), _interval(near[0])
    if own.is_as_long_as(other.length * shots[0] / shots[1]):
        return ""
    return (
        f"an interval of {own.length:g} s for {shots[0]} shots, the files around it"
        f" {other.length:g} s for {shots[1]}"
    )
