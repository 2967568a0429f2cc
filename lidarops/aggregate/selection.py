"""Parses a selection of products as given by a user."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import StrEnum
from typing import TypeVar

from lidarops.aggregate.facts import ProductSelection
from lidarops.errors import RetrievalInputError
from lidarops.kinds import kinds


def parse_selection(
    kind: str | None,
    channel: str | None,
    station: str | None,
    instrument: str | None,
    since: datetime | str | None,
    until: datetime | str | None,
) -> ProductSelection:
    """Return a selection from names and times.

    Raises
    ------
    RetrievalInputError
        If the kind is unknown or a time is not ISO 8601.
    """
    return ProductSelection(
        None if kind is None else _known_kind(kind),
        channel,
        station,
        instrument,
        _parse_time(since, "since"),
        _parse_time(until, "until"),
    )


def _known_kind(name: str) -> str:
    """Return the name of a kind of product.

    Raises
    ------
    RetrievalInputError
        If there is no such kind.
    """
    if name not in kinds():
        raise RetrievalInputError(
            f"is {name!r}", field="kind", remedy=f"choose one of {', '.join(kinds())}"
        )
    return name


def _parse_time(text: datetime | str | None, name: str) -> datetime | None:
    """Return a time; without a time zone it is UTC.

    Raises
    ------
    RetrievalInputError
        If it is not ISO 8601.
    """
    if text is None:
        return None
    try:
        time = text if isinstance(text, datetime) else datetime.fromisoformat(text)
    except ValueError as error:
        raise RetrievalInputError(
            f"is {text!r}", field=name, remedy="give a time such as 2026-03-01T12:00"
        ) from error
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


_Choice = TypeVar("_Choice", bound=StrEnum)


def parse_choice(choices: type[_Choice], word: str, field: str) -> _Choice:
    """Return the member of an enumeration with this value.

    Raises
    ------
    RetrievalInputError
        If there is none; the message lists the choices.
    """
    try:
        return choices(word)
    except ValueError as error:
        raise RetrievalInputError(
            f"is {word!r}", field=field, remedy=f"choose one of {', '.join(choices)}"
        ) from error
