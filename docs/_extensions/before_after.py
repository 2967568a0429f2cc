"""Figures of an independent study beside those of today, from the committed results."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

import benchmark_results
import tables
import verdicts
from benchmark_results import Row

from benchmarks.harness.figure import Figure, Judgement, Target, Unit, format_time, with_error
from benchmarks.harness.rates import TARGETS, Unmet

RATIO: Final = "ratio"
"""Beginning of a place that names two figures, of which the first is divided by the second."""


def page() -> str:
    """Return a table for each group of figures: before, now, target and verdict."""
    before = _read("before")
    return "\n".join([before["origin"], *_groups(before["groups"])])


def _groups(groups: list[dict[str, Any]]) -> Iterator[str]:
    columns = ("figure", "before", "now", "target", "made by", "remark")
    for group in groups:
        yield f"*{group['title']}*"
        rows = [
            (
                row["figure"],
                row["before"],
                _text(measured(row["now"])),
                str(judgement(row) or ""),
                f"`{command(row['now'])}`",
                remark(row),
            )
            for row in group["rows"]
        ]
        yield from tables.table(columns, rows)


def measured(place: list[Any]) -> Figure:
    """Return a figure of a committed result, given the result and where it stands in it."""
    if place[0] == RATIO:
        first, second = (measured(part) for part in place[1:])
        return Figure(first.value / second.value)
    row = _row(place)
    return Figure(float(row.value or 0.0), row.error, row.unit)


def _row(place: list[Any]) -> Row:
    result, title, case, method, quantity = place
    (row,) = (
        row
        for name, rows in benchmark_results.read(result)["tables"].items()
        if name.startswith(title) or name.endswith(f": {title}")
        for row in rows
        if (row.case, row.method, row.quantity) == (case, method, quantity)
    )
    return row


def judgement(row: dict[str, Any]) -> Judgement | None:
    """Return the target of a row and whether the figure meets it, as the benchmark decides."""
    if row["target"] is None:
        return None
    return Target(**row["target"]).judged(measured(row["now"]))


def remark(row: dict[str, Any]) -> str:
    """Return why a figure does not meet its target, and how its draws differ from the study's."""
    return "; ".join(text for text in (why(row), row.get("note", "")) if text)


def why(row: dict[str, Any]) -> str:
    """Return why a figure does not meet its target: as stated beside it, or for the benchmark."""
    judged = judgement(row)
    if judged is None or judged.met:
        return ""
    if "why" in row or row["now"][0] != "stability":
        return str(row.get("why", ""))
    _, title, case, method, quantity = row["now"]
    target = next(name for name, shares in TARGETS.items() if quantity in (*shares, "share"))
    return verdicts.why(Unmet(title, case, method, target, judged))


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


def command(place: list[Any]) -> str:
    """Return the command that makes a figure."""
    result = place[1][0] if place[0] == RATIO else place[0]
    return str(benchmark_results.read(result)["command"]).split(" --out")[0]


def _read(name: str) -> dict[str, Any]:
    path = benchmark_results.RESULTS / f"{name}.json"
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
