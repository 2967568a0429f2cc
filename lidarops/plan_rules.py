"""Rules that plans of single instruments and of networks share: what makes a signal of counts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from lidarops.campaign import ChannelFacts, InstrumentFacts, channel_facts
from lidarops.records import ChannelLayout, DetectionMode, LeftOut, Scene, Step

GLUED = "glued_"
"""Prefix of the channels that join ``analog_`` and ``photon_`` ones of the same light."""


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
    VISIBILITY = "visibility"


@dataclass(frozen=True, slots=True)
class Case:
    """What the rules of one channel look at."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    known: ChannelFacts
    member: str
    """Instrument, where it is part of a network; else empty."""

    def step(self, name: StepName, reason: str, **settings: Any) -> Step:
        """Return a step of the channel."""
        return Step(name.value, self.channel.name, settings, self._told(reason), self.member)

    def without(self, name: StepName, reason: str) -> LeftOut:
        """Return what is left out of the channel."""
        return LeftOut(name.value, self.channel.name, self._told(reason), self.member)

    def _told(self, reason: str) -> str:
        return f"{self.member}: {reason}" if self.member else reason


def parts_of(glued: str) -> tuple[str, str]:
    """Return the names of the analog and the photon counting part of a glued channel."""
    label = glued.removeprefix(GLUED)
    return f"analog_{label}", f"photon_{label}"


def joined_channels(scene: Scene, names: Iterable[str]) -> tuple[ChannelLayout, ...]:
    """Return those ``glued_`` channels of which the files hold both parts on one range grid."""
    present = {channel.name: channel for channel in scene.layout}
    found = []
    for name in names:
        analog, photon = (present.get(part) for part in parts_of(name))
        if analog and photon and analog.bin_width == photon.bin_width:
            found.append(replace(photon, name=name, bins=min(analog.bins, photon.bins)))
    return tuple(found)


def wavelength(channel: ChannelLayout, known: ChannelFacts) -> float:
    """Return the wavelength in m that the campaign or else the header gives; may be NaN."""
    return channel.wavelength if known.wavelength is None else known.wavelength


def glue_rules(case: Case) -> Iterator[Step | LeftOut]:
    """Decide on the steps that join two channels."""
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


def conditioning(case: Case) -> Iterator[Step | LeftOut]:
    """Decide on the steps from the counts of a channel of the files to its signal."""
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


def _overlap_rule(case: Case) -> Step | LeftOut:
    full = case.facts.full_overlap_range
    reason = "nearer bins are flagged and not retrieved from"
    if case.facts.overlap_profile:
        told = f"given by the campaign; {reason}"
        profile = case.facts.overlap_profile
        return case.step(StepName.OVERLAP, told, full_overlap_range=full, overlap_profile=profile)
    if full > 0:
        return case.step(StepName.OVERLAP, reason, full_overlap_range=full)
    return case.without(StepName.OVERLAP, "the campaign gives no full_overlap_range")


def _range_rule(case: Case) -> Step | LeftOut:
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


def _dark_rule(case: Case) -> Step | LeftOut:
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


def ranged_by(channel: str) -> str:
    """Return the channel whose ranges a channel has: a joined one those of its photons."""
    return parts_of(channel)[1] if channel.startswith(GLUED) else channel
