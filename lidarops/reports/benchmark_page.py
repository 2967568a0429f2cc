"""The HTML report of a benchmark: one page with tables and charts, without network or scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from jinja2 import Environment, PackageLoader, StrictUndefined

from lidarops.errors import CatalogError
from lidarops.figures import svg
from lidarops.figures.charts import Chart, Ladder, draw_chart
from lidarops.figures.wording import visible
from lidarops.system.files import write_atomically

INDEX: Final = "index.html"
"""Name of the page inside its folder."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table, printed alike on the page and in a terminal."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    """One cell per column; the first cell names the row."""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Part:
    """A chapter of the page."""

    title: str
    text: str
    charts: tuple[Chart | Ladder, ...] = ()
    tables: tuple[Table, ...] = ()
    details: tuple[Table, ...] = ()
    """Tables that are folded on the page and left out in a terminal."""


@dataclass(frozen=True, slots=True)
class BenchmarkReport:
    """The content of a benchmark's report."""

    title: str
    facts: tuple[tuple[str, str], ...]
    """Terms and values: machine, time and versions."""
    parts: tuple[Part, ...]
    data: str = ""
    """Name of the file beside the page with all numbers; empty without such a file."""


@dataclass(frozen=True, slots=True)
class ChartFile:
    """A chart as an image file beside the page."""

    file: str
    caption: str
    alt: str


def build_benchmark_page(report: BenchmarkReport, folder: Path) -> Path:
    """Write the page of a benchmark and its charts.

    Parameters
    ----------
    report : BenchmarkReport
    folder : Path
        Created if missing.

    Returns
    -------
    Path
        ``index.html`` in the folder.

    Raises
    ------
    CatalogError
        If the folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        pictures = {part.title: _pictures(part.charts, folder) for part in report.parts}
        template = _environment().get_template("benchmark.html")
        page = template.render(report=report, pictures=pictures)
        write_atomically(folder / INDEX, page.encode())
    except OSError as error:
        raise CatalogError(
            f"the report cannot be written: {error}",
            file=folder,
            remedy="choose a folder you can write to",
        ) from error
    return folder / INDEX


def _pictures(charts: Sequence[Chart | Ladder], folder: Path) -> list[ChartFile]:
    pictures = []
    for chart in charts:
        figure = draw_chart(chart)
        name = f"{chart.name}.svg"
        write_atomically(folder / name, svg.file(figure))
        pictures.append(ChartFile(name, chart.caption, figure.text))
    return pictures


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("lidarops.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
