"""Figures of an independent study beside those of today, from the committed results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

import benchmark_results
import tables

from lidarops.bench.harness.rows import Figure, Unit, format_time, share_text, with_error

STUDY: Final = "python tests/studies/intervals.py"
PLAIN: Final = {"order", "kernels"}
"""Groups of the study whose figures are no shares."""


def page() -> str:
    """Return a table for each group of figures: before, now, target and verdict."""
    before = _read("before")
    return "\n".join([before["origin"], *_groups(before["groups"])])


def _groups(groups: list[dict[str, Any]]) -> Iterator[str]:
    columns = ("figure", "before", "now", "target", "made by", "where missed, why")
    for group in groups:
        yield f"*{group['title']}*"
        rows = []
        for row in group["rows"]:
            figure = measured(row["now"])
            cells = (row["figure"], row["before"], _text(figure), verdict(figure, row["target"]))
            rows.append((*cells, _command(row["now"][0]), row.get("why", "")))
        yield from tables.table(columns, rows)


def measured(place: list[str]) -> Figure:
    """Return a figure of a committed result, given the result and where it stands in it."""
    result, *names = place
    if result == "intervals":
        group, name = names
        figure = _read("intervals")[group]["figures"][name]
        unit = Unit.NUMBER if group in PLAIN else Unit.SHARE
        return Figure(figure["value"], figure.get("error", 0.0), unit)
    title, case, method, quantity = names
    (row,) = (
        row
        for name, rows in benchmark_results.read(result)["tables"].items()
        if name.startswith(title) or name.endswith(f": {title}")
        for row in rows
        if (row.case, row.method, row.quantity) == (case, method, quantity)
    )
    return Figure(row.value, row.error, row.unit)


def verdict(figure: Figure, target: dict[str, float] | None) -> str:
    """Return the target, and whether the figure meets it, within 2 Monte Carlo errors or not."""
    if target is None:
        return ""
    least, most = target.get("least", 0.0), target["most"]
    text = share_text(most) if not least else f"{100.0 * least:g} to {share_text(most)}"
    away = max(least - figure.value, figure.value - most)
    if away <= 0.0:
        return f"{text} met"
    return f"{text} {'undecided' if away <= 2.0 * figure.error else 'MISSED'}"


def _text(figure: Figure) -> str:
    if figure.unit is Unit.TIME:
        return format_time(figure.value)
    if figure.unit is Unit.SHARE:
        return f"{percent_text(figure)} %"
    return with_error(figure.value, figure.error)


def percent_text(figure: Figure) -> str:
    """Return a share in percent, with its error in units of the last digit."""
    whole = figure.times(100.0)
    return with_error(whole.value, whole.error)


def _command(result: str) -> str:
    if result == "intervals":
        return f"`{STUDY}`"
    return f"`{benchmark_results.read(result)['command'].split(' --out')[0]}`"


def _read(name: str) -> dict[str, Any]:
    path = benchmark_results.RESULTS / f"{name}.json"
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
