"""Targets that the stability benchmark does not meet, each with its reason."""

from __future__ import annotations

import json
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Final

import benchmark_results
import tables
from benchmark_results import Row

from benchmarks.harness.figure import CPU_TIME, Judgement, Verdict, share_text
from benchmarks.harness.rates import SATISFIED, SHARE, TARGET, TARGETS, Unmet
from benchmarks.harness.results import cell

_WORDS: Final = {TARGET: "false", "needless target": "needless"}


def page() -> str:
    """Return a table of the targets that are not met, with the reasons."""
    columns = ("part", "quantity", "class", "share", "value", "target", "why")
    unmet = list(_with_figures())
    rows = [
        (
            *(one.part, one.quantity, one.name, _words(one.target)),
            *("" if figure is None else cell(figure), str(one.judgement), why(one)),
        )
        for one, figure in unmet
    ]
    judged = sum(judgement(row) is not None for row in _rows())
    missed = sum(one.judgement.verdict is Verdict.MISSED for one, _ in unmet)
    counts = (
        f"Of {judged} targets, {judged - len(rows)} are met, {missed} are missed, and for "
        f"{len(rows) - missed} the scenes do not decide."
    )
    return "\n".join([counts, *tables.table(columns, rows)])


def _words(target: str) -> str:
    return _WORDS.get(target, target.removesuffix(" target"))


def every_unmet() -> list[Unmet]:
    """Return the targets of the committed result that are not met."""
    return [one for one, _ in _with_figures()]


def above_target() -> set[tuple[str, str]]:
    """Return class and quantity of the shares of false values that are above their target."""
    return {
        (one.name, one.quantity)
        for one, figure in _with_figures()
        if one.target == TARGET and figure is not None and float(figure.value or 0) > SATISFIED
    }


def _with_figures() -> Iterator[tuple[Unmet, Row | None]]:
    """Yield the targets that are not met, with the rows that they judge."""
    for title, rows in benchmark_results.read("stability")["tables"].items():
        figures = {(row.case, row.method, row.quantity): row for row in rows}
        for row in rows:
            judged = judgement(row)
            if judged and not judged.met:
                one = Unmet(part_of(title), row.case, row.method, row.quantity, judged)
                yield one, judged_row(figures, row)


def judgement(row: Row) -> Judgement | None:
    """Return what a row states of a target; None where it states nothing."""
    stated = row.quantity in TARGETS and row.value is not None
    return Judgement.read(str(row.value)) if stated else None


def judged_row(figures: dict[tuple[str, str, str], Row], row: Row) -> Row | None:
    """Return the row of the figure that a target is for."""
    held, elsewhere = TARGETS[row.quantity]
    judged = judgement(row)
    holds = judged is not None and judged.limits == share_text(SATISFIED)
    for quantity in (held if holds else elsewhere, SHARE, CPU_TIME):
        figure = figures.get((row.case, row.method, quantity))
        if figure is not None:
            return figure
    return None


def part_of(title: str) -> str:
    """Return the part of the benchmark that a table is of."""
    return title.rpartition(": ")[2]


def _rows() -> Iterator[Row]:
    for rows in benchmark_results.read("stability")["tables"].values():
        yield from rows


Reason = dict[str, str]
"""``why``, and patterns of the part, quantity, class, target and verdict that it is for."""


def stated_reasons() -> list[Reason]:
    """Return the reasons for targets that are not met, the most special ones first."""
    file = benchmark_results.RESULTS / "reasons.json"
    return list(json.loads(file.read_text(encoding="utf-8")))


def why(one: Unmet) -> str:
    """Return the reason of a target that is not met; empty if none is stated."""
    texts = {"part": one.part, "quantity": one.quantity, "class": one.name, "target": one.target,
             "verdict": one.judgement.verdict}  # fmt: skip
    fits = (
        reason["why"]
        for reason in stated_reasons()
        if all(fnmatchcase(text, reason.get(key, "*")) for key, text in texts.items())
    )
    return next(fits, "")
