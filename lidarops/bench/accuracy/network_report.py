"""Report page of the accuracy of networks of lidars."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.network_cases import FigurePoint, LidarLine
from lidarops.bench.accuracy.network_scores import (
    Comparison,
    NetworkAccuracy,
    NetworkScenario,
    SolverRate,
    VisibilityScore,
)
from lidarops.bench.harness.benchmark import study_page
from lidarops.bench.harness.rows import (
    CPU_TIME,
    OF_TIMES,
    Quantity,
    Row,
    Unit,
    chart,
    panel,
    rows_of,
    share_text,
    table,
    table_of_methods,
)
from lidarops.bench.harness.timing import READ
from lidarops.figures.charts import Chart
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

_NOT_DRAWN: Final = frozenset({"multiplier 0.95", "multiplier 0"})
"""Solvers that are in the tables only."""
_PEER: Final = "scipy least_squares"
_HIGHEST: Final = 2.0
"""Largest systematic error in figure 2."""
_RMSE: Final = "RMSE of extinction"
_FIRST_BIAS: Final = "mean error at the first crossing"
_FIRST_RMSE: Final = "RMSE at the first crossing"
_OF_SOLVER: Final = (
    Quantity("solved", "solved", Unit.SHARE),
    Quantity("flagged", "flagged", Unit.SHARE),
    Quantity("mean error", "bias", Unit.SHARE),
    Quantity(_RMSE, "rmse", Unit.SHARE),
    Quantity("RMSE unflagged", "unflagged_rmse", Unit.SHARE),
    Quantity("within 1", "within.0", Unit.SHARE),
    Quantity("within 1.96", "within.1", Unit.SHARE),
    Quantity("within 3", "within.2", Unit.SHARE),
    Quantity("χ²/dof", "chi_square"),
    Quantity(CPU_TIME, "microseconds", Unit.TIME, 1e3),
    Quantity("reads", "reads"),
)
_OF_FIRST: Final = (
    Quantity(_FIRST_BIAS, "visibility_bias.0", Unit.SHARE),
    Quantity(_FIRST_RMSE, "visibility_rmse.0", Unit.SHARE),
)
_OF_POINT: Final = (
    Quantity("paper, without signs", "printed"),
    Quantity("crossing 1, with signs", "signed"),
    Quantity("near crossing", "near"),
    Quantity("solved", "simulated"),
)
_OF_SIGHT: Final = (
    Quantity("-ln(contrast)", "constant"),
    Quantity("mean truth (m)", "visibility"),
    Quantity("mean error (m)", "bias"),
    Quantity("RMSE (m)", "rmse"),
    Quantity("within 1", "within_error", Unit.SHARE),
    Quantity("in interval", "within_interval", Unit.SHARE),
)
_OF_COMPARISON: Final = (
    Quantity("profiles", "profiles"),
    Quantity("lidarops, RMSE", "ours", Unit.SHARE),
    Quantity("scipy, RMSE", "peer", Unit.SHARE),
    Quantity("difference / stated", "apart"),
    Quantity("lidarops, CPU time", "ours_microseconds", Unit.TIME, 1e3),
    Quantity("scipy, CPU time", "peer_microseconds", Unit.TIME, 1e3),
)
_OF_PEER: Final = (
    Quantity(_RMSE, "peer", Unit.SHARE),
    Quantity(CPU_TIME, "peer_microseconds", Unit.TIME, 1e3),
)


def network_accuracy_report(result: NetworkAccuracy) -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return study_page(
        "Networks of lidars: error of extinction and visibility against run time",
        result,
        *(_errors(result, lidars) for lidars in network_cases.LIDAR_LINES),
        _figure(result.figure),
        _visibility(result.sights),
        _peers(result.comparisons),
        cycles_part(result.cycles),
    )


def _errors(result: NetworkAccuracy, lidars: LidarLine) -> Part:
    scenarios = [scenario for scenario in result.cases if scenario.place == lidars.name]
    network, name = lidars.network(), lidars.name.capitalize()
    rows = [row for scenario in scenarios for row in _rows(scenario)]
    first = [row for row in rows if row.quantity in {_FIRST_BIAS, _FIRST_RMSE}]
    solvers = [row for row in rows if row not in first]
    return Part(
        title=f"{name}: error against run time",
        text=f"{network.beams} beams, {network.crossings} crossings, of which "
        f"{int(network.near_crossing.sum())} near ones; {scenarios[0].profiles:,} profiles of each "
        f"case, bins of {network_cases.STEP:g} m, "
        "relative noise of each bin as given, plus 1 % of the power at the first crossing of the "
        f"beam; blocks of {network_cases.BLOCK} profiles. Extinction is 2 per km at 600 m with a "
        "scale height of 1 km (gradient), or 1.5 per km with a plume of 3.5 per km that is fixed "
        "or drifts by 300 m in a block. Multipliers below 1 are those of the paper and neglect a "
        "part of the solution; the unbiased estimate assigns that part to the start crossing. "
        "Errors are relative and clipped at 300 %, because a quotient of noise has no variance. "
        "Where noise hides the attenuation (0.2 per km), most values are flagged. The few "
        "unflagged ones are those that noise has made large, and their errors exceed the stated "
        "ones.",
        charts=(_chart(scenarios, lidars, result.comparisons),),
        tables=(
            *(
                table_of_methods(
                    f"{name}: visibility, {quantity}",
                    first,
                    quantity,
                    "All values that are not withheld, with and without flags.",
                )
                for quantity in (_FIRST_BIAS, _FIRST_RMSE)
            ),
            table(
                f"{name}: extinction by the network, all near crossings",
                [row for row in solvers if row.method == network_cases.NETWORK.name],
                _NOTE,
            ),
        ),
        details=(table(f"{name}: all methods", solvers, _NOTE),),
    )


_NOTE: Final = (
    "Solved: share of values that are not withheld. Within: share of unflagged values within this "
    "number of stated standard errors; 68.3, 95 and 99.7 % for correct errors. Median crossing: "
    "median over the crossings of the RMS error of visibility. CPU time per profile, and in "
    f"multiples of {READ}. In brackets: Monte Carlo standard error of the last digit, from block "
    "to block."
)


def _rows(scenario: NetworkScenario) -> Iterator[Row]:
    case = f"{scenario.air}, noise {share_text(scenario.noise)}"
    for method, score in scenario.scores.items():
        yield from rows_of(case, method, score, (*_OF_FIRST, *_OF_SOLVER))
        crossings = [rmse.value for rmse in score.visibility_rmse if rmse is not None]
        median = float(np.median(crossings)) if crossings else None
        yield Row(case, method, "median crossing", median, unit=Unit.SHARE)


def _chart(
    scenarios: Sequence[NetworkScenario], lidars: LidarLine, comparisons: Sequence[Comparison]
) -> Chart:
    airs = [air.name for air in network_cases.AIRS if air.name != network_cases.THIN]
    rows: dict[str, list[Row]] = {air: [] for air in airs}
    for scenario in scenarios:
        if scenario.air in rows:
            rows[scenario.air] += [r for r in _rows(scenario) if r.method not in _NOT_DRAWN]
    for comparison in comparisons:
        if comparison.place == lidars.name:
            rows[comparison.air] += rows_of("", _PEER, comparison, _OF_PEER)
    return chart(
        f"work-precision-{lidars.name.replace(' ', '')}",
        f"Error of extinction against run time, {lidars.name}",
        "Root mean square error at the near crossings, of values with and without flags, with bars "
        "of 2 Monte Carlo standard errors. The joined marks of a method are for noise of "
        f"{', '.join(share_text(noise) for noise in network_cases.NOISES)} of each bin; scipy has "
        f"{share_text(network_cases.PEER_NOISE)} only.",
        tuple(panel(air, group, _RMSE, joined=True, hollow={_PEER}) for air, group in rows.items()),
    )


def _figure(points: Sequence[FigurePoint]) -> Part:
    rows = [
        row
        for point in points
        for row in rows_of(f"{point.elevation:g}", f"{point.first_lidar:g} m", point, _OF_POINT)
    ]
    drawn = [row for row in rows if not isinstance(row.value, float) or row.value <= _HIGHEST]
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
            chart(
                "paper-figure-2",
                "Systematic error of visibility, with a multiplier of 0.8",
                "(true - estimate) / true, by the distance of lidars 1 and 3. Solved: from signals "
                f"without noise, at the near crossing. Errors above {_HIGHEST:g}: table only.",
                tuple(
                    panel(
                        quantity.name,
                        drawn,
                        quantity.name,
                        x="elevation of beam 2 (degree)",
                        joined=True,
                        logarithmic=(False, False),
                        level=1.0,
                    )
                    for quantity in _OF_POINT
                ),
            ),
        ),
        tables=(
            table(
                "Figure 2 by the distance of lidars 1 and 3",
                sorted(rows, key=lambda row: row.method),
                "(true - estimate) / true; none beyond the pole. Solved: from signals without "
                "noise, at the near crossing.",
                case="elevation",
                method="lidars apart",
            ),
        ),
    )


def _visibility(scores: Sequence[VisibilityScore]) -> Part:
    rows = [
        row
        for score in scores
        for row in rows_of(share_text(score.noise), f"{score.contrast:.4g}", score, _OF_SIGHT)
    ]
    return Part(
        title="Visibility by three contrasts",
        text=f"Of unflagged extinction by the network of {network_cases.THREE_BY_TWO.name} in a "
        f"{network_cases.VISIBILITY_AIR.name}, all near crossings. A contrast multiplies values "
        "and errors alike. A wrong contrast is an error itself: visibility for 0.02 is 31 % larger "
        "than for 0.05, and 0.14 % larger for exp(-3).",
        tables=(
            table(
                "Errors of visibility",
                rows,
                "Within 1: within the linear standard error. Interval: from the lower to the "
                "upper visibility, converted from extinction. 68.3 % for correct errors.",
                case="noise",
                method="contrast",
            ),
        ),
    )


def _peers(comparisons: Sequence[Comparison]) -> Part:
    rows = [row for c in comparisons for row in rows_of(c.place, c.air, c, _OF_COMPARISON)]
    return Part(
        title="Comparison with a plain fit",
        text=f"Noise {share_text(network_cases.PEER_NOISE)}, without prior: extinctions and "
        "beam constants of a profile by scipy.optimize.least_squares, weighted as if point values "
        "were independent, without errors or flags, and with all points; lidarops leaves out those "
        "that are too noisy.",
        tables=(
            table(
                "Network without prior and scipy, the same profiles",
                rows,
                "Of extinction at the near crossings that lidarops solves, clipped at 300 %. "
                "Difference: root mean square, over the stated standard errors of lidarops.",
                case="network",
                method="air",
            ),
        ),
    )


def cycles_part(rates: Sequence[SolverRate]) -> Part:
    """Return the section on the CPU time of cycles."""
    return Part(
        title="Cycles per second",
        text="Random cycles, one thread, shortest CPU time of interleaved repeats. Values and "
        "variances at the first crossing; numpy.linalg.solve gives all crossings without "
        f"variances. {READ} is a vectorised maximum of start, end, integral and variance in the "
        "same run.",
        tables=(rates_table("CPU time of a cycle", rates),),
    )


def rates_table(title: str, rates: Sequence[SolverRate]) -> Table:
    """Return the table of the CPU times of solvers."""
    quantities = (
        Quantity("lidarops", "ours"),
        Quantity("in a call", "size"),
        *OF_TIMES[1:],
    )
    rows = [r for rate in rates for r in rows_of(f"{rate.beams}", rate.method, rate, quantities)]
    return table(title, rows, f"Reads: multiples of {READ}.", case="beams")
