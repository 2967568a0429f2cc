"""What the benchmark of networks of lidars found, as tables and charts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases as known
from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.accuracy.homogeneous_report import facts
from lidarops.bench.accuracy.network_cases import FigurePoint, Place
from lidarops.bench.accuracy.network_scores import (
    READ,
    Comparison,
    MultiPosition,
    MultiPositionThroughput,
    NetworkScenario,
    NetworkScore,
    Sight,
    SolverRate,
)
from lidarops.figures.charts import Chart, Panel, Series
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

_NONE: Final = "-"
_DRAWN_AIRS: Final = tuple(air.name for air in known.AIRS if air.name != known.THIN)
_LEFT_OUT: Final = frozenset({"multiplier 0.95", "multiplier 0"})
"""Ways that the figures leave to the tables."""
_HIGHEST: Final = 2.0
"""Systematic error up to which figure 2 is drawn."""


def network_accuracy_report(found: MultiPosition, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return BenchmarkReport(
        title="Networks of lidars: error of extinction and visibility against run time",
        facts=facts(found.date, found.machine),
        parts=(
            *(_errors(found, place) for place in known.PLACES),
            _figure(found.figure),
            _visibility(found.sights),
            _peers(found.comparisons),
            _cycles(found.cycles),
        ),
        data=data,
    )


def network_throughput_report(found: MultiPositionThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the throughput benchmark."""
    return BenchmarkReport(
        title="Networks of lidars: time per cycle and per profile",
        facts=facts(found.date, found.machine),
        parts=(_cycles(found.cycles), _profiles(found)),
        data=data,
    )


# Errors ---------------------------------------------------------------------------------------


def _errors(found: MultiPosition, place: Place) -> Part:
    cases = [case for case in found.cases if case.place == place.name]
    net = place.network()
    return Part(
        title=f"{place.name.capitalize()}: error against run time",
        text=f"{net.beams} beams, {net.crossings} crossings, of which {int(net.near_crossing.sum())} "
        f"near ones; {cases[0].profiles:,} profiles of each case, bins of {known.STEP:g} m, "
        "relative noise of each bin as given, and 1 % of the power at the beam's first crossing "
        f"besides; blocks of {known.BLOCK} profiles. Extinction is 2 per km at 600 m with a scale "
        "height of 1 km (gradient), or 1.5 per km with a plume of 3.5 per km, which stands still "
        "or drifts by 300 m in a block. Multipliers below 1 are those of the paper, which "
        "neglect a part of the solution; unbiased puts that part to the start crossing. Errors "
        "are relative and clipped at 300 %, as a quotient of noise has no variance. Where noise "
        "hides the attenuation (0.2 per km), most values are flagged, and the few that are not "
        "are those that noise has made large: their error is not as stated.",
        charts=(_chart(cases, place, found.comparisons),),
        tables=(_first_crossing(cases, place), _network_table(cases, place)),
        details=tuple(_case_table(case) for case in cases),
    )


def _chart(
    cases: Sequence[NetworkScenario], place: Place, comparisons: Sequence[Comparison]
) -> Chart:
    drawn = [way.name for way in known.network_solvers(place) if way.name not in _LEFT_OUT]
    return Chart(
        name=f"work-precision-{place.name.replace(' ', '')}",
        title=f"Error of extinction against run time, {place.name}",
        caption="Root mean square error at the near crossings, of values with and without flags, "
        "with its Monte Carlo error. The marks of a way, joined, are noise of "
        f"{', '.join(f'{100 * noise:g}' for noise in known.NOISES)} % of each bin; scipy has "
        f"{_noise(known.PEER_NOISE)} only.",
        panels=tuple(
            Panel(
                title=air,
                x_label="CPU time per profile (µs)",
                y_label="" if number else "RMS error of extinction (%)",
                series=(
                    *(_way_series(cases, air, name) for name in drawn),
                    _peer_series([c for c in comparisons if (c.place, c.air) == (place.name, air)]),
                ),
            )
            for number, air in enumerate(_DRAWN_AIRS)
        ),
    )


def _way_series(cases: Sequence[NetworkScenario], air: str, way: str) -> Series:
    points = [
        (case.scores[way].microseconds, rmse.value, rmse.error)
        for case in cases
        if case.air == air and (rmse := case.scores[way].rmse) is not None
    ]
    return Series(
        way,
        tuple(x for x, _, _ in points),
        tuple(100.0 * y for _, y, _ in points),
        # A bar that reaches 0 has no place on a logarithmic axis.
        tuple(100.0 * max(y - bar, 0.1 * y) for _, y, bar in points),
        tuple(100.0 * (y + bar) for _, y, bar in points),
        joined=True,
    )


def _peer_series(comparisons: Sequence[Comparison]) -> Series:
    return Series(
        "scipy least_squares",
        tuple(one.peer_microseconds for one in comparisons),
        tuple(100.0 * one.peer for one in comparisons),
        hollow=True,
    )


def _first_crossing(cases: Sequence[NetworkScenario], place: Place) -> Table:
    names = [way.name for way in known.network_solvers(place)]
    return Table(
        title=f"{place.name.capitalize()}: visibility at the first crossing, mean / RMS error in %",
        columns=("air", "noise", *names),
        rows=tuple(
            (
                case.air,
                _noise(case.noise),
                *(_bias_and_rmse(case.scores[name]) for name in names),
            )
            for case in cases
        ),
        note="All values that are not withheld, flagged or not. In brackets: Monte Carlo standard "
        "error of the last digit.",
    )


def _bias_and_rmse(score: NetworkScore) -> str:
    bias, rmse = score.visibility_bias[0], score.visibility_rmse[0]
    return _NONE if bias is None or rmse is None else f"{_percents(bias)} / {_percents(rmse)}"


def _network_table(cases: Sequence[NetworkScenario], place: Place) -> Table:
    return Table(
        title=f"{place.name.capitalize()}: extinction by the network, all near crossings",
        columns=("air", "noise", *_COLUMNS),
        rows=tuple(
            (case.air, _noise(case.noise), *_cells(case.scores[known.NETWORK.name]))
            for case in cases
        ),
        note=_NOTE,
    )


def _case_table(case: NetworkScenario) -> Table:
    return Table(
        title=f"{case.place.capitalize()}, {case.air}, noise {_noise(case.noise)}",
        columns=("way", *_COLUMNS),
        rows=tuple((name, *_cells(score)) for name, score in case.scores.items()),
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
    "Solved: share of values that are not withheld. Within: share of unflagged values within so "
    "many stated standard errors; 68.3, 95 and 99.7 % where errors are as stated. Median crossing: "
    "of the RMS errors of visibility at each. CPU time per profile, and as multiples of "
    f"{READ}. In brackets: Monte Carlo standard error of the last digit, from block to block."
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
        title="Figure 2 of the paper, and the right signs",
        text="Systematic error of visibility with a multiplier of 0.8 in homogeneous air of 2 per "
        "km, lidars 2 and 3 apart by 500 m, beams 1 and 3 at 120 and 90 degrees (drabenko2021). "
        "Without signs: its formula with the plain lengths of the triangle's sides, the only "
        "reading whose values fit the axis of the figure; the drawn curves themselves were not "
        "compared. Below the "
        "crossing of beams 1 and 3, crossing 1 is the far one on both of its beams, and all signs "
        "turn: the error at crossing 1 is above 1 and grows beyond bounds, up to a pole, below "
        "which the estimate is refused. A cycle that starts at a near crossing, and leads away "
        "from the lidars, keeps it below 1. At the crossing, it is 1 whatever the multiplier.",
        charts=(
            Chart(
                name="paper-figure-2",
                title="Systematic error of visibility with a multiplier of 0.8",
                caption="By the distance of lidars 1 and 3. Hollow: signals without noise, "
                f"solved. Errors above {_HIGHEST:g} are in the table only.",
                panels=(
                    _figure_panel(points, "paper, without signs", "printed"),
                    _figure_panel(points, "crossing 1, with signs", "signed"),
                    _figure_panel(points, "near crossing", "near"),
                ),
            ),
        ),
        tables=tuple(_figure_table(points, first) for first in known.FIGURE_FIRST_LIDARS),
    )


def _figure_panel(points: Sequence[FigurePoint], title: str, name: str) -> Panel:
    series = [
        _figure_series(points, first, name, f"{first:g} m") for first in known.FIGURE_FIRST_LIDARS
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
        note="(true - estimate) / true. Solved: signals without noise, from the near crossing.",
    )


def _or_none(value: float | None) -> str:
    return _NONE if value is None else f"{value:.4f}"


# Visibility -----------------------------------------------------------------------------------


def _visibility(sights: Sequence[Sight]) -> Part:
    return Part(
        title="Visibility by three contrasts",
        text=f"Of unflagged extinction by the network of {known.THREE_BY_TWO.name} in a "
        f"{known.SIGHTS_AIR.name}, all near crossings. A contrast multiplies values and errors "
        "alike; taken for another one, it is an error itself: 0.02 sees 31 % farther than 0.05, "
        "and exp(-3) 0.14 %.",
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
                        _noise(one.noise),
                        f"{one.contrast:.4g}",
                        f"{one.constant:.4f}",
                        f"{one.visibility:.0f}",
                        bracketed(one.bias, sign=True),
                        bracketed(one.rmse),
                        f"{100.0 * one.rmse.value / one.visibility:.1f}",
                        percent(one.within_error.value),
                        percent(one.within_interval.value),
                    )
                    for one in sights
                ),
                note="Within 1: linear standard error. Interval: from the lower to the upper "
                "visibility, turned over from extinction. 68.3 % where errors are as stated.",
            ),
        ),
    )


# Peers and time -------------------------------------------------------------------------------


def _peers(comparisons: Sequence[Comparison]) -> Part:
    return Part(
        title="Beside a plain fit",
        text=f"Noise {_noise(known.PEER_NOISE)}, without prior: a profile's extinctions and "
        "beam constants by scipy.optimize.least_squares, weighted as if point values were "
        "independent, without errors or flags, and with every point, where ours leaves out "
        "those in too much noise.",
        tables=(
            Table(
                title="Network without prior and scipy, the same profiles",
                columns=(
                    "network", "air", "profiles", "ours, RMSE %", "scipy, RMSE %", "apart / stated",
                    "ours, µs", "scipy, µs", "ratio",
                ),
                rows=tuple(
                    (
                        one.place,
                        one.air,
                        f"{one.profiles:,}",
                        f"{100.0 * one.ours:.3g}",
                        f"{100.0 * one.peer:.3g}",
                        f"{one.apart:.2f}",
                        f"{one.ours_microseconds:,.0f}",
                        f"{one.peer_microseconds:,.0f}",
                        f"{one.peer_microseconds / one.ours_microseconds:,.0f}",
                    )
                    for one in comparisons
                ),
                note="Of extinction at the near crossings that ours solves, clipped at 300 %. "
                "Apart: root mean square difference over our stated standard errors.",
            ),
        ),
    )  # fmt: skip


def _cycles(rates: Sequence[SolverRate]) -> Part:
    return Part(
        title="Cycles per second",
        text="Random cycles, one thread, least CPU time of interleaved repeats. Values and "
        "variances at the first crossing; numpy.linalg.solve gives all crossings without variances. "
        "The read is a vectorised maximum of the same arrays in the same run.",
        tables=tuple(
            Table(
                title=f"Cycles of {beams} beams",
                columns=("way", "whose", "cycles", "million / s", "ns each", "reads"),
                rows=tuple(
                    (
                        rate.way,
                        _whose(rate),
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


def _profiles(found: MultiPositionThroughput) -> Part:
    return Part(
        title="Whole profiles",
        text="From signals to extinction with errors, visibility and flags: point values, "
        "integrals and their covariances, and the solution. One thread. Two threads with half "
        f"of the cycles of 3 beams each are {found.gain:.2f} times as fast on the wall, which says "
        "something only of a machine with two idle cores.",
        tables=tuple(
            Table(
                title=f"Profiles of {beams} beams",
                columns=("way", "profiles", "µs each", "reads"),
                rows=tuple(
                    (
                        rate.way,
                        f"{rate.size:,}",
                        f"{rate.nanoseconds / 1e3:,.3g}",
                        f"{rate.reads:,.1f}",
                    )
                    for rate in found.profiles
                    if rate.beams == beams
                ),
                note=f"Reads: multiples of {READ} of the power.",
            )
            for beams in sorted({rate.beams for rate in found.profiles})
        ),
    )


def _whose(rate: SolverRate) -> str:
    return "ours" if rate.ours else "floor" if rate.way == READ else "peer"


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
