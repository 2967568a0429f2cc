"""Find files whose headers state what all files around them contradict: damaged digits.

Headers have no checksum. A header that is the only one of its kind, between files that agree with
each other, is more likely damaged than true: a change of the lidar stays for more than one file.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Final, NamedTuple

from lidarops.catalog.granules import by_wording
from lidarops.catalog.rows import day_of
from lidarops.plan.outlying_intervals import lone_intervals
from lidarops.plan.outlying_pointings import lone_pointings
from lidarops.plan.surroundings import Outlying, ReadHeader, granules_around
from lidarops.raw.header import RawChannel, RawHeader
from lidarops.records import FEWEST_ALIKE, FileNote, Granule, Role, Status

_OF_VALUES: Final = frozenset(
    {"wavelength_label", "bins", "bin_width", "adc_bits", "input_range", "device"}
)
"""Properties of a channel by which its values, their ranges or its name would be wrong."""
_FREE: Final = frozenset({"name", "shots", "scale", "places", "mode", "wavelength", "polarisation"})
"""Properties that vary from file to file, or that follow from others."""
_COMPARED: Final = tuple(
    item.name for item in fields(RawChannel) if item.name not in _FREE | _OF_VALUES
)
_REMEDY: Final = (
    "a damaged digit, or a change for this file only (leave it out, correct its header, or give"
    " such files an instrument of their own)"
)


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


def new_notes(
    before: Sequence[Granule], after: Sequence[Granule], days: Collection[int]
) -> Iterator[FileNote]:
    """Yield a note for each one that `without_outlying` added to a file of some days.

    Parameters
    ----------
    before, after : sequence of Granule
        What it was given, and the granules that it kept.
    days : collection of int
        Days since 1970-01-01.
    """
    known = {granule.path: len(granule.notes) for granule in before}
    for granule in after:
        for text in granule.notes[known[granule.path] :]:
            if granule.start and day_of(granule.start) in days:
                yield FileNote(granule.instrument, text, contradicts=False, files=1)


def joined_notes(notes: Iterable[FileNote]) -> Iterator[FileNote]:
    """Yield notes on files of equal wording as one, with their number of files."""
    files: Counter[tuple[bool, str, str]] = Counter()
    for note in notes:
        files[note.contradicts, note.instrument, note.text] += note.files
    for (contradicts, instrument, text), number in sorted(by_wording(files).items()):
        yield FileNote(instrument, text, contradicts, number)


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
    outlying: dict[str, Outlying] = {}
    ordered = sorted(granules, key=lambda g: (g.instrument, g.role.value, g.start, g.path))
    for (_, role), alike in itertools.groupby(ordered, key=lambda g: (g.instrument, g.role)):
        own = list(alike)
        statements = [_lone_setups(own, days, read), lone_intervals(own, days, read)]
        if role is Role.SIGNAL:
            statements.append(lone_pointings(own, days))
        for granule, stated in itertools.chain(*statements):
            before = outlying.get(granule.path)
            outlying[granule.path] = stated if before is None else before.joined(stated)
    return outlying


def _lone_setups(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader
) -> Iterator[tuple[Granule, Outlying]]:
    """Yield granules whose site or channels are recorded otherwise than those around them."""
    lone = {index: near for key in (_setup, _layout) for index, near in _lone(granules, days, key)}
    for index, near in lone.items():
        stated = _compared(granules[index], [granules[other] for other in near], read)
        if stated is not None:
            yield granules[index], stated


def _setup(granule: Granule) -> Hashable:
    return granule.setup


def _layout(granule: Granule) -> Hashable:
    return granule.layout


def _lone(
    granules: Sequence[Granule], days: Collection[int], key: Callable[[Granule], Hashable]
) -> Iterator[tuple[int, tuple[int, int]]]:
    """Yield the places of files that no other is like, with those of the two nearest files.

    These are like each other and like others.
    """
    for own, around in granules_around(granules, days):
        counts = Counter(key(granules[index]) for index in around)
        if len(counts) == 1:
            continue
        for place, index in enumerate(around):
            if counts[key(granules[index])] > 1 or index not in own:
                continue
            first = min(max(place - 1, 0), len(around) - 3)
            near = tuple(other for other in around[first : first + 3] if other != index)
            stated = {key(granules[other]) for other in near}
            if len(near) == 2 and len(stated) == 1 and counts[stated.pop()] >= FEWEST_ALIKE:
                yield index, (near[0], near[1])


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
