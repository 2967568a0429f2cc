"""The figures of the ``homogeneous`` product: extinction and background of sections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import xarray as xr

from lidarops.figures.kind_figures import KindFigures, ProductSource, View
from lidarops.figures.panels import Figure, units
from lidarops.figures.series_data import Comparison, Section, compare, join
from lidarops.figures.series_panels import Quantity, score_figures, series_figures
from lidarops.products.homogeneous.figure_data import QUANTITIES, SECTION_VARIABLES, read_sections
from lidarops.records import Role


def _read(product: xr.Dataset, source: ProductSource) -> list[Section] | None:
    scene = source.scene
    steps = scene.plan.steps if scene and scene.plan else ()
    sections = read_sections(
        product,
        source.truth,
        instrument=source.instrument,
        channel=source.channel,
        paths=[item.path for item in scene.inputs if item.role is Role.SIGNAL] if scene else (),
        dark_subtracted=any(
            step.name == "dark" and step.channel == source.channel for step in steps
        ),
    )
    return [section for section in sections if section.time.size] or None


def _sections(contents: Sequence[list[Section]]) -> list[Section]:
    return join(section for sections in contents for section in sections)


def _draw(contents: Sequence[list[Section]]) -> Iterator[Figure]:
    sections = _sections(contents)
    background = units(sections[0].estimates["background"].units)
    quantities = (
        Quantity("total_extinction", 1e3, "km⁻¹"),
        Quantity("background", 1.0, background),
    )
    yield from series_figures(sections, quantities, "Extinction and background of range sections")
    yield from score_figures(sections, QUANTITIES)


def _compare(contents: Sequence[list[Section]]) -> Iterator[Comparison | None]:
    for section in _sections(contents):
        yield from (compare(section, quantity) for quantity in QUANTITIES)


FIGURES: Final = KindFigures(
    (View("homogeneous", SECTION_VARIABLES, _read, _draw, _compare),),
    preferred="total_extinction",
    values=(Quantity("total_extinction", 1e3, "km⁻¹"),),
)
