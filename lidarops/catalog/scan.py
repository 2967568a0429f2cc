"""Update the catalog from an archive: an incremental scan that reads only headers."""

from __future__ import annotations

import re
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import chain
from operator import itemgetter
from typing import Final, NamedTuple
from urllib.parse import unquote

from lidarops.campaign.model import Campaign
from lidarops.campaign.path_patterns import path_pattern
from lidarops.catalog.granules import DatedFile, Fingerprint
from lidarops.catalog.raw_files import (
    GranuleRow,
    Headers,
    RemoteSource,
    Source,
    UnreadFile,
    acknowledged_reasons,
    misdated,
    printable,
    read_row,
    unread_row,
)
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, UnavailableError
from lidarops.raw.formats import raw_formats, time_in_path
from lidarops.records import (
    EXPECTED,
    MISDATED,
    UNREADABLE,
    IdlePattern,
    Role,
    Status,
    digest,
)
from lidarops.system.code_version import reading_version
from lidarops.system.processes import CRASHED, Processes
from lidarops.system.stores import Stored, without_keys

_BATCH = 2000
_TOGETHER = 250
"""Headers in one batch for a process."""
_WORTH_PROCESSES = 5000
"""Least number of headers to read for which further processes are started."""
_MOST_PROCESSES = 8
"""Further processes would wait for the one that writes the catalog."""

_FACTS_OF_HEADERS: Final = {
    "valid_from", "valid_to", "invalid", "zenith_angle", "azimuth", "clock_offset"
}  # fmt: skip
"""Facts on which the granule of a file depends."""

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """Numbers of files in a scan."""

    files: int
    added: int
    changed: int
    unchanged: int
    vanished: int
    refused: int
    """Refused granules in the whole catalog, not only the new ones; without those of periods that
    the campaign declares invalid."""
    moved: int = 0
    """Files with a new path and known content; they count neither as added nor as vanished."""
    idle_patterns: tuple[IdlePattern, ...] = ()
    """Patterns of the campaign that match no file."""


class _Claim(NamedTuple):
    """A file pattern of one role of one instrument."""

    instrument: str
    role: Role
    folder: re.Pattern[str] | None
    name: re.Pattern[str]
    """Pattern of the path after the folder; of the whole path if `folder` is None."""
    pattern: str
    scan_key: str


def scan_archive(
    campaign: Campaign,
    store: Store,
    *,
    progress: Progress | None = None,
    before_write: Callable[[], object] | None = None,
    workers: int = 1,
) -> ScanSummary:
    """Update the catalog from the archive.

    Only files whose size, modification time or campaign settings changed are opened, or all if the
    code that reads them changed. Of these, only the header is read; the whole file is read only if
    a product was made from it or it may have moved, to compare the content. An unusable file
    becomes a refused granule with a reason; so does one whose date contradicts those of its folder,
    as long as they do. If nothing changed, nothing is written. Memory grows with the number of
    changed files, not with the archive.

    Parameters
    ----------
    campaign : Campaign
        Its `archive` is an absolute path, or a URL that fsspec knows.
    store : Store
        The catalog to update.
    progress : callable, optional
        Called with the number of files done since the last call.
    before_write : callable, optional
        Called before anything is written; it may raise an error to prevent this.
    workers : int, optional
        Largest number of local processes that read headers, used if thousands of files are new or
        changed; does not affect the catalog. Headers behind a URL are read by this process.

    Raises
    ------
    CatalogError
        If the archive cannot be listed, or if it holds no claimed file although the catalog knows
        some; the catalog then stays unchanged.
    """
    work = _Scan(campaign, store, progress, before_write)
    headers = Headers(work.source, campaign, store.campaign)
    crashed = partial(unread_row, headers, reason=CRASHED)
    with (
        store.fingerprints() as known,
        Processes(min(workers, _MOST_PROCESSES), headers) as readers,
    ):
        # Of no other file is the size requested.
        listed = work.source.files(lambda path: bool(work.owners(path)))
        due = work.due(_joined(listed, known))
        if isinstance(work.source, RemoteSource):
            rows = work.source.map(partial(read_row, headers), due)
        else:
            pairs = readers.map_items(
                read_row, due, at_a_time=_TOGETHER, fewest=_WORTH_PROCESSES, lost=crashed
            )
            rows = map(itemgetter(1), pairs)
        for row in rows:
            work.enter(row)
    return work.finish()


def _joined(
    files: Iterator[Stored], known: Iterator[Fingerprint]
) -> Iterator[tuple[Stored | None, Fingerprint | None]]:
    """Pair the files of the archive with those of the catalog; both are sorted by path."""
    before, last = next(known, None), None
    for file in chain(files, [None]):
        path = None if file is None else printable(file.path)
        while before is not None and (path is None or before.path < path):
            yield None, before
            before = next(known, None)
        if before is not None and before.path == path:
            yield file, before
            before = next(known, None)
        # The printable form of a name that is not UTF-8 may equal another path.
        elif file is not None and path != last:
            yield file, None
        last = path


class _Scan:
    """One pass over an archive."""

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        progress: Progress | None,
        before_write: Callable[[], object] | None,
    ) -> None:
        self.source = Source.of(campaign.archive)
        self._campaign = campaign
        self._archive = campaign.archive
        self._store = store
        self._progress = progress or (lambda _: None)
        self._write = before_write or (lambda: None)
        self._claims = _claims(campaign)
        self._folder: str | None = None
        self._near: list[_Claim] = []
        self._idle = set(self._claims)
        self._files = self._changed = 0
        self._judged: deque[Fingerprint | None] = deque()
        self._pending: dict[str, list[GranuleRow]] = defaultdict(list)
        """Rows to write, by the folder that must be listed before because names in it count."""
        self._held = 0
        # With an empty catalog, no new file can be a moved one.
        self._new: set[str] | None = set() if store.count() else None
        self._added = 0
        self._gone: dict[str, Fingerprint] = {}
        self._readable = False
        """Whether a file could be read, now or when the catalog got to know it."""

    def due(
        self, pairs: Iterable[tuple[Stored | None, Fingerprint | None]]
    ) -> Iterator[UnreadFile]:
        """Compare each file with the catalog, and yield those whose header must be read."""
        for file, before in pairs:
            owners = [] if file is None else self.owners(file.path)
            if self._idle:
                self._idle.difference_update(owners)
            if file is None or not owners:
                if before is not None:
                    self._gone[before.path] = before
                continue
            self._files += 1
            if self._files % _BATCH == 0:
                self._progress(_BATCH)
            key, *others = [owner.scan_key for owner in owners]
            if others:
                key = digest([key, *others])[:16]
            if before is None or not self._is_known(before, file, key):
                self._judged.append(before)
                first = owners[0].instrument
                rivals = sorted({claim.instrument for claim in owners} - {first})
                yield UnreadFile(file, first, owners[0].role, tuple(rivals), key)
            else:
                self._readable = True

    def _is_known(self, before: Fingerprint, file: Stored, key: str) -> bool:
        """Return whether the catalog holds what a file is; a damaged one may have been repaired."""
        known = before.size, before.mtime_ns, before.scan_key
        same = known == (file.size, file.mtime_ns, key)
        return same and (not before.is_damaged or self._digest(file.path) == before.sha256)

    def owners(self, path: str) -> list[_Claim]:
        """Return the claims of instruments on a path."""
        # The index of a web server encodes names: "+45" is "%2B45".
        encoded = "%" in path and self._archive.startswith(("http://", "https://"))
        owners: list[_Claim] = []
        for plain in (path, unquote(path)) if encoded else (path,):
            folder, slash, name = plain.rpartition("/")
            if folder + slash != self._folder:
                self._folder = folder + slash
                self._near = [
                    claim
                    for claim in self._claims
                    if claim.folder is None or claim.folder.match(self._folder)
                ]
            owners = owners or [
                claim
                for claim in self._near
                if claim.name.match(plain if claim.folder is None else name)
            ]
        return owners

    def enter(self, row: GranuleRow) -> None:
        """Enter the row of the next file in `due`, unless it is unchanged."""
        before = self._judged.popleft()
        values = row.values
        self._readable |= not values["reason"].startswith(UNREADABLE)
        if before is None:
            self._added += 1
            if self._new is not None:
                self._new.add(values["path"])
        elif (before.stamp_low, before.stamp_high) == (values["stamp_low"], values["stamp_high"]):
            return
        else:
            # Read a whole file only if a product was made from it.
            was_used = before.sha256 is not None and not before.is_damaged
            readable = was_used and values["status"] == Status.GOOD
            same = readable and self._digest(values["path"]) == before.sha256
            # The processing checks any other content.
            values["sha256"] = before.sha256 if same else None
            self._changed += not (same and before.scan_key == values["scan_key"])
            # The time of a file that was good is known, also if its name tells none. The stamps
            # leave it out, so that a scan that knows no more writes nothing.
            values["start"] = values["start"] or before.start
        known = values["format"] or (before.format if before else "")
        self._pending[_counted_in(values["path"], known)].append(row)
        self._held += 1
        if self._held >= _BATCH and self._readable:
            self._flush(f"/{values['path']}")

    def _digest(self, path: str) -> str | None:
        try:
            return self.source.digest(path)
        except OSError:
            return None

    def _flush(self, path: str = "") -> None:
        """Write rows; before the end of the scan not those of folders that hold a path."""
        self._held = 0
        done = [folder for folder in self._pending if not (folder and path.startswith(folder))]
        rows: list[GranuleRow] = []
        reasons: dict[str, str] = {}
        for folder in done:
            own = self._pending.pop(folder)
            rows += own
            reasons |= self._misdated(folder, own) if folder else {}
        if rows or reasons:
            self._write()
            self._store.replace(rows, reasons)

    def _misdated(self, folder: str, rows: Sequence[GranuleRow]) -> dict[str, str]:
        """Refuse misdated rows of a folder; return path -> new reason of known files."""
        new = {row.values["path"]: row.values for row in rows}
        known = [
            file
            for file in self._store.files_in(folder.strip("/"))
            if file.path not in new and file.path not in self._gone
        ]
        read = (
            DatedFile(*(values[name] for name in DatedFile._fields))
            for values in new.values()
            if values["stop"]
        )
        starts: dict[tuple[str, str], dict[str, datetime]] = defaultdict(dict)
        for file in (*known, *read):
            if _counted_in(file.path, file.format):
                starts[file.instrument, file.role][file.path] = file.start
        reasons = {path: why for own in starts.values() for path, why in misdated(own).items()}
        for path in new.keys() & reasons.keys():
            new[path].update(status=Status.REFUSED.value, reason=reasons[path], sha256=None)
        return {
            file.path: reasons.get(file.path, "")
            for file in known
            if file.reason.startswith(MISDATED if file.reason else "")
            and file.reason != reasons.get(file.path, "")
        }

    def finish(self) -> ScanSummary:
        """Write the remaining rows, and return the numbers."""
        if self._gone and not self._files:
            raise self._emptied()
        if self._files > 1 and not self._readable:
            raise UnavailableError(
                f"gives none of its {self._files} files; the catalog stays unchanged",
                file=without_keys(self._archive),
                field="archive",
                remedy="check the keys and permissions with which lidarops reads it",
            )
        for path, before in self._gone.items():
            # What a file is compared with may be gone.
            self._pending[_counted_in(path, before.format)] += []
        self._flush()
        moved = self._moved()
        if moved:
            self._write()
            self._store.store_digests(moved)
        if self._gone:
            self._write()
            self._store.forget(self._gone)
        if self._added or self._changed or self._gone:
            self._store.bind_channel_names()
        self._progress(self._files % _BATCH)
        added = self._added - len(moved)
        reasons = acknowledged_reasons(self._campaign, self._store.reasons())
        return ScanSummary(
            files=self._files,
            added=added,
            changed=self._changed,
            unchanged=self._files - added - self._changed - len(moved),
            vanished=len(self._gone) - len(moved),
            refused=sum(not reason.startswith(EXPECTED) for reason in reasons.values()),
            moved=len(moved),
            idle_patterns=tuple(
                IdlePattern(
                    claim.instrument,
                    "dark_files" if claim.role is Role.DARK else "files",
                    claim.pattern,
                )
                for claim in self._claims
                if claim in self._idle
            ),
        )

    def _emptied(self) -> CatalogError:
        # This is how an unmounted disk looks.
        return UnavailableError(
            "holds no file that an instrument of the campaign claims, although the catalog knows"
            f" {len(self._gone)}; the catalog stays unchanged",
            file=without_keys(self._archive),
            field="archive",
            remedy="check that it is mounted, that it is the archive of this campaign, and that"
            " files and dark_files match; if it was emptied on purpose, use another catalog, or"
            f" move {self._store.place} away if it holds no other campaign",
        )

    def _moved(self) -> dict[str, str]:
        """Return path -> SHA-256 of new files with the content of a vanished one."""
        lost: dict[tuple[int, datetime | None], Counter[str]] = defaultdict(Counter)
        for before in self._gone.values():
            if before.sha256:
                lost[before.size, before.start][before.sha256] += 1
        moved: dict[str, str] = {}
        if not (lost and self._new):
            return moved
        with self._store.without_digest() as rows:
            for path, size, start in rows:
                candidates = lost.get((size, start)) if path in self._new else None
                digest = self._digest(path) if candidates else None
                if candidates and digest and candidates[digest] > 0:
                    candidates[digest] -= 1
                    moved[path] = digest
        return moved


def _counted_in(path: str, known: str) -> str:
    """Return the folder, between slashes, of a file whose name only counts; else nothing."""
    if known not in raw_formats() or time_in_path(path, known) is not None:
        return ""
    return f"/{path}".rpartition("/")[0] + "/"


def _claims(campaign: Campaign) -> list[_Claim]:
    claims: list[_Claim] = []
    version = reading_version()
    for key, instrument in campaign.instruments.items():
        station = campaign.stations[instrument.station]
        for role, patterns in (
            (Role.DARK, instrument.dark_files),
            (Role.SIGNAL, instrument.files),
        ):
            settings = [
                version,
                key,
                role.value,
                patterns,
                instrument.header_position,
                instrument.header_pointing,
                instrument.name_times,
                instrument.position_tolerance,
                instrument.altitude_tolerance,
                station.model_dump(),
                [
                    fact.model_dump(mode="json", include=_FACTS_OF_HEADERS)
                    for fact in instrument.facts
                ],
            ]
            scan_key = digest(settings)[:16]
            for pattern in patterns:
                folder, slash, name = pattern.rpartition("/")
                # Files of a folder share the first. But "**" also matches files in subfolders.
                whole = "**" in name
                begin = None if whole else path_pattern(folder + slash)
                end = path_pattern(pattern if whole else name)
                claims.append(_Claim(key, role, begin, end, pattern, scan_key))
    return claims
