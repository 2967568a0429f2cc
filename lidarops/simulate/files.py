"""One simulated raw file: its bytes and the truth behind it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from lidarops.campaign.model import InstrumentFacts, channel_facts
from lidarops.campaign.simulation import (
    Acquisition,
    AnalogRecorder,
    DamageKind,
    Detector,
    PhotonCounter,
)
from lidarops.constants import LICEL_DISCRIMINATOR_STEP, LICEL_RANGE_PER_MICROSECOND
from lidarops.raw.licel import Dataset, DatasetKind, Header, encode, new_dataset
from lidarops.records import DetectionMode, Role
from lidarops.simulate.atmosphere import Air, Beam, Path
from lidarops.simulate.damage import damaged
from lidarops.simulate.dialects import Occasion, header_of, spelled
from lidarops.simulate.echo import echo
from lidarops.simulate.instrument import (
    BRIGHTEST,
    Laser,
    Photoelectrons,
    count_fast,
    count_photons,
    digitise,
    digitise_fast,
    release,
    seen_from,
)
from lidarops.simulate.signal import backscatter_signal, bin_centres
from lidarops.simulate.site import Order, Site, channel_name, dead_time, modes, random_stream
from lidarops.simulate.sun import sky_brightness, solar_elevation
from lidarops.simulate.truth import ChannelTruth, FileTruth, Grid, ProfileTruth, cell_stops

Array = NDArray[np.float64]
AnyCounts = NDArray[np.signedinteger[Any]]
Key = tuple[object, ...]
Kept = TypeVar("Kept")

_KEPT: Final = 64
"""Paths that are kept for the files to come."""

_STEP: Final = timedelta(minutes=10)
"""In which the air changes where an archive is simulated fast."""


class _Ranges(NamedTuple):
    """The bins of a channel; see `bin_centres`."""

    bins: int
    bin_width: float
    offset: float


@dataclass(frozen=True, slots=True)
class _Moment:
    """What is the same for all channels of one file."""

    order: Order
    acquisition: Acquisition
    start: datetime
    middle: datetime
    facts: InstrumentFacts
    zenith_angle: float
    azimuth: float | None
    sun: float
    """Elevation of the sun, degree."""
    energy: float
    """Of the laser, relative."""
    hours: float
    """Since the start of the campaign."""
    line: Beam
    air: datetime
    """When the air is as the file sees it."""
    state: tuple[object, ...]
    """Of the air."""


@dataclass(frozen=True, slots=True)
class _Light:
    """What falls on a detector, in MHz of photoelectrons."""

    rate: Array
    sky: float
    extinction: float
    amplitude: float
    bin_time: float
    """s for which a bin is open after one shot."""
    electrons: Photoelectrons | None
    """None where they are not drawn one by one."""


@dataclass(frozen=True, slots=True)
class _Beam:
    """The signal of a laser at full energy, MHz of photoelectrons."""

    signal: Array
    extinction: float
    """m-1; NaN where the path is not homogeneous."""
    amplitude: float


class Simulator:
    """Simulates the files of one instrument.

    Parameters
    ----------
    site : Site
    """

    def __init__(self, site: Site) -> None:
        self.site = site
        self._datasets: dict[tuple[int, float, int], tuple[Dataset, ...]] = {}
        self._paths: dict[Key, Path] = {}
        self._beams: dict[Key, _Beam] = {}
        self._position = site.position
        self._air = Air(
            site.settings.air_of(site.key),
            altitude=site.origin.altitude,
            start=site.settings.start,
            seed=site.settings.seed,
        )
        self.grid = _grid(site)

    def file(self, order: Order) -> tuple[bytes, FileTruth]:
        """Simulate one raw file.

        Parameters
        ----------
        order : Order
            A dark file has the telescope covered: offset and noise only.

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
        site = self.site
        random = random_stream(site.settings.seed, site.key, order.role, order.index)
        moment = self._moment(order, random)
        channels: dict[str, tuple[AnyCounts, ChannelTruth]] = {}
        for detector in site.simulated.detectors:
            channels |= self._read_out(moment, detector, random)
        header = self._header(moment)
        content = encode(header, {name: counts for name, (counts, _) in channels.items()})
        damage = site.damage_of(order.index) if order.role is Role.SIGNAL else None
        if damage is not None:
            content = damaged(damage, content, random)
        return content, FileTruth(
            path=site.path_of(order),
            instrument=site.key,
            time=moment.middle,
            zenith_angle=moment.zenith_angle,
            azimuth=math.nan if moment.azimuth is None else moment.azimuth,
            clock_error=site.simulated.acquisition.clock_error(moment.start)[1].total_seconds(),
            energy=moment.energy,
            channels={name: known for name, (_, known) in channels.items()},
            damage=damage if order.twin or damage is not DamageKind.DUPLICATE else None,
            profile=self._profile(moment, [known for _, known in channels.values()]),
        )

    def _moment(self, order: Order, random: np.random.Generator) -> _Moment:
        site = self.site
        start = site.start_of(order.role, order.index)
        middle = start + site.duration_of(order) / 2
        hours = (middle - site.settings.start).total_seconds() / 3600.0
        facts = site.instrument.facts_at(start)
        acquisition = site.acquisition_of(order.role, order.index)
        zenith, azimuth = site.pointing_of(order, facts)
        air = self._when(middle)
        return _Moment(
            order=order,
            acquisition=acquisition,
            start=start,
            middle=middle,
            facts=facts,
            zenith_angle=zenith,
            azimuth=azimuth,
            sun=solar_elevation(middle, site.station.latitude, site.station.longitude),
            energy=self._energy(hours, acquisition.shots, random),
            hours=hours,
            line=Beam(*self._position, zenith, azimuth or 0.0),
            air=air,
            state=self._air.state(air),
        )

    def _energy(self, hours: float, shots: int, random: np.random.Generator) -> float:
        drift = self.site.simulated.laser
        laser = Laser(
            per_hour=drift.per_hour, file_jitter=drift.jitter, shot_jitter=drift.shot_jitter
        )
        return laser.energy(hours, shots, random)

    def _header(self, moment: _Moment) -> Header:
        site, acquisition = self.site, moment.acquisition
        _, error = site.simulated.acquisition.clock_error(moment.start)
        start = moment.start + error
        occasion = Occasion(
            start=start,
            stop=start + site.duration_of(moment.order),
            zenith_angle=moment.zenith_angle,
            azimuth=moment.azimuth,
            shots=acquisition.shots,
            repetition_rate=acquisition.repetition_rate,
        )
        name = site.name_of(moment.order)
        return header_of(site.dialect, name, site.place, occasion, self._lines(acquisition))

    def _lines(self, acquisition: Acquisition) -> tuple[Dataset, ...]:
        key = acquisition.bins, acquisition.bin_width, acquisition.shots
        if key not in self._datasets:
            self._datasets[key] = tuple(
                _dataset(self.site, acquisition, detector, mode, number)
                for number, detector in enumerate(self.site.simulated.detectors)
                for mode in modes(detector)
            )
        return self._datasets[key]

    def _read_out(
        self, moment: _Moment, detector: Detector, random: np.random.Generator
    ) -> dict[str, tuple[AnyCounts, ChannelTruth]]:
        lights = self._lights(moment, detector, random)
        channels = {}
        for mode in modes(detector):
            name = channel_name(mode, detector)
            light = lights[_offset(moment, name)]
            if mode is DetectionMode.ANALOG and detector.analog is not None:
                recorder = _drifted(detector.analog, moment.hours)
                counts = self._digitised(light, recorder, moment, random)
                unit, dark_offset = recorder.gain, recorder.dark_offset
            else:
                lost = dead_time(self.site, moment.start, name)
                counter = detector.photon or PhotonCounter()
                counts = self._counted(light, counter, lost, moment, random)
                unit, dark_offset = 1.0, math.nan
            channels[name] = (
                counts,
                ChannelTruth(
                    extinction=light.extinction,
                    background=unit * light.sky,
                    amplitude=unit * light.amplitude,
                    dark_offset=dark_offset,
                ),
            )
        return channels

    def _lights(
        self, moment: _Moment, detector: Detector, random: np.random.Generator
    ) -> dict[float, _Light]:
        """Return what falls on the recorders of a detector, by their range offset.

        They see the same photoelectrons, each in its own bins.
        """
        offsets = sorted(
            {_offset(moment, channel_name(mode, detector)) for mode in modes(detector)}
        )
        bins, bin_width = grid_of(moment.acquisition, detector)
        first, fast_mode = offsets[0], self.site.settings.fast
        if len(offsets) == 1 or fast_mode:
            return {
                offset: self._light(moment, detector, _Ranges(bins, bin_width, offset), random)
                for offset in offsets
            }
        more = math.ceil((offsets[-1] - first) / bin_width) + 1
        whole = self._light(moment, detector, _Ranges(bins + more, bin_width, first), random)
        lights = {}
        for offset in offsets:
            start = (offset - first) / bin_width
            electrons = seen_from(
                cast("Photoelectrons", whole.electrons), start, bins, random=random
            )
            lights[offset] = replace(whole, rate=electrons.rate, electrons=electrons)
        return lights

    def _digitised(
        self, light: _Light, recorder: AnalogRecorder, moment: _Moment, random: np.random.Generator
    ) -> AnyCounts:
        if light.electrons is not None:
            return digitise(light.electrons, recorder, random=random)
        return digitise_fast(
            light.rate,
            recorder,
            shots=moment.acquisition.shots,
            bin_time=light.bin_time,
            random=random,
        )

    def _counted(
        self,
        light: _Light,
        counter: PhotonCounter,
        lost: float,
        moment: _Moment,
        random: np.random.Generator,
    ) -> AnyCounts:
        if light.electrons is not None:
            return count_photons(
                light.electrons, dead_time=lost, random=random, paralyzable=counter.paralyzable
            )
        return count_fast(
            light.rate,
            shots=moment.acquisition.shots,
            bin_time=light.bin_time,
            dead_time=lost,
            random=random,
            paralyzable=counter.paralyzable,
        )

    def _light(
        self, moment: _Moment, detector: Detector, ranges: _Ranges, random: np.random.Generator
    ) -> _Light:
        bins, bin_width, _ = ranges
        shots = moment.acquisition.shots
        if moment.order.role is Role.DARK:
            rate, glow, extinction, amplitude = np.zeros(bins), 0.0, math.nan, math.nan
        else:
            beam = self._beam(moment, detector, ranges)
            sky = detector.background
            glow = sky.night + (sky.day - sky.night) * sky_brightness(moment.sun)
            rate = np.minimum(moment.energy * beam.signal + glow, BRIGHTEST)
            extinction, amplitude = beam.extinction, moment.energy * beam.amplitude
        electrons = None
        if not self.site.settings.fast:
            electrons = release(rate, shots=shots, bin_width=bin_width, random=random)
        bin_time = bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6
        return _Light(rate, glow, extinction, amplitude, bin_time, electrons)

    def _beam(self, moment: _Moment, detector: Detector, ranges: _Ranges) -> _Beam:
        full = moment.facts.full_overlap_range
        key = detector.label, full, ranges, moment.line, moment.state
        if key in self._beams:
            return self._beams[key]
        path = self._path(moment, detector.wavelength * 1e-9, ranges)
        distance = bin_centres(*ranges)
        constant = detector.system_constant
        pulse = self.site.simulated.pulse
        if pulse is None:
            signal = backscatter_signal(
                distance,
                extinction=path.extinction,
                backscatter=path.backscatter,
                system_constant=constant,
                full_overlap_range=full,
            )
        else:
            signal = echo(distance, path, pulse, system_constant=constant, full_overlap_range=full)
        told = math.nan, math.nan
        if path.homogeneous:
            told = float(path.extinction[0]), constant * float(path.backscatter[0])
        return _kept(self._beams, key, _Beam(signal, *told))

    def _path(self, moment: _Moment, wavelength: float, ranges: _Ranges) -> Path:
        key = wavelength, ranges, moment.line, moment.state
        if key in self._paths:
            return self._paths[key]
        path = self._air.along(moment.line, bin_centres(*ranges), moment.air, wavelength)
        return _kept(self._paths, key, path)

    def _when(self, middle: datetime) -> datetime:
        start = self.site.settings.start
        if not self.site.settings.fast:
            return middle
        return start + (middle - start) // _STEP * _STEP

    def _profile(self, moment: _Moment, channels: Sequence[ChannelTruth]) -> ProfileTruth | None:
        order, grid = moment.order, self.grid
        told = all(math.isfinite(channel.extinction) for channel in channels)
        if order.role is Role.DARK or told or order.index % grid.every or grid.stops.size < 2:
            return None
        ranges = _Ranges(int(grid.stops[-1]), grid.bin_width, 0.0)
        paths = [self._path(moment, wavelength, ranges) for wavelength in grid.wavelengths]
        extinction = np.stack([path.extinction for path in paths])
        backscatter = np.stack([path.backscatter for path in paths])
        return ProfileTruth(grid.mean(extinction), grid.mean(backscatter), grid.depth(extinction))


def _offset(moment: _Moment, channel: str) -> float:
    return channel_facts(moment.facts, channel).range_offset or 0.0


def _kept(cache: dict[Key, Kept], key: Key, value: Kept) -> Kept:
    if len(cache) >= _KEPT:
        cache.clear()
    cache[key] = value
    return value


def _drifted(recorder: AnalogRecorder, hours: float) -> AnalogRecorder:
    if not recorder.dark_drift:
        return recorder
    offset = max(recorder.dark_offset + recorder.dark_drift * hours, 0.0)
    return recorder.model_copy(update={"dark_offset": offset})


def grid_of(acquisition: Acquisition, detector: Detector) -> tuple[int, float]:
    """Return bins and bin width (m) of a detector."""
    return detector.bins or acquisition.bins, detector.bin_width or acquisition.bin_width


def _grid(site: Site) -> Grid:
    settings, acquisition = site.settings, site.simulated.acquisition
    grids = [grid_of(acquisition, detector) for detector in site.simulated.detectors]
    bin_width = min(width for _, width in grids)
    bins = int(max(bins * width for bins, width in grids) // bin_width)
    return Grid(
        instrument=site.key,
        wavelengths=tuple(sorted({d.wavelength * 1e-9 for d in site.simulated.detectors})),
        bin_width=bin_width,
        stops=cell_stops(bins, bin_width, settings.truth.cells),
        every=-(-settings.files(site.key) // settings.truth.profiles),
    )


def _dataset(
    site: Site, acquisition: Acquisition, detector: Detector, mode: DetectionMode, number: int
) -> Dataset:
    analog = detector.analog if mode is DetectionMode.ANALOG else None
    level = 0 if detector.photon is None else detector.photon.discriminator_level
    bins, bin_width = grid_of(acquisition, detector)
    dataset = new_dataset(
        kind=DatasetKind.PHOTON if analog is None else DatasetKind.ANALOG,
        wavelength=detector.wavelength * 1e-9,
        polarisation=detector.polarisation,
        bins=bins,
        bin_width=bin_width,
        shots=acquisition.shots,
        laser=site.dialect.laser,
        high_voltage=detector.high_voltage,
        adc_bits=0 if analog is None else analog.adc_bits,
        input_range=0.0 if analog is None else analog.adc_range * 1e-3,
        discriminator=level * LICEL_DISCRIMINATOR_STEP,
        device=f"BC{number}" if analog is None else f"BT{number}",
    )
    return spelled(site.dialect, dataset)
