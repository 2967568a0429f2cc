"""Commands that read the ledger: list the runs, verify the recorded files, publish products."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Annotated

import typer

from lidarops.cli.app import (
    ArchiveOption,
    CampaignFile,
    CatalogOption,
    JsonOption,
    OutOption,
    command,
    exit_with_status,
    progress_bar,
    say,
    show_rows,
)

if TYPE_CHECKING:
    from lidarops.catalog.store import Run


@command()
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
        plain = [asdict(run) for run in listed]
        typer.echo(json.dumps(plain, indent=2, default=datetime.isoformat))
        return
    columns = ("run", "status", "took", "scenes", "products", "failed", "refused", "stages", "by")
    show_rows(f"Runs of {settings.name}", columns, map(_row, listed))


def _row(run: Run) -> tuple[object, ...]:
    took = "" if run.finished is None else str(run.finished - run.started).partition(".")[0]
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in run.seconds.items())
    numbers = (run.scenes, run.products, run.failed, run.refused)
    return run.id, run.status.value, took, *numbers, stages, run.holder


@command()
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
    from lidarops.catalog.database import check_archive_and_catalog
    from lidarops.catalog.product_files import verify_archive
    from lidarops.catalog.store import Store

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    if archive and not products_only:
        check_archive_and_catalog(settings, archive=archive)
    with (
        Store(settings.catalog_url, settings.name, create=False) as store,
        progress_bar("verify", None) as bar,
    ):
        checked, mismatches = 0, []
        for file in verify_archive(settings, store, inputs=not products_only):
            checked += 1
            bar.advance(1)
            mismatches += [file] if file.problem else []
    if as_json:
        summary = {"files": checked, "mismatches": [asdict(file) for file in mismatches]}
        typer.echo(json.dumps(summary, indent=2))
    else:
        rows = ((file.what, file.path, file.problem) for file in mismatches)
        show_rows("Not as recorded", ("what", "file", "problem"), rows)
        say(f"{checked} files read, {len(mismatches)} not as recorded")
    exit_with_status(failed=bool(mismatches))


@command()
def publish(
    campaign: CampaignFile,
    url: Annotated[
        str, typer.Argument(help="Destination, such as s3://bucket/prefix or file:///...")
    ],
    out: OutOption = None,
    catalog: CatalogOption = None,
    site: Annotated[
        bool, typer.Option("--site", help="Also copy the pages, to the folder site.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Copy products to an object store: send what it lacks or has outdated; remove nothing.

    With --site, pages go beside them: make these with lidarops site OUT --products-at .. before.

    Example: lidarops publish catalogs/demo.yaml s3://bucket/demo --site
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.product_files import publish_products, publish_site
    from lidarops.system.stores import without_keys

    settings = load_campaign(campaign, output=out, catalog=catalog)
    published = publish_products(settings, url)
    pages = publish_site(settings, url) if site else None
    if as_json:
        document = asdict(published) | ({} if pages is None else {"site": asdict(pages)})
        typer.echo(json.dumps(document, indent=2))
        return
    others = f", {published.others} other files left alone" if published.others else ""
    counts = f"{len(published.uploaded)} sent, {published.unchanged} unchanged{others}"
    say(f"{without_keys(url)}: {counts}")
    if pages is not None:
        say(f"pages: {len(pages.uploaded)} sent, {pages.unchanged} unchanged")
