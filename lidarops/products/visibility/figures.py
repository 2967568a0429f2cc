"""The figures of the ``visibility`` product: series at crossings, and a map of beams."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import xarray as xr

from lidarops.figures.kind_figures import Drawn, KindFigures, PageFigures
from lidarops.figures.svg_series import Quantity, stacked_page
from lidarops.products.visibility.figure_data import read_crossings, read_map
from lidarops.products.visibility.svg_map import draw_network_map


def _page(product: xr.Dataset) -> PageFigures:
    quantities = (Quantity("visibility", 1.0, "km"), Quantity("extinction", 1e3, "km⁻¹"))
    title = "Visibility and extinction at the crossings"
    page = stacked_page(read_crossings(product), quantities, title)
    sheet, words = draw_network_map(read_map(product))
    plan = Drawn.of(sheet, "Map of beams and crossings", words, "map")
    return replace(page, figures=(*page.figures, plan))


FIGURES: Final = KindFigures(page=_page, preferred="visibility_in_air")
