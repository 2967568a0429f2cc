"""The HTML report of a run: one page with its figures, readable without a web server."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby, zip_longest
from pathlib import Path
from typing import Final
from urllib.parse import quote

from jinja2 import Environment

from lidarops.errors import UnavailableError
from lidarops.figures import browser
from lidarops.figures.panels import Figure
from lidarops.figures.templates import environment, style
from lidarops.records import RunRecord
from lidarops.reports import gallery, run_tables
from lidarops.reports.difference import difference
from lidarops.reports.findings import unmet_rows
from lidarops.reports.gallery import Gallery, Picture
from lidarops.reports.rejections import rejection_rows
from lidarops.reports.run_record import FILE_NAME, INDEX
from lidarops.system.files import write_atomically

ROWS: Final = 2000
"""Most rows of a table on the page. The run record beside it holds all rows."""
_SHEET: Final = "report.css"
_SHOWN: Final = 9
"""Most figures on the page, of each instrument in turn; the others are folded."""


_TABLES: Final = (
    run_tables.summary, run_tables.verdict, run_tables.outcome_class, run_tables.changed_products,
    run_tables.findings, run_tables.instruments, run_tables.left_out, run_tables.carried_out,
    run_tables.scenes_without_product, run_tables.flags, run_tables.refused,
    run_tables.failed_rows, run_tables.internal_errors, run_tables.hashes,
)  # fmt: skip
"""What the template shows of a record, by the name of the function."""


@dataclass(frozen=True, slots=True)
class RunReport:
    """Files of a report."""

    page: Path
    quicklook: Figure | None
    """First figure of products; None if there is none."""


def build_report(
    record: RunRecord, folder: Path, *, figures: int = gallery.FIGURES, workers: int = 1
) -> RunReport:
    """Write the report of a run.

    Parameters
    ----------
    record : RunRecord
        Any run, also one without scenes or with failed scenes only.
    folder : Path
        Report folder; created if missing. The page holds the data of its figures, which the script
        beside it draws. Links are relative, and the page needs no network.
    figures : int, optional
        Most figures of products.
    workers : int, optional
        Most processes that read products and draw. The report does not depend on it.

    Returns
    -------
    RunReport
        Missing and unreadable products are listed on the page.

    Raises
    ------
    CatalogError
        If the folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        filled = gallery.fill(record, limit=figures, workers=workers)
        target = folder / INDEX
        write_atomically(folder / browser.SCRIPT, browser.script())
        write_atomically(folder / _SHEET, style("lidarops.reports", _SHEET))
        write_atomically(target, _render(record, folder, filled).encode())
    except OSError as error:
        raise UnavailableError(
            f"the report cannot be written: {error}",
            file=folder,
            remedy=f"make space or choose a folder you can write to, then lidarops report {folder}",
        ) from error
    pictures = filled.pictures
    return RunReport(target, pictures[0].figure if pictures else None)


def _render(record: RunRecord, folder: Path, filled: Gallery) -> str:
    paths = [product.path for scene in record.scenes for product in scene.products]
    links = {path: _href(record, path, folder) for path in paths}
    missing = sorted(path for path, link in links.items() if not link)
    problems = dict.fromkeys(missing, "the file is missing")
    problems |= filled.problems
    pictures = _by_instrument([one for one in filled.pictures if not one.lacking])
    template = _environment().get_template("run.html")
    return template.render(
        record=record,
        rows=ROWS,
        version=record.version,
        difference=difference(record, folder),
        overview=_overview(pictures),
        unmet=unmet_rows(record.findings),
        scenes=record.scenes[:ROWS],
        links=links,
        rejections=list(rejection_rows(record.scenes)),
        problems=sorted(problems.items()),
        pictures=pictures,
        lacking=[picture for picture in filled.pictures if picture.lacking],
        drawn={name: number for number, (name, _) in enumerate(pictures, 1)},
        undrawn=filled.undrawn,
        run_file=FILE_NAME if (folder / FILE_NAME).is_file() else "",
        **{table.__name__: table(record) for table in _TABLES},
    )


@cache
def _environment() -> Environment:
    own = environment("lidarops.reports")
    own.globals |= {"root": "", "sheet": _SHEET, "trail": []}
    own.filters |= {"moment": run_tables.moment, "drawn": browser.inline}
    own.filters |= {"outcome": run_tables.outcome_word}
    return own


def _href(record: RunRecord, product: str, folder: Path) -> str:
    """Return the link from a report to a product; empty if its file is missing."""
    path = (Path(record.products) / product).resolve()
    if not path.is_file():
        return ""
    try:
        relative = os.path.relpath(path, folder.resolve())
    except ValueError:  # No relative path leads to another drive.
        return path.as_uri()
    return quote(os.fsencode(Path(relative).as_posix()))


def _by_instrument(pictures: Sequence[Picture]) -> list[tuple[str, list[Picture]]]:
    ordered = sorted(pictures, key=lambda picture: picture.instrument)
    return [
        (name, list(figures))
        for name, figures in groupby(ordered, lambda picture: picture.instrument)
    ]


def _overview(pictures: Sequence[tuple[str, Sequence[Picture]]]) -> list[Picture]:
    """Return the first figures of each instrument, up to `_SHOWN`, sorted by instrument."""
    turns = zip_longest(*(figures for _, figures in pictures))
    first = [picture for turn in turns for picture in turn if picture is not None][:_SHOWN]
    return sorted(first, key=lambda picture: picture.instrument)
