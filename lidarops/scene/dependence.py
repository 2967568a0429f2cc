"""Determine what one product depends on: its part of the plan, of the campaign and of the inputs.

A scene gives several products, and each is up to date or stale by itself. Whatever a product does
not depend on must neither appear in it nor make it stale.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from lidarops.campaign.model import Campaign, InstrumentFacts
from lidarops.kinds import kinds, with_read
from lidarops.netcdf.context import product_of_path
from lidarops.records import (
    InputRecord,
    LeftOut,
    Plan,
    PlannedStep,
    Role,
    Scene,
    UnusedFile,
    products_of,
)
from lidarops.scene.case import ANCILLARY_FILES, DARK_FILES, READ_STEP, sources

UNUSABLE_FILE: Final = "ancillary"
"""Rule by which a product is left out because a file that it needs cannot be used."""

UNUSED: Final = "unused"
"""Key of the unused files in the settings of a product."""

ProductKey = tuple[str, str]
"""Kind and channel of a product."""

_EDGES: Final = frozenset({"valid_from", "valid_to"})


def read_products(step: PlannedStep) -> tuple[ProductKey, ...]:
    """Return kind and channel of the products that a product reads."""
    reads = kinds()[step.name].reads
    parts = (need.rpartition("/") for need in step.needs) if reads else ()
    return tuple((name, channel or step.channel) for channel, _, name in parts if name in reads)


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
    needed, own = needed_places(entries), products_of(entries)
    waiting = [
        place
        for place, entry in enumerate(entries)
        if entry in own and (entry.name, entry.channel) in products
    ]
    reached: set[int] = set()
    while waiting:
        place = waiting.pop()
        if place not in reached:
            reached.add(place)
            waiting += needed[place]
    kept = [entries[place] for place in sorted(reached)]
    steps = [entry for entry in kept if isinstance(entry, PlannedStep)]
    # A channel is read for the products and channels that are left.
    readers = defaultdict[str, set[tuple[bool, str]]](set)
    for step in steps:
        if step in own:
            readers[step.channel].add((False, step.name))
        for channel in sources(step):
            readers[channel].add((True, step.channel))
    for place, step in enumerate(steps):
        if step.name == READ_STEP and not step.instrument:
            words = " and ".join(name for _, name in sorted(readers[step.channel]))
            steps[place] = replace(step, reason=f"required by {words}")
    return replace(
        plan,
        steps=tuple(steps),
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
    for kind, channel in plan.product_keys:
        steps = plan_closure(plan, [(kind, channel)]).steps
        reasons = [
            f"{name}: {problems[name]}" for name in ancillary_files(steps) if name in problems
        ]
        reasons += [
            without[read]
            for step in products_of(steps)
            for read in read_products(step)
            if read in without
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


def places_by_need(entries: Sequence[PlannedStep | LeftOut]) -> Iterator[list[list[int]]]:
    """Yield, for each entry of a plan, the places of the entries that each of its needs names."""
    places: dict[tuple[str, str], list[int]] = defaultdict(list)
    for place, entry in enumerate(entries):
        places[entry.channel, entry.name].append(place)
    for entry in entries:
        needs = entry.needs if isinstance(entry, PlannedStep) else ()
        parts = (need.rpartition("/") for need in needs)
        yield [
            [
                place
                for place in places.get((channel or entry.channel, name), ())
                # A product of a whole network needs entries of every member.
                if entry.instrument in ("", entries[place].instrument)
                and entries[place].product in ("", entry.product)
            ]
            for channel, _, name in parts
        ]


def needed_places(entries: Sequence[PlannedStep | LeftOut]) -> list[list[int]]:
    """Return, for each entry of a plan, the places of the entries that it names as needed."""
    return [sorted(itertools.chain(*found)) for found in places_by_need(entries)]


def plan_of_kinds(plan: Plan, selected: Collection[str]) -> Plan:
    """Return the part of a plan that concerns some kinds of product, and those they are made of.

    Parameters
    ----------
    plan : Plan
    selected : collection of str
        Kinds of product.
    """
    chosen = with_read(selected)
    products = [product for product in plan.product_keys if product[0] in chosen]
    closure = plan_closure(plan, products)
    names = {*chosen, READ_STEP}
    left_out = tuple(
        omission
        for omission in plan.left_out
        if omission.name in names or omission in closure.left_out
    )
    return replace(closure, left_out=left_out)


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
    dark = any(step.name == "dark" for step in plan.steps) or any(
        omission.rule == DARK_FILES for omission in plan.left_out
    )
    return tuple(file for file in scene.unused if dark or file.role is Role.SIGNAL)


def unused_inputs(unused: Iterable[UnusedFile]) -> tuple[InputRecord, ...]:
    """Return the unused files of a product as the ledger knows them, by whose loss it is kept."""
    # Of a name that is stated with escapes, the file is not found.
    return tuple(InputRecord(f.path, Role.UNUSED, "") for f in unused if "\\" not in f.path)


def scene_facts(campaign: Campaign, scene: Scene) -> InstrumentFacts:
    """Return the facts about the instrument of a scene at its time."""
    moment = scene.granules[0].start if scene.granules else None
    return campaign.instruments[scene.instrument].facts_at(moment or scene.start)


def facts_settings(campaign: Campaign, scene: Scene, plan: Plan, channel: str) -> dict[str, Any]:
    """Return the facts about an instrument on which a product depends.

    Parameters
    ----------
    campaign : Campaign
    scene : Scene
        Of one instrument.
    plan : Plan
        Plan of the product, from `plan_closure`.
    channel : str
        Channel of the product.

    Returns
    -------
    dict
        As plain JSON types, without the edges of their validity period, because closing a period
        changes nothing within it.
    """
    # Products of products state the facts that those were made with.
    known = scene_facts(campaign, scene) if reads_files(plan) else InstrumentFacts()
    settings = known.model_dump(mode="json")
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


def ancillary_files(steps: Sequence[PlannedStep]) -> dict[str, Role]:
    """Return the ancillary files that steps read, by path, with their roles."""
    named = {
        path: role
        for step in steps
        for key, role in ANCILLARY_FILES.items()
        if (path := step.settings.get(key)) is not None
    }
    chosen = (step.settings["atmosphere"] for step in steps if step.settings.get("atmosphere"))
    return named | {one["file"]: Role.ATMOSPHERE for air in chosen for one in air["profiles"]}


def product_inputs(plan: Plan, files: Iterable[InputRecord]) -> tuple[InputRecord, ...]:
    """Return the files of a scene, and the products, that a part of its plan reads.

    Parameters
    ----------
    plan : Plan
        Plan of the product, from `plan_closure`.
    files : iterable of InputRecord
        Files and products of the scene.
    """
    names = {step.name for step in plan.steps}
    raw = {Role.SIGNAL: READ_STEP in names, Role.DARK: "dark" in names}
    named = ancillary_files(plan.steps)
    products = {product for step in plan.products for product in read_products(step)}
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


def inputs_digest(files: Sequence[InputRecord]) -> str:
    """Return the sha256 of the contents and roles of files, independent of their names."""
    # Writes the JSON of `digest` directly: every product needs this, for thousands of files.
    contents = sorted([f'["{file.role}","{file.sha256}"]' for file in files])
    return hashlib.sha256(f"[{','.join(contents)}]".encode()).hexdigest()
