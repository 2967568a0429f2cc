"""Builds the site: pages of new and changed products, and all calendar pages.

Pages of unchanged products are kept.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

import xarray as xr
from markupsafe import Markup

from lidarops import __version__
from lidarops.errors import CatalogError, ProductError, UnavailableError
from lidarops.figures import browser
from lidarops.figures.kind_figures import View, figures_of, view_of
from lidarops.figures.panels import Figure
from lidarops.figures.product_names import attribute, light_in_words, scalar
from lidarops.figures.raster import COLUMNS
from lidarops.figures.templates import style
from lidarops.figures.time_axis import TIME_BOUNDS
from lidarops.netcdf.read import decoded
from lidarops.netcdf.stored import UNREADABLE, StoredProduct, open_stored, reading
from lidarops.netcdf.stored_flags import flags_names, refuse_moved_flags
from lidarops.netcdf.variables import QUALITY_FLAG, USABLE
from lidarops.reports import product_contents
from lidarops.site import pages
from lidarops.site.paths import (
    BESIDE,
    CALENDAR_HEIGHT,
    Links,
    day_page,
    month_list,
    product_folder,
    year_page,
)
from lidarops.site.product_entry import Entry, Problem, with_neighbours
from lidarops.site.quality import Quality, read_quality
from lidarops.system.code_version import pages_version
from lidarops.system.files import (
    MANIFEST,
    SITE,
    last_change,
    product_paths,
    settled_before,
    sha256_of,
    within,
    write_atomically,
)
from lidarops.system.processes import CRASHED, Processes

_FORMAT: Final = "lidarops site"
_READ_BYTES: Final = 16_000_000
"""Most bytes of a variable that is read as a whole."""
_ALWAYS: Final = "time", TIME_BOUNDS, QUALITY_FLAG, USABLE
_OURS: Final = ("product", "station")
"""Folders that only the site writes to."""


@dataclass(frozen=True, slots=True)
class Site:
    """Result of building a site."""

    index: Path
    products: int
    """Products with a page."""
    made: int
    """Product pages that were made now; the others were kept."""
    problems: tuple[Problem, ...]
    """Products without a page, or with an incomplete page."""


class _Before(NamedTuple):
    """The existing site; empty if it is unknown or outdated."""

    listed: Sequence[Entry]
    entries: Mapping[str, Entry]
    """Those that have their pages, by path."""
    rest: Mapping[str, Any]
    """What the manifest states but for the entries."""
    as_of: float
    """Products of earlier times are as in the entries, s since 1970."""
    finished: float
    """Files of the site of later times are of a build that did not end."""


_NOTHING: Final = _Before([], {}, {}, 0.0, 0.0)
_FIELDS: Final = tuple(item.name for item in fields(Entry))
_IN_SITE: Final = (pages.INDEX, pages.SHEET, browser.SCRIPT)
"""Files in the folder of the site itself, whose time the manifest changes."""
_Kept = tuple[Path, Path, float]
"""Folders of the products and of the site, and the height of the calendar."""
_Task = tuple[str, Entry | None]
"""Path of a product, and its entry if it has a page."""
_Drawn = tuple[Figure, Markup]
"""A figure, and as a page holds it."""
_Outcome = tuple[Entry | Problem, bool]
"""Entry or problem of a product, and whether its page was made now."""


def build_site(
    output: str | Path,
    *,
    workers: int = 1,
    products_at: str = BESIDE,
    stac_at: str = "",
    reports_at: str = "",
    below: float = CALENDAR_HEIGHT,
    progress: Callable[[int], None] = lambda _done: None,
) -> Site:
    """Write the site of all products of a campaign's output to its folder ``site``.

    Pages need neither server nor network; one script draws their figures. The page of a product
    depends only on the product, except its links, which are written anew in each build. It is kept
    while the product, the page and lidarops do not change, by their times, or of a copied product
    by its sha256; where nothing has changed, nothing is written. Equal archives give equal bytes,
    for any number of workers.

    Parameters
    ----------
    output : path or str
        Output folder of a campaign, with its folder ``products``.
    workers : int, optional
        Number of processes.
    products_at : str, optional
        Where the downloads lead: an address, or a place relative to the site.
    stac_at, reports_at : str, optional
        Where the links to the STAC catalog and to the report of the last run lead, where the site
        is not used in the output: an address, or a place relative to the site.
    below : float, optional
        Height above the station, m, below which a profile with a usable value counts in the
        calendar.
    progress : callable, optional
        Called with the number of products done since the last call.

    Returns
    -------
    Site
        Unreadable products, and with several workers those whose reading ends its process, are
        listed in it and on the first page.

    Raises
    ------
    ProductError
        If `output` holds no products.
    CatalogError
        If the site cannot be written, or the folder ``site`` has other content.
    """
    output = Path(output).resolve()
    links = Links(output, products_at, stac_at, reports_at)
    products, site = product_folder(output), output / SITE
    as_of, before = settled_before(), _existing(site, links, below)
    outcomes: dict[str, _Outcome] = {}
    tasks: list[_Task] = []
    for path in product_paths(products):
        known = before.entries.get(path)
        if known is not None and last_change(products / path) < before.as_of:
            outcomes[path] = known, False
        else:
            tasks.append((path, known))
    if outcomes:
        progress(len(outcomes))
    with Processes(workers, (products, site, below)) as processes:
        for task, outcome in processes.map_items(_page, tasks, at_a_time=1, lost=_crashed):
            outcomes[task[0]] = outcome
            progress(1)
    entries, problems, made = _collected(outcomes)
    built = Site(site / pages.INDEX, len(entries), made, tuple(problems))
    stated = _stated(problems, links, below)
    is_same = not made and (entries, stated) == (before.listed, before.rest)
    if not is_same or _is_touched(site, links, before):
        _link(site, entries, links)
        expected = _write_calendar(site, entries, problems, links, below)
        _sweep(site, expected)
        # Last, because later files are of a build that did not end.
        _write_manifest(site, entries, stated, as_of)
    return built


def _collected(outcomes: Mapping[str, _Outcome]) -> tuple[list[Entry], list[Problem], int]:
    """Return entries and problems in the order of paths, and the number of pages made."""
    entries, problems, made = [], [], 0
    for _, (outcome, new) in sorted(outcomes.items(), key=itemgetter(0)):
        if isinstance(outcome, Problem):
            problems.append(outcome)
        else:
            entries.append(outcome)
            made += new
            if outcome.problem:
                problems.append(Problem(outcome.path, outcome.problem))
    return entries, problems, made


def _page(kept: _Kept, task: _Task) -> _Outcome:
    """Make or keep the page of one product."""
    (products, site, below), (path, known) = kept, task
    try:
        file = within(products, path)
        with reading(file):
            sha256 = sha256_of(file)
        if known is not None and known.sha256 == sha256:
            return known, False
        return _make(path, file, sha256, site, below), True
    except ProductError as error:
        # With relative paths, because pages must not depend on the location of the archive.
        words = str(error).replace(str(products / path), path)
        return Problem(path, words or type(error).__name__), True


def _crashed(task: _Task) -> _Outcome:
    return Problem(task[0], CRASHED), True


def _make(path: str, file: Path, sha256: str, site: Path, below: float) -> Entry:
    with reading(file), open_stored(file) as stored:
        kind = attribute(stored, "lidarops_kind")
        opened = _decoded(stored, kind)
        quality, no_quality = _quality(opened, below)
        figures, not_drawn = _draw(stored, opened, kind, quality.figure)
        origin = product_contents.origin(opened)
        start, stop = product_contents.span(opened)
        no_flags = "" if QUALITY_FLAG in opened else "the product has no quality flags"
        problems = (not_drawn, no_quality, origin["problem"], no_flags)
        station = attribute(opened, "lidarops_station")
        instrument = attribute(opened, "lidarops_instrument")
        entry = Entry(
            path=path,
            sha256=sha256,
            size=file.stat().st_size,
            campaign=product_contents.campaign(opened),
            station=station,
            place=attribute(opened, "platform", station),
            instrument=instrument,
            name=attribute(opened, "instrument", instrument),
            kind=kind,
            channel=attribute(opened, "lidarops_channel"),
            light=light_in_words(opened),
            latitude=product_contents.middle(opened, "latitude"),
            longitude=product_contents.middle(opened, "longitude"),
            altitude=scalar(opened, "station_altitude"),
            license=attribute(opened, "license", ""),
            start=start,
            stop=stop,
            values=quality.verdicts.values,
            usable=quality.verdicts.usable,
            unflagged=quality.verdicts.good,
            profiles=quality.profiles,
            available=quality.available,
            lacking=quality.lacking,
            problem="; ".join(filter(None, problems)),
        )
        page = pages.product(entry, stored, quality, origin, figures)
    # It is written again with its links.
    _write(site, entry.page, page, sync=False)
    return entry


def _decoded(stored: StoredProduct, kind: str) -> xr.Dataset:
    """Return the variables of a product that its page shows, decoded.

    Of an unknown kind, any variable may be shown. What several parts of the page need is read once,
    unless it is large.
    """
    figures = figures_of(kind)
    uses = Counter(name for view in (figures.views if figures else ()) for name in view.variables)
    uses.update((*_ALWAYS, *product_contents.USED, *flags_names(stored)))
    opened = decoded(stored, uses if figures else stored.variables)
    for name, variable in opened.variables.items():
        if uses[str(name)] > 1 and variable.nbytes <= _READ_BYTES:
            variable.load()
    return opened


def _quality(product: xr.Dataset, below: float) -> tuple[Quality, str]:
    """Return the quality of a product, or why it is not known."""
    try:
        return read_quality(product, below), ""
    except UNREADABLE as error:
        return Quality(), f"its quality over time cannot be drawn: {error}"


def _with_quality(figures: list[Figure], shown: Figure | None) -> list[Figure]:
    """Return figures with the quality over time below the first, or after it."""
    if shown is None:
        return figures
    if not figures or not figures[0].panels[-1].x.time:
        return [*figures[:1], shown, *figures[1:]]
    first, (panel,) = figures[0], shown.panels
    joined = (*first.panels, replace(panel, x=first.panels[-1].x))
    words = f"{first.words}. {shown.words}"
    return [replace(first, panels=joined, words=words), *figures[1:]]


def _draw(
    stored: StoredProduct, opened: xr.Dataset, kind: str, quality: Figure | None
) -> tuple[list[_Drawn], str]:
    """Draw a product; if it does not fit its kind, as a product of unknown kind."""
    figures = figures_of(kind)
    problem = ""
    try:
        if figures is not None:
            refuse_moved_flags(opened)
            return _figures(opened, figures.views, quality), ""
    except UNREADABLE as error:
        problem = f"it cannot be drawn as {kind}: {error}"
    try:
        whole = decoded(stored, stored.variables, decode_coords=True)
        return _figures(whole, [view_of(kind)], quality), problem
    except UNREADABLE as error:
        return [], problem or f"it cannot be drawn: {error}"


def _figures(
    opened: xr.Dataset, views: Sequence[View[Any]], quality: Figure | None
) -> list[_Drawn]:
    contents = ((view, view.read(opened, COLUMNS)) for view in views)
    figures = [
        figure
        for view, content in contents
        if content is not None
        for figure in view.draw([content])
    ]
    return [(figure, browser.inline(figure)) for figure in _with_quality(figures, quality)]


def _write(
    site: Path, name: str, content: bytes, *, sync: bool = True, as_of: float | None = None
) -> None:
    """Write a file of the site atomically; one that holds the same stays, if its time may be any.

    All files are written here.
    """
    target = within(site, name)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if as_of is not None or not target.is_file() or target.read_bytes() != content:
            write_atomically(target, content, as_of, sync=sync)
    except OSError as error:
        raise UnavailableError(
            f"cannot be written: {error}",
            file=target,
            remedy="check that the folder can be written and the disk has space, then run again",
        ) from error


def _link(site: Path, entries: Sequence[Entry], links: Links) -> None:
    """Write what leads to and from each product into its page."""
    for entry, neighbours in with_neighbours(entries):
        page = (site / entry.page).read_bytes()
        linked = pages.with_navigation(page, pages.navigation(entry, neighbours, links))
        _write(site, entry.page, linked)


def _write_calendar(
    site: Path, entries: Sequence[Entry], problems: Sequence[Problem], links: Links, below: float
) -> set[str]:
    """Write all calendar pages; return the files that belong in the site's folders."""
    expected = {entry.page for entry in entries}

    def write(name: str, content: bytes) -> None:
        expected.add(name)
        _write(site, name, content)

    for station, station_entries in pages.grouped(entries, "station").items():
        by_year = pages.grouped(station_entries, "year")
        for year in by_year:
            write(year_page(station, year), pages.year(station, year, by_year))
        for month, month_entries in pages.grouped(station_entries, "month").items():
            name = month_list(station, month)
            lines = [f"{links.product(entry, name)}\n" for entry in month_entries]
            write(name, "".join(lines).encode())
        by_day = pages.grouped(station_entries, "day")
        ends = [None, *by_day, None]
        for (before, _), (day, after) in zip(pairwise(ends), pairwise(ends[1:]), strict=False):
            if day is not None:
                name = day_page(station, day)
                write(name, pages.day(station, day, by_day, before, after))
    campaigns = sorted({entry.campaign for entry in entries})
    _write(site, pages.SHEET, style("lidarops.site", pages.SHEET))
    _write(site, browser.SCRIPT, browser.script())
    _write(site, pages.INDEX, pages.index(entries, problems, campaigns, links, below))
    return expected


def _sweep(site: Path, expected: set[str]) -> None:
    """Remove pages of products that no longer exist."""
    for folder in _OURS:
        for file in sorted((site / folder).rglob("*"), reverse=True):
            if file.is_dir() and not file.is_symlink():
                if not any(file.iterdir()):
                    file.rmdir()
            elif file.relative_to(site).as_posix() not in expected:
                file.unlink(missing_ok=True)


@cache
def _version() -> str:
    """Return a digest of the code that makes pages; if it changes, all pages are made again."""
    return f"{__version__} {pages_version()}"


def _stated(problems: Sequence[Problem], links: Links, below: float) -> dict[str, Any]:
    """Return what the manifest states but for the entries: all that the site follows from."""
    return {
        **_of_all_pages(below),
        "products_at": links.products,
        "catalog": links.catalog(pages.INDEX),
        "report": links.report(pages.INDEX),
        "problems": [asdict(problem) for problem in problems],
    }


def _of_all_pages(below: float) -> dict[str, Any]:
    """Return what all pages of products follow from."""
    return {"format": _FORMAT, "version": _version(), "below": below}


def _write_manifest(
    site: Path, entries: Sequence[Entry], stated: Mapping[str, Any], as_of: float
) -> None:
    """Write the manifest, whose times tell what happened before and after a build."""
    listed = [{name: getattr(entry, name) for name in _FIELDS} for entry in entries]
    document = {**stated, "products": listed}
    text = json.dumps(document, sort_keys=True, separators=(",\n", ": "))
    _write(site, MANIFEST, f"{text}\n".encode("ascii"), as_of=as_of)


def _existing(site: Path, links: Links, below: float) -> _Before:
    """Return the existing site; without entries if they are unknown or outdated."""
    file = site / MANIFEST
    if not file.is_file():
        if site.exists() and (not site.is_dir() or any(site.iterdir())):
            raise CatalogError(
                "exists, but is no site of lidarops",
                file=site,
                remedy="move it away, so that its content is not lost",
            )
        # Written first, so that an interrupted build is recognised as a site.
        _write_manifest(site, [], _stated([], links, below), 0.0)
        return _NOTHING
    try:
        as_of, finished = file.stat().st_mtime, last_change(file)
        stated = json.loads(file.read_bytes())
        listed = [Entry(**item) for item in stated.pop("products")]
        if not _of_all_pages(below).items() <= stated.items():
            return _NOTHING
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return _NOTHING
    whole = {one.path: one for one in listed if last_change(site / one.page) <= finished}
    return _Before(listed, whole, stated, as_of, finished)


def _is_touched(site: Path, links: Links, before: _Before) -> bool:
    """Return whether a file of the site, or what its pages link, changed after the last build."""
    inside = chain.from_iterable((site / folder).rglob("*") for folder in _OURS)
    own = (site / name for name in (*_IN_SITE, *_OURS))
    return links.changed(before.as_of) or any(
        last_change(place) > before.finished for place in chain(own, inside)
    )
