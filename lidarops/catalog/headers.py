"""Make granules from the headers of raw files.

Processes that read headers import only this module, so it imports little, to start quickly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Self

from lidarops.catalog.rows import RETRY, GranuleRow, row_of
from lidarops.catalog.sources import RawFile, Source, printable
from lidarops.errors import RawFormatError
from lidarops.raw.formats import UNKNOWN_FORMAT, parse_raw_header
from lidarops.raw.header import HeaderOrder, RawHeader
from lidarops.records import Granule, Role, Status

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign

_UNREADABLE: Final = "cannot be read"
_TRY_AGAIN: Final = (_UNREADABLE, UNKNOWN_FORMAT)
"""Starts of the reason if a refused file may be readable another time, or its format be added."""

_HEADER_BYTES = 16384
_FAR_FROM_STATION = 0.5
"""degree; a header position farther from the station gets a note."""


class UnreadFile(NamedTuple):
    """A file whose header must be read."""

    file: RawFile
    instrument: str
    role: Role
    rivals: tuple[str, ...]
    """Other instruments that claim the file."""
    scan_key: str
    """Digest of the settings that affect its granule."""


class _Pointing(NamedTuple):
    valid_from: datetime
    valid_to: datetime
    zenith_angle: float | None
    azimuth: float | None


@dataclass(frozen=True, slots=True)
class _Place:
    """Position and pointing of an instrument, as far as the campaign gives them."""

    latitude: float
    longitude: float
    header_position: HeaderOrder | Literal["ignore"]
    pointings: tuple[_Pointing, ...]

    def pointing(self, moment: datetime) -> tuple[float | None, float | None]:
        for fact in self.pointings:
            if fact.valid_from <= moment < fact.valid_to:
                return fact.zenith_angle, fact.azimuth
        return None, None


@dataclass(frozen=True, slots=True)
class Headers:
    """The source of raw files and the settings with which their headers are read."""

    source: Source
    _campaign: str
    _places: Mapping[str, _Place]

    @classmethod
    def of(cls, campaign: Campaign, source: Source, entered_as: str) -> Self:
        """Extract the settings for headers from a campaign, whose module takes long to import.

        Rows get the name `entered_as`, by which the catalog knows the campaign.
        """
        places = {
            name: _Place(
                campaign.stations[instrument.station].latitude,
                campaign.stations[instrument.station].longitude,
                instrument.header_position,
                tuple(
                    _Pointing(fact.valid_from, fact.valid_to, fact.zenith_angle, fact.azimuth)
                    for fact in instrument.facts
                ),
            )
            for name, instrument in campaign.instruments.items()
        }
        return cls(source, entered_as, places)

    def place(self, instrument: str) -> _Place:
        """Return position and pointing of an instrument."""
        return self._places[instrument]

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
    try:
        head = headers.source.head(file.path, _HEADER_BYTES)
        header = parse_raw_header(head, file=file.path, size=file.size)
        return _accepted(due, header, headers.place(due.instrument))
    except RawFormatError as error:
        return _refused(due, str(error).removeprefix(f"{file.path}: "))
    except OSError as error:
        return _refused(due, f"{_UNREADABLE}: {error.strerror or error}")


def _refused(due: UnreadFile, reason: str) -> Granule:
    return Granule(
        path=printable(due.file.path),
        size=due.file.size,
        mtime_ns=due.file.mtime_ns,
        instrument=due.instrument,
        role=due.role,
        status=Status.REFUSED,
        reason=reason,
    )


def _accepted(due: UnreadFile, header: RawHeader, place: _Place) -> Granule:
    zenith_angle, azimuth = place.pointing(header.start)
    notes = header.notes
    latitude, longitude = place.latitude, place.longitude
    order = place.header_position
    position = None if order == "ignore" else header.position(order)
    if position is not None:
        latitude, longitude = position
        distance = max(abs(latitude - place.latitude), abs(longitude - place.longitude))
        if distance > _FAR_FROM_STATION:
            note = _position_note(latitude, longitude, place.latitude, place.longitude)
            notes = (*notes, note)
    return Granule(
        path=due.file.path,
        size=due.file.size,
        mtime_ns=due.file.mtime_ns,
        instrument=due.instrument,
        role=due.role,
        status=Status.GOOD,
        notes=notes,
        start=header.start,
        stop=header.stop,
        zenith_angle=header.zenith_angle if zenith_angle is None else zenith_angle,
        azimuth=header.azimuth if azimuth is None else azimuth,
        latitude=latitude,
        longitude=longitude,
        altitude=header.altitude,
        layout=header.layout,
        format=header.format,
        header_digest=header.digest,
    )


def _position_note(latitude: float, longitude: float, north: float, east: float) -> str:
    swapped = max(abs(longitude - north), abs(latitude - east)) <= _FAR_FROM_STATION
    remedy = (
        "they look swapped: set header_position of the instrument"
        if swapped
        else "the position of the campaign is used; header_position: ignore silences this"
    )
    return (
        f"header position {latitude:.1f} N {longitude:.1f} E is not that of the station"
        f" {north:.1f} N {east:.1f} E ({remedy})"
    )
