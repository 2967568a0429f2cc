"""Commands that show one file or one run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, app, show, with_plain_errors


@app.command()
@with_plain_errors
def report(
    run: Annotated[
        Path, typer.Argument(help="Report folder of a run, or its run.json.", metavar="RUN")
    ],
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 1,
) -> None:
    """Build the HTML report of a run and its figures again.

    Example: lidarops report demo/report/RUN --workers 2
    """
    from lidarops.reports import run_page, run_record

    folder = run if run.is_dir() else run.parent
    typer.echo(
        str(run_page.build_report(run_record.load_run_record(run), folder, workers=workers).page)
    )


@app.command()
@with_plain_errors
def inspect(
    file: Annotated[Path, typer.Argument(help="A raw file or a product.", metavar="FILE")],
    provenance: Annotated[
        bool, typer.Option("--provenance", help="Print the PROV-JSON of a product.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the content of a raw file or a product.

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
