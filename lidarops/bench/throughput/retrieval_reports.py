"""Report pages of the throughput of readers and retrievals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lidarops.bench.accuracy.elastic_report import elastic_cost_part
from lidarops.bench.accuracy.network_report import cycles_part, rates_table
from lidarops.bench.harness.benchmark import RESULT, facts, study_page
from lidarops.bench.harness.rows import (
    OF_TIMES,
    Quantity,
    cost_part,
    rows_of,
    step_rows,
    table,
)
from lidarops.bench.harness.timing import Machine
from lidarops.bench.throughput.networks import NetworkThroughput
from lidarops.bench.throughput.readers import ReaderThroughput
from lidarops.bench.throughput.retrievals import ElasticThroughput, SolverThroughput
from lidarops.bench.throughput.scan_kernels import MultiAngleThroughput
from lidarops.reports.benchmark_page import BenchmarkReport, Part

_OF_READER: Final = (
    Quantity("files/s", "files_per_second"),
    Quantity("MB/s", "megabytes_per_second"),
    Quantity("times floor", "times_floor"),
)


def reader_report(
    result: Sequence[ReaderThroughput], date: str, machine: Machine
) -> BenchmarkReport:
    """Return the page of the reader's benchmark."""
    rows = [row for rate in result for row in rows_of("", rate.name, rate, _OF_READER)]
    text = "Raw files to arrays, from the page cache, against floors measured in the same run."
    part = Part("Throughput", text, tables=(table("One core, CPU time", rows, method="what"),))
    return BenchmarkReport("Reader: files per second", facts(date, machine), (part,), RESULT)


def homogeneous_throughput_report(result: SolverThroughput) -> BenchmarkReport:
    """Return the page of the throughput of a homogeneous path."""
    rows = [r for s in result.speeds for r in rows_of(s.setting.label, s.method, s, OF_TIMES)]
    gains = [
        row
        for threads in result.threads
        for row in rows_of(threads.dtype, threads.method, threads, (Quantity("gain", "gain"),))
    ]
    return study_page(
        "Homogeneous path: time per profile",
        result,
        cost_part(
            "time",
            f"Path {result.path.label}, {result.path.bins} bins; all outputs and flags, one "
            "thread, least CPU time of interleaved repeats. JAX and numba are timed once "
            "compiled.",
            rows,
        ),
        Part(
            title="Two threads",
            text="Wall time of one thread over that of two threads with half of the profiles "
            "each. It is meaningful only on a machine with two idle cores.",
            tables=(table("Gain of two threads", gains, case="data"),),
        ),
    )


def elastic_throughput_report(result: ElasticThroughput) -> BenchmarkReport:
    """Return the page of the throughput of elastic inversions."""
    return study_page(
        "Elastic inversion: time per profile",
        result,
        elastic_cost_part(result.costs),
    )


def multiangle_throughput_report(result: MultiAngleThroughput) -> BenchmarkReport:
    """Return the page of the throughput of retrievals from scans."""
    return study_page(
        "Scans: time per profile",
        result,
        cost_part(
            "multiangle-time",
            f"Clear air, {result.angles} angles, {result.altitudes} altitudes, float64, one "
            "thread, least CPU time of interleaved repeats. make_beams, regress and "
            "vertical.smooth are steps; the others are complete retrievals, with all errors, "
            "residuals and flags. Plain: without the robust passes, which a single residual "
            "too large for chance starts, and which take more time than all other steps. The "
            "peers give values without flags, lstsq also standard errors.",
            step_rows(result.costs),
        ),
    )


def network_throughput_report(result: NetworkThroughput) -> BenchmarkReport:
    """Return the page of the throughput of networks of lidars."""
    return study_page(
        "Networks of lidars: time per cycle and per profile",
        result,
        cycles_part(result.cycles),
        Part(
            title="Whole profiles",
            text="From signals to extinction with errors, visibility and flags: point values, "
            "integrals and their covariances, and the solution. One thread. Two threads with "
            f"half of the cycles of 3 beams each are {result.gain:.2f} times as fast in wall "
            "time, which is meaningful only on a machine with two idle cores.",
            tables=(rates_table("CPU time of a profile", result.profiles),),
        ),
    )
