"""CPU time of retrievals per profile, beside peers and a read of the same array."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy import multiangle_cases, network_cases
from benchmarks.accuracy.elastic import elastic_costs
from benchmarks.accuracy.homogeneous_cases import PathSolver, Scenario, method_arguments
from benchmarks.accuracy.homogeneous_peers import iterative_peers
from benchmarks.accuracy.multiangle_cases import Scan
from benchmarks.accuracy.multiangle_peers import scan_peers
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Chapter, Effort, Results, Study, frame
from benchmarks.harness.timing import (
    CPU_TIME,
    READ,
    affordable,
    in_threads,
    least_times,
    time_methods,
)
from benchmarks.harness.verdicts import Scores
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
_PRECISIONS: Final = ("float32", "float64")
_MISSING: Final = 0.3
"""Share of the bins that are NaN, at random."""
_SCAN_INPUTS: Final = "read (np.max), signal and variance"
_TIMED_PROFILES: Final = 250


def _repeats(effort: Effort, most: int) -> int:
    return effort.repeats or (3 if effort.quick else most)


def _calls_of(batch: int) -> str:
    return f"{batch:,} profile{'' if batch == 1 else 's'} a call"


def _study(title: str, effort: Effort, name: str, text: str, scores: Scores) -> Study:
    """Return the study of the CPU time of methods, with a table for each case."""
    cases = dict.fromkeys(case for case, _ in scores)
    chapter = Chapter(
        "CPU time per profile",
        f"{text} One thread, least CPU time of interleaved repeats; numba is timed once compiled. "
        f"{READ} is a vectorised maximum of the same array in the same run: the floor.",
        [
            Results(
                case,
                {key: score for key, score in scores.items() if key[0] == case},
                "Reads: multiples of the read. Profiles: of a call, fewer for slow methods.",
            )
            for case in cases
        ],
        [Chart(name, "CPU time per profile", "A mark for each case.", frame(scores), CPU_TIME)],
    )
    return Study(title, effort.date, [chapter])


# Homogeneous path -----------------------------------------------------------------------------


def measure_solvers(effort: Effort, *, profiles: int | None = None) -> Study:
    """Time every method of `fit_homogeneous_path`, and the iterative peers, on one path with noise.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Most profiles per call.
    """
    count = profiles or (8_000 if effort.quick else 40_000)
    repeats = _repeats(effort, 9)
    scores: Scores = {}
    for missing, variance, dtype in product((0.0, _MISSING), (1.0, None), _PRECISIONS):
        scores |= _solver_costs(dtype, variance, missing, (count, repeats))
        effort.progress(1)
    gains: Scores = {
        (dtype, HomogeneousMethod.DIRECT): {"gain": _thread_gain(dtype, count, repeats)}
        for dtype in _PRECISIONS
    }
    threads = Chapter(
        "Two threads",
        "Wall time of one thread over that of two threads with half of the profiles each. It is "
        "meaningful only on a machine with two idle cores.",
        [Results("Gain of two threads", gains, case="data")],
    )
    text = (
        f"Path {PATH.label}, {PATH.bins} bins; one variance for all profiles or none, no "
        "correlation length or exposure. All outputs and flags."
    )
    study = _study("Homogeneous path: time per profile", effort, "time", text, scores)
    return Study(study.title, study.date, [*study.chapters, threads])


def _powers(dtype: str, missing: float, count: int) -> Any:
    power = PATH.powers(count, dtype=dtype)
    if missing:
        power[np.random.default_rng(1).random(power.shape, np.float32) < missing] = np.nan
    return power


def _solver_costs(
    dtype: str, variance: float | None, missing: float, size: tuple[int, int]
) -> Scores:
    count, repeats = size
    power = _powers(dtype, missing, count)
    peers: dict[str, PathSolver] = iterative_peers() if variance and not missing else {}
    solvers: dict[str, Callable[[Any, Scenario], object]] = {
        method.value: partial(_solve, method, variance)
        for method in HomogeneousMethod
        # The cubic allows no gaps: it raises an error at once.
        if not (missing and method is HomogeneousMethod.CUBIC)
    }
    calls: dict[str, tuple[Callable[[], object], int]] = {READ: (partial(np.max, power), count)}
    for name, solver in {**solvers, **peers}.items():
        few = affordable(partial(_first, solver, power), count)
        calls[name] = (partial(_first, solver, power, few), few)
    gaps = f"{100 * missing:.0f} % of bins missing" if missing else "dense"
    case = f"{dtype}, {gaps}, variance {'given' if variance else 'estimated'}"
    return time_methods(case, calls, repeats, peers=peers)


def _first(solver: Callable[[Any, Scenario], object], power: Any, profiles: int) -> object:
    return solver(power[:profiles], PATH)


def _solve(method: HomogeneousMethod, variance: float | None, power: Any, path: Scenario) -> object:
    options = method_arguments(method, path)
    return fit_homogeneous_path(power, path.range, variance=variance, method=method, **options)


def _thread_gain(dtype: str, count: int, repeats: int) -> float:
    solve = partial(_solve, HomogeneousMethod.DIRECT, 1.0)
    power = _powers(dtype, 0.0, count)
    halves = np.array_split(power, 2)
    calls = {
        "one": lambda: solve(power, PATH),
        "two": lambda: in_threads(lambda half: solve(halves[half], PATH), 2),
    }
    times = least_times(calls, repeats, clock="perf_counter")
    return times["one"] / times["two"]


# Elastic inversion, scans and networks --------------------------------------------------------


def measure_elastic(effort: Effort, *, batches: Sequence[int] | None = None) -> Study:
    """Time every step from counts to backscatter, and simple peers, on the simulated set.

    Parameters
    ----------
    effort : Effort
    batches : sequence of int, optional
        Profiles per call.
    """
    scores: Scores = {}
    for size in batches or ((1, 400) if effort.quick else (1, 100, 2000)):
        scores |= elastic_costs(_calls_of(size), size, _repeats(effort, 9))
        effort.progress(1)
    text = (
        "Profiles of 1005 bins, float64. Steps of lidarops compute all errors and flags; all "
        "steps: background, clouds, reference window and inversion with its error budget. The "
        "peer of the background gives values and errors without flags, Klett in numpy values alone."
    )
    return _study("Elastic inversion: time per profile", effort, "elastic-time", text, scores)


def measure_scans(effort: Effort, *, batches: Sequence[int] | None = None) -> Study:
    """Time methods and peers on clear air, beside reading the inputs.

    Parameters
    ----------
    effort : Effort
    batches : sequence of int, optional
        Profiles per call.
    """
    scene = multiangle_cases.clear(3000.0)
    scores: Scores = {}
    for batch in batches or ((1, 64) if effort.quick else (1, 64, 512)):
        scan = scene.draw(batch, batch, 8)
        scores |= _scan_costs(_calls_of(batch), scan, _repeats(effort, 5))
        effort.progress(1)
    text = (
        f"Clear air, {scene.path.size} angles, {scene.altitude.size} altitudes, float64. Complete "
        "retrievals, with all errors, residuals and flags. Plain: without the robust passes, which "
        "a single residual too large for chance starts, and which take more time than all other "
        "steps. The peers give values without flags, lstsq also standard errors."
    )
    return _study("Scans: time per profile", effort, "multiangle-time", text, scores)


def _scan_costs(case: str, scan: Scan, repeats: int) -> Scores:
    """Return the CPU time of methods and peers, the reads first."""
    batch = len(scan.signal)
    # Callers pass an array, not a view of one row.
    scan = Scan(scan.scene, scan.signal, np.ascontiguousarray(scan.variance))
    calls: dict[str, tuple[Callable[[], object], int]] = {
        READ: (lambda: np.max(scan.signal), batch),
        _SCAN_INPUTS: (lambda: (np.max(scan.signal), np.max(scan.variance)), batch),
    }
    for name, solver in multiangle_cases.scan_methods().items():
        calls[name] = (partial(solver, scan), batch)
    for method in (multiangle_cases.KANO_HAMILTON, multiangle_cases.JOINT):
        plain = partial(multiangle_cases.retrieve, scan, method, robust=False)
        calls[f"{method}, plain"] = (plain, batch)
    peers = scan_peers()
    for name, solver in peers.items():
        calls[name] = (partial(solver, scan.first(1)), 1)
    return time_methods(case, calls, repeats, peers={_SCAN_INPUTS, *peers})


def measure_networks(effort: Effort) -> Study:
    """Time whole profiles of networks with every solver."""
    scores: Scores = {}
    for lidars in network_cases.LIDAR_LINES:
        network, size = lidars.network(), _TIMED_PROFILES
        signals = network_cases.signals(network, network_cases.AIRS[0])
        power, variance = signals.draw(network_cases.PEER_NOISE, size, 7)
        calls: dict[str, tuple[Callable[[], object], int]] = {READ: (partial(np.max, power), size)}
        for solver in network_cases.NETWORK_SOLVERS:
            calls[solver.name] = (partial(solver, power, variance, signals), size)
        scores |= time_methods(f"{network.beams} beams", calls, _repeats(effort, 7))
        effort.progress(1)
    text = (
        "From signals to extinction with errors, visibility and flags: point values, "
        "integrals and their covariances, and the solution."
    )
    return _study("Networks of lidars: time per profile", effort, "network-time", text, scores)
