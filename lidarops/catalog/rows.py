"""Granules as rows of the catalog: made where headers are read, which other processes do too.

So it imports little, and no database.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Final, NamedTuple

from lidarops.records import ChannelLayout, Granule

AGAIN: Final = ""
"""Scan key of a file that could not be read: it is looked at again with every scan."""

_HALF: Final = (1 << 31) - 1


class GranuleRow(NamedTuple):
    """A granule for the catalog."""

    values: dict[str, Any]
    """By column."""
    layout: str
    """Row of the layout that it names."""


def naive(moment: datetime | None) -> datetime | None:
    """Return a time as the tables hold it: UTC, without a zone."""
    return None if moment is None else moment.astimezone(UTC).replace(tzinfo=None)


def aware(moment: datetime | None) -> datetime | None:
    """Return a time of the tables with its zone."""
    return None if moment is None else moment.replace(tzinfo=UTC)


def day_of(moment: datetime) -> int:
    """Return the days since 1970-01-01 of a time, in UTC."""
    return (moment.astimezone(UTC).date() - datetime(1970, 1, 1, tzinfo=UTC).date()).days


def row_of(granule: Granule, campaign: str, scan_key: str) -> GranuleRow:
    """Return the row of a granule.

    Parameters
    ----------
    granule : Granule
    campaign : str
        Its name.
    scan_key : str
        Digest of the settings that it was read with; `AGAIN` where it could not be read.
    """
    digest, text = _layout_row(granule.layout)
    return GranuleRow(_values(granule, campaign, scan_key, digest), text)


def _stamp(granule: Granule, scan_key: str, layout: str) -> tuple[int, int]:
    """Return two numbers that change with anything that a scan found of a file."""
    facts = (
        granule.path,
        granule.size,
        granule.mtime_ns,
        scan_key,
        granule.instrument,
        granule.role.value,
        granule.status.value,
        granule.reason,
        granule.start,
        granule.stop,
        granule.zenith_angle,
        granule.azimuth,
        layout,
    )
    digest = hashlib.sha256(repr(facts).encode("utf-8", "backslashreplace")).digest()
    return int.from_bytes(digest[:4], "big") & _HALF, int.from_bytes(digest[4:8], "big") & _HALF


# The files of an archive share few layouts.
@lru_cache(maxsize=128)
def _layout_row(layout: tuple[ChannelLayout, ...]) -> tuple[str, str]:
    text = json.dumps([asdict(channel) for channel in layout], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16], text


def _values(granule: Granule, campaign: str, scan_key: str, layout: str) -> dict[str, Any]:
    low, high = _stamp(granule, scan_key, layout)
    return {
        "campaign": campaign,
        "path": granule.path,
        "size": granule.size,
        "mtime_ns": granule.mtime_ns,
        "scan_key": scan_key,
        "instrument": granule.instrument,
        "role": granule.role.value,
        "status": granule.status.value,
        "reason": granule.reason,
        "notes": json.dumps(granule.notes) if granule.notes else "[]",
        "start": naive(granule.start),
        "stop": naive(granule.stop),
        "zenith_angle": granule.zenith_angle,
        "azimuth": granule.azimuth,
        "latitude": granule.latitude,
        "longitude": granule.longitude,
        "altitude": granule.altitude,
        "layout": layout,
        "sha256": granule.sha256,
        "header_digest": granule.header_digest,
        "day": None if granule.start is None else day_of(granule.start),
        "stamp_low": low,
        "stamp_high": high,
    }
