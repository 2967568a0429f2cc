"""The benchmarks by name: run one, write its result and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from lidarops.bench import all_retrievals
from lidarops.bench.accuracy import elastic, homogeneous, multiangle, network
from lidarops.bench.harness.benchmark import RESULT, BenchmarkKind, BenchmarkOutput, Effort
from lidarops.bench.harness.rows import Study
from lidarops.bench.throughput import archives, campaigns, memory, readers, retrievals
from lidarops.errors import CampaignError
from lidarops.reports.benchmark_page import build_benchmark_page
from lidarops.system.files import write_atomically

STABILITY: Final = "stability"
"""The benchmark that is no `BenchmarkKind`, because it has no cases to choose from."""

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
    if benchmark is Benchmark.MEMORY:
        return memory.run_memory(kind, effort=effort)
    studies = _accuracy(data) if kind is BenchmarkKind.ACCURACY else _throughput(files)
    if benchmark not in studies:
        raise CampaignError(
            f"the case {benchmark.value!r} has no {kind.value}",
            remedy=f"choose: {' or '.join(studies)}",
        )
    return studies[benchmark](effort).output()


_Studies = Mapping[Benchmark, Callable[[Effort], Study]]


def _accuracy(data: Path | None) -> _Studies:
    return {
        Benchmark.ALL: partial(all_retrievals.measure_all, data=data),
        Benchmark.ELASTIC: partial(elastic.measure_elastic_accuracy, data=data),
        Benchmark.HOMOGENEOUS: homogeneous.measure_homogeneous,
        Benchmark.MULTIANGLE: multiangle.measure_multiangle,
        Benchmark.NETWORK: network.measure_network,
    }


def _throughput(files: Sequence[Path]) -> _Studies:
    return {
        Benchmark.ARCHIVE: archives.measure_archives,
        Benchmark.CAMPAIGNS: campaigns.measure_campaigns,
        Benchmark.ELASTIC: retrievals.measure_elastic,
        Benchmark.HOMOGENEOUS: retrievals.measure_solvers,
        Benchmark.MULTIANGLE: retrievals.measure_scans,
        Benchmark.NETWORK: retrievals.measure_networks,
        Benchmark.READER: partial(readers.measure_readers, paths=files),
    }


def write_benchmark(output: BenchmarkOutput, folder: Path) -> Path:
    """Write the result of a benchmark as JSON, and its page; return the path of the page.

    Raises
    ------
    CatalogError
        If the folder cannot be written.
    """
    page = build_benchmark_page(output.report, folder)
    write_atomically(folder / RESULT, output.json().encode())
    return page


def _member(names: type[_Names], value: str, what: str, *other_choices: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        choices = " or ".join((*names, *other_choices))
        raise CampaignError(f"no {what} {value!r}", remedy=f"choose: {choices}") from None
