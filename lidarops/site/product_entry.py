"""The entry of a product in the calendar, and grades of the share of usable profiles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from statistics import fmean
from typing import Final

from lidarops.netcdf.variables import is_retrieved
from lidarops.records import Verdicts
from lidarops.site.paths import product_page


class ShareGrade(StrEnum):
    """Grade of a share of profiles with a usable value."""

    MOST = "most"
    SOME = "some"
    FEW = "few"
    NONE = "none"
    UNKNOWN = "unknown"

    @property
    def css(self) -> str:
        """CSS class."""
        return f"g-{self.name.lower()}"

    @property
    def meaning(self) -> str:
        """Range of shares in words."""
        return _MEANING[self]

    @classmethod
    def of(cls, share: float | None) -> ShareGrade:
        """Return the grade of a share of usable profiles (0 to 1; None without quality flags)."""
        if share is None:
            return cls.UNKNOWN
        if share <= 0.0:
            return cls.NONE
        if share < _SOME:
            return cls.FEW
        return cls.SOME if share < _MOST else cls.MOST


_SOME: Final = 0.25
_MOST: Final = 0.75
_MEANING: Final = {
    ShareGrade.MOST: "75 % or more of the profiles usable",
    ShareGrade.SOME: "25 to 75 % usable",
    ShareGrade.FEW: "less than 25 % usable",
    ShareGrade.NONE: "no profile usable",
    ShareGrade.UNKNOWN: "no quality flags",
}


@dataclass(frozen=True, slots=True)
class Entry:
    """A product in the calendar."""

    path: str
    """Relative to the folder of the products."""
    sha256: str
    size: int
    campaign: str
    """Title of the campaign."""
    station: str
    place: str
    """Name of the station."""
    instrument: str
    name: str
    """Name of the instrument."""
    kind: str
    channel: str
    light: str
    """Wavelength and detection of the channel in words; empty if unknown."""
    latitude: float | None
    longitude: float | None
    altitude: float | None
    """m, of the station."""
    license: str
    start: str
    """UTC, ISO 8601 to the second."""
    stop: str
    values: int
    """Number of values with quality flags."""
    usable: int
    """Number of values that no bit rejects."""
    unflagged: int
    profiles: int
    """Number of profiles with quality flags."""
    available: int
    """Number of profiles with a usable value below the height that matters."""
    lacking: str
    """Why no value is usable; empty if one is."""
    alt: str
    """Description of the thumbnail."""
    problem: str
    """What is wrong with the product; empty if nothing."""

    @property
    def page(self) -> str:
        """Relative to the site."""
        return product_page(self.path)

    @property
    def thumbnail(self) -> str:
        """Relative to the site."""
        return self.page.removesuffix(".html") + ".png"

    @property
    def files(self) -> tuple[str, ...]:
        """Files of the page, relative to the site."""
        return self.page, self.thumbnail

    @property
    def label(self) -> str:
        """Channel in words, with its name."""
        return f"{self.light} ({self.channel})" if self.light else self.channel

    @property
    def day(self) -> str:
        """UTC day on which the data begin."""
        return self.start[:10]

    @property
    def month(self) -> str:
        """UTC month of that day, such as ``2024-09``."""
        return self.start[:7]

    @property
    def year(self) -> str:
        """UTC year of that day."""
        return self.start[:4]

    @property
    def verdicts(self) -> Verdicts:
        """Numbers of good values, of those to be used with care, and of rejected ones."""
        return Verdicts.of(self.values, unflagged=self.unflagged, usable=self.usable)

    @property
    def grade(self) -> ShareGrade:
        """Grade of the share of usable profiles."""
        return ShareGrade.of(self.availability)

    @property
    def availability(self) -> float | None:
        """Share of usable profiles, 0 to 1; None without quality flags."""
        return self.available / self.profiles if self.profiles else None


@dataclass(frozen=True, slots=True)
class Problem:
    """A product without a page, or with an incomplete page."""

    path: str
    reason: str


def mean_availability(entries: Iterable[Entry]) -> float | None:
    """Return the mean over products of the share of usable profiles; None without quality flags.

    Only retrievals count if there are any. The mean is over products, so that one of many
    profiles does not dominate one of few.
    """
    known = [(entry.kind, share) for entry in entries if (share := entry.availability) is not None]
    retrieved = [share for kind, share in known if is_retrieved(kind)]
    shares = retrieved or [share for _, share in known]
    return fmean(shares) if shares else None
