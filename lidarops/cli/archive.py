"""Commands that work on the archive of a campaign: catalog, plan, reprocess."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidarops.cli.app import (
    ArchiveOption,
    CampaignFile,
    CatalogOption,
    InstrumentOption,
    JsonOption,
    OutOption,
    ProductOption,
    SinceOption,
    StationOption,
    UntilOption,
    WaitOption,
    add_row,
    app,
    exit_with_status,
    growing_bar,
    make_table,
    progress_bar,
    show,
    show_error,
    utc,
    with_plain_errors,
)
from lidarops.cli.logs import LogFileOption, LogJsonOption, LogLevelOption, set_up
from lidarops.errors import LidarOpsError
from lidarops.kinds import kinds

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from contextlib import AbstractContextManager

    from distributed import Client
    from rich.table import Table

    from lidarops.campaign.model import Campaign
    from lidarops.plan.cost_estimate import RunTime
    from lidarops.records import Granule, Plan, RunRecord
    from lidarops.run.archive import Result
    from lidarops.run.selection import Selection
    from lidarops.run.staleness import Judgement

_LEAST_MEMORY = 2**20
"""Bytes; a smaller size probably lacks its unit."""

_UNUSABLE = "its retrievals gave no usable value"
_NO_SCENE = "nothing to do: the selection contains no scene of the archive"

AllStepsOption = Annotated[
    bool,
    typer.Option(
        "--all-steps", help="Run every step, even those without effect, and read files in full."
    ),
]


def _size(text: str | None) -> str | None:
    """Refuse an invalid size before the archive is scanned, which may take an hour."""
    if text is None:
        return None
    from dask.utils import parse_bytes

    try:
        size = parse_bytes(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is not a size such as 2GiB") from error
    if size < _LEAST_MEMORY:
        raise typer.BadParameter(
            f"{text!r} is too little for a worker: give a size with its unit, such as 2GiB"
        )
    return text


@app.command()
@with_plain_errors
def catalog(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    catalog: CatalogOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
    wait: WaitOption = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Create or update the catalog of the archive; list refused files and why.

    Example: lidarops catalog catalogs/demo.yaml
    """
    from dataclasses import asdict

    from lidarops.catalog.store import Store
    from lidarops.run.archive import update_catalog

    settings = _loaded(campaign, archive, out, catalog)
    with progress_bar("catalog", None) as advance:
        summary = update_catalog(settings, progress=advance, wait=wait, workers=workers)
    with Store(settings.catalog_url, settings.name) as store:
        refused = store.refused()
    if as_json:
        reasons = [{"path": granule.path, "reason": granule.reason} for granule in refused]
        typer.echo(json.dumps({**asdict(summary), "refused_files": reasons}, indent=2))
    else:
        show(_refused_table(refused))
        typer.echo(
            f"{summary.files} files: {summary.added} added, {summary.changed} changed,"
            f" {summary.moved} moved, {summary.unchanged} unchanged, {summary.vanished} vanished,"
            f" {summary.refused} refused"
        )
    exit_with_status(failed=bool(refused))


@app.command("plan")
@with_plain_errors
def show_plan(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    catalog: CatalogOption = None,
    instrument: InstrumentOption = None,
    station: StationOption = None,
    product: ProductOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    stale: Annotated[
        bool, typer.Option("--stale", help="Show only the products to be made, and why.")
    ] = False,
    wait: WaitOption = 0.0,
    all_steps: AllStepsOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show scenes, their steps, what is left out and what is stale, and why. Processes nothing.

    Also shows the estimated CPU time, and the memory that a process needs for each scene.

    Example: lidarops plan catalogs/demo.yaml
    """
    from lidarops.plan.cost_estimate import RunTime
    from lidarops.run.archive import assess
    from lidarops.run.selection import selects_no_scene
    from lidarops.steps.memory import scene_memory

    settings = _loaded(campaign, archive, out, catalog, all_steps=all_steps)
    selection = _selection(instrument, station, product, since, until)
    judgements = assess(settings, selection=selection, everything=not stale, wait=wait)
    making, everything = RunTime(), RunTime()
    scenes = []
    no_scene = True
    for judged in judgements:
        no_scene = False
        scene, whole = judged.scene, settings.all_steps
        times = {
            "to_be_made": making.add(scene, judged.needed(), whole=whole),
            "everything": everything.add(scene, judged.requested, whole=whole),
        }
        memory = {
            "to_be_made": scene_memory(scene, judged.needed()).total,
            "everything": scene_memory(scene, judged.requested).total,
        }
        if as_json:
            estimates = {"estimated_cpu_seconds": times, "estimated_memory_bytes": memory}
            scenes.append({**_plain(judged), **estimates})
            continue
        title = f"{scene.id}: {len(scene.granules)} granules, {len(scene.dark)} dark"
        needs = {
            name: f"about {times[name]:.2g} s of CPU time and {memory[name] / 1e6:.0f} MB of memory"
            for name in times
        }
        if not stale:
            show(_plan_table(f"{title}, {needs['everything']}", judged.requested))
        show(_stale_table(f"{title}, {needs['to_be_made']}", judged))
    no_scene = no_scene and selects_no_scene(settings, selection)
    # With --stale, fresh scenes were not judged.
    runs = {"to be made": making} | ({} if stale else {"everything, with --force": everything})
    if as_json:
        estimate = {
            name.partition(",")[0].replace(" ", "_"): run.parts for name, run in runs.items()
        }
        no_scene_found = {"no_scene_selected": no_scene}
        document = {"scenes": scenes, **no_scene_found, "estimated_cpu_seconds": estimate}
        typer.echo(json.dumps(document, indent=2))
        return
    if no_scene:
        typer.echo(_NO_SCENE)
    show(_time_table(runs))


@app.command()
@with_plain_errors
def reprocess(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    catalog: CatalogOption = None,
    instrument: InstrumentOption = None,
    station: StationOption = None,
    product: ProductOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    force: Annotated[
        bool, typer.Option("--force", help="Process everything selected, even what is fresh.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes; default 1.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a running dask scheduler to use.")
    ] = None,
    tls: Annotated[
        tuple[Path, Path, Path] | None,
        typer.Option(
            "--tls",
            help="Certificate of the authority, own certificate and own key, for --scheduler.",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster", help="slurm, kubernetes, or a YAML file that describes a cluster."
        ),
    ] = None,
    memory_limit: Annotated[
        str | None,
        typer.Option(
            "--memory-limit",
            help="Memory limit of each process, such as 2GiB; scenes are read in chunks that fit.",
            callback=_size,
        ),
    ] = None,
    wait: WaitOption = 0.0,
    remove_orphans: Annotated[
        bool,
        typer.Option(
            "--remove-orphans",
            help="Remove products that would not be made again: no longer requested, or without"
            " raw files.",
        ),
    ] = False,
    profiles_per_chunk: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Profiles that are processed together, whatever the limit; affects no result.",
        ),
    ] = None,
    all_steps: AllStepsOption = False,
    log_level: LogLevelOption = "warning",
    log_json: LogJsonOption = False,
    log_file: LogFileOption = None,
    as_json: JsonOption = False,
) -> None:
    """Update the catalog, make all stale products, and write a report.

    Writes nothing if there is nothing to do. Exit code 1 if anything was refused or failed.

    Example: lidarops reprocess catalogs/demo.yaml --workers 2
    """
    from lidarops.run import archive as pipeline
    from lidarops.run.options import missing_report
    from lidarops.run.selection import selects_no_scene

    set_up(log_level, as_json=log_json, file=log_file)
    settings = _loaded(campaign, archive, out, catalog, all_steps=all_steps)
    selection = _selection(instrument, station, product, since, until)
    connect = _cluster(workers, scheduler, tls, cluster, memory_limit)
    with growing_bar("reprocess", "granules") as bar:
        options = pipeline.Options(
            force=force,
            workers=workers or 1,
            memory=memory_limit,
            cluster=connect,
            wait=wait,
            profiles_per_chunk=profiles_per_chunk,
            progress=lambda outcome: bar.advance(outcome.granules),
            expect=bar.grow,
        )
        result = pipeline.bring_up_to_date(settings, selection=selection, options=options)
    no_scene = result.record is None and selects_no_scene(settings, selection)
    if no_scene and not as_json:
        _print_without_scene(settings, result, removing=remove_orphans)
    elif not as_json:
        _print_result(settings, result, removing=remove_orphans)
    report_note = missing_report(settings) if result.record is None else ""
    if report_note and not as_json:
        typer.echo(report_note)
    page, removed = None, None
    try:
        if result.record is not None:
            page = _page(settings, result.record, options.workers)
        if remove_orphans:
            removed = pipeline.remove_orphans(settings, result, wait=wait)
    finally:
        # The result is printed even if the page or the removal failed.
        if as_json:
            summary = _run_summary(settings, result, page)
            summary |= {"no_scene_selected": no_scene, "removed": removed or 0}
            typer.echo(json.dumps({**summary, "unreported": report_note}, indent=2))
        else:
            _print_places(result, page)
    if removed is not None and not as_json:
        show(_orphans_table(result, removed))
    if result.signal:
        raise typer.Exit(128 + result.signal)
    left = result if removed is None else replace(result, orphans=())
    exit_with_status(failed=left.has_failures or (result.record is not None and page is None))


def _page(campaign: Campaign, run: RunRecord, workers: int) -> Path | None:
    """Build the report page of a run; if that fails, show the error and return None."""
    from lidarops.run.archive import report_run

    try:
        return report_run(campaign, run, workers=workers).page
    except LidarOpsError as error:
        show_error(error)
        return None


def _loaded(
    campaign: Path,
    archive: str | None,
    out: str | None,
    catalog: str | None,
    *,
    all_steps: bool = False,
) -> Campaign:
    from lidarops.campaign.model import load_campaign
    from lidarops.run.selection import check_archive_and_catalog

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    check_archive_and_catalog(settings, archive=archive)
    return settings.model_copy(update={"all_steps": all_steps or settings.all_steps})


def _cluster(
    workers: int | None,
    scheduler: str | None,
    tls: tuple[Path, Path, Path] | None,
    cluster: str | None,
    memory: str | None,
) -> Callable[[], AbstractContextManager[Client]] | None:
    """Return a function that connects to the selected cluster; None for this machine."""
    if tls and scheduler is None:
        raise typer.BadParameter("--tls belongs to --scheduler; a cluster file has its own tls")
    if scheduler is None and cluster is None:
        return None
    from lidarops.run import clusters

    chosen = clusters.choose_cluster(
        workers=workers, scheduler=scheduler, cluster=cluster, memory=memory
    )
    if tls and isinstance(chosen, clusters.Scheduler):
        ca, certificate, key = tls
        files = clusters.Tls(ca=ca, certificate=certificate, key=key)
        chosen = chosen.model_copy(update={"tls": files})
    return partial(clusters.connect_client, chosen)


def _selection(
    instruments: list[str] | None,
    stations: list[str] | None,
    products: list[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Selection:
    from lidarops.run.selection import Selection

    for name in products or ():
        if name not in kinds():
            raise typer.BadParameter(
                f"{name!r} is not a kind of product; the kinds are {', '.join(kinds())}"
            )
    return Selection(
        stations=tuple(stations or ()),
        instruments=tuple(instruments or ()),
        kinds=tuple(products or ()),
        since=utc(since),
        until=utc(until),
    )


def _refused_table(refused: list[Granule]) -> Table:
    table = make_table("Refused", "file", "instrument", "reason")
    for granule in refused:
        add_row(table, granule.path, granule.instrument, granule.reason)
    return table


def _plan_table(title: str, plan: Plan) -> Table:
    from lidarops.figures.wording import decided_on
    from lidarops.steps.reading import idle_window

    table = make_table(title, "channel", "step", "does", "reason", "rule", "number")
    for step in plan.steps:
        settings = ", ".join(f"{key} {value}" for key, value in step.settings.items())
        idle = idle_window(step, plan.steps)
        done = f"no effect: {idle}" if idle else settings or "yes"
        cells = (step.channel, step.name, done, step.reason)
        add_row(table, *cells, step.rule, decided_on(step.number))
    for omission in plan.left_out:
        cells = (omission.channel, omission.name, "left out", omission.reason)
        add_row(table, *cells, omission.rule, decided_on(omission.number))
    return table


def _time_table(runs: Mapping[str, RunTime]) -> Table:
    title = "Estimated CPU time in s on a common server core"
    table = make_table(title, "", "scenes", "processing", "start", "report", "all")
    for name, run in runs.items():
        add_row(table, name, run.count, *(f"{seconds:.2g}" for seconds in run.parts.values()))
    return table


def _stale_table(title: str, judged: Judgement) -> Table:
    table = make_table(f"{title}: to be made", "product", "channel", "reason")
    for product in judged.stale:
        add_row(table, product.kind, product.channel, product.reason)
    if judged.held:
        add_row(table, "none", "", f"not tried again, because nothing has changed: {judged.held}")
    return table


def _plain(judged: Judgement) -> dict[str, Any]:
    from lidarops.steps.reading import idle_window

    stale = [
        {"kind": product.kind, "channel": product.channel, "reason": product.reason}
        for product in judged.stale
    ]
    plan = judged.requested
    idle = [idle_window(step, plan.steps) for step in plan.steps]
    steps = [
        {**step.as_dict(), **({"no_effect": why} if why else {})}
        for step, why in zip(plan.steps, idle, strict=True)
    ]
    return {
        **plan.as_dict(),
        "steps": steps,
        "stale": stale,
        "fresh": judged.fresh,
        "held": judged.held,
    }


def _run_summary(campaign: Campaign, result: Result, page: Path | None) -> dict[str, Any]:
    from dataclasses import asdict

    record = result.record
    scenes = () if record is None else record.scenes
    return {
        "run": None if record is None else record.id,
        "status": result.status.value,
        "report": None if page is None else str(page),
        "scenes": len(scenes),
        "failed_scenes": dict(result.failed_scenes),
        "internal_errors": {
            scene: {"error": error, "traceback": result.internal[scene]}
            for scene, error in result.internal_errors.items()
        },
        "unusable_scenes": list(result.unusable_scenes),
        "refused_files": {granule.path: granule.reason for granule in _refused(campaign, result)},
        "products": [product.path for scene in scenes for product in scene.products],
        "files_set_aside": dict(result.set_aside),
        "empty_scenes": dict(result.empty_scenes),
        "more_of_both": result.more_unused,
        "not_in_files": [
            {**asdict(request), "nowhere": request.nowhere} for request in result.unmet
        ],
        "orphans": {
            orphan.path: orphan.reason for orphan in result.orphans if not orphan.requested
        },
        "kept_products": {
            orphan.path: orphan.reason for orphan in result.orphans if orphan.requested
        },
    }


def _print_places(result: Result, page: Path | None) -> None:
    """Print where the report and the tracebacks of internal errors are."""
    from lidarops.figures.wording import counted

    if page is not None:
        typer.echo(f"report:   {page}")
    if result.internal:
        on_page = page is not None and set(result.internal) <= _processed_scenes(result)
        scenes = counted(len(result.internal), "scene")
        place = page if on_page else "the output of the same command with --json"
        typer.echo(
            f"{scenes} ended with an internal error: please report it,"
            f" with the traceback in {place}"
        )


def _refused(campaign: Campaign, result: Result) -> list[Granule]:
    if result.record is not None:
        late = [granule for scene in result.record.scenes for granule in scene.refused]
        early = {granule.path: granule for granule in (*result.record.refused, *late)}
        return list(early.values())
    from lidarops.catalog.store import Store

    with Store(campaign.catalog_url, campaign.name) as store:
        return store.refused()


def _print_result(campaign: Campaign, result: Result, *, removing: bool) -> None:
    table = make_table("Products", "scene", "kind", "channel", "values", "unflagged", "flags")
    for scene in () if result.record is None else result.record.scenes:
        for product in scene.products:
            flags = ", ".join(f"{name.lower()} {count}" for name, count in product.flagged.items())
            name = (scene.scene, product.kind, product.channel)
            add_row(table, *name, product.values, product.unflagged, flags)
        if scene.error:
            add_row(table, scene.scene, "none", "", "", "", scene.error)
    show(table)
    refused = _refused(campaign, result)
    show(_refused_table(refused))
    show(_unused_table(result, {granule.path for granule in refused}))
    show(_unmet_table(result))
    if not removing:
        show(_orphans_table(result, None))
    show(_kept_table(result))
    show(_unusable_table(result))
    show(_failures_table(result))
    if result.record is not None:
        ended = f" ({result.status.value})" if result.status != "finished" else ""
        typer.echo(f"products: {campaign.products_root}{ended}")
        return
    typer.echo("nothing to do: every requested product is fresh or cannot be made")


def _unused_table(result: Result, listed: Collection[str]) -> Table:
    title = "Not used" + (
        f" ({result.more_unused} more on other days)" if result.more_unused else ""
    )
    table = make_table(title, "file or scene", "reason")
    for path, reason in result.set_aside.items():
        if path not in listed:
            add_row(table, path, reason)
    for scene, reason in result.empty_scenes.items():
        add_row(table, scene, reason)
    return table


def _unmet_table(result: Result) -> Table:
    from lidarops.figures.wording import lacking

    title = "Requested, but not in the files"
    table = make_table(title, "instrument", "channel", "requested by", "reason", "missing in")
    for request in result.unmet:
        cells = (request.instrument, request.channel, request.requested_by, request.reason)
        add_row(table, *cells, lacking(request))
    return table


def _print_without_scene(campaign: Campaign, result: Result, *, removing: bool) -> None:
    refused = _refused(campaign, result)
    show(_refused_table(refused))
    show(_unused_table(result, {granule.path for granule in refused}))
    show(_unmet_table(result))
    if not removing:
        show(_orphans_table(result, None))
    show(_kept_table(result))
    show(_failures_table(result))
    typer.echo(_NO_SCENE)


def _orphans_table(result: Result, removed: int | None) -> Table:
    fate = "kept; --remove-orphans removes them" if removed is None else f"{removed} removed"
    table = make_table(f"Products that the campaign no longer requests ({fate})", "file", "reason")
    for orphan in result.orphans:
        if not orphan.requested:
            add_row(table, orphan.path, orphan.reason)
    return table


def _kept_table(result: Result) -> Table:
    title = "Requested products that could not be made again (kept)"
    table = make_table(title, "file", "reason")
    for orphan in result.orphans:
        if orphan.requested:
            add_row(table, orphan.path, orphan.reason)
    return table


def _unusable_table(result: Result) -> Table:
    table = make_table("Without a usable value", "scene", "problem")
    processed = _processed_scenes(result)
    for scene in result.unusable_scenes:
        if scene in processed:
            add_row(table, scene, _UNUSABLE)
    return table


def _processed_scenes(result: Result) -> set[str]:
    return {scene.scene for scene in (() if result.record is None else result.record.scenes)}


def _failures_table(result: Result) -> Table:
    processed = _processed_scenes(result)
    table = make_table("From earlier runs, unchanged since", "scene", "problem")
    for scene, error in result.failures.items():
        if scene not in processed:
            add_row(table, scene, error)
    for scene in result.unusable:
        if scene not in processed:
            add_row(table, scene, _UNUSABLE)
    return table
