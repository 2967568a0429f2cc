"""Results of all studies as rows of (case, method, quantity, value), with tables, charts, page."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.harness.timing import Machine, machine
from lidarops.errors import CatalogError
from lidarops.figures import svg
from lidarops.figures.charts import Chart, ChartPanel, Ladder, Series, draw_chart, pareto
from lidarops.figures.templates import environment
from lidarops.figures.wording import percent
from lidarops.system.files import write_atomically

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

INDEX: Final = "index.html"
RESULT: Final = "result.json"
"""Names of the page and of the file of all numbers in the folder of a benchmark."""
CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
_NONE: Final = "-"
_ROUNDING: Final = 1e-12
"""Relative error of sums of equal values, which is no Monte Carlo error."""


class Unit(StrEnum):
    """Unit of a value, which selects how it is written."""

    NUMBER = ""
    SHARE = "1"
    """0 to 1, written in percent."""
    TIME = "ns"
    """Written in a suitable unit and drawn in microseconds."""


_DRAWN: Final = {Unit.NUMBER: (1.0, ""), Unit.SHARE: (100.0, "%"), Unit.TIME: (1e-3, "µs")}


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its Monte Carlo standard error, which is 0 without one."""

    value: float
    error: float = 0.0
    unit: Unit = Unit.NUMBER

    def times(self, factor: float) -> Figure:
        """Return the figure in another unit of the same kind."""
        return replace(self, value=factor * self.value, error=factor * self.error)


def share(value: Figure | float) -> Figure:
    """Return a figure that is written in percent."""
    return replace(value if isinstance(value, Figure) else Figure(value), unit=Unit.SHARE)


def cpu_time(nanoseconds: float) -> Figure:
    """Return the figure of a time."""
    return Figure(nanoseconds, unit=Unit.TIME)


Score = dict[str, "Figure | float | str | None"]
"""Values of one method in one case, by quantity; None where it has none."""
Scores = dict[tuple[str, str], Score]
"""Scores by case and method."""


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


def rows_of(case: str, method: str, score: Score) -> list[Row]:
    """Return a row for each quantity of a score."""
    return [
        Row(case, method, quantity, value.value, value.error, value.unit)
        if isinstance(value, Figure)
        else Row(case, method, quantity, value)
        for quantity, value in score.items()
    ]


def rows_of_scores(scores: Scores) -> list[Row]:
    """Return the rows of scores by case and method."""
    return [row for names, score in scores.items() for row in rows_of(*names, score)]


def by_method(rows: Iterable[Row], quantity: str) -> list[Row]:
    """Return the rows of one quantity turned, so that each method is a column."""
    return [
        Row("", row.case, row.method, row.value, row.error, row.unit)
        for row in rows
        if row.quantity == quantity
    ]


# Text ------------------------------------------------------------------------------------------


def with_error(value: float, error: float) -> str:
    """Return a value with its error in units of the last digit."""
    if not error > _ROUNDING * abs(value):
        return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.3g}"
    digits = max(-math.floor(math.log10(error)), 0)
    # Zero has no sign.
    shown = round(value, digits) + 0.0
    return f"{shown:.{digits}f}({error * 10**digits:.0f})"


def share_text(share: float) -> str:
    """Return a share that was chosen, not measured, in percent."""
    return f"{100.0 * share:g} %"


def format_time(nanoseconds: float) -> str:
    """Return a time in s, ms, µs or ns."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"


def cell(row: Row) -> str:
    """Return the text of a value in a table."""
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


@dataclass(frozen=True, slots=True)
class Table:
    """A table, printed alike on the page and in a terminal."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    """One cell per column; the first cell names the row."""
    note: str = ""


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
        lines.setdefault((row.case, row.method), {})[row.quantity] = cell(row)
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


# Studies ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Results:
    """Rows under a heading."""

    title: str
    rows: Sequence[Row]
    note: str = ""
    case: str = "case"
    """Heading of the column of cases."""
    method: str = "method"
    folded: bool = False
    """Whether the table is folded on the page and left out in a terminal."""

    @property
    def table(self) -> Table:
        """The rows as a table."""
        return table(self.title, self.rows, self.note, case=self.case, method=self.method)


@dataclass(frozen=True, slots=True)
class Chapter:
    """A part of a study."""

    title: str
    text: str
    results: Sequence[Results]
    charts: Sequence[Chart | Ladder] = ()


@dataclass(frozen=True, slots=True)
class Work:
    """Error and run time of one method in one setting, for the page of all retrievals."""

    setting: str
    quantity: str
    """With its unit."""
    method: str
    error: Figure
    """Root mean square."""
    coverage: Figure | None
    """Share of truths in the stated 95 percent interval; None if the method states none."""
    time: Figure
    """CPU time per profile."""
    ours: bool = True
    """Whether a method of lidarops; else a peer."""
    informed: bool = False
    """Whether the method knows more than the profile."""


@dataclass(frozen=True, slots=True)
class Study:
    """All results of one benchmark."""

    title: str
    date: str
    chapters: Sequence[Chapter]
    works: Sequence[Work] = ()
    missed: Sequence[str] = ()
    """Targets that are missed; the command fails where there is one."""
    unnamed: Sequence[str] = ()
    """Those of them for which no reason is stated."""
    cpu_seconds: float = 0.0
    """CPU time of the whole benchmark, with its child processes."""
    machine: Machine = field(default_factory=machine)

    def figures(self, title: str) -> dict[tuple[str, str, str], Row]:
        """Return the rows under a heading by case, method and quantity."""
        return {
            (row.case, row.method, row.quantity): row
            for chapter in self.chapters
            for results in chapter.results
            if results.title == title
            for row in results.rows
        }

    @property
    def facts(self) -> list[tuple[str, str]]:
        """Date, machine and software, as far as known."""
        about = self.machine
        packages = ", ".join(f"{name} {version}" for name, version in about.packages.items())
        values = (self.date, about.processor, str(about.cores), about.python, packages)
        terms = ("Date", "Processor", "Cores", "Python", "Packages")
        return [fact for fact in zip(terms, values, strict=True) if fact[1]]

    def json(self) -> str:
        """Return all rows, by the headings of their tables, as JSON."""
        shown = [results for chapter in self.chapters for results in chapter.results]
        document = {
            "title": self.title,
            "date": self.date,
            "machine": asdict(self.machine),
            "cpu_seconds": round(self.cpu_seconds, 1),
            "tables": {results.title: [asdict(row) for row in results.rows] for results in shown},
            "headings": {results.title: [results.case, results.method] for results in shown},
            "notes": {results.title: results.note for results in shown},
        }
        return json.dumps(document, indent=1, allow_nan=False)

    def write(self, folder: Path) -> Path:
        """Write the page with its charts, and the JSON; return the path of the page.

        Raises
        ------
        CatalogError
            If the folder cannot be written.
        """
        page = folder / INDEX
        try:
            folder.mkdir(parents=True, exist_ok=True)
            drawn = {
                chart.name: draw_chart(chart)
                for chapter in self.chapters
                for chart in chapter.charts
            }
            for name, figure in drawn.items():
                write_atomically(folder / f"{name}.svg", svg.file(figure))
            template = environment("lidarops.bench.harness").get_template("benchmark.html")
            text = template.render(study=self, drawn=drawn, result=RESULT)
            write_atomically(page, text.encode())
            write_atomically(folder / RESULT, self.json().encode())
        except OSError as error:
            raise CatalogError(
                f"the report cannot be written: {error}",
                file=folder,
                remedy="choose a folder you can write to",
            ) from error
        return page
