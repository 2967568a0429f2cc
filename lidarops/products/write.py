"""The only writer of NetCDF files: whole or not at all, and the same bytes every time."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import netCDF4
import numpy as np
import xarray as xr
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK

from lidarops.errors import ProductError

COMPRESSION_LEVEL: Final = 4
CHUNK_BYTES: Final = 1 << 20
"""A chunk is the whole variable, or as many whole rows of it as fit here."""

_Format = Literal["NETCDF4", "NETCDF4_CLASSIC"]


@dataclass(frozen=True, slots=True)
class Written:
    """A file that was written."""

    sha256: str
    size: int


def write(dataset: xr.Dataset, path: str | Path) -> Written:
    """Write a product.

    The file appears under its name when it is complete and on disk, or not at all; what stood
    there before stays until then. Equal datasets give equal bytes with equal versions of netCDF
    and HDF5. Safe in threads, which netCDF4 alone is not.

    Parameters
    ----------
    dataset : xr.Dataset
        From `lidarops.products.build.build`: encoded, in memory.
    path : path or str
        The file; missing folders are made.

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
    """Write any dataset as xarray would encode it, as safely and with the same bytes every time.

    Parameters
    ----------
    dataset : xr.Dataset
        In memory; may hold times and text.
    path : path or str
        The file; missing folders are made.

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
    # As data variables: what xarray holds as coordinates it would encode a second time.
    plain = {str(name): _as_chars(path, str(name), each) for name, each in encoded.items()}
    return _write(xr.Dataset(plain, attrs=dict(attributes)), Path(path), "NETCDF4")


def _as_chars(path: str | Path, name: str, variable: xr.Variable) -> xr.Variable:
    values = np.asarray(variable.values)
    if values.dtype.kind not in "OU":
        return variable
    if not all(isinstance(value, str) for value in values.flat):
        raise ProductError("holds objects that are no text", file=path, field=name)
    # Text of variable length lies on HDF5's heap, where no order of bytes is promised.
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
    with _replacing(path) as temporary:
        with NETCDF4_PYTHON_LOCK:
            _store(dataset, temporary, model)
        return _settle(temporary)


def _refuse_unstorable(dataset: xr.Dataset, path: Path) -> None:
    for name, variable in dataset.variables.items():
        if variable.dtype.kind not in "iufS":
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
    """Give a temporary file that takes the place of `path` at the end, and is gone on failure."""
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
            remedy="see that the folder can be written and the disk has space, then run again",
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


def _store(dataset: xr.Dataset, path: Path, model: _Format) -> None:
    unlimited = dataset.encoding.get("unlimited_dims", ())
    with netCDF4.Dataset(path, "w", format=model, clobber=False) as file:
        file.setncatts(dataset.attrs)
        for name, size in dataset.sizes.items():
            file.createDimension(str(name), None if name in unlimited else size)
        targets = {
            str(name): _define(file, str(name), variable)
            for name, variable in dataset.variables.items()
        }
        for name, target in targets.items():
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
        variable.dtype,
        [str(dim) for dim in variable.dims],
        fill_value=attributes.pop("_FillValue", None),
        **storage,
    )
    target.set_auto_maskandscale(False)
    target.set_auto_chartostring(False)
    target.setncatts(attributes)
    return target
