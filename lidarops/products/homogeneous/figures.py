"""The figures of the ``homogeneous`` product: extinction and background of sections."""

from __future__ import annotations

from typing import Final

import xarray as xr

from lidarops.figures import svg
from lidarops.figures.kind_figures import KindFigures, PageFigures, no_figures
from lidarops.figures.series_data import join
from lidarops.figures.svg_series import Quantity, stacked_page
from lidarops.products.homogeneous.figure_data import read_sections


def _page(product: xr.Dataset) -> PageFigures:
    sections = [section for section in join(read_sections(product)) if section.time.size]
    if not sections:
        return no_figures("no profile")
    units = svg.units(sections[0].estimates["background"].units)
    quantities = (Quantity("extinction", 1e3, "km⁻¹"), Quantity("background", 1.0, units))
    return stacked_page(sections, quantities, "Extinction and background of range sections")


FIGURES: Final = KindFigures(page=_page, preferred="extinction")
