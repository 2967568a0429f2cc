"""Make the plan of a scene of a network: where beams cross, which steps run, and why."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.campaign.model import Campaign, InstrumentFacts, channel_facts
from lidarops.errors import RetrievalInputError
from lidarops.plan.rules import (
    ALL_STEPS,
    ANALOG_NOISE,
    NO_WAVELENGTH,
    Case,
    Decisions,
    Rule,
    StepName,
    applied,
)
from lidarops.plan.signal_rules import (
    GLUED,
    bins_with_noise,
    bins_within,
    conditioning,
    glue_rules,
    glued_parts,
    joined_layout,
    range_channel,
    range_offset,
    required_by,
    tail_mean_reason,
    wavelength,
)
from lidarops.products.visibility.settings import VisibilityProductSettings
from lidarops.records import ChannelLayout, DetectionMode, Granule, LeftOut, Plan, Scene, Step
from lidarops.retrieve.background.left_signal import window_before
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.labeled import BINS_BEYOND
from lidarops.settings import VisibilitySettings

SAME_POINTING: Final = 0.1
"""degree; pointings of one instrument within this angle are one beam (resolution of headers)."""
_SAME_WAVELENGTH: Final = 1e-9
"""m; largest difference between equal wavelengths of instruments."""

VISIBILITY_KEYS: Final = ("contrast", "law", "angstrom_exponent", "exponent_standard_error")
"""Settings of a step that define visibility."""


@dataclass(frozen=True, slots=True)
class BeamPlan:
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

    def as_dict(self) -> dict[str, Any]:
        """Return the beam as plain JSON types."""
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
        Scene with members.
    campaign : Campaign

    Returns
    -------
    Plan
        Steps of the channels of every member, then those of the network, whose settings name the
        beams. Without steps where the beams do not cross; `left_out` then states why.
    """
    case = _NetworkCase(scene, campaign)
    steps: list[Step] = []
    left_out: list[LeftOut] = []
    _sort(applied((PRESENT,), case), steps, left_out)
    for member in scene.members:
        _sort(applied(MEMBER, _MemberCase(member, campaign, case.settings)), steps, left_out)
    able = {step.instrument for step in steps}
    beams = [
        beam
        for member in scene.members
        if member.instrument in able
        for beam in _MemberCase(member, campaign, case.settings).pointings()
    ]
    wavelengths = [step.settings["wavelength"] for step in steps if step.name == StepName.READ]
    crossings = _CrossingsCase(case, tuple(beams), tuple(wavelengths))
    _sort(applied(CROSSINGS, crossings), [], left_out)
    if crossings.reason:
        return Plan(scene.id, (), tuple(left_out))
    used = {beam.instrument for beam in crossings.kept}
    steps = [step for step in steps if step.instrument in used]
    _sort(applied(JOINT, crossings), steps, left_out)
    return Plan(scene.id, tuple(steps), tuple(left_out))


def _sort(decisions: Decisions, steps: list[Step], left_out: list[LeftOut]) -> None:
    for decision in decisions:
        (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]


def visibility_settings(settings: VisibilitySettings) -> dict[str, Any]:
    """Return the definition of visibility as settings of a step."""
    return {
        "contrast": settings.threshold,
        "law": settings.law,
        "angstrom_exponent": settings.angstrom_exponent,
        "exponent_standard_error": settings.exponent_standard_error,
    }


def _beams_of(
    beams: Sequence[BeamPlan], scene: Scene, campaign: Campaign
) -> tuple[geometry.Beam, ...]:
    """Return the position and direction of the beams."""
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


def member_channel(member: Scene, name: str) -> ChannelLayout:
    """Return a channel of the files of a member, or one glued from two of them."""
    if name.startswith(GLUED):
        return joined_layout(member.layout, [name])[0]
    return next(channel for channel in member.layout if channel.name == name)


def channel_ranges(channel: ChannelLayout, facts: InstrumentFacts) -> npt.NDArray[np.float64]:
    """Return the ranges of the bin centres of a channel, m."""
    ranged = replace(channel, name=range_channel(channel.name))
    middles = (np.arange(channel.bins) + 0.5) * channel.bin_width
    return np.asarray(middles + range_offset(ranged, facts))


def _granule_pointing(granule: Granule, facts: InstrumentFacts) -> tuple[float, float] | None:
    """Return zenith angle and azimuth of a granule; facts of the campaign override headers."""
    zenith = granule.zenith_angle if facts.zenith_angle is None else facts.zenith_angle
    azimuth = granule.azimuth if facts.azimuth is None else facts.azimuth
    if zenith is None or azimuth is None:
        return None
    return zenith, azimuth % 360.0


@dataclass(frozen=True, slots=True)
class _NetworkCase:
    """A scene of a network, as the rules see it."""

    scene: Scene
    campaign: Campaign

    @property
    def settings(self) -> VisibilityProductSettings:
        """Settings of the product."""
        return self.campaign.networks[self.scene.instrument].visibility

    def step(
        self, name: StepName, reason: str, *, number: float | None = None, **settings: Any
    ) -> Step:
        """Return a step of the whole network."""
        return Step(name.value, self.settings.channel, settings, reason, number=number)

    def without(self, name: StepName, reason: str, *, number: float | None = None) -> LeftOut:
        """Return a step that is left out for the whole network."""
        return LeftOut(name.value, self.settings.channel, reason, number=number)


@dataclass(frozen=True, slots=True)
class _MemberCase:
    """The scene of one member of a network, as the rules see it."""

    scene: Scene
    """Scene of the member."""
    campaign: Campaign
    settings: VisibilityProductSettings

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument."""
        instrument = self.campaign.instruments[self.scene.instrument]
        return instrument.facts_at(self.scene.granules[0].start or self.scene.start)

    @property
    def channel(self) -> ChannelLayout:
        """The channel that the network uses."""
        return member_channel(self.scene, self.settings.channel)

    @property
    def tail(self) -> tuple[float, float]:
        """Limits in m of the range whose mean is the background."""
        last = self.channel.bins * self.channel.bin_width
        start, stop = self.settings.background_range or (0.9 * last, last)
        return start, min(stop, last)

    def channel_case(self, channel: ChannelLayout) -> Case:
        """Return the case of a channel."""
        facts_of_channel = channel_facts(self.facts, channel.name)
        return Case(self.scene, channel, self.facts, facts_of_channel, self.scene.instrument)

    def why_not(self) -> tuple[str, float | None]:
        """Return why a member cannot take part (empty where it can), and the deciding number."""
        name, facts = self.settings.channel, self.facts
        glued = joined_layout(self.scene.layout, [name]) if name.startswith(GLUED) else ()
        held = [channel.name for channel in (*self.scene.layout, *glued)]
        if name not in held:
            return f"the files hold no {name}, only {', '.join(held)}", None
        photon = channel_facts(facts, range_channel(name))
        if math.isnan(wavelength(self.channel, photon)):
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
        end = float(channel_ranges(self.channel, self.facts)[-1])
        farthest = min(end, self.settings.farthest or end)
        distinct: list[tuple[float, float]] = []
        for direction in directions:
            if not any(angle_between(direction, other) <= SAME_POINTING for other in distinct):
                distinct.append(direction)
        for zenith, azimuth in distinct:
            yield BeamPlan(
                self.scene.instrument,
                zenith,
                azimuth,
                self.facts.full_overlap_range,
                farthest,
                self.settings.exponent_of(self.scene.instrument),
            )


def _left(
    settings: VisibilityProductSettings, member: str, reason: str, number: float | None = None
) -> LeftOut:
    reason = f"{member}: {reason}"
    return LeftOut(StepName.VISIBILITY.value, settings.channel, reason, member, number=number)


def _present(case: _NetworkCase) -> Decisions:
    present = {member.instrument for member in case.scene.members}
    for name in case.campaign.networks[case.scene.instrument].instruments:
        if name not in present:
            yield _left(case.settings, name, "no granule in the window", 0.0)


def _fits(case: _MemberCase) -> Decisions:
    reason, number = case.why_not()
    if reason:
        yield _left(case.settings, case.scene.instrument, reason, number)


def _signals(case: _MemberCase) -> Decisions:
    """Decide on the steps from the counts of a member to its signal, by the rules of a channel."""
    if case.why_not()[0]:
        return
    name = case.settings.channel
    present = {channel.name: channel for channel in case.scene.layout}
    for part in glued_parts(name) if name.startswith(GLUED) else (name,):
        part_case = case.channel_case(present[part])
        yield _read(part_case, wavelength(part_case.channel, part_case.facts_of_channel))
        yield from conditioning(part_case)
    if name.startswith(GLUED):
        glued_case = case.channel_case(case.channel)
        photon = channel_facts(case.facts, glued_parts(name)[1])
        yield _read(glued_case, wavelength(glued_case.channel, photon))
        yield from glue_rules(glued_case)


def _read(case: Case, metres: float) -> Step:
    """Return the step that reads a channel at a wavelength in m."""
    reason = required_by([StepName.VISIBILITY])
    step = case.step(StepName.READ, reason, number=metres, wavelength=metres)
    return replace(step, rule=_MEMBER_CHANNEL)


def _background(case: _MemberCase) -> Decisions:
    if case.why_not()[0]:
        return
    channel = case.channel
    start, stop = case.tail
    yield case.channel_case(channel).step(
        StepName.BACKGROUND,
        tail_mean_reason(case.settings.background_range),
        number=(stop - start) / channel.bin_width,
        method="tail_mean",
        range=[start, stop],
    )


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


def _network_of(
    beams: Sequence[BeamPlan],
    scene: Scene,
    campaign: Campaign,
    *,
    tolerance: float,
    smallest_angle: float,
) -> geometry.Network:
    """Return the crossings of beams; see `lidarops.retrieve.network.geometry.build_network`."""
    return geometry.build_network(
        _beams_of(beams, scene, campaign),
        tolerance=tolerance,
        nearest=[beam.nearest for beam in beams],
        farthest=[beam.farthest for beam in beams],
        smallest_angle=smallest_angle,
    )


class _CrossingsCase:
    """The beams of a network, as the rules see them, which determine those that cross."""

    def __init__(
        self, whole: _NetworkCase, beams: Sequence[BeamPlan], wavelengths: Sequence[float]
    ) -> None:
        self.whole = whole
        self.beams = tuple(beams)
        self.wavelengths = tuple(wavelengths)
        self.kept: tuple[BeamPlan, ...] = ()
        self.reason = ""
        """Why there is no network; empty where there is one."""

    def crossings(self, beams: Sequence[BeamPlan]) -> geometry.Network:
        """Return the crossings of beams."""
        settings = self.whole.settings
        return _network_of(
            beams, self.whole.scene, self.whole.campaign,
            tolerance=settings.tolerance, smallest_angle=settings.smallest_angle,
        )  # fmt: skip

    def no_network(self, reason: str, number: float | None = None) -> LeftOut:
        """Keep the reason why there is no network, and return the product as left out."""
        self.reason = reason
        return self.whole.without(StepName.VISIBILITY, reason, number=number)


def _one_wavelength(case: _CrossingsCase) -> Decisions:
    wavelengths = case.wavelengths
    if wavelengths and max(wavelengths) - min(wavelengths) > _SAME_WAVELENGTH:
        listed = ", ".join(f"{metres * 1e9:g}" for metres in sorted(set(wavelengths)))
        reason = f"the instruments have different wavelengths: {listed} nm"
        yield case.no_network(reason, max(wavelengths) - min(wavelengths))


def _few_enough(case: _CrossingsCase) -> Decisions:
    if not case.reason and len(case.beams) > geometry.MOST_BEAMS:
        reason = f"{len(case.beams)} beams exceed the limit of {geometry.MOST_BEAMS}"
        yield case.no_network(reason, float(len(case.beams)))


def _beams_meet(case: _CrossingsCase) -> Decisions:
    """Leave out beams with fewer than two crossings, until all remaining beams have two."""
    if case.reason:
        return
    kept = list(case.beams)
    while kept:
        network = case.crossings(kept)
        counts = {beam: int(network.on_beam(n)[0].size) for n, beam in enumerate(kept)}
        lost = [beam for beam in kept if counts[beam] < 2]
        for beam in lost:
            pointing = f"zenith angle {beam.zenith_angle:g} and azimuth {beam.azimuth:g} degree"
            reason = f"the beam at {pointing} has fewer than two crossings with other beams"
            yield _left(case.whole.settings, beam.instrument, reason, float(counts[beam]))
        if not lost:
            break
        kept = [beam for beam in kept if beam not in lost]
    case.kept = tuple(kept)


def _some_left(case: _CrossingsCase) -> Decisions:
    if not case.reason and not case.kept:
        reason = "no beam has two crossings with other beams, between which it is attenuated"
        yield case.no_network(reason, 0.0)


def _cycle(case: _CrossingsCase) -> Decisions:
    method = case.whole.settings.method
    if case.reason or method not in {"cycle", "multiplier", "unbiased"}:
        return
    try:
        geometry.build_cycle(case.crossings(case.kept))
    except RetrievalInputError as error:
        yield case.no_network(f"method {method}: {error}", float(len(case.kept)))


def _range_window(case: _CrossingsCase) -> Decisions:
    """Decide, for every instrument, which bins its crossings and its background need."""
    network = case.crossings(case.kept)
    for member in case.whole.scene.members:
        numbers = [n for n, beam in enumerate(case.kept) if beam.instrument == member.instrument]
        if numbers:
            farthest = max(float(network.on_beam(n)[1][-1]) for n in numbers)
            yield _member_window(
                _MemberCase(member, case.whole.campaign, case.whole.settings), farthest
            )


def _member_window(case: _MemberCase, farthest: float) -> Step | LeftOut:
    channel = case.channel
    counts = case.channel_case(channel)
    if channel.name.startswith(GLUED) or channel.mode is not DetectionMode.PHOTON:
        return counts.without(StepName.RANGE_WINDOW, ANALOG_NOISE)
    if case.campaign.all_steps:
        return counts.without(StepName.RANGE_WINDOW, ALL_STEPS)
    width, (start, stop) = channel.bin_width, case.tail
    low, high = window_before(start + width)
    near = bins_with_noise(0.0, farthest + BINS_BEYOND * width, counts)
    far = (bins_within(low - width, high, counts), bins_within(start, stop, counts))
    kept = _merged([near, *far], channel.bins)
    number = float(sum(past - first for first, past in kept))
    if len(kept) == 1 and number == channel.bins:
        reason = "crossings and background need all bins"
        return counts.without(StepName.RANGE_WINDOW, reason, number=number)
    reason = "bins between the farthest crossing and the background range are not needed"
    return counts.step(StepName.RANGE_WINDOW, reason, number=number, bins=kept)


def _merged(stretches: Iterable[tuple[int, int]], bins: int) -> list[list[int]]:
    """Return stretches of bins, with touching ones merged."""
    kept: list[list[int]] = []
    for first, past in sorted((first, min(past, bins)) for first, past in stretches):
        if kept and first <= kept[-1][1]:
            kept[-1][1] = max(kept[-1][1], past)
        elif first < past:
            kept.append([first, past])
    return kept


def _average(case: _CrossingsCase) -> Decisions:
    seconds = case.whole.settings.average.total_seconds()
    reason = "signals are averaged before the retrieval: noise biases means of retrieved values"
    yield case.whole.step(StepName.AVERAGE, reason, number=seconds, seconds=seconds)


def _prior(case: _CrossingsCase) -> Decisions:
    settings = case.whole.settings
    if settings.method != "network":
        reason = f"method {settings.method} uses no prior"
        yield case.whole.without(StepName.PRIOR, reason)
    elif settings.prior == "none":
        reason = "the campaign requests no prior: gradients along beams mimic attenuation"
        yield case.whole.without(StepName.PRIOR, reason)
    else:
        reason = (
            "decided from the data: the strongest prior about the mean field of a block that agrees"
            " with its beams"
        )
        number = settings.block / settings.average
        yield case.whole.step(StepName.PRIOR, reason, number=number)


def _visibility(case: _CrossingsCase) -> Decisions:
    """Yield the step that retrieves visibility from the beams of all members."""
    settings, network = case.whole.settings, case.crossings(case.kept)
    beams = case.kept
    yield case.whole.step(
        StepName.VISIBILITY,
        f"{len(beams)} beams of {len({beam.instrument for beam in beams})} instruments have"
        f" {network.crossings} crossings, {int(network.near_crossing.sum())} of them near ones",
        number=float(network.crossings),
        beams=[beam.as_dict() for beam in beams],
        wavelength=min(case.wavelengths),
        block_seconds=settings.block.total_seconds(),
        method=settings.method,
        prior=settings.prior,
        tolerance=settings.tolerance,
        smallest_angle=settings.smallest_angle,
        exponent_relative_error=settings.exponent_relative_error,
        lidar_ratio_relative_error=settings.lidar_ratio_relative_error,
        overlap_relative_error=settings.overlap_relative_error,
        **visibility_settings(settings.visibility),
    )


_MEMBER_CHANNEL: Final = "member_channel"
PRESENT: Final = Rule(
    "member_present", StepName.VISIBILITY, "Does the window hold files of the instrument?", _present
)
MEMBER: Final = (
    Rule("member", StepName.VISIBILITY, "Can the instrument take part?", _fits),
    Rule(_MEMBER_CHANNEL, StepName.READ, "Which channels does the network need?", _signals),
    Rule("member_background", StepName.BACKGROUND, "Which bins give the background?", _background),
)
"""Rules for each instrument of a network."""
CROSSINGS: Final = (
    Rule("one_colour", StepName.VISIBILITY, "Do all have one wavelength?", _one_wavelength),
    Rule("few_beams", StepName.VISIBILITY, "Are there few enough beams?", _few_enough),
    Rule("beams_meet", StepName.VISIBILITY, "Does the beam have two crossings?", _beams_meet),
    Rule("some_meet", StepName.VISIBILITY, "Is a beam with crossings left?", _some_left),
    Rule("cycle", StepName.VISIBILITY, "Do the beams form the cycle of the method?", _cycle),
)
"""Rules for all beams of a network; the first that finds no network ends the planning."""
JOINT: Final = (
    Rule(
        "member_window",
        StepName.RANGE_WINDOW,
        "Which bins do crossings and background need?",
        _range_window,
    ),
    Rule("network_average", StepName.AVERAGE, "How long are signals averaged?", _average),
    Rule("prior", StepName.PRIOR, "Is there a prior about the field?", _prior),
    Rule("visibility", StepName.VISIBILITY, "Where do the beams cross?", _visibility),
)
"""Rules for the beams that cross."""
NETWORK: Final = (PRESENT, *MEMBER, *CROSSINGS, *JOINT)
