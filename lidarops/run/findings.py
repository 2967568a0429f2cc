"""Find where an archive is not what its campaign states, names and requests.

A requested channel that no file holds is a typing error, one that some files lack is a changed
lidar.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts
from lidarops.catalog.store import Verdict
from lidarops.kinds import Scope, kinds
from lidarops.raw.header import label_of
from lidarops.records import (
    FactsNote,
    Findings,
    Holding,
    IdlePattern,
    Unmade,
    Unmet,
    UnusableFile,
    glued_parts,
    is_glued,
)
from lidarops.run.day_states import FIRST, LAST, DayStates
from lidarops.run.options import Selection, requested_products
from lidarops.scene.case import (
    ABSENT,
    ANCILLARY_FILES,
    LAG_STEP,
    UNMATCHED,
    joined_layout,
    missing_channels,
    named_channels,
)

if TYPE_CHECKING:
    from lidarops.run.leftovers import Lost

FACTS: Final = "facts"
_NO_OVERLAP: Final = (
    "give neither full_overlap_range nor overlap_profile: bins near the lidar are used as they are,"
    " and a rise of the signal there is no cloud unless clean air beyond shows that"
)
_NEVER_TOGETHER: Final = (
    "its instruments have no files at the same time, on the first and the last day"
)


def find(
    states: DayStates,
    idle_patterns: Iterable[IdlePattern],
    orphans: Collection[str] = (),
    *,
    lost: Lost | None = None,
    settled: Mapping[int, Verdict] = MappingProxyType({}),
) -> Findings:
    """Return the findings on the instruments and networks that are selected.

    Parameters
    ----------
    states : DayStates
        With the catalog and ledger after the run.
    idle_patterns : iterable of IdlePattern
        Of the scan.
    orphans : collection of str
        Paths of products that would not be made again.
    lost : Lost, optional
        Raw files of products that are lost; None where no day changed and none is acknowledged.
    settled : mapping of int to Verdict
        Days that are settled. Their ancillary files can be used.
    """
    campaign, store, selection = states.campaign, states.store, states.selection
    owners = [
        name
        for name in (*campaign.instruments, *campaign.networks)
        if selection.owner(name, campaign)
    ]
    instruments = {member for name in owners for member in _members(campaign, name)}
    usable = {name for verdict in settled.values() for name in verdict.files}
    exchanged = exchanged_recorders(states.names.holdings)
    incomplete, idle = _facts_notes(states, sorted(instruments))
    return Findings(
        unmet=unavailable_channels(campaign, states.names.holdings, instruments, selection),
        file_notes=(*store.file_notes(instruments), *states.names.notes(instruments)),
        idle_patterns=tuple(one for one in idle_patterns if one.instrument in instruments),
        unusable_files=tuple(_unusable_files(states, sorted(instruments), usable)),
        unmade=tuple(_unmade(states, owners, orphans, settled)),
        incomplete_facts=(
            *incomplete,
            *(note for note in exchanged if note.instrument in instruments),
        ),
        idle_facts=(*idle, *(lost.idle if lost else ())),
        lost_files=tuple(
            found for found in (lost.findings if lost else ()) if found.instrument in instruments
        ),
    )


def _members(campaign: Campaign, owner: str) -> Collection[str]:
    """Return the instruments of a network, or the instrument itself."""
    network = campaign.networks.get(owner)
    return (owner,) if network is None else network.instruments


def _facts_notes(
    states: DayStates, instruments: Iterable[str]
) -> tuple[list[FactsNote], list[FactsNote]]:
    """Return the facts that state no overlap, and those that no file or product uses.

    Of instruments with files only.
    """
    incomplete, idle = [], []
    for name in instruments:
        instrument = states.campaign.instruments[name]
        times = [held.since for held in states.names.holdings if held.instrument == name]
        valid = [facts for facts in instrument.facts if not facts.invalid]
        for facts in valid if times else ():
            period = period_of(facts)
            if not any(facts.valid_from <= time < facts.valid_to for time in times):
                reason = "hold for no file: their period and the times of the files do not overlap"
                idle.append(FactsNote(name, period, reason))
                continue
            idle += unused_lidar_ratios(name, facts, instrument)
            if not (facts.full_overlap_range or facts.overlap_profile):
                incomplete.append(FactsNote(name, period, _NO_OVERLAP))
    return incomplete, idle


def _unusable_files(
    states: DayStates, instruments: Iterable[str], usable: Collection[str]
) -> Iterator[UnusableFile]:
    """Yield the files that facts name and that cannot be used."""
    for name in instruments:
        named = {
            (key, path): role
            for facts in states.campaign.instruments[name].facts
            for key, role in ANCILLARY_FILES.items()
            for part in (facts, *facts.channels.values())
            if (path := getattr(part, key, None)) is not None and path not in usable
        }
        for (key, path), role in named.items():
            problem = states.file_problem(path, role)
            if problem:
                yield UnusableFile(name, key, path, problem)
        station = states.campaign.instruments[name].station
        for path, problem in states.air.problems(station).items() if states.air else ():
            yield UnusableFile(name, "atmosphere", path, problem)


def _unmade(
    states: DayStates,
    owners: Iterable[str],
    orphans: Collection[str],
    settled: Mapping[int, Verdict],
) -> Iterator[Unmade]:
    """Yield the requested products that have files and that no selected scene has."""
    campaign, store, selection = states.campaign, states.store, states.selection
    missing = [
        (owner, kind, channel)
        for owner in owners
        for kind, channel in requested_products(campaign, owner)
        if (not selection.kinds or kind in selection.kinds)
        and not any(
            selection.scene(scene, campaign)
            for scene in store.scenes_with_product(owner, kind, channel, without=orphans)
        )
    ]
    if not missing:
        return
    spans = store.days_of_instruments(*selection.day_limits)
    # Within an interval, some scenes of a day may not be selected.
    limited = selection.since or selection.until
    known = {} if limited else {day: verdict.unmade for day, verdict in settled.items()}
    for owner, kind, channel in missing:
        held = {day for name in _members(campaign, owner) for day in spans.get(name, ())}
        days = sorted({min(held), max(held)}) if held else []
        if kinds()[kind].scope is Scope.MONTH:
            days = states.months(days)
        found = [_unmade_on(states, day, known).get(f"{owner} {kind} {channel}") for day in days]
        if days and None not in found:
            reasons = dict.fromkeys(reason for of_day in found for reason in of_day or ())
            reason = "; ".join(filter(None, reasons)) if reasons else _NEVER_TOGETHER
            if reason:
                yield Unmade(owner, kind, channel, reason)


def _unmade_on(
    states: DayStates, day: int, known: dict[int, dict[str, list[str]]]
) -> dict[str, list[str]]:
    """Return the requested products that no selected scene of a day gives, with the reasons.

    A day that is not among the known ones is judged, and added to them.
    """
    if day not in known:
        from lidarops.run.staleness import Judge  # noqa: PLC0415 - loads the numerics

        judge = Judge(states.campaign, states.store, selection=states.selection)
        known[day] = judge.days([day]).unmade[day]
    return known[day]


def unused_lidar_ratios(
    name: str, facts: InstrumentFacts, instrument: Instrument
) -> Iterator[FactsNote]:
    """Yield the lidar ratios of analog channels that a glued channel does not take.

    Parameters
    ----------
    name : str
        Key of the instrument.
    facts : InstrumentFacts
    instrument : Instrument
    """
    named = named_channels(instrument.products.requested)
    for glued in [name for name in named if is_glued(name)]:
        analog, photon = glued_parts(glued)
        of_parts = (facts.channels.get(part) for part in (analog, photon))
        of_analog, of_photon = (
            fact and (fact.lidar_ratio is not None or fact.lidar_ratio_profile) for fact in of_parts
        )
        if of_analog and not of_photon and analog not in named:
            reason = f"not used: {glued} takes the lidar ratio of {photon}"
            yield FactsNote(name, f"lidar ratio of {analog}", reason)


def unavailable_channels(
    campaign: Campaign,
    holdings: Iterable[Holding],
    instruments: Collection[str],
    selection: Selection,
) -> tuple[Unmet, ...]:
    """Return the channels that are requested or have facts, and that files of an instrument lack.

    A requested channel is looked for in all files of its instrument, one with facts in the files
    of the period of the facts.

    Parameters
    ----------
    campaign : Campaign
    holdings : iterable of Holding
        Of all files, cut at `validity_edges`.
    instruments : collection of str
        Restricts the result to these instruments of the campaign.
    selection : Selection
        Restricts requested channels to its kinds, and facts to periods that touch its times.

    Returns
    -------
    tuple of Unmet
        Channels that no file holds come first.
    """
    all_files, held = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    lacking: dict[tuple[str, str, str], list[tuple[int, str]]] = defaultdict(list)
    for holding in holdings:
        name, files = holding.instrument, holding.files
        if name not in instruments:
            continue
        instrument = campaign.instruments[name]
        facts = instrument.facts_at(holding.since)
        held.update({(name, channel.name): files for channel in holding.layout})
        all_files.update({(name, requester): files for requester in ("", period_of(facts))})
        for requester, channel, reason in _lacking(holding, instrument, facts, selection):
            lacking[name, requester, channel].append((files, reason))
    unmet = []
    for (name, requester, channel), counts in lacking.items():
        of_facts = requester.startswith(FACTS)
        files = sum(count for count, _ in counts)
        whole = all_files[name, requester if of_facts else ""]
        having = held[name, channel] if of_facts else whole - files
        unmet.append(Unmet(name, channel, requester, max(counts)[1], files, whole, having))
    return tuple(sorted(unmet, key=lambda request: (not request.nowhere, request.instrument)))


def _lacking(
    holding: Holding, instrument: Instrument, facts: InstrumentFacts, selection: Selection
) -> Iterator[tuple[str, str, str]]:
    """Yield what requests a channel that some files lack, the channel, and why."""
    since, until = selection.since, selection.until
    touched = (since is None or facts.valid_to > since) and (
        until is None or facts.valid_from < until
    )
    reasons = {}
    requested = instrument.products.requested
    glued = joined_layout(holding.layout, named_channels(requested))
    for left in missing_channels(holding.layout, glued, requested, facts):
        if left.rule == ABSENT and (not selection.kinds or left.name in selection.kinds):
            reasons[left.name, left.channel] = left.reason
        elif left.rule == UNMATCHED and touched and left.name != LAG_STEP:
            reasons[period_of(facts), left.channel] = left.reason
    for (requester, channel), reason in reasons.items():
        yield requester, channel, reason


def exchanged_recorders(holdings: Iterable[Holding]) -> Iterator[FactsNote]:
    """Yield the channels of which no file holds both recorders: one may have replaced the other."""
    found: dict[tuple[str, str], dict[tuple[str, str], set[int]]] = defaultdict(dict)
    for number, held in enumerate(holdings):
        for channel in held.layout:
            alike = found[held.instrument, label_of(channel.name)]
            alike.setdefault((channel.name, channel.recorder), set()).add(number)
    for (instrument, _), alike in sorted(found.items()):
        for (name, recorder), (other, new) in itertools.combinations(sorted(alike), 2):
            if name != other and new and alike[name, recorder].isdisjoint(alike[other, new]):
                reason = (
                    f"no file holds both its recorder {new} and {recorder} of {name}: if it took"
                    f" its place, state recorder: {new} for {name} in the facts from then on"
                )
                yield FactsNote(instrument, other, reason)


def period_of(facts: InstrumentFacts) -> str:
    """Return the period of facts, such as ``facts from 2024-01-01T00:00:00Z``."""
    first = "" if facts.valid_from == FIRST else f" from {facts.valid_from:%Y-%m-%dT%H:%M:%SZ}"
    last = "" if facts.valid_to == LAST else f" to {facts.valid_to:%Y-%m-%dT%H:%M:%SZ}"
    return f"{FACTS}{first}{last}"
