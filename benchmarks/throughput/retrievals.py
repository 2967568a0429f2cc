"""CPU time per profile of a homogeneous path, beside peers and a read of the same array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous_peers import iterative_peers
from benchmarks.harness.figure import CPU_TIME, Scores, cpu_time, timed
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Effort, Results, Study, frame
from benchmarks.scenes.homogeneous_paths import Scenario, method_arguments
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
READ: Final = "read (np.max)"
"""Name of the floor of all times: a vectorised read of the same array in the same run."""
_PRECISIONS: Final = ("float32", "float64")
_MISSING: Final = 0.3
"""Share of the bins that are NaN, at random."""
_TRIED: Final = 16
_LONGEST: Final = 0.06
"""Longest time of one round of a solver, s; slower solvers get fewer profiles."""

Solver = Callable[[Any, Scenario], object]


def measure_solvers(
    effort: Effort, *, profiles: int | None = None, repeats: int | None = None
) -> Study:
    """Time every method of `fit_homogeneous_path`, and the iterative peers, on one path with noise.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Most profiles per call.
    repeats : int, optional
        Repeats of each timing, of which the least time counts.
    """
    count = profiles or (8_000 if effort.quick else 40_000)
    repeats = repeats or (3 if effort.quick else 9)
    scores: dict[str, Scores] = {}
    for missing, variance, dtype in product((0.0, _MISSING), (1.0, None), _PRECISIONS):
        gaps = f"{100 * missing:.0f} % of bins missing" if missing else "dense"
        case = f"{dtype}, {gaps}, variance {'given' if variance else 'estimated'}"
        power = PATH.powers(count, dtype=dtype)
        if missing:
            power[np.random.default_rng(1).random(power.shape, np.float32) < missing] = np.nan
        scores[case] = _times(case, power, _solvers(variance, missing), repeats)
        effort.progress(1)
    note = (
        f"Path {PATH.label}, {PATH.bins} bins; one variance for all profiles or none, no "
        "correlation length or exposure. All outputs and flags. One thread, least CPU time of "
        "interleaved repeats; numba is timed once compiled. Reads: multiples of the read, "
        f"{READ}, a vectorised maximum of the same array in the same run: the floor. Profiles: of "
        "a call, fewer for slow methods."
    )
    results = [Results(case, of_case, note) for case, of_case in scores.items()]
    every = {key: score for of_case in scores.values() for key, score in of_case.items()}
    chart = Chart("time", "CPU time per profile", frame(every), CPU_TIME)
    return Study(results, [chart])


def _solvers(variance: float | None, missing: float) -> dict[str, Solver]:
    solvers: dict[str, Solver] = {
        method.value: partial(_solve, method, variance)
        for method in HomogeneousMethod
        # The cubic allows no gaps: it raises an error at once.
        if not (missing and method is HomogeneousMethod.CUBIC)
    }
    return solvers | (iterative_peers() if variance and not missing else {})


def _solve(method: HomogeneousMethod, variance: float | None, power: Any, path: Scenario) -> object:
    options = method_arguments(method, path)
    return fit_homogeneous_path(power, path.range, variance=variance, method=method, **options)


def _times(case: str, power: Any, solvers: Mapping[str, Solver], repeats: int) -> Scores:
    """Return the least CPU time per profile of each method, and as a multiple of the read."""
    profiles = {READ: len(power)}
    calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
    for name, solver in solvers.items():
        few = profiles[name] = _affordable(partial(_first, solver, power), len(power))
        calls[name] = partial(_first, solver, power, few)
    times = least_times(calls, repeats)
    spent = {name: seconds / profiles[name] for name, seconds in times.items()}
    return {
        (case, name): {
            "lidarops": name in list(HomogeneousMethod),
            "profiles": profiles[name],
            CPU_TIME: cpu_time(1e9 * seconds),
            "reads": seconds / spent[READ],
        }
        for name, seconds in spent.items()
    }


def _first(solver: Solver, power: Any, profiles: int) -> object:
    return solver(power[:profiles], PATH)


def _affordable(call: Callable[[int], object], most: int) -> int:
    """Return how many profiles a call may get; the call takes a number of profiles."""
    few = min(_TRIED, most)
    # The fixed cost of a call counts less with more profiles: estimate twice.
    for _ in range(2):
        call(few)
        per_profile = timed(partial(call, few))[0] / few
        few = min(most, max(round(_LONGEST / per_profile), _TRIED))
    return few


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
