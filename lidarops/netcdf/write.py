"""The only writer of NetCDF files: writes atomically, with the same bytes for the same data."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import h5py
import netCDF4
import numpy as np
import xarray as xr
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK

from lidarops.errors import ProductError
from lidarops.netcdf._deflate import Offset, deflate_chunks

COMPRESSION_LEVEL: Final = 4
CHUNK_BYTES: Final = 1 << 20
"""Largest chunk: a chunk is the whole variable, or as many whole rows as fit."""

BULK_BYTES: Final = 1 << 14
"""Smallest variable that ISA-L deflates: ten times faster, and a little larger in the file."""

_TYPES: Final = {"S1", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"}
_Chunks = dict[str, list[tuple[Offset, bytes]]]
_Format = Literal["NETCDF4", "NETCDF4_CLASSIC"]


@dataclass(frozen=True, slots=True)
class Written:
    """A file that was written."""

    sha256: str
    size: int


def write_product(dataset: xr.Dataset, path: str | Path) -> Written:
    """Write a product.

    The file appears under its name when it is complete and on disk, or not at all; a former file
    stays until then. Equal datasets give equal bytes with equal versions of netCDF4, h5py and isal
    on one processor architecture. Thread-safe, unlike netCDF4.

    Parameters
    ----------
    dataset : xr.Dataset
        From `lidarops.netcdf.build.build_dataset`: encoded, in memory.
    path : path or str
        Path of the file; missing folders are created.

    Returns
    -------
    Written

    Raises
    ------
    ProductError
        If the dataset is not in memory, or the file cannot be written.
    """
    return _write(dataset, Path(path), "NETCDF4_CLASSIC")


def write_plain(dataset: xr.Dataset, path: str | Path) -> Written:
    """Write any dataset as xarray would encode it, atomically and with reproducible bytes.

    Parameters
    ----------
    dataset : xr.Dataset
        In memory; may hold times and text.
    path : path or str
        Path of the file; missing folders are created.

    Returns
    -------
    Written

    Raises
    ------
    ProductError
        If the dataset is not in memory, cannot be encoded, or the file cannot be written.
    """
    _refuse_lazy(dataset, path)
    variables, attributes = xr.conventions.encode_dataset_coordinates(dataset)
    try:
        encoded, attributes = xr.conventions.cf_encoder(variables, attributes)
    except (TypeError, ValueError) as error:
        raise ProductError(f"cannot be encoded: {error}", file=path) from error
    # All as data variables: xarray would encode coordinates a second time.
    plain = {str(name): _as_chars(path, str(name), var) for name, var in encoded.items()}
    return _write(xr.Dataset(plain, attrs=dict(attributes)), Path(path), "NETCDF4")


def _as_chars(path: str | Path, name: str, variable: xr.Variable) -> xr.Variable:
    values = np.asarray(variable.values)
    if values.dtype.kind not in "OU":
        return variable
    if not all(isinstance(value, str) for value in values.flat):
        raise ProductError("holds objects that are not text", file=path, field=name)
    # Text of variable length lies on HDF5's heap, whose byte order is not reproducible.
    packed = np.char.encode(values.astype(str), "utf-8")
    length = max(packed.dtype.itemsize, 1)
    chars = np.ascontiguousarray(packed.astype(f"S{length}"))
    return xr.Variable(
        (*variable.dims, f"{name}_strlen"),
        chars.reshape(*packed.shape, 1).view("S1"),
        {**variable.attrs, "_Encoding": "utf-8"},
    )


def chunk_sizes(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Return the chunk shape of a variable: all of it, or whole rows up to about 1 MiB.

    Parameters
    ----------
    shape : tuple of int
    itemsize : int
        Bytes of an element.

    Returns
    -------
    tuple of int
    """
    chunk = list(shape)
    for axis in range(len(chunk)):
        rest = int(np.prod(chunk[axis + 1 :], dtype=np.int64)) * itemsize
        chunk[axis] = max(1, min(chunk[axis], CHUNK_BYTES // max(rest, 1)))
        if rest <= CHUNK_BYTES:
            break
    return tuple(chunk)


def _refuse_lazy(dataset: xr.Dataset, path: str | Path) -> None:
    for name, variable in dataset.variables.items():
        if variable.chunks is not None:
            raise ProductError(
                "is a dask array, whose bytes in a file depend on the order of its tasks",
                file=path,
                field=str(name),
                remedy="load the dataset before it is written",
            )


def _write(dataset: xr.Dataset, path: Path, model: _Format) -> Written:
    _refuse_lazy(dataset, path)
    _refuse_unstorable(dataset, path)
    bulk = [str(name) for name in dataset.variables if _is_bulk(dataset, str(name))]
    with _replacing(path) as temporary:
        with NETCDF4_PYTHON_LOCK:
            _store(dataset, temporary, model, without=bulk)
        if bulk:
            # No lock: ISA-L lets the other threads go on.
            chunks = {name: _deflated(dataset.variables[name]) for name in bulk}
            temporary.write_bytes(_filled(temporary.read_bytes(), dataset, chunks))
        return _settle(temporary)


def _is_bulk(dataset: xr.Dataset, name: str) -> bool:
    variable = dataset.variables[name]
    # netCDF renames variables in HDF5 whose names are not ASCII, or are those of other dimensions.
    same_name = name.isascii() and (name not in dataset.sizes or variable.dims[:1] == (name,))
    return variable.nbytes >= BULK_BYTES and same_name


def _deflated(variable: xr.Variable) -> list[tuple[Offset, bytes]]:
    native = variable.dtype.newbyteorder("=")
    fill = variable.attrs.get("_FillValue", netCDF4.default_fillvals[native.str[1:]])
    chunk = chunk_sizes(variable.shape, native.itemsize)
    return list(deflate_chunks(variable.values.astype(native, copy=False), chunk, fill))


def _filled(image: bytes, dataset: xr.Dataset, chunks: _Chunks) -> bytes:
    """Return the image of a file with the chunks of its still empty variables filled in."""
    with NETCDF4_PYTHON_LOCK, h5py.File.in_memory(image, block_size=CHUNK_BYTES) as file:
        for name, parts in chunks.items():
            target = file[name]
            # The unlimited dimension has no length yet.
            target.resize(dataset.variables[name].shape)
            for offset, data in parts:
                target.id.write_direct_chunk(offset, data)
        file.flush()
        complete: bytes = file.id.get_file_image()
        return complete


def _refuse_unstorable(dataset: xr.Dataset, path: Path) -> None:
    for name, variable in dataset.variables.items():
        if variable.dtype.str[1:] not in _TYPES:
            raise ProductError(
                f"has data of type {variable.dtype}, which NetCDF cannot hold",
                file=path,
                field=str(name),
                remedy="encode it first",
            )
        if variable.size == 0:
            raise ProductError("is empty", file=path, field=str(name))


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` at the end, and is removed on failure."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
        _sync(path.parent)
    # netCDF4 reports a full disk as RuntimeError.
    except (OSError, RuntimeError) as error:
        raise ProductError(
            f"cannot be written: {error}",
            file=path,
            remedy="check that the folder is writable and the disk has space, then run again",
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _settle(path: Path) -> Written:
    _sync(path)
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
    return Written(digest.hexdigest(), path.stat().st_size)


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


def _store(dataset: xr.Dataset, path: Path, model: _Format, *, without: Container[str]) -> None:
    """Write everything except the data of the variables in `without`."""
    unlimited = dataset.encoding.get("unlimited_dims", ())
    # In memory until the end, because HDF5 may crash on a full disk.
    with _DefinedAtOnce(
        path, "w", format=model, clobber=False, diskless=True, persist=True
    ) as file:
        file.setncatts(dataset.attrs)
        for name, size in dataset.sizes.items():
            file.createDimension(str(name), None if name in unlimited else size)
        targets = {
            str(name): _define(file, str(name), variable)
            for name, variable in dataset.variables.items()
        }
        file.end_definitions()
        for name, target in targets.items():
            if name not in without:
                target[...] = dataset.variables[name].values


def _define(file: netCDF4.Dataset, name: str, variable: xr.Variable) -> Any:
    attributes = dict(variable.attrs)
    storage: dict[str, Any] = {}
    if variable.dims:
        storage = {
            "compression": "zlib",
            "complevel": COMPRESSION_LEVEL,
            "shuffle": True,
            "chunksizes": chunk_sizes(variable.shape, variable.dtype.itemsize),
        }
    target = file.createVariable(
        name,
        variable.dtype.newbyteorder("="),
        [str(dim) for dim in variable.dims],
        fill_value=attributes.pop("_FillValue", None),
        **storage,
    )
    target.set_auto_maskandscale(False)
    target.set_auto_chartostring(False)
    target.setncatts(attributes)
    return target
