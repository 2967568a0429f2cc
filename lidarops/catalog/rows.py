"""Granules as rows of the catalog.

Processes that read headers make these rows, so this module imports little, and no database.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, fields
from datetime import UTC, date, datetime
from functools import lru_cache
from typing import Any, Final, NamedTuple

from lidarops.records import ChannelLayout, Granule

RETRY: Final = ""
"""Scan key of a file that could not be read: every scan tries it again."""
NO_NOTES: Final = "[]"
"""Stored notes of a file that has none."""

_FIELDS: Final = tuple(item.name for item in fields(Granule))
_HALF: Final = (1 << 31) - 1
_EPOCH: Final = date(1970, 1, 1).toordinal()


class GranuleRow(NamedTuple):
    """A granule for the catalog."""

    values: dict[str, Any]
    """By column."""
    layout: str
    """JSON text of its layout of channels."""


def naive(moment: datetime | None) -> datetime | None:
    """Return a time as stored in the tables: UTC, without a zone."""
    return None if moment is None else moment.astimezone(UTC).replace(tzinfo=None)


def aware(moment: datetime | None) -> datetime | None:
    """Return a stored time with its zone, UTC."""
    return None if moment is None else moment.replace(tzinfo=UTC)


def day_of(moment: datetime) -> int:
    """Return the UTC day of a time, in days since 1970-01-01."""
    return moment.astimezone(UTC).toordinal() - _EPOCH


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
    digest, text = _layout_row(granule.layout)
    return GranuleRow(_values(granule, campaign, scan_key, digest), text)


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


def _values(granule: Granule, campaign: str, scan_key: str, layout: str) -> dict[str, Any]:
    low, high = _stamp(granule, scan_key, layout)
    return {
        **{name: getattr(granule, name) for name in _FIELDS},
        "campaign": campaign,
        "scan_key": scan_key,
        "role": granule.role.value,
        "status": granule.status.value,
        "notes": json.dumps(granule.notes),
        "contradictions": json.dumps(granule.contradictions),
        "start": naive(granule.start),
        "stop": naive(granule.stop),
        "layout": layout,
        "day": None if granule.start is None else day_of(granule.start),
        "stamp_low": low,
        "stamp_high": high,
    }
