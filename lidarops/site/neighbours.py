"""What is beside a product: the previous and the next one, and others of the same time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from lidarops.kinds import rank_of
from lidarops.site.product_entry import Entry


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Products beside one product."""

    before: Entry | None
    """The previous product of the same instrument, kind and channel."""
    after: Entry | None
    siblings: tuple[Entry, ...]
    """Of the other kinds and channels of the instrument, the product nearest in time among those of
    the same day that overlap this one."""


def with_neighbours(entries: Sequence[Entry]) -> Iterator[tuple[Entry, Neighbours]]:
    """Yield every product with those beside it, in the given order."""
    series: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    days: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    for entry in sorted(entries, key=lambda entry: (entry.start, entry.path)):
        series[_series(entry)].append(entry)
        days[entry.station, entry.instrument, entry.day].append(entry)
    ends: dict[str, tuple[Entry | None, Entry | None]] = {}
    for group in series.values():
        befores, afters = [None, *group[:-1]], [*group[1:], None]
        for entry, before, after in zip(group, befores, afters, strict=True):
            ends[entry.path] = before, after
    for entry in entries:
        same_day = days[entry.station, entry.instrument, entry.day]
        yield entry, Neighbours(*ends[entry.path], _siblings(entry, same_day))


def _series(entry: Entry) -> tuple[str, ...]:
    return entry.station, entry.instrument, entry.kind, entry.channel


def _siblings(entry: Entry, same_day: Iterable[Entry]) -> tuple[Entry, ...]:
    start = datetime.fromisoformat(entry.start)
    overlapping = [
        other
        for other in same_day
        # A product without length overlaps one that starts with it.
        if other.start == entry.start or (other.start < entry.stop and entry.start < other.stop)
    ]
    nearest: dict[tuple[str, ...], Entry] = {}
    for other in sorted(overlapping, key=lambda o: abs(datetime.fromisoformat(o.start) - start)):
        nearest.setdefault(_series(other), other)
    del nearest[_series(entry)]
    return tuple(nearest[key] for key in sorted(nearest, key=lambda key: (rank_of(key[2]), key)))
