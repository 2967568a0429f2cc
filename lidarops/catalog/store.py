"""The database of a campaign: catalog and ledger."""

from __future__ import annotations

from dataclasses import replace

from lidarops.catalog.ledger import Ledger, Run, RunStatus
from lidarops.catalog.lock import Lock


class Store(Ledger):
    """Catalog and ledger of one campaign: granules, runs and products.

    Parameters
    ----------
    url : str
        SQLAlchemy URL, such as ``sqlite:///catalog.sqlite`` or ``postgresql+psycopg://...``.
    campaign : str
        Name of the campaign; several may share a database.
    create : bool
        Whether to make the catalog if there is none.

    Raises
    ------
    CatalogError
        If the database does not exist, cannot be opened, or has another schema version.
    """

    def runs(self, *, limit: int | None = None) -> list[Run]:
        """Return the runs of the campaign, the newest first, with their stage timings.

        A run that is marked as running has died if no living process holds the lock.
        """
        runs = super().runs(limit=limit)
        if self.in_use():
            return runs
        died = {RunStatus.RUNNING: RunStatus.DIED}
        return [replace(run, status=died.get(run.status, run.status)) for run in runs]

    def in_use(self) -> bool:
        """Return whether a living process holds the lock."""
        holder = Lock(self).holder()
        return holder is not None and not holder.dead

    def others_at_work(self) -> bool:
        """Return whether a living process holds the lock of another campaign of the catalog."""
        return Lock(self).others_at_work()

    def has_dead_run(self) -> bool:
        """Return whether the process of a run that did not end has died."""
        return self.has_open_run() and not self.in_use()
