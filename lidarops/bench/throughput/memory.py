"""Peak memory of processes that process scenes of several sizes."""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from lidarops.bench.harness.benchmark import (
    CAMPAIGN_FILE,
    RESULT,
    BenchmarkKind,
    BenchmarkOutput,
    Effort,
    facts,
)
from lidarops.bench.harness.timing import Machine, machine
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.raw import licel_write
from lidarops.raw.licel_header import DatasetKind, Laser
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table
from lidarops.run import archive

BINS: Final = 16_000
SIZES: Final = (26, 101, 400)
"""MB of raw counts of a scene."""
_TINY: Final = 1
"""MB of the scene that loads the code of a process before the measurement."""
_SHOTS: Final = 400
_INTERVAL: Final = timedelta(seconds=20)
_DAY: Final = datetime(2025, 3, 20, tzinfo=UTC)
_BIN_WIDTH: Final = 3.75
_VARIANTS: Final = 4
"""Number of different profiles; files repeat them."""
_ELASTIC: Final[Mapping[str, Any]] = {"channels": ["analog_532o"], "lidar_ratio": 50}
_HOMOGENEOUS: Final[Mapping[str, Any]] = {
    "channels": ["photon_532o"],
    "sections": [[750, 6000], [1500, 9000]],
}
KINDS: Final[Mapping[str, tuple[int, Mapping[str, Any]]]] = {
    "signal": (0, {"signal": {}}),
    "elastic": (0, {"elastic": _ELASTIC}),
    "homogeneous": (90, {"homogeneous": _HOMOGENEOUS}),
    "signal and elastic": (0, {"signal": {}, "elastic": _ELASTIC}),
    "signal and homogeneous": (90, {"signal": {}, "homogeneous": _HOMOGENEOUS}),
}
"""Zenith angle and products of each campaign; all have the same files."""


@dataclass(frozen=True, slots=True)
class Peak:
    """Peak memory of one process."""

    kinds: str
    raw: float
    """MB of raw counts of the scene."""
    base: float
    """MB at the peak of a tiny scene of the same kinds."""
    above: float
    """MB above the base at the peak of the scene."""


@dataclass(frozen=True, slots=True)
class MemoryStudy:
    """Peak memory of processes, by size of the scene and kinds of products."""

    date: str
    machine: Machine
    peaks: tuple[Peak, ...]


def run_memory(kind: BenchmarkKind, *, effort: Effort) -> BenchmarkOutput:
    """Run the benchmark of memory.

    Raises
    ------
    CampaignError
        If its accuracy is requested.
    """
    if kind is not BenchmarkKind.THROUGHPUT:
        raise CampaignError("the case 'memory' has no accuracy", remedy="choose throughput")
    sizes = SIZES[:2] if effort.quick else SIZES
    peaks = []
    for peak in measure_peaks(sizes, tuple(KINDS)):
        peaks.append(peak)
        effort.progress(1)
    study = MemoryStudy(effort.date, machine(), tuple(peaks))
    return BenchmarkOutput(study, memory_report(study))


def measure_peaks(sizes: Sequence[int], kinds: Sequence[str]) -> Iterator[Peak]:
    """Yield the peak memory of a fresh process for each kind and size, MB of raw counts."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        root = Path(folder)
        for size in (_TINY, *sizes):
            write_files(root / str(size), size)
        for name in kinds:
            # The first process compiles what is not cached, which takes memory of its own.
            _in_fresh_process(root, name, _TINY)
            for size in sizes:
                yield _in_fresh_process(root, name, size)


def _in_fresh_process(root: Path, kinds: str, size: int) -> Peak:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak, root, kinds, size).result()


def _peak(root: Path, kinds: str, size: int) -> Peak:
    with tempfile.TemporaryDirectory(dir=root) as out:
        base = _peak_of_scene(root / str(_TINY), kinds, Path(out) / "tiny")
        above = _peak_of_scene(root / str(size), kinds, Path(out) / "scene") - base
    return Peak(kinds, float(size), base, above)


def _peak_of_scene(folder: Path, kinds: str, out: Path) -> float:
    """Process a scene; return the peak memory of this process so far, MB."""
    record = archive.reprocess(campaign_of(folder, kinds, out))
    if record is None or any(scene.error for scene in record.scenes):
        raise CampaignError("a scene of the benchmark gave no product", field=kinds)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def campaign_of(folder: Path, kinds: str, out: Path) -> Campaign:
    """Write the campaign file of some `KINDS` for a folder of raw files; return the campaign."""
    out.mkdir()
    file = out / CAMPAIGN_FILE
    file.write_text(yaml.safe_dump(_settings(*KINDS[kinds])), encoding="utf-8")
    return load_campaign(file, archive=str(folder), output=str(out))


def _settings(zenith_angle: int, products: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": "memory",
        "title": "Campaign of a benchmark",
        "archive": "raw",
        "output": "out",
        "stations": {"here": {"name": "Here", "latitude": 50, "longitude": 10, "altitude": 100}},
        "instruments": {
            "lidar": {
                "station": "here",
                "files": "h*",
                "facts": [{"full_overlap_range": 300, "zenith_angle": zenith_angle}],
                "products": {name: dict(settings) for name, settings in products.items()},
            }
        },
    }


def write_files(folder: Path, size: float) -> int:
    """Write the raw files of a scene of `size` MB of counts; return their number."""
    folder.mkdir(parents=True)
    layout: dict[str, Any] = {
        "wavelength": 532e-9,
        "bins": BINS,
        "bin_width": _BIN_WIDTH,
        "shots": _SHOTS,
    }
    kinds = (DatasetKind.ANALOG, DatasetKind.PHOTON)
    datasets = [licel_write.new_dataset(kind=kind, **layout) for kind in kinds]
    counts = _counts()
    number = round(size * 1e6 / (4 * BINS * len(kinds)))
    for index in range(number):
        start = _DAY + index * _INTERVAL
        header = licel_write.new_header(
            name=f"h{index:06d}",
            site="Here",
            start=start,
            stop=start + _INTERVAL,
            altitude=100,
            longitude=10,
            latitude=50,
            datasets=datasets,
            lasers=[Laser(_SHOTS, 20), Laser(0, 0)],
        )
        signal = counts[index % _VARIANTS]
        values = {dataset.name: signal for dataset in header.datasets}
        (folder / f"h{index:06d}").write_bytes(licel_write.encode(header, values))
    return number


def _counts() -> np.ndarray[Any, Any]:
    """Return noisy counts of a decaying signal, (profile, bin)."""
    distance = _BIN_WIDTH * (np.arange(BINS) + 0.5)
    expected = 40.0 + 2e4 * (1e3 / (distance + 300.0)) ** 2 * np.exp(-2e-4 * distance)
    return np.random.default_rng(7).poisson(expected, (_VARIANTS, BINS))


# Page -----------------------------------------------------------------------------------------


def memory_report(study: MemoryStudy) -> BenchmarkReport:
    """Return the report page."""
    return BenchmarkReport(
        title="Memory of a process, by size of the scene",
        facts=facts(study.date, study.machine),
        parts=(
            Part(
                title="Peak memory above the base of a process",
                text="Scenes of one analog and one photon-counting channel with "
                f"{BINS:,} bins, each in a fresh process. The base is the peak after a tiny scene "
                "of the same kinds, with imports and compiled code.",
                tables=(_table(study.peaks),),
            ),
        ),
        data=RESULT,
    )


def _table(peaks: Sequence[Peak]) -> Table:
    smallest = {peak.kinds: peak for peak in reversed(peaks)}
    rows = []
    for peak in peaks:
        first = smallest[peak.kinds]
        growth = (peak.above - first.above) / (peak.raw - first.raw) if peak is not first else None
        rows.append(
            (
                peak.kinds,
                f"{peak.raw:.0f}",
                f"{peak.base:.0f}",
                f"{peak.above:.0f}",
                "-" if growth is None else f"{growth:.2f}",
            )
        )
    return Table(
        title="Peak memory",
        columns=("products", "raw MB", "base MB", "above base MB", "slope"),
        rows=tuple(rows),
        note="Slope: growth above the base from the smallest scene, MB for 1 MB of raw counts.",
    )
