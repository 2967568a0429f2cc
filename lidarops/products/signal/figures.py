"""The figure of the ``signal`` product: an image of the signal."""

from __future__ import annotations

from typing import Final

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, image_view

_SIGNAL: Final = ImageQuantity("range-corrected signal", farthest=15e3)
FIGURES: Final = KindFigures((image_view("signal", "signal", _SIGNAL),), preferred="signal")
