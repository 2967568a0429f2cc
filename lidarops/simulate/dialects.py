"""How the headers of real stations deviate from each other: sites, zenith angles, bin widths.

Every deviation here was seen in files of that station. A header is built by the project's own
writer, its text is changed as the station writes it, and it is parsed again, so that a `Header`
never differs from what a reader will find.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Literal

from lidarops.campaign.simulated_files import DialectName
from lidarops.raw.licel import Dataset, Header, Laser, new_header
from lidarops.raw.licel_header import parse_dataset

_LINE = 78


@dataclass(frozen=True, slots=True)
class Dialect:
    """How one station writes its headers."""

    layout: Literal["classic", "extended", "raymetrics"] | None = None
    """None: extended where the azimuth is known."""
    site: Literal["key", "cut", "whole"] = "key"
    """Key of the station in the campaign, its name cut at 8 characters, or its whole name."""
    minus_90: bool = False
    """Whether vertical is written as -90."""
    whole_bin_widths: bool = False
    """Whether bin widths are written as whole metres in four digits: 0015."""
    both_lasers: bool = False
    """Whether line 3 gives shots and rate for both lasers, whichever fires."""
    second_laser: bool = False
    """Whether the datasets belong to laser 2, of which line 3 gives the shots."""
    tens: bool = False
    """Whether the file name ends in minutes and tens of seconds: ``mmX``."""

    @property
    def holds_azimuth(self) -> bool:
        """Whether the headers can say where a scan looks."""
        return self.layout in {None, "extended"}

    @property
    def laser(self) -> int:
        """Number of the laser in the dataset lines."""
        return 2 if self.second_laser else 1


DIALECTS: Final[Mapping[DialectName, Dialect]] = {
    "licel": Dialect(),
    "manaus": Dialect(
        layout="raymetrics", site="whole", minus_90=True, both_lasers=True, tens=True
    ),
    "saopaulo": Dialect(layout="classic", site="cut", second_laser=True),
    "pilar": Dialect(layout="classic", site="cut"),
    "golmud": Dialect(layout="classic", site="whole", whole_bin_widths=True),
}


@dataclass(frozen=True, slots=True)
class Place:
    """Where and how a lidar stands, as its header says it."""

    key: str
    """Of the station in the campaign."""
    name: str
    altitude: float
    """m above the geoid."""
    first: float
    """degree: the coordinate that the instrument writes first, the longitude for most."""
    second: float
    """degree"""


@dataclass(frozen=True, slots=True)
class Occasion:
    """What differs from file to file."""

    start: datetime
    """As the clock of the computer has it."""
    stop: datetime
    zenith_angle: float
    """degree, 0 = up."""
    azimuth: float | None
    """degree; None where nobody knows it."""
    shots: int
    repetition_rate: float
    """Hz"""
    temperature: float = 303.15
    """K at the ground, for dialects that write it."""
    pressure: float = 1.013e5
    """Pa"""


def tail(dialect: Dialect, stop: datetime, jumps: int = 0) -> str:
    """Return the end of a file name: minutes and seconds of the stop time.

    The hundredths of a second tell files apart that were written before and after a jump of the
    clock.
    """
    if dialect.tens:
        return f"{stop:%M}{stop.second // 10:d}"
    return f"{stop:%M%S}{jumps:02d}"


def header_of(
    dialect: Dialect, name: str, place: Place, occasion: Occasion, datasets: tuple[Dataset, ...]
) -> Header:
    """Return the header of one file in a station's dialect.

    Raises
    ------
    RawFormatError
        Where a number or text does not fit the dialect.
    """
    weather = dialect.layout == "raymetrics"
    vertical = occasion.zenith_angle == 0.0
    return new_header(
        name=name,
        site=_site(dialect, place),
        start=occasion.start,
        stop=occasion.stop,
        altitude=place.altitude,
        longitude=place.first,
        latitude=place.second,
        zenith_angle=-90.0 if dialect.minus_90 and vertical else occasion.zenith_angle,
        azimuth=occasion.azimuth if dialect.holds_azimuth else None,
        temperature=occasion.temperature if weather else None,
        pressure=occasion.pressure if weather else None,
        datasets=datasets,
        lasers=_lasers(dialect, occasion),
        dialect=dialect.layout,
    )


def spelled(dialect: Dialect, dataset: Dataset) -> Dataset:
    """Return a dataset line as the station spells it."""
    if not dialect.whole_bin_widths:
        return dataset
    tokens = dataset.line.decode("latin-1").split()
    tokens[6] = f"{dataset.bin_width:04.0f}"
    text = (" " + " ".join(tokens)).ljust(_LINE) + "\r\n"
    return parse_dataset(text.encode("latin-1"))


def _site(dialect: Dialect, place: Place) -> str:
    if dialect.site == "key":
        return place.key
    return place.name[:8].strip() if dialect.site == "cut" else place.name


def _lasers(dialect: Dialect, occasion: Occasion) -> tuple[Laser, Laser]:
    fires = Laser(occasion.shots, occasion.repetition_rate)
    if dialect.both_lasers:
        return fires, fires
    if dialect.second_laser:
        return Laser(0, occasion.repetition_rate), fires
    return fires, Laser(0, 0.0)
