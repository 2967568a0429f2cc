"""How fast the solvers of a homogeneous path, and the steps of an elastic inversion, are.

Times stand beside that of a vectorised read of the same array in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.homogeneous_cases import Scenario, Way, method_arguments
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.bench.harness.timing import Machine, in_threads, least_times, machine
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

READ: Final = "read (np.max)"
PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
THREADED: Final = ("compressed", "fast")

_PROFILES: Final = 40_000
_QUICK_PROFILES: Final = 8_000
_REPEATS: Final = 9
_QUICK_REPEATS: Final = 3
_MISSING: Final = 0.3
_TRIED: Final = 16
_LONGEST: Final = 0.06
"""Seconds that one round of one way may take; slower ones get fewer profiles."""


@dataclass(frozen=True, slots=True)
class Setting:
    """The data that a way to solve is given."""

    dtype: str
    known_variance: bool
    missing: float
    """Share of the bins, at random, that are NaN."""

    @property
    def label(self) -> str:
        """In words."""
        gaps = f"{100 * self.missing:.0f} % of bins missing" if self.missing else "dense"
        variance = "variance given" if self.known_variance else "variance estimated"
        return f"{self.dtype}, {gaps}, {variance}"


@dataclass(frozen=True, slots=True)
class Speed:
    """CPU time of one way to solve in one setting."""

    way: str
    setting: Setting
    profiles: int
    nanoseconds: float
    """A profile, least of the repeats."""
    reads: float
    """The same as a multiple of the read of the same array in the same run."""


@dataclass(frozen=True, slots=True)
class Threads:
    """Time on the wall with one thread over that with two, each with half of the profiles."""

    way: str
    dtype: str
    gain: float


@dataclass(frozen=True, slots=True)
class SolverThroughput:
    """The throughput benchmark of the homogeneous path."""

    date: str
    machine: Machine
    path: Scenario
    speeds: tuple[Speed, ...]
    threads: tuple[Threads, ...]


def measure_solvers(
    *,
    quick: bool = False,
    date: str = "",
    profiles: int | None = None,
    repeats: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> SolverThroughput:
    """Time every method of `fit_homogeneous_path`, and the iterative peers, on one path with noise.

    Parameters
    ----------
    quick : bool
        Fewer profiles and repeats.
    date : str
        When it is run, as it is to be stated.
    profiles, repeats : int, optional
        Most profiles of one call; counted rounds, of which the least time counts.
    progress : callable
        Is given 1 after each setting.
    """
    count = profiles or (_QUICK_PROFILES if quick else _PROFILES)
    rounds = repeats or (_QUICK_REPEATS if quick else _REPEATS)
    speeds: list[Speed] = []
    for setting in settings():
        speeds += _speeds(setting, count, rounds)
        progress(1)
    threads = [
        _threads(way, dtype, count, rounds)
        for way, dtype in product(THREADED, ("float32", "float64"))
        if way in set(HomogeneousMethod)
    ]
    return SolverThroughput(date, machine(), PATH, tuple(speeds), tuple(threads))


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
    for name, way in _ways(setting).items():
        sizes[name] = _affordable(_first(way, power), count)
        calls[name] = partial(way, power[: sizes[name]], PATH)
    times = least_times(calls, repeats)
    read = times[READ] / count
    for name, seconds in times.items():
        each = seconds / sizes[name]
        yield Speed(name, setting, sizes[name], 1e9 * each, each / read)


def _ways(setting: Setting) -> Mapping[str, Callable[[Any, Scenario], object]]:
    variance = 1.0 if setting.known_variance else None
    ours = {
        str(m): partial(_solve, m, variance)
        for m in HomogeneousMethod
        if m is not HomogeneousMethod.AUTO
    }
    if setting.missing:
        # The cubic takes no gaps, and says so at once.
        return {name: way for name, way in ours.items() if name != HomogeneousMethod.CUBIC}
    others: dict[str, Way] = iterative_peers() if setting.known_variance else {}
    return {**ours, **others}


def _solve(method: HomogeneousMethod, variance: float | None, power: Any, path: Scenario) -> object:
    return fit_homogeneous_path(
        power,
        path.range,
        variance=variance,
        method=method.value,
        **method_arguments(method, path),  # type: ignore[arg-type]
    )


def _first(way: Callable[[Any, Scenario], object], power: Any) -> Callable[[int], object]:
    return lambda few: way(power[:few], PATH)


def _affordable(call: Callable[[int], object], most: int) -> int:
    """Return how many profiles a call may get; it takes a number of profiles."""
    # What a call costs before the first profile counts for less, the more profiles it gets.
    few = _within(call, min(_TRIED, most), most)
    return few if few == most else _within(call, few, most)


def _within(call: Callable[[int], object], tried: int, most: int) -> int:
    call(tried)
    begin = time.perf_counter()
    call(tried)
    each = (time.perf_counter() - begin) / tried
    return int(min(most, max(round(_LONGEST / each), _TRIED)))


def _threads(way: str, dtype: str, count: int, repeats: int) -> Threads:
    power = _powers(Setting(dtype, known_variance=True, missing=0.0), count)
    call = partial(_solve, HomogeneousMethod(way), 1.0)
    halves = np.array_split(power, 2)
    times = least_times(
        {
            "one": lambda: call(power, PATH),
            "two": lambda: in_threads(lambda part: call(halves[part], PATH), 2),
        },
        repeats,
        clock="perf_counter",
    )
    return Threads(way, dtype, times["one"] / times["two"])


# Elastic inversion ----------------------------------------------------------------------------

ALL_STEPS: Final = "all steps"
ELASTIC_LEVEL: Final = 1e4
"""Background of the profiles that are timed, counts a shot."""
_BATCHES: Final = (1, 100, 2000)
_QUICK_BATCHES: Final = (1, 400)


@dataclass(frozen=True, slots=True)
class StepCost:
    """CPU time of one step of the elastic retrieval, or of a peer."""

    step: str
    batch: int
    """Profiles that a call would get."""
    profiles: int
    """Profiles that it got: fewer where it is slow."""
    nanoseconds: float
    """A profile, least of the repeats."""
    reads: float
    """The same as a multiple of the read of the same array in the same run."""
    ours: bool


@dataclass(frozen=True, slots=True)
class ElasticThroughput:
    """The throughput benchmark of the elastic retrieval."""

    date: str
    machine: Machine
    bins: int
    level: float
    """Background, counts a shot."""
    costs: tuple[StepCost, ...]


def measure_elastic(
    *,
    quick: bool = False,
    date: str = "",
    batches: Sequence[int] | None = None,
    repeats: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> ElasticThroughput:
    """Time every step from counts to backscatter, and plain peers, on the simulated set.

    Parameters
    ----------
    quick : bool
        Fewer profiles and repeats.
    date : str
        When it is run, as it is to be stated.
    batches : sequence of int, optional
        Profiles of one call.
    repeats : int, optional
        Counted rounds, of which the least time counts.
    progress : callable
        Is given 1 after each batch.
    """
    sizes = batches or (_QUICK_BATCHES if quick else _BATCHES)
    rounds = repeats or (_QUICK_REPEATS if quick else _REPEATS)
    costs: list[StepCost] = []
    for size in sizes:
        costs += elastic_costs(size, rounds)
        progress(1)
    return ElasticThroughput(date, machine(), elastic_cases.RANGE.size, ELASTIC_LEVEL, tuple(costs))


def elastic_costs(batch: int, repeats: int) -> list[StepCost]:
    """Return the CPU time of each step and peer, the read first.

    Parameters
    ----------
    batch : int
        Profiles of one call; slow peers get fewer.
    repeats : int
        Counted rounds.
    """
    steps, others = _steps(elastic_cases.simulated_sky().counts(ELASTIC_LEVEL, batch))
    sizes = {name: _affordable(step, batch) for name, step in (steps | others).items()}
    sizes[READ] = batch
    calls = {name: partial(step, sizes[name]) for name, step in (steps | others).items()}
    times = least_times(calls, repeats)
    read = times[READ] / batch
    return [
        StepCost(
            step=name,
            batch=batch,
            profiles=sizes[name],
            nanoseconds=1e9 * seconds / sizes[name],
            reads=seconds / sizes[name] / read,
            ours=name in steps and name != READ,
        )
        for name, seconds in times.items()
    ]


_Step = Callable[[int], object]
"""What is done with so many profiles."""


def _steps(counts: Any) -> tuple[dict[str, _Step], dict[str, _Step]]:
    """Return our steps, with the read, and the peers."""
    sky = elastic_cases.simulated_sky()
    find = elastic_cases.background_methods()
    found = find[elastic_cases.KNOWN_SHAPE](counts, sky)
    power, noise = elastic_cases.cleared(counts, sky, found), elastic_cases.variance(counts)
    # The peers take no gaps: they get the bins of incomplete overlap too.
    whole = counts - found.background[:, np.newaxis]

    def solve_particles(few: int) -> object:
        return elastic_cases.particles_of(
            power[:few],
            sky,
            elastic_cases.GIVEN,
            noise=noise[:few],
            background_error=found.standard_error[:few],
        )

    whole_way = elastic_cases.Chain(elastic_cases.KNOWN_SHAPE, choose=True)

    def everything(few: int) -> object:
        part = counts[:few]
        return elastic_cases.invert(part, sky, find[whole_way.way](part, sky), whole_way)

    ours: dict[str, _Step] = {
        READ: lambda few: np.max(counts[:few]),
        elastic_cases.TAIL_MEAN: lambda few: find[elastic_cases.TAIL_MEAN](counts[:few], sky),
        elastic_cases.KNOWN_SHAPE: lambda few: find[elastic_cases.KNOWN_SHAPE](counts[:few], sky),
        elastic_cases.TOLD: lambda few: find[elastic_cases.TOLD](counts[:few], sky),
        "layers.screen": lambda few: elastic_cases.screened(power[:few], noise[:few], sky),
        "reference.choose": lambda few: elastic_cases.chosen_window(power[:few], noise[:few], sky),
        "elastic.solve": solve_particles,
        ALL_STEPS: everything,
    }
    others: dict[str, _Step] = {
        "background, numpy lstsq": lambda few: elastic_cases.lstsq_backgrounds(counts[:few], sky),
        "Klett, numpy": lambda few: elastic_cases.klett_numpy(whole[:few], sky),
        "Klett, Python": lambda few: elastic_cases.klett_python(whole[:few], sky),
    }
    return ours, others
