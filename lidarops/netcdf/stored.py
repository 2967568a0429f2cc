"""Read variables and attributes of products by HDF5 alone, without xarray and netCDF4.

Whatever a library raises for a damaged file is raised as `ProductError`, which names the file. What
a file states is checked against its size before anything of it is read: a crafted file of some kB
can state variables of many GB, or take values from other files.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import h5py
import numpy as np
from h5py import AttributeManager, h5, h5a, h5d, h5ds, h5g, h5l, h5o, h5s, h5t
from numpy.typing import NDArray

from lidarops.errors import NO_FILE, LidarOpsError, ProductError

HDF5: Final = b"\x89HDF"
"""First bytes of NetCDF-4 files."""
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
_DEFLATE_LIMIT: Final = 1032
"""Largest factor by which deflate, the only compression of our products, shrinks data (zlib)."""
_UNWRITTEN: Final = 64 * 2**20
"""Bytes that a file may state beyond that: HDF5 stores no chunk where nothing was written."""
_MEMORY_SHARE: Final = 0.5
"""Share of the memory of this machine that one variable may take; assumed."""
_GIGABYTE: Final = 1e9
_DISTRUST: Final = "lidarops does not write such files: do not trust this one"
_NO_VARIABLE: Final = b"This is a netCDF dimension but not a netCDF variable"
OTHER_DIMENSION: Final = "_nc4_non_coord_"
"""Prefix in HDF5 of a variable that has the name of a dimension but does not lie along it."""
_OF_HDF5: Final = (
    b"CLASS", b"NAME", b"DIMENSION_LIST", b"REFERENCE_LIST", b"_NCProperties", b"_nc3_strict",
    b"_Netcdf4Coordinates", b"_Netcdf4Dimid",
)  # fmt: skip
"""Attributes by which HDF5 and NetCDF keep dimensions, which NetCDF does not show."""


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Raise what a library raises for a damaged product as `ProductError`, which names the file."""
    try:
        yield
    except LidarOpsError:
        raise
    except NO_FILE as error:
        raise ProductError("the file is missing", file=path) from error
    except _OF_LIBRARIES as error:
        words = " ".join(str(error).replace(str(path), Path(path).name).split())
        raise ProductError(
            f"cannot be read: {words[:_MOST_WORDS] or type(error).__name__}",
            file=path,
            remedy="restore it from a copy, or make it again with lidarops reprocess",
        ) from error


class Attributes(Mapping[str, Any]):
    """Attributes in the order of the file, with the values of netCDF4; each read on access.

    Parameters
    ----------
    owner : h5py.h5d.DatasetID or h5py.h5g.GroupID
    """

    def __init__(self, owner: Any) -> None:
        self._owner = owner
        self._known: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        """Return a text, a number, or an array of several."""
        if name not in self._known:
            if not h5a.exists(self._owner, name.encode()):
                raise KeyError(name)
            self._known[name] = self._read(name)
        return self._known[name]

    def whole(self) -> dict[str, Any]:
        """Return all attributes."""
        known = self._known
        self._known = {name: known[name] if name in known else self._read(name) for name in self}
        return dict(self._known)

    def _read(self, name: str) -> Any:
        stored = h5a.open(self._owner, name.encode())
        held, size = stored.get_type(), stored.get_storage_size()
        sort = held.get_class()
        # What most attributes are is read in the type of the file, which is faster.
        if sort == h5t.STRING and size in (0, held.get_size()) and not held.is_variable_str():
            text = np.zeros((), f"S{held.get_size()}")
            if size:
                stored.read(text, mtype=held)
            return text.item().decode(errors="replace")
        if sort in (h5t.INTEGER, h5t.FLOAT) and size:
            values = np.empty(size // held.get_size(), held.dtype)
            stored.read(values, mtype=held)
            return values if values.size > 1 else values[0]
        return _plain(AttributeManager(SimpleNamespace(id=self._owner))[name])

    def __iter__(self) -> Iterator[str]:
        """Return the names in order."""
        names: list[bytes] = []
        h5a.iterate(self._owner, names.append, index_type=h5.INDEX_CRT_ORDER)
        return (name.decode() for name in names if name not in _OF_HDF5)

    def __len__(self) -> int:
        """Return their number."""
        return sum(1 for _ in self)


def _plain(value: Any) -> Any:
    """Return the value of an attribute of h5py as netCDF4 gives it."""
    if not isinstance(value, np.ndarray):
        return np.empty(0, value.dtype) if isinstance(value, h5py.Empty) else value
    if value.size == 1:
        return value.reshape(-1)[0]
    return value.tolist() if value.dtype.kind == "O" else value


class StoredVariable:
    """A variable of an open NetCDF-4 file.

    Parameters
    ----------
    path : path or str
        Of the file, in messages.
    name : str
        In HDF5.
    address : int
    stored : h5py.h5d.DatasetID
    """

    def __init__(self, path: str | Path, name: str, address: int, stored: Any) -> None:
        # Each object that h5py makes of a file takes 5 us, so few are made.
        self._path, self._name, self._address, self._stored = path, name, address, stored
        layout = stored.get_create_plist()
        if layout.get_external_count() or layout.get_layout() == h5d.VIRTUAL:
            raise _from_elsewhere(path, name)
        self._type = stored.get_type()
        if self._type.get_class() == h5t.VLEN:
            problem = "has values of variable length, and does not state how large they are"
            raise ProductError(problem, file=path, field=name, remedy=_DISTRUST)
        self.shape: tuple[int, ...] = stored.shape
        chunk = layout.get_chunk() if layout.get_layout() == h5d.CHUNKED else (0,)
        self.is_scale = h5a.exists(stored, b"CLASS") and h5ds.is_scale(stored)
        """Whether it gives a dimension its length."""
        # A dimension without variable holds no values.
        self.is_bare = self.is_scale and h5ds.get_scale_name(stored).startswith(_NO_VARIABLE)
        values = 0 if self.is_bare else math.prod(self.shape)
        self.stated = self._type.get_size() * max(values, math.prod(chunk))
        """Bytes in memory; at least one chunk is read."""
        self.attrs = Attributes(stored)
        self.dims: tuple[str, ...] = ()
        self.written: tuple[str, ...] = ()
        """Its dimensions in the file, where ``altitude`` may stand for ``range``."""

    def lie_along(self, along: Mapping[tuple[int, int], str]) -> None:
        """Take its dimensions from those of a file; one without other dimensions is its own."""
        own = (f"{self._name}_{axis}" if axis else self._name for axis in range(len(self.shape)))
        self.dims = tuple(along.get((self._address, axis), name) for axis, name in enumerate(own))
        self.written = self.dims

    def attached(self) -> Iterator[tuple[int, int]]:
        """Yield the address of each variable along this dimension, and which axis of it this is."""
        key = b"REFERENCE_LIST"
        if h5a.exists(self._stored, key):
            stored = h5a.open(self._stored, key)
            held = stored.get_type()
            # References are addresses. Read as they are, which is faster than to follow each.
            pairs = np.empty(stored.shape, f"V{held.get_size()}")
            stored.read(pairs, mtype=held)
            parts = (("<u8", held.get_member_offset(0)), ("<i4", held.get_member_offset(1)))
            columns = (pairs.getfield(*part).tolist() for part in parts)
            yield from zip(*columns, strict=True)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values in memory."""
        stated: np.dtype[Any] = self._type.dtype
        return stated.newbyteorder("=")

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """Return values as stored.

        Raises
        ------
        ProductError
            If they cannot be read, or would not fit into memory.
        """
        self._refuse_more_than_fits(key)
        with reading(self._path):
            if self._type.get_class() == h5t.STRING and self._type.is_variable_str():
                text = h5py.Dataset(self._stored).asstr(errors="replace")
                return np.asarray(text[() if key is ... else key], object)
            # All rows are read as a whole, which takes half the time.
            if key is not ... and key != slice(0, *self.shape[:1]):
                return np.asarray(h5py.Dataset(self._stored)[key], self.dtype)
            values = np.empty(self.shape, self.dtype)
            self._stored.read(h5s.ALL, h5s.ALL, values)
            return values

    def _refuse_more_than_fits(self, key: Any) -> None:
        most = _MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if self.stated <= most:
            return
        keys = () if key is ... else key if isinstance(key, tuple) else (key,)
        taken = (
            len(range(size)[part]) if isinstance(part, slice) else np.size(part)
            for size, part in zip(self.shape, keys, strict=False)
        )
        size = self._type.get_size() * math.prod((*taken, *self.shape[len(keys) :]))
        if size > most:
            raise _too_large(size, most, "be read on this machine", self._path, self._name)


class StoredProduct:
    """An open NetCDF-4 file.

    Parameters
    ----------
    file : h5py.File
    path : path or str
        Its name, in messages.

    Raises
    ------
    ProductError
        If it states more than it can hold.
    """

    def __init__(self, file: h5py.File, path: str | Path) -> None:
        root = h5g.open(file.id, b"/")
        self.attrs = Attributes(root)
        """Global attributes."""
        stored = dict(_variables(root, path))
        _refuse_bomb({name: one.stated for name, one in stored.items()}, path)
        scales = {name: one for name, one in stored.items() if one.is_scale}
        self.sizes = {name: one.shape[0] for name, one in scales.items()}
        """Length of each dimension."""
        along = {place: name for name, one in scales.items() for place in one.attached()}
        self.variables: dict[str, StoredVariable] = {}
        """In the order of the file."""
        for name, one in stored.items():
            if not one.is_bare:
                one.lie_along(along)
                self.variables[name.removeprefix(OTHER_DIMENSION)] = one
        # Named alike for vertical and slant beams, and in files without a dimension ``altitude``.
        distance = self.variables.get("range")
        if distance is not None and distance.dims == ("altitude",) and "range" not in self.sizes:
            self.sizes = {"range" if d == "altitude" else d: n for d, n in self.sizes.items()}
            for one in self.variables.values():
                one.dims = tuple("range" if dim == "altitude" else dim for dim in one.dims)

    def __contains__(self, name: str) -> bool:
        """Return whether there is a variable of this name."""
        return name in self.variables

    def __getitem__(self, name: str) -> StoredVariable:
        """Return a variable."""
        return self.variables[name]


@contextmanager
def open_stored(path: str | Path) -> Iterator[StoredProduct]:
    """Open a NetCDF-4 file; what is raised while it is open passes, but for reading values.

    Parameters
    ----------
    path : path or str

    Yields
    ------
    StoredProduct

    Raises
    ------
    ProductError
        If it cannot be read, or states more than it can hold (naming the variable).
    """
    with ExitStack() as until_closed:
        with reading(path):
            file = until_closed.enter_context(h5py.File(path, "r"))
            product = StoredProduct(file, path)
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
    with reading(path), h5py.File(path, "r") as file:
        if file.attrs["id"] not in (key, key.encode()):
            raise changed(path)
        stored = file[name]
        return np.asarray(stored[rows] if stored.shape else stored[()])


def changed(path: str | Path) -> ProductError:
    """Return the error of a file that holds another product than before."""
    return ProductError("changed while it was read", file=path, remedy="run again")


def _variables(root: Any, path: str | Path) -> Iterator[tuple[str, StoredVariable]]:
    """Yield what a file holds but groups, in its order, with the names of HDF5."""
    links: list[tuple[int, bytes, bool, int]] = []

    def note(name: bytes, link: Any) -> None:
        links.append((link.corder, name, link.type == h5l.TYPE_HARD, link.u))

    root.links.iterate(note, info=True)
    for _, key, hard, address in sorted(links):
        # Untyped: the types of h5py differ between its releases.
        stored: Any = h5o.open(root, key) if hard else None
        if isinstance(stored, h5g.GroupID):
            continue
        name = key.decode()
        if not isinstance(stored, h5d.DatasetID):
            raise _from_elsewhere(path, name)
        yield name, StoredVariable(path, name, address, stored)


def _from_elsewhere(path: str | Path, name: str) -> ProductError:
    problem = "takes its values from elsewhere, which could be any file of this machine"
    return ProductError(problem, file=path, field=name, remedy=_DISTRUST)


def _refuse_bomb(stated: Mapping[str, int], path: str | Path) -> None:
    """Refuse variables that cannot be in their file."""
    size, held = Path(path).stat().st_size, sum(stated.values())
    most = _DEFLATE_LIMIT * size + _UNWRITTEN
    if held > most:
        largest = max(stated, key=lambda name: stated[name])
        raise _too_large(held, most, f"be in a file of {size} bytes", path, largest)


def _too_large(held: int, most: float, able: str, path: str | Path, name: str) -> ProductError:
    return ProductError(
        f"states {held / _GIGABYTE:.3g} GB of values, but at most {most / _GIGABYTE:.3g} GB can"
        f" {able}",
        file=path,
        field=name,
        remedy=_DISTRUST,
    )
