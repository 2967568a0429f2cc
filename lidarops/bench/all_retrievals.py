"""Error against run time of all retrievals, on one page."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from lidarops.bench import overview
from lidarops.bench.accuracy import (
    elastic,
    homogeneous_report,
    multiangle_report,
    network,
    network_report,
)
from lidarops.bench.accuracy import (
    homogeneous as accuracy,
)
from lidarops.bench.accuracy.elastic import Elastic
from lidarops.bench.accuracy.multiangle_scores import MultiAngle
from lidarops.bench.accuracy.multiangle_scores import measure_multiangle as measure_scans
from lidarops.bench.accuracy.network_scores import NetworkAccuracy
from lidarops.bench.harness.benchmark import RESULT, BenchmarkOutput, Effort, facts
from lidarops.bench.harness.timing import Machine, least_times, machine
from lidarops.bench.overview import Baseline, WorkPrecision
from lidarops.reports.benchmark_page import BenchmarkReport, Part

_PROFILES: Final = 500
_BINS: Final = 4096
_CHANNELS: Final = 12
_ROUNDS: Final = 9


@dataclass(frozen=True, slots=True)
class AllRetrievals:
    """Accuracy results of all retrievals."""

    date: str
    machine: Machine
    baselines: tuple[Baseline, ...]
    works: tuple[WorkPrecision, ...]
    homogeneous: accuracy.Accuracy
    elastic: Elastic
    multiangle: MultiAngle
    network: NetworkAccuracy


def run_all_retrievals(effort: Effort, *, data: Path | None = None) -> BenchmarkOutput:
    """Measure error against run time of all retrievals.

    Parameters
    ----------
    effort : Effort
    data : Path, optional
        Folder of published signals, for the elastic retrieval.

    Raises
    ------
    CampaignError
        If the folder holds no such files.
    RawFormatError
        If a published file cannot be read.
    """
    quick, date, progress = effort.quick, effort.date, effort.progress
    paths = accuracy.measure_homogeneous(quick=quick, date=date, progress=progress)
    vertical = elastic.measure_elastic_accuracy(
        quick=quick, date=date, data=data, progress=progress
    )
    scans = measure_scans(quick=quick, date=date, progress=progress)
    networks = network.measure_network(
        quick=quick, date=date, repeats=effort.repeats, progress=progress
    )
    result = AllRetrievals(
        date=date,
        machine=machine(),
        baselines=tuple(_baselines()),
        works=overview.work_precision_rows(paths, vertical, scans, networks),
        homogeneous=paths,
        elastic=vertical,
        multiangle=scans,
        network=networks,
    )
    return BenchmarkOutput(result, _report(result))


def _baselines() -> Iterator[Baseline]:
    profiles = np.random.default_rng(0).random((_PROFILES, _BINS), np.float32)
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        file = Path(folder) / "counts"
        file.write_bytes(np.zeros((_CHANNELS, _BINS), np.int32).tobytes())
        times = least_times({"memory": lambda: np.max(profiles), "file": file.read_bytes}, _ROUNDS)
    yield Baseline(
        f"read a profile of {_BINS} float32 in memory (np.max)", 1e9 * times["memory"] / _PROFILES
    )
    yield Baseline(
        f"read a file of {_CHANNELS} channels of {_BINS} bins from the page cache",
        1e9 * times["file"],
    )


def _report(result: AllRetrievals) -> BenchmarkReport:
    reports = (
        (
            "Homogeneous path",
            "homogeneous",
            homogeneous_report.homogeneous_accuracy_report(result.homogeneous),
        ),
        ("Elastic inversion", "elastic", elastic.elastic_accuracy_report(result.elastic)),
        ("Scans", "multiangle", multiangle_report.multiangle_accuracy_report(result.multiangle)),
        ("Networks", "network", network_report.network_accuracy_report(result.network)),
    )
    chapters = [
        _prefixed(chapter, title, name)
        for title, name, report in reports
        for chapter in report.parts
    ]
    return BenchmarkReport(
        title="All retrievals: error against run time",
        facts=facts(result.date, result.machine),
        parts=(overview.overview(result.works, result.baselines), *chapters),
        data=RESULT,
    )


def _prefixed(chapter: Part, title: str, name: str) -> Part:
    """Return a chapter with the retrieval in its title and file names, which makes them unique."""
    charts = tuple(replace(chart, name=f"{name}-{chart.name}") for chart in chapter.charts)
    return replace(chapter, title=f"{title}: {chapter.title}", charts=charts)
