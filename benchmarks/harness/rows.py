"""Results of all studies as rows of (case, method, quantity, value)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from benchmarks.harness.figure import Figure, Unit
from benchmarks.harness.verdicts import Judgement

CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
Score = dict[str, "Figure | Judgement | float | str | None"]
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
        else Row(case, method, quantity, str(value) if isinstance(value, Judgement) else value)
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
