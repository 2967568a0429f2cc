"""Commands that read the ledger: list the runs, and verify the recorded files."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidarops.cli.app import (
    ArchiveOption,
    CampaignFile,
    CatalogOption,
    JsonOption,
    OutOption,
    add_row,
    app,
    exit_with_status,
    make_table,
    progress_bar,
    show,
    with_plain_errors,
)

if TYPE_CHECKING:
    from lidarops.catalog.ledger import Run


@app.command()
@with_plain_errors
def runs(
    campaign: CampaignFile,
    out: OutOption = None,
    catalog: CatalogOption = None,
    limit: Annotated[
        int, typer.Option(min=1, help="Number of runs to show, the newest first.")
    ] = 20,
    as_json: JsonOption = False,
) -> None:
    """Show the runs of a campaign, the newest first: status, numbers and time per stage.

    Example: lidarops runs catalogs/demo.yaml
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store

    settings = load_campaign(campaign, output=out, catalog=catalog)
    with Store(settings.catalog_url, settings.name, create=False) as store:
        listed = store.runs(limit=limit)
    if as_json:
        typer.echo(json.dumps([_plain(run) for run in listed], indent=2))
        return
    columns = ("run", "status", "took", "scenes", "products", "failed", "refused", "stages", "by")
    table = make_table(f"Runs of {settings.name}", *columns)
    for run in listed:
        took = "" if run.finished is None else str(run.finished - run.started).partition(".")[0]
        stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in run.seconds.items())
        numbers = (run.scenes, run.products, run.failed, run.refused)
        add_row(table, run.id, run.status.value, took, *numbers, stages, run.holder)
    show(table)


def _plain(run: Run) -> dict[str, Any]:
    return {
        **asdict(run),
        "started": run.started.isoformat(),
        "finished": run.finished and run.finished.isoformat(),
    }


@app.command()
@with_plain_errors
def verify(
    campaign: CampaignFile,
    archive: ArchiveOption = None,
    out: OutOption = None,
    catalog: CatalogOption = None,
    products_only: Annotated[
        bool, typer.Option("--products-only", help="Do not read the raw files.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Read all products and their inputs again; list files that differ from the ledger.

    Example: lidarops verify catalogs/demo.yaml
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store
    from lidarops.catalog.verify import verify_archive
    from lidarops.run.selection import check_archive_and_catalog

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    if archive and not products_only:
        check_archive_and_catalog(settings, archive=archive)
    checked = 0

    with (
        Store(settings.catalog_url, settings.name, create=False) as store,
        progress_bar("verify", None) as advance,
    ):

        def count(done: int) -> None:
            nonlocal checked
            checked += done
            advance(done)

        mismatches = list(verify_archive(settings, store, inputs=not products_only, progress=count))
    if as_json:
        summary = {"files": checked, "mismatches": [asdict(file) for file in mismatches]}
        typer.echo(json.dumps(summary, indent=2))
    else:
        table = make_table("Not as recorded", "what", "file", "problem")
        for file in mismatches:
            add_row(table, file.what, file.path, file.problem)
        show(table)
        typer.echo(f"{checked} files read, {len(mismatches)} not as recorded")
    exit_with_status(failed=bool(mismatches))
