"""Products of vertical lidars have altitude as dimension, and are read along range as others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day, facts_of
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops import open_products
from lidarops.aggregate.facts import Period, groups
from lidarops.aggregate.means import Means
from lidarops.netcdf import product_file
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.read import open_product
from lidarops.netcdf.stored import open_stored
from lidarops.netcdf.write import write_product
from lidarops.records import Grade
from lidarops.reports.inspection import describe

KINDS = ("signal", "elastic", "raman")
"""Kinds whose values lie at range bins."""


def made(path: Path, kind: str, **beam: Any) -> Path:
    write_product(build_product(MAKERS[kind](**beam), context(kind)), path)
    return path


@pytest.fixture
def former(monkeypatch: pytest.MonkeyPatch):
    """Write products as earlier versions did: along range."""
    monkeypatch.setattr(product_file, "on_altitude", dict)
    return monkeypatch


@pytest.mark.parametrize("kind", KINDS)
def test_values_of_a_vertical_lidar_are_selected_by_altitude(kind: str, tmp_path: Path):
    with xr.open_dataset(made(tmp_path / "product.nc", kind, zenith=5.0)) as product:
        assert "range" not in product.dims
        altitude = product.indexes["altitude"]
        assert altitude.is_monotonic_increasing
        assert altitude.is_unique
        assert product["altitude"].attrs["axis"] == "Z"
        assert product["altitude"].attrs["positive"] == "up"
        distance = product.coords["range"]
        assert distance.dims == ("altitude",)
        one = product.sel(altitude=200.0, method="nearest")
        expected = 53.5 + one["range"] * np.cos(np.deg2rad(5.0))
        assert one["altitude"].item() == pytest.approx(expected.item())
        assert abs(one["altitude"].item() - 200.0) <= 0.5 * np.diff(altitude).max()
        for variable in product.data_vars.values():
            assert "range" not in variable.attrs.get("cell_methods", "")


@pytest.mark.parametrize(
    "beam",
    [
        {"zenith": 11.0},
        {"zenith": 90.0},
        # It looks down, so that altitude falls with range.
        {"zenith": 180.0},
        {"zenith": [0.0, 0.0, 0.0, 0.0, 1.0]},
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_other_lidars_keep_range(kind: str, beam: dict[str, Any], tmp_path: Path):
    with xr.open_dataset(made(tmp_path / "product.nc", kind, **beam)) as product:
        assert product["range"].dims == ("range",)
        assert "altitude" not in product.dims


def test_altitudes_that_rounding_makes_equal_are_no_dimension(tmp_path: Path):
    data = MAKERS["signal"](zenith=0.0)
    fine = data.assign_coords(range=1e-8 * data["range"])
    write_product(build_product(fine, context("signal")), tmp_path / "product.nc")
    with xr.open_dataset(tmp_path / "product.nc") as product:
        assert product["altitude"].dims == ("range",)


@pytest.mark.parametrize("kind", KINDS)
def test_products_of_earlier_versions_are_read_alike(
    kind: str, tmp_path: Path, former: pytest.MonkeyPatch
):
    old = made(tmp_path / "old.nc", kind, zenith=0.0)
    former.undo()
    new = made(tmp_path / "new.nc", kind, zenith=0.0)
    names = [name for name in xr.open_dataset(old).variables if name != "provenance"]
    with open_product(old, names) as before, open_product(new, names) as now:
        assert now["range"].dims == ("range",)
        for name in names:
            assert before[name].dims == now[name].dims
            np.testing.assert_array_equal(before[name].values, now[name].values)
    # A run replaces it, because others see another dimension; no value has changed.
    change = compare_products(old, new)
    assert change.grade is Grade.MINOR
    assert (change.largest, change.lost, change.moved) == (0.0, 0, "")


def test_products_of_both_versions_are_one_series(tmp_path: Path, former: pytest.MonkeyPatch):
    add_day(tmp_path, 0, "elastic")
    former.undo()
    add_day(tmp_path, 1, "elastic")
    assert len({facts.grid for facts in facts_of(tmp_path)}) == 1
    data = open_products(tmp_path)
    assert data["aerosol_backscatter"].dims == ("time", "altitude")
    assert data["range"].dims == ("altitude",)
    assert "range" in data.coords
    one = data["aerosol_backscatter"].sel(altitude=200.0, method="nearest").load()
    assert one.sizes == {"time": 10}


def test_means_lie_along_altitude(tmp_path: Path):
    for day in range(2):
        add_day(tmp_path, day, "elastic")
    grouped = groups(facts_of(tmp_path))
    (group,) = grouped
    (file,) = Means(tmp_path, grouped, Period.MONTH).of(group).files
    with xr.open_dataset(tmp_path / file.path) as means, open_products(tmp_path) as days:
        assert means["aerosol_backscatter"].dims == ("time", "altitude")
        assert "altitude: mean" in means["aerosol_backscatter"].attrs["cell_methods"]
        expected = days["aerosol_backscatter"].mean("time")
        found = means["aerosol_backscatter"].squeeze("time")
        np.testing.assert_allclose(found, expected, rtol=1e-2)
        np.testing.assert_array_equal(means["altitude"], days["altitude"])


def test_inspect_states_the_dimensions_of_the_file(tmp_path: Path):
    shown = describe(made(tmp_path / "product.nc", "signal", zenith=0.0))
    assert "altitude" in shown["dimensions"]
    assert "range" not in shown["dimensions"]
    dimensions = {each["name"]: each["dimensions"] for each in shown["variables"]}
    assert dimensions["range"] == f"altitude {shown['dimensions']['altitude']}"


def test_a_foreign_file_with_both_dimensions_keeps_them(tmp_path: Path):
    path = tmp_path / "foreign.nc"
    with netCDF4.Dataset(path, "w") as file:
        for name, size in (("altitude", 3), ("range", 4)):
            file.createDimension(name, size)
        file.createVariable("altitude", "f8", ("altitude",))[:] = np.arange(3.0)
        file.createVariable("range", "f8", ("altitude",))[:] = np.arange(3.0)
        file.createVariable("x", "f8", ("range", "altitude"))[:] = np.zeros((4, 3))
    with open_stored(path) as product:
        assert product["x"].dims == ("range", "altitude")
