"""Rows as charts: a series of points for each method."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Final

from benchmarks.harness.drawing import Chart, ChartPanel, Series, pareto
from benchmarks.harness.figure import Unit
from benchmarks.harness.rows import CPU_TIME, Row

_DRAWN: Final = {Unit.NUMBER: (1.0, ""), Unit.SHARE: (100.0, "%"), Unit.TIME: (1e-3, "µs")}


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
    return f"{name} ({_DRAWN[unit][1]})" if unit else name


def _height(row: Row) -> float | None:
    if row.value is None or isinstance(row.value, str):
        return None
    return _DRAWN[row.unit][0] * row.value


def _series(
    label: str, points: Sequence[tuple[float, Row]], *, joined: bool, hollow: bool
) -> Series:
    heights = [_height(row) or 0.0 for _, row in points]
    bars = [2.0 * _DRAWN[row.unit][0] * row.error for _, row in points]
    ends = [
        # A bar that reaches 0 cannot be drawn on a logarithmic axis.
        (max(y - bar, 0.1 * y) if y > 0.0 else y - bar, y + bar)
        for y, bar in zip(heights, bars, strict=True)
    ]
    low, high = zip(*ends, strict=True) if any(bars) else ((), ())
    across = tuple(x for x, _ in points)
    return Series(label, across, tuple(heights), low, high, hollow=hollow, joined=joined)


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
