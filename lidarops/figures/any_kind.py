"""The figure of a product of any kind: its main variable against time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures import svg, svg_series
from lidarops.figures.kind_figures import PageFigures, no_figures, preferred_variables
from lidarops.figures.series_data import NumberedSeries, SeriesEstimate, quality_bits
from lidarops.netcdf.stored_flags import rejecting_mask, stored_bits
from lidarops.netcdf.variables import QUALITY_FLAG

Floats = NDArray[np.float64]

_BULK: Final = 64_000_000
"""Bytes of a variable above which only some profiles are read."""


@dataclass(frozen=True, slots=True)
class MainVariable:
    """The main variable of a product over time."""

    name: str
    long_name: str
    series: tuple[NumberedSeries, ...]
    """Those with the most values."""
    of: int
    """Number of series of the variable."""

    @property
    def title(self) -> str:
        """What is drawn."""
        few = f", {len(self.series)} of {self.of} series" if self.of > len(self.series) else ""
        return f"{self.long_name[:1].upper()}{self.long_name[1:]}{few}"


def read_main_variable(
    product: xr.Dataset, *, kind: str, most: int = svg_series.SERIES
) -> MainVariable | None:
    """Return the main variable of a product as series over time.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy. Of a large variable, only some profiles are read.
    kind : str
        Kind of the product, which may be unknown.
    most : int, optional
        Most series.

    Returns
    -------
    MainVariable or None
        The first that varies with time of: the preferred variables of all kinds, variables with a
        standard error, floating-point variables. None without any.
    """
    name = _main_name(product)
    if name is None:
        return None
    step = max(1, -(-product[name].nbytes // _BULK))
    some = product.isel(time=slice(None, None, step))
    some = some.isel(time=np.argsort(some["time"].values, kind="stable"))
    variable = some[name]
    table, unknown = _table(variable), np.full(variable.sizes["time"], np.nan)
    flags = quality_bits(_beside(some, QUALITY_FLAG, name, 0.0)).reshape(table.shape)
    stated = some[QUALITY_FLAG].attrs if QUALITY_FLAG in some else {}
    rejecting = rejecting_mask(stored_bits(stated, kind))
    errors = _table(_beside(some, f"{name}_standard_error", name, np.nan))
    units = str(variable.attrs.get("units", ""))
    most_values = np.argsort(-np.isfinite(table).sum(axis=0), kind="stable")[:most]
    series = tuple(
        NumberedSeries(
            time=some["time"].values.astype("datetime64[ns]"),
            flag=flags[:, k],
            rejecting=rejecting,
            estimates={name: SeriesEstimate(table[:, k], errors[:, k], unknown, units)},
            noun=str(variable.dims[1]) if variable.ndim > 1 else "",
            number=k,
        )
        for k in np.sort(most_values).tolist()
    )
    return MainVariable(name, str(variable.attrs.get("long_name", name)), series, table.shape[1])


def _main_name(product: xr.Dataset) -> str | None:
    if "time" not in product.variables or product["time"].dtype.kind != "M":
        return None
    over_time = [
        str(name)
        for name, variable in product.data_vars.items()
        if variable.dims[:1] == ("time",) and variable.dtype.kind == "f" and variable.size
    ]
    preferred = [name for name in preferred_variables() if name in over_time]
    uncertain = [name for name in over_time if f"{name}_standard_error" in product]
    return next(iter([*preferred, *uncertain, *over_time]), None)


def _beside(product: xr.Dataset, other: str, name: str, default: float) -> xr.DataArray:
    """Return another variable along the dimensions of one; the default if there is none."""
    variable = product[name]
    same = other in product and product[other].dims == variable.dims
    return product[other] if same else xr.full_like(variable, default)


def _table(variable: xr.DataArray) -> Floats:
    return variable.values.reshape(variable.sizes["time"], -1).astype(np.float64)


def draw_page(product: xr.Dataset) -> PageFigures:
    """Draw the main variable of a product of any kind for a page."""
    main = read_main_variable(product, kind=product.attrs.get("lidarops_kind", ""))
    if main is None:
        return no_figures("no variable to draw")
    units = svg.units(main.series[0].estimates[main.name].units)
    quantity = svg_series.Quantity(main.name, 1.0, units)
    return svg_series.stacked_page(main.series, (quantity,), main.title)
