"""Stores: the products of one kind as a copy with versions, an Icechunk repository.

A store has a Zarr group for each instrument, channel and grid. An update writes the rows of
products that the store lacks, and ends in one commit: a snapshot, which stays readable when its
products are replaced. Products are copied, because a reference to a replaced file leads nowhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate import need
from lidarops.aggregate._join import pattern_of, shared_attributes, sorted_by_time
from lidarops.aggregate.facts import (
    Facts,
    ProductSelection,
    Refused,
    groups,
    plain,
    refuse_duplicates,
    refuse_several,
)
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.stored import StoredProduct, StoredVariable, reading
from lidarops.system.files import only_one

if TYPE_CHECKING:
    from lidarops.aggregate.means import Means

FOLDER: Final = "stores"
"""Folder of stores beside the products; unlike aggregates, they cannot be made again."""

_BRANCH: Final = "main"
_ROWS: Final = 256
"""Rows of a chunk, whatever the products: an update copies the rows of its last chunk again."""
_LEAST_CHUNK: Final = 2**14
"""Bytes: times of a year of minutes, which opening reads, are 257 chunks; of `_ROWS`, 2054."""
_LARGEST_CHUNK: Final = 2**20
"""Bytes: as in products."""


@dataclass(frozen=True, slots=True)
class StoreUpdate:
    """A store after an update."""

    path: str
    """Relative to the root of the products, with forward slashes."""
    snapshot: str
    """Id of the newest snapshot."""
    groups: int
    added: int
    """Number of products that the store did not hold; with `dropped`, a product made again."""
    dropped: int
    """Number of products that only older snapshots hold now."""
    refused: tuple[Refused, ...] = ()
    """Products that could not be read and are not in the newest snapshot."""
    failed: tuple[str, ...] = ()
    """Groups that stay as they were, one sentence each."""


@dataclass(slots=True)
class Changes:
    """What an update changes."""

    means: Means | None
    """As of `update_store`."""
    added: list[tuple[str, str]] = field(default_factory=list)
    """Path and version of products."""
    dropped: int = 0
    failed: list[str] = field(default_factory=list)


class UnreadableProductError(Exception):
    """Facts of a product that cannot be read or has changed, and why."""


def store_path(root: Path, kind: str) -> Path:
    """Return the folder of the store of a kind."""
    return root / FOLDER / kind


def stored_kinds(root: Path) -> list[str]:
    """Return the kinds that have a store."""
    return sorted(path.name for path in (root / FOLDER).glob("*") if is_store(path))


def is_store(path: Path) -> bool:
    """Return whether a folder is an Icechunk repository."""
    return (path / "snapshots").is_dir() and (path / "refs").is_dir()


def update_store(
    root: Path,
    kind: str,
    products: Sequence[Facts],
    selection: ProductSelection,
    runs: Mapping[str, str],
    means: Means | None = None,
) -> StoreUpdate:
    """Bring the store of a kind up to date; without a change there is no new snapshot.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; the store is ``stores/KIND`` in it.
    kind : str
    products : sequence of Facts
        All products of the kind that `selection` selects.
    selection : ProductSelection
        By names only. Other groups of the store are left alone.
    runs : mapping of str to str
        Product path -> run that made it, for the message of the commit.
    means : Means, optional
        Takes the products of each group of which all are read.

    Raises
    ------
    ProductError
        If the store cannot be written, or is being written by another process. It then keeps its
        newest snapshot.
    LidarOpsError
        If icechunk is not installed.
    """
    icechunk = need("icechunk")
    target = store_path(root, kind)
    wanted, refused = list(products), []
    target.parent.mkdir(parents=True, exist_ok=True)
    # A folder could not tell the commit of a second writer from that of the first one.
    lock = target.parent / f".{target.name}.lock"
    with _clear_errors(target), only_one(lock, wait=False):
        repository = icechunk.Repository.open_or_create(_storage(target))
        while True:
            session = repository.writable_session(_BRANCH)
            try:
                changes = Changes(means)
                _write_groups(session.store, root, wanted, replace(selection, kind=kind), changes)
                break
            except UnreadableProductError as error:
                facts, reason = error.args
                wanted.remove(facts)
                refused.append(Refused(facts.path, reason))
        if session.has_uncommitted_changes:
            session.commit(_message(kind, changes, runs))
        return StoreUpdate(
            target.relative_to(root).as_posix(),
            session.snapshot_id,
            len(groups(wanted)),
            len(changes.added),
            changes.dropped,
            tuple(refused),
            tuple(changes.failed),
        )


@contextmanager
def _clear_errors(target: Path) -> Iterator[None]:
    icechunk = need("icechunk")
    try:
        yield
    except (BlockingIOError, icechunk.ConflictError) as error:
        raise ProductError(
            "another process writes this store", file=target, remedy="run again when it has ended"
        ) from error
    # Zarr finds no group where it cannot read one.
    except (icechunk.IcechunkError, FileNotFoundError) as error:
        # Icechunk draws a tree of causes, whose first line begins with a cross.
        reason = str(error).strip().partition("\n")[0].removeprefix("x ")
        raise ProductError(f"the store cannot be read or written: {reason}", file=target) from error


def _storage(target: Path) -> Any:
    icechunk = need("icechunk")
    # It warns of concurrent commits in a folder, which `update_store` refuses.
    icechunk.set_logs_filter("error")
    return icechunk.local_filesystem_storage(str(target.resolve()))


def _message(kind: str, changes: Changes, runs: Mapping[str, str]) -> str:
    names = sorted({runs[path] for path, _ in changes.added if path in runs})
    of = f"run {', '.join(names)}: " if names else ""
    first = f"{of}{kind}: {len(changes.added)} added, {changes.dropped} dropped"
    return "\n".join([first, *(f"{path} version {number}" for path, number in changes.added)])


def _write_groups(
    store: Any,
    root: Path,
    products: Sequence[Facts],
    selection: ProductSelection,
    changes: Changes,
) -> None:
    by_name = {group.name: alike for group, alike in groups(products).items()}
    stored = dict(_stored_groups(store, selection))
    for name in stored.keys() - by_name.keys():
        changes.dropped += stored[name][PRODUCT.name].shape[0]
        del _root(store)[name]
    for name, alike in by_name.items():
        try:
            _write_group(store, name, root, alike, changes)
        except ProductError as error:
            changes.failed.append(str(error))


def _stored_groups(store: Any, selection: ProductSelection) -> Iterator[tuple[str, Any]]:
    """Yield the groups of a store that are selected by their names."""
    for name, group in sorted(_root(store).groups()):
        stated = group.attrs
        names = selection.names.items()
        if "lidarops_kind" in stated and all(
            stated.get(f"lidarops_{key}") == value for key, value in names
        ):
            yield name, group


def _root(store: Any) -> Any:
    """Return the root group of a store."""
    return need("zarr").open_group(store, mode="r" if store.read_only else "a")


def _write_group(
    store: Any, name: str, root: Path, products: Sequence[Facts], changes: Changes
) -> None:
    """Write the products that a group lacks; one whose rows are at their place stays.

    `products` are all of the group, in order of time. Where a time occurs twice, nothing is
    written; where a product cannot be read, part of the group may be.
    """
    held = _held(store, name)
    ids = [product.id for product in products]
    starts = np.cumsum([0, *(product.profiles for product in products)]).tolist()
    lacking = {at for at, key in enumerate(ids) if held.places.get(key) != (at, starts[at])}
    gone = held.places.keys() - set(ids)
    if not lacking and not gone:
        return
    if 0 in lacking:
        # The first product gives the attributes of variables.
        lacking = set(range(len(ids)))
    refuse_duplicates((product.path, _times(root, product)) for product in _meeting(products))
    if 0 not in lacking:
        rows = _resized(_root(store)[name], starts[-1], len(products))
    # What all have in common is known of those that stay, unless others go.
    shared = [] if gone or 0 in lacking else [held.attributes]
    means = changes.means if 0 in lacking else None
    with means.averaging(products[0].group) if means else nullcontext() as averaging:
        for at in range(len(ids)) if gone else sorted(lacking):
            facts = products[at]
            with _unreadable(facts), facts.opened(root) as product:
                with reading(facts.path):
                    shared = [shared_attributes([*shared, product.attrs])]
                    version = product.attrs["product_version"]
                    pattern = None if at or 0 not in lacking else pattern_of(product, facts)
                if pattern is not None:
                    _create(store, name, pattern)
                    rows = _resized(_root(store)[name], starts[-1], len(products))
                if at in lacking:
                    _add(rows, product, facts, at, starts[at])
                if averaging is not None:
                    averaging.take(facts, product)
            if at in lacking and facts.id not in held.places:
                changes.added.append((facts.path, version))
    for parts in rows.values():
        parts.write()
    attributes = {key: plain(value) for key, value in shared[0].items()}
    _root(store)[name].attrs.put(attributes)
    changes.dropped += len(gone)


def _meeting(products: Sequence[Facts]) -> list[Facts]:
    """Return those of some products in order of time that may share a time with another."""
    found: dict[str, Facts] = {}
    last = products[0]
    for product in products[1:]:
        if product.start < last.stop or product.start == last.start:
            found |= {last.path: last, product.path: product}
        last = max(last, product, key=attrgetter("stop"))
    return list(found.values())


def _times(root: Path, facts: Facts) -> NDArray[np.float64]:
    with _unreadable(facts), facts.opened(root) as product:
        return product["time"][...]


@contextmanager
def _unreadable(facts: Facts) -> Iterator[None]:
    """Name the product that cannot be read or has changed."""
    try:
        yield
    except ProductError as error:
        raise UnreadableProductError(facts, error.problem) from error


class _Held(NamedTuple):
    """What a group holds before an update."""

    attributes: Mapping[str, Any]
    places: Mapping[str, tuple[int, int]]
    """Id -> number and first row of each product."""


def _held(store: Any, name: str) -> _Held:
    root = _root(store)
    if name not in root:
        return _Held({}, {})
    group = root[name]
    ids = group[PRODUCT.name][:].tolist()
    lengths = np.bincount(group[PRODUCT_INDEX.name][:], minlength=len(ids))
    starts = np.cumsum([0, *lengths]).tolist()
    places = {product: (at, starts[at]) for at, product in enumerate(ids)}
    return _Held(group.attrs.asdict(), places)


class _Rows:
    """Rows of an array that are written at once.

    Neighbours in one chunk are together, because each write keeps a copy of its chunk, and chunks
    are apart, so that memory holds few rows.
    """

    def __init__(self, array: Any, *, of_profiles: bool) -> None:
        self.array = array
        self.of_profiles = of_profiles
        """Whether a row is of a profile, not of a whole product."""
        self.first, self.stop = 0, 0
        self.parts: list[NDArray[Any]] = []

    def add(self, start: int, stop: int, values: StoredVariable | NDArray[Any]) -> None:
        """Add the rows of a product, of which as many as belong to a chunk are read at a time."""
        chunk = self.array.chunks[0]
        edges = (start, *range((start // chunk + 1) * chunk, stop, chunk), stop)
        for low, high in pairwise(edges):
            if low % chunk == 0 or low != self.stop:
                self.write()
                self.first = low
            self.parts.append(values[low - start : high - start])
            self.stop = high

    def write(self) -> None:
        """Write what was added."""
        if self.parts:
            self.array[self.first : self.stop] = np.concatenate(self.parts)
            self.parts = []


def _resized(group: Any, profiles: int, products: int) -> dict[str, _Rows]:
    """Make the arrays of a group as long as its products; return those that hold rows."""
    length, rows = {"time": profiles, PRODUCT.name: products}, {}
    for name, array in group.arrays():
        dims = array.metadata.dimension_names or ()
        array.resize(tuple(length.get(d, n) for d, n in zip(dims, array.shape, strict=True)))
        if length.keys() & set(dims):
            rows[name] = _Rows(array, of_profiles="time" in dims)
    return rows


def _add(
    rows: Mapping[str, _Rows], product: StoredProduct, facts: Facts, at: int, start: int
) -> None:
    """Add the rows of a product, with its number among all and its first row."""
    own = {
        PRODUCT.name: np.array([facts.id]),
        PRODUCT_INDEX.name: np.full(facts.profiles, at, np.int32),
    }
    for name, parts in rows.items():
        if parts.of_profiles:
            values = own[name] if name in own else product[name]
            parts.add(start, start + facts.profiles, values)
        else:
            parts.add(at, at + 1, own[name] if name in own else product[name][...][None])


def _create(store: Any, name: str, pattern: xr.Dataset) -> None:
    """Write a group like a product, but without its rows."""
    # Of variable length, which all readers of Zarr know.
    text = pattern[PRODUCT.name].astype(np.dtypes.StringDType(), keep_attrs=True)
    like = pattern.reset_coords().assign_coords({PRODUCT.name: text})
    encoding = {}
    compressor = need("zarr.codecs").BloscCodec(cname="zstd", clevel=5, shuffle="shuffle")
    for key, variable in like.variables.items():
        variable.encoding = {}
        if key != PRODUCT.name:
            encoding[key] = {"chunks": _chunk(variable), "compressors": compressor}
    like.isel(time=slice(0), product=slice(0)).drop_attrs(deep=False).to_zarr(
        store, group=name, mode="w", encoding=encoding, zarr_format=3, consolidated=False
    )


def _chunk(variable: xr.Variable) -> tuple[int, ...]:
    if not {"time", PRODUCT.name} & set(variable.dims):
        return variable.shape
    row = variable.dtype.itemsize * int(np.prod(variable.shape[1:]))
    rows = min(max(_ROWS, _LEAST_CHUNK // row), max(1, _LARGEST_CHUNK // row))
    return (rows, *variable.shape[1:])


def open_store(path: Path, selection: ProductSelection, version: str | None) -> xr.Dataset:
    """Open the selected products of a store as one lazy dataset, sorted by time.

    Parameters
    ----------
    path : path
        Folder of the store.
    selection : ProductSelection
        Must leave one group.
    version : str or None
        Id of a snapshot; None for the newest.

    Returns
    -------
    xarray.Dataset
        As from `lidarops.open_products`, but not masked.

    Raises
    ------
    ProductError
        If the store has no such snapshot, or no or several groups are selected.
    LidarOpsError
        If icechunk is not installed.
    """
    with _clear_errors(path):
        repository = need("icechunk").Repository.open(_storage(path))
        which = {"branch": _BRANCH} if version is None else {"snapshot_id": version}
        store = repository.readonly_session(**which).store
        names = [name for name, _ in _stored_groups(store, selection)]
        if not names:
            raise _no_product(path)
        remedy = "select by channel, station or instrument, or open a group with xarray.open_zarr"
        refuse_several(names, path, remedy)
        data = xr.open_zarr(store, group=names[0], consolidated=False, chunks={})
    ids = data[PRODUCT.name]
    ids = xr.Variable(ids.dims, np.array(ids.values.tolist(), str), ids.attrs)
    data = data.assign_coords({PRODUCT.name: ids})
    return sorted_by_time(_within_times(data.set_coords(PRODUCT_INDEX.name), selection, path))


def _no_product(path: Path) -> ProductError:
    return ProductError("no product found", file=path, remedy="select less strictly")


def _within_times(data: xr.Dataset, selection: ProductSelection, path: Path) -> xr.Dataset:
    """Select whole products by time."""
    if selection.since is None and selection.until is None:
        return data
    index = data[PRODUCT_INDEX.name].values
    begins, ends = np.moveaxis(data["time_bnds"].values, -1, 0)
    first = np.searchsorted(index, np.arange(data.sizes[PRODUCT.name]))
    admitted = np.ones(first.size, bool)
    if selection.since is not None:
        admitted &= np.maximum.reduceat(ends, first) > _datetime64(selection.since)
    if selection.until is not None:
        admitted &= np.minimum.reduceat(begins, first) < _datetime64(selection.until)
    if not admitted.any():
        raise _no_product(path)
    chosen = data.isel(time=admitted[index], product=admitted)
    number = (np.cumsum(admitted, dtype=np.int32) - np.int32(1))[index[admitted[index]]]
    return chosen.assign_coords({PRODUCT_INDEX.name: chosen[PRODUCT_INDEX.name].copy(data=number)})


def _datetime64(time: datetime) -> np.datetime64:
    return np.datetime64(time.astimezone(UTC).replace(tzinfo=None), "ns")
