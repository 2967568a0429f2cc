"""The run record as JSON (``run.json``): what a run did, stored beside its report."""

from __future__ import annotations

import json
import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from lidarops.errors import NO_FILE, CatalogError
from lidarops.records import RunRecord
from lidarops.system.files import write_atomically

FILE_NAME: Final = "run.json"
"""Name of the record inside a run's report folder."""

_FORMAT: Final = "lidarops run record"
_VERSION: Final = 3
_T = TypeVar("_T")
_REMEDY: Final = "give a run's report folder or its run.json, or run the campaign again"
# JSON has no such numbers, and only Python reads Python's spelling of them.
_NOT_FINITE: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


class _MismatchError(Exception):
    """A value of the wrong type; carries its place and what was expected there."""

    def __init__(self, place: str, expected: str) -> None:
        self.place = place
        self.expected = expected
        super().__init__(place, expected)


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
    document = {"format": _FORMAT, "version": _VERSION, "record": _plain(record)}
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
        raise CatalogError(
            f"cannot be written: {error}",
            file=target,
            remedy="make space or choose a folder you can write to, then reprocess with --force",
        ) from error
    return target


def load_run_record(path: str | Path) -> RunRecord:
    """Read a run record that `save_run_record` wrote.

    Parameters
    ----------
    path : path or str
        The run's report folder, or the ``run.json`` in it.

    Returns
    -------
    RunRecord
        Equal to the saved record.

    Raises
    ------
    CatalogError
        If the file is missing, damaged or not exactly a run record (a wrong type, an unknown
        or a missing field). States the file, the field and what was expected.
    """
    path = Path(path)
    path = path / FILE_NAME if path.is_dir() else path
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
        record = _dataclass(RunRecord, document.get("record"), "record")
    except _MismatchError as error:
        raise CatalogError(
            f"expected {error.expected}", file=path, field=error.place, remedy=_REMEDY
        ) from error
    return record


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, float) and not math.isfinite(value):
        return next(name for name, number in _NOT_FINITE.items() if repr(number) == repr(value))
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, datetime):
        return value.isoformat()
    # Settings are plain already. `save_run_record` refuses non-finite numbers in them: text in
    # their place could not be distinguished from text when it is read.
    return dict(value) if isinstance(value, Mapping) else value


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


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
        return _dataclass(expected, value, place)
    if isinstance(expected, type) and issubclass(expected, StrEnum):
        return _enum(expected, value, place)
    return _SCALARS[expected](value, place)


def _dataclass(kind: type[_T], value: object, place: str) -> _T:
    items = _checked(value, dict, f"the fields of {kind.__name__}", place)
    hints = _hints(kind)  # type: ignore[arg-type]  # mypy checks the __hash__ of instances
    for name in sorted(set(hints) ^ set(items)):
        missing = "this field, which is missing"
        raise _MismatchError(
            f"{place}.{name}", missing if name in hints else f"no such field of {kind.__name__}"
        )
    return kind(**{name: _typed(hints[name], items[name], f"{place}.{name}") for name in hints})


def _enum(kind: type[StrEnum], value: object, place: str) -> StrEnum:
    for member in kind:
        if member.value == value:
            return member
    choices = ", ".join(member.value for member in kind)
    raise _MismatchError(place, f"one of {choices}, not {value!r:.80}")


def _checked(value: object, kind: type[_T], words: str, place: str) -> _T:
    # In Python, booleans are integers.
    if not isinstance(value, kind) or isinstance(value, bool):
        raise _MismatchError(place, f"{words}, not {value!r:.80}")
    return value


def _text(value: object, place: str) -> str:
    return _checked(value, str, "text", place)


def _integer(value: object, place: str) -> int:
    return _checked(value, int, "a whole number", place)


def _boolean(value: object, place: str) -> bool:
    if not isinstance(value, bool):
        raise _MismatchError(place, f"true or false, not {value!r:.80}")
    return value


def _float(value: object, place: str) -> float:
    if isinstance(value, str) and value in _NOT_FINITE:
        return _NOT_FINITE[value]
    if isinstance(value, float):
        return value
    integer = _checked(value, int, "a number", place)
    try:
        return float(integer)
    except OverflowError as error:
        raise _MismatchError(place, f"a number below 1e308, not {integer!r:.80}") from error


def _datetime(value: object, place: str) -> datetime:
    text = _checked(value, str, "an ISO 8601 date and time", place)
    try:
        return datetime.fromisoformat(text)
    except ValueError as error:
        raise _MismatchError(place, f"an ISO 8601 date and time, not {text!r:.80}") from error


def _anything(value: object, _: str) -> object:
    return value


_SCALARS: Final[Mapping[object, Callable[[object, str], object]]] = {
    str: _text,
    bool: _boolean,
    int: _integer,
    float: _float,
    datetime: _datetime,
    Any: _anything,
}
