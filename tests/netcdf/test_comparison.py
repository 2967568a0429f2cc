"""Two versions of a product: the grade of their difference, its size and its causes."""

from __future__ import annotations

import math
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
from support.products.made_products import context, homogeneous, provenance, visibility

from lidarops.errors import ProductError
from lidarops.netcdf import sizes
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.write import write_product
from lidarops.records import Change, Grade, InputRecord, Role, Stamp

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


@pytest.mark.parametrize(
    ("errors", "grade"), [(0.05, Grade.MINOR), (0.2, Grade.MAJOR), (-3.0, Grade.MAJOR)]
)
def test_the_grade_goes_by_the_stated_error(errors: float, grade: Grade, tmp_path: Path):
    change = compared(tmp_path, shift(errors))
    assert change.grade is grade
    assert change.variable == NAME
    assert change.largest == pytest.approx(abs(errors), rel=1e-3)
    with xr.open_dataset(tmp_path / "old.nc", decode_cf=False) as old:
        sizes = [array.size for name, array in old.variables.items() if name != "provenance"]
    assert change.share == pytest.approx(1 / sum(sizes))


def test_a_value_that_goes_is_major(tmp_path: Path):
    def lose(data: xr.Dataset) -> None:
        data[NAME][2, 1] = np.nan
        data["quality_flag"][2, 1] = 1

    change = compared(tmp_path, lose)
    assert change.grade is Grade.MAJOR
    assert math.isinf(change.largest)
    assert change.as_dict()["largest"] is None


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
    assert (change.grade, change.variable) == (Grade.MAJOR, name)
    assert math.isinf(change.largest)


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
    monkeypatch.setattr(sizes, "_MEMORY_SHARE", 1e-12)
    assert compared(tmp_path).grade is Grade.NONE


def test_another_text_is_minor(tmp_path: Path):
    change = compared(tmp_path, title="Another title")
    assert (change.grade, change.variable, change.share) == (Grade.MINOR, "", 0.0)


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
