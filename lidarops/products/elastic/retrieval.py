"""The product ``elastic``: its decision, and its making."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, Final

import xarray as xr

from lidarops.products.elastic import ElasticAssumptions, ElasticSettings
from lidarops.products.elastic.variables import LAYOUT
from lidarops.retrieve.clouds.labeled import Reference
from lidarops.retrieve.elastic import labeled
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled_averaging import MEANS_TOGETHER, Screening
from lidarops.scene.case import REQUESTED, ChannelCase, Entries, Entry, NoSettings
from lidarops.scene.profiles import Averages, ChannelSignal, Chunk, ProductStream, gluing
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
from lidarops.settings import SettingsModel

Case = ChannelCase[ElasticSettings]


def _known_shape(case: Case) -> Entry:
    """Fit the background with the shape of the signal of aerosol-free air, where requested."""
    if reason := before_pulse(case):
        return case.leave("known_shape", f"the background is the {reason}")
    if case.request.background == "known_shape":
        return case.run("known_shape", "the far range is assumed to be aerosol-free, and tested")
    return case.leave(
        "known_shape", "the campaign requests tail_mean; signal in the far range biases it"
    )


def _lidar_ratio(case: Case) -> dict[str, Any]:
    """Return the settings of the lidar ratio: facts of the channel, or the settings of the kind."""
    facts = case.facts_of_channel
    names = ("lidar_ratio", "lidar_ratio_standard_error")
    given = {name: getattr(facts, name) for name in names}
    return {"lidar_ratio_profile": facts.lidar_ratio_profile} | {
        name: getattr(case.request, name) if value is None else value
        for name, value in given.items()
    }


class InversionSettings(ElasticAssumptions):
    """Settings of the entry ``elastic``; with a profile, the lidar ratio holds above it."""

    lidar_ratio_profile: str | None = None
    """Ancillary file of the lidar ratio and its error over altitude."""


class ElasticPlan(SettingsModel):
    """What a plan states of a product."""

    average: AverageSettings
    known_shape: NoSettings | None = None
    reference: Reference
    elastic: InversionSettings


def _needs(case: Case) -> Entries:
    """Invert the averaged elastic signals, where a fixed beam reaches aerosol-free air."""
    request = case.request
    _, limits = reference_limits(case, request.reference)
    if isinstance(limits, str):
        yield case.leave("elastic", limits)
        return
    reason = "the noise of a single profile is too large for the inversion"
    yield average(case, request.average, reason)
    yield _known_shape(case)
    reason = "windows within the campaign's limits are tested against the molecular profile"
    reference = Reference(**dict(limits))
    yield case.run("reference", reason, reference, number=limits.highest - limits.lowest)
    settings = InversionSettings.taken_from(request, **_lidar_ratio(case))
    taken = (
        "read", "overlap", "noise", "glue", "molecular", "average", "known_shape", "reference"
    )  # fmt: skip
    yield case.run("elastic", REQUESTED, settings, needs=taken)


def _held(settings: ElasticPlan, work: Workload) -> float:
    """Return the bytes of the averages that are completed together, and of their inversion."""
    together = min(work.intervals(settings.average.seconds), MEANS_TOGETHER)
    return (_BYTES_OF_A_BIN * together + _BYTES_OF_PARTS) * work.bins


_BYTES_OF_PARTS: Final = 1500.0
"""Bytes per bin of the parts of the open average: 44 each of two records that are glued."""
_BYTES_OF_A_BIN: Final = 240.0
"""Bytes per bin of an average that is open or being inverted, from ``benchmarks throughput --case
memory``."""


class _Inversion(ProductStream):
    """Averages of the profiles of a scene, and their inversion."""

    def __init__(self, settings: ElasticPlan, signal: ChannelSignal) -> None:
        self._settings, self._signal = settings.elastic, signal
        self._known_shape = settings.known_shape is not None
        self._reference = settings.reference
        self._averages = Averages(
            [signal.profiles],
            signal.source.geometry,
            signal.shots,
            settings.average.seconds,
            Screening(cloud_contrast(signal.wavelength), self._reference.highest),
        )
        constant = settings.elastic.lidar_ratio, settings.elastic.lidar_ratio_standard_error
        self._lidar_ratio = labeled.constant_ratio(*constant)
        if name := settings.elastic.lidar_ratio_profile:
            profile = signal.source.ancillaries.lidar_ratios[name]
            self._lidar_ratio = partial(profile.at, beyond=constant)

    def add(self, chunk: Chunk) -> Iterator[xr.Dataset]:
        """Add the next profiles to their averages; return those that are complete, inverted."""
        return self._averages.rows(chunk, self._inverted)

    def _inverted(self, averages: xr.Dataset) -> xr.Dataset:
        signal, settings = self._signal, self._settings
        inverted = labeled.invert_elastic(
            averages.assign_coords(signal.source.pointing),
            molecules=signal.molecules,
            wavelength=signal.wavelength,
            station_altitude=signal.source.station_altitude,
            lidar_ratio=self._lidar_ratio,
            molecular_relative_error=settings.molecular_relative_error,
            reference=self._reference,
            known_shape=self._known_shape,
            overlap=signal.overlap_at(averages["range"].to_numpy()),
            overlap_is_stated=signal.full_overlap_range is not None,
        )
        least = settings.least_signal_to_noise
        flagged = with_low_signal_to_noise(inverted, LAYOUT.weighed, least)
        glued = flagged.assign(gluing(averages))
        bit, error = ElasticQuality.STANDARD_AIR, settings.molecular_relative_error
        return with_methods(glued, signal, bit, error, known_shape=self._known_shape)


RETRIEVAL: Final = Retrieval(settings=ElasticPlan, needs=_needs, stream=_Inversion, held=_held)
