"""Commands that ask the ledger: what was run, and is everything still as it was recorded."""

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
    leave,
    make_table,
    plainly,
    progress_bar,
    show,
)

if TYPE_CHECKING:
    from lidarops.catalog.ledger import Run


@app.command()
@plainly
def runs(
    campaign: CampaignFile,
    out: OutOption = None,
    catalog: CatalogOption = None,
    limit: Annotated[int, typer.Option(min=1, help="Only the newest.")] = 20,
    as_json: JsonOption = False,
) -> None:
    """Show the runs of a campaign, the newest first: how they ended, and what took the time.

    Example: lidarops runs catalogs/demo.yaml
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store

    settings = load_campaign(campaign, output=out, catalog=catalog)
    with Store(settings.catalog_url, settings.name, create=False) as store:
        found = store.runs(limit=limit)
    if as_json:
        typer.echo(json.dumps([_plain(run) for run in found], indent=2))
        return
    columns = ("run", "status", "took", "scenes", "products", "failed", "refused", "stages", "by")
    table = make_table(f"Runs of {settings.name}", *columns)
    for run in found:
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
@plainly
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
    """Read all products and their inputs again, and name each that is not as recorded.

    Example: lidarops verify catalogs/demo.yaml
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store
    from lidarops.catalog.verify import verify_archive as audit
    from lidarops.run.selection import refuse_nowhere

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    if archive and not products_only:
        refuse_nowhere(settings, archive=archive)
    looked = 0

    with (
        Store(settings.catalog_url, settings.name, create=False) as store,
        progress_bar("verify", None) as advance,
    ):

        def count(done: int) -> None:
            nonlocal looked
            looked += done
            advance(done)

        found = list(audit(settings, store, inputs=not products_only, progress=count))
    if as_json:
        told = {"files": looked, "mismatches": [asdict(each) for each in found]}
        typer.echo(json.dumps(told, indent=2))
    else:
        table = make_table("Not as recorded", "what", "file", "problem")
        for each in found:
            add_row(table, each.what, each.path, each.problem)
        show(table)
        typer.echo(f"{looked} files read, {len(found)} not as recorded")
    leave(failed=bool(found))
