"""Peak memory of processes that process scenes of several sizes."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from benchmarks.harness.figure import Scores
from benchmarks.harness.results import Effort, Results, Study
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.raw.licel import DatasetKind, Laser
from lidarops.run import archive

BINS: Final = 16_000
SIZES: Final = (26, 101, 400)
"""MB of raw counts of a scene."""
_TINY: Final = 1
"""MB of the scene that loads the code of a process before the measurement."""
_DAY: Final = datetime(2025, 3, 20, tzinfo=UTC)
_INTERVAL: Final = timedelta(seconds=20)
_SHOTS: Final = 400
_BIN_WIDTH: Final = 3.75
_VARIANTS: Final = 4
"""Number of different profiles; files repeat them."""
_ZENITH_ANGLES: Final = (0.0, 30.0, 45.0, 60.0, 70.0, 75.0, 80.0, 85.0)
"""degree, in the headers of consecutive files: one cycle of a scan."""
_DARK_SHARE: Final = 0.1
"""Dark files for each file of the scene."""
_ANALOG: Final[dict[str, Any]] = {"channels": ["analog_532o"]}
_PHOTON: Final[dict[str, Any]] = {"channels": ["photon_532o"]}
_MINUTE: Final[dict[str, Any]] = {"average": "1min"}
_Lidars = dict[str, tuple[Sequence[str], float, float, dict[str, float]]]
_ALONE: Final[_Lidars] = {"here": (("",), 50.0, 10.0, {"full_overlap_range": 300})}
_LEVEL: Final[dict[str, float]] = {"full_overlap_range": 150, "zenith_angle": 90.0}
_NETWORK: Final[_Lidars] = {
    "west": ("012", 47.25, 11.3, _LEVEL | {"azimuth": 70.0}),
    "east": ("345", 47.25, 11.353, _LEVEL | {"azimuth": 310.0}),
    "north": ("6789", 47.2811, 11.3265, _LEVEL | {"azimuth": 190.0}),
}
"""Ends of the names of files, latitude, longitude and facts of each lidar."""
_WITH_DARK: Final = ", dark files"
_VISIBILITY: Final = "visibility"
_OF_ONE: Final[Mapping[str, tuple[float | None, Mapping[str, Any]]]] = {
    "signal": (0.0, {"signal": {}}),
    f"signal{_WITH_DARK}": (0.0, {"signal": _ANALOG}),
    "homogeneous": (90.0, {"homogeneous": _PHOTON | {"sections": [[750, 6000]]}}),
    "elastic": (0.0, {"elastic": _ANALOG}),
    "elastic, 1 min": (0.0, {"elastic": _ANALOG | _MINUTE}),
    f"elastic, 1 min{_WITH_DARK}": (0.0, {"elastic": _ANALOG | _MINUTE}),
    "elastic, glued": (0.0, {"elastic": {"channels": ["glued_532o"]}}),
    # At 80 degrees sections may be retrieved, and the beam reaches the reference window.
    "signal, homogeneous and elastic": (80.0, {
        "signal": {},
        "homogeneous": _PHOTON | {"sections": [[750, 1250]]},
        "elastic": _PHOTON | {"reference": {"lowest": 1000, "highest": 4000}},
    }),
    "multiangle": (None, {"multiangle": _PHOTON | {"step": 15}}),
}  # fmt: skip
"""Zenith angle, degree, and products of one lidar, by case; without an angle, it scans."""
CASES: Final = (*_OF_ONE, _VISIBILITY)
"""Rows of the table; all have the same files."""


class Peak(NamedTuple):
    """Peak memory of one process."""

    case: str
    raw: float
    """MB of raw counts of the scene."""
    base: float
    """MB at the peak of a tiny scene of the same case."""
    above: float
    """MB above the base at the peak of the scene."""


def measure_memory(effort: Effort) -> Study:
    """Measure the peak memory of processes, by size of the scene and products."""
    scores: Scores = {}
    smallest: dict[str, Peak] = {}
    for peak in measure_peaks(SIZES[:2] if effort.quick else SIZES, CASES):
        first = smallest.setdefault(peak.case, peak)
        more = peak.raw - first.raw
        scores[peak.case, f"{peak.raw:.0f}"] = {
            "base MB": round(peak.base),
            "above base MB": round(peak.above),
            "slope": (peak.above - first.above) / more if more else None,
        }
        effort.progress(1)
    note = (
        f"Scenes of one analog and one photon-counting channel with {BINS:,} bins, each in a fresh "
        "process. The base is the peak after a tiny scene of the same case, with imports and "
        "compiled code. Slope: growth above the base from the smallest scene, MB for 1 MB of raw "
        "counts."
    )
    return Study([Results("Peak memory", scores, note, method="raw MB")])


def measure_peaks(sizes: Sequence[int], cases: Sequence[str]) -> Iterator[Peak]:
    """Yield the peak memory of a fresh process for each case and size, MB of raw counts."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        root = Path(folder)
        for size in (_TINY, *sizes):
            write_files(root / str(size), size)
        for name in cases:
            # The first process compiles what is not cached, which takes memory of its own.
            _peak_of_process(root, name, _TINY)
            for size in sizes:
                yield _peak_of_process(root, name, size)


def _peak_of_process(root: Path, case: str, size: int) -> Peak:
    """Return the peak of a new process, whose memory holds nothing else."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_peak, root, case, size).result()


def _peak(root: Path, case: str, size: int) -> Peak:
    with tempfile.TemporaryDirectory(dir=root) as out:
        base = _peak_of_scene(root / str(_TINY), case, Path(out) / "tiny")
        above = _peak_of_scene(root / str(size), case, Path(out) / "scene") - base
    return Peak(case, float(size), base, above)


def _peak_of_scene(folder: Path, case: str, out: Path) -> float:
    """Process a scene; return the peak memory of this process so far, MB."""
    record = archive.reprocess(campaign_of(folder, case, out))
    if record is None or any(scene.error for scene in record.scenes):
        raise CampaignError("a scene of the benchmark gave no product", field=case)
    # The maximum of `resource` includes the memory of the parent process.
    status = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    kibibytes = next(line for line in status if line.startswith("VmHWM")).split()[1]
    return 1024.0 * float(kibibytes) / 1e6


def campaign_of(folder: Path, case: str, out: Path) -> Campaign:
    """Write the campaign file of one of `CASES` for a folder of raw files; return the campaign."""
    campaign: dict[str, Any] = {"name": "memory", "title": "Campaign of a benchmark",
                                "archive": "raw", "output": "out"}  # fmt: skip
    angle, products = _OF_ONE.get(case, (None, {}))
    lidars, more = _ALONE, {} if angle is None else {"zenith_angle": angle}
    if case == _VISIBILITY:
        lidars, valley = _NETWORK, {"visibility": {"channel": "photon_532o"}}
        campaign["networks"] = {"valley": {"instruments": [*_NETWORK], **valley}}
    campaign["stations"] = {
        name: {"name": name, "latitude": latitude, "longitude": longitude, "altitude": 100}
        for name, (_, latitude, longitude, _) in lidars.items()
    }
    campaign["instruments"] = {
        name: {"station": name, "files": [f"h*{end}" for end in ends], "facts": [facts | more],
               "products": dict(products)}
        for name, (ends, _, _, facts) in lidars.items()
    }  # fmt: skip
    if case.endswith(_WITH_DARK):
        campaign["instruments"]["here"]["dark_files"] = "d*"
    out.mkdir()
    file = out / "campaign.yaml"
    file.write_text(yaml.safe_dump(campaign), encoding="utf-8")
    return load_campaign(file, archive=str(folder), output=str(out))


def write_files(folder: Path, size: float) -> None:
    """Write raw files with `size` MB of counts, and dark files."""
    folder.mkdir(parents=True)
    layout: dict[str, Any] = {
        "wavelength": 532e-9, "bins": BINS, "bin_width": _BIN_WIDTH, "shots": _SHOTS,
    }  # fmt: skip
    kinds = (DatasetKind.ANALOG, DatasetKind.PHOTON)
    datasets = [licel.new_dataset(licel.Recorder(kind), **layout) for kind in kinds]
    distance = _BIN_WIDTH * (np.arange(BINS) + 0.5)
    expected = 40.0 + 2e4 * (1e3 / (distance + 300.0)) ** 2 * np.exp(-2e-4 * distance)
    counts = np.random.default_rng(7).poisson(expected, (_VARIANTS, BINS))
    number = round(size * 1e6 / (4 * BINS * len(kinds)))
    for index in range(-max(1, round(_DARK_SHARE * number)), number):
        start = _DAY + index * _INTERVAL
        name = f"h{index:06d}" if index >= 0 else f"d{-index:06d}"
        header = licel.new_header(
            name=name,
            place=licel.Place("Here", 100, 10, 50, _ZENITH_ANGLES[index % len(_ZENITH_ANGLES)]),
            start=start,
            stop=start + _INTERVAL,
            datasets=datasets,
            lasers=[Laser(_SHOTS, 20), Laser(0, 0)],
        )
        signal = counts[index % _VARIANTS] if index >= 0 else np.zeros_like(counts[0])
        values = {dataset.name: signal for dataset in header.datasets}
        (folder / name).write_bytes(licel.encode(header, values))
