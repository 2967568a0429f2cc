"""Products as xarray datasets, whole ones or some of their variables, and what they state."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from lidarops.errors import NO_FILE, ProductError
from lidarops.netcdf.stored import HDF5, StoredProduct, StoredVariable, open_stored, reading
from lidarops.netcdf.stored_flags import refuse_moved_flags

LAZY_BYTES: Final = 1 << 14
"""Smallest variable that is not read at once."""


class _Lazy(BackendArray):
    """Values of a variable, read on access."""

    def __init__(self, stored: StoredVariable) -> None:
        self._stored = stored
        self.shape, self.dtype = stored.shape, stored.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.OUTER_1VECTOR
        read = self._stored.__getitem__
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, read))


def as_variable(stored: StoredVariable) -> xr.Variable:
    """Return a variable that is not decoded, lazy if it has 16 KiB or more."""
    small = stored.stated < LAZY_BYTES
    values = stored[...] if small else indexing.LazilyIndexedArray(_Lazy(stored))
    return xr.Variable(stored.dims, values, stored.attrs.whole())


def decoded(product: StoredProduct, names: Iterable[str], **decoding: Any) -> xr.Dataset:
    """Return some variables of an open product, decoded, without indexes; see `open_product`."""
    stored = {name: as_variable(product[name]) for name in names if name in product}
    options = {"decode_coords": False, "decode_timedelta": False, **decoding}
    variables, attributes, named = xr.conventions.decode_cf_variables(
        stored, product.attrs.whole(), **options
    )
    own = {name: v for name, v in variables.items() if v.dims == (name,) or name in named}
    others = {name: one for name, one in variables.items() if name not in own}
    return xr.Dataset(others, xr.Coordinates(own, indexes={}), attributes)


@contextmanager
def open_product(
    path: str | Path, names: Iterable[str] | None = None, **decoding: Any
) -> Iterator[xr.Dataset]:
    """Open a product; for some of its variables, which is faster than to open all of it.

    They are decoded as by `xarray.open_dataset`: missing values are NaN, times datetime64[ns].
    Of named variables, the bits of ``quality_flag`` are at the places that its kind gives them now.

    Parameters
    ----------
    path : path or str
        A product, which may be larger than memory where no variable is read as a whole.
    names : iterable of str, optional
        Names of variables, of all by default. Those that the product does not have are left out.
    **decoding
        As for `xarray.decode_cf`.

    Yields
    ------
    xr.Dataset
        Without indexes. Variables of 16 KiB and more are lazy: only indexed values are read. A
        variable with the name of its dimension is a coordinate. Those of a vertical lidar have the
        dimension ``range``, whatever that of the file is.

    Raises
    ------
    ProductError
        If there is no such file; if it states more than it can hold; if named variables have bits
        of flags at other places than its kind has now; if it cannot be read, possibly only when
        values are.
    """
    with ExitStack() as until_closed:
        with reading(path):
            stored = until_closed.enter_context(open_stored(path))
            product = decoded(stored, stored.variables if names is None else names, **decoding)
            if names is not None:
                refuse_moved_flags(product)
        yield product


def read_origin(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the PROV-JSON document of a product and its global attributes.

    Raises
    ------
    ProductError
        If the file cannot be read or holds no provenance.
    """
    if not is_netcdf(path):
        remedy = "give the path of a product of lidarops"
        raise ProductError("is no NetCDF file", file=path, remedy=remedy, wrong_use=True)
    with reading(path), open_product(path, ["provenance"]) as product:
        if "provenance" not in product:
            problem = "has no such variable"
            raise ProductError(problem, file=path, field="provenance", wrong_use=True)
        text, attributes = str(product["provenance"].item()), dict(product.attrs)
    try:
        document: dict[str, Any] = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ProductError(f"is not JSON: {error}", file=path, field="provenance") from error
    return document, attributes


def read_provenance(path: str | Path) -> dict[str, Any]:
    """Read the PROV-JSON document of a product; see `read_origin`."""
    return read_origin(path)[0]


def is_netcdf(path: str | Path) -> bool:
    """Return whether a file is NetCDF-4 by its first bytes.

    Raises
    ------
    ProductError
        If it cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return file.read(len(HDF5)) == HDF5
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        raise ProductError(problem, file=path, wrong_use=isinstance(error, NO_FILE)) from error
