"""CPU time of a campaign from raw files to report, by stage, and its growth with the size.

Of archives of up to 10^5 small files, the growth of the cost per file shows what 10^8 files cost.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from scipy import stats

from benchmarks.harness.figure import Scores, share, timed
from benchmarks.harness.results import Effort, Results, Study
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.raw import licel
from lidarops.raw.licel import DatasetKind, Laser
from lidarops.records import RunRecord
from lidarops.run import archive

CAMPAIGN_FILE: Final = "campaign.yaml"
"""Name of the campaign file in the folder of each campaign."""
_DAY: Final = datetime(2025, 3, 20, tzinfo=UTC)
_INTERVAL: Final = timedelta(minutes=1)
"""Duration of a file."""
BIN_WIDTH: Final = 3.75
_SHOTS: Final = 400
_VARIANTS: Final = 4
"""Number of different profiles; files repeat them."""
_ZENITH_ANGLES: Final = (0.0, 30.0, 45.0, 60.0, 70.0, 75.0, 80.0, 85.0)
"""degree, in the headers of consecutive files: one cycle of a scan."""
_SHORTEST: Final = 1e-4
"""s; least time, because a coarse clock may not advance during a fast call."""
STAGES: Final = {
    "scan": "headers of all files into the catalog",
    "read": "digest and header of each file of a scene",
    "retrieve": "counts to results, including reading the channels",
    "write": "products as NetCDF",
    "orchestration": "scenes, plans, staleness, ledger",
    "report": "page and figures",
    "scan, all known": "list the files and compare them with the catalog",
    "all unchanged": "a second run without anything to process",
}
"""Stages of processing a campaign, and what is done in each."""
_OF_SCENES: Final = {"digest": "read", "retrieve": "retrieve", "write": "write"}
"""Stages by the names of the laps of a scene."""
_AGAIN: Final = ("scan, all known", "all unchanged")
"""Stages of a run that is not the first."""


@dataclass(frozen=True, slots=True)
class CampaignSize:
    """Size of a campaign."""

    scenes: int = 2
    profiles: int = 30
    """Files per scene; must divide 1440."""
    bins: int = 1000
    retrieved: bool = True
    """Whether homogeneous paths are retrieved, or only signals kept."""

    @property
    def files(self) -> int:
        """Number of raw files."""
        return self.scenes * self.profiles


_ALONG: Final[Mapping[str, tuple[CampaignSize, ...]]] = {
    "scenes": tuple(CampaignSize(scenes=n) for n in (2, 4, 8, 16)),
    "profiles": tuple(CampaignSize(profiles=n) for n in (15, 30, 60, 120)),
    "files": tuple(CampaignSize(n, 480, 200, retrieved=False) for n in (2, 20, 200)),
}
_QUICK: Final[Mapping[str, tuple[CampaignSize, ...]]] = {
    **{name: _ALONG[name][:3] for name in ("scenes", "profiles")},
    "files": tuple(CampaignSize(n, 480, 200, retrieved=False) for n in (1, 2, 4)),
}
Cost = tuple[CampaignSize, dict[str, float]]
"""Size of a campaign, and its CPU time by stage, s."""


def measure_campaigns(
    effort: Effort,
    *,
    along: Mapping[str, Sequence[CampaignSize]] | None = None,
) -> Study:
    """Write campaigns of several sizes in temporary folders, and time their processing.

    Parameters
    ----------
    effort : Effort
        A quick run has fewer and smaller campaigns.
    along : mapping of str to sequence of CampaignSize, optional
        Sizes for each varied property, at least 2.
    """
    # The first campaign of a process includes imports and compilation; it is not counted.
    _cost(CampaignSize(scenes=1, profiles=15), effort)
    growths = {
        name: [_cost(size, effort) for size in sizes]
        for name, sizes in (along or (_QUICK if effort.quick else _ALONG)).items()
    }
    results = [growth(name, costs) for name, costs in growths.items()]
    return Study("Campaigns: CPU time by stage", effort.date, results)


def _cost(size: CampaignSize, effort: Effort) -> Cost:
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        campaign = write_campaign(size, Path(folder))
        seconds = {"scan": _timed(lambda: archive.update_catalog(campaign))}
        started = time.perf_counter()
        cpu, record = timed(lambda: archive.reprocess(campaign))
        wall = time.perf_counter() - started
        if record is None:
            raise CampaignError("the campaign has nothing to process", field="archive")
        seconds |= _stage_times(record, cpu, wall)
        seconds["report"] = _timed(lambda: archive.report_run(campaign, record))
        again, unchanged = _AGAIN
        seconds[again] = _timed(lambda: archive.update_catalog(campaign))
        seconds[unchanged] = _timed(lambda: archive.reprocess(campaign))
    effort.progress(1)
    return size, seconds


def _stage_times(record: RunRecord, cpu: float, wall: float) -> dict[str, float]:
    """Return the CPU time of a run by stage, in proportion to wall time."""
    laps = dict.fromkeys(_OF_SCENES.values(), 0.0)
    for outcome in record.scenes:
        for name, lap in outcome.seconds.items():
            if name in _OF_SCENES:
                laps[_OF_SCENES[name]] += lap
    laps["orchestration"] = wall - sum(laps.values())
    return {stage: max(cpu * lap / wall, _SHORTEST) for stage, lap in laps.items()}


def _timed(call: Callable[[], object]) -> float:
    return max(timed(call)[0], _SHORTEST)


def write_campaign(size: CampaignSize, folder: Path) -> Campaign:
    """Return a campaign of this size, whose raw files are written."""
    write_files(folder / "raw", size.files, size.bins, _INTERVAL)
    products: dict[str, Any] = {"signal": {"channels": ["photon_532o"]}}
    if size.retrieved:
        sections = [[750, 0.9 * BIN_WIDTH * size.bins]]
        products["homogeneous"] = {"channels": ["photon_532o"], "sections": sections}
    facts = {
        "full_overlap_range": 300,
        "zenith_angle": 90,
        "channels": {"photon_532o": {"dead_time": 3e-9}},
    }
    lidar = {"station": "here", "files": "h*", "facts": [facts], "products": products}
    window = {"window": f"{size.profiles}min"}
    file = folder / CAMPAIGN_FILE
    settings = campaign_settings("measured", {"lidar": lidar}, scenes=window)
    file.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return load_campaign(file)


def campaign_settings(name: str, instruments: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Return the content of a campaign file of one station, ``here``, unless others are given."""
    here = {"name": "Here", "latitude": 50, "longitude": 10, "altitude": 100}
    return {
        "name": name,
        "title": "Campaign of a benchmark",
        "archive": "raw",
        "output": "out",
        "stations": {"here": here},
        "instruments": dict(instruments),
        **others,
    }


def write_files(
    folder: Path, number: int, bins: int, interval: timedelta, dark_files: int = 0
) -> None:
    """Write raw files ``h*`` of an analog and a photon-counting channel, and dark files ``d*``."""
    folder.mkdir(parents=True)
    layout: dict[str, Any] = {
        "wavelength": 532e-9, "bins": bins, "bin_width": BIN_WIDTH, "shots": _SHOTS,
    }  # fmt: skip
    kinds = (DatasetKind.ANALOG, DatasetKind.PHOTON)
    datasets = [licel.new_dataset(licel.Recorder(kind), **layout) for kind in kinds]
    distance = BIN_WIDTH * (np.arange(bins) + 0.5)
    expected = 40.0 + 2e4 * (1e3 / (distance + 300.0)) ** 2 * np.exp(-2e-4 * distance)
    counts = np.random.default_rng(7).poisson(expected, (_VARIANTS, bins))
    for index in range(-dark_files, number):
        start = _DAY + index * interval
        name = f"h{index:06d}" if index >= 0 else f"d{-index:06d}"
        header = licel.new_header(
            name=name,
            place=licel.Place("Here", 100, 10, 50, _ZENITH_ANGLES[index % len(_ZENITH_ANGLES)]),
            start=start,
            stop=start + interval,
            datasets=datasets,
            lasers=[Laser(_SHOTS, 20), Laser(0, 0)],
        )
        signal = counts[index % _VARIANTS] if index >= 0 else np.zeros_like(counts[0])
        values = {dataset.name: signal for dataset in header.datasets}
        (folder / name).write_bytes(licel.encode(header, values))


def slope(sizes: Sequence[float], seconds: Sequence[float]) -> tuple[float, float]:
    """Return the log-log slope of times, and half of its 95 percent interval."""
    fit = stats.linregress(np.log(sizes), np.log(seconds))
    half = stats.t.ppf(0.975, len(sizes) - 2) * fit.stderr if len(sizes) > 2 else 0.0
    return float(fit.slope), float(half) if math.isfinite(half) else 0.0


def growth(along: str, costs: Sequence[Cost]) -> Results:
    """Return the times of the stages of the largest campaign, and how they grow with the size."""
    size, spent = costs[-1]
    sizes = [getattr(each, along) for each, _ in costs]
    total = sum(seconds for stage, seconds in spent.items() if stage not in _AGAIN)
    scores: Scores = {}
    for stage, seconds in spent.items():
        steepness, half = slope(sizes, [of_stage[stage] for _, of_stage in costs])
        scores["", stage] = {
            "work": STAGES[stage],
            "CPU time (s)": seconds,
            "share": None if stage in _AGAIN else share(seconds / total),
            "ms per file": 1e3 * seconds / size.files,
            "slope": f"{steepness:.2f} ± {half:.2f}",
        }
    return Results(
        f"By number of {along}; times at {getattr(size, along)}",
        scores,
        "Campaigns of one lidar on a local disk, which TMPDIR selects, in one process: "
        f"{size.scenes} scenes of {size.profiles} files, {size.bins} bins. "
        "CPU time; that of a run is divided among its stages in proportion to wall time. Slope: "
        "of the logarithm of time against that of the size, with its 95 % interval; 1 is linear.",
        method="stage",
    )
