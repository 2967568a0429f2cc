"""The benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TypeVar

from benchmarks import all_retrievals
from benchmarks.accuracy import elastic, homogeneous, multiangle, network
from benchmarks.harness.results import BenchmarkKind, Effort, Study
from benchmarks.harness.timing import cpu_seconds
from benchmarks.stability import study
from benchmarks.throughput import (
    archives,
    campaigns,
    memory,
    raman_night,
    readers,
    retrievals,
)
from lidarops.errors import CampaignError

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
    RAMAN = "raman"
    READER = "reader"


def run_benchmark(
    what: str,
    case: str | None,
    files: Sequence[Path],
    effort: Effort,
    *,
    data: Path | None = None,
) -> Study:
    """Run a benchmark, and measure its CPU time.

    Parameters
    ----------
    what : {"accuracy", "throughput", "stability"}
    case : Benchmark or str, optional
        None means "reader" if files are given, else "all" for the accuracy and "homogeneous" for
        the throughput. The stability has its own cases, and None means all.
    files : sequence of Path
        Raw files of one layout, only for "reader".
    effort : Effort
    data : Path, optional
        Folder of published signals, for the accuracy of "elastic" or "all".

    Raises
    ------
    CampaignError
        If there is no such benchmark, or it has no such option.
    RawFormatError
        If "reader" gets no file, or one that cannot be read.
    """
    kind = _member(BenchmarkKind, what, "benchmark")
    begin = cpu_seconds()
    if kind is BenchmarkKind.STABILITY:
        options = {"files": files, "data": data, "repeats": effort.repeats}
        for name, value in options.items():
            _refuse(name, value, "is no option of the benchmark 'stability'")
        result = study.measure_stability(effort, case=case)
        return replace(result, cpu_seconds=cpu_seconds() - begin)
    default = Benchmark.ALL if kind is BenchmarkKind.ACCURACY else Benchmark.HOMOGENEOUS
    benchmark = _member(Benchmark, case or (Benchmark.READER if files else default), "case")
    if benchmark is not Benchmark.READER:
        _refuse("files", files, f"the case {benchmark.value!r} takes no files")
    if benchmark not in {Benchmark.ELASTIC, Benchmark.ALL} or kind is BenchmarkKind.THROUGHPUT:
        _refuse("data", data, "is for the accuracy of the case 'elastic'")
    studies = _accuracy(data) if kind is BenchmarkKind.ACCURACY else _throughput(files)
    if benchmark not in studies:
        raise CampaignError(
            f"the case {benchmark.value!r} has no {kind.value}",
            remedy=f"choose: {' or '.join(studies)}",
        )
    return replace(studies[benchmark](effort), cpu_seconds=cpu_seconds() - begin)


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
        Benchmark.HOMOGENEOUS: retrievals.measure_solvers,
        Benchmark.MEMORY: memory.measure_memory,
        Benchmark.RAMAN: raman_night.measure_raman,
        Benchmark.READER: partial(readers.measure_readers, paths=files),
    }


def _refuse(option: str, value: object, problem: str) -> None:
    if value:
        raise CampaignError(problem, field=option, remedy="leave it out")


def _member(names: type[_Names], value: str, what: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        raise CampaignError(
            f"no {what} {value!r}", remedy=f"choose: {' or '.join(names)}"
        ) from None
