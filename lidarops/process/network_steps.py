"""Carry out the steps of a network's plan: from raw counts of several lidars to ``visibility``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from dask.base import compute

from lidarops.campaign.model import Station
from lidarops.flags import Quality
from lidarops.plan import network_plan
from lidarops.plan.network_plan import SAME_POINTING, BeamPlan
from lidarops.plan.rules import StepName
from lidarops.process import channel_steps
from lidarops.process.channel_steps import SceneData
from lidarops.records import Step
from lidarops.retrieve.air.labeled import Definition
from lidarops.retrieve.network import geometry, labeled
from lidarops.retrieve.network.labeled import BeamAverages

Integers = npt.NDArray[np.int64]

_EPOCH: Final = np.datetime64("1970-01-01T00:00:00", "ns")


@dataclass(frozen=True, slots=True)
class Member:
    """One instrument of a network, with the data on which its steps work."""

    instrument: str
    station: Station
    scene_data: SceneData | None
    """Holds the steps of this instrument only; None where no granule can be read."""
    range: npt.NDArray[np.float64]
    """m, ranges of the bins according to the plan."""


def process_network(members: Sequence[Member], joint: Mapping[str, Step]) -> xr.Dataset:
    """Carry out the steps of a network.

    Parameters
    ----------
    members : sequence of Member
    joint : mapping of str to Step
        The steps of the whole network, by name.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``visibility`` product.

    Raises
    ------
    LidarOpsError
        If the data do not agree with the plan.
    """
    seconds = joint[StepName.AVERAGE].settings["seconds"]
    settings = joint[StepName.VISIBILITY].settings
    channel = joint[StepName.VISIBILITY].channel
    by_name = {member.instrument: member for member in members}
    beam_plans = [BeamPlan(**beam_plan) for beam_plan in settings["beams"]]
    beams = [
        _Beam(by_name[beam_plan.instrument], beam_plan, channel, seconds)
        for beam_plan in beam_plans
    ]
    # Computed together, so that the beams of an instrument share one reading of its files.
    computed = compute(*(beam.lazy for beam in beams))  # type: ignore[no-untyped-call]
    signals = [beam.signals(data) for beam, data in zip(beams, computed, strict=True)]
    return labeled.retrieve_network(
        signals,
        _network(signals, settings, beam_plans),
        labeled.NetworkSettings(
            block_intervals=round(settings["block_seconds"] / seconds),
            visibility=Definition(
                wavelength=settings["wavelength"],
                **{name: settings[name] for name in network_plan.VISIBILITY_KEYS},
            ),
            method=settings["method"],
            prior=settings["prior"],
            exponent_relative_error=settings["exponent_relative_error"],
            lidar_ratio_relative_error=settings["lidar_ratio_relative_error"],
            overlap_relative_error=settings["overlap_relative_error"],
        ),
    )


def _network(
    signals: Sequence[BeamAverages], settings: Mapping[str, Any], beam_plans: Sequence[BeamPlan]
) -> geometry.Network:
    return geometry.build_network(
        [
            geometry.Beam(*beam.station, azimuth=beam.azimuth, elevation=90.0 - beam.zenith_angle)
            for beam in signals
        ],
        tolerance=settings["tolerance"],
        nearest=[beam_plan.nearest for beam_plan in beam_plans],
        farthest=[beam_plan.farthest for beam_plan in beam_plans],
        smallest_angle=settings["smallest_angle"],
    )


class _Beam:
    """One beam of a member: the averaged profiles of its pointing."""

    def __init__(self, member: Member, beam_plan: BeamPlan, channel: str, seconds: float) -> None:
        self._member, self._beam_plan, self._channel = member, beam_plan, channel
        self._source: channel_steps.FileChannel | channel_steps.GluedChannel | None = None
        self._interval: Integers = np.zeros(0, dtype=np.int64)
        self.lazy = _no_averages(member.range)
        scene_data = member.scene_data
        profiles = [] if scene_data is None else list(_profiles_of(scene_data.archive, beam_plan))
        if scene_data is not None and profiles:
            archive = scene_data.archive.isel(time=profiles)
            self._source = channel_steps.channel_source(
                replace(scene_data, archive=archive), channel
            )
            self._interval = _intervals(archive["time"].to_numpy(), seconds)
            self.lazy = self._source.averages(seconds)

    def signals(self, computed: xr.Dataset) -> BeamAverages:
        """Return the averages with the geometry and settings of the beam."""
        member, scene_data = self._member, self._member.scene_data
        averages = computed if self._source is None else self._source.glued(computed)
        planned = {} if scene_data is None else scene_data.steps(self._channel)
        distance = averages["range"].to_numpy().astype(np.float64)
        near, far = (
            planned[StepName.BACKGROUND].settings["range"] if planned else (distance[0], np.inf)
        )
        return BeamAverages(
            averages=averages,
            interval=self._interval,
            instrument=member.instrument,
            station=(member.station.latitude, member.station.longitude, member.station.altitude),
            background_range=(near, far),
            nearest=self._beam_plan.nearest,
            overlap=(
                None
                if scene_data is None
                else channel_steps.overlap_at(planned, scene_data.ancillaries, distance)
            ),
            exponent=self._beam_plan.exponent,
            zenith_angle=self._beam_plan.zenith_angle,
            azimuth=self._beam_plan.azimuth,
        )


def _profiles_of(archive: xr.Dataset, beam_plan: BeamPlan) -> Iterator[int]:
    """Yield the indices of the profiles of a beam."""
    planned = (beam_plan.zenith_angle, beam_plan.azimuth)
    pairs = zip(archive["zenith_angle"].to_numpy(), archive["azimuth"].to_numpy(), strict=True)
    for number, (zenith, azimuth) in enumerate(pairs):
        if network_plan.angle_between((zenith, azimuth), planned) <= SAME_POINTING:
            yield number


def _intervals(moments: npt.NDArray[np.datetime64], seconds: float) -> Integers:
    """Return the numbers of the clock intervals that hold profiles, each once."""
    length = np.timedelta64(round(seconds * 1e9), "ns")
    return np.unique((moments.astype("datetime64[ns]") - _EPOCH) // length).astype(np.int64)


def _no_averages(distance: npt.NDArray[np.float64]) -> xr.Dataset:
    """Return averages of a beam without profiles."""
    empty = np.zeros((0, distance.size))
    pair = ("time", "range")
    return xr.Dataset(
        {
            "power": (pair, empty),
            "variance": (pair, empty),
            "quality": (pair, np.full(empty.shape, int(Quality.INPUT_MISSING), dtype=np.int32)),
            "shots": ("time", np.zeros(0, dtype=np.int32)),
        },
        coords={
            "range": distance,
            "time_bnds": (("time", "nv"), np.zeros((0, 2), dtype="datetime64[ns]")),
        },
    )
