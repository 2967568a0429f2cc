"""The benchmarks by name: run one, write its result and page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from lidarops.bench import all_retrievals
from lidarops.bench.accuracy import (
    elastic,
    elastic_report,
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
    memory,
    networks,
    readers,
    retrieval_reports,
    retrievals,
    scan_kernels,
)
from lidarops.errors import CampaignError
from lidarops.reports.benchmark_page import BenchmarkReport, build_benchmark_page

STABILITY: Final = "stability"
"""The benchmark that is no `BenchmarkKind`, because it has no cases to choose from."""
_REPEATS: Final = 7

_Names = TypeVar("_Names", bound=StrEnum)


class Benchmark(StrEnum):
    """Case of a benchmark."""

    ALL = "all"
    ARCHIVE = "archive"
    CAMPAIGNS = "campaigns"
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
    if benchmark is not Benchmark.READER and files:
        raise CampaignError(f"the case {benchmark.value!r} takes no files", remedy="leave them out")
    published = benchmark in {Benchmark.ELASTIC, Benchmark.ALL} and kind is BenchmarkKind.ACCURACY
    if data is not None and not published:
        raise CampaignError(
            "is for the accuracy of the case 'elastic'", field="data", remedy="leave it out"
        )
    if benchmark is Benchmark.READER and kind is BenchmarkKind.THROUGHPUT:
        return _reader(files, effort)
    if benchmark is Benchmark.MEMORY:
        return memory.run_memory(kind, effort=effort)
    studies = _accuracy(data) if kind is BenchmarkKind.ACCURACY else _throughput()
    if benchmark not in studies:
        raise CampaignError(
            f"the case {benchmark.value!r} has no {kind.value}",
            remedy=f"choose: {' or '.join(studies)}",
        )
    measure, report = studies[benchmark]
    result = measure(effort)
    return BenchmarkOutput(result, report(result))


_Study = tuple[Callable[..., Any], Callable[[Any], BenchmarkReport]]
"""Measures with an `Effort`, and makes the page of the result."""


def _accuracy(data: Path | None) -> dict[Benchmark, _Study]:
    measure_all = partial(all_retrievals.measure_all, data=data)
    measure_elastic = partial(elastic.measure_elastic_accuracy, data=data)
    return {
        Benchmark.ALL: (measure_all, all_retrievals.all_retrievals_report),
        Benchmark.ELASTIC: (measure_elastic, elastic_report.elastic_accuracy_report),
        Benchmark.HOMOGENEOUS: (
            homogeneous.measure_homogeneous,
            homogeneous_report.homogeneous_accuracy_report,
        ),
        Benchmark.MULTIANGLE: (
            multiangle_scores.measure_multiangle,
            multiangle_report.multiangle_accuracy_report,
        ),
        Benchmark.NETWORK: (network.measure_network, network_report.network_accuracy_report),
    }


def _throughput() -> dict[Benchmark, _Study]:
    return {
        Benchmark.ARCHIVE: (archives.measure_archives, archives.archives_report),
        Benchmark.CAMPAIGNS: (campaigns.measure_campaigns, campaigns.campaigns_report),
        Benchmark.ELASTIC: (
            retrievals.measure_elastic,
            retrieval_reports.elastic_throughput_report,
        ),
        Benchmark.HOMOGENEOUS: (
            retrievals.measure_solvers,
            retrieval_reports.homogeneous_throughput_report,
        ),
        Benchmark.MULTIANGLE: (
            scan_kernels.measure_scan_kernels,
            retrieval_reports.multiangle_throughput_report,
        ),
        Benchmark.NETWORK: (
            networks.measure_network_throughput,
            retrieval_reports.network_throughput_report,
        ),
    }


def _reader(files: Sequence[Path], effort: Effort) -> BenchmarkOutput:
    rates = readers.measure_readers(files, repeats=effort.repeats or _REPEATS)
    return BenchmarkOutput(rates, retrieval_reports.reader_report(rates, effort.date, machine()))


def write_benchmark(output: BenchmarkOutput, folder: Path) -> Path:
    """Write the result of a benchmark as JSON, and its page; return the path of the page.

    Raises
    ------
    CatalogError
        If the folder cannot be written.
    """
    results.save(output.result, folder / RESULT)
    return build_benchmark_page(output.report, folder)


def _member(names: type[_Names], value: str, what: str, *other_choices: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        choices = " or ".join((*names, *other_choices))
        raise CampaignError(f"no {what} {value!r}", remedy=f"choose: {choices}") from None
