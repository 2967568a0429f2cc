"""The granules around each granule, with which its header is compared."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Final, NamedTuple

from lidarops.catalog.rows import day_of
from lidarops.raw.header import RawHeader
from lidarops.records import Granule

NEAR_DAYS: Final = 1
"""Days before and after that of a file whose files are compared with it."""

ReadHeader = Callable[[Granule], RawHeader | None]
"""Header of a file; None where it cannot be read."""


class Outlying(NamedTuple):
    """What the header of a file states otherwise than the files around it, in words."""

    refused: str
    """Why the file cannot be used; empty where values are right whatever is true."""
    note: str

    def joined(self, other: Outlying) -> Outlying:
        """Return both statements."""
        return Outlying(*("; ".join(filter(None, pair)) for pair in zip(self, other, strict=True)))


def granules_around(
    granules: Sequence[Granule], days: Collection[int]
) -> Iterator[tuple[range, range]]:
    """Yield the places of the granules of each of some days, and of those around this day.

    Parameters
    ----------
    granules : sequence of Granule
        Good ones of one instrument and role, by start time.
    days : collection of int
        Days since 1970-01-01.
    """
    first: dict[int, int] = {}
    past: dict[int, int] = {}
    for index, granule in enumerate(granules):
        assert granule.start is not None  # noqa: S101 - good granules have one
        day = day_of(granule.start)
        first.setdefault(day, index)
        past[day] = index + 1
    for day in sorted(first.keys() & set(days)):
        near = [other for other in range(day - NEAR_DAYS, day + NEAR_DAYS + 1) if other in first]
        yield range(first[day], past[day]), range(first[near[0]], past[near[-1]])
