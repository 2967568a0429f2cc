"""Report page of the accuracy on homogeneous paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lidarops.bench.accuracy.homogeneous import (
    Accuracy,
    AccuracyCase,
    MonteCarloFigure,
    Offset,
    SolverOutcome,
    outcomes_of,
)
from lidarops.bench.accuracy.homogeneous_cases import QUANTITIES
from lidarops.bench.harness.benchmark import facts
from lidarops.figures.charts import Chart, Panel, Series, pareto
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

_HELPED: Final = frozenset(
    {
        HomogeneousMethod.LINEARIZED,
        HomogeneousMethod.KNOWN_BACKGROUND,
        HomogeneousMethod.KNOWN_EXTINCTION,
    }
)
"""Methods that are given more than the profile."""
_PUBLISHED: Final = {1e3: 10.6, 4e3: 6.5, 6e3: 1.5, 8e3: 1.2}
"""bobrovsky2024, table 1, less an assumed truth of 37.00, over an assumed noise of 0.1."""
_GAIN: Final = 0.98
"""Ratio of RMSE; a smaller gain is Monte Carlo noise."""
_UNSOLVED: Final = "-"


def homogeneous_accuracy_report(result: Accuracy, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return BenchmarkReport(
        title="Homogeneous path: error against the Cramér-Rao bound",
        facts=facts(result.date, result.machine),
        parts=(_overview(result), _by_difficulty(result), _offsets(result.offsets)),
        data=data,
    )


def _methods(result: Accuracy) -> list[str]:
    return [outcome.method for outcome in result.cases[0].outcomes]


# Accuracy ------------------------------------------------------------------------------------


def _overview(result: Accuracy) -> Part:
    count = len(result.cases)
    profiles = result.cases[0].outcomes[0].profiles
    return Part(
        title="Error against time",
        text=f"{count} paths of 225 bins through white noise, from 2.5 or 10.5 km over 1.7 or "
        f"8 km, extinction 0.01 to 5 per km, signal 15 to 100 000 times the noise, background "
        f"370; {profiles:,} profiles each, fewer for scipy. The bound is the inverse Fisher "
        "matrix of background, amplitude and extinction. The amplitude is the signal extrapolated "
        "to range zero; its logarithm is compared. Profiles that a method rejects do not count "
        "for its error. The iterative peers start from the true "
        "background and amplitude and 0.8 of the true extinction.",
        charts=(_work_precision(result), _convergence(result)),
        tables=(_costs(result), *(_summary(result, quantity) for quantity in QUANTITIES)),
        details=tuple(_table(result, method) for method in _methods(result)),
    )


def _work_precision(result: Accuracy) -> Chart:
    return Chart(
        name="work-precision",
        title="Error against CPU time per profile",
        caption="Median over the paths of RMSE over the Cramér-Rao bound, with bars from the "
        "least to the largest; CPU time of one run. Hollow: methods that are given more than the "
        "profile, or reject every profile of some paths; these are not part of the Pareto front.",
        panels=tuple(_work_panel(result, quantity) for quantity in QUANTITIES),
    )


def _work_panel(result: Accuracy, quantity: str) -> Panel:
    series = []
    points = []
    for method in _methods(result):
        pairs = outcomes_of(result, method)
        errors = [o.scores[quantity].rmse.value for _, o in pairs if quantity in o.scores]
        cost = float(np.median([o.nanoseconds for _, o in pairs]))
        complete = method not in _HELPED and len(errors) == len(pairs)
        if complete:
            points.append((cost, float(np.median(errors))))
        series.append(_point(method, cost, errors, hollow=not complete))
    return Panel(
        title=_spelled(quantity),
        x_label="CPU time per profile (ns)",
        y_label="RMSE over bound" if quantity == QUANTITIES[0] else "",
        series=tuple(series),
        level=1.0,
        front=pareto(points, _GAIN),
    )


def _convergence(result: Accuracy) -> Chart:
    return Chart(
        name="convergence",
        title="Distance from converged least squares against CPU time per profile",
        caption="Largest distance from the solution of the direct method, in units of the "
        "Cramér-Rao bound: median over the paths, with bars from the least to the largest. "
        "Hollow as above.",
        panels=tuple(_convergence_panel(result, quantity) for quantity in QUANTITIES),
    )


def _convergence_panel(result: Accuracy, quantity: str) -> Panel:
    series = []
    points = []
    for method in _methods(result):
        pairs = outcomes_of(result, method)
        distances = [o.distances[quantity] for _, o in pairs if o.distances.get(quantity)]
        cost = float(np.median([o.nanoseconds for _, o in pairs]))
        complete = method not in _HELPED and len(distances) == len(pairs)
        if complete:
            points.append((cost, float(np.median(distances))))
        series.append(_point(method, cost, distances, hollow=not complete))
    return Panel(
        title=_spelled(quantity),
        x_label="CPU time per profile (ns)",
        y_label="distance over bound" if quantity == QUANTITIES[0] else "",
        series=tuple(series),
        front=pareto(points),
    )


def _point(method: str, cost: float, errors: Sequence[float], *, hollow: bool) -> Series:
    if not errors:
        return Series(method, (), (), hollow=hollow)
    middle = float(np.median(errors))
    return Series(method, (cost,), (middle,), (min(errors),), (max(errors),), hollow=hollow)


def _costs(result: Accuracy) -> Table:
    rows = []
    for method in _methods(result):
        outcomes = [outcome for _, outcome in outcomes_of(result, method)]
        rows.append(
            (
                method,
                f"{outcomes[0].profiles:,}",
                percent(float(np.mean([outcome.flagged for outcome in outcomes]))),
                percent(float(np.mean([outcome.rejected for outcome in outcomes]))),
                f"{np.median([outcome.nanoseconds for outcome in outcomes]):,.0f}",
            )
        )
    return Table(
        title="All paths",
        columns=("method", "profiles", "flagged", "rejected", "ns each"),
        rows=tuple(rows),
    )


def _summary(result: Accuracy, quantity: str) -> Table:
    rows = []
    for method in _methods(result):
        pairs = outcomes_of(result, method)
        scores = [outcome.scores[quantity] for _, outcome in pairs if quantity in outcome.scores]
        if scores:
            coverage = sorted((score.coverage for score in scores), key=lambda m: m.value)
            rows.append(
                (
                    method,
                    f"{len(scores)} of {len(pairs)}",
                    f"{np.median([score.rmse.value for score in scores]):.3f}",
                    _value(max((score.rmse for score in scores), key=lambda m: m.value)),
                    _value(max((score.bias for score in scores), key=lambda m: abs(m.value))),
                    _value(coverage[0]),
                    _value(coverage[-1]),
                )
            )
    return Table(
        title=f"{_spelled(quantity).capitalize()}, all paths",
        columns=("method", "solved", "RMSE", "worst", "bias", "95 %", "to"),
        rows=tuple(rows),
        note="Paths solved; RMSE over the bound, median and worst path; bias over the bound, "
        "worst path; least and largest coverage of the 95 percent interval. In brackets the "
        "Monte Carlo standard error in the last digits; the worst of many paths exceeds the "
        "typical one by two or three of these errors.",
    )


def _table(result: Accuracy, method: str) -> Table:
    pairs = outcomes_of(result, method)
    columns = [
        f"{_spelled(q)}: {what}" for q in QUANTITIES for what in ("RMSE", "bias", "coverage")
    ]
    return Table(
        title=f"{method}, path by path",
        columns=("path", "difficulty", *columns, "flagged", "rejected", "ns per profile"),
        rows=tuple(_row(case, outcome) for case, outcome in pairs),
        note=f"{pairs[0][1].profiles:,} profiles per path. RMSE and bias over the bound. "
        "Difficulty: least standard error of extinction over extinction + 1 / mean range.",
    )


def _row(case: AccuracyCase, outcome: SolverOutcome) -> tuple[str, ...]:
    cells: list[str] = []
    for quantity in QUANTITIES:
        score = outcome.scores.get(quantity)
        figures = (score.rmse, score.bias, score.coverage) if score else (None,) * 3
        cells += [_value(figure) if figure else _UNSOLVED for figure in figures]
    shares = (percent(outcome.flagged), percent(outcome.rejected))
    time = f"{outcome.nanoseconds:,.0f}"
    return (case.scenario.label, f"{case.difficulty:.2g}", *cells, *shares, time)


def _spelled(quantity: str) -> str:
    return quantity.replace("_", " ")


def _value(figure: MonteCarloFigure) -> str:
    return f"{figure.value:.3f}({1e3 * figure.error:.0f})"


def _by_difficulty(result: Accuracy) -> Part:
    methods = [
        method for method in ("compressed", "fast", "direct", "cubic") if method in _methods(result)
    ]
    return Part(
        title="Error against difficulty",
        text="The same errors, path by path, against the least possible error of extinction.",
        charts=(
            Chart(
                name="difficulty",
                title="Error against difficulty",
                caption="RMSE over the Cramér-Rao bound against the least standard error of "
                "extinction over extinction + 1 / mean range, with Monte Carlo errors.",
                panels=tuple(_difficulty_panel(result, methods, q) for q in QUANTITIES),
            ),
        ),
    )


def _difficulty_panel(result: Accuracy, methods: Sequence[str], quantity: str) -> Panel:
    return Panel(
        title=_spelled(quantity),
        x_label="difficulty",
        y_label="RMSE over bound" if quantity == QUANTITIES[0] else "",
        series=tuple(_difficulties(result, method, quantity) for method in methods),
        level=1.0,
    )


def _difficulties(result: Accuracy, method: str, quantity: str) -> Series:
    points = [
        (case.difficulty, outcome.scores[quantity].rmse)
        for case, outcome in outcomes_of(result, method)
        if quantity in outcome.scores
    ]
    return Series(
        label=method,
        x=tuple(x for x, _ in points),
        y=tuple(y.value for _, y in points),
        low=tuple(y.value - y.error for _, y in points),
        high=tuple(y.value + y.error for _, y in points),
        hollow=method in (HomogeneousMethod.FAST, HomogeneousMethod.DIRECT),
    )


def _offsets(offsets: Sequence[Offset]) -> Part:
    return Part(
        title="Background of the published cubic",
        text="Tables 1 and 2 of bobrovsky2024 give a background that decreases with the length of "
        "the section. This is due to noise: with a lag of one bin and no correction for the "
        "noise, the cubic counts part of the signal as background, however many profiles are "
        "averaged. The tables do not state the signal; 17 times the noise at 2.5 km, 15 m bins "
        "and 0.03 per km are assumed. The remaining error of the compressed method is the bias "
        "of all least-squares solutions to second order in the noise; averaging removes it.",
        charts=(_offset_chart(offsets),),
        tables=(_offset_table(offsets),),
    )


def _offset_chart(offsets: Sequence[Offset]) -> Chart:
    return Chart(
        name="offsets",
        title="Mean error of the background, sections from 2.5 km",
        caption="Bars: 3 standard errors of the mean of all profiles, flagged or not. Published: "
        "table 1 less an assumed truth of 37.00, over an assumed noise of 0.10; its entry at 4 "
        "km is not reproduced.",
        panels=tuple(
            _offset_panel([o for o in offsets if o.averaged == averaged and o.start < 5e3])
            for averaged in sorted({o.averaged for o in offsets})
        ),
    )


def _offset_panel(offsets: Sequence[Offset]) -> Panel:
    averaged = offsets[0].averaged
    lengths = tuple(o.length / 1e3 for o in offsets)
    return Panel(
        title="single profiles" if averaged == 1 else f"means of {averaged} profiles",
        x_label="length of the section (km)",
        y_label="mean error of background (noise of a profile)",
        series=(
            _errors("cubic, lag 1, as published", lengths, [o.lag_1 for o in offsets]),
            _errors("compressed", lengths, [o.compressed for o in offsets]),
            Series(
                "published tables",
                tuple(length / 1e3 for length in _PUBLISHED),
                tuple(_PUBLISHED.values()),
                hollow=True,
            ),
        ),
        x_log=False,
        y_log=False,
        level=0.0,
    )


def _errors(label: str, lengths: tuple[float, ...], errors: Sequence[MonteCarloFigure]) -> Series:
    return Series(
        label,
        lengths,
        tuple(m.value for m in errors),
        tuple(m.value - 3 * m.error for m in errors),
        tuple(m.value + 3 * m.error for m in errors),
        joined=True,
    )


def _offset_table(offsets: Sequence[Offset]) -> Table:
    return Table(
        title="Mean error of the background, in units of the noise of one profile",
        columns=(
            "section",
            "mean of",
            "lag 1",
            "compressed",
            "scatter",
            "expected",
            "flagged",
        ),
        rows=tuple(
            (
                f"{o.start / 1e3:g} + {o.length / 1e3:g} km",
                f"{o.averaged}",
                _value(o.lag_1),
                _value(o.compressed),
                f"{o.scatter:.3f}",
                f"{o.expected:.3f}" if abs(o.expected) < o.scatter else _UNSOLVED,
                percent(o.flagged),
            )
            for o in offsets
        ),
        note="Mean error and, in brackets, its standard error in the last digits: of the cubic "
        "with a lag of one bin, and of the compressed method with its scatter. Expected: "
        "second-order bias of least squares, omitted where it exceeds the scatter and is not "
        "meaningful.",
    )
