"""Find channels that a campaign requests or gives facts of, and that the files do not hold.

The rules compare one layout of channels with the campaign. `lidarops.plan.scene_plan` applies them
to a scene, `unavailable_channels` to all files of an archive: a channel that no file holds is a
typing error, one that some files lack is a lidar that was changed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts
from lidarops.plan.rules import Decisions, Rule, StepName, applied
from lidarops.plan.signal_rules import GLUED, glued_parts, joined_layout
from lidarops.records import ChannelLayout, Holding, LeftOut, Unmet

FACTS: Final = "facts"

_FIRST: Final = datetime.min.replace(tzinfo=UTC)
_LAST: Final = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Held:
    """The channels of some files, with their instrument and its facts at that time."""

    layout: tuple[ChannelLayout, ...]
    instrument: Instrument
    facts: InstrumentFacts


def glued_channels(
    layout: Sequence[ChannelLayout], instrument: Instrument
) -> tuple[ChannelLayout, ...]:
    """Return the requested glued channels that can be made from files.

    Parameters
    ----------
    layout : sequence of ChannelLayout
        Channels of the files.
    instrument : Instrument
        Its products request glued channels by names such as ``glued_532o``.

    Returns
    -------
    tuple of ChannelLayout
        Channels whose analog and photon-counting parts have one bin width; in photon-counting
        units.
    """
    return joined_layout(layout, sorted(_requested_glued(instrument)))


def _requested_glued(instrument: Instrument) -> set[str]:
    products = instrument.products
    channels = [
        name
        for settings in (products.elastic, products.multiangle)
        if settings is not None
        for name in settings.channels
    ]
    if products.signal is not None and products.signal.channels != "all":
        channels += products.signal.channels
    return {name for name in channels if name.startswith(GLUED)}


def _requested_channels(instrument: Instrument) -> dict[StepName, Sequence[str]]:
    """Return the channels that each kind of product names."""
    products = instrument.products
    return {
        kind: settings.channels
        for kind, settings in (
            (StepName.SIGNAL, products.signal),
            (StepName.HOMOGENEOUS, products.homogeneous),
            (StepName.ELASTIC, products.elastic),
            (StepName.MULTIANGLE, products.multiangle),
        )
        if settings is not None and settings.channels != "all"
    }


def _absent(held: Held) -> Decisions:
    """Yield the channels that the campaign requests and the files lack."""
    channels = {channel.name: channel for channel in held.layout}
    glued = [channel.name for channel in glued_channels(held.layout, held.instrument)]
    for kind, names in _requested_channels(held.instrument).items():
        for name in names:
            if kind is StepName.HOMOGENEOUS and name.startswith(GLUED):
                reason = "not made of glued channels: each record is fitted with its own background"
                yield LeftOut(kind, name, reason)
            elif name not in channels and name not in glued:
                yield LeftOut(kind, name, _why_absent(name, channels))


def _why_absent(name: str, channels: Mapping[str, ChannelLayout]) -> str:
    if name.startswith(GLUED):
        parts = glued_parts(name)
        if set(parts) <= set(channels):
            widths = [f"{channels[part].bin_width:g} m" for part in parts]
            return f"its analog and photon-counting channels have bins of {' and '.join(widths)}"
        missing = [part for part in parts if part not in channels]
        return f"the files hold no {' and no '.join(missing)} to glue"
    return f"the files hold no such channel, only {', '.join(channels)}"


def _unmatched_facts(held: Held) -> Decisions:
    """Yield the channels of the campaign's facts that the files lack."""
    present = [channel.name for channel in held.layout]
    for name, facts in held.facts.channels.items():
        if name not in present:
            reason = f"the facts name a channel that the files lack; they hold {', '.join(present)}"
            yield LeftOut(StepName.READ.value, name, reason)
        elif facts.lag is not None and not name.startswith("analog_"):
            reason = "a lag belongs to the facts of the analog channel"
            yield LeftOut(StepName.LAG.value, name, reason)


ABSENT: Final = Rule(
    "channel_present", StepName.READ, "Do the files hold the requested channels?", _absent
)
UNMATCHED: Final = Rule(
    "facts_fit", StepName.READ, "Do the campaign's facts fit the files?", _unmatched_facts
)
RULES: Final = (ABSENT, UNMATCHED)


def validity_edges(campaign: Campaign) -> list[datetime]:
    """Return the times at which facts of any instrument change, rising."""
    edges = {
        edge
        for instrument in campaign.instruments.values()
        for facts in instrument.facts
        for edge in (facts.valid_from, facts.valid_to)
    }
    return sorted(edges - {_FIRST, _LAST})


def lacks_channels(
    campaign: Campaign, layouts: Iterable[tuple[str, tuple[ChannelLayout, ...]]]
) -> bool:
    """Return whether files may lack a channel that the campaign names, at any time.

    Parameters
    ----------
    campaign : Campaign
    layouts : iterable of (str, tuple of ChannelLayout)
        Instruments, and the channels of their files.
    """
    return any(
        _lacking(Held(layout, owner, facts))
        for name, layout in layouts
        if (owner := campaign.instruments.get(name)) is not None
        for facts in owner.facts or (InstrumentFacts(),)
    )


def names_channels(campaign: Campaign) -> bool:
    """Return whether a campaign names channels, so that files may lack them."""
    return any(
        any(_requested_channels(instrument).values())
        or any(facts.channels for facts in instrument.facts)
        for instrument in campaign.instruments.values()
    )


def _lacking(held: Held) -> list[LeftOut]:
    """Return the channels that files lack, without misplaced facts about a lag."""
    omissions = (omission for omission in applied(RULES, held) if isinstance(omission, LeftOut))
    return [omission for omission in omissions if omission.name != StepName.LAG]


def unavailable_channels(
    campaign: Campaign,
    holdings: Iterable[Holding],
    *,
    instruments: Collection[str] | None = None,
    kinds: Collection[str] = (),
    since: datetime | None = None,
    until: datetime | None = None,
) -> tuple[Unmet, ...]:
    """Return the channels that are requested or have facts, and that files of an instrument lack.

    A requested channel is looked for in all files of its instrument, one with facts in the files
    of the period of the facts.

    Parameters
    ----------
    campaign : Campaign
    holdings : iterable of Holding
        Of all files, cut at `validity_edges`.
    instruments : collection of str, optional
        Restricts the result to these instruments.
    kinds : collection of str
        Restricts requested channels to these kinds of product; all where empty.
    since, until : datetime, optional
        Restricts facts to periods that touch [since, until).

    Returns
    -------
    tuple of Unmet
        Channels that no file holds come first.
    """
    requested = {StepName(kind) for kind in kinds} or set(StepName)
    all_files: dict[tuple[str, str], int] = defaultdict(int)
    lacking: dict[tuple[str, str, str], list[tuple[int, str]]] = defaultdict(list)
    held: dict[tuple[str, str], int] = defaultdict(int)
    for holding in holdings:
        name = holding.instrument
        instrument = campaign.instruments.get(name)
        if instrument is None or not (instruments is None or name in instruments):
            continue
        for channel_layout in holding.layout:
            held[name, channel_layout.name] += holding.files
        facts = instrument.facts_at(holding.since)
        period = _period(facts)
        for requester in {"", period}:
            all_files[name, requester] += holding.files
        touched = (since is None or facts.valid_to > since) and (
            until is None or facts.valid_from < until
        )
        reasons = {}
        for omission in _lacking(Held(holding.layout, instrument, facts)):
            if omission.rule == ABSENT.name and StepName(omission.name) in requested:
                reasons[omission.name, omission.channel] = omission.reason
            elif omission.rule == UNMATCHED.name and touched:
                reasons[period, omission.channel] = omission.reason
        for (requester, channel), reason in reasons.items():
            lacking[name, requester, channel].append((holding.files, reason))
    unmet = []
    for (name, requester, channel), counts in lacking.items():
        of_facts = requester.startswith(FACTS)
        files = sum(count for count, _ in counts)
        whole = all_files[name, requester if of_facts else ""]
        having = held[name, channel] if of_facts else whole - files
        unmet.append(Unmet(name, channel, requester, max(counts)[1], files, whole, having))
    return tuple(sorted(unmet, key=lambda request: (not request.nowhere, request.instrument)))


def _period(facts: InstrumentFacts) -> str:
    first = "" if facts.valid_from == _FIRST else f" from {facts.valid_from:%Y-%m-%dT%H:%M:%SZ}"
    last = "" if facts.valid_to == _LAST else f" to {facts.valid_to:%Y-%m-%dT%H:%M:%SZ}"
    return f"{FACTS}{first}{last}"
