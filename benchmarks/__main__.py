"""The command ``python -m benchmarks``, run from a checkout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import typer

# First of all, it sets the number of threads.
from lidarops.cli.app import command, no_url, progress_bar, show_rows

# isort: split
from benchmarks.accuracy import comparison, elastic, homogeneous, multiangle, network
from benchmarks.harness.figure import cpu_seconds
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.stability import study
from benchmarks.throughput import memory, retrievals
from lidarops.errors import CampaignError


def measure_all(effort: Effort) -> Study:
    """Measure error against run time of all retrievals.

    Raises
    ------
    CampaignError
        If the folder of published signals holds no such files.
    """
    studies = {
        "homogeneous path": homogeneous.measure_homogeneous(effort),
        "elastic inversion": elastic.measure_elastic_accuracy(effort),
        "scans over zenith angle": multiangle.measure_multiangle(effort),
        "networks of lidars": network.measure_network(effort),
    }
    beside = Results(
        "Ours beside the strongest peer",
        comparison.against_peers({name: study.works for name, study in studies.items()}),
        "All settings that peers solve too. Of methods whose errors differ by less than 2 Monte "
        "Carlo errors, the fastest; none that knows more than the profile. Ratios of ours over "
        "that of the peer; equal if the errors differ by less than 2 Monte Carlo errors.",
        case="error of",
        method="ours",
    )
    others = [
        replace(results, title=f"{name.split()[0].capitalize()}: {results.title}")
        for name, study in studies.items()
        for results in study.results[1:]
    ]
    tables = [study.results[0] for study in studies.values()]
    charts = [chart for study in studies.values() for chart in study.charts]
    works = [work for study in studies.values() for work in study.works]
    return Study([beside, *tables, *others], charts, works)


app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
BENCHMARKS: Final[dict[str, dict[str, Callable[[Effort], Study]]]] = {
    "accuracy": {
        "all": measure_all,
        "elastic": elastic.measure_elastic_accuracy,
        "homogeneous": homogeneous.measure_homogeneous,
        "multiangle": multiangle.measure_multiangle,
        "network": network.measure_network,
    },
    "throughput": {"homogeneous": retrievals.measure_solvers, "memory": memory.measure_memory},
    "stability": study.CASES,
}
"""Benchmarks by what they measure and case; the first case is the default."""
_OF_PUBLISHED: Final = ("accuracy elastic", "accuracy all")
"""Benchmarks that take the folder of published signals."""


@command(program=app)
def main(
    what: Annotated[str, typer.Argument(help="accuracy, throughput or stability", metavar="WHAT")],
    case: Annotated[
        str | None,
        typer.Option(help="all, elastic, homogeneous, memory, multiangle, network or raman."),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of the EARLINET elastic intercomparison, for the case elastic."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure less.")] = False,
    out: Annotated[
        str | None,
        typer.Option("--out", help="Folder for all numbers as JSON, and charts.", callback=no_url),
    ] = None,
) -> None:
    """Measure accuracy, throughput or stability.

    Accuracy compares errors with the least possible errors; throughput compares times with a floor
    measured in the same run; stability shows how often a wrong value
    has no flag, and fails with 1 where a target is missed. Its cases are homogeneous, signal,
    elastic, multiangle, network, raman, flags and light, or the name of a table.

    Example: python -m benchmarks accuracy --case homogeneous --quick --out bench

    Example: python -m benchmarks accuracy --case elastic --quick --data boeckmann
    """
    with progress_bar("bench") as bar:
        effort = Effort(quick, bar.advance, data)
        measured = measure(what, case, effort)
    written = None if out is None else measured.write(Path(out))
    for results in measured.results:
        table = results.table
        show_rows(results.title, table.columns, table.itertuples(index=False, name=None))
    if written is not None:
        typer.echo(f"all numbers: {written}")
    for target in measured.missed:
        typer.echo(f"missed: {target}", err=True)
    if measured.missed:
        raise typer.Exit(1)


def measure(what: str, case: str | None, effort: Effort) -> Study:
    """Run a benchmark, and state its date and CPU time.

    Raises
    ------
    CampaignError
        If there is no such benchmark, or it takes no folder of published signals.
    """
    if what not in BENCHMARKS:
        raise CampaignError(f"no benchmark {what!r}", remedy=f"choose: {' or '.join(BENCHMARKS)}")
    cases = BENCHMARKS[what]
    case = case or next(iter(cases))
    if case not in cases:
        raise CampaignError(f"no case {case!r} of {what}", remedy=f"choose: {' or '.join(cases)}")
    if effort.data and f"{what} {case}" not in _OF_PUBLISHED:
        raise CampaignError(
            f"is no option of {what} {case}", field="data",
            remedy=f"leave it out, or choose: {' or '.join(_OF_PUBLISHED)}",
        )  # fmt: skip
    begin, today = cpu_seconds(), datetime.now(UTC).date().isoformat()
    return replace(cases[case](effort), date=today, cpu_seconds=cpu_seconds() - begin)


if __name__ == "__main__":
    app(prog_name="python -m benchmarks")
