"""Accuracy of the solvers of a homogeneous path against the least possible error."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.homogeneous_cases import (
    BACKGROUND,
    QUANTITIES,
    TAIL_MEAN,
    Estimates,
    PathSolver,
    Scenario,
    background_bias,
    difficulty,
    least_errors,
    methods,
    scenarios,
)
from benchmarks.accuracy.peers import SLOW, iterative_peers
from benchmarks.harness.benchmark import Effort
from benchmarks.harness.charts import chart, error_against_time, panel
from benchmarks.harness.figure import Figure, cpu_time, share
from benchmarks.harness.rows import CPU_TIME, Score, Scores, rows_of_scores
from benchmarks.harness.statistics import TWO_SIDED, mean, root, share_inside
from benchmarks.harness.study import Chapter, Results, Study, Work
from lidarops.retrieve.background.cubic_and_tail import cubic
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

PROFILES: Final = 10_000
QUICK_PROFILES: Final = 4_000
_SLOW_SHARE: Final = 20
_WARM: Final = 64
_ROUNDS: Final = 3
"""Timed calls, of which the least counts: others share the processor."""
_INFORMED: Final = frozenset(
    {
        HomogeneousMethod.LINEARIZED,
        HomogeneousMethod.KNOWN_BACKGROUND,
        HomogeneousMethod.KNOWN_EXTINCTION,
    }
)
"""Methods that are given more than the profile."""

_RMSE: Final = "RMSE over bound"
_DISTANCE: Final = "distance over bound"
_DIFFICULTY: Final = "difficulty"


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
    scores: Scores = {}
    for seed, scenario in enumerate(scenarios(quick=effort.quick)):
        scores |= _scores(scenario, solvers, scenario.powers(count, seed))
        effort.progress(1)
    offsets = published_offsets(count)
    return Study(
        "Homogeneous path: error against the Cramér-Rao bound",
        effort.date,
        [_overview(scores), _offsets(offsets)],
        list(_works(scores)),
    )


def _scores(scenario: Scenario, solvers: Mapping[str, PathSolver], power: Any) -> Scores:
    converged = solvers[HomogeneousMethod.DIRECT](power, scenario)
    hardness: Score = {_DIFFICULTY: difficulty(scenario)}
    return {
        (scenario.label, name): hardness | score_path(name, solver, scenario, power, converged)
        for name, solver in solvers.items()
    }


def score_path(
    name: str, solver: PathSolver, scenario: Scenario, power: Any, converged: Estimates
) -> Score:
    """Return errors over the Cramér-Rao bound, flags and time of one solver on one path.

    Parameters
    ----------
    name : str
    solver : PathSolver
    scenario : Scenario
    power : (profile, bin) float
    converged : Estimates
        Solution of the direct method.
    """
    if name in SLOW:
        power = power[: max(len(power) // _SLOW_SHARE, 16)]
    solver(power[:_WARM], scenario)
    seconds = []
    for _ in range(1 if name in SLOW else _ROUNDS):
        begin = time.process_time()
        solution = solver(power, scenario)
        seconds.append(time.process_time() - begin)
    least = least_errors(scenario)
    score: Score = {}
    for quantity in QUANTITIES:
        errors = _errors(solution, quantity, scenario.truth[quantity], least[quantity])
        if errors["RMSE"] is not None:
            errors["distance"] = _distance(solution, converged, quantity) / least[quantity]
        score |= {f"{quantity.replace('_', ' ')}: {key}": value for key, value in errors.items()}
    return score | {
        "profiles": len(power),
        "flagged": share(float(solution.flagged.mean())),
        "rejected": share(float(solution.rejected.mean())),
        CPU_TIME: cpu_time(1e9 * min(seconds) / len(power)),
    }


def _errors(solution: Estimates, quantity: str, truth: float, least: float) -> Score:
    """Return errors over the profiles that are not rejected; None for a value that is given."""
    error = (solution.values[quantity] - truth) / least
    stated = solution.standard_errors[quantity] / least
    kept = np.isfinite(error) & ~solution.rejected
    if kept.sum() < 2 or not np.any(stated[kept] > 0):
        return dict.fromkeys(("RMSE", "bias", "95 %", "distance"))
    error, stated = error[kept], stated[kept]
    return {
        "RMSE": root(mean(error**2)),
        "bias": mean(error),
        "95 %": share_inside(np.abs(error) <= TWO_SIDED * stated),
    }


def _distance(solution: Estimates, converged: Estimates, quantity: str) -> float:
    """Return the largest difference from the direct method where neither rejects."""
    count = len(solution.rejected)
    kept = ~solution.rejected & ~converged.rejected[:count]
    distance = np.abs(solution.values[quantity] - converged.values[quantity][:count])[kept]
    return float(np.nanmax(distance, initial=0.0))


# Chapters -------------------------------------------------------------------------------------


def _columns(scores: Scores, method: str) -> dict[str, list[Figure]]:
    """Return the figures of a method on all paths by quantity, without those that it lacks."""
    columns: dict[str, list[Figure]] = {}
    for (_, name), score in scores.items():
        for quantity, value in score.items() if name == method else ():
            if isinstance(value, Figure | float):
                figure = value if isinstance(value, Figure) else Figure(value)
                columns.setdefault(quantity, []).append(figure)
    return columns


def _ranked(figures: list[Figure]) -> list[Figure]:
    return sorted(figures, key=lambda figure: figure.value)


def _summary(scores: Scores) -> Scores:
    """Return the scores of all paths together, by unknown and method."""
    paths = len(dict.fromkeys(path for path, _ in scores))
    summary: Scores = {}
    for case in (quantity.replace("_", " ") for quantity in QUANTITIES):
        for method in dict.fromkeys(method for _, method in scores):
            columns = _columns(scores, method)
            errors = _ranked(columns.get(f"{case}: RMSE", []))
            solved = "all" if len(errors) == paths else f"{len(errors):,}"
            line: Score = {"solved": solved}
            if errors:
                coverage = _ranked(columns[f"{case}: 95 %"])
                bias = max(columns[f"{case}: bias"], key=lambda figure: abs(figure.value))
                line |= {_RMSE: errors[len(errors) // 2], "worst": errors[-1], "bias": bias}
                line |= {"95 %": coverage[0], "to": coverage[-1]}
            distances = [f.value for f in columns.get(f"{case}: distance", []) if f.value]
            if distances:
                line[_DISTANCE] = float(np.median(distances))
            for name in ("flagged", "rejected"):
                line[name] = share(float(np.mean([f.value for f in columns[name]])))
            line[CPU_TIME] = cpu_time(float(np.median([f.value for f in columns[CPU_TIME]])))
            summary[case, method] = line
    return summary


def _solves_all(scores: Scores, method: str) -> bool:
    """Return whether a method has an error of any unknown on all paths."""
    own = [score for (_, name), score in scores.items() if name == method]
    names = (f"{quantity.replace('_', ' ')}: RMSE" for quantity in QUANTITIES)
    return any(all(score[name] is not None for score in own) for name in names)


def _works(scores: Scores) -> list[Work]:
    peers = {*iterative_peers(), TAIL_MEAN}
    works = []
    for method in dict.fromkeys(method for _, method in scores):
        columns = _columns(scores, method)
        errors = _ranked(columns.get("extinction: RMSE", []))
        if errors:
            paths = len(columns[CPU_TIME])
            works.append(
                Work(
                    f"median of {paths} paths",
                    "extinction, RMSE over the Cramér-Rao bound",
                    method,
                    errors[len(errors) // 2],
                    _ranked(columns["extinction: 95 %"])[len(errors) // 2],
                    cpu_time(float(np.median([f.value for f in columns[CPU_TIME]]))),
                    ours=method not in peers,
                    informed=method in _INFORMED,
                )
            )
    return works


def _overview(scores: Scores) -> Chapter:
    summary, paths = rows_of_scores(_summary(scores)), rows_of_scores(scores)
    methods_of = list(dict.fromkeys(method for _, method in scores))
    hollow = {method for method in methods_of if not _solves_all(scores, method)} | _INFORMED
    drawn = [row for row in paths if row.method in {"direct", "cubic"}]
    profiles = next(row.value for row in paths if row.quantity == "profiles")
    return Chapter(
        "Error against time",
        f"{len({row.case for row in paths})} paths of 225 bins through white noise, from 2.5 or "
        "10.5 km over 1.7 or 8 km, extinction 0.01 to 5 per km, signal 15 to 100 000 times the "
        f"noise, background 370; {profiles:,} profiles each, fewer for scipy. The bound is the "
        "inverse Fisher matrix of background, amplitude and extinction. The amplitude is the "
        "signal extrapolated to range zero; its logarithm is compared. Profiles that a method "
        "rejects do not count for its error. The iterative peers start from the fit of the mean of "
        "64 profiles, and test no residuals. Variable projection stops at steps of 0.05 standard "
        "errors. Distance: largest difference from the "
        "solution of the direct method. Difficulty: least standard error of extinction over "
        "extinction + 1 / mean range.",
        [
            Results(
                "All paths",
                summary,
                "Median over the paths of RMSE and of the distance, over the bound; RMSE and bias "
                "of the worst path; least and largest coverage of the 95 percent interval; mean "
                "shares of flagged and rejected profiles. In brackets the Monte Carlo standard "
                "error in the last digits; the worst of many paths exceeds the typical one by two "
                "or three of these errors.",
                case="error of",
            ),
            *(
                Results(
                    f"{method}, path by path",
                    [row for row in paths if row.method == method],
                    "RMSE, bias and distance over the bound.",
                    case="path",
                    folded=True,
                )
                for method in methods_of
            ),
        ],
        [
            error_against_time("work-precision", summary, _RMSE, hollow=hollow, level=1.0),
            error_against_time("convergence", summary, _DISTANCE, hollow=hollow, gain=1.0),
            chart(
                "difficulty",
                "Error against difficulty",
                "RMSE over the Cramér-Rao bound of each path, with bars of 2 Monte Carlo standard "
                "errors.",
                [
                    panel(
                        quantity.replace("_", " "),
                        drawn,
                        f"{quantity.replace('_', ' ')}: RMSE",
                        x=_DIFFICULTY,
                        level=1.0,
                    )
                    for quantity in QUANTITIES
                ],
            ),
        ],
    )


# Background of the published cubic ------------------------------------------------------------

_PAPER_LENGTHS: Final = ((2500.0, (1e3, 2e3, 4e3, 6e3, 8e3)), (10500.0, (1e3, 2e3, 2.5e3)))
_PAPER_STEP: Final = 15.0
_PAPER_SIGNAL: Final = 17.0
_PAPER_EXTINCTION: Final = 3e-5
_AVERAGED: Final = 100
_PUBLISHED: Final = {1e3: 10.6, 4e3: 6.5, 6e3: 1.5, 8e3: 1.2}
"""bobrovsky2024, table 1, less an assumed truth of 37.00, over an assumed noise of 0.1."""
_LENGTH: Final = "length of the section (km)"


def published_offsets(count: int) -> Scores:
    """Return the errors of background for the signals of the published tables.

    The tables do not state the signal. A signal of 17 times the noise at 2.5 km, bins of 15 m and
    an extinction of 0.03 km-1 reproduce the decrease of the published background with length.
    """
    fade = np.exp(-2 * _PAPER_EXTINCTION * (10500.0 - 2500.0)) * (2500.0 / 10500.0) ** 2
    signals = {2500.0: _PAPER_SIGNAL, 10500.0: float(_PAPER_SIGNAL * fade)}
    sections = [(start, length) for start, lengths in _PAPER_LENGTHS for length in lengths]
    return {
        (_section(start, length), f"{averaged}"): _offset(
            start, length, signals[start], averaged, (count, seed)
        )
        for averaged in (1, _AVERAGED)
        for seed, (start, length) in enumerate(sections)
    }


def _section(start: float, length: float) -> str:
    return f"{start / 1e3:g} + {length / 1e3:g} km"


def _offset(
    start: float, length: float, signal: float, averaged: int, draw: tuple[int, int]
) -> Score:
    # The mean of white noise is white noise: powers in units of its standard deviation.
    scale = float(np.sqrt(averaged))
    path = Scenario(
        start,
        length,
        _PAPER_EXTINCTION,
        signal * scale,
        background=BACKGROUND * scale,
        bins=round(length / _PAPER_STEP) + 1,
    )
    power = path.powers(*draw)
    # A variance of 0 means no noise, so that its bias is not subtracted, as published.
    published = cubic(power, path.range, lag=1, variance=0.0).background
    solution = methods()[HomogeneousMethod.DIRECT](power, path)
    background = solution.values["background"]
    score: Score = {
        _LENGTH: length / 1e3,
        "lag 1": mean((published - path.background) / scale),
        "direct": mean((background - path.background) / scale),
        "scatter": float(np.nanstd(background)) / scale,
        "expected": background_bias(path) / scale,
        "flagged": share(float(solution.flagged.mean())),
    }
    return score | {"published": _PUBLISHED.get(length)} if start < 5e3 else score


def _offsets(scores: Scores) -> Chapter:
    rows = rows_of_scores(scores)
    start, lengths = _PAPER_LENGTHS[0]
    sections = {_section(start, length) for length in lengths}
    near = [row for row in rows if row.case in sections]
    return Chapter(
        "Background of the published cubic",
        "Tables 1 and 2 of bobrovsky2024 give a background that decreases with the length of "
        "the section. This is due to noise: with a lag of one bin and no correction for the "
        "noise, the cubic counts part of the signal as background, however many profiles are "
        "averaged. The tables do not state the signal; 17 times the noise at 2.5 km, 15 m bins "
        "and 0.03 per km are assumed. The remaining error of the direct fit is the bias "
        "of all least-squares solutions to second order in the noise; averaging removes it.",
        [
            Results(
                "Mean error of the background, in units of the noise of one profile",
                rows,
                "Mean error and, in brackets, its standard error: of the cubic with a lag of one "
                "bin, and of the direct fit with its scatter. Expected: second-order bias "
                "of least squares, not meaningful where it exceeds the scatter.",
                case="section",
                method="mean of",
            ),
        ],
        [
            chart(
                "offsets",
                "Mean error of the background, sections from 2.5 km",
                "In units of the noise of a profile, of all profiles, flagged or not. Published: "
                "table 1 less an assumed truth of 37.00, over an assumed noise of 0.10; its entry "
                "at 4 km is not reproduced.",
                [
                    panel(
                        title,
                        [row for row in near if row.method == f"{averaged}"],
                        ("lag 1", "direct", "published"),
                        x=_LENGTH,
                        joined=True,
                        hollow={"published"},
                        logarithmic=(False, False),
                        level=0.0,
                    )
                    for title, averaged in (
                        ("single profiles", 1),
                        ("means of profiles", _AVERAGED),
                    )
                ],
            ),
        ],
    )
