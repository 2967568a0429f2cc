"""Make granules from the headers of raw files.

Its sources decide whether a header is read again, so it imports little.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from lidarops.catalog.rows import RETRY, GranuleRow, row_of
from lidarops.catalog.sources import RawFile, Source, printable
from lidarops.errors import RawFormatError
from lidarops.raw.formats import parse_raw_header, read_start
from lidarops.raw.header import RawHeader
from lidarops.records import UNKNOWN_FORMAT, UNREADABLE, Granule, Role, Status

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts, Station

_TRY_AGAIN: Final = (UNREADABLE, UNKNOWN_FORMAT)
"""Starts of the reason if a refused file may be readable another time, or its format be added."""

HEADER_BYTES: Final = 16384
"""Bytes that hold the header of any format."""
_ROUNDING_OF_ANGLES: Final = 1.0
"""degree; headers hold whole degrees."""


class UnreadFile(NamedTuple):
    """A file whose header must be read."""

    file: RawFile
    instrument: str
    role: Role
    rivals: tuple[str, ...]
    """Other instruments that claim the file."""
    scan_key: str
    """Digest of the settings that affect its granule."""


@dataclass(frozen=True, slots=True)
class _Lidar:
    """What the campaign states of an instrument that headers state too."""

    instrument: Instrument
    station: Station

    def is_near(self, latitude: float, longitude: float) -> bool:
        """Return whether a position is that of the station, within the tolerance."""
        eastward = (longitude - self.station.longitude + 180.0) % 360.0 - 180.0
        northward = latitude - self.station.latitude
        return max(abs(northward), abs(eastward)) <= self.instrument.position_tolerance

    def is_level(self, altitude: float) -> bool:
        """Return whether an altitude is that of the station, within the tolerance."""
        return abs(altitude - self.station.altitude) <= self.instrument.altitude_tolerance


@dataclass(frozen=True, slots=True)
class Headers:
    """The source of raw files and the settings with which their headers are read."""

    source: Source
    _campaign: str
    _lidars: Mapping[str, _Lidar]

    @classmethod
    def of(cls, campaign: Campaign, source: Source, entered_as: str) -> Self:
        """Return the settings of a campaign for headers.

        Rows get the name `entered_as`, by which the catalog knows the campaign.
        """
        lidars = {
            name: _Lidar(instrument, campaign.stations[instrument.station])
            for name, instrument in campaign.instruments.items()
        }
        return cls(source, entered_as, lidars)

    def lidar(self, instrument: str) -> _Lidar:
        """Return an instrument with its station."""
        return self._lidars[instrument]

    def row(self, due: UnreadFile, granule: Granule) -> GranuleRow:
        """Return the row of a granule."""
        retry = granule.reason.startswith(_TRY_AGAIN)
        return row_of(granule, self._campaign, RETRY if retry else due.scan_key)


def read_row(headers: Headers, due: UnreadFile) -> GranuleRow:
    """Read the header of a file and return its row; see `read_header`."""
    return headers.row(due, read_header(headers, due))


def read_header(headers: Headers, due: UnreadFile) -> Granule:
    """Return the granule of a file; if it is unusable, a refused one with the reason."""
    file = due.file
    if printable(file.path) != file.path:
        return _refused(due, "has a name that is not UTF-8 (rename it)")
    if due.rivals:
        claimants = f"{due.instrument} and {', '.join(due.rivals)}"
        return _refused(due, f"claimed by instruments {claimants} (make their patterns disjoint)")
    head = b""
    try:
        head = headers.source.head(file.path, HEADER_BYTES)
        header = parse_raw_header(head, file=file.path, size=file.size)
        return _accepted(due, header, headers.lidar(due.instrument))
    except RawFormatError as error:
        reason = str(error).removeprefix(f"{file.path}: ")
        return _refused(due, reason, _start(head, headers.lidar(due.instrument)))
    except OSError as error:
        return _refused(due, f"{UNREADABLE}: {error.strerror or error}")


def _start(head: bytes, lidar: _Lidar) -> datetime | None:
    """Return the start of a file that is refused, by which it belongs to a scene."""
    start = read_start(head)
    if start is None:
        return None
    return start - timedelta(seconds=lidar.instrument.facts_by_clock(start).clock_offset)


def _refused(due: UnreadFile, reason: str, start: datetime | None = None) -> Granule:
    return Granule(
        path=printable(due.file.path),
        size=due.file.size,
        mtime_ns=due.file.mtime_ns,
        instrument=due.instrument,
        role=due.role,
        status=Status.REFUSED,
        reason=reason,
        start=start,
    )


def _accepted(due: UnreadFile, header: RawHeader, lidar: _Lidar) -> Granule:
    instrument, station = lidar.instrument, lidar.station
    facts = instrument.facts_by_clock(header.start)
    header = header.read_as(instrument.header_pointing)
    if header.doubt and facts.zenith_angle is None:
        raise RawFormatError(
            header.doubt,
            file=header.path,
            field="pointing",
            remedy="leave the file out, or set header_pointing if it states no scan, or give"
            " zenith_angle in the facts if the beam is fixed: it holds for all files of the period",
        )
    shift = timedelta(seconds=facts.clock_offset)
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
        "notes": (*header.notes, *_overridden(header, facts, lidar)),
    }
    return Granule(
        path=due.file.path,
        size=due.file.size,
        mtime_ns=due.file.mtime_ns,
        instrument=due.instrument,
        role=due.role,
        status=Status.GOOD,
        contradictions=() if order == "ignore" else tuple(_contradictions(header, position, lidar)),
        **header.stated | of_campaign,
    )


def _contradictions(
    header: RawHeader, position: tuple[float, float] | None, lidar: _Lidar
) -> Iterator[str]:
    """Yield what the header states otherwise than the station of the campaign."""
    station, altitude = lidar.station, header.altitude
    if position is not None and not lidar.is_near(*position):
        latitude, longitude = position
        remedy = "correct the station, or set header_position: ignore or position_tolerance"
        if lidar.is_near(longitude, latitude):
            remedy = (
                "they look swapped: correct the station, or set header_position if the header has"
                " them in another order"
            )
        yield (
            f"the header states the position {latitude:.1f} N {longitude:.1f} E, the station of the"
            f" campaign {station.latitude:.1f} N {station.longitude:.1f} E ({remedy})"
        )
    if altitude is not None and not lidar.is_level(altitude):
        remedy = "correct the station, or set header_position: ignore or altitude_tolerance"
        if abs(altitude - 1e3 * station.altitude) <= lidar.instrument.altitude_tolerance:
            remedy = "that of the station looks like km: give m"
        yield (
            f"the header states the altitude {altitude:.0f} m, the station of the campaign"
            f" {station.altitude:.5g} m ({remedy})"
        )


def _overridden(header: RawHeader, facts: InstrumentFacts, lidar: _Lidar) -> Iterator[str]:
    """Yield what of the campaign overrides what the header states otherwise."""
    for name in ("zenith_angle", "azimuth"):
        stated, given = getattr(header, name), getattr(facts, name)
        if None not in (stated, given) and (
            abs((stated - given + 180.0) % 360.0 - 180.0) > _ROUNDING_OF_ANGLES
        ):
            yield f"{name} {given:g} degree of the campaign overrides {stated:g} of the header"
    if header.doubt:
        yield f"zenith_angle {facts.zenith_angle:g} of the facts overrides header: {header.doubt}"
    if lidar.instrument.header_position == "ignore":
        pair, altitude = header.coordinates, header.altitude
        if pair is not None and not (lidar.is_near(*pair) or lidar.is_near(*pair[::-1])):
            yield f"header_position: ignore overrides {pair[0]:g}, {pair[1]:g} of the header"
        if altitude is not None and not lidar.is_level(altitude):
            yield f"header_position: ignore overrides the altitude {altitude:g} m of the header"
