"""Time the solvers of a homogeneous path and the steps of an elastic inversion.

Times are compared with a vectorised read of the same array in the same run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic_costs import ELASTIC_LEVEL, elastic_costs
from lidarops.bench.accuracy.homogeneous_cases import PathSolver, Scenario, method_arguments
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import (
    READ,
    Machine,
    StepCost,
    affordable,
    in_threads,
    least_times,
    machine,
)
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
THREADED: Final = ("compressed",)

_PROFILES: Final = 40_000
_QUICK_PROFILES: Final = 8_000
_REPEATS: Final = 9
_QUICK_REPEATS: Final = 3
_MISSING: Final = 0.3


@dataclass(frozen=True, slots=True)
class Setting:
    """Data for which the solvers are timed."""

    dtype: str
    known_variance: bool
    missing: float
    """Share of the bins, at random, that are NaN."""

    @property
    def label(self) -> str:
        """Description in words."""
        gaps = f"{100 * self.missing:.0f} % of bins missing" if self.missing else "dense"
        variance = "variance given" if self.known_variance else "variance estimated"
        return f"{self.dtype}, {gaps}, {variance}"


@dataclass(frozen=True, slots=True)
class Speed:
    """CPU time of one solver in one setting."""

    method: str
    setting: Setting
    profiles: int
    nanoseconds: float
    """Per profile, least of the repeats."""
    reads: float
    """The same as a multiple of the read of the same array in the same run."""


@dataclass(frozen=True, slots=True)
class Threads:
    """Wall time of one thread over that of two, each with half of the profiles."""

    method: str
    dtype: str
    gain: float


@dataclass(frozen=True, slots=True)
class SolverThroughput:
    """Result of the throughput benchmark of the homogeneous path."""

    date: str
    machine: Machine
    path: Scenario
    speeds: tuple[Speed, ...]
    threads: tuple[Threads, ...]


def measure_solvers(effort: Effort, *, profiles: int | None = None) -> SolverThroughput:
    """Time every method of `fit_homogeneous_path`, and the iterative peers, on one path with noise.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Most profiles per call.
    """
    count = profiles or (_QUICK_PROFILES if effort.quick else _PROFILES)
    rounds = effort.repeats or (_QUICK_REPEATS if effort.quick else _REPEATS)
    speeds: list[Speed] = []
    for setting in settings():
        speeds += _speeds(setting, count, rounds)
        effort.progress(1)
    threads = [
        _threads(method, dtype, count, rounds)
        for method, dtype in product(THREADED, ("float32", "float64"))
        if method in set(HomogeneousMethod)
    ]
    return SolverThroughput(effort.date, machine(), PATH, tuple(speeds), tuple(threads))


def settings() -> list[Setting]:
    """Return the settings that are timed."""
    return [
        Setting(dtype, known_variance, missing)
        for missing, known_variance, dtype in product(
            (0.0, _MISSING), (True, False), ("float32", "float64")
        )
    ]


def _powers(setting: Setting, count: int) -> Any:
    power = PATH.powers(count, dtype=setting.dtype)
    if setting.missing:
        gaps = np.random.default_rng(1).random(power.shape, np.float32) < setting.missing
        power[gaps] = np.nan
    return power


def _speeds(setting: Setting, count: int, repeats: int) -> Iterator[Speed]:
    power = _powers(setting, count)
    calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
    sizes = {READ: count}
    for name, solver in _solvers(setting).items():
        sizes[name] = affordable(_first(solver, power), count)
        calls[name] = partial(solver, power[: sizes[name]], PATH)
    times = least_times(calls, repeats)
    read = times[READ] / count
    for name, seconds in times.items():
        per_profile = seconds / sizes[name]
        yield Speed(name, setting, sizes[name], 1e9 * per_profile, per_profile / read)


def _solvers(setting: Setting) -> Mapping[str, Callable[[Any, Scenario], object]]:
    variance = 1.0 if setting.known_variance else None
    ours = {
        str(m): partial(_solve, m, variance)
        for m in HomogeneousMethod
        if m is not HomogeneousMethod.AUTO
    }
    if setting.missing:
        # The cubic allows no gaps: it raises an error at once.
        return {name: solver for name, solver in ours.items() if name != HomogeneousMethod.CUBIC}
    others: dict[str, PathSolver] = iterative_peers() if setting.known_variance else {}
    return {**ours, **others}


def _solve(method: HomogeneousMethod, variance: float | None, power: Any, path: Scenario) -> object:
    return fit_homogeneous_path(
        power,
        path.range,
        variance=variance,
        method=method.value,
        **method_arguments(method, path),  # type: ignore[arg-type]
    )


def _first(solver: Callable[[Any, Scenario], object], power: Any) -> Callable[[int], object]:
    return lambda few: solver(power[:few], PATH)


def _threads(method: str, dtype: str, count: int, repeats: int) -> Threads:
    power = _powers(Setting(dtype, known_variance=True, missing=0.0), count)
    call = partial(_solve, HomogeneousMethod(method), 1.0)
    halves = np.array_split(power, 2)
    times = least_times(
        {
            "one": lambda: call(power, PATH),
            "two": lambda: in_threads(lambda half: call(halves[half], PATH), 2),
        },
        repeats,
        clock="perf_counter",
    )
    return Threads(method, dtype, times["one"] / times["two"])


# Elastic inversion ----------------------------------------------------------------------------

_BATCHES: Final = (1, 100, 2000)
_QUICK_BATCHES: Final = (1, 400)


@dataclass(frozen=True, slots=True)
class ElasticThroughput:
    """Result of the throughput benchmark of the elastic retrieval."""

    date: str
    machine: Machine
    bins: int
    level: float
    """Background, counts per shot."""
    costs: tuple[StepCost, ...]


def measure_elastic(effort: Effort, *, batches: Sequence[int] | None = None) -> ElasticThroughput:
    """Time every step from counts to backscatter, and simple peers, on the simulated set.

    Parameters
    ----------
    effort : Effort
    batches : sequence of int, optional
        Profiles per call.
    """
    sizes = batches or (_QUICK_BATCHES if effort.quick else _BATCHES)
    rounds = effort.repeats or (_QUICK_REPEATS if effort.quick else _REPEATS)
    costs: list[StepCost] = []
    for size in sizes:
        costs += elastic_costs(size, rounds)
        effort.progress(1)
    return ElasticThroughput(
        effort.date, machine(), elastic_cases.RANGE.size, ELASTIC_LEVEL, tuple(costs)
    )
