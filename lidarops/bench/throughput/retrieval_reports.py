"""Report pages of the throughput of readers, of a homogeneous path and of elastic inversions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from lidarops.bench.accuracy.elastic_costs import cost_part
from lidarops.bench.harness.benchmark import facts
from lidarops.bench.harness.timing import READ, Machine
from lidarops.bench.throughput import readers
from lidarops.bench.throughput.retrievals import (
    ElasticThroughput,
    Setting,
    SolverThroughput,
    Speed,
    settings,
)
from lidarops.figures.charts import Ladder
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

_UNSOLVED: Final = "-"


def reader_report(
    result: Sequence[readers.ReaderThroughput], date: str, machine: Machine, data: str = ""
) -> BenchmarkReport:
    """Return the page of the reader's benchmark."""
    table = Table(
        title="Throughput, one core, CPU time",
        columns=("what", "files/s", "MB/s", "times floor"),
        rows=tuple(
            (
                rate.name,
                f"{rate.files_per_second:,.0f}",
                f"{rate.megabytes_per_second:,.0f}",
                f"{rate.times_floor:.2f}",
            )
            for rate in result
        ),
    )
    text = "Raw files to arrays, from the page cache, against floors measured in the same run."
    return BenchmarkReport(
        title="Reader: files per second",
        facts=facts(date, machine),
        parts=(Part("Throughput", text, tables=(table,)),),
        data=data,
    )


def homogeneous_throughput_report(result: SolverThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the throughput benchmark."""
    return BenchmarkReport(
        title="Homogeneous path: time per profile",
        facts=facts(result.date, result.machine),
        parts=(_times(result), _threads(result)),
        data=data,
    )


def _times(result: SolverThroughput) -> Part:
    by_setting = {setting: _speeds(result, setting) for setting in settings()}
    names = list(dict.fromkeys(speed.method for speed in result.speeds))
    return Part(
        title="CPU time per profile",
        text=f"Path {result.path.label}, {result.path.bins} bins; all outputs and flags, one "
        "thread, least CPU time of interleaved repeats. The read is a vectorised maximum of the "
        "same array in the same run. JAX and numba are timed once compiled.",
        charts=(_ladder(names, by_setting),),
        tables=tuple(_speed_table(setting, speeds) for setting, speeds in by_setting.items()),
    )


def _speeds(result: SolverThroughput, setting: Setting) -> dict[str, Speed]:
    return {speed.method: speed for speed in result.speeds if speed.setting == setting}


def _ladder(names: Sequence[str], result: Mapping[Setting, Mapping[str, Speed]]) -> Ladder:
    return Ladder(
        name="time",
        title="CPU time per profile of 225 bins",
        caption="All methods with a given variance; the read is the floor.",
        x_label="CPU time per profile (ns)",
        rows=tuple(names),
        series=tuple(
            (
                f"{setting.dtype}, {'gaps' if setting.missing else 'dense'}",
                tuple(speeds[name].nanoseconds if name in speeds else None for name in names),
            )
            for setting, speeds in result.items()
            if setting.known_variance
        ),
    )


def _speed_table(setting: Setting, speeds: Mapping[str, Speed]) -> Table:
    best = speeds.get(HomogeneousMethod.COMPRESSED)
    return Table(
        title=setting.label,
        columns=("method", "profiles", "ns each", "reads", "ratio"),
        rows=tuple(
            (
                speed.method,
                f"{speed.profiles:,}",
                f"{speed.nanoseconds:,.1f}",
                f"{speed.reads:,.2f}",
                f"{speed.nanoseconds / best.nanoseconds:,.2f}" if best else _UNSOLVED,
            )
            for speed in speeds.values()
        ),
        note=f"Reads: multiples of {READ}. Ratio: to the compressed method. Profiles: per call.",
    )


def _threads(result: SolverThroughput) -> Part:
    return Part(
        title="Two threads",
        text="Wall time of one thread over that of two threads with half of the profiles each. It "
        "is meaningful only on a machine with two idle cores.",
        tables=(
            Table(
                title="Gain of two threads",
                columns=("method", "data", "gain"),
                rows=tuple((t.method, t.dtype, f"{t.gain:.2f}") for t in result.threads),
            ),
        ),
    )


def elastic_throughput_report(result: ElasticThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the elastic throughput benchmark."""
    return BenchmarkReport(
        title="Elastic inversion: time per profile",
        facts=facts(result.date, result.machine),
        parts=(cost_part(result.costs, result.bins),),
        data=data,
    )
