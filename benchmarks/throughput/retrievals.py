"""CPU time per profile of a homogeneous path, beside the peer and a read of the same array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous_peers import PEERS
from benchmarks.harness.figure import CPU_TIME, Scores, cpu_time, timed
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.scenes.homogeneous_paths import Scenario, method_arguments
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
READ: Final = "read (np.max)"
"""Name of the floor of all times: a vectorised read of the same array in the same run."""
_MISSING: Final = 0.3
"""Share of the bins that are NaN, at random."""

Solver = Callable[[Any, Scenario], object]


def measure_solvers(
    effort: Effort, *, profiles: int | None = None, repeats: int | None = None
) -> Study:
    """Time every method of `fit_homogeneous_path`, and the peer, on one path with noise.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Profiles per call.
    repeats : int, optional
        Repeats of each timing, of which the least time counts.
    """
    count = profiles or (4_000 if effort.quick else 16_000)
    repeats = repeats or (3 if effort.quick else 9)
    note = (
        f"Path {PATH.label}, {PATH.bins} bins; one variance for all profiles or none, no "
        "correlation length or exposure. All outputs and flags. One thread, least CPU time of "
        "interleaved repeats; numba is timed once compiled. Reads: multiples of the read, "
        f"{READ}, a vectorised maximum of the same array in the same run: the floor."
    )
    results = []
    for missing, variance in product((0.0, _MISSING), (1.0, None)):
        gaps = f"{100 * missing:.0f} % of bins missing" if missing else "dense"
        case = f"float32, {gaps}, variance {'given' if variance else 'estimated'}"
        power = PATH.powers(count, dtype=np.float32)
        if missing:
            power[np.random.default_rng(1).random(power.shape, np.float32) < missing] = np.nan
        scores = _times(case, power, _solvers(variance, missing), repeats)
        results.append(Results(case, scores, note))
        effort.progress(1)
    return Study(results)


def _solvers(variance: float | None, missing: float) -> dict[str, Solver]:
    solvers: dict[str, Solver] = {
        method.value: partial(_solve, method, variance)
        for method in HomogeneousMethod
        # The cubic allows no gaps: it raises an error at once.
        if not (missing and method is HomogeneousMethod.CUBIC)
    }
    return solvers | (PEERS if variance and not missing else {})


def _solve(method: HomogeneousMethod, variance: float | None, power: Any, path: Scenario) -> object:
    options = method_arguments(method, path)
    return fit_homogeneous_path(power, path.range, variance=variance, method=method, **options)


def _times(case: str, power: Any, solvers: Mapping[str, Solver], repeats: int) -> Scores:
    """Return the least CPU time per profile of each method, and as a multiple of the read."""
    calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
    calls |= {name: partial(solver, power, PATH) for name, solver in solvers.items()}
    times = least_times(calls, repeats)
    return {
        (case, name): {
            "lidarops": name in list(HomogeneousMethod),
            CPU_TIME: cpu_time(1e9 * seconds / len(power)),
            "reads": seconds / times[READ],
        }
        for name, seconds in times.items()
    }


def least_times(functions: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the least CPU time in seconds of each function, by name.

    The functions take turns, so that other load of the machine affects all of them. One round
    before that is not counted: it compiles and fills caches.
    """
    for function in functions.values():
        function()
    rounds = [
        {name: timed(function)[0] for name, function in functions.items()} for _ in range(repeats)
    ]
    return {name: min(times[name] for times in rounds) for name in functions}
