"""Raw files -> granules: an incremental, header-only scan of an archive."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from lidarops.campaign import Campaign
from lidarops.catalog.granules import AGAIN, Fingerprint, stamp_of
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, RawFormatError
from lidarops.raw import licel
from lidarops.records import Granule, Role, Status
from lidarops.stores import RemoteStore

_BATCH = 2000
_HEADER_BYTES = 16384
_SCAN_VERSION = 1
_FAR_FROM_STATION = 0.5
"""degree; a header position farther than this from the station gets a note."""

_UNREADABLE = "cannot be read"

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """What a scan found."""

    files: int
    added: int
    changed: int
    unchanged: int
    vanished: int
    refused: int
    """Refused granules in the whole catalog, not only the new ones."""
    moved: int = 0
    """Files under a new path whose content was known: neither added nor vanished."""


class RawFile(NamedTuple):
    """A file of the archive as the file system lists it."""

    path: str
    size: int
    mtime_ns: int


@dataclass(frozen=True, slots=True)
class _Claim:
    """The files that one role of one instrument claims."""

    instrument: str
    role: Role
    folder: re.Pattern[str] | None
    name: re.Pattern[str]
    """Of the rest of the path behind the folder; of the whole path where `folder` is None."""
    scan_key: str


def scan(
    campaign: Campaign,
    store: Store,
    *,
    progress: Progress | None = None,
    before_write: Callable[[], object] | None = None,
) -> ScanSummary:
    """Bring the catalog up to date with the archive.

    Only files whose size, modification time or campaign settings changed are opened. Of these
    the headers are read, and the whole file only to tell whether the content that a product was
    made from has changed or has moved. A file that cannot be used becomes a refused granule with
    a reason. Where nothing changed, nothing is written. Memory does not grow with the archive,
    but with what changed in it.

    Parameters
    ----------
    campaign : Campaign
        With an absolute `archive`, or a URL that fsspec knows.
    store : Store
        The catalog to update.
    progress : callable, optional
        Called with the number of files done since the last call.
    before_write : callable, optional
        Called before anything is written; may raise to prevent it.

    Returns
    -------
    ScanSummary

    Raises
    ------
    CatalogError
        If the archive cannot be listed.
    """
    work = _Scan(campaign, store, progress, before_write)
    with store.fingerprints() as known:
        for file, before in _joined(work.source.files(), known):
            work.compare(file, before)
    return work.finish()


def _joined(
    files: Iterator[RawFile], known: Iterator[Fingerprint]
) -> Iterator[tuple[RawFile | None, Fingerprint | None]]:
    """Pair what the file system lists with what the catalog knows; both come by path."""
    before = next(known, None)
    last = None
    for file in files:
        path = _printable(file.path)
        if path == last:
            # A name that is no text and looks like another one's text: it has its own refusal.
            continue
        last = path
        while before is not None and before.path < path:
            yield None, before
            before = next(known, None)
        if before is not None and before.path == path:
            yield file, before
            before = next(known, None)
        else:
            yield file, None
    while before is not None:
        yield None, before
        before = next(known, None)


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
        self._store = store
        self._progress = progress
        self._before_write = before_write
        self._claims = _claims(campaign)
        self._folder: str | None = None
        self._near: list[_Claim] = []
        self._files = self._changed = 0
        self._told = 0
        self._pending: list[tuple[Granule, str]] = []
        self._added = 0
        self._gone: list[Fingerprint] = []

    def compare(self, file: RawFile | None, before: Fingerprint | None) -> None:
        """Judge one file, by what is there and what was known of it."""
        owners = [] if file is None else self._owners(file.path)
        if file is None or not owners:
            if before is not None:
                self._gone.append(before)
            return
        self._files += 1
        if self._files % _BATCH == 0:
            self._tell()
        key = _key(owners)
        if before is None or (before.size, before.mtime_ns, before.scan_key) != (
            file.size,
            file.mtime_ns,
            key,
        ):
            self._enter(_granule(file, owners, self._campaign, self.source), key, before)

    def _owners(self, path: str) -> list[_Claim]:
        folder, slash, name = path.rpartition("/")
        if folder + slash != self._folder:
            self._folder = folder + slash
            self._near = [
                claim
                for claim in self._claims
                if claim.folder is None or claim.folder.match(self._folder)
            ]
        return [
            claim
            for claim in self._near
            if claim.name.match(path if claim.folder is None else name)
        ]

    def _enter(self, granule: Granule, key: str, before: Fingerprint | None) -> None:
        if granule.reason.startswith(_UNREADABLE):
            key = AGAIN
        if before is None:
            self._added += 1
        elif (before.stamp_low, before.stamp_high) == stamp_of(granule, key):
            return
        else:
            # Only a content that a product was made from is worth reading whole.
            readable = before.sha256 and granule.status is Status.GOOD
            digest = self._digest(granule.path) if readable else None
            granule = replace(granule, sha256=digest)
            same = digest is not None and digest == before.sha256
            self._changed += not (same and before.scan_key == key)
        self._pending.append((granule, key))
        if len(self._pending) >= _BATCH:
            self._flush()

    def _digest(self, path: str) -> str | None:
        try:
            return self.source.digest(path)
        except OSError:
            return None

    def _flush(self) -> None:
        if not self._pending:
            return
        self._write()
        self._store.replace(self._pending)
        self._pending.clear()

    def _write(self) -> None:
        if self._before_write is not None:
            self._before_write()

    def _tell(self) -> None:
        if self._progress and self._files > self._told:
            self._progress(self._files - self._told)
        self._told = self._files

    def finish(self) -> ScanSummary:
        """Write what is left, and sum up."""
        self._flush()
        moved = self._moved()
        if moved:
            self._write()
            self._store.store_digests(moved)
        if self._gone:
            self._write()
            self._store.forget([before.path for before in self._gone])
        self._tell()
        added = self._added - len(moved)
        return ScanSummary(
            files=self._files,
            added=added,
            changed=self._changed,
            unchanged=self._files - added - self._changed - len(moved),
            vanished=len(self._gone) - len(moved),
            refused=self._store.count(status=Status.REFUSED),
            moved=len(moved),
        )

    def _moved(self) -> dict[str, str]:
        """Return path -> sha256 of new files that hold what a vanished one held."""
        lost: dict[tuple[int, datetime | None], Counter[str]] = defaultdict(Counter)
        for before in self._gone:
            if before.sha256:
                lost[before.size, before.start][before.sha256] += 1
        found: dict[str, str] = {}
        if not (lost and self._added):
            return found
        with self._store.unread() as rows:
            for path, size, start in rows:
                candidates = lost.get((size, start))
                digest = self._digest(path) if candidates else None
                if candidates and digest and candidates[digest] > 0:
                    candidates[digest] -= 1
                    found[path] = digest
        return found


def _claims(campaign: Campaign) -> list[_Claim]:
    claims: list[_Claim] = []
    for key, instrument in campaign.instruments.items():
        station = campaign.stations[instrument.station]
        for role, patterns in (
            (Role.DARK, instrument.dark_files),
            (Role.SIGNAL, instrument.files),
        ):
            settings = [
                _SCAN_VERSION,
                key,
                role.value,
                patterns,
                instrument.header_position,
                station.model_dump(),
                [
                    (str(fact.valid_from), fact.zenith_angle, fact.azimuth)
                    for fact in instrument.facts
                ],
            ]
            digest = hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:16]
            claims.extend(_Claim(key, role, *_parts(pattern), digest) for pattern in patterns)
    return claims


def _parts(pattern: str) -> tuple[re.Pattern[str] | None, re.Pattern[str]]:
    """Split a pattern, as the files of a folder share what is before their names."""
    folder, slash, name = pattern.rpartition("/")
    if "**" in name:
        # Such a name reaches into folders below.
        return None, _regex(pattern)
    return _regex(folder + slash), _regex(name)


def _key(owners: list[_Claim]) -> str:
    if len(owners) == 1:
        return owners[0].scan_key
    return hashlib.sha256("+".join(owner.scan_key for owner in owners).encode()).hexdigest()[:16]


def _regex(pattern: str) -> re.Pattern[str]:
    parts = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    tokens = re.split(r"(\*\*/|\*\*|\*|\?)", pattern)
    return re.compile("".join(parts.get(token, re.escape(token)) for token in tokens) + r"\Z")


def _granule(file: RawFile, owners: list[_Claim], campaign: Campaign, source: Source) -> Granule:
    owner = owners[0]
    # Refused until its header has been read.
    granule = Granule(
        path=_printable(file.path),
        size=file.size,
        mtime_ns=file.mtime_ns,
        instrument=owner.instrument,
        role=owner.role,
        status=Status.REFUSED,
    )
    if granule.path != file.path:
        return replace(granule, reason="has a name that is not UTF-8 (rename it)")
    rivals = sorted({claim.instrument for claim in owners} - {owner.instrument})
    if rivals:
        claimants = f"{owner.instrument} and {', '.join(rivals)}"
        return replace(
            granule,
            reason=f"claimed by instruments {claimants} (make their patterns disjoint)",
        )
    try:
        header = licel.parse_header(
            source.head(file.path, _HEADER_BYTES), file=file.path, size=file.size
        )
        return _accept(granule, header, campaign)
    except RawFormatError as error:
        return replace(granule, reason=str(error).removeprefix(f"{file.path}: "))
    except OSError as error:
        return replace(granule, reason=f"{_UNREADABLE}: {error.strerror or error}")


def _printable(path: str) -> str:
    """Return a path that can be stored and shown: names may hold bytes that are no text."""
    return path if path.isascii() else path.encode("utf-8", "backslashreplace").decode()


def _accept(granule: Granule, header: licel.Header, campaign: Campaign) -> Granule:
    instrument = campaign.instruments[granule.instrument]
    station = campaign.stations[instrument.station]
    facts = instrument.facts_at(header.start)
    notes = list(header.notes)
    latitude, longitude = station.latitude, station.longitude
    if instrument.header_position != "ignore":
        latitude, longitude = header.position(instrument.header_position)
        away = max(abs(latitude - station.latitude), abs(longitude - station.longitude))
        if away > _FAR_FROM_STATION:
            notes.append(_position_note(latitude, longitude, station.latitude, station.longitude))
    return replace(
        granule,
        status=Status.GOOD,
        notes=tuple(notes),
        start=header.start,
        stop=header.stop,
        zenith_angle=header.zenith_angle if facts.zenith_angle is None else facts.zenith_angle,
        azimuth=header.azimuth if facts.azimuth is None else facts.azimuth,
        latitude=latitude,
        longitude=longitude,
        altitude=header.altitude,
        layout=licel.layout(header),
    )


def _position_note(latitude: float, longitude: float, north: float, east: float) -> str:
    swapped = max(abs(longitude - north), abs(latitude - east)) <= _FAR_FROM_STATION
    remedy = (
        "they look swapped: set header_position of the instrument"
        if swapped
        else "the campaign's position is used; header_position: ignore silences this"
    )
    return (
        f"header position {latitude:.1f} N {longitude:.1f} E is not the station's"
        f" {north:.1f} N {east:.1f} E ({remedy})"
    )


def _rank(entry: os.DirEntry[str]) -> str:
    """Return what puts entries into the order that the paths of their files have."""
    name = _printable(entry.name)
    return f"{name}/" if entry.is_dir(follow_symlinks=False) else name


def _listed(entry: os.DirEntry[str], path: str) -> RawFile:
    try:
        about = entry.stat()
    except OSError:
        # A link to nowhere is a file that cannot be read, and must be said to be one.
        return RawFile(path, 0, 0)
    return RawFile(path, about.st_size, about.st_mtime_ns)


class Source:
    """Where the raw files are: a local folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> Source:
        """Return the source of an archive, by its folder or URL."""
        return RemoteSource(archive) if "://" in archive else Source(Path(archive))

    def files(self) -> Iterator[RawFile]:
        """List files in the order of their paths, whatever the file system's own."""
        if not self._root.is_dir():
            raise CatalogError(
                "the archive is not a folder",
                file=self._root,
                remedy="set archive in the campaign file, --archive or LIDAROPS_ARCHIVE",
            )
        yield from self._walk(str(self._root), "")

    def _walk(self, folder: str, prefix: str) -> Iterator[RawFile]:
        try:
            with os.scandir(folder) as listing:
                entries = sorted(listing, key=_rank)
        except OSError as error:
            raise CatalogError(
                f"cannot be listed: {error.strerror}", file=folder, remedy="check its permissions"
            ) from error
        for entry in entries:
            path = f"{prefix}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                yield from self._walk(entry.path, f"{path}/")
            else:
                yield _listed(entry, path)

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file."""
        file = self._root / path
        # Opening a pipe would wait for ever.
        if not file.is_file():
            raise OSError(errno.EINVAL, "is no regular file, or a link to nowhere")
        with file.open("rb", buffering=0) as stream:
            return stream.read(size)

    def digest(self, path: str) -> str:
        """Return the sha256 of a file."""
        file = self._root / path
        if not file.is_file():
            raise OSError(errno.EINVAL, "is no regular file, or a link to nowhere")
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()


class RemoteSource(Source):
    """A store behind an fsspec URL."""

    def __init__(self, url: str) -> None:
        self._store = RemoteStore(url)

    def files(self) -> Iterator[RawFile]:
        """List files in the order of their paths."""
        for stored in self._store.files():
            yield RawFile(stored.path, stored.size, stored.stamp)

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file."""
        with _of_one_file():
            return self._store.head(path, size)

    def digest(self, path: str) -> str:
        """Return the sha256 of a file."""
        with _of_one_file():
            return self._store.digest(path)


@contextmanager
def _of_one_file() -> Iterator[None]:
    """Tell a file that cannot be read, which is refused, from a store that is away."""
    try:
        yield
    except CatalogError as error:
        if isinstance(error.__cause__, FileNotFoundError | PermissionError):
            raise error.__cause__ from error
        raise
