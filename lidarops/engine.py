"""Run many scenes, serially or on a dask cluster.

Nothing that happens to one scene stops the others.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from lidarops import __version__
from lidarops.campaign import Campaign
from lidarops.catalog.store import Store
from lidarops.plans import plan
from lidarops.processing import Job, failed, process
from lidarops.records import (
    RunRecord,
    SceneOutcome,
    Status,
)
from lidarops.scenes import Cut

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[SceneOutcome], None]


def run(
    campaign: Campaign,
    cut: Cut,
    *,
    workers: int = 1,
    client: Client | None = None,
    profiles_per_chunk: int | None = None,
    progress: Progress | None = None,
) -> RunRecord:
    """Process scenes into products and enter the run in the ledger.

    Parameters
    ----------
    campaign : Campaign
    cut : Cut
        The scenes, from `lidarops.scenes.cut` (and `select`).
    workers : int
        Processes; 1 runs in this one, more start a dask cluster on this machine.
    client : distributed.Client, optional
        A cluster to use instead.
    profiles_per_chunk : int, optional
        Profiles a dask chunk; changes memory and speed, never a result.
    progress : callable, optional
        Called with the outcome of each scene as it ends.

    Returns
    -------
    RunRecord

    Raises
    ------
    CatalogError
        If the ledger cannot be written.
    """
    started = datetime.now(UTC)
    jobs = make_jobs(campaign, cut, profiles_per_chunk=profiles_per_chunk)
    outcomes = process_all(jobs, workers=workers, client=client, progress=progress)
    return conclude(campaign, cut, outcomes, started=started)


def make_jobs(campaign: Campaign, cut: Cut, *, profiles_per_chunk: int | None = None) -> list[Job]:
    """Plan every scene."""
    return [Job(campaign, scene, plan(scene, campaign), profiles_per_chunk) for scene in cut.scenes]


def process_all(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    client: Client | None = None,
    progress: Progress | None = None,
) -> list[SceneOutcome]:
    """Process scenes serially, on new local workers or on a cluster; see `run`."""
    outcomes: list[SceneOutcome] = []
    with _outcomes(jobs, workers, client) as stream:
        for outcome in stream:
            outcomes.append(outcome)
            if progress:
                progress(outcome)
    return outcomes


def conclude(
    campaign: Campaign, cut: Cut, outcomes: Sequence[SceneOutcome], *, started: datetime
) -> RunRecord:
    """Make the record of a run and enter it in the ledger; see `run`."""
    store = Store(campaign.catalog_url, campaign.name)
    try:
        record = RunRecord(
            id=f"{started:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}",
            campaign=campaign.name,
            title=campaign.title,
            started=started,
            finished=datetime.now(UTC),
            version=__version__,
            archive=campaign.archive,
            products=str(campaign.products_root),
            scenes=tuple(sorted(outcomes, key=lambda outcome: outcome.scene)),
            refused=(*store.granules(status=Status.REFUSED), *cut.set_aside),
            truth=_truth(campaign),
        )
        store.record_run(record)
    finally:
        store.close()
    return record


def _truth(campaign: Campaign) -> str:
    if campaign.simulation is None or not campaign.truth_path.exists():
        return ""
    return str(campaign.truth_path)


@contextmanager
def _outcomes(
    jobs: Sequence[Job], workers: int, client: Client | None
) -> Iterator[Iterator[SceneOutcome]]:
    if client is not None:
        yield _distributed(jobs, client)
    elif workers <= 1 or len(jobs) <= 1:
        yield map(process, jobs)
    else:
        with local_client(min(workers, len(jobs))) as own:
            yield _distributed(jobs, own)


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Start a dask cluster of single-threaded processes on this machine.

    netCDF4 writes from one thread of a process only, and BLAS and numba gain nothing from more.
    """
    from distributed import Client, LocalCluster  # noqa: PLC0415 - takes a second to import

    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _distributed(jobs: Sequence[Job], client: Client) -> Iterator[SceneOutcome]:
    from distributed import as_completed  # noqa: PLC0415 - takes a second to import

    # The largest scene last would keep one worker busy while the others idle.
    largest_first = sorted(jobs, key=lambda job: -sum(g.size for g in job.scene.granules))
    futures = {client.submit(process, job, pure=False): job for job in largest_first}
    for future in as_completed(futures):
        job = futures[future]
        error = future.exception()
        if error is None:
            yield future.result()
        else:
            yield failed(job, f"the worker failed: {error!r}")
        future.release()
