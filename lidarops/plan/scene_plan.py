"""Make the plan of a scene: the graph of the steps that run, and those left out, with reasons.

Each step decides for itself; here its case is made, and steps are decided only where a product
needs them. A reason is a sentence that a user can check against the campaign file.
"""

from __future__ import annotations

from collections.abc import Iterator

from lidarops.campaign.model import Campaign, Instrument, channel_facts
from lidarops.kinds import Scope, kinds_of
from lidarops.plan import availability
from lidarops.records import LeftOut, Plan, PlannedStep, Scene
from lidarops.steps.case import ChannelCase
from lidarops.steps.channels import (
    READ_STEP,
    estimated_against,
    file_channels,
    joined_layout,
    prepared_channels,
)
from lidarops.steps.registry import (
    SHARED,
    channel_steps,
    needed_steps,
    network_step,
    product_step,
    with_needs,
)
from lidarops.steps.step import NOT_REQUESTED, REQUEST, Leave

Entries = Iterator[PlannedStep | LeftOut]


def plan_scene(scene: Scene, campaign: Campaign) -> Plan:
    """Decide what runs for a scene.

    Parameters
    ----------
    scene : Scene
    campaign : Campaign

    Returns
    -------
    Plan
        Steps by channel in the order in which they run. It may have no steps; `left_out` then
        states why.
    """
    entries = _network_entries(scene, campaign) if scene.members else _entries(scene, campaign)
    linked = with_needs(entries)
    plan = Plan(
        scene.id,
        tuple(entry for entry in linked if isinstance(entry, PlannedStep)),
        tuple(entry for entry in linked if isinstance(entry, LeftOut)),
    )
    return plan if scene.members else _drop_unused_channels(plan)


def _network_entries(scene: Scene, campaign: Campaign) -> Entries:
    for kind, request in campaign.networks[scene.instrument].requested().items():
        yield from network_step(kind).plan(scene, campaign, request)


def _entries(scene: Scene, campaign: Campaign) -> Entries:
    instrument = campaign.instruments[scene.instrument]
    # A scene never spans an edge of a validity period, so the facts of its first granule hold.
    facts = instrument.facts_at(scene.granules[0].start or scene.start)
    yield from availability.missing_channels(scene.layout, instrument, facts)
    glued = joined_layout(scene.layout, availability.named_channels(instrument))
    networks = {
        name: settings.channel
        for name, network in campaign.networks.items()
        if scene.instrument in network.instruments
        for settings in network.requested().values()
    }
    for channel in (*scene.layout, *glued):
        yield from _channel_entries(
            ChannelCase(
                scene,
                channel,
                facts,
                channel_facts(facts, channel.name),
                all_steps=campaign.all_steps,
                requests={
                    kind: settings
                    for kind, settings in instrument.products.requested().items()
                    if settings.covers(channel.name, of_files=channel in scene.layout)
                },
                requesters=tuple(
                    dict.fromkeys(
                        (
                            *(
                                other.name
                                for other in glued
                                if other != channel and channel.name in file_channels(other.name)
                            ),
                            *_companions_of(channel.name, instrument),
                            *(
                                other.name
                                for other in scene.layout
                                if channel.name == estimated_against(other, facts, scene.layout)
                            ),
                        )
                    )
                ),
                networks=tuple(
                    name for name, used in networks.items() if channel.name in file_channels(used)
                ),
            )
        )


def _companions_of(channel: str, instrument: Instrument) -> list[str]:
    """Return the channels of which a requested product is made with another channel."""
    return [
        other
        for settings in instrument.products.requested().values()
        for other in settings.named
        if channel in settings.companions(other)
    ]


def _channel_entries(case: ChannelCase) -> Entries:
    """Yield the entries of a channel: its conditioning, then product by product."""
    read, *conditioning = channel_steps(case.channel.name)
    reading = list(read.entries(case))
    yield from reading
    if not any(isinstance(entry, PlannedStep) for entry in reading):
        return
    for step in conditioning:
        yield from step.entries(case)
    made = {kind.name: list(_product_entries(case, kind.name)) for kind in kinds_of(Scope.CHANNEL)}
    needed = {
        name
        for kind, entries in made.items()
        if any(isinstance(entry, PlannedStep) for entry in entries)
        for name in needed_steps(kind)
    }
    for step in SHARED:
        if step.name in needed:
            yield from step.entries(case)
    for entries in made.values():
        yield from entries


def _product_entries(case: ChannelCase, kind: str) -> Entries:
    """Yield the entries of a product; its other steps only where the product is made."""
    of_product = case.of_product(kind, case.requests.get(kind))
    if of_product.request is None:
        yield of_product.entry(kind, Leave(NOT_REQUESTED, rule=REQUEST))
        return
    making = product_step(kind)
    product = list(making.entries(of_product))
    if any(isinstance(entry, PlannedStep) for entry in product):
        for part in making.parts:
            yield from part.entries(of_product)
    yield from product


def _drop_unused_channels(plan: Plan) -> Plan:
    """Return a plan without the channels of which no product is made."""
    used = {
        part
        for step in plan.steps
        if step.product
        for part in prepared_channels(plan.steps, step.channel)
    }
    unused = {step.channel for step in plan.steps} - used
    reason = "no requested product of this channel can be made"
    return Plan(
        plan.scene,
        tuple(step for step in plan.steps if step.channel not in unused),
        (
            *(
                omission
                for omission in plan.left_out
                if omission.channel not in unused or omission.product
            ),
            *(
                LeftOut(READ_STEP, channel, reason, rule="channel")
                for channel in dict.fromkeys(step.channel for step in plan.steps)
                if channel in unused
            ),
        ),
    )
