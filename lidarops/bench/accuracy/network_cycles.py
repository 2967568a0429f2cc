"""CPU time of cycles of beams with every solver, beside numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.network_scores import SolverRate
from lidarops.bench.harness.timing import READ, in_threads, least_times
from lidarops.retrieve.network.cycles import solve_cycle, values_and_variances

_CYCLES: Final = {3: 500_000, 12: 100_000}
_QUICK_CYCLES: Final = {3: 100_000, 12: 20_000}
"""Number of cycles in a call, by the number of beams of a cycle."""


def cycle_rates(*, quick: bool, repeats: int) -> list[SolverRate]:
    """Return CPU times of cycles of 3 and 12 beams with every solver, the read first."""
    rates = []
    for beams, cycles in (_QUICK_CYCLES if quick else _CYCLES).items():
        rows = network_cases.random_rows(cycles, beams)
        sizes = {name: min(cycles, largest) for name, (_, largest) in _CYCLE_SOLVERS.items()}
        calls = {
            name: partial(solver, rows.first(sizes[name]))
            for name, (solver, _) in _CYCLE_SOLVERS.items()
        }
        times = least_times(calls, repeats)
        nanoseconds = {name: 1e9 * seconds / sizes[name] for name, seconds in times.items()}
        rates += [
            SolverRate(
                name,
                beams,
                sizes[name],
                nanoseconds[name],
                nanoseconds[name] / nanoseconds[READ],
                name in OURS,
            )
            for name in calls
        ]
    return rates


def thread_gain(*, quick: bool, repeats: int) -> float:
    """Return the wall time of one thread over that of two with half of the cycles each."""
    cycles = (_QUICK_CYCLES if quick else _CYCLES)[3]
    rows = network_cases.random_rows(cycles, 3)
    halves = rows.first(cycles // 2), rows.last(cycles // 2)
    times = least_times(
        {
            "one": lambda: _with_variance(rows),
            "two": lambda: in_threads(lambda half: _with_variance(halves[half]), 2),
        },
        repeats,
        clock="perf_counter",
    )
    return times["one"] / times["two"]


def _read(rows: network_cases.RandomRows) -> object:
    return [np.max(array) for array in rows.arrays]


def _with_variance(rows: network_cases.RandomRows) -> object:
    return values_and_variances(*rows.arrays)


def _with_one_variance(rows: network_cases.RandomRows) -> object:
    return values_and_variances(rows.start, rows.end, rows.integral, rows.variance[0])


def _with_flags(rows: network_cases.RandomRows) -> object:
    return solve_cycle(rows.start, rows.end, rows.integral, relative_variance=rows.variance)


VALUES: Final = "closed form with variance"
SHARED: Final = "closed form, one variance for all"
FLAGS: Final = "closed form with sensitivities and flags"
LU: Final = "numpy.linalg.solve at once"
ONE_BY_ONE: Final = "numpy.linalg.solve, one by one"
OURS: Final = frozenset({VALUES, SHARED, FLAGS})

_ALL: Final = 10**9
_CYCLE_SOLVERS: Final[Mapping[str, tuple[Callable[[network_cases.RandomRows], object], int]]] = {
    READ: (_read, _ALL),
    VALUES: (_with_variance, _ALL),
    SHARED: (_with_one_variance, _ALL),
    FLAGS: (_with_flags, 100_000),
    LU: (network_cases.solve_by_lu, 50_000),
    ONE_BY_ONE: (network_cases.solve_by_lu_one_by_one, 5_000),
}
"""Solvers of cycles, each with its largest number of cycles."""
