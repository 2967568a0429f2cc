"""Check the data of a product against its layout, and encode them as they are stored."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import ProductError
from lidarops.netcdf.variables import FILL_VALUE, Layout, Row, attributes, summary_of
from lidarops.records import DetectionMode

Values = npt.NDArray[Any]
_MANTISSA_BITS: Final = 23


def refuse_unknown(data: xr.Dataset, layout: Layout) -> None:
    """Refuse a dataset that holds a data variable that is not in the layout.

    Raises
    ------
    ProductError
    """
    known = {*layout.rows, *(row.bounds for row in layout.rows.values())}
    known -= {summary_of(row.name) for row in layout.judges}
    for name in data.data_vars:
        if name not in known:
            raise ProductError(
                "is not a variable of this kind of product",
                field=str(name),
                remedy="add a row to lidarops/products/KIND/variables.py, or drop the variable",
            )


def taken(data: xr.Dataset, name: str, dims: tuple[str, ...]) -> Values:
    """Return the numbers of a variable with its dimensions in the given order.

    Raises
    ------
    ProductError
        If the variable is missing, empty, lazy, not numeric, or has other dimensions.
    """
    if name not in data.variables:
        raise ProductError("is missing", field=name, remedy=f"its dimensions are {dims}")
    variable = data.variables[name]
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


def stored(data: xr.Dataset, row: Row, flags: Values | None = None) -> Values:
    """Return a variable as it is stored: in the type of its row, with fill values.

    Parameters
    ----------
    data : xr.Dataset
        In memory.
    row : Row
    flags : ndarray of int32, optional
        Of the same shape: every missing value must carry a quality bit that states why.

    Raises
    ------
    ProductError
        If it is missing, of other dimensions or type, or holds values that its row does not allow.
    """
    values = taken(data, row.name, row.dims)
    check_range(row, values)
    if row.dtype.startswith("i"):
        return whole_numbers(row, values)
    encoded = as_stored(row, values)
    missing = encoded == FILL_VALUE if flags is not None else None
    unflagged = 0 if missing is None else int(np.count_nonzero(missing & (flags == 0)))
    if unflagged:
        raise ProductError(
            f"{unflagged} of {encoded.size} values are missing or not finite and carry no quality"
            " bit",
            field=row.name,
            remedy="raise a bit in quality_flag where a value is missing",
        )
    return encoded


def whole_numbers(row: Row, values: Values) -> Values:
    """Return counts or bits in the type of their row.

    Raises
    ------
    ProductError
        If a value is not a whole number that the type can hold.
    """
    held = np.dtype(row.dtype)
    limits = np.iinfo(held)
    if values.dtype.kind == "M":
        raise ProductError("holds times, not numbers", field=row.name)
    # NaN compares as false, so it is refused too.
    fits = (values >= limits.min) & (values <= limits.max)
    if not fits.all() or (values.dtype.kind == "f" and (values != np.rint(values)).any()):
        raise ProductError(f"holds values that are not whole numbers of {held}", field=row.name)
    return values.astype(held)


def check_range(row: Row, values: Values) -> None:
    """Check that values lie in the valid range, outside of which readers would mask them.

    Raises
    ------
    ProductError
        If any value lies outside; missing values do not count.
    """
    if row.valid_min is None and row.valid_max is None:
        return
    low = -np.inf if row.valid_min is None else row.valid_min
    high = np.inf if row.valid_max is None else row.valid_max
    outside = int(np.count_nonzero((values < low) | (values > high)))
    if outside:
        raise ProductError(
            f"holds {outside} values out of the valid range [{low:g}, {high:g}]", field=row.name
        )


def as_stored(row: Row, values: Values) -> Values:
    """Return values in the type of their row.

    Floats are rounded to the bits of the row; those that are not finite get the fill value.
    """
    # A value too large for the type becomes infinite, and counts as missing.
    with np.errstate(over="ignore"):
        encoded = values.astype(row.dtype)
    if encoded.dtype.kind == "f":
        if row.bits is not None:
            encoded = bitround(encoded, row.bits)
        encoded[~np.isfinite(encoded)] = FILL_VALUE
    return encoded


def bitround(values: Values, bits: int) -> Values:
    """Round to fewer bits of the mantissa, half to even, so that the values compress better.

    Parameters
    ----------
    values : ndarray of float32
    bits : int
        Explicit bits of the mantissa to keep; the relative error is at most 2^-(bits + 1).

    Returns
    -------
    ndarray of float32
        NaN stays NaN; a value beyond the largest float becomes infinite.
    """
    drop = _MANTISSA_BITS - bits
    if drop <= 0:
        return values.copy()
    whole = values.view(np.uint32)
    odd = (whole >> np.uint32(drop)) & np.uint32(1)
    rounded = whole + odd
    rounded += np.uint32((1 << (drop - 1)) - 1)
    rounded &= np.uint32(0xFFFFFFFF & ~((1 << drop) - 1))
    result: Values = rounded.view(np.float32)
    missing = np.isnan(values)
    result[missing] = np.nan
    return result


def as_text(row: Row, text: str, mode: DetectionMode) -> xr.Variable:
    """Return a text as the variable of its row."""
    return xr.Variable(row.dims, np.frombuffer(text.encode(), "S1"), attributes(row, mode=mode))
