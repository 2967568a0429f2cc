"""Scene of a network -> plan: which beams meet where, what runs, what is left out, and why."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.campaign import Campaign, InstrumentFacts, channel_facts
from lidarops.errors import RetrievalInputError
from lidarops.plan_rules import (
    GLUED,
    Case,
    StepName,
    conditioning,
    glue_rules,
    joined_channels,
    parts_of,
    range_offset,
    ranged_by,
    wavelength,
)
from lidarops.product_settings import NetworkVisibilitySettings, VisibilitySettings
from lidarops.records import ChannelLayout, Granule, LeftOut, Plan, Scene, Step
from lidarops.retrieve import geometry

SAME_POINTING: Final = 0.1
"""degree, within which beams of one instrument point alike: what headers tell."""
_SAME_COLOUR: Final = 1e-9
"""m, within which wavelengths of instruments are one."""


SIGHT: Final = ("contrast", "law", "angstrom_exponent", "exponent_standard_error")
"""Settings of a step that say what visibility is."""


@dataclass(frozen=True, slots=True)
class RayPlan:
    """One beam of one member of a network."""

    instrument: str
    zenith_angle: float
    """degree."""
    azimuth: float
    """degree."""
    nearest: float
    """m, range from which on the signal is used."""
    farthest: float
    """m."""
    exponent: float

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain JSON types."""
        return {
            "instrument": self.instrument,
            "zenith_angle": self.zenith_angle,
            "azimuth": self.azimuth,
            "nearest": self.nearest,
            "farthest": self.farthest,
            "exponent": self.exponent,
        }


def plan(scene: Scene, campaign: Campaign) -> Plan:
    """Decide what runs for a scene of a network.

    Parameters
    ----------
    scene : Scene
        With members.
    campaign : Campaign

    Returns
    -------
    Plan
        Steps of every member's channels, then the one that joins them, whose settings name the
        beams. Without steps where the beams do not meet; its `left_out` says why.
    """
    settings = campaign.networks[scene.instrument].visibility
    steps: list[Step] = []
    rays: list[RayPlan] = []
    present = {member.instrument for member in scene.members}
    left_out = [
        _left(settings, name, "no granule in the window")
        for name in campaign.networks[scene.instrument].instruments
        if name not in present
    ]
    for member in scene.members:
        decided = _Member(member, campaign, settings)
        for decision in decided.decisions:
            (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]
        rays += decided.rays
    colours = {step.settings["wavelength"] for step in steps if step.name == StepName.READ}
    if colours and max(colours) - min(colours) > _SAME_COLOUR:
        told = ", ".join(f"{colour * 1e9:g}" for colour in sorted(colours))
        reason = f"the instruments see different wavelengths: {told} nm"
        kept: list[RayPlan] = []
    else:
        kept, reason = _meeting(rays, scene, campaign, settings, left_out)
    if reason:
        left_out.append(
            LeftOut(StepName.VISIBILITY.value, settings.channel, reason, rule="visibility")
        )
        return Plan(scene.id, (), tuple(left_out))
    used = {ray.instrument for ray in kept}
    steps = [step for step in steps if step.instrument in used]
    return Plan(scene.id, (*steps, *_joint(kept, scene, campaign, min(colours))), tuple(left_out))


def sight(settings: VisibilitySettings) -> dict[str, Any]:
    """Return how visibility follows from extinction, as settings of a step."""
    return {
        "contrast": settings.threshold,
        "law": settings.law,
        "angstrom_exponent": settings.angstrom_exponent,
        "exponent_standard_error": settings.exponent_standard_error,
    }


def rays_of(rays: Sequence[RayPlan], scene: Scene, campaign: Campaign) -> tuple[geometry.Ray, ...]:
    """Return the beams in space."""
    stations = {member.instrument: campaign.stations[member.station] for member in scene.members}
    return tuple(
        geometry.Ray(
            latitude=stations[ray.instrument].latitude,
            longitude=stations[ray.instrument].longitude,
            altitude=stations[ray.instrument].altitude,
            azimuth=ray.azimuth,
            elevation=90.0 - ray.zenith_angle,
        )
        for ray in rays
    )


def channel_of(member: Scene, name: str) -> ChannelLayout:
    """Return a channel that a member's files hold, or that is joined of two of them."""
    if name.startswith(GLUED):
        return joined_channels(member, [name])[0]
    return next(channel for channel in member.layout if channel.name == name)


def ranges_of(channel: ChannelLayout, facts: InstrumentFacts) -> npt.NDArray[np.float64]:
    """Return the ranges of the middles of the bins of a channel, m."""
    ranged = replace(channel, name=ranged_by(channel.name))
    middles = (np.arange(channel.bins) + 0.5) * channel.bin_width
    return np.asarray(middles + range_offset(ranged, facts))


def pointing(granule: Granule, facts: InstrumentFacts) -> tuple[float, float] | None:
    """Return zenith angle and azimuth of a granule; what the campaign says wins over headers."""
    zenith = granule.zenith_angle if facts.zenith_angle is None else facts.zenith_angle
    azimuth = granule.azimuth if facts.azimuth is None else facts.azimuth
    if zenith is None or azimuth is None:
        return None
    return zenith, azimuth % 360.0


def _left(
    settings: NetworkVisibilitySettings,
    member: str,
    reason: str,
    *,
    rule: str = "member",
    number: float | None = None,
) -> LeftOut:
    told = f"{member}: {reason}"
    step = StepName.VISIBILITY.value
    return LeftOut(step, settings.channel, told, member, rule=rule, number=number)


class _Member:
    """The rules of one member of a network."""

    def __init__(
        self, member: Scene, campaign: Campaign, settings: NetworkVisibilitySettings
    ) -> None:
        self._scene = member
        self._settings = settings
        instrument = campaign.instruments[member.instrument]
        self._facts = instrument.facts_at(member.granules[0].start or member.start)
        self.rays: list[RayPlan] = []
        self.decisions: list[Step | LeftOut] = list(self._decide())

    def _case(self, channel: ChannelLayout) -> Case:
        known = channel_facts(self._facts, channel.name)
        return Case(self._scene, channel, self._facts, known, self._scene.instrument)

    def _decide(self) -> Iterator[Step | LeftOut]:
        name = self._settings.channel
        reason = self._why_not()
        if reason:
            yield _left(self._settings, self._scene.instrument, reason)
            return
        present = {channel.name: channel for channel in self._scene.layout}
        for part in parts_of(name) if name.startswith(GLUED) else (name,):
            case = self._case(present[part])
            asked = f"asked for by {StepName.VISIBILITY}"
            colour = wavelength(case.channel, case.known)
            yield case.step(StepName.READ, asked, wavelength=colour)
            yield from conditioning(case)
        if name.startswith(GLUED):
            case = self._case(self._channel())
            photon = channel_facts(self._facts, parts_of(name)[1])
            colour = wavelength(case.channel, photon)
            yield case.step(StepName.READ, f"asked for by {StepName.VISIBILITY}", wavelength=colour)
            yield from glue_rules(case)
        yield self._background()
        self.rays = list(self._pointings())

    def _background(self) -> Step:
        channel = self._channel()
        last = channel.bins * channel.bin_width
        told = self._settings.background_range
        reason = (
            "the last tenth of the bins: signal left there biases it"
            if told is None
            else "background_range of the campaign: signal left there biases it"
        )
        start, stop = told or (0.9 * last, last)
        return self._case(channel).step(
            StepName.BACKGROUND, reason, method="tail_mean", range=[start, min(stop, last)]
        )

    def _channel(self) -> ChannelLayout:
        return channel_of(self._scene, self._settings.channel)

    def _why_not(self) -> str:
        """Return why a member cannot take part, nothing where it can."""
        name = self._settings.channel
        joined = joined_channels(self._scene, [name]) if name.startswith(GLUED) else ()
        held = [channel.name for channel in (*self._scene.layout, *joined)]
        if name not in held:
            return f"the files hold no {name}, only {', '.join(held)}"
        photon = channel_facts(self._facts, ranged_by(name))
        if math.isnan(wavelength(self._channel(), photon)):
            return "the header's wavelength is implausible and the campaign's facts give none"
        if not (self._facts.overlap_profile or self._facts.full_overlap_range > 0):
            return (
                "the campaign gives neither full_overlap_range nor overlap_profile: 1 percent of"
                " overlap at the nearest point changes extinction there by 5 percent"
            )
        last = self._channel().bins * self._channel().bin_width
        if self._settings.background_range and self._settings.background_range[0] >= last:
            return f"background_range begins beyond the bins, which end at {last:g} m"
        if any(pointing(granule, self._facts) is None for granule in self._scene.granules):
            return "neither headers nor campaign tell where all beams point"
        return ""

    def _pointings(self) -> Iterator[RayPlan]:
        told = sorted(
            {
                found
                for granule in self._scene.granules
                if (found := pointing(granule, self._facts)) is not None
            }
        )
        channel = self._channel()
        end = float(ranges_of(channel, self._facts)[-1])
        farthest = min(end, self._settings.farthest or end)
        kept: list[tuple[float, float]] = []
        for found in told:
            if not any(apart(found, other) <= SAME_POINTING for other in kept):
                kept.append(found)
        for zenith, azimuth in kept:
            yield RayPlan(
                self._scene.instrument,
                zenith,
                azimuth,
                self._facts.full_overlap_range,
                farthest,
                self._settings.exponent_of(self._scene.instrument),
            )


def apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the angle between two pointings (zenith angle, azimuth), all in degree."""
    first, second = (
        (
            math.sin(math.radians(zenith)) * math.sin(math.radians(azimuth)),
            math.sin(math.radians(zenith)) * math.cos(math.radians(azimuth)),
            math.cos(math.radians(zenith)),
        )
        for zenith, azimuth in (one, other)
    )
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * math.dist(first, second))))


def meeting_of(
    rays: Sequence[RayPlan],
    scene: Scene,
    campaign: Campaign,
    *,
    tolerance: float,
    smallest_angle: float,
) -> geometry.Network:
    """Return where beams meet; see `lidarops.retrieve.geometry.network`."""
    return geometry.network(
        rays_of(rays, scene, campaign),
        tolerance=tolerance,
        nearest=[ray.nearest for ray in rays],
        farthest=[ray.farthest for ray in rays],
        smallest_angle=smallest_angle,
    )


def _meeting(
    rays: Sequence[RayPlan],
    scene: Scene,
    campaign: Campaign,
    settings: NetworkVisibilitySettings,
    left_out: list[LeftOut],
) -> tuple[list[RayPlan], str]:
    """Return the beams that meet others twice at least, or why there are none."""
    kept = list(rays)
    if len(kept) > geometry.MOST_RAYS:
        return [], f"{len(kept)} beams are more than {geometry.MOST_RAYS}"
    while kept:
        net = meeting_of(
            kept, scene, campaign,
            tolerance=settings.tolerance, smallest_angle=settings.smallest_angle,
        )  # fmt: skip
        lost = [ray for n, ray in enumerate(kept) if net.on_ray(n)[0].size < 2]
        for ray in lost:
            told = f"the beam at {ray.zenith_angle:g} degree, azimuth {ray.azimuth:g}, meets"
            reason = f"{told} fewer than two points that others see"
            left_out.append(_left(settings, ray.instrument, reason, rule="beams_meet"))
        if not lost:
            break
        kept = [ray for ray in kept if ray not in lost]
    if not kept:
        return [], "no beam meets others in two points, between which extinction attenuates it"
    if settings.method in {"cycle", "multiplier", "unbiased"}:
        try:
            geometry.cycle(net)
        except RetrievalInputError as error:
            return [], f"method {settings.method}: {error}"
    return kept, ""


def _joint(
    rays: Sequence[RayPlan],
    scene: Scene,
    campaign: Campaign,
    colour: float,
) -> Iterator[Step]:
    """Give the steps that join the members, which see light of one wavelength."""
    settings = campaign.networks[scene.instrument].visibility
    net = meeting_of(
        rays, scene, campaign,
        tolerance=settings.tolerance, smallest_angle=settings.smallest_angle,
    )  # fmt: skip
    yield Step(
        StepName.AVERAGE.value,
        settings.channel,
        {"seconds": settings.average.total_seconds()},
        "signals are averaged before they are solved: noise biases what is averaged afterwards",
        rule="average",
        number=settings.average.total_seconds(),
    )
    yield Step(
        StepName.VISIBILITY.value,
        settings.channel,
        {
            "rays": [ray.as_dict() for ray in rays],
            "wavelength": colour,
            "block_seconds": settings.block.total_seconds(),
            "method": settings.method,
            "prior": settings.prior,
            "tolerance": settings.tolerance,
            "smallest_angle": settings.smallest_angle,
            "exponent_relative_error": settings.exponent_relative_error,
            "lidar_ratio_relative_error": settings.lidar_ratio_relative_error,
            "overlap_relative_error": settings.overlap_relative_error,
            **sight(settings.visibility),
        },
        f"{len(rays)} beams of {len({ray.instrument for ray in rays})} instruments meet in"
        f" {net.vertices} points, {int(net.near_vertex.sum())} of which are near ones",
        rule="visibility",
        number=float(net.vertices),
    )
