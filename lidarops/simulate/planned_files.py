"""One simulated instrument: its settings and place, and the files that it writes."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

import numpy as np

from lidarops.campaign.model import Instrument, InstrumentFacts, Station, channel_facts
from lidarops.campaign.simulated_instrument import Acquisition, DamageKind, Detector
from lidarops.campaign.simulation import HorizontalPath, InstrumentSimulation, SimulationSettings
from lidarops.constants import EARTH_RADIUS
from lidarops.errors import CampaignError
from lidarops.records import DetectionMode, Role
from lidarops.simulate.damage import FOREIGN_NAME
from lidarops.simulate.dialects import DIALECTS, Dialect

_MASK: Final = (1 << 64) - 1

_COPY_SUFFIX: Final = ".copy"
"""End of the name of a duplicate, after the name of the file."""


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file that will be written."""

    role: Role
    index: int
    """Index from 0 among the files of that role."""
    copy: bool = False
    """Whether it is a copy of a file under another name."""


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

    def damage_of(self, index: int) -> DamageKind | None:
        """Return the damage of the signal file `index`; None for a good file."""
        random_damage = self.simulated.random_damage
        if index in self.damage or random_damage is None:
            return self.damage.get(index)
        draw, kind = _random_words(self.settings.seed, f"{self.key}/damage", index)
        if draw >= random_damage.fraction * 2.0**32:
            return None
        return random_damage.kinds[kind % len(random_damage.kinds)]

    def start_of(self, role: Role, index: int) -> datetime:
        """Return the start of a file in true time."""
        if role is Role.DARK:
            return self.settings.start_of_dark(self.key, index)
        return self.settings.start_of(self.key, index)

    def acquisition_of(self, role: Role, index: int) -> Acquisition:
        """Return the acquisition settings of a file, dark files included."""
        return self.simulated.acquisition.at(self.start_of(role, index))

    def planned_files(self) -> Iterator[PlannedFile]:
        """Yield every file of the instrument: dark files first, then signal files in time."""
        acquisition = self.simulated.acquisition
        for index in range(acquisition.dark_files):
            yield PlannedFile(Role.DARK, index)
        for index in range(self.settings.files(self.key)):
            if acquisition.is_missing(self.start_of(Role.SIGNAL, index)):
                continue
            yield PlannedFile(Role.SIGNAL, index)
            if self.damage_of(index) is DamageKind.DUPLICATE:
                yield PlannedFile(Role.SIGNAL, index, copy=True)

    def path_of(self, planned: PlannedFile) -> str:
        """Return the path of a file in the archive.

        Names follow Licel: prefix, two digits of the year, month in hexadecimal, day, hour, and
        after the point minute, second and hundredths of a second, all of the stop time.
        """
        folder, prefix = self.folder[planned.role], self.prefix[planned.role]
        kind = self.damage_of(planned.index) if planned.role is Role.SIGNAL else None
        if kind is DamageKind.FOREIGN:
            return f"{folder}{prefix}{planned.index}{FOREIGN_NAME}"
        name = self.name_of(planned)
        if kind is DamageKind.RENAMED:
            name = f"{prefix}_{name}"
        return folder + name + (_COPY_SUFFIX if planned.copy else "")

    def name_of(self, planned: PlannedFile) -> str:
        """Return the name of a file in its header."""
        start = self.start_of(planned.role, planned.index)
        jumps, error = self.simulated.acquisition.clock_error(start)
        stop = start + self.duration_of(planned) + error
        suffix = self.dialect.name_suffix(stop, jumps)
        return f"{self.prefix[planned.role]}{stop:%y}{stop.month:X}{stop:%d%H}.{suffix}"

    def duration_of(self, planned: PlannedFile) -> timedelta:
        """Return the duration of a file."""
        return timedelta(seconds=self.acquisition_of(planned.role, planned.index).duration)

    def pointing_of(
        self, planned: PlannedFile, facts: InstrumentFacts
    ) -> tuple[float, float | None]:
        """Return zenith angle and azimuth of a file, degree; the azimuth is None if unknown."""
        scan = self.simulated.pointing
        if scan is not None:
            cycle = scan.cycle()
            return cycle[planned.index % len(cycle)]
        if facts.zenith_angle is not None:
            return facts.zenith_angle, facts.azimuth
        level = isinstance(self.simulated, HorizontalPath)
        return (90.0 if level else 0.0), facts.azimuth


def channel_name(mode: DetectionMode, detector: Detector) -> str:
    """Return the name of a channel, as the reader of raw files derives it from the header."""
    return f"{mode.value}_{detector.label}"


def modes(detector: Detector) -> tuple[DetectionMode, ...]:
    """Return the detection modes of a detector, in the order of the datasets in a file."""
    analog = () if detector.analog is None else (DetectionMode.ANALOG,)
    photon = () if detector.photon is None else (DetectionMode.PHOTON,)
    return analog + photon


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
