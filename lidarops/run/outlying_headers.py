"""Find files whose headers state what no other file of these days does: damaged digits.

Headers have no checksum. A header that is the only one of its kind, where most files of its day and
of the days beside it agree, is more likely damaged than true: a change of the lidar stays for more
than one file.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import fields, replace
from statistics import median
from typing import Any, Final, NamedTuple

from lidarops.catalog.raw_files import out_of_order
from lidarops.raw.formats import time_in_path
from lidarops.raw.header import RawChannel, RawHeader
from lidarops.records import FEWEST_ALIKE, Granule, Role, Status, day_of

NEAR_DAYS: Final = 1
"""Days before and after that of a file whose files are compared with it."""
_OF_VALUES: Final = frozenset(
    {"wavelength_label", "bins", "bin_width", "adc_bits", "input_range", "device"}
)
"""Properties of a channel by which its values, their ranges or its name would be wrong."""
_FREE: Final = frozenset({"name", "shots", "scale", "places", "mode", "wavelength", "polarisation"})
"""Properties that vary from file to file, or that follow from others."""
_COMPARED: Final = {
    item.name: item.name in _OF_VALUES for item in fields(RawChannel) if item.name not in _FREE
}
_SUMMER_TIME: Final = 3600.0
"""s; names may be by local time, headers by UTC."""
_JITTER: Final = 2
"""s; two times in whole seconds may make an interval so much longer than another one."""
_REMEDY: Final = (
    "a damaged digit, or a change for this file only (leave it out, correct its header, or give"
    " such files an instrument of their own)"
)

ReadHeader = Callable[[Granule], RawHeader | None]
"""Header of a file; None where it cannot be read."""
Ahead = Callable[[Granule], float | None]
"""Clock of the instrument minus UTC at a file, s, which its start has not; None where names tell no
time."""
Statements = Iterator[tuple[int, str, bool]]
"""Place of a file, what its header states, and whether the file cannot be used for that."""


class Outlying(NamedTuple):
    """What the header of a file states otherwise than the files around it, in words."""

    refused: str
    """Why the file cannot be used; empty where values are right whatever is true."""
    note: str


def without_outlying(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader, ahead: Ahead
) -> tuple[list[Granule], list[Granule], list[tuple[Granule, str]]]:
    """Return granules without those whose headers cannot be used, these as refused ones, and notes.

    Headers that differ in what changes no value become notes, each given with its granule.
    Parameters as `outlying_headers`.
    """
    outlying = outlying_headers(granules, days, read, ahead)
    kept, refused, noted = [], [], []
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
            noted.append((granule, note))
    return kept, refused, noted


def outlying_headers(
    granules: Sequence[Granule], days: Collection[int], read: ReadHeader, ahead: Ahead
) -> dict[str, Outlying]:
    """Return the files of some days whose headers differ from the mode of the files around them.

    These are the files of the same instrument and role on this day and the days beside it. What
    another one of them states too, or fewer than `FEWEST_ALIKE` agree on, is no damage.

    Parameters
    ----------
    granules : sequence of Granule
        Good ones, in any order, also of the days before and after.
    days : collection of int
        Days since 1970-01-01.
    read : callable
    ahead : callable

    Returns
    -------
    dict
        By path.
    """
    by_day: dict[tuple[str, Role, int], list[Granule]] = defaultdict(list)
    for granule in sorted(granules, key=lambda g: (g.start, g.path)):
        if granule.start:
            by_day[granule.instrument, granule.role, day_of(granule.start)].append(granule)
    found: dict[str, dict[bool, list[str]]] = {}
    for instrument, role, day in [key for key in by_day if key[2] in days]:
        near = range(day - NEAR_DAYS, day + NEAR_DAYS + 1)
        around = [g for other in near for g in by_day.get((instrument, role, other), ())]
        if len(around) <= FEWEST_ALIKE:
            continue
        statements = [*_setups(around, day, read), *_intervals(around, day, read)]
        statements += [*_times(around, day, ahead), *_out_of_order(around, day)]
        if role is Role.SIGNAL:
            statements += _pointings(around, day)
        for place, text, refused in statements:
            texts = found.setdefault(around[place].path, {True: [], False: []})
            texts[refused].append(text)
    return {
        path: Outlying("; ".join(texts[True]), "; ".join(texts[False]))
        for path, texts in found.items()
    }


def _places_of_lone_values(
    around: Sequence[Granule], day: int, stated: Sequence[Hashable]
) -> Iterator[tuple[int, int]]:
    """Yield places of files of a day that alone state a value, with that of a usual file."""
    counts = Counter(stated)
    mode, files = counts.most_common(1)[0]
    if len(counts) == 1 or files < FEWEST_ALIKE:
        return
    usual = stated.index(mode)
    for place, granule in enumerate(around):
        if counts[stated[place]] == 1 and granule.start and day_of(granule.start) == day:
            yield place, usual


def _setups(around: Sequence[Granule], day: int, read: ReadHeader) -> Statements:
    """Yield what files alone state of their site or channels."""
    lone = dict(_places_of_lone_values(around, day, [granule.layout for granule in around]))
    lone |= _places_of_lone_values(around, day, [granule.setup for granule in around])
    for place, usual in lone.items():
        own, other = read(around[place]), read(around[usual])
        if own and other:
            yield from ((place, *stated) for stated in _differences(own, other))


def _differences(own: RawHeader, usual: RawHeader) -> Iterator[tuple[str, bool]]:
    """Yield in words what two headers state otherwise, and whether values follow from it."""
    names = [", ".join(channel.name for channel in header.channels) for header in (own, usual)]
    stated: list[tuple[Any, ...]] = [("channels", *names, True)]
    stated.append(("site", own.site, usual.site, False))
    if len(own.channels) == len(usual.channels):
        stated += [
            (f"{other.name} {name}", getattr(channel, name), getattr(other, name), of_values)
            for channel, other in zip(own.channels, usual.channels, strict=True)
            for name, of_values in _COMPARED.items()
        ]
    for subject, one, other, of_values in stated:
        if one != other:
            yield f"{subject} {one}, the files around it {other}", of_values


def _intervals(around: Sequence[Granule], day: int, read: ReadHeader) -> Statements:
    """Yield which files lasted longer or shorter than the others for the same shots.

    One that lasted while another one was recorded cannot be used: its start or stop is wrong.
    """
    ends = [(g.start.timestamp(), g.stop.timestamp()) for g in around if g.start and g.stop]
    lengths = [round(stop - start) for start, stop in ends]
    for place, usual in _places_of_lone_values(around, day, lengths):
        length, other = lengths[place], lengths[usual]
        if any(0 < abs(length - near) <= _JITTER for near in lengths):
            continue
        own, others = (_shots(read(around[index])) for index in (place, usual))
        if not (own and others) or abs(length - other * own / others) <= _JITTER:
            continue
        text = f"an interval of {length} s for {own} shots,"
        text += f" the files around it {other} s for {others}"
        start, stop = ends[place]
        beside = ends[max(place - 1, 0) : place] + ends[place + 1 : place + 2]
        overlaps = any(min(stop, past) - max(start, first) > _JITTER for first, past in beside)
        text += ", and one of them was recorded at the same time" if overlaps else ""
        yield place, text, overlaps


def _times(around: Sequence[Granule], day: int, ahead: Ahead) -> Statements:
    """Yield which files start away from the time in their name as no other file does.

    Names tell start or stop, in any time zone: the other files show how far they are from it. A
    clock that is set moves both, and summer time may move one of the two by an hour.
    """
    away: dict[int, float] = {}
    longest = 0.0
    for place, granule in enumerate(around):
        named, clock = time_in_path(granule.path, granule.format), ahead(granule)
        if named and clock is not None and granule.start and granule.stop:
            away[place] = (granule.start - named).total_seconds() + clock
            longest = max(longest, (granule.stop - granule.start).total_seconds())
    if len(away) <= FEWEST_ALIKE:
        return
    usual = median(away.values())
    for place, own in away.items():
        granule = around[place]
        room = longest + _JITTER
        if abs(own - usual) <= room or any(
            abs(own - other) <= room for at, other in away.items() if at != place
        ):
            continue
        if granule.start and day_of(granule.start) == day:
            text = (
                f"the start {granule.start:%Y-%m-%d %H:%M:%S} UTC, {own - usual:+.0f} s away from"
            )
            text += " where its name and the files around it have it"
            # Such a file may be the only one of its day before or after a change of time.
            summer = abs(abs(own - usual) - _SUMMER_TIME) <= room
            yield place, text, not summer


def _out_of_order(around: Sequence[Granule], day: int) -> Statements:
    """Yield which files start out of the order of names, where names tell no time."""
    starts = {
        granule.path: granule.start
        for granule in around
        if granule.start and time_in_path(granule.path, granule.format) is None
    }
    places = {granule.path: place for place, granule in enumerate(around)}
    for path in out_of_order(starts):
        if day_of(starts[path]) == day:
            text = f"the start {starts[path]:%Y-%m-%d %H:%M:%S} UTC, out of the order of names"
            yield places[path], text, False


def _shots(header: RawHeader | None) -> int:
    return max((channel.shots for channel in header.channels), default=0) if header else 0


def _pointings(around: Sequence[Granule], day: int) -> Statements:
    """Yield the pointing that one file alone has, if each other pointing has several files.

    Of a beam that is fixed otherwise it cannot be used: the whole scene would seem to move. In a
    scan it is one of many pointings.
    """
    stated = [(granule.zenith_angle, granule.azimuth) for granule in around]
    others = sorted(Counter(stated).values())[1:]
    if others and others[0] >= FEWEST_ALIKE:
        for place, _ in _places_of_lone_values(around, day, stated):
            named = zip(("zenith angle", "azimuth"), stated[place], strict=True)
            words = " and ".join(f"{name} {angle:g}" for name, angle in named if angle is not None)
            yield place, f"the pointing {words} alone of all files around it", len(others) == 1
