"""Products as one lazy dataset."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day, facts_of
from support.products.damaged_products import damage_values

from lidarops.aggregate.index import write_index
from lidarops.aggregate.open_products import open_products
from lidarops.errors import ProductError, RetrievalInputError
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.stored import open_stored
from lidarops.netcdf.variables import summarize_flags


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("archive")
    for day in (1, 0, 2):
        add_day(root, day, "elastic")
        add_day(root, day, sections=3)
    return root


def test_a_folder_opens_in_order_of_time_with_units_and_flags(archive: Path):
    data = open_products(archive, kind="homogeneous", usable=2)
    assert data.indexes["time"].is_monotonic_increasing
    assert data.sizes["time"] == 15
    assert data.total_extinction.attrs["units"] == "m-1"
    assert data.quality_flag.attrs["flag_meanings"].split()[0] == "input_missing"
    assert data.total_extinction.chunks == ((5, 5, 5), (3,))
    assert {"altitude", "zenith_angle", "section_range"} <= set(data.coords)
    parts = []
    for facts in facts_of(archive):
        if facts.kind == "homogeneous":
            with xr.open_dataset(archive / facts.path) as product:
                parts.append(product.load())
    for name in ("total_extinction", "quality_flag", "time_bnds"):
        expected = np.concatenate([part[name] for part in parts])
        np.testing.assert_array_equal(data[name], expected)


@pytest.mark.parametrize("level", [0, 1])
def test_unusable_values_are_missing(level: int, archive: Path):
    data = open_products(archive, kind="elastic", usable=level).load()
    everything = open_products(archive, kind="elastic", usable=2).load()
    flags = everything.quality_flag.to_numpy()
    worst = summarize_flags(flags, flags_of("elastic"))
    np.testing.assert_array_equal(data.usable, worst)
    assert set(np.unique(worst)) == {0, 1, 2}
    np.testing.assert_array_equal(
        data.aerosol_backscatter, np.where(worst <= level, everything.aerosol_backscatter, np.nan)
    )
    np.testing.assert_array_equal(data.quality_flag, flags)
    np.testing.assert_array_equal(data.background, everything.background)
    assert data.aerosol_backscatter.attrs == everything.aerosol_backscatter.attrs


def test_variables_of_a_whole_product_have_the_dimension_product(tmp_path: Path):
    for day in range(2):
        add_day(
            tmp_path,
            day,
            "elastic",
            change=lambda data, day=day: data.assign(lidar_ratio=data.lidar_ratio - 10.0 + day),
        )
    data = open_products(tmp_path)
    assert data.lidar_ratio.dims == ("product", "altitude")
    ratio = data.lidar_ratio.isel(altitude=0)
    np.testing.assert_array_equal(ratio, [40.0, 41.0])
    ratio = ratio.isel(product=data.product_index)
    np.testing.assert_array_equal(ratio, np.repeat([40.0, 41.0], 5))
    assert data["product"].to_numpy().tolist() == [product.id for product in facts_of(tmp_path)]


def test_an_index_gives_the_same_data_as_the_folder(archive: Path):
    pytest.importorskip("pyarrow")
    index = archive / write_index(archive, facts_of(archive))
    selection = {"kind": "elastic", "since": "2026-03-02", "until": "2026-03-03T00:00"}
    data = open_products(index, **selection).load()
    assert data.sizes["time"] == 5
    xr.testing.assert_identical(data, open_products(archive, **selection).load())


def test_files_open_in_any_order(archive: Path):
    paths = [archive / facts.path for facts in facts_of(archive) if facts.kind == "elastic"]
    data = open_products(reversed(paths)).load()
    xr.testing.assert_identical(data, open_products(archive, kind="elastic").load())


def test_products_of_several_groups_are_not_mixed(archive: Path):
    with pytest.raises(ProductError, match=r"2 groups.*elastic photon_532o grid .*homogeneous"):
        open_products(archive)


def test_a_product_twice_is_refused_by_name(tmp_path: Path):
    path = tmp_path / add_day(tmp_path, 0)
    shutil.copy(path, tmp_path / "copy.nc")
    with pytest.raises(ProductError, match=r"copy\.nc: holds a profile at .*20260301T000000\.nc"):
        open_products([path, tmp_path / "copy.nc"])


def test_a_damaged_product_is_named(tmp_path: Path):
    add_day(tmp_path, 0)
    damaged = tmp_path / add_day(tmp_path, 1)
    damaged.write_bytes(damaged.read_bytes()[:5000])
    with pytest.raises(ProductError, match=r"20260302T000000\.nc: cannot be read"):
        open_products(tmp_path)


def test_a_damaged_chunk_raises_an_error(tmp_path: Path):
    path = tmp_path / add_day(tmp_path, 0, "signal", profiles=30, bins=1000)
    damage_values(path, "signal")
    with pytest.raises((ProductError, RuntimeError)):
        open_products(path, usable=2).load()


@pytest.mark.parametrize("profiles", [5, 6])
def test_a_product_that_is_replaced_after_it_was_opened_is_named(profiles: int, tmp_path: Path):
    path = add_day(tmp_path, 0)
    data = open_products(tmp_path)
    add_day(tmp_path, 0, version=2, profiles=profiles)
    with pytest.raises(ProductError, match=f"{path}: changed while it was read"):
        data.load()


def test_only_selected_files_are_opened_and_each_once_but_for_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("pyarrow")
    for day in range(4):
        add_day(tmp_path, day)
        add_day(tmp_path, day, "signal")
    index = tmp_path / write_index(tmp_path, facts_of(tmp_path))
    os.utime(index, ns=2 * (time.time_ns() + 10**9,))
    replaced = add_day(tmp_path, 0, "signal", version=2)
    os.utime(tmp_path / replaced, ns=2 * (time.time_ns() + 2 * 10**9,))
    new = add_day(tmp_path, 4)
    opened: Counter[str] = Counter()

    def counting(read: Callable[..., Any]) -> Callable[..., Any]:
        def counted(file: Path, **options: Any) -> Any:
            opened[Path(file).relative_to(tmp_path).as_posix()] += 1
            return read(file, **options)

        return counted

    since = {"kind": "homogeneous", "since": "2026-03-03"}
    with monkeypatch.context() as patch:
        patch.setattr(xr, "open_dataset", counting(xr.open_dataset))
        place = "lidarops.aggregate.open_products.open_stored"
        patch.setattr(place, counting(open_stored))
        patch.setattr("lidarops.aggregate.facts.open_stored", counting(open_stored))
        data = open_products(tmp_path, **since)
    selected = [facts.path for facts in facts_of(tmp_path) if facts.kind == "homogeneous"][2:]
    assert new in selected
    # What changed since the index was written may be selected.
    # The first one also gives the variables.
    assert opened == Counter([*selected, replaced, selected[0]])
    index.unlink()
    xr.testing.assert_identical(data.load(), open_products(tmp_path, **since).load())


def test_a_vertical_lidar_can_be_selected_by_altitude(archive: Path):
    data = open_products(archive, kind="elastic")
    part = data.aerosol_backscatter.sel(altitude=slice(100.0, 200.0))
    altitude = data["station_altitude"] + data["range"]
    np.testing.assert_allclose(data["altitude"], altitude, atol=0.01)
    assert part.sizes["altitude"] == np.count_nonzero((altitude >= 100.0) & (altitude <= 200.0)) > 9


def test_a_slant_beam_is_selected_by_range(tmp_path: Path):
    add_day(tmp_path, 0, "signal", zenith=60.0)
    data = open_products(tmp_path)
    assert data.signal.dims == ("time", "range")
    assert data["altitude"].dims == ("range",)


def test_wrong_arguments_raise_clear_errors(archive: Path, tmp_path: Path):
    with pytest.raises(RetrievalInputError, match=r"usable: is 3 .*0 keeps"):
        open_products(archive, kind="elastic", usable=3)
    with pytest.raises(ProductError, match="no product found"):
        open_products(archive, station="nowhere")
    with pytest.raises(ProductError, match="no product found"):
        open_products([])
    with pytest.raises(ProductError, match="is not a file"):
        open_products(tmp_path / "nothing.nc")


@pytest.mark.parametrize("kind", kinds())
def test_rejecting_bits_are_those_of_the_flags(kind: str):
    flags = flags_of(kind)
    for bit in flags:
        rejects = bool(bit & flags.rejecting)
        assert summarize_flags(np.array([int(bit)], np.int32), flags)[0] == (2 if rejects else 1)
