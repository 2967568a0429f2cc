"""What is asked for of a campaign: whether there is such a thing at all."""

from __future__ import annotations

from lidarops.campaign import Campaign
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.scenes import cut
from lidarops.staleness import Selection


def refuse_unknown(campaign: Campaign, selection: Selection) -> None:
    """Refuse a selection that cannot be meant.

    Raises
    ------
    CampaignError
        If the campaign knows no such station or instrument, or the interval is empty.
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
    since, until = selection.since, selection.until
    if since is not None and until is not None and since >= until:
        raise CampaignError(
            f"no time lies from {since.isoformat()} to {until.isoformat()}",
            field="since, until",
            remedy="since must be earlier than until",
        )


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
            selection.scenes(cut(campaign, store.granules_of(day, day, dark_days=0)).scenes)
            for day in days
        )
