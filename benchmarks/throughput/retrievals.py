"""CPU time per profile of a homogeneous path, beside the peer and a read of the same array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous import PEERS
from benchmarks.harness.figure import CPU_TIME, Scores, cpu_time, timed
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.scenes.homogeneous_paths import Scenario, solve_by
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
READ: Final = "read (np.max)"
"""Name of the floor of all times: a vectorised read of the same array in the same run."""
_MISSING: Final = 0.3
"""Share of the bins that are NaN, at random."""
_NOTE: Final = (
    f"Path {PATH.label}, {PATH.bins} bins; one variance for all profiles or none, no "
    "correlation length or exposure. All outputs and flags. One thread, least CPU time of "
    "interleaved repeats; numba is timed once compiled. Reads: multiples of the read, "
    f"{READ}, a vectorised maximum of the same array in the same run: the floor."
)


def measure_solvers(effort: Effort, *, profiles: int = 0, repeats: int = 0) -> Study:
    """Time every method of `fit_homogeneous_path`, and the peer, on one path with noise.

    The least time of the repeats counts; those that are 0 are chosen by the effort.
    """
    count = profiles or (4_000 if effort.quick else 16_000)
    repeats = repeats or (3 if effort.quick else 9)
    results = []
    for missing, variance in product((0.0, _MISSING), (1.0, None)):
        gaps = f"{100 * missing:.0f} % of bins missing" if missing else "dense"
        case = f"float32, {gaps}, variance {'given' if variance else 'estimated'}"
        power = PATH.powers(count, dtype=np.float32)
        if missing:
            power[np.random.default_rng(1).random(power.shape, np.float32) < missing] = np.nan
        calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
        for method in HomogeneousMethod:
            # The cubic allows no gaps: it raises an error at once.
            if not (missing and method is HomogeneousMethod.CUBIC):
                calls[method.value] = partial(solve_by, method, power, PATH, variance)
        if variance and not missing:
            calls |= {name: partial(solver, power, PATH) for name, solver in PEERS.items()}
        results.append(Results(case, _times(case, calls, repeats, count), _NOTE))
        effort.progress(1)
    return Study(results)


def _times(
    case: str, calls: Mapping[str, Callable[[], object]], repeats: int, profiles: int
) -> Scores:
    """Return the least CPU time per profile of each call, and as a multiple of the read."""
    times = least_times(calls, repeats)
    ours: list[Any] = list(HomogeneousMethod)
    return {
        (case, name): {
            "lidarops": name in ours,
            CPU_TIME: cpu_time(1e9 * seconds / profiles),
            "reads": seconds / times[READ],
        }
        for name, seconds in times.items()
    }


def least_times(functions: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the least CPU time in seconds of each function, by name.

    The functions take turns, so that other load of the machine affects all of them. One round
    before that is not counted: it compiles and fills caches.
    """
    rounds = [
        {name: timed(function)[0] for name, function in functions.items()}
        for _ in range(1 + repeats)
    ]
    return {name: min(times[name] for times in rounds[1:]) for name in functions}
