"""Report page of the accuracy of networks of lidars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.accuracy.network_cases import FigurePoint, LidarLine
from lidarops.bench.accuracy.network_scores import (
    Comparison,
    NetworkAccuracy,
    NetworkScenario,
    NetworkScore,
    SolverRate,
    VisibilityScore,
)
from lidarops.bench.harness.benchmark import facts
from lidarops.bench.harness.timing import READ
from lidarops.figures.charts import Chart, Panel, Series
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

_NONE: Final = "-"
_DRAWN_AIRS: Final = tuple(air.name for air in network_cases.AIRS if air.name != network_cases.THIN)
_NOT_DRAWN: Final = frozenset({"multiplier 0.95", "multiplier 0"})
"""Solvers that are in the tables only."""
_HIGHEST: Final = 2.0
"""Largest systematic error in figure 2."""


def network_accuracy_report(result: NetworkAccuracy, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return BenchmarkReport(
        title="Networks of lidars: error of extinction and visibility against run time",
        facts=facts(result.date, result.machine),
        parts=(
            *(_errors(result, lidars) for lidars in network_cases.LIDAR_LINES),
            _figure(result.figure),
            _visibility(result.sights),
            _peers(result.comparisons),
            cycles_part(result.cycles),
        ),
        data=data,
    )


# Errors ---------------------------------------------------------------------------------------


def _errors(result: NetworkAccuracy, lidars: LidarLine) -> Part:
    scenarios = [scenario for scenario in result.cases if scenario.place == lidars.name]
    network = lidars.network()
    return Part(
        title=f"{lidars.name.capitalize()}: error against run time",
        text=f"{network.beams} beams, {network.crossings} crossings, of which "
        f"{int(network.near_crossing.sum())} near ones; {scenarios[0].profiles:,} profiles of each "
        f"case, bins of {network_cases.STEP:g} m, "
        "relative noise of each bin as given, plus 1 % of the power at the first crossing of the "
        f"beam; blocks of {network_cases.BLOCK} profiles. Extinction is 2 per km at 600 m with a "
        "scale "
        "height of 1 km (gradient), or 1.5 per km with a plume of 3.5 per km that is fixed or "
        "drifts by 300 m in a block. Multipliers below 1 are those of the paper and neglect a "
        "part of the solution; the unbiased estimate assigns that part to the start crossing. "
        "Errors are relative and clipped at 300 %, because a quotient of noise has no variance. "
        "Where noise hides the attenuation (0.2 per km), most values are flagged. The few "
        "unflagged ones are those that noise has made large, and their errors exceed the stated "
        "ones.",
        charts=(_chart(scenarios, lidars, result.comparisons),),
        tables=(_first_crossing(scenarios, lidars), _network_table(scenarios, lidars)),
        details=tuple(_case_table(scenario) for scenario in scenarios),
    )


def _chart(
    scenarios: Sequence[NetworkScenario], lidars: LidarLine, comparisons: Sequence[Comparison]
) -> Chart:
    solvers = [
        solver.name
        for solver in network_cases.network_solvers(lidars)
        if solver.name not in _NOT_DRAWN
    ]
    return Chart(
        name=f"work-precision-{lidars.name.replace(' ', '')}",
        title=f"Error of extinction against run time, {lidars.name}",
        caption="Root mean square error at the near crossings, of values with and without flags, "
        "with its Monte Carlo error. The joined marks of a method are for noise of "
        f"{', '.join(f'{100 * noise:g}' for noise in network_cases.NOISES)} % of each bin; scipy "
        "has "
        f"{_noise(network_cases.PEER_NOISE)} only.",
        panels=tuple(
            Panel(
                title=air,
                x_label="CPU time per profile (µs)",
                y_label="" if index else "RMS error of extinction (%)",
                series=(
                    *(_solver_series(scenarios, air, name) for name in solvers),
                    _peer_series(
                        [
                            comparison
                            for comparison in comparisons
                            if (comparison.place, comparison.air) == (lidars.name, air)
                        ]
                    ),
                ),
            )
            for index, air in enumerate(_DRAWN_AIRS)
        ),
    )


def _solver_series(scenarios: Sequence[NetworkScenario], air: str, solver: str) -> Series:
    points = [
        (scenario.scores[solver].microseconds, rmse.value, rmse.error)
        for scenario in scenarios
        if scenario.air == air and (rmse := scenario.scores[solver].rmse) is not None
    ]
    return Series(
        solver,
        tuple(x for x, _, _ in points),
        tuple(100.0 * y for _, y, _ in points),
        # An error bar that reaches 0 cannot be drawn on a logarithmic axis.
        tuple(100.0 * max(y - bar, 0.1 * y) for _, y, bar in points),
        tuple(100.0 * (y + bar) for _, y, bar in points),
        joined=True,
    )


def _peer_series(comparisons: Sequence[Comparison]) -> Series:
    return Series(
        "scipy least_squares",
        tuple(comparison.peer_microseconds for comparison in comparisons),
        tuple(100.0 * comparison.peer for comparison in comparisons),
        hollow=True,
    )


def _first_crossing(scenarios: Sequence[NetworkScenario], lidars: LidarLine) -> Table:
    names = [solver.name for solver in network_cases.network_solvers(lidars)]
    return Table(
        title=f"{lidars.name.capitalize()}: visibility at the first crossing, mean / RMS error, %",
        columns=("air", "noise", *names),
        rows=tuple(
            (
                scenario.air,
                _noise(scenario.noise),
                *(_bias_and_rmse(scenario.scores[name]) for name in names),
            )
            for scenario in scenarios
        ),
        note="All values that are not withheld, with and without flags. In brackets: Monte Carlo "
        "standard error of the last digit.",
    )


def _bias_and_rmse(score: NetworkScore) -> str:
    bias, rmse = score.visibility_bias[0], score.visibility_rmse[0]
    return _NONE if bias is None or rmse is None else f"{_percents(bias)} / {_percents(rmse)}"


def _network_table(scenarios: Sequence[NetworkScenario], lidars: LidarLine) -> Table:
    return Table(
        title=f"{lidars.name.capitalize()}: extinction by the network, all near crossings",
        columns=("air", "noise", *_COLUMNS),
        rows=tuple(
            (
                scenario.air,
                _noise(scenario.noise),
                *_cells(scenario.scores[network_cases.NETWORK.name]),
            )
            for scenario in scenarios
        ),
        note=_NOTE,
    )


def _case_table(scenario: NetworkScenario) -> Table:
    return Table(
        title=f"{scenario.place.capitalize()}, {scenario.air}, noise {_noise(scenario.noise)}",
        columns=("method", *_COLUMNS),
        rows=tuple((name, *_cells(score)) for name, score in scenario.scores.items()),
        note=_NOTE,
    )


_COLUMNS: Final = (
    "solved",
    "flagged",
    "mean error %",
    "RMSE %",
    "RMSE % unflagged",
    "within 1",
    "within 1.96",
    "within 3",
    "median crossing %",
    "χ²/dof",
    "µs",
    "reads",
)
_NOTE: Final = (
    "Solved: share of values that are not withheld. Within: share of unflagged values within this "
    "number of stated standard errors; 68.3, 95 and 99.7 % for correct errors. Median crossing: "
    "median over the crossings of the RMS error of visibility. CPU time per profile, and in "
    f"multiples of {READ}. In brackets: Monte Carlo standard error of the last digit, from block "
    "to "
    "block."
)


def _cells(score: NetworkScore) -> tuple[str, ...]:
    crossings = [rmse.value for rmse in score.visibility_rmse if rmse is not None]
    within = [_NONE] * 3
    if score.within is not None:
        within = [percent(inside.value) for inside in score.within]
    return (
        percent(score.solved),
        percent(score.flagged.value),
        _percents(score.bias),
        _percents(score.rmse),
        _percents(score.unflagged_rmse),
        *within,
        f"{100.0 * float(np.median(crossings)):.3g}" if crossings else _NONE,
        _NONE if score.chi_square is None else f"{score.chi_square:.2f}",
        f"{score.microseconds:.0f}",
        f"{score.reads:,.1f}",
    )


# The paper's second figure --------------------------------------------------------------------


def _figure(points: Sequence[FigurePoint]) -> Part:
    return Part(
        title="Figure 2 of the paper, and the correct signs",
        text="Systematic error of visibility with a multiplier of 0.8 in homogeneous air of 2 per "
        "km, lidars 2 and 3 apart by 500 m, beams 1 and 3 at 120 and 90 degrees (drabenko2021). "
        "Without signs: the formula with unsigned lengths of the sides of the triangle, the only "
        "reading whose values fit the axis of the figure; the drawn curves were not compared. "
        "Below the crossing of beams 1 and 3, crossing 1 is the far one on both of its beams, and "
        "all signs change: the error at crossing 1 is above 1 and grows without limit up to a "
        "pole, below which there is no estimate. A cycle that starts at a near crossing and leads "
        "away from the lidars keeps the error below 1. At the crossing, it is 1 for every "
        "multiplier.",
        charts=(
            Chart(
                name="paper-figure-2",
                title="Systematic error of visibility with a multiplier of 0.8",
                caption="By the distance of lidars 1 and 3. Hollow: retrieved from signals without "
                f"noise. Errors above {_HIGHEST:g} are in the table only.",
                panels=(
                    _figure_panel(points, "paper, without signs", "printed"),
                    _figure_panel(points, "crossing 1, with signs", "signed"),
                    _figure_panel(points, "near crossing", "near"),
                ),
            ),
        ),
        tables=tuple(_figure_table(points, first) for first in network_cases.FIGURE_FIRST_LIDARS),
    )


def _figure_panel(points: Sequence[FigurePoint], title: str, name: str) -> Panel:
    series = [
        _figure_series(points, first, name, f"{first:g} m")
        for first in network_cases.FIGURE_FIRST_LIDARS
    ]
    if name == "near":
        series.append(_figure_series(points, None, "simulated", "signals without noise"))
    return Panel(
        title=title,
        x_label="elevation of beam 2 (degree)",
        y_label="" if name != "printed" else "(true - estimate) / true",
        series=tuple(series),
        x_log=False,
        y_log=False,
        level=1.0,
    )


def _figure_series(
    points: Sequence[FigurePoint], first: float | None, name: str, label: str
) -> Series:
    drawn = [
        (point.elevation, value)
        for point in points
        if first in (None, point.first_lidar)
        and (value := getattr(point, name)) is not None
        and value <= _HIGHEST
    ]
    return Series(
        label,
        tuple(x for x, _ in drawn),
        tuple(y for _, y in drawn),
        hollow=name == "simulated",
        joined=name != "simulated",
    )


def _figure_table(points: Sequence[FigurePoint], first: float) -> Table:
    return Table(
        title=f"Figure 2, lidars 1 and 3 apart by {first:g} m",
        columns=(
            "elevation",
            "paper, without signs",
            "crossing 1, with signs",
            "near crossing",
            "solved",
        ),
        rows=tuple(
            (
                f"{point.elevation:g}",
                f"{point.printed:.4f}",
                "pole" if point.signed is None else f"{point.signed:.4g}",
                _or_none(point.near),
                _or_none(point.simulated),
            )
            for point in points
            if point.first_lidar == first
        ),
        note="(true - estimate) / true. Solved: from signals without noise, at the near crossing.",
    )


def _or_none(value: float | None) -> str:
    return _NONE if value is None else f"{value:.4f}"


# Visibility -----------------------------------------------------------------------------------


def _visibility(scores: Sequence[VisibilityScore]) -> Part:
    return Part(
        title="Visibility by three contrasts",
        text=f"Of unflagged extinction by the network of {network_cases.THREE_BY_TWO.name} in a "
        f"{network_cases.VISIBILITY_AIR.name}, all near crossings. A contrast multiplies values "
        "and errors "
        "alike. A wrong contrast is an error itself: visibility for 0.02 is 31 % larger than for "
        "0.05, and 0.14 % larger for exp(-3).",
        tables=(
            Table(
                title="Errors of visibility, m",
                columns=(
                    "noise",
                    "contrast",
                    "-ln(contrast)",
                    "mean truth",
                    "mean error",
                    "RMSE",
                    "RMSE %",
                    "within 1",
                    "in interval",
                ),
                rows=tuple(
                    (
                        _noise(score.noise),
                        f"{score.contrast:.4g}",
                        f"{score.constant:.4f}",
                        f"{score.visibility:.0f}",
                        bracketed(score.bias, sign=True),
                        bracketed(score.rmse),
                        f"{100.0 * score.rmse.value / score.visibility:.1f}",
                        percent(score.within_error.value),
                        percent(score.within_interval.value),
                    )
                    for score in scores
                ),
                note="Within 1: within the linear standard error. Interval: from the lower to the "
                "upper visibility, converted from extinction. 68.3 % for correct errors.",
            ),
        ),
    )


# Peers and time -------------------------------------------------------------------------------


def _peers(comparisons: Sequence[Comparison]) -> Part:
    return Part(
        title="Comparison with a plain fit",
        text=f"Noise {_noise(network_cases.PEER_NOISE)}, without prior: extinctions and "
        "beam constants of a profile by scipy.optimize.least_squares, weighted as if point values "
        "were independent, without errors or flags, and with all points; lidarops leaves out those "
        "that are too noisy.",
        tables=(
            Table(
                title="Network without prior and scipy, the same profiles",
                columns=(
                    "network", "air", "profiles", "lidarops, RMSE %", "scipy, RMSE %",
                    "difference / stated", "lidarops, µs", "scipy, µs", "ratio",
                ),
                rows=tuple(
                    (
                        comparison.place,
                        comparison.air,
                        f"{comparison.profiles:,}",
                        f"{100.0 * comparison.ours:.3g}",
                        f"{100.0 * comparison.peer:.3g}",
                        f"{comparison.apart:.2f}",
                        f"{comparison.ours_microseconds:,.0f}",
                        f"{comparison.peer_microseconds:,.0f}",
                        f"{comparison.peer_microseconds / comparison.ours_microseconds:,.0f}",
                    )
                    for comparison in comparisons
                ),
                note="Of extinction at the near crossings that lidarops solves, clipped at 300 %. "
                "Difference: root mean square, over the stated standard errors of lidarops.",
            ),
        ),
    )  # fmt: skip


def cycles_part(rates: Sequence[SolverRate]) -> Part:
    """Return the section on the CPU time of cycles."""
    return Part(
        title="Cycles per second",
        text="Random cycles, one thread, shortest CPU time of interleaved repeats. Values and "
        "variances at the first crossing; numpy.linalg.solve gives all crossings without "
        "variances. "
        "The read is a vectorised maximum of the same arrays in the same run.",
        tables=tuple(
            Table(
                title=f"Cycles of {beams} beams",
                columns=("method", "by", "cycles", "million / s", "ns each", "reads"),
                rows=tuple(
                    (
                        rate.method,
                        _provider(rate),
                        f"{rate.size:,}",
                        f"{1e3 / rate.nanoseconds:,.3g}",
                        f"{rate.nanoseconds:,.4g}",
                        f"{rate.reads:,.2f}",
                    )
                    for rate in rates
                    if rate.beams == beams
                ),
                note=f"Reads: multiples of {READ} of start, end, integral and variance.",
            )
            for beams in sorted({rate.beams for rate in rates})
        ),
    )


def _provider(rate: SolverRate) -> str:
    return "lidarops" if rate.ours else "floor" if rate.method == READ else "peer"


def _noise(noise: float) -> str:
    return f"{100.0 * noise:g} %"


def _percents(figure: MonteCarloFigure | None) -> str:
    if figure is None:
        return _NONE
    return bracketed(
        MonteCarloFigure(100.0 * figure.value, 100.0 * figure.error), sign=True
    ).lstrip("+")


def bracketed(figure: MonteCarloFigure, *, sign: bool = False) -> str:
    """Return a figure with its error in units of the last digit."""
    plus = "+" if sign else ""
    if not figure.error > 0.0:
        return f"{figure.value:{plus}.3g}"
    digits = max(-math.floor(math.log10(figure.error)), 0)
    return f"{figure.value:{plus}.{digits}f}({figure.error * 10**digits:.0f})"
