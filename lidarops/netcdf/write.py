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
import netCDF4
import numpy as np
import xarray as xr
from deflate import zlib_compress
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
"""Up to this size, a variable without rows is stored as it is: the index of a chunk takes 2.1 kB.
"""

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
        An existing file.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r+")
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
            with NETCDF4_PYTHON_LOCK:
                _store(skeleton, temporary)
            stream = QuietFile(temporary)
        with stream:
            file = RowFile(skeleton, path, stream)
            try:
                for name, variable in skeleton.variables.items():
                    if name in skeleton.chunks and name not in skeleton.with_rows:
                        file.write(name, 0, variable.values)
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
        self._targets = {}
        with _disk_errors(path), NETCDF4_PYTHON_LOCK:
            self._file = h5py.File(stream, "r+")
            for name in self._chunks:
                variable = self._variables[name]
                other = name in skeleton.sizes and variable.dims[0] != name
                inside = unicodedata.normalize("NFC", f"{OTHER_DIMENSION if other else ''}{name}")
                self._targets[name] = h5py.h5d.open(self._file.id, inside.encode())
                # Its final length.
                self._targets[name].set_extent(variable.shape)

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
        """Write whole chunks of a variable, from a row on."""
        variable = self._variables[name]
        native = variable.dtype.newbyteorder("=")
        fill = variable.attrs.get("_FillValue", netCDF4.default_fillvals[native.str[1:]])
        chunks = deflate_chunks(values.astype(native, copy=False), self._chunks[name], fill)
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


class _DefinedAtOnce(netCDF4.Dataset):
    """A file whose dimensions, variables and attributes are written together.

    In the classic model, netCDF4 rewrites all definitions after each new one, which takes as long
    as the rest of a small product.
    """

    def _enddef(self) -> None:
        """Stay in define mode; netCDF4 calls this after each definition."""

    def end_definitions(self) -> None:
        """Write the definitions, and leave define mode."""
        super()._enddef()  # type: ignore[misc]  # not in its stubs


def _store(skeleton: Skeleton, path: Path) -> None:
    """Write all definitions and the variables without chunks."""
    # In memory until the end, because HDF5 may crash on a full disk.
    with _DefinedAtOnce(
        path, "w", format="NETCDF4_CLASSIC", clobber=False, diskless=True, persist=True
    ) as file:
        file.setncatts(skeleton.attributes)
        for name, size in skeleton.sizes.items():
            file.createDimension(name, None if name == skeleton.unlimited else size)
        targets: dict[str, Any] = {}
        for name, variable in skeleton.variables.items():
            attributes, chunk = dict(variable.attrs), skeleton.chunks.get(name)
            targets[name] = file.createVariable(
                name,
                variable.dtype.newbyteorder("="),
                [str(dim) for dim in variable.dims],
                fill_value=attributes.pop("_FillValue", None),
                compression="zlib" if chunk else None,
                complevel=COMPRESSION_LEVEL,
                shuffle=True,
                chunksizes=chunk,
            )
            targets[name].set_auto_maskandscale(False)
            targets[name].set_auto_chartostring(False)
            targets[name].setncatts(attributes)
        file.end_definitions()
        for name, target in targets.items():
            if name not in skeleton.chunks:
                target[...] = skeleton.variables[name].values


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
