"""The command ``python -m benchmarks``, run from a checkout."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

# First of all, it sets the number of threads.
from lidarops.cli.app import JsonOption, command, no_url, progress_bar, show_rows

from benchmarks.harness.results import Effort  # isort: skip
from benchmarks.registry import run_benchmark  # isort: skip

app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)


@command(program=app)
def main(
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

    Example: python -m benchmarks accuracy --case homogeneous --quick --out bench

    Example: python -m benchmarks accuracy --case elastic --quick --data boeckmann

    Example: python -m benchmarks throughput demo/raw/coast/h*.*0

    Example: python -m benchmarks stability --quick --out bench

    Example: python -m benchmarks stability --case raman
    """
    today = datetime.now(UTC).date().isoformat()
    with progress_bar("bench", None) as bar:
        effort = Effort(quick=quick, repeats=repeats, date=today, progress=bar.advance)
        study = run_benchmark(what, case, files or [], effort, data=data)
    page = None if out is None else study.write(Path(out))
    if as_json:
        typer.echo(study.json())
    else:
        for results in study.results:
            if not results.folded:
                table = results.table
                show_rows(results.title, table.columns, table.itertuples(index=False, name=None))
        if page is not None:
            typer.echo(f"report: {page}")
    for target in study.missed:
        typer.echo(f"missed: {target}", err=True)
    for target in study.unnamed:
        typer.echo(f"missed, and not named in reasons.json: {target}", err=True)
    if study.missed:
        raise typer.Exit(1)


if __name__ == "__main__":
    app(prog_name="python -m benchmarks")
