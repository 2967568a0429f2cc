"""The way of the data for whoever runs it: catalog -> scenes -> run -> report.

The command line and the Prefect flows call these; neither holds logic of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from lidarops.campaign import Campaign
from lidarops.catalog.scan import scan
from lidarops.catalog.store import Store
from lidarops.errors import SceneError
from lidarops.records import RunRecord
from lidarops.reports import page, record
from lidarops.scenes import Cut, cut, select


def prepare(
    campaign: Campaign,
    *,
    instruments: Sequence[str] = (),
    since: datetime | None = None,
    until: datetime | None = None,
) -> Cut:
    """Bring the catalog up to date and cut it into the scenes that are asked for.

    Parameters
    ----------
    campaign : Campaign
    instruments : sequence of str
        All where empty.
    since, until : datetime, optional
        Only scenes that touch this interval.

    Returns
    -------
    Cut

    Raises
    ------
    CatalogError
        If the archive or the catalog cannot be used.
    SceneError
        If there is no scene, or none of an instrument that is asked for.
    """
    store = Store(campaign.catalog_url, campaign.name)
    try:
        scan(campaign, store)
        everything = cut(campaign, store.granules())
    finally:
        store.close()
    chosen = select(everything.scenes, instruments=instruments, since=since, until=until)
    if not chosen:
        raise SceneError(
            f"holds {len(everything.scenes)} scenes, none of which is asked for"
            if everything.scenes
            else "holds no good file that an instrument claims as a signal",
            file=campaign.archive,
            remedy="see lidarops catalog, the patterns of the campaign, --since and --until",
        )
    return Cut(chosen, everything.set_aside)


def report_run(campaign: Campaign, run: RunRecord) -> Path:
    """Keep the record of a run and build its page.

    Returns
    -------
    Path
        Of the page.
    """
    folder = campaign.report_root / run.id
    record.save(run, folder)
    return page.build(run, folder)
