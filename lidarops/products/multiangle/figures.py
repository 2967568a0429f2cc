"""The figures of the ``multiangle`` product: an image of extinction, and one scan cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures import svg
from lidarops.figures import svg_profiles as profiles
from lidarops.figures.kind_figures import Drawn, KindFigures, PageFigures
from lidarops.figures.kind_images import KindImage
from lidarops.figures.svg import LEFT, Sheet, SvgPanel
from lidarops.figures.wording import utc
from lidarops.products.multiangle.figure_data import (
    EXTINCTION_VARIABLES,
    QUANTITIES,
    ScanProfile,
    clearest_cycle,
    read_extinction,
)

Floats = NDArray[np.float64]

_MARKS: Final = 120
"""Most marks of flagged values."""
IMAGE: Final = KindImage(EXTINCTION_VARIABLES, read_extinction, "extinction", along="altitude")


def _page(product: xr.Dataset) -> PageFigures:
    page = IMAGE.page(product)
    profile = clearest_cycle(product)
    if profile is None:
        return page
    sheet, words = _cycle(profile, "f2")
    caption = f"Scan cycle at {utc(profile.time)} (most unflagged values)"
    return replace(page, figures=(*page.figures, Drawn.of(sheet, caption, words, "f2")))


FIGURES: Final = KindFigures(page=_page, preferred="optical_depth")


def _cycle(profile: ScanProfile, key: str) -> tuple[Sheet, str]:
    """Draw optical depth and extinction of one scan cycle against altitude."""
    sheet = Sheet(height=profiles.HEIGHT)
    y = profile.altitude / 1e3
    factors = {"optical_depth": 1.0, "extinction": 1e3}
    shown = {}
    for name in QUANTITIES:
        estimate = profile.estimates[name]
        shown[name] = [
            factors[name] * part
            for part in (
                estimate.value,
                estimate.standard_error,
                estimate.standard_error + np.nan_to_num(estimate.gradient_error),
                estimate.rejected,
            )
        ]
    spans = [profiles.span([value - error, value + error]) for value, error, _, _ in shown.values()]
    panels = profiles.panels(y, spans, log=False)
    labels = ("optical depth", "extinction (km⁻¹)")
    for number, (panel, label, parts) in enumerate(
        zip(panels, labels, shown.values(), strict=True)
    ):
        sheet.frame(panel, "" if number else "altitude (km)", below=label)
        _estimate(sheet, panel, panel.y(y), parts, f"{key}-s{number}")
    named = [("M-9 0H9", "line c0", "retrieved, with standard error")]
    wide = ("M-9-4H9V4H-9z", "band wide c0", "plus largest error from a horizontal gradient")
    svg.draw_legend(sheet, LEFT + 14, 20, [*named, wide, (svg.cross(0, 0), "off", "rejected")])
    value = shown["extinction"][0]
    good = value[np.isfinite(value)]
    reach = (
        f"{svg.number(float(good.min()))} to {svg.number(float(good.max()))} km⁻¹"
        if good.size
        else "no usable value"
    )
    flagged = int((profile.flag != 0).sum())
    return sheet, f"Extinction {reach}; {flagged} of {profile.flag.size} altitudes flagged"


def _estimate(sheet: Sheet, panel: SvgPanel, up: Floats, parts: Sequence[Floats], key: str) -> None:
    value, error, wide, rejected = parts

    def draw() -> None:
        for width, css in ((wide, "band wide c0"), (error, "band c0")):
            low, high = panel.x(value - width), panel.x(value + width)
            sheet.path(svg.band(up, low, high, upright=True), css)
        sheet.path(svg.line(panel.x(value), up), "line c0")
        some = slice(None, None, max(1, -(-rejected.size // _MARKS)))
        sheet.path(svg.marks(panel.x(rejected[some]), up[some], svg.cross), "off")

    sheet.clipped(panel, draw, key)
