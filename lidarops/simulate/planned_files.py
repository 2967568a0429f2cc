"""One simulated instrument: its settings and place, its header dialect, the files that it writes.

Every deviation of a dialect was seen in files of that station. A header is built by
`lidarops.raw`, its text is changed as the station writes it, and the result is parsed again. A
`Header` therefore always agrees with its text.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Final, Literal

import numpy as np

from lidarops.campaign.model import Instrument, InstrumentFacts, Station, channel_facts
from lidarops.campaign.simulated_instrument import (
    Acquisition,
    DamageKind,
    DialectName,
    Pointing,
)
from lidarops.campaign.simulation import InstrumentSimulation, SimulationSettings
from lidarops.constants import EARTH_RADIUS
from lidarops.errors import CampaignError
from lidarops.raw.licel import Dataset, Laser, ScanGrid
from lidarops.raw.licel_header import parse_dataset
from lidarops.records import Role
from lidarops.simulate.damage import FOREIGN_NAME

_MASK: Final = (1 << 64) - 1

_COPY_SUFFIX: Final = ".copy"
"""End of the name of a duplicate, after the name of the file."""

_LINE: Final = 78
"""Characters to which a line of a header is padded."""


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
    is the start; and every channel is written twice, of which the first holds all counts, and each
    states half of the shots."""

    @property
    def holds_azimuth(self) -> bool:
        """Whether headers hold the azimuth of a scan."""
        return self.scans or self.layout in {None, "extended"}

    def shots_of_memories(self, shots: int) -> tuple[int, ...]:
        """Return the shots that headers state for each memory of a channel."""
        return (shots - shots // 2, shots // 2) if self.scans else (shots,)

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
        if self.scans:
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
    "raymetrics_scan": Dialect(layout="raymetrics", scans=True),
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


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file that will be written."""

    role: Role
    index: int
    """Index from 0 among the files of that role."""
    start: datetime
    """True time."""
    acquisition: Acquisition
    """With the changes that hold for it."""
    clock_error: timedelta
    """Clock of the computer minus true time."""
    name: str
    """In its header."""
    path: str
    """In the archive."""
    damage: DamageKind | None = None
    copy: bool = False
    """Whether it is a copy of a file under another name."""

    @property
    def duration(self) -> timedelta:
        """From start to stop."""
        return timedelta(seconds=self.acquisition.duration)


@dataclass(frozen=True, slots=True)
class SimulatedInstrument:
    """One simulated instrument: its simulation settings, campaign facts and place."""

    key: str
    """Key of the instrument in the campaign."""
    settings: SimulationSettings
    instrument: Instrument
    station: Station
    origin: Station
    """Origin of the coordinates of the air."""
    folder: Mapping[Role, str]
    """Folder of the files in the archive, with a final slash unless it is the root."""
    prefix: Mapping[Role, str]
    """First letters of the file names."""
    damage: Mapping[int, DamageKind]
    """Damage of single signal files, by index; random damage is not included."""

    @property
    def simulated(self) -> InstrumentSimulation:
        """Simulation settings of the instrument."""
        return self.settings.instruments[self.key]

    @property
    def scan(self) -> Pointing | None:
        """Sequence of zenith angles; None where the facts of the campaign give the pointing."""
        return self.simulated.scan

    @property
    def dialect(self) -> Dialect:
        """Dialect of the headers."""
        return DIALECTS[self.simulated.acquisition.dialect]

    @property
    def written_position(self) -> tuple[float, float]:
        """The two coordinates in the order and with the signs of its headers, degree."""
        pair = self.station.longitude, self.station.latitude
        if self.instrument.header_position == "latitude_first":
            pair = pair[::-1]
        if self.simulated.acquisition.signs_lost:
            pair = abs(pair[0]), abs(pair[1])
        return pair

    @property
    def position(self) -> tuple[float, float, float]:
        r"""Position east, north and above the origin, m, on a flat Earth.

        Notes
        -----
        East, at the middle latitude, :math:`r (\lambda - \lambda_0) \cos((\phi + \phi_0) / 2)`,
        north :math:`r (\phi - \phi_0)`, with the mean radius r of the Earth.
        """
        middle = math.radians(0.5 * (self.station.latitude + self.origin.latitude))
        turn = (self.station.longitude - self.origin.longitude + 180.0) % 360.0 - 180.0
        east = EARTH_RADIUS * math.radians(turn) * math.cos(middle)
        north = EARTH_RADIUS * math.radians(self.station.latitude - self.origin.latitude)
        return east, north, self.station.altitude - self.origin.altitude

    def planned_files(self) -> Iterator[PlannedFile]:
        """Yield every file of the instrument: dark files first, then signal files in time."""
        settings, acquisition = self.settings, self.simulated.acquisition
        for index in range(acquisition.dark_files):
            yield self._planned(Role.DARK, index, settings.start_of_dark(self.key, index))
        for index in range(settings.files(self.key)):
            start = settings.start_of(self.key, index)
            if acquisition.is_missing(start):
                continue
            planned = self._planned(Role.SIGNAL, index, start, self._damage_of(index))
            yield planned
            if planned.damage is DamageKind.DUPLICATE:
                yield replace(planned, path=planned.path + _COPY_SUFFIX, copy=True)

    def _damage_of(self, index: int) -> DamageKind | None:
        """Return the damage of the signal file `index`; None for a good file."""
        random_damage = self.simulated.random_damage
        if index in self.damage or random_damage is None:
            return self.damage.get(index)
        draw, kind = _random_words(self.settings.seed, f"{self.key}/damage", index)
        if draw >= random_damage.fraction * 2.0**32:
            return None
        return random_damage.kinds[kind % len(random_damage.kinds)]

    def _planned(
        self, role: Role, index: int, start: datetime, damage: DamageKind | None = None
    ) -> PlannedFile:
        """Return a file.

        Names follow Licel: prefix, two digits of the year, month in hexadecimal, day, hour, and
        after the point minute, second and hundredths of a second, all of the stop time.
        """
        acquisition = self.simulated.acquisition.at(start)
        jumps, error = acquisition.clock_error(start)
        stop = start + timedelta(seconds=acquisition.duration) + error
        prefix, suffix = self.prefix[role], self.dialect.name_suffix(stop, jumps)
        name = f"{prefix}{stop:%y}{stop.month:X}{stop:%d%H}.{suffix}"
        file = f"{prefix}_{name}" if damage is DamageKind.RENAMED else name
        if damage is DamageKind.FOREIGN:
            file = f"{prefix}{index}{FOREIGN_NAME}"
        path = self.folder[role] + file
        return PlannedFile(role, index, start, acquisition, error, name, path, damage)

    def pointing_of(
        self, planned: PlannedFile, facts: InstrumentFacts
    ) -> tuple[float, float | None]:
        """Return zenith angle and azimuth of a file, degree; the azimuth is None if unknown."""
        if self.scan is not None:
            cycle = self.scan.cycle()
            return cycle[planned.index % len(cycle)]
        return facts.zenith_angle or 0.0, facts.azimuth


def photon_dead_time(site: SimulatedInstrument, start: datetime, channel: str) -> float:
    """Return the dead time of a photon counter at the start of a file, s, from the campaign.

    Raises
    ------
    CampaignError
        If the facts of the instrument give none.
    """
    seconds = channel_facts(site.instrument.facts_at(start), channel).dead_time
    if not isinstance(seconds, float):
        raise CampaignError(
            f"the facts give no dead time at {start:%Y-%m-%d %H:%M} UTC",
            field=f"instruments.{site.key}.facts.channels.{channel}.dead_time",
            remedy="give one in s: the simulation takes it from the facts",
        )
    return seconds


def random_stream(seed: int, key: str, role: Role, index: int) -> np.random.Generator:
    """Return the random generator of one file; it depends on no other file."""
    words = [seed, zlib.crc32(f"{key}/{role.value}".encode()), index]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


def _random_words(seed: int, purpose: str, index: int) -> tuple[int, int]:
    """Return two random numbers of 32 bits (splitmix64), much faster than a generator."""
    word = (seed ^ zlib.crc32(purpose.encode()) << 32) + (index + 1) * 0x9E3779B97F4A7C15
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        word &= _MASK
        word = (word ^ word >> shift) * factor
    return word >> 32 & 0xFFFFFFFF, word & 0xFFFFFFFF
