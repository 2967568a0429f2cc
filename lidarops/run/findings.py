"""Find where an archive is not what its campaign states, names and requests."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.plan import availability
from lidarops.records import FactsNote, Findings, IdlePattern, Role, Unmade, UnusableFile
from lidarops.run.day_states import DayStates
from lidarops.run.selection import station_of
from lidarops.scene.channels import READ_STEP

if TYPE_CHECKING:
    from lidarops.run.leftovers import Lost
    from lidarops.run.staleness import Judgement

_NO_OVERLAP: Final = (
    "give neither full_overlap_range nor overlap_profile: bins near the lidar are used as they are,"
    " and a rise of the signal there is no cloud unless clean air beyond shows that"
)


def find(
    states: DayStates,
    idle_patterns: Iterable[IdlePattern],
    orphans: Collection[str] = (),
    *,
    lost: Lost | None = None,
    usable: Collection[str] = (),
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
    usable : collection of str
        Ancillary files that need no look.
    """
    campaign, store, selection = states.campaign, states.store, states.selection
    owners = [
        name
        for name in (*campaign.instruments, *campaign.networks)
        if selection.owner(name, station_of(campaign, name))
    ]
    instruments = {member for name in owners for member in _members(campaign, name)}
    exchanged = availability.exchanged_recorders(states.names.holdings)
    return Findings(
        unmet=availability.unavailable_channels(
            campaign,
            states.names.holdings,
            instruments=instruments,
            kinds=selection.kinds,
            since=selection.since,
            until=selection.until,
        ),
        file_notes=(*store.file_notes(instruments), *states.names.notes(instruments)),
        idle_patterns=tuple(idle for idle in idle_patterns if idle.instrument in instruments),
        unusable_files=tuple(_unusable_files(states, sorted(instruments), usable)),
        unmade=tuple(_unmade(states, owners, orphans)),
        incomplete_facts=(
            *_incomplete_facts(campaign, store, sorted(instruments)),
            *(note for note in exchanged if note.instrument in instruments),
        ),
        idle_facts=(
            *_idle_facts(campaign, store, sorted(instruments)),
            *(lost.idle if lost else ()),
        ),
        lost_files=tuple(
            found for found in (lost.findings if lost else ()) if found.instrument in instruments
        ),
    )


def _members(campaign: Campaign, owner: str) -> Collection[str]:
    """Return the instruments of a network, or the instrument itself."""
    network = campaign.networks.get(owner)
    return (owner,) if network is None else network.instruments


def _incomplete_facts(
    campaign: Campaign, store: Store, instruments: Iterable[str]
) -> Iterator[FactsNote]:
    """Yield the facts of instruments with files that state no overlap."""
    for name in instruments:
        for facts in campaign.instruments[name].facts:
            stated = facts.full_overlap_range or facts.overlap_profile
            if not stated and store.has_files(name, facts.valid_from, facts.valid_to):
                yield FactsNote(name, availability.period_of(facts), _NO_OVERLAP)


def _idle_facts(
    campaign: Campaign, store: Store, instruments: Iterable[str]
) -> Iterator[FactsNote]:
    """Yield the facts that no file or product uses, of instruments with files."""
    for name in instruments:
        instrument = campaign.instruments[name]
        if not (instrument.facts and store.has_files(name)):
            continue
        for facts in instrument.facts:
            if store.has_files(name, facts.valid_from, facts.valid_to):
                yield from availability.unused_lidar_ratios(name, facts, instrument)
            else:
                reason = "hold for no file: their period and the times of the files do not overlap"
                yield FactsNote(name, availability.period_of(facts), reason)


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


def _unmade(states: DayStates, owners: Iterable[str], orphans: Collection[str]) -> Iterator[Unmade]:
    """Yield the requested products that have files and that no selected scene has."""
    campaign, store, selection = states.campaign, states.store, states.selection
    missing = [
        (owner, kind, channel)
        for owner in owners
        for kind, channel in _requested(campaign, owner)
        if (not selection.kinds or kind in selection.kinds)
        and not any(
            selection.scene(scene, campaign)
            for scene in store.scenes_with_product(owner, kind, channel, without=orphans)
        )
    ]
    if not missing:
        return
    from lidarops.run.staleness import Judge  # noqa: PLC0415 - loads the numerics

    judge = Judge(campaign, store, selection=selection)
    spans = store.days_of_instruments(*selection.day_limits)
    judged: dict[int, Sequence[Judgement]] = {}
    for owner, kind, channel in missing:
        days = _first_and_last_day(campaign, owner, spans)
        for day in days:
            if day not in judged:
                judged[day] = judge.days([day]).judgements
        scenes = [
            scene
            for day in days
            for scene in judged[day]
            if scene.scene.instrument == owner and selection.scene(scene.scene.id, campaign)
        ]
        reason = _why_not(scenes, kind, channel)
        if days and reason:
            yield Unmade(owner, kind, channel, reason)


def _requested(campaign: Campaign, owner: str) -> Iterator[tuple[str, str]]:
    """Yield kind and channel of the requested products; an empty channel if all are requested."""
    if owner in campaign.networks:
        for kind, joint in campaign.networks[owner].requested().items():
            yield kind, joint.channel
        return
    for kind, settings in campaign.instruments[owner].products.requested().items():
        for channel in settings.named or [""]:
            yield kind, channel


def _first_and_last_day(
    campaign: Campaign, owner: str, spans: Mapping[str, tuple[int, int]]
) -> list[int]:
    """Return the first and last day on which an owner has files."""
    days = [day for name in _members(campaign, owner) for day in spans.get(name, ())]
    return sorted({min(days), max(days)}) if days else []


def _why_not(scenes: Sequence[Judgement], kind: str, channel: str) -> str:
    """Return why no scene gives a product; empty if one should, but failed or is yet to run."""
    if not scenes:
        return "its instruments have no files at the same time, on the first and the last day"
    from lidarops.scene import dependence  # noqa: PLC0415 - loads the numerics
    from lidarops.scene.case import REQUEST  # noqa: PLC0415

    reasons: dict[str, None] = {}
    for judged in scenes:
        planned = dependence.planned_products(judged.requested)
        if any(made == kind and channel in ("", name) for made, name in planned):
            return ""
        reasons |= dict.fromkeys(
            left.reason
            for left in judged.requested.left_out
            if left.name in (kind, READ_STEP)
            and channel in ("", left.channel)
            and left.rule != REQUEST
        )
    return "; ".join(reasons)
