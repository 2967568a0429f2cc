"""Scene -> plan: what runs for a scene, what is left out, and why.

Every rule gives its reason in words that a user can check against the campaign file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar

from lidarops.campaign import (
    Campaign,
    ChannelFacts,
    HomogeneousSettings,
    Instrument,
    InstrumentFacts,
    SignalSettings,
    channel_facts,
)
from lidarops.records import ChannelLayout, DetectionMode, LeftOut, Plan, Scene, Step

MIN_SECTION_BINS = 8

_Settings = TypeVar("_Settings", SignalSettings, HomogeneousSettings)


class StepName(StrEnum):
    """Names of the steps, in the order in which they run."""

    READ = "read"
    OVERLAP = "overlap"
    RANGE_OFFSET = "range_offset"
    DARK = "dark"
    DEAD_TIME = "dead_time"
    NOISE = "noise"
    BACKGROUND = "background"
    SIGNAL = "signal"
    HOMOGENEOUS = "homogeneous"


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
    left_out = list(_absent(scene, instrument))
    for channel in scene.layout:
        for decision in _channel(scene, channel, instrument, facts):
            (steps if isinstance(decision, Step) else left_out).append(decision)  # type: ignore[arg-type]
    return Plan(scene.id, tuple(steps), tuple(left_out))


def wavelength(channel: ChannelLayout, known: ChannelFacts) -> float:
    """Return the wavelength in m that the campaign or else the header gives; may be NaN."""
    return channel.wavelength if known.wavelength is None else known.wavelength


def _absent(scene: Scene, instrument: Instrument) -> Iterator[LeftOut]:
    """Name the channels that the campaign wants and the files lack."""
    present = [channel.name for channel in scene.layout]
    for kind, wanted in (
        (StepName.SIGNAL, instrument.products.signal),
        (StepName.HOMOGENEOUS, instrument.products.homogeneous),
    ):
        names: Sequence[str] = [] if wanted is None or wanted.channels == "all" else wanted.channels
        for name in names:
            if name not in present:
                reason = f"the files hold no such channel, only {', '.join(present)}"
                yield LeftOut(kind.value, name, reason)


def _channel(
    scene: Scene, channel: ChannelLayout, instrument: Instrument, facts: InstrumentFacts
) -> Iterator[Step | LeftOut]:
    products = instrument.products
    case = _Case(
        scene=scene,
        channel=channel,
        facts=facts,
        known=channel_facts(facts, channel.name),
        signal=_wanted(products.signal, channel),
        homogeneous=_wanted(products.homogeneous, channel),
    )
    if case.signal is None and case.homogeneous is None:
        yield case.without(StepName.READ, "no product of the campaign asks for this channel")
        return
    if math.isnan(wavelength(channel, case.known)):
        reason = "the header's wavelength is implausible and the campaign's facts give none"
        yield case.without(StepName.READ, reason)
        return
    last = channel.bins * channel.bin_width
    yield case.step(
        StepName.READ,
        "asked for by " + " and ".join(kind for kind in _asked(case)),
        wavelength=wavelength(channel, case.known),
    )
    yield from _conditioning(case)
    yield from _signal_rules(case, last)
    yield from _homogeneous_rules(case, last)


def _wanted(settings: _Settings | None, channel: ChannelLayout) -> _Settings | None:
    if settings is None or settings.channels == "all" or channel.name in settings.channels:
        return settings
    return None


def _asked(case: _Case) -> Iterator[str]:
    if case.signal is not None:
        yield "signal"
    if case.homogeneous is not None:
        yield "homogeneous"


def _conditioning(case: _Case) -> Iterator[Step | LeftOut]:
    photon = case.channel.mode is DetectionMode.PHOTON
    if case.facts.full_overlap_range > 0:
        reason = "nearer bins are flagged and not retrieved from"
        yield case.step(StepName.OVERLAP, reason, full_overlap_range=case.facts.full_overlap_range)
    else:
        yield case.without(StepName.OVERLAP, "the campaign gives no full_overlap_range")
    if case.known.range_offset:
        reason = "given by the campaign"
        yield case.step(StepName.RANGE_OFFSET, reason, range_offset=case.known.range_offset)
    else:
        yield case.without(StepName.RANGE_OFFSET, "the campaign gives no range_offset")
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


def _dark_rule(case: _Case) -> Step | LeftOut:
    if case.channel.mode is DetectionMode.PHOTON:
        return case.without(StepName.DARK, "dark counts are part of the photon background")
    if not case.scene.dark:
        return case.without(StepName.DARK, "no dark files within 24 h of the scene")
    reason = f"{len(case.scene.dark)} dark files within 24 h of the scene"
    return case.step(StepName.DARK, reason, files=len(case.scene.dark))


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
