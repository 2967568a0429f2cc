"""Scene -> plan: what runs for a scene, what is left out, and why.

Every rule gives its reason in words that a user can check against the campaign file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from lidarops import network_plans
from lidarops.campaign import Campaign, Instrument, InstrumentFacts, channel_facts
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
from lidarops.product_settings import (
    ElasticSettings,
    HomogeneousSettings,
    MultiAngleSettings,
    SignalSettings,
)
from lidarops.records import ChannelLayout, LeftOut, Plan, Scene, Step

MIN_SECTION_BINS = 8

STEEPEST = 80.0
"""degree; largest zenith angle at which a beam reaches air without aerosol."""
STEADY = 0.05
"""degree; by which the zenith angle of a beam that stands still may differ between files."""

LEAST_SPREAD = 5.0
"""degree; smallest spread of zenith angles that is a scan."""

_Settings = TypeVar(
    "_Settings", SignalSettings, HomogeneousSettings, ElasticSettings, MultiAngleSettings
)


@dataclass(frozen=True, slots=True)
class _Case(Case):
    """What the rules of one channel look at, and the products that are wanted of it."""

    signal: SignalSettings | None
    """Set where the channel's ``signal`` product is wanted."""
    homogeneous: HomogeneousSettings | None
    """Set where the channel's ``homogeneous`` product is wanted."""
    elastic: ElasticSettings | None
    """Set where the channel's ``elastic`` product is wanted."""
    multiangle: MultiAngleSettings | None
    """Set where the channel's ``multiangle`` product is wanted."""
    glued: tuple[str, ...]
    """Channels that this one is joined into."""


def plan(scene: Scene, campaign: Campaign) -> Plan:
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
        return network_plans.plan(scene, campaign)
    instrument = campaign.instruments[scene.instrument]
    # A scene never straddles an edge of a validity period, so its first granule speaks for all.
    facts = instrument.facts_at(scene.granules[0].start or scene.start)
    steps: list[Step] = []
    left_out = [*_absent(scene, instrument), *_strange_facts(scene, facts)]
    for channel in (*scene.layout, *glued_channels(scene, instrument)):
        for decision in _channel(scene, channel, instrument, facts):
            (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]
    return Plan(scene.id, tuple(steps), tuple(left_out))


def glued_channels(scene: Scene, instrument: Instrument) -> tuple[ChannelLayout, ...]:
    """Return the channels that a scene gets by joining analog and photon counting ones.

    Parameters
    ----------
    scene : Scene
    instrument : Instrument
        Whose products ask for channels named ``glued_`` and a label.

    Returns
    -------
    tuple of ChannelLayout
        Those of which the files hold both parts on one range grid; in photon counting units.
    """
    return joined_channels(scene, sorted(_asked_glued(instrument)))


def _asked_glued(instrument: Instrument) -> set[str]:
    products = instrument.products
    asked = [
        name
        for wanted in (products.elastic, products.multiangle)
        if wanted is not None
        for name in wanted.channels
    ]
    if products.signal is not None and products.signal.channels != "all":
        asked += products.signal.channels
    return {name for name in asked if name.startswith(GLUED)}


def _absent(scene: Scene, instrument: Instrument) -> Iterator[LeftOut]:
    """Name the channels that the campaign wants and the files lack."""
    channels = {channel.name: channel for channel in scene.layout}
    made = [channel.name for channel in glued_channels(scene, instrument)]
    products = instrument.products
    for kind, wanted in (
        (StepName.SIGNAL, products.signal),
        (StepName.HOMOGENEOUS, products.homogeneous),
        (StepName.ELASTIC, products.elastic),
        (StepName.MULTIANGLE, products.multiangle),
    ):
        names: Sequence[str] = [] if wanted is None or wanted.channels == "all" else wanted.channels
        for name in names:
            if kind is StepName.HOMOGENEOUS and name.startswith(GLUED):
                yield LeftOut(kind.value, name, "each record is fitted with its own background")
            elif name not in channels and name not in made:
                yield LeftOut(kind.value, name, _why_absent(name, channels))


def _strange_facts(scene: Scene, facts: InstrumentFacts) -> Iterator[LeftOut]:
    """Name the channels of which the campaign tells facts, and which the files lack."""
    present = [channel.name for channel in scene.layout]
    for name, known in facts.channels.items():
        if name not in present:
            reason = f"facts of a channel that the files do not hold, only {', '.join(present)}"
            yield LeftOut(StepName.READ.value, name, reason)
        elif known.lag is not None and not name.startswith("analog_"):
            yield LeftOut(StepName.LAG.value, name, "a lag is a fact of the analog channel")


def _why_absent(name: str, channels: Mapping[str, ChannelLayout]) -> str:
    if name.startswith(GLUED):
        parts = parts_of(name)
        if set(parts) <= set(channels):
            widths = [f"{channels[part].bin_width:g} m" for part in parts]
            return f"its parts have bins of {' and '.join(widths)}"
        missing = [part for part in parts if part not in channels]
        return f"the files hold no {' and no '.join(missing)} to join"
    return f"the files hold no such channel, only {', '.join(channels)}"


def _channel(
    scene: Scene, channel: ChannelLayout, instrument: Instrument, facts: InstrumentFacts
) -> Iterator[Step | LeftOut]:
    products = instrument.products
    made = [glued.name for glued in glued_channels(scene, instrument)]
    joined = channel.name in made
    case = _Case(
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
    )
    asked = list(_asked(case))
    if not asked:
        yield case.without(StepName.READ, "no product of the campaign asks for this channel")
        return
    known = channel_facts(facts, parts_of(channel.name)[1]) if joined else case.known
    if math.isnan(wavelength(channel, known)):
        reason = "the header's wavelength is implausible and the campaign's facts give none"
        yield case.without(StepName.READ, reason)
        return
    last = channel.bins * channel.bin_width
    yield case.step(
        StepName.READ, "asked for by " + " and ".join(asked), wavelength=wavelength(channel, known)
    )
    yield from glue_rules(case) if joined else conditioning(case)
    yield from _signal_rules(case, last)
    yield from _homogeneous_rules(case, last)
    yield from _elastic_rules(case, last)
    yield from _multiangle_rules(case, last)


def _wanted(settings: _Settings | None, channel: ChannelLayout) -> _Settings | None:
    if settings is None:
        return None
    # All channels of the files: a joined one is made where it is asked for by name.
    everything = settings.channels == "all" and not channel.name.startswith(GLUED)
    return settings if everything or channel.name in settings.channels else None


def _asked(case: _Case) -> Iterator[str]:
    if case.signal is not None:
        yield "signal"
    if case.homogeneous is not None:
        yield "homogeneous"
    if case.elastic is not None:
        yield "elastic"
    if case.multiangle is not None:
        yield "multiangle"
    yield from case.glued


def _signal_rules(case: _Case, last: float) -> Iterator[Step | LeftOut]:
    if case.signal is None:
        yield case.without(StepName.SIGNAL, "the campaign does not ask for it")
        return
    start, stop = case.signal.background_range or (0.9 * last, last)
    if (min(stop, last) - start) / case.channel.bin_width < MIN_SECTION_BINS:
        reason = (
            f"background_range {start:g}-{stop:g} m holds fewer than {MIN_SECTION_BINS} bins,"
            f" which end at {last:g} m"
        )
        yield case.without(StepName.SIGNAL, reason)
        return
    reason = (
        "the last tenth of the bins: signal left there biases it"
        if case.signal.background_range is None
        else "background_range of the campaign: signal left there biases it"
    )
    yield case.step(StepName.BACKGROUND, reason, method="tail_mean", range=[start, min(stop, last)])
    yield case.step(StepName.SIGNAL, "the campaign asks for it")


def _homogeneous_rules(case: _Case, last: float) -> Iterator[Step | LeftOut]:
    if case.homogeneous is None:
        yield case.without(StepName.HOMOGENEOUS, "the campaign does not ask for it")
        return
    sections = []
    for near, far in case.homogeneous.sections:
        bins = (min(far, last) - near) / case.channel.bin_width
        if far > last or bins < MIN_SECTION_BINS:
            reason = (
                f"section {near:g}-{far:g} m does not lie inside the bins, which end at {last:g} m,"
                f" with at least {MIN_SECTION_BINS} of them"
            )
            yield case.without(StepName.HOMOGENEOUS, reason)
        else:
            sections.append([near, far])
    if sections:
        reason = "the campaign asks for it; background is retrieved with extinction"
        wanted = case.homogeneous.visibility
        yield case.step(
            StepName.HOMOGENEOUS,
            reason,
            method=case.homogeneous.method,
            sections=sections,
            **({} if wanted is None else {"visibility": network_plans.sight(wanted)}),
        )


def _elastic_rules(case: _Case, last: float) -> Iterator[Step | LeftOut]:
    """Decide on the steps of the ``elastic`` product of a channel, whose bins end at `last` m."""
    settings = case.elastic
    if settings is None:
        yield case.without(StepName.ELASTIC, "the campaign does not ask for it")
        return
    zenith, reason = _steady_zenith(case)
    stretch = 1.0 / math.cos(math.radians(zenith)) if not reason else math.nan
    window = settings.reference
    # Windows are sought among the middles of bins.
    ranged = replace(case.channel, name=ranged_by(case.channel.name))
    offset = range_offset(ranged, case.facts)
    reach = last - 0.5 * case.channel.bin_width + offset
    bottom, top = window.lowest * stretch, min(window.highest * stretch, reach)
    if not reason and top - bottom < window.width * stretch * (1.0 - 1e-9):
        reason = (
            f"the bins end at {reach:g} m, nearer than a reference window of {window.width:g} m"
            f" above {window.lowest:g} m"
        )
    if reason:
        yield case.without(StepName.ELASTIC, reason)
        return
    seconds = settings.average.total_seconds()
    yield case.step(StepName.AVERAGE, "noise of a single profile is too large", seconds=seconds)
    yield _molecular_rule(case)
    if settings.background == "known_shape":
        reason = "the far range is taken as air without aerosol, and tested for it"
        yield case.step(StepName.KNOWN_SHAPE, reason)
    else:
        reason = "the campaign asks for tail_mean: signal left in the far range biases it"
        yield case.without(StepName.KNOWN_SHAPE, reason)
    reason = "candidates within the campaign's limits are tested against the shape of air"
    yield case.step(
        StepName.REFERENCE,
        reason,
        lowest=bottom,
        highest=top,
        width=window.width * stretch,
        scattering_ratio=window.scattering_ratio,
        relative_error=window.relative_error,
    )
    yield case.step(
        StepName.ELASTIC,
        "the campaign asks for it",
        lidar_ratio=settings.lidar_ratio,
        lidar_ratio_standard_error=settings.lidar_ratio_standard_error,
        molecular_relative_error=settings.molecular_relative_error,
    )


def _molecular_rule(case: _Case) -> Step:
    source = case.facts.molecular_profile
    if source:
        return case.step(StepName.MOLECULAR, "given by the campaign", molecular_profile=source)
    reason = "the campaign gives no molecular_profile: US Standard Atmosphere 1976"
    return case.step(StepName.MOLECULAR, reason)


def _multiangle_rules(case: _Case, last: float) -> Iterator[Step | LeftOut]:
    settings = case.multiangle
    if settings is None:
        yield case.without(StepName.MULTIANGLE, "the campaign does not ask for it")
        return
    reason = _no_scan(case)
    if reason:
        yield case.without(StepName.MULTIANGLE, reason)
        return
    # The elastic product needs a beam that stands still: only one of both tells of molecules.
    yield _molecular_rule(case)
    yield case.step(
        StepName.MULTIANGLE,
        "the campaign asks for it, and the beam scans",
        highest=settings.highest,
        step=settings.step,
        method=settings.method,
        largest_gradient=settings.largest_gradient,
        layers=[list(layer) for layer in settings.layers],
        background_range=[0.9 * last, last],
    )


def _no_scan(case: _Case) -> str:
    """Return why the files of a scene are no scan, nothing where they are."""
    if case.facts.zenith_angle is not None:
        return f"the campaign says that the beam stands still at {case.facts.zenith_angle:g} degree"
    told = [granule.zenith_angle for granule in case.scene.granules]
    angles = [angle for angle in told if angle is not None]
    if len(angles) < len(told):
        return "headers do not tell all zenith angles"
    spread = max(angles) - min(angles)
    if spread < LEAST_SPREAD:
        return f"zenith angles spread over {spread:g} degree only: the beam does not scan"
    return ""


def _steady_zenith(case: _Case) -> tuple[float, str]:
    """Return the zenith angle of a beam that stands still, or why there is none."""
    if case.facts.zenith_angle is not None:
        angles = [case.facts.zenith_angle]
    else:
        told = [granule.zenith_angle for granule in case.scene.granules]
        if any(angle is None for angle in told):
            return math.nan, "neither headers nor campaign tell the zenith angle"
        angles = [angle for angle in told if angle is not None]
    if max(angles) - min(angles) > STEADY:
        return math.nan, f"the beam moves, from {min(angles):g} to {max(angles):g} degree"
    if max(angles) > STEEPEST:
        return math.nan, f"at {max(angles):g} degree the beam reaches no air without aerosol"
    return max(angles), ""
