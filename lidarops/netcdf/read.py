"""Reads some variables of a product fast: a report reads thousands of products, a few of each.

xarray reads these files too, and gives the same; but it looks at all that a file holds before it
gives anything of it. Only what `lidarops.netcdf.write` writes is read faster, anything else in
NetCDF-4 is read by HDF5 itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK
from xarray.core import indexing

from lidarops.errors import ProductError
from lidarops.netcdf._deflate import inflate_chunk
from lidarops.netcdf.write import BULK_BYTES

_ATTRIBUTES: Final = (
    "units",
    "calendar",
    "_FillValue",
    "missing_value",
    "scale_factor",
    "add_offset",
    "_Unsigned",
    "_Encoding",
    "dtype",
)
"""What a variable's values mean. To look for others takes longer than to read the values."""
_NO_VARIABLE: Final = b"This is a netCDF dimension but not a netCDF variable"
_OTHER_DIMENSION: Final = "_nc4_non_coord_"
"""Stands before the name of a variable that has the name of a dimension that it does not have."""
_FILTERS: Final = [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]


def open_product(path: str | Path, names: Iterable[str]) -> xr.Dataset:
    """Open a product for some of its variables.

    They are decoded as by `xarray.open_dataset`: missing values are NaN, times datetime64[ns].

    Parameters
    ----------
    path : path or str
        A product.
    names : iterable of str
        Of variables. Those that the product does not have are left out, as not every product of
        a kind has all of them: whoever needs one says so.

    Returns
    -------
    xr.Dataset
        To be closed, or used in a ``with``. Variables of 16 KiB and more are lazy, and only what
        is asked of them is read. Without indexes, and of the attributes only those that tell what
        values mean: their units. A variable that has the name of its dimension is a coordinate.

    Raises
    ------
    ProductError
        If there is no such file or it cannot be read, which may turn out while values are read.
    """
    with ExitStack() as until_closed:
        file = _File(Path(path))
        until_closed.callback(file.close)
        variables = file.variables(names)
        close = until_closed.pop_all().close
    coordinates = {name: found for name, found in variables.items() if found.dims == (name,)}
    dataset = xr.Dataset(
        {name: found for name, found in variables.items() if name not in coordinates},
        coords=xr.Coordinates(coordinates, indexes={}),
    )
    dataset.set_close(close)
    return dataset


def profiles_in(path: str | Path) -> int:
    """Return the number of profiles of a product, without reading any value; 0 without a time.

    Raises
    ------
    ProductError
        If there is no such file, or it cannot be read.
    """
    file = _File(Path(path))
    try:
        return file.length("time")
    finally:
        file.close()


class _File:
    """An open file, whose every failure is told as that of a product."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise ProductError("the file is missing", file=path)
        self._path = path
        with self.access():
            self._file = h5py.File(path, "r")

    def close(self) -> None:
        with NETCDF4_PYTHON_LOCK:
            self._file.close()

    @contextmanager
    def access(self) -> Iterator[None]:
        try:
            # netCDF4 may use the same library, which lets nobody else in.
            with NETCDF4_PYTHON_LOCK:
                yield
        # What HDF5 raises depends on where it meets the damage.
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise self.damaged(error) from error

    def damaged(self, error: object) -> ProductError:
        return ProductError(f"cannot be read: {error}", file=self._path)

    def length(self, dimension: str) -> int:
        with self.access():
            found = self._file.get(dimension)
            return int(found.shape[0]) if isinstance(found, h5py.Dataset) and found.shape else 0

    def variables(self, names: Iterable[str]) -> dict[str, xr.Variable]:
        """Return those that are there, decoded."""
        with self.access():
            there = set(self._file)
            found = {name: self._stored(name, there) for name in names}
        stored = {name: variable for name, variable in found.items() if variable is not None}
        for variable in list(stored.values()):
            # Bounds of times have no units of their own.
            bounds = variable.attrs.pop("bounds", None)
            if bounds in stored:
                stored[bounds].attrs.setdefault("units", variable.attrs["units"])
        return {name: self._decoded(name, variable) for name, variable in stored.items()}

    def _stored(self, name: str, there: Container[str]) -> xr.Variable | None:
        foreign = f"{_OTHER_DIMENSION}{name}"
        inside = foreign if foreign in there else name
        if inside not in there:
            return None
        # To get it from the file takes four times as long.
        found = h5py.Dataset(h5py.h5d.open(self._file.id, inside.encode()))
        if _is_bare_dimension(found):
            return None
        dims, attributes = _dimensions(found, name), _attributes(found)
        fill = _own_fill(found.dtype, attributes)
        if found.size * found.dtype.itemsize < BULK_BYTES:
            # Most are small and asked for again and again.
            values = _unfilled(np.asarray(found[()]), fill)
            return xr.Variable(dims, values, attributes, fastpath=True)
        lazy = indexing.LazilyIndexedArray(_Stored(self, found, fill))
        return xr.Variable(dims, lazy, attributes, fastpath=True)

    def _decoded(self, name: str, stored: xr.Variable) -> xr.Variable:
        if _is_plain(stored):
            return stored
        try:
            decoded = xr.conventions.decode_cf_variable(name, stored, decode_timedelta=False)
            return decoded if stored.nbytes >= BULK_BYTES else decoded.load()
        except (ValueError, TypeError, OverflowError) as error:
            raise ProductError(
                f"cannot be decoded: {error}", file=self._path, field=name
            ) from error


class _Stored(BackendArray):
    """The values of a variable, read where they are indexed; NaN where they are missing."""

    def __init__(self, file: _File, dataset: h5py.Dataset, fill: np.floating[Any] | None) -> None:
        self._file = file
        self._dataset = dataset
        self._fill = fill
        self._deflated = _is_deflated(dataset)
        self.shape = dataset.shape
        self.dtype = dataset.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.BASIC
        values = indexing.explicit_indexing_adapter(key, self.shape, support, self._read)
        return np.asarray(values)

    def _read(self, key: tuple[Any, ...]) -> NDArray[Any]:
        if self._deflated and all(isinstance(one, slice) for one in key):
            spans = [range(size)[one] for size, one in zip(self.shape, key, strict=True)]
            if all(span.step == 1 for span in spans):
                return _unfilled(self._inflate(spans), self._fill)
        with self._file.access():
            values = np.asarray(self._dataset[key])
        return _unfilled(values, self._fill)

    def _inflate(self, spans: list[range]) -> NDArray[Any]:
        """Read a block of whole chunks or parts of them, faster than HDF5's own filters do."""
        chunk = self._dataset.chunks
        values = np.empty([len(span) for span in spans], self.dtype)
        corners = (
            range(span.start - span.start % step, span.stop, step)
            for span, step in zip(spans, chunk, strict=True)
        )
        for corner in itertools.product(*corners):
            part = self._part(corner)
            into, out_of = zip(*map(_shared, spans, corner, chunk), strict=True)
            values[into] = part[out_of]
        return values

    def _part(self, corner: tuple[int, ...]) -> NDArray[Any]:
        """Read a chunk; of one that HDF5 itself must read, what lies within the values."""
        chunk = self._dataset.chunks
        with self._file.access():
            skipped, data = self._dataset.id.read_direct_chunk(corner)
            if skipped:
                # HDF5 may store a chunk without some of the filters.
                inside = (slice(at, at + step) for at, step in zip(corner, chunk, strict=True))
                return np.asarray(self._dataset[tuple(inside)])
        try:
            return inflate_chunk(data, chunk, self.dtype)
        except ValueError as error:
            raise self._file.damaged(error) from error


def _shared(span: range, corner: int, step: int) -> tuple[slice, slice]:
    """Return what a chunk and the values asked for have in common, in the latter and the former."""
    first, last = max(span.start, corner), min(span.stop, corner + step)
    return slice(first - span.start, last - span.start), slice(first - corner, last - corner)


def _is_deflated(dataset: h5py.Dataset) -> bool:
    """Whether every chunk is there, shuffled and deflated, and nothing else was done to it."""
    if dataset.chunks is None:
        return False
    layout = dataset.id.get_create_plist()
    filters = [layout.get_filter(number)[0] for number in range(layout.get_nfilters())]
    chunks = math.prod(map(_count, dataset.shape, dataset.chunks))
    plain = dataset.dtype.kind in "iuf" and dataset.dtype.isnative
    return plain and filters == _FILTERS and dataset.id.get_num_chunks() == chunks


def _own_fill(dtype: np.dtype[Any], attributes: dict[str, Any]) -> np.floating[Any] | None:
    """Take out the fill value of a number that nothing else is said of, as in our products."""
    fill = attributes.get("_FillValue")
    alone = attributes.keys() <= {"units", "_FillValue"} and not _has_time_units(attributes)
    if isinstance(fill, np.floating) and dtype == fill.dtype and dtype.isnative and alone:
        del attributes["_FillValue"]
        return fill
    return None


def _unfilled(values: NDArray[Any], fill: np.floating[Any] | None) -> NDArray[Any]:
    if fill is not None:
        values[values == fill] = np.nan
    return values


def _is_plain(stored: xr.Variable) -> bool:
    """Whether a variable holds what is in the file: a number that nothing says how to take."""
    coded = stored.attrs.keys() - {"units"} or _has_time_units(stored.attrs)
    return stored.dtype.kind in "iuf" and not coded


def _has_time_units(attributes: Mapping[str, Any]) -> bool:
    return " since " in str(attributes.get("units", ""))


def _count(size: int, step: int) -> int:
    return -(-size // step)


def _is_bare_dimension(dataset: h5py.Dataset) -> bool:
    if not h5py.h5ds.is_scale(dataset.id):
        return False
    return bool(h5py.h5ds.get_scale_name(dataset.id).startswith(_NO_VARIABLE))


def _dimensions(dataset: h5py.Dataset, name: str) -> tuple[str, ...]:
    """Return the names of dimensions, which HDF5 holds as references to what lies along them."""
    if not dataset.shape:
        return ()
    if h5py.h5ds.is_scale(dataset.id):
        return (name,)
    scales = dataset.attrs["DIMENSION_LIST"]
    return tuple(
        h5py.h5r.get_name(references[0], dataset.id).decode().rpartition("/")[2]
        for references in scales
    )


def _attributes(dataset: h5py.Dataset) -> dict[str, Any]:
    there = [name for name in _ATTRIBUTES if h5py.h5a.exists(dataset.id, name.encode())]
    found = {name: _attribute(dataset, name) for name in there}
    if _has_time_units(found) and "bounds" in dataset.attrs:
        found["bounds"] = _attribute(dataset, "bounds")
    return found


def _attribute(dataset: h5py.Dataset, name: str) -> Any:
    value = dataset.attrs[name]
    if isinstance(value, bytes):
        return value.decode()
    # What NetCDF holds as one number is an array of one in HDF5.
    return value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
