"""The figures of the ``homogeneous`` product: extinction and background of sections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import KindFigures, View
from lidarops.figures.panels import Figure, units
from lidarops.figures.series_data import TimeSeries, float_values, join, require
from lidarops.figures.series_panels import Quantity, series_figures
from lidarops.netcdf.stored_flags import bits_of, quality_bits, rejecting_mask

_Content = tuple[str, list[TimeSeries]]
"""Units of the background, and the sections."""
_QUANTITIES: Final = ("total_extinction", "background")
_ALONG_BOTH: Final = (
    *_QUANTITIES,
    *(f"{name}_standard_error" for name in _QUANTITIES),
    "quality_flag",
)
SECTION_VARIABLES: Final = ("time", *_ALONG_BOTH, "section_bounds")
"""Variables that `read_sections` needs."""


def read_sections(product: xr.Dataset) -> list[TimeSeries]:
    """Return the sections of a homogeneous product, sorted by near end.

    Parameters
    ----------
    product : Dataset
        Kind ``homogeneous``, dims (time, section).

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions or units.
    """
    _check(product)
    stored = product.variables
    order = np.argsort(stored["time"].values, kind="stable")
    time = stored["time"].values.astype("datetime64[ns]")[order]
    flags = quality_bits(stored["quality_flag"])[order]
    rejecting = rejecting_mask(bits_of(product))
    bounds = stored["section_bounds"].values.astype(np.float64)
    values = {name: float_values(product, name)[order] for name in _ALONG_BOTH[:-1]}
    sections = []
    for k in np.argsort(bounds[:, 0], kind="stable"):
        columns = {name: both[:, k] for name, both in values.items()}
        near, far = bounds[k].tolist()
        label = f"{near / 1e3:g}\N{EN DASH}{far / 1e3:g} km"
        sections.append(TimeSeries(time, columns, flags[:, k], rejecting, label, (near, far)))
    return sections


def _check(product: xr.Dataset) -> None:
    require(product, {"time": ("time",)} | dict.fromkeys(_ALONG_BOTH, ("time", "section")))
    bounds = product.variables.get("section_bounds")
    if bounds is None or bounds.shape[1:] != (2,):
        raise ProductError("has no section bounds", field="section_bounds")
    units = product.variables["total_extinction"].attrs.get("units")
    if units != "m-1":
        raise ProductError(f"has the units {units!r}, not 'm-1'", field="total_extinction")


def _read(product: xr.Dataset, _: int) -> _Content | None:
    sections = read_sections(product)
    unit = units(str(product.variables["background"].attrs.get("units", "")))
    return (unit, sections) if product.sizes["time"] and sections else None


def _draw(contents: Sequence[_Content]) -> Iterator[Figure]:
    sections = join(section for _, sections in contents for section in sections)
    quantities = (
        Quantity("total_extinction", 1e3, "km⁻¹"),
        Quantity("background", 1.0, contents[0][0]),
    )
    return series_figures(sections, quantities, "Extinction and background of range sections")


FIGURES: Final = KindFigures(
    (View("homogeneous", SECTION_VARIABLES, _read, _draw),),
    preferred="total_extinction",
)
