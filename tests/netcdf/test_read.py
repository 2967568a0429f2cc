"""Some variables are read with the values of xarray, for any part of a variable."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context, signal

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.netcdf import read
from lidarops.netcdf.read import open_product
from lidarops.netcdf.write import write_product


def by_xarray(path: Path) -> xr.Dataset:
    with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as product:
        return product.load()


def assert_same(found: xr.Variable, known: xr.Variable) -> None:
    assert found.dims == known.dims
    assert found.dtype == known.dtype
    np.testing.assert_array_equal(found.values, known.values)
    assert found.attrs.get("units") == known.attrs.get("units")


@pytest.fixture(scope="module")
def chunked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A signal product of three chunks, the last of them cut, with missing values."""
    data = signal(300, 2000)
    values = np.random.default_rng(3).normal(size=(300, 2000))
    values[5, 7:1900] = np.nan
    values[299] = np.nan
    values[0, 0] = np.nan
    flags = data["quality_flag"].values | np.where(np.isnan(values), Quality.INPUT_MISSING, 0)
    both = data["signal"].dims
    data = data.assign(signal=(both, values), quality_flag=(both, flags.astype(np.int32)))
    path = tmp_path_factory.mktemp("products") / "chunked.nc"
    write_product(build_product(data, context("signal")), path)
    with h5py.File(path) as file:
        assert file["signal"].id.get_num_chunks() == 3
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", MAKERS)
def test_every_variable_of_every_kind_is_read_as_by_xarray(kind: str, tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS[kind](), context(kind)), path)
    known = by_xarray(path)
    with open_product(path, map(str, known.variables)) as found:
        assert set(found.variables) == set(known.variables)
        for name, variable in known.variables.items():
            assert_same(found.variables[name], variable)
        assert found.sizes == known.sizes
        assert set(known.dims) & set(known.coords) <= set(found.coords)
    for name, variable in known.variables.items():
        # Bounds have no units of their own.
        with open_product(path, [str(name), "time"]) as found:
            assert_same(found.variables[name], variable)


def test_a_whole_product_has_the_coordinates_of_xarray(tmp_path: Path):
    path = tmp_path / "product.nc"
    moving = signal(zenith=[0.0, 30.0, 60.0, 30.0, 90.0])
    write_product(build_product(moving, context("signal")), path)
    known = by_xarray(path)
    with open_product(path, decode_coords=True) as found:
        assert set(found.coords) == set(known.coords)
        assert set(found.data_vars) == set(known.data_vars)


def test_missing_values_are_nan(chunked: Path):
    with open_product(chunked, ["signal"]) as product:
        missing = np.isnan(product["signal"].values)
    assert missing[5, 7:1900].all()
    assert missing[299].all()
    assert missing.sum() == 1893 + 2000 + 1


def slices(size: int) -> st.SearchStrategy[slice]:
    # xarray cannot handle empty slices that go backwards.
    return st.slices(size).filter(lambda part: len(range(size)[part]) > 0)


KEYS = st.one_of(
    st.integers(0, 299),
    slices(300),
    st.lists(st.integers(0, 299), min_size=1, max_size=5).map(np.array),
    st.lists(st.booleans(), min_size=300, max_size=300).map(np.array),
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.differing_executors])
@given(time=KEYS, bins=st.one_of(st.integers(0, 1999), slices(2000)))
def test_any_slice_equals_that_slice_of_the_whole(chunked: Path, time: object, bins: object):
    with open_product(chunked, ["signal", "quality_flag"]) as product:
        whole = product["signal"].values
        part = product["signal"].isel(time=time, range=bins)
        np.testing.assert_array_equal(part.values, whole[time][..., bins])
        twice = product.isel(range=bins).isel(time=time)["quality_flag"]
        flags = product["quality_flag"].values
        np.testing.assert_array_equal(twice.values, flags[time][..., bins])


def test_large_variables_are_read_in_parts(chunked: Path):
    tracemalloc.start()
    with open_product(chunked, ["signal", "quality_flag"]) as product:
        part = product["signal"].isel(time=slice(29, 31))
        assert part.values.shape == (2, 2000)
        peak = tracemalloc.get_traced_memory()[1]
        assert peak < product["signal"].nbytes / 3
    tracemalloc.stop()


def test_absent_variables_are_left_out(chunked: Path):
    with open_product(chunked, ["signal", "nothing", "nv"]) as product:
        assert set(product.variables) == {"signal"}


class TestOfOtherWriters:
    """Files that HDF5 reads, decoded as by xarray."""

    @pytest.mark.parametrize(
        "encoding",
        [
            {"dtype": "i2", "scale_factor": 0.5, "add_offset": 3.0, "_FillValue": -1},
            {"dtype": "f8", "_FillValue": np.nan, "fletcher32": True},
            {"dtype": "f4", "zlib": True, "shuffle": False},
            {"dtype": ">f4", "zlib": True, "shuffle": True},
            {"dtype": "i4", "_FillValue": -9},
        ],
    )
    def test_numbers(self, encoding: dict[str, object], tmp_path: Path):
        path = tmp_path / "other.nc"
        values = np.round(np.random.default_rng(1).uniform(0, 900, (100, 100)))
        values[3, 4] = np.nan
        if encoding["dtype"] in ("f4", ">f4"):
            values[3, 4] = 1.0
        xr.Dataset(
            {"x": (("time", "y"), values)},
            coords={"time": np.datetime64("2026-03-01", "ns") + np.arange(100) * 10**9},
        ).to_netcdf(path, encoding={"x": encoding, "time": {"dtype": "i8"}})
        known = by_xarray(path)
        with open_product(path, ["x", "time"]) as found:
            for name in ("x", "time"):
                np.testing.assert_array_equal(found[name].values, known[name].values)
            assert found["x"].dtype == known["x"].dtype

    def test_variable_with_the_name_of_another_dimension(self, tmp_path: Path):
        path = tmp_path / "named.nc"
        xr.Dataset({"y": ("time", np.arange(3.0)), "x": ("y", np.arange(4.0))}).drop_vars(
            "y"
        ).to_netcdf(path)
        import netCDF4

        with netCDF4.Dataset(path, "a") as file:
            file.createDimension("time", 3)
            file.createVariable("y", "f8", ("time",))[:] = np.arange(3.0)
        with open_product(path, ["x", "y"]) as product:
            assert product["y"].dims == ("time",)
            assert product["x"].dims == ("y",)

    def test_invalid_times(self, tmp_path: Path):
        path = tmp_path / "times.nc"
        units = {"units": "fortnights since the flood"}
        xr.Dataset({"time": ("time", np.arange(3.0), units)}).to_netcdf(path)
        with pytest.raises(ProductError, match="cannot be read"), open_product(path, ["time"]):
            pass


def _cut(whole: bytes) -> bytes:
    return whole[: len(whole) // 2]


def _spoilt(whole: bytes) -> bytes:
    return whole[:40] + b"\xff" * 400 + whole[440:]


def signal_in(path: Path) -> xr.DataArray:
    with open_product(path, ["signal"]) as product:
        return product["signal"].load()


class TestDamage:
    @pytest.mark.parametrize("damage", [bytes, lambda whole: b"garbage", _cut, _spoilt])
    def test_of_a_file_is_reported(
        self, damage: Callable[[bytes], bytes], chunked: Path, tmp_path: Path
    ):
        path = tmp_path / "damaged.nc"
        path.write_bytes(b"" if damage is bytes else damage(chunked.read_bytes()))
        with pytest.raises(ProductError, match=r"damaged\.nc: cannot be read: .+"):
            signal_in(path)

    def test_missing_file(self, tmp_path: Path):
        missing = pytest.raises(ProductError, match=r"no\.nc: the file is missing")
        with missing, open_product(tmp_path / "no.nc", []):
            pass

    def test_of_one_chunk_is_reported_when_it_is_read(self, chunked: Path, tmp_path: Path):
        path = tmp_path / "rotten.nc"
        whole = bytearray(chunked.read_bytes())
        with h5py.File(chunked) as file:
            assert file["signal"].nbytes > read.LAZY_BYTES
            place = file["signal"].id.get_chunk_info(1)
            first = place.chunk_offset[0]
        middle = place.byte_offset + place.size // 2
        whole[middle] ^= 0xFF
        path.write_bytes(whole)
        with open_product(path, ["signal"]) as product:
            product["signal"].isel(time=slice(0, first)).load()
        with (
            pytest.raises(ProductError, match=r"rotten\.nc: cannot be read: .+"),
            open_product(path, ["signal"]) as product,
        ):
            product["signal"].isel(time=slice(first, first + 1)).load()

    def test_leaves_no_file_open(self, tmp_path: Path):
        path = tmp_path / "times.nc"
        xr.Dataset({"time": ("time", [1.0], {"units": "x since y"})}).to_netcdf(path)
        with pytest.raises(ProductError), open_product(path, ["time"]):
            pass
        # HDF5 refuses to write to a file that it has open for reading.
        with h5py.File(path, "a") as file:
            file.attrs["title"] = "still writable"
