"""Open and read products: whole ones, or some variables of many, which is faster.

Whatever a library raises for a damaged file is raised as `ProductError`, which names the file. What
a file states is checked against its size before anything of it is read: a crafted file of some kB
can state variables of many GB, or take values from other files.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import NO_FILE, LidarOpsError, ProductError
from lidarops.netcdf.stored_flags import refuse_moved_flags

NETCDF_MAGIC: Final = (b"CDF\x01", b"CDF\x02", b"CDF\x05", b"\x89HDF")
"""First bytes of NetCDF files."""
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
# Not annotated by xarray.
_STORE: Final[Any] = xr.backends.NetCDF4DataStore
_HDF5: Final = NETCDF_MAGIC[-1]
_DEFLATE_LIMIT: Final = 1032
"""Largest factor by which deflate, the only compression of our products, shrinks data (zlib)."""
_UNWRITTEN: Final = 64 * 2**20
"""Bytes that a file may state beyond that: HDF5 stores no chunk where nothing was written."""
_MEMORY_SHARE: Final = 0.5
"""Share of the memory of this machine that one variable may take; assumed."""
_GIGABYTE: Final = 1e9
_DISTRUST: Final = "lidarops does not write such files: do not trust this one"
_NO_VARIABLE: Final = b"This is a netCDF dimension but not a netCDF variable"


@contextmanager
def reading(
    path: str | Path, families: tuple[type[Exception], ...] = _OF_LIBRARIES
) -> Iterator[None]:
    """Raise what a library raises for a damaged product, by default anything, as `ProductError`."""
    try:
        yield
    except LidarOpsError:
        raise
    except NO_FILE as error:
        raise ProductError("the file is missing", file=path) from error
    except families as error:
        words = " ".join(str(error).replace(str(path), Path(path).name).split())
        raise ProductError(
            f"cannot be read: {words[:_MOST_WORDS] or type(error).__name__}",
            file=path,
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
        If it cannot be read, or states more than it can hold.
    """
    with reading(path):
        check_sizes(path, in_parts=in_parts)
        with xr.open_dataset(path, engine="netcdf4", cache=False, **decoding) as product:
            yield product


@contextmanager
def opened_stored(path: str | Path) -> Iterator[Any]:
    """Open a whole product as netCDF4 gives it, faster than `opened_product`; values are as stored.

    Yields
    ------
    netCDF4.Dataset

    Raises
    ------
    ProductError
        If it cannot be read, or states more than it can hold.
    """
    with reading(path):
        check_sizes(path)
        with _STORE.open(os.fspath(path)) as store:
            product = store.ds
            product.set_auto_maskandscale(False)
            product.set_auto_chartostring(False)
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
            store = until_closed.enter_context(_STORE.open(os.fspath(path)))
            stored = {
                name: store.open_store_variable(name, store.ds.variables[name])
                for name in names
                if name in store.ds.variables
            }
            whole = xr.Dataset(stored, attrs=store.get_attrs())
            product = xr.decode_cf(whole, decode_coords=False, decode_timedelta=False)
            refuse_moved_flags(product)
            product = product.drop_indexes(list(product.xindexes))
            for variable in product.variables.values():
                # Small variables are read at once: most are used several times.
                if variable.nbytes < LAZY_BYTES:
                    variable.load()
        with reading(path, (RuntimeError,)):
            yield product


def stored_values(path: str | Path, key: str, name: str, rows: slice = slice(None)) -> NDArray[Any]:
    """Return values of a variable of a product as stored, or some rows of them.

    Parameters
    ----------
    path : path or str
        A NetCDF-4 file.
    key : str
        Global attribute ``id`` that the product had before.
    name : str
        Of the variable.
    rows : slice
        Along its first dimension; all of a variable without dimensions.

    Raises
    ------
    ProductError
        If they cannot be read, or the file holds another product now.
    """
    # Opened some times faster than by netCDF4.
    with reading(path), h5py.File(path, "r") as file:
        if file.attrs["id"] not in (key, key.encode()):
            raise changed(path)
        stored = file[name]
        return np.asarray(stored[rows] if stored.shape else stored[()])


def changed(path: str | Path) -> ProductError:
    """Return the error of a file that holds another product than before."""
    return ProductError("changed while it was read", file=path, remedy="run again")


def check_sizes(path: str | Path, *, in_parts: bool = False) -> None:
    """Refuse a NetCDF-4 file whose variables cannot be in it, or do not fit into memory.

    Other files pass: those of NetCDF-3 are no larger in memory than on disk.

    Parameters
    ----------
    path : path or str
    in_parts : bool
        Whether no variable is read as a whole, so that it may be larger than memory.

    Raises
    ------
    ProductError
        Naming the variable.
    OSError
        If the file cannot be read.
    """
    file = Path(path)
    with file.open("rb") as stream:
        if stream.read(len(_HDF5)) != _HDF5:
            return
        size = os.fstat(stream.fileno()).st_size
    with h5py.File(file, "r") as opened:
        stated = {name: _stated_bytes(opened, name, file) for name in opened}
    largest = max(stated, key=lambda name: stated[name], default="")
    most = _DEFLATE_LIMIT * size + _UNWRITTEN
    _refuse_more(sum(stated.values()), most, file, largest, "hold")
    if not in_parts:
        memory = _MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        _refuse_more(stated.get(largest, 0), memory, file, largest, "be read on this machine")


def _refuse_more(stated: int, most: float, file: Path, field: str, able: str) -> None:
    if stated > most:
        raise ProductError(
            f"states {stated / _GIGABYTE:.3g} GB of values, but a file of {file.stat().st_size}"
            f" bytes can {able} at most {most / _GIGABYTE:.3g} GB",
            file=file,
            field=field,
            remedy=_DISTRUST,
        )


def _stated_bytes(opened: h5py.File, name: str, file: Path) -> int:
    """Return the bytes of a variable in memory; at least one chunk is read of it."""
    place = name.encode()
    hard = opened.id.links.get_info(place).type == h5py.h5l.TYPE_HARD
    # Untyped: the types of h5py differ between its releases.
    stored: Any = h5py.h5o.open(opened.id, place) if hard else None
    if isinstance(stored, h5py.h5g.GroupID):
        return 0
    # Faster than the attributes of a dataset.
    layout: Any = stored.get_create_plist() if isinstance(stored, h5py.h5d.DatasetID) else None
    if layout is None or layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
        problem = "takes its values from elsewhere, which could be any file of this machine"
        raise ProductError(problem, file=file, field=name, remedy=_DISTRUST)
    held = stored.get_type()
    if held.get_class() == h5py.h5t.VLEN:
        problem = "has values of variable length, and does not state how large they are"
        raise ProductError(problem, file=file, field=name, remedy=_DISTRUST)
    chunk = math.prod(layout.get_chunk()) if layout.get_layout() == h5py.h5d.CHUNKED else 0
    # A dimension without variable holds no values.
    scale = h5py.h5ds.get_scale_name(stored) if h5py.h5ds.is_scale(stored) else b""
    bare = scale.startswith(_NO_VARIABLE)
    values = 0 if bare else stored.get_space().get_simple_extent_npoints()
    return int(held.get_size() * max(values, chunk))
