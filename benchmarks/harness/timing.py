"""CPU time of this process, and the machine on which it was measured."""

from __future__ import annotations

import multiprocessing
import os
import platform
import resource
import time
from collections.abc import Callable, Container, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

from benchmarks.harness.figure import cpu_time
from benchmarks.harness.verdicts import Scores
from lidarops.system.code_version import source_version

CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
READS: Final = "reads"
"""Quantity: CPU time as a multiple of the read."""
READ: Final = "read (np.max)"
"""Name of the floor of all times: a vectorised read of the same array in the same run."""
_SHORTEST: Final = 1e-9
"""s; least time, because a coarse clock may not advance during a fast call."""
_TRIED: Final = 16
_LONGEST: Final = 0.06
"""Longest time of one round of a solver, s; slower solvers get fewer profiles."""
_PACKAGES: Final = ("lidarops", "numpy", "numba", "scipy")

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def machine() -> dict[str, Any]:
    """Return processor, cores, versions of Python and packages, and the digest of the code."""
    models = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        if line.startswith("model name")
    ]
    return {
        "processor": models[0] if models else platform.machine(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "code": source_version(),
    }


def least_times(functions: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the least CPU time in seconds of each function, by name.

    The functions take turns, so that other load of the machine affects all of them. One round
    before that is not counted: it compiles and fills caches.
    """
    least = dict.fromkeys(functions, float("inf"))
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            least[name] = min(least[name], timed(function)[0])
    return least


Calls = Mapping[str, tuple[Callable[[], object], int]]
"""Calls by method, each with its number of profiles; the read is one of them."""


def time_methods(case: str, calls: Calls, repeats: int, *, peers: Container[str] = ()) -> Scores:
    """Return the least CPU time per profile of each method, and as a multiple of the read."""
    times = least_times({name: call for name, (call, _) in calls.items()}, repeats)
    read = times[READ] / calls[READ][1]
    return {
        (case, name): {
            "lidarops": name != READ and name not in peers,
            "profiles": profiles,
            CPU_TIME: cpu_time(1e9 * times[name] / profiles),
            READS: times[name] / profiles / read,
        }
        for name, (_, profiles) in calls.items()
    }


def timed(call: Callable[[], _Result]) -> tuple[float, _Result]:
    """Return the CPU time of a call in seconds, and its result."""
    begin = time.process_time()
    result = call()
    return max(time.process_time() - begin, _SHORTEST), result


def cpu_seconds() -> float:
    """Return the CPU time of this process so far, with that of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def in_fresh_process(
    function: Callable[_Arguments, _Result], *args: _Arguments.args, **kwargs: _Arguments.kwargs
) -> _Result:
    """Call a function in a new process, whose memory holds nothing else."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *args, **kwargs).result()


def peak_memory() -> float:
    """Return the peak memory of this process so far, bytes."""
    # The maximum of `resource` includes the memory of the parent process.
    status = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024.0 * float(next(line for line in status if line.startswith("VmHWM")).split()[1])


def affordable(call: Callable[[int], object], most: int) -> int:
    """Return how many profiles a call may get; the call takes a number of profiles."""
    few = min(_TRIED, most)
    # The fixed cost of a call counts less with more profiles: estimate twice.
    for _ in range(2):
        call(few)
        per_profile = timed(partial(call, few))[0] / few
        few = min(most, max(round(_LONGEST / per_profile), _TRIED))
    return few
