"""Simulate raw files: the bytes of each file, and its truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

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
from lidarops.raw.licel import (
    Dataset,
    DatasetKind,
    Header,
    Place,
    Recorder,
    encode,
    new_dataset,
    new_header,
)
from lidarops.records import Role
from lidarops.simulate.analog import digitise
from lidarops.simulate.atmosphere import (
    Air,
    Beam,
    BeamPath,
    sky_brightness,
    solar_elevation,
)
from lidarops.simulate.counting import (
    Counts,
    Photoelectrons,
    count_photons,
    delay_recorder,
    release,
)
from lidarops.simulate.damage import damage_file
from lidarops.simulate.planned_files import (
    PlannedFile,
    SimulatedInstrument,
    photon_dead_time,
    random_stream,
    scan_grid,
)
from lidarops.simulate.pulse import pulse_echo
from lidarops.simulate.signal import backscatter_signal, bin_centres
from lidarops.simulate.truth import FileTruth, TruthGrid, cell_stops

Array = NDArray[np.float64]
Key = tuple[object, ...]
Cached = TypeVar("Cached")

_CACHED: Final = 64
"""Entries of a cache; a full cache is emptied."""

_SAME: Final = 1e-9
"""Relative difference below which two extinctions count as equal."""
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
    facts: InstrumentFacts
    middle: datetime
    hours: float
    """From the start of the campaign to the middle of the file."""
    zenith_angle: float
    azimuth: float | None
    sky: float
    """Brightness of the sky, relative to that with the sun at the zenith."""
    energy: float
    """Laser energy, relative to the nominal energy."""
    beam: Beam
    air_time: datetime
    """Time at which the air is evaluated."""
    air_state: tuple[object, ...]


@dataclass(frozen=True, slots=True)
class _Light:
    """Light on a detector, in MHz of photoelectrons."""

    electrons: Photoelectrons
    sky: float = 0.0
    extinction: float = math.nan
    """m-1; NaN if the path is not homogeneous."""
    amplitude: float = math.nan


class _Nominal(NamedTuple):
    """Light at nominal laser energy, without sky."""

    rate: Array
    extinction: float
    amplitude: float


class Simulator:
    """Simulator of the files of one instrument."""

    def __init__(self, site: SimulatedInstrument) -> None:
        self.site = site
        self._datasets: dict[tuple[int, float, int], tuple[Dataset, ...]] = {}
        self._paths: dict[Key, BeamPath] = {}
        self._signals: dict[Key, _Nominal] = {}
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
        counts: dict[str, Counts] = {}
        true: dict[str, float] = {}
        for detector in site.simulated.detectors:
            lights = self._lights(conditions, detector, random)
            for name, recorder in detector.recorders.items():
                light = lights[_offset(conditions, name)]
                counts[name], about = self._read_out(conditions, name, recorder, light, random)
                true |= {f"{quantity}_{name}": value for quantity, value in about.items()}
        if site.dialect.scans:
            # The second memory is empty, although the header shares the shots between both.
            counts |= {f"{name}_2": np.zeros_like(row) for name, row in counts.items()}
        content = encode(self._header(conditions), counts)
        damage = planned.damage
        if damage is not None:
            content = damage_file(damage, content, random)
        extinctions = [true[name] for name in true if name.startswith("total_extinction")]
        first = extinctions[0]
        alike = all(abs(value - first) <= _SAME * first for value in extinctions)
        values: dict[str, Any] = {
            **true,
            "path": planned.path,
            "instrument": site.key,
            "time": np.datetime64(conditions.middle.replace(tzinfo=None), "ns"),
            "zenith_angle": conditions.zenith_angle,
            "azimuth": math.nan if conditions.azimuth is None else conditions.azimuth,
            "clock_error": planned.clock_error.total_seconds(),
            "energy": conditions.energy,
            "total_extinction": first if alike else math.nan,
            "damage": damage.value
            if damage and (planned.copy or damage is not DamageKind.DUPLICATE)
            else "",
        }
        homogeneous = all(map(math.isfinite, extinctions))
        return content, FileTruth(values, None if homogeneous else self._profile(conditions))

    def _conditions(self, planned: PlannedFile, random: np.random.Generator) -> _Conditions:
        site, acquisition = self.site, planned.acquisition
        middle = planned.start + planned.duration / 2
        hours = (middle - site.settings.start).total_seconds() / 3600.0
        facts = site.instrument.facts_at(planned.start)
        zenith, azimuth = site.pointing_of(planned, facts)
        sun = solar_elevation(middle, site.station.latitude, site.station.longitude)
        air_time, begin = middle, site.settings.start
        if site.settings.fast:
            air_time = begin + (middle - begin) // _AIR_STEP * _AIR_STEP
        return _Conditions(
            planned=planned,
            acquisition=acquisition,
            facts=facts,
            middle=middle,
            hours=hours,
            zenith_angle=zenith,
            azimuth=azimuth,
            sky=sky_brightness(sun),
            energy=site.simulated.laser.energy(hours, acquisition.shots, random),
            beam=Beam(*self._position, zenith, azimuth or 0.0),
            air_time=air_time,
            air_state=self._air.state(air_time),
        )

    def _header(self, conditions: _Conditions) -> Header:
        site, planned, acquisition = self.site, conditions.planned, conditions.acquisition
        dialect = site.dialect
        start = planned.start + planned.clock_error
        scan = scan_grid(site.scan.cycle()) if site.scan is not None and dialect.scans else None
        return new_header(
            name=planned.name,
            place=Place(
                dialect.site_of(site.instrument.station, site.station.name),
                site.station.altitude,
                *site.written_position,
                dialect.written_zenith(conditions.zenith_angle, scan),
                conditions.azimuth if dialect.holds_azimuth else None,
                *dialect.weather,
            ),
            start=start,
            stop=start + planned.duration if scan is None else start,
            scan=scan,
            datasets=self._dataset_lines(acquisition),
            lasers=dialect.lasers(acquisition.shots, acquisition.repetition_rate),
            dialect=dialect.layout,
        )

    def _dataset_lines(self, acquisition: Acquisition) -> tuple[Dataset, ...]:
        key = acquisition.bins, acquisition.bin_width, acquisition.shots
        if key not in self._datasets:
            self._datasets[key] = tuple(
                self._dataset(number, recorder, shots, *_grid_of(acquisition, detector))
                for number, detector in enumerate(self.site.simulated.detectors)
                for shots in self.site.dialect.shots_of_memories(acquisition.shots)
                for recorder in detector.recorders.values()
            )
        return self._datasets[key]

    def _dataset(
        self,
        number: int,
        recorder: AnalogRecorder | PhotonCounter,
        shots: int,
        bins: int,
        bin_width: float,
    ) -> Dataset:
        """Return the line of a recorder of detector `number`."""
        detector, dialect = self.site.simulated.detectors[number], self.site.dialect
        if isinstance(recorder, AnalogRecorder):
            written = Recorder(
                DatasetKind.ANALOG,
                f"BT{number}",
                detector.high_voltage,
                adc_bits=recorder.adc_bits,
                input_range=recorder.adc_range * 1e-3,
            )
        else:
            written = Recorder(DatasetKind.PHOTON, f"BC{number}", detector.high_voltage)
        dataset = new_dataset(
            written,
            wavelength=detector.wavelength * 1e-9,
            polarisation=detector.polarisation,
            bins=bins,
            bin_width=bin_width,
            shots=shots,
            laser=dialect.laser,
        )
        return dialect.written_dataset(dataset)

    def _read_out(
        self,
        conditions: _Conditions,
        channel: str,
        recorder: AnalogRecorder | PhotonCounter,
        light: _Light,
        random: np.random.Generator,
    ) -> tuple[Counts, dict[str, float]]:
        """Return the counts of a recorder, and its true values."""
        unit, dark = 1.0, {}
        if isinstance(recorder, AnalogRecorder):
            drifted = _drifted(recorder, conditions.hours)
            counts = digitise(light.electrons, drifted, random=random)
            unit, dark = drifted.gain, {"dark_offset": drifted.dark_offset}
        else:
            counts = count_photons(
                light.electrons,
                dead_time=photon_dead_time(self.site, conditions.planned.start, channel),
                paralyzable=recorder.paralyzable,
                random=random,
            )
        return counts, {
            "total_extinction": light.extinction,
            "background": unit * light.sky,
            "amplitude": unit * light.amplitude,
            **dark,
        }

    def _lights(
        self, conditions: _Conditions, detector: Detector, random: np.random.Generator
    ) -> dict[float, _Light]:
        """Return the light on the recorders of a detector, by range offset.

        All recorders of a detector share its photoelectrons, each in its own bins.
        """
        offsets = sorted({_offset(conditions, name) for name in detector.recorders})
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
            electrons = delay_recorder(common.electrons, start, bins, random=random)
            lights[offset] = replace(common, electrons=electrons)
        return lights

    def _light(
        self,
        conditions: _Conditions,
        detector: Detector,
        grid: _BinGrid,
        random: np.random.Generator,
    ) -> _Light:
        released = partial(
            release,
            shots=conditions.acquisition.shots,
            bin_width=grid.bin_width,
            random=None if self.site.settings.fast else random,
        )
        if conditions.planned.role is Role.DARK:
            return _Light(released(np.zeros(grid.bins)))
        nominal, energy = self._nominal_light(conditions, detector, grid), conditions.energy
        background = detector.background
        sky = background.night + (background.day - background.night) * conditions.sky
        electrons = released(energy * nominal.rate + sky)
        return _Light(electrons, sky, nominal.extinction, energy * nominal.amplitude)

    def _nominal_light(
        self, conditions: _Conditions, detector: Detector, grid: _BinGrid
    ) -> _Nominal:
        full = conditions.facts.full_overlap_range
        key = detector.label, full, grid, conditions.beam, conditions.air_state
        if key in self._signals:
            return self._signals[key]
        path = self._path(conditions, detector.wavelength * 1e-9, grid)
        distance = bin_centres(*grid)
        constant, pulse = detector.system_constant, self.site.simulated.pulse
        receiver: dict[str, Any] = {"system_constant": constant, "full_overlap_range": full}
        extinction = amplitude = math.nan
        if detector.raman is not None:
            rate = backscatter_signal(
                distance,
                extinction=self._path(conditions, detector.raman.laser * 1e-9, grid).extinction,
                backscatter=self._air.raman_along(conditions.beam, distance, detector.raman),
                returning_extinction=path.extinction,
                **receiver,
            )
        elif pulse is None:
            rate = backscatter_signal(
                distance, extinction=path.extinction, backscatter=path.backscatter, **receiver
            )
        else:
            rate = pulse_echo(distance, path, pulse, **receiver)
        if path.homogeneous and detector.raman is None:
            extinction = float(path.extinction[0])
            amplitude = constant * float(path.backscatter[0])
        return _cache(self._signals, key, _Nominal(rate, extinction, amplitude))

    def _path(self, conditions: _Conditions, wavelength: float, grid: _BinGrid) -> BeamPath:
        key = wavelength, grid, conditions.beam, conditions.air_state
        if key in self._paths:
            return self._paths[key]
        path = self._air.along(conditions.beam, bin_centres(*grid), conditions.air_time, wavelength)
        return _cache(self._paths, key, path)

    def _profile(self, conditions: _Conditions) -> dict[str, NDArray[np.float32]] | None:
        planned, grid = conditions.planned, self.grid
        if planned.role is Role.DARK or planned.index % grid.stride or grid.stops.size < 2:
            return None
        bins = _BinGrid(int(grid.stops[-1]), grid.bin_width, 0.0)
        paths = [self._path(conditions, wavelength, bins) for wavelength in grid.wavelengths]
        extinction = np.stack([path.extinction for path in paths])
        return grid.profile(extinction, np.stack([path.backscatter for path in paths]))


def _offset(conditions: _Conditions, channel: str) -> float:
    facts = conditions.facts
    return (channel_facts(facts, channel).range_offset or 0.0) - facts.pre_trigger


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
        wavelengths=tuple(sorted({d.wavelength * 1e-9 for d in site.simulated.detectors})),
        bin_width=bin_width,
        stops=cell_stops(bins, bin_width, settings.truth.cells),
        stride=-(-settings.files(site.key) // settings.truth.profiles),
    )
