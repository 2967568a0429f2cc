"""The beams of a network, from the headers and the campaign, and where they cross."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from lidarops.campaign.model import Campaign, InstrumentFacts, Station, channel_facts
from lidarops.products.visibility import VisibilityProductSettings
from lidarops.records import ChannelLayout, Granule, Scene
from lidarops.retrieve.network import geometry
from lidarops.scene.case import (
    ChannelCase,
    channel_ranges,
    joined_layout,
    member_channel,
)
from lidarops.scene.dependence import scene_facts
from lidarops.scene.pipe import NO_WAVELENGTH
from lidarops.settings import SettingsModel

NAME: Final = "visibility"
SAME_POINTING: Final = 0.1
"""degree; pointings of one instrument within this angle are one beam (resolution of headers)."""


class BeamPlan(SettingsModel):
    """One beam of one member of a network."""

    instrument: str
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree."""
    nearest: float
    """m, smallest range at which the signal is used."""
    farthest: float
    """m."""
    exponent: float


@dataclass(frozen=True, slots=True)
class MemberCase:
    """The scene of one member of a network, as the rules see it."""

    scene: Scene
    """Scene of the member."""
    campaign: Campaign
    settings: VisibilityProductSettings

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument."""
        return scene_facts(self.campaign, self.scene)

    @property
    def channel(self) -> ChannelLayout:
        """The channel that the network uses."""
        return member_channel(self.scene.layout, self.settings.channel)

    def channel_case(self, channel: ChannelLayout) -> ChannelCase[VisibilityProductSettings]:
        """Return the case of a channel."""
        return ChannelCase(
            self.scene,
            channel,
            self.facts,
            channel_facts(self.facts, channel.name),
            self.settings,
            all_steps=self.campaign.all_steps,
            member=self.scene.instrument,
            requesters=(NAME,),
        )

    def why_not(self) -> tuple[str, float | None]:
        """Return why a member cannot take part (empty where it can), and the deciding number."""
        name, facts = self.settings.channel, self.facts
        glued = joined_layout(self.scene.layout, [name])
        held = [channel.name for channel in (*self.scene.layout, *glued)]
        if name not in held:
            return f"the files hold no {name}, only {', '.join(held)}", None
        photon = channel_facts(facts, name)
        if math.isnan(photon.wavelength or self.channel.wavelength):
            return NO_WAVELENGTH, None
        if not (facts.overlap_profile or facts.full_overlap_range > 0):
            return (
                "the campaign gives neither full_overlap_range nor overlap_profile: an overlap"
                " error of 1 percent at the nearest crossing changes extinction there by 5 percent"
            ), facts.full_overlap_range
        last = self.channel.bins * self.channel.bin_width
        if self.settings.background_range and self.settings.background_range[0] >= last:
            return f"background_range begins beyond the last bin, which ends at {last:g} m", last
        if any(_granule_pointing(granule, facts) is None for granule in self.scene.granules):
            return "neither headers nor campaign give the pointing of all beams", None
        return "", None

    def pointings(self) -> Iterator[BeamPlan]:
        """Yield the beams of the member, each once."""
        directions = sorted(
            {
                direction
                for granule in self.scene.granules
                if (direction := _granule_pointing(granule, self.facts)) is not None
            }
        )
        end = float(channel_ranges(self.channel, channel_facts(self.facts, self.channel.name))[-1])
        farthest = min(end, self.settings.farthest or end)
        distinct: list[tuple[float, float]] = []
        for direction in directions:
            if not any(angle_between(direction, other) <= SAME_POINTING for other in distinct):
                distinct.append(direction)
        for zenith, azimuth in distinct:
            yield BeamPlan(
                instrument=self.scene.instrument,
                zenith_angle=zenith,
                azimuth=azimuth,
                nearest=self.facts.full_overlap_range,
                farthest=farthest,
                exponent=self.settings.exponent_of(self.scene.instrument),
            )


def _granule_pointing(granule: Granule, facts: InstrumentFacts) -> tuple[float, float] | None:
    """Return zenith angle and azimuth of a granule; facts of the campaign override headers."""
    zenith = granule.zenith_angle if facts.zenith_angle is None else facts.zenith_angle
    azimuth = granule.azimuth if facts.azimuth is None else facts.azimuth
    if zenith is None or azimuth is None:
        return None
    return zenith, azimuth % 360.0


def angle_between(pointing: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the angle between two pointings (zenith angle, azimuth), all in degree."""
    first, second = (
        (
            math.sin(math.radians(zenith)) * math.sin(math.radians(azimuth)),
            math.sin(math.radians(zenith)) * math.cos(math.radians(azimuth)),
            math.cos(math.radians(zenith)),
        )
        for zenith, azimuth in (pointing, other)
    )
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * math.dist(first, second))))


def crossings(
    beams: Sequence[BeamPlan],
    stations: Mapping[str, Station],
    tolerance: float,
    smallest_angle: float,
) -> geometry.Network:
    """Return the crossings of beams of instruments at stations; see `geometry.build_network`."""
    owners = [stations[beam.instrument] for beam in beams]
    places = [(owner.latitude, owner.longitude, owner.altitude) for owner in owners]
    return geometry.build_network(
        [
            geometry.Beam(*place, beam.azimuth, 90.0 - beam.zenith_angle)
            for place, beam in zip(places, beams, strict=True)
        ],
        tolerance=tolerance,
        nearest=[beam.nearest for beam in beams],
        farthest=[beam.farthest for beam in beams],
        smallest_angle=smallest_angle,
    )
