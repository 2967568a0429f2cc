"""Which products are meant: a selection, and how a user gives it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final, TypeVar

from lidarops.errors import RetrievalInputError
from lidarops.kinds import kinds

NAMES: Final = ("kind", "station", "instrument", "channel")


@dataclass(frozen=True, slots=True)
class ProductSelection:
    """Selection of products; None selects all."""

    kind: str | None = None
    channel: str | None = None
    station: str | None = None
    instrument: str | None = None
    since: datetime | None = None
    """Select products that end after this time."""
    until: datetime | None = None
    """Select products that start before this time."""

    @property
    def names(self) -> dict[str, str]:
        """Names that a product must have, by what they name."""
        names = {name: getattr(self, name) for name in NAMES}
        return {name: value for name, value in names.items() if value is not None}

    def admits(self, stated: Mapping[str, str], start: datetime, stop: datetime) -> bool:
        """Return whether a product with these names and times is selected."""
        return (
            all(stated.get(name) == value for name, value in self.names.items())
            and (self.since is None or stop > self.since)
            and (self.until is None or start < self.until)
        )


EVERYTHING: Final = ProductSelection()


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
    if kind is not None and kind not in kinds():
        raise RetrievalInputError(
            f"is {kind!r}", field="kind", remedy=f"choose one of {', '.join(kinds())}"
        )
    times = (_parse_time(since, "since"), _parse_time(until, "until"))
    return ProductSelection(kind, channel, station, instrument, *times)


def _parse_time(text: datetime | str | None, name: str) -> datetime | None:
    """Return a time; without a time zone it is UTC."""
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
