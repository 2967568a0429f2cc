"""The image of a kind of product: a quantity against time and range or altitude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lidarops.figures import svg, svg_images
from lidarops.figures.kind_figures import Drawn, PageFigures
from lidarops.figures.raster import Raster


@dataclass(frozen=True, slots=True)
class KindImage:
    """How the image of a kind of product is read and named."""

    variables: tuple[str, ...]
    """Variables that `read` needs."""
    read: Callable[..., Raster]
    """Called with a product and ``profiles``, the profiles per column."""
    what: str
    """Name of the quantity."""
    along: str = "range"
    """``range`` or ``altitude``."""

    def page(self, product: xr.Dataset) -> PageFigures:
        """Draw the image and its thumbnail for a page."""
        profiles = max(1, -(-product.sizes.get("time", 0) // svg_images.COLUMNS))
        raster = self.read(product, profiles=profiles)
        label = f"{self.what} ({svg.units(raster.units)})"
        sheet, words = svg_images.image_sheet(raster, along=self.along, label=label, key="f1")
        below = ", with the background below" if np.isfinite(raster.background).any() else ""
        caption = f"{self.what.capitalize()} against time and {self.along}{below}"
        drawn = Drawn.of(sheet, caption, words, "f1")
        return PageFigures((drawn,), svg_images.thumbnail(raster), caption)
