"""Make the plan of a scene: what runs, channel by channel, and what is left out, with reasons.

Each stage of the pipe and each kind of product decides for itself; here its case is made. A reason
is a sentence that a user can check against the campaign file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from lidarops.campaign.model import (
    Campaign,
    ChannelFacts,
    InstrumentFacts,
    channel_facts,
)
from lidarops.kinds import Scope, kinds, kinds_of
from lidarops.netcdf.context import product_of_path
from lidarops.records import (
    ChannelLayout,
    LeftOut,
    Plan,
    PlannedStep,
    Scene,
    file_channels,
    is_glued,
    products_of,
)
from lidarops.scene.air import AirFiles
from lidarops.scene.case import (
    NO_PRODUCT,
    NOT_REQUESTED,
    READ_STEP,
    REQUEST,
    ChannelCase,
    Entries,
    Entry,
    estimated_against,
    joined_layout,
    missing_channels,
    named_channels,
    prepared_channels,
    product_channel,
)
from lidarops.scene.dependence import ProductKey, places_by_need, scene_facts
from lidarops.scene.pipe import AIR, plan_molecular, plan_stages, with_air_error
from lidarops.scene.retrieval import Derivation, NetworkCase, NetworkRetrieval, Retrieval, making
from lidarops.settings import ChannelProduct


def plan_scene(scene: Scene, campaign: Campaign, air: AirFiles | None = None) -> Plan:
    """Decide what runs for a scene.

    Parameters
    ----------
    scene : Scene
    campaign : Campaign
    air : AirFiles, optional
        Profiles of the sources of the campaign; by default they are looked up for this scene.

    Returns
    -------
    Plan
        Steps by channel in the order in which they run. It may have no steps; `left_out` then
        states why.
    """
    if scene.members:
        requested = campaign.networks[scene.instrument].requested
        entries: Entries = (
            entry
            for kind, request in requested.items()
            for entry in making(kind, NetworkRetrieval).needs(NetworkCase(scene, campaign, request))
        )
    elif scene.granules:
        if air is None and campaign.atmosphere:
            air = AirFiles(campaign)
        entries = _entries(scene, campaign, air)
    else:
        entries = _month_entries(scene, campaign)
    linked = _linked(list(entries))
    steps = tuple(entry for entry in linked if isinstance(entry, PlannedStep))
    left_out = tuple(entry for entry in linked if isinstance(entry, LeftOut))
    if scene.members or not scene.granules:
        return Plan(scene.id, steps, left_out)
    products = dict.fromkeys(step.channel for step in steps if step.product)
    used = {part for channel in products for part in prepared_channels(steps, channel)}
    unused = dict.fromkeys(step.channel for step in steps if step.channel not in used)
    reason = "no requested product of this channel can be made"
    return Plan(
        scene.id,
        tuple(step for step in steps if step.channel in used),
        (
            *(entry for entry in left_out if entry.channel not in unused or entry.product),
            *(LeftOut(READ_STEP, channel, reason, rule="channel") for channel in unused),
        ),
    )


def _entries(scene: Scene, campaign: Campaign, air: AirFiles | None) -> Entries:
    # A scene never spans an edge of a validity period, so the facts of its first granule hold.
    facts = scene_facts(campaign, scene)
    wanted = campaign.instruments[scene.instrument].products.requested
    layout = scene.layout
    glued = joined_layout(layout, named_channels(wanted))
    yield from missing_channels(layout, glued, wanted, facts)
    cases = list(_cases(scene, campaign, facts, wanted, layout, glued))
    entries = [entry for case in cases for entry in _channel_entries(case, air)]
    yield from entries
    # Those of all channels are decided by now.
    made = _made(entries)
    read = {entry.channel for entry in entries if isinstance(entry, PlannedStep)}
    for kind in kinds_of(Scope.CHANNEL):
        settings = wanted.get(kind.name)
        for of_pipe in cases if kind.reads else ():
            case = replace(of_pipe, product=kind.name, request=settings)
            name = case.channel.name
            if settings and settings.covers(name, of_files=case.channel in layout):
                derived = list(_derived_entries(case, made))
                made |= _made(derived)
                yield from derived
            elif name in read:
                yield case.leave(kind.name, NOT_REQUESTED, rule=REQUEST)


def _made(entries: Iterable[Entry]) -> dict[ProductKey, None]:
    """Return kind and channel of the products that run."""
    steps = [entry for entry in entries if isinstance(entry, PlannedStep)]
    return {(step.name, step.channel): None for step in products_of(steps)}


def _cases(
    scene: Scene,
    campaign: Campaign,
    facts: InstrumentFacts,
    wanted: Mapping[str, ChannelProduct],
    layout: Sequence[ChannelLayout],
    glued: Sequence[ChannelLayout],
) -> Iterator[ChannelCase[Any]]:
    """Yield the cases of the channels of the files, and of those glued from them."""
    requested = {kind: one for kind, one in wanted.items() if not kinds()[kind].reads}
    readers: defaultdict[str, dict[str, None]] = defaultdict(dict)
    for other in glued:
        for part in file_channels(other.name):
            readers[part][other.name] = None
    for settings in requested.values():
        for own in settings.named:
            for companion in settings.companions(own):
                readers[companion][own] = None
    channels = (*layout, *glued)
    of_channels = {channel.name: channel_facts(facts, channel.name) for channel in channels}
    for other in layout:
        readers[estimated_against(other, of_channels[other.name], layout)][other.name] = None
    for channel in channels:
        name = channel.name
        yield ChannelCase(
            scene,
            channel,
            facts,
            of_channels[name],
            None,
            all_steps=campaign.all_steps,
            requests={
                kind: settings
                for kind, settings in requested.items()
                if settings.covers(name, of_files=channel in layout)
            },
            requesters=tuple(readers[name]),
            networks=tuple(
                key
                for key, network in campaign.networks.items()
                if scene.instrument in network.instruments
                and any(name in file_channels(one.channel) for one in network.requested.values())
            ),
        )


def _month_entries(scene: Scene, campaign: Campaign) -> Entries:
    """Yield the entries of a month, of the channels that are requested or have products."""
    requested = campaign.instruments[scene.instrument].products.requested
    held = dict.fromkeys(product_of_path(product.path) for product in scene.products)
    for kind in kinds_of(Scope.MONTH):
        if settings := requested.get(kind.name):
            own = [channel for read, channel in held if read in kind.reads]
            present = [name for name in own if settings.covers(name, of_files=not is_glued(name))]
            for name in dict.fromkeys([*settings.named, *present]):
                case = ChannelCase(
                    scene,
                    product_channel(name),
                    InstrumentFacts(),
                    ChannelFacts(),
                    settings,
                    product=kind.name,
                )
                yield from _derived_entries(case, held)


def _derived_entries(
    case: ChannelCase[ChannelProduct], made: Collection[ProductKey]
) -> Iterator[Entry]:
    """Yield the entries of a product that is made of others, of which some are there."""
    kind, own = kinds()[case.product], case.channel.name
    channels = (own, *case.request.companions(own))
    read = [(name, channel) for channel in channels for name in kind.reads]
    missing = [f"{name} of {channel}" for name, channel in read if (name, channel) not in made]
    if missing:
        where = "the scene" if case.scene.granules else "the month"
        reason = f"made of products that {where} lacks: {', '.join(missing)}"
        yield case.leave(kind.name, reason, rule=NO_PRODUCT, number=float(len(missing)))
        return
    needs = (name if channel == own else f"{channel}/{name}" for name, channel in read)
    entries = list(making(kind.name, Derivation).needs(case))
    products = products_of(entries)
    for entry in entries:
        if isinstance(entry, PlannedStep) and entry in products:
            yield replace(entry, needs=(*entry.needs, *needs))
        else:
            yield entry


def _channel_entries(case: ChannelCase[Any], air: AirFiles | None) -> list[Entry]:
    """Return the entries of a channel: its conditioning, then product by product."""
    stages = plan_stages(case)
    if isinstance(stages[0], LeftOut):
        return stages
    products: list[Entry] = []
    for kind in kinds_of(Scope.CHANNEL):
        own = replace(case, product=kind.name, request=case.requests.get(kind.name))
        if own.request is not None:
            products += making(kind.name, Retrieval).needs(own)
        elif not kind.reads:
            products.append(own.leave(kind.name, NOT_REQUESTED, rule=REQUEST))
    if not any(AIR in entry.needs for entry in products if isinstance(entry, PlannedStep)):
        return [*stages, *products]
    molecular = plan_molecular(case, air)
    if (error := molecular.settings.get("relative_error")) is not None:
        products = [with_air_error(entry, error) for entry in products]
    return [*stages, molecular, *products]


def _linked(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries of a plan, of which each step names only needs that the plan holds.

    A product also needs those with which it is compared: of channels that measure the same.
    """
    steps = [entry for entry in entries if isinstance(entry, PlannedStep)]
    wavelengths = {s.channel: s.settings["wavelength"] for s in steps if s.name == READ_STEP}
    alike: defaultdict[tuple[str, float], list[str]] = defaultdict(list)
    products = products_of(steps)
    for step in products:
        kind = kinds()[step.name]
        if kind.common and not kind.reads:
            alike[kind.name, wavelengths[step.channel]].append(step.channel)
    linked: list[Entry] = []
    for entry, found in zip(entries, places_by_need(entries), strict=True):
        if isinstance(entry, LeftOut):
            linked.append(entry)
            continue
        # Products that are read are there, of the scene or of the month.
        read = kinds()[entry.name].reads if entry in products else ()
        needs = [
            need
            for need, places in zip(entry.needs, found, strict=True)
            if places or need.rpartition("/")[2] in read
        ]
        compared = alike.get((entry.name, wavelengths.get(entry.channel, 0.0)), ())
        needs += [f"{other}/{entry.name}" for other in compared if other != entry.channel]
        linked.append(replace(entry, needs=tuple(needs)))
    return linked
