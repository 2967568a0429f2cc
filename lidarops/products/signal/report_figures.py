"""The figures of the ``signal`` product in reports."""

from __future__ import annotations

from functools import partial
from typing import Final

from lidarops.figures.kind_figures import ReportFigures
from lidarops.figures.product_figures import image_figures
from lidarops.products.signal.figures import IMAGE

REPORT: Final = ReportFigures(
    partial(image_figures, IMAGE, "Range-corrected signal and background")
)
