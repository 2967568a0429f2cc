"""Scene -> plan: what runs for a scene, what is left out, and why.

Every rule gives its reason in words that a user can check against the campaign file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, TypeVar

from lidarops.campaign import (
    Campaign,
    ChannelFacts,
    ElasticSettings,
    HomogeneousSettings,
    Instrument,
    InstrumentFacts,
    MultiAngleSettings,
    SignalSettings,
    channel_facts,
)
from lidarops.records import ChannelLayout, DetectionMode, LeftOut, Plan, Scene, Step

MIN_SECTION_BINS = 8

GLUED = "glued_"
"""Prefix of the channels that join ``analog_`` and ``photon_`` ones of the same light."""
STEEPEST = 80.0
"""degree; largest zenith angle at which a beam reaches air without aerosol."""
STEADY = 0.05
"""degree; by which the zenith angle of a beam that stands still may differ between files."""

LEAST_SPREAD = 5.0
"""degree; smallest spread of zenith angles that is a scan."""

_Settings = TypeVar(
    "_Settings", SignalSettings, HomogeneousSettings, ElasticSettings, MultiAngleSettings
)


class StepName(StrEnum):
    """Names of the steps, in the order in which they run."""

    READ = "read"
    OVERLAP = "overlap"
    RANGE_OFFSET = "range_offset"
    DARK = "dark"
    DEAD_TIME = "dead_time"
    NOISE = "noise"
    LAG = "lag"
    GLUE = "glue"
    BACKGROUND = "background"
    SIGNAL = "signal"
    HOMOGENEOUS = "homogeneous"
    AVERAGE = "average"
    MOLECULAR = "molecular"
    KNOWN_SHAPE = "known_shape"
    REFERENCE = "reference"
    ELASTIC = "elastic"
    MULTIANGLE = "multiangle"


@dataclass(frozen=True, slots=True)
class _Case:
    """What the rules of one channel look at."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    known: ChannelFacts
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

    def step(self, name: StepName, reason: str, **settings: Any) -> Step:
        return Step(name.value, self.channel.name, settings, reason)

    def without(self, name: StepName, reason: str) -> LeftOut:
        return LeftOut(name.value, self.channel.name, reason)


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
    present = {channel.name: channel for channel in scene.layout}
    found = []
    for name in sorted(_asked_glued(instrument)):
        analog, photon = (present.get(part) for part in parts_of(name))
        if analog and photon and analog.bin_width == photon.bin_width:
            found.append(replace(photon, name=name, bins=min(analog.bins, photon.bins)))
    return tuple(found)


def parts_of(glued: str) -> tuple[str, str]:
    """Return the names of the analog and the photon counting part of a glued channel."""
    label = glued.removeprefix(GLUED)
    return f"analog_{label}", f"photon_{label}"


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


def wavelength(channel: ChannelLayout, known: ChannelFacts) -> float:
    """Return the wavelength in m that the campaign or else the header gives; may be NaN."""
    return channel.wavelength if known.wavelength is None else known.wavelength


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
    yield from _glue_rules(case) if joined else _conditioning(case)
    yield from _signal_rules(case, last)
    yield from _homogeneous_rules(case, last)
    yield from _elastic_rules(case, last)
    yield from _multiangle_rules(case, last)


def _glue_rules(case: _Case) -> Iterator[Step | LeftOut]:
    yield _overlap_rule(case)
    analog, photon = parts_of(case.channel.name)
    lag = channel_facts(case.facts, analog).lag
    if lag is None:
        reason = "the campaign gives no lag and asks for no estimate; headers say 0"
        yield case.without(StepName.LAG, reason)
    elif lag == "estimate":
        reason = "the campaign asks for an estimate, from noise that both records share"
        yield case.step(StepName.LAG, reason, method="estimate")
    else:
        yield case.step(StepName.LAG, "given by the campaign", method="given", lag=lag)
    reason = "the campaign asks for the joined channel"
    yield case.step(StepName.GLUE, reason, analog=analog, photon=photon)


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


def _conditioning(case: _Case) -> Iterator[Step | LeftOut]:
    photon = case.channel.mode is DetectionMode.PHOTON
    yield _overlap_rule(case)
    yield _range_rule(case)
    yield _dark_rule(case)
    if not photon:
        yield case.without(StepName.DEAD_TIME, "analog detection has no dead time")
    elif case.known.dead_time is None:
        reason = "the campaign gives no dead_time; pile-up is judged with 4 ns"
        yield case.without(StepName.DEAD_TIME, reason)
    else:
        reason = "given by the campaign"
        yield case.step(StepName.DEAD_TIME, reason, dead_time=case.known.dead_time)
    if photon:
        yield case.step(StepName.NOISE, "photon counts are Poisson distributed", method="poisson")
    elif case.known.noise_variance is not None:
        reason = "given by the campaign"
        yield case.step(
            StepName.NOISE, reason, method="given", noise_variance=case.known.noise_variance
        )
    else:
        reason = "the campaign gives no noise_variance; third differences along range"
        yield case.step(StepName.NOISE, reason, method="differences")


def _overlap_rule(case: _Case) -> Step | LeftOut:
    full = case.facts.full_overlap_range
    reason = "nearer bins are flagged and not retrieved from"
    if case.facts.overlap_profile:
        told = f"given by the campaign; {reason}"
        profile = case.facts.overlap_profile
        return case.step(StepName.OVERLAP, told, full_overlap_range=full, overlap_profile=profile)
    if full > 0:
        return case.step(StepName.OVERLAP, reason, full_overlap_range=full)
    return case.without(StepName.OVERLAP, "the campaign gives no full_overlap_range")


def _range_rule(case: _Case) -> Step | LeftOut:
    offset = range_offset(case.channel, case.facts)
    if offset:
        reason = "given by the campaign"
        if isinstance(case.known.lag, float):
            reason += f", with the lag of {case.known.lag:g} bins"
        return case.step(StepName.RANGE_OFFSET, reason, range_offset=offset)
    if case.known.lag == "estimate":
        reason = "a lag that is estimated moves joined channels only"
        return case.without(StepName.RANGE_OFFSET, reason)
    return case.without(StepName.RANGE_OFFSET, "the campaign gives no range_offset")


def range_offset(channel: ChannelLayout, facts: InstrumentFacts) -> float:
    """Return what is added to the ranges of a channel, m: what is told, less a lag that is told."""
    known = channel_facts(facts, channel.name)
    late = known.lag * channel.bin_width if isinstance(known.lag, float) else 0.0
    return (known.range_offset or 0.0) - late


def _dark_rule(case: _Case) -> Step | LeftOut:
    if case.channel.mode is DetectionMode.PHOTON:
        return case.without(StepName.DARK, "dark counts are part of the photon background")
    if not case.scene.dark:
        return case.without(StepName.DARK, "no dark files within 24 h of the scene")
    told = f"{len(case.scene.dark)} dark files within 24 h of the scene"
    times = [granule.start for granule in case.scene.dark if granule.start]
    profiles = [granule.start for granule in case.scene.granules if granule.start]
    if min(times) < max(profiles) and min(profiles) < max(times):
        reason, method = f"{told}, before and after it: interpolated in time", "interpolated"
    else:
        reason, method = f"{told}, on one side of it: the nearest", "nearest"
    return case.step(StepName.DARK, reason, files=len(case.scene.dark), method=method)


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
        yield case.step(
            StepName.HOMOGENEOUS, reason, method=case.homogeneous.method, sections=sections
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
    ranged_by = replace(case.channel, name=_ranged_by(case.channel.name))
    offset = range_offset(ranged_by, case.facts)
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


def _ranged_by(channel: str) -> str:
    """Return the channel whose ranges a channel has: a joined one those of its photons."""
    return parts_of(channel)[1] if channel.startswith(GLUED) else channel


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
