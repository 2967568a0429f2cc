"""Open and read products: whole ones through xarray, and some variables fast.

A report reads a few variables of thousands of products. xarray reads these with the same result,
but inspects the whole file first. Only files of `lidarops.netcdf.write` are read faster; other
NetCDF-4 files are read through HDF5. Whatever a library raises for a damaged file is raised as
`ProductError`, which names the file.
"""

from __future__ import annotations

import itertools
import json
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

from lidarops.errors import NO_FILE, LidarOpsError, ProductError
from lidarops.netcdf._deflate import inflate_chunk
from lidarops.netcdf.sizes import (
    OTHER_DIMENSION,
    check_contents,
    check_sizes,
    is_bare_dimension,
)
from lidarops.netcdf.stored_flags import Recoding, recoding
from lidarops.netcdf.variables import QUALITY_FLAG

NETCDF_MAGIC: Final = (b"CDF\x01", b"CDF\x02", b"CDF\x05", b"\x89HDF")
"""First bytes of NetCDF files."""
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
"""Attributes needed to decode values. Reading all attributes takes longer than the values."""
LAZY_BYTES: Final = 1 << 14
"""Smallest variable that is not read at once."""
_OF_LIBRARIES: Final = (
    OSError,
    EOFError,
    RuntimeError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
)
"""Families of errors of HDF5, netCDF4, xarray and numpy; the type depends on the place of the
damage."""
UNREADABLE: Final = (*_OF_LIBRARIES, LidarOpsError)
"""What is raised where a part of a damaged or foreign product is read and drawn."""
_MOST_WORDS: Final = 300
"""Characters of the message of a library that are shown."""
_FILTERS: Final = [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]


@contextmanager
def reading(path: str | Path, field: str | None = None) -> Iterator[None]:
    """Raise whatever a library raises for a damaged product as `ProductError`.

    Parameters
    ----------
    path : path or str
    field : str, optional
        The variable that is read.
    """
    try:
        yield
    except LidarOpsError:
        raise
    except _OF_LIBRARIES as error:
        words = " ".join(str(error).replace(str(path), Path(path).name).split())
        raise ProductError(
            f"cannot be read: {words[:_MOST_WORDS] or type(error).__name__}",
            file=path,
            field=field,
            remedy="restore it from a copy, or make it again with lidarops reprocess",
        ) from error


@contextmanager
def opened_product(
    path: str | Path, *, in_parts: bool = False, **decoding: Any
) -> Iterator[xr.Dataset]:
    """Open a whole product; what is raised while it is open names it.

    Parameters
    ----------
    path : path or str
    in_parts : bool
        Whether the product may be larger than memory, because no variable is read as a whole.
    **decoding
        As for `xarray.open_dataset`.

    Yields
    ------
    xr.Dataset
        Lazy.

    Raises
    ------
    ProductError
        If it cannot be read, or states more than it can hold (`lidarops.netcdf.sizes`).
    """
    with reading(path):
        (check_contents if in_parts else check_sizes)(path)
        with xr.open_dataset(path, engine="netcdf4", cache=False, **decoding) as product:
            yield product


def read_provenance(path: str | Path) -> dict[str, Any]:
    """Read the PROV-JSON document of a product.

    Parameters
    ----------
    path : path or str
        A product file.

    Raises
    ------
    ProductError
        If the file cannot be read or holds no provenance.
    """
    return read_origin(path)[0]


def read_origin(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the PROV-JSON document of a product and its global attributes; see `read_provenance`."""
    if not _is_netcdf(Path(path)):
        problem = "is no NetCDF file" if Path(path).is_file() else "is no file"
        remedy = "give the path of a product of lidarops"
        raise ProductError(problem, file=path, remedy=remedy, wrong_use=True)
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


def _is_netcdf(path: Path) -> bool:
    """Return whether a file is NetCDF by its first bytes, or exists but cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(4) in NETCDF_MAGIC
    except NO_FILE:
        return False
    except OSError:
        return True


def open_product(path: str | Path, names: Iterable[str]) -> xr.Dataset:
    """Open a product for some of its variables.

    They are decoded as by `xarray.open_dataset`: missing values are NaN, times datetime64[ns].
    The bits of ``quality_flag`` are at the places that its kind gives them now.

    Parameters
    ----------
    path : path or str
        A product.
    names : iterable of str
        Names of variables. Those that the product does not have are left out.

    Returns
    -------
    xr.Dataset
        To be closed, or used in a ``with``. Variables of 16 KiB and more are lazy: only indexed
        values are read. Without indexes, and of the attributes only units. A variable with the
        name of its dimension is a coordinate.

    Raises
    ------
    ProductError
        If there is no such file or it cannot be read; if ``quality_flag`` carries a bit that its
        kind does not have; possibly only when values are read.
    """
    with ExitStack() as until_closed:
        file = _File(Path(path))
        until_closed.callback(file.close)
        variables = file.variables(names)
        close = until_closed.pop_all().close
    coordinates = {name: var for name, var in variables.items() if var.dims == (name,)}
    dataset = xr.Dataset(
        {name: var for name, var in variables.items() if name not in coordinates},
        coords=xr.Coordinates(coordinates, indexes={}),
    )
    dataset.set_close(close)
    return dataset


def profiles_in(path: str | Path) -> int:
    """Return the number of profiles of a product without reading values; 0 without a time.

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
    """An open file whose errors are raised as `ProductError`."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise ProductError("the file is missing", file=path)
        self.path = path
        with self.access():
            self._file = h5py.File(path, "r")

    def close(self) -> None:
        with NETCDF4_PYTHON_LOCK:
            self._file.close()

    @contextmanager
    def access(self) -> Iterator[None]:
        # netCDF4 may use the same HDF5 library, which is not thread-safe.
        with reading(self.path), NETCDF4_PYTHON_LOCK:
            yield

    def length(self, dimension: str) -> int:
        with self.access():
            item = self._file.get(dimension)
            return int(item.shape[0]) if isinstance(item, h5py.Dataset) and item.shape else 0

    def variables(self, names: Iterable[str]) -> dict[str, xr.Variable]:
        """Return the variables that the file holds, decoded."""
        with self.access():
            present = set(self._file)
            candidates = {name: self._stored(name, present) for name in names}
        stored = {name: variable for name, variable in candidates.items() if variable is not None}
        for variable in list(stored.values()):
            # Bounds of times have no units of their own.
            bounds = variable.attrs.pop("bounds", None)
            if bounds in stored:
                stored[bounds].attrs.setdefault("units", variable.attrs["units"])
        return {name: self._decoded(name, variable) for name, variable in stored.items()}

    def _stored(self, name: str, present: Container[str]) -> xr.Variable | None:
        foreign = f"{OTHER_DIMENSION}{name}"
        inside = foreign if foreign in present else name
        if inside not in present:
            return None
        # Faster than indexing the file object.
        dataset = h5py.Dataset(h5py.h5d.open(self._file.id, inside.encode()))
        if is_bare_dimension(dataset.id):
            return None
        dims, attributes = _dimensions(dataset, name), _attributes(dataset)
        fill = _own_fill(dataset.dtype, attributes)
        recode = self._recoding(dataset) if name == QUALITY_FLAG else None
        if dataset.size * dataset.dtype.itemsize < LAZY_BYTES:
            # Small variables are read at once: most are used several times.
            values = _unfilled(np.asarray(dataset[()]), fill)
            if recode is not None:
                values = recode(values)
            return xr.Variable(dims, values, attributes, fastpath=True)
        lazy = indexing.LazilyIndexedArray(_Stored(self, dataset, fill, recode))
        return xr.Variable(dims, lazy, attributes, fastpath=True)

    def _recoding(self, dataset: h5py.Dataset) -> Recoding | None:
        kind = self._file.attrs.get("lidarops_kind", b"")
        names = [name for name in ("flag_masks", "flag_meanings") if name in dataset.attrs]
        attributes = {name: _attribute(dataset, name) for name in names}
        return recoding(attributes, kind.decode() if isinstance(kind, bytes) else kind)

    def _decoded(self, name: str, stored: xr.Variable) -> xr.Variable:
        if _is_plain(stored):
            return stored
        with reading(self.path, name):
            decoded = xr.conventions.decode_cf_variable(name, stored, decode_timedelta=False)
            return decoded if stored.nbytes >= LAZY_BYTES else decoded.load()


class _Stored(BackendArray):
    """The values of a variable, read on indexing; NaN where they are missing."""

    def __init__(
        self,
        file: _File,
        dataset: h5py.Dataset,
        fill: np.floating[Any] | None,
        recode: Recoding | None,
    ) -> None:
        self._file = file
        self._dataset = dataset
        self._fill = fill
        self._recode = recode
        self._deflated = _is_deflated(dataset)
        self.shape = dataset.shape
        self.dtype = dataset.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.BASIC
        values = indexing.explicit_indexing_adapter(key, self.shape, support, self._read)
        return np.asarray(values if self._recode is None else self._recode(values))

    def _read(self, key: tuple[Any, ...]) -> NDArray[Any]:
        if self._deflated and all(isinstance(index, slice) for index in key):
            spans = [range(size)[index] for size, index in zip(self.shape, key, strict=True)]
            if all(span.step == 1 for span in spans):
                return _unfilled(self._inflate(spans), self._fill)
        with self._file.access():
            values = np.asarray(self._dataset[key])
        return _unfilled(values, self._fill)

    def _inflate(self, spans: list[range]) -> NDArray[Any]:
        """Read a block of values chunk by chunk, faster than HDF5's own filters do."""
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
        """Return a chunk; without its part beyond the array where HDF5 has to read it."""
        chunk = self._dataset.chunks
        with self._file.access():
            skipped, data = self._dataset.id.read_direct_chunk(corner)
            if skipped:
                # HDF5 may store a chunk without some of the filters.
                inside = (slice(at, at + step) for at, step in zip(corner, chunk, strict=True))
                return np.asarray(self._dataset[tuple(inside)])
        with reading(self._file.path):
            return inflate_chunk(data, chunk, self.dtype)


def _shared(span: range, corner: int, step: int) -> tuple[slice, slice]:
    """Return the overlap of requested values and a chunk, as slices into either."""
    first, last = max(span.start, corner), min(span.stop, corner + step)
    return slice(first - span.start, last - span.start), slice(first - corner, last - corner)


def _is_deflated(dataset: h5py.Dataset) -> bool:
    """Whether every chunk is stored, shuffled and deflated, without other filters."""
    if dataset.chunks is None:
        return False
    layout = dataset.id.get_create_plist()
    filters = [layout.get_filter(number)[0] for number in range(layout.get_nfilters())]
    chunks = math.prod(map(_count, dataset.shape, dataset.chunks))
    plain = dataset.dtype.kind in "iuf" and dataset.dtype.isnative
    return plain and filters == _FILTERS and dataset.id.get_num_chunks() == chunks


def _own_fill(dtype: np.dtype[Any], attributes: dict[str, Any]) -> np.floating[Any] | None:
    """Remove and return the fill value of a float without other coding, as in our products."""
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
    """Whether the numbers in the file need no decoding."""
    coded = stored.attrs.keys() - {"units"} or _has_time_units(stored.attrs)
    return stored.dtype.kind in "iuf" and not coded


def _has_time_units(attributes: Mapping[str, Any]) -> bool:
    return " since " in str(attributes.get("units", ""))


def _count(size: int, step: int) -> int:
    return -(-size // step)


def _dimensions(dataset: h5py.Dataset, name: str) -> tuple[str, ...]:
    """Return the names of the dimensions, which HDF5 stores as references to scales."""
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
    present = [name for name in _ATTRIBUTES if h5py.h5a.exists(dataset.id, name.encode())]
    attributes = {name: _attribute(dataset, name) for name in present}
    if _has_time_units(attributes) and "bounds" in dataset.attrs:
        attributes["bounds"] = _attribute(dataset, "bounds")
    return attributes


def _attribute(dataset: h5py.Dataset, name: str) -> Any:
    value = dataset.attrs[name]
    if isinstance(value, bytes):
        return value.decode()
    # NetCDF stores a single number as an HDF5 array of length one.
    return value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
