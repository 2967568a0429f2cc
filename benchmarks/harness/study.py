"""All results of one benchmark, and their page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from benchmarks.harness.drawing import Chart, Ladder, draw_chart
from benchmarks.harness.figure import Figure
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, table
from benchmarks.harness.timing import Machine, machine
from lidarops.errors import CatalogError
from lidarops.figures import svg
from lidarops.figures.templates import environment
from lidarops.system.files import write_atomically

INDEX: Final = "index.html"
RESULT: Final = "result.json"
"""Names of the page and of the file of all numbers in the folder of a benchmark."""


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
            template = environment("benchmarks.harness").get_template("benchmark.html")
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
