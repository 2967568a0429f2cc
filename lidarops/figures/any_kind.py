"""The figure of products of any kind: their main variable against time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import (
    ProductSource,
    View,
    figures_of,
    preferred_variables,
)
from lidarops.figures.panels import Figure, units
from lidarops.figures.series_data import NumberedSeries, SeriesEstimate, join, quality_bits
from lidarops.figures.series_panels import SERIES, Quantity, series_figures
from lidarops.kinds import kinds
from lidarops.netcdf.stored_flags import rejecting_mask, stored_bits
from lidarops.netcdf.variables import QUALITY_FLAG, layout_of

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
    product: xr.Dataset, *, kind: str, name: str | None = None
) -> MainVariable | None:
    """Return the main variable of a product as series over time.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy. Of a large variable, only some profiles are read.
    kind : str
        Kind of the product, which may be unknown.
    name : str, optional
        Another variable over time.

    Returns
    -------
    MainVariable or None
        The first that varies with time of: the preferred variables of all kinds, variables with a
        standard error, floating-point variables. None without any.
    """
    name = name or main_name(product)
    if name is None:
        return None
    step = max(1, -(-product[name].nbytes // _BULK))
    some = product.isel(time=slice(None, None, step))
    some = some.isel(time=np.argsort(some["time"].values, kind="stable"))
    variable = some[name]
    table, unknown = _table(variable), np.full(variable.sizes["time"], np.nan)
    flags = quality_bits(_matching_variable(some, QUALITY_FLAG, name, 0.0)).reshape(table.shape)
    stated = some[QUALITY_FLAG].attrs if QUALITY_FLAG in some else {}
    rejecting = rejecting_mask(stored_bits(stated, kind))
    errors = _table(_matching_variable(some, f"{name}_standard_error", name, np.nan))
    units = str(variable.attrs.get("units", ""))
    most_values = np.argsort(-np.isfinite(table).sum(axis=0), kind="stable")[:SERIES]
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


def main_name(product: xr.Dataset) -> str | None:
    """Return the name of the main variable of a product; None without a variable over time."""
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


def _matching_variable(product: xr.Dataset, other: str, name: str, default: float) -> xr.DataArray:
    """Return another variable along the dimensions of one; the default if there is none."""
    variable = product[name]
    same = other in product and product[other].dims == variable.dims
    return product[other] if same else xr.full_like(variable, default)


def _table(variable: xr.DataArray) -> Floats:
    return variable.values.reshape(variable.sizes["time"], -1).astype(np.float64)


def view_of(kind: str, name: str | None = None) -> View[MainVariable]:
    """Return the view of a variable; of the main one for kinds without figures, or unknown."""
    return View(kind, _variables(kind, name), partial(_read, kind, name), _draw)


def views_of(kind: str) -> Sequence[View[Any]]:
    """Return the views of products of any kind, known or not."""
    figures = figures_of(kind)
    return figures.views if figures is not None else (view_of(kind),)


def _read(
    kind: str, name: str | None, product: xr.Dataset, _: ProductSource
) -> MainVariable | None:
    return read_main_variable(product, kind=kind, name=name)


def _variables(kind: str, name: str | None) -> tuple[str, ...]:
    """Return the variables of which one may be the main variable, with their errors."""
    data = layout_of(kind).data if kind in kinds() and not name else ()
    uncertain = [row.name for row in data if row.uncertain]
    names = [name] if name else dict.fromkeys([*uncertain, *preferred_variables()])
    return "time", QUALITY_FLAG, *names, *(f"{name}_standard_error" for name in names)


def _draw(variables: Sequence[MainVariable]) -> Iterator[Figure]:
    first = variables[0]
    joined = join(one for main in variables if main.name == first.name for one in main.series)
    unit = units(first.series[0].estimates[first.name].units)
    return series_figures(joined[:SERIES], (Quantity(first.name, 1.0, unit),), first.title)
