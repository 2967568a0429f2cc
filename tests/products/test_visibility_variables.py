"""The ``visibility`` product: CF discrete sampling geometry, complete and compliant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.products.compliance import findings, permitted
from support.products.encoded_products import build_product
from support.products.made_network import product as made
from support.products.made_products import context

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.netcdf.variables import layout_of
from lidarops.netcdf.write import write_product

KIND = "visibility"


@pytest.fixture(scope="module")
def data() -> xr.Dataset:
    return made()


@pytest.mark.slow
@pytest.mark.parametrize("intervals", [1, 6])
def test_it_complies(intervals: int, tmp_path: Path):
    retrieved = made(intervals)
    path = tmp_path / "product.nc"
    write_product(build_product(retrieved, context(KIND)), path)
    assert findings(path) == (set(), permitted(KIND, retrieved))


@pytest.mark.slow
def test_missing_values_only_comply(data: xr.Dataset, tmp_path: Path):
    lost = data.copy(deep=True)
    lost["quality_flag"][:] = int(Quality.INPUT_MISSING)
    for name, variable in lost.data_vars.items():
        if variable.dtype.kind == "f" and name != "beam_range":
            variable[...] = np.nan
    path = tmp_path / "product.nc"
    write_product(build_product(lost, context(KIND)), path)
    assert findings(path) == (set(), permitted(KIND, lost))


def test_each_crossing_is_a_time_series(data: xr.Dataset, tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(data, context(KIND)), path)
    with xr.open_dataset(path) as stored:
        assert stored.attrs["featureType"] == "timeSeries"
        roles = [name for name, v in stored.variables.items() if "cf_role" in v.attrs]
        assert roles == ["crossing_id"]
        assert stored["crossing_id"].dims == ("crossing",)
        main = stored["visibility_in_air"]
        assert main.attrs["standard_name"] == "visibility_in_air"
        assert main.attrs["units"] == "m"
        assert main.dims == ("time", "crossing")
        assert {"latitude", "longitude", "altitude", "crossing_id"} <= set(main.coords)
        assert stored.attrs["geospatial_lat_min"] == pytest.approx(float(data["latitude"].min()))
        assert stored.attrs["geospatial_lon_max"] == pytest.approx(float(data["longitude"].max()))
        assert "POLYGON" in stored.attrs["geospatial_bounds"]
        # Positions and pointings of the lidars.
        np.testing.assert_allclose(stored["beam_azimuth"], [70, 310, 190])
        np.testing.assert_allclose(stored["beam_latitude"], data["beam_latitude"])
        assert np.isfinite(stored["beam_range"]).sum() == 6
        assert "beam 0: lidar-0" in stored.attrs["lidarops_steps"]
        np.testing.assert_allclose(main, data["visibility_in_air"], rtol=2e-4)


def test_a_value_may_not_be_missing_without_a_reason(data: xr.Dataset):
    silent = data.copy(deep=True)
    silent["total_extinction"][0, 0] = np.nan
    with pytest.raises(ProductError, match="no quality bit"):
        build_product(silent, context(KIND))


def test_bits_are_those_that_a_network_can_raise(data: xr.Dataset):
    flags = layout_of(KIND).rows["quality_flag"].flags
    assert flags is not None
    strange = data.copy(deep=True)
    strange["quality_flag"][0, 0] = int(Quality.NO_GLUING)
    with pytest.raises(ProductError, match="not have: 16"):
        build_product(strange, context(KIND))
