"""Catalog and ledger of a campaign in one database."""

from __future__ import annotations

from dataclasses import replace

from lidarops.catalog.ledger import Ledger, Run, RunStatus
from lidarops.catalog.lock import Lock


class Store(Ledger):
    """The catalog and ledger of one campaign: granules, and what was made from them.

    Parameters
    ----------
    url : str
        SQLAlchemy URL, such as ``sqlite:///catalog.sqlite`` or ``postgresql+psycopg://...``.
    campaign : str
        Name of the campaign; several may share a database.
    create : bool
        Whether to make the catalog where there is none.

    Raises
    ------
    CatalogError
        If the database cannot be opened, or is of another version of lidarops, or is not there.
    """

    def runs(self, *, limit: int | None = None) -> list[Run]:
        """Return the runs of the campaign, the newest first, with their stage timings.

        One that its process did not end, and that no living one can be at work on, has died.
        """
        found = super().runs(limit=limit)
        holder = Lock(self).holder()
        if holder is not None and not holder.dead:
            return found
        died = {RunStatus.RUNNING: RunStatus.DIED}
        return [replace(run, status=died.get(run.status, run.status)) for run in found]
