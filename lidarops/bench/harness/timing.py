"""CPU time of this process, and what machine it was measured on."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from lidarops.plan.cost_estimate import processor

_SHORTEST: Final = 1e-9
"""The clock of a fast machine with little work may not have moved."""
_PACKAGES: Final = ("lidarops", "numpy", "numba", "scipy", "jax")


@dataclass(frozen=True, slots=True)
class Machine:
    """Where and with what a benchmark ran."""

    processor: str
    python: str
    packages: Mapping[str, str]
    """Version by name, of what is installed."""


def machine() -> Machine:
    """Return the machine and the packages of this process."""
    return Machine(
        processor=processor(),
        python=platform.python_version(),
        packages={name: found for name in _PACKAGES if (found := _version(name))},
    )


def least_times(
    ways: Mapping[str, Callable[[], object]], repeats: int, *, clock: str = "process_time"
) -> dict[str, float]:
    """Return the least time in seconds of each way, by name.

    The ways take turns, so that what else the machine does meets all of them; one uncounted
    round before compiles and fills caches.

    Parameters
    ----------
    ways : mapping of str to callable
    repeats : int
        Counted rounds, at least 1.
    clock : {"process_time", "perf_counter"}
        CPU time of all threads of the process, or time on the wall.
    """
    read: Callable[[], float] = getattr(time, clock)
    least = dict.fromkeys(ways, float("inf"))
    for way in ways.values():
        way()
    for _ in range(repeats):
        for name, way in ways.items():
            begin = read()
            way()
            least[name] = min(least[name], max(read() - begin, _SHORTEST))
    return least


def in_threads(way: Callable[[int], object], parts: int) -> None:
    """Call ``way(0)`` to ``way(parts - 1)`` in as many threads."""
    with ThreadPoolExecutor(parts) as pool:
        for future in [pool.submit(way, part) for part in range(parts)]:
            future.result()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
