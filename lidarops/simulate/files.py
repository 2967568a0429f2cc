"""One simulated raw file: its name, its bytes and the truth behind it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from lidarops.campaign import Instrument, InstrumentFacts, Station, channel_facts
from lidarops.constants import LICEL_DISCRIMINATOR_STEP
from lidarops.errors import CampaignError
from lidarops.raw.licel import Dataset, DatasetKind, Laser, encode, new_dataset, new_header
from lidarops.records import DetectionMode, Role
from lidarops.simulate.damage import FOREIGN_NAME, damaged
from lidarops.simulate.instrument import Counts, Photoelectrons, count_photons, digitise, release
from lidarops.simulate.paths import path_at
from lidarops.simulate.settings import (
    Acquisition,
    DamageKind,
    Detector,
    HorizontalPath,
    SimulatedInstrument,
    SimulationSettings,
)
from lidarops.simulate.signal import backscatter_signal, bin_centres
from lidarops.simulate.sun import sky_brightness, solar_elevation

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Site:
    """One simulated instrument: what is simulated, what the campaign knows of it, where it is."""

    key: str
    """Of the instrument in the campaign."""
    settings: SimulationSettings
    instrument: Instrument
    station: Station
    folder: Mapping[Role, str]
    """Folder of the files in the archive, with a final slash where it is not the root."""
    prefix: Mapping[Role, str]
    """First letters of the file names."""

    @property
    def simulated(self) -> SimulatedInstrument:
        """What is simulated."""
        return self.settings.instruments[self.key]

    def damage_of(self, index: int) -> DamageKind | None:
        """Return what is wrong with the signal file `index`."""
        kinds = {damage.index: damage.kind for damage in self.simulated.damage}
        return kinds.get(index)

    def start_of(self, role: Role, index: int) -> datetime:
        """Return when a file starts."""
        if role is Role.DARK:
            return self.settings.start_of_dark(self.key, index)
        return self.settings.start_of(self.key, index)

    def name_of(self, role: Role, index: int) -> str:
        """Return the path of a file in the archive.

        Names are Licel's: prefix, two digits of the year, month in hexadecimal, day, hour, and
        after the point minute, second and hundredths of a second, all of the stop time.
        """
        if role is Role.SIGNAL and self.damage_of(index) is DamageKind.FOREIGN:
            return self.folder[role] + self.prefix[role] + FOREIGN_NAME
        stop = self.start_of(role, index) + self.duration
        name = f"{self.prefix[role]}{stop:%y}{stop.month:X}{stop:%d%H.%M%S}00"
        return self.folder[role] + name

    @property
    def duration(self) -> timedelta:
        """Duration of a file."""
        return timedelta(seconds=self.simulated.acquisition.duration)


@dataclass(frozen=True, slots=True)
class ChannelTruth:
    """What a retrieval should find in one channel of one file."""

    extinction: float
    """m-1; NaN where the path is not homogeneous."""
    background: float
    """Sky light: MHz before dead time, or mV without the dark offset."""
    amplitude: float
    """B of P = P* + B R^-2 exp(-2 sigma R), MHz m2 or mV m2; NaN where not homogeneous."""
    dark_offset: float
    """mV; NaN for photon counting."""


@dataclass(frozen=True, slots=True)
class FileTruth:
    """What is known of one simulated file."""

    path: str
    """In the archive, with forward slashes."""
    instrument: str
    time: datetime
    """Middle of the file."""
    channels: Mapping[str, ChannelTruth]
    damage: DamageKind | None

    @property
    def extinction(self) -> float:
        """The extinction, m-1, that all channels see; NaN where the path is not homogeneous."""
        return next(iter(self.channels.values())).extinction


@dataclass(frozen=True, slots=True)
class _Moment:
    """What is the same for all channels of one file."""

    site: Site
    role: Role
    middle: datetime
    facts: InstrumentFacts
    sun: float
    """Elevation of the sun, degree."""

    @property
    def zenith_angle(self) -> float:
        if self.facts.zenith_angle is not None:
            return self.facts.zenith_angle
        return 90.0 if isinstance(self.site.simulated, HorizontalPath) else 0.0


@dataclass(frozen=True, slots=True)
class _Light:
    """What falls on a detector, in MHz of photoelectrons."""

    rate: Array
    sky: float
    extinction: float
    amplitude: float


def channel_name(mode: DetectionMode, detector: Detector) -> str:
    """Return the name of a channel, as the reader of raw files makes it from the header."""
    return f"{mode.value}_{detector.label}"


def modes(detector: Detector) -> tuple[DetectionMode, ...]:
    """Return how a detector is read, in the order of the datasets in a file."""
    analog = () if detector.analog is None else (DetectionMode.ANALOG,)
    photon = () if detector.photon is None else (DetectionMode.PHOTON,)
    return analog + photon


def random_stream(seed: int, key: str, role: Role, index: int) -> np.random.Generator:
    """Return the random numbers of one file: the same whatever else is simulated, and when."""
    words = [seed, zlib.crc32(f"{key}/{role.value}".encode()), index]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(words)))


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


def simulate_file(site: Site, role: Role, index: int) -> tuple[bytes, FileTruth]:
    """Simulate one raw file.

    Parameters
    ----------
    site : Site
    role : Role
        A dark file has the telescope covered: offset and noise only.
    index : int
        From 0, among the files of that role.

    Returns
    -------
    content : bytes
        The same whichever other files are simulated before, beside or without this one.
    truth : FileTruth

    Raises
    ------
    CampaignError
        Where the campaign gives no dead time for a photon counter.
    RawFormatError
        Where a number does not fit the headers of raw files.
    """
    random = random_stream(site.settings.seed, site.key, role, index)
    start = site.start_of(role, index)
    moment = _Moment(
        site=site,
        role=role,
        middle=start + site.duration / 2,
        facts=site.instrument.facts_at(start),
        sun=solar_elevation(start + site.duration / 2, *_position(site)),
    )
    channels: dict[str, tuple[Dataset, Counts, ChannelTruth]] = {}
    for number, detector in enumerate(site.simulated.detectors):
        channels |= _read_out(moment, start, detector, number, random)
    path = site.name_of(role, index)
    header = new_header(
        name=path.rpartition("/")[2],
        site=site.instrument.station,
        start=start,
        stop=start + site.duration,
        altitude=site.station.altitude,
        longitude=site.station.longitude,
        latitude=site.station.latitude,
        zenith_angle=moment.zenith_angle,
        azimuth=moment.facts.azimuth,
        datasets=[dataset for dataset, _, _ in channels.values()],
        lasers=_lasers(site),
    )
    content = encode(header, {name: counts for name, (_, counts, _) in channels.items()})
    damage = site.damage_of(index) if role is Role.SIGNAL else None
    truth = FileTruth(
        path=path,
        instrument=site.key,
        time=moment.middle,
        channels={name: known for name, (_, _, known) in channels.items()},
        damage=damage,
    )
    return (content if damage is None else damaged(damage, content, random)), truth


def _position(site: Site) -> tuple[float, float]:
    return site.station.latitude, site.station.longitude


def _lasers(site: Site) -> tuple[Laser, Laser]:
    acquisition = site.simulated.acquisition
    return Laser(acquisition.shots, acquisition.repetition_rate), Laser(0, 0.0)


def _read_out(
    moment: _Moment,
    start: datetime,
    detector: Detector,
    number: int,
    random: np.random.Generator,
) -> dict[str, tuple[Dataset, Counts, ChannelTruth]]:
    site, acquisition = moment.site, moment.site.simulated.acquisition
    # Outputs with the same trigger delay share their photoelectrons, bin by bin.
    released: dict[float, Photoelectrons] = {}
    channels = {}
    for mode in modes(detector):
        name = channel_name(mode, detector)
        offset = channel_facts(moment.facts, name).range_offset or 0.0
        light = _light(moment, detector, offset)
        if offset not in released:
            released[offset] = release(
                light.rate,
                shots=acquisition.shots,
                bin_width=acquisition.bin_width,
                random=random,
            )
        if mode is DetectionMode.ANALOG and detector.analog is not None:
            counts = digitise(released[offset], detector.analog, random=random)
            unit, dark_offset = detector.analog.gain, detector.analog.dark_offset
        else:
            lost = dead_time(site, start, name)
            counts = count_photons(released[offset], dead_time=lost, random=random)
            unit, dark_offset = 1.0, math.nan
        truth = ChannelTruth(
            extinction=light.extinction,
            background=unit * light.sky,
            amplitude=unit * light.amplitude,
            dark_offset=dark_offset,
        )
        channels[name] = _dataset(acquisition, detector, mode, number), counts, truth
    return channels


def _light(moment: _Moment, detector: Detector, offset: float) -> _Light:
    site, acquisition = moment.site, moment.site.simulated.acquisition
    if moment.role is Role.DARK:
        return _Light(np.zeros(acquisition.bins), 0.0, math.nan, math.nan)
    wavelength = detector.wavelength * 1e-9
    distance = bin_centres(acquisition.bins, acquisition.bin_width, offset)
    path = path_at(
        site.simulated,
        moment=moment.middle,
        wavelength=wavelength,
        distance=distance,
        zenith_angle=moment.zenith_angle,
        station_altitude=site.station.altitude,
    )
    signal = backscatter_signal(
        distance,
        extinction=path.extinction,
        backscatter=path.backscatter,
        system_constant=detector.system_constant,
        full_overlap_range=moment.facts.full_overlap_range,
    )
    sky = detector.background
    glow = sky.night + (sky.day - sky.night) * sky_brightness(moment.sun)
    if not path.homogeneous:
        return _Light(signal + glow, glow, math.nan, math.nan)
    amplitude = detector.system_constant * float(path.backscatter[0])
    return _Light(signal + glow, glow, float(path.extinction[0]), amplitude)


def _dataset(
    acquisition: Acquisition, detector: Detector, mode: DetectionMode, number: int
) -> Dataset:
    analog = detector.analog if mode is DetectionMode.ANALOG else None
    level = 0 if detector.photon is None else detector.photon.discriminator_level
    return new_dataset(
        kind=DatasetKind.PHOTON if analog is None else DatasetKind.ANALOG,
        wavelength=detector.wavelength * 1e-9,
        polarisation=detector.polarisation,
        bins=acquisition.bins,
        bin_width=acquisition.bin_width,
        shots=acquisition.shots,
        high_voltage=detector.high_voltage,
        adc_bits=0 if analog is None else analog.adc_bits,
        input_range=0.0 if analog is None else analog.adc_range * 1e-3,
        discriminator=level * LICEL_DISCRIMINATOR_STEP,
        device=f"BC{number}" if analog is None else f"BT{number}",
    )
