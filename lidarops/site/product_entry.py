"""The entry of a product in the calendar, its grade, and the products beside it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import Final

from lidarops.kinds import rank_of
from lidarops.netcdf.variables import is_retrieved
from lidarops.records import Verdicts
from lidarops.site.paths import product_page

GRADES: Final = {
    "most": "75 % or more of the profiles usable",
    "some": "25 to 75 % usable",
    "few": "less than 25 % usable",
    "none": "no profile usable",
    "unknown": "no quality flags",
}
"""Grades of a share of profiles with a usable value, in words."""


def grade_of(share: float | None) -> str:
    """Return the grade of a share of usable profiles (0 to 1; None without quality flags)."""
    if share is None:
        return "unknown"
    if share <= 0.0:
        return "none"
    return "few" if share < 0.25 else "some" if share < 0.75 else "most"


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
    problem: str
    """What is wrong with the product; empty if nothing."""

    @property
    def page(self) -> str:
        """Relative to the site."""
        return product_page(self.path)

    @property
    def label(self) -> str:
        """Channel in words, with its name."""
        return self.light or self.channel

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
    def grade(self) -> str:
        """Grade of the share of usable profiles."""
        return grade_of(self.availability)

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


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Products beside one product."""

    before: Entry | None
    """The previous product of the same instrument, kind and channel."""
    after: Entry | None
    siblings: tuple[Entry, ...]
    """Of the other kinds and channels of the instrument, the product nearest in time among those of
    the same day that overlap this one."""


def with_neighbours(entries: Sequence[Entry]) -> Iterator[tuple[Entry, Neighbours]]:
    """Yield every product with those beside it, in the given order."""
    series: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    days: dict[tuple[str, ...], list[Entry]] = defaultdict(list)
    for entry in sorted(entries, key=lambda entry: (entry.start, entry.path)):
        series[_series(entry)].append(entry)
        days[entry.station, entry.instrument, entry.day].append(entry)
    ends: dict[str, tuple[Entry | None, Entry | None]] = {}
    for group in series.values():
        befores, afters = [None, *group[:-1]], [*group[1:], None]
        for entry, before, after in zip(group, befores, afters, strict=True):
            ends[entry.path] = before, after
    for entry in entries:
        same_day = days[entry.station, entry.instrument, entry.day]
        yield entry, Neighbours(*ends[entry.path], _siblings(entry, same_day))


def _series(entry: Entry) -> tuple[str, ...]:
    return entry.station, entry.instrument, entry.kind, entry.channel


def _siblings(entry: Entry, same_day: Iterable[Entry]) -> tuple[Entry, ...]:
    start = datetime.fromisoformat(entry.start)
    overlapping = [
        other
        for other in same_day
        # A product without length overlaps one that starts with it.
        if other.start == entry.start or (other.start < entry.stop and entry.start < other.stop)
    ]
    nearest: dict[tuple[str, ...], Entry] = {}
    for other in sorted(overlapping, key=lambda o: abs(datetime.fromisoformat(o.start) - start)):
        nearest.setdefault(_series(other), other)
    del nearest[_series(entry)]
    return tuple(nearest[key] for key in sorted(nearest, key=lambda key: (rank_of(key[2]), key)))
