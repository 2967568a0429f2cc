"""Iris, cf-python and cf_xarray on products of every kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from lidarops.kinds import flags_of
from lidarops.netcdf.write import write_product

pytestmark = pytest.mark.slow


@pytest.fixture
def sample(product: Path) -> Path:
    """One product a kind, and a CF profile, because these libraries read slowly."""
    if "scan" not in product.stem and product.stem != "signal_vertical":
        pytest.skip("one beam a kind is enough")
    return product


def ancillaries(product: xr.Dataset) -> set[str]:
    return {
        name
        for variable in product.variables.values()
        for name in variable.attrs.get("ancillary_variables", "").split()
    }


@pytest.fixture
def iris(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("iris")
    import iris
    import iris.analysis
    import iris.common.metadata

    plain = iris.common.metadata.xxh64_hexdigest

    def encoded(item):
        return plain(item.encode() if isinstance(item, str) else item)

    # iris 3.14 passes text to xxhash, whose version 4 requires bytes.
    monkeypatch.setattr(iris.common.metadata, "xxh64_hexdigest", encoded)
    return iris


def test_iris_loads_every_variable_with_its_ancillaries_and_means(iris, sample: Path):
    cubes = {cube.var_name: cube for cube in iris.load(sample)}
    with xr.open_dataset(sample, decode_coords="all") as opened:
        numbers = {name for name, each in opened.data_vars.items() if each.dtype.kind in "fi"}
        held = {each.var_name for cube in cubes.values() for each in cube.ancillary_variables()}
        assert numbers <= {*cubes, *held}
        main = max(cubes.values(), key=lambda cube: len(cube.ancillary_variables()))
        of_main = set(opened[main.var_name].attrs["ancillary_variables"].split())
        assert {each.var_name for each in main.ancillary_variables()} == of_main
        assert main.coord("time").has_bounds()
        assert main.cell_methods
        assert len(main.coords("latitude")) <= 1
        mean = main.collapsed("time", iris.analysis.MEAN)
        expected = opened[main.var_name].astype(float).mean("time")
        np.testing.assert_allclose(np.ma.filled(mean.data, np.nan), expected, rtol=1e-6)


def test_cf_python_reads_fields_without_errors(sample: Path):
    cf = pytest.importorskip("cf")
    fields = cf.read(str(sample))
    with xr.open_dataset(sample, decode_coords="all") as opened:
        numbers = {name for name, each in opened.data_vars.items() if each.dtype.kind in "fi"}
        found = {field.nc_get_variable(): field for field in fields}
        assert numbers <= {*found, *ancillaries(opened)}
        main = max(fields, key=lambda field: len(field.field_ancillaries()))
        # One field only: cf-python takes seconds for each.
        assert set(main.dataset_compliance() or {}) <= {"CF version"}
        name = main.nc_get_variable()
        of_main = {each.nc_get_variable() for each in main.field_ancillaries().values()}
        assert of_main == set(opened[name].attrs["ancillary_variables"].split())
        mean = main.collapse("time: mean").squeeze().array
        expected = opened[name].astype(float).mean("time")
        np.testing.assert_allclose(np.ma.filled(mean, np.nan), expected, rtol=1e-6)
        if "featureType" in opened.attrs:
            assert opened.attrs["featureType"] in ("timeSeries", "timeSeriesProfile")
            assert main.DSG


def test_cf_xarray_finds_axes_bounds_and_flags(product: Path):
    pytest.importorskip("cf_xarray")
    with xr.open_dataset(product, decode_coords="all") as opened:
        assert opened.cf["time"].attrs["standard_name"] == "time"
        assert opened.cf.bounds["time"] == ["time_bnds"]
        assert opened.cf.axes["Z"] == ["altitude"]
        assert opened.cf.axes["T"] == ["time"]
        # Only one latitude is that of the values.
        assert len(opened.cf.standard_names["latitude"]) == 1
        # One variable of flags, and one of what they say, for each quantity that has its own.
        for name in opened.cf.standard_names["quality_flag"]:
            flags = opened[name]
            for bit in flags.attrs["flag_meanings"].split():
                place = int(flags_of(opened.attrs["lidarops_kind"]).named(bit))
                expected = (flags.to_numpy() & place) != 0
                np.testing.assert_array_equal((flags.cf == bit).to_numpy(), expected)
        for name in opened.cf.standard_names["aggregate_quality_flag"]:
            usable = opened[name]
            np.testing.assert_array_equal(usable.cf == "do_not_use", usable == 2)
            np.testing.assert_array_equal(usable.cf <= "use_with_care", usable <= 1)


def test_xarray_opens_many_days_at_once(product: Path, tmp_path: Path):
    pytest.importorskip("dask")
    with xr.open_dataset(product, decode_cf=False) as opened:
        later = opened.load().copy(deep=True)
    for name in ("time", "time_bnds"):
        later[name] = later[name].copy(data=later[name].values + 86400.0)
    later.encoding["unlimited_dims"] = {"time"}
    write_product(later, tmp_path / "later.nc")
    with xr.open_mfdataset(
        [product, tmp_path / "later.nc"],
        data_vars="minimal",
        coords="minimal",
        compat="override",
    ) as both:
        assert both.sizes["time"] == 2 * opened.sizes["time"]
        assert both["quality_flag"].dtype == np.int32
