"""Header dialects of real stations: sites, zenith angles, bin widths.

Every deviation was seen in files of that station. A header is built by `lidarops.raw`, its text
is changed as the station writes it, and the result is parsed again. A `Header` therefore always
agrees with its text.
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
    """None: extended if the azimuth is known."""
    site: Literal["key", "cut", "whole"] = "key"
    """Key of the station in the campaign, its name cut to 8 characters, or its whole name."""
    minus_90: bool = False
    """Whether vertical is written as -90."""
    whole_bin_widths: bool = False
    """Whether bin widths are written as whole metres in four digits: 0015."""
    both_lasers: bool = False
    """Whether line 3 gives shots and rate for both lasers, although one fires."""
    second_laser: bool = False
    """Whether the datasets belong to laser 2, whose shots line 3 gives."""
    tens: bool = False
    """Whether the file name ends in minutes and tens of seconds, ``mmX``."""

    @property
    def holds_azimuth(self) -> bool:
        """Whether headers hold the azimuth of a scan."""
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
    """Name and position of a lidar, as in its headers."""

    key: str
    """Key of the station in the campaign."""
    name: str
    altitude: float
    """m above the geoid."""
    first: float
    """degree; the coordinate that the instrument writes first, mostly the longitude."""
    second: float
    """degree."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Header values that differ from file to file."""

    start: datetime
    """By the clock of the computer."""
    stop: datetime
    zenith_angle: float
    """degree, 0 = up."""
    azimuth: float | None
    """degree; None if unknown."""
    shots: int
    repetition_rate: float
    """Hz."""
    temperature: float = 303.15
    """K at the ground, for dialects that write it."""
    pressure: float = 1.013e5
    """Pa."""


def name_suffix(dialect: Dialect, stop: datetime, jumps: int = 0) -> str:
    """Return the end of a file name: minutes and seconds of the stop time.

    The last two digits count the jumps of the clock, so files from before and after a jump have
    different names.
    """
    if dialect.tens:
        return f"{stop:%M}{stop.second // 10:d}"
    return f"{stop:%M%S}{jumps:02d}"


def make_header(
    dialect: Dialect,
    name: str,
    place: Place,
    measurement: Measurement,
    datasets: tuple[Dataset, ...],
) -> Header:
    """Return the header of one file in a station's dialect.

    Raises
    ------
    RawFormatError
        If a number or text does not fit the dialect.
    """
    weather = dialect.layout == "raymetrics"
    vertical = measurement.zenith_angle == 0.0
    return new_header(
        name=name,
        site=_site(dialect, place),
        start=measurement.start,
        stop=measurement.stop,
        altitude=place.altitude,
        longitude=place.first,
        latitude=place.second,
        zenith_angle=-90.0 if dialect.minus_90 and vertical else measurement.zenith_angle,
        azimuth=measurement.azimuth if dialect.holds_azimuth else None,
        temperature=measurement.temperature if weather else None,
        pressure=measurement.pressure if weather else None,
        datasets=datasets,
        lasers=_lasers(dialect, measurement),
        dialect=dialect.layout,
    )


def dataset_in_dialect(dialect: Dialect, dataset: Dataset) -> Dataset:
    """Return a dataset line as the station writes it."""
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


def _lasers(dialect: Dialect, measurement: Measurement) -> tuple[Laser, Laser]:
    firing = Laser(measurement.shots, measurement.repetition_rate)
    if dialect.both_lasers:
        return firing, firing
    if dialect.second_laser:
        return Laser(0, measurement.repetition_rate), firing
    return firing, Laser(0, 0.0)
