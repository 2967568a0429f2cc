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

from lidarops import __version__
from lidarops.figures import svg
from lidarops.figures.panels import Figure
from lidarops.figures.templates import environment
from lidarops.figures.wording import counted, percent, size
from lidarops.kinds import kinds, rank_of
from lidarops.netcdf.variables import is_retrieved
from lidarops.site.paths import day_page, href, slug, year_page
from lidarops.site.product_contents import Origin, QualityCounts, variables
from lidarops.site.product_entry import UNKNOWN, Entry, Grade, Problem, mean_share

INDEX: Final = "index.html"
ROWS: Final = 2000
"""Most rows of a table on a page."""
_YEARS: Final = 48
"""Most years on the first page with a table of months; beyond, stations link to years."""
_PROBLEMS: Final = 200
_LATEST: Final = 6

ByDay = Mapping[str, Sequence[Entry]]


@cache
def style() -> str:
    """Return the style sheet of the site, with that of figures."""
    own = files("lidarops.site").joinpath("templates", "site.css").read_text(encoding="utf-8")
    return svg.style() + own


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
    figures: Sequence[Figure],
) -> bytes:
    """Return the page of a product; it depends only on the product and its path."""
    page = entry.page
    file = entry.path.rsplit("/", 1)[-1]
    summary = [
        ("Title", str(opened.attrs.get("title", "not stated"))),
        ("Station", _named(entry.place, entry.station)),
        ("Instrument", entry.instrument),
        ("Kind", entry.kind),
        ("Channel", entry.channel),
        ("Data", f"{_clock(entry.start)} to {_clock(entry.stop)} UTC"),
        ("Size", f"{size(entry.size)} ({entry.size:,} bytes)"),
    ]
    return _render(
        "product.html",
        page,
        heading=f"{_about(entry.kind, 'Product of kind')}, {entry.channel}",
        lead=f"{entry.place}, {entry.instrument}, {_clock(entry.start)} to"
        f" {_clock(entry.stop)} UTC",
        trail=[*_trail(entry, page), (entry.day, href(day_page(entry.station, entry.day), page))],
        download=href(f"../products/{entry.path}", page),
        file=file,
        size=size(entry.size),
        sha256=entry.sha256,
        problem=entry.problem,
        summary=summary,
        figures=[(svg.inline(figure), figure.text) for figure in figures],
        quality=quality,
        grade=entry.grade,
        quality_text=_quality(entry),
        origin=origin,
        prov=href(entry.files[2], page),
        variables=variables(opened),
        attributes=[(str(name), str(value)) for name, value in opened.attrs.items()],
        most=ROWS,
    )


def _about(kind: str, other: str) -> str:
    """Return the heading of products of a kind; before the name of an unknown one, `other`."""
    if kind == UNKNOWN:
        return "Products of unknown kind"
    known = kinds().get(kind)
    return known.title if known else f"{other} {kind}"


def _named(place: str, key: str) -> str:
    return place if place == key else f"{place} ({key})"


def _clock(moment: str) -> str:
    return moment.replace("T", " ")[:16]


def _trail(entry: Entry, page: str) -> list[tuple[str, str]]:
    year = int(entry.day[:4])
    return [
        ("Archive", href(INDEX, page)),
        (f"{entry.place} {year}", href(year_page(entry.station, year), page)),
    ]


def _quality(entry: Entry) -> str:
    if entry.share is None:
        return "no quality flags"
    flagged = percent((entry.values - entry.unflagged) / entry.values)
    return f"{percent(entry.share)} of {entry.values:,} values usable, {flagged} flagged"


def _card(entry: Entry, page: str, *, place: bool) -> dict[str, Any]:
    spans = f"{_clock(entry.start)[11:]} to {_clock(entry.stop)[11:]} UTC"
    where = f"{entry.place}, {entry.day}, {spans}" if place else spans
    share = entry.share
    return {
        "thumbnail": href(entry.thumbnail, page),
        "alt": entry.alt,
        "href": href(entry.page, page),
        "kind": entry.kind,
        "channel": entry.channel,
        "where": where,
        "grade": entry.grade,
        "quality": "" if share is None else f"{percent(share)} usable",
        "problem": entry.problem,
    }


def _order(entry: Entry) -> tuple[Any, ...]:
    rank = rank_of(entry.kind)
    return entry.instrument, rank, entry.kind, entry.channel, entry.start, entry.path


def _short(share: float | None) -> str:
    """Return a share in whole percent; only exact 0 and 1 become 0 % and 100 %."""
    if share is None:
        return ""
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


def days(entries: Iterable[Entry]) -> dict[str, list[Entry]]:
    """Return the entries by day."""
    return _by(entries, lambda entry: entry.day)


def index(entries: Sequence[Entry], problems: Sequence[Problem], campaigns: Sequence[str]) -> bytes:
    """Return the first page."""
    by_station = stations(entries)
    rows = sum(len(years(group)) for group in by_station.values())
    title = f"Lidar archive: {', '.join(campaigns[:3])}" if campaigns else "Lidar archive"
    newest = sorted(entries, key=lambda entry: (entry.start, entry.path), reverse=True)
    retrieved = [entry for entry in newest if is_retrieved(entry.kind)] or newest
    return _render(
        "index.html",
        INDEX,
        title=title,
        lead=_index_lead(entries, by_station),
        trail=[],
        grades=list(Grade),
        months=calendar.month_name[1:],
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
    instruments = sorted({entry.instrument for entry in entries})
    return {
        "anchor": f"s-{slug(key)}",
        "name": entries[0].place,
        "about": f"{counted(len(entries), 'product')}, {', '.join(instruments[:6])}",
        "links": links,
        "years": [
            link | {"cells": _months(group)}
            for link, group in zip(links, by_year.values(), strict=True)
        ]
        if matrix
        else [],
    }


def _months(entries: Sequence[Entry]) -> list[dict[str, Any] | None]:
    cells: list[dict[str, Any] | None] = [None] * 12
    for month, group in _by(entries, lambda entry: entry.day[5:7]).items():
        share = mean_share(group)
        number = int(month)
        cells[number - 1] = {
            "number": number,
            "label": f"{calendar.month_name[number]} {group[0].day[:4]}",
            "days": len({entry.day for entry in group}),
            "share": _short(share),
            "grade": Grade.of(share),
        }
    return cells


def year(key: str, number: int, entries: Sequence[Entry], all_years: Sequence[str]) -> bytes:
    """Return the page of a year of a station; `all_years` are those with data."""
    page = year_page(key, number)
    by_day = days(entries)
    months = sorted({int(day[5:7]) for day in by_day})
    weeks = calendar.Calendar()
    return _render(
        "year.html",
        page,
        place=entries[0].place,
        year=number,
        lead=f"{counted(len(entries), 'product')} of {counted(len(by_day), 'day')}",
        trail=[("Archive", href(INDEX, page))],
        others=[
            (other, "" if int(other) == number else href(year_page(key, int(other)), page))
            for other in all_years
        ]
        if len(all_years) > 1
        else [],
        grades=list(Grade),
        weekdays=calendar.day_name[:],
        months=[
            {
                "number": month,
                "name": calendar.month_name[month],
                "weeks": [
                    [_day(key, date_, month, by_day, page) for date_ in week]
                    for week in weeks.monthdatescalendar(number, month)
                ],
            }
            for month in months
        ],
    )


def _day(key: str, date_: date, month: int, by_day: ByDay, page: str) -> dict[str, Any]:
    if date_.month != month:
        return {"href": "", "number": 0}
    entries = by_day.get(date_.isoformat(), ())
    if not entries:
        return {"href": "", "number": date_.day}
    share = mean_share(entries)
    return {
        "href": href(day_page(key, date_.isoformat()), page),
        "number": date_.day,
        "share": _short(share),
        "grade": Grade.of(share),
        "words": f" usable, {counted(len(entries), 'product')}",
    }


def day(
    key: str, day_: str, entries: Sequence[Entry], before: str | None, after: str | None
) -> bytes:
    """Return the page of a day of a station, with links to the previous and next day with data."""
    page = day_page(key, day_)
    ordered = sorted(entries, key=_order)
    share = mean_share(entries)
    mean = "" if share is None else f", on average {percent(share)} of values usable"

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
        instruments=[
            (
                instrument,
                [
                    (
                        _about(kind, "Kind"),
                        [_card(entry, page, place=False) for entry in rows],
                    )
                    for kind, rows in groupby(group, key=lambda entry: entry.kind)
                ],
            )
            for instrument, group in groupby(ordered, key=lambda entry: entry.instrument)
        ],
    )
