"""CPU time of a campaign from raw files to report, by stage, and its growth with the size.

Of archives of up to 10^5 small files, the growth of the cost per file shows what 10^8 files cost.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from scipy import stats

from benchmarks.harness.figure import share
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.harness.timing import timed
from benchmarks.harness.verdicts import Scores
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.netcdf.write import write_plain
from lidarops.records import RunRecord
from lidarops.run import archive
from lidarops.simulate import campaign as simulation

CAMPAIGN_FILE: Final = "campaign.yaml"
"""Name of the campaign file in the folder of each simulated campaign."""
_DAY: Final = datetime(2025, 3, 20, tzinfo=UTC)
_INTERVAL: Final = 60
"""s; duration of a file."""
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
    """Size of a simulated campaign."""

    scenes: int = 2
    profiles: int = 30
    """Files per scene; must divide 1440."""
    bins: int = 1000
    angles: int = 0
    """Directions of a scan; 0 for a horizontal lidar."""
    retrieved: bool = True
    """Whether homogeneous paths are retrieved, or only signals kept."""

    @property
    def files(self) -> int:
        """Number of raw files."""
        return self.scenes * self.profiles


_ALONG: Final[Mapping[str, tuple[CampaignSize, ...]]] = {
    "scenes": tuple(CampaignSize(scenes=n) for n in (2, 4, 8, 16)),
    "profiles": tuple(CampaignSize(profiles=n) for n in (15, 30, 60, 120)),
    "bins": tuple(CampaignSize(bins=n) for n in (500, 1000, 2000, 4000)),
    "angles": tuple(CampaignSize(angles=n, profiles=120, bins=2000) for n in (5, 9, 17)),
    "files": tuple(CampaignSize(n, 480, 200, retrieved=False) for n in (2, 20, 200)),
}
_QUICK: Final[Mapping[str, tuple[CampaignSize, ...]]] = {
    **{name: _ALONG[name][:3] for name in ("scenes", "profiles", "bins")},
    "files": tuple(CampaignSize(n, 480, 200, retrieved=False) for n in (1, 2, 4)),
}
Cost = tuple[CampaignSize, dict[str, float]]
"""Size of a campaign, and its CPU time by stage, s."""


def measure_campaigns(
    effort: Effort,
    *,
    along: Mapping[str, Sequence[CampaignSize]] | None = None,
) -> Study:
    """Simulate campaigns of several sizes in temporary folders, and time their processing.

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
        campaign = simulate_campaign(size, Path(folder))
        seconds = {"scan": _timed(lambda: archive.update_catalog(campaign))}
        started = time.perf_counter()
        cpu, record = timed(lambda: archive.reprocess(campaign))
        wall = time.perf_counter() - started
        if record is None:
            raise CampaignError("the simulated campaign has nothing to process", field="simulation")
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


def simulate_campaign(size: CampaignSize, folder: Path) -> Campaign:
    """Return a simulated campaign of this size, whose raw files are written."""
    path = folder / CAMPAIGN_FILE
    path.write_text(yaml.safe_dump(_settings(size)), encoding="utf-8")
    campaign = load_campaign(path)
    written = simulation.simulate_campaign(campaign)
    write_plain(written.truth, campaign.truth_path)
    return campaign


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


def _settings(size: CampaignSize) -> dict[str, Any]:
    scans = size.angles > 0
    channel = "photon_532o"
    products: dict[str, Any] = {"signal": {}}
    if scans:
        products["multiangle"] = {"channels": [channel], "highest": 6000, "step": 60}
    elif size.retrieved:
        products["homogeneous"] = {
            "channels": [channel],
            "sections": [[750, 0.9 * 7.5 * size.bins]],
        }
    facts_of_lidar = {"full_overlap_range": 300, "channels": {channel: {"dead_time": 3e-9}}}
    lidar = {
        "station": "here",
        "files": "here/h*",
        "facts": [facts_of_lidar if scans else facts_of_lidar | {"zenith_angle": 90}],
        "products": products,
    }
    simulation = {
        "seed": 7,
        "start": _DAY,
        "duration": size.files * _INTERVAL,
        "instruments": {"lidar": _scanning(size) if scans else _level(size)},
    }
    window = {"window": f"{size.profiles}min"}
    return campaign_settings("measured", {"lidar": lidar}, scenes=window, simulation=simulation)


def _level(size: CampaignSize) -> dict[str, Any]:
    return {
        "kind": "horizontal",
        "aerosol_extinction": {"minimum": 5e-5, "maximum": 2e-4, "hour_of_maximum": 18},
        "aerosol": {"lidar_ratio": 50},
    } | _recorded(size)


def _scanning(size: CampaignSize) -> dict[str, Any]:
    angles = np.degrees(np.arccos(1.0 / np.linspace(1.0, 4.0, size.angles)))
    return {
        "kind": "lidar",
        "atmosphere": {
            "boundary_layer": {
                "extinction": 1.5e-4,
                "height": {"minimum": 600, "maximum": 1500, "hour_of_maximum": 14},
                "aerosol": {"lidar_ratio": 50, "angstrom_exponent": 1.2},
            }
        },
        "scan": {"zenith_angles": [round(float(angle), 1) for angle in angles], "azimuth": 90},
    } | _recorded(size)


def _recorded(size: CampaignSize) -> dict[str, Any]:
    detector = {"wavelength": 532, "signal_rate": 5.0, "background": {"night": 0.05, "day": 0.5}}
    acquisition = {"interval": _INTERVAL, "shots": 1000, "repetition_rate": 20, "bins": size.bins}
    return {"acquisition": acquisition, "detectors": [detector | {"photon": {}}]}


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
        "Simulated campaigns of one lidar on a local disk, which TMPDIR selects, in one process: "
        f"{size.scenes} scenes of {size.profiles} files, {size.bins} bins"
        + (f", {size.angles} directions. " if size.angles else ". ")
        + "CPU time; that of a run is divided among its stages in proportion to wall time. Slope: "
        "of the logarithm of time against that of the size, with its 95 % interval; 1 is linear.",
        method="stage",
    )
