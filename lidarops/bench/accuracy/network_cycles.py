"""CPU time of cycles of beams with every solver, beside numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy.network_cases import (
    RandomRows,
    random_rows,
    solve_by_lu,
    solve_by_lu_one_by_one,
)
from lidarops.bench.harness.costs import thread_gain, time_methods
from lidarops.bench.harness.rows import Row
from lidarops.bench.harness.timing import READ
from lidarops.retrieve.network.cycles import solve_cycle, values_and_variances

CYCLES: Final = {3: 500_000, 12: 100_000}
QUICK_CYCLES: Final = {3: 100_000, 12: 20_000}
"""Number of cycles in a call, by the number of beams of a cycle."""


def cycle_costs(cycles: Mapping[int, int], repeats: int) -> list[Row]:
    """Return CPU times of cycles with every solver, the read first."""
    rows: list[Row] = []
    for beams, count in cycles.items():
        drawn = random_rows(count, beams)
        sizes = {name: min(count, largest) for name, (_, largest) in _SOLVERS.items()}
        calls = {
            name: (partial(solver, drawn.first(sizes[name])), sizes[name])
            for name, (solver, _) in _SOLVERS.items()
        }
        rows += time_methods(f"{beams}", calls, repeats, peers=_PEERS)
    return rows


def cycle_thread_gain(count: int, repeats: int) -> float:
    """Return the wall time of one thread over that of two with half of the cycles each."""
    drawn = random_rows(count, 3)
    halves = drawn.first(count // 2), drawn.last(count // 2)
    return thread_gain(
        partial(_with_variance, drawn), lambda half: _with_variance(halves[half]), repeats
    )


def _read(rows: RandomRows) -> object:
    return [np.max(array) for array in rows.arrays]


def _with_variance(rows: RandomRows) -> object:
    return values_and_variances(*rows.arrays)


def _with_one_variance(rows: RandomRows) -> object:
    return values_and_variances(rows.start, rows.end, rows.integral, rows.variance[0])


def _with_flags(rows: RandomRows) -> object:
    return solve_cycle(rows.start, rows.end, rows.integral, relative_variance=rows.variance)


_ALL: Final = 10**9
_SOLVERS: Final[Mapping[str, tuple[Callable[[RandomRows], object], int]]] = {
    READ: (_read, _ALL),
    "closed form with variance": (_with_variance, _ALL),
    "closed form, one variance for all": (_with_one_variance, _ALL),
    "closed form with sensitivities and flags": (_with_flags, 100_000),
    "numpy.linalg.solve at once": (solve_by_lu, 50_000),
    "numpy.linalg.solve, one by one": (solve_by_lu_one_by_one, 5_000),
}
"""Solvers of cycles, each with its largest number of cycles."""
_PEERS: Final = frozenset(name for name in _SOLVERS if name.startswith("numpy"))
