"""Commands that look at one file or one run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, app, plainly, show


@app.command()
@plainly
def report(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or its run.json.", metavar="RUN")],
    workers: Annotated[int, typer.Option(min=1, max=256, help="Processes.")] = 1,
) -> None:
    """Build the HTML report and figures of a run again.

    Example: lidarops report demo/report/RUN --workers 2
    """
    from lidarops.reports import run_page, run_record

    folder = run if run.is_dir() else run.parent
    typer.echo(
        str(run_page.build_report(run_record.load_run_record(run), folder, workers=workers).page)
    )


@app.command()
@plainly
def inspect(
    file: Annotated[Path, typer.Argument(help="A raw file or a product.", metavar="FILE")],
    provenance: Annotated[
        bool, typer.Option("--provenance", help="Print a product's PROV-JSON.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show what a raw file or a product holds.

    Example: lidarops inspect demo/raw/coast/h2492106.010000
    """
    from lidarops.reports import inspection

    if provenance:
        typer.echo(inspection.provenance(file))
        return
    if as_json:
        typer.echo(json.dumps(inspection.describe(file), indent=2, ensure_ascii=False))
        return
    for table in inspection.tables(file):
        show(table)
