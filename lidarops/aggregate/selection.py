"""Which products are asked for, as a person writes it."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import StrEnum
from typing import TypeVar

from lidarops.aggregate.facts import ProductSelection
from lidarops.errors import RetrievalInputError
from lidarops.records import ProductKind


def select(
    kind: ProductKind | str | None,
    channel: str | None,
    station: str | None,
    instrument: str | None,
    since: datetime | str | None,
    until: datetime | str | None,
) -> ProductSelection:
    """Check what is asked for.

    Raises
    ------
    RetrievalInputError
        If the kind is unknown or a time is no ISO 8601.
    """
    return ProductSelection(
        None if kind is None else choice(ProductKind, kind, "kind"),
        channel,
        station,
        instrument,
        moment(since, "since"),
        moment(until, "until"),
    )


def moment(told: datetime | str | None, name: str) -> datetime | None:
    """Read a time; without a zone it is UTC.

    Raises
    ------
    RetrievalInputError
        If it is no ISO 8601.
    """
    if told is None:
        return None
    try:
        found = told if isinstance(told, datetime) else datetime.fromisoformat(told)
    except ValueError as error:
        raise RetrievalInputError(
            f"is {told!r}", field=name, remedy="give a time such as 2026-03-01T12:00"
        ) from error
    return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)


_Choice = TypeVar("_Choice", bound=StrEnum)


def choice(choices: type[_Choice], told: str, field: str) -> _Choice:
    """Return what a word stands for.

    Raises
    ------
    RetrievalInputError
        Naming the words, if it is none of them.
    """
    try:
        return choices(told)
    except ValueError as error:
        raise RetrievalInputError(
            f"is {told!r}", field=field, remedy=f"choose one of {', '.join(choices)}"
        ) from error
