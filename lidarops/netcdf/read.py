"""Products as xarray datasets: whole ones, or some variables of many."""

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
from lidarops.netcdf.stored import (
    HDF5,
    StoredProduct,
    StoredVariable,
    opened_stored,
    reading,
    stored_product,
)
from lidarops.netcdf.stored_flags import refuse_moved_flags

NETCDF_MAGIC: Final = (b"CDF\x01", b"CDF\x02", b"CDF\x05", HDF5)
"""First bytes of NetCDF files."""
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


def dataset_of(product: StoredProduct, *, as_written: bool = False) -> xr.Dataset:
    """Return an open product as a dataset that is not decoded.

    Parameters
    ----------
    product : StoredProduct
    as_written : bool
        Whether to keep the dimension ``altitude`` of a vertical lidar, which is else ``range``.

    Returns
    -------
    xr.Dataset
        Variables of 16 KiB and more are lazy: only indexed values are read.
    """
    variables = {name: as_variable(stored) for name, stored in product.variables.items()}
    if as_written:
        for name, stored in product.variables.items():
            variables[name].dims = stored.written
    return xr.Dataset(variables, attrs=product.attrs.whole())


def decoded(product: StoredProduct, names: Iterable[str]) -> xr.Dataset:
    """Return some variables of an open product, decoded, without indexes.

    Parameters
    ----------
    product : StoredProduct
    names : iterable of str
        Those that the product does not have are left out.

    Returns
    -------
    xr.Dataset
        As from `open_product`.
    """
    stored = {name: as_variable(product[name]) for name in names if name in product}
    variables, attributes, _ = xr.conventions.decode_cf_variables(
        stored, product.attrs.whole(), decode_coords=False, decode_timedelta=False
    )
    own = {name: one for name, one in variables.items() if one.dims == (name,)}
    others = {name: one for name, one in variables.items() if name not in own}
    return xr.Dataset(others, xr.Coordinates(own, indexes={}), attributes)


def as_variable(stored: StoredVariable) -> xr.Variable:
    """Return a variable that is not decoded, lazy if it has 16 KiB or more."""
    small = stored.stated < LAZY_BYTES
    values = stored[...] if small else indexing.LazilyIndexedArray(_Lazy(stored))
    return xr.Variable(stored.dims, values, stored.attrs.whole())


@contextmanager
def opened_product(
    path: str | Path,
    *,
    in_parts: bool = False,
    as_written: bool = False,
    decode_cf: bool = True,
    **decoding: Any,
) -> Iterator[xr.Dataset]:
    """Open a whole product; what is raised while it is open names it.

    Parameters
    ----------
    path : path or str
    in_parts : bool
        Whether the product may be larger than memory, because no variable is read as a whole.
    as_written : bool
        As of `dataset_of`.
    decode_cf : bool
    **decoding
        As for `xarray.decode_cf`.

    Yields
    ------
    xr.Dataset
        Lazy, but for small variables.

    Raises
    ------
    ProductError
        If it cannot be read, or states more than it can hold.
    """
    with reading(path):
        with Path(path).open("rb") as file:
            is_hdf5 = file.read(len(HDF5)) == HDF5
        if not is_hdf5:
            # NetCDF-3, which is no larger in memory than on disk.
            decoding |= {"engine": "netcdf4", "cache": False, "decode_cf": decode_cf}
            with xr.open_dataset(path, **decoding) as product:
                yield product
            return
    with opened_stored(path, in_parts=in_parts) as stored:
        whole = dataset_of(stored, as_written=as_written)
        yield xr.decode_cf(whole, **decoding) if decode_cf else whole


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
    with opened_product(path, in_parts=True, decode_times=False) as product:
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
    """Return whether a file is NetCDF by its first bytes.

    Raises
    ------
    ProductError
        If it cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return file.read(4) in NETCDF_MAGIC
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        raise ProductError(problem, file=path, wrong_use=isinstance(error, NO_FILE)) from error


@contextmanager
def open_product(path: str | Path, names: Iterable[str]) -> Iterator[xr.Dataset]:
    """Open a product for some of its variables, which is faster than to open all of it.

    They are decoded as by `xarray.open_dataset`: missing values are NaN, times datetime64[ns].
    The bits of ``quality_flag`` are at the places that its kind gives them now.

    Parameters
    ----------
    path : path or str
        A product.
    names : iterable of str
        Names of variables. Those that the product does not have are left out.

    Yields
    ------
    xr.Dataset
        Without indexes. Variables of 16 KiB and more are lazy: only indexed values are read. A
        variable with the name of its dimension is a coordinate.

    Raises
    ------
    ProductError
        If there is no such file; if it has bits of flags at other places than its kind has now; if
        it cannot be read, possibly only when values are.
    """
    with ExitStack() as until_closed:
        with reading(path):
            stored = until_closed.enter_context(stored_product(path))
            product = decoded(stored, names)
            refuse_moved_flags(product)
        yield product
