"""CPU time of this process, and the machine on which it was measured."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, TypeVar

from lidarops.system.code_version import source_version

CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
_SHORTEST: Final = 1e-9
"""s; least time, because a coarse clock may not advance during a fast call."""
_PACKAGES: Final = ("lidarops", "numpy", "numba", "scipy")

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


def timed(call: Callable[[], _Result]) -> tuple[float, _Result]:
    """Return the CPU time of a call in seconds, and its result."""
    begin = time.process_time()
    result = call()
    return max(time.process_time() - begin, _SHORTEST), result


def cpu_seconds() -> float:
    """Return the CPU time of this process so far, with that of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
