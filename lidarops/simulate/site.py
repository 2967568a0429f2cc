"""One simulated instrument: what is simulated, where it stands, and which files it writes."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

import numpy as np

from lidarops.campaign.model import Instrument, InstrumentFacts, Station, channel_facts
from lidarops.campaign.simulation import (
    Acquisition,
    DamageKind,
    Detector,
    HorizontalPath,
    SimulatedInstrument,
    SimulationSettings,
)
from lidarops.errors import CampaignError
from lidarops.records import DetectionMode, Role
from lidarops.simulate.damage import FOREIGN_NAME
from lidarops.simulate.dialects import DIALECTS, Dialect, Place, tail

EARTH_RADIUS: Final = 6_371_008.8
"""m, mean radius."""

_MASK: Final = (1 << 64) - 1

TWIN: Final = ".copy"
"""What follows the name of a file in the name of its duplicate."""


@dataclass(frozen=True, slots=True)
class Order:
    """One file to be written."""

    role: Role
    index: int
    """From 0, among the files of that role."""
    twin: bool = False
    """Whether it is the copy of a file under another name."""


@dataclass(frozen=True, slots=True)
class Site:
    """One simulated instrument: what is simulated, what the campaign knows of it, where it is."""

    key: str
    """Of the instrument in the campaign."""
    settings: SimulationSettings
    instrument: Instrument
    station: Station
    origin: Station
    """Of the frame in which the air in front of it is described."""
    folder: Mapping[Role, str]
    """Folder of the files in the archive, with a final slash where it is not the root."""
    prefix: Mapping[Role, str]
    """First letters of the file names."""
    damage: Mapping[int, DamageKind]
    """What is wrong with signal files, as far as it was said file by file."""

    @property
    def simulated(self) -> SimulatedInstrument:
        """What is simulated."""
        return self.settings.instruments[self.key]

    @property
    def dialect(self) -> Dialect:
        """Whose headers the files have."""
        return DIALECTS[self.simulated.acquisition.dialect]

    @property
    def place(self) -> Place:
        """Where the instrument stands, as its headers say it."""
        station = self.station
        pair = station.longitude, station.latitude
        if self.instrument.header_position == "latitude_first":
            pair = pair[::-1]
        if self.simulated.acquisition.signs_lost:
            pair = abs(pair[0]), abs(pair[1])
        return Place(self.instrument.station, station.name, station.altitude, *pair)

    @property
    def position(self) -> tuple[float, float, float]:
        r"""Metres east, north and above the origin: flat, as fits a network of lidars.

        Notes
        -----
        East at the middle latitude :math:`r (\lambda - \lambda_0) \cos((\phi + \phi_0) / 2)`,
        north :math:`r (\phi - \phi_0)`, on a sphere.
        """
        middle = math.radians(0.5 * (self.station.latitude + self.origin.latitude))
        turn = (self.station.longitude - self.origin.longitude + 180.0) % 360.0 - 180.0
        east = EARTH_RADIUS * math.radians(turn) * math.cos(middle)
        north = EARTH_RADIUS * math.radians(self.station.latitude - self.origin.latitude)
        return east, north, self.station.altitude - self.origin.altitude

    def damage_of(self, index: int) -> DamageKind | None:
        """Return what is wrong with the signal file `index`."""
        chance = self.simulated.random_damage
        if index in self.damage or chance is None:
            return self.damage.get(index)
        lot, kind = _words(self.settings.seed, f"{self.key}/damage", index)
        if lot >= chance.fraction * 2.0**32:
            return None
        return chance.kinds[kind % len(chance.kinds)]

    def start_of(self, role: Role, index: int) -> datetime:
        """Return when a file starts, by the true time."""
        if role is Role.DARK:
            return self.settings.start_of_dark(self.key, index)
        return self.settings.start_of(self.key, index)

    def acquisition_of(self, role: Role, index: int) -> Acquisition:
        """Return how a file is taken: dark files as those of the start or of the end."""
        return self.simulated.acquisition.at(self.start_of(role, index))

    def orders(self) -> Iterator[Order]:
        """Yield every file of the instrument: dark ones, then signal ones in time."""
        acquisition = self.simulated.acquisition
        for index in range(acquisition.dark_files):
            yield Order(Role.DARK, index)
        for index in range(self.settings.files(self.key)):
            if acquisition.is_missing(self.start_of(Role.SIGNAL, index)):
                continue
            yield Order(Role.SIGNAL, index)
            if self.damage_of(index) is DamageKind.DUPLICATE:
                yield Order(Role.SIGNAL, index, twin=True)

    def path_of(self, order: Order) -> str:
        """Return the path of a file in the archive.

        Names are Licel's: prefix, two digits of the year, month in hexadecimal, day, hour, and
        after the point minute, second and hundredths of a second, all of the stop time.
        """
        folder, prefix = self.folder[order.role], self.prefix[order.role]
        kind = self.damage_of(order.index) if order.role is Role.SIGNAL else None
        if kind is DamageKind.FOREIGN:
            return f"{folder}{prefix}{order.index}{FOREIGN_NAME}"
        name = self.name_of(order)
        if kind is DamageKind.RENAMED:
            name = f"{prefix}_{name}"
        return folder + name + (TWIN if order.twin else "")

    def name_of(self, order: Order) -> str:
        """Return the name of a file as its header has it."""
        start = self.start_of(order.role, order.index)
        jumps, error = self.simulated.acquisition.clock_error(start)
        stop = start + self.duration_of(order) + error
        end = tail(self.dialect, stop, jumps)
        return f"{self.prefix[order.role]}{stop:%y}{stop.month:X}{stop:%d%H}.{end}"

    def duration_of(self, order: Order) -> timedelta:
        """Return how long a file takes."""
        return timedelta(seconds=self.acquisition_of(order.role, order.index).duration)

    def pointing_of(self, order: Order, facts: InstrumentFacts) -> tuple[float, float | None]:
        """Return zenith angle and azimuth of a file, degree; None where nobody knows it."""
        scan = self.simulated.pointing
        if scan is not None:
            cycle = scan.cycle()
            return cycle[order.index % len(cycle)]
        if facts.zenith_angle is not None:
            return facts.zenith_angle, facts.azimuth
        level = isinstance(self.simulated, HorizontalPath)
        return (90.0 if level else 0.0), facts.azimuth


def channel_name(mode: DetectionMode, detector: Detector) -> str:
    """Return the name of a channel, as the reader of raw files makes it from the header."""
    return f"{mode.value}_{detector.label}"


def modes(detector: Detector) -> tuple[DetectionMode, ...]:
    """Return how a detector is read, in the order of the datasets in a file."""
    analog = () if detector.analog is None else (DetectionMode.ANALOG,)
    photon = () if detector.photon is None else (DetectionMode.PHOTON,)
    return analog + photon


def dead_time(site: Site, start: datetime, channel: str) -> float:
    """Return the dead time of a photon counter at the start of a file, s, from the campaign.

    Raises
    ------
    CampaignError
        Where the facts of the instrument give none.
    """
    known = channel_facts(site.instrument.facts_at(start), channel).dead_time
    if known is None:
        raise CampaignError(
            f"the facts give no dead time at {start:%Y-%m-%d %H:%M} UTC",
            field=f"instruments.{site.key}.facts.channels.{channel}.dead_time",
            remedy="give one, in s: the simulation takes it from the facts",
        )
    return known


def random_stream(seed: int, key: str, role: Role, index: int) -> np.random.Generator:
    """Return the random numbers of one file: the same whatever else is simulated, and when."""
    words = [seed, zlib.crc32(f"{key}/{role.value}".encode()), index]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


def _words(seed: int, purpose: str, index: int) -> tuple[int, int]:
    """Return two numbers of 32 bits (splitmix64), in a fraction of the time of a generator."""
    word = (seed ^ zlib.crc32(purpose.encode()) << 32) + (index + 1) * 0x9E3779B97F4A7C15
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        word &= _MASK
        word = (word ^ word >> shift) * factor
    return word >> 32 & 0xFFFFFFFF, word & 0xFFFFFFFF
