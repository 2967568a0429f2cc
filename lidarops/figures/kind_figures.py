"""What a kind of product states about its figures, and how pages and reports find it.

A kind has a module ``figures``, which holds `KindFigures` by the name ``FIGURES``. Products of
other kinds are drawn by `lidarops.figures.any_kind`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import xarray as xr

from lidarops.figures.image_panels import ImageQuantity, image_figure
from lidarops.figures.panels import Figure
from lidarops.figures.raster import Raster, raster_variables, read_raster
from lidarops.kinds import kinds

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True)
class View(Generic[Content]):
    """A way to look at products of one instrument and channel."""

    name: str
    """Name among the views of its kind."""
    variables: tuple[str, ...]
    """Variables that `read` needs."""
    read: Callable[[xr.Dataset, int], Content | None]
    """Reduces an open product, which may be lazy, to so many columns of an image at most; None if
    there is nothing to show. Raises `ProductError` if the product is of another kind. It is sent to
    another process, so it must be possible to pickle it."""
    draw: Callable[[Sequence[Content]], Iterable[Figure]]
    """Returns the figures of the contents of at least one product."""
    first: bool = False
    """Whether a report draws only the first product that has content."""
    shows: str = ""
    """Variable of an image against time."""


@dataclass(frozen=True, slots=True)
class KindFigures:
    """Figures of a kind of product."""

    views: tuple[View[Any], ...]
    """The first figure of the first view is the thumbnail of a product."""
    preferred: str
    """Variable for an overview of any product that has it."""


def image_view(
    kind: str, variable: str, quantity: ImageQuantity, along: str = "range"
) -> View[Raster]:
    """Return the view of a variable of a kind against time and range or altitude."""
    return View(
        kind if kind == variable else f"{kind}-{variable.replace('_', '-')}",
        raster_variables(variable, along),
        partial(_read_raster, variable, along, quantity.farthest),
        lambda rasters: [image_figure(rasters, quantity, along)],
        shows=variable,
    )


def _read_raster(
    variable: str, along: str, farthest: float, product: xr.Dataset, columns: int
) -> Raster:
    names = [name for name in raster_variables(variable, along) if name in product.variables]
    part = product[names]
    if along in part:
        part = part.isel({along: slice(0, int(np.searchsorted(part[along].values, farthest)))})
    profiles = max(-(-part.sizes["time"] // columns), 1)
    return read_raster(part, quantity=variable, profiles=profiles, along=along)


def figures_of(kind: str) -> KindFigures | None:
    """Return the figures of a kind of product; None if the kind is unknown or states none."""
    known = kinds().get(kind)
    return known.optional_part("figures", "FIGURES") if known else None


def preferred_variables() -> tuple[str, ...]:
    """Return the preferred variables of all kinds, in the order of their rank."""
    known = (figures_of(kind) for kind in kinds())
    return tuple(dict.fromkeys(figures.preferred for figures in known if figures is not None))
