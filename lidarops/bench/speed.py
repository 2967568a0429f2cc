"""How fast the solvers of a homogeneous path are, against a vectorised read of the same array."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from lidarops.bench.homogeneous import Scenario, Way, arguments
from lidarops.bench.peers import peers
from lidarops.bench.timing import Machine, in_threads, least_times, machine
from lidarops.retrieve.homogeneous import Method, solve

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
class Throughput:
    """The throughput benchmark of the homogeneous path."""

    date: str
    machine: Machine
    path: Scenario
    speeds: tuple[Speed, ...]
    threads: tuple[Threads, ...]


def measure(
    *,
    quick: bool = False,
    date: str = "",
    profiles: int | None = None,
    repeats: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Throughput:
    """Time every method of `solve`, and the iterative peers, on one path with noise.

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
        if way in set(Method)
    ]
    return Throughput(date, machine(), PATH, tuple(speeds), tuple(threads))


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
        sizes[name] = _affordable(way, power)
        calls[name] = partial(way, power[: sizes[name]], PATH)
    times = least_times(calls, repeats)
    read = times[READ] / count
    for name, seconds in times.items():
        each = seconds / sizes[name]
        yield Speed(name, setting, sizes[name], 1e9 * each, each / read)


def _ways(setting: Setting) -> Mapping[str, Callable[[Any, Scenario], object]]:
    variance = 1.0 if setting.known_variance else None
    ours = {str(m): partial(_solve, m, variance) for m in Method if m is not Method.AUTO}
    if setting.missing:
        # The cubic takes no gaps, and says so at once.
        return {name: way for name, way in ours.items() if name != Method.CUBIC}
    others: dict[str, Way] = peers() if setting.known_variance else {}
    return {**ours, **others}


def _solve(method: Method, variance: float | None, power: Any, path: Scenario) -> object:
    return solve(
        power,
        path.range,
        variance=variance,
        method=method.value,
        **arguments(method, path),  # type: ignore[arg-type]
    )


def _affordable(way: Callable[[Any, Scenario], object], power: Any) -> int:
    # What a call costs before the first profile counts for less, the more profiles it gets.
    few = _within(way, power[:_TRIED], len(power))
    return few if few == len(power) else _within(way, power[:few], len(power))


def _within(way: Callable[[Any, Scenario], object], tried: Any, most: int) -> int:
    way(tried, PATH)
    begin = time.perf_counter()
    way(tried, PATH)
    each = (time.perf_counter() - begin) / len(tried)
    return int(min(most, max(round(_LONGEST / each), _TRIED)))


def _threads(way: str, dtype: str, count: int, repeats: int) -> Threads:
    power = _powers(Setting(dtype, known_variance=True, missing=0.0), count)
    call = partial(_solve, Method(way), 1.0)
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
