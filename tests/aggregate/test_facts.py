"""Facts and groups of products; paths that lead out of their folder are refused."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from support.archives.aggregate_archive import add_day, facts_of

from lidarops.aggregate.facts import (
    Facts,
    ProductSelection,
    Refused,
    grid_notes,
    groups,
    list_products,
    read_product_facts,
    within,
)
from lidarops.errors import ProductError
from lidarops.kinds import flags_of
from lidarops.netcdf.write import write_plain


def test_facts_are_those_of_the_file(tmp_path: Path):
    path = add_day(tmp_path, 2, profiles=5, sections=3)
    (facts,) = facts_of(tmp_path)
    with xr.open_dataset(tmp_path / path) as product:
        flags = product.quality_flag.to_numpy()
        assert facts.id == product.attrs["id"]
        assert facts.start == datetime(2026, 3, 3, 10, tzinfo=UTC)
        assert facts.stop == datetime(2026, 3, 3, 10, 50, tzinfo=UTC)
    assert facts.verdicts.values == flags.size == 15
    assert facts.verdicts.usable == np.count_nonzero((flags & flags_of(facts.kind).rejecting) == 0)
    assert facts.verdicts.good == np.count_nonzero(flags == 0)
    assert facts.flagged == {"NO_SIGNAL": 1, "LOW_SIGNAL": 1}
    assert facts.wavelength == pytest.approx(532e-9)
    assert (facts.latitude, facts.longitude, facts.altitude) == (46.44, 30.76, 53.5)
    assert facts.size == (tmp_path / path).stat().st_size


def test_products_of_one_grid_form_one_group_for_any_number_of_profiles(tmp_path: Path):
    add_day(tmp_path, 0, profiles=5)
    add_day(tmp_path, 1, profiles=7)
    by_group = groups(facts_of(tmp_path))
    assert [len(products) for products in by_group.values()] == [2]
    assert grid_notes(by_group) == []


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
def test_products_of_another_grid_form_another_group_with_a_note(other, tmp_path: Path):
    add_day(tmp_path, 0)
    add_day(tmp_path, 1, **other)
    by_group = groups(facts_of(tmp_path))
    assert [len(products) for products in by_group.values()] == [1, 1]
    (sentence,) = grid_notes(by_group)
    assert "odesa lidar-1 homogeneous photon_532o: products of 2 grids" in sentence


def test_damaged_and_foreign_files_are_refused_and_others_read(tmp_path: Path):
    good = add_day(tmp_path, 0)
    damaged = add_day(tmp_path, 1)
    content = (tmp_path / damaged).read_bytes()
    (tmp_path / damaged).write_bytes(content[: len(content) // 2])
    write_plain(xr.Dataset({"a": ("x", np.arange(3.0))}), tmp_path / "products/foreign.nc")
    (tmp_path / "products/text.nc").write_text("no NetCDF")
    results = {path: read_product_facts(tmp_path, path) for path in list_products(tmp_path)}
    assert isinstance(results.pop(good), Facts)
    assert set(results) == {damaged, "products/foreign.nc", "products/text.nc"}
    assert all(isinstance(file, Refused) and file.reason for file in results.values())


def test_an_attribute_that_a_product_lacks_is_named(tmp_path: Path):
    path = add_day(tmp_path, 0)
    with netCDF4.Dataset(tmp_path / path, "a") as product:
        del product.lidarops_campaign
    refused = read_product_facts(tmp_path, path)
    assert isinstance(refused, Refused)
    assert "lidarops_campaign" in refused.reason


def test_hidden_files_and_aggregates_are_not_listed(tmp_path: Path):
    path = add_day(tmp_path, 0, folder="")
    for name in ("aggregates/means/a.nc", ".hidden/a.nc", "odesa/.a.nc"):
        target = tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(b"")
    assert list_products(tmp_path) == [path]


def test_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(ProductError, match="is not a folder"):
        list_products(tmp_path / "nothing")


@given(st.lists(st.sampled_from(["a", "..", ".", "b.nc", ""]), max_size=6), st.booleans())
def test_no_path_leads_out(parts: list[str], absolute: bool):
    root = Path("/srv/out")
    path = ("/" if absolute else "") + "/".join(parts)
    try:
        file = within(root, path)
    except ProductError:
        return
    assert file.resolve().is_relative_to(root.resolve())
    assert ".." not in file.parts


def test_a_link_to_the_outside_is_refused(tmp_path: Path):
    outside = add_day(tmp_path / "elsewhere", 0)
    root = tmp_path / "out"
    (root / "products").mkdir(parents=True)
    (root / "products/link.nc").symlink_to(tmp_path / "elsewhere" / outside)
    refused = read_product_facts(root, "products/link.nc")
    assert isinstance(refused, Refused)
    assert "leads out of" in refused.reason


def test_a_selection_admits_products_that_overlap_in_time(tmp_path: Path):
    for day in range(4):
        add_day(tmp_path, day)
    add_day(tmp_path, 1, "signal")
    selection = ProductSelection(
        "homogeneous",
        since=datetime(2026, 3, 2, 10, 30, tzinfo=UTC),
        until=datetime(2026, 3, 3, 10, 10, tzinfo=UTC),
    )
    selected = [read_product_facts(tmp_path, path, selection) for path in list_products(tmp_path)]
    assert [facts.start.day for facts in selected if isinstance(facts, Facts)] == [2, 3]
