"""Stores: products of a kind with versions, compared with their files."""

from __future__ import annotations

import fcntl
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day, facts_of
from support.products.made_products import MAKERS

from lidarops.aggregate import versioned_store
from lidarops.aggregate.facts import EVERYTHING, UNSHARED, ProductSelection, Refused
from lidarops.aggregate.open_products import open_products
from lidarops.aggregate.versioned_store import StoreUpdate, store_path, update_store
from lidarops.errors import ProductError, RetrievalInputError

icechunk = pytest.importorskip("icechunk")

KIND = "signal"
OTHER = {"station_key": "coast"}


def update(
    root: Path,
    kind: str = KIND,
    selection: ProductSelection = EVERYTHING,
    runs: dict[str, str] | None = None,
) -> StoreUpdate:
    products = [facts for facts in facts_of(root) if facts.kind == kind]
    return update_store(root, kind, products, selection, runs or {})


def repository(root: Path, kind: str = KIND) -> Any:
    return icechunk.Repository.open(icechunk.local_filesystem_storage(str(store_path(root, kind))))


def messages(root: Path) -> list[str]:
    return [snapshot.message for snapshot in repository(root).ancestry(branch="main")]


def assert_same_bits(data: xr.Dataset, expected: xr.Dataset) -> None:
    xr.testing.assert_identical(data, expected)
    for name, variable in expected.variables.items():
        assert data[name].dtype == variable.dtype
        assert data[name].values.tobytes() == variable.values.tobytes(), name


def assert_like_products(root: Path, kind: str = KIND) -> None:
    files = [root / facts.path for facts in facts_of(root) if facts.kind == kind]
    expected = open_products(files, usable=2).load()
    assert_same_bits(open_products(store_path(root, kind), usable=2).load(), expected)


# Variables of elastic and Raman products have the same types and dimensions.
@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in MAKERS if kind != "elastic"])
def test_a_store_that_grew_has_the_bits_and_attributes_of_the_products(kind: str, tmp_path: Path):
    for day in range(2):
        path = add_day(tmp_path, day, kind)
        done = update(tmp_path, kind)
        assert (done.path, done.groups, done.added, done.dropped) == (f"stores/{kind}", 1, 1, 0)
    assert_like_products(tmp_path, kind)
    # And by xarray alone, like the file of the last product.
    store = repository(tmp_path, kind).readonly_session("main").store
    data = xr.open_zarr(store, group=facts_of(tmp_path)[0].group.name, consolidated=False)
    data = data.isel(time=slice(5, None), product=1).drop_vars(["product", "product_index"])
    with xr.open_dataset(tmp_path / path) as product:
        same = product.drop_vars(UNSHARED, errors="ignore").load()
        same.attrs = {key: product.attrs[key] for key in data.attrs}
        assert_same_bits(data.load(), same)


def test_products_of_unequal_length_may_come_in_any_order(tmp_path: Path):
    lengths = {3: 7, 4: 1, 0: 5, 1: 6}
    for day, profiles in lengths.items():
        add_day(tmp_path, day, profiles=profiles, kind=KIND)
        assert update(tmp_path).added == 1
        assert_like_products(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("bins", "rows"), [(1000, 256), (10000, 26)])
def test_chunks_are_long_whatever_the_first_product_but_within_a_mebibyte(
    bins: int, rows: int, tmp_path: Path
):
    for day, profiles in enumerate((1, 270)):
        add_day(tmp_path, day, KIND, profiles=profiles, bins=bins)
    update(tmp_path)
    assert_like_products(tmp_path)
    data = open_products(store_path(tmp_path, KIND), usable=2)
    assert data.signal.chunks[0][0] == rows
    assert data.shots.chunks == ((271,),)


def test_a_product_made_again_replaces_its_times_and_the_snapshot_before_stays(tmp_path: Path):
    for day in range(3):
        add_day(tmp_path, day, KIND)
    before = update(tmp_path)
    old = open_products(store_path(tmp_path, KIND), usable=2).load()
    path = add_day(tmp_path, 1, KIND, version=2)
    after = update(tmp_path, runs={path: "20260401T000000-abcdef"})
    assert (after.added, after.dropped) == (1, 1)
    assert after.snapshot != before.snapshot
    assert messages(tmp_path)[0].splitlines() == [
        f"run 20260401T000000-abcdef: {KIND}: 1 added, 1 dropped",
        f"{path} version 2",
    ]
    assert_like_products(tmp_path)
    data = open_products(store_path(tmp_path, KIND), usable=2)
    changed = (data.signal.fillna(0) != old.signal.fillna(0)).any("altitude").values
    np.testing.assert_array_equal(changed, np.repeat([False, True, False], 5))
    stored = open_products(store_path(tmp_path, KIND), usable=2, version=before.snapshot)
    assert_same_bits(stored.load(), old)


def test_a_product_made_again_may_have_other_times(tmp_path: Path):
    for day in range(3):
        add_day(tmp_path, day, KIND)
    update(tmp_path)
    for day, profiles in ((1, 8), (0, 2)):
        add_day(tmp_path, day, KIND, version=2, profiles=profiles)
        update(tmp_path)
        assert_like_products(tmp_path)


def test_attributes_are_those_that_all_products_have(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    odd = add_day(tmp_path, 1, KIND, of={"title": "Another title"})
    update(tmp_path)
    store = store_path(tmp_path, KIND)
    assert "title" not in open_products(store).attrs
    # No later product can bring it back,
    add_day(tmp_path, 2, KIND)
    update(tmp_path)
    assert_like_products(tmp_path)
    # but the end of the odd one does.
    assert add_day(tmp_path, 1, KIND, version=2) == odd
    update(tmp_path)
    assert open_products(store).attrs["title"].startswith("Demo campaign")
    assert_like_products(tmp_path)


def test_without_anything_new_there_is_no_snapshot(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    first = update(tmp_path)
    again = update(tmp_path)
    assert (again.snapshot, again.added) == (first.snapshot, 0)
    assert len(messages(tmp_path)) == 2


def test_what_the_archive_lost_is_only_in_the_snapshots_before(tmp_path: Path):
    add_day(tmp_path, 0, KIND, of=OTHER)
    kept = [add_day(tmp_path, day, KIND) for day in (1, 2)]
    before = update(tmp_path)
    assert before.groups == 2
    for facts in facts_of(tmp_path):
        if facts.path != kept[0]:
            (tmp_path / facts.path).unlink()
    after = update(tmp_path)
    assert (after.groups, after.added, after.dropped) == (1, 0, 2)
    assert_like_products(tmp_path)
    with pytest.raises(ProductError, match="products of 2 groups cannot be joined: coast_lidar-1"):
        open_products(store_path(tmp_path, KIND), version=before.snapshot)


def test_groups_that_are_not_selected_stay(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    other = add_day(tmp_path, 0, KIND, of=OTHER)
    update(tmp_path)
    (tmp_path / other).unlink()
    add_day(tmp_path, 1, KIND)
    done = update(tmp_path, selection=ProductSelection(station="odesa"))
    assert (done.groups, done.added, done.dropped) == (1, 1, 0)
    store = store_path(tmp_path, KIND)
    assert open_products(store, station="odesa").sizes["time"] == 10
    assert open_products(store, station="coast").sizes["time"] == 5


@pytest.mark.slow
def test_a_killed_update_leaves_the_snapshot_before_and_the_next_one_completes(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    before = update(tmp_path)
    add_day(tmp_path, 1, KIND)
    add_day(tmp_path, 0, KIND, version=2)
    killed = f"""
import os, signal
from pathlib import Path
import zarr
from lidarops.aggregate.aggregates import make_aggregates
write = zarr.Array.__setitem__
def write_and_die(array, rows, values):
    write(array, rows, values)
    if array.basename == "signal" and rows == slice(0, 10):
        os.kill(os.getpid(), signal.SIGKILL)
zarr.Array.__setitem__ = write_and_die
make_aggregates(Path({str(tmp_path)!r}), store=True)
"""
    process = subprocess.run([sys.executable, "-c", killed], check=False)
    assert process.returncode == -signal.SIGKILL
    assert len(messages(tmp_path)) == 2
    assert open_products(store_path(tmp_path, KIND)).load().sizes["time"] == 5
    done = update(tmp_path)
    assert (done.added, done.dropped) == (2, 1)
    assert_like_products(tmp_path)
    assert open_products(store_path(tmp_path, KIND), version=before.snapshot).sizes["time"] == 5


def test_a_second_writer_is_refused(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    before = update(tmp_path)
    add_day(tmp_path, 1, KIND)
    with (tmp_path / f"stores/.{KIND}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ProductError, match=f"stores/{KIND}: another process writes this"):
            update(tmp_path)
    assert update(tmp_path).snapshot != before.snapshot


def test_a_commit_of_a_writer_without_lock_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    add_day(tmp_path, 0, KIND)
    update(tmp_path)
    add_day(tmp_path, 1, KIND)

    def commit_first(*_: object) -> str:
        session = repository(tmp_path).writable_session("main")
        xr.Dataset({"a": 1}).to_zarr(session.store, group="other", consolidated=False)
        session.commit("another writer")
        return "this writer"

    monkeypatch.setattr(versioned_store, "_message", commit_first)
    with pytest.raises(ProductError, match="another process writes this store"):
        update(tmp_path)
    assert messages(tmp_path)[0] == "another writer"


def test_a_product_with_a_damaged_chunk_is_left_out(tmp_path: Path):
    paths = [add_day(tmp_path, day, KIND) for day in range(3)]
    with h5py.File(tmp_path / paths[1], "r+") as file:
        signal_values = file["signal"]
        index, place = (0, 0), signal_values.id.get_chunk_info(0)
        assert place.chunk_offset == index
    with (tmp_path / paths[1]).open("r+b") as file:
        file.seek(place.byte_offset)
        file.write(bytes(place.size))
    done = update(tmp_path)
    assert [product.path for product in done.refused] == [paths[1]]
    assert "cannot be read" in done.refused[0].reason
    (tmp_path / paths[1]).unlink()
    assert_like_products(tmp_path)


@pytest.mark.parametrize("profiles", [5, 6])
def test_a_product_that_changes_while_it_is_copied_is_left_out(
    profiles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    paths = [add_day(tmp_path, day, KIND) for day in range(3)]
    refuse_duplicates = versioned_store.refuse_duplicates

    def replace_a_product(*known: Any) -> None:
        refuse_duplicates(*known)
        add_day(tmp_path, 1, KIND, version=2, profiles=profiles)

    # The last that happens before rows are copied.
    monkeypatch.setattr(versioned_store, "refuse_duplicates", replace_a_product)
    done = update(tmp_path)
    monkeypatch.undo()
    assert done.refused == (Refused(paths[1], "changed while it was read"),)
    assert open_products(store_path(tmp_path, KIND)).sizes["product"] == 2
    assert update(tmp_path).added == 1
    assert_like_products(tmp_path)


def test_an_error_without_words_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(_target: Path) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(versioned_store, "_storage", fail)
    with pytest.raises(ProductError, match="the store cannot be read or written"):
        update(tmp_path)


def test_a_time_twice_fails_its_group_only(tmp_path: Path):
    first = add_day(tmp_path, 0, KIND)
    add_day(tmp_path, 0, KIND, of=OTHER)
    update(tmp_path)
    shutil.copy(tmp_path / first, tmp_path / "products/copy.nc")
    add_day(tmp_path, 1, KIND, of=OTHER)
    done = update(tmp_path)
    assert len(done.failed) == 1
    assert "holds a profile at 2026-03-01T10:05:00Z" in done.failed[0]
    store = store_path(tmp_path, KIND)
    assert open_products(store, station="odesa").sizes["time"] == 5
    assert open_products(store, station="coast").sizes["time"] == 10


def test_products_are_selected_by_time_as_from_files(tmp_path: Path):
    for day in range(4):
        add_day(tmp_path, day, KIND)
    update(tmp_path)
    for times in (
        {"since": "2026-03-02"},
        {"until": "2026-03-03"},
        {"since": "2026-03-02T10:20", "until": "2026-03-03T10:30"},
    ):
        data = open_products(store_path(tmp_path, KIND), **times).load()
        xr.testing.assert_equal(data, open_products(tmp_path, **times).load())
    with pytest.raises(ProductError, match="no product found"):
        open_products(store_path(tmp_path, KIND), since="2030-01-01")


def test_wrong_versions_and_stores_raise_clear_errors(tmp_path: Path):
    add_day(tmp_path, 0, KIND)
    update(tmp_path)
    store = store_path(tmp_path, KIND)
    for version in ("nothing", "2CECHNKREP0F1RSTCMT0"):
        with pytest.raises(ProductError, match=rf"stores/{KIND}: .*snapshot.*{version}"):
            open_products(store, version=version)
    with pytest.raises(RetrievalInputError, match="version: only stores have versions"):
        open_products(tmp_path, version="nothing")
    with pytest.raises(ProductError, match="no product found"):
        open_products(store, channel="nothing")
    with pytest.raises(ProductError, match=rf"open one of the stores in it: {KIND}"):
        open_products(store.parent)
    for file in (store / "snapshots").iterdir():
        file.write_bytes(b"nothing")
    with pytest.raises(ProductError, match=f"stores/{KIND}: the store cannot be read"):
        open_products(store)
