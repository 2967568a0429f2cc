"""Checks of archive and catalog before a command works on them, and a catalog for the moment."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import sqlalchemy as sa

from lidarops.campaign.model import Campaign
from lidarops.catalog.database import Database, refuse_wrong_url
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


@contextmanager
def without_writing(campaign: Campaign) -> Iterator[Campaign]:
    """Yield a campaign whose catalog may be updated without a trace in its output folder.

    A catalog in a folder that does not exist, or cannot be written, is replaced by a temporary one,
    which starts as its copy. Any other is the campaign's own: its update saves the next run work.
    """
    file = Path(sa.make_url(campaign.catalog_url).database or "")
    in_file = campaign.catalog_url.startswith("sqlite") and file.name
    if not in_file or os.access(file.parent, os.W_OK):
        yield campaign
        return
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        copy = Path(folder, file.name)
        if file.exists():
            with closing(Database(campaign.catalog_url, campaign.name, create=False)) as source:
                source.copy_to(copy)
        yield campaign.model_copy(update={"catalog": f"sqlite:///{copy}"})
