"""What a campaign asks for, or tells facts of, and the files do not hold.

The rules look at one layout of channels. Of single scenes they are asked by `lidarops.plan.scene_plan`; of
all files of an archive by `unavailable`, as a name that no file has is a slip of the pen, and one that
some have and others lack is a lidar that was changed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts
from lidarops.plan.signal_rules import (
    GLUED,
    Decisions,
    Rule,
    StepName,
    applied,
    joined_channels,
    parts_of,
)
from lidarops.records import ChannelLayout, Holding, LeftOut, ProductKind, Unmet

FACTS: Final = "facts"

_FIRST: Final = datetime.min.replace(tzinfo=UTC)
_LAST: Final = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Held:
    """What files hold, and what the campaign says of their instrument at their time."""

    layout: tuple[ChannelLayout, ...]
    instrument: Instrument
    facts: InstrumentFacts


def glued_channels(
    layout: Sequence[ChannelLayout], instrument: Instrument
) -> tuple[ChannelLayout, ...]:
    """Return the channels that files give by joining analog and photon counting ones.

    Parameters
    ----------
    layout : sequence of ChannelLayout
        Of the files.
    instrument : Instrument
        Whose products ask for channels named ``glued_`` and a label.

    Returns
    -------
    tuple of ChannelLayout
        Those of which the files hold both parts on one range grid; in photon counting units.
    """
    return joined_channels(layout, sorted(_asked_glued(instrument)))


def _asked_glued(instrument: Instrument) -> set[str]:
    products = instrument.products
    asked = [
        name
        for wanted in (products.elastic, products.multiangle)
        if wanted is not None
        for name in wanted.channels
    ]
    if products.signal is not None and products.signal.channels != "all":
        asked += products.signal.channels
    return {name for name in asked if name.startswith(GLUED)}


def _asked(instrument: Instrument) -> dict[StepName, Sequence[str]]:
    """Return the channels that each kind of product names."""
    products = instrument.products
    return {
        kind: wanted.channels
        for kind, wanted in (
            (StepName.SIGNAL, products.signal),
            (StepName.HOMOGENEOUS, products.homogeneous),
            (StepName.ELASTIC, products.elastic),
            (StepName.MULTIANGLE, products.multiangle),
        )
        if wanted is not None and wanted.channels != "all"
    }


def _absent(held: Held) -> Decisions:
    """Name the channels that the campaign wants and the files lack."""
    channels = {channel.name: channel for channel in held.layout}
    made = [channel.name for channel in glued_channels(held.layout, held.instrument)]
    for kind, names in _asked(held.instrument).items():
        for name in names:
            if kind is StepName.HOMOGENEOUS and name.startswith(GLUED):
                yield LeftOut(kind.value, name, "each record is fitted with its own background")
            elif name not in channels and name not in made:
                yield LeftOut(kind.value, name, _why_absent(name, channels))


def _why_absent(name: str, channels: Mapping[str, ChannelLayout]) -> str:
    if name.startswith(GLUED):
        parts = parts_of(name)
        if set(parts) <= set(channels):
            widths = [f"{channels[part].bin_width:g} m" for part in parts]
            return f"its parts have bins of {' and '.join(widths)}"
        missing = [part for part in parts if part not in channels]
        return f"the files hold no {' and no '.join(missing)} to join"
    return f"the files hold no such channel, only {', '.join(channels)}"


def _strange_facts(held: Held) -> Decisions:
    """Name the channels of which the campaign tells facts, and which the files lack."""
    present = [channel.name for channel in held.layout]
    for name, known in held.facts.channels.items():
        if name not in present:
            reason = f"facts of a channel that the files do not hold, only {', '.join(present)}"
            yield LeftOut(StepName.READ.value, name, reason)
        elif known.lag is not None and not name.startswith("analog_"):
            yield LeftOut(StepName.LAG.value, name, "a lag is a fact of the analog channel")


ABSENT: Final = Rule(
    "channel_present", StepName.READ, "Do the files hold what is asked for?", _absent
)
STRANGE: Final = Rule(
    "facts_fit", StepName.READ, "Do the campaign's facts fit the files?", _strange_facts
)
RULES: Final = (ABSENT, STRANGE)


def edges(campaign: Campaign) -> list[datetime]:
    """Return the times at which facts of some instrument change, rising."""
    found = {
        edge
        for instrument in campaign.instruments.values()
        for facts in instrument.facts
        for edge in (facts.valid_from, facts.valid_to)
    }
    return sorted(found - {_FIRST, _LAST})


def lacks_any(campaign: Campaign, layouts: Iterable[tuple[str, tuple[ChannelLayout, ...]]]) -> bool:
    """Return whether some files may lack something that the campaign names, at whatever time.

    Parameters
    ----------
    campaign : Campaign
    layouts : iterable of (str, tuple of ChannelLayout)
        Instruments, and what files of theirs hold.
    """
    return any(
        _lacked(Held(layout, owner, facts))
        for name, layout in layouts
        if (owner := campaign.instruments.get(name)) is not None
        for facts in owner.facts or (InstrumentFacts(),)
    )


def names_any(campaign: Campaign) -> bool:
    """Return whether a campaign names channels, so that files may lack them."""
    return any(
        any(_asked(instrument).values()) or any(facts.channels for facts in instrument.facts)
        for instrument in campaign.instruments.values()
    )


def _lacked(held: Held) -> list[LeftOut]:
    """Return what files lack; not what they hold and cannot be used as it is told."""
    found = (each for each in applied(RULES, held) if isinstance(each, LeftOut))
    return [left for left in found if left.name != StepName.LAG]


def unavailable(
    campaign: Campaign,
    holdings: Iterable[Holding],
    *,
    instruments: Collection[str] | None = None,
    kinds: Collection[ProductKind] = (),
    since: datetime | None = None,
    until: datetime | None = None,
) -> tuple[Unmet, ...]:
    """Return what is asked for, or told of, and not in the files of an instrument.

    Parameters
    ----------
    campaign : Campaign
    holdings : iterable of Holding
        Of all files, cut at `edges`: whatever is asked for, a channel is looked for in all files
        of its instrument, and one of facts in those of their period.
    instruments : collection of str, optional
        Only of these.
    kinds : collection of ProductKind
        Only what these ask for, and facts; all where empty.
    since, until : datetime, optional
        Only facts whose period touches [since, until).

    Returns
    -------
    tuple of Unmet
        Those that no file has first.
    """
    asked = {StepName(kind.value) for kind in kinds} or set(StepName)
    all_files: dict[tuple[str, str], int] = defaultdict(int)
    lacking: dict[tuple[str, str, str], list[tuple[int, str]]] = defaultdict(list)
    held: dict[tuple[str, str], int] = defaultdict(int)
    for each in holdings:
        instrument = campaign.instruments.get(each.instrument)
        if instrument is None or not (instruments is None or each.instrument in instruments):
            continue
        for there in each.layout:
            held[each.instrument, there.name] += each.files
        facts = instrument.facts_at(each.since)
        period = _period(facts)
        for word in {"", period}:
            all_files[each.instrument, word] += each.files
        touched = (since is None or facts.valid_to > since) and (
            until is None or facts.valid_from < until
        )
        told = {}
        for left in _lacked(Held(each.layout, instrument, facts)):
            if left.rule == ABSENT.name and StepName(left.name) in asked:
                told[left.name, left.channel] = left.reason
            elif left.rule == STRANGE.name and touched:
                told[period, left.channel] = left.reason
        for (word, channel), reason in told.items():
            lacking[each.instrument, word, channel].append((each.files, reason))
    found = []
    for (name, word, channel), without in lacking.items():
        of_facts = word.startswith(FACTS)
        files, whole = sum(count for count, _ in without), all_files[name, word if of_facts else ""]
        holding = held[name, channel] if of_facts else whole - files
        found.append(Unmet(name, channel, word, max(without)[1], files, whole, holding))
    return tuple(sorted(found, key=lambda each: (not each.nowhere, each.instrument)))


def _period(facts: InstrumentFacts) -> str:
    first = "" if facts.valid_from == _FIRST else f" from {facts.valid_from:%Y-%m-%dT%H:%M:%SZ}"
    last = "" if facts.valid_to == _LAST else f" to {facts.valid_to:%Y-%m-%dT%H:%M:%SZ}"
    return f"{FACTS}{first}{last}"
