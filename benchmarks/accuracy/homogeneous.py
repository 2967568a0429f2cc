"""Accuracy of the solvers of a homogeneous path against the least possible error."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous_cases import (
    BACKGROUND,
    QUANTITIES,
    TAIL_MEAN,
    PathSolver,
    Scenario,
    background_bias,
    least_errors,
    methods,
    scenarios,
)
from benchmarks.accuracy.homogeneous_peers import SLOW, iterative_peers
from benchmarks.harness.figure import Figure, cpu_time, share
from benchmarks.harness.plots import Chart
from benchmarks.harness.results import Chapter, Effort, Results, Study, Work, frame
from benchmarks.harness.statistics import TWO_SIDED, mean, root, share_inside
from benchmarks.harness.timing import CPU_TIME
from benchmarks.harness.verdicts import Score, Scores
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
_RMSE: Final = "RMSE over bound"


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
    summary = _summary(scores)
    peers = {*iterative_peers(), TAIL_MEAN}
    return Study(
        "Homogeneous path: error against the Cramér-Rao bound",
        effort.date,
        [
            Chapter(
                "Error against time",
                "Paths of 225 bins through white noise, from 2.5 or 10.5 km over 1.7 or 8 km, "
                "extinction 0.01 to 5 per km, signal 15 to 100 000 times the noise. The bound is "
                "the inverse Fisher matrix of background, amplitude and extinction. Profiles that "
                "a method rejects do not count for its error. The iterative peers start from the "
                "fit of the mean of 64 profiles, and test no residuals.",
                [
                    Results(
                        "All paths",
                        summary,
                        "Median over the paths of the RMSE over the bound; RMSE and bias of the "
                        "worst path; least and largest coverage of the 95 percent interval; mean "
                        "shares of flagged and rejected profiles. In brackets the Monte Carlo "
                        "standard error in the last digits.",
                        case="error of",
                    )
                ],
                [
                    Chart(
                        "work-precision",
                        "RMSE over bound against CPU time",
                        "Hollow: peers, and methods that know more than the profile.",
                        frame(summary),
                        _RMSE,
                        peers | _INFORMED,
                        level=1.0,
                    )
                ],
            ),
            _offsets_chapter(published_offsets(count)),
        ],
        list(_works(scores, peers)),
    )


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
    seconds = []
    for _ in range(rounds):
        begin = time.process_time()
        solution = solver(power, scenario)
        seconds.append(time.process_time() - begin)
    least = least_errors(scenario)
    score: Score = {
        "profiles": len(power),
        "flagged": share(float(solution.flagged.mean())),
        "rejected": share(float(solution.rejected.mean())),
        CPU_TIME: cpu_time(1e9 * min(seconds) / len(power)),
    }
    for name in QUANTITIES:
        error = (solution.values[name] - scenario.truth[name]) / least[name]
        stated = solution.standard_errors[name] / least[name]
        kept = np.isfinite(error) & ~solution.rejected
        # A value that is given has no score.
        if kept.sum() >= 2 and np.any(stated[kept] > 0):
            error, stated = error[kept], stated[kept]
            score[f"{name}: RMSE"] = root(mean(error**2))
            score[f"{name}: bias"] = mean(error)
            score[f"{name}: 95 %"] = share_inside(np.abs(error) <= TWO_SIDED * stated)
    return score


def _ranked(paths: Sequence[Score], quantity: str) -> list[Figure]:
    """Return the figures of a quantity on all paths that have one, the smallest first."""
    figures = [score[quantity] for score in paths if quantity in score]
    return sorted((f for f in figures if isinstance(f, Figure)), key=lambda figure: figure.value)


def _median(figures: Sequence[Figure]) -> float:
    return float(np.median([figure.value for figure in figures]))


def _summary(scores: dict[str, list[Score]]) -> Scores:
    """Return the scores of all paths together, by unknown and method."""
    summary: Scores = {}
    for quantity in QUANTITIES:
        for method, paths in scores.items():
            errors = _ranked(paths, f"{quantity}: RMSE")
            line: Score = {"solved": "all" if len(errors) == len(paths) else f"{len(errors):,}"}
            if errors:
                coverage = _ranked(paths, f"{quantity}: 95 %")
                bias = max(_ranked(paths, f"{quantity}: bias"), key=lambda each: abs(each.value))
                line |= {_RMSE: errors[len(errors) // 2], "worst": errors[-1], "bias": bias}
                line |= {"95 %": coverage[0], "to": coverage[-1]}
            for name in ("flagged", "rejected"):
                line[name] = share(float(np.mean([each.value for each in _ranked(paths, name)])))
            line[CPU_TIME] = cpu_time(_median(_ranked(paths, CPU_TIME)))
            summary[quantity.replace("_", " "), method] = line
    return summary


def _works(scores: dict[str, list[Score]], peers: set[str]) -> Iterator[Work]:
    for method, paths in scores.items():
        errors = _ranked(paths, "extinction: RMSE")
        if errors:
            yield Work(
                f"median of {len(paths)} paths",
                "extinction, RMSE over the Cramér-Rao bound",
                method,
                errors[len(errors) // 2],
                _ranked(paths, "extinction: 95 %")[len(errors) // 2],
                cpu_time(_median(_ranked(paths, CPU_TIME))),
                ours=method not in peers,
                informed=method in _INFORMED,
            )


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
    fade = np.exp(-2 * _PAPER_EXTINCTION * (10500.0 - 2500.0)) * (2500.0 / 10500.0) ** 2
    signals = {2500.0: _PAPER_SIGNAL, 10500.0: float(_PAPER_SIGNAL * fade)}
    sections = [(start, length) for start, lengths in _PAPER_LENGTHS for length in lengths]
    scores: Scores = {}
    for averaged in (1, _AVERAGED):
        # The mean of white noise is white noise: powers in units of its standard deviation.
        scale = float(np.sqrt(averaged))
        for seed, (start, length) in enumerate(sections):
            path = Scenario(
                start,
                length,
                _PAPER_EXTINCTION,
                signals[start] * scale,
                background=BACKGROUND * scale,
                bins=round(length / _PAPER_STEP) + 1,
            )
            score = _offset(path, path.powers(count, seed), scale)
            if start < 5e3:
                score["published"] = _PUBLISHED.get(length)
            scores[f"{start / 1e3:g} + {length / 1e3:g} km", f"{averaged}"] = score
    return scores


def _offset(path: Scenario, power: Any, scale: float) -> Score:
    # A variance of 0 means no noise, so that its bias is not subtracted, as published.
    published = cubic(power, path.range, lag=1, variance=0.0).background
    solution = methods()[HomogeneousMethod.DIRECT](power, path)
    background = solution.values["background"]
    return {
        "length of the section (km)": path.length / 1e3,
        "lag 1": mean((published - path.background) / scale),
        "direct": mean((background - path.background) / scale),
        "scatter": float(np.nanstd(background)) / scale,
        "expected": background_bias(path) / scale,
        "flagged": share(float(solution.flagged.mean())),
    }


def _offsets_chapter(scores: Scores) -> Chapter:
    return Chapter(
        "Background of the published cubic",
        "Tables 1 and 2 of bobrovsky2024 give a background that decreases with the length of "
        "the section. This is due to noise: with a lag of one bin and no correction for the "
        "noise, the cubic counts part of the signal as background, however many profiles are "
        "averaged. The remaining error of the direct fit is the bias of all least-squares "
        "solutions to second order in the noise; averaging removes it.",
        [
            Results(
                "Mean error of the background, in units of the noise of one profile",
                scores,
                "Mean error and, in brackets, its standard error: of the cubic with a lag of one "
                "bin, and of the direct fit with its scatter. Expected: second-order bias "
                "of least squares, not meaningful where it exceeds the scatter.",
                case="section",
                method="mean of",
            ),
        ],
    )
