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
from benchmarks.accuracy.homogeneous_peers import SLOW, iterative_peers
from benchmarks.harness.figure import (
    CPU_TIME,
    Figure,
    Score,
    Scores,
    cpu_time,
    mean_by_block,
    share,
)
from benchmarks.harness.results import Effort, Results, Study, Work
from benchmarks.scenes.homogeneous_paths import (
    BACKGROUND,
    QUANTITIES,
    TAIL_MEAN,
    PathSolver,
    Scenario,
    methods,
    scenarios,
)
from lidarops.retrieve.background.cubic_and_tail import cubic
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

PROFILES: Final = 10_000
QUICK_PROFILES: Final = 4_000
_SLOW_SHARE: Final = 20
_WARM: Final = 64
_ROUNDS: Final = 3
"""Timed calls, of which the least counts: others share the processor."""
_INFORMED: Final = frozenset({"linearized", "known_background", "known_extinction"})
"""Methods that are given more than the profile."""
_NOTE: Final = (
    "Paths of 225 bins through white noise, from 2.5 or 10.5 km over 1.7 or 8 km, extinction 0.01 "
    "to 5 per km, signal 15 to 100 000 times the noise. The bound is the inverse Fisher matrix of "
    "background, amplitude and extinction. Profiles that a method rejects do not count for its "
    "error. The iterative peers start from the fit of the mean of 64 profiles, and test no "
    "residuals. Median over the paths of the RMSE over the bound; its largest value, and the "
    "largest mean error, each over all paths; mean shares of flagged and rejected profiles."
)


def measure_homogeneous(effort: Effort, *, profiles: int | None = None) -> Study:
    """Solve simulated profiles by every method of `fit_homogeneous_path` and by iterative peers.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Per scenario; the peers of scipy get a twentieth of them, at least 16.
    """
    count = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    solvers = {**methods(), **iterative_peers()}
    scores: dict[str, list[Score]] = {name: [] for name in solvers}
    for seed, scenario in enumerate(scenarios(quick=effort.quick)):
        power = scenario.powers(count, seed)
        for name, solver in solvers.items():
            few = max(count // _SLOW_SHARE, 16) if name in SLOW else count
            rounds = 1 if name in SLOW else _ROUNDS
            scores[name].append(score_path(solver, scenario, power[:few], rounds))
        effort.progress(1)
    offsets = Results(
        "Mean error of the background, in units of the noise of one profile",
        published_offsets(count),
        "Tables 1 and 2 of bobrovsky2024 give a background that decreases with the length of the "
        "section. This is due to noise: with a lag of one bin and no correction for the noise, the "
        "cubic counts part of the signal as background, however many profiles are averaged. The "
        "remaining error of the direct fit is the bias of all least-squares solutions to second "
        "order in the noise; averaging removes it. Mean error and, in brackets, its standard "
        "error: of the cubic with a lag of one bin, and of the direct fit with its scatter.",
        case="section",
        method="mean of",
    )
    return comparison("homogeneous path", list(_works(scores)), _NOTE, [offsets])


def score_path(solver: PathSolver, scenario: Scenario, power: Any, rounds: int = 1) -> Score:
    """Return errors over the Cramér-Rao bound, flags and time of one solver on one path.

    Parameters
    ----------
    solver : PathSolver
    scenario : Scenario
    power : (profile, bin) float
    rounds : int
        Timed calls.
    """
    solver(power[:_WARM], scenario)
    spent, solution = time_profiles(partial(solver, power, scenario), len(power), rounds)
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
                ours=method not in {*iterative_peers(), TAIL_MEAN},
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


# Background of the published cubic ------------------------------------------------------------

_PAPER_LENGTHS: Final = ((2500.0, (1e3, 2e3, 4e3, 6e3, 8e3)), (10500.0, (1e3, 2e3, 2.5e3)))
_PAPER_STEP: Final = 15.0
_PAPER_SIGNAL: Final = 17.0
_PAPER_EXTINCTION: Final = 3e-5
_AVERAGED: Final = 100
_PUBLISHED: Final = {1e3: 10.6, 4e3: 6.5, 6e3: 1.5, 8e3: 1.2}
"""bobrovsky2024, table 1, less an assumed truth of 37.00, over an assumed noise of 0.1."""


def published_offsets(count: int) -> Scores:
    """Return the errors of background for the signals of the published tables.

    The tables do not state the signal. A signal of 17 times the noise at 2.5 km, bins of 15 m and
    an extinction of 0.03 km-1 reproduce the decrease of the published background with length.
    """
    sections = [(start, length) for start, lengths in _PAPER_LENGTHS for length in lengths]
    scores: Scores = {}
    for averaged, (seed, (start, length)) in product((1, _AVERAGED), enumerate(sections)):
        path = published_path(start, length, averaged)
        score = _offset(path, path.powers(count, seed), averaged**0.5)
        if start < 5e3:
            score["published"] = _PUBLISHED.get(length)
        scores[f"{start / 1e3:g} + {length / 1e3:g} km", f"{averaged}"] = score
    return scores


def published_path(start: float, length: float, averaged: int) -> Scenario:
    """Return a section of the published tables, whose profiles are means of so many."""
    away = start - _PAPER_LENGTHS[0][0]
    fade = np.exp(-2 * _PAPER_EXTINCTION * away) * (_PAPER_LENGTHS[0][0] / start) ** 2
    # The mean of white noise is white noise: powers in units of its standard deviation.
    scale = averaged**0.5
    bins = round(length / _PAPER_STEP) + 1
    signal = float(_PAPER_SIGNAL * fade) * scale
    return Scenario(start, length, _PAPER_EXTINCTION, signal, BACKGROUND * scale, bins)


def _offset(path: Scenario, power: Any, scale: float) -> Score:
    # A variance of 0 means no noise, so that its bias is not subtracted, as published.
    published = cubic(power, path.range, lag=1, variance=0.0).background
    solution = methods()[HomogeneousMethod.DIRECT](power, path)
    background = solution.values["background"]
    errors = {"lag 1": published - path.background, "direct": background - path.background}
    return {
        "length of the section (km)": path.length / 1e3,
        **{
            name: mean_by_block(error / scale, np.isfinite(error), 1)
            for name, error in errors.items()
        },
        "scatter": float(np.nanstd(background)) / scale,
        "flagged": share(float(solution.flagged.mean())),
    }
