"""Find the steps of every kind of product, and what follows from their inputs and outputs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Final

from lidarops.errors import LidarOpsError
from lidarops.kinds import kind_of
from lidarops.records import LeftOut, PlannedStep, is_glued
from lidarops.steps.case import ChannelCase
from lidarops.steps.channels import glued_parts
from lidarops.steps.conditioning import Dark, DeadTime, Noise, Overlap, RangeOffset
from lidarops.steps.data import Data
from lidarops.steps.gluing import Glue, Lag
from lidarops.steps.network import NetworkProductStep
from lidarops.steps.preparation import Molecular
from lidarops.steps.reading import READ, WAVELENGTH
from lidarops.steps.step import Datum, Definition, MakingStep, ProductStep, Step

SharedStep = Step[ChannelCase, Any]

FILE_STEPS: Final[tuple[SharedStep, ...]] = (
    READ, Overlap(), RangeOffset(), Dark(), DeadTime(), Noise(),
)  # fmt: skip
"""From the counts of a channel of the files to its profiles, in the order in which they run."""
GLUE_STEPS: Final[tuple[SharedStep, ...]] = (READ, Overlap(), Lag(), Glue())
"""From two channels of the files to the profiles of the glued one."""
SHARED: Final[tuple[SharedStep, ...]] = (Molecular(),)
"""Steps that are decided once a channel, if one of its products needs them."""


def making_step(kind: str) -> MakingStep[Any, Any]:
    """Return the step that makes a product of a kind.

    Raises
    ------
    LidarOpsError
        If there is no such kind, its package is incomplete, or its step has another name.
    """
    step: MakingStep[Any, Any] = kind_of(kind).part("steps", "STEP")
    if not isinstance(step, MakingStep) or step.name != kind:
        raise LidarOpsError(
            f"kind of product {kind!r}: STEP is no step that makes a product of that name",
            remedy=f"correct {kind_of(kind).package}.steps",
        )
    return step


def product_step(kind: str) -> ProductStep[Any, Any]:
    """Return the step that makes a product of a kind of one channel, as `making_step`."""
    step: ProductStep[Any, Any] = kind_of(kind).part("steps", "STEP")
    return step


def network_step(kind: str) -> NetworkProductStep[Any, Any]:
    """Return the step that makes a product of a kind of networks, as `making_step`."""
    step: NetworkProductStep[Any, Any] = kind_of(kind).part("steps", "STEP")
    return step


@cache
def _definitions(product: str) -> Mapping[str, Definition[Any]]:
    """Return what a plan of a product may hold, by name; the shared steps for an empty name."""
    making = making_step(product) if product else None
    own = (*making.parts, making) if making else ()
    shared = {known.name: known for known in (*FILE_STEPS, *GLUE_STEPS, *SHARED)}
    known = shared | {part.name: part for part in own}
    if len(known) != len(shared) + len(own):
        raise LidarOpsError(
            f"kind of product {product!r}: two of its steps, or one and a shared step, have one"
            " name",
            remedy=f"rename a step in {kind_of(product).package}.steps",
        )
    return known


def definition(planned: PlannedStep) -> Definition[Any]:
    """Return what a planned step is."""
    return _definitions(planned.product)[planned.name]


def gives(planned: PlannedStep, datum: Datum[Any]) -> bool:
    """Return whether a planned step gives a datum."""
    step = definition(planned)
    return isinstance(step, Step) and datum in step.outputs


def carry_out(planned: PlannedStep, data: Data) -> None:
    """Carry out a planned step; what is chosen only has no data."""
    step = definition(planned)
    if isinstance(step, Step):
        step.carry_out(step.typed(planned), data)


def needed_steps(kind: str) -> frozenset[str]:
    """Return the names of the steps from which those of a product take data."""
    return frozenset(name for taker in _definitions(kind) for name in _suppliers(kind, taker))


@cache
def _suppliers(product: str, name: str) -> tuple[str, ...]:
    """Return the names of what a step of a product takes."""
    known = _definitions(product)
    taker = known[name]
    return tuple(
        other.name for other in known.values() if other is not taker and _takes(taker, other)
    )


def _takes(taker: Definition[Any], other: Definition[Any]) -> bool:
    """Return whether a step takes outputs of another, or makes its product by a choice."""
    if isinstance(taker, Step | MakingStep) and isinstance(other, Step):
        return not {*taker.inputs}.isdisjoint(other.outputs)
    return isinstance(taker, MakingStep)


def with_needs(entries: Iterable[PlannedStep | LeftOut]) -> list[PlannedStep | LeftOut]:
    """Return the entries of a plan, of which each step names those whose outputs it takes.

    The step that makes a product names the products with which its own is compared.
    """
    entries = list(entries)
    compared = _compared([entry for entry in entries if isinstance(entry, PlannedStep)])
    places = {(e.channel, e.instrument, e.product, e.name) for e in entries}
    # A step of a whole network takes from every member.
    places |= {(e.channel, "", e.product, e.name) for e in entries}
    return [
        replace(entry, needs=(*_needs(entry, places), *compared.get(id(entry), ())))
        if isinstance(entry, PlannedStep)
        else entry
        for entry in entries
    ]


def _compared(steps: Sequence[PlannedStep]) -> dict[int, list[str]]:
    """Return the products of other channels that measure the same, by the identity of a step."""
    wavelengths = {s.channel: s.settings["wavelength"] for s in steps if gives(s, WAVELENGTH)}
    alike: defaultdict[tuple[str, float], list[PlannedStep]] = defaultdict(list)
    for step in steps:
        if step.name == step.product and kind_of(step.product).common:
            alike[step.product, wavelengths[step.channel]].append(step)
    return {
        id(step): [f"{other.channel}/{other.name}" for other in group if other is not step]
        for group in alike.values()
        for step in group
    }


def _needs(planned: PlannedStep, places: Collection[tuple[str, str, str, str]]) -> tuple[str, ...]:
    def present(channel: str, names: Iterable[str]) -> list[str]:
        products = dict.fromkeys(("", planned.product))
        return [
            name
            for name in names
            if any((channel, planned.instrument, product, name) in places for product in products)
        ]

    needs = present(planned.channel, _suppliers(planned.product, planned.name))
    step = definition(planned)
    if isinstance(step, Step) and step.from_parts:
        names = [s.name for s in FILE_STEPS if not {*step.from_parts}.isdisjoint(s.outputs)]
        for part in glued_parts(planned.channel):
            needs += [f"{part}/{name}" for name in present(part, names)]
    if isinstance(step, ProductStep | Step):
        for other in step.companions(step.typed(planned)):
            names = [
                s.name
                for s in channel_steps(other)
                if not {*step.from_companions}.isdisjoint(s.outputs)
            ]
            needs += [f"{other}/{name}" for name in present(other, names)]
    return tuple(needs)


def channel_steps(channel: str) -> tuple[SharedStep, ...]:
    """Return the steps from raw counts to the profiles of a channel."""
    return GLUE_STEPS if is_glued(channel) else FILE_STEPS
