"""What the site remembers of a product, and how good its values are, in words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from statistics import fmean
from typing import Final

SIGNAL: Final = "signal"
UNKNOWN: Final = "unknown"


class Grade(StrEnum):
    """How many of the values can be used, in a word."""

    MOST = "most"
    SOME = "some"
    FEW = "few"
    NONE = "none"
    UNJUDGED = "not judged"

    @property
    def css(self) -> str:
        """Name of its style."""
        return f"g-{self.name.lower()}"

    @property
    def meaning(self) -> str:
        """Which shares of usable values it stands for."""
        return _MEANING[self]

    @classmethod
    def of(cls, share: float | None) -> Grade:
        """Return the grade of a share of usable values, 0 to 1; None where nothing judges."""
        if share is None:
            return cls.UNJUDGED
        if share <= 0.0:
            return cls.NONE
        if share < _SOME:
            return cls.FEW
        return cls.SOME if share < _MOST else cls.MOST


_SOME: Final = 0.25
_MOST: Final = 0.75
_MEANING: Final = {
    Grade.MOST: "75 % or more of the values usable",
    Grade.SOME: "25 to 75 % usable",
    Grade.FEW: "less than 25 % usable",
    Grade.NONE: "no value usable",
    Grade.UNJUDGED: "without quality flags",
}


@dataclass(frozen=True, slots=True)
class Entry:
    """One product as the calendar knows it."""

    path: str
    """Relative to the folder of the products."""
    sha256: str
    size: int
    page: str
    """Relative to the site."""
    thumbnail: str
    """Relative to the site."""
    digests: tuple[str, ...]
    """sha256 of the files of the product's page, in the order of `files`."""
    campaign: str
    station: str
    place: str
    """Name of the station."""
    instrument: str
    kind: str
    channel: str
    start: str
    """UTC, ISO 8601 to the second."""
    stop: str
    values: int
    """Number of values that quality bits judge."""
    usable: int
    """Number of those that no bit rejects."""
    unflagged: int
    alt: str
    """What the thumbnail shows."""
    problem: str
    """What is wrong with the product although it has a page; empty where nothing is."""

    @property
    def files(self) -> tuple[str, ...]:
        """Files of its page, relative to the site."""
        return self.page, self.thumbnail, f"{self.page.removesuffix('.html')}.prov.json"

    @property
    def day(self) -> str:
        """UTC day on which its data begin."""
        return self.start[:10]

    @property
    def share(self) -> float | None:
        """Share of usable values; None where nothing judges them."""
        return self.usable / self.values if self.values else None

    @property
    def grade(self) -> Grade:
        """How good its values are."""
        return Grade.of(self.share)


@dataclass(frozen=True, slots=True)
class Problem:
    """A product that has no page, or a page with less than it should have."""

    path: str
    reason: str


def mean_share(entries: Iterable[Entry]) -> float | None:
    """Return the mean over products of the share of usable values.

    Retrievals count where there are any: the far range of a signal is flagged by nature. The
    mean is over products and not over values, so that a product of many bins does not hide one
    of few sections. None where nothing is judged.
    """
    judged = [(entry.kind == SIGNAL, entry.share) for entry in entries if entry.share is not None]
    retrieved = [share for is_signal, share in judged if not is_signal]
    shares = retrieved or [share for _, share in judged]
    return fmean(shares) if shares else None
