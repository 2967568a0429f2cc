"""What a kind of product states about its figures, and how views find it.

A kind has up to two modules for figures. Its module ``figures`` holds `KindFigures` by the name
``FIGURES``, for the site. Its module ``report_figures`` holds `ReportFigures` by the name
``REPORT``, for reports; it is apart because it needs matplotlib. Products of other kinds are drawn
by `lidarops.figures.any_kind`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import xarray as xr
from markupsafe import Markup

from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.svg import THUMB, Sheet
from lidarops.kinds import kinds


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure of a page."""

    caption: str
    figure: Markup

    @classmethod
    def of(cls, sheet: Sheet, caption: str, words: str, key: str) -> Drawn:
        """Return a figure with its caption, a description, and a key that is unique on a page."""
        text = f"{caption}. {words}."
        return cls(text, sheet.svg(key, text))


@dataclass(frozen=True, slots=True)
class PageFigures:
    """The figures of the page of a product."""

    figures: tuple[Drawn, ...]
    thumbnail: Sheet
    alt: str
    """Description of the thumbnail."""


def no_figures(words: str) -> PageFigures:
    """Return a page without figures, with the reason as thumbnail."""
    width, height = THUMB
    sheet = Sheet(height=height, width=width)
    sheet.text(width / 2, height / 2 + 5, words, css="t m")
    return PageFigures((), sheet, f"No figure: {words}")


@dataclass(frozen=True, slots=True)
class KindFigures:
    """Figures of a kind of product on pages."""

    page: Callable[[xr.Dataset], PageFigures]
    """Draws an open product, which may be lazy. Raises `ProductError` if it is of another kind."""
    preferred: str
    """Variable for an overview of any product that has it."""


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure of a report, to be drawn with matplotlib."""

    name: str
    """Start of its file name."""
    caption: str
    draw: Callable[..., Any]
    """Called with `content` and ``title``; returns a `matplotlib.figure.Figure`. It is sent to
    another process, so it must be possible to pickle it."""
    content: Any


@dataclass(frozen=True, slots=True)
class ReportFigures:
    """Figures of a kind of product in reports."""

    figures: Callable[[Group, Sources], Iterator[ReportFigure]]
    """Yields the figures of a group of products."""
    compares: bool = False
    """Whether it notes comparisons with the truth, before it yields the first figure."""


def figures_of(kind: str) -> KindFigures | None:
    """Return how pages show a kind of product; None if the kind is unknown or does not state it."""
    known = kinds().get(kind)
    return known.optional_part("figures", "FIGURES") if known else None


def report_figures_of(kind: str) -> ReportFigures | None:
    """Return how reports show a kind of product; None as `figures_of`."""
    known = kinds().get(kind)
    return known.optional_part("report_figures", "REPORT") if known else None


def preferred_variables() -> tuple[str, ...]:
    """Return the preferred variables of all kinds, in the order of their rank."""
    known = (figures_of(kind) for kind in kinds())
    return tuple(dict.fromkeys(figures.preferred for figures in known if figures is not None))
