"""Stores: the products of one kind as a copy with versions, an Icechunk repository.

A store has a Zarr group for each instrument, channel and grid. An update writes the rows of
products that the store lacks, and ends in one commit: a snapshot, which stays readable when its
products are replaced. Products are copied, because a reference to a replaced file leads nowhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.aggregate._join import join
from lidarops.aggregate._optional_packages import need
from lidarops.aggregate._store_group import (
    Changes,
    UnreadableProductError,
    root_of,
    write_group,
)
from lidarops.aggregate.facts import (
    Facts,
    ProductSelection,
    Refused,
    groups,
)
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.system.files import only_one

FOLDER: Final = "stores"
"""Folder of stores beside the products; unlike aggregates, they cannot be made again."""

_BRANCH: Final = "main"
_NAMES: Final = ("kind", "station", "instrument", "channel")


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

    Returns
    -------
    StoreUpdate

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
    with _only_writer(target), _clear_errors(target):
        repository = icechunk.Repository.open_or_create(_storage(target))
        while True:
            session = repository.writable_session(_BRANCH)
            try:
                changes = _write_groups(session.store, root, wanted, replace(selection, kind=kind))
                break
            except UnreadableProductError as error:
                wanted.remove(error.facts)
                refused.append(Refused(error.facts.path, error.reason))
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
def _only_writer(target: Path) -> Iterator[None]:
    """Refuse a second writer, whose commit a folder could not tell from the first one's."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with only_one(target.parent / f".{target.name}.lock", wait=False):
            yield
    except BlockingIOError as error:
        raise _conflict(target) from error


@contextmanager
def _clear_errors(target: Path) -> Iterator[None]:
    icechunk = need("icechunk")
    try:
        yield
    except icechunk.ConflictError as error:
        raise _conflict(target) from error
    # Zarr finds no group where it cannot read one.
    except (icechunk.IcechunkError, FileNotFoundError) as error:
        # Icechunk draws a tree of causes, whose first line begins with a cross.
        reason = str(error).strip().partition("\n")[0].removeprefix("x ")
        raise ProductError(f"the store cannot be read or written: {reason}", file=target) from error


def _conflict(target: Path) -> ProductError:
    return ProductError(
        "another process writes this store", file=target, remedy="run again when it has ended"
    )


def _storage(target: Path) -> Any:
    icechunk = need("icechunk")
    # It warns of concurrent commits in a folder, which `_only_writer` refuses.
    icechunk.set_logs_filter("error")
    return icechunk.local_filesystem_storage(str(target.resolve()))


def _message(kind: str, changes: Changes, runs: Mapping[str, str]) -> str:
    names = sorted({runs[path] for path, _ in changes.added if path in runs})
    of = f"run {', '.join(names)}: " if names else ""
    first = f"{of}{kind}: {len(changes.added)} added, {changes.dropped} dropped"
    return "\n".join([first, *(f"{path} version {number}" for path, number in changes.added)])


def _write_groups(
    store: Any, root: Path, products: Sequence[Facts], selection: ProductSelection
) -> Changes:
    changes = Changes()
    by_name = {group.name: alike for group, alike in groups(products).items()}
    stored = dict(_stored_groups(store, selection))
    for name in stored.keys() - by_name.keys():
        changes.dropped += stored[name][PRODUCT.name].shape[0]
        del root_of(store)[name]
    for name, alike in by_name.items():
        try:
            write_group(store, name, root, alike, changes)
        except ProductError as error:
            changes.failed.append(str(error))
    return changes


def _stored_groups(store: Any, selection: ProductSelection) -> Iterator[tuple[str, Any]]:
    """Yield the groups of a store that are selected by their names."""
    now = datetime.now(UTC)
    by_names = replace(selection, since=None, until=None)
    for name, group in sorted(root_of(store).groups()):
        names = (group.attrs.get(f"lidarops_{key}") for key in _NAMES)
        kind, station, instrument, channel = names
        if kind and by_names.admits(kind, station, instrument, channel, now, now):
            yield name, group


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
        if len(names) != 1:
            raise _not_one(path, names)
        data = xr.open_zarr(store, group=names[0], consolidated=False, chunks={})
    ids = data[PRODUCT.name]
    ids = xr.Variable(ids.dims, np.array(ids.values.tolist(), str), ids.attrs)
    data = data.assign_coords({PRODUCT.name: ids})
    return join([_within_times(data.set_coords(PRODUCT_INDEX.name), selection, path)])


def _not_one(path: Path, names: Sequence[str]) -> ProductError:
    if not names:
        return ProductError("no product found", file=path, remedy="select less strictly")
    return ProductError(
        f"products of {len(names)} groups cannot be joined: {'; '.join(names)}",
        file=path,
        remedy="select by channel, station or instrument, or open a group with xarray.open_zarr",
    )


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
        raise _not_one(path, ())
    chosen = data.isel(time=admitted[index], product=admitted)
    number = (np.cumsum(admitted, dtype=np.int32) - np.int32(1))[index[admitted[index]]]
    return chosen.assign_coords({PRODUCT_INDEX.name: chosen[PRODUCT_INDEX.name].copy(data=number)})


def _datetime64(time: datetime) -> np.datetime64:
    return np.datetime64(time.astimezone(UTC).replace(tzinfo=None), "ns")
