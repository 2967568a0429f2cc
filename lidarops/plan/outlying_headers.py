"""Find files whose headers state what all files around them contradict: damaged digits.

Headers have no checksum. A header that is the only one of its kind, between files that agree with
each other, is more likely damaged than true: a change of the lidar stays for more than one file.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Final, NamedTuple

from lidarops.catalog.rows import day_of
from lidarops.raw.header import RawChannel, RawHeader
from lidarops.records import Granule, Status

NEAR_DAYS: Final = 1
"""Days before and after that of a file whose files are compared with it."""
_FEWEST_ALIKE: Final = 3
"""Fewest other files that must agree; with fewer, any of them may be the damaged one."""
_OF_VALUES: Final = frozenset({"wavelength_label", "bins", "bin_width", "adc_bits", "input_range"})
"""Properties of a channel by which its values or their ranges would be wrong."""
_FREE: Final = frozenset({"name", "shots", "scale", "places", "mode", "wavelength", "polarisation"})
"""Properties that vary from file to file, or that follow from others."""
_COMPARED: Final = tuple(
    item.name for item in fields(RawChannel) if item.name not in _FREE | _OF_VALUES
)
_REMEDY: Final = (
    "a damaged digit, or a change for this file only (leave it out, correct its header, or give"
    " such files an instrument of their own)"
)

ReadHeader = Callable[[Granule], RawHeader | None]
"""Header of a file; None where it cannot be read."""


class Outlying(NamedTuple):
    """What the header of a file states otherwise than the files around it, in words."""

    refused: str
    """Why the file cannot be used; empty where values are right whatever is true."""
    note: str


def without_outlying(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader
) -> tuple[list[Granule], list[Granule]]:
    """Return granules without those whose headers cannot be used, and these as refused ones.

    Headers that differ in what changes no value become notes. Parameters as `outlying_headers`.
    """
    outlying = outlying_headers(granules, days, read)
    kept, refused = [], []
    for granule in granules:
        stated = outlying.get(granule.path)
        if stated is None:
            kept.append(granule)
        elif stated.refused:
            reason = f"its header states {stated.refused}: {_REMEDY}"
            refused.append(replace(granule, status=Status.REFUSED, reason=reason))
        else:
            note = f"the header states {stated.note}"
            kept.append(replace(granule, notes=(*granule.notes, note)))
    return kept, refused


def outlying_headers(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader
) -> dict[str, Outlying]:
    """Return the files of some days whose headers differ from all around them.

    Parameters
    ----------
    granules : sequence of Granule
        Good ones, in any order, also of the days before and after.
    days : collection of int
        Days since 1970-01-01.
    read : callable

    Returns
    -------
    dict
        By path.
    """
    outlying = {}
    ordered = sorted(granules, key=lambda g: (g.instrument, g.role.value, g.start, g.path))
    for _, alike in itertools.groupby(ordered, key=lambda g: (g.instrument, g.role)):
        own = list(alike)
        lone = {index: near for key in (_digest, _layout) for index, near in _lone(own, days, key)}
        for index, near in lone.items():
            stated = _compared(own[index], [own[other] for other in near], read)
            if stated is not None:
                outlying[own[index].path] = stated
    return outlying


def _digest(granule: Granule) -> Hashable:
    return granule.header_digest


def _layout(granule: Granule) -> Hashable:
    return granule.layout


def _lone(
    granules: Sequence[Granule], days: Collection[int], key: Callable[[Granule], Hashable]
) -> Iterator[tuple[int, tuple[int, int]]]:
    """Yield the places of files that no other is like, with those of the two nearest files.

    These are like each other and like others.
    """
    of_day: dict[int, list[int]] = {}
    for index, granule in enumerate(granules):
        of_day.setdefault(_day(granule), []).append(index)
    for day in sorted(of_day.keys() & set(days)):
        around = [
            index
            for near in range(day - NEAR_DAYS, day + NEAR_DAYS + 1)
            for index in of_day.get(near, ())
        ]
        counts = Counter(key(granules[index]) for index in around)
        if len(counts) == 1:
            continue
        for place, index in enumerate(around):
            if counts[key(granules[index])] > 1 or _day(granules[index]) != day:
                continue
            first = min(max(place - 1, 0), len(around) - 3)
            near = tuple(other for other in around[first : first + 3] if other != index)
            stated = {key(granules[other]) for other in near}
            if len(near) == 2 and len(stated) == 1 and counts[stated.pop()] >= _FEWEST_ALIKE:
                yield index, (near[0], near[1])


def _day(granule: Granule) -> int:
    assert granule.start is not None  # noqa: S101 - good granules have one
    return day_of(granule.start)


def _compared(granule: Granule, near: Sequence[Granule], read: ReadHeader) -> Outlying | None:
    """Return in what the header of a file differs from those of two that are alike."""
    headers = [header for header in map(read, (granule, *near)) if header is not None]
    if len(headers) <= len(near):
        return None
    refused: list[str] = []
    noted: list[str] = []
    for statement in _statements(headers):
        own, *others = statement.stated
        if len(set(others)) == 1 and own != others[0]:
            text = f"{statement.subject} {own}, the files around it {others[0]}"
            (refused if statement.of_values else noted).append(text)
    if not (refused or noted):
        return None
    return Outlying("; ".join(refused), "; ".join(noted))


class _Statement(NamedTuple):
    """What each of some headers states of the same thing."""

    subject: str
    stated: tuple[Hashable, ...]
    of_values: bool
    """Whether values or their ranges follow from it."""


def _statements(headers: Sequence[RawHeader]) -> Iterator[_Statement]:
    names = tuple(", ".join(c.name for c in header.channels) for header in headers)
    yield _Statement("channels", names, of_values=True)
    yield _Statement("site", tuple(header.site for header in headers), of_values=False)
    if len({len(header.channels) for header in headers}) > 1:
        return
    for channels in zip(*(header.channels for header in headers), strict=True):
        for name in (*sorted(_OF_VALUES), *_COMPARED):
            values = tuple(getattr(channel, name) for channel in channels)
            yield _Statement(f"{channels[1].name} {name}", values, of_values=name in _OF_VALUES)
