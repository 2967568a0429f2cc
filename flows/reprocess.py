"""Flow: bring the products of a campaign up to date.

``python -m flows.reprocess catalogs/demo.yaml`` needs no set-up: if the environment names no
Prefect server, it starts a temporary one.

One Prefect task processes all stale scenes, with its own dask cluster. Each batch of scenes is a
task run within it, because a task costs tens of milliseconds, more than a file. The ledger records
every scene as it ends, so that a retried task continues where it stopped.

If files are refused or scenes failed, in this run or since an earlier one, the run ends in the
state `flows.WITH_FAILURES`, because nobody sees the exit code of a scheduled run.
"""

from __future__ import annotations

import base64
import logging
import time
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import count
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
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.events import emit_event
from prefect.states import Completed
from prefect.tasks import exponential_backoff
from prefect.utilities.annotations import quote
from pydantic import AfterValidator, Field

from flows import NO_FILES, WITH_FAILURES
from flows.start import (
    CatalogUrl,
    Location,
    catalog_parameter,
    keep_main_module_out,
    plain_errors,
    tie_to_this_process,
)
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.database import check_archive_and_catalog
from lidarops.catalog.product_files import publish_products
from lidarops.catalog.store import RunStatus, Store
from lidarops.cli import options
from lidarops.errors import CatalogError, LidarOpsError, ProductError, SceneError
from lidarops.figures.wording import counted
from lidarops.kinds import kinds
from lidarops.records import ACKNOWLEDGED, Role, RunRecord, SceneOutcome, day_of
from lidarops.reports import run_tables
from lidarops.reports.findings import finding_rows
from lidarops.run import clusters
from lidarops.run.archive import (
    Options,
    Result,
    Selection,
    bring_up_to_date,
    refused_files,
    report_earlier_runs,
    report_run,
)
from lidarops.run.options import (
    NO_USABLE_VALUE,
    Batch,
    check_selection,
    selected,
    selects_no_scene,
)
from lidarops.settings import Instant

_T = TypeVar("_T")

Workers = Annotated[int, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(ge=0, le=86_400)]
Hours = Annotated[float, Field(gt=0, le=8_784)]


def _known_kind(name: str) -> str:
    if name not in kinds():
        raise ValueError(f"{name!r} is no kind of product; the kinds are {', '.join(kinds())}")
    return name


KindName = Annotated[
    str, AfterValidator(_known_kind), Field(json_schema_extra={"enum": list(kinds())})
]

_LEVELS = (logging.INFO, logging.WARNING)
_PROGRESS_INTERVAL = 15.0
"""s between reports of progress; each is a request to the server."""
_MOST_NAMED = 20
"""Scenes or files of one kind of problem that the log names; the server stores every line."""


def _may_pass(_task: object, _run: TaskRun, state: State[Any]) -> bool:
    """Return whether a retry may help, e.g. if a store, database or cluster is unavailable."""
    # A user at a terminal should see the error at once.
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
    """Keep Prefect from searching an argument for futures: a run holds thousands of objects."""
    return cast("_T", quote(value))


class _Progress:
    """Publishes the progress of a run."""

    def __init__(self, campaign: str) -> None:
        description = f"Granules of stale scenes of campaign {campaign}"
        self._artifact = cast("UUID", create_progress_artifact(0.0, description=description))
        self._expected = 0
        self._done = 0
        self._next = 0.0

    def expect(self, granules: int) -> None:
        self._expected += granules

    def advance(self, outcome: SceneOutcome) -> None:
        self._done += outcome.granules
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + _PROGRESS_INTERVAL
            share = min(1.0, self._done / max(self._expected, 1))
            update_progress_artifact(self._artifact, 100.0 * share)

    def end(self) -> None:
        update_progress_artifact(self._artifact, 100.0)


@task(name="scenes", task_run_name="batch {number}", cache_policy=NO_CACHE)
def batch_task(number: int, carry_out: Batch) -> int:
    """Carry out a batch of scenes, log how each of them ended, and return their number."""
    scenes = carry_out()
    logger = get_run_logger()
    for scene in scenes:
        ended = scene.error or counted(len(scene.products), "product")
        logger.log(_LEVELS[bool(scene.error)], "%s: %s", scene.scene, ended)
    logger.info("batch %d: %s", number, counted(len(scenes), "scene"))
    return len(scenes)


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
    progress, numbers = _Progress(campaign.name), count(1)
    chosen = Options(
        force=full,
        wait=wait,
        journal=True,
        progress=progress.advance,
        expect=progress.expect,
        batch=lambda carry_out: batch_task(next(numbers), _opaque(carry_out)),
    )
    if isinstance(cluster, clusters.Local):
        chosen = replace(chosen, workers=cluster.workers, memory=cluster.memory)
    else:
        chosen = replace(chosen, cluster=partial(clusters.connect_client, cluster))
    result = bring_up_to_date(campaign, selection=selection, options=chosen)
    progress.end()
    if result.status is not RunStatus.FINISHED:
        raise _unfinished(result)
    return result


def _unfinished(result: Result) -> LidarOpsError:
    """Return the error of a run that did not finish."""
    remedy = "run again: finished scenes are kept"
    if result.status is not RunStatus.STOPPED:
        return SceneError(f"the run is {result.status}", remedy=remedy)
    errors = [scene.error for scene in result.scenes if scene.error]
    last_error = f": {errors[-1]}" if errors else ""
    # A run stops if products cannot be written, which a retry may cure; see `_may_pass`.
    return ProductError(
        f"the run stopped, because scene after scene failed{last_error}", remedy=remedy
    )


@task(name="report", **_RETRY)
def report_task(campaign: Campaign, record: RunRecord, workers: int, pages_at: str | None) -> Path:
    """Write the report of a run, and publish its table, link and quicklook as artifacts."""
    built = report_run(campaign, record, workers=workers)
    key, words = campaign.name.lower(), f"Run {record.id}, report {built.page}"
    create_table_artifact(
        key=f"{key}-products", table=run_tables.instruments(record), description=words
    )
    if pages_at is not None:
        # No browser follows a link from a page of the server to a file.
        place = built.page.relative_to(campaign.output).as_posix()
        create_link_artifact(f"{pages_at.rstrip('/')}/{place}", words, key=f"{key}-report")
    if built.quicklook is not None:
        from lidarops.figures.stills import still  # noqa: PLC0415 - imports matplotlib

        # The server may run on another machine, so the artifact contains the picture.
        encoded = base64.b64encode(still(built.quicklook, ".png")).decode()
        url = f"data:image/png;base64,{encoded}"
        create_image_artifact(image_url=url, key=f"{key}-quicklook")
    return built.page


@task(name="publish", **_RETRY)
def publish_task(campaign: Campaign, url: str) -> None:
    """Copy new and changed products to an object store."""
    published = publish_products(campaign, url)
    get_run_logger().info(
        "%s: %d sent, %d unchanged", url, len(published.uploaded), published.unchanged
    )


def _tell_missing(campaign: Campaign, selection: Selection, within: float) -> None:
    """Raise the event `flows.NO_FILES` for each instrument without a file in the last hours."""
    due = runtime.flow_run.scheduled_start_time or datetime.now(UTC)
    since = due - timedelta(hours=within)
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        files = store.granules_of(day_of(since), day_of(due), dark_days=0)
    came = {f.instrument for f in files if f.role is Role.SIGNAL and f.start and f.start > since}
    for name in campaign.instruments:
        if name not in came and selection.owner(name, campaign):
            words = f"no good file within the {within:g} h before {due:%Y-%m-%d %H:%M} UTC"
            get_run_logger().warning("%s: %s", name, words)
            emit_event(
                NO_FILES,
                {"prefect.resource.id": f"lidarops.archive.{campaign.name}.{name}"},
                payload={"campaign": campaign.name, "instrument": name, "message": words},
            )


def _run_name() -> str:
    """Return the name of a run: campaign, full or incremental, and scheduled time."""
    parameters = runtime.flow_run.parameters
    due = runtime.flow_run.scheduled_start_time or datetime.now(UTC)
    kind = "full" if parameters.get("full") else "incremental"
    return f"{Path(parameters['campaign']).stem}-{kind}-{due:%Y%m%dT%H%M}"


@flow(name="lidarops-reprocess", flow_run_name=_run_name)
def reprocess(
    campaign: str,
    archive: Location | None = None,
    out: str | None = None,
    workers: Workers | None = None,
    instruments: list[str] | None = None,
    since: Instant | None = None,
    until: Instant | None = None,
    scheduler: str | None = None,
    cluster: str | None = None,
    wait: Seconds = 0.0,
    publish: Location | None = None,
    catalog: CatalogUrl | None = None,
    stations: list[str] | None = None,
    products: list[KindName] | None = None,
    memory_limit: clusters.Memory | None = None,
    files_within: Hours | None = None,
    pages_at: Location | None = None,
    *,
    full: bool = False,
) -> tuple[Result, Path | None]:
    """Make the missing and stale products of a campaign, and the report of the run.

    Parameters
    ----------
    campaign : str
        Path of the campaign file.
    archive, out : str, optional
        Override the campaign file, as on the command line.
    workers : int, optional
        Number of worker processes; default 1.
    instruments, stations, products : list of str, optional
        Only these instruments, stations and kinds of product.
    since, until : datetime, optional
        Only scenes that touch this interval.
    scheduler, cluster : str, optional
        As on the command line; see `lidarops.run.clusters.choose_cluster`.
    wait : float
        s to wait for another run on the same archive.
    publish : str, optional
        URL of an object store to which the products are copied.
    catalog : str, optional
        SQLAlchemy URL of catalog and ledger; overrides the campaign file.
    memory_limit : str, optional
        Memory limit of a local worker, such as ``2GiB``.
    files_within : float, optional
        h before the scheduled time within which each instrument should have a good file; where one
        has none, the event `flows.NO_FILES` is raised.
    pages_at : str, optional
        Address at which the output folder is served, for the link to the report.
    full : bool
        Whether to make also fresh products again.

    Returns
    -------
    result : Result
    report : Path or None
        The HTML page; None if there was nothing to do.

    If anything is refused or failed, the flow ends in the state `flows.WITH_FAILURES`, and the
    results are the data of this state; callers of the flow get the data.
    """
    tie_to_this_process()
    keep_main_module_out()
    chosen = clusters.choose_cluster(
        workers=workers, scheduler=scheduler, cluster=cluster, memory=memory_limit
    )
    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    selection = selected(instruments, stations, products, since, until)
    result = process_task(_opaque(settings), _opaque(selection), chosen, full=full, wait=wait)
    if files_within is not None:
        _tell_missing(settings, selection, files_within)
    # First, because copy and report may fail.
    message = _log_problems(settings, result) if result.has_failures else ""
    # Even if nothing was stale: an earlier copy may have failed.
    if publish is not None:
        publish_task(_opaque(settings), publish)
    local = chosen.workers if isinstance(chosen, clusters.Local) else 1
    built = None
    if result.record is None:
        no_scene = selects_no_scene(settings, selection)
        reason = "the selection contains no scene of the archive" if no_scene else "nothing to do"
        get_run_logger().info("campaign %s: %s", settings.name, reason)
    else:
        built = report_task(_opaque(settings), _opaque(result.record), local, pages_at)
        scenes = len(result.record.scenes)
        get_run_logger().info("run %s: %d scenes, report %s", result.record.id, scenes, built)
    made = "" if result.record is None else result.record.id
    for page in report_earlier_runs(settings, without=made, workers=local):
        get_run_logger().info("campaign %s: report of an earlier run, %s", settings.name, page)
    if not result.has_failures:
        return result, built
    # Prefect uses a returned state as that of the flow, and gives its data to callers.
    ended: State[Any] = Completed(name=WITH_FAILURES, message=message, data=(result, built))
    return cast("tuple[Result, Path | None]", ended)


def _log_problems(campaign: Campaign, result: Result) -> str:
    """Log refused and failed files and scenes, some by name; return their numbers as text."""
    problems = {
        "scenes ended with an internal error": result.internal_errors,
        "scenes failed": result.failed_scenes,
        "scenes without a usable value": dict.fromkeys(result.unusable_scenes, NO_USABLE_VALUE),
        "files refused": {
            granule.path: granule.reason
            for granule in refused_files(result)
            if granule.path not in result.set_aside and not granule.is_expected
        },
        "scenes without product": result.empty_scenes,
        "good files in no scene": {
            path: reason
            for path, reason in result.set_aside.items()
            if not reason.startswith(ACKNOWLEDGED)
        },
        "requested channels in no file": {
            f"{request.channel} of {request.instrument}, for {request.requested_by}": request.reason
            for request in result.findings.unmet
            if request.nowhere
        },
        "findings on files": {
            f"{row.instrument}, {row.subject}": row.problem
            for row in finding_rows(result.findings)
            if row.fails
        },
        "requested products made in no scene": {
            f"{unmade.kind} {unmade.channel} of {unmade.instrument}": unmade.reason
            for unmade in result.findings.unmade
        },
        "products without a raw file (reprocess --remove-orphans removes them)": result.lost,
    }
    logger = get_run_logger()
    for kind, reasons in problems.items():
        for name, reason in list(reasons.items())[:_MOST_NAMED]:
            logger.warning("%s: %s", name, reason)
        if len(reasons) > _MOST_NAMED:
            logger.warning("... and %d more %s", len(reasons) - _MOST_NAMED, kind)
    for name, trace in list(result.internal.items())[:_MOST_NAMED]:
        logger.error("scene %s, internal error: please report it\n%s", name, trace)
    numbers = {kind: len(reasons) for kind, reasons in problems.items()}
    summary = ", ".join(f"{number} {kind}" for kind, number in numbers.items() if number)
    logger.warning("campaign %s: %s", campaign.name, summary)
    return summary


def main(
    campaign: str,
    archive: options.Archive = None,
    out: options.Out = None,
    catalog: options.Catalog = None,
    instruments: options.Instruments = None,
    stations: options.Stations = None,
    products: options.Products = None,
    since: options.Since = None,
    until: options.Until = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=10_000, help="Number of workers.")
    ] = None,
    scheduler: options.Scheduler = None,
    cluster: options.Cluster = None,
    memory_limit: Annotated[
        str | None, typer.Option(help="Memory limit of a local worker, such as 2GiB.")
    ] = None,
    wait: options.Wait = 0.0,
    publish: Annotated[
        str | None, typer.Option(help="URL of a store to which the products are copied.")
    ] = None,
    files_within: Annotated[
        float | None, typer.Option(help="Hours within which each instrument should have a file.")
    ] = None,
    pages_at: Annotated[
        str | None, typer.Option(help="Address at which the output folder is served.")
    ] = None,
    *,
    full: Annotated[
        bool, typer.Option("--force", "--full", help="Make fresh products again, too.")
    ] = False,
) -> None:
    """Bring the products of a campaign up to date as a Prefect flow."""
    # Those of the flow have the same names.
    parameters: dict[str, Any] = dict(locals())
    # Check before the flow, which would start a server first and show tracebacks.
    with plain_errors():
        parameters["catalog"] = catalog_parameter(catalog)
        valid = reprocess.validate_parameters(parameters)
        settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
        selection_names = ("instruments", "stations", "products", "since", "until")
        check_selection(settings, selected(*(valid[name] for name in selection_names)))
        clusters.choose_cluster(
            workers=workers, scheduler=scheduler, cluster=cluster, memory=memory_limit
        )
        check_archive_and_catalog(settings, archive=archive)
    tie_to_this_process()
    with plain_errors():
        result, built = reprocess(**parameters)
    if result.record is None:
        typer.echo("nothing to do")
    else:
        made = counted(sum(len(scene.products) for scene in result.scenes), "product")
        typer.echo(f"made:     {made} of {counted(len(result.scenes), 'scene')}")
        known = [file.reason for file in refused_files(result) if file.is_expected]
        for why, files in Counter(reason.partition(":")[0] for reason in known).items():
            typer.echo(f"not used: {counted(files, 'file')}, {why}")
        typer.echo(f"products: {result.record.products}\nreport:   {built}")
    raise typer.Exit(1 if result.has_failures else 0)


if __name__ == "__main__":
    typer.run(main)
