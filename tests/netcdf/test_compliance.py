"""Products of every shape against compliance-checker in strict mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.products.compliance import findings, permitted
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context, homogeneous

from lidarops.flags import Quality
from lidarops.netcdf.write import write_product
from lidarops.records import DetectionMode

pytestmark = pytest.mark.slow

SCAN = {"zenith": [0.0, 30.0, 60.0, 80.0, 90.0], "azimuth": [0.0, 1.0, 2.0, 3.0, 4.0]}
SHAPES: dict[str, dict[str, Any]] = {
    "horizontal": {"zenith": 90.0, "azimuth": 200.0},
    "scan": SCAN,
    "one_profile": {"zenith": 3.0, "profiles": 1},
    "many_profiles": {"zenith": 0.0, "profiles": 300},
}


def missing(kind: str) -> xr.Dataset:
    data = MAKERS[kind](zenith=90.0)
    for name, variable in data.data_vars.items():
        if str(name).endswith("quality_flag"):
            variable[...] = int(Quality.INPUT_MISSING)
        elif variable.dtype.kind == "f":
            variable[...] = np.nan
    return data


@pytest.mark.parametrize("shape", list(SHAPES))
@pytest.mark.parametrize("kind", list(MAKERS))
def test_products_comply(kind: str, shape: str, tmp_path: Path):
    path = tmp_path / "product.nc"
    data = MAKERS[kind](**SHAPES[shape])
    write_product(build_product(data, context(kind)), path)
    assert findings(path) == (set(), permitted(kind, data))


@pytest.mark.parametrize("kind", list(MAKERS))
def test_a_product_of_missing_values_only_complies(kind: str, tmp_path: Path):
    path = tmp_path / "product.nc"
    of = context(kind, mode=DetectionMode.ANALOG, wavelength=float("nan"))
    data = missing(kind)
    write_product(build_product(data, of), path)
    assert findings(path) == (set(), permitted(kind, data))
    with xr.open_dataset(path) as product:
        of_aerosol = kind in ("elastic", "raman")
        main = "aerosol_extinction" if of_aerosol else "total_extinction"
        assert np.isnan(product["signal" if kind == "signal" else main]).all()
        assert "wavelength" not in product


def test_the_checker_detects_an_error(tmp_path: Path):
    product = build_product(homogeneous(), context())
    product["total_extinction"].attrs["units"] = "kg"
    product["total_extinction"].attrs["standard_name"] = "altitude"
    path = tmp_path / "product.nc"
    write_product(product, path)
    assert any("total_extinction" in said for said in findings(path)[0])
