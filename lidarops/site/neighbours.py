"""What is beside a product: the previous and the next one, and others of the same time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarops.kinds import rank_of
from lidarops.site.product_entry import Entry

Seconds = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Products beside one product."""

    before: Entry | None
    """The previous product of the same instrument, kind and channel."""
    after: Entry | None
    siblings: tuple[Entry, ...]
    """Of the other kinds and channels of the instrument, the product nearest in time among those
    that overlap this one."""


def with_neighbours(entries: Sequence[Entry]) -> Iterator[tuple[Entry, Neighbours]]:
    """Yield every product with those beside it, in the given order."""
    series: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    for entry in sorted(entries, key=lambda entry: (entry.start, entry.path)):
        series[_series(entry)].append(entry)
    ends: dict[str, tuple[Entry | None, Entry | None]] = {}
    for group in series.values():
        befores, afters = [None, *group[:-1]], [*group[1:], None]
        for entry, before, after in zip(group, befores, afters, strict=True):
            ends[entry.path] = before, after
    of_instrument: dict[tuple[str, ...], list[tuple[str, ...]]] = defaultdict(list)
    for key in series:
        of_instrument[key[:2]].append(key)
    spans = {key: _Spans.of(group) for key, group in series.items()}
    for entry in entries:
        own = _series(entry)
        others = (
            spans[key].nearest(entry)
            for key in sorted(of_instrument[own[:2]], key=lambda key: (rank_of(key[2]), key))
            if key != own
        )
        siblings = tuple(other for other in others if other is not None)
        yield entry, Neighbours(*ends[entry.path], siblings)


def _series(entry: Entry) -> tuple[str, ...]:
    return entry.station, entry.instrument, entry.kind, entry.channel


@dataclass(frozen=True, slots=True)
class _Spans:
    """Products by their start, with their times in seconds."""

    entries: Sequence[Entry]
    starts: Seconds
    stops: Seconds
    latest: Seconds
    """Latest stop of a product and those before it."""

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> _Spans:
        """Return the spans of products in the order of their start."""
        starts = _seconds(entry.start for entry in entries)
        stops = _seconds(entry.stop for entry in entries)
        return cls(entries, starts, stops, np.maximum.accumulate(stops))

    def nearest(self, to: Entry) -> Entry | None:
        """Return the product nearest in time of those that overlap another; None without any."""
        start, stop = _seconds([to.start, to.stop]).tolist()
        first = int(np.searchsorted(self.latest, start))
        last = int(np.searchsorted(self.starts, stop, side="right"))
        overlapping = [
            k
            for k in range(first, last)
            # A product without length overlaps one that starts with it.
            if self.starts[k] == start or (self.starts[k] < stop and start < self.stops[k])
        ]
        if not overlapping:
            return None
        return self.entries[min(overlapping, key=lambda k: (abs(int(self.starts[k]) - start), k))]


def _seconds(moments: Iterable[str]) -> Seconds:
    return np.array(list(moments), dtype="datetime64[s]").astype(np.int64)
