"""The run record as JSON (``run.json``): what a run did, stored beside its report.

Until it is there, a journal holds the scenes of the run as they end.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from lidarops.errors import NO_FILE, CatalogError, UnavailableError
from lidarops.records import RunRecord, SceneOutcome
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

_T = TypeVar("_T")
# JSON has no such numbers, and only Python reads Python's spelling of them.
_NOT_FINITE: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
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
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, _document(record))
    except (TypeError, ValueError) as error:
        raise CatalogError(
            f"the run record holds a value that JSON cannot hold: {error}",
            file=target,
            field="settings",
            remedy="use only text, finite numbers, booleans, lists and mappings in settings",
        ) from error
    except OSError as error:
        raise UnavailableError(
            f"cannot be written: {error}",
            file=target,
            remedy="make space, then run again, which makes the report; or lidarops report"
            f" {target.parent}",
        ) from error
    (target.parent / JOURNAL).unlink(missing_ok=True)
    return target


def _document(record: RunRecord) -> Iterator[bytes]:
    """Yield the record as JSON, one scene at a time, because all of them would fill memory."""
    stated = plain(replace(record, scenes=()))
    document = {"format": _FORMAT, "version": _VERSION, "record": stated}
    before, opened, after = _text(document).partition('"scenes": [')
    yield f"{before}{opened}".encode("ascii")
    # As deep as they lie in the document.
    for number, scene in enumerate(record.scenes):
        text = f"\n{_text(plain(scene))}".replace("\n", "\n   ")
        yield f"{',' if number else ''}{text}".encode("ascii")
    yield ("\n  " if record.scenes else "").encode("ascii") + after.encode("ascii")


def _text(document: object) -> str:
    return json.dumps(document, indent=1, allow_nan=False)


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


# Records as plain JSON values, and back: every field, with its exact type -----------------------


class MismatchError(Exception):
    """A value of the wrong type; carries its place and what was expected there."""

    def __init__(self, place: str, expected: str) -> None:
        self.place = place
        self.expected = expected
        super().__init__(place, expected)


def plain(value: object) -> object:
    """Return a record, or a value in it, as plain JSON types."""
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, float) and not math.isfinite(value):
        return next(name for name, number in _NOT_FINITE.items() if repr(number) == repr(value))
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, datetime):
        return value.isoformat()
    # Settings are plain already. `save_run_record` refuses non-finite numbers in them: text in
    # their place could not be distinguished from text when it is read.
    return dict(value) if isinstance(value, Mapping) else value


@cache
def _hints(kind: type) -> dict[str, object]:
    return typing.get_type_hints(kind)


def _typed(expected: object, value: object, place: str) -> object:
    """Return a JSON `value` as the type `expected` of a field."""
    origin, arguments = typing.get_origin(expected), typing.get_args(expected)
    if origin is types.UnionType:
        (kind,) = (argument for argument in arguments if argument is not type(None))
        return None if value is None else _typed(kind, value, place)
    if origin is tuple:
        items = _checked(value, list, "a list", place)
        return tuple(_typed(arguments[0], item, f"{place}[{i}]") for i, item in enumerate(items))
    if origin is Mapping:
        pairs = _checked(value, dict, "a mapping", place)
        return {key: _typed(arguments[1], item, f"{place}.{key}") for key, item in pairs.items()}
    if isinstance(expected, type) and is_dataclass(expected):
        return from_plain(expected, value, place)
    return _scalar(expected, value, place)


def from_plain(kind: type[_T], value: object, place: str) -> _T:
    """Return a record from plain JSON types.

    Raises
    ------
    MismatchError
        If a value has another type than its field, or a field is unknown or missing.
    """
    items = _checked(value, dict, f"the fields of {kind.__name__}", place)
    hints = _hints(kind)  # type: ignore[arg-type]  # mypy checks the __hash__ of instances
    for name in sorted(set(hints) ^ set(items)):
        missing = "this field, which is missing"
        raise MismatchError(
            f"{place}.{name}", missing if name in hints else f"no such field of {kind.__name__}"
        )
    return kind(**{name: _typed(hints[name], items[name], f"{place}.{name}") for name in hints})


def _checked(value: object, kind: type[_T], words: str, place: str) -> _T:
    if not isinstance(value, kind):
        raise MismatchError(place, f"{words}, not {value!r:.80}")
    return value


_SCALARS: Final[Mapping[object, tuple[Any, Callable[[Any], object], str]]] = {
    # Scenes of an instrument have most of their words in common.
    str: (str, sys.intern, "text"),
    bool: (bool, bool, "true or false"),
    int: (int, int, "a whole number"),
    float: ((int, float), float, "a number below 1e308"),
    datetime: (str, datetime.fromisoformat, "an ISO 8601 date and time"),
}
"""Types of fields: their types in JSON, how they are read, and what was expected, in words."""


def _scalar(kind: object, value: object, place: str) -> object:
    if kind is Any:
        return value
    if kind is float and isinstance(value, str):
        value = _NOT_FINITE.get(value, value)
    read: Callable[[Any], object]
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        written, read, words = str, kind, f"one of {', '.join(kind)}"
    else:
        written, read, words = _SCALARS[kind]
    # In Python, booleans are integers.
    if isinstance(value, written) and isinstance(value, bool) == (kind is bool):
        with suppress(OverflowError, ValueError):
            return read(value)
    raise MismatchError(place, f"{words}, not {value!r:.80}")
