"""Commands that work on the archive of a campaign."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidarops.cli.app import (
    ArchiveOption,
    CampaignFile,
    InstrumentOption,
    JsonOption,
    OutOption,
    SinceOption,
    UntilOption,
    add_row,
    app,
    leave,
    make_table,
    plainly,
    progress_bar,
    show,
    utc,
)

if TYPE_CHECKING:
    from rich.table import Table

    from lidarops.campaign import Campaign
    from lidarops.catalog.store import Store
    from lidarops.records import Granule, Plan, RunRecord
    from lidarops.scenes import Cut


@app.command()
@plainly
def catalog(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Scan the archive, or bring its catalog up to date; list what is refused and why.

    Example: lidarops catalog catalogs/demo.yaml
    """
    from dataclasses import asdict

    from lidarops.campaign import load
    from lidarops.catalog.scan import scan
    from lidarops.records import Status

    settings = load(campaign, archive=archive, output=out)
    store = _open_store(settings)
    try:
        with progress_bar("catalog", None) as advance:
            summary = scan(settings, store, progress=advance)
        refused = store.granules(status=Status.REFUSED)
    finally:
        store.close()
    if as_json:
        reasons = [{"path": granule.path, "reason": granule.reason} for granule in refused]
        typer.echo(json.dumps({**asdict(summary), "refused_files": reasons}, indent=2))
    else:
        show(_refused_table(refused))
        typer.echo(
            f"{summary.files} files: {summary.added} added, {summary.changed} changed,"
            f" {summary.unchanged} unchanged, {summary.vanished} vanished,"
            f" {summary.refused} refused"
        )
    leave(failed=bool(refused))


@app.command("plan")
@plainly
def show_plan(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    instrument: InstrumentOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the scenes, their steps, and what is left out and why. Runs nothing.

    Example: lidarops plan catalogs/demo.yaml
    """
    from lidarops.campaign import load
    from lidarops.plans import plan

    settings = load(campaign, archive=archive, output=out)
    cut = _cut_scenes(settings, instrument, since, until)
    plans = [plan(scene, settings) for scene in cut.scenes]
    if as_json:
        typer.echo(json.dumps([item.as_dict() for item in plans], indent=2))
        return
    for scene, item in zip(cut.scenes, plans, strict=True):
        title = f"{scene.id}: {len(scene.granules)} granules, {len(scene.dark)} dark"
        show(_plan_table(title, item))


@app.command()
@plainly
def reprocess(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    instrument: InstrumentOption = None,
    since: SinceOption = None,
    until: UntilOption = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Processes.")] = 1,
    profiles_per_chunk: Annotated[
        int | None, typer.Option(min=1, help="Profiles a dask chunk; changes no result.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Catalog the archive, process its scenes into products, and write the report.

    Example: lidarops reprocess catalogs/demo.yaml --workers 2
    """
    from lidarops.campaign import load
    from lidarops.engine import run
    from lidarops.pipeline import report_run

    settings = load(campaign, archive=archive, output=out)
    cut = _cut_scenes(settings, instrument, since, until)
    with progress_bar("reprocess", len(cut.scenes)) as advance:
        record = run(
            settings,
            cut,
            workers=workers,
            profiles_per_chunk=profiles_per_chunk,
            progress=lambda _outcome: advance(1),
        )
    page = report_run(settings, record)
    if as_json:
        typer.echo(json.dumps(_run_summary(record, page), indent=2))
    else:
        _tell(record, page)
    leave(failed=record.failed)


def _open_store(campaign: Campaign) -> Store:
    from lidarops.catalog.store import Store

    return Store(campaign.catalog_url, campaign.name)


def _cut_scenes(
    campaign: Campaign,
    instruments: list[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Cut:
    from lidarops.pipeline import prepare

    return prepare(campaign, instruments=instruments or (), since=utc(since), until=utc(until))


def _refused_table(refused: list[Granule]) -> Table:
    table = make_table("Refused", "file", "instrument", "reason")
    for granule in refused:
        add_row(table, granule.path, granule.instrument, granule.reason)
    return table


def _plan_table(title: str, plan: Plan) -> Table:
    table = make_table(title, "channel", "step", "does", "why")
    for step in plan.steps:
        settings = ", ".join(f"{key} {value}" for key, value in step.settings.items())
        add_row(table, step.channel, step.name, settings or "yes", step.reason)
    for left in plan.left_out:
        add_row(table, left.channel, left.name, "left out", left.reason)
    return table


def _run_summary(record: RunRecord, page: Path) -> dict[str, Any]:
    return {
        "run": record.id,
        "report": str(page),
        "scenes": len(record.scenes),
        "failed_scenes": {scene.scene: scene.error for scene in record.scenes if scene.error},
        "refused_files": {granule.path: granule.reason for granule in _all_refused(record)},
        "products": [product.path for scene in record.scenes for product in scene.products],
    }


def _all_refused(record: RunRecord) -> list[Granule]:
    return [*record.refused, *(granule for scene in record.scenes for granule in scene.refused)]


def _tell(record: RunRecord, page: Path) -> None:
    table = make_table("Products", "scene", "kind", "channel", "values", "unflagged", "flags")
    for scene in record.scenes:
        for product in scene.products:
            flags = ", ".join(f"{name.lower()} {count}" for name, count in product.flagged.items())
            of = (scene.scene, product.kind.value, product.channel)
            add_row(table, *of, product.values, product.unflagged, flags)
        if scene.error:
            add_row(table, scene.scene, "none", "", "", "", scene.error)
    show(table)
    show(_refused_table(_all_refused(record)))
    typer.echo(f"products: {record.products}\nreport:   {page}")
