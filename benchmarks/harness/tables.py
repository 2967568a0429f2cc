"""Rows as tables, which are printed alike on the page and in a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from benchmarks.harness.figure import Unit, format_time, with_error
from benchmarks.harness.rows import Row
from lidarops.figures.wording import percent

_NONE: Final = "-"


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
