"""The benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Final, TypeVar

from lidarops.bench import all_retrievals
from lidarops.bench.accuracy import (
    elastic,
    homogeneous,
    homogeneous_report,
    multiangle_report,
    network,
)
from lidarops.bench.harness import results
from lidarops.bench.harness.terms import RESULT, Effort, Finding, Kind
from lidarops.bench.harness.timing import machine
from lidarops.bench.throughput import (
    archives,
    campaigns,
    cost_calibration,
    readers,
    retrievals,
)
from lidarops.errors import CampaignError
from lidarops.reports import benchmark_page

STABILITY: Final = "stability"
"""The benchmark that is no `Kind`: it has no cases to choose from."""
_REPEATS: Final = 7

_Names = TypeVar("_Names", bound=StrEnum)


class Benchmark(StrEnum):
    """What is measured."""

    ALL = "all"
    ARCHIVE = "archive"
    COSTS = "costs"
    ELASTIC = "elastic"
    HOMOGENEOUS = "homogeneous"
    MULTIANGLE = "multiangle"
    MULTIPOSITION = "multiposition"
    PIPELINE = "pipeline"
    READER = "reader"


def run_benchmark(
    what: str,
    case: str | None,
    files: Sequence[Path],
    effort: Effort,
    *,
    data: Path | None = None,
) -> Finding:
    """Run a benchmark.

    Parameters
    ----------
    what : {"accuracy", "throughput"}
    case : Case or str, optional
        None is "reader" where files are given; else all retrievals on one page for the accuracy,
        and "homogeneous" for the throughput.
    files : sequence of Path
        Raw files of one layout, for "reader" and no other.
    effort : Effort
    data : Path, optional
        Folder of published signals, for the accuracy of "elastic" or of all.

    Raises
    ------
    CampaignError
        Where there is no such benchmark, or the case takes no files.
    RawFormatError
        Where "reader" gets no file, or one that cannot be read.
    """
    kind = _member(Kind, what, "benchmark", STABILITY)
    usual = Benchmark.ALL if kind is Kind.ACCURACY else Benchmark.HOMOGENEOUS
    chosen = _member(Benchmark, case or (Benchmark.READER if files else usual), "case")
    _check(kind, chosen, files, data)
    ways: dict[Benchmark, Callable[[], Finding]] = {
        Benchmark.ALL: lambda: all_retrievals.run_all_retrievals(effort, data=data),
        Benchmark.ARCHIVE: lambda: archives.run_archives(kind, effort=effort),
        Benchmark.COSTS: lambda: cost_calibration.run_cost_calibration(kind, effort=effort),
        Benchmark.ELASTIC: lambda: elastic.run_elastic(kind, data=data, effort=effort),
        Benchmark.HOMOGENEOUS: lambda: _homogeneous(kind, effort),
        Benchmark.MULTIANGLE: lambda: multiangle_report.run_multiangle(kind, effort=effort),
        Benchmark.MULTIPOSITION: lambda: network.run_network(kind, effort=effort),
        Benchmark.PIPELINE: lambda: campaigns.run_campaigns(kind, effort=effort),
        Benchmark.READER: lambda: _reader(files, effort),
    }
    return ways[chosen]()


def _reader(files: Sequence[Path], effort: Effort) -> Finding:
    read = readers.reader(files, repeats=effort.repeats or _REPEATS)
    return Finding(read, homogeneous_report.reader_report(read, effort.date, machine(), RESULT))


def _homogeneous(kind: Kind, effort: Effort) -> Finding:
    if kind is Kind.ACCURACY:
        found = homogeneous.measure_homogeneous(
            quick=effort.quick, date=effort.date, progress=effort.progress
        )
        return Finding(found, homogeneous_report.homogeneous_accuracy_report(found, RESULT))
    timed = retrievals.measure_solvers(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return Finding(timed, homogeneous_report.homogeneous_throughput_report(timed, RESULT))


def _check(kind: Kind, case: Benchmark, files: Sequence[Path], data: Path | None) -> None:
    if case is Benchmark.READER and kind is Kind.ACCURACY:
        raise CampaignError("the reader has no accuracy benchmark", remedy="choose throughput")
    if case is Benchmark.ALL and kind is Kind.THROUGHPUT:
        raise CampaignError("all retrievals at once have no throughput", remedy="choose a case")
    if case is not Benchmark.READER and files:
        raise CampaignError(f"the case {case.value!r} takes no files", remedy="leave them out")
    if data is not None and (
        case not in {Benchmark.ELASTIC, Benchmark.ALL} or kind is not Kind.ACCURACY
    ):
        raise CampaignError(
            "is for the accuracy of the case 'elastic'", field="data", remedy="leave it out"
        )


def write_benchmark(finding: Finding, folder: Path) -> Path:
    """Write the figures as JSON and the page of a benchmark; return the page.

    Raises
    ------
    CatalogError
        Where the folder cannot be written.
    """
    results.save(finding.result, folder / RESULT)
    return benchmark_page.build_benchmark_page(finding.report, folder)


def _member(names: type[_Names], value: str, what: str, *others: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        choices = " or ".join((*names, *others))
        raise CampaignError(f"no {what} {value!r}", remedy=f"choose: {choices}") from None
