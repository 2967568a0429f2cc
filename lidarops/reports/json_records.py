"""Records as plain JSON values, and back: every field, with its exact type."""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from typing import Any, Final, TypeVar

_T = TypeVar("_T")
# JSON has no such numbers, and only Python reads Python's spelling of them.
_NOT_FINITE: Final = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


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
    str: (str, str, "text"),
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
