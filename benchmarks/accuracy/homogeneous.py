"""Accuracy of the solvers of a homogeneous path against the least possible error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.comparison import (
    BIAS,
    COVERAGE,
    RMSE,
    comparison,
    score_errors,
    time_profiles,
)
from benchmarks.accuracy.homogeneous_peers import PEERS
from benchmarks.harness.figure import (
    CPU_TIME,
    Figure,
    Score,
    Work,
    cpu_time,
    share,
)
from benchmarks.harness.results import Effort, Study
from benchmarks.scenes.homogeneous_paths import (
    QUANTITIES,
    TAIL_MEAN,
    PathSolver,
    Scenario,
    methods,
    scenarios,
)

PROFILES: Final = 10_000
QUICK_PROFILES: Final = 4_000
_WARM: Final = 64
_ROUNDS: Final = 3
"""Timed calls, of which the least counts: others share the processor."""
_INFORMED: Final = frozenset({"linearized", "known_background", "known_extinction"})
"""Methods that are given more than the profile."""
_NOTE: Final = (
    "Paths of 225 bins through white noise, from 2.5 or 10.5 km over 1.7 or 8 km, extinction 0.01 "
    "to 5 per km, signal 15 to 100 000 times the noise. The bound is the inverse Fisher matrix of "
    "background, amplitude and extinction. Profiles that a method rejects do not count for its "
    "error. The peer starts from the fit of the mean of 64 profiles, and tests no residuals. "
    "Median over the paths of the RMSE over the bound; its largest value, and the "
    "largest mean error, each over all paths; mean shares of flagged and rejected profiles."
)


def measure_homogeneous(effort: Effort, *, profiles: int | None = None) -> Study:
    """Solve simulated profiles by every method of `fit_homogeneous_path` and by the peer.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Per scenario.
    """
    count = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    solvers = {**methods(), **PEERS}
    scores: dict[str, list[Score]] = {name: [] for name in solvers}
    for seed, scenario in enumerate(scenarios(quick=effort.quick)):
        power = scenario.powers(count, seed)
        for name, solver in solvers.items():
            scores[name].append(score_path(solver, scenario, power))
        effort.progress(1)
    return comparison("homogeneous path", list(_works(scores)), _NOTE)


def score_path(solver: PathSolver, scenario: Scenario, power: Any) -> Score:
    """Return errors over the Cramér-Rao bound, flags and time of one solver on one path.

    Parameters
    ----------
    solver : PathSolver
    scenario : Scenario
    power : (profile, bin) float
    """
    solver(power[:_WARM], scenario)
    spent, solution = time_profiles(partial(solver, power, scenario), len(power), _ROUNDS)
    score: Score = {
        "flagged": share(float(solution.flagged.mean())),
        "rejected": share(float(solution.rejected.mean())),
        CPU_TIME: spent,
    }
    least = scenario.least_errors()
    for name in QUANTITIES:
        error = (solution.values[name] - getattr(scenario, name)) / least[name]
        stated = solution.standard_errors[name] / least[name]
        kept = np.isfinite(error) & ~solution.rejected
        # A value that is given has no score.
        if kept.sum() >= 2 and np.any(stated[kept] > 0):
            errors = score_errors(error, stated, kept)
            score |= {f"{name}: {quantity}": figure for quantity, figure in errors.items()}
    return score


def _works(scores: dict[str, list[Score]]) -> Iterator[Work]:
    """Yield the errors of extinction, then of background, on all paths together."""
    for quantity, (method, paths) in product(QUANTITIES, scores.items()):
        errors = _ranked(paths, f"{quantity}: {RMSE}")
        if errors:
            half = len(errors) // 2
            times = [figure.value for figure in _ranked(paths, CPU_TIME)]
            shares = {name: _ranked(paths, name) for name in ("flagged", "rejected")}
            yield Work(
                f"median of {len(paths)} paths",
                f"{quantity}, RMSE over the Cramér-Rao bound",
                method,
                errors[half],
                _ranked(paths, f"{quantity}: {COVERAGE}")[half],
                cpu_time(float(np.median(times))),
                ours=method not in {*PEERS, TAIL_MEAN},
                informed=method in _INFORMED,
                more={
                    "worst": errors[-1],
                    BIAS: max(_ranked(paths, f"{quantity}: {BIAS}"), key=lambda f: abs(f.value)),
                    **{
                        name: share(float(np.mean([figure.value for figure in figures])))
                        for name, figures in shares.items()
                    },
                },
            )


def _ranked(paths: Sequence[Score], quantity: str) -> list[Figure]:
    """Return the figures of a quantity on all paths that have one, the smallest first."""
    figures = [score[quantity] for score in paths if quantity in score]
    return sorted(figures, key=lambda figure: figure.value)
