"""Targets that the stability benchmark does not meet, each with its reason."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import benchmark_results
import tables

from lidarops.bench.harness.rows import Row, cell
from lidarops.bench.harness.verdicts import unmet
from lidarops.bench.stability import reasons
from lidarops.bench.stability.random_scenes import TARGETS

_WORDS: Final = {"target": "false", "needless target": "needless"}


class Unmet(NamedTuple):
    """A target that is missed, or for which the scenes do not decide."""

    part: str
    quantity: str
    name: str
    """Class."""
    target: str
    share: str
    verdict: str
    """Target and verdict."""


def page() -> str:
    """Return a table of the targets that are not met, with the reasons."""
    columns = ("part", "quantity", "class", "share", "value", "target", "why")
    rows = [
        (one.part, one.quantity, one.name, _words(one.target), one.share, one.verdict, why(one))
        for one in every_unmet()
    ]
    judged = sum(row.quantity in TARGETS and row.value is not None for row in _rows())
    missed = sum(one.verdict.endswith("MISSED") for one in every_unmet())
    counts = (
        f"Of {judged} targets, {judged - len(rows)} are met, {missed} are missed, and for "
        f"{len(rows) - missed} the scenes do not decide."
    )
    return "\n".join([counts, *tables.table(columns, rows)])


def _words(target: str) -> str:
    return _WORDS.get(target, target.removesuffix(" target"))


def every_unmet() -> list[Unmet]:
    """Return the targets of the committed result that are not met."""
    return list(_unmet())


def _unmet() -> Iterator[Unmet]:
    for title, rows in benchmark_results.read("stability")["tables"].items():
        figures = {(row.case, row.method, row.quantity): row for row in rows}
        for row in rows:
            if row.quantity in TARGETS and unmet(row.value):
                shown = judged_row(figures, row)
                yield Unmet(
                    part_of(title), row.case, row.method, row.quantity,
                    "" if shown is None else cell(shown), str(row.value),
                )  # fmt: skip


def judged_row(figures: dict[tuple[str, str, str], Row], row: Row) -> Row | None:
    """Return the row of the share that a target is for."""
    held, elsewhere = TARGETS[row.quantity]
    # Where the model holds, intervals have targets.
    holds = figures.get((row.case, row.method, "95 % target"))
    pooled = row.method == "all where the model holds"
    name = held if pooled or (holds is not None and holds.value) else elsewhere
    for quantity in (name, "share", "CPU time"):
        found = figures.get((row.case, row.method, quantity))
        if found is not None:
            return found
    return None


def part_of(title: str) -> str:
    """Return the part of the benchmark that a table is of."""
    return title.rpartition(": ")[2]


def _rows() -> Iterator[Row]:
    for rows in benchmark_results.read("stability")["tables"].values():
        yield from rows


def stated_reasons() -> list[reasons.Reason]:
    """Return the reasons for targets that are not met, the most special ones first."""
    return reasons.read_reasons(benchmark_results.RESULTS / reasons.FILE.name)


def why(one: Unmet) -> str:
    """Return the reason of a target that is not met; empty if none is stated."""
    verdict = unmet(one.verdict)
    if verdict is None:
        return ""
    missed = reasons.Unmet(one.part, one.quantity, one.name, one.target, verdict)
    return reasons.why(missed, stated_reasons())
