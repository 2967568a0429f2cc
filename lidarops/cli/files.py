"""Commands on one file or one run, and on those that the ledger knows: show, verify, publish."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidarops.cli import options
from lidarops.cli.app import (
    command,
    exit_with_status,
    from_here,
    progress_bar,
    say,
    show_rows,
    show_tables,
)
from lidarops.errors import LidarOpsError

if TYPE_CHECKING:
    from lidarops.catalog.store import Run
    from lidarops.figures.panels import Figure


@command()
def report(
    run: Annotated[
        Path, typer.Argument(help="Report folder of a run, or its run.json.", metavar="RUN")
    ],
    workers: options.Workers = 1,
) -> None:
    """Build the HTML report of a run and its figures again.

    Example: lidarops report demo/report/RUN --workers 2
    """
    from lidarops.reports import run_page, run_record

    folder = run if run.is_dir() else run.parent
    say(str(run_page.build_report(run_record.load_run_record(run), folder, workers=workers).page))


@command()
def inspect(
    file: Annotated[
        Path,
        typer.Argument(help="A raw file, a product, or a folder of raw files.", metavar="FILE"),
    ],
    provenance: Annotated[
        bool, typer.Option("--provenance", help="Print the PROV-JSON of a product.")
    ] = False,
    time: Annotated[
        str, typer.Option(help="UTC, such as 2024-09-21T15:00: only the profile of this time.")
    ] = "",
    as_json: options.Json = False,
) -> None:
    """Show the content of a raw file or a product, or the groups of raw files of a folder.

    Of a product: quality, values, the steps with their settings, how to cite it, and attributes.

    Example: lidarops inspect demo/raw/coast/h2492106.010000
    """
    from lidarops.reports import inspection

    if provenance:
        say(inspection.provenance(file))
        return
    if as_json:
        typer.echo(json.dumps(inspection.describe(file, time), indent=2, ensure_ascii=False))
        return
    show_tables(inspection.tables(file, time))


@command()
def plot(
    file: Annotated[Path, typer.Argument(help="A raw file or a product.", metavar="FILE")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="PNG, SVG or PDF file; by default FILE.png here."),
    ] = None,
    variable: Annotated[str, typer.Option(help="Draw this variable only.")] = "",
    time: Annotated[
        str, typer.Option(help="UTC, such as 2024-03-01T06:00/2024-03-01T18:00.", metavar="SPAN")
    ] = "",
    range_: Annotated[str, typer.Option("--range", help="km, such as 0.3/5.", metavar="SPAN")] = "",
    altitude: Annotated[str, typer.Option(help="km above sea level.", metavar="SPAN")] = "",
) -> None:
    """Draw a raw file or a product; more than one figure get numbered files.

    Example: lidarops plot demo/raw/coast/h2492106.010000 -o h2492106.svg
    """
    from lidarops.reports import plotting

    figures = plotting.draw_file(file, plotting.selection(variable, time, range_, altitude))
    _write_figures(figures, out or Path(f"{file.name.removesuffix('.nc')}.png"))


def _write_figures(figures: tuple[Figure, ...], out: Path, *, quiet: bool = False) -> None:
    from lidarops.figures.stills import still
    from lidarops.reports import plotting
    from lidarops.system.files import write_atomically

    if out.suffix not in plotting.TYPES:
        raise LidarOpsError(f"is none of {', '.join(plotting.TYPES)}", file=out, wrong_use=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    for number, figure in enumerate(figures, 1):
        target = out if len(figures) == 1 else out.with_stem(f"{out.stem}_{number}")
        write_atomically(target, still(figure, out.suffix))
        if not quiet:
            say(f"{target}: {figure.caption}")


@command()
def reproduce(
    product: Annotated[Path, typer.Argument(help="A product.", metavar="PRODUCT")],
    archive: Annotated[
        str | None,
        typer.Option("--archive", help="Folder or URL of the raw files; searched for by default."),
    ] = None,
    ancillary: Annotated[
        Path | None,
        typer.Option("--ancillary", help="Folder of soundings and overlap functions."),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option(
            "--catalog",
            help="SQLAlchemy URL of a catalog that knows where raw files were moved;"
            " searched for by default.",
            metavar="URL",
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Make a product again from its provenance. Exit code 0 if every byte is the same.

    Example: lidarops reproduce demo/products/hill/hill-vertical/elastic/2024/*355o*0922*.nc
    """
    from lidarops.run.reproduction import explain_difference, reproduce_product

    result = reproduce_product(product, archive=archive, ancillary=ancillary, catalog=catalog)
    say(json.dumps(asdict(result), indent=2) if as_json else explain_difference(result))
    exit_with_status(failed=not result.identical)


@command()
def compare(
    old: Annotated[Path, typer.Argument(help="A product.", metavar="PRODUCT")],
    new: Annotated[
        Path | None,
        typer.Argument(
            help="Another version of it; else the one that it replaced is compared with it.",
            metavar="NEW",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="PNG, SVG or PDF file of mean profiles.")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Show how a product differs from another version of it, and why. Exit code 0 if it does not.

    none: the same values and texts. minor: other texts or flags, or values within a tenth of their
    stated errors. major: all else. Quantities differ by what is listed, where both are usable.

    Example: lidarops compare PRODUCT.nc -o change.png
    """
    from lidarops.catalog.product_files import last_kept
    from lidarops.figures.wording import change_in_words
    from lidarops.netcdf.comparison import compare_products, quantity_changes
    from lidarops.records import Grade

    old, new = (last_kept(old), old) if new is None else (old, new)
    change, quantities = compare_products(old, new), quantity_changes(old, new)
    if as_json:
        listed = [row._asdict() for row in quantities]
        typer.echo(json.dumps({**change.as_dict(), "quantities": listed}, indent=2))
    else:
        say(f"{change.grade.value}: {change_in_words(change)}")
        for cause in change.causes:
            say(f"  {cause}")
        columns = ("quantity", "unit", "values", "mean before", "mean change", "largest change")
        rows = ((*row[:3], *(f"{number:.3g}" for number in row[3:])) for row in quantities)
        show_rows(f"{new.name}, against {from_here(old)}", columns, rows)
    if out is not None:
        from lidarops.reports import plotting

        _write_figures(plotting.draw_change(old, new), out, quiet=as_json)
    exit_with_status(failed=change.grade is not Grade.NONE)


@command()
def runs(
    campaign: options.Campaign = Path(),
    out: options.Out = None,
    catalog: options.Catalog = None,
    limit: Annotated[
        int, typer.Option(min=1, help="Number of runs to show, the newest first.")
    ] = 20,
    as_json: options.Json = False,
) -> None:
    """Show the runs of a campaign, the newest first, and who holds its catalog now.

    Of a run its status, numbers and time per stage; then the scenes that failed when they were last
    tried, and the report of the newest run. A holder that is dead is overtaken by the next
    command; one that only may be, because it ran elsewhere, by a command with --wait 60.

    Example: lidarops runs catalogs/demo.yaml
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.lock import Lock
    from lidarops.catalog.store import Store
    from lidarops.reports.run_record import INDEX

    settings = load_campaign(campaign, output=out, catalog=catalog)
    with Store(settings.catalog_url, settings.name, create=False) as store:
        listed, holder = store.runs(limit=limit), Lock(store).held_by()
        failures = store.failures()
    if as_json:
        plain = [asdict(run) for run in listed]
        typer.echo(json.dumps(plain, indent=2, default=datetime.isoformat))
        return
    columns = ("run", "status", "took", "scenes", "products", "failed", "refused", "stages", "by")
    show_rows(f"Runs of {settings.name}", columns, map(_row, listed))
    show_rows("Failed, as last tried", ("scene", "error"), failures.items())
    reports = (settings.report_root / run.id / INDEX for run in listed)
    for page in [page for page in reports if page.exists()][:1]:
        say(f"newest report: {from_here(page)}")
    if holder:
        say(f"The catalog is {holder}.")


def _row(run: Run) -> tuple[object, ...]:
    took = "" if run.finished is None else str(run.finished - run.started).partition(".")[0]
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in run.seconds.items())
    numbers = (run.scenes, run.products, run.failed, run.refused)
    return run.id, run.status.value, took, *numbers, stages, run.holder


@command()
def verify(
    campaign: options.Campaign = Path(),
    archive: options.Archive = None,
    out: options.Out = None,
    catalog: options.Catalog = None,
    products_only: Annotated[
        bool, typer.Option("--products-only", help="Do not read the raw files.")
    ] = False,
    as_json: options.Json = False,
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
        progress_bar("verify") as bar,
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
    campaign: options.Campaign,
    url: Annotated[
        str, typer.Argument(help="Destination, such as s3://bucket/prefix or file:///...")
    ],
    out: options.Out = None,
    catalog: options.Catalog = None,
    site: Annotated[
        bool, typer.Option("--site", help="Also copy the pages, to the folder site.")
    ] = False,
    as_json: options.Json = False,
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
