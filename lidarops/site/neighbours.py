"""What is beside a product: the previous and the next one, and others of the same time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lidarops.kinds import rank_of
from lidarops.site.product_entry import Entry


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Products beside one product."""

    before: Entry | None
    """The previous product of the same instrument, kind and channel."""
    after: Entry | None
    siblings: tuple[Entry, ...]
    """Of the other kinds and channels of the instrument, the product nearest in time."""


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
    starts = {key: _seconds(group) for key, group in series.items()}
    for entry in entries:
        own = _series(entry)
        others = (
            _nearest(series[key], starts[key], entry)
            for key in sorted(of_instrument[own[:2]], key=lambda key: (rank_of(key[2]), key))
            if key != own
        )
        yield entry, Neighbours(*ends[entry.path], tuple(others))


def _series(entry: Entry) -> tuple[str, ...]:
    return entry.station, entry.instrument, entry.kind, entry.channel


def _seconds(entries: Iterable[Entry]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([entry.start for entry in entries], dtype="datetime64[s]").astype(np.int64)


def _nearest(
    entries: Sequence[Entry], starts: np.ndarray[tuple[int], np.dtype[np.int64]], to: Entry
) -> Entry:
    (start,) = _seconds([to])
    place = int(np.clip(np.searchsorted(starts, start), 1, max(starts.size - 1, 1)))
    choices = range(max(place - 1, 0), min(place + 1, starts.size))
    return entries[min(choices, key=lambda k: (abs(int(starts[k] - start)), k))]
