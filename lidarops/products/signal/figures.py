"""The figure of the ``signal`` product: an image of the signal."""

from __future__ import annotations

from functools import partial
from typing import Final

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, image_view
from lidarops.figures.raster import raster_variables, read_raster

_READ: Final = partial(read_raster, quantity="signal", kind="signal")
FIGURES: Final = KindFigures(
    (
        image_view(
            "signal",
            raster_variables("signal"),
            _READ,
            ImageQuantity("range-corrected signal", farthest=15e3),
        ),
    ),
    preferred="signal",
)
