"""Checks of archive and catalog before a command loads what it needs to work on them."""

from __future__ import annotations

from lidarops.campaign.model import Campaign
from lidarops.catalog.database import refuse_wrong_url
from lidarops.catalog.lock import Lock
from lidarops.catalog.sources import Source
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError


def check_archive_and_catalog(campaign: Campaign, *, archive: str | None) -> None:
    """Refuse an archive that does not exist and a catalog whose URL names no database.

    Parameters
    ----------
    campaign : Campaign
        As loaded.
    archive : str, optional
        Archive that overrides the campaign file. It is wrong use if this one does not exist; the
        archive of a campaign file may be temporarily unavailable.

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


def refuse_held_catalog(campaign: Campaign) -> None:
    """Refuse a catalog that a living process holds.

    Raises
    ------
    CatalogError
        Names the holder.
    """
    try:
        store = Store(campaign.catalog_url, campaign.name, create=False)
    except CatalogError:
        # There is none yet, or the run says what is wrong with it.
        return
    with store:
        if store.in_use():
            raise Lock(store).refusal()
