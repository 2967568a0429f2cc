"""Steps of the product ``raman``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, cast

import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.constants import KNOWN_SHAPE_PAPERS
from lidarops.products.raman.settings import RamanProductSettings
from lidarops.products.raman.variables import LAYOUT
from lidarops.retrieve.background.detectable_light import detect_light, spaced_indices
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.scattering import (
    NITROGEN_SHIFT,
    WATER_SHIFT,
    is_raman_line,
    raman_wavelength,
)
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.retrieve.signal.labeled_averaging import MEANS_TOGETHER
from lidarops.retrieve.signal.labeled_screening import Screening
from lidarops.retrieve.signal.screening import cloud_contrast
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.case import ProductCase
from lidarops.steps.channels import file_channels, member_channel, range_channel, wavelength
from lidarops.steps.conditioning import FULL_OVERLAP_RANGE, OVERLAP, PROFILES
from lidarops.steps.data import (
    Chunk,
    Data,
    ProductStream,
    RowProduct,
    WholeProduct,
    in_one_batch,
)
from lidarops.steps.pointing import fixed_zenith
from lidarops.steps.preparation import AVERAGE, MOLECULES, Average, with_methods
from lidarops.steps.profiles import ScreenedAverages
from lidarops.steps.reading import WAVELENGTH
from lidarops.steps.signal_to_noise import with_low_signal_to_noise
from lidarops.steps.step import REQUESTED, Decisions, Leave, ProductStep, Run
from lidarops.steps.workload import Workload

Case = ProductCase[RamanProductSettings]

LOOKED_AT: Final = 64
"""Profiles of a scene that are looked at for a Raman signal."""
NEAREST: Final = 500.0
FARTHEST: Final = 3000.0
"""m; where the Raman signal is looked for: beyond most overlap, before it gets weak."""
LEAST_SIGNAL: Final = 4.0
"""Standard errors of the signal of a profile. In 64 profiles of noise, the largest exceeds this in
0.2 % of scenes."""


STANDARD_SLOPE_ERROR: Final = 1.6e-5
"""m-1, of the derivative of the logarithm of the density of the standard atmosphere: root mean
square from 0.1 to 12 km of its deviation from the sounding of Manaus
(`tests/end_to_end/test_raman.py`), 16 K warmer."""
SOUNDING_SLOPE_ERROR: Final = 2e-6
"""m-1, the same of a sounding or model: 0.5 K over 1 km. Assumed."""


class RetrievalSettings(SettingsModel):
    """Settings of the step ``raman``; lengths are along the beam."""

    nitrogen: str
    water_vapour: str | None = None
    calibration: float | None = None
    """kg kg-1 per ratio of the signals of water vapour and nitrogen."""
    calibration_standard_error: float | None = None
    lowest: float = quantity(unit="m", description="of the reference window")
    highest: float = quantity(unit="m", description="of the reference window")
    width: float = quantity(unit="m", description="of the reference window")
    scattering_ratio: float
    reference_relative_error: float
    cell: float = quantity(unit="m")
    farthest: float = quantity(unit="m")
    known_shape: bool
    angstrom_exponent: float
    angstrom_standard_error: float
    molecular_relative_error: float
    molecular_slope_error: float = quantity(unit="m-1", description="along the beam")
    overlap_relative_error: float
    filter_width: float | None = quantity(None, unit="m")
    least_signal_to_noise: float


_AVERAGE: Final = Average("the noise of a single profile is too large for Raman signals")


@dataclass(frozen=True, slots=True)
class _Limits:
    """Stretch of ranges along the beam, and why there is none."""

    stretch: float
    reach: float
    reason: str


def _limits(case: Case) -> _Limits:
    zenith, reason = fixed_zenith(case)
    stretch = 1.0 / math.cos(math.radians(zenith)) if not reason else math.nan
    reach = case.last - 0.5 * case.channel.bin_width
    window = case.request.reference
    if (
        not reason
        and min(window.highest * stretch, reach) < (window.lowest + window.width) * stretch
    ):
        reason = (
            f"the last bin at {reach:g} m is too near for a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    return _Limits(stretch, reach, reason)


def _slope_error(case: Case) -> float:
    """Return the error of the derivative of the logarithm of the density of air, m-1 of height."""
    stated = case.request.molecular_slope_error
    if stated is not None:
        return stated
    return SOUNDING_SLOPE_ERROR if case.facts.molecular_profile else STANDARD_SLOPE_ERROR


def _absent(case: Case, channel: str, gas: str, shift: float) -> str:
    """Return why a Raman channel of a gas cannot be used; empty where it can."""
    layout = case.scene.layout
    try:
        found = member_channel(layout, channel)
    except StopIteration:
        held = ", ".join(known.name for known in layout)
        return f"the files hold no channel {channel}, only {held}"
    if found.bin_width != case.channel.bin_width:
        return (
            f"{channel} has bins of {found.bin_width:g} m, {case.channel.bin_width:g} m are needed"
        )
    length = wavelength(found, channel_facts(case.facts, range_channel(channel)))
    own = wavelength(case.channel, channel_facts(case.facts, range_channel(case.channel.name)))
    if not is_raman_line(length, own, shift):
        return (
            f"{channel} measures {length * 1e9:g} nm, but the Raman line of {gas} for"
            f" {own * 1e9:g} nm is at {raman_wavelength(own, shift) * 1e9:.1f} nm: name the channel"
            " of that line, or correct wavelength in the facts"
        )
    return ""


class Raman(ProductStep[RamanProductSettings, RetrievalSettings]):
    """Retrieve extinction, backscatter and lidar ratio from averaged signals."""

    name = "raman"
    settings = RetrievalSettings
    inputs = (PROFILES, WAVELENGTH, FULL_OVERLAP_RANGE, OVERLAP, AVERAGE, MOLECULES)
    from_companions = (PROFILES, WAVELENGTH)
    parts = (_AVERAGE,)

    def decide(self, case: Case) -> Decisions:
        """Run where a fixed beam reaches the reference window, and the files hold the channels."""
        request, name = case.request, case.channel.name
        limits = _limits(case)
        nitrogen, water = request.nitrogen[name], request.water_vapour.get(name)
        reason = limits.reason or _absent(case, nitrogen, "nitrogen", NITROGEN_SHIFT)
        if reason:
            yield Leave(reason)
            return
        facts = None if water is None else channel_facts(case.facts, range_channel(water))
        absent = "" if water is None else _absent(case, water, "water vapour", WATER_SHIFT)
        if facts is not None and not absent and facts.water_vapour_calibration is None:
            absent = f"the facts of {water} give no water_vapour_calibration"
        if facts is None or absent:
            water, facts = None, None
        if absent:
            yield Leave(f"no water vapour: {absent}")
        window = request.reference
        settings = RetrievalSettings(
            nitrogen=nitrogen,
            water_vapour=water,
            calibration=facts.water_vapour_calibration if facts else None,
            calibration_standard_error=facts.water_vapour_calibration_error if facts else None,
            lowest=window.lowest * limits.stretch,
            highest=min(window.highest * limits.stretch, limits.reach),
            width=window.width * limits.stretch,
            scattering_ratio=window.scattering_ratio,
            reference_relative_error=window.relative_error,
            cell=request.cell,
            farthest=min(request.highest * limits.stretch, limits.reach),
            known_shape=request.background == "known_shape",
            angstrom_exponent=request.angstrom_exponent,
            angstrom_standard_error=request.angstrom_standard_error,
            molecular_relative_error=request.molecular_relative_error,
            molecular_slope_error=_slope_error(case) / limits.stretch,
            overlap_relative_error=request.overlap_relative_error,
            filter_width=request.filter_width,
            least_signal_to_noise=request.least_signal_to_noise,
        )
        yield Run(REQUESTED, settings)

    def companions(self, settings: RetrievalSettings) -> tuple[str, ...]:
        """Return the Raman channels."""
        water = settings.water_vapour
        return (settings.nitrogen,) if water is None else (settings.nitrogen, water)

    def stream(self, settings: RetrievalSettings, data: Data) -> ProductStream:
        """Return the product, whose averages are retrieved as they become complete."""
        dark = _without_signal(settings, data)
        if not dark:
            return _Retrieval(settings, data)
        data.notes.append(f"raman of {data.channel}: {dark}")
        return _Dark(settings, data, dark)

    def held(self, settings: RetrievalSettings, work: Workload) -> float:
        """Return the bytes of the averages that are completed together, and of their solution."""
        names = (work.channel, *self.companions(settings))
        records = sum(len(file_channels(name)) for name in names)
        together = min(_averages(work), MEANS_TOGETHER)
        return bytes_held(records, together, work.bins, settings.farthest / settings.cell)


def bytes_held(records: int, means: int, bins: int, cells: float) -> float:
    """Return the bytes of means of some records that are completed and solved together."""
    of_means = records * (_BYTES_OF_A_BIN * means + _BYTES_OF_PARTS) * bins
    return of_means + (_BYTES_OF_A_PROFILE * means + _BYTES_OF_A_SOLUTION) * cells**2


_BYTES_OF_PARTS: Final = 500.0
"""Bytes per bin of the parts of the open average of a record, of which glued channels have two."""
_BYTES_OF_A_BIN: Final = 205.0
"""Bytes per bin of a complete average of a record. Both are measured
(`tests/products/test_raman_memory.py`), as are those of the solution."""
_BYTES_OF_A_PROFILE: Final = 33.0
"""Bytes per pair of cells of each fitted profile: four matrices, kept until all are solved."""
_BYTES_OF_A_SOLUTION: Final = 80.0
"""Bytes per pair of cells of the profile that is being solved."""


def _averages(work: Workload) -> int:
    average = _AVERAGE.settings_in(work.plan)
    return work.intervals(average.seconds) if average else 0


def _assumptions(settings: RetrievalSettings, laser: float, raman: float) -> labeled.Assumptions:
    return labeled.Assumptions(
        RamanSettings(
            wavelength=laser,
            raman_wavelength=raman,
            angstrom_exponent=settings.angstrom_exponent,
            angstrom_standard_error=settings.angstrom_standard_error,
            lowest=settings.lowest,
            highest=settings.highest,
            width=settings.width,
            scattering_ratio=settings.scattering_ratio,
            reference_relative_error=settings.reference_relative_error,
            molecular_relative_error=settings.molecular_relative_error,
            overlap_relative_error=settings.overlap_relative_error,
            molecular_slope_error=settings.molecular_slope_error,
        ),
        cell=settings.cell,
        highest=settings.farthest,
        known_shape=settings.known_shape,
        filter_width=settings.filter_width,
    )


class _Retrieval(RowProduct):
    """Averages of the profiles of all channels, and their retrieval."""

    def __init__(self, settings: RetrievalSettings, data: Data) -> None:
        self._settings, self._data = settings, data
        self._begun = False
        names = [data.channel, *STEP.companions(settings)]
        source, shots = data.source, data[PROFILES].shots(data.source.archive)
        self._averages = ScreenedAverages(
            [_of(data, name)[PROFILES] for name in names],
            source.geometry,
            shots,
            data[AVERAGE],
            Screening(cloud_contrast(data[WAVELENGTH]), settings.highest),
        )

    def rows(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Add the next profiles to their averages, and yield those that are complete."""
        self._averages.add(chunk)
        for means in self._averages.completed():
            rows = self._retrieved(*means)
            if not self._begun:
                self._begun = True
                yield rows.drop_dims("time").assign_coords(self._averages.times.coords)
            yield rows

    def _retrieved(
        self, elastic: xr.Dataset, nitrogen: xr.Dataset, water: xr.Dataset | None = None
    ) -> xr.Dataset:
        data, settings = self._data, self._settings
        raman = _of(data, settings.nitrogen)[WAVELENGTH]
        overlap = data.get(OVERLAP)
        retrieved = labeled.retrieve(
            elastic.assign_coords(_pointing(data)),
            nitrogen,
            molecules=data[MOLECULES],
            station_altitude=data.source.station_altitude,
            assumptions=_assumptions(settings, data[WAVELENGTH], raman),
            water=None if water is None else self._water(water),
            overlap=None if overlap is None else overlap(elastic["range"].to_numpy()),
            overlap_is_stated=data.get(FULL_OVERLAP_RANGE) is not None,
        )
        if settings.known_shape:
            retrieved = retrieved.assign_attrs(references=KNOWN_SHAPE_PAPERS)
        weighed = [name for name in LAYOUT.weighed if name in retrieved]
        flagged = with_low_signal_to_noise(retrieved, weighed, settings.least_signal_to_noise)
        return with_methods(flagged, data[MOLECULES], known_shape=settings.known_shape)

    def _water(self, averages: xr.Dataset) -> labeled.WaterVapour:
        settings = self._settings
        # `Raman.decide` names the channel only with its calibration.
        name = cast("str", settings.water_vapour)
        constant = cast("float", settings.calibration)
        error = cast("float", settings.calibration_standard_error)
        return labeled.WaterVapour(averages, _of(self._data, name)[WAVELENGTH], constant, error)


def _of(data: Data, channel: str) -> Data:
    """Return what the steps of a channel gave."""
    return data if channel == data.channel else data.channels[channel]


def _pointing(data: Data) -> Mapping[str, float]:
    geometry = data.source.geometry
    names = [name for name in ("zenith_angle", "azimuth") if name in geometry]
    return {name: float(geometry[name][0]) for name in names}


def _without_signal(settings: RetrievalSettings, data: Data) -> str:
    """Return in words that no profile that is looked at has a Raman signal; empty if one has."""
    archive, profiles = data.source.archive, data.channels[settings.nitrogen][PROFILES]
    places = spaced_indices(archive.sizes["time"], LOOKED_AT)
    seen, most = 0, 0.0
    for place in places:
        power, variance, quality, length = (
            profiles.of(archive.isel(time=[place]))[name].to_numpy()
            for name in ("power", "variance", "quality", CORRELATION_LENGTH)
        )
        light = detect_light(power, variance * length, quality, profiles.range, NEAREST, FARTHEST)
        seen, most = seen + light.profiles, max(most, light.significance)
    if not seen or most >= LEAST_SIGNAL:
        return ""
    return (
        f"no signal of {settings.nitrogen} from {NEAREST:g} to {FARTHEST:g} m in {seen}"
        f" profiles looked at: at most {most:.1f} standard errors (limit {LEAST_SIGNAL:g});"
        " nothing is retrieved"
    )


class _Dark(WholeProduct):
    """A product without values, whose rows are the averages of a scene without Raman signal."""

    def __init__(self, settings: RetrievalSettings, data: Data, reason: str) -> None:
        self._settings, self._data, self._reason = settings, data, reason

    @property
    def reads(self) -> bool:
        """Nothing is read."""
        return False

    def add(self, chunk: Chunk) -> None:
        """Take nothing of the profiles."""

    def results(self) -> Iterator[xr.Dataset]:
        """Yield the empty product."""
        data, settings = self._data, self._settings
        source = data.source
        shots = data[PROFILES].shots(source.archive)
        means = data[PROFILES].averages(source.geometry, shots, data[AVERAGE])
        raman = _of(data, settings.nitrogen)[WAVELENGTH]
        empty = labeled.without_signal(
            means.times,
            shots.compute(),
            data[PROFILES].range,
            _pointing(data),
            molecules=data[MOLECULES],
            station_altitude=source.station_altitude,
            assumptions=_assumptions(settings, data[WAVELENGTH], raman),
        )
        product = with_methods(empty, data[MOLECULES], known_shape=settings.known_shape)
        return in_one_batch(product.assign_attrs(steps=f"raman: {self._reason}"))


STEP: Final = Raman()
