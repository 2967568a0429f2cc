"""The results of benchmarks as they are committed: tables of numbers and figures.

``python docs/_extensions/benchmark_results.py NAME BENCH`` takes what ``python -m benchmarks ...
--out BENCH`` wrote into ``docs/results/NAME.json``, and the figures that the page shows.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd
import tables

from benchmarks.harness.figure import Unit
from benchmarks.harness.results import COLUMNS, table

RESULTS: Final = Path(__file__).resolve().parents[1] / "results"
DIGITS: Final = 6
ERROR_DIGITS: Final = 4


class Row(NamedTuple):
    """One value of one method in one case."""

    case: str
    method: str
    quantity: str
    value: float | str | None
    error: float = 0.0
    """Monte Carlo standard error; 0 without one."""
    unit: Unit = Unit.NUMBER


class Selection(NamedTuple):
    """What is taken of a result."""

    command: str
    titles: tuple[str, ...]
    """Beginnings of the titles of tables; a table of all if empty."""
    quantities: tuple[str, ...] = ()
    """All if empty."""
    figures: tuple[str, ...] = ()


SELECTIONS: Final = {
    "accuracy": Selection(
        "python -m benchmarks accuracy --quick --out bench",
        ("Ours beside", "Homogeneous path:", "Elastic inversion:", "Scans over zenith",
         "Networks of lidars:"),
        figures=("all-homogeneous-path", "all-elastic-inversion", "all-scans-over-zenith-angle",
                 "all-networks-of-lidars"),
    ),
    "memory": Selection(
        "python -m benchmarks throughput --case memory --out bench", ("Peak memory",)
    ),
    "published": Selection(
        "python -m benchmarks accuracy --case elastic --quick --data boeckmann --out bench",
        ("Background of published files", "Backscatter of published files"),
    ),
    "stability": Selection(
        "python -m benchmarks stability --out bench",
        ("",),
        ("clusters", "values", "not rejected", "within 1.96", "95 % target", "within 1",
         "68 % target", "stated / median error", "false, random error", "and not uncertain",
         "target", "of these undetectable", "and below 3.5", "without any flag",
         "needlessly flagged", "needless target", "share", "CPU time"),
    ),
    "throughput": Selection(
        "python -m benchmarks throughput --quick --out bench", ("float32, dense", "float32, 30 %")
    ),
}  # fmt: skip


def take(name: str, folder: Path) -> None:
    """Write the results of a benchmark, and copy its figures."""
    selection = SELECTIONS[name]
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    kept = {
        title: _by_case_and_method(row for row in rows if _is_kept(row, selection))
        for title, rows in result["tables"].items()
        if title.startswith(selection.titles)
    }
    head = {
        "command": selection.command,
        "date": result["date"],
        "machine": result["machine"],
        "cpu_seconds": result["cpu_seconds"],
        "headings": {title: result["headings"][title] for title in kept},
        "notes": _notes(result["notes"], kept),
    }
    rows = ",\n".join(
        f" {json.dumps(title)}: [\n  "
        + ",\n  ".join(json.dumps(row, ensure_ascii=False, separators=(",", ":")) for row in rows)
        + "]"
        for title, rows in kept.items()
    )
    text = json.dumps(head, indent=1)[:-2] + ',\n "tables": {\n' + rows + "\n}}\n"
    (RESULTS / f"{name}.json").write_text(text, encoding="utf-8")
    for figure in selection.figures:
        shutil.copy(folder / f"{figure}.svg", RESULTS / f"{name}-{figure}.svg")


def _notes(notes: dict[str, str], titles: Iterable[str]) -> dict[str, str]:
    """Return the notes of tables, each with the first table that has it."""
    titles_by_note = {notes[title]: title for title in reversed(list(titles)) if notes[title]}
    return {title: note for note, title in titles_by_note.items()}


def _is_kept(row: dict[str, Any], selection: Selection) -> bool:
    return not selection.quantities or row["quantity"] in selection.quantities


def _by_case_and_method(rows: Iterable[dict[str, Any]]) -> list[list[Any]]:
    """Return the quantities of each case and method: value, error and unit."""
    groups: dict[tuple[str, str], dict[str, list[Any]]] = {}
    for row in rows:
        value = row["value"]
        groups.setdefault((row["case"], row["method"]), {})[row["quantity"]] = [
            _rounded(value, DIGITS) if isinstance(value, float) else value,
            _rounded(row["error"], ERROR_DIGITS),
            row["unit"],
        ]
    return [[*key, quantities] for key, quantities in groups.items()]


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


def page(name: str, part: str = "") -> str:
    """Return the machine and the tables of a benchmark, or those whose titles end with a part."""
    result = read(name)
    lines = [facts(result)]
    for title, rows in result["tables"].items():
        if not title.endswith(part):
            continue
        case, method = result["headings"][title]
        shown = table(pd.DataFrame(rows, columns=COLUMNS, dtype=object), case=case, method=method)
        cells = shown.itertuples(index=False, name=None)
        lines += ["", f"*{title}*", *tables.table([*shown.columns], cells)]
        lines += [result["notes"].get(title, "")]
    return "\n".join(lines)


def read(name: str) -> dict[str, Any]:
    """Return a committed result, with its rows."""
    return _parsed((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


@cache
def _parsed(text: str) -> dict[str, Any]:
    result = json.loads(text)
    return {
        **result,
        "tables": {
            title: [
                Row(case, method, quantity, value, error, Unit(unit))
                for case, method, quantities in groups
                for quantity, (value, error, unit) in quantities.items()
            ]
            for title, groups in result["tables"].items()
        },
    }


def facts(result: dict[str, Any]) -> str:
    """Return what was run, when, and on what machine."""
    machine = result["machine"]
    packages = ", ".join(f"{name} {number}" for name, number in machine["packages"].items())
    seconds = result.get("cpu_seconds")
    cost = f", {seconds:,.0f} s of CPU time" if seconds else ""
    return (
        f"`{result['command']}`, {result['date']}: {machine['processor']}, {machine['cores']} "
        f"cores, Python {machine['python']}, {packages}, code {machine['code']}{cost}."
    )


def scoreboard() -> str:
    """Return the errors of chains on published simulations, ours and those of others."""
    others = json.loads((RESULTS / "others.json").read_text(encoding="utf-8"))
    return "\n".join(_scoreboard(read("published")["tables"], others))


def _scoreboard(ours: dict[str, list[Row]], others: dict[str, Any]) -> Iterator[str]:
    for score in others["scores"]:
        factor, digits = score["factor"], score["digits"]
        (rows,) = (rows for title, rows in ours.items() if title.startswith(score["table"]))
        values = {
            (row.case, row.method): _signed(row.value, factor, digits)
            for row in rows
            if row.quantity == score["quantity"]
        }
        chains = score["chains"]
        yield f"*{score['title']}*"
        yield from tables.table(
            ("background", *(f"lidarops, {method}" for method in score["methods"]), *chains),
            [
                (
                    f"{level} counts",
                    *(values[level, method] for method in score["methods"]),
                    *(_signed(chain[level], 1.0, digits) for chain in chains.values()),
                )
                for level in dict.fromkeys(row.case for row in rows)
            ],
        )
        yield score["note"]
        yield ""
    yield others["origin"]


def _signed(value: float | None, factor: float, digits: int) -> str:
    """Return a number with its sign; zero has none."""
    if value is None:
        return "no value"
    number = round(value * factor, digits)
    return f"{number:+.{digits}f}" if number else f"{0:.{digits}f}"


if __name__ == "__main__":
    take(sys.argv[1], Path(sys.argv[2]))
