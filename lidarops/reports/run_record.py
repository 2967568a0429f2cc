"""The run record as JSON (``run.json``): what a run did, stored beside its report.

Until it is there, a journal holds the scenes of the run as they end.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from lidarops.errors import NO_FILE, CatalogError, UnavailableError
from lidarops.records import RunRecord, SceneOutcome
from lidarops.reports.json_records import MismatchError, from_plain, plain
from lidarops.system.files import write_atomically

FILE_NAME: Final = "run.json"
"""Name of the record inside a run's report folder."""

JOURNAL: Final = "scenes.jsonl"
"""Name of the journal beside it; gone once the record is saved."""
INDEX: Final = "index.html"
"""Name of the page beside it."""
_FORMAT: Final = "lidarops run record"
_VERSION: Final = 9
_REMEDY: Final = "give a run's report folder or its run.json, or run the campaign again"

_LOG = logging.getLogger(__name__)


def save_run_record(record: RunRecord, folder: Path) -> Path:
    """Write a run record to ``run.json`` in `folder` atomically.

    Parameters
    ----------
    record : RunRecord
        Its settings must be plain JSON types, see `lidarops.records`.
    folder : Path
        Report folder of the run; created if missing.

    Returns
    -------
    Path
        The file. `load_run_record` reads an equal record; tuples in settings become lists.

    Raises
    ------
    CatalogError
        If the folder cannot be written, or a setting is not a plain JSON type.
    """
    target = Path(folder) / FILE_NAME
    document = {"format": _FORMAT, "version": _VERSION, "record": plain(record)}
    try:
        text = json.dumps(document, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise CatalogError(
            f"the run record holds a value that JSON cannot hold: {error}",
            file=target,
            field="settings",
            remedy="use only text, finite numbers, booleans, lists and mappings in settings",
        ) from error
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, text.encode("ascii"))
    except OSError as error:
        raise UnavailableError(
            f"cannot be written: {error}",
            file=target,
            remedy="make space, then run again, which makes the report; or lidarops report"
            f" {target.parent}",
        ) from error
    (target.parent / JOURNAL).unlink(missing_ok=True)
    return target


def exists(folder: Path) -> bool:
    """Return whether a report folder holds the record of a run, or its journal."""
    return any((folder / name).exists() for name in (FILE_NAME, JOURNAL))


def load_run_record(path: str | Path) -> RunRecord:
    """Read a run record that `save_run_record` wrote.

    Parameters
    ----------
    path : path or str
        The run's report folder, or the ``run.json`` in it.

    Returns
    -------
    RunRecord
        Equal to the saved record; if there is none, as far as the journal of the run reaches.

    Raises
    ------
    CatalogError
        If the file is missing, damaged or not exactly a run record (a wrong type, an unknown
        or a missing field). States the file, the field and what was expected.
    """
    path = Path(path)
    journal = (path if path.is_dir() else path.parent) / JOURNAL
    path = path / FILE_NAME if path.is_dir() else path
    if journal.exists() and not path.exists():
        return _load_journal(journal)
    try:
        document = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except OSError as error:
        is_missing = isinstance(error, NO_FILE)
        raise CatalogError(
            f"cannot be read: {error}", file=path, remedy=_REMEDY, wrong_use=is_missing
        ) from error
    except (ValueError, RecursionError) as error:
        raise CatalogError(f"is not a JSON document: {error}", file=path, remedy=_REMEDY) from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise CatalogError("is not a lidarops run record", file=path, remedy=_REMEDY)
    if document.get("version") != _VERSION:
        raise CatalogError(
            f"has version {document.get('version')!r}, but this lidarops reads {_VERSION}",
            file=path,
            field="version",
            remedy="use the lidarops version that wrote it, or run the campaign again",
        )
    try:
        record = from_plain(RunRecord, document.get("record"), "record")
    except MismatchError as error:
        raise CatalogError(
            f"expected {error.expected}", file=path, field=error.place, remedy=_REMEDY
        ) from error
    return record


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


class Journal:
    """Writes the journal of a run; where the disk refuses it, the run goes on without one.

    Parameters
    ----------
    folder : Path
        Report folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._refused = False

    def write(self, entry: RunRecord | SceneOutcome) -> None:
        """Write the record of a run that has no scenes yet, or a scene that has ended."""
        if self._refused:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with (self._folder / JOURNAL).open("a", encoding="ascii") as stream:
                stream.write(json.dumps(plain(entry)) + "\n")
        except OSError as error:
            self._refused = True
            _LOG.warning("no report could be made of this run if it died now: %s", error)


def _load_journal(file: Path) -> RunRecord:
    """Return the record of a run that ended without one, as far as its journal reaches.

    Raises
    ------
    CatalogError
        If the file cannot be read or is no journal.
    """
    try:
        head, *lines = file.read_text(encoding="ascii").splitlines()
        record = from_plain(RunRecord, json.loads(head), "record")
        written = datetime.fromtimestamp(file.stat().st_mtime, UTC)
    except (OSError, ValueError, RecursionError, MismatchError) as error:
        raise CatalogError(f"cannot be read: {error}", file=file) from error
    scenes: dict[str, SceneOutcome] = {}
    for number, line in enumerate(lines):
        try:
            scene = from_plain(SceneOutcome, json.loads(line), f"scenes[{number}]")
        except (ValueError, RecursionError, MismatchError):
            # The kill, or the full disk, cut this line.
            break
        scenes[scene.scene] = scene
    ended = tuple(scenes[name] for name in sorted(scenes))
    return replace(record, scenes=ended, finished=max(written, record.started), cut_short=True)
