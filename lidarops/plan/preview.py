"""Plan -> plan, in the worker: a look at a few profiles leaves out what would give nothing.

The rules of `lidarops.plan.scene_plan` know headers alone. These know what some profiles show. What they
leave out stands in the product as missing, with the quality bit that the retrieval would give.
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
from lidarops.plan.signal_rules import Decisions, Rule, StepName, applied
from lidarops.records import Granule, LeftOut, Plan, Step
from lidarops.retrieve.background.detectable_light import Look, look_for_light, spaced

GAP: Final = timedelta(minutes=10)
"""Longest time between profiles that are looked at where the first ones show nothing."""
DARK: Final = 3.0
"""Significance below which no first profile shows light; a retrieval is accepted above 5. Noise
alone lifts the largest of 16 above 3 in 2 % of scenes, above 1.7 in half."""
STILL_DARK: Final = 3.5
"""The same for the many profiles of the second look, of which noise alone lifts some."""
WITHOUT: Final = "left_out"
"""Setting of a homogeneous step: sections that are not retrieved, with the bit that says why."""

Profiles = Callable[[str, Sequence[Granule]], xr.Dataset]
"""Gives power, variance and quality of a channel in some granules."""


@dataclass(frozen=True, slots=True)
class Sight:
    """What the rules of one section look at."""

    step: Step
    near: float
    """m."""
    far: float
    """m."""
    first: Look
    all: Look
    """Of the second look, where there was one; else the first."""

    def without(self, reason: str, number: float) -> LeftOut:
        """Return the section as left out."""
        told = f"section {self.near:g}-{self.far:g} m: {reason}"
        return LeftOut(self.step.name, self.step.channel, told, self.step.instrument, number=number)


def _dark(sight: Sight) -> Decisions:
    if sight.first.significance < DARK and sight.all.significance < STILL_DARK:
        most = max(sight.first.significance, sight.all.significance)
        reason = (
            f"{sight.all.profiles} profiles, {GAP.total_seconds() / 60:g} min apart at most, show"
            f" no light: {most:.1f} standard errors at most, and {STILL_DARK:g} are none"
        )
        yield sight.without(reason, most)


def _saturated(sight: Sight) -> Decisions:
    if sight.first.unsaturated == sight.all.unsaturated == 0:
        reason = (
            f"all of {sight.all.profiles} profiles, {GAP.total_seconds() / 60:g} min apart at"
            " most, are saturated"
        )
        yield sight.without(reason, 0.0)


SECTION_DARK: Final = Rule(
    "section_dark", StepName.HOMOGENEOUS, "Does a profile show light in the section?", _dark
)
SECTION_SATURATED: Final = Rule(
    "section_saturated",
    StepName.HOMOGENEOUS,
    "Is a profile not saturated in the section?",
    _saturated,
)
REFINEMENTS: Final = (SECTION_SATURATED, SECTION_DARK)
_BITS: Final[Mapping[str, Quality]] = {
    SECTION_SATURATED.name: Quality.SATURATED,
    SECTION_DARK.name: Quality.LOW_SIGNAL,
}


def refine_plan(plan: Plan, granules: Sequence[Granule], profiles: Profiles) -> Plan:
    """Leave out of a plan the sections in which there is nothing to retrieve.

    Parameters
    ----------
    plan : Plan
    granules : sequence of Granule
        Usable ones of the scene, by time.
    profiles : callable
        Of a channel and some of the granules.

    Returns
    -------
    Plan
        The same for the same files, whatever the chunks and workers; unchanged where it was
        refined before.
    """
    looking = {
        step.channel: int(step.settings["profiles"])
        for step in plan.steps
        if step.name == StepName.LOOK
    }
    steps = []
    left_out = list(plan.left_out)
    for step in plan.steps:
        if step.name == StepName.HOMOGENEOUS and step.channel in looking and granules:
            found = _sections(step, granules, profiles, looking[step.channel])
            left_out += found.values()
            steps.append(_without(step, found))
        else:
            steps.append(step)
    return replace(plan, steps=tuple(steps), left_out=tuple(left_out))


def _sections(
    step: Step, granules: Sequence[Granule], profiles: Profiles, most: int
) -> dict[tuple[float, float], LeftOut]:
    """Return the sections that are left out, and why."""
    before = {(near, far) for near, far, _ in step.settings.get(WITHOUT, ())}
    asked = [(n, f) for n, f in step.settings["sections"] if (n, f) not in before]
    places = spaced(len(granules), most)
    first = _looks(profiles(step.channel, [granules[k] for k in places]), asked)
    doubtful = [
        section
        for section, seen in first.items()
        if seen.profiles and (seen.significance < DARK or not seen.unsaturated)
    ]
    if not doubtful:
        return {}
    rest = [granules[k] for k in _second(granules, places)]
    # Together with the first, so that either look counts all that was looked at.
    again = _looks(profiles(step.channel, rest), doubtful) if rest else {}
    found = {}
    for section in doubtful:
        sight = Sight(step, *section, first[section], _joined(first[section], again.get(section)))
        decision = next(applied(REFINEMENTS, sight), None)
        if isinstance(decision, LeftOut):
            found[section] = decision
    return found


def _second(granules: Sequence[Granule], places: npt.NDArray[np.int64]) -> list[int]:
    """Return further places, so that no two that are looked at lie farther apart than `GAP`."""
    looked = {int(place) for place in places}
    more = []
    last: datetime | None = None
    for place, granule in enumerate(granules):
        following = granules[place + 1].start if place + 1 < len(granules) else None
        if place in looked:
            last = granule.start
        elif last is None or following is None or following - last > GAP:
            more.append(place)
            last = granule.start
    return more


def _joined(first: Look, second: Look | None) -> Look:
    if second is None:
        return first
    return Look(
        first.profiles + second.profiles,
        max(first.significance, second.significance),
        first.unsaturated + second.unsaturated,
    )


def _looks(
    profiles: xr.Dataset, sections: Sequence[tuple[float, float]]
) -> dict[tuple[float, float], Look]:
    power, variance, quality, distance = (
        profiles[name].to_numpy() for name in ("power", "variance", "quality", "range")
    )
    return {
        (near, far): look_for_light(power, variance, quality, distance, near, far)
        for near, far in sections
    }


def _without(step: Step, found: Mapping[tuple[float, float], LeftOut]) -> Step:
    if not found:
        return step
    told: list[list[Any]] = [*step.settings.get(WITHOUT, ())]
    told += [[*section, _BITS[left.rule].name] for section, left in found.items()]
    return replace(step, settings={**step.settings, WITHOUT: told})
