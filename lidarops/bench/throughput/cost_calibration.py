"""What each thing that a plan asks for costs on this machine, for the estimates of run times.

A campaign of many kinds and sizes of scenes is simulated and processed, whole and product by
product. The costs are those of least relative squares, none of them negative.
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

from lidarops.bench.accuracy.homogeneous_report import facts
from lidarops.bench.harness.terms import CAMPAIGN_FILE, RESULT, Effort, Finding, Kind
from lidarops.bench.harness.timing import Machine, machine
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.netcdf.write import write_plain
from lidarops.plan import cost_estimate, product_dependence
from lidarops.plan.cost_estimate import Costs, Term
from lidarops.process.scene import Job, process_scene
from lidarops.records import ProductKind, RunRecord
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table
from lidarops.run import archive
from lidarops.simulate.campaign import plan_simulation, write_simulation

_LOG = logging.getLogger(__name__)

_START: Final = datetime(2025, 3, 20, 20, tzinfo=UTC)
_LENGTH: Final = 7200
"""s, of the campaign and its one scene an instrument."""
_ROUNDS: Final = 3
_IDLE_RUNS: Final = 3
_OFF: Final = 1.5
"""Ratio between estimate and measurement that is told, as estimates are meant to be closer."""
_TRUST: Final = 0.05
"""Of the costs that come with lidarops: a relative departure of 1 from one of them weighs as much
as a misfit of this share in one scene. It decides only what the scenes do not tell."""
_PHOTON: Final = "photon_532o"
_ANALOG: Final = "analog_532o"
_GLUED: Final = "glued_532o"


@dataclass(frozen=True, slots=True)
class Observation:
    """One scene, or a part of it, that was processed."""

    scene: str
    products: tuple[str, ...]
    amounts: Mapping[Term, float]
    seconds: float
    """CPU time."""
    estimated: float
    """From the costs that were found, s."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """The costs of a machine, and what they were found from."""

    date: str
    machine: Machine
    seconds: Mapping[str, float]
    """By term."""
    observations: tuple[Observation, ...]
    path: str
    """Where the costs are kept."""

    @property
    def farthest(self) -> float:
        """Largest ratio between estimated and measured time, whichever is larger."""
        ratios = [each.estimated / each.seconds for each in self.observations]
        return max(max(ratio, 1.0 / ratio) for ratio in ratios)


def doubt(found: Calibration) -> str:
    """Say where the costs do not tell what they were found from; empty where they do."""
    if found.farthest <= _OFF:
        return ""
    return (
        f"the estimate of one of the scenes that the costs were found from is off by a factor of"
        f" {found.farthest:.2f}: calibrate again while the machine does nothing else"
    )


def run_cost_calibration(kind: Kind, *, effort: Effort) -> Finding:
    """Calibrate this machine, and keep what was found for ``lidarops plan``.

    Raises
    ------
    CampaignError
        Where accuracy is asked for.
    CatalogError
        Where the calibration cannot be kept.
    """
    if kind is not Kind.THROUGHPUT:
        raise CampaignError("costs have no accuracy benchmark", remedy="choose throughput")
    rounds = effort.repeats or (1 if effort.quick else _ROUNDS)
    found = calibrate(date=effort.date, rounds=rounds, progress=effort.progress)
    if told := doubt(found):
        _LOG.warning(told)
    return Finding(found, calibration_report(found, RESULT))


def calibrate(
    *,
    date: str = "",
    rounds: int = _ROUNDS,
    path: Path | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Calibration:
    """Measure the costs of this machine, in about a minute once code is compiled.

    Parameters
    ----------
    date : str
        When it is run, as it is to be stated.
    rounds : int
        Of which the median counts.
    path : Path, optional
        Where to keep the costs, instead of this user's cache.
    progress : callable
        Is given 1 after each round, and after the report.
    """
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        campaign = _simulated(Path(folder))
        # The first run pays for what is compiled and loaded.
        record = archive.reprocess(campaign)
        if record is None or any(scene.error for scene in record.scenes):
            raise CampaignError("the simulated campaign cannot be processed", field="simulation")
        progress(1)
        measured = _scenes(campaign, rounds, progress)
        seconds = fitted(measured)
        seconds |= _report(campaign, record) | _loads(campaign)
        progress(1)
        seconds[Term.RUN] = _beside(campaign, Costs(seconds | {Term.RUN: 0.0}))
        progress(1)
    here = machine()
    kept = cost_estimate.save_calibration(Costs(seconds, processor=here.processor, date=date), path)
    model = Costs(seconds)
    return Calibration(
        date=date,
        machine=here,
        seconds={term.value: seconds[term] for term in Term},
        observations=tuple(replace(each, estimated=model.of(each.amounts)) for each in measured),
        path=str(kept),
    )


def fitted(observations: Sequence[Observation]) -> dict[Term, float]:
    """Return the costs of least relative squares, s a unit.

    Minimises sum_i (1 - a_i x / t_i)^2 + sum_k (w (x_k / d_k - 1))^2 over x >= 0, with the
    amounts a, the times t and the costs d that come with lidarops.

    Parameters
    ----------
    observations : sequence of Observation
        With times above zero.
    """
    usual = np.array([cost_estimate.DEFAULTS[term] for term in Term])
    amounts = np.array([[each.amounts.get(term, 0.0) for term in Term] for each in observations])
    seconds = np.array([each.seconds for each in observations])
    told = amounts * usual / seconds[:, np.newaxis]
    weak = _TRUST * np.eye(len(Term))
    found, _ = nnls(
        np.vstack([told, weak]), np.concatenate([np.ones(len(seconds)), np.full(len(Term), _TRUST)])
    )
    return {term: float(value) for term, value in zip(Term, found * usual, strict=True)}


def _scenes(
    campaign: Campaign, rounds: int, progress: Callable[[int], object]
) -> list[Observation]:
    """Process every scene whole, with and without known digests, and product by product."""
    jobs = [
        job
        for judged in archive.assess(campaign, force=True)
        for job in _parts(Job(campaign, judged.scene, judged.plan))
    ]
    times: list[list[float]] = [[] for _ in jobs]
    for _ in range(rounds):
        for job, spent in zip(jobs, times, strict=True):
            begin = time.process_time()
            outcome = process_scene(job)
            spent.append(time.process_time() - begin)
            if outcome.error:
                raise CampaignError(f"{job.scene.id}: {outcome.error}", field="simulation")
        progress(1)
    return [
        Observation(
            scene=job.scene.instrument,
            products=tuple(
                f"{kind} {channel}" for kind, channel in product_dependence.wanted(job.plan)
            ),
            amounts=cost_estimate.amounts(job.scene, job.plan),
            seconds=median(spent),
            estimated=0.0,
        )
        for job, spent in zip(jobs, times, strict=True)
    ]


def _parts(job: Job) -> Iterator[Job]:
    yield job
    granules = tuple(replace(each, sha256=None) for each in job.scene.granules)
    yield replace(job, scene=replace(job.scene, granules=granules))
    wanted = product_dependence.wanted(job.plan)
    for product in wanted if len(wanted) > 1 else ():
        yield replace(job, plan=product_dependence.plan_closure(job.plan, [product]))


def _report(campaign: Campaign, record: RunRecord) -> dict[Term, float]:
    """Return what a page of a report costs, and the figures of each kind of product."""
    page = _page(campaign, replace(record, scenes=()))
    found = {Term.PAGE: page}
    for kind in ProductKind:
        some = sorted(
            (replace(scene, products=mine)
             for scene in record.scenes
             if (mine := tuple(made for made in scene.products if made.kind is kind)[:1])),
            key=lambda scene: scene.products[0].values,
        )  # fmt: skip
        least = max(_page(campaign, replace(record, scenes=(some[0],))) - page, 0.0)
        found[cost_estimate.figure(kind)] = least
        if kind is ProductKind.SIGNAL:
            most = max(_page(campaign, replace(record, scenes=(some[-1],))) - page, least)
            few, many = (some[place].products[0].values for place in (0, -1))
            found[Term.FIGURE_VALUE] = (most - least) / (many - few)
    return found


def _loads(campaign: Campaign) -> dict[Term, float]:
    """Return what a process of its own loads with the first product of each kind, s."""
    told = _child(
        "from lidarops.bench.throughput.cost_calibration import first_times; first_times(sys.argv[1])",
        campaign,
    )
    found: dict[str, list[float]] = json.loads(told)
    return {
        cost_estimate.load_of(kind): max(first - again, 0.0)
        for kind, (first, again) in found.items()
    }


def first_times(path: str) -> None:
    """Write for each kind of product what the first scene and the same again cost, as JSON."""
    campaign = load_campaign(path)
    jobs: dict[str, Job] = {}
    for judged in archive.assess(campaign, force=True):
        for kind, channel in product_dependence.wanted(judged.plan):
            mine = product_dependence.plan_closure(judged.plan, [(kind, channel)])
            jobs.setdefault(kind.value, Job(campaign, judged.scene, mine))
    found = {}
    # What all kinds load counts for the first of them, signals.
    for kind in ProductKind:
        found[kind.value] = [process_scene(jobs[kind.value]).cpu_seconds for _ in range(2)]
    sys.stdout.write(json.dumps(found))


def _child(code: str, campaign: Campaign, *words: str) -> str:
    """Run Python in a process of its own, and return what it writes."""
    path = str(campaign.folder / CAMPAIGN_FILE)
    done = subprocess.run(  # noqa: S603 - this very Python and a file of our own
        [sys.executable, "-c", f"import sys; {code}", path, *words],
        check=False,
        capture_output=True,
        text=True,
    )
    # 1 tells of scenes without a value to use, which cost as much.
    if done.returncode not in (0, 1) or not done.stdout:
        raise CampaignError(f"a process of the calibration failed: {done.stderr[-500:]}")
    return done.stdout


def _page(campaign: Campaign, record: RunRecord) -> float:
    begin = time.process_time()
    archive.report_run(campaign, record)
    return time.process_time() - begin


def _beside(campaign: Campaign, model: Costs) -> float:
    """Return what a run in a process of its own costs beside its scenes and its report, s.

    No less than the median of runs with nothing to do: as a difference of large numbers alone it
    came out at a quarter of that where the machine was busy.
    """
    tally = cost_estimate.Tally(model)
    for judged in archive.assess(campaign, force=True):
        tally.add(judged.scene, judged.plan)
    beside = _of_run(campaign, "--force") - tally.total
    return max(beside, median(_of_run(campaign) for _ in range(_IDLE_RUNS)))


def _of_run(campaign: Campaign, *words: str) -> float:
    """Return the CPU time of a run in a process of its own, s."""
    before = _of_children()
    command = "from lidarops.cli import app; sys.argv.insert(1, 'reprocess'); app()"
    _child(command, campaign, *words, "--json")
    return _of_children() - before


def _of_children() -> float:
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
    known: dict[str, Any] = {
        "full_overlap_range": 150,
        "channels": {_PHOTON: {"dead_time": 3e-9}},
    }
    if "scan" not in lidar.air:
        known["zenith_angle"] = 0 if lidar.air["kind"] == "vertical" else 90
    return {
        "station": lidar.station,
        "files": f"{name}/m*",
        "dark_files": f"{name}/dark/d*",
        "facts": [known],
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


def calibration_report(found: Calibration, data: str = "") -> BenchmarkReport:
    """Return the page of a calibration."""
    terms = Table(
        title="What things cost",
        columns=("term", "CPU s each", "that come with lidarops"),
        rows=tuple(
            (term.value, f"{found.seconds[term]:.3g}", f"{cost_estimate.DEFAULTS[term]:.3g}")
            for term in Term
        ),
        note=f"Kept in {found.path}; lidarops plan estimates run times with them.",
    )
    scenes = Table(
        title="Scenes they were found from",
        columns=("instrument", "products", "CPU s", "estimated", "ratio"),
        rows=tuple(
            (
                each.scene,
                ", ".join(each.products),
                f"{each.seconds:.3f}",
                f"{each.estimated:.3f}",
                f"{each.estimated / each.seconds:.2f}",
            )
            for each in found.observations
        ),
    )
    text = (
        "CPU time of simulated scenes of many kinds and sizes, whole and product by product, as a"
        " sum over what there is in them. The farthest estimate of these is off by a factor of"
        f" {found.farthest:.2f}."
    )
    if told := doubt(found):
        text += f" Do not trust them: {told}."
    return BenchmarkReport(
        title="Costs: what the estimates of run times come from",
        facts=facts(found.date, found.machine),
        parts=(Part(title="Costs of this machine", text=text, tables=(terms, scenes)),),
        data=data,
    )
