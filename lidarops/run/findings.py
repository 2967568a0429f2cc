"""Find where an archive is not what its campaign states, names and requests."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Verdict
from lidarops.kinds import Scope, kinds
from lidarops.records import FactsNote, Findings, IdlePattern, Role, Unmade, UnusableFile
from lidarops.run import channels
from lidarops.run.day_states import DayStates
from lidarops.run.options import requested_products

if TYPE_CHECKING:
    from lidarops.run.leftovers import Lost

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
    exchanged = channels.exchanged_recorders(states.names.holdings)
    incomplete, idle = _facts_notes(states, sorted(instruments))
    return Findings(
        unmet=channels.unavailable_channels(
            campaign, states.names.holdings, instruments, selection
        ),
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
        for facts in instrument.facts if times else ():
            period = channels.period_of(facts)
            if not any(facts.valid_from <= time < facts.valid_to for time in times):
                reason = "hold for no file: their period and the times of the files do not overlap"
                idle.append(FactsNote(name, period, reason))
                continue
            idle += channels.unused_lidar_ratios(name, facts, instrument)
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
            for fact in states.campaign.instruments[name].facts
            for key, path, role in (
                ("molecular_profile", fact.molecular_profile, Role.MOLECULAR),
                ("overlap_profile", fact.overlap_profile, Role.OVERLAP),
                *(
                    ("lidar_ratio_profile", channel.lidar_ratio_profile, Role.LIDAR_RATIO)
                    for channel in fact.channels.values()
                ),
            )
            if path is not None and path not in usable
        }
        for (key, path), role in named.items():
            problem = states.file_problem(path, role)
            if problem:
                yield UnusableFile(name, key, path, problem)


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
        days = _first_and_last_day(campaign, owner, spans)
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


def _first_and_last_day(
    campaign: Campaign, owner: str, spans: Mapping[str, tuple[int, int]]
) -> list[int]:
    """Return the first and last day on which an owner has files."""
    days = [day for name in _members(campaign, owner) for day in spans.get(name, ())]
    return sorted({min(days), max(days)}) if days else []
