"""Determine what one product depends on: its part of the plan, of the campaign and of the inputs.

A scene gives several products, and each is up to date or stale by itself. Whatever a product does
not depend on must neither appear in it nor make it stale.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from lidarops.campaign.model import Campaign, InstrumentFacts, as_settings
from lidarops.kinds import reads_of, with_read
from lidarops.netcdf.context import product_of_path
from lidarops.records import (
    InputRecord,
    LeftOut,
    Plan,
    PlannedStep,
    Role,
    Scene,
    UnusedFile,
)
from lidarops.scene.case import READ_STEP, sources
from lidarops.scene.pipe import lacks_dark, required_by

UNUSABLE_FILE: Final = "ancillary"
"""Rule by which a product is left out because a file that it needs cannot be used."""

UNUSED: Final = "unused"
"""Key of the unused files in the settings of a product."""

ProductKey = tuple[str, str]
"""Kind and channel of a product."""

_EDGES: Final = frozenset({"valid_from", "valid_to"})
_FILES: Final = {
    "overlap_profile": Role.OVERLAP,
    "molecular_profile": Role.MOLECULAR,
    "lidar_ratio_profile": Role.LIDAR_RATIO,
}
"""Settings of a plan that name ancillary files, with their roles."""


def is_product(entry: PlannedStep | LeftOut) -> bool:
    """Return whether an entry of a plan is about the step that makes a product."""
    return bool(entry.product) and entry.name == entry.product


def read_products(step: PlannedStep) -> tuple[ProductKey, ...]:
    """Return kind and channel of the products that a step reads."""
    reads = reads_of(step.product) if is_product(step) else ()
    parts = (need.rpartition("/") for need in step.needs) if reads else ()
    return tuple((name, channel or step.channel) for channel, _, name in parts if name in reads)


def planned_products(plan: Plan) -> tuple[ProductKey, ...]:
    """Return kind and channel of the products that a plan makes, in its order."""
    keys = ((step.name, step.channel) for step in plan.steps if is_product(step))
    return tuple(dict.fromkeys(keys))


def plan_closure(plan: Plan, products: Collection[ProductKey]) -> Plan:
    """Return the part of a plan that the given products need.

    Parameters
    ----------
    plan : Plan
    products : collection of (str, str)
        Kind and channel of each product.

    Returns
    -------
    Plan
        The same for a product, whatever else the whole plan holds.
    """
    entries: Sequence[PlannedStep | LeftOut] = (*plan.steps, *plan.left_out)
    places = _places(entries)
    waiting = [
        entry for entry in entries if is_product(entry) and (entry.name, entry.channel) in products
    ]
    reached: set[int] = set()
    while waiting:
        entry = waiting.pop()
        if id(entry) not in reached:
            reached.add(id(entry))
            waiting += _needed(entry, places)
    kept = [entry for entry in entries if id(entry) in reached]
    steps = [entry for entry in kept if isinstance(entry, PlannedStep)]
    return replace(
        plan,
        steps=tuple(_with_requesters(step, steps) for step in steps),
        left_out=tuple(entry for entry in kept if isinstance(entry, LeftOut)),
    )


def without_unusable_files(plan: Plan, problems: Mapping[str, str]) -> Plan:
    """Return a plan without the products that need an ancillary file that cannot be used.

    Nor those that are made of such a product.

    Parameters
    ----------
    plan : Plan
    problems : mapping of str to str
        Path of a file -> why it cannot be used.
    """
    kept, left_out = [], []
    without: dict[ProductKey, str] = {}
    for kind, channel in planned_products(plan):
        steps = plan_closure(plan, [(kind, channel)]).steps
        reasons = [
            f"{name}: {problems[name]}" for name in ancillary_files(steps) if name in problems
        ]
        reasons += [
            without[read] for step in steps for read in read_products(step) if read in without
        ]
        if reasons:
            reason = without[kind, channel] = "; ".join(dict.fromkeys(reasons))
            left_out.append(LeftOut(kind, channel, reason, rule=UNUSABLE_FILE, product=kind))
        else:
            kept.append((kind, channel))
    if not left_out:
        return plan
    steps = plan_closure(plan, kept).steps
    return replace(plan, steps=steps, left_out=(*plan.left_out, *left_out))


def needed_places(plan: Plan) -> list[list[int]]:
    """Return, for each step of a plan, the places of the steps whose outputs it takes."""
    places = _places(plan.steps)
    numbers = {id(step): number for number, step in enumerate(plan.steps)}
    return [sorted(numbers[id(other)] for other in _needed(step, places)) for step in plan.steps]


def _places(
    entries: Iterable[PlannedStep | LeftOut],
) -> Mapping[tuple[str, str], Sequence[PlannedStep | LeftOut]]:
    """Return the entries of a plan by channel and name."""
    places: dict[tuple[str, str], list[PlannedStep | LeftOut]] = defaultdict(list)
    for entry in entries:
        places[entry.channel, entry.name].append(entry)
    return places


def _needed(
    entry: PlannedStep | LeftOut,
    places: Mapping[tuple[str, str], Sequence[PlannedStep | LeftOut]],
) -> Iterator[PlannedStep | LeftOut]:
    """Yield the entries of a plan that a step names as needed."""
    if isinstance(entry, LeftOut):
        return
    for need in entry.needs:
        channel, _, name = need.rpartition("/")
        for other in places.get((channel or entry.channel, name), ()):
            of_member = not entry.instrument or other.instrument == entry.instrument
            if of_member and other.product in ("", entry.product):
                yield other


def _with_requesters(step: PlannedStep, steps: Iterable[PlannedStep]) -> PlannedStep:
    """Return a step whose reason, if it reads a channel, names only what it is read for."""
    if step.instrument or step.name != READ_STEP:
        return step
    products = sorted(s.name for s in steps if is_product(s) and s.channel == step.channel)
    glued = sorted({s.channel for s in steps if step.channel in sources(s)})
    return replace(step, reason=required_by(dict.fromkeys((*products, *glued))))


def plan_of_kinds(plan: Plan, selected: Collection[str]) -> Plan:
    """Return the part of a plan that concerns some kinds of product, and those they are made of.

    Parameters
    ----------
    plan : Plan
    selected : collection of str
        Kinds of product; all where empty.
    """
    if not selected:
        return plan
    kinds = with_read(selected)
    products = [product for product in planned_products(plan) if product[0] in kinds]
    closure = plan_closure(plan, products)
    names = {*kinds, READ_STEP}
    left_out = tuple(
        omission
        for omission in plan.left_out
        if omission.name in names or omission in closure.left_out
    )
    return replace(closure, left_out=left_out)


def product_notes(scene: Scene, plan: Plan, channel: str) -> tuple[str, ...]:
    """Return the notes on the files of a scene, without those on channels that a product lacks.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        Plan of the product, from `plan_closure`.
    channel : str
        Channel of the product.
    """
    if not reads_files(plan):
        return ()
    others = {held.name for member in scene.members or (scene,) for held in member.layout}
    others -= {step.channel for step in plan.steps} | {channel}
    return tuple(note for note in scene.notes if others.isdisjoint(note.split(": ")))


def product_unused(scene: Scene, plan: Plan) -> tuple[UnusedFile, ...]:
    """Return the unused files of a scene that a product would be made from.

    Dark files also where the plan subtracts none for want of them.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        Plan of the product, from `plan_closure`.
    """
    if not reads_files(plan):
        return ()
    dark = _reads_dark(plan) or any(map(lacks_dark, plan.left_out))
    return tuple(file for file in scene.unused if dark or file.role is Role.SIGNAL)


def unused_inputs(unused: Iterable[UnusedFile]) -> tuple[InputRecord, ...]:
    """Return the unused files of a product as the ledger knows them, by whose loss it is kept."""
    # Of a name that is stated with escapes, the file is not found.
    return tuple(InputRecord(f.path, Role.UNUSED, "") for f in unused if "\\" not in f.path)


def scene_facts(campaign: Campaign, scene: Scene) -> InstrumentFacts:
    """Return the facts about the instrument of a scene at its time."""
    moment = scene.granules[0].start if scene.granules else None
    return campaign.instruments[scene.instrument].facts_at(moment or scene.start)


def facts_settings(known: InstrumentFacts, plan: Plan, channel: str) -> dict[str, Any]:
    """Return the facts about an instrument on which a product depends.

    Parameters
    ----------
    known : InstrumentFacts
    plan : Plan
        Plan of the product, from `plan_closure`.
    channel : str
        Channel of the product.

    Returns
    -------
    dict
        `known` as plain JSON types, without the edges of its validity period, because closing a
        period changes nothing within it.
    """
    settings = as_settings(known)
    channels = {step.channel for step in plan.steps} | {channel}
    read = ancillary_files(plan.steps)
    return {
        **{
            # Facts that are texts name files.
            key: None if isinstance(value, str) and value not in read else value
            for key, value in settings.items()
            if key not in _EDGES
        },
        "channels": {name: fact for name, fact in settings["channels"].items() if name in channels},
    }


def ancillary_files(steps: Iterable[PlannedStep]) -> dict[str, Role]:
    """Return the ancillary files that steps read, by path, with their roles."""
    return {
        path: role
        for step in steps
        for key, role in _FILES.items()
        if (path := step.settings.get(key)) is not None
    }


def product_inputs(plan: Plan, files: Iterable[InputRecord]) -> tuple[InputRecord, ...]:
    """Return the files of a scene, and the products, that a part of its plan reads.

    Parameters
    ----------
    plan : Plan
        Plan of the product, from `plan_closure`.
    files : iterable of InputRecord
        Files and products of the scene.
    """
    raw = {Role.SIGNAL: reads_files(plan), Role.DARK: _reads_dark(plan)}
    named = ancillary_files(plan.steps)
    products = {product for step in plan.steps for product in read_products(step)}
    return tuple(
        file
        for file in files
        if raw.get(file.role)
        or file.path in named
        or (file.role is Role.PRODUCT and product_of_path(file.path) in products)
    )


def reads_files(plan: Plan) -> bool:
    """Return whether a part of a plan reads raw files; without, it reads other products."""
    return any(step.name == READ_STEP for step in plan.steps)


def _reads_dark(plan: Plan) -> bool:
    return any(step.name == "dark" for step in plan.steps)


def inputs_digest(files: Sequence[InputRecord]) -> str:
    """Return the sha256 of the contents and roles of files, independent of their names."""
    # Writes the JSON of `digest` directly: every product needs this, for thousands of files.
    contents = sorted([f'["{file.role}","{file.sha256}"]' for file in files])
    return hashlib.sha256(f"[{','.join(contents)}]".encode()).hexdigest()
