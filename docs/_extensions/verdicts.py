"""Targets that the stability benchmark does not meet, each with its reason."""

from __future__ import annotations

import json
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

import benchmark_results
import tables

from lidarops.bench.harness.rows import Row, cell
from lidarops.bench.harness.verdicts import unmet
from lidarops.bench.stability.random_scenes import TARGETS

PARTS: Final = ("part", "quantity", "class", "target")
"""What a reason is for, as patterns; a part that is left out stands for all."""


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


def reasons() -> list[dict[str, str]]:
    """Return the reasons for targets that are not met, the most special ones first."""
    path = benchmark_results.RESULTS / "reasons.json"
    content: list[dict[str, str]] = json.loads(path.read_text(encoding="utf-8"))
    return content


def why(one: Unmet) -> str:
    """Return the reason of a target that is not met; empty if none is stated."""
    return next((reason["why"] for reason in reasons() if matches(reason, one)), "")


def matches(reason: dict[str, Any], one: Unmet) -> bool:
    """Return whether a reason is for this target."""
    values = dict(zip(PARTS, one, strict=False)) | {"verdict": one.verdict.rpartition(" ")[2]}
    return all(
        fnmatchcase(values[name], pattern) for name, pattern in reason.items() if name != "why"
    )
