"""Scene of a network -> plan: which beams meet where, what runs, what is left out, and why."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.campaign.model import Campaign, InstrumentFacts, channel_facts
from lidarops.campaign.product_settings import NetworkVisibilitySettings, VisibilitySettings
from lidarops.errors import RetrievalInputError
from lidarops.plan.signal_rules import (
    ALL_STEPS,
    GLUED,
    Case,
    Decisions,
    Rule,
    StepName,
    applied,
    conditioning,
    glue_rules,
    joined_channels,
    parts_of,
    range_offset,
    ranged_by,
    reaching,
    wavelength,
    within,
)
from lidarops.records import ChannelLayout, DetectionMode, Granule, LeftOut, Plan, Scene, Step
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.labeled import BEFORE_TAIL, BEYOND

SAME_POINTING: Final = 0.1
"""degree, within which beams of one instrument point alike: what headers tell."""
_SAME_COLOUR: Final = 1e-9
"""m, within which wavelengths of instruments are one."""


SIGHT: Final = ("contrast", "law", "angstrom_exponent", "exponent_standard_error")
"""Settings of a step that say what visibility is."""


@dataclass(frozen=True, slots=True)
class BeamPlan:
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


def plan_network(scene: Scene, campaign: Campaign) -> Plan:
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
    asked = NetworkCase(scene, campaign)
    steps: list[Step] = []
    left_out: list[LeftOut] = []
    _sort(applied((PRESENT,), asked), steps, left_out)
    for member in scene.members:
        _sort(applied(MEMBER, MemberCase(member, campaign, asked.settings)), steps, left_out)
    able = {step.instrument for step in steps}
    beams = [
        beam
        for member in scene.members
        if member.instrument in able
        for beam in MemberCase(member, campaign, asked.settings).pointings()
    ]
    colours = [step.settings["wavelength"] for step in steps if step.name == StepName.READ]
    found = Meeting(asked, tuple(beams), tuple(colours))
    _sort(applied(MEETING, found), [], left_out)
    if found.reason:
        return Plan(scene.id, (), tuple(left_out))
    used = {beam.instrument for beam in found.kept}
    steps = [step for step in steps if step.instrument in used]
    _sort(applied(JOINT, found), steps, left_out)
    return Plan(scene.id, tuple(steps), tuple(left_out))


def _sort(decisions: Decisions, steps: list[Step], left_out: list[LeftOut]) -> None:
    for decision in decisions:
        (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]


def sight(settings: VisibilitySettings) -> dict[str, Any]:
    """Return how visibility follows from extinction, as settings of a step."""
    return {
        "contrast": settings.threshold,
        "law": settings.law,
        "angstrom_exponent": settings.angstrom_exponent,
        "exponent_standard_error": settings.exponent_standard_error,
    }


def beams_of(
    beams: Sequence[BeamPlan], scene: Scene, campaign: Campaign
) -> tuple[geometry.Beam, ...]:
    """Return the beams in space."""
    stations = {member.instrument: campaign.stations[member.station] for member in scene.members}
    return tuple(
        geometry.Beam(
            latitude=stations[beam.instrument].latitude,
            longitude=stations[beam.instrument].longitude,
            altitude=stations[beam.instrument].altitude,
            azimuth=beam.azimuth,
            elevation=90.0 - beam.zenith_angle,
        )
        for beam in beams
    )


def channel_of(member: Scene, name: str) -> ChannelLayout:
    """Return a channel that a member's files hold, or that is joined of two of them."""
    if name.startswith(GLUED):
        return joined_channels(member.layout, [name])[0]
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


@dataclass(frozen=True, slots=True)
class NetworkCase:
    """What the rules of a network look at."""

    scene: Scene
    campaign: Campaign

    @property
    def settings(self) -> NetworkVisibilitySettings:
        """Of the product."""
        return self.campaign.networks[self.scene.instrument].visibility

    def step(
        self, name: StepName, reason: str, *, number: float | None = None, **settings: Any
    ) -> Step:
        """Return a step that joins the members."""
        return Step(name.value, self.settings.channel, settings, reason, number=number)

    def without(self, name: StepName, reason: str, *, number: float | None = None) -> LeftOut:
        """Return what is left out for all members."""
        return LeftOut(name.value, self.settings.channel, reason, number=number)


@dataclass(frozen=True, slots=True)
class MemberCase:
    """What the rules of one member of a network look at."""

    scene: Scene
    """Of the member."""
    campaign: Campaign
    settings: NetworkVisibilitySettings

    @property
    def facts(self) -> InstrumentFacts:
        """What is known of the instrument."""
        instrument = self.campaign.instruments[self.scene.instrument]
        return instrument.facts_at(self.scene.granules[0].start or self.scene.start)

    @property
    def channel(self) -> ChannelLayout:
        """The channel that the network wants."""
        return channel_of(self.scene, self.settings.channel)

    @property
    def tail(self) -> tuple[float, float]:
        """The ranges in m whose mean is the background."""
        last = self.channel.bins * self.channel.bin_width
        start, stop = self.settings.background_range or (0.9 * last, last)
        return start, min(stop, last)

    def of(self, channel: ChannelLayout) -> Case:
        """Return what the rules of a channel look at."""
        known = channel_facts(self.facts, channel.name)
        return Case(self.scene, channel, self.facts, known, self.scene.instrument)

    def why_not(self) -> tuple[str, float | None]:
        """Return why a member cannot take part, nothing where it can, and the number."""
        name, facts = self.settings.channel, self.facts
        joined = joined_channels(self.scene.layout, [name]) if name.startswith(GLUED) else ()
        held = [channel.name for channel in (*self.scene.layout, *joined)]
        if name not in held:
            return f"the files hold no {name}, only {', '.join(held)}", None
        photon = channel_facts(facts, ranged_by(name))
        if math.isnan(wavelength(self.channel, photon)):
            return "the header's wavelength is implausible and the campaign's facts give none", None
        if not (facts.overlap_profile or facts.full_overlap_range > 0):
            return (
                "the campaign gives neither full_overlap_range nor overlap_profile: 1 percent of"
                " overlap at the nearest point changes extinction there by 5 percent"
            ), facts.full_overlap_range
        last = self.channel.bins * self.channel.bin_width
        if self.settings.background_range and self.settings.background_range[0] >= last:
            return f"background_range begins beyond the bins, which end at {last:g} m", last
        if any(pointing(granule, facts) is None for granule in self.scene.granules):
            return "neither headers nor campaign tell where all beams point", None
        return "", None

    def pointings(self) -> Iterator[BeamPlan]:
        """Give the beams of the member, each once."""
        told = sorted(
            {
                found
                for granule in self.scene.granules
                if (found := pointing(granule, self.facts)) is not None
            }
        )
        end = float(ranges_of(self.channel, self.facts)[-1])
        farthest = min(end, self.settings.farthest or end)
        kept: list[tuple[float, float]] = []
        for found in told:
            if not any(apart(found, other) <= SAME_POINTING for other in kept):
                kept.append(found)
        for zenith, azimuth in kept:
            yield BeamPlan(
                self.scene.instrument,
                zenith,
                azimuth,
                self.facts.full_overlap_range,
                farthest,
                self.settings.exponent_of(self.scene.instrument),
            )


def _left(
    settings: NetworkVisibilitySettings, member: str, reason: str, number: float | None = None
) -> LeftOut:
    told = f"{member}: {reason}"
    return LeftOut(StepName.VISIBILITY.value, settings.channel, told, member, number=number)


def _present(case: NetworkCase) -> Decisions:
    present = {member.instrument for member in case.scene.members}
    for name in case.campaign.networks[case.scene.instrument].instruments:
        if name not in present:
            yield _left(case.settings, name, "no granule in the window", 0.0)


def _fits(case: MemberCase) -> Decisions:
    reason, number = case.why_not()
    if reason:
        yield _left(case.settings, case.scene.instrument, reason, number)


def _signals(case: MemberCase) -> Decisions:
    """Decide on what makes a signal of the counts of a member, by the rules of any channel."""
    if case.why_not()[0]:
        return
    name = case.settings.channel
    present = {channel.name: channel for channel in case.scene.layout}
    for part in parts_of(name) if name.startswith(GLUED) else (name,):
        of_part = case.of(present[part])
        yield _reading(of_part, wavelength(of_part.channel, of_part.known))
        yield from conditioning(of_part)
    if name.startswith(GLUED):
        joined = case.of(case.channel)
        photon = channel_facts(case.facts, parts_of(name)[1])
        yield _reading(joined, wavelength(joined.channel, photon))
        yield from glue_rules(joined)


def _reading(case: Case, colour: float) -> Step:
    told = f"asked for by {StepName.VISIBILITY}"
    read = case.step(StepName.READ, told, number=colour, wavelength=colour)
    return replace(read, rule=_MEMBER_CHANNEL)


def _background(case: MemberCase) -> Decisions:
    if case.why_not()[0]:
        return
    channel, told = case.channel, case.settings.background_range
    reason = (
        "the last tenth of the bins: signal left there biases it"
        if told is None
        else "background_range of the campaign: signal left there biases it"
    )
    start, stop = case.tail
    yield case.of(channel).step(
        StepName.BACKGROUND,
        reason,
        number=(stop - start) / channel.bin_width,
        method="tail_mean",
        range=[start, stop],
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
    beams: Sequence[BeamPlan],
    scene: Scene,
    campaign: Campaign,
    *,
    tolerance: float,
    smallest_angle: float,
) -> geometry.Network:
    """Return where beams meet; see `lidarops.retrieve.network.geometry.build_network`."""
    return geometry.build_network(
        beams_of(beams, scene, campaign),
        tolerance=tolerance,
        nearest=[beam.nearest for beam in beams],
        farthest=[beam.farthest for beam in beams],
        smallest_angle=smallest_angle,
    )


class Meeting:
    """What the rules of beams that may meet look at: those that do, found on the way."""

    def __init__(
        self, asked: NetworkCase, beams: Sequence[BeamPlan], colours: Sequence[float]
    ) -> None:
        self.asked = asked
        self.beams = tuple(beams)
        self.colours = tuple(colours)
        self.kept: tuple[BeamPlan, ...] = ()
        self.reason = ""
        """Why there is no network; empty where there is one."""

    def net(self, beams: Sequence[BeamPlan]) -> geometry.Network:
        """Return where beams meet."""
        settings = self.asked.settings
        return meeting_of(
            beams, self.asked.scene, self.asked.campaign,
            tolerance=settings.tolerance, smallest_angle=settings.smallest_angle,
        )  # fmt: skip

    def none(self, reason: str, number: float | None = None) -> LeftOut:
        """Return the product as left out."""
        self.reason = reason
        return self.asked.without(StepName.VISIBILITY, reason, number=number)


def _one_colour(case: Meeting) -> Decisions:
    if case.colours and max(case.colours) - min(case.colours) > _SAME_COLOUR:
        told = ", ".join(f"{colour * 1e9:g}" for colour in sorted(set(case.colours)))
        reason = f"the instruments see different wavelengths: {told} nm"
        yield case.none(reason, max(case.colours) - min(case.colours))


def _few_enough(case: Meeting) -> Decisions:
    if not case.reason and len(case.beams) > geometry.MOST_BEAMS:
        reason = f"{len(case.beams)} beams are more than {geometry.MOST_BEAMS}"
        yield case.none(reason, float(len(case.beams)))


def _beams_meet(case: Meeting) -> Decisions:
    """Leave out beams that meet fewer than two others, until all that are left meet."""
    if case.reason:
        return
    kept = list(case.beams)
    while kept:
        net = case.net(kept)
        points = {beam: int(net.on_beam(n)[0].size) for n, beam in enumerate(kept)}
        lost = [beam for beam in kept if points[beam] < 2]
        for beam in lost:
            told = f"the beam at {beam.zenith_angle:g} degree, azimuth {beam.azimuth:g}, meets"
            reason = f"{told} fewer than two points that others see"
            yield _left(case.asked.settings, beam.instrument, reason, float(points[beam]))
        if not lost:
            break
        kept = [beam for beam in kept if beam not in lost]
    case.kept = tuple(kept)


def _some_meet(case: Meeting) -> Decisions:
    if not case.reason and not case.kept:
        reason = "no beam meets others in two points, between which extinction attenuates it"
        yield case.none(reason, 0.0)


def _cycle(case: Meeting) -> Decisions:
    method = case.asked.settings.method
    if case.reason or method not in {"cycle", "multiplier", "unbiased"}:
        return
    try:
        geometry.build_cycle(case.net(case.kept))
    except RetrievalInputError as error:
        yield case.none(f"method {method}: {error}", float(len(case.kept)))


def _range_window(case: Meeting) -> Decisions:
    """Decide, for every instrument, which bins its beams and its background need."""
    net = case.net(case.kept)
    for member in case.asked.scene.members:
        mine = [n for n, beam in enumerate(case.kept) if beam.instrument == member.instrument]
        if mine:
            farthest = max(float(net.on_beam(n)[1][-1]) for n in mine)
            yield _member_window(
                MemberCase(member, case.asked.campaign, case.asked.settings), farthest
            )


def _member_window(case: MemberCase, farthest: float) -> Step | LeftOut:
    channel = case.channel
    counts = case.of(channel)
    if channel.name.startswith(GLUED) or channel.mode is not DetectionMode.PHOTON:
        reason = "noise of analog records is estimated from the whole of them"
        return counts.without(StepName.RANGE_WINDOW, reason)
    if case.campaign.all_steps:
        return counts.without(StepName.RANGE_WINDOW, ALL_STEPS)
    width, (start, stop) = channel.bin_width, case.tail
    low, high = (share * (start + width) for share in BEFORE_TAIL)
    near = reaching(0.0, farthest + BEYOND * width, counts)
    far = (within(low - width, high, counts), within(start, stop, counts))
    kept = _merged([near, *far], channel.bins)
    number = float(sum(past - first for first, past in kept))
    if len(kept) == 1 and number == channel.bins:
        reason = "beams and background reach over all bins"
        return counts.without(StepName.RANGE_WINDOW, reason, number=number)
    reason = "no bins between the farthest point and those that tell the background are needed"
    return counts.step(StepName.RANGE_WINDOW, reason, number=number, bins=kept)


def _merged(stretches: Iterable[tuple[int, int]], bins: int) -> list[list[int]]:
    """Return stretches of bins, those that touch as one."""
    kept: list[list[int]] = []
    for first, past in sorted((first, min(past, bins)) for first, past in stretches):
        if kept and first <= kept[-1][1]:
            kept[-1][1] = max(kept[-1][1], past)
        elif first < past:
            kept.append([first, past])
    return kept


def _average(case: Meeting) -> Decisions:
    seconds = case.asked.settings.average.total_seconds()
    reason = "signals are averaged before they are solved: noise biases what is averaged afterwards"
    yield case.asked.step(StepName.AVERAGE, reason, number=seconds, seconds=seconds)


def _prior(case: Meeting) -> Decisions:
    settings = case.asked.settings
    if settings.method != "network":
        reason = f"method {settings.method} takes no prior"
        yield case.asked.without(StepName.PRIOR, reason)
    elif settings.prior == "none":
        reason = "the campaign asks for none: gradients along beams pass for attenuation"
        yield case.asked.without(StepName.PRIOR, reason)
    else:
        reason = (
            "decided from the data: the strongest prior about the mean field of a block that its"
            " beams do not contradict"
        )
        number = settings.block / settings.average
        yield case.asked.step(StepName.PRIOR, reason, number=number)


def _visibility(case: Meeting) -> Decisions:
    """Give the step that joins the members, which see light of one wavelength."""
    settings, net = case.asked.settings, case.net(case.kept)
    beams = case.kept
    yield case.asked.step(
        StepName.VISIBILITY,
        f"{len(beams)} beams of {len({beam.instrument for beam in beams})} instruments meet in"
        f" {net.crossings} points, {int(net.near_crossing.sum())} of which are near ones",
        number=float(net.crossings),
        beams=[beam.as_dict() for beam in beams],
        wavelength=min(case.colours),
        block_seconds=settings.block.total_seconds(),
        method=settings.method,
        prior=settings.prior,
        tolerance=settings.tolerance,
        smallest_angle=settings.smallest_angle,
        exponent_relative_error=settings.exponent_relative_error,
        lidar_ratio_relative_error=settings.lidar_ratio_relative_error,
        overlap_relative_error=settings.overlap_relative_error,
        **sight(settings.visibility),
    )


_MEMBER_CHANNEL: Final = "member_channel"
PRESENT: Final = Rule(
    "member_present", StepName.VISIBILITY, "Does the window hold files of the instrument?", _present
)
MEMBER: Final = (
    Rule("member", StepName.VISIBILITY, "Can the instrument take part?", _fits),
    Rule(_MEMBER_CHANNEL, StepName.READ, "Which channels does the network need?", _signals),
    Rule("member_background", StepName.BACKGROUND, "Where is its background?", _background),
)
"""Of each instrument of a network."""
MEETING: Final = (
    Rule("one_colour", StepName.VISIBILITY, "Do all see one wavelength?", _one_colour),
    Rule("few_beams", StepName.VISIBILITY, "Are there beams that can be solved?", _few_enough),
    Rule("beams_meet", StepName.VISIBILITY, "Does the beam meet others twice?", _beams_meet),
    Rule("some_meet", StepName.VISIBILITY, "Is a beam left that others meet?", _some_meet),
    Rule("cycle", StepName.VISIBILITY, "Do the beams make what the method needs?", _cycle),
)
"""Of all beams of a network; the first that finds that there is none ends it."""
JOINT: Final = (
    Rule(
        "member_window",
        StepName.RANGE_WINDOW,
        "Which bins do beams and background need?",
        _range_window,
    ),
    Rule("network_average", StepName.AVERAGE, "How long are signals averaged?", _average),
    Rule("prior", StepName.PRIOR, "Is a mean field held beforehand?", _prior),
    Rule("visibility", StepName.VISIBILITY, "Do beams meet, and where?", _visibility),
)
"""Of the beams that meet."""
NETWORK: Final = (PRESENT, *MEMBER, *MEETING, *JOINT)
