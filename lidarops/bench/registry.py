"""The benchmarks by name: run one, write its result and page."""

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
    multiangle_scores,
    network,
    network_report,
)
from lidarops.bench.harness import results
from lidarops.bench.harness.benchmark import RESULT, BenchmarkKind, BenchmarkOutput, Effort
from lidarops.bench.harness.timing import machine
from lidarops.bench.throughput import (
    archives,
    campaigns,
    cost_calibration,
    memory,
    networks,
    readers,
    retrieval_reports,
    retrievals,
    scan_kernels,
    scan_report,
)
from lidarops.errors import CampaignError
from lidarops.reports import benchmark_page

STABILITY: Final = "stability"
"""The benchmark that is no `BenchmarkKind`, because it has no cases to choose from."""
_REPEATS: Final = 7

_Names = TypeVar("_Names", bound=StrEnum)


class Benchmark(StrEnum):
    """Case of a benchmark."""

    ALL = "all"
    ARCHIVE = "archive"
    CAMPAIGNS = "campaigns"
    COSTS = "costs"
    ELASTIC = "elastic"
    HOMOGENEOUS = "homogeneous"
    MEMORY = "memory"
    MULTIANGLE = "multiangle"
    NETWORK = "network"
    READER = "reader"


def run_benchmark(
    what: str,
    case: str | None,
    files: Sequence[Path],
    effort: Effort,
    *,
    data: Path | None = None,
) -> BenchmarkOutput:
    """Run a benchmark and return its result and page.

    Parameters
    ----------
    what : {"accuracy", "throughput"}
    case : Benchmark or str, optional
        None means "reader" if files are given, else "all" for the accuracy and "homogeneous" for
        the throughput.
    files : sequence of Path
        Raw files of one layout, only for "reader".
    effort : Effort
    data : Path, optional
        Folder of published signals, for the accuracy of "elastic" or "all".

    Raises
    ------
    CampaignError
        If there is no such benchmark, or the case takes no files.
    RawFormatError
        If "reader" gets no file, or one that cannot be read.
    """
    kind = _member(BenchmarkKind, what, "benchmark", STABILITY)
    default = Benchmark.ALL if kind is BenchmarkKind.ACCURACY else Benchmark.HOMOGENEOUS
    benchmark = _member(Benchmark, case or (Benchmark.READER if files else default), "case")
    _check(kind, benchmark, files, data)
    runs: dict[Benchmark, Callable[[], BenchmarkOutput]] = {
        Benchmark.ALL: lambda: all_retrievals.run_all_retrievals(effort, data=data),
        Benchmark.ARCHIVE: lambda: archives.run_archives(kind, effort=effort),
        Benchmark.CAMPAIGNS: lambda: campaigns.run_campaigns(kind, effort=effort),
        Benchmark.COSTS: lambda: cost_calibration.run_cost_calibration(kind, effort=effort),
        Benchmark.ELASTIC: lambda: _elastic(kind, data, effort),
        Benchmark.HOMOGENEOUS: lambda: _homogeneous(kind, effort),
        Benchmark.MEMORY: lambda: memory.run_memory(kind, effort=effort),
        Benchmark.MULTIANGLE: lambda: _multiangle(kind, effort),
        Benchmark.NETWORK: lambda: _network(kind, effort),
        Benchmark.READER: lambda: _reader(files, effort),
    }
    return runs[benchmark]()


def _reader(files: Sequence[Path], effort: Effort) -> BenchmarkOutput:
    rates = readers.measure_readers(files, repeats=effort.repeats or _REPEATS)
    return BenchmarkOutput(
        rates, retrieval_reports.reader_report(rates, effort.date, machine(), RESULT)
    )


def _homogeneous(kind: BenchmarkKind, effort: Effort) -> BenchmarkOutput:
    if kind is BenchmarkKind.ACCURACY:
        accuracy = homogeneous.measure_homogeneous(
            quick=effort.quick, date=effort.date, progress=effort.progress
        )
        return BenchmarkOutput(
            accuracy, homogeneous_report.homogeneous_accuracy_report(accuracy, RESULT)
        )
    throughput = retrievals.measure_solvers(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return BenchmarkOutput(
        throughput, retrieval_reports.homogeneous_throughput_report(throughput, RESULT)
    )


def _elastic(kind: BenchmarkKind, data: Path | None, effort: Effort) -> BenchmarkOutput:
    if kind is BenchmarkKind.ACCURACY:
        accuracy = elastic.measure_elastic_accuracy(
            quick=effort.quick, date=effort.date, data=data, progress=effort.progress
        )
        return BenchmarkOutput(accuracy, elastic.elastic_accuracy_report(accuracy, RESULT))
    throughput = retrievals.measure_elastic(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return BenchmarkOutput(
        throughput, retrieval_reports.elastic_throughput_report(throughput, RESULT)
    )


def _multiangle(kind: BenchmarkKind, effort: Effort) -> BenchmarkOutput:
    if kind is BenchmarkKind.ACCURACY:
        accuracy = multiangle_scores.measure_multiangle(
            quick=effort.quick, date=effort.date, progress=effort.progress
        )
        return BenchmarkOutput(
            accuracy, multiangle_report.multiangle_accuracy_report(accuracy, RESULT)
        )
    throughput = scan_kernels.measure_scan_kernels(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return BenchmarkOutput(throughput, scan_report.multiangle_throughput_report(throughput, RESULT))


def _network(kind: BenchmarkKind, effort: Effort) -> BenchmarkOutput:
    if kind is BenchmarkKind.ACCURACY:
        accuracy = network.measure_network(
            quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
        )
        return BenchmarkOutput(accuracy, network_report.network_accuracy_report(accuracy, RESULT))
    throughput = networks.measure_network_throughput(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return BenchmarkOutput(throughput, networks.network_throughput_report(throughput, RESULT))


def _check(kind: BenchmarkKind, case: Benchmark, files: Sequence[Path], data: Path | None) -> None:
    if case is Benchmark.READER and kind is BenchmarkKind.ACCURACY:
        raise CampaignError("the reader has no accuracy benchmark", remedy="choose throughput")
    if case is Benchmark.ALL and kind is BenchmarkKind.THROUGHPUT:
        raise CampaignError("the case 'all' has no throughput", remedy="choose another case")
    if case is not Benchmark.READER and files:
        raise CampaignError(f"the case {case.value!r} takes no files", remedy="leave them out")
    if data is not None and (
        case not in {Benchmark.ELASTIC, Benchmark.ALL} or kind is not BenchmarkKind.ACCURACY
    ):
        raise CampaignError(
            "is for the accuracy of the case 'elastic'", field="data", remedy="leave it out"
        )


def write_benchmark(output: BenchmarkOutput, folder: Path) -> Path:
    """Write the result of a benchmark as JSON, and its page; return the path of the page.

    Raises
    ------
    CatalogError
        If the folder cannot be written.
    """
    results.save(output.result, folder / RESULT)
    return benchmark_page.build_benchmark_page(output.report, folder)


def _member(names: type[_Names], value: str, what: str, *other_choices: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        choices = " or ".join((*names, *other_choices))
        raise CampaignError(f"no {what} {value!r}", remedy=f"choose: {choices}") from None
