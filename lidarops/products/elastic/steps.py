"""Steps of the product ``elastic``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import xarray as xr

from lidarops.campaign.model import channel_facts
from lidarops.constants import KNOWN_SHAPE_PAPERS
from lidarops.products.elastic.settings import ElasticSettings
from lidarops.products.elastic.variables import LAYOUT
from lidarops.records import Role
from lidarops.retrieve.clouds.labeled import Reference
from lidarops.retrieve.elastic import labeled
from lidarops.retrieve.signal.labeled_averaging import MEANS_TOGETHER
from lidarops.retrieve.signal.labeled_screening import Screening
from lidarops.retrieve.signal.screening import cloud_contrast
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.case import ProductCase
from lidarops.steps.channels import range_channel, range_offset
from lidarops.steps.conditioning import FULL_OVERLAP_RANGE, OVERLAP, PROFILES
from lidarops.steps.data import Chunk, Data, RowProduct, Source
from lidarops.steps.pointing import fixed_zenith
from lidarops.steps.preparation import AVERAGE, MOLECULES, Average, with_methods
from lidarops.steps.profiles import ScreenedAverages, gluing
from lidarops.steps.reading import WAVELENGTH
from lidarops.steps.signal_to_noise import with_low_signal_to_noise
from lidarops.steps.step import (
    REQUESTED,
    Datum,
    Decisions,
    Leave,
    NoSettings,
    ProductStep,
    Run,
    Step,
)
from lidarops.steps.workload import Workload

Case = ProductCase[ElasticSettings]

KNOWN_SHAPE: Final = Datum[bool]("known_shape")
"""That the background is fitted with the shape of the signal of clean air."""
REFERENCE: Final = Datum[Reference]("reference")


@dataclass(frozen=True, slots=True)
class _ReferenceLimits:
    """Limits within which the reference window may lie, m along the beam."""

    bottom: float
    top: float
    width: float
    reason: str
    """Why there can be no reference window; empty where there can."""


def _reference_limits(case: Case) -> _ReferenceLimits:
    zenith, reason = fixed_zenith(case)
    stretch = 1.0 / math.cos(math.radians(zenith)) if not reason else math.nan
    window = case.request.reference
    # A window is a set of bin centres.
    ranged = replace(case.channel, name=range_channel(case.channel.name))
    reach = case.last - 0.5 * case.channel.bin_width + range_offset(ranged, case.facts)
    bottom, top = window.lowest * stretch, min(window.highest * stretch, reach)
    if not reason and top - bottom < window.width * stretch * (1.0 - 1e-9):
        reason = (
            f"the last bin at {reach:g} m is too near for a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    return _ReferenceLimits(bottom, top, window.width * stretch, reason)


class KnownShape(Step[Case, NoSettings]):
    """Fit the background with the shape of the signal of aerosol-free air."""

    name = "known_shape"
    outputs = (KNOWN_SHAPE,)

    def decide(self, case: Case) -> Decisions:
        """Run where the campaign requests this background."""
        if case.request.background == "known_shape":
            yield Run("the far range is assumed to be aerosol-free, and tested")
        else:
            yield Leave("the campaign requests tail_mean; signal in the far range biases it")

    def carry_out(self, settings: NoSettings, data: Data) -> None:  # noqa: ARG002
        """Give that the shape is used."""
        data[KNOWN_SHAPE] = True


class ReferenceWindowSettings(SettingsModel):
    """Settings of the step ``reference``."""

    lowest: float = quantity(unit="m", description="along the beam")
    highest: float = quantity(unit="m", description="along the beam")
    width: float = quantity(unit="m", description="along the beam")
    scattering_ratio: float
    relative_error: float


class ReferenceWindow(Step[Case, ReferenceWindowSettings]):
    """State where the reference window may lie."""

    name = "reference"
    settings = ReferenceWindowSettings
    outputs = (REFERENCE,)

    def decide(self, case: Case) -> Decisions:
        """Run always."""
        limits, window = _reference_limits(case), case.request.reference
        settings = ReferenceWindowSettings(
            lowest=limits.bottom,
            highest=limits.top,
            width=limits.width,
            scattering_ratio=window.scattering_ratio,
            relative_error=window.relative_error,
        )
        reason = "windows within the campaign's limits are tested against the molecular profile"
        yield Run(reason, settings, number=limits.top - limits.bottom)

    def carry_out(self, settings: ReferenceWindowSettings, data: Data) -> None:
        """Give the limits."""
        data[REFERENCE] = Reference(**dict(settings))


def _lidar_ratio(case: Case) -> dict[str, Any]:
    """Return the settings of the lidar ratio: facts of the channel, or the settings of the kind."""
    facts = channel_facts(case.facts, range_channel(case.channel.name))
    names = ("lidar_ratio", "lidar_ratio_standard_error")
    given = {name: getattr(facts, name) for name in names}
    return {"lidar_ratio_profile": facts.lidar_ratio_profile} | {
        name: getattr(case.request, name) if value is None else value
        for name, value in given.items()
    }


class InversionSettings(SettingsModel):
    """Settings of the step ``elastic``."""

    lidar_ratio: float = quantity(
        unit="sr", description="above a measured profile where one is given"
    )
    lidar_ratio_standard_error: float = quantity(unit="sr", description="of lidar_ratio")
    lidar_ratio_profile: str | None = None
    """Ancillary file of both over altitude."""
    molecular_relative_error: float
    least_signal_to_noise: float


_AVERAGE: Final = Average("the noise of a single profile is too large for the inversion")


class Elastic(ProductStep[ElasticSettings, InversionSettings]):
    """Invert the averaged elastic signals."""

    name = "elastic"
    settings = InversionSettings
    inputs = (
        PROFILES, WAVELENGTH, FULL_OVERLAP_RANGE, OVERLAP, AVERAGE, MOLECULES, KNOWN_SHAPE,
        REFERENCE,
    )  # fmt: skip
    parts = (_AVERAGE, KnownShape(), ReferenceWindow())

    def decide(self, case: Case) -> Decisions:
        """Run where a fixed beam reaches aerosol-free air."""
        limits = _reference_limits(case)
        if limits.reason:
            yield Leave(limits.reason)
            return
        settings = InversionSettings(
            **_lidar_ratio(case),
            molecular_relative_error=case.request.molecular_relative_error,
            least_signal_to_noise=case.request.least_signal_to_noise,
        )
        yield Run(REQUESTED, settings)

    def files(self, settings: InversionSettings) -> Mapping[str, Role]:
        """Return the file of the lidar ratio."""
        name = settings.lidar_ratio_profile
        return {name: Role.LIDAR_RATIO} if name else {}

    def stream(self, settings: InversionSettings, data: Data) -> RowProduct:
        """Return the product, whose averages are inverted as they become complete."""
        return _Inversion(settings, data)

    def held(self, settings: InversionSettings, work: Workload) -> float:  # noqa: ARG002
        """Return the bytes of the averages that are completed together, and of their inversion."""
        together = min(_averages(work), MEANS_TOGETHER)
        return (_BYTES_OF_A_BIN * together + _BYTES_OF_PARTS) * work.bins


def _averages(work: Workload) -> int:
    average = _AVERAGE.settings_in(work.plan)
    return work.intervals(average.seconds) if average else 0


_BYTES_OF_PARTS: Final = 1500.0
"""Bytes per bin of the parts of the open average: 44 each of two records that are glued."""
_BYTES_OF_A_BIN: Final = 240.0
"""Bytes per bin of an average that is open or being inverted, from ``lidarops bench throughput
--case memory``."""


class _Inversion(RowProduct):
    """Averages of the profiles of a scene, and their inversion."""

    def __init__(self, settings: InversionSettings, data: Data) -> None:
        self._settings, self._data = settings, data
        source, profiles = data.source, data[PROFILES]
        self._averages = ScreenedAverages(
            [profiles],
            source.geometry,
            profiles.shots(source.archive),
            data[AVERAGE],
            Screening(cloud_contrast(data[WAVELENGTH]), data[REFERENCE].highest),
        )
        self._begun = False
        self._lidar_ratio = _ratio_at(settings, source)

    def rows(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Add the next profiles to their averages, and yield those that are complete, inverted."""
        self._averages.add(chunk)
        for (averages,) in self._averages.completed():
            rows = self._inverted(averages)
            if not self._begun:
                self._begun = True
                yield rows.drop_dims("time").assign_coords(self._averages.times.coords)
            yield rows

    def _inverted(self, averages: xr.Dataset) -> xr.Dataset:
        data, settings = self._data, self._settings
        geometry, overlap = data.source.geometry, data.get(OVERLAP)
        known_shape = data.get(KNOWN_SHAPE) is True
        pointing = {
            name: float(geometry[name][0])
            for name in ("zenith_angle", "azimuth")
            if name in geometry
        }
        inverted = labeled.invert_elastic(
            averages.assign_coords(pointing),
            molecules=data[MOLECULES],
            wavelength=data[WAVELENGTH],
            station_altitude=data.source.station_altitude,
            lidar_ratio=self._lidar_ratio,
            molecular_relative_error=settings.molecular_relative_error,
            reference=data[REFERENCE],
            known_shape=known_shape,
            overlap=None if overlap is None else overlap(averages["range"].to_numpy()),
            overlap_is_stated=data.get(FULL_OVERLAP_RANGE) is not None,
        )
        if known_shape:
            inverted = inverted.assign_attrs(references=KNOWN_SHAPE_PAPERS)
        least = settings.least_signal_to_noise
        flagged = with_low_signal_to_noise(inverted, LAYOUT.weighed, least)
        glued = flagged.assign(gluing(averages))
        return with_methods(glued, data[MOLECULES], known_shape=known_shape)


def _ratio_at(settings: InversionSettings, source: Source) -> labeled.RatioAt:
    """Return the function of altitude that gives the lidar ratio and its standard error."""
    constant = settings.lidar_ratio, settings.lidar_ratio_standard_error
    name = settings.lidar_ratio_profile
    if name is None:
        return labeled.constant_ratio(*constant)
    return partial(source.ancillaries.lidar_ratios[name].at, beyond=constant)


STEP: Final = Elastic()
