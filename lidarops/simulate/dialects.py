"""Header dialects of real stations: sites, zenith angles, bin widths.

Every deviation was seen in files of that station. A header is built by `lidarops.raw`, its text
is changed as the station writes it, and the result is parsed again. A `Header` therefore always
agrees with its text.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Literal

from lidarops.campaign.simulated_instrument import DialectName
from lidarops.raw.licel import Dataset, Laser, ScanGrid
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
    scans: bool = False
    """Whether headers state elevations, negative upwards, and the grid of the scan, and the stop
    is the start."""
    two_memories: bool = False
    """Whether every channel is written twice, of which the first holds all counts, and each states
    half of the shots."""

    @property
    def holds_azimuth(self) -> bool:
        """Whether headers hold the azimuth of a scan."""
        return self.scans or self.layout in {None, "extended"}

    def shots_of_memories(self, shots: int) -> tuple[int, ...]:
        """Return the shots that headers state for each memory of a channel."""
        return (shots - shots // 2, shots // 2) if self.two_memories else (shots,)

    @property
    def laser(self) -> int:
        """Number of the laser in the dataset lines."""
        return 2 if self.second_laser else 1

    @property
    def weather(self) -> tuple[float, float] | tuple[None, None]:
        """Temperature (K) and pressure (Pa) at the ground; None where headers state neither."""
        return (303.15, 1.013e5) if self.layout == "raymetrics" else (None, None)

    def site_of(self, key: str, name: str) -> str:
        """Return the site of a station as headers state it, by its key and name."""
        if self.site == "key":
            return key
        return name[:8].strip() if self.site == "cut" else name

    def written_zenith(self, zenith: float, scan: ScanGrid | None) -> float:
        """Return a zenith angle in degree as headers state it."""
        if scan is not None:
            return round(zenith - 90.0, 1)
        return -90.0 if (self.minus_90 or self.scans) and zenith == 0.0 else zenith

    def lasers(self, shots: int, repetition_rate: float) -> tuple[Laser, Laser]:
        """Return the lasers of line 3, by the shots of a file and their rate in Hz."""
        stated = self.shots_of_memories(shots)[0]
        firing = Laser(stated, repetition_rate)
        if self.both_lasers:
            return firing, firing
        if self.two_memories:
            return firing, Laser(stated, 0.0)
        if self.second_laser:
            return Laser(0, repetition_rate), firing
        return firing, Laser(0, 0.0)

    def name_suffix(self, stop: datetime, jumps: int) -> str:
        """Return the end of a file name: minutes and seconds of the stop time.

        The last two digits count the jumps of the clock, so files from before and after a jump
        have different names.
        """
        if self.tens:
            return f"{stop:%M}{stop.second // 10:d}"
        return f"{stop:%M%S}{jumps:02d}"

    def written_dataset(self, dataset: Dataset) -> Dataset:
        """Return a dataset line as the station writes it."""
        if not self.whole_bin_widths:
            return dataset
        tokens = dataset.line.decode("latin-1").split()
        tokens[6] = f"{dataset.bin_width:04.0f}"
        text = (" " + " ".join(tokens)).ljust(_LINE) + "\r\n"
        return parse_dataset(text.encode("latin-1"))


DIALECTS: Final[Mapping[DialectName, Dialect]] = {
    "licel": Dialect(),
    "manaus": Dialect(
        layout="raymetrics", site="whole", minus_90=True, both_lasers=True, tens=True
    ),
    "saopaulo": Dialect(layout="classic", site="cut", second_laser=True),
    "pilar": Dialect(layout="classic", site="cut"),
    "golmud": Dialect(layout="classic", site="whole", whole_bin_widths=True),
    "raymetrics_scan": Dialect(layout="raymetrics", scans=True, two_memories=True),
}


def scan_grid(pointings: Sequence[tuple[float, float]]) -> ScanGrid:
    """Return the grid of a scan, of the zenith angle and azimuth of its beams in degree."""
    zeniths, azimuths = (sorted(set(angles)) for angles in zip(*pointings, strict=True))
    return ScanGrid(
        azimuths[0], azimuths[-1], _common_step(azimuths),
        round(zeniths[-1] - 90.0, 1), round(zeniths[0] - 90.0, 1), _common_step(zeniths),
        azimuth_offset=0.0,
    )  # fmt: skip


def _common_step(angles: Sequence[float]) -> float:
    """Return the largest step of tenths of a degree on which all angles lie."""
    return math.gcd(*(round(10.0 * (angle - angles[0])) for angle in angles)) / 10.0
