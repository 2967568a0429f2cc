"""Simulate raw files: the bytes of each file, and its truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from lidarops.campaign.model import InstrumentFacts, channel_facts
from lidarops.campaign.simulated_instrument import (
    Acquisition,
    AnalogRecorder,
    DamageKind,
    Detector,
    PhotonCounter,
)
from lidarops.constants import LICEL_DISCRIMINATOR_STEP, LICEL_RANGE_PER_MICROSECOND
from lidarops.raw.licel import Dataset, DatasetKind, Header, encode, new_dataset, new_header
from lidarops.records import DetectionMode, Role
from lidarops.simulate.analog import digitise, digitise_fast
from lidarops.simulate.atmosphere import (
    Air,
    Beam,
    BeamPath,
    sky_brightness,
    solar_elevation,
)
from lidarops.simulate.counting import (
    BRIGHTEST,
    Photoelectrons,
    count_fast,
    count_photons,
    delay_recorder,
    release,
)
from lidarops.simulate.damage import damage_file
from lidarops.simulate.planned_files import (
    PlannedFile,
    SimulatedInstrument,
    channel_name,
    modes,
    photon_dead_time,
    random_stream,
    scan_grid,
)
from lidarops.simulate.pulse import pulse_echo
from lidarops.simulate.signal import backscatter_signal, bin_centres
from lidarops.simulate.truth import (
    ChannelTruth,
    FileTruth,
    ProfileTruth,
    TruthGrid,
    cell_stops,
)

Array = NDArray[np.float64]
AnyCounts = NDArray[np.signedinteger[Any]]
Key = tuple[object, ...]
Cached = TypeVar("Cached")

_CACHED: Final = 64
"""Entries of a cache; a full cache is emptied."""

_AIR_STEP: Final = timedelta(minutes=10)
"""Interval at which the air changes in a fast simulation."""


class _BinGrid(NamedTuple):
    """Range bins of a channel; see `bin_centres`."""

    bins: int
    bin_width: float
    offset: float


@dataclass(frozen=True, slots=True)
class _Conditions:
    """Conditions that all channels of one file share."""

    planned: PlannedFile
    acquisition: Acquisition
    start: datetime
    middle: datetime
    facts: InstrumentFacts
    zenith_angle: float
    azimuth: float | None
    sun: float
    """Elevation of the sun, degree."""
    energy: float
    """Laser energy, relative to the nominal energy."""
    hours: float
    """Hours since the start of the campaign."""
    beam: Beam
    air_time: datetime
    """Time at which the air is evaluated."""
    air_state: tuple[object, ...]


@dataclass(frozen=True, slots=True)
class _Light:
    """Light on a detector, in MHz of photoelectrons."""

    rate: Array
    sky: float
    extinction: float
    amplitude: float
    bin_time: float
    """s for which a bin is open after one shot."""
    electrons: Photoelectrons | None
    """None in a fast simulation."""


@dataclass(frozen=True, slots=True)
class _LaserSignal:
    """Signal at nominal laser energy, MHz of photoelectrons."""

    rate: Array
    extinction: float
    """m-1; NaN if the path is not homogeneous."""
    amplitude: float


class Simulator:
    """Simulator of the files of one instrument.

    Parameters
    ----------
    site : SimulatedInstrument
    """

    def __init__(self, site: SimulatedInstrument) -> None:
        self.site = site
        self._datasets: dict[tuple[int, float, int], tuple[Dataset, ...]] = {}
        self._paths: dict[Key, BeamPath] = {}
        self._signals: dict[Key, _LaserSignal] = {}
        self._position = site.position
        self._air = Air(
            site.settings.air_of(site.key),
            altitude=site.origin.altitude,
            start=site.settings.start,
            seed=site.settings.seed,
        )
        self.grid = _truth_grid(site)

    def simulate(self, planned: PlannedFile) -> tuple[bytes, FileTruth]:
        """Simulate one raw file.

        Parameters
        ----------
        planned : PlannedFile
            A dark file is taken with a covered telescope: offset and noise only.

        Returns
        -------
        content : bytes
            They do not depend on any other file.
        truth : FileTruth

        Raises
        ------
        CampaignError
            If the campaign gives no dead time for a photon counter.
        RawFormatError
            If a number does not fit the headers of raw files.
        """
        site = self.site
        random = random_stream(site.settings.seed, site.key, planned.role, planned.index)
        conditions = self._conditions(planned, random)
        channels: dict[str, tuple[AnyCounts, ChannelTruth]] = {}
        for detector in site.simulated.detectors:
            channels |= self._read_out(conditions, detector, random)
        header = self._header(conditions)
        counts = {name: values for name, (values, _) in channels.items()}
        if site.dialect.two_memories:
            # The second memory is empty, although the header shares the shots between both.
            counts |= {f"{name}_2": np.zeros_like(values) for name, values in counts.items()}
        content = encode(header, counts)
        damage = site.damage_of(planned.index) if planned.role is Role.SIGNAL else None
        if damage is not None:
            content = damage_file(damage, content, random)
        return content, FileTruth(
            path=site.path_of(planned),
            instrument=site.key,
            time=conditions.middle,
            zenith_angle=conditions.zenith_angle,
            azimuth=math.nan if conditions.azimuth is None else conditions.azimuth,
            clock_error=site.simulated.acquisition.clock_error(conditions.start)[1].total_seconds(),
            energy=conditions.energy,
            channels={name: values for name, (_, values) in channels.items()},
            damage=damage if planned.copy or damage is not DamageKind.DUPLICATE else None,
            profile=self._profile(conditions, [values for _, values in channels.values()]),
        )

    def _conditions(self, planned: PlannedFile, random: np.random.Generator) -> _Conditions:
        site = self.site
        start = site.start_of(planned.role, planned.index)
        middle = start + site.duration_of(planned) / 2
        hours = (middle - site.settings.start).total_seconds() / 3600.0
        facts = site.instrument.facts_at(start)
        acquisition = site.acquisition_of(planned.role, planned.index)
        zenith, azimuth = site.pointing_of(planned, facts)
        air_time = self._air_time(middle)
        return _Conditions(
            planned=planned,
            acquisition=acquisition,
            start=start,
            middle=middle,
            facts=facts,
            zenith_angle=zenith,
            azimuth=azimuth,
            sun=solar_elevation(middle, site.station.latitude, site.station.longitude),
            energy=site.simulated.laser.energy(hours, acquisition.shots, random),
            hours=hours,
            beam=Beam(*self._position, zenith, azimuth or 0.0),
            air_time=air_time,
            air_state=self._air.state(air_time),
        )

    def _header(self, conditions: _Conditions) -> Header:
        site, acquisition = self.site, conditions.acquisition
        dialect, pointing = site.dialect, site.simulated.pointing
        _, error = site.simulated.acquisition.clock_error(conditions.start)
        start = conditions.start + error
        scan = scan_grid(pointing.cycle()) if pointing is not None and dialect.scans else None
        longitude, latitude = site.written_position
        temperature, pressure = dialect.weather
        return new_header(
            name=site.name_of(conditions.planned),
            site=dialect.site_of(site.instrument.station, site.station.name),
            start=start,
            stop=start + site.duration_of(conditions.planned) if scan is None else start,
            altitude=site.station.altitude,
            longitude=longitude,
            latitude=latitude,
            zenith_angle=dialect.written_zenith(conditions.zenith_angle, scan),
            azimuth=conditions.azimuth if dialect.holds_azimuth else None,
            scan=scan,
            datasets=self._dataset_lines(acquisition),
            lasers=dialect.lasers(acquisition.shots, acquisition.repetition_rate),
            dialect=dialect.layout,
            temperature=temperature,
            pressure=pressure,
        )

    def _dataset_lines(self, acquisition: Acquisition) -> tuple[Dataset, ...]:
        key = acquisition.bins, acquisition.bin_width, acquisition.shots
        if key not in self._datasets:
            self._datasets[key] = tuple(
                _dataset(
                    self.site,
                    acquisition.model_copy(update={"shots": shots}),
                    detector,
                    mode,
                    number,
                )
                for number, detector in enumerate(self.site.simulated.detectors)
                for shots in self.site.dialect.shots_of_memories(acquisition.shots)
                for mode in modes(detector)
            )
        return self._datasets[key]

    def _read_out(
        self, conditions: _Conditions, detector: Detector, random: np.random.Generator
    ) -> dict[str, tuple[AnyCounts, ChannelTruth]]:
        lights = self._lights(conditions, detector, random)
        shots = conditions.acquisition.shots
        channels: dict[str, tuple[AnyCounts, ChannelTruth]] = {}
        for mode in modes(detector):
            name = channel_name(mode, detector)
            light = lights[_offset(conditions, name)]
            if mode is DetectionMode.ANALOG and detector.analog is not None:
                recorder = _drifted(detector.analog, conditions.hours)
                counts = self._digitised(light, recorder, conditions, random)
                unit, dark_offset = recorder.gain, recorder.dark_offset
            else:
                counter: Callable[..., AnyCounts] = (
                    partial(count_photons, light.electrons)
                    if light.electrons
                    else partial(count_fast, light.rate, shots=shots, bin_time=light.bin_time)
                )
                counts = counter(
                    dead_time=photon_dead_time(self.site, conditions.start, name),
                    paralyzable=(detector.photon or PhotonCounter()).paralyzable,
                    random=random,
                )
                unit, dark_offset = 1.0, math.nan
            channels[name] = (
                counts,
                ChannelTruth(
                    total_extinction=light.extinction,
                    background=unit * light.sky,
                    amplitude=unit * light.amplitude,
                    dark_offset=dark_offset,
                ),
            )
        return channels

    def _digitised(
        self,
        light: _Light,
        recorder: AnalogRecorder,
        conditions: _Conditions,
        random: np.random.Generator,
    ) -> AnyCounts:
        if light.electrons is not None:
            return digitise(light.electrons, recorder, random=random)
        return digitise_fast(
            light.rate,
            recorder,
            shots=conditions.acquisition.shots,
            bin_time=light.bin_time,
            random=random,
        )

    def _lights(
        self, conditions: _Conditions, detector: Detector, random: np.random.Generator
    ) -> dict[float, _Light]:
        """Return the light on the recorders of a detector, by range offset.

        All recorders of a detector share its photoelectrons, each in its own bins.
        """
        offsets = sorted(
            {_offset(conditions, channel_name(mode, detector)) for mode in modes(detector)}
        )
        bins, bin_width = _grid_of(conditions.acquisition, detector)
        first = offsets[0]
        if len(offsets) == 1 or self.site.settings.fast:
            return {
                offset: self._light(conditions, detector, _BinGrid(bins, bin_width, offset), random)
                for offset in offsets
            }
        extra = math.ceil((offsets[-1] - first) / bin_width) + 1
        common = self._light(conditions, detector, _BinGrid(bins + extra, bin_width, first), random)
        lights = {}
        for offset in offsets:
            start = (offset - first) / bin_width
            electrons = delay_recorder(
                cast("Photoelectrons", common.electrons), start, bins, random=random
            )
            lights[offset] = replace(common, rate=electrons.rate, electrons=electrons)
        return lights

    def _light(
        self,
        conditions: _Conditions,
        detector: Detector,
        grid: _BinGrid,
        random: np.random.Generator,
    ) -> _Light:
        bins, bin_width, _ = grid
        shots = conditions.acquisition.shots
        if conditions.planned.role is Role.DARK:
            rate, sky, extinction, amplitude = np.zeros(bins), 0.0, math.nan, math.nan
        else:
            signal = self._laser_signal(conditions, detector, grid)
            background = detector.background
            sky = background.night + (background.day - background.night) * sky_brightness(
                conditions.sun
            )
            rate = np.minimum(conditions.energy * signal.rate + sky, BRIGHTEST)
            extinction, amplitude = signal.extinction, conditions.energy * signal.amplitude
        electrons = None
        if not self.site.settings.fast:
            electrons = release(rate, shots=shots, bin_width=bin_width, random=random)
        bin_time = bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6
        return _Light(rate, sky, extinction, amplitude, bin_time, electrons)

    def _laser_signal(
        self, conditions: _Conditions, detector: Detector, grid: _BinGrid
    ) -> _LaserSignal:
        full = conditions.facts.full_overlap_range
        key = detector.label, full, grid, conditions.beam, conditions.air_state
        if key in self._signals:
            return self._signals[key]
        path = self._path(conditions, detector.wavelength * 1e-9, grid)
        distance = bin_centres(*grid)
        constant = detector.system_constant
        pulse = self.site.simulated.pulse
        if detector.raman is not None:
            rate = backscatter_signal(
                distance,
                extinction=self._path(conditions, detector.raman.laser * 1e-9, grid).extinction,
                backscatter=self._air.raman_along(conditions.beam, distance, detector.raman),
                system_constant=constant,
                full_overlap_range=full,
                returning_extinction=path.extinction,
            )
            signal = _LaserSignal(rate, math.nan, math.nan)
            return _cache(self._signals, key, signal)
        if pulse is None:
            rate = backscatter_signal(
                distance,
                extinction=path.extinction,
                backscatter=path.backscatter,
                system_constant=constant,
                full_overlap_range=full,
            )
        else:
            rate = pulse_echo(
                distance, path, pulse, system_constant=constant, full_overlap_range=full
            )
        extinction = amplitude = math.nan
        if path.homogeneous:
            extinction = float(path.extinction[0])
            amplitude = constant * float(path.backscatter[0])
        return _cache(self._signals, key, _LaserSignal(rate, extinction, amplitude))

    def _path(self, conditions: _Conditions, wavelength: float, grid: _BinGrid) -> BeamPath:
        key = wavelength, grid, conditions.beam, conditions.air_state
        if key in self._paths:
            return self._paths[key]
        path = self._air.along(conditions.beam, bin_centres(*grid), conditions.air_time, wavelength)
        return _cache(self._paths, key, path)

    def _air_time(self, middle: datetime) -> datetime:
        start = self.site.settings.start
        if not self.site.settings.fast:
            return middle
        return start + (middle - start) // _AIR_STEP * _AIR_STEP

    def _profile(
        self, conditions: _Conditions, channels: Sequence[ChannelTruth]
    ) -> ProfileTruth | None:
        planned, grid = conditions.planned, self.grid
        homogeneous = all(math.isfinite(channel.total_extinction) for channel in channels)
        skipped = planned.role is Role.DARK or planned.index % grid.stride
        if skipped or homogeneous or grid.stops.size < 2:
            return None
        bins = _BinGrid(int(grid.stops[-1]), grid.bin_width, 0.0)
        paths = [self._path(conditions, wavelength, bins) for wavelength in grid.wavelengths]
        extinction = np.stack([path.extinction for path in paths])
        backscatter = np.stack([path.backscatter for path in paths])
        return ProfileTruth(grid.mean(extinction), grid.mean(backscatter), grid.depth(extinction))


def _offset(conditions: _Conditions, channel: str) -> float:
    return channel_facts(conditions.facts, channel).range_offset or 0.0


def _cache(cache: dict[Key, Cached], key: Key, value: Cached) -> Cached:
    if len(cache) >= _CACHED:
        cache.clear()
    cache[key] = value
    return value


def _drifted(recorder: AnalogRecorder, hours: float) -> AnalogRecorder:
    if not recorder.dark_drift:
        return recorder
    offset = max(recorder.dark_offset + recorder.dark_drift * hours, 0.0)
    return recorder.model_copy(update={"dark_offset": offset})


def _grid_of(acquisition: Acquisition, detector: Detector) -> tuple[int, float]:
    """Return bins and bin width (m) of a detector."""
    return detector.bins or acquisition.bins, detector.bin_width or acquisition.bin_width


def _truth_grid(site: SimulatedInstrument) -> TruthGrid:
    settings, acquisition = site.settings, site.simulated.acquisition
    grids = [_grid_of(acquisition, detector) for detector in site.simulated.detectors]
    bin_width = min(width for _, width in grids)
    bins = int(max(bins * width for bins, width in grids) // bin_width)
    return TruthGrid(
        instrument=site.key,
        wavelengths=tuple(sorted({d.wavelength * 1e-9 for d in site.simulated.detectors})),
        bin_width=bin_width,
        stops=cell_stops(bins, bin_width, settings.truth.cells),
        stride=-(-settings.files(site.key) // settings.truth.profiles),
    )


def _dataset(
    site: SimulatedInstrument,
    acquisition: Acquisition,
    detector: Detector,
    mode: DetectionMode,
    number: int,
) -> Dataset:
    analog = detector.analog if mode is DetectionMode.ANALOG else None
    level = 0 if detector.photon is None else detector.photon.discriminator_level
    bins, bin_width = _grid_of(acquisition, detector)
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
    return site.dialect.written_dataset(dataset)
