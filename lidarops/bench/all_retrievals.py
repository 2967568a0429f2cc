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
    elastic_report,
    homogeneous,
    homogeneous_report,
    multiangle_report,
    multiangle_scores,
    network,
    network_report,
)
from lidarops.bench.accuracy.elastic import Elastic
from lidarops.bench.accuracy.homogeneous import Accuracy
from lidarops.bench.accuracy.multiangle_scores import MultiAngle
from lidarops.bench.accuracy.network_scores import NetworkAccuracy
from lidarops.bench.harness.benchmark import Effort, study_page
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
    homogeneous: Accuracy
    elastic: Elastic
    multiangle: MultiAngle
    network: NetworkAccuracy


def measure_all(effort: Effort, *, data: Path | None = None) -> AllRetrievals:
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
    paths = homogeneous.measure_homogeneous(effort)
    vertical = elastic.measure_elastic_accuracy(effort, data=data)
    scans = multiangle_scores.measure_multiangle(effort)
    networks = network.measure_network(effort)
    return AllRetrievals(
        date=effort.date,
        machine=machine(),
        baselines=tuple(_baselines()),
        works=overview.work_precision_rows(paths, vertical, scans, networks),
        homogeneous=paths,
        elastic=vertical,
        multiangle=scans,
        network=networks,
    )


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


def all_retrievals_report(result: AllRetrievals) -> BenchmarkReport:
    """Return the page of all retrievals."""
    reports = {
        "homogeneous": homogeneous_report.homogeneous_accuracy_report(result.homogeneous),
        "elastic": elastic_report.elastic_accuracy_report(result.elastic),
        "multiangle": multiangle_report.multiangle_accuracy_report(result.multiangle),
        "network": network_report.network_accuracy_report(result.network),
    }
    chapters = [_prefixed(part, name) for name, report in reports.items() for part in report.parts]
    return study_page(
        "All retrievals: error against run time",
        result,
        overview.overview(result.works, result.baselines),
        *chapters,
    )


def _prefixed(chapter: Part, name: str) -> Part:
    """Return a chapter with the retrieval in its title and file names, which makes them unique."""
    charts = tuple(replace(chart, name=f"{name}-{chart.name}") for chart in chapter.charts)
    return replace(chapter, title=f"{name.capitalize()}: {chapter.title}", charts=charts)
