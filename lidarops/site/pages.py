"""The pages of the site as HTML."""

from __future__ import annotations

import calendar
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from functools import cache
from importlib.resources import files
from itertools import groupby
from typing import Any, Final

import xarray as xr
from markupsafe import Markup

from lidarops import __version__
from lidarops.figures import browser
from lidarops.figures.panels import Figure
from lidarops.figures.product_names import UNKNOWN
from lidarops.figures.templates import environment, page_style
from lidarops.figures.wording import counted, percent, size, verdicts_in_words
from lidarops.kinds import kinds, rank_of
from lidarops.netcdf.variables import is_retrieved
from lidarops.site.links import Links
from lidarops.site.neighbours import Neighbours
from lidarops.site.paths import day_page, href, month_list, slug, year_page
from lidarops.site.product_contents import Origin, QualityCounts, citation, contact, variables
from lidarops.site.product_entry import Entry, Problem, ShareGrade, mean_availability
from lidarops.site.station_map import Place, station_map
from lidarops.site.values import ValueRow

INDEX: Final = "index.html"
INPUTS: Final = 40
"""Most input files that a page lists."""
_YEARS: Final = 48
"""Most years on the first page with a table of months; beyond, stations link to years."""
_PROBLEMS: Final = 200
_LATEST: Final = 6
_NAVIGATION: Final = (b"<!-- navigation -->", b"<!-- /navigation -->")
"""Ends of the part of a product page that does not follow from the product."""
_FILTERED: Final = 16
"""Most kinds that can be chosen on a page of a day."""

ByDay = Mapping[str, Sequence[Entry]]


@cache
def style() -> str:
    """Return the style sheet of the site."""
    own = files("lidarops.site").joinpath("templates", "site.css").read_text(encoding="utf-8")
    return page_style() + own


def _render(template: str, page: str, **context: Any) -> bytes:
    root = "../" * page.count("/")
    page_of = environment("lidarops.site").get_template(template)
    text = page_of.render(root=root, version=__version__, counted=counted, **context)
    return text.encode("utf-8", "replace")


def product(
    entry: Entry,
    opened: xr.Dataset,
    quality: QualityCounts,
    origin: Origin,
    figures: Sequence[tuple[Figure, Markup]],
    values: Sequence[ValueRow],
) -> bytes:
    """Return the page of a product; it depends only on the product and its path."""
    page = entry.page
    file = entry.path.rsplit("/", 1)[-1]
    summary = [
        ("Title", str(opened.attrs.get("title", "not stated"))),
        ("Station", _named(entry.place, entry.station)),
        ("Instrument", _named(entry.name, entry.instrument)),
        ("Kind", entry.kind),
        ("Channel", entry.label),
        ("Data", _span(entry)),
        ("File", file),
        ("Size", f"{size(entry.size)} ({entry.size:,} bytes)"),
    ]
    return _render(
        "product.html",
        page,
        heading=f"{_about(entry.kind, 'Product of kind')}, {entry.light or entry.channel}",
        lead=f"{entry.place}; {entry.name}; {_span(entry)}",
        trail=[*_trail(entry, page), (entry.day, href(day_page(entry.station, entry.day), page))],
        file=file,
        sha256=entry.sha256,
        problem=entry.problem,
        lacking=entry.lacking,
        summary=summary,
        figures=[(markup, figure.text) for figure, markup in figures],
        quality=quality,
        grade=entry.grade,
        quality_text=_quality(entry),
        origin=origin,
        values=values,
        citation=citation(opened),
        license=entry.license,
        contact=contact(opened),
        references=str(opened.attrs.get("references", "")).splitlines(),
        variables=variables(opened),
        attributes=[(str(name), str(value)) for name, value in opened.attrs.items()],
        most=INPUTS,
    )


def navigation(entry: Entry, neighbours: Neighbours, links: Links) -> bytes:
    """Return the part of a product page that leads to its file and to other products."""
    page = entry.page
    ends = [
        None
        if other is None
        else {"href": href(other.page, page), "words": f"{_clock(other.start)} UTC"}
        for other in (neighbours.before, neighbours.after)
    ]
    beside = [
        {
            "href": href(other.page, page),
            "words": f"{_about(other.kind, 'Kind')}, {other.light or other.channel}",
        }
        for other in neighbours.siblings
    ]
    module = environment("lidarops.site").get_template("navigation.html")
    text = module.render(
        download=links.product(entry, page),
        file=entry.path.rsplit("/", 1)[-1],
        size=size(entry.size),
        stac=links.stac(entry, page),
        before=ends[0],
        after=ends[1],
        siblings=beside,
    )
    return text.encode("utf-8", "replace")


def with_navigation(page: bytes, part: bytes) -> bytes:
    """Return a product page with another part of `navigation`."""
    head, first, rest = page.partition(_NAVIGATION[0])
    _, last, tail = rest.partition(_NAVIGATION[1])
    return b"".join((head, first, b"\n", part, b"\n", last, tail))


def _about(kind: str, other: str) -> str:
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
    year = int(entry.day[:4])
    return [
        ("Archive", href(INDEX, page)),
        (f"{entry.place} {year}", href(year_page(entry.station, year), page)),
    ]


def _quality(entry: Entry) -> str:
    if not entry.values:
        return "no quality flags"
    return f"{verdicts_in_words(entry.verdicts)} of {entry.values:,} values"


def _card(entry: Entry, page: str, *, place: bool) -> dict[str, Any]:
    spans = f"{_clock(entry.start)[11:]} to {_clock(entry.stop)[11:]} UTC"
    where = f"{entry.place}, {entry.day}, {spans}" if place else spans
    return {
        "thumbnail": href(entry.thumbnail, page),
        "alt": entry.alt,
        "href": href(entry.page, page),
        "title": _about(entry.kind, "Kind"),
        "light": entry.light or entry.channel,
        "where": where,
        "grade": entry.grade,
        "quality": verdicts_in_words(entry.verdicts) if entry.values else "",
        "lacking": entry.lacking,
        "problem": entry.problem,
    }


def _order(entry: Entry) -> tuple[Any, ...]:
    """Return the place of a product on the page of a day: signals, then what is retrieved."""
    kind = is_retrieved(entry.kind), rank_of(entry.kind), entry.kind
    return entry.instrument, *kind, entry.channel, entry.start, entry.path


def _cell(share: float | None) -> dict[str, Any]:
    """Return what a day or month shows: the share of usable profiles, and its grade."""
    if share is None:
        return {"share": "", "of": "", "grade": ShareGrade.UNKNOWN}
    return {"share": _short(share), "of": " of profiles usable", "grade": ShareGrade.of(share)}


def _short(share: float) -> str:
    """Return a share in whole percent; only exact 0 and 1 become 0 % and 100 %."""
    whole = round(100 * share)
    if whole in (0, 100) and share not in (0.0, 1.0):
        return "<1 %" if whole == 0 else ">99 %"
    return f"{whole} %"


def _by(entries: Iterable[Entry], key: Callable[[Entry], str]) -> dict[str, list[Entry]]:
    groups: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        groups[key(entry)].append(entry)
    return dict(sorted(groups.items()))


def stations(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """Return the entries by station."""
    return _by(entries, lambda entry: entry.station)


def years(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """Return the entries by year."""
    return _by(entries, lambda entry: entry.day[:4])


def months(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """Return the entries by month, such as ``2024-09``."""
    return _by(entries, lambda entry: entry.day[:7])


def tabs(entries: Iterable[Entry]) -> list[str]:
    """Return the kinds of products in the order of their rank, after an empty one for all."""
    kinds_ = sorted({entry.kind for entry in entries}, key=lambda kind: (rank_of(kind), kind))
    return ["", *kinds_]


def days(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """Return the entries by day."""
    return _by(entries, lambda entry: entry.day)


def index(
    entries: Sequence[Entry],
    problems: Sequence[Problem],
    campaigns: Sequence[str],
    links: Links,
    below: float,
) -> bytes:
    """Return the first page. `below` is the height of the calendar above the station, m."""
    by_station = stations(entries)
    rows = sum(len(years(group)) for group in by_station.values())
    title = f"Lidar archive: {'; '.join(campaigns[:3])}" if campaigns else "Lidar archive"
    newest = sorted(entries, key=lambda entry: (entry.start, entry.path), reverse=True)
    retrieved = [e for e in newest if is_retrieved(e.kind) and not e.lacking] or newest
    return _render(
        "index.html",
        INDEX,
        title=title,
        lead=_index_lead(entries, by_station),
        trail=[],
        grades=list(ShareGrade),
        below=f"{below / 1e3:g} km",
        map=browser.inline(station_map(places)) if (places := _places(by_station)) else "",
        stac=links.catalog(INDEX),
        report=links.report(INDEX),
        licenses=sorted({entry.license for entry in entries if entry.license}),
        stations=[_station(key, group, matrix=rows <= _YEARS) for key, group in by_station.items()],
        latest=[_card(entry, INDEX, place=True) for entry in retrieved[:_LATEST]],
        problems=problems,
        files=len({*(entry.path for entry in entries), *(item.path for item in problems)}),
        most=_PROBLEMS,
    )


def _index_lead(entries: Sequence[Entry], by_station: Mapping[str, Sequence[Entry]]) -> str:
    if not entries:
        return "No product could be read."
    first, last = (end(entry.day for entry in entries) for end in (min, max))
    return (
        f"{counted(len(entries), 'product')} of {counted(len(by_station), 'station')},"
        f" {size(sum(entry.size for entry in entries))}, from {first} to {last}"
    )


def _station(key: str, entries: Sequence[Entry], *, matrix: bool) -> dict[str, Any]:
    by_year = years(entries)
    links = [{"year": year, "href": href(year_page(key, int(year)), INDEX)} for year in by_year]
    instruments = sorted({entry.name for entry in entries})
    return {
        "anchor": f"s-{slug(key)}",
        "name": entries[0].place,
        "about": f"{counted(len(entries), 'product')}; {'; '.join(instruments[:6])}",
        "position": _position(entries[0]),
        "links": links,
        "years": [
            link | {"cells": _months(group)}
            for link, group in zip(links, by_year.values(), strict=True)
        ]
        if matrix
        else [],
    }


def _places(by_station: Mapping[str, Sequence[Entry]]) -> list[Place]:
    return [
        Place(first.place, first.latitude, first.longitude)
        for first, *_ in by_station.values()
        if first.latitude is not None and first.longitude is not None
    ]


def _position(entry: Entry) -> str:
    """Return the position of a station in words; empty if unknown."""
    if entry.latitude is None or entry.longitude is None:
        return ""
    north, east = "NS"[entry.latitude < 0], "EW"[entry.longitude < 0]
    words = f"{abs(entry.latitude):.5g}° {north}, {abs(entry.longitude):.6g}° {east}"
    return words if entry.altitude is None else f"{words}, {entry.altitude:.4g} m"


def _months(entries: Sequence[Entry]) -> list[dict[str, Any] | None]:
    cells: list[dict[str, Any] | None] = [None] * 12
    for month, group in _by(entries, lambda entry: entry.day[5:7]).items():
        number = int(month)
        cells[number - 1] = {
            "number": number,
            "name": calendar.month_abbr[number],
            "label": f"{calendar.month_name[number]} {group[0].day[:4]}",
            "days": len({entry.day for entry in group}),
            **_cell(mean_availability(group)),
        }
    return cells


def year(
    key: str, number: int, entries: Sequence[Entry], all_years: Sequence[str], kind: str = ""
) -> bytes:
    """Return the page of a year of a station, of all kinds of product or of one.

    `all_years` are those with data; `entries` are of all kinds.
    """
    page = year_page(key, number, kind)
    of_kind = [entry for entry in entries if kind in ("", entry.kind)]
    by_day = days(of_kind)
    by_month = months(of_kind)
    return _render(
        "year.html",
        page,
        place=entries[0].place,
        year=number,
        lead=f"{counted(len(of_kind), 'product')} of {counted(len(by_day), 'day')}",
        kind=_about(kind, "Kind") if kind else "",
        tabs=[
            (
                _about(tab, "Kind") if tab else "All kinds",
                "" if tab == kind else href(year_page(key, number, tab), page),
            )
            for tab in tabs(entries)
        ],
        trail=[("Archive", href(INDEX, page))],
        others=[
            (other, "" if int(other) == number else href(year_page(key, int(other)), page))
            for other in all_years
        ]
        if len(all_years) > 1
        else [],
        grades=list(ShareGrade),
        weekdays=calendar.day_name[:],
        months=[
            {
                "number": int(month[5:]),
                "name": calendar.month_name[int(month[5:])],
                "files": href(month_list(key, month), page),
                "about": f"{counted(len(group), 'file')},"
                f" {size(sum(entry.size for entry in group))}",
                "weeks": _weeks(key, month, by_day, page),
            }
            for month, group in by_month.items()
        ],
    )


def _weeks(key: str, month: str, by_day: ByDay, page: str) -> list[list[dict[str, Any]]]:
    """Return the days of a month by week."""
    year_, number = int(month[:4]), int(month[5:])
    return [
        [_day(key, date_, number, by_day, page) for date_ in week]
        for week in calendar.Calendar().monthdatescalendar(year_, number)
    ]


def _day(key: str, date_: date, month: int, by_day: ByDay, page: str) -> dict[str, Any]:
    if date_.month != month:
        return {"href": "", "number": 0}
    entries = by_day.get(date_.isoformat(), ())
    if not entries:
        return {"href": "", "number": date_.day}
    return {
        "href": href(day_page(key, date_.isoformat()), page),
        "number": date_.day,
        "words": f", {counted(len(entries), 'product')}",
        **_cell(mean_availability(entries)),
    }


def day(key: str, day_: str, by_day: ByDay, before: str | None, after: str | None) -> bytes:
    """Return the page of a day of a station, with links to the previous and next day with data."""
    page = day_page(key, day_)
    entries = by_day[day_]
    shown_kinds = tabs(entries)[1:]
    ordered = sorted(entries, key=_order)
    share = mean_availability(entries)
    mean = "" if share is None else f"; {percent(share)} of profiles usable"

    def beside(other: str | None) -> tuple[str, str] | None:
        return None if other is None else (other, href(day_page(key, other), page))

    return _render(
        "day.html",
        page,
        place=entries[0].place,
        day=day_,
        lead=f"{counted(len(entries), 'product')}{mean}",
        trail=_trail(entries[0], page),
        before=beside(before),
        after=beside(after),
        month=f"{calendar.month_name[int(day_[5:7])]} {day_[:4]}",
        weeks=_weeks(key, day_[:7], by_day, page),
        weekdays=calendar.day_name[:],
        grades=[grade for grade in ShareGrade if any(entry.grade is grade for entry in entries)],
        kinds=[_about(kind, "Kind") for kind in shown_kinds[:_FILTERED]],
        instruments=[
            _instrument(list(group), shown_kinds, page)
            for _, group in groupby(ordered, key=lambda entry: entry.instrument)
        ],
    )


def _instrument(entries: Sequence[Entry], shown_kinds: Sequence[str], page: str) -> dict[str, Any]:
    """Return an instrument: its products of a day by kind, and those without usable value."""
    return {
        "name": _named(entries[0].name, entries[0].instrument),
        "kinds": [
            (
                shown_kinds.index(kind),
                _about(kind, "Kind"),
                [_card(entry, page, place=False) for entry in rows],
            )
            for kind, rows in groupby(
                (entry for entry in entries if not entry.lacking), key=lambda entry: entry.kind
            )
        ],
        "lacking": [
            (shown_kinds.index(entry.kind), _card(entry, page, place=False))
            for entry in entries
            if entry.lacking
        ],
    }
