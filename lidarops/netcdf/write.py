"""The only writer of NetCDF files: writes atomically, with the same bytes for the same data.

The chunks of a file are deflated and written as soon as their rows are there, so memory does not
grow with the file. Their order depends on the data only, not on how many rows came at a time.

Chunks are shuffled and deflated here, faster than HDF5 does, in the format of its filters `shuffle`
and `deflate`, so any NetCDF reader can read them. The whole writing of a `signal` product of one
real day, from values in memory to the digest of the file, takes 2.4 times less CPU than with HDF5's
own filters at level 4 of zlib (files are 5 % larger), and 2 times less than at level 1 (files are
5 % smaller): one channel of Pilar (8.5 MB of values), medians of five paired repeats. ISA-L is
faster, but one chunk of some 3,500 had another stream for the same data.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import secrets
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, cast

import h5py
import numpy as np
import xarray as xr
from deflate import zlib_compress
from netCDF4 import default_fillvals
from numpy.typing import NDArray
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK

from lidarops.errors import ProductError
from lidarops.netcdf.stored import OTHER_DIMENSION
from lidarops.system.files import sha256_of, write_atomically

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

COMPRESSION_LEVEL: Final = 4
CHUNK_BYTES: Final = 1 << 20
"""Largest chunk: a chunk is the whole variable, or as many whole rows as fit."""
CONTIGUOUS_BYTES: Final = 2048
"""Up to this size, a variable without rows is stored as it is."""

_EMPTY: Final = bytes.fromhex(
    "894844460d0a1a0a020808000000000000000000300000000000000028010000000000006100000000000000"
    "d66e27994f48445202208d070e6b8d070e6b8d070e6b8d070e6b161307000500020010000400000700000000"
    "00000000000324d95f4f484452021c00100000b802220000000000030000000000000000ffffffffffffffff"
    "ffffffffffffffffffffffffffffffff0a0600010000000100100000007e"
).ljust(292, b"\0") + bytes.fromhex("f80a5cda")
"""A file of HDF5 without content, made with properties that h5py cannot set: indexes of chunks hold
4 chunks in a node (`H5Pset_istore_k` 2, not 32), and the root group keeps its links and attributes
in its header (`H5Pset_link_phase_change` and `H5Pset_attr_phase_change` 4096, not 8)."""
_MOST_ATTRIBUTES: Final = 4096
"""Most attributes of a variable in its header; HDF5 has 8 by default."""
_SCALAR: Final = h5py.h5s.create(h5py.h5s.SCALAR)
_Array = NDArray[Any]

_LEVEL: Final = 1
"""Compression level of libdeflate, 1 to 12; level 2 takes a sixth longer for 5 % smaller files."""


@dataclass(frozen=True, slots=True)
class Written:
    """A file that was written."""

    sha256: str
    size: int


def write_product(dataset: xr.Dataset, path: str | Path) -> Written:
    """Write an encoded dataset that is in memory.

    The file appears under its name when it is complete and on disk, or not at all; a former file
    stays until then. Equal datasets give equal bytes with equal versions of netCDF4, h5py and
    libdeflate on one processor architecture. Thread-safe, unlike netCDF4.

    Parameters
    ----------
    dataset : xr.Dataset
        Encoded, in memory; with at most one unlimited dimension.
    path : path or str
        Path of the file; missing folders are created.

    Raises
    ------
    ProductError
        If the file cannot be written.
    """
    unlimited = next((str(name) for name in dataset.encoding.get("unlimited_dims", ())), None)
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    skeleton = Skeleton(variables, dataset.attrs, unlimited)
    with create_file(skeleton, Path(path)) as file:
        rows = {name: variable.values for name, variable in skeleton.with_rows.items()}
        if rows:
            file.add(rows)
    return cast("Written", file.written)


def write_plain(dataset: xr.Dataset, path: Path) -> None:
    """Write any dataset as xarray encodes it, atomically and with reproducible bytes.

    Parameters
    ----------
    dataset : xr.Dataset
        May hold times and text.
    path : Path
        Missing folders are created.

    Raises
    ------
    ProductError
        If the dataset cannot be encoded, or the file cannot be written.
    """
    # Text of variable length lies on HDF5's heap, whose byte order is not reproducible.
    encoding: dict[Any, dict[str, Any]] = {
        name: {"dtype": "S1"} if variable.dtype.kind == "U" else {"zlib": True}
        for name, variable in dataset.variables.items()
    }
    with _disk_errors(path), TemporaryDirectory() as folder:
        whole = Path(folder, path.name)
        try:
            dataset.to_netcdf(whole, engine="netcdf4", encoding=encoding)
        except (TypeError, ValueError) as error:
            raise ProductError(f"cannot be encoded: {error}", file=path) from error
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, whole.read_bytes())


def chunk_sizes(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Return the chunk shape of a variable: all of it, or whole rows up to about 1 MiB.

    Parameters
    ----------
    shape : tuple of int
    itemsize : int
        Bytes of an element.
    """
    chunk = list(shape)
    for axis in range(len(chunk)):
        rest = math.prod(chunk[axis + 1 :]) * itemsize
        chunk[axis] = max(1, min(chunk[axis], CHUNK_BYTES // max(rest, 1)))
        if rest <= CHUNK_BYTES:
            break
    return tuple(chunk)


class Skeleton:
    """All of a file except the values of its rows, which may come later, some at a time.

    The rows are those along the unlimited dimension, of the variables that have it first.

    Parameters
    ----------
    variables : mapping of str to xr.Variable
        Encoded, in the order of the file. Of variables with rows, the values are not used.
    attributes : mapping
    unlimited : str or None
    """

    def __init__(
        self,
        variables: Mapping[str, xr.Variable],
        attributes: Mapping[str, Any],
        unlimited: str | None,
    ) -> None:
        self.variables, self.attributes, self.unlimited = variables, attributes, unlimited
        self.sizes: dict[str, int] = {}
        """Length of every dimension, in the order of the file."""
        self.with_rows: dict[str, xr.Variable] = {}
        self.chunks: dict[str, tuple[int, ...]] = {}
        """Chunk shapes of the variables that are not stored as they are."""
        for name, variable in variables.items():
            self.sizes |= {str(dim): size for dim, size in variable.sizes.items()}
            if variable.dims and variable.dims[0] == unlimited:
                self.with_rows[name] = variable
            large = variable.dims and variable.nbytes > CONTIGUOUS_BYTES
            if unlimited in variable.dims or large:
                self.chunks[name] = chunk_sizes(variable.shape, variable.dtype.itemsize)


class QuietFile(io.FileIO):
    """A local file for HDF5, which may crash where it cannot write.

    It keeps its first error, and from then on drops what is written.

    Parameters
    ----------
    path : Path
        Where no file exists.

    Raises
    ------
    OSError
        If the file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+")
        self.error: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write all of `data`, and return its length even where it was dropped."""
        rest = memoryview(data)
        size = rest.nbytes
        try:
            while rest and self.error is None:
                rest = rest[self._write_some(rest) :]
        except OSError as error:
            self.error = error
        return size

    def _write_some(self, data: memoryview) -> int:
        """Write as much as the disk takes at once, and return its length."""
        return super().write(data)

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size of the file, unless it failed before."""
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0


@contextmanager
def create_file(
    skeleton: Skeleton,
    path: Path,
    replaces: Callable[[Path], bool] = lambda _new: True,
) -> Iterator[RowFile]:
    """Yield a file to which rows are added; at the end it is complete, on disk and has its name.

    Several threads may write files at once.

    Parameters
    ----------
    skeleton : Skeleton
    path : Path
        Missing folders are created. A former file is replaced at the end, and stays if anything
        fails.
    replaces : callable
        Returns of the complete file, under its temporary name, whether it replaces the former one.

    Raises
    ------
    ProductError
        If the file cannot be written, or lacks rows at the end.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with _disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = QuietFile(temporary)
        with stream:
            file = RowFile(skeleton, path, stream)
            try:
                file.define(skeleton)
                yield file
                file.complete()
            finally:
                file.close()
        with _disk_errors(path):
            _sync(temporary)
            written = Written(sha256_of(temporary), temporary.stat().st_size)
        if not replaces(temporary):
            return
        with _disk_errors(path):
            temporary.replace(path)
            _sync(path.parent)
        file.written = written
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


class RowFile:
    """A file that is being written; see `create_file`."""

    written: Written | None = None
    """The file, once it is complete and has its name."""

    def __init__(self, skeleton: Skeleton, path: Path, stream: QuietFile) -> None:
        self._variables = skeleton.variables
        self._path = path
        self._stream = stream
        self._rows = 0
        self._chunks = skeleton.chunks
        self._held: dict[str, list[_Array]] = {name: [] for name in skeleton.with_rows}
        """The last rows of each variable, whose chunk is incomplete."""
        self._total = skeleton.sizes[str(skeleton.unlimited)] if self._held else 0
        self._targets: dict[str, Any] = {}
        stream.write(_EMPTY)
        with _disk_errors(path), NETCDF4_PYTHON_LOCK:
            self._file = h5py.File(stream, "r+", libver=("v108", "v108"))

    def define(self, skeleton: Skeleton) -> None:
        """Write all definitions, and the variables without rows."""
        with _disk_errors(self._path), NETCDF4_PYTHON_LOCK:
            self._targets = _define(skeleton, self._file.id)
        for name, variable in skeleton.variables.items():
            if name not in skeleton.with_rows:
                self.write(name, 0, variable.values)

    def add(self, rows: Mapping[str, _Array]) -> None:
        """Write the next rows.

        Parameters
        ----------
        rows : mapping of str to ndarray, shape (n, ...)
            Values of every variable that has rows, with its type and shape; n is at least 1, and
            at most the number of rows that are missing. Those of incomplete chunks are copied.

        Raises
        ------
        ProductError
            If they cannot be written.
        """
        blocks = [
            (first + len(values), name, first, values)
            for name in self._held
            for first, values in self._complete_chunks(name, rows[name])
        ]
        # Among blocks with the same last row, the order of variables stays.
        blocks.sort(key=itemgetter(0))
        for _, name, first, values in blocks:
            self.write(name, first, values)
        self._rows += len(next(iter(rows.values())))

    def _complete_chunks(self, name: str, rows: _Array) -> Iterator[tuple[int, _Array]]:
        """Yield first row and rows of the chunks that the next rows complete; hold the rest."""
        step, held = self._chunks[name][0], self._held[name]
        first = self._rows - self._rows % step
        while len(rows):
            size = min(step, self._total - first)
            missing = size - sum(map(len, held))
            if len(rows) < missing:
                held.append(rows.copy())
                return
            pieces = [*held, rows[:missing]]
            rows = rows[missing:]
            yield first, pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
            held.clear()
            first += size

    def write(self, name: str, begin: int, values: _Array) -> None:
        """Write a whole variable, or whole chunks from a row on."""
        variable = self._variables[name]
        native = values.astype(_native(variable), copy=False)
        if name not in self._chunks:
            with _disk_errors(self._path), NETCDF4_PYTHON_LOCK:
                self._targets[name].write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(native))
            return
        chunks = deflate_chunks(native, self._chunks[name], _fill_value(variable))
        with _disk_errors(self._path):
            # Deflated without the lock, so that other threads go on.
            for (first, *others), data in chunks:
                with NETCDF4_PYTHON_LOCK:
                    self._targets[name].write_direct_chunk((begin + first, *others), data)
                if self._stream.error is not None:
                    raise self._stream.error

    def complete(self) -> None:
        """Close the file, if all rows came and are in it."""
        if self._rows != self._total:
            raise ProductError(f"has {self._rows} of {self._total} rows", file=self._path)
        with _disk_errors(self._path):
            with NETCDF4_PYTHON_LOCK:
                self._file.close()
            if self._stream.error is not None:
                raise self._stream.error

    def close(self) -> None:
        """Close the file; where it is not complete, write nothing more."""
        self._stream.error = self._stream.error or OSError("the file is discarded")
        with NETCDF4_PYTHON_LOCK:
            self._file.close()


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """Raise errors of disks and libraries as `ProductError`."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise ProductError(
            f"cannot be written: {error}",
            file=path,
            remedy="check that the folder is writable and the disk has space, then run again",
        ) from error


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _define(skeleton: Skeleton, root: Any) -> dict[str, Any]:
    """Define a file after the NetCDF-4 classic model; return its HDF5 datasets by variable.

    netCDF-C would write attributes from the ninth of a variable on, and the index of its chunks,
    in blocks of some kB each: most of a small product.
    """
    sizes = skeleton.sizes
    # HDF5 may know a variable by its name where no other dimension has it.
    inside = {
        name: name if name not in sizes or one.dims == (name,) else f"{OTHER_DIMENSION}{name}"
        for name, one in skeleton.variables.items()
    }
    found = {
        name: _dataset(root, inside[name], variable, skeleton.chunks.get(name), skeleton.unlimited)
        for name, variable in skeleton.variables.items()
    }
    scales: dict[str, Any] = {}
    uses: dict[str, list[tuple[Any, int]]] = {}
    for number, (dim, size) in enumerate(sizes.items()):
        if inside.get(dim) == dim:
            scales[dim], label = found[dim], dim
        else:
            unused = xr.Variable(dim, np.broadcast_to(np.float32(0), size))
            chunk = (1,) if dim == skeleton.unlimited else None
            scales[dim] = _dataset(root, dim, unused, chunk, skeleton.unlimited)
            label = f"This is a netCDF dimension but not a netCDF variable. {size:10d}"
        h5py.h5ds.set_scale(scales[dim], label.encode())
        _write_attributes(scales[dim], {"_Netcdf4Dimid": np.int32(number)})
        uses[dim] = []
    for name, variable in skeleton.variables.items():
        attributes = dict(variable.attrs)
        if "_FillValue" in attributes:
            # As netCDF-C does: first, and in the type of the variable.
            fill = np.array(attributes.pop("_FillValue"), _native(variable))
            attributes = {"_FillValue": fill, **attributes}
        if variable.dims and inside[name] not in scales:
            axes = np.empty(variable.ndim, h5py.vlen_dtype(h5py.ref_dtype))
            for axis, dim in enumerate(map(str, variable.dims)):
                axes[axis] = np.array([_reference(scales[dim])], h5py.ref_dtype)
                uses[dim].append((_reference(found[name]), axis))
            attributes["DIMENSION_LIST"] = axes
        _write_attributes(found[name], attributes)
    use = np.dtype([("dataset", h5py.ref_dtype), ("dimension", np.uint32)])
    for dim, used in uses.items():
        if used:
            _write_attributes(scales[dim], {"REFERENCE_LIST": np.array(used, use)})
    _write_attributes(root, {**skeleton.attributes, "_nc3_strict": np.int32(1)})
    return found


def _reference(dataset: Any) -> Any:
    return h5py.h5r.create(dataset, b".", h5py.h5r.OBJECT)


def _dataset(
    root: Any,
    name: str,
    variable: xr.Variable,
    chunk: tuple[int, ...] | None,
    unlimited: str | None,
) -> Any:
    """Return a new dataset of HDF5, without values."""
    storage = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    storage.set_obj_track_times(track_times=False)
    storage.set_attr_creation_order(h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED)
    storage.set_attr_phase_change(_MOST_ATTRIBUTES, 0)
    storage.set_fill_value(np.array(_fill_value(variable), _native(variable)))
    if chunk:
        storage.set_chunk(chunk)
        storage.set_shuffle()
        storage.set_deflate(COMPRESSION_LEVEL)
    limits = tuple(
        h5py.h5s.UNLIMITED if dim == unlimited else size for dim, size in variable.sizes.items()
    )
    space = h5py.h5s.create_simple(variable.shape, limits) if limits else _SCALAR
    link = h5py.h5p.create(h5py.h5p.LINK_CREATE)
    link.set_char_encoding(h5py.h5t.CSET_UTF8)
    inside = unicodedata.normalize("NFC", name).encode()
    sort = h5py.h5t.py_create(_native(variable))
    return h5py.h5d.create(root, inside, sort, space, storage, link)


def _write_attributes(owner: Any, attributes: Mapping[str, Any]) -> None:
    """Write attributes of a file or a variable as netCDF-C does: numbers as vectors."""
    for name, value in attributes.items():
        data = np.array(value.encode()) if isinstance(value, str) else np.atleast_1d(value)
        space = h5py.h5s.create_simple(data.shape) if data.ndim else _SCALAR
        sort = h5py.h5t.py_create(data.dtype, logical=True)
        h5py.h5a.create(owner, name.encode(), sort, space).write(data)


def _native(variable: xr.Variable) -> np.dtype[Any]:
    native: np.dtype[Any] = variable.dtype.newbyteorder("=")
    return native


def _fill_value(variable: xr.Variable) -> Any:
    """Return what values that are not written have, as netCDF-C sets it."""
    return variable.attrs.get("_FillValue", default_fillvals[_native(variable).str[1:]])


def deflate_chunks(
    values: NDArray[Any], chunk: tuple[int, ...], fill_value: Any
) -> Iterator[tuple[tuple[int, ...], bytes]]:
    """Cut an array into chunks, and shuffle and deflate each.

    Equal values give equal bytes, with one version of libdeflate on one architecture of
    processor.

    Parameters
    ----------
    values : ndarray, shape (n_0, ..., n_k)
        In the byte order of the file, with any memory layout.
    chunk : tuple of int, length k + 1
        Elements of a chunk along each axis, each at least 1.
    fill_value : scalar
        Fills the part of a last chunk beyond the array, as HDF5 does.

    Yields
    ------
    offset : tuple of int
        Index of the chunk's first element.
    data : bytes
        A zlib stream.
    """
    corners = (range(0, size, step) for size, step in zip(values.shape, chunk, strict=True))
    for offset in itertools.product(*corners):
        part = values[tuple(slice(at, at + step) for at, step in zip(offset, chunk, strict=True))]
        if part.shape != chunk:
            whole = np.full(chunk, fill_value, dtype=values.dtype)
            whole[tuple(slice(size) for size in part.shape)] = part
            part = whole
        yield offset, bytes(zlib_compress(b"".join(map(bytes, _planes(part))), _LEVEL))


def _planes(part: NDArray[Any]) -> Iterator[NDArray[np.uint8]]:
    """Yield the first bytes of all elements, then the second bytes: the order of HDF5's `shuffle`.

    Parameters
    ----------
    part : ndarray
        Elements have 1, 2, 4 or 8 bytes.

    Yields
    ------
    ndarray of uint8, shape (size,)
    """
    plain = np.ascontiguousarray(part).reshape(-1)
    words = plain.view(f"<u{plain.itemsize}")
    for shift in range(0, 8 * plain.itemsize, 8):
        yield (words >> words.dtype.type(shift)).astype(np.uint8)
