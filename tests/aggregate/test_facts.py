"""Facts of products, their groups, and paths that stay in their folder."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from support.aggregate_archive import add_day, facts_of

from lidarops.aggregate.facts import (
    Facts,
    ProductSelection,
    Refused,
    groups,
    list_products,
    read_facts,
    read_product_facts,
    told_grids,
    within,
)
from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.netcdf.write import write_plain
from lidarops.records import ProductKind


def test_facts_are_what_the_file_holds(tmp_path: Path):
    path = add_day(tmp_path, 2, profiles=5, sections=3)
    facts = read_facts(tmp_path, path)
    with xr.open_dataset(tmp_path / path) as product:
        flags = product.quality_flag.to_numpy()
        assert facts.id == product.attrs["id"]
        assert facts.start == datetime(2026, 3, 3, 10, tzinfo=UTC)
        assert facts.stop == datetime(2026, 3, 3, 10, 50, tzinfo=UTC)
    assert facts.values == flags.size == 15
    assert facts.usable == np.count_nonzero((flags & int(Quality.rejecting())) == 0)
    assert facts.unflagged == np.count_nonzero(flags == 0)
    assert facts.flagged == {"NO_SIGNAL": 1, "LOW_SIGNAL": 1}
    assert facts.wavelength == pytest.approx(532e-9)
    assert (facts.latitude, facts.longitude, facts.altitude) == (46.44, 30.76, 53.5)
    assert facts.size == (tmp_path / path).stat().st_size


def test_products_of_one_grid_are_one_group_whatever_their_number_of_profiles(tmp_path: Path):
    add_day(tmp_path, 0, profiles=5)
    add_day(tmp_path, 1, profiles=7)
    found = groups(facts_of(tmp_path))
    assert [len(products) for products in found.values()] == [2]
    assert told_grids(found) == []


@pytest.mark.parametrize(
    "other",
    [
        {"sections": 3},
        {"zenith": 5.0},
        {"change": lambda data: data.assign_coords(section_range=data.section_range + 1.0)},
        {"of": {"wavelength": 355e-9}},
    ],
    ids=["sections", "zenith", "range", "wavelength"],
)
def test_products_of_another_grid_are_a_group_of_their_own_and_told(other, tmp_path: Path):
    add_day(tmp_path, 0)
    add_day(tmp_path, 1, **other)
    found = groups(facts_of(tmp_path))
    assert [len(products) for products in found.values()] == [1, 1]
    (sentence,) = told_grids(found)
    assert "odesa lidar-1 homogeneous photon_532o: products of 2 grids" in sentence


def test_a_damaged_file_and_a_foreign_file_are_named_and_the_rest_goes_on(tmp_path: Path):
    good = add_day(tmp_path, 0)
    damaged = add_day(tmp_path, 1)
    content = (tmp_path / damaged).read_bytes()
    (tmp_path / damaged).write_bytes(content[: len(content) // 2])
    write_plain(xr.Dataset({"a": ("x", np.arange(3.0))}), tmp_path / "products/foreign.nc")
    (tmp_path / "products/text.nc").write_text("no NetCDF")
    found = {each.path: each for each in read_product_facts(tmp_path, list_products(tmp_path))}
    assert isinstance(found.pop(good), Facts)
    assert set(found) == {damaged, "products/foreign.nc", "products/text.nc"}
    assert all(isinstance(each, Refused) and each.reason for each in found.values())


def test_hidden_files_and_aggregates_are_not_listed(tmp_path: Path):
    path = add_day(tmp_path, 0, folder="")
    for name in ("aggregates/means/a.nc", ".hidden/a.nc", "odesa/.a.nc"):
        target = tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(b"")
    assert list_products(tmp_path) == [path]


def test_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(ProductError, match="is no folder"):
        list_products(tmp_path / "nothing")


@given(st.lists(st.sampled_from(["a", "..", ".", "b.nc", ""]), max_size=6), st.booleans())
def test_no_path_leads_out(parts: list[str], absolute: bool):
    root = Path("/srv/out")
    path = ("/" if absolute else "") + "/".join(parts)
    try:
        found = within(root, path)
    except ProductError:
        return
    assert found.resolve().is_relative_to(root.resolve())
    assert ".." not in found.parts


def test_a_link_to_the_outside_is_refused(tmp_path: Path):
    outside = add_day(tmp_path / "elsewhere", 0)
    root = tmp_path / "out"
    (root / "products").mkdir(parents=True)
    (root / "products/link.nc").symlink_to(tmp_path / "elsewhere" / outside)
    (found,) = read_product_facts(root, list_products(root))
    assert isinstance(found, Refused)
    assert "leads out of" in found.reason


def test_a_selection_admits_what_overlaps_in_time(tmp_path: Path):
    for day in range(4):
        add_day(tmp_path, day)
    add_day(tmp_path, 1, ProductKind.SIGNAL)
    wanted = ProductSelection(
        ProductKind.HOMOGENEOUS,
        since=datetime(2026, 3, 2, 10, 30, tzinfo=UTC),
        until=datetime(2026, 3, 3, 10, 10, tzinfo=UTC),
    )
    found = list(read_product_facts(tmp_path, list_products(tmp_path), wanted))
    assert [each.start.day for each in found if isinstance(each, Facts)] == [2, 3]
