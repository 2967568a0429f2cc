"""The catalog's half of the database: granules, one row a raw file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Final, NamedTuple

import sqlalchemy as sa

from lidarops.catalog.database import BATCH, Database, day_of, naive
from lidarops.catalog.schema import GRANULE, LAYOUT
from lidarops.records import ChannelLayout, DetectionMode, Granule, Role, Status

AGAIN: Final = ""
"""Scan key of a file that could not be read: it is looked at again with every scan."""

_HALF: Final = (1 << 31) - 1
_C = GRANULE.c
Layouts = Mapping[str, tuple[ChannelLayout, ...]]


class Fingerprint(NamedTuple):
    """What a scan compares a file with."""

    path: str
    size: int
    mtime_ns: int
    scan_key: str
    stamp_low: int
    stamp_high: int
    sha256: str | None
    start: datetime | None
    """UTC, without a zone."""


@dataclass(frozen=True, slots=True)
class DaySum:
    """The granules of one role on one day, summed up: equal where no row has changed."""

    day: int
    role: Role
    good: int
    low: int
    high: int


class Granules(Database):
    """The granules of a campaign."""

    @contextmanager
    def fingerprints(self) -> Iterator[Iterator[Fingerprint]]:
        """Give a fingerprint of every granule, by path, without holding them all."""
        columns = (_C.path, _C.size, _C.mtime_ns, _C.scan_key, _C.stamp_low, _C.stamp_high)
        query = (
            sa.select(*columns, _C.sha256, _C.start)
            .where(_C.campaign == self.campaign)
            .order_by(_C.path)
        )
        with self.stream(query) as rows:
            yield map(Fingerprint._make, rows)

    @contextmanager
    def unread(self) -> Iterator[Iterator[tuple[str, int, datetime | None]]]:
        """Give path, size and start of good granules that were never read whole."""
        query = (
            sa.select(_C.path, _C.size, _C.start)
            .where(
                _C.campaign == self.campaign,
                _C.status == Status.GOOD.value,
                _C.sha256.is_(None),
            )
            .order_by(_C.path)
        )
        with self.stream(query) as rows:
            yield ((path, size, start) for path, size, start in rows)

    def replace(self, granules: Iterable[tuple[Granule, str]]) -> None:
        """Insert granules, each with its scan key, in place of rows of the same path."""
        rows = []
        layouts: dict[str, str] = {}
        for granule, scan_key in granules:
            digest, text = _layout_row(granule.layout)
            layouts[digest] = text
            rows.append(_granule_row(granule, self.campaign, scan_key, digest))
        if not rows:
            return
        with self.transaction() as connection:
            connection.execute(
                self.insert_new(LAYOUT),
                [{"hash": key, "channels": text} for key, text in layouts.items()],
            )
            connection.execute(self.upsert(GRANULE), rows)

    def forget(self, paths: Collection[str]) -> None:
        """Remove the rows of files that are no longer in the archive."""
        if paths:
            with self.transaction() as connection:
                self._remove(connection, paths)

    def _remove(self, connection: sa.Connection, paths: Collection[str]) -> None:
        gone = sa.delete(GRANULE).where(
            _C.campaign == self.campaign, _C.path == sa.bindparam("gone")
        )
        connection.execute(gone, [{"gone": path} for path in paths])

    def store_digests(self, digests: Mapping[str, str]) -> None:
        """Enter the sha256 of files that were read whole, by path."""
        if not digests:
            return
        with self.transaction() as connection:
            self._enter_digests(connection, digests)

    def _enter_digests(self, connection: sa.Connection, digests: Mapping[str, str]) -> None:
        if digests:
            connection.execute(
                sa.update(GRANULE)
                .where(_C.campaign == self.campaign, _C.path == sa.bindparam("file"))
                .values(sha256=sa.bindparam("digest")),
                [{"file": path, "digest": digest} for path, digest in digests.items()],
            )

    def granules(self, *, status: Status | None = None) -> list[Granule]:
        """Return the granules of the campaign, by instrument, start time and path."""
        wanted = [] if status is None else [_C.status == status.value]
        return self._granules(*wanted)

    def granules_of(self, first: int, last: int, *, dark_days: int) -> list[Granule]:
        """Return good granules that start on days `first` to `last`, and dark ones around them.

        Parameters
        ----------
        first, last : int
            Days since 1970-01-01, both included.
        dark_days : int
            How many days earlier and later dark granules may be.
        """
        near = _C.day.between(first - dark_days, last + dark_days)
        here = _C.day.between(first, last)
        role = sa.or_(here, _C.role == Role.DARK.value)
        return self._granules(near, role, _C.status == Status.GOOD.value)

    def _granules(self, *wanted: sa.ColumnElement[bool]) -> list[Granule]:
        query = sa.select(*_OF_GRANULE).where(_C.campaign == self.campaign, *wanted)
        query = query.order_by(_C.instrument, _C.start, _C.path)
        with self.transaction() as connection:
            layouts = {
                row.hash: _layout_from(row.channels)
                for row in connection.execute(sa.select(LAYOUT))
            }
        with self.stream(query) as rows:
            return [_granule_from(row, layouts) for row in rows]

    def refused(self) -> list[Granule]:
        """Return the granules that the catalog refuses."""
        return self.granules(status=Status.REFUSED)

    def count(self, *, status: Status | None = None) -> int:
        """Return how many granules there are."""
        wanted = [] if status is None else [_C.status == status.value]
        query = sa.select(sa.func.count()).where(_C.campaign == self.campaign, *wanted)
        with self.transaction() as connection:
            return int(connection.scalar(query) or 0)

    def day_sums(self) -> list[DaySum]:
        """Return the sums of the stamps of good granules by day and role."""
        query = (
            sa.select(
                _C.day,
                _C.role,
                sa.func.count(),
                sa.func.sum(_C.stamp_low),
                sa.func.sum(_C.stamp_high),
            )
            .where(_C.campaign == self.campaign, _C.status == Status.GOOD.value)
            .group_by(_C.day, _C.role)
            .order_by(_C.day, _C.role)
        )
        with self.transaction() as connection:
            return [
                DaySum(day, Role(role), count, int(low), int(high))
                for day, role, count, low, high in connection.execute(query)
            ]

    def paths_by_digest(self, digests: Collection[str]) -> dict[str, str]:
        """Return sha256 -> path of granules that hold these contents."""
        found: dict[str, str] = {}
        wanted = sorted(digests)
        with self.transaction() as connection:
            for first in range(0, len(wanted), BATCH):
                part = wanted[first : first + BATCH]
                query = sa.select(_C.sha256, _C.path).where(
                    _C.campaign == self.campaign, _C.sha256.in_(part)
                )
                found.update((row.sha256, row.path) for row in connection.execute(query))
        return found


_OF_GRANULE: Final = tuple(
    _C[name]
    for name in (
        "path", "size", "mtime_ns", "instrument", "role", "status", "reason", "notes", "start",
        "stop", "zenith_angle", "azimuth", "latitude", "longitude", "altitude", "layout", "sha256",
    )
)  # fmt: skip
_ROLES: Final = {role.value: role for role in Role}
_STATUSES: Final = {status.value: status for status in Status}


def stamp(granule: Granule, scan_key: str, layout: str) -> tuple[int, int]:
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


def stamp_of(granule: Granule, scan_key: str) -> tuple[int, int]:
    """Return the stamp that a granule's row would have."""
    return stamp(granule, scan_key, _layout_row(granule.layout)[0])


# The files of an archive share few layouts.
@lru_cache(maxsize=128)
def _layout_row(layout: tuple[ChannelLayout, ...]) -> tuple[str, str]:
    text = json.dumps([asdict(channel) for channel in layout], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16], text


def _layout_from(text: str) -> tuple[ChannelLayout, ...]:
    return tuple(
        ChannelLayout(**{**channel, "mode": DetectionMode(channel["mode"])})
        for channel in json.loads(text)
    )


def _granule_row(granule: Granule, campaign: str, scan_key: str, layout: str) -> dict[str, Any]:
    low, high = stamp(granule, scan_key, layout)
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
        "day": None if granule.start is None else day_of(granule.start),
        "stamp_low": low,
        "stamp_high": high,
    }


def _granule_from(row: Any, layouts: Layouts) -> Granule:
    (
        path, size, mtime_ns, instrument, role, status, reason, notes, start, stop,
        zenith_angle, azimuth, latitude, longitude, altitude, layout, sha256,
    ) = row  # fmt: skip
    return Granule(
        path=path,
        size=size,
        mtime_ns=mtime_ns,
        instrument=instrument,
        role=_ROLES[role],
        status=_STATUSES[status],
        reason=reason,
        # Most granules have none, and there are millions.
        notes=() if notes == "[]" else tuple(json.loads(notes)),
        start=None if start is None else start.replace(tzinfo=UTC),
        stop=None if stop is None else stop.replace(tzinfo=UTC),
        zenith_angle=zenith_angle,
        azimuth=azimuth,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        layout=layouts[layout],
        sha256=sha256,
    )
