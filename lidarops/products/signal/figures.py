"""The figures of the ``signal`` product: an image of the signal."""

from __future__ import annotations

from typing import Final

from lidarops.figures.kind_figures import KindFigures
from lidarops.figures.kind_images import KindImage
from lidarops.figures.raster import raster_variables, read_raster

IMAGE: Final = KindImage(raster_variables(), read_raster, "range-corrected signal")
FIGURES: Final = KindFigures(page=IMAGE.page, preferred="signal")
