"""Raw files -> granules: an incremental, header-only scan of an archive."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from lidarops.campaign import Campaign
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, RawFormatError
from lidarops.raw import licel
from lidarops.records import Granule, Role, Status

_BATCH = 2000
_HEADER_BYTES = 16384
_SCAN_VERSION = 1
_FAR_FROM_STATION = 0.5
"""degree; a header position farther than this from the station gets a note."""

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


@dataclass(frozen=True, slots=True)
class RawFile:
    """A file of the archive as the file system lists it."""

    path: str
    size: int
    mtime_ns: int


@dataclass(frozen=True, slots=True)
class _Claim:
    """The files that one role of one instrument claims."""

    instrument: str
    role: Role
    pattern: re.Pattern[str]
    scan_key: str


def scan(campaign: Campaign, store: Store, *, progress: Progress | None = None) -> ScanSummary:
    """Bring the catalog up to date with the archive.

    Only files whose size, modification time or campaign settings changed are opened, and only
    their headers are read. A file that cannot be used becomes a refused granule with a reason.

    Parameters
    ----------
    campaign : Campaign
        With an absolute `archive`, or a URL that fsspec knows.
    store : Store
        The catalog to update.
    progress : callable, optional
        Called with the number of files done since the last call.

    Returns
    -------
    ScanSummary

    Raises
    ------
    CatalogError
        If the archive cannot be listed.
    """
    source = _Source.of(campaign.archive)
    claims = _claims(campaign)
    known = store.fingerprints()
    seen: set[str] = set()
    added = changed = 0

    def fresh() -> Iterator[tuple[Granule, str]]:
        nonlocal added, changed
        for file in source.files():
            owners = [claim for claim in claims if claim.pattern.match(file.path)]
            if not owners:
                continue
            path = _printable(file.path)
            seen.add(path)
            key = "+".join(owner.scan_key for owner in owners)[:16]
            before = known.get(path)
            if before == (file.size, file.mtime_ns, key):
                continue
            added += before is None
            changed += before is not None
            yield _granule(file, owners, campaign, source), key

    pending = fresh()
    while batch := list(islice(pending, _BATCH)):
        store.replace(batch)
        if progress:
            progress(len(batch))
    gone = known.keys() - seen
    store.forget(gone)
    return ScanSummary(
        files=len(seen),
        added=added,
        changed=changed,
        unchanged=len(seen) - added - changed,
        vanished=len(gone),
        refused=len(store.granules(status=Status.REFUSED)),
    )


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
            claims.extend(_Claim(key, role, _regex(pattern), digest) for pattern in patterns)
    return claims


def _regex(pattern: str) -> re.Pattern[str]:
    parts = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    tokens = re.split(r"(\*\*/|\*\*|\*|\?)", pattern)
    return re.compile("".join(parts.get(token, re.escape(token)) for token in tokens) + r"\Z")


def _granule(file: RawFile, owners: list[_Claim], campaign: Campaign, source: _Source) -> Granule:
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
        return replace(granule, reason=f"cannot be read: {error.strerror or error}")


def _printable(path: str) -> str:
    """Return a path that can be stored and shown: names may hold bytes that are no text."""
    return path.encode("utf-8", "backslashreplace").decode()


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


def _listed(entry: os.DirEntry[str], path: str) -> RawFile:
    try:
        about = entry.stat()
    except OSError:
        # A link to nowhere is a file that cannot be read, and must be said to be one.
        return RawFile(path, 0, 0)
    return RawFile(path, about.st_size, about.st_mtime_ns)


class _Source:
    """Where the raw files are: a local folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> _Source:
        return _RemoteSource(archive) if "://" in archive else _Source(Path(archive))

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
                entries = sorted(listing, key=lambda entry: entry.name)
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


class _RemoteSource(_Source):
    """A store behind an fsspec URL."""

    def __init__(self, url: str) -> None:
        import fsspec  # noqa: PLC0415 - most archives are local, and the import takes 0.1 s

        try:
            self._fs, self._prefix = fsspec.core.url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise CatalogError(
                f"the archive's URL cannot be opened: {error}",
                file=url,
                remedy="use a URL that fsspec knows and install its package",
            ) from error
        self._prefix = self._prefix.rstrip("/")

    def files(self) -> Iterator[RawFile]:
        listing = self._fs.find(self._prefix, detail=True)
        for name in sorted(listing):
            about = listing[name]
            path = name.removeprefix(self._prefix).lstrip("/")
            yield RawFile(path, int(about["size"]), _modified(about))

    def head(self, path: str, size: int) -> bytes:
        data: bytes = self._fs.cat_file(f"{self._prefix}/{path}", start=0, end=size)
        return data


def _modified(about: dict[str, Any]) -> int:
    """Return a number that changes when a remote file does."""
    for key in ("mtime", "LastModified", "last_modified", "updated", "created", "ETag", "etag"):
        value = about.get(key)
        if isinstance(value, int | float):
            return int(value * 1e9)
        if value is not None:
            text = value.isoformat() if hasattr(value, "isoformat") else str(value)
            return int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big")
    return 0
