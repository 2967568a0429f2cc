"""Results of all studies as rows of (case, method, quantity, value), with tables and charts."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

from lidarops.bench.harness.timing import READ, StepCost
from lidarops.figures.charts import Chart, ChartPanel, Ladder, Series, pareto
from lidarops.figures.wording import counted, percent
from lidarops.reports.benchmark_page import Part, Table

CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
_NONE: Final = "-"
_ROUNDING: Final = 1e-12
"""Relative error of sums of equal values, which is no Monte Carlo error."""


@dataclass(frozen=True, slots=True)
class MonteCarloFigure:
    """Statistic of random profiles, with its Monte Carlo standard error."""

    value: float
    error: float


class Unit(StrEnum):
    """Unit of a value, which selects how it is written."""

    NUMBER = ""
    SHARE = "%"
    """0 to 1, written in percent."""
    TIME = "µs"
    """Nanoseconds, written in a suitable unit and drawn in microseconds."""


_DRAWN: Final[Mapping[Unit, float]] = {Unit.NUMBER: 1.0, Unit.SHARE: 100.0, Unit.TIME: 1e-3}


@dataclass(frozen=True, slots=True)
class Quantity:
    """A column of a table: its heading, and where a score holds the value."""

    name: str
    path: str
    """Attributes, keys and indices from the score to the value, joined by dots."""
    unit: Unit = Unit.NUMBER
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Row:
    """One value of one method in one case."""

    case: str
    method: str
    quantity: str
    value: float | str | None
    error: float = 0.0
    """Monte Carlo standard error; 0 without one."""
    unit: Unit = Unit.NUMBER


def rows_of(case: str, method: str, score: object, quantities: Iterable[Quantity]) -> list[Row]:
    """Return a row for each quantity of a score; without value where the score holds None."""
    return [
        figure_row(case, method, quantity, _follow(score, quantity.path)) for quantity in quantities
    ]


def figure_row(case: str, method: str, quantity: Quantity, value: Any) -> Row:
    """Return the row of a value, with its Monte Carlo error if it has one."""
    error = 0.0
    if isinstance(value, MonteCarloFigure):
        value, error = quantity.factor * value.value, quantity.factor * value.error
    elif isinstance(value, float):
        value = quantity.factor * value
    return Row(case, method, quantity.name, value, error, quantity.unit)


def _follow(value: Any, path: str) -> Any:
    for step in path.split("."):
        if value is None:
            return None
        if isinstance(value, Mapping):
            value = value.get(step)
        elif isinstance(value, tuple):
            value = value[int(step)]
        else:
            value = getattr(value, step)
    return value


# Text ------------------------------------------------------------------------------------------


def with_error(value: float, error: float) -> str:
    """Return a value with its error in units of the last digit."""
    if not error > _ROUNDING * abs(value):
        return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.3g}"
    digits = max(-math.floor(math.log10(error)), 0)
    return f"{value:.{digits}f}({error * 10**digits:.0f})"


def share_text(share: float) -> str:
    """Return a share that was chosen, not measured, in percent."""
    return f"{100.0 * share:g} %"


def format_time(nanoseconds: float) -> str:
    """Return a time in s, ms, µs or ns."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"


def _cell(row: Row) -> str:
    value = row.value
    if value is None or isinstance(value, str):
        return value or _NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if row.unit is Unit.TIME:
        return format_time(value)
    if row.unit is Unit.SHARE:
        # Rounding must not turn a share below 1 into 100 %.
        rounds = not row.error and 0.999 < value < 1.0
        return percent(value) if rounds else f"{with_error(100.0 * value, 100.0 * row.error)} %"
    return with_error(value, row.error)


# Tables ----------------------------------------------------------------------------------------


def table(
    title: str, rows: Sequence[Row], note: str = "", *, case: str = "case", method: str = "method"
) -> Table:
    """Return a table with a line for each case and method, and a column for each quantity.

    Parameters
    ----------
    title, note : str
    rows : sequence of Row
    case, method : str
        Headings of these columns; a column whose values are all the same is left out.
    """
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        lines.setdefault((row.case, row.method), {})[row.quantity] = _cell(row)
    names = [number for number in (0, 1) if len({line[number] for line in lines}) > 1] or [1]
    quantities = tuple(dict.fromkeys(row.quantity for row in rows))
    return Table(
        title,
        (*((case, method)[number] for number in names), *quantities),
        tuple(
            (
                *(line[number] for number in names),
                *(cells.get(quantity, _NONE) for quantity in quantities),
            )
            for line, cells in lines.items()
        ),
        note,
    )


def table_of_methods(title: str, rows: Sequence[Row], quantity: str, note: str = "") -> Table:
    """Return a table of one quantity with a line for each case and a column for each method."""
    turned = [
        Row("", row.case, row.method, row.value, row.error, row.unit)
        for row in rows
        if row.quantity == quantity
    ]
    return table(title, turned, note, method="case")


# Charts ----------------------------------------------------------------------------------------


def chart(name: str, title: str, caption: str, panels: Sequence[ChartPanel]) -> Chart:
    """Return a chart in which a mark means the same in all panels.

    Parameters
    ----------
    name : str
        Name of the file.
    title, caption : str
    panels : sequence of ChartPanel
        With a common vertical axis, which is labelled once.
    """
    labels = dict.fromkeys(series.label for panel in panels for series in panel.series)
    aligned = []
    for number, panel in enumerate(panels):
        series = {series.label: series for series in panel.series}
        repeated = number and panel.y_label == panels[0].y_label
        aligned.append(
            replace(
                panel,
                y_label="" if repeated or panel.y_label == panel.title else panel.y_label,
                series=tuple(series.get(label, Series(label, (), ())) for label in labels),
            )
        )
    return Chart(name, title, caption, tuple(aligned))


def panel(
    title: str,
    rows: Sequence[Row],
    heights: str | Sequence[str],
    *,
    x: str = CPU_TIME,
    joined: bool = False,
    hollow: Container[str] = (),
    gain: float | None = None,
    logarithmic: tuple[bool, bool] = (True, True),
    level: float | None = None,
) -> ChartPanel:
    """Return a panel with a series for each method, and a point for each of its cases.

    Parameters
    ----------
    title : str
    rows : sequence of Row
    heights : str or sequence of str
        Quantities on the vertical axis; several of them are the series, instead of the methods.
    x : str
        Quantity on the horizontal axis; if there is none of this name, cases are numbers.
    joined : bool
        Whether lines join the points of a series.
    hollow : container of str
        Series with hollow marks, which the front leaves out.
    gain : float, optional
        Draw the Pareto front of points lower than this times the previous one.
    logarithmic : tuple of bool
        Horizontal and vertical axis.
    level : float, optional
        Height of a thin line.
    """
    names = (heights,) if isinstance(heights, str) else tuple(heights)
    places = {(row.case, row.method): row for row in rows if row.quantity == x}
    points: dict[str, list[tuple[float, Row]]] = {}
    for row in rows:
        if row.quantity in names:
            series = points.setdefault(row.method if len(names) == 1 else row.quantity, [])
            place = places.get((row.case, row.method))
            across = _height(place) if place else None if places else float(row.case)
            if across is not None and _height(row) is not None:
                series.append((across, row))
    unit = next((row.unit for row in rows if row.quantity in names), Unit.NUMBER)
    x_unit = next((row.unit for row in places.values()), Unit.NUMBER)
    solid = [point for label, group in points.items() if label not in hollow for point in group]
    return ChartPanel(
        title,
        _axis(x, x_unit),
        _axis(names[0] if len(names) == 1 else "error", unit),
        tuple(
            _series(label, group, joined=joined, hollow=label in hollow)
            for label, group in points.items()
        ),
        *logarithmic,
        level=level,
        front=()
        if gain is None
        else pareto([(across, _height(row) or 0.0) for across, row in solid], gain),
    )


def _axis(name: str, unit: Unit) -> str:
    return f"{name} ({unit})" if unit else name


def _height(row: Row) -> float | None:
    if row.value is None or isinstance(row.value, str):
        return None
    return _DRAWN[row.unit] * row.value


def _series(
    label: str, points: Sequence[tuple[float, Row]], *, joined: bool, hollow: bool
) -> Series:
    heights = [_height(row) or 0.0 for _, row in points]
    bars = [2.0 * _DRAWN[row.unit] * row.error for _, row in points]
    low, high = (
        tuple(height + sign * bar for height, bar in zip(heights, bars, strict=True))
        for sign in (-1.0, 1.0)
    )
    # A bar that reaches 0 cannot be drawn on a logarithmic axis.
    low = tuple(
        max(end, 0.1 * height) if height > 0.0 else end
        for end, height in zip(low, heights, strict=True)
    )
    bars_drawn = any(bars)
    return Series(
        label,
        tuple(across for across, _ in points),
        tuple(heights),
        low if bars_drawn else (),
        high if bars_drawn else (),
        hollow=hollow,
        joined=joined,
    )


def error_against_time(
    name: str,
    rows: Sequence[Row],
    quantity: str,
    *,
    hollow: Container[str] = (),
    gain: float = 0.98,
    level: float | None = None,
) -> Chart:
    """Return the chart of an error against the CPU time, with a panel for each case.

    Parameters
    ----------
    name : str
        Name of the file.
    rows : sequence of Row
    quantity : str
        Error on the vertical axis.
    hollow : container of str
        Methods that are peers, or know more than the profile.
    gain : float
        Ratio of errors above which a gain is Monte Carlo noise.
    level : float, optional
        Least possible error.
    """
    return chart(
        name,
        f"{quantity} against CPU time per profile",
        "Bars of 2 Monte Carlo standard errors. Hollow: peers, and methods that know more than the "
        "profile or solve only a part. The steps join the methods that no other beats in both "
        "error and time.",
        [
            panel(
                case,
                [row for row in rows if row.case == case],
                quantity,
                hollow=hollow,
                gain=gain,
                level=level,
            )
            for case in dict.fromkeys(row.case for row in rows)
        ],
    )


OF_TIMES: Final = (
    Quantity("profiles", "profiles"),
    Quantity(CPU_TIME, "nanoseconds", Unit.TIME),
    Quantity("reads", "reads"),
)
"""Quantities of a cost; reads are multiples of the read of the same array."""


def step_rows(costs: Iterable[StepCost]) -> list[Row]:
    """Return the rows of the costs of steps, with a case for each number of profiles per call."""
    quantities = (Quantity("lidarops", "ours"), *OF_TIMES)
    return [
        row
        for cost in costs
        for row in rows_of(f"{counted(cost.batch, 'profile')} a call", cost.step, cost, quantities)
    ]


def cost_part(name: str, text: str, rows: Sequence[Row]) -> Part:
    """Return the chapter on the CPU time of methods, with a chart of all cases."""
    times = {(row.case, row.method): _height(row) for row in rows if row.quantity == CPU_TIME}
    cases, methods = (tuple(dict.fromkeys(key[number] for key in times)) for number in (0, 1))
    return Part(
        title="CPU time per profile",
        text=f"{text} {READ} is a vectorised maximum of the same array in the same run: the floor.",
        charts=(
            Ladder(
                name,
                "CPU time per profile",
                "A mark for each case.",
                _axis(CPU_TIME, Unit.TIME),
                methods,
                tuple(
                    (case, tuple(times.get((case, method)) for method in methods)) for case in cases
                ),
            ),
        ),
        tables=tuple(
            table(
                case,
                [row for row in rows if row.case == case],
                "Reads: multiples of the read. Profiles: of a call, fewer for slow methods.",
            )
            for case in cases
        ),
    )
