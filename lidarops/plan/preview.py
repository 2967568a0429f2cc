"""Refine a plan in the worker: leave out sections in which sampled profiles show no signal.

The rules of `lidarops.plan.scene_plan` know headers only; these rules see some profiles. Sections
that they leave out are missing in the product, with the quality bit that the retrieval would set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.plan.rules import Decisions, Rule, StepName, applied
from lidarops.records import Granule, LeftOut, Plan, Step
from lidarops.retrieve.background.detectable_light import (
    LightDetection,
    detect_light,
    spaced_indices,
)

GAP: Final = timedelta(minutes=10)
"""Longest time between sampled profiles where the first sample shows no signal."""
DARK: Final = 3.0
"""Significance below which no profile of the first sample shows a signal; a retrieval is accepted
above 5. Noise alone lifts the largest of 16 above 3 in 2 % of scenes, above 1.7 in half."""
STILL_DARK: Final = 3.5
"""The same for the second sample, which has more profiles and so larger noise maxima."""
OMITTED: Final = "left_out"
"""Setting of a homogeneous step: sections that are not retrieved, with the bit that says why."""

Profiles = Callable[[str, Sequence[Granule]], xr.Dataset]
"""Returns power, variance and quality of a channel in some granules."""


@dataclass(frozen=True, slots=True)
class _SectionCase:
    """One section of a homogeneous step, with what sampled profiles show there."""

    step: Step
    near: float
    """m."""
    far: float
    """m."""
    first: LightDetection
    all: LightDetection
    """Of both samples together, where there was a second one; else `first`."""

    def without(self, reason: str, number: float) -> LeftOut:
        """Return the section as left out."""
        reason = f"section {self.near:g}-{self.far:g} m: {reason}"
        return LeftOut(
            self.step.name, self.step.channel, reason, self.step.instrument, number=number
        )


def _dark(case: _SectionCase) -> Decisions:
    if case.first.significance < DARK and case.all.significance < STILL_DARK:
        most = max(case.first.significance, case.all.significance)
        reason = (
            f"no signal in {case.all.profiles} profiles at most {GAP.total_seconds() / 60:g} min"
            f" apart: at most {most:.1f} standard errors (limit {STILL_DARK:g})"
        )
        yield case.without(reason, most)


def _saturated(case: _SectionCase) -> Decisions:
    if case.first.unsaturated == case.all.unsaturated == 0:
        reason = (
            f"all {case.all.profiles} profiles, at most {GAP.total_seconds() / 60:g} min apart,"
            " are saturated"
        )
        yield case.without(reason, 0.0)


SECTION_DARK: Final = Rule(
    "section_dark", StepName.HOMOGENEOUS, "Does a profile show a signal in the section?", _dark
)
SECTION_SATURATED: Final = Rule(
    "section_saturated",
    StepName.HOMOGENEOUS,
    "Is any profile unsaturated in the section?",
    _saturated,
)
REFINEMENTS: Final = (SECTION_SATURATED, SECTION_DARK)
_BITS: Final[Mapping[str, Quality]] = {
    SECTION_SATURATED.name: Quality.SATURATED,
    SECTION_DARK.name: Quality.LOW_SIGNAL,
}


def refine_plan(plan: Plan, granules: Sequence[Granule], profiles: Profiles) -> Plan:
    """Return a plan without the sections in which there is nothing to retrieve.

    Parameters
    ----------
    plan : Plan
    granules : sequence of Granule
        Usable granules of the scene, by time.
    profiles : callable
        Returns the profiles of a channel in some of the granules.

    Returns
    -------
    Plan
        Independent of chunks and workers; unchanged where it was refined before.
    """
    sample_sizes = {
        step.channel: int(step.settings["profiles"])
        for step in plan.steps
        if step.name == StepName.LOOK
    }
    steps = []
    left_out = list(plan.left_out)
    for step in plan.steps:
        if step.name == StepName.HOMOGENEOUS and step.channel in sample_sizes and granules:
            omitted = _sections(step, granules, profiles, sample_sizes[step.channel])
            left_out += omitted.values()
            steps.append(_without(step, omitted))
        else:
            steps.append(step)
    return replace(plan, steps=tuple(steps), left_out=tuple(left_out))


def _sections(
    step: Step, granules: Sequence[Granule], profiles: Profiles, most: int
) -> dict[tuple[float, float], LeftOut]:
    """Return the sections that are left out, and why."""
    before = {(near, far) for near, far, _ in step.settings.get(OMITTED, ())}
    sections = [(n, f) for n, f in step.settings["sections"] if (n, f) not in before]
    places = spaced_indices(len(granules), most)
    first = _looks(profiles(step.channel, [granules[k] for k in places]), sections)
    doubtful = [
        section
        for section, seen in first.items()
        if seen.profiles and (seen.significance < DARK or not seen.unsaturated)
    ]
    if not doubtful:
        return {}
    rest = [granules[k] for k in _second_places(granules, places)]
    second = _looks(profiles(step.channel, rest), doubtful) if rest else {}
    omitted = {}
    for section in doubtful:
        both = _merged_looks(first[section], second.get(section))
        decision = next(
            applied(REFINEMENTS, _SectionCase(step, *section, first[section], both)), None
        )
        if isinstance(decision, LeftOut):
            omitted[section] = decision
    return omitted


def _second_places(granules: Sequence[Granule], places: npt.NDArray[np.int64]) -> list[int]:
    """Return the indices of further granules, so that samples are at most `GAP` apart."""
    sampled = {int(place) for place in places}
    more = []
    last: datetime | None = None
    for place, granule in enumerate(granules):
        following = granules[place + 1].start if place + 1 < len(granules) else None
        if place in sampled:
            last = granule.start
        elif last is None or following is None or following - last > GAP:
            more.append(place)
            last = granule.start
    return more


def _merged_looks(first: LightDetection, second: LightDetection | None) -> LightDetection:
    if second is None:
        return first
    return LightDetection(
        first.profiles + second.profiles,
        max(first.significance, second.significance),
        first.unsaturated + second.unsaturated,
    )


def _looks(
    profiles: xr.Dataset, sections: Sequence[tuple[float, float]]
) -> dict[tuple[float, float], LightDetection]:
    power, variance, quality, distance = (
        profiles[name].to_numpy() for name in ("power", "variance", "quality", "range")
    )
    return {
        (near, far): detect_light(power, variance, quality, distance, near, far)
        for near, far in sections
    }


def _without(step: Step, omitted: Mapping[tuple[float, float], LeftOut]) -> Step:
    if not omitted:
        return step
    entries: list[list[Any]] = [*step.settings.get(OMITTED, ())]
    entries += [[*section, _BITS[omission.rule].name] for section, omission in omitted.items()]
    return replace(step, settings={**step.settings, OMITTED: entries})
