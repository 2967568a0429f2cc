"""Make the plan of a scene: what runs, channel by channel, and what is left out, with reasons.

Each stage of the pipe and each kind of product decides for itself; here its case is made. A reason
is a sentence that a user can check against the campaign file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from lidarops.campaign.model import Campaign, channel_facts
from lidarops.kinds import Scope, kind_of, kinds_of
from lidarops.records import LeftOut, Plan, PlannedStep, Scene
from lidarops.scene.case import NOT_REQUESTED, REQUEST, ChannelCase, Entries, Entry
from lidarops.scene.channels import (
    READ_STEP,
    estimated_against,
    file_channels,
    joined_layout,
    missing_channels,
    named_channels,
    prepared_channels,
)
from lidarops.scene.dependence import is_product
from lidarops.scene.pipe import AIR, PIPE, plan_stages
from lidarops.scene.retrieval import NetworkCase, making
from lidarops.settings import ChannelProduct


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
    linked = list(_linked(list(entries)))
    plan = Plan(
        scene.id,
        tuple(entry for entry in linked if isinstance(entry, PlannedStep)),
        tuple(entry for entry in linked if isinstance(entry, LeftOut)),
    )
    return plan if scene.members else _drop_unused_channels(plan)


def _network_entries(scene: Scene, campaign: Campaign) -> Entries:
    for kind, request in campaign.networks[scene.instrument].requested().items():
        yield from making(kind).needs(NetworkCase(scene, campaign, request))


def _entries(scene: Scene, campaign: Campaign) -> Entries:
    instrument = campaign.instruments[scene.instrument]
    # A scene never spans an edge of a validity period, so the facts of its first granule hold.
    facts = instrument.facts_at(scene.granules[0].start or scene.start)
    layout = scene.layout
    yield from missing_channels(layout, instrument, facts)
    glued = joined_layout(layout, named_channels(instrument))
    requested = instrument.products.requested()
    networks = _channels_of_networks(scene, campaign)
    estimated = {other.name: estimated_against(other, facts, layout) for other in layout}
    for channel in (*layout, *glued):
        name = channel.name
        requesters = [
            *(
                other.name
                for other in glued
                if other != channel and name in file_channels(other.name)
            ),
            *_companions_of(name, requested.values()),
            *(other for other, analog in estimated.items() if name == analog),
        ]
        yield from _channel_entries(
            ChannelCase(
                scene,
                channel,
                facts,
                channel_facts(facts, name),
                all_steps=campaign.all_steps,
                requests={
                    kind: settings
                    for kind, settings in requested.items()
                    if settings.covers(name, of_files=channel in layout)
                },
                requesters=tuple(dict.fromkeys(requesters)),
                networks=tuple(used for used, names in networks.items() if name in names),
            )
        )


def _channels_of_networks(scene: Scene, campaign: Campaign) -> dict[str, tuple[str, ...]]:
    """Return the channels of the files that each network uses of the instrument of a scene."""
    return {
        name: file_channels(settings.channel)
        for name, network in campaign.networks.items()
        if scene.instrument in network.instruments
        for settings in network.requested().values()
    }


def _companions_of(channel: str, requested: Iterable[ChannelProduct]) -> list[str]:
    """Return the channels of which a requested product is made with another channel."""
    return [
        other
        for settings in requested
        for other in settings.named
        if channel in settings.companions(other)
    ]


def _channel_entries(case: ChannelCase) -> list[Entry]:
    """Return the entries of a channel: its conditioning, then product by product."""
    stages = plan_stages(case)
    if isinstance(stages[0], LeftOut):
        return stages
    products = [
        entry for kind in kinds_of(Scope.CHANNEL) for entry in _product_entries(case, kind.name)
    ]
    needed = any(AIR in entry.needs for entry in products if isinstance(entry, PlannedStep))
    return [*stages, *([PIPE[AIR].decide(case)] if needed else []), *products]


def _product_entries(case: ChannelCase, kind: str) -> list[Entry]:
    """Return the entries of a product."""
    request = case.requests.get(kind)
    if request is None:
        return [replace(case, product=kind).leave(kind, NOT_REQUESTED, rule=REQUEST)]
    return list(making(kind).needs(case.of_product(kind, request)))


def _linked(entries: Sequence[Entry]) -> Iterator[Entry]:
    """Yield the entries of a plan, of which each step names only needs that the plan holds.

    A product also needs those with which it is compared.
    """
    places = {(e.channel, e.instrument, e.product, e.name) for e in entries}
    # A product of a whole network needs entries of every member.
    places |= {(e.channel, "", e.product, e.name) for e in entries}
    compared = _compared([entry for entry in entries if isinstance(entry, PlannedStep)])

    def is_held(need: str, step: PlannedStep) -> bool:
        channel, _, name = need.rpartition("/")
        return any(
            (channel or step.channel, step.instrument, product, name) in places
            for product in ("", step.product)
        )

    for entry in entries:
        if isinstance(entry, PlannedStep):
            held = [need for need in entry.needs if is_held(need, entry)]
            yield replace(entry, needs=(*held, *compared.get((entry.name, entry.channel), ())))
        else:
            yield entry


def _compared(steps: Iterable[PlannedStep]) -> dict[tuple[str, str], list[str]]:
    """Return the products that measure the same in other channels, by kind and channel."""
    wavelengths = {s.channel: s.settings["wavelength"] for s in steps if s.name == READ_STEP}
    alike: defaultdict[tuple[str, float], list[str]] = defaultdict(list)
    for step in steps:
        if is_product(step) and kind_of(step.product).common:
            alike[step.product, wavelengths[step.channel]].append(step.channel)
    return {
        (kind, channel): [f"{other}/{kind}" for other in channels if other != channel]
        for (kind, _), channels in alike.items()
        for channel in channels
    }


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
