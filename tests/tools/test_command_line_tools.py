"""CDO, NCO and ncdump on products of every kind: means, subsets and joined files."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr

from lidarops.netcdf.write import chunk_sizes

pytestmark = pytest.mark.slow


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"{name} is not installed")


def call(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        check=True,
        capture_output=True,
        encoding="utf-8",
        # CDO cuts texts in the middle of a UTF-8 character.
        errors="replace",
    )


def measured(product: xr.Dataset) -> Iterator[str]:
    """Return the names of numeric variables over time, which are averaged."""
    for name, variable in product.data_vars.items():
        if variable.dims[:1] == ("time",) and variable.dtype.kind == "f":
            yield str(name)


def assert_means(product: Path, means: Path, names: list[str]) -> None:
    with xr.open_dataset(product) as before, xr.open_dataset(means) as after:
        assert names
        for name in names:
            expected = before[name].astype(float).mean("time")
            np.testing.assert_allclose(
                np.squeeze(after[name].to_numpy()), np.squeeze(expected), rtol=1e-6, err_msg=name
            )


def values_of(product: Path) -> list[str]:
    with xr.open_dataset(product, decode_coords="all") as opened:
        return list(measured(opened))


@pytest.fixture
def for_cdo(product: Path, tmp_path: Path) -> Path:
    """The product, without positions that CDO cannot read.

    CDO 2.1 skips series whose positions are not on a grid. It reads them without the attribute
    ``coordinates`` (``ncatted -a coordinates,,d,,``).
    """
    if not product.stem.startswith("visibility"):
        return product
    plain = Path(shutil.copy(product, tmp_path / "plain.nc"))
    with netCDF4.Dataset(plain, "a") as file:
        for variable in file.variables.values():
            if "coordinates" in variable.ncattrs():
                variable.delncattr("coordinates")
    return plain


@needs("cdo")
def test_cdo_reports_that_it_skips_series_of_many_positions(
    made: Callable[[str, str], Path],
):
    shown = call("cdo", "showname", made("visibility", "horizontal"))
    assert "skipped variable visibility_in_air!" in shown.stderr


@needs("cdo")
def test_cdo_takes_means_over_time(product: Path, for_cdo: Path, tmp_path: Path):
    names = values_of(product)
    # CDO averages floats in single precision unless double precision is requested.
    call(
        "cdo",
        "-s",
        "-b",
        "F64",
        "timmean",
        f"-selname,{','.join(names)}",
        for_cdo,
        tmp_path / "m.nc",
    )
    assert_means(product, tmp_path / "m.nc", names)


@needs("cdo")
def test_cdo_reads_every_number_and_names_skipped_text(product: Path, for_cdo: Path):
    shown = call("cdo", "showname", for_cdo)
    with xr.open_dataset(product, decode_coords="all") as opened:
        numbers = {str(name) for name, each in opened.data_vars.items() if each.dtype.kind in "fi"}
    # Scalars are no fields for CDO: a container, and the method of a network, which has no place.
    scalars = {"quantization_info"} | ({"retrieval_method"} if "crossing" in opened.dims else set())
    assert numbers - set(shown.stdout.split()) <= scalars
    # CDO 2.1 has no text: the two variables are named on standard error, nothing else is lost.
    for name in ("station", "provenance"):
        assert name not in shown.stdout.split()
        assert f"skipped variable {name}" in shown.stderr


@needs("cdo")
def test_cdo_joins_days_and_keeps_bits(product: Path, for_cdo: Path, tmp_path: Path):
    one, later = for_cdo, tmp_path / "later.nc"
    if for_cdo != product:
        # Without positions, CDO takes the beams of a network for series.
        one = tmp_path / "one.nc"
        call("cdo", "-s", "selname,total_extinction,quality_flag", for_cdo, one)
    call("cdo", "-s", "shifttime,1day", one, later)
    call("cdo", "-s", "mergetime", one, later, tmp_path / "both.nc")
    with xr.open_dataset(product) as before, xr.open_dataset(tmp_path / "both.nc") as both:
        assert both.sizes["time"] == 2 * before.sizes["time"]
        flags = np.squeeze(both["quality_flag"].to_numpy())[: before.sizes["time"]]
        np.testing.assert_array_equal(flags, np.squeeze(before["quality_flag"].to_numpy()))


@needs("cdo")
@pytest.mark.parametrize("kind", ["signal", "elastic", "raman"])
def test_cdo_selects_altitudes_of_vertical_lidars(
    kind: str, made: Callable[[str, str], Path], tmp_path: Path
):
    product = made(kind, "vertical")
    with xr.open_dataset(product) as opened:
        name = next(iter(values_of(product)))
        shown = call("cdo", "-s", "showlevel", f"-selname,{name}", product).stdout
        levels = np.array(shown.split(), float)
        np.testing.assert_allclose(levels, opened["altitude"], rtol=1e-6)
        call("cdo", "-s", f"sellevel,{levels[2]}", f"-selname,{name}", product, tmp_path / "one.nc")
        with xr.open_dataset(tmp_path / "one.nc") as one:
            expected = opened[name].sel(altitude=levels[2], method="nearest")
            np.testing.assert_array_equal(np.squeeze(one[name].to_numpy()), expected)


@needs("ncra")
def test_nco_takes_means_over_time(product: Path, tmp_path: Path):
    call("ncra", "--dbl", product, tmp_path / "mean.nc")
    assert_means(product, tmp_path / "mean.nc", values_of(product))


@needs("ncrcat")
def test_nco_joins_files_over_time(product: Path, tmp_path: Path):
    later = tmp_path / "later.nc"
    shutil.copy(product, later)
    with netCDF4.Dataset(later, "a") as file:
        for name in ("time", "time_bnds"):
            file[name][:] = file[name][:] + 86400.0
    call("ncrcat", product, later, tmp_path / "both.nc")
    with xr.open_dataset(tmp_path / "both.nc") as both, xr.open_dataset(product) as one:
        profiles = one.sizes["time"]
        np.testing.assert_array_equal(both["time"][:profiles], one["time"])
        np.testing.assert_array_equal(both["time"][profiles:], one["time"] + np.timedelta64(1, "D"))
        for name, variable in one.variables.items():
            if "time" in variable.dims and variable.dtype.kind in "fi":
                for half in (both[name][:profiles], both[name][profiles:]):
                    np.testing.assert_array_equal(half, variable)
        assert both["station"].item() == one["station"].item()
    with netCDF4.Dataset(tmp_path / "both.nc") as file:
        assert file.dimensions["time"].isunlimited()
        variable = file["quality_flag"]
        assert variable.chunking() != [1, *variable.shape[1:]]


@needs("ncks")
def test_nco_extracts_variables_with_their_ancillaries(product: Path, tmp_path: Path):
    names = [name for name in values_of(product) if not name.startswith("bin_")]
    call("ncks", "-v", names[0], "-d", "time,1,3", product, tmp_path / "cut.nc")
    with xr.open_dataset(product) as whole, xr.open_dataset(tmp_path / "cut.nc") as cut:
        np.testing.assert_array_equal(cut[names[0]], whole[names[0]][1:4])
        # By the attributes `ancillary_variables`, `coordinates` and `bounds`.
        assert {f"{names[0]}_standard_error", "quality_flag", "usable", "time_bnds"} <= set(
            cut.variables
        )
        assert {"latitude", "longitude"} <= set(cut.variables) or len(whole[names[0]].dims) > 2


@needs("ncdump")
def test_ncdump_shows_one_epoch_and_the_meanings_of_flags(product: Path):
    header = call("ncdump", "-hs", product).stdout
    assert "time = UNLIMITED" in header
    assert 'time:units = "seconds since 1970-01-01 00:00:00"' in header
    assert 'usable:flag_meanings = "good use_with_care do_not_use"' in header
    assert "usable:flag_values = 0b, 1b, 2b" in header
    assert ':_Format = "netCDF-4 classic model"' in header
    assert "NaN" not in header


def test_chunks_have_the_declared_shape(
    made: Callable[[str, str], Path],
):
    # An unlimited dimension would give chunks of one profile, and aggregates 30 times slower.
    with netCDF4.Dataset(made("signal", "scan")) as file:
        for variable in file.variables.values():
            if variable.chunking() != "contiguous":
                expected = chunk_sizes(variable.shape, variable.dtype.itemsize)
                assert tuple(variable.chunking()) == expected
