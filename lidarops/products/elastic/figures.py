"""The figures of the ``elastic`` product: an image of backscatter, and a profile with errors."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures import svg
from lidarops.figures import svg_profiles as profiles
from lidarops.figures.kind_figures import Drawn, KindFigures, PageFigures
from lidarops.figures.kind_images import KindImage
from lidarops.figures.raster import raster_variables, read_raster
from lidarops.figures.svg import LEFT, Sheet
from lidarops.figures.wording import utc
from lidarops.products.elastic.figure_data import Profile, clearest_profile

Floats = NDArray[np.float64]

_CAUSES: Final = {
    "noise": "noise",
    "background": "background",
    "reference": "reference",
    "lidar_ratio": "lidar ratio",
    "molecular": "molecules",
}
_QUANTITY: Final = "attenuated_backscatter"
IMAGE: Final = KindImage(
    raster_variables(_QUANTITY),
    partial(read_raster, quantity=_QUANTITY, kind="elastic"),
    "attenuated backscatter",
)


def _page(product: xr.Dataset) -> PageFigures:
    page = IMAGE.page(product)
    profile = clearest_profile(product)
    if profile is None:
        return page
    sheet, words = _error_budget(profile, "f2")
    caption = f"Profile at {utc(profile.time)} (most unflagged bins) and its error budget"
    return replace(page, figures=(*page.figures, Drawn.of(sheet, caption, words, "f2")))


FIGURES: Final = KindFigures(page=_page, preferred="backscatter")


def _error_budget(profile: Profile, key: str) -> tuple[Sheet, str]:
    """Draw a backscatter profile with its standard error, and its error budget."""
    sheet = Sheet(height=profiles.HEIGHT)
    y = profile.range / 1e3
    value, error, molecular = (
        1e6 * part for part in (profile.backscatter, profile.standard_error, profile.molecular)
    )
    causes = {name: 1e6 * part for name, part in profile.budget.items()}
    spans = (
        profiles.span([value - error, value + error, molecular]),
        profiles.decades([*causes.values(), error]),
    )
    left, right = profiles.panels(y, spans, log=True)
    up = left.y(y)

    def draw_values() -> None:
        low, high = left.x(value - error), left.x(value + error)
        sheet.path(svg.band(up, low, high, upright=True), "band c0")
        sheet.path(svg.line(left.x(value), up), "line c0")
        sheet.path(svg.line(left.x(molecular), up), "line d2 c1")

    def draw_causes() -> None:
        for number, part in enumerate(causes.values()):
            sheet.path(svg.line(right.x(_positive(part)), up), f"line d{number} c{number}")
        sheet.path(svg.line(right.x(_positive(error)), up), "line ink")

    unit = "10⁻⁶ m⁻¹ sr⁻¹"
    sheet.frame(left, "range (km)", below=f"backscatter ({unit})")
    sheet.frame(right, "", below=f"error of backscatter ({unit})")
    sheet.clipped(left, draw_values, f"{key}-p")
    sheet.clipped(right, draw_causes, f"{key}-p")
    named = [("M-9 0H9", "line c0", "particles"), ("M-9 0H9", "line d2 c1", "molecules")]
    svg.draw_legend(sheet, LEFT + 14, 20, named)
    rows = [("M-9 0H9", f"line d{n} c{n}", _CAUSES[name]) for n, name in enumerate(causes)]
    svg.draw_legend(sheet, LEFT + 330, 20, [*rows, ("M-9 0H9", "line ink", "total")])
    bottom, top = (f"{edge / 1e3:.3g}" for edge in profile.reference)
    good = value[np.isfinite(value)]
    reach = f"{svg.number(float(good.min()))} to {svg.number(float(good.max()))} {unit}"
    return sheet, (
        f"Particle backscatter {reach}, lidar ratio {profile.lidar_ratio:g} sr, reference"
        f" window {bottom} to {top} km; the band is the standard error"
    )


def _positive(values: Floats) -> Floats:
    return np.where(values > 0, values, np.nan)
