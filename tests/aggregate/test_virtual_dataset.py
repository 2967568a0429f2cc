"""Views: virtual datasets, compared with their products."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day, facts_of
from support.products.made_products import MAKERS

from lidarops.aggregate.facts import groups
from lidarops.aggregate.open_products import open_products
from lidarops.aggregate.virtual_dataset import View, open_view, write_view
from lidarops.errors import ProductError

pytest.importorskip("zarr")


def view_of(root: Path) -> View:
    (products,) = groups(facts_of(root)).values()
    return write_view(root, products)


def eager(root: Path, name: str) -> np.ndarray:
    """Return all values of a variable, read product by product."""
    parts = []
    # In order of time, because file names end with the date.
    for path in sorted((root / "products").rglob("*.nc")):
        with xr.open_dataset(path) as product:
            parts.append(product[name].to_numpy())
    return np.concatenate(parts)


# Variables of elastic and Raman products have the same types and dimensions.
@pytest.mark.parametrize(
    "kind", [kind for kind in MAKERS if kind not in ("homogeneous", "elastic")]
)
def test_a_view_has_the_content_of_the_products(kind: str, tmp_path: Path):
    for day in (2, 0, 1):
        add_day(tmp_path, day, kind)
    view = view_of(tmp_path)
    assert (view.products, view.parts, view.profiles) == (3, 1, 15)
    virtual = open_view(tmp_path / view.path, usable=2)
    xr.testing.assert_identical(
        virtual.load(), open_products(tmp_path, usable=2)[list(virtual.variables)].load()
    )
    for name in ("quality_flag", "time", "shots"):
        np.testing.assert_array_equal(virtual[name], eager(tmp_path, name))


@pytest.mark.slow
def test_two_hundred_products_have_the_mean_of_the_eager_ones(tmp_path: Path):
    for day in range(200):
        add_day(tmp_path, day, profiles=6)
    view = view_of(tmp_path)
    assert view.products == 200
    virtual = open_view(tmp_path / view.path, usable=2)
    values = eager(tmp_path, "total_extinction").astype(np.float64)
    mean = float(virtual.total_extinction.astype(np.float64).mean())
    assert mean == pytest.approx(np.nanmean(values), rel=1e-6)
    # The dataset is lazy.
    assert virtual.total_extinction.chunks is not None
    assert len(virtual.total_extinction.chunks[0]) == 200


def test_products_of_unequal_length_are_joined_in_order_of_time(tmp_path: Path):
    for day, profiles in enumerate((5, 7, 5, 6, 7)):
        add_day(tmp_path, day, "signal", profiles=profiles)
    view = view_of(tmp_path)
    assert view.parts == 3
    virtual = open_view(tmp_path / view.path, usable=2)
    np.testing.assert_array_equal(virtual.signal, eager(tmp_path, "signal"))
    np.testing.assert_array_equal(virtual.time, eager(tmp_path, "time"))
    counts = np.bincount(virtual.product_index.to_numpy())
    assert sorted(counts) == [5, 5, 6, 7, 7]
    ids = {facts.start: facts.id for facts in facts_of(tmp_path)}
    assert virtual["product"].to_numpy()[virtual.product_index.to_numpy()[0]] == ids[min(ids)]


def test_a_last_chunk_that_is_not_full_ends_a_part(tmp_path: Path):
    # 1 MiB holds 26 rows of 10000 numbers of 4 bytes.
    for day in range(2):
        add_day(tmp_path, day, "signal", profiles=30, bins=10000)
    view = view_of(tmp_path)
    assert view.parts == 2
    virtual = open_view(tmp_path / view.path, usable=2)
    np.testing.assert_array_equal(virtual.signal, eager(tmp_path, "signal"))


def test_a_product_with_a_chunk_that_is_not_deflated_is_left_out(tmp_path: Path):
    good, odd = (add_day(tmp_path, day) for day in range(2))
    with h5py.File(tmp_path / odd, "r+") as file:
        stored = file["valid_bins"][...]
        shuffle_only = 0b10
        planes = stored.view(np.uint8).reshape(-1, 4).T.tobytes()
        file["valid_bins"].id.write_direct_chunk((0, 0), planes, filter_mask=shuffle_only)
    with xr.open_dataset(tmp_path / odd) as product:
        np.testing.assert_array_equal(product.valid_bins, stored)
    view = view_of(tmp_path)
    assert view.products == 1
    (refused,) = view.refused
    assert refused.path == odd
    assert "not deflated" in refused.reason
    assert open_view(tmp_path / view.path).sizes["time"] == 5
    assert good in (tmp_path / view.path).read_text()


def test_the_archive_can_move(tmp_path: Path):
    for day in range(2):
        add_day(tmp_path / "here", day)
    view = view_of(tmp_path / "here")
    assert "/" not in json.loads((tmp_path / "here" / view.path).read_text())["templates"][
        "u"
    ].replace("../..", "")
    before = open_view(tmp_path / "here" / view.path).total_extinction.to_numpy()
    shutil.move(tmp_path / "here", tmp_path / "there")
    np.testing.assert_array_equal(
        open_view(tmp_path / "there" / view.path).total_extinction, before
    )


def test_a_view_is_read_by_zarr_without_lidarops(tmp_path: Path):
    import fsspec
    import zarr

    for day in range(2):
        add_day(tmp_path, day, "signal")
    view = view_of(tmp_path)
    system = fsspec.filesystem(
        "reference",
        fo=str(tmp_path / view.path),
        template_overrides={"u": str(tmp_path)},
        asynchronous=True,
    )
    plain = xr.open_zarr(zarr.storage.FsspecStore(system, read_only=True), consolidated=False)
    np.testing.assert_array_equal(plain.signal, eager(tmp_path, "signal"))


def test_equal_archives_give_equal_views(tmp_path: Path):
    for root in ("a", "b"):
        for day in (0, 1) if root == "a" else (1, 0):
            add_day(tmp_path / root, day)
    views = [(tmp_path / root / view_of(tmp_path / root).path).read_bytes() for root in "ab"]
    assert views[0] == views[1]


def test_unusable_values_are_missing_and_their_flags_stay(tmp_path: Path):
    add_day(tmp_path, 0, "signal")
    view = view_of(tmp_path)
    virtual, everything = (open_view(tmp_path / view.path, usable=level) for level in (1, 2))
    assert np.isnan(virtual.signal[:, :3]).all()
    assert np.isfinite(everything.signal[1:, :3]).all()
    assert (virtual.usable[:, :3] == 2).all()
    xr.testing.assert_equal(virtual.quality_flag, everything.quality_flag)


def test_a_product_that_changed_is_refused(tmp_path: Path):
    paths = [add_day(tmp_path, day) for day in range(2)]
    view = view_of(tmp_path)
    content = (tmp_path / paths[1]).read_bytes()
    identifier = facts_of(tmp_path)[1].id.encode()
    (tmp_path / paths[1]).write_bytes(content.replace(identifier, b"0" * len(identifier)))
    with pytest.raises(ProductError, match=r"20260302.*has changed since the view"):
        open_view(tmp_path / view.path)
    (tmp_path / paths[1]).unlink()
    with pytest.raises(ProductError, match=r"20260302.*is missing or has changed"):
        open_view(tmp_path / view.path)


def test_a_view_that_refers_to_other_files_is_refused(tmp_path: Path):
    add_day(tmp_path / "out", 0, "signal")
    view = tmp_path / "out" / view_of(tmp_path / "out").path
    document = json.loads(view.read_text())

    def refused(change: dict[str, Any], match: str) -> None:
        view.write_text(json.dumps(document | change))
        with pytest.raises(ProductError, match=match):
            open_view(view)

    (tmp_path / "secret").write_text("x")
    own = document["lidarops"]
    product = {**own["products"][0], "path": "../secret"}
    refused({"lidarops": {**own, "products": [product]}}, "not a path inside")
    stray = {**document["refs"], "signal/0.0": ["{{u}}/../secret", 0, 1]}
    refused({"refs": stray}, "not one of its products")
    pickled = json.loads(document["refs"]["signal/.zarray"]) | {"filters": [{"id": "pickle"}]}
    refused(
        {"refs": {**document["refs"], "signal/.zarray": json.dumps(pickled)}},
        "not stored as in views",
    )
    refused({"lidarops": {**own, "format": 99}}, "not a view of this version")


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"lidarops": {"format": 1}}'])
def test_other_files_are_refused(content: bytes, tmp_path: Path):
    (tmp_path / "aggregates/views").mkdir(parents=True)
    path = tmp_path / "aggregates/views/a.json"
    path.write_bytes(content)
    with pytest.raises(ProductError, match="view"):
        open_view(path)


def test_profiles_at_the_same_time_are_refused(tmp_path: Path):
    first = add_day(tmp_path, 0)
    copy = tmp_path / "products/copy.nc"
    shutil.copy(tmp_path / first, copy)
    with pytest.raises(ProductError, match=r"holds a profile at 2026-03-01T10:05:00Z.*also in"):
        view_of(tmp_path)


def test_products_of_several_groups_are_never_mixed(tmp_path: Path):
    add_day(tmp_path, 0)
    add_day(tmp_path, 1, sections=3)
    with pytest.raises(ProductError, match="one group"):
        write_view(tmp_path, facts_of(tmp_path))
