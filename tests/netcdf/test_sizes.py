"""Crafted NetCDF files cost one line: no memory, and no file of the machine is read."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day
from support.archives.site_archive import add
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.errors import ProductError
from lidarops.netcdf import stored
from lidarops.netcdf.read import open_product
from lidarops.netcdf.stored import open_stored


def _unwritten(file: Path) -> None:
    """A variable of 80 TB of which nothing was written."""
    with netCDF4.Dataset(file, "a") as product:
        for side in ("broad", "high"):
            product.createDimension(side, 3_200_000)
        product.createVariable("bomb", "f8", ("broad", "high"), zlib=True, chunksizes=(64, 64))


def _coordinate(file: Path) -> None:
    """A coordinate, which xarray reads when it opens the file."""
    with netCDF4.Dataset(file, "a") as product:
        product.createDimension("bomb", 4 * 10**9)
        product.createVariable("bomb", "f8", ("bomb",), zlib=True, chunksizes=(4096,))


def _large_chunk(file: Path) -> None:
    with h5py.File(file, "a") as product:
        product.create_dataset(
            "bomb", (1, 1), "u1", chunks=(30_000, 60_000), maxshape=(None, None), compression=1
        )


def _other_file(file: Path) -> None:
    with h5py.File(file, "a") as product:
        product.create_dataset("bomb", (64,), "u1", external=[("/etc/passwd", 0, 64)])


def _link(file: Path) -> None:
    with h5py.File(file, "a") as product:
        product["bomb"] = h5py.ExternalLink("/etc/passwd", "/")


def _virtual(file: Path) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4,))
    with h5py.File(file, "a") as product:
        product.create_virtual_dataset("bomb", layout)


def _variable_length(file: Path) -> None:
    with h5py.File(file, "a") as product:
        product.create_dataset("bomb", (2,), dtype=h5py.vlen_dtype("i4"))[0] = np.arange(3)


def check_sizes(path: Path) -> None:
    with open_product(path):
        pass


CRAFTED: list[Callable[[Path], None]] = [
    _unwritten, _coordinate, _large_chunk, _other_file, _link, _virtual,
    _variable_length,
]  # fmt: skip


@pytest.mark.parametrize("craft", CRAFTED)
def test_a_crafted_product_is_refused_before_it_is_read(
    tmp_path: Path, craft: Callable[[Path], None]
) -> None:
    product = tmp_path / add_day(tmp_path, 0)
    check_sizes(product)
    craft(product)
    assert product.stat().st_size < 2_000_000
    with pytest.raises(ProductError, match=r"bomb: .*do not trust"):
        check_sizes(product)


@pytest.mark.parametrize("craft", CRAFTED)
@pytest.mark.parametrize(
    "command", ["inspect", "inspect --provenance", "reproduce", "plot", "compare"]
)
def test_a_crafted_product_costs_one_line(
    tmp_path: Path, craft: Callable[[Path], None], command: str
) -> None:
    product = tmp_path / add_day(tmp_path, 0)
    craft(product)
    files = [str(product)] * (2 if command == "compare" else 1)
    result = CliRunner().invoke(app, [*command.split(), *files])
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert len(result.output.splitlines()) == 1
    assert "bomb" in result.output
    assert "root:" not in result.output


@pytest.mark.parametrize("craft", CRAFTED)
def test_other_products_are_aggregated_and_shown(
    tmp_path: Path, craft: Callable[[Path], None]
) -> None:
    pytest.importorskip("pyarrow")
    crafted, whole = (add_day(tmp_path, day) for day in range(2))
    craft(tmp_path / crafted)
    made = CliRunner().invoke(app, ["aggregate", str(tmp_path), "--means", "day", "--json"])
    assert made.exit_code == 1
    described = json.loads(made.stdout)
    assert described["products"] == 1
    assert [refused["path"] for refused in described["refused"]] == [crafted]
    shown = CliRunner().invoke(app, ["site", str(tmp_path), "--json"])
    assert shown.exit_code == 1
    described = json.loads(shown.stdout)
    assert described["products"] == 1
    assert [problem["path"] for problem in described["problems"]] == [
        crafted.removeprefix("products/")
    ]
    assert whole


def test_honest_files_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Values that compress as well as deflate can, small unwritten ones, read in parts."""
    zeros = xr.Dataset({"x": ("t", np.zeros(20_000_000))})
    zeros.to_netcdf(tmp_path / "zeros.nc", encoding={"x": {"zlib": True, "complevel": 9}})
    assert (tmp_path / "zeros.nc").stat().st_size < 200_000
    check_sizes(tmp_path / "zeros.nc")
    with netCDF4.Dataset(tmp_path / "unwritten.nc", "w") as file:
        file.createDimension("t", 8_000_000)
        file.createVariable("x", "f8", ("t",), zlib=True)
    check_sizes(tmp_path / "unwritten.nc")
    # On a machine of little memory.
    monkeypatch.setattr(stored, "_MEMORY_SHARE", 1e-6)
    with open_product(tmp_path / "zeros.nc") as product:
        assert not product["x"][100:200:3].any()
        with pytest.raises(ProductError, match=r"x: .*on this machine"):
            product["x"].load()
    with (
        open_stored(tmp_path / "zeros.nc") as product,
        pytest.raises(ProductError, match=r"x: .*on this machine"),
    ):
        product["x"][...]


def test_inspect_reads_large_variables_in_parts(tmp_path: Path) -> None:
    values = np.arange(6_000_000.0).reshape(3, -1)
    values[1, 1] = np.nan
    path = tmp_path / "large.nc"
    xr.Dataset({"x": (("t", "r"), values)}).to_netcdf(path)
    shown = CliRunner().invoke(app, ["inspect", str(path), "--json"])
    (variable,) = json.loads(shown.output)["variables"]
    assert (variable["minimum"], variable["maximum"], variable["missing"]) == (0.0, 5999999.0, 1)


def test_a_site_of_made_products_keeps_its_pages(tmp_path: Path) -> None:
    product = add(tmp_path, "signal")
    shutil.copy(product, product.with_name("copy.nc"))
    assert CliRunner().invoke(app, ["site", str(tmp_path)]).exit_code == 0
