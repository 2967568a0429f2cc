"""What `lidarops inspect` shows of raw files and products."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.archives import raw_archives
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.errors import LidarOpsError
from lidarops.netcdf.write import write_product
from lidarops.reports.inspection import describe, tables


@pytest.mark.parametrize("kind", list(MAKERS))
def test_products_show_verdicts_bits_and_extremes(kind: str, tmp_path: Path):
    data = MAKERS[kind]()
    path = tmp_path / "product.nc"
    write_product(build_product(data, context(kind)), path)
    shown = CliRunner().invoke(app, ["inspect", str(path), "--json"])
    assert shown.exit_code == 0
    description = json.loads(shown.output)
    assert description == describe(path)
    assert description["attributes"]["lidarops_kind"] == kind
    variables = {row["name"]: row for row in description["variables"]}
    with xr.open_dataset(path) as opened:
        assert set(variables) == set(opened.variables)
        for name in opened.data_vars:
            if opened[name].dtype.kind == "f" and opened[name].size and name in data:
                assert variables[name]["missing"] == int(opened[name].isnull().sum())
                largest = None if opened[name].isnull().all() else float(opened[name].max())
                assert variables[name]["maximum"] == pytest.approx(largest)
    counts = {row["name"]: row for row in description["quality"]}
    size = data["quality_flag"].size
    assert sum(counts[name]["values"] for name in ("good", "use_with_care", "do_not_use")) == size
    good = int((data["quality_flag"] == 0).sum())
    assert counts["good"]["values"] == good
    table = CliRunner().invoke(app, ["inspect", str(path)], env={"COLUMNS": "200"})
    assert all(word in table.output for word in ("Variables", "Quality", "do_not_use", "units"))
    first = [table.output.index(word) for word in ("do_not_use", "Variables", "Conventions")]
    assert first == sorted(first)


def test_a_time_selects_the_profile_that_holds_it(tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS["elastic"](), context("elastic")), path)
    with xr.open_dataset(path) as opened:
        begin, end = opened["time_bnds"].values[1].astype("datetime64[s]")
        second = opened.isel(time=1).load()
    within = describe(path, f"{begin + (end - begin) // 2}Z")
    values = {row["name"]: row for row in within["variables"]}
    assert values["time"]["minimum"] == values["time"]["maximum"] == str(second.time.values)[:19]
    largest = float(second["aerosol_backscatter"].max())
    assert values["aerosol_backscatter"]["maximum"] == pytest.approx(largest)
    assert sum(row["values"] for row in within["quality"][:3]) == second.sizes["range"]
    west = begin + (end - begin) // 2 - np.timedelta64(3, "h")
    assert describe(path, f"{west}-03:00") == within
    for wrong in ("1999-01-01", "noon", "17:40"):
        shown = CliRunner().invoke(app, ["inspect", str(path), "--time", wrong])
        assert shown.exit_code == 2
        assert wrong in shown.output
    folder = CliRunner().invoke(app, ["inspect", str(tmp_path), "--time", str(begin)])
    assert folder.exit_code == 2


def test_variables_with_errors_come_before_coordinates_and_bounds(tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS["signal"](), context("signal")), path)
    names = [row["name"] for row in describe(path)["variables"]]
    assert names[:2] == ["signal", "signal_standard_error"]
    main = {name.removesuffix("_standard_error") for name in names if name.endswith("_error")}
    rest = [name for name in names if name not in main and not name.endswith("_error")]
    assert names[-len(rest) :] == rest
    assert {"time", "time_bnds", "range"} <= set(rest)


def test_a_product_tells_its_settings_and_how_to_cite_it(tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(build_product(MAKERS["homogeneous"](), context("homogeneous")), path)
    description = describe(path)
    steps = {row["step"]: row["settings"] for row in description["steps"]}
    assert steps["background"] == "range: [10000.0, 12000.0]"
    with xr.open_dataset(path) as opened:
        assert opened.attrs["title"] in description["citation"]
    shown = CliRunner().invoke(app, ["inspect", str(path)], env={"COLUMNS": "200"}).output
    assert "Steps" in shown
    assert "citation" in shown


def test_a_folder_shows_a_line_for_each_group_of_like_files(tmp_path: Path):
    for number in range(3):
        raw_archives.write(tmp_path / f"day/h{number}", raw_archives.content(5.0 * number))
    raw_archives.write(tmp_path / "dark/h9", raw_archives.content(20.0, zenith_angle=0.0))
    raw_archives.write(tmp_path / "day/h4", raw_archives.content(25.0)[:-100])
    raw_archives.write(tmp_path / "notes.txt", b"words " * 40)
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path), "--json"])
    description = json.loads(shown.output)
    lines = {
        row["files"]: (row["count"], row["role"], row["zenith_angle"])
        for row in description["groups"]
    }
    assert lines == {"day/h*": (3, "signal", "90"), "dark/h*": (1, "dark", "0")}
    assert description["groups"][0]["channels"] == "analog_532o, photon_532o"
    assert [row["file"] for row in description["refused"]] == ["day/h4"]
    assert description["other"] == ["notes.txt"]
    table = CliRunner().invoke(app, ["inspect", str(tmp_path)], env={"COLUMNS": "200"})
    assert "day/h*" in table.output


def test_raw_files_show_all_their_channels(tmp_path: Path):
    path = raw_archives.write(tmp_path / "h0", raw_archives.content(0, bins=4000))
    shown = CliRunner().invoke(app, ["inspect", str(path), "--json"])
    description = json.loads(shown.output)
    assert description["type"] == "raw"
    assert description["start"].startswith("2026-03-01")
    assert {"analog_532o", "photon_532o"} <= {row["name"] for row in description["channels"]}
    assert {"analog", "photon"} <= {row["kind"] for row in description["datasets"]}
    widths = {row["name"]: (row["bins"], row["bin_width"]) for row in description["channels"]}
    assert set(widths.values()) == {(4000, 7.5)}, widths
    green = {row["wavelength"] for row in description["channels"] if "532" in row["name"]}
    assert list(green) == [pytest.approx(532e-9)]
    _, (_, columns, rows), _ = tables(path)
    for name, cells in zip(columns, zip(*rows, strict=True), strict=True):
        assert any(cells), name
    table = CliRunner().invoke(app, ["inspect", str(path)], env={"COLUMNS": "200"})
    assert all(word in table.output for word in ("Channels", "photon_532o", "zenith angle"))
    assert all(unit in table.output for unit in ("wavelength (m)", "bin width (m)", " degree "))
    header = description["source"].splitlines()
    assert header[1].strip() in table.output
    assert "b'" not in table.output


def test_foreign_netcdf_is_shown_too(tmp_path: Path):
    path = tmp_path / "other.nc"
    xr.Dataset({"x": ("n", [1.0, float("nan")])}).to_netcdf(path)
    description = describe(path)
    assert description["quality"] == []
    assert description["variables"][0]["missing"] == 1
    assert CliRunner().invoke(app, ["inspect", str(path)]).exit_code == 0


def test_of_an_unknown_kind_the_file_tells_what_its_bits_mean(tmp_path: Path):
    whole = (("time", "range"), np.array([[0, 1 << 20], [1 << 21, 3 << 20]], np.int32))
    masks = {"flag_masks": np.int32([1 << 20, 1 << 21]), "flag_meanings": "breezy stormy"}
    masks["flag_assessments"] = "Indeterminate Bad"
    product = xr.Dataset({"quality_flag": (*whole, masks)}, attrs={"lidarops_kind": "wind"})
    product["usable"] = ("time", "range"), np.array([[0, 1], [2, 2]], np.int8)
    product.to_netcdf(tmp_path / "wind.nc")
    counts = {row["name"]: row for row in describe(tmp_path / "wind.nc")["quality"]}
    verdicts = ("good", "use_with_care", "do_not_use")
    assert [counts[name]["values"] for name in verdicts] == [1, 1, 2]
    assert [counts[name]["severity"] for name in ("breezy", "stormy")] == ["care", "reject"]


def test_other_files_are_refused(tmp_path: Path):
    path = tmp_path / "text.txt"
    path.write_text("nothing")
    with pytest.raises(LidarOpsError, match=r"text\.txt") as caught:
        describe(path)
    # No campaign is concerned.
    assert "pattern" not in str(caught.value)
    assert "inspect reads NetCDF products and raw files" in str(caught.value)
