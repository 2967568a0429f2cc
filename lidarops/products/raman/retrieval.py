"""The product ``raman``: its decision, and its making."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, cast

import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.errors import SceneError
from lidarops.products.raman import RamanProduct
from lidarops.products.raman.variables import LAYOUT
from lidarops.records import file_channels
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.scattering import (
    NITROGEN_SHIFT,
    WATER_SHIFT,
    is_raman_line,
    raman_wavelength,
)
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled_averaging import MEANS_TOGETHER, Screening
from lidarops.scene.air import SLOPE
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, member_channel
from lidarops.scene.profiles import Averages, ChannelSignal, Chunk, ProductStream
from lidarops.scene.retrieval import (
    AverageSettings,
    Retrieval,
    Workload,
    average,
    before_pulse,
    reference_limits,
    with_low_signal_to_noise,
    with_methods,
)
from lidarops.settings import SettingsModel, quantity

Case = ChannelCase[RamanProduct]


class RetrievalEntry(SettingsModel, RamanSettings):
    """Settings of the entry ``raman``: those of the campaign, and what the scene gives."""

    nitrogen: str
    water_vapour: str | None = None
    calibration: float | None = None
    """kg kg-1 per ratio of the signals of water vapour and nitrogen."""
    calibration_standard_error: float | None = None
    zenith_angle: float = quantity(unit="degree")
    least_signal_to_noise: float

    @property
    def channels(self) -> tuple[str, ...]:
        """The Raman channels."""
        water = self.water_vapour
        return (self.nitrogen,) if water is None else (self.nitrogen, water)

    @property
    def stretch(self) -> float:
        """Length along the beam per height, m m-1."""
        return 1.0 / math.cos(math.radians(self.zenith_angle))


class RamanPlan(SettingsModel):
    """What a plan states of a product."""

    average: AverageSettings
    raman: RetrievalEntry


def _absent(case: Case, channel: str, gas: str, shift: float) -> str:
    """Return why a Raman channel of a gas cannot be used; empty where it can."""
    try:
        found = member_channel(case.scene.layout, channel)
    except SceneError as error:
        return error.problem
    if found.bin_width != case.channel.bin_width:
        return (
            f"{channel} has bins of {found.bin_width:g} m, {case.channel.bin_width:g} m are needed"
        )
    facts = channel_facts(case.facts, channel)
    length = facts.wavelength or found.wavelength
    own = case.facts_of_channel.wavelength or case.channel.wavelength
    if not is_raman_line(length, own, shift):
        return (
            f"{channel} measures {length * 1e9:g} nm, but the Raman line of {gas} for"
            f" {own * 1e9:g} nm is at {raman_wavelength(own, shift) * 1e9:.1f} nm: name the channel"
            " of that line, or correct wavelength in the facts"
        )
    return ""


def _needs(case: Case) -> Entries:
    """Retrieve extinction, backscatter and lidar ratio from averaged signals.

    Where a fixed beam reaches the reference window, and the files hold the channels.
    """
    request, name = case.request, case.channel.name
    zenith, limits = reference_limits(case, request.reference)
    nitrogen, water = request.nitrogen[name], request.water_vapour.get(name)
    absent = _absent(case, nitrogen, "nitrogen", NITROGEN_SHIFT)
    reason = limits if isinstance(limits, str) else absent
    if reason:
        yield case.leave("raman", reason)
        return
    facts = None if water is None else channel_facts(case.facts, water)
    absent = "" if water is None else _absent(case, water, "water vapour", WATER_SHIFT)
    if facts is not None and not absent and facts.water_vapour_calibration is None:
        absent = f"the facts of {water} give no water_vapour_calibration"
    if facts is None or absent:
        water, facts = None, None
    yield average(
        case, request.average, "the noise of a single profile is too large for Raman signals"
    )
    if absent:
        yield case.leave("raman", f"no water vapour: {absent}")
    settings = RetrievalEntry.taken_from(
        request,
        nitrogen=nitrogen,
        water_vapour=water,
        calibration=facts.water_vapour_calibration if facts else None,
        calibration_standard_error=facts.water_vapour_calibration_error if facts else None,
        zenith_angle=zenith,
    )
    taken = ["read", "overlap", "noise", "glue", "molecular", "average"]
    stages = "read", "noise", "glue"
    taken += [f"{raman}/{stage}" for raman in settings.channels for stage in stages]
    before = before_pulse(case)
    reason = f"{REQUESTED}; each background is a {before}" if before else REQUESTED
    yield case.run("raman", reason, settings, needs=taken)


def _held(settings: RamanPlan, work: Workload) -> float:
    """Return the bytes of the averages that are completed together, and of their solution."""
    names = (work.channel, *settings.raman.channels)
    records = sum(len(file_channels(name)) for name in names)
    together = min(work.intervals(settings.average.seconds), MEANS_TOGETHER)
    width = member_channel(work.scene.layout, work.channel).bin_width
    highest = min(settings.raman.highest * settings.raman.stretch, work.bins * width)
    return bytes_held(records, together, work.bins, highest / settings.raman.cell)


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


class _Retrieval(ProductStream):
    """Averages of the profiles of all channels, and their retrieval."""

    def __init__(self, settings: RamanPlan, signal: ChannelSignal) -> None:
        self._settings, self._signal = settings.raman, signal
        if (error := signal.air_error) is not None:
            slope = settings.raman.molecular_slope_error
            changes = {"molecular_slope_error": SLOPE * error if slope is None else slope}
            self._settings = settings.raman.model_copy(update=changes)
        names = [signal.channel, *settings.raman.channels]
        highest = settings.raman.reference.highest * settings.raman.stretch
        self._averages = Averages(
            [signal.channels[name].profiles for name in names],
            signal.source.geometry,
            signal.shots,
            settings.average.seconds,
            Screening(cloud_contrast(signal.wavelength), highest),
        )

    def add(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Add the next profiles to their averages; return what those give that are complete."""
        return self._averages.rows(chunk, self._retrieved)

    def _retrieved(
        self, elastic: xr.Dataset, nitrogen: xr.Dataset, water: xr.Dataset | None = None
    ) -> xr.Dataset:
        signal, settings = self._signal, self._settings
        retrieved = labeled.retrieve(
            elastic.assign_coords(signal.source.pointing),
            nitrogen,
            molecules=signal.molecules,
            station_altitude=signal.source.station_altitude,
            wavelengths=(signal.wavelength, signal.channels[settings.nitrogen].wavelength),
            settings=settings,
            water=None if water is None else self._water(water),
            overlap=signal.overlap_at(elastic["range"].to_numpy()),
            overlap_is_stated=signal.full_overlap_range is not None,
        )
        weighed = [name for name in LAYOUT.weighed if name in retrieved]
        flagged = with_low_signal_to_noise(retrieved, weighed, settings.least_signal_to_noise)
        bit, error = RamanQuality.STANDARD_AIR, settings.molecular_relative_error
        return with_methods(flagged, signal, bit, error, known_shape=settings.known_shape)

    def _water(self, averages: xr.Dataset) -> labeled.WaterVapour:
        settings = self._settings
        # `_needs` names the channel only with its calibration.
        name = cast("str", settings.water_vapour)
        constant = cast("float", settings.calibration)
        error = cast("float", settings.calibration_standard_error)
        metres = self._signal.channels[name].wavelength
        return labeled.WaterVapour(averages, metres, constant, error)


RETRIEVAL: Final = Retrieval(settings=RamanPlan, needs=_needs, stream=_Retrieval, held=_held)
