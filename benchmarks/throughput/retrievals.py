"""CPU time per profile of a homogeneous path, beside peers and a read of the same array."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous_cases import PathSolver, Scenario, method_arguments
from benchmarks.accuracy.homogeneous_peers import iterative_peers
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Effort, Results, Study, frame
from benchmarks.harness.timing import CPU_TIME, READ, affordable, time_methods
from benchmarks.harness.verdicts import Scores
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, fit_homogeneous_path

PATH: Final = Scenario(start=2500.0, length=8000.0, extinction=3e-5, signal=1000.0)
_PRECISIONS: Final = ("float32", "float64")
_MISSING: Final = 0.3
"""Share of the bins that are NaN, at random."""


def measure_solvers(effort: Effort, *, profiles: int | None = None) -> Study:
    """Time every method of `fit_homogeneous_path`, and the iterative peers, on one path with noise.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Most profiles per call.
    """
    count = profiles or (8_000 if effort.quick else 40_000)
    repeats = effort.repeats or (3 if effort.quick else 9)
    scores: Scores = {}
    for missing, variance, dtype in product((0.0, _MISSING), (1.0, None), _PRECISIONS):
        scores |= _solver_costs(dtype, variance, missing, (count, repeats))
        effort.progress(1)
    note = (
        f"Path {PATH.label}, {PATH.bins} bins; one variance for all profiles or none, no "
        "correlation length or exposure. All outputs and flags. One thread, least CPU time of "
        "interleaved repeats; numba is timed once compiled. Reads: multiples of the read, "
        f"{READ}, a vectorised maximum of the same array in the same run: the floor. Profiles: of "
        "a call, fewer for slow methods."
    )
    results = [
        Results(case, {key: score for key, score in scores.items() if key[0] == case}, note)
        for case in dict.fromkeys(case for case, _ in scores)
    ]
    chart = Chart("time", "CPU time per profile", "A mark for each case.", frame(scores), CPU_TIME)
    return Study("Homogeneous path: time per profile", effort.date, results, [chart])


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
