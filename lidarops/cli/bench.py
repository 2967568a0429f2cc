"""The command that measures accuracy, throughput and stability."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from lidarops.cli.app import JsonOption, command, no_url, progress_bar, show_rows


@command()
def bench(
    what: Annotated[str, typer.Argument(help="accuracy, throughput or stability", metavar="WHAT")],
    files: Annotated[
        list[Path] | None, typer.Argument(help="Raw files of one layout, for the case reader.")
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(
            help="all, archive, campaigns, elastic, homogeneous, memory, multiangle, network, "
            "raman or reader."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of the EARLINET elastic intercomparison, for the case elastic."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure less.")] = False,
    repeats: Annotated[
        int | None, typer.Option(min=1, max=100, help="Number of repeats of each timing.")
    ] = None,
    out: Annotated[
        str | None, typer.Option("--out", help="Folder for the page and its JSON.", callback=no_url)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure accuracy, throughput or stability.

    Accuracy compares errors with the least possible errors; throughput compares times with a floor
    measured in the same run; stability shows how often a wrong value
    has no flag, and fails with 1 where a target is missed. Its cases are homogeneous, signal,
    elastic, multiangle, network, raman, flags and order, or the name of a table.

    Example: lidarops bench accuracy --case homogeneous --quick --out bench

    Example: lidarops bench accuracy --case elastic --quick --data boeckmann

    Example: lidarops bench throughput demo/raw/coast/h*.*0

    Example: lidarops bench stability --quick --out bench

    Example: lidarops bench stability --case raman
    """
    from lidarops.bench.harness.benchmark import Effort
    from lidarops.bench.registry import run_benchmark

    today = datetime.now(UTC).date().isoformat()
    with progress_bar("bench", None) as bar:
        effort = Effort(quick=quick, repeats=repeats, date=today, progress=bar.advance)
        study = run_benchmark(what, case, files or [], effort, data=data)
    page = None if out is None else study.write(Path(out))
    if as_json:
        typer.echo(study.json())
    else:
        for results in (shown for chapter in study.chapters for shown in chapter.results):
            if not results.folded:
                show_rows(results.title, results.table.columns, results.table.rows)
        if page is not None:
            typer.echo(f"report: {page}")
    for target in study.missed:
        typer.echo(f"missed: {target}", err=True)
    for target in study.unnamed:
        typer.echo(f"missed, and not named in reasons.json: {target}", err=True)
    if study.missed:
        raise typer.Exit(1)
