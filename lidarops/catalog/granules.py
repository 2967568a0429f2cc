"""The catalog part of the database: granules, one row per raw file."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import sqlalchemy as sa

from lidarops.catalog.database import CHANNEL_NAME, GRANULE, LAYOUT, Database
from lidarops.catalog.raw_files import NO_NOTES, GranuleRow
from lidarops.raw.header import Names, recorder_names
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    FileNote,
    Granule,
    Holding,
    Role,
    Status,
    without_numbers,
)

_C = GRANULE.c
Layouts = Mapping[str, tuple[ChannelLayout, ...]]

_MOST_VALUES: Final = 3
"""Notes that differ by a number only, as of the angles of a scan, of which each is reported."""


class Fingerprint(NamedTuple):
    """What the catalog knows of a file, for comparison in a scan."""

    path: str
    size: int
    mtime_ns: int
    scan_key: str
    stamp_low: int
    stamp_high: int
    sha256: str | None
    start: datetime | None
    status: str
    format: str

    @property
    def is_damaged(self) -> bool:
        """Whether the file is refused for its content, of which `sha256` is the digest."""
        return self.status == Status.REFUSED and self.sha256 is not None


class DatedFile(NamedTuple):
    """A file whose header could be read, and when it starts."""

    path: str
    instrument: str
    role: Role
    start: datetime
    format: str = ""
    reason: str = ""
    """Why it is refused for all that; empty where it is good."""


class DaySum(NamedTuple):
    """Sums over the granules of one role on one day; unchanged if no row changed."""

    day: int
    role: Role
    good: int
    low: int
    high: int


class Granules(Database):
    """The granules of a campaign."""

    @contextmanager
    def fingerprints(self) -> Iterator[Iterator[Fingerprint]]:
        """Yield a fingerprint of every granule, ordered by path, without holding them all."""
        columns = (_C[name] for name in Fingerprint._fields)
        query = sa.select(*columns).where(_C.campaign == self.campaign).order_by(_C.path)
        with self.stream(query) as rows:
            yield map(Fingerprint._make, rows)

    @contextmanager
    def without_digest(self) -> Iterator[Iterator[tuple[str, int, datetime | None]]]:
        """Yield path, size and start of good granules without SHA-256 (never read in full)."""
        query = (
            sa.select(_C.path, _C.size, _C.start)
            .where(*self._good(), _C.sha256.is_(None))
            .order_by(_C.path)
        )
        with self.stream(query) as rows:
            yield ((path, size, start) for path, size, start in rows)

    def replace(
        self, rows: Sequence[GranuleRow], reasons: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Insert granules, replacing rows of the same path, and enter reasons of others by path.

        A reason refuses a granule, an empty one makes it good again.
        """
        layouts = {row.values["layout"]: row.layout for row in rows}
        judged = sa.update(GRANULE).where(
            _C.campaign == self.campaign, _C.path == sa.bindparam("file")
        )
        # By a digest a scan would know a damaged file.
        judged = judged.values(status=sa.bindparam("now"), reason=sa.bindparam("why"), sha256=None)
        with self.transaction() as connection:
            if rows:
                connection.execute(
                    self.upsert(LAYOUT, replacing=False),
                    [{"hash": key, "channels": text} for key, text in layouts.items()],
                )
                connection.execute(self.upsert(GRANULE), [row.values for row in rows])
            for path, why in reasons.items():
                now = Status.REFUSED if why else Status.GOOD
                connection.execute(judged, {"file": path, "now": now.value, "why": why})

    def forget(self, paths: Collection[str]) -> None:
        """Remove the rows of files that are no longer in the archive."""
        gone = sa.delete(GRANULE).where(
            _C.campaign == self.campaign, _C.path == sa.bindparam("gone")
        )
        self.execute(gone, [{"gone": path} for path in paths])

    def store_digests(self, digests: Mapping[str, str]) -> None:
        """Enter the SHA-256 of files, by path."""
        self.execute(*self._digests(digests))

    def _digests(self, digests: Mapping[str, str]) -> tuple[sa.Update, list[dict[str, Any]]]:
        """Return the statement that enters digests, and its rows."""
        statement = (
            sa.update(GRANULE)
            .where(_C.campaign == self.campaign, _C.path == sa.bindparam("file"))
            .values(sha256=sa.bindparam("digest"))
        )
        return statement, [{"file": path, "digest": digest} for path, digest in digests.items()]

    def granules(
        self, *conditions: sa.ColumnElement[bool], status: Status | None = None
    ) -> list[Granule]:
        """Return the granules of the campaign, ordered by instrument, start time and path."""
        conditions += () if status is None else (_C.status == status.value,)
        query = sa.select(*_GRANULE_COLUMNS).where(_C.campaign == self.campaign, *conditions)
        query = query.order_by(_C.instrument, _C.start, _C.path)
        layouts = dict(self.read(sa.select(LAYOUT), lambda row: (row.hash, _layout_from(row[1]))))
        with self.stream(query) as rows:
            return list(self.decoded(_granule_from(row, layouts) for row in rows))

    def granules_of(self, first: int, last: int, *, dark_days: int) -> list[Granule]:
        """Return good granules that start on days `first` to `last`, and dark ones around them.

        Parameters
        ----------
        first, last : int
            Days since 1970-01-01, both included.
        dark_days : int
            Days before `first` and after `last` from which dark granules are included.
        """
        near = _C.day.between(first - dark_days, last + dark_days)
        on_days = _C.day.between(first, last)
        role = sa.or_(on_days, _C.role == Role.DARK.value)
        return self.granules(near, role, status=Status.GOOD)

    def refused(self) -> list[Granule]:
        """Return the granules that the catalog refuses."""
        return self.granules(status=Status.REFUSED)

    def reasons(self) -> dict[str, str]:
        """Return why the catalog refuses granules, by path."""
        query = sa.select(_C.path, _C.reason)
        query = query.where(_C.campaign == self.campaign, _C.status == Status.REFUSED.value)
        return dict(self.read(query, tuple))

    def files_in(self, folder: str) -> list[DatedFile]:
        """Return the files with headers in a folder itself; of the archive where it is empty."""
        columns = (_C.path, _C.instrument, _C.role, _C.start, _C.format, _C.reason)
        # Of no other file a scan knows the stop.
        known = _C.campaign == self.campaign, _C.stop.is_not(None)
        begin = f"{folder}/" if folder else ""
        with self.stream(sa.select(*columns).where(*known, *_below(folder))) as rows:
            return [
                DatedFile(path, instrument, _ROLES[role], *others)
                for path, instrument, role, *others in self.decoded(rows)
                if "/" not in path[len(begin) :]
            ]

    def nearest_days(self, folder: str, instrument: str) -> list[datetime]:
        """Return when the first good signal file of each day starts, of those below a folder.

        Of the first folder above it that holds some, where it holds none.
        """
        query = (
            sa.select(sa.func.min(_C.start))
            .where(*self._good(Role.SIGNAL), *_below(folder), _C.instrument == instrument)
            .group_by(_C.day)
        )
        days = sorted(start for (start,) in self.read(query, tuple))
        if days or not folder:
            return days
        return self.nearest_days(folder.rpartition("/")[0], instrument)

    def _good(self, role: Role | None = None) -> list[sa.ColumnElement[bool]]:
        conditions = [_C.campaign == self.campaign, _C.status == Status.GOOD.value]
        return conditions if role is None else [*conditions, _C.role == role.value]

    def count(self, *conditions: sa.ColumnElement[bool]) -> int:
        """Return the number of granules."""
        query = sa.select(sa.func.count()).where(_C.campaign == self.campaign, *conditions)
        return int(self.read(query, tuple)[0][0])

    def day_sums(self) -> list[DaySum]:
        """Return the sums of the stamps of good granules by day and role."""
        sums = sa.func.count(), sa.func.sum(_C.stamp_low), sa.func.sum(_C.stamp_high)
        query = (
            sa.select(_C.day, _C.role, *sums)
            .where(*self._good())
            .group_by(_C.day, _C.role)
            .order_by(_C.day, _C.role)
        )
        return self.read(
            query, lambda row: DaySum(row[0], Role(row[1]), row[2], int(row[3]), int(row[4]))
        )

    def holdings(self, edges: Sequence[datetime]) -> list[Holding]:
        """Return how many good signal granules hold which channels, by instrument and period.

        Parameters
        ----------
        edges : sequence of datetime
            Ascending times that separate the periods.

        Returns
        -------
        list of Holding
            One per instrument, period and layout of channels.
        """
        begins = [datetime.min.replace(tzinfo=UTC), *edges]
        later = [(_C.start >= edge, k) for k, edge in enumerate(edges, 1)]
        period = sa.case(*reversed(later), else_=0) if later else sa.literal_column("0")
        signal = (
            sa.select(_C.instrument, period.label("period"), _C.layout, _C.start)
            .where(*self._good(Role.SIGNAL))
            .subquery()
        )
        *columns, start = signal.c
        groups = (
            sa.select(*columns, sa.func.count().label("files"), sa.func.min(start).label("first"))
            .group_by(*columns)
            .subquery()
        )
        query = (
            sa.select(groups, LAYOUT.c.channels)
            .join(LAYOUT, LAYOUT.c.hash == groups.c.layout)
            .order_by(groups.c.instrument, groups.c.period, groups.c.layout)
        )
        return [
            Holding(name, begins[k], _layout_from(text), files, first)
            for name, k, _, files, first, text in self.read(query, tuple)
        ]

    def channel_names(self) -> Mapping[str, Names]:
        """Return the names that recorders have for good, by instrument."""
        query = sa.select(CHANNEL_NAME).where(CHANNEL_NAME.c.campaign == self.campaign)
        names: dict[str, dict[Any, str]] = defaultdict(dict)
        for row, recorder in self.read(query, lambda row: (row, json.loads(row.recorder))):
            names[row.instrument][tuple(recorder)] = row.name
        return names

    def bind_channel_names(self) -> None:
        """Enter names for recorders without one; they stay when files are forgotten."""
        held: dict[str, list[Any]] = defaultdict(list)
        for holding in self.holdings(()):
            held[holding.instrument].append((holding.layout, holding.files, holding.first))
        bound, ours = self.channel_names(), {"campaign": self.campaign}
        rows = [
            {**ours, "instrument": instrument, "name": name, "recorder": json.dumps(recorder)}
            for instrument, files in held.items()
            for recorder, name in recorder_names(files, bound=bound.get(instrument)).items()
        ]
        self.execute(self.upsert(CHANNEL_NAME, replacing=False), rows)

    def days_of_instruments(
        self, first: int | None = None, last: int | None = None
    ) -> dict[str, tuple[int, int]]:
        """Return the first and the last day with good signal granules, by instrument.

        Parameters
        ----------
        first, last : int, optional
            Days outside of these do not count.
        """
        query = sa.select(_C.instrument, sa.func.min(_C.day), sa.func.max(_C.day))
        query = query.where(*self._good(Role.SIGNAL)).group_by(_C.instrument)
        limits = [] if first is None else [_C.day >= first]
        limits += [] if last is None else [_C.day <= last]
        return {name: (begin, end) for name, begin, end in self.read(query.where(*limits), tuple)}

    def file_notes(self, instruments: Collection[str]) -> tuple[FileNote, ...]:
        """Return the notes on good signal granules, contradictions first, then by frequency.

        Parameters
        ----------
        instruments : collection of str
        """
        noted = sa.or_(_C.notes != NO_NOTES, _C.contradictions != NO_NOTES)
        columns = (_C.instrument, _C.notes, _C.contradictions)
        query = sa.select(*columns, sa.func.count()).where(*self._good(Role.SIGNAL), noted)
        rows = self.read(
            query.group_by(*columns),
            lambda row: (row, _sentences(row.notes), _sentences(row.contradictions)),
        )
        return joined_notes(
            FileNote(instrument, text, contradicts, count)
            for (instrument, *_, count), *stored in rows
            if instrument in instruments
            for texts, contradicts in zip(stored, (False, True), strict=True)
            for text in texts
        )

    def paths_by_digest(self, digests: Collection[str]) -> dict[str, str]:
        """Return SHA-256 -> path of the granules with these digests."""
        columns = sa.select(_C.sha256, _C.path).where(_C.campaign == self.campaign)
        rows = self.read_batches(digests, lambda batch: columns.where(_C.sha256.in_(batch)))
        return dict(rows)


_GRANULE_NAMES: Final = tuple(field.name for field in fields(Granule))
_GRANULE_COLUMNS: Final = tuple(_C[name] for name in _GRANULE_NAMES)
_ROLES: Final = {role.value: role for role in Role}
_STATUSES: Final = {status.value: status for status in Status}


def _below(folder: str) -> list[sa.ColumnElement[bool]]:
    # All paths that begin so: "0" follows "/".
    return [_C.path > f"{folder}/", _C.path < f"{folder}0"] if folder else []


def _layout_from(text: str) -> tuple[ChannelLayout, ...]:
    return tuple(
        ChannelLayout(**{**channel, "mode": DetectionMode(channel["mode"])})
        for channel in json.loads(text)
    )


def joined_notes(notes: Iterable[FileNote]) -> tuple[FileNote, ...]:
    """Return notes, contradictions first, then by frequency; equal ones are one.

    So are many that differ by numbers only: notes that state a value of each file would fill the
    report.
    """
    wordings: dict[tuple[str, bool, str], Counter[str]] = defaultdict(Counter)
    for note in notes:
        wording = note.instrument, note.contradicts, without_numbers(note.text)
        wordings[wording][note.text] += note.files
    joined = []
    for (instrument, contradicts, _), texts in wordings.items():
        found = dict(texts)
        if len(texts) > _MOST_VALUES:
            _, text = max((files, text) for text, files in texts.items())
            found = {f"{text}; {len(texts) - 1} other values in other files": texts.total()}
        joined += [FileNote(instrument, text, contradicts, files) for text, files in found.items()]
    joined.sort(key=lambda note: (not note.contradicts, -note.files, note.instrument, note.text))
    return tuple(joined)


def _sentences(stored: str) -> tuple[str, ...]:
    # Skip the parsing for most of the millions of granules.
    return () if stored == NO_NOTES else tuple(json.loads(stored))


def _granule_from(row: Any, layouts: Layouts) -> Granule:
    stored = dict(zip(_GRANULE_NAMES, row, strict=True))
    stored["role"] = _ROLES[stored["role"]]
    stored["status"] = _STATUSES[stored["status"]]
    stored["notes"] = _sentences(stored["notes"])
    stored["contradictions"] = _sentences(stored["contradictions"])
    stored["layout"] = layouts[stored["layout"]]
    return Granule(**stored)
