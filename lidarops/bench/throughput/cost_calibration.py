"""Calibration of the cost model of ``lidarops plan`` on this machine.

A campaign with many kinds and sizes of scenes is simulated and processed, whole scenes and single
products. A fit of non-negative least squares of relative errors gives the cost of each term.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
import yaml
from scipy.optimize import nnls

from lidarops.bench.harness.benchmark import CAMPAIGN_FILE, Effort, study_page
from lidarops.bench.harness.rows import Row, table
from lidarops.bench.harness.timing import Machine, machine
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.kinds import kinds
from lidarops.netcdf.write import write_plain
from lidarops.plan import cost_estimate
from lidarops.plan.cost_estimate import Costs, Term
from lidarops.process.job import Job
from lidarops.process.scene import process_scene
from lidarops.records import RunRecord
from lidarops.reports.benchmark_page import BenchmarkReport, Part
from lidarops.run import archive
from lidarops.simulate.campaign import plan_simulation, write_simulation
from lidarops.steps import dependence

_LOG = logging.getLogger(__name__)

_START: Final = datetime(2025, 3, 20, 20, tzinfo=UTC)
_LENGTH: Final = 7200
"""s; duration of the campaign and of the one scene of each instrument."""
_ROUNDS: Final = 3
_IDLE_RUNS: Final = 3
_LARGEST_RATIO: Final = 1.5
"""Ratio between estimate and measurement above which a warning is given."""
_PRIOR_WEIGHT: Final = 0.05
"""Weight of the default costs: a relative deviation of 1 from a default counts like a misfit of
this share in one scene. It matters only for costs that the scenes do not determine."""
_PHOTON: Final = "photon_532o"
_ANALOG: Final = "analog_532o"
_GLUED: Final = "glued_532o"


@dataclass(frozen=True, slots=True)
class Observation:
    """One processed scene, or a part of it."""

    scene: str
    products: tuple[str, ...]
    amounts: Mapping[str, float]
    seconds: float
    """CPU time."""
    estimated: float
    """Estimate from the fitted costs, s."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Fitted costs of a machine, and the observations of the fit."""

    date: str
    machine: Machine
    seconds: Mapping[str, float]
    """Cost per unit of each term."""
    observations: tuple[Observation, ...]
    path: str
    """File in which the costs are saved."""

    @property
    def largest_ratio(self) -> float:
        """Largest ratio between estimated and measured time, in either direction."""
        ratios = [observation.estimated / observation.seconds for observation in self.observations]
        return max(max(ratio, 1.0 / ratio) for ratio in ratios)


def accuracy_warning(calibration: Calibration) -> str:
    """Return a warning if an estimate is far from its measurement, else an empty text."""
    if calibration.largest_ratio <= _LARGEST_RATIO:
        return ""
    return (
        f"the estimate of one of the calibration scenes is off by a factor of"
        f" {calibration.largest_ratio:.2f}: calibrate again while the machine is idle"
    )


def calibrate(
    effort: Effort, *, rounds: int | None = None, path: Path | None = None
) -> Calibration:
    """Measure the costs of this machine, in about a minute after compilation, and save them.

    Parameters
    ----------
    effort : Effort
    rounds : int, optional
        The median of these counts.
    path : Path, optional
        File for the costs, instead of the user's cache.

    Raises
    ------
    CatalogError
        If the calibration cannot be saved.
    """
    rounds = rounds or effort.repeats or (1 if effort.quick else _ROUNDS)
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        campaign = _simulated(Path(folder))
        # The first run includes compilation and loading; it is not counted.
        record = archive.reprocess(campaign)
        if record is None or any(scene.error for scene in record.scenes):
            raise CampaignError("the simulated campaign cannot be processed", field="simulation")
        effort.progress(1)
        observations = _scenes(campaign, rounds, effort.progress)
        seconds = fit_costs(observations)
        seconds |= _report(campaign, record) | _load_times(campaign)
        effort.progress(1)
        seconds[Term.RUN] = _run_cost(campaign, Costs(seconds | {Term.RUN: 0.0}))
        effort.progress(1)
    this_machine = machine()
    saved = cost_estimate.save_calibration(
        Costs(seconds, processor=this_machine.processor, date=effort.date), path
    )
    model = Costs(seconds)
    return Calibration(
        date=effort.date,
        machine=this_machine,
        seconds={term: seconds[term] for term in cost_estimate.default_costs()},
        observations=tuple(
            replace(observation, estimated=model.of(observation.amounts))
            for observation in observations
        ),
        path=str(saved),
    )


def fit_costs(observations: Sequence[Observation]) -> dict[str, float]:
    """Return the costs by least squares of relative errors, s per unit.

    Minimises sum_i (1 - a_i x / t_i)^2 + sum_k (w (x_k / d_k - 1))^2 over x >= 0, with the
    amounts a, the times t, the default costs d and their weight w.

    Parameters
    ----------
    observations : sequence of Observation
        With times above zero.
    """
    defaults_by_term = cost_estimate.default_costs()
    terms, defaults = list(defaults_by_term), np.array(list(defaults_by_term.values()))
    amounts = np.array(
        [[observation.amounts.get(term, 0.0) for term in terms] for observation in observations]
    )
    seconds = np.array([observation.seconds for observation in observations])
    matrix = amounts * defaults / seconds[:, np.newaxis]
    prior = _PRIOR_WEIGHT * np.eye(len(terms))
    relative, _ = nnls(
        np.vstack([matrix, prior]),
        np.concatenate([np.ones(len(seconds)), np.full(len(terms), _PRIOR_WEIGHT)]),
    )
    return {term: float(value) for term, value in zip(terms, relative * defaults, strict=True)}


def _scenes(
    campaign: Campaign, rounds: int, progress: Callable[[int], object]
) -> list[Observation]:
    """Return the times of whole scenes, with and without known digests, and of single products."""
    jobs = [
        job
        for assessment in archive.assess(campaign, force=True)
        for job in _job_variants(Job(campaign, assessment.scene, assessment.plan))
    ]
    times: list[list[float]] = [[] for _ in jobs]
    for _ in range(rounds):
        for job, seconds in zip(jobs, times, strict=True):
            begin = time.process_time()
            outcome = process_scene(job)
            seconds.append(time.process_time() - begin)
            if outcome.error:
                raise CampaignError(f"{job.scene.id}: {outcome.error}", field="simulation")
        progress(1)
    return [
        Observation(
            scene=job.scene.instrument,
            products=tuple(
                f"{kind} {channel}" for kind, channel in dependence.planned_products(job.plan)
            ),
            amounts=cost_estimate.amounts(job.scene, job.plan),
            seconds=median(seconds),
            estimated=0.0,
        )
        for job, seconds in zip(jobs, times, strict=True)
    ]


def _job_variants(job: Job) -> Iterator[Job]:
    yield job
    granules = tuple(replace(granule, sha256=None) for granule in job.scene.granules)
    yield replace(job, scene=replace(job.scene, granules=granules))
    products = dependence.planned_products(job.plan)
    for product in products if len(products) > 1 else ():
        yield replace(job, plan=dependence.plan_closure(job.plan, [product]))


def _report(campaign: Campaign, record: RunRecord) -> dict[str, float]:
    """Return the costs of a report page, and of the figures of each kind of product."""
    page = _page(campaign, replace(record, scenes=()))
    costs: dict[str, float] = {Term.PAGE: page}
    for kind in kinds():
        scenes = sorted(
            (replace(scene, products=first_product)
             for scene in record.scenes
             if (first_product := tuple(p for p in scene.products if p.kind == kind)[:1])),
            key=lambda scene: scene.products[0].values,
        )  # fmt: skip
        if not scenes:
            # The campaign makes no product of a kind of another package.
            continue
        smallest_cost = max(_page(campaign, replace(record, scenes=(scenes[0],))) - page, 0.0)
        costs[cost_estimate.figure_term(kind)] = smallest_cost
        if kind == "signal":
            largest_cost = max(
                _page(campaign, replace(record, scenes=(scenes[-1],))) - page, smallest_cost
            )
            least_values, most_values = (scenes[index].products[0].values for index in (0, -1))
            costs[Term.FIGURE_VALUE] = (largest_cost - smallest_cost) / (most_values - least_values)
    return costs


def _load_times(campaign: Campaign) -> dict[str, float]:
    """Return the time to load code for the first product of each kind, in a new process, s."""
    output = _child(
        "from lidarops.bench.throughput.cost_calibration import first_times;"
        " first_times(sys.argv[1])",
        campaign,
    )
    times: dict[str, list[float]] = json.loads(output)
    return {
        cost_estimate.load_term(kind): max(first - second, 0.0)
        for kind, (first, second) in times.items()
    }


def first_times(path: str) -> None:
    """Write the times of the first scene of each kind and of the same scene again, as JSON."""
    campaign = load_campaign(path)
    jobs: dict[str, Job] = {}
    for assessment in archive.assess(campaign, force=True):
        for kind, channel in dependence.planned_products(assessment.plan):
            plan = dependence.plan_closure(assessment.plan, [(kind, channel)])
            jobs.setdefault(kind, Job(campaign, assessment.scene, plan))
    times = {}
    # Code that all kinds load counts for the first of them, signals.
    for kind in [kind for kind in kinds() if kind in jobs]:
        times[kind] = [process_scene(jobs[kind]).cpu_seconds for _ in range(2)]
    sys.stdout.write(json.dumps(times))


def _child(code: str, campaign: Campaign, *words: str) -> str:
    """Run Python code in a new process, and return its output."""
    path = str(campaign.folder / CAMPAIGN_FILE)
    process = subprocess.run(  # noqa: S603 - this Python and our own file
        [sys.executable, "-c", f"import sys; {code}", path, *words],
        check=False,
        capture_output=True,
        text=True,
    )
    # Status 1 means scenes without usable values, which cost the same.
    if process.returncode not in (0, 1) or not process.stdout:
        raise CampaignError(f"a process of the calibration failed: {process.stderr[-500:]}")
    return process.stdout


def _page(campaign: Campaign, record: RunRecord) -> float:
    begin = time.process_time()
    archive.report_run(campaign, record)
    return time.process_time() - begin


def _run_cost(campaign: Campaign, model: Costs) -> float:
    """Return the cost of a run in a new process, without its scenes and its report, s.

    It is at least the median of runs without anything to process. The difference of large numbers
    alone was only a quarter of that on a busy machine.
    """
    tally = cost_estimate.Tally(model)
    for assessment in archive.assess(campaign, force=True):
        tally.add(assessment.scene, assessment.plan)
    difference = _run_time(campaign, "--force") - tally.total
    return max(difference, median(_run_time(campaign) for _ in range(_IDLE_RUNS)))


def _run_time(campaign: Campaign, *words: str) -> float:
    """Return the CPU time of a run in a new process, s."""
    before = _children_time()
    command = "from lidarops.cli import app; sys.argv.insert(1, 'reprocess'); app()"
    _child(command, campaign, *words, "--json")
    return _children_time() - before


def _children_time() -> float:
    used = os.times()
    return used.children_user + used.children_system


# The campaign ---------------------------------------------------------------------------------


def _simulated(folder: Path) -> Campaign:
    path = folder / CAMPAIGN_FILE
    path.write_text(yaml.safe_dump(_settings()), encoding="utf-8")
    campaign = load_campaign(path)
    written = write_simulation(plan_simulation(campaign))
    write_plain(written.truth, campaign.truth_path)
    return campaign


_OUTPUTS: Final[Mapping[str, dict[str, Any]]] = {
    _PHOTON: {"photon": {}},
    _ANALOG: {"analog": {"gain": 0.05, "noise": 0.3, "dark_offset": 3.0, "adc_range": 100}},
}
_AEROSOL: Final = {"lidar_ratio": 50}
_LEVEL: Final[dict[str, Any]] = {
    "kind": "horizontal",
    "aerosol": _AEROSOL,
    "aerosol_extinction": {"minimum": 5e-5, "maximum": 2e-4, "hour_of_maximum": 18},
}
_COLUMN: Final[dict[str, Any]] = {
    "boundary_layer": {
        "extinction": 1.5e-4,
        "height": {"minimum": 600, "maximum": 1500, "hour_of_maximum": 14},
        "aerosol": _AEROSOL,
    }
}
_UP: Final[dict[str, Any]] = {"kind": "vertical", **_COLUMN}


def _scan(*angles: float) -> dict[str, Any]:
    pointing = {"zenith_angles": list(angles), "azimuth": 90}
    return {"kind": "lidar", "atmosphere": _COLUMN, "scan": pointing}


def _beam(azimuth: float) -> dict[str, Any]:
    haze = {"extinction": {"minimum": 4e-4, "maximum": 4e-4, "hour_of_maximum": 12}}
    return {
        "kind": "lidar",
        "atmosphere": {"homogeneous": {**haze, "aerosol": _AEROSOL}},
        "scan": {"zenith_angles": [90], "azimuth": azimuth},
    }


def _homogeneous(*channels: str, far: float) -> dict[str, Any]:
    return {"homogeneous": {"channels": list(channels), "sections": [[750, far]]}}


def _elastic(channel: str, minutes: int) -> dict[str, Any]:
    return {"elastic": {"channels": [channel], "average": f"{minutes}min"}}


def _multiangle(highest: float) -> dict[str, Any]:
    return {"multiangle": {"channels": [_PHOTON], "highest": highest, "step": 60}}


@dataclass(frozen=True, slots=True)
class _Lidar:
    """An instrument of the campaign."""

    air: Mapping[str, Any]
    files: int
    bins: int
    products: Mapping[str, Any]
    channels: tuple[str, ...] = (_PHOTON,)
    dark_files: int = 0
    station: str = "west"


_SIGNAL: Final[dict[str, Any]] = {"signal": {}}
_BOTH: Final = (_PHOTON, _ANALOG)
_ZENITHS: Final = (0, 30, 45, 60, 70, 75, 80, 85)
_LIDARS: Final[Mapping[str, _Lidar]] = {
    "level-short": _Lidar(_LEVEL, 12, 1000, _SIGNAL | _homogeneous(_PHOTON, far=6000)),
    "level-long": _Lidar(_LEVEL, 120, 1000, _SIGNAL | _homogeneous(_PHOTON, far=6000)),
    "level-both": _Lidar(
        _LEVEL, 60, 2000, _SIGNAL | _homogeneous(_PHOTON, _ANALOG, far=4500), _BOTH, 20
    ),
    "up-short": _Lidar(_UP, 12, 2000, _SIGNAL | _elastic(_ANALOG, 60), _BOTH, 6),
    "up-long": _Lidar(_UP, 120, 4000, _SIGNAL | _elastic(_PHOTON, 10), _BOTH, 6),
    "up-joined": _Lidar(_UP, 60, 4000, _elastic(_GLUED, 30), _BOTH, 6),
    "scan-short": _Lidar(_scan(*_ZENITHS[::2]), 24, 2000, _multiangle(3000)),
    "scan-long": _Lidar(_scan(*_ZENITHS), 120, 2400, _SIGNAL | _multiangle(6000)),
    "north-lidar": _Lidar(_beam(190), 24, 2000, {}, station="north"),
    "east-lidar": _Lidar(_beam(310), 24, 2000, {}, station="east"),
    "west-lidar": _Lidar(_beam(70), 24, 2000, {}),
}
_NETWORK: Final = ["west-lidar", "east-lidar", "north-lidar"]


def _settings() -> dict[str, Any]:
    return {
        "name": "costs",
        "title": "Campaign of a calibration of costs",
        "archive": "raw",
        "output": "out",
        "stations": {
            "west": {"name": "W", "latitude": 47.25, "longitude": 11.3, "altitude": 600},
            "east": {"name": "E", "latitude": 47.25, "longitude": 11.353, "altitude": 600},
            "north": {"name": "N", "latitude": 47.2811, "longitude": 11.3265, "altitude": 600},
        },
        "instruments": {name: _instrument(name, lidar) for name, lidar in _LIDARS.items()},
        "networks": {
            f"every-{minutes}": {
                "instruments": _NETWORK,
                "visibility": {"channel": _PHOTON, "average": f"{minutes}min"},
            }
            for minutes in (5, 30)
        },
        "scenes": {"window": f"{_LENGTH // 60}min"},
        "simulation": {
            "seed": 11,
            "start": _START,
            "duration": _LENGTH,
            "fast": True,
            "instruments": {name: _simulation(lidar) for name, lidar in _LIDARS.items()},
        },
    }


def _instrument(name: str, lidar: _Lidar) -> dict[str, Any]:
    facts_of_lidar: dict[str, Any] = {
        "full_overlap_range": 150,
        "channels": {_PHOTON: {"dead_time": 3e-9}},
    }
    if "scan" not in lidar.air:
        facts_of_lidar["zenith_angle"] = 0 if lidar.air["kind"] == "vertical" else 90
    return {
        "station": lidar.station,
        "files": f"{name}/m*",
        "dark_files": f"{name}/dark/d*",
        "facts": [facts_of_lidar],
        "products": dict(lidar.products),
    }


def _simulation(lidar: _Lidar) -> dict[str, Any]:
    outputs: dict[str, Any] = {}
    for channel in lidar.channels:
        outputs |= _OUTPUTS[channel]
    seconds = _LENGTH // lidar.files
    return {
        **lidar.air,
        "acquisition": {
            "interval": seconds,
            "shots": 10 * seconds,
            "repetition_rate": 20,
            "bins": lidar.bins,
            "dark_files": lidar.dark_files,
        },
        "detectors": [
            {
                "wavelength": 532,
                "signal_rate": 10.0,
                "background": {"night": 0.05, "day": 2.0},
                **outputs,
            }
        ],
    }


# Page -----------------------------------------------------------------------------------------


def calibration_report(calibration: Calibration) -> BenchmarkReport:
    """Return the page of a calibration."""
    defaults = cost_estimate.default_costs()
    terms = [
        row
        for term, default in defaults.items()
        for row in (
            Row("", term, "CPU s per unit", calibration.seconds[term]),
            Row("", term, "default", default),
        )
    ]
    scenes = [
        row
        for scene in calibration.observations
        for row in (
            Row(scene.scene, ", ".join(scene.products), "CPU s", scene.seconds),
            Row(scene.scene, ", ".join(scene.products), "estimated", scene.estimated),
            Row(scene.scene, ", ".join(scene.products), "ratio", scene.estimated / scene.seconds),
        )
    ]
    text = (
        "CPU time of simulated scenes of many kinds and sizes, whole and single products, as a sum"
        " over their contents. The worst estimate is off by a factor of"
        f" {calibration.largest_ratio:.2f}."
    )
    if warning := accuracy_warning(calibration):
        _LOG.warning(warning)
        text += f" Do not trust them: {warning}."
    return study_page(
        "Costs: calibration of the estimates of run times",
        calibration,
        Part(
            title="Costs of this machine",
            text=text,
            tables=(
                table(
                    "Costs by term",
                    terms,
                    f"Saved in {calibration.path}; lidarops plan estimates run times with them.",
                    method="term",
                ),
                table("Calibration scenes", scenes, case="instrument", method="products"),
            ),
        ),
    )
