"""Make the plan of a scene: what runs, channel by channel, and what is left out, with reasons.

Each stage of the pipe and each kind of product decides for itself; here its case is made. A reason
is a sentence that a user can check against the campaign file.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace

from lidarops.campaign.model import (
    Campaign,
    ChannelFacts,
    InstrumentFacts,
    channel_facts,
)
from lidarops.kinds import Scope, kind_of, kinds_of, reads_of
from lidarops.netcdf.context import product_of_path
from lidarops.records import LeftOut, Plan, PlannedStep, Scene, is_glued
from lidarops.scene.case import (
    NO_PRODUCT,
    NOT_REQUESTED,
    READ_STEP,
    REQUEST,
    ChannelCase,
    Entries,
    Entry,
    ProductCase,
    estimated_against,
    file_channels,
    joined_layout,
    missing_channels,
    named_channels,
    prepared_channels,
    product_channel,
)
from lidarops.scene.dependence import ProductKey, is_product, scene_facts
from lidarops.scene.pipe import AIR, PIPE, plan_stages
from lidarops.scene.retrieval import Derivation, NetworkCase, NetworkRetrieval, Retrieval, making
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
    if scene.members:
        entries = _network_entries(scene, campaign)
    elif scene.granules:
        entries = _entries(scene, campaign)
    else:
        entries = _month_entries(scene, campaign)
    linked = list(_linked(list(entries)))
    plan = Plan(
        scene.id,
        tuple(entry for entry in linked if isinstance(entry, PlannedStep)),
        tuple(entry for entry in linked if isinstance(entry, LeftOut)),
    )
    return _drop_unused_channels(plan) if scene.layout and not scene.members else plan


def _network_entries(scene: Scene, campaign: Campaign) -> Entries:
    for kind, request in campaign.networks[scene.instrument].requested().items():
        yield from making(kind, NetworkRetrieval).needs(NetworkCase(scene, campaign, request))


def _entries(scene: Scene, campaign: Campaign) -> Entries:
    instrument = campaign.instruments[scene.instrument]
    # A scene never spans an edge of a validity period, so the facts of its first granule hold.
    facts = scene_facts(campaign, scene)
    layout = scene.layout
    yield from missing_channels(layout, instrument, facts)
    glued = joined_layout(layout, named_channels(instrument))
    wanted = instrument.products.requested()
    requested = {kind: one for kind, one in wanted.items() if not reads_of(kind)}
    networks = _channels_of_networks(scene, campaign)
    estimated = {other.name: estimated_against(other, facts, layout) for other in layout}
    entries: list[Entry] = []
    cases: dict[str, ChannelCase] = {}
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
        case = cases[name] = ChannelCase(
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
        entries += _channel_entries(case)
    yield from entries
    # Those of all channels are decided by now.
    made = dict.fromkeys(_made(entries))
    read = {entry.channel for entry in entries if isinstance(entry, PlannedStep)}
    for kind in kinds_of(Scope.CHANNEL):
        settings = wanted.get(kind.name)
        for name, case in cases.items() if kind.reads else ():
            if settings and settings.covers(name, of_files=case.channel in layout):
                derived = list(_derived_entries(case.of_product(kind.name, settings), made))
                made |= dict.fromkeys(_made(derived))
                yield from derived
            elif name in read:
                yield replace(case, product=kind.name).leave(kind.name, NOT_REQUESTED, rule=REQUEST)


def _made(entries: Iterable[Entry]) -> Iterator[ProductKey]:
    """Yield kind and channel of the products that run."""
    for entry in entries:
        if isinstance(entry, PlannedStep) and is_product(entry):
            yield entry.name, entry.channel


def _month_entries(scene: Scene, campaign: Campaign) -> Entries:
    """Yield the entries of a month, of the channels that are requested or have products."""
    requested = campaign.instruments[scene.instrument].products.requested()
    held = dict.fromkeys(product_of_path(product.path) for product in scene.products)
    for kind in kinds_of(Scope.MONTH):
        if settings := requested.get(kind.name):
            own = [channel for read, channel in held if read in kind.reads]
            present = [name for name in own if settings.covers(name, of_files=not is_glued(name))]
            for name in dict.fromkeys([*settings.named, *present]):
                case = ChannelCase(scene, product_channel(name), InstrumentFacts(), ChannelFacts())
                yield from _derived_entries(case.of_product(kind.name, settings), held)


def _derived_entries(
    case: ProductCase[ChannelProduct], made: Collection[ProductKey]
) -> Iterator[Entry]:
    """Yield the entries of a product that is made of others, of which some are there."""
    kind, own = kind_of(case.product), case.channel.name
    channels = (own, *case.request.companions(own))
    read = [(name, channel) for channel in channels for name in kind.reads]
    missing = [f"{name} of {channel}" for name, channel in read if (name, channel) not in made]
    if missing:
        where = "the scene" if case.scene.granules else "the month"
        reason = f"made of products that {where} lacks: {', '.join(missing)}"
        yield case.leave(kind.name, reason, rule=NO_PRODUCT, number=float(len(missing)))
        return
    needs = (name if channel == own else f"{channel}/{name}" for name, channel in read)
    for entry in making(kind.name, Derivation).needs(case):
        if isinstance(entry, PlannedStep) and is_product(entry):
            yield replace(entry, needs=(*entry.needs, *needs))
        else:
            yield entry


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
        entry
        for kind in kinds_of(Scope.CHANNEL)
        if not kind.reads
        for entry in _product_entries(case, kind.name)
    ]
    needed = any(AIR in entry.needs for entry in products if isinstance(entry, PlannedStep))
    return [*stages, *([PIPE[AIR].decide(case)] if needed else []), *products]


def _product_entries(case: ChannelCase, kind: str) -> list[Entry]:
    """Return the entries of a product."""
    request = case.requests.get(kind)
    if request is None:
        return [replace(case, product=kind).leave(kind, NOT_REQUESTED, rule=REQUEST)]
    return list(making(kind, Retrieval).needs(case.of_product(kind, request)))


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
            # Products that are read are there, of the scene or of the month.
            read = reads_of(entry.product) if is_product(entry) else ()
            held = [n for n in entry.needs if n.rpartition("/")[2] in read or is_held(n, entry)]
            yield replace(entry, needs=(*held, *compared.get((entry.name, entry.channel), ())))
        else:
            yield entry


def _compared(steps: Iterable[PlannedStep]) -> dict[tuple[str, str], list[str]]:
    """Return the products that measure the same in other channels, by kind and channel."""
    wavelengths = {s.channel: s.settings["wavelength"] for s in steps if s.name == READ_STEP}
    alike: defaultdict[tuple[str, float], list[str]] = defaultdict(list)
    for step in steps:
        if is_product(step) and kind_of(step.product).common and not reads_of(step.product):
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
