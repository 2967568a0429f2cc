"""Two versions of a product: the grade of their difference, its size and its causes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.products.damaged_products import damage_values
from support.products.encoded_products import build_product
from support.products.made_products import (
    context,
    elastic,
    homogeneous,
    provenance,
    signal,
    visibility,
)
from typer.testing import CliRunner

from lidarops.catalog import product_files
from lidarops.cli import app
from lidarops.errors import ProductError
from lidarops.figures.wording import change_in_words
from lidarops.flags import Quality
from lidarops.netcdf import comparison, stored
from lidarops.netcdf.comparison import compare_products, quantity_changes
from lidarops.netcdf.write import write_product
from lidarops.records import Change, Grade, InputRecord, Measure, Role, Stamp
from lidarops.system.files import sha256_of

NAME = "total_extinction"


def written(path: Path, data: xr.Dataset, **changes: Any) -> Path:
    write_product(build_product(data, context(**changes)), path)
    return path


def compared(
    folder: Path, change: Callable[[xr.Dataset], Any] = lambda data: None, **changes: Any
) -> Change:
    """Return how a product differs from one with changed data or context."""
    other = homogeneous()
    change(other)
    old = written(folder / "old.nc", homogeneous())
    return compare_products(old, written(folder / "new.nc", other, **changes))


def shift(errors: float, where: Any = (2, 1)) -> Callable[[xr.Dataset], None]:
    def change(data: xr.Dataset) -> None:
        data[NAME][where] += errors * data[f"{NAME}_standard_error"][where]

    return change


def test_another_version_code_and_date_are_no_difference(tmp_path: Path):
    later = Stamp(2, context().written.replace(year=2030))
    code = replace(provenance(), code_version="fedcba9876543210")
    change = compared(tmp_path, stamp=later, provenance=code)
    assert (change.grade, change.largest, change.share) == (Grade.NONE, 0.0, 0.0)
    assert change.causes == ("software code: 0123456789abcdef -> fedcba9876543210",)


def test_the_change_of_a_quantity_is_stated_in_its_unit_where_both_are_usable(tmp_path: Path):
    old = homogeneous()
    new = old.copy(deep=True)
    new[NAME][:] -= 2e-6
    new[NAME][2] += 1e-4
    new["quality_flag"][2] = int(Quality.SATURATED)
    files = written(tmp_path / "old.nc", old), written(tmp_path / "new.nc", new)
    (change,) = [found for found in quantity_changes(*files) if found.quantity == NAME]
    with xr.open_dataset(files[1]) as now:
        kept = old[NAME].values[now["usable"].values < 2]
    assert (change.unit, change.values) == ("m-1", kept.size)
    assert change.before == pytest.approx(kept.mean(), rel=1e-3)
    assert (change.change, change.largest) == pytest.approx((-2e-6, -2e-6), abs=1e-7)


def test_a_product_is_compared_with_the_one_that_it_replaced(tmp_path: Path):
    product, picture = tmp_path / "products" / "elastic.nc", tmp_path / "change.png"
    compare = ["compare", str(product), "--json", "-o", str(picture)]
    data = elastic(zenith=0.0)
    for sign in (0, 1):
        data["aerosol_backscatter"] = data["aerosol_backscatter"] + sign * 1e-6
        written(tmp_path / "new.nc", data, kind="elastic")
        product.parent.mkdir(exist_ok=True)
        if sign:
            assert CliRunner().invoke(app, compare).exit_code == 2
            product_files.keep(tmp_path, product.name, sha256_of(product))
        (tmp_path / "new.nc").replace(product)
    found = CliRunner().invoke(app, compare)
    assert isinstance(found.exception, SystemExit)
    assert found.exit_code == 1
    rows = {row["quantity"]: row for row in json.loads(found.stdout)["quantities"]}
    assert rows["aerosol_backscatter"]["unit"] == "m-1 sr-1"
    assert rows["aerosol_backscatter"]["change"] == pytest.approx(1e-6, rel=0.05)
    assert picture.stat().st_size > 1000
    shown = CliRunner().invoke(app, compare[:2])
    assert "aerosol_backscatter" in shown.stdout


@pytest.mark.parametrize(
    ("errors", "grade"), [(0.05, Grade.MINOR), (0.2, Grade.MAJOR), (-3.0, Grade.MAJOR)]
)
def test_the_grade_goes_by_the_stated_error(errors: float, grade: Grade, tmp_path: Path):
    change = compared(tmp_path, shift(errors))
    assert change.grade is grade
    assert change.variable == NAME
    assert change.largest == pytest.approx(abs(errors), rel=1e-3)
    with xr.open_dataset(tmp_path / "old.nc", decode_cf=False) as old:
        sizes = [array.size for array in old.variables.values() if array.dtype.kind in "if"]
    assert change.share == pytest.approx(1 / sum(sizes))


def test_a_value_that_goes_is_major(tmp_path: Path):
    def lose(data: xr.Dataset) -> None:
        data[NAME][2, 1] = np.nan
        data["quality_flag"][2, 1] = 1

    change = compared(tmp_path, lose)
    assert (change.grade, change.variable, change.largest) == (Grade.MAJOR, NAME, 0.0)
    assert change.lost
    assert change_in_words(change).startswith(f"{change.lost} values came or went; ")


def changed_elastic(folder: Path, name: str, value: float) -> Change:
    """Return how a product differs in which one good bin has another value of a variable."""
    files = [written(folder / file, elastic(), kind="elastic") for file in ("old.nc", "new.nc")]
    with netCDF4.Dataset(files[0], "a") as product:
        # No error term is zero in the made product.
        product["aerosol_backscatter_error_lidar_ratio"][2, 10] = 0.0
    with netCDF4.Dataset(files[1], "a") as product:
        product["aerosol_backscatter_error_lidar_ratio"][2, 10] = 0.0
        product[name][2, 10] = value
    return compare_products(*files)


@pytest.mark.parametrize(("share", "grade"), [(1e-3, Grade.MINOR), (0.3, Grade.MAJOR)])
def test_a_term_of_the_error_that_was_zero_is_judged_by_the_error(
    share: float, grade: Grade, tmp_path: Path
):
    """Its relative change is infinite, and means nothing."""
    with xr.open_dataset(
        written(tmp_path / "whole.nc", elastic(), kind="elastic"), decode_cf=False
    ) as whole:
        error = float(whole["aerosol_backscatter_standard_error"][2, 10])
    name = "aerosol_backscatter_error_lidar_ratio"
    change = changed_elastic(tmp_path, name, share * error)
    assert (change.grade, change.variable, change.lost) == (grade, name, 0)
    assert change.measure is Measure.OF_ERROR
    assert change.largest == pytest.approx(share, rel=1e-3)
    assert f"up to {100 * share:.2g} % of the standard error in {name}" in change_in_words(change)


def test_another_caring_bit_is_counted_and_the_values_are_measured(tmp_path: Path):
    def change(data: xr.Dataset) -> None:
        data["quality_flag"][2, 1] = Quality.OUTLIER
        shift(0.05, (3, 1))(data)

    found = compared(tmp_path, change)
    assert (found.grade, found.variable, found.flags, found.lost) == (Grade.MINOR, NAME, 1, 0)
    assert found.largest == pytest.approx(0.05, rel=1e-3)
    assert "; 1 flag differs; " in change_in_words(found)


def test_a_rejecting_bit_leaves_the_other_values_measured(tmp_path: Path):
    def change(data: xr.Dataset) -> None:
        data["quality_flag"][2, 1] = Quality.INCOMPLETE_OVERLAP
        shift(0.05, (3, 1))(data)

    found = compared(tmp_path, change)
    assert found.grade is Grade.MAJOR
    assert found.lost
    assert found.largest == pytest.approx(0.05, rel=1e-3)


def test_values_that_are_rejected_in_both_are_not_measured(tmp_path: Path):
    old, new = homogeneous(), homogeneous()
    for data in (old, new):
        data["quality_flag"][2, 1] = Quality.INCOMPLETE_OVERLAP
    shift(9.0)(new)
    change = compare_products(written(tmp_path / "old.nc", old), written(tmp_path / "new.nc", new))
    assert (change.grade, change.largest) == (Grade.MINOR, 0.0)
    assert change.share > 0.0


def test_without_a_stated_error_the_difference_is_a_share_of_the_value(tmp_path: Path):
    def change(data: xr.Dataset) -> None:
        data["reduced_chi2"] *= 1.5

    found = compared(tmp_path, change)
    assert (found.grade, found.measure) == (Grade.MAJOR, Measure.SIZE)
    assert "up to 50 % of the value in reduced_chi2" in change_in_words(found)
    assert "up to 100 % of the value" in change_in_words(replace(found, largest=1.0))


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("time", 3600.0),
        ("time_bnds", 900.0),
        ("longitude", 0.9),
        ("station_altitude", 60.0),
        ("altitude", 300.0),
        ("wavelength", -22.0),
    ],
)
def test_values_of_another_place_time_or_wavelength_are_major(
    name: str, step: float, tmp_path: Path
):
    """An hour is a small share of the seconds since 1970."""
    files = [written(tmp_path / name, homogeneous()) for name in ("old.nc", "new.nc")]
    with netCDF4.Dataset(files[1], "a") as product:
        product[name][...] += step
    change = compare_products(*files)
    assert change.grade is Grade.MAJOR
    assert change_in_words(change).startswith(f"another {name}; ")


def test_other_units_are_major(tmp_path: Path):
    files = [written(tmp_path / name, homogeneous()) for name in ("old.nc", "new.nc")]
    with netCDF4.Dataset(files[1], "a") as product:
        product[NAME].units = "km-1"
    change = compare_products(*files)
    assert change.grade is Grade.MAJOR
    assert change_in_words(change).startswith(f"another meaning of {NAME}; ")


@pytest.mark.parametrize(("share", "grade"), [(0.005, Grade.MINOR), (0.5, Grade.MAJOR)])
@pytest.mark.parametrize("name", ["usable", "cloud_mask"])
def test_many_values_of_another_state_are_major(
    name: str, share: float, grade: Grade, tmp_path: Path
):
    """Good values that are all to be used with care are lost to whoever wants good ones."""
    files = [written(tmp_path / file, elastic(), kind="elastic") for file in ("old.nc", "new.nc")]
    for file, state in zip(files, (0, 1), strict=True):
        with netCDF4.Dataset(file, "a") as product:
            states = np.zeros(product[name].size, np.int8)
            states[: int(share * states.size)] = state
            product[name][...] = states.reshape(product[name].shape)
    change = compare_products(*files)
    assert change.grade is grade
    assert (f"other states of {name}" in change_in_words(change)) == (grade is Grade.MAJOR)


def test_few_good_values_that_are_lost_are_major(tmp_path: Path):
    """Two of twenty good values are to be used with care: at most 1 % of all."""
    files = [written(tmp_path / file, elastic(), kind="elastic") for file in ("old.nc", "new.nc")]
    for file, good in zip(files, (20, 18), strict=True):
        with netCDF4.Dataset(file, "a") as product:
            size = product["usable"].size
            states = np.where(np.arange(size) < good, 0, 1).astype(np.int8)
            product["usable"][...] = states.reshape(product["usable"].shape)
    assert size >= 200
    assert compare_products(*files).grade is Grade.MAJOR


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"station_key": "other"}, "lidarops_station"),
        ({"instrument_key": "other"}, "lidarops_instr"),
    ],
)
def test_another_product_is_refused(changes: dict[str, Any], field: str, tmp_path: Path):
    with pytest.raises(ProductError, match=field):
        compared(tmp_path, **changes)


@pytest.mark.parametrize("bound", [math.inf, -math.inf])
@pytest.mark.parametrize("changed", [0, 1])
def test_a_bound_that_becomes_infinite_or_finite_is_major(
    bound: float, changed: int, tmp_path: Path
):
    """An interval may be unbounded, as that of visibility in clear air."""
    name = "visibility_in_air_upper"
    files = [
        written(tmp_path / file, visibility(), kind="visibility") for file in ("old.nc", "new.nc")
    ]
    with netCDF4.Dataset(files[changed], "a") as product:
        product[name][2, 1] = bound
    change = compare_products(*files)
    assert (change.grade, change.variable, change.lost) == (Grade.MAJOR, name, 1)


@pytest.mark.parametrize("text", ["{}", "[]", '{"entity": []}', '{"entity": {"a": "b"}}'])
def test_a_product_without_its_making_is_one_error(text: str, tmp_path: Path):
    files = [written(tmp_path / name, homogeneous()) for name in ("old.nc", "new.nc")]
    with netCDF4.Dataset(files[1], "a") as product:
        product["provenance"][...] = text
    with pytest.raises(ProductError, match=r"new\.nc: provenance: does not say how"):
        compare_products(*files)


@pytest.mark.parametrize("name", [NAME, "provenance"])
@pytest.mark.parametrize("damaged", [0, 1])
def test_a_damaged_product_is_one_error(name: str, damaged: int, tmp_path: Path):
    files = [written(tmp_path / file, homogeneous()) for file in ("old.nc", "new.nc")]
    damage_values(files[damaged], name)
    with pytest.raises(ProductError, match=files[damaged].name):
        compare_products(*files)


def test_a_product_larger_than_memory_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    files = [tmp_path / f"{name}.nc" for name in ("old", "new")]
    for file in files:
        write_product(build_product(signal(300, 2000), context("signal")), file)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    monkeypatch.setattr(stored, "_MEMORY_SHARE", 1e6 / memory)
    with pytest.raises(ProductError, match="on this machine"):
        compare_products(*files)
    monkeypatch.setattr(comparison, "_BLOCK", 1 << 16)
    assert compare_products(*files).grade is Grade.NONE


def test_another_text_is_minor(tmp_path: Path):
    change = compared(tmp_path, title="Another title")
    assert (change.grade, change.variable, change.share) == (Grade.MINOR, "", 0.0)


def test_causes_of_long_texts_show_where_they_differ(tmp_path: Path):
    settings = dict(provenance().settings)
    texts = ["a text that is the same for quite a while, " * 3 + end for end in ("old", "new")]
    before, after = (provenance(settings={**settings, "note": text}) for text in texts)
    old = written(tmp_path / "old.nc", homogeneous(), provenance=before)
    new = written(tmp_path / "new.nc", homogeneous(), provenance=after)
    (cause,) = compare_products(old, new).causes
    assert cause == 'setting note: ...quite a while, old" -> ...quite a while, new"'


def test_causes_name_inputs_settings_and_packages(tmp_path: Path):
    before = provenance()
    dark = InputRecord("dark/d.dat", Role.DARK, "e" * 64)
    after = replace(
        before,
        inputs=(*before.inputs[:-1], dark),
        settings={**before.settings, "facts": {"full_overlap_range": 600.0}},
        versions={**before.versions, "numpy": "3.0"},
    )
    causes = compared(tmp_path, provenance=after).causes
    assert "input dark/d.dat: ffffffffffff -> eeeeeeeeeeee" in causes
    assert "setting facts.full_overlap_range: 500.0 -> 600.0" in causes
    assert "software numpy: 2.4.6 -> 3.0" in causes
