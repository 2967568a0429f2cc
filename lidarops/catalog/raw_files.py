"""The raw files of an archive: list them, read their headers, and make rows of the catalog.

An archive is a folder, or behind a URL. These sources decide whether a header is read again, and
processes that read headers load them, so they import little, and no database.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from lidarops.campaign.path_patterns import path_matcher
from lidarops.errors import RawFormatError, UnavailableError
from lidarops.raw.formats import parse_raw_header, read_start, time_in_path
from lidarops.raw.header import TIME_REMEDY, RawHeader
from lidarops.records import (
    ACKNOWLEDGED,
    INVALID,
    MISDATED,
    UNREADABLE,
    ChannelLayout,
    Granule,
    Header,
    Role,
    Status,
    day_of,
    without_numbers,
)
from lidarops.system.files import opened_regular, sha256_of
from lidarops.system.stores import RemoteStore, Stored

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts, Station


RETRY: Final = ""
"""Scan key of a file that could not be read: every scan tries it again."""
NO_NOTES: Final = "[]"
"""Stored notes of a file that has none."""

_FIELDS: Final = tuple(item.name for item in fields(Granule))
_STATED: Final = tuple(item.name for item in fields(Header))
_HALF: Final = (1 << 31) - 1
_FUTURE: Final = "starts in the future"
_TRY_AGAIN: Final = (UNREADABLE, _FUTURE)
"""Starts of the reason if a refused file may be readable another time, or the clock of this machine
be set."""

HEADER_BYTES: Final = 16384
"""Bytes that hold the header of any format."""
_CLOCKS_DIFFER: Final = timedelta(days=2)
"""A clock of raw files may be a day ahead of UTC, by `clock_offset`."""
_ROUNDING_OF_ANGLES: Final = 1.0
"""degree; headers hold whole degrees."""
_FEWEST_IN_ORDER: Final = 5
"""Files whose starts follow the order of names not by chance."""
_BOTH_SIDES: Final = 2
_MINUTE: Final = "%Y-%m-%d %H:%M"


def printable(path: str) -> str:
    """Return a path that can be stored and shown: names may hold bytes that are not UTF-8."""
    return path if path.isascii() else path.encode("utf-8", "backslashreplace").decode()


def acknowledged(campaign: Campaign, granules: Iterable[Granule]) -> list[Granule]:
    """Return granules that are not used; where the campaign acknowledges it, the reason says so."""
    unused = [*granules]
    if not campaign.acknowledged:
        return unused
    reasons = acknowledged_reasons(campaign, {granule.path: granule.reason for granule in unused})
    return [replace(granule, reason=reasons[granule.path]) for granule in unused]


def acknowledged_reasons(campaign: Campaign, reasons: Mapping[str, str]) -> dict[str, str]:
    """Return path -> why the file is not used, after what the campaign acknowledges of it."""
    entries = [
        (path_matcher(entry.what), f"{ACKNOWLEDGED} ({entry.reason}): ")
        for entry in campaign.acknowledged
        if entry.holds
    ]
    return {
        path: next((words for matches, words in entries if matches(path)), "") + reason
        for path, reason in reasons.items()
    }


def misdated(starts: Mapping[str, datetime]) -> dict[str, str]:
    """Return path -> why a file is refused, of those of another date than their neighbours by name.

    Given are the starts, by path, of files whose names tell no time.
    """
    return {
        path: f"{MISDATED}, {' and '.join(f'{one} ({starts[one]:{_MINUTE}})' for one in beside)}:"
        f" it starts {starts[path]:{_MINUTE}} (correct the date in its header; if it is right,"
        " rename the file or move it to another folder)"
        for path, beside in out_of_order(starts, timedelta(days=1)).items()
        # Before the first or behind the last, nothing tells a wrong date from another session.
        if len(beside) == _BOTH_SIDES
    }


def out_of_order(
    starts: Mapping[str, datetime], room: timedelta = timedelta()
) -> dict[str, list[str]]:
    """Return the files that start before or after both files beside them by name, and these.

    These are the nearest of the longest run of files whose starts follow the order of names; of
    several, of the one that takes least time. Names have an order in one folder, where they agree
    but for numbers: a file may be renamed. None where over one and a quarter of the files are away,
    or too few are not: names that count anew each day tell no order. Six files follow it but for
    one, or eight but for two, in less than 4 % of all orders.

    Parameters
    ----------
    starts : mapping of str to datetime
        By path.
    room : timedelta
        By how much more than that. Files that are less away do not count against the order.
    """
    alike: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path in sorted(starts, key=lambda path: (_by_number(path), path)):
        folder, _, name = path.rpartition("/")
        alike[folder, without_numbers(name)].append(path)
    return {
        paths[place]: [paths[other] for other in beside]
        for paths in alike.values()
        for place, beside in _away(
            [starts[path].timestamp() for path in paths], room.total_seconds()
        ).items()
    }


def _by_number(path: str) -> list[str | int]:
    """Return a key that orders f9 before f10."""
    parts = re.split(r"(\d+)", path)
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def _away(times: Sequence[float], room: float) -> dict[int, list[int]]:
    """Return the places away from the longest run of times that does not fall, with the nearest."""
    # The places that end the longest run up to them, by its length: their times fall.
    levels: list[list[int]] = []
    for place, time in enumerate(times):
        length = bisect_right(levels, time, key=lambda level: times[level[-1]])
        levels[length:] = levels[length:] or [[]]
        levels[length].append(place)
    run: list[int] = []
    for level in reversed(levels):
        last = times[run[-1]] if run else times[level[-1]]
        run.append(level[bisect_left(level, -last, key=lambda one: -times[one])])
    run.reverse()
    places, within = {}, set(run)
    for place in (place for place in range(len(times)) if place not in within):
        after = bisect_right(run, place)
        before, later = run[max(after - 1, 0) : after], run[after : after + 1]
        if any(times[place] < times[one] - room for one in before) or any(
            times[place] > times[one] + room for one in later
        ):
            places[place] = before + later
    enough = len(times) - len(places) >= _FEWEST_IN_ORDER
    return places if enough and len(places) <= max(1, len(times) // 4) else {}


class Source:
    """An archive in a local folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> Source:
        """Return the source of an archive, given its folder or URL."""
        return RemoteSource(archive) if "://" in archive else Source(Path(archive))

    def files(
        self,
        is_used: Callable[[str], bool] = lambda _: True,  # noqa: ARG002 - sizes cost nothing here
    ) -> Iterator[Stored]:
        """List files, sorted by path; those that are not used may have no size."""
        self.refuse_absent()
        yield from self._files_below(str(self._root), "")

    def refuse_absent(self) -> None:
        """Raise an error if the folder does not exist.

        Raises
        ------
        CatalogError
        """
        if not self._root.is_dir():
            raise UnavailableError(
                "the archive is not a folder",
                file=self._root,
                remedy="set archive in the campaign file, --archive or LIDAROPS_ARCHIVE",
            )

    def _files_below(self, folder: str, prefix: str) -> Iterator[Stored]:
        try:
            with os.scandir(folder) as listing:
                entries = [(entry, entry.is_dir(follow_symlinks=False)) for entry in listing]
        except OSError as error:
            raise UnavailableError(
                f"cannot be listed: {error.strerror}", file=folder, remedy="check its permissions"
            ) from error
        # In the order of the paths of their files.
        entries.sort(key=lambda item: printable(item[0].name) + "/" * item[1])
        for entry, is_folder in entries:
            path = f"{prefix}{entry.name}"
            if is_folder:
                yield from self._files_below(entry.path, f"{path}/")
                continue
            try:
                status = entry.stat()
            except OSError:
                # A broken link is listed too, so that it is reported as unreadable.
                yield Stored(path, 0, 0)
            else:
                yield Stored(path, status.st_size, status.st_mtime_ns)

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file."""
        with opened_regular(self._root / path) as stream:
            return stream.read(size)

    def digest(self, path: str) -> str:
        """Return the SHA-256 of a file."""
        return sha256_of(self._root / path)


class RemoteSource(RemoteStore, Source):
    """An archive behind an fsspec URL."""

    def refuse_absent(self) -> None:
        """Do nothing: checking a store may take as long as listing it."""


class GranuleRow(NamedTuple):
    """A granule for the catalog."""

    values: dict[str, Any]
    """By column."""
    layout: str
    """JSON text of its layout of channels."""


class UnreadFile(NamedTuple):
    """A file whose header must be read."""

    file: Stored
    instrument: str
    role: Role
    rivals: tuple[str, ...]
    """Other instruments that claim the file."""
    scan_key: str
    """Digest of the settings that affect its granule."""


class Headers(NamedTuple):
    """The source of raw files and the campaign with which their headers are read."""

    source: Source
    campaign: Campaign
    entered_as: str
    """Name by which the catalog knows the campaign."""


def read_row(headers: Headers, due: UnreadFile) -> GranuleRow:
    """Read the header of a file and return its row; see `read_header`."""
    granule = read_header(headers, due)
    retry = granule.reason.startswith(_TRY_AGAIN)
    return row_of(granule, headers.entered_as, RETRY if retry else due.scan_key)


def unread_row(headers: Headers, due: UnreadFile, reason: str) -> GranuleRow:
    """Return the row of a file whose reading came to no end: it is read again once it changed."""
    return row_of(_refused(due, f"{UNREADABLE}: {reason}"), headers.entered_as, due.scan_key)


def read_header(headers: Headers, due: UnreadFile) -> Granule:
    """Return the granule of a file; if it is unusable, a refused one with the reason."""
    file = due.file
    if printable(file.path) != file.path:
        return _refused(due, "has a name that is not UTF-8 (rename it)")
    if due.rivals:
        claimants = f"{due.instrument} and {', '.join(due.rivals)}"
        return _refused(due, f"claimed by instruments {claimants} (make their patterns disjoint)")
    head, instrument = b"", headers.campaign.instruments[due.instrument]
    try:
        head = headers.source.head(file.path, HEADER_BYTES)
        header = parse_raw_header(head, file=file.path, size=file.size)
        return _accepted(due, header, instrument, headers.campaign.stations[instrument.station])
    except RawFormatError as error:
        reason = str(error).removeprefix(f"{file.path}: ")
        return _refused(due, reason, _start(head, instrument))
    except OSError as error:
        return _refused(due, f"{UNREADABLE}: {error.strerror or error}")


def _start(head: bytes, instrument: Instrument) -> datetime | None:
    """Return the start of a file that is refused, by which it belongs to a scene."""
    start = read_start(head)
    if start is None:
        return None
    return start - timedelta(seconds=instrument.facts_at(start, by_clock=True).clock_offset)


def _refused(due: UnreadFile, reason: str, start: datetime | None = None) -> Granule:
    return _granule(due, Status.REFUSED, reason=reason, start=start)


def _granule(due: UnreadFile, status: Status, **stated: Any) -> Granule:
    return Granule(
        path=printable(due.file.path),
        size=due.file.size,
        mtime_ns=due.file.mtime_ns,
        instrument=due.instrument,
        role=due.role,
        status=status,
        **stated,
    )


def _accepted(
    due: UnreadFile, header: RawHeader, instrument: Instrument, station: Station
) -> Granule:
    facts = instrument.facts_at(header.start, by_clock=True)
    shift = timedelta(seconds=facts.clock_offset)
    left_out = _left_out(header, facts, instrument, due.role)
    if left_out:
        return _refused(due, left_out, header.start - shift)
    if instrument.name_times == "checked":
        header.check_time()
    header = header.read_as(instrument.header_pointing)
    if header.doubt and facts.zenith_angle is None:
        raise RawFormatError(
            header.doubt,
            file=header.path,
            field="pointing",
            remedy="leave the file out, or set header_pointing if it states no scan, or give"
            " zenith_angle in the facts if the beam is fixed: it holds for all files of the period",
        )
    order = instrument.header_position
    position = None if order == "ignore" else header.position(order)
    latitude, longitude = position or (station.latitude, station.longitude)
    of_campaign = {
        "start": header.start - shift,
        "stop": header.stop - shift,
        "zenith_angle": header.zenith_angle if facts.zenith_angle is None else facts.zenith_angle,
        "azimuth": header.azimuth if facts.azimuth is None else facts.azimuth,
        "latitude": latitude,
        "longitude": longitude,
        "notes": (*header.notes, *_overridden(header, facts, instrument, station)),
    }
    return _granule(
        due,
        Status.GOOD,
        contradictions=tuple(_contradictions(header, position, instrument, station)),
        **{name: getattr(header, name) for name in _STATED} | of_campaign,
    )


def _left_out(header: RawHeader, facts: InstrumentFacts, instrument: Instrument, role: Role) -> str:
    """Return why no product is made of a file by its time; else empty."""
    now = datetime.now(UTC)
    if header.start > now + _CLOCKS_DIFFER:
        named = time_in_path(header.path, header.format)
        told = f", its name {named:%Y-%m-%d %H:%M}" if named else ""
        return (
            f"{_FUTURE}: {header.start:%Y-%m-%d %H:%M}, today is {now:%Y-%m-%d}{told}"
            f" ({TIME_REMEDY}; clock_offset is at most a day)"
        )
    # Dark files are judged by the scenes that use them.
    if role is Role.SIGNAL and facts.invalid:
        return f"{INVALID}: {facts.invalid}"
    if role is Role.SIGNAL and not any(facts is stated for stated in instrument.facts):
        utc = header.start - timedelta(seconds=facts.clock_offset)
        ends = [fact.valid_to for fact in instrument.facts if fact.valid_to <= utc]
        begins = [fact.valid_from for fact in instrument.facts if fact.valid_from > utc]
        beside = [f"one ends {max(ends):%Y-%m-%d %H:%M}"] if ends else []
        beside += [f"one begins {min(begins):%Y-%m-%d %H:%M}"] if begins else []
        return (
            f"starts {utc:%Y-%m-%d %H:%M}, a time that no period of the facts holds:"
            f" {', '.join(beside)} (give one, or one that is `invalid`)"
        )
    return ""


def _is_near(instrument: Instrument, station: Station, latitude: float, longitude: float) -> bool:
    """Return whether a position is that of the station, within the tolerance."""
    eastward = (longitude - station.longitude + 180.0) % 360.0 - 180.0
    northward = latitude - station.latitude
    return max(abs(northward), abs(eastward)) <= instrument.position_tolerance


def _contradictions(
    header: RawHeader,
    position: tuple[float, float] | None,
    instrument: Instrument,
    station: Station,
) -> Iterator[str]:
    """Yield what the header states otherwise than the station of the campaign."""
    if instrument.header_position == "ignore":
        return
    altitude, tolerance = header.altitude, instrument.altitude_tolerance
    if position is not None and not _is_near(instrument, station, *position):
        latitude, longitude = position
        remedy = "correct the station, or set header_position: ignore or position_tolerance"
        if _is_near(instrument, station, longitude, latitude):
            remedy = (
                "they look swapped: correct the station, or set header_position if the header has"
                " them in another order"
            )
        yield (
            f"the header states the position {latitude:.1f} N {longitude:.1f} E, the station of the"
            f" campaign {station.latitude:.1f} N {station.longitude:.1f} E ({remedy})"
        )
    if altitude is not None and abs(altitude - station.altitude) > tolerance:
        remedy = "correct the station, or set header_position: ignore or altitude_tolerance"
        if abs(altitude - 1e3 * station.altitude) <= tolerance:
            remedy = "that of the station looks like km: give m"
        yield (
            f"the header states the altitude {altitude:.0f} m, the station of the campaign"
            f" {station.altitude:.5g} m ({remedy})"
        )


def _overridden(
    header: RawHeader, facts: InstrumentFacts, instrument: Instrument, station: Station
) -> Iterator[str]:
    """Yield what of the campaign overrides what the header states otherwise."""
    for name in ("zenith_angle", "azimuth"):
        stated, given = getattr(header, name), getattr(facts, name)
        if None not in (stated, given) and (
            abs((stated - given + 180.0) % 360.0 - 180.0) > _ROUNDING_OF_ANGLES
        ):
            yield f"{name} {given:g} degree of the campaign overrides {stated:g} of the header"
    if header.doubt:
        yield f"zenith_angle {facts.zenith_angle:g} of the facts overrides header: {header.doubt}"
    if instrument.header_position == "ignore":
        pair, altitude = header.coordinates, header.altitude
        orders = (pair, pair[::-1]) if pair else ()
        if pair and not any(_is_near(instrument, station, *order) for order in orders):
            yield f"header_position: ignore overrides {pair[0]:g}, {pair[1]:g} of the header"
        if (
            altitude is not None
            and abs(altitude - station.altitude) > instrument.altitude_tolerance
        ):
            yield f"header_position: ignore overrides the altitude {altitude:g} m of the header"


def row_of(granule: Granule, campaign: str, scan_key: str) -> GranuleRow:
    """Return the row of a granule.

    Parameters
    ----------
    granule : Granule
    campaign : str
        Its name.
    scan_key : str
        Digest of the settings with which it was read; `RETRY` if it could not be read.
    """
    layout, text = _layout_row(granule.layout)
    low, high = _stamp(granule, scan_key, layout)
    values = {
        **{name: getattr(granule, name) for name in _FIELDS},
        "campaign": campaign,
        "scan_key": scan_key,
        "role": granule.role.value,
        "status": granule.status.value,
        "notes": json.dumps(granule.notes),
        "contradictions": json.dumps(granule.contradictions),
        "layout": layout,
        "day": None if granule.start is None else day_of(granule.start),
        "stamp_low": low,
        "stamp_high": high,
    }
    return GranuleRow(values, text)


def _stamp(granule: Granule, scan_key: str, layout: str) -> tuple[int, int]:
    """Return two numbers that change with anything that a scan reads from a file."""
    facts = (
        granule.path,
        granule.size,
        granule.mtime_ns,
        scan_key,
        granule.instrument,
        granule.role.value,
        granule.status.value,
        granule.reason,
        # As numbers: the repr of a time takes twice as long.
        None if granule.start is None else granule.start.timestamp(),
        None if granule.stop is None else granule.stop.timestamp(),
        granule.zenith_angle,
        granule.azimuth,
        granule.format,
        layout,
    )
    digest = hashlib.sha256(repr(facts).encode("utf-8", "backslashreplace")).digest()
    return int.from_bytes(digest[:4], "big") & _HALF, int.from_bytes(digest[4:8], "big") & _HALF


# An archive has few different layouts.
@lru_cache(maxsize=128)
def _layout_row(layout: tuple[ChannelLayout, ...]) -> tuple[str, str]:
    text = json.dumps([asdict(channel) for channel in layout], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16], text
