"""Rules for the steps from raw counts to a signal, shared by single instruments and networks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Final

from lidarops.campaign.model import ChannelFacts, InstrumentFacts, channel_facts
from lidarops.plan.rules import WHOLE, Case, Decisions, Rule, StepName, applied
from lidarops.raw.model import Stretches
from lidarops.records import ChannelLayout, DetectionMode, Granule, Step
from lidarops.retrieve.signal.counts_to_signal import MIN_NOISE_BINS, NOISE_WINDOW
from lidarops.retrieve.signal.dark import SESSION_GAP

GLUED = "glued_"
"""Prefix of channels that are glued from the ``analog_`` and ``photon_`` ones of a detector."""

STEEPEST = 80.0
"""degree; largest zenith angle at which a beam reaches aerosol-free air."""
FIXED = 0.05
"""degree; largest difference between the zenith angles of the files of a fixed beam."""

LEAST_SPREAD = 5.0
"""degree; smallest span of zenith angles of a scan."""


def required_by(requesters: Iterable[str]) -> str:
    """Return the reason why a channel is read: the products and glued channels that need it."""
    return f"required by {' and '.join(requesters)}"


def tail_mean_reason(background_range: tuple[float, float] | None) -> str:
    """Return the reason for a background that is the mean of the far range."""
    if background_range is None:
        return "mean of the last tenth of the bins; signal there biases it"
    return "mean over background_range of the campaign; signal there biases it"


def glued_parts(glued: str) -> tuple[str, str]:
    """Return the names of the analog and the photon-counting channel of a glued channel."""
    label = glued.removeprefix(GLUED)
    return f"analog_{label}", f"photon_{label}"


def joined_layout(
    layout: Iterable[ChannelLayout], names: Iterable[str]
) -> tuple[ChannelLayout, ...]:
    """Return the glued channels whose two parts are in the files with one bin width."""
    present = {channel.name: channel for channel in layout}
    glued = []
    for name in names:
        analog, photon = (present.get(part) for part in glued_parts(name))
        if analog and photon and analog.bin_width == photon.bin_width:
            glued.append(replace(photon, name=name, bins=min(analog.bins, photon.bins)))
    return tuple(glued)


def wavelength(channel: ChannelLayout, facts: ChannelFacts) -> float:
    """Return the wavelength in m from the campaign or else the header; may be NaN."""
    return channel.wavelength if facts.wavelength is None else facts.wavelength


def _overlap(case: Case) -> Decisions:
    full = case.facts.full_overlap_range
    reason = "bins nearer than full overlap are flagged and excluded"
    if case.facts.overlap_profile:
        profile = case.facts.overlap_profile
        yield case.step(
            StepName.OVERLAP,
            f"overlap_profile given by the campaign; {reason}",
            number=full,
            full_overlap_range=full,
            overlap_profile=profile,
        )
    elif full > 0:
        yield case.step(StepName.OVERLAP, reason, number=full, full_overlap_range=full)
    else:
        yield case.without(StepName.OVERLAP, "the campaign gives no full_overlap_range")


def _range(case: Case) -> Decisions:
    offset = range_offset(case.channel, case.facts)
    if offset:
        reason = "given by the campaign"
        if isinstance(case.facts_of_channel.lag, float):
            reason += f", including a lag of {case.facts_of_channel.lag:g} bins"
        yield case.step(StepName.RANGE_OFFSET, reason, number=offset, range_offset=offset)
    elif case.facts_of_channel.lag == "estimate":
        reason = "an estimated lag shifts glued channels only"
        yield case.without(StepName.RANGE_OFFSET, reason)
    else:
        yield case.without(StepName.RANGE_OFFSET, "the campaign gives no range_offset")


def _dark(case: Case) -> Decisions:
    if case.channel.mode is DetectionMode.PHOTON:
        yield case.without(StepName.DARK, "dark counts are part of the photon-counting background")
        return
    count = len(case.scene.dark)
    if not count:
        yield case.without(StepName.DARK, "no dark files within 24 h of the scene", number=0.0)
        return
    times = sorted(granule.start for granule in case.scene.dark if granule.start)
    profiles = [granule.start for granule in case.scene.granules if granule.start]
    around = times[0] < max(profiles) and min(profiles) < times[-1]
    sessions = _sessions(case.scene.dark)
    # Interpolation needs two sessions.
    if around and sessions > 1:
        use, method = "interpolated in time", "interpolated"
    elif sessions > 1:
        use, method = "the nearest in time is used", "nearest"
    else:
        use, method = "one session, used for all profiles", "nearest"
    order = _times_around(times, min(profiles), max(profiles))
    files = "1 dark file" if count == 1 else f"{count} dark files"
    reason = f"{files} within 24 h of the scene, {order}: {use}"
    yield case.step(StepName.DARK, reason, number=float(count), files=count, method=method)


def _sessions(dark: Iterable[Granule]) -> int:
    """Return the number of dark sessions, separated by `SESSION_GAP` as in the retrieval."""
    middles = sorted(
        granule.start + ((granule.stop or granule.start) - granule.start) / 2
        for granule in dark
        if granule.start
    )
    gaps = ((later - time).total_seconds() for time, later in itertools.pairwise(middles))
    return 1 + sum(gap > SESSION_GAP for gap in gaps)


def _times_around(times: Sequence[datetime], first: datetime, last: datetime) -> str:
    """Return in words how many times lie before, among and after the profiles of a scene."""
    counts = {
        "before": sum(time < first for time in times),
        "among": sum(first <= time <= last for time in times),
        "after": sum(time > last for time in times),
    }
    *firsts, last_count = [f"{number} {place}" for place, number in counts.items() if number]
    words = f"{', '.join(firsts)} and {last_count}" if firsts else last_count
    return f"{words} its profiles"


def _dead_time(case: Case) -> Decisions:
    dead_time = case.facts_of_channel.dead_time
    if case.channel.mode is not DetectionMode.PHOTON:
        yield case.without(StepName.DEAD_TIME, "analog detection has no dead time")
    elif dead_time is None:
        reason = "the campaign gives no dead_time; pile-up is flagged for an assumed 4 ns"
        yield case.without(StepName.DEAD_TIME, reason)
    else:
        reason = "given by the campaign"
        yield case.step(StepName.DEAD_TIME, reason, number=dead_time, dead_time=dead_time)


def _noise(case: Case) -> Decisions:
    variance = case.facts_of_channel.noise_variance
    if case.channel.mode is DetectionMode.PHOTON:
        yield case.step(StepName.NOISE, "photon counts are Poisson distributed", method="poisson")
    elif variance is not None:
        yield case.step(
            StepName.NOISE,
            "given by the campaign",
            number=variance,
            method="given",
            noise_variance=variance,
        )
    else:
        reason = "the campaign gives no noise_variance; estimated from third differences over range"
        yield case.step(StepName.NOISE, reason, method="differences")


def _lag(case: Case) -> Decisions:
    lag = channel_facts(case.facts, glued_parts(case.channel.name)[0]).lag
    if lag is None:
        reason = "the campaign gives no lag and requests no estimate; headers state 0"
        yield case.without(StepName.LAG, reason)
    elif lag == "estimate":
        reason = "the campaign requests an estimate, from noise common to both records"
        yield case.step(StepName.LAG, reason, method="estimate")
    else:
        reason = "given by the campaign"
        yield case.step(StepName.LAG, reason, number=lag, method="given", lag=lag)


def _glue(case: Case) -> Decisions:
    analog, photon = glued_parts(case.channel.name)
    reason = "the campaign requests the glued channel"
    yield case.step(StepName.GLUE, reason, analog=analog, photon=photon)


_OVERLAP: Final = Rule(
    "overlap", StepName.OVERLAP, "Does the campaign state the overlap?", _overlap
)
CONDITIONING: Final = (
    _OVERLAP,
    Rule("range_offset", StepName.RANGE_OFFSET, "Do the ranges of the bins need a shift?", _range),
    Rule("dark", StepName.DARK, "Is it analog, with dark files within 24 h?", _dark),
    Rule(
        "dead_time",
        StepName.DEAD_TIME,
        "Is it photon counting, with a known dead time?",
        _dead_time,
    ),
    Rule("noise", StepName.NOISE, "Is the noise given, Poisson, or to be estimated?", _noise),
)
"""From the counts of a channel of the files to its signal."""
GLUING: Final = (
    _OVERLAP,
    Rule("lag", StepName.LAG, "Is a lag between the records given or to be estimated?", _lag),
    Rule("glue", StepName.GLUE, "Does a product need the glued channel?", _glue),
)
"""From two channels of the files to the glued one."""


def glue_rules(case: Case) -> Decisions:
    """Decide on the steps that glue two channels."""
    return applied(GLUING, case)


def conditioning(case: Case) -> Decisions:
    """Decide on the steps from the counts of a channel of the files to its signal."""
    return applied(CONDITIONING, case)


def range_offset(channel: ChannelLayout, facts: InstrumentFacts) -> float:
    """Return the shift of the ranges of a channel, m: the given offset minus the given lag."""
    of_channel = channel_facts(facts, channel.name)
    late = of_channel.lag * channel.bin_width if isinstance(of_channel.lag, float) else 0.0
    return (of_channel.range_offset or 0.0) - late


def read_windows(steps: Collection[Step]) -> dict[str, Stretches]:
    """Return the channels of which only some bins are needed, with these bins."""
    whole = _needing_all(steps)
    return {
        step.channel: tuple((first, past) for first, past in step.settings["bins"])
        for step in steps
        if step.name == StepName.RANGE_WINDOW and (step.instrument, step.channel) not in whole
    }


def idle_window(step: Step, steps: Collection[Step]) -> str:
    """Return why a range window has no effect; empty where it has one, or for other steps.

    Such a window stays in the plan, because the plan stated in a product must not depend on the
    other products of the scene.

    Parameters
    ----------
    step : Step
    steps : collection of Step
        All steps of the scene.
    """
    if step.name != StepName.RANGE_WINDOW:
        return ""
    needing = _needing_all(steps).get((step.instrument, step.channel), [])
    if not needing:
        return ""
    return f"{' and '.join(needing)} need{'s' if len(needing) == 1 else ''} all bins"


def _needing_all(steps: Collection[Step]) -> dict[tuple[str, str], list[str]]:
    """Return instrument and channel -> the products and glued channels that need all its bins."""
    needing: dict[tuple[str, str], list[str]] = {}
    for step in steps:
        if step.name in WHOLE:
            needing.setdefault((step.instrument, step.channel), []).append(step.name)
        elif step.name == StepName.GLUE:
            for parent in step.settings.values():
                needing.setdefault((step.instrument, parent), []).append(step.channel)
    return needing


def bins_with_noise(nearest: float, farthest: float, case: Case) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, with those that their noise needs.

    The variance of a count is that of the mean over a share of the range on either side.

    Returns
    -------
    (int, int)
        The first bin, and the one past the last, which may lie beyond the channel.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)

    def margin(distance: float) -> int:
        # Two for rounding.
        return max(math.ceil(NOISE_WINDOW * distance / width), MIN_NOISE_BINS) + 2

    first = math.floor((nearest - offset) / width) - margin(nearest)
    return max(first, 0), math.ceil((farthest - offset) / width) + margin(farthest)


def bins_within(nearest: float, farthest: float, case: Case) -> tuple[int, int]:
    """Return the bins of counts between ranges in m, without a margin for their noise.

    For bins that are averaged: the noise at the ends then comes from fewer bins.
    """
    width, offset = case.channel.bin_width, range_offset(case.channel, case.facts)
    # Two for rounding.
    first = math.floor((nearest - offset) / width) - 2
    return max(first, 0), max(math.ceil((farthest - offset) / width) + 2, 0)


def range_channel(channel: str) -> str:
    """Return the channel that defines the ranges: for a glued one, the photon-counting one."""
    return glued_parts(channel)[1] if channel.startswith(GLUED) else channel


def no_scan(case: Case) -> str:
    """Return why the files of a scene are not a scan; empty where they are."""
    if case.facts.zenith_angle is not None:
        angle = case.facts.zenith_angle
        return f"the campaign states a fixed beam at a zenith angle of {angle:g} degree"
    header_angles = [granule.zenith_angle for granule in case.scene.granules]
    angles = [angle for angle in header_angles if angle is not None]
    if len(angles) < len(header_angles):
        return "headers lack zenith angles"
    spread = max(angles) - min(angles)
    if spread < LEAST_SPREAD:
        return f"zenith angles span only {spread:g} degree: the beam does not scan"
    return ""


def fixed_zenith(case: Case) -> tuple[float, str]:
    """Return the zenith angle of a fixed beam in degree, or NaN and why there is none."""
    if case.facts.zenith_angle is not None:
        angles = [case.facts.zenith_angle]
    else:
        header_angles = [granule.zenith_angle for granule in case.scene.granules]
        if any(angle is None for angle in header_angles):
            return math.nan, "neither headers nor campaign give the zenith angle"
        angles = [angle for angle in header_angles if angle is not None]
    if max(angles) - min(angles) > FIXED:
        reason = f"the zenith angle of the beam changes from {min(angles):g} to {max(angles):g}"
        return math.nan, f"{reason} degree"
    if max(angles) > STEEPEST:
        reason = f"at a zenith angle of {max(angles):g} degree the beam does not reach"
        return math.nan, f"{reason} aerosol-free air"
    return max(angles), ""
