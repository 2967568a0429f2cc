"""Makes the site: pages of what changed, kept pages of what did not, and the calendar anew."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import xarray as xr

from lidarops import __version__
from lidarops.errors import CatalogError, ProductError
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.reports.run_record import write_atomically
from lidarops.site import pages, product_contents, product_gallery
from lidarops.site.paths import (
    SITE,
    day_page,
    inside,
    product_folder,
    product_page,
    product_paths,
    year_page,
)
from lidarops.site.product_entry import Entry, Problem

MANIFEST: Final = "manifest.json"
"""What the site was made of; also what tells a site from any other folder."""
_FORMAT: Final = "lidarops site"
_OURS: Final = ("product", "station")
"""Folders of the site in which nothing else may lie."""
# What opening and reading a damaged or foreign file has been seen to raise.
_UNREADABLE: Final = (
    OSError,
    RuntimeError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    ArithmeticError,
    ProductError,
)


@dataclass(frozen=True, slots=True)
class Site:
    """What was made."""

    index: Path
    products: int
    """Products with a page."""
    made: int
    """Pages of products that were made now; the others are unchanged."""
    problems: tuple[Problem, ...]
    """Products without a page, or with less on it than there should be."""


@dataclass(frozen=True, slots=True)
class _Task:
    path: str
    products: Path
    site: Path
    known: Entry | None


_Outcome = tuple[Entry | Problem, bool]
"""What became of a product, and whether its page was made now."""


def build_site(
    output: str | Path, *, workers: int = 1, progress: Callable[[int], None] | None = None
) -> Site:
    """Write the site of all products of a campaign's output to its folder ``site``.

    Pages need neither server nor network nor script. The page of a product depends on the
    product alone and is kept while the product's sha256, the page and lidarops are the same.
    Equal archives give equal bytes, for any number of workers.

    Parameters
    ----------
    output : path or str
        Output folder of a campaign, with its ``products``.
    workers : int, optional
        Processes.
    progress : callable, optional
        Told how many products were done since it was last told.

    Returns
    -------
    Site
        Products that cannot be read are named in it and on the first page.

    Raises
    ------
    ProductError
        If `output` holds no products.
    CatalogError
        If the site cannot be written, or the folder ``site`` holds something else.
    """
    output = Path(output).resolve()
    products, site = product_folder(output), output / SITE
    before = _manifest(site)
    tasks = [_Task(path, products, site, before.get(path)) for path in product_paths(products)]
    entries, problems, made = _collect(tasks, workers, progress)
    expected = _write_calendar(site, entries, problems)
    _write_manifest(site, entries, problems)
    _sweep(site, expected)
    return Site(site / pages.INDEX, len(entries), made, tuple(problems))


def _collect(
    tasks: Sequence[_Task], workers: int, progress: Callable[[int], None] | None
) -> tuple[list[Entry], list[Problem], int]:
    entries, problems, made = [], [], 0
    for outcome, new in _outcomes(tasks, workers):
        if isinstance(outcome, Problem):
            problems.append(outcome)
        else:
            entries.append(outcome)
            made += new
            if outcome.problem:
                problems.append(Problem(outcome.path, outcome.problem))
        if progress is not None:
            progress(1)
    return entries, problems, made


def _outcomes(tasks: Sequence[_Task], workers: int) -> Iterator[_Outcome]:
    """Return what became of the products, in their order."""
    if workers == 1:
        yield from map(_page, tasks)
        return
    rest = list(tasks)
    while rest:
        done = 0
        with _pool(min(workers, len(rest))) as pool:
            futures = [pool.submit(_page, task) for task in rest]
            for future in futures:
                try:
                    outcome = future.result()
                except BrokenExecutor:
                    break
                done += 1
                yield outcome
        if done < len(rest):
            yield _alone(rest[done])
            done += 1
        rest = rest[done:]


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def _alone(task: _Task) -> _Outcome:
    """Read in a process of its own what may have ended another one."""
    with _pool(1) as pool:
        try:
            return pool.submit(_page, task).result()
        except BrokenExecutor:
            return Problem(task.path, "reading it ended the process that read it"), True


def _page(task: _Task) -> _Outcome:
    """Make the page of one product, or keep it."""
    try:
        file = inside(task.products, task.path)
        with file.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        if task.known is not None and _is_kept(task.known, sha256, task.site):
            return task.known, False
        return _made(task, file, sha256), True
    except _UNREADABLE as error:
        return Problem(task.path, _reason(file_of=task, error=error)), True


def _reason(*, file_of: _Task, error: BaseException) -> str:
    # The path stands beside the reason, and where the archive lies changes no page.
    words = str(error).replace(str(file_of.products / file_of.path), file_of.path)
    return words or type(error).__name__


def _is_kept(known: Entry, sha256: str, site: Path) -> bool:
    if known.sha256 != sha256:
        return False
    found = (inside(site, name) for name in known.files)
    return all(
        file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() == digest
        for file, digest in zip(found, known.digests, strict=True)
    )


def _made(task: _Task, file: Path, sha256: str) -> Entry:
    with xr.open_dataset(file, engine="netcdf4", decode_timedelta=False) as opened:
        judged, origin = product_contents.judge(opened), product_contents.origin(opened)
        span = product_contents.span(opened)
        kind = product_contents.attribute(opened, "lidarops_kind")
        gallery, problem = _drawn(opened, kind)
        page = product_page(task.path)
        station = product_contents.attribute(opened, "lidarops_station")
        entry = Entry(
            path=task.path,
            sha256=sha256,
            size=file.stat().st_size,
            page=page,
            thumbnail=page.removesuffix(".html") + ".svg",
            digests=(),
            campaign=product_contents.attribute(opened, "lidarops_campaign"),
            station=station,
            place=product_contents.attribute(opened, "platform", station),
            instrument=product_contents.attribute(opened, "lidarops_instrument"),
            kind=kind,
            channel=product_contents.attribute(opened, "lidarops_channel"),
            start=span.start,
            stop=span.stop,
            values=judged.values,
            usable=judged.usable,
            unflagged=judged.unflagged,
            alt=gallery.alt,
            problem=_joined(problem, origin.problem, _unjudged(opened)),
        )
        contents = (
            pages.product(entry, opened, judged, origin, gallery.figures),
            gallery.thumbnail,
            origin.text.encode(),
        )
    for name, content in zip(entry.files, contents, strict=True):
        _write(task.site, name, content)
    return replace(entry, digests=tuple(hashlib.sha256(c).hexdigest() for c in contents))


def _drawn(opened: xr.Dataset, kind: str) -> tuple[product_gallery.Gallery, str]:
    """Draw a product; where it is not what its kind says, as one of no known kind."""
    style = pages.style("thumb.css")
    try:
        return product_gallery.draw_gallery(opened, kind, style), ""
    except _UNREADABLE as error:
        problem = f"it cannot be drawn as {kind}: {error}"
    try:
        return product_gallery.draw_gallery(opened, "", style), problem
    except _UNREADABLE:
        return product_gallery.nothing("it cannot be drawn", style), problem


def _unjudged(opened: xr.Dataset) -> str:
    return "" if QUALITY_FLAG in opened else "the product holds no quality flags"


def _joined(*problems: str) -> str:
    return "; ".join(problem for problem in problems if problem)


def _write(site: Path, name: str, content: bytes) -> None:
    """Write one file of the site, in one step: the only place that does."""
    target = inside(site, name)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, content)
    except OSError as error:
        raise CatalogError(
            f"cannot be written: {error}",
            file=target,
            remedy="see that the folder can be written and the disk has space, then run again",
        ) from error


def _write_calendar(site: Path, entries: Sequence[Entry], problems: Sequence[Problem]) -> set[str]:
    """Write all pages that are of no single product; return every file of the site's folders."""
    expected = {name for entry in entries for name in entry.files}
    for station, of_station in pages.stations(entries).items():
        known = pages.years(of_station)
        for year, of_year in known.items():
            name = year_page(station, int(year))
            expected.add(name)
            _write(site, name, pages.year(station, int(year), of_year, list(known)))
        by_day = pages.days(of_station)
        around = [None, *by_day, None]
        for (before, _), (day, after) in zip(pairwise(around), pairwise(around[1:]), strict=False):
            if day is not None:
                name = day_page(station, day)
                expected.add(name)
                _write(site, name, pages.day(station, day, by_day[day], before, after))
    campaigns = sorted({entry.campaign for entry in entries})
    _write(site, "site.css", pages.style("site.css").encode())
    _write(site, pages.INDEX, pages.index(entries, problems, campaigns))
    return expected


def _sweep(site: Path, expected: set[str]) -> None:
    """Remove the pages of what is no longer there."""
    for folder in _OURS:
        for file in sorted((site / folder).rglob("*"), reverse=True):
            if file.is_dir() and not file.is_symlink():
                if not any(file.iterdir()):
                    file.rmdir()
            elif file.relative_to(site).as_posix() not in expected:
                file.unlink(missing_ok=True)


@cache
def _version() -> str:
    """Return a digest of all that makes pages: with another one, none is kept."""
    package = Path(__file__).resolve().parents[1]
    sources = [
        package / "flags.py",
        *(package / "figures").glob("*.py"),
        package / "reports/run_record.py",
    ]
    sources += [path for path in (package / "site").rglob("*") if path.suffix in _SOURCES]
    digest = hashlib.sha256(__version__.encode())
    for source in sorted(sources):
        digest.update(source.name.encode() + source.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()


_SOURCES: Final = (".py", ".html", ".css")


def _write_manifest(site: Path, entries: Sequence[Entry], problems: Sequence[Problem]) -> None:
    document = {
        "format": _FORMAT,
        "version": _version(),
        "products": [asdict(entry) for entry in entries],
        "problems": [asdict(problem) for problem in problems],
    }
    text = json.dumps(document, indent=0, sort_keys=True)
    _write(site, MANIFEST, text.encode("ascii") + b"\n")


def _manifest(site: Path) -> dict[str, Entry]:
    """Read what the site was made of; nothing is kept where that cannot be told."""
    file = site / MANIFEST
    if not file.is_file():
        if site.exists() and (not site.is_dir() or any(site.iterdir())):
            raise CatalogError(
                "exists, and is no site of lidarops",
                file=site,
                remedy="move it away, so that nothing in it is lost",
            )
        # First of all, so that a site whose making was cut short is known as one.
        _write_manifest(site, [], [])
        return {}
    try:
        document = json.loads(file.read_bytes())
        if document["format"] != _FORMAT or document["version"] != _version():
            return {}
        return {item["path"]: _entry(item) for item in document["products"]}
    except (ValueError, KeyError, TypeError):
        return {}


def _entry(item: dict[str, Any]) -> Entry:
    values = {field.name: item[field.name] for field in fields(Entry)}
    known = Entry(**(values | {"digests": tuple(item["digests"])}))
    # A page is named by its product, not by a file that anyone may have edited.
    page = product_page(known.path)
    if (known.page, known.thumbnail) != (page, page.removesuffix(".html") + ".svg"):
        raise ValueError(known.path)
    return known
