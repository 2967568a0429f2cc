"""Find the steps of every kind of product, and what follows from their inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, Final

from lidarops.kinds import kind_of
from lidarops.records import Granule, LeftOut, Plan, PlannedStep, Scene
from lidarops.steps.channels import file_channels, glued_parts, is_glued
from lidarops.steps.conditioning import (
    PROFILES,
    Dark,
    DeadTime,
    Noise,
    Overlap,
    RangeOffset,
)
from lidarops.steps.gluing import Glue, Lag
from lidarops.steps.products import Molecular
from lidarops.steps.reading import Read
from lidarops.steps.step import Step

FILE_STEPS: Final[tuple[Step[Any], ...]] = (
    Read(), Overlap(), RangeOffset(), Dark(), DeadTime(), Noise(),
)  # fmt: skip
"""From the counts of a channel of the files to its profiles, in the order in which they run."""
GLUE_STEPS: Final[tuple[Step[Any], ...]] = (Read(), Overlap(), Lag(), Glue())
"""From two channels of the files to the profiles of the glued one."""
SHARED: Final[tuple[Step[Any], ...]] = (Molecular(),)
"""Steps that are decided once a channel, if one of its products needs them."""


@cache
def steps_of(kind: str) -> tuple[Step[Any], ...]:
    """Return the own steps of a kind of product, of which the last one makes it.

    Raises
    ------
    LidarOpsError
        If there is no such kind, or its package is incomplete.
    """
    steps: tuple[Step[Any], ...] = kind_of(kind).part("steps", "STEPS")
    return steps


def product_step(kind: str) -> Any:
    """Return the step that makes a product of a kind."""
    return steps_of(kind)[-1]


@cache
def _definitions(product: str) -> Mapping[str, Step[Any]]:
    """Return the steps that a product may have, by name; the shared ones for an empty name."""
    own = steps_of(product) if product else ()
    return {step.name: step for step in (*FILE_STEPS, *GLUE_STEPS, *SHARED, *own)}


def definition(entry: PlannedStep | LeftOut) -> Step[Any]:
    """Return the step that an entry of a plan is about."""
    return _definitions(entry.product)[entry.name]


def typed_settings(planned: PlannedStep) -> Any:
    """Return the settings of a planned step as the model of its step."""
    return definition(planned).settings.model_validate(dict(planned.settings))


def needed_steps(kind: str) -> frozenset[str]:
    """Return the names of all steps whose outputs a product needs, directly or not."""
    known = _definitions(kind)
    needed, new = set(), {kind}
    while new:
        needed |= new
        wanted = {datum for name in new for datum in known[name].inputs}
        new = {name for name, step in known.items() if wanted & set(step.outputs)} - needed
    return frozenset(needed)


@cache
def _suppliers(product: str, name: str) -> tuple[str, ...]:
    """Return the names of the steps whose outputs a step of a product takes."""
    known = _definitions(product)
    wanted = set(known[name].inputs)
    return tuple(
        other for other, step in known.items() if other != name and wanted & set(step.outputs)
    )


def with_needs(entries: Iterable[PlannedStep | LeftOut]) -> list[PlannedStep | LeftOut]:
    """Return the entries of a plan, of which each step names those whose outputs it takes."""
    entries = list(entries)
    places = {(e.channel, e.instrument, e.product, e.name) for e in entries}
    # A step of a whole network takes from every member.
    places |= {(e.channel, "", e.product, e.name) for e in entries}
    return [
        replace(entry, needs=_needs(entry, places)) if isinstance(entry, PlannedStep) else entry
        for entry in entries
    ]


def _needs(step: PlannedStep, places: Collection[tuple[str, str, str, str]]) -> tuple[str, ...]:
    def present(channel: str, names: Iterable[str]) -> list[str]:
        products = dict.fromkeys(("", step.product))
        return [
            name
            for name in names
            if any((channel, step.instrument, product, name) in places for product in products)
        ]

    needs = present(step.channel, _suppliers(step.product, step.name))
    if step.name == Glue.name:
        for part in glued_parts(step.channel):
            needs += [f"{part}/{name}" for name in present(part, _PROFILE_STEPS)]
    return tuple(needs)


_PROFILE_STEPS: Final = tuple(step.name for step in FILE_STEPS if PROFILES in step.outputs)
"""Steps that give the profiles of a channel of the files."""


def setting_of(plan: Plan, product: str, step: str, name: str) -> Any:
    """Return a setting of a step of a product in a plan."""
    return next(
        planned.settings[name]
        for planned in plan.steps
        if planned.name == step and planned.product == product
    )


def settings_of(plan: Plan, product: str, step: str, channel: str) -> Mapping[str, Any] | None:
    """Return the settings of a step of a product of a channel; None where it does not run."""
    for planned in plan.steps:
        if (planned.name, planned.product, planned.channel) == (step, product, channel):
            return planned.settings
    return None


def bins_of(scene: Scene, product: str, plan: Plan) -> int:
    """Return the number of bins of the channel of a product; `plan` holds that product only."""
    channel = next(step.channel for step in plan.steps if step.name == product)
    bins = {layout.name: layout.bins for layout in scene.layout}
    return min(bins[name] for name in file_channels(channel))


def intervals(granules: Iterable[Granule], seconds: float) -> int:
    """Return the number of clock intervals that hold profiles."""
    starts = (granule.start for granule in granules)
    return len({math.floor(start.timestamp() / seconds) for start in starts if start})


def channel_steps(channel: str) -> tuple[Step[Any], ...]:
    """Return the steps from raw counts to the profiles of a channel."""
    return GLUE_STEPS if is_glued(channel) else FILE_STEPS
