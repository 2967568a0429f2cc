"""Scene -> plan: what runs for a scene, what is left out, and why.

Every rule gives its reason in words that a user can check against the campaign file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts, channel_facts
from lidarops.campaign.product_settings import (
    ElasticSettings,
    HomogeneousSettings,
    MultiAngleSettings,
    SignalSettings,
)
from lidarops.plan import availability, network_plan, scan_rules
from lidarops.plan.availability import glued_channels
from lidarops.plan.signal_rules import (
    ALL_STEPS,
    CONDITIONING,
    GLUED,
    ChannelCase,
    Decisions,
    Rule,
    StepName,
    applied,
    glue_rules,
    no_scan,
    parts_of,
    range_offset,
    ranged_by,
    reaching,
    steady_zenith,
    wavelength,
)
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    LeftOut,
    Plan,
    ProductKind,
    Scene,
    Step,
)
from lidarops.retrieve.homogeneous.labeled import LEVEL

MIN_SECTION_BINS = 8

LOOKED_AT: Final = 16
"""Profiles of a scene that are looked at first."""

_ROUNDING: Final = 1e-6
"""Relative; angles of headers and of files are rounded in ways of their own."""

_Settings = TypeVar(
    "_Settings", SignalSettings, HomogeneousSettings, ElasticSettings, MultiAngleSettings
)


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the rules of a whole scene look at."""

    scene: Scene
    instrument: Instrument
    facts: InstrumentFacts
    networks: Mapping[str, str]
    """Those that the instrument is part of -> the channel that they want."""


def plan_scene(scene: Scene, campaign: Campaign) -> Plan:
    """Decide what runs for a scene.

    Parameters
    ----------
    scene : Scene
    campaign : Campaign

    Returns
    -------
    Plan
        Steps by channel in the order in which they run. A plan without steps is possible; its
        `left_out` says why.
    """
    if scene.members:
        return network_plan.plan_network(scene, campaign)
    instrument = campaign.instruments[scene.instrument]
    # A scene never straddles an edge of a validity period, so its first granule speaks for all.
    facts = instrument.facts_at(scene.granules[0].start or scene.start)
    steps: list[Step] = []
    networks = {
        name: network.visibility.channel
        for name, network in campaign.networks.items()
        if scene.instrument in network.instruments
    }
    asked = _Asked(scene, instrument, facts, networks)
    held = availability.Held(scene.layout, instrument, facts)
    left_out = [left for left in applied(availability.RULES, held) if isinstance(left, LeftOut)]
    for channel in (*scene.layout, *glued_channels(scene.layout, instrument)):
        for decision in _channel(channel, asked, all_steps=campaign.all_steps):
            (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]
    return _without_idle(Plan(scene.id, tuple(steps), tuple(left_out)))


def _without_idle(told: Plan) -> Plan:
    """Leave out the channels of which every product is left out, as nothing reads them."""
    kinds = tuple(ProductKind)
    giving = {step.channel for step in told.steps if step.name in kinds}
    for name in [name for name in giving if name.startswith(GLUED)]:
        giving.update(parts_of(name))
    idle = {step.channel for step in told.steps} - giving
    reason = "nothing that this channel is asked for can be made"
    return replace(
        told,
        steps=tuple(step for step in told.steps if step.channel in giving),
        left_out=(
            *(left for left in told.left_out if left.channel not in idle or left.name in kinds),
            *(
                LeftOut(step.name, step.channel, reason, rule=step.rule)
                for step in told.steps
                if step.channel in idle and step.name == StepName.READ
            ),
        ),
    )


def _channel(channel: ChannelLayout, asked: _Asked, *, all_steps: bool) -> Decisions:
    scene, instrument, facts = asked.scene, asked.instrument, asked.facts
    products = instrument.products
    made = [glued.name for glued in glued_channels(scene.layout, instrument)]
    joined = channel.name in made
    case = ChannelCase(
        scene=scene,
        channel=channel,
        facts=facts,
        known=channel_facts(facts, channel.name),
        member="",
        signal=_wanted(products.signal, channel),
        homogeneous=None if joined else _wanted(products.homogeneous, channel),
        elastic=_wanted(products.elastic, channel),
        multiangle=_wanted(products.multiangle, channel),
        glued=tuple(name for name in made if channel.name in parts_of(name)),
        networks=tuple(
            name
            for name, wanted in asked.networks.items()
            if channel.name in (parts_of(wanted) if wanted.startswith(GLUED) else (wanted,))
        ),
        all_steps=all_steps,
    )
    reading = list(CHANNEL.decisions(case))
    yield from reading
    if not any(isinstance(decision, Step) for decision in reading):
        return
    yield from glue_rules(case) if joined else applied((RANGE_WINDOW, *CONDITIONING), case)
    yield from applied(PRODUCTS, case)


def _read(case: ChannelCase) -> Decisions:
    asked = list(_asked(case))
    if not asked:
        reason = "no product of the campaign asks for this channel"
        if case.networks:
            word = "networks" if len(case.networks) > 1 else "network"
            reason = f"used by {word} {' and '.join(case.networks)} alone"
        yield case.without(StepName.READ, reason)
        return
    name = case.channel.name
    known = channel_facts(case.facts, parts_of(name)[1]) if name.startswith(GLUED) else case.known
    if math.isnan(wavelength(case.channel, known)):
        reason = "the header's wavelength is implausible and the campaign's facts give none"
        yield case.without(StepName.READ, reason)
        return
    yield case.step(
        StepName.READ,
        "asked for by " + " and ".join(asked),
        wavelength=wavelength(case.channel, known),
    )


def _wanted(settings: _Settings | None, channel: ChannelLayout) -> _Settings | None:
    if settings is None:
        return None
    # All channels of the files: a joined one is made where it is asked for by name.
    everything = settings.channels == "all" and not channel.name.startswith(GLUED)
    return settings if everything or channel.name in settings.channels else None


def _asked(case: ChannelCase) -> Iterator[str]:
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
        reason = "noise of analog records is estimated from the whole of them"
        yield case.without(StepName.RANGE_WINDOW, reason)
        return
    if case.all_steps:
        yield case.without(StepName.RANGE_WINDOW, ALL_STEPS)
        return
    farthest = max((far for _, far in _level_sections(case)), default=math.nan)
    if math.isnan(farthest):
        return
    bins = reaching(0.0, farthest, case)[1]
    if not 0 < bins < case.channel.bins:
        reason = "a section reaches the end of the bins"
        yield case.without(StepName.RANGE_WINDOW, reason, number=float(case.channel.bins))
        return
    reason = "homogeneous sections need no farther bins, and counts none to tell their noise"
    yield case.step(StepName.RANGE_WINDOW, reason, number=float(bins), bins=[[0, bins]])


def _background(case: ChannelCase) -> Decisions:
    if case.signal is None:
        return
    start, stop, bins = _tail(case, case.signal)
    if bins < MIN_SECTION_BINS:
        return
    reason = (
        "the last tenth of the bins: signal left there biases it"
        if case.signal.background_range is None
        else "background_range of the campaign: signal left there biases it"
    )
    yield case.step(
        StepName.BACKGROUND, reason, number=bins, method="tail_mean", range=[start, stop]
    )


def _tail(case: ChannelCase, settings: SignalSettings) -> tuple[float, float, float]:
    """Return the range whose mean is the background, m, and how many bins that holds."""
    start, stop = settings.background_range or (0.9 * case.last, case.last)
    stop = min(stop, case.last)
    return start, stop, (stop - start) / case.channel.bin_width


def _signal(case: ChannelCase) -> Decisions:
    if case.signal is None:
        yield case.without(StepName.SIGNAL, "the campaign does not ask for it")
        return
    start, _, bins = _tail(case, case.signal)
    if bins < MIN_SECTION_BINS:
        stop = case.signal.background_range[1] if case.signal.background_range else case.last
        reason = (
            f"background_range {start:g}-{stop:g} m holds fewer than {MIN_SECTION_BINS} bins,"
            f" which end at {case.last:g} m"
        )
        yield case.without(StepName.SIGNAL, reason, number=bins)
        return
    yield case.step(StepName.SIGNAL, "the campaign asks for it")


def _inside(case: ChannelCase, near: float, far: float) -> float:
    """Return how many bins hold a section; NaN where it reaches beyond them."""
    return (far - near) / case.channel.bin_width if far <= case.last else math.nan


def _sections(case: ChannelCase) -> list[tuple[float, float]]:
    """Return the sections that lie inside the bins."""
    wanted = [] if case.homogeneous is None else case.homogeneous.sections
    return [(near, far) for near, far in wanted if _inside(case, near, far) >= MIN_SECTION_BINS]


def _outside(case: ChannelCase) -> Decisions:
    inside = _sections(case)
    for near, far in [] if case.homogeneous is None else case.homogeneous.sections:
        if (near, far) not in inside:
            bins = (min(far, case.last) - near) / case.channel.bin_width
            reason = (
                f"section {near:g}-{far:g} m does not lie inside the bins, which end at"
                f" {case.last:g} m, with at least {MIN_SECTION_BINS} of them"
            )
            yield case.without(StepName.HOMOGENEOUS, reason, number=bins)


def _climb(case: ChannelCase, near: float, far: float) -> float:
    """Return by how much the most level beam of a scene climbs along a section, m, or infinity.

    A beam of which nobody tells where it points is not taken for a level one.
    """
    told = case.facts.zenith_angle
    angles = [granule.zenith_angle if told is None else told for granule in case.scene.granules]
    return min(
        math.inf if angle is None else (far - near) * abs(math.cos(math.radians(angle)))
        for angle in angles
    )


def _level_sections(case: ChannelCase) -> list[tuple[float, float]]:
    """Return the sections that are retrieved: inside the bins, along a path that may be level."""
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
            told = (
                "neither headers nor campaign tell that it is level"
                if math.isinf(climb)
                else f"it climbs by {climb:.0f} m, and {LEVEL:g} m are level"
            )
            reason = f"section {near:g}-{far:g} m: {told}: aerosol that thins fakes extinction"
            number = None if math.isinf(climb) else climb
            yield case.without(StepName.HOMOGENEOUS, reason, number=number)


def _look(case: ChannelCase) -> Decisions:
    if case.homogeneous is None or not _level_sections(case):
        return
    if case.all_steps:
        yield case.without(StepName.LOOK, ALL_STEPS)
    else:
        reason = "sections in which no profile shows light are not retrieved"
        yield case.step(StepName.LOOK, reason, number=float(LOOKED_AT), profiles=LOOKED_AT)


def _homogeneous(case: ChannelCase) -> Decisions:
    if case.homogeneous is None:
        yield case.without(StepName.HOMOGENEOUS, "the campaign does not ask for it")
        return
    sections = [[near, far] for near, far in _level_sections(case)]
    if sections:
        reason = "the campaign asks for it; background is retrieved with extinction"
        wanted = case.homogeneous.visibility
        yield case.step(
            StepName.HOMOGENEOUS,
            reason,
            number=float(len(sections)),
            method=case.homogeneous.method,
            sections=sections,
            **({} if wanted is None else {"visibility": network_plan.sight(wanted)}),
        )


def _along_path(case: ChannelCase) -> Decisions:
    if case.homogeneous is None or not _level_sections(case):
        return
    wanted = case.homogeneous.visibility
    if wanted is None:
        reason = "the campaign asks for no visibility along the sections: no such variable"
        yield case.without(StepName.ALONG_PATH, reason)
    else:
        reason = "the campaign asks for visibility along the sections: variables of it"
        yield case.step(StepName.ALONG_PATH, reason, number=wanted.threshold)


@dataclass(frozen=True, slots=True)
class _Clean:
    """Where along a beam air without aerosol is looked for."""

    bottom: float
    """m along the beam, as the others."""
    top: float
    width: float
    reason: str
    """Why it is looked for nowhere; empty where it is."""


def _clean(case: ChannelCase, settings: ElasticSettings) -> _Clean:
    zenith, reason = steady_zenith(case)
    stretch = 1.0 / math.cos(math.radians(zenith)) if not reason else math.nan
    window = settings.reference
    # Windows are sought among the middles of bins.
    ranged = replace(case.channel, name=ranged_by(case.channel.name))
    offset = range_offset(ranged, case.facts)
    reach = case.last - 0.5 * case.channel.bin_width + offset
    bottom, top = window.lowest * stretch, min(window.highest * stretch, reach)
    if not reason and top - bottom < window.width * stretch * (1.0 - 1e-9):
        reason = (
            f"the bins end at {reach:g} m, nearer than a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    return _Clean(bottom, top, window.width * stretch, reason)


def _elastic_settings(case: ChannelCase) -> ElasticSettings | None:
    """Return the settings of the elastic product, where there is one."""
    settings = case.elastic
    return None if settings is None or _clean(case, settings).reason else settings


def _average(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is not None:
        seconds = settings.average.total_seconds()
        reason = "noise of a single profile is too large"
        yield case.step(StepName.AVERAGE, reason, number=seconds, seconds=seconds)


def _known_shape(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is None:
        return
    if settings.background == "known_shape":
        reason = "the far range is taken as air without aerosol, and tested for it"
        yield case.step(StepName.KNOWN_SHAPE, reason)
    else:
        reason = "the campaign asks for tail_mean: signal left in the far range biases it"
        yield case.without(StepName.KNOWN_SHAPE, reason)


def _reference(case: ChannelCase) -> Decisions:
    settings = _elastic_settings(case)
    if settings is None:
        return
    clean = _clean(case, settings)
    reason = "candidates within the campaign's limits are tested against the shape of air"
    yield case.step(
        StepName.REFERENCE,
        reason,
        number=clean.top - clean.bottom,
        lowest=clean.bottom,
        highest=clean.top,
        width=clean.width,
        scattering_ratio=settings.reference.scattering_ratio,
        relative_error=settings.reference.relative_error,
    )


def _elastic(case: ChannelCase) -> Decisions:
    settings = case.elastic
    if settings is None:
        yield case.without(StepName.ELASTIC, "the campaign does not ask for it")
        return
    clean = _clean(case, settings)
    if clean.reason:
        yield case.without(StepName.ELASTIC, clean.reason)
        return
    yield case.step(
        StepName.ELASTIC,
        "the campaign asks for it",
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
    reason = "the campaign gives no molecular_profile: US Standard Atmosphere 1976"
    yield case.step(StepName.MOLECULAR, reason)


CHANNEL: Final = Rule(
    "channel", StepName.READ, "Does a product need the channel, at a known wavelength?", _read
)
RANGE_WINDOW: Final = Rule(
    "range_window",
    StepName.RANGE_WINDOW,
    "Which bins do the sections of counts need?",
    _range_window,
)
PRODUCTS: Final = (
    Rule("background", StepName.BACKGROUND, "Does the far range hold enough bins?", _background),
    Rule("signal", StepName.SIGNAL, "Is it asked for, and can background be told?", _signal),
    Rule("section_inside", StepName.HOMOGENEOUS, "Do the bins hold the section?", _outside),
    Rule("section_level", StepName.HOMOGENEOUS, "May the path be level?", _level),
    Rule("look", StepName.LOOK, "May sections turn out to hold no light?", _look),
    Rule("homogeneous", StepName.HOMOGENEOUS, "Is a section left to retrieve?", _homogeneous),
    Rule("along_path", StepName.ALONG_PATH, "Are variables of visibility wanted?", _along_path),
    Rule("average", StepName.AVERAGE, "Does a retrieval need less noise?", _average),
    Rule("molecular", StepName.MOLECULAR, "Does a retrieval need the air's density?", _molecular),
    Rule("known_shape", StepName.KNOWN_SHAPE, "Which background is asked for?", _known_shape),
    Rule("reference", StepName.REFERENCE, "Where may air be without aerosol?", _reference),
    Rule("elastic", StepName.ELASTIC, "Does one beam reach air without aerosol?", _elastic),
    *scan_rules.SCANS,
)
"""Of the products of a channel, in the order in which they run."""
