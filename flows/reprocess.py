"""Flow: bring the products of a campaign up to date.

``python -m flows.reprocess catalogs/demo.yaml`` needs no set-up: without a Prefect server in the
environment it starts one for the time of the run.

One Prefect task processes all scenes that are due, with a dask cluster of its own: a task costs
tens of milliseconds and a file fewer. What is done is entered scene by scene in the ledger, so
that a task that is tried again goes on where it was.

A run after which something is refused or failed, now or before and still so, ends in the state
`flows.WITH_FAILURES`, as nobody sees the exit code of a run on a schedule.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast
from uuid import UUID

import typer
from prefect import flow, get_run_logger, runtime, task
from prefect.artifacts import (
    create_image_artifact,
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.client.schemas.objects import State, TaskRun
from prefect.states import Completed
from prefect.tasks import exponential_backoff
from prefect.utilities.annotations import quote
from pydantic import Field

from flows import WITH_FAILURES, usage
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.campaign.product_settings import Instant
from lidarops.catalog.ledger import RunStatus
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, LidarOpsError, ProductError, SceneError
from lidarops.records import ProductKind, RunRecord, SceneOutcome
from lidarops.reports import run_page
from lidarops.run import clusters
from lidarops.run.archive import Options, Result, Selection, bring_up_to_date, report_run
from lidarops.run.options import missing_report
from lidarops.run.publication import publish_products
from lidarops.run.selection import check_archive_and_catalog, check_selection, selects_no_scene

_T = TypeVar("_T")

Workers = Annotated[int, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(ge=0, le=86_400)]

_TOLD_EVERY = 15.0
"""s between reports of progress, each of which is a request to the server."""
_NAMED = 20
"""Scenes or files of one kind of trouble that the log names: each line is kept by the server."""


def _may_pass(_task: object, _run: TaskRun, state: State[Any]) -> bool:
    """Tell whether trying again may help: a store, a database or a cluster that is away."""
    # Who waits at a terminal is better told at once.
    if runtime.deployment.id is None:
        return False
    return isinstance(state.data, OSError | CatalogError | clusters.ClusterError | ProductError)


_RETRY: dict[str, Any] = {
    "retries": 4,
    "retry_delay_seconds": exponential_backoff(10),
    "retry_jitter_factor": 0.5,
    "retry_condition_fn": _may_pass,
}


def _opaque(value: _T) -> _T:
    """Keep Prefect from walking an argument in search of futures: a run holds thousands."""
    return cast("_T", quote(value))


class _Progress:
    """Publishes how far a run is, now and then."""

    def __init__(self, campaign: str) -> None:
        described = f"Granules of campaign {campaign} that are due"
        self._artifact = cast("UUID", create_progress_artifact(0.0, description=described))
        self._expected = 0
        self._done = 0
        self._next = 0.0

    def expect(self, granules: int) -> None:
        self._expected += granules

    def advance(self, outcome: SceneOutcome) -> None:
        self._done += outcome.granules
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + _TOLD_EVERY
            share = min(1.0, self._done / max(self._expected, 1))
            update_progress_artifact(self._artifact, 100.0 * share)

    def end(self) -> None:
        update_progress_artifact(self._artifact, 100.0)


@task(name="process", **_RETRY)
def process_task(
    campaign: Campaign,
    selection: Selection,
    cluster: clusters.Cluster,
    *,
    full: bool,
    wait: float,
) -> Result:
    """Bring catalog and products up to date."""
    progress = _Progress(campaign.name)
    options = Options(force=full, wait=wait, progress=progress.advance, expect=progress.expect)
    if isinstance(cluster, clusters.Local):
        options = replace(options, workers=cluster.workers, memory=cluster.memory)
    else:
        options = replace(options, cluster=partial(clusters.connect_client, cluster))
    result = bring_up_to_date(campaign, selection=selection, options=options)
    progress.end()
    if result.status is not RunStatus.FINISHED:
        raise _unfinished(result)
    return result


def _unfinished(result: Result) -> LidarOpsError:
    """Return what a run is told by that did not come to its end."""
    remedy = "run again: what is done stays done"
    if result.status is not RunStatus.STOPPED:
        return SceneError(f"the run is {result.status}", remedy=remedy)
    errors = [
        scene.error for scene in (result.record.scenes if result.record else ()) if scene.error
    ]
    told = f": {errors[-1]}" if errors else ""
    # A run gives up where products cannot be written, which may pass; see `_may_pass`.
    return ProductError(f"the run gave up, as scene after scene failed{told}", remedy=remedy)


@task(name="report", **_RETRY)
def report_task(campaign: Campaign, record: RunRecord, workers: int) -> Path:
    """Write the report of a run and publish its table, its link and its quicklook."""
    built = report_run(campaign, record, workers=workers)
    key = campaign.name.lower()
    create_table_artifact(
        key=f"{key}-products", table=run_page.summary_rows(record), description=f"Run {record.id}"
    )
    create_link_artifact(built.page.as_uri(), f"Report of run {record.id}", key=f"{key}-report")
    if built.quicklook is not None:
        # The server may stand on another machine, so the picture travels in the artifact.
        encoded = base64.b64encode(built.quicklook.read_bytes()).decode()
        create_image_artifact(image_url=f"data:image/png;base64,{encoded}", key=f"{key}-quicklook")
    return built.page


@task(name="publish", **_RETRY)
def publish_task(campaign: Campaign, url: str) -> None:
    """Bring an object store up to date with the products."""
    done = publish_products(campaign, url)
    get_run_logger().info("%s: %d sent, %d unchanged", url, len(done.uploaded), done.unchanged)


def _run_name() -> str:
    """Name a run after its campaign, what it does, and when it was due."""
    given = runtime.flow_run.parameters
    due = runtime.flow_run.scheduled_start_time or datetime.now(UTC)
    kind = "full" if given.get("full") else "incremental"
    return f"{Path(given['campaign']).stem}-{kind}-{due:%Y%m%dT%H%M}"


@flow(name="lidarops-reprocess", flow_run_name=_run_name)
def reprocess(
    campaign: str,
    archive: str | None = None,
    out: str | None = None,
    workers: Workers | None = None,
    instruments: list[str] | None = None,
    since: Instant | None = None,
    until: Instant | None = None,
    scheduler: str | None = None,
    cluster: str | None = None,
    wait: Seconds = 0.0,
    publish: str | None = None,
    catalog: str | None = None,
    stations: list[str] | None = None,
    products: list[ProductKind] | None = None,
    memory_limit: clusters.Memory | None = None,
    *,
    full: bool = False,
) -> tuple[Result, Path | None]:
    """Make the products of a campaign that are missing or stale, and the report of the run.

    Parameters
    ----------
    campaign : str
        Path of the campaign file.
    archive, out : str, optional
        As on the command line.
    workers : int, optional
        Processes; 1 where not given.
    instruments, stations, products : list of str, optional
        Only these; kinds of products.
    since, until : datetime, optional
        Only scenes that touch this interval.
    scheduler, cluster : str, optional
        As on the command line: `lidarops.run.clusters.choose_cluster`.
    wait : float
        s to wait for another run on the same archive.
    publish : str, optional
        URL of an object store that the products are copied to.
    catalog : str, optional
        As on the command line: SQLAlchemy URL of catalog and ledger.
    memory_limit : str, optional
        Most memory of a worker of this machine, such as ``2GiB``.
    full : bool
        Also what is fresh.

    Returns
    -------
    result : Result
    report : Path or None
        The HTML page; None where there was nothing to do.

    Both come as the data of a state of its own name, `flows.WITH_FAILURES`, where something is
    refused or failed; who calls the flow gets the data.
    """
    chosen = clusters.choose_cluster(
        workers=workers, scheduler=scheduler, cluster=cluster, memory=memory_limit
    )
    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    selection = _selection(instruments, stations, products, since, until)
    result = process_task(_opaque(settings), _opaque(selection), chosen, full=full, wait=wait)
    # First, as copy and report may fail.
    message = _tell_troubles(settings, result) if result.troubled else ""
    # Also where nothing was due: an earlier copy may have failed.
    if publish is not None:
        publish_task(_opaque(settings), publish)
    built = None
    if result.record is None:
        none = selects_no_scene(settings, selection)
        what = "no scene of the archive is asked for" if none else "nothing to do"
        get_run_logger().info("campaign %s: %s", settings.name, what)
        if said := missing_report(settings):
            get_run_logger().warning("campaign %s: %s", settings.name, said)
    else:
        local = chosen.workers if isinstance(chosen, clusters.Local) else 1
        built = report_task(_opaque(settings), _opaque(result.record), local)
        scenes = len(result.record.scenes)
        get_run_logger().info("run %s: %d scenes, report %s", result.record.id, scenes, built)
    if not result.troubled:
        return result, built
    # Prefect takes a state that is returned for the flow's own, and gives callers its data.
    ended: State[Any] = Completed(name=WITH_FAILURES, message=message, data=(result, built))
    return cast("tuple[Result, Path | None]", ended)


def _selection(
    instruments: list[str] | None,
    stations: list[str] | None,
    products: list[ProductKind] | None,
    since: datetime | None,
    until: datetime | None,
) -> Selection:
    return Selection(
        stations=tuple(stations or ()),
        instruments=tuple(instruments or ()),
        kinds=tuple(products or ()),
        since=since,
        until=until,
    )


def _tell_troubles(campaign: Campaign, result: Result) -> str:
    """Log what is refused or failed by name, as far as it is not too much; return the numbers."""
    scenes = () if result.record is None else result.record.scenes
    failed = {**result.failures, **{each.scene: each.error for each in scenes if each.error}}
    named = {
        "scenes failed": failed,
        "scenes left nothing to use": dict.fromkeys(
            (*result.unusable, *(each.scene for each in scenes if each.unusable)),
            "its retrievals left nothing to use",
        ),
        "files refused": _refused(campaign, result),
        "scenes can give no product": result.empty_scenes,
        "good files stand in no scene": result.set_aside,
        "channels named and in no file": {
            f"{each.channel} of {each.instrument}, for {each.requested_by}": each.reason
            for each in result.unmet
            if each.nowhere
        },
        "products without a raw file (reprocess --remove-orphans removes them)": result.lost,
    }
    logger = get_run_logger()
    for what, troubles in named.items():
        for name, reason in list(troubles.items())[:_NAMED]:
            logger.warning("%s: %s", name, reason)
        if len(troubles) > _NAMED:
            logger.warning("... and %d more %s", len(troubles) - _NAMED, what)
    numbers = {what: len(each) for what, each in named.items()}
    numbers["more on days in which nothing changed"] = result.more_unused
    told = ", ".join(f"{number} {what}" for what, number in numbers.items() if number)
    logger.warning("campaign %s: %s", campaign.name, told)
    return told


def _refused(campaign: Campaign, result: Result) -> Mapping[str, str]:
    """Return file -> reason of what is refused, by the catalog or by a scene of the run."""
    with Store(campaign.catalog_url, campaign.name) as store:
        early = store.refused()
    late = (
        []
        if result.record is None
        else [granule for scene in result.record.scenes for granule in scene.refused]
    )
    return {granule.path: granule.reason for granule in (*early, *late)}


def main(
    campaign: str,
    archive: str | None = None,
    out: str | None = None,
    catalog: Annotated[
        str | None, typer.Option(help="SQLAlchemy URL of catalog and ledger")
    ] = None,
    instrument: Annotated[list[str] | None, typer.Option(help="only this one")] = None,
    station: Annotated[list[str] | None, typer.Option(help="only this one")] = None,
    product: Annotated[list[ProductKind] | None, typer.Option(help="only this kind")] = None,
    since: Annotated[datetime | None, typer.Option(help="only scenes that end later, UTC")] = None,
    until: Annotated[datetime | None, typer.Option(help="only scenes that start before")] = None,
    workers: Annotated[int | None, typer.Option(min=1, max=10_000)] = None,
    scheduler: Annotated[str | None, typer.Option(help="address of a dask scheduler")] = None,
    cluster: Annotated[
        str | None, typer.Option(help="slurm, kubernetes, or a YAML file that describes one")
    ] = None,
    memory_limit: Annotated[
        str | None, typer.Option(help="most memory of a worker here, such as 2GiB")
    ] = None,
    wait: Annotated[float, typer.Option(min=0, help="s to wait for another run")] = 0.0,
    publish: Annotated[
        str | None, typer.Option(help="URL of a store that the products are copied to")
    ] = None,
    *,
    full: Annotated[bool, typer.Option("--force", "--full", help="also what is fresh")] = False,
) -> None:
    """Bring the products of a campaign up to date as a Prefect flow."""
    given: dict[str, Any] = {
        "campaign": campaign,
        "archive": archive,
        "out": out,
        "catalog": catalog,
        "instruments": instrument,
        "stations": station,
        "products": product,
        "since": since,
        "until": until,
        "workers": workers,
        "scheduler": scheduler,
        "cluster": cluster,
        "memory_limit": memory_limit,
        "wait": wait,
        "publish": publish,
        "full": full,
    }
    # Within the flow all of this would be told after the start of a server, in tracebacks.
    with usage.told():
        valid = reprocess.validate_parameters(given)
        settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
        of_selection = ("instruments", "stations", "products", "since", "until")
        check_selection(settings, _selection(*(valid[name] for name in of_selection)))
        clusters.choose_cluster(
            workers=workers, scheduler=scheduler, cluster=cluster, memory=memory_limit
        )
        check_archive_and_catalog(settings, archive=archive)
    with usage.told():
        result, built = reprocess(**given)
    if result.record is None:
        typer.echo("nothing to do")
    else:
        typer.echo(f"products: {result.record.products}\nreport:   {built}")
    raise typer.Exit(1 if result.troubled else 0)


if __name__ == "__main__":
    typer.run(main)
