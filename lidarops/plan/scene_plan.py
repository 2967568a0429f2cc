"""Make the plan of a scene of one instrument: the steps that run, those left out, and why.

One rule decides on one step; `CHANNEL`, `RANGE_WINDOW` and `PRODUCTS` list the rules. A reason is
a sentence that a user can check against the campaign file. `plan_scene` is the entry point; it
hands networks over to `lidarops.plan.network_plan`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts, channel_facts
from lidarops.kinds import kinds
from lidarops.plan import availability, network_plan, scan_rules
from lidarops.plan.availability import glued_channels
from lidarops.plan.rules import (
    ALL_STEPS,
    ANALOG_NOISE,
    NO_PRODUCT,
    NO_WAVELENGTH,
    NOT_REQUESTED,
    REQUESTED,
    ChannelCase,
    Decisions,
    Rule,
    StepName,
    applied,
)
from lidarops.plan.signal_rules import (
    CONDITIONING,
    GLUED,
    bins_with_noise,
    fixed_zenith,
    glue_rules,
    glued_parts,
    no_scan,
    range_channel,
    range_offset,
    required_by,
    tail_mean_reason,
    wavelength,
)
from lidarops.products.elastic.settings import ElasticSettings
from lidarops.products.homogeneous.settings import HomogeneousSettings
from lidarops.products.multiangle.settings import MultiAngleSettings
from lidarops.products.signal.settings import SignalSettings
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    LeftOut,
    Plan,
    Scene,
    Step,
)
from lidarops.retrieve.homogeneous.labeled import LEVEL

MIN_SECTION_BINS = 8

LOOKED_AT: Final = 16
"""Number of profiles of a scene that are sampled first."""

_ROUNDING: Final = 1e-6
"""Relative tolerance: headers and campaign files round angles differently."""

_Settings = TypeVar(
    "_Settings", SignalSettings, HomogeneousSettings, ElasticSettings, MultiAngleSettings
)


@dataclass(frozen=True, slots=True)
class _SceneCase:
    """A scene of one instrument, with the campaign's facts about it."""

    scene: Scene
    instrument: Instrument
    facts: InstrumentFacts
    networks: Mapping[str, str]
    """Networks of which the instrument is a member -> the channel that they use."""


def plan_scene(scene: Scene, campaign: Campaign) -> Plan:
    """Decide what runs for a scene.

    Parameters
    ----------
    scene : Scene
    campaign : Campaign

    Returns
    -------
    Plan
        Steps by channel in the order in which they run. It may have no steps; `left_out` then
        states why.
    """
    if scene.members:
        return network_plan.plan_network(scene, campaign)
    instrument = campaign.instruments[scene.instrument]
    # A scene never spans an edge of a validity period, so the facts of its first granule hold.
    facts = instrument.facts_at(scene.granules[0].start or scene.start)
    steps: list[Step] = []
    networks = {
        name: network.visibility.channel
        for name, network in campaign.networks.items()
        if scene.instrument in network.instruments
    }
    case = _SceneCase(scene, instrument, facts, networks)
    held = availability.Held(scene.layout, instrument, facts)
    left_out = [
        omission for omission in applied(availability.RULES, held) if isinstance(omission, LeftOut)
    ]
    for channel in (*scene.layout, *glued_channels(scene.layout, instrument)):
        for decision in _channel(channel, case, all_steps=campaign.all_steps):
            (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]
    return _drop_unused_channels(Plan(scene.id, tuple(steps), tuple(left_out)))


def _drop_unused_channels(plan: Plan) -> Plan:
    """Return a plan without the channels of which no product is made."""
    names = tuple(kinds())
    used = {step.channel for step in plan.steps if step.name in names}
    for name in [name for name in used if name.startswith(GLUED)]:
        used.update(glued_parts(name))
    unused = {step.channel for step in plan.steps} - used
    reason = "no requested product of this channel can be made"
    return replace(
        plan,
        steps=tuple(step for step in plan.steps if step.channel in used),
        left_out=(
            *(
                omission
                for omission in plan.left_out
                if omission.channel not in unused or omission.name in names
            ),
            *(
                LeftOut(step.name, step.channel, reason, rule=step.rule)
                for step in plan.steps
                if step.channel in unused and step.name == StepName.READ
            ),
        ),
    )


def _channel(channel: ChannelLayout, whole: _SceneCase, *, all_steps: bool) -> Decisions:
    """Decide on the steps of one channel."""
    scene, instrument, facts = whole.scene, whole.instrument, whole.facts
    products = instrument.products
    glued_names = [glued.name for glued in glued_channels(scene.layout, instrument)]
    is_glued = channel.name in glued_names
    case = ChannelCase(
        scene=scene,
        channel=channel,
        facts=facts,
        facts_of_channel=channel_facts(facts, channel.name),
        member="",
        signal=_settings_for(products.signal, channel),
        homogeneous=None if is_glued else _settings_for(products.homogeneous, channel),
        elastic=_settings_for(products.elastic, channel),
        multiangle=_settings_for(products.multiangle, channel),
        glued=tuple(name for name in glued_names if channel.name in glued_parts(name)),
        networks=tuple(
            name
            for name, used in whole.networks.items()
            if channel.name in (glued_parts(used) if used.startswith(GLUED) else (used,))
        ),
        all_steps=all_steps,
    )
    reading = list(CHANNEL.decisions(case))
    yield from reading
    if not any(isinstance(decision, Step) for decision in reading):
        return
    yield from glue_rules(case) if is_glued else applied((RANGE_WINDOW, *CONDITIONING), case)
    yield from applied(PRODUCTS, case)


def _read(case: ChannelCase) -> Decisions:
    requesters = list(_requesters(case))
    if not requesters:
        reason = NO_PRODUCT
        if case.networks:
            word = "networks" if len(case.networks) > 1 else "network"
            reason = f"used only by {word} {' and '.join(case.networks)}"
        yield case.without(StepName.READ, reason)
        return
    name = case.channel.name
    facts_of_channel = (
        channel_facts(case.facts, glued_parts(name)[1])
        if name.startswith(GLUED)
        else case.facts_of_channel
    )
    if math.isnan(wavelength(case.channel, facts_of_channel)):
        yield case.without(StepName.READ, NO_WAVELENGTH)
        return
    yield case.step(
        StepName.READ,
        required_by(requesters),
        wavelength=wavelength(case.channel, facts_of_channel),
    )


def _settings_for(settings: _Settings | None, channel: ChannelLayout) -> _Settings | None:
    if settings is None:
        return None
    # "all" means the channels of the files: a glued one has to be requested by name.
    covers_all = settings.channels == "all" and not channel.name.startswith(GLUED)
    return settings if covers_all or channel.name in settings.channels else None


def _requesters(case: ChannelCase) -> Iterator[str]:
    if case.signal is not None:
        yield "signal"
    if case.homogeneous is not None:
        yield "homogeneous"
    if case.elastic is not None:
        yield "elastic"
    if case.multiangle is not None:
        yield "multiangle"
    yield from case.glued


def _range_window(case: ChannelCase) -> Decisions:
    if case.homogeneous is None:
        return
    if case.channel.mode is not DetectionMode.PHOTON:
        yield case.without(StepName.RANGE_WINDOW, ANALOG_NOISE)
        return
    if case.all_steps:
        yield case.without(StepName.RANGE_WINDOW, ALL_STEPS)
        return
    farthest = max((far for _, far in _level_sections(case)), default=math.nan)
    if math.isnan(farthest):
        return
    bins = bins_with_noise(0.0, farthest, case)[1]
    if not 0 < bins < case.channel.bins:
        reason = "a section extends to the last bin"
        yield case.without(StepName.RANGE_WINDOW, reason, number=float(case.channel.bins))
        return
    reason = "neither homogeneous sections nor the noise of their counts need farther bins"
    yield case.step(StepName.RANGE_WINDOW, reason, number=float(bins), bins=[[0, bins]])


def _background(case: ChannelCase) -> Decisions:
    if case.signal is None:
        return
    start, stop, bins = _tail(case, case.signal)
    if bins < MIN_SECTION_BINS:
        return
    yield case.step(
        StepName.BACKGROUND,
        tail_mean_reason(case.signal.background_range),
        number=bins,
        method="tail_mean",
        range=[start, stop],
    )


def _tail(case: ChannelCase, settings: SignalSettings) -> tuple[float, float, float]:
    """Return the limits of the range whose mean is the background, m, and its number of bins."""
    start, stop = settings.background_range or (0.9 * case.last, case.last)
    stop = min(stop, case.last)
    return start, stop, (stop - start) / case.channel.bin_width


def _signal(case: ChannelCase) -> Decisions:
    if case.signal is None:
        yield case.without(StepName.SIGNAL, NOT_REQUESTED)
        return
    start, _, bins = _tail(case, case.signal)
    if bins < MIN_SECTION_BINS:
        stop = case.signal.background_range[1] if case.signal.background_range else case.last
        reason = (
            f"background_range {start:g}-{stop:g} m holds fewer than {MIN_SECTION_BINS} bins;"
            f" the last bin ends at {case.last:g} m"
        )
        yield case.without(StepName.SIGNAL, reason, number=bins)
        return
    yield case.step(StepName.SIGNAL, REQUESTED)


def _inside(case: ChannelCase, near: float, far: float) -> float:
    """Return the number of bins of a section; NaN where it extends beyond the last bin."""
    return (far - near) / case.channel.bin_width if far <= case.last else math.nan


def _sections(case: ChannelCase) -> list[tuple[float, float]]:
    """Return the sections that lie within the bins."""
    requested = [] if case.homogeneous is None else case.homogeneous.sections
    return [(near, far) for near, far in requested if _inside(case, near, far) >= MIN_SECTION_BINS]


def _outside(case: ChannelCase) -> Decisions:
    inside = _sections(case)
    for near, far in [] if case.homogeneous is None else case.homogeneous.sections:
        if (near, far) not in inside:
            bins = (min(far, case.last) - near) / case.channel.bin_width
            reason = (
                f"section {near:g}-{far:g} m extends beyond the last bin at {case.last:g} m, or"
                f" holds fewer than {MIN_SECTION_BINS} bins"
            )
            yield case.without(StepName.HOMOGENEOUS, reason, number=bins)


def _climb(case: ChannelCase, near: float, far: float) -> float:
    """Return the climb of the most level beam of a scene along a section, m.

    Infinite where the zenith angle is unknown, so that the beam does not count as level.
    """
    fixed = case.facts.zenith_angle
    angles = [granule.zenith_angle if fixed is None else fixed for granule in case.scene.granules]
    return min(
        math.inf if angle is None else (far - near) * abs(math.cos(math.radians(angle)))
        for angle in angles
    )


def _level_sections(case: ChannelCase) -> list[tuple[float, float]]:
    """Return the sections that are retrieved: within the bins, along a nearly level path."""
    return [
        (near, far)
        for near, far in _sections(case)
        if case.all_steps or _climb(case, near, far) <= LEVEL * (1.0 + _ROUNDING)
    ]


def _level(case: ChannelCase) -> Decisions:
    kept = _level_sections(case)
    for near, far in _sections(case):
        if (near, far) not in kept:
            climb = _climb(case, near, far)
            slope = (
                "neither headers nor campaign give the zenith angle"
                if math.isinf(climb)
                else f"the beam climbs {climb:.0f} m (limit {LEVEL:g} m)"
            )
            reason = f"section {near:g}-{far:g} m: {slope}; a vertical gradient would mimic"
            reason += " extinction"
            number = None if math.isinf(climb) else climb
            yield case.without(StepName.HOMOGENEOUS, reason, number=number)


def _look(case: ChannelCase) -> Decisions:
    if case.homogeneous is None or not _level_sections(case):
        return
    if case.all_steps:
        yield case.without(StepName.LOOK, ALL_STEPS)
    else:
        reason = "sections in which no sampled profile shows a signal are not retrieved"
        yield case.step(StepName.LOOK, reason, number=float(LOOKED_AT), profiles=LOOKED_AT)


def _homogeneous(case: ChannelCase) -> Decisions:
    if case.homogeneous is None:
        yield case.without(StepName.HOMOGENEOUS, NOT_REQUESTED)
        return
    sections = [[near, far] for near, far in _level_sections(case)]
    if sections:
        definition = case.homogeneous.visibility
        yield case.step(
            StepName.HOMOGENEOUS,
            f"{REQUESTED}; background is retrieved together with extinction",
            number=float(len(sections)),
            method=case.homogeneous.method,
            sections=sections,
            **(
                {}
                if definition is None
                else {"visibility": network_plan.visibility_settings(definition)}
            ),
        )


def _along_path(case: ChannelCase) -> Decisions:
    if case.homogeneous is None or not _level_sections(case):
        return
    definition = case.homogeneous.visibility
    if definition is None:
        reason = "the campaign requests no visibility along the sections"
        yield case.without(StepName.ALONG_PATH, reason)
    else:
        reason = "the campaign requests visibility along the sections"
        yield case.step(StepName.ALONG_PATH, reason, number=definition.threshold)


@dataclass(frozen=True, slots=True)
class _ReferenceLimits:
    """Limits within which the reference window may lie, m along the beam."""

    bottom: float
    top: float
    width: float
    reason: str
    """Why there can be no reference window; empty where there can."""


def _reference_limits(case: ChannelCase, settings: ElasticSettings) -> _ReferenceLimits:
    zenith, reason = fixed_zenith(case)
    stretch = 1.0 / math.cos(math.radians(zenith)) if not reason else math.nan
    window = settings.reference
    # A window is a set of bin centres.
    ranged = replace(case.channel, name=range_channel(case.channel.name))
    offset = range_offset(ranged, case.facts)
    reach = case.last - 0.5 * case.channel.bin_width + offset
    bottom, top = window.lowest * stretch, min(window.highest * stretch, reach)
    if not reason and top - bottom < window.width * stretch * (1.0 - 1e-9):
        reason = (
            f"the last bin at {reach:g} m is too near for a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    return _ReferenceLimits(bottom, top, window.width * stretch, reason)


def _elastic_settings(case: ChannelCase) -> ElasticSettings | None:
    """Return the settings of the elastic product; None where it is not made."""
    settings = case.elastic
    return None if settings is None or _reference_limits(case, settings).reason else settings


def _average(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is not None:
        seconds = settings.average.total_seconds()
        reason = "the noise of a single profile is too large for the inversion"
        yield case.step(StepName.AVERAGE, reason, number=seconds, seconds=seconds)


def _known_shape(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is None:
        return
    if settings.background == "known_shape":
        reason = "the far range is assumed to be aerosol-free, and tested"
        yield case.step(StepName.KNOWN_SHAPE, reason)
    else:
        reason = "the campaign requests tail_mean; signal in the far range biases it"
        yield case.without(StepName.KNOWN_SHAPE, reason)


def _reference(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is None:
        return
    limits = _reference_limits(case, settings)
    reason = "windows within the campaign's limits are tested against the molecular profile"
    yield case.step(
        StepName.REFERENCE,
        reason,
        number=limits.top - limits.bottom,
        lowest=limits.bottom,
        highest=limits.top,
        width=limits.width,
        scattering_ratio=settings.reference.scattering_ratio,
        relative_error=settings.reference.relative_error,
    )


def _elastic(case: ChannelCase) -> Decisions:
    settings = case.elastic
    if settings is None:
        yield case.without(StepName.ELASTIC, NOT_REQUESTED)
        return
    limits = _reference_limits(case, settings)
    if limits.reason:
        yield case.without(StepName.ELASTIC, limits.reason)
        return
    yield case.step(
        StepName.ELASTIC,
        REQUESTED,
        lidar_ratio=settings.lidar_ratio,
        lidar_ratio_standard_error=settings.lidar_ratio_standard_error,
        molecular_relative_error=settings.molecular_relative_error,
    )


def _molecular(case: ChannelCase) -> Decisions:
    scans = case.multiangle is not None and not no_scan(case)
    if _elastic_settings(case) is None and not scans:
        return
    source = case.facts.molecular_profile
    if source:
        reason = "given by the campaign"
        yield case.step(StepName.MOLECULAR, reason, molecular_profile=source)
        return
    reason = "the campaign gives no molecular_profile; US Standard Atmosphere 1976 is used"
    yield case.step(StepName.MOLECULAR, reason)


CHANNEL: Final = Rule(
    "channel", StepName.READ, "Does a product need the channel, at a known wavelength?", _read
)
RANGE_WINDOW: Final = Rule(
    "range_window",
    StepName.RANGE_WINDOW,
    "Which bins do the sections of a photon-counting channel need?",
    _range_window,
)
PRODUCTS: Final = (
    Rule("background", StepName.BACKGROUND, "Does the far range hold enough bins?", _background),
    Rule("signal", StepName.SIGNAL, "Is it requested, with bins for the background?", _signal),
    Rule("section_inside", StepName.HOMOGENEOUS, "Is the section within the bins?", _outside),
    Rule("section_level", StepName.HOMOGENEOUS, "Is the path nearly level?", _level),
    Rule("look", StepName.LOOK, "May sections contain no signal?", _look),
    Rule("homogeneous", StepName.HOMOGENEOUS, "Is a section left to retrieve?", _homogeneous),
    Rule("along_path", StepName.ALONG_PATH, "Is visibility on the path requested?", _along_path),
    Rule("average", StepName.AVERAGE, "Does a retrieval need averaged signals?", _average),
    Rule("molecular", StepName.MOLECULAR, "Does a retrieval need the air density?", _molecular),
    Rule("known_shape", StepName.KNOWN_SHAPE, "Which background is requested?", _known_shape),
    Rule("reference", StepName.REFERENCE, "Where may the air be aerosol-free?", _reference),
    Rule("elastic", StepName.ELASTIC, "Does a fixed beam reach aerosol-free air?", _elastic),
    *scan_rules.SCANS,
)
"""Rules for the products of a channel, in the order in which the steps run."""
