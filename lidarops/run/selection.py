"""What is asked for: whether there is such a thing at all."""

from __future__ import annotations

from lidarops.campaign.model import Campaign
from lidarops.catalog.database import refuse_wrong_url
from lidarops.catalog.sources import Source
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError, CatalogError
from lidarops.plan import availability
from lidarops.plan.scenes import cut_scenes
from lidarops.records import ProductKind, Unmet
from lidarops.run.staleness import Selection


def refuse_unknown(campaign: Campaign, selection: Selection) -> None:
    """Refuse a selection that cannot be meant.

    Raises
    ------
    CampaignError
        If the campaign knows no such station or instrument, or the interval is empty, or nothing
        of it is asked for such a kind of product.
    """
    known = {
        "instrument": (selection.instruments, (*campaign.instruments, *campaign.networks)),
        "station": (selection.stations, (*campaign.stations, *campaign.networks)),
    }
    for word, (asked, there) in known.items():
        for name in asked:
            if name not in there:
                raise CampaignError(
                    f"the campaign has no {word} {name!r}",
                    remedy=f"known: {', '.join(sorted(set(there)))}",
                )
    kinds = _kinds(campaign)
    for kind in selection.kinds:
        if kind not in kinds:
            raise CampaignError(
                f"no instrument or network of the campaign is asked for product {kind.value!r}",
                remedy=f"asked for: {', '.join(kinds) or 'none'}",
            )
    since, until = selection.since, selection.until
    if since is not None and until is not None and since >= until:
        raise CampaignError(
            f"no time lies from {since.isoformat()} to {until.isoformat()}",
            field="since, until",
            remedy="since must be earlier than until",
        )


def _kinds(campaign: Campaign) -> list[ProductKind]:
    """Return the kinds of product that a campaign asks for."""
    wanted = [each.products for each in campaign.instruments.values()]
    return [
        kind
        for kind in ProductKind
        if any(getattr(each, kind.value, None) is not None for each in wanted)
        or (kind is ProductKind.VISIBILITY and campaign.networks)
    ]


def refuse_nowhere(campaign: Campaign, *, archive: str | None) -> None:
    """Refuse an archive that is not there and a catalog that has no URL of a database.

    Parameters
    ----------
    campaign : Campaign
        As loaded.
    archive : str, optional
        What was given beside the campaign file: it is wrong use where that is not there, while
        the archive of a file may be away for a while.

    Raises
    ------
    CatalogError
    """
    refuse_wrong_url(campaign.catalog_url)
    try:
        Source.of(campaign.archive).refuse_absent()
    except CatalogError as error:
        error.wrong_use = error.wrong_use or bool(archive)
        raise


def none(campaign: Campaign, selection: Selection) -> bool:
    """Return whether something is asked for in which no scene of the catalog lies.

    Parameters
    ----------
    campaign : Campaign
        With a catalog.
    selection : Selection
    """
    if selection.everything:
        return False
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        days = selection.days(sorted({each.day for each in store.day_sums()}))
        # No scene is longer than a day, and the first one that is asked for answers.
        return not any(
            selection.scenes(cut_scenes(campaign, store.granules_of(day, day, dark_days=0)).scenes)
            for day in days
        )


def unmet_requests(campaign: Campaign, store: Store, selection: Selection) -> tuple[Unmet, ...]:
    """Return what is asked for, or told facts of, and not in the files.

    Parameters
    ----------
    campaign : Campaign
    store : Store
        Its catalog.
    selection : Selection
        Only of instruments, and of members of networks, that are asked for.
    """
    # To count files takes longer than to find that none lacks anything, as is usual.
    if not (availability.names_any(campaign) and availability.lacks_any(campaign, store.layouts())):
        return ()
    owners: dict[str, tuple[str, ...]] = {name: (name,) for name in campaign.instruments}
    owners |= {name: tuple(each.instruments) for name, each in campaign.networks.items()}
    chosen = {
        member
        for name, members in owners.items()
        for member in members
        if (not selection.instruments or name in selection.instruments)
        and (not selection.stations or _station(campaign, name) in selection.stations)
    }
    return availability.unavailable(
        campaign,
        store.holdings(availability.edges(campaign)),
        instruments=chosen,
        kinds=selection.kinds,
        since=selection.since,
        until=selection.until,
    )


def _station(campaign: Campaign, name: str) -> str:
    owner = campaign.instruments.get(name)
    return owner.station if owner else name
