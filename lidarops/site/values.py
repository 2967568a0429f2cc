"""Summary of the values of a product."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.any_kind import main_name
from lidarops.figures.kind_figures import figures_of
from lidarops.figures.panels import number, units
from lidarops.figures.series_panels import Quantity
from lidarops.figures.wording import percent
from lidarops.netcdf.stored_flags import judge

READ_BYTES: Final = 1_000_000
"""Most bytes of a variable that are read. Of a longer one, every second profile is, or fewer."""

Row = dict[str, str]
"""The usable values of one quantity, in the displayed unit, in words, by heading: its name and
unit, the share of usable values, percentiles, and the median of the standard errors."""


class Values(NamedTuple):
    """Summary of the values of a product."""

    rows: tuple[Row, ...] = ()
    every: int = 1
    """Of how many profiles one counts."""


def read_values(product: xr.Dataset, kind: str) -> Values:
    """Return a summary of each main quantity of a product; empty if none is over time.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy.
    kind : str
        Kind of the product, which states its main quantities; may be unknown.
    """
    quantities = _quantities(product, kind)
    largest = max((product[quantity.name].nbytes for quantity in quantities), default=1)
    every = max(-(-largest // READ_BYTES), 1)
    return Values(tuple(_row(product, quantity, every) for quantity in quantities), every)


def _quantities(product: xr.Dataset, kind: str) -> tuple[Quantity, ...]:
    """Return the quantities over time that the kind states, else the main variable."""
    figures = figures_of(kind)
    stated = figures.values if figures is not None else ()
    known = tuple(q for q in stated if q.name in product.data_vars and product[q.name].size)
    if not known:
        name = main_name(product)
        if name is not None:
            known = (Quantity(name, 1.0, units(str(product[name].attrs.get("units", "")))),)
    return tuple(q for q in known if product[q.name].dims[:1] == ("time",))


def _row(product: xr.Dataset, quantity: Quantity, every: int) -> Row:
    some = product.isel(time=slice(None, None, every))
    whole = some[quantity.name]

    def along(name: str) -> xr.DataArray | None:
        """Return another variable of the same dimensions; None without one."""
        return some[name] if name in some and some[name].dims == whole.dims else None

    values = quantity.factor * whole.values.astype(np.float64)
    usable = np.isfinite(values)
    judged, error = judge(some, quantity.name), along(f"{quantity.name}_standard_error")
    usable &= ~judged.rejected
    errors = np.full(values.shape, np.nan)
    if error is not None:
        errors = quantity.factor * error.values.astype(np.float64)
    known = usable & np.isfinite(errors)
    title = quantity.label
    low, middle, high = _words(values[usable], (5.0, 50.0, 95.0))
    return {
        "quantity": f"{title[:1].upper()}{title[1:]}",
        "usable": percent(np.count_nonzero(usable) / usable.size),
        "5 %": low,
        "median": middle,
        "95 %": high,
        "median error": _words(errors[known], (50.0,))[0],
    }


def _words(values: NDArray[np.float64], shares: tuple[float, ...]) -> list[str]:
    """Return percentiles to three digits; a dash each without values."""
    if not values.size:
        return ["\N{EN DASH}"] * len(shares)
    return [number(float(f"{value:.3g}")) for value in np.percentile(values, shares)]
