"""Rules that plans of single instruments and of networks share: what makes a signal of counts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from typing import Any, Final

from lidarops.campaign.model import ChannelFacts, InstrumentFacts, channel_facts
from lidarops.campaign.product_settings import (
    ElasticSettings,
    HomogeneousSettings,
    MultiAngleSettings,
    SignalSettings,
)
from lidarops.raw.model import Stretches
from lidarops.records import ChannelLayout, DetectionMode, Granule, LeftOut, Scene, Step
from lidarops.retrieve.signal.counts_to_signal import MIN_NOISE_BINS, NOISE_WINDOW
from lidarops.retrieve.signal.dark import SESSION_GAP

GLUED = "glued_"
"""Prefix of the channels that join ``analog_`` and ``photon_`` ones of the same light."""

ALL_STEPS: Final = "all steps are asked for: nothing is left out for giving nothing"

STEEPEST = 80.0
"""degree; largest zenith angle at which a beam reaches air without aerosol."""
STEADY = 0.05
"""degree; by which the zenith angle of a beam that stands still may differ between files."""

LEAST_SPREAD = 5.0
"""degree; smallest spread of zenith angles that is a scan."""


class StepName(StrEnum):
    """Names of the steps, in the order in which they run."""

    READ = "read"
    RANGE_WINDOW = "range_window"
    OVERLAP = "overlap"
    RANGE_OFFSET = "range_offset"
    DARK = "dark"
    DEAD_TIME = "dead_time"
    NOISE = "noise"
    LAG = "lag"
    GLUE = "glue"
    BACKGROUND = "background"
    SIGNAL = "signal"
    LOOK = "look"
    HOMOGENEOUS = "homogeneous"
    ALONG_PATH = "along_path"
    AVERAGE = "average"
    MOLECULAR = "molecular"
    KNOWN_SHAPE = "known_shape"
    REFERENCE = "reference"
    ELASTIC = "elastic"
    GRADIENT = "gradient"
    GRADIENT_REGRESSOR = "gradient_regressor"
    ROBUST = "robust"
    VERTICAL = "vertical"
    CORRELATION = "correlation"
    LAYERS = "layers"
    MULTIANGLE = "multiangle"
    PRIOR = "prior"
    VISIBILITY = "visibility"


WHOLE: Final = (StepName.SIGNAL, StepName.ELASTIC, StepName.MULTIANGLE)
"""Products that need all bins of a channel."""


@dataclass(frozen=True, slots=True)
class Case:
    """What the rules of one channel look at."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    known: ChannelFacts
    member: str
    """Instrument, where it is part of a network; else empty."""

    def step(
        self, name: StepName, reason: str, *, number: float | None = None, **settings: Any
    ) -> Step:
        """Return a step of the channel; `number` is the one that it was decided on."""
        return Step(
            name.value, self.channel.name, settings, self._told(reason), self.member, number=number
        )

    def without(self, name: StepName, reason: str, *, number: float | None = None) -> LeftOut:
        """Return what is left out of the channel."""
        return LeftOut(
            name.value, self.channel.name, self._told(reason), self.member, number=number
        )

    def _told(self, reason: str) -> str:
        return f"{self.member}: {reason}" if self.member else reason


@dataclass(frozen=True, slots=True)
class ChannelCase(Case):
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
    networks: tuple[str, ...]
    """Networks that use the channel."""
    all_steps: bool
    """Whether nothing is left out because it would give nothing."""

    @property
    def last(self) -> float:
        """Where the bins end, m, without an offset."""
        return self.channel.bins * self.channel.bin_width


Decisions = Iterator[Step | LeftOut]


@dataclass(frozen=True, slots=True)
class Rule:
    """One decision, by name: what it is about, what it asks, and the function that takes it."""

    name: str
    step: StepName
    asks: str
    decide: Callable[[Any], Decisions]
    """Of a `Case`, or of what else the stage of the rule looks at; gives nothing where the
    question does not arise."""

    def decisions(self, case: Any) -> Decisions:
        """Give what the rule decides, with its name, unless that of a rule it asks is there."""
        for decision in self.decide(case):
            yield replace(decision, rule=decision.rule or self.name)


def applied(rules: Iterable[Rule], case: Any) -> Decisions:
    """Give what rules decide, in their order."""
    for rule in rules:
        yield from rule.decisions(case)


def parts_of(glued: str) -> tuple[str, str]:
    """Return the names of the analog and the photon counting part of a glued channel."""
    label = glued.removeprefix(GLUED)
    return f"analog_{label}", f"photon_{label}"


def joined_channels(
    layout: Iterable[ChannelLayout], names: Iterable[str]
) -> tuple[ChannelLayout, ...]:
    """Return those ``glued_`` channels of which the files hold both parts on one range grid."""
    present = {channel.name: channel for channel in layout}
    found = []
    for name in names:
        analog, photon = (present.get(part) for part in parts_of(name))
        if analog and photon and analog.bin_width == photon.bin_width:
            found.append(replace(photon, name=name, bins=min(analog.bins, photon.bins)))
    return tuple(found)


def wavelength(channel: ChannelLayout, known: ChannelFacts) -> float:
    """Return the wavelength in m that the campaign or else the header gives; may be NaN."""
    return channel.wavelength if known.wavelength is None else known.wavelength


def _overlap(case: Case) -> Decisions:
    full = case.facts.full_overlap_range
    reason = "nearer bins are flagged and not retrieved from"
    if case.facts.overlap_profile:
        told = f"given by the campaign; {reason}"
        profile = case.facts.overlap_profile
        yield case.step(
            StepName.OVERLAP, told, number=full, full_overlap_range=full, overlap_profile=profile
        )
    elif full > 0:
        yield case.step(StepName.OVERLAP, reason, number=full, full_overlap_range=full)
    else:
        yield case.without(StepName.OVERLAP, "the campaign gives no full_overlap_range")


def _range(case: Case) -> Decisions:
    offset = range_offset(case.channel, case.facts)
    if offset:
        reason = "given by the campaign"
        if isinstance(case.known.lag, float):
            reason += f", with the lag of {case.known.lag:g} bins"
        yield case.step(StepName.RANGE_OFFSET, reason, number=offset, range_offset=offset)
    elif case.known.lag == "estimate":
        reason = "a lag that is estimated moves joined channels only"
        yield case.without(StepName.RANGE_OFFSET, reason)
    else:
        yield case.without(StepName.RANGE_OFFSET, "the campaign gives no range_offset")


def _dark(case: Case) -> Decisions:
    if case.channel.mode is DetectionMode.PHOTON:
        yield case.without(StepName.DARK, "dark counts are part of the photon background")
        return
    count = len(case.scene.dark)
    if not count:
        yield case.without(StepName.DARK, "no dark files within 24 h of the scene", number=0.0)
        return
    times = sorted(granule.start for granule in case.scene.dark if granule.start)
    profiles = [granule.start for granule in case.scene.granules if granule.start]
    around = times[0] < max(profiles) and min(profiles) < times[-1]
    sessions = _sessions(case.scene.dark)
    # Within a single session there is nothing to interpolate between.
    if around and sessions > 1:
        told, method = "interpolated in time", "interpolated"
    elif sessions > 1:
        told, method = "the nearest of them in time", "nearest"
    else:
        told, method = "one session, which serves all profiles", "nearest"
    lie = _where(times, min(profiles), max(profiles))
    files = "1 dark file" if count == 1 else f"{count} dark files"
    reason = f"{files} within 24 h of the scene, {lie}: {told}"
    yield case.step(StepName.DARK, reason, number=float(count), files=count, method=method)


def _sessions(dark: Iterable[Granule]) -> int:
    """Return how many sessions dark files make, as the retrieval tells them apart."""
    middles = sorted(
        granule.start + ((granule.stop or granule.start) - granule.start) / 2
        for granule in dark
        if granule.start
    )
    gaps = ((later - time).total_seconds() for time, later in itertools.pairwise(middles))
    return 1 + sum(gap > SESSION_GAP for gap in gaps)


def _where(times: Sequence[datetime], first: datetime, last: datetime) -> str:
    """Say how many times lie before, among and after the profiles of a scene."""
    places = {
        "before": sum(time < first for time in times),
        "among": sum(first <= time <= last for time in times),
        "after": sum(time > last for time in times),
    }
    told = [f"{number} {place}" for place, number in places.items() if number]
    *firsts, rest = told
    return f"{', '.join(firsts)} and {rest} its profiles" if firsts else f"{rest} its profiles"


def _dead_time(case: Case) -> Decisions:
    dead_time = case.known.dead_time
    if case.channel.mode is not DetectionMode.PHOTON:
        yield case.without(StepName.DEAD_TIME, "analog detection has no dead time")
    elif dead_time is None:
        reason = "the campaign gives no dead_time; pile-up is judged with 4 ns"
        yield case.without(StepName.DEAD_TIME, reason)
    else:
        reason = "given by the campaign"
        yield case.step(StepName.DEAD_TIME, reason, number=dead_time, dead_time=dead_time)


def _noise(case: Case) -> Decisions:
    given = case.known.noise_variance
    if case.channel.mode is DetectionMode.PHOTON:
        yield case.step(StepName.NOISE, "photon counts are Poisson distributed", method="poisson")
    elif given is not None:
        reason = "given by the campaign"
        yield case.step(StepName.NOISE, reason, number=given, method="given", noise_variance=given)
    else:
        reason = "the campaign gives no noise_variance; third differences along range"
        yield case.step(StepName.NOISE, reason, method="differences")


def _lag(case: Case) -> Decisions:
    lag = channel_facts(case.facts, parts_of(case.channel.name)[0]).lag
    if lag is None:
        reason = "the campaign gives no lag and asks for no estimate; headers say 0"
        yield case.without(StepName.LAG, reason)
    elif lag == "estimate":
        reason = "the campaign asks for an estimate, from noise that both records share"
        yield case.step(StepName.LAG, reason, method="estimate")
    else:
        reason = "given by the campaign"
        yield case.step(StepName.LAG, reason, number=lag, method="given", lag=lag)


def _glue(case: Case) -> Decisions:
    analog, photon = parts_of(case.channel.name)
    reason = "the campaign asks for the joined channel"
    yield case.step(StepName.GLUE, reason, analog=analog, photon=photon)


_OVERLAP: Final = Rule(
    "overlap", StepName.OVERLAP, "Does the campaign say where the beam is seen whole?", _overlap
)
CONDITIONING: Final = (
    _OVERLAP,
    Rule("range_offset", StepName.RANGE_OFFSET, "Are the ranges of the bins off?", _range),
    Rule("dark", StepName.DARK, "Is it analog, with dark files within 24 h?", _dark),
    Rule("dead_time", StepName.DEAD_TIME, "Does it count, with a known dead time?", _dead_time),
    Rule("noise", StepName.NOISE, "Is the noise given, Poisson, or to be estimated?", _noise),
)
"""From the counts of a channel of the files to its signal."""
GLUING: Final = (
    _OVERLAP,
    Rule("lag", StepName.LAG, "Is one of the records known to be late?", _lag),
    Rule("glue", StepName.GLUE, "Does a product ask for the joined channel?", _glue),
)
"""From two channels of the files to one that joins them."""


def glue_rules(case: Case) -> Decisions:
    """Decide on the steps that join two channels."""
    return applied(GLUING, case)


def conditioning(case: Case) -> Decisions:
    """Decide on the steps from the counts of a channel of the files to its signal."""
    return applied(CONDITIONING, case)


def range_offset(channel: ChannelLayout, facts: InstrumentFacts) -> float:
    """Return what is added to the ranges of a channel, m: what is told, less a lag that is told."""
    known = channel_facts(facts, channel.name)
    late = known.lag * channel.bin_width if isinstance(known.lag, float) else 0.0
    return (known.range_offset or 0.0) - late


def read_windows(steps: Collection[Step]) -> dict[str, Stretches]:
    """Return the channels of which only some bins are needed, and which."""
    whole = _needing_all(steps)
    return {
        step.channel: tuple((first, past) for first, past in step.settings["bins"])
        for step in steps
        if step.name == StepName.RANGE_WINDOW and (step.instrument, step.channel) not in whole
    }


def idle_window(step: Step, steps: Collection[Step]) -> str:
    """Return why a range window of a plan keeps no bin from being read; empty where it does, or is none.

    It stands in the plan all the same: what a product tells of itself must not depend on which
    others are made.

    Parameters
    ----------
    step : Step
    steps : collection of Step
        All that are carried out together.
    """
    if step.name != StepName.RANGE_WINDOW:
        return ""
    needing = _needing_all(steps).get((step.instrument, step.channel), [])
    if not needing:
        return ""
    return f"{' and '.join(needing)} need{'s' if len(needing) == 1 else ''} all bins"


def _needing_all(steps: Collection[Step]) -> dict[tuple[str, str], list[str]]:
    """Return instrument and channel -> what is made of it and needs all bins."""
    found: dict[tuple[str, str], list[str]] = {}
    for step in steps:
        if step.name in WHOLE:
            found.setdefault((step.instrument, step.channel), []).append(step.name)
        elif step.name == StepName.GLUE:
            for part in step.settings.values():
                found.setdefault((step.instrument, part), []).append(step.channel)
    return found


def reaching(nearest: float, farthest: float, case: Case) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, with those that tell their noise.

    The variance of counts is that of their mean over a share of the range on either side.

    Returns
    -------
    (int, int)
        The first, and the one past the last; it may lie beyond the bins of the channel.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)

    def beside(distance: float) -> int:
        # Two for rounding.
        return max(math.ceil(NOISE_WINDOW * distance / width), MIN_NOISE_BINS) + 2

    first = math.floor((nearest - offset) / width) - beside(nearest)
    return max(first, 0), math.ceil((farthest - offset) / width) + beside(farthest)


def within(nearest: float, farthest: float, case: Case) -> tuple[int, int]:
    """Return the bins of counts between ranges in m alone, as `reaching` does with more of them.

    For bins of which a mean is all that is needed: the noise of those at the ends is that of fewer.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)
    # Two for rounding.
    first = math.floor((nearest - offset) / width) - 2
    return max(first, 0), max(math.ceil((farthest - offset) / width) + 2, 0)


def ranged_by(channel: str) -> str:
    """Return the channel whose ranges a channel has: a joined one those of its photons."""
    return parts_of(channel)[1] if channel.startswith(GLUED) else channel


def no_scan(case: Case) -> str:
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


def steady_zenith(case: Case) -> tuple[float, str]:
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
