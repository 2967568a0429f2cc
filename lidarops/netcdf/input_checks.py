"""What the engine hands over, checked against the table of variables."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.netcdf.variables import Layout, Row

Values = npt.NDArray[Any]


class CheckedInput:
    """A dataset whose variables are taken one by one, each as its row wants it.

    Parameters
    ----------
    data : xr.Dataset
        In memory.
    layout : Layout

    Raises
    ------
    ProductError
        If the dataset holds a data variable that the layout does not know.
    """

    def __init__(self, data: xr.Dataset, layout: Layout) -> None:
        rows = (*layout.coordinates, *layout.variables)
        # What is computed from the flags cannot be handed over, and so cannot contradict them.
        known = {row.name for row in rows if not row.summary} | {row.bounds for row in rows}
        for name in data.data_vars:
            if name not in known:
                raise ProductError(
                    "is no variable of this kind of product",
                    field=str(name),
                    remedy="add a row to lidarops/products/layouts.py, or drop the variable",
                )
        self._data = data

    def __contains__(self, name: str) -> bool:
        return name in self._data.variables

    def take(self, name: str, dims: tuple[str, ...]) -> Values:
        """Return the numbers of a variable with its dimensions in the given order.

        Raises
        ------
        ProductError
            If the variable is missing, empty, lazy or no numbers, or has other dimensions.
        """
        if name not in self:
            raise ProductError("is missing", field=name, remedy=f"it has dimensions {dims}")
        variable = self._data.variables[name]
        if variable.chunks is not None:
            raise ProductError(
                "is a dask array", field=name, remedy="load the dataset before it is built"
            )
        if set(variable.dims) != set(dims) or variable.ndim != len(dims):
            raise ProductError(f"has dimensions {variable.dims}, not {dims}", field=name)
        values = np.asarray(variable.transpose(*dims).values)
        if values.dtype.kind not in "iufM":
            raise ProductError(f"has data of type {values.dtype}, not numbers", field=name)
        if values.size == 0:
            raise ProductError("is empty", field=name)
        return values

    def dims(self, name: str) -> tuple[str, ...]:
        """Return the dimensions of a variable."""
        return tuple(str(dim) for dim in self._data.variables[name].dims)


def whole_numbers(row: Row, values: Values) -> Values:
    """Return counts or bits in the type of their row.

    Raises
    ------
    ProductError
        If a value is no whole number that the type can hold.
    """
    stored = np.dtype(row.dtype)
    limits = np.iinfo(stored)
    if values.dtype.kind == "M":
        raise ProductError("holds times, not numbers", field=row.name)
    # NaN compares false, so that it is refused too.
    fits = (values >= limits.min) & (values <= limits.max)
    if not fits.all() or (values.dtype.kind == "f" and (values != np.rint(values)).any()):
        raise ProductError(f"holds values that are not whole numbers of {stored}", field=row.name)
    return values.astype(stored)


def check_range(row: Row, values: Values) -> None:
    """Refuse values that readers would mask because they lie out of the valid range.

    Raises
    ------
    ProductError
        If there are any; missing values are none.
    """
    low = -np.inf if row.valid_min is None else row.valid_min
    high = np.inf if row.valid_max is None else row.valid_max
    outside = int(np.count_nonzero((values < low) | (values > high)))
    if outside:
        raise ProductError(
            f"holds {outside} values out of the valid range [{low:g}, {high:g}]", field=row.name
        )


def check_flags(row: Row, values: Values) -> None:
    """Refuse quality bits that the kind of product does not have.

    Raises
    ------
    ProductError
        If there are any.
    """
    strange = int(np.bitwise_or.reduce(values & ~np.int32(row.flags or 0), axis=None))
    if strange:
        known = int(sum(Quality))
        names = [str(bit.name).lower() for bit in Quality if strange & bit]
        names += [f"unknown bits {strange & ~known:#x}"] if strange & ~known else []
        raise ProductError(
            f"holds bits that this kind of product does not have: {', '.join(names)}",
            field=row.name,
            remedy="add them to the kind in lidarops/products/layouts.py",
        )


def check_flagged(row: Row, values: Values, flags: Values) -> None:
    """Refuse missing values that carry no quality bit: each must say why it is missing.

    Raises
    ------
    ProductError
        If there are any.
    """
    silent = int(np.count_nonzero(~np.isfinite(values) & (flags == 0)))
    if silent:
        raise ProductError(
            f"{silent} of {values.size} values are missing or not finite and carry no quality bit",
            field=row.name,
            remedy="raise a bit in quality_flag where a value is missing",
        )
