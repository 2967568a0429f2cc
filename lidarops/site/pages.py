"""The pages of the site as HTML: what the templates are filled with."""

from __future__ import annotations

import calendar
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from functools import cache, partial
from typing import Any, Final

from jinja2 import Environment
from markupsafe import Markup

from lidarops.figures.panels import Figure
from lidarops.figures.product_names import UNKNOWN
from lidarops.figures.templates import environment
from lidarops.figures.wording import SEVERITIES, counted, percent, size
from lidarops.kinds import kinds, rank_of
from lidarops.netcdf.stored import StoredProduct
from lidarops.netcdf.variables import is_retrieved
from lidarops.reports.product_contents import citation, contact, variables
from lidarops.site.paths import Links, day_page, href, month_list, slug, year_page
from lidarops.site.product_entry import (
    GRADES,
    Entry,
    Neighbours,
    Problem,
    grade_of,
    mean_availability,
)
from lidarops.site.quality import Quality

INDEX: Final = "index.html"
SHEET: Final = "site.css"
_INPUTS: Final = 12
"""Most input files that a page lists."""
_PROBLEMS: Final = 200
_LATEST: Final = 6
_NAVIGATION: Final = (b"<!-- navigation -->", b"<!-- /navigation -->")
"""Ends of the part of a product page that does not follow from the product."""

ByDay = Mapping[str, Sequence[Entry]]


@cache
def _templates() -> Environment:
    """Return the templates, with the functions that they call."""
    own = environment("lidarops.site")
    own.globals |= {
        "grades": GRADES,
        "weekdays": calendar.day_name[:],
        "month_name": calendar.month_name[:],
        "sheet": SHEET,
        "about": _about,
        "clock": _clock,
        "shown_span": _span,
        "cell": _cell,
        "grouped": grouped,
        "weeks_of": _weeks,
        "day_page": day_page,
        "year_page": year_page,
        "month_list": month_list,
        "slug": slug,
    }
    return own


def _render(template: str, page: str, **context: Any) -> bytes:
    """Return a page; `link` of its template leads to a file of the site."""
    link = partial(href, page=page)
    text = (
        _templates()
        .get_template(template)
        .render(root="../" * page.count("/"), link=link, **context)
    )
    return text.encode("utf-8", "replace")


def product(
    entry: Entry,
    opened: StoredProduct,
    quality: Quality,
    origin: Mapping[str, Any],
    figures: Sequence[tuple[Figure, Markup]],
) -> bytes:
    """Return the page of a product; it depends only on the product and its path."""
    page = entry.page
    file = entry.path.rsplit("/", 1)[-1]
    return _render(
        "product.html",
        page,
        entry=entry,
        heading=f"{_about(entry.kind, 'Product of kind')}, {entry.label}",
        trail=[*_trail(entry, page), (entry.day, href(day_page(entry.station, entry.day), page))],
        file=file,
        summary=[
            ("Title", str(opened.attrs.get("title", "not stated"))),
            ("Station", _named(entry.place, entry.station)),
            ("Instrument", _named(entry.name, entry.instrument)),
            ("Kind", entry.kind),
            ("Channel", entry.label),
            ("Data", _span(entry)),
            ("File", file),
            ("Size", f"{size(entry.size)} ({entry.size:,} bytes)"),
            ("sha256", entry.sha256),
        ],
        figures=[(markup, figure.text) for figure, markup in figures],
        bits=[
            (bit.word, SEVERITIES[bit.severity], bit.description, n, percent(n / entry.values))
            for bit, n in quality.bits
        ],
        origin=origin,
        citation=citation(opened),
        contact=contact(opened),
        references=str(opened.attrs.get("references", "")).splitlines(),
        variables=variables(opened),
        most=_INPUTS,
    )


def navigation(entry: Entry, neighbours: Neighbours, links: Links) -> bytes:
    """Return the part of a product page that leads to its file and to other products."""
    return _render(
        "navigation.html",
        entry.page,
        entry=entry,
        download=links.product(entry, entry.page),
        stac=links.stac(entry, entry.page),
        near=neighbours,
    )


def with_navigation(page: bytes, part: bytes) -> bytes:
    """Return a product page with another part of `navigation`."""
    head, first, rest = page.partition(_NAVIGATION[0])
    _, last, tail = rest.partition(_NAVIGATION[1])
    return b"".join((head, first, b"\n", part, b"\n", last, tail))


def _about(kind: str, other: str = "Kind") -> str:
    """Return the heading of products of a kind; before the name of an unknown one, `other`."""
    if kind == UNKNOWN:
        return "Products of unknown kind"
    known = kinds().get(kind)
    return known.title if known else f"{other} {kind}"


def _named(place: str, key: str) -> str:
    return place if place == key else f"{place} ({key})"


def _span(entry: Entry) -> str:
    start, stop = _clock(entry.start), _clock(entry.stop)
    day_, clock = start.split()
    same = stop.startswith(day_)
    return f"{day_}, {clock} to {stop[11:]} UTC" if same else f"{start} to {stop} UTC"


def _clock(moment: str) -> str:
    return moment.replace("T", " ")[:16]


def _trail(entry: Entry, page: str) -> list[tuple[str, str]]:
    return [
        ("Archive", href(INDEX, page)),
        (f"{entry.place} {entry.year}", href(year_page(entry.station, entry.year), page)),
    ]


def _order(entry: Entry) -> tuple[Any, ...]:
    """Return the place of a product on the page of a day: signals, then what is retrieved."""
    kind = is_retrieved(entry.kind), rank_of(entry.kind), entry.kind
    return entry.instrument, *kind, entry.channel, entry.start, entry.path


def _cell(entries: Iterable[Entry]) -> dict[str, Any]:
    """Return what a day or month shows: the share of usable profiles, and its grade."""
    share = mean_availability(entries)
    words = ("", "") if share is None else (percent(share), " of profiles usable")
    return {"share": words[0], "of": words[1], "grade": grade_of(share)}


def grouped(entries: Iterable[Entry], by: str) -> dict[str, list[Entry]]:
    """Return the entries by one of their texts, such as ``station`` or ``month``, in its order."""
    groups: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        groups[getattr(entry, by)].append(entry)
    return dict(sorted(groups.items()))


def index(
    entries: Sequence[Entry],
    problems: Sequence[Problem],
    campaigns: Sequence[str],
    links: Links,
    below: float,
) -> bytes:
    """Return the first page. `below` is the height of the calendar above the station, m."""
    by_station = grouped(entries, "station")
    newest = sorted(entries, key=lambda entry: (entry.start, entry.path), reverse=True)
    retrieved = [e for e in newest if is_retrieved(e.kind) and not e.lacking] or newest
    lead = "No product could be read."
    if entries:
        first, last = (end(entry.day for entry in entries) for end in (min, max))
        lead = (
            f"{counted(len(entries), 'product')} of {counted(len(by_station), 'station')},"
            f" {size(sum(entry.size for entry in entries))}, from {first} to {last}"
        )
    return _render(
        "index.html",
        INDEX,
        title=f"Lidar archive: {'; '.join(campaigns[:3])}" if campaigns else "Lidar archive",
        lead=lead,
        trail=[],
        below=f"{below / 1e3:g} km",
        stac=links.catalog(INDEX),
        report=links.report(INDEX),
        licenses=sorted({entry.license for entry in entries if entry.license}),
        stations=by_station,
        latest=retrieved[:_LATEST],
        problems=[(problem.path, problem.reason) for problem in problems],
        files=len({*(entry.path for entry in entries), *(item.path for item in problems)}),
        most=_PROBLEMS,
    )


def year(key: str, own: str, by_year: Mapping[str, Sequence[Entry]]) -> bytes:
    """Return the page of a year of a station, with links to its other years with data."""
    page, entries = year_page(key, own), by_year[own]
    return _render(
        "year.html",
        page,
        key=key,
        place=entries[0].place,
        year=own,
        entries=entries,
        trail=[("Archive", href(INDEX, page))],
        years=list(by_year),
    )


def _weeks(month: str, days_: ByDay) -> list[list[tuple[date, Sequence[Entry]]]]:
    """Return the days of a month, such as ``2024-09``, by week, with their products."""
    weeks = calendar.Calendar().monthdatescalendar(int(month[:4]), int(month[5:]))
    return [[(date_, days_.get(date_.isoformat(), ())) for date_ in week] for week in weeks]


def day(key: str, day_: str, by_day: ByDay, before: str | None, after: str | None) -> bytes:
    """Return the page of a day of a station, with links to the previous and next day with data."""
    page = day_page(key, day_)
    entries = sorted(by_day[day_], key=_order)
    share = mean_availability(entries)
    mean = "" if share is None else f"; {percent(share)} of profiles usable"
    return _render(
        "day.html",
        page,
        key=key,
        place=entries[0].place,
        day=day_,
        lead=f"{counted(len(entries), 'product')}{mean}",
        trail=_trail(entries[0], page),
        before=before,
        after=after,
        days=by_day,
        instruments=grouped(entries, "instrument"),
        named=_named,
    )
