"""Find where an archive is not what its campaign states, names and requests."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.plan import availability
from lidarops.records import Findings, IdlePattern, Role, Unmade, Unmet, UnusableFile
from lidarops.run.selection import Selection, station_of
from lidarops.run.staleness import Judge
from lidarops.steps import dependence
from lidarops.steps.step import REQUEST

_DAYS_EXAMINED: Final = 3
"""Days whose plans are searched for the reason why a product is never made."""


def find(
    judge: Judge, store: Store, selection: Selection, idle_patterns: Iterable[IdlePattern]
) -> Findings:
    """Return the findings on the selected instruments and networks.

    Parameters
    ----------
    judge : Judge
        Of the campaign.
    store : Store
        Its catalog and ledger, after the run.
    selection : Selection
    idle_patterns : iterable of IdlePattern
        Of the scan.
    """
    campaign = judge.campaign
    owners = [
        name
        for name in (*campaign.instruments, *campaign.networks)
        if selection.owner(name, station_of(campaign, name))
    ]
    instruments = {member for name in owners for member in _members(campaign, name)}
    return Findings(
        unmet=_unmet(campaign, store, selection, instruments),
        file_notes=store.file_notes(instruments),
        idle_patterns=tuple(idle for idle in idle_patterns if idle.instrument in instruments),
        unusable_files=tuple(_unusable_files(judge, sorted(instruments))),
        unmade=tuple(_unmade(judge, store, selection, owners)),
    )


def _members(campaign: Campaign, owner: str) -> Collection[str]:
    """Return the instruments of a network, or the instrument itself."""
    network = campaign.networks.get(owner)
    return (owner,) if network is None else network.instruments


def _unmet(
    campaign: Campaign, store: Store, selection: Selection, instruments: Collection[str]
) -> tuple[Unmet, ...]:
    """Return the channels that products or facts name and files do not hold."""
    # Usually no file lacks anything, which is faster to find out than to count files.
    if not (
        availability.names_channels(campaign)
        and availability.lacks_channels(campaign, store.layouts())
    ):
        return ()
    return availability.unavailable_channels(
        campaign,
        store.holdings(availability.validity_edges(campaign)),
        instruments=instruments,
        kinds=selection.kinds,
        since=selection.since,
        until=selection.until,
    )


def _unusable_files(judge: Judge, instruments: Iterable[str]) -> Iterator[UnusableFile]:
    """Yield the files that facts name and that cannot be used."""
    for name in instruments:
        named = {
            (key, path): role
            for fact in judge.campaign.instruments[name].facts
            for key, path, role in (
                ("molecular_profile", fact.molecular_profile, Role.MOLECULAR),
                ("overlap_profile", fact.overlap_profile, Role.OVERLAP),
            )
            if path is not None
        }
        for (key, path), role in named.items():
            problem = judge.file_problem(path, role)
            if problem:
                yield UnusableFile(name, key, path, problem)


def _unmade(
    judge: Judge, store: Store, selection: Selection, owners: Iterable[str]
) -> Iterator[Unmade]:
    """Yield the kinds that are requested, have files, and are made in no scene of the selection."""
    campaign = judge.campaign
    have_files = {instrument for instrument, _ in store.layouts()}
    days: list[int] | None = None
    for owner in owners:
        for kind in _requested(campaign, owner):
            folder = f"{station_of(campaign, owner)}/{owner}/{kind}/"
            if (selection.kinds and kind not in selection.kinds) or not have_files.intersection(
                _members(campaign, owner)
            ):
                continue
            if days is None:
                days = selection.days(sorted({day_sum.day for day_sum in store.day_sums()}))
            if days and not store.has_product(folder, days[0], days[-1]):
                reason = _why_never(judge, days, owner, kind)
                if reason:
                    yield Unmade(owner, kind, reason)


def _requested(campaign: Campaign, owner: str) -> Collection[str]:
    if owner in campaign.networks:
        return campaign.networks[owner].requested().keys()
    return campaign.instruments[owner].products.requested().keys()


def _why_never(judge: Judge, days: list[int], owner: str, kind: str) -> str:
    """Return why some scenes of an owner do not give a kind; empty if one should, but failed."""
    reasons: dict[str, None] = {}
    examined = {days[0], days[len(days) // 2], days[-1]}
    for day in sorted(examined)[:_DAYS_EXAMINED]:
        for judged in judge.days([day]).judgements:
            if judged.scene.instrument != owner:
                continue
            if any(made == kind for made, _ in dependence.planned_products(judged.requested)):
                return ""
            reasons |= dict.fromkeys(
                left.reason
                for left in judged.requested.left_out
                if left.name == kind and left.rule != REQUEST
            )
    return "; ".join(reasons)
