"""Command that measures."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, add_row, app, make_table, plainly, progress_bar, show


@app.command()
@plainly
def bench(
    what: Annotated[str, typer.Argument(help="accuracy or throughput", metavar="WHAT")],
    files: Annotated[
        list[Path] | None, typer.Argument(help="Raw files of one layout, for the case reader.")
    ] = None,
    case: Annotated[
        str | None, typer.Option(help="elastic, homogeneous, multiangle, multiposition or reader.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of the EARLINET elastic intercomparison, for the case elastic."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A minute at most.")] = False,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100, help="Counted repeats of each timing.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of page and JSON.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure errors against the least possible ones, or speed against a floor of the same run.

    Example: lidarops bench accuracy --case homogeneous --quick --out bench

    Example: lidarops bench accuracy --case elastic --quick --data boeckmann

    Example: lidarops bench throughput demo/raw/coast/h*.*0
    """
    from lidarops.bench import cases, results
    from lidarops.bench.terms import Effort

    today = datetime.now(UTC).date().isoformat()
    with progress_bar("bench", None) as advance:
        effort = Effort(quick=quick, repeats=repeats, date=today, progress=advance)
        finding = cases.run(what, case, files or [], effort, data=data)
    page = None if out is None else cases.write(finding, out)
    if as_json:
        typer.echo(json.dumps(results.plain(finding.result), indent=1))
        return
    for part in finding.report.parts:
        for found in part.tables:
            table = make_table(found.title, *found.columns)
            for cells in found.rows:
                add_row(table, *cells)
            show(table)
    if page is not None:
        typer.echo(f"report: {page}")
