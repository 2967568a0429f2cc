"""Results of benchmarks: tables of (case, method, quantity, value), and their JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import pandas as pd

from benchmarks.harness.figure import Figure, Judgement, Scores, Unit, Work, format_time, with_error
from benchmarks.harness.plots import Chart, draw
from lidarops.errors import CatalogError
from lidarops.system.code_version import source_version
from lidarops.system.files import write_atomically

RESULT: Final = "result.json"
"""Name of the file of all numbers in the folder of a benchmark."""
COLUMNS: Final = ["case", "method", "quantity", "value", "error", "unit"]
"""Columns of a table of results; an error of 0 is none."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Size of a run, its inputs, and the progress callback."""

    quick: bool = False
    progress: Callable[[int], object] = lambda _: None
    """Called with 1 after each scenario or setting."""
    data: Path | None = None
    """Folder of published signals, for the accuracy of the elastic retrieval."""


def machine() -> dict[str, Any]:
    """Return processor, cores, versions of Python and packages, and the digest of the code."""
    models = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        if line.startswith("model name")
    ]
    return {
        "processor": models[0] if models else platform.machine(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("lidarops", "numpy", "numba", "scipy")},
        "code": source_version(),
    }


def frame(scores: Scores) -> pd.DataFrame:
    """Return scores as a table with a line for each value, with the columns `COLUMNS`."""
    rows = [
        (*key, quantity, *_parts(value))
        for key, score in scores.items()
        for quantity, value in score.items()
    ]
    return pd.DataFrame(rows, columns=COLUMNS, dtype=object)


def _parts(value: Any) -> tuple[Any, float, str]:
    if isinstance(value, Figure):
        return value.value, value.error, value.unit
    return str(value) if isinstance(value, Judgement) else value, 0.0, Unit.NUMBER


def cell(row: Any) -> str:
    """Return the text of a row of a table of results."""
    value = row.value
    if value is None or isinstance(value, str):
        return value or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if row.unit == Unit.TIME:
        return format_time(value)
    if row.unit == Unit.SHARE:
        # Rounding must not turn a share below 1 into 100 %.
        rounds = not row.error and 0.999 < value < 1.0
        return ">99.9 %" if rounds else f"{with_error(100.0 * value, 100.0 * row.error)} %"
    return with_error(value, row.error)


def table(rows: pd.DataFrame, *, case: str = "case", method: str = "method") -> pd.DataFrame:
    """Return texts with a line for each case and method, and a column for each quantity.

    Parameters
    ----------
    rows : DataFrame
        With the columns `COLUMNS`.
    case, method : str
        Headings of these columns; a column whose values are all the same is left out.
    """
    cells = rows.assign(text=[cell(row) for row in rows.itertuples(index=False)])
    keys = pd.MultiIndex.from_frame(rows[["case", "method"]].drop_duplicates())
    wide = cells.pivot_table("text", ["case", "method"], "quantity", "last")
    wide = wide.reindex(index=keys, columns=rows["quantity"].unique()).fillna("-").reset_index()
    constant = [name for name in ("case", "method") if wide[name].nunique() == 1]
    left_out = constant if len(constant) == 1 else ["case"] * len(constant[:1])
    return wide.drop(columns=left_out).rename(columns={"case": case, "method": method})


@dataclass(frozen=True, slots=True)
class Results:
    """Scores under a heading."""

    title: str
    scores: Scores
    note: str = ""
    """What was simulated and what the columns are."""
    case: str = "case"
    """Heading of the column of cases."""
    method: str = "method"

    @property
    def table(self) -> pd.DataFrame:
        """The scores as texts."""
        return table(frame(self.scores), case=self.case, method=self.method)


@dataclass(frozen=True, slots=True)
class Study:
    """All results of one benchmark."""

    results: Sequence[Results]
    charts: Sequence[Chart] = ()
    works: Sequence[Work] = ()
    missed: Sequence[str] = ()
    """Targets that are missed; the command fails where there is one."""
    date: str = ""
    cpu_seconds: float = 0.0
    """CPU time of the whole benchmark, with its child processes."""

    def figures(self, title: str) -> dict[tuple[str, str, str], Any]:
        """Return the rows under a heading by case, method and quantity."""
        (scores,) = (results.scores for results in self.results if results.title == title)
        rows = frame(scores).itertuples(index=False)
        return {(row.case, row.method, row.quantity): row for row in rows}

    def json(self) -> str:
        """Return all rows, by the headings of their tables, and the machine as JSON."""
        document = {
            "date": self.date,
            "machine": machine(),
            "cpu_seconds": round(self.cpu_seconds, 1),
            "tables": {each.title: frame(each.scores).to_dict("records") for each in self.results},
            "headings": {each.title: [each.case, each.method] for each in self.results},
            "notes": {each.title: each.note for each in self.results},
        }
        return json.dumps(document, indent=1, allow_nan=False)

    def write(self, folder: Path) -> Path:
        """Write the charts and the JSON; return the path of the JSON.

        Raises
        ------
        CatalogError
            If the folder cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for chart in self.charts:
                write_atomically(folder / f"{chart.name}.svg", draw(chart))
            write_atomically(folder / RESULT, self.json().encode())
        except OSError as error:
            raise CatalogError(
                f"the report cannot be written: {error}",
                file=folder,
                remedy="choose a folder you can write to",
            ) from error
        return folder / RESULT
