"""Writes products as the rows of one Zarr group of a store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate._join import open_piece, shared_attributes
from lidarops.aggregate._optional_packages import need
from lidarops.aggregate.facts import Facts, opened, plain, refuse_changed, refuse_duplicates
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.read import reading
from lidarops.system.files import within

_ROWS: Final = 256
"""Rows of a chunk, whatever the products: an update copies the rows of its last chunk again."""
_LEAST_CHUNK: Final = 2**14
"""Bytes: times of a year of minutes, which opening reads, are 257 chunks; of `_ROWS`, 2054."""
_LARGEST_CHUNK: Final = 2**20
"""Bytes: as in products."""


@dataclass(slots=True)
class Changes:
    """What an update changes."""

    added: list[tuple[str, str]] = field(default_factory=list)
    """Path and version of products."""
    dropped: int = 0
    failed: list[str] = field(default_factory=list)


class UnreadableProductError(Exception):
    """A product that cannot be read or has changed, though its facts could be read."""

    def __init__(self, facts: Facts, reason: str) -> None:
        super().__init__(reason)
        self.facts = facts
        self.reason = reason


def root_of(store: Any) -> Any:
    """Return the root group of a store."""
    return need("zarr").open_group(store, mode="r" if store.read_only else "a")


def write_group(
    store: Any, name: str, root: Path, products: Sequence[Facts], changes: Changes
) -> None:
    """Write the products that a group lacks; one whose rows are at their place stays.

    Parameters
    ----------
    store : icechunk.IcechunkStore
        Of a writable session.
    name : str
        Of the group.
    root : path
    products : sequence of Facts
        All of the group, in order of time.
    changes : Changes
        Gets what changes.

    Raises
    ------
    ProductError
        If a time occurs twice. Nothing is written then.
    UnreadableProductError
        If a product cannot be read or has changed since. Part of the group may be written then.
    """
    held = _held(store, name)
    ids = [product.id for product in products]
    starts = np.cumsum([0, *(product.profiles for product in products)]).tolist()
    lacking = [at for at in range(len(ids)) if held.places.get(ids[at]) != (at, starts[at])]
    gone = held.places.keys() - set(ids)
    if not lacking and not gone:
        return
    if 0 in lacking:
        # The first product gives the attributes of variables.
        lacking = list(range(len(ids)))
    # What all have in common is known of those that stay, unless others go.
    read = range(len(ids)) if gone else lacking
    about = {at: _about(root, products[at]) for at in read}
    _refuse_duplicates(products, starts, held, about)
    known = [] if gone or 0 in lacking else [held.attributes]
    shared = shared_attributes([*known, *(stated.attributes for stated in about.values())])
    if 0 in lacking:
        with _piece(root, products[0]) as piece:
            _create(store, name, piece)
    group = root_of(store)[name]
    group.attrs.put({key: plain(value) for key, value in shared.items()})
    _write_rows(group, root, products, lacking, starts)
    new = [at for at in lacking if ids[at] not in held.places]
    changes.added += [(products[at].path, about[at].attributes["product_version"]) for at in new]
    changes.dropped += len(gone)


@dataclass(frozen=True, slots=True)
class _Held:
    """What a group holds before an update."""

    attributes: Mapping[str, Any]
    times: NDArray[np.float64]
    places: Mapping[str, tuple[int, int]]
    """Id -> number and first row of each product."""


def _held(store: Any, name: str) -> _Held:
    root = root_of(store)
    if name not in root:
        return _Held({}, np.empty(0), {})
    group = root[name]
    ids = group[PRODUCT.name][:].tolist()
    lengths = np.bincount(group[PRODUCT_INDEX.name][:], minlength=len(ids))
    starts = np.cumsum([0, *lengths]).tolist()
    places = {product: (at, starts[at]) for at, product in enumerate(ids)}
    return _Held(group.attrs.asdict(), group["time"][:], places)


@dataclass(frozen=True, slots=True)
class _About:
    """What the file of a product states."""

    attributes: Mapping[str, Any]
    times: NDArray[np.float64]


def _about(root: Path, facts: Facts) -> _About:
    try:
        with opened(within(root, facts.path)) as product:
            refuse_changed(product, facts)
            return _About(dict(product.attrs), product["time"].values)
    except ProductError as error:
        raise UnreadableProductError(facts, error.problem) from error


def _refuse_duplicates(
    products: Sequence[Facts], starts: Sequence[int], held: _Held, about: Mapping[int, _About]
) -> None:
    times = [
        about[at].times if at in about else held.times[slice(*rows)]
        for at, rows in enumerate(pairwise(starts))
    ]
    owners = [facts.path for facts in products for _ in range(facts.profiles)]
    refuse_duplicates(np.concatenate(times), owners)


def _write_rows(
    group: Any, root: Path, products: Sequence[Facts], lacking: Sequence[int], starts: Sequence[int]
) -> None:
    length = {"time": starts[-1], PRODUCT.name: len(products)}
    rows = {}
    for name, array in group.arrays():
        dims = array.metadata.dimension_names or ()
        array.resize(tuple(length.get(d, n) for d, n in zip(dims, array.shape, strict=True)))
        rows[name] = _Rows(array)
    for at in lacking:
        _write_product(rows, root, products[at], at, starts[at])
    for array in rows.values():
        array.flush()


def _create(store: Any, name: str, piece: xr.Dataset) -> None:
    """Write a group like a product, but without its rows."""
    # Of variable length, which all readers of Zarr know.
    text = piece[PRODUCT.name].astype(np.dtypes.StringDType(), keep_attrs=True)
    like = piece.reset_coords().assign_coords({PRODUCT.name: text})
    encoding = {}
    for key, variable in like.variables.items():
        variable.encoding = {}
        if key != PRODUCT.name:
            encoding[key] = {"chunks": _chunk(variable), "compressors": _compressor()}
    like.isel(time=slice(0), product=slice(0)).drop_attrs(deep=False).to_zarr(
        store, group=name, mode="w", encoding=encoding, zarr_format=3, consolidated=False
    )


def _chunk(variable: xr.Variable) -> tuple[int, ...]:
    if not _is_long(variable):
        return variable.shape
    row = variable.dtype.itemsize * int(np.prod(variable.shape[1:]))
    rows = min(max(_ROWS, _LEAST_CHUNK // row), max(1, _LARGEST_CHUNK // row))
    return (rows, *variable.shape[1:])


def _is_long(variable: xr.Variable) -> bool:
    return bool({"time", PRODUCT.name} & set(variable.dims))


def _compressor() -> Any:
    return need("zarr.codecs").BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")


@dataclass(slots=True)
class _Rows:
    """Rows of an array that wait until their chunk is complete, because each write keeps a copy."""

    array: Any
    first: int = 0
    stop: int = 0
    waiting: list[NDArray[Any]] = field(default_factory=list)

    def add(self, first: int, values: NDArray[Any]) -> None:
        """Write rows of one chunk, at the latest when the next one begins."""
        if first != self.stop:
            self.flush()
            self.first = first
        self.waiting.append(values)
        self.stop = first + len(values)
        if self.stop % self.array.chunks[0] == 0:
            self.flush()

    def flush(self) -> None:
        """Write all rows that wait."""
        if self.waiting:
            self.array[self.first : self.stop] = np.concatenate(self.waiting)
        self.waiting.clear()
        self.first = self.stop


def _write_product(
    rows: Mapping[str, _Rows], root: Path, facts: Facts, number: int, start: int
) -> None:
    with _piece(root, facts) as piece:
        piece[PRODUCT_INDEX.name] = piece[PRODUCT_INDEX.name] + np.int32(number)
        for name, variable in piece.variables.items():
            if not _is_long(variable):
                continue
            array = rows[str(name)]
            first = start if "time" in variable.dims else number
            for low, high in _blocks(first, first + variable.shape[0], array.array.chunks[0]):
                array.add(low, _values(variable[low - first : high - first], facts))


def _blocks(start: int, stop: int, chunk: int) -> Iterator[tuple[int, int]]:
    """Yield the rows from `start` to `stop` in blocks within chunks, so that memory holds few."""
    return pairwise((start, *range((start // chunk + 1) * chunk, stop, chunk), stop))


def _values(variable: xr.Variable, facts: Facts) -> NDArray[Any]:
    try:
        with reading(facts.path):
            return variable.values
    except ProductError as error:
        raise UnreadableProductError(facts, error.problem) from error


def _piece(root: Path, facts: Facts) -> xr.Dataset:
    try:
        return open_piece(within(root, facts.path), facts, dask=False)
    except ProductError as error:
        raise UnreadableProductError(facts, error.problem) from error
