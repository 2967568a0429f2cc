"""Sounding and overlap files: units, and refusal of other files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support import factories

from lidarops.campaign.ancillary_files import (
    Ancillaries,
    lidar_ratio_profile,
    molecular_profile,
    overlap_profile,
)
from lidarops.errors import AncillaryError
from lidarops.records import Role
from lidarops.retrieve.air.molecular import us_standard
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.run.scenes import cut_scenes
from lidarops.scene.dependence import ancillary_files
from lidarops.scene.plan import plan_scene

ALTITUDE = np.linspace(0.0, 20_000.0, 41)
PRESSURE, TEMPERATURE = us_standard(ALTITUDE)
OVERLAP = "range [m],overlap\n200,0.25\n400,0.75\n600,1\n"


def _sounding(folder: Path, head: str, *columns: np.ndarray, name: str = "air.csv") -> str:
    rows = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    (folder / name).write_text("\n".join([head, *rows, ""]))
    return name


@pytest.mark.parametrize(
    ("head", "scales"),
    [
        ("altitude,pressure,temperature", (1.0, 1.0, 0.0)),
        ("altitude [m],pressure [Pa],temperature [K]", (1.0, 1.0, 0.0)),
        ("Altitude [km], Pressure [hPa] ,temperature [degC]", (1e-3, 1e-2, -273.15)),
        ("\ufeffaltitude,pressure[mbar],temperature", (1.0, 1e-2, 0.0)),
        # Without a unit, the size of the pressure determines it.
        ("# made by hand\n\naltitude,pressure,temperature", (1.0, 1e-2, 0.0)),
    ],
)
def test_units_in_brackets_are_turned_into_si(
    tmp_path: Path, head: str, scales: tuple[float, float, float]
) -> None:
    length, force, zero = scales
    name = _sounding(tmp_path, head, ALTITUDE * length, PRESSURE * force, TEMPERATURE + zero)
    profile, digest = molecular_profile(tmp_path, name)
    np.testing.assert_allclose(profile.altitude, ALTITUDE, rtol=1e-8)
    np.testing.assert_allclose(profile.pressure, PRESSURE, rtol=1e-8)
    np.testing.assert_allclose(profile.temperature, TEMPERATURE, rtol=1e-8)
    assert digest == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()


def test_unused_columns_may_hold_anything(tmp_path: Path) -> None:
    (tmp_path / "o.csv").write_text("note,overlap,range [km]\nnear,0.25,0.2\n,1,0.4\n")
    profile, _ = overlap_profile(tmp_path, "o.csv")
    np.testing.assert_allclose(profile.range, [200.0, 400.0])
    np.testing.assert_array_equal(profile.overlap, [0.25, 1.0])


def test_netcdf_is_the_same_as_csv(tmp_path: Path) -> None:
    (tmp_path / "o.csv").write_text(OVERLAP)
    xr.Dataset(
        {"overlap": ("range", [0.25, 0.75, 1.0], {"units": "1"})},
        coords={"range": ("range", [0.2, 0.4, 0.6], {"units": "km"})},
    ).to_netcdf(tmp_path / "o.nc")
    text, _ = overlap_profile(tmp_path, "o.csv")
    binary, digest = overlap_profile(tmp_path, "o.nc")
    np.testing.assert_allclose(binary.range, text.range)
    np.testing.assert_array_equal(binary.overlap, text.overlap)
    assert digest == hashlib.sha256((tmp_path / "o.nc").read_bytes()).hexdigest()
    xr.Dataset(
        {
            "pressure": ("level", np.rint(PRESSURE).astype(np.int32), {"units": "Pa"}),
            "temperature": ("level", TEMPERATURE - 273.15, {"units": "degC"}),
            "altitude": ("level", ALTITUDE.astype(np.float32)),
        }
    ).to_netcdf(tmp_path / "air.nc")
    air, _ = molecular_profile(tmp_path, "air.nc")
    np.testing.assert_allclose(air.pressure, PRESSURE, atol=0.5)
    np.testing.assert_allclose(air.temperature, TEMPERATURE, rtol=1e-12)


def test_overlap_between_its_ranges(tmp_path: Path) -> None:
    (tmp_path / "o.csv").write_text(OVERLAP)
    profile, _ = overlap_profile(tmp_path, "o.csv")
    at = profile.at(np.array([-10.0, 199.9, 200.0, 300.0, 600.0, 601.0, 9000.0]))
    np.testing.assert_array_equal(at, [np.nan, np.nan, 0.25, 0.5, 1.0, 1.0, 1.0])


def _measured(folder: Path, overlap: np.ndarray) -> None:
    """Write the variables of a product with measured overlap of cells of 60 m."""
    error = np.where(overlap < 1.0, 0.01, 0.0)
    names = ("lidar_ratio_error_random", "lidar_ratio_error_systematic", "usable")
    values = {"overlap": overlap, "overlap_standard_error": error}
    xr.Dataset(
        {name: (("time", "range"), row[np.newaxis]) for name, row in values.items()}
        | {name: (("time", "range"), np.ones((1, overlap.size))) for name in names},
        coords={"range": ("range", 60.0 * (np.arange(overlap.size) + 0.5))},
    ).to_netcdf(folder / "night.nc")


def _sine(r: np.ndarray) -> np.ndarray:
    return np.where(r < 600.0, np.sin(np.pi * r / 1200.0) ** 2, 1.0)


def test_measured_overlap_has_the_slope_of_the_true_one(tmp_path: Path) -> None:
    """Lines between the means of cells are off by 7e-4 m-1, more than the extinction of haze."""
    cells = 60.0 * (np.arange(15)[:, np.newaxis] + (np.arange(600) + 0.5) / 600.0)
    _measured(tmp_path, _sine(cells).mean(axis=1))
    profile, _ = overlap_profile(tmp_path, "night.nc")
    r = np.arange(37.5, 700.0, 15.0)
    np.testing.assert_allclose(profile.at(r), _sine(r), atol=3e-4)
    r = r[r > 180.0]
    slopes = [np.diff(np.log(overlap)) / 15.0 for overlap in (profile.at(r), _sine(r))]
    np.testing.assert_allclose(*slopes, atol=5e-5)


def test_measured_overlap_is_positive_and_not_above_one(tmp_path: Path) -> None:
    overlap = np.where(np.arange(15) < 4, [0.001, 0.1, 0.02, 0.98] + 11 * [0.0], 1.0)
    overlap[5] = np.nan
    _measured(tmp_path, overlap)
    profile, _ = overlap_profile(tmp_path, "night.nc")
    assert np.all((profile.overlap > 0.0) & (profile.overlap <= 1.0))
    assert profile.at(np.array([240.0, 241.0, 900.0])).tolist() == [1.0, 1.0, 1.0]
    assert profile.range[0] > 30.0
    _measured(tmp_path, np.where(np.arange(15) < 1, 0.5, 1.0))
    profile, _ = overlap_profile(tmp_path, "night.nc")
    assert profile.at(np.array([29.0, 60.0])).tolist() == [pytest.approx(np.nan, nan_ok=True), 1.0]


RATIOS = "altitude [km],lidar_ratio [sr],lidar_ratio_standard_error\n1,40,4\n3,60,12\n"


def test_lidar_ratios_are_linear_between_their_altitudes(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text(RATIOS)
    profile, digest = lidar_ratio_profile(tmp_path, "s.csv")
    ratio, error = profile.at(np.array([0.0, 1000.0, 2000.0, 3000.0, 9000.0]), (50.0, 10.0))
    np.testing.assert_array_equal(ratio, [40.0, 40.0, 50.0, 60.0, 60.0])
    np.testing.assert_array_equal(error, [4.0, 4.0, 8.0, 12.0, 12.0])
    assert digest == hashlib.sha256((tmp_path / "s.csv").read_bytes()).hexdigest()


def _product(
    folder: Path,
    ratio: object,
    random: object,
    usable: object,
    quality: object = 0,
    backscatter: object = 1.0,
    **errors: object,
) -> None:
    """Write the variables of a product with lidar ratios over times and heights, 1 km apart.

    Errors are by their cause, of extinction in sr and of backscatter relative to 1.
    """
    plane, values = ("time", "range"), np.asarray(ratio, float)
    heights = values.shape[1]
    stated = {f"aerosol_extinction_error_{cause}": 0.0 for cause in EXTINCTION_CAUSES}
    stated |= {f"aerosol_backscatter_error_{cause}": 0.0 for cause in BACKSCATTER_CAUSES}
    stated |= {"aerosol_extinction_error_noise": random, "aerosol_extinction_error_molecular": 2.0}
    stated |= {f"aerosol_backscatter_error_{cause}": error for cause, error in errors.items()}
    stated |= {"aerosol_extinction": values, "aerosol_backscatter": backscatter}
    stated |= {"lidar_ratio_error_random": 0.0, "lidar_ratio_error_systematic": 0.0}
    stated |= {"molecular_backscatter": 0.0}
    altitude = 1000.0 * np.arange(1, heights + 1)
    xr.Dataset(
        {name: (plane, np.broadcast_to(array, values.shape)) for name, array in stated.items()}
        | {
            "vertical_resolution": (plane, np.full(values.shape, 1000.0)),
            "usable": (plane, np.broadcast_to(np.asarray(usable, np.int8), values.shape)),
            "quality_flag": (plane, np.broadcast_to(np.asarray(quality, np.int32), values.shape)),
            "reference_scattering_ratio": 1.0,
            "reference_scattering_ratio_standard_error": 0.02,
        },
        coords={"altitude": ("range", altitude), "range": altitude},
    ).to_netcdf(folder / "night.nc")


def test_measured_lidar_ratios_are_averaged_by_the_noise_of_profiles(tmp_path: Path) -> None:
    ratio = np.array([[50.0, 40.0], [60.0, 40.0], [np.nan, 40.0]])
    random = np.array([[3.0, 3.0], [6.0, 3.0], [3.0, 3.0]])
    noise = 0.01 * np.array([[1.0], [np.sqrt(2.0)], [1.0]])
    _product(tmp_path, ratio, random, [[0, 2], [1, 2], [0, 2]], noise=noise)
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    assert profile.altitude.tolist() == [1000.0]
    mean = (2 * 50.0 + 60.0) / 3
    assert profile.ratio[0] == pytest.approx(mean)
    by_noise = np.hypot(2 * 3.0, 6.0) / 3
    of_backscatter = mean * np.hypot(0.02, np.sqrt(2**2 + 2) / 3 * 0.01)
    error = np.sqrt(by_noise**2 + 2.0**2 + of_backscatter**2)
    assert profile.standard_error[0] == pytest.approx(error)
    _product(tmp_path, ratio, random, 2)
    with pytest.raises(AncillaryError, match="usable"):
        lidar_ratio_profile(tmp_path, "night.nc")


def test_backscatter_is_averaged_over_the_air_of_extinction(tmp_path: Path) -> None:
    """Not over nearer air, where both channels have the same overlap and extinction is missing."""
    _product(tmp_path, [[np.nan, 50.0, 50.0]], 1.0, 0, backscatter=[[10.0, 1.0, 1.0]])
    product = xr.load_dataset(tmp_path / "night.nc")
    length = product["vertical_resolution"].where(product["aerosol_extinction"] > 0.0)
    product["vertical_resolution"] = 2.0 * length
    product.to_netcdf(tmp_path / "night.nc")
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    np.testing.assert_allclose(profile.ratio, 50.0)


def test_profiles_of_uncertain_background_hardly_count(tmp_path: Path) -> None:
    background, ratio = np.full((47, 1), 0.05), np.full((47, 2), 60.0)
    background[4], ratio[4] = 3.0, 500.0
    _product(tmp_path, ratio, 0.0, 0, background=background)
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    np.testing.assert_allclose(profile.ratio, 60.0, rtol=0.01)
    assert np.all(profile.standard_error < 3.0)


def test_products_without_errors_by_the_baseline_are_used(tmp_path: Path) -> None:
    _product(tmp_path, [[60.0, 60.0]], 5.0, 0)
    whole, _ = lidar_ratio_profile(tmp_path, "night.nc")
    with xr.open_dataset(tmp_path / "night.nc") as product:
        names = [f"aerosol_{of}_error_baseline" for of in ("extinction", "backscatter")]
        product.drop_vars(names).to_netcdf(tmp_path / "former.nc")
    former, _ = lidar_ratio_profile(tmp_path, "former.nc")
    assert former.ratio.tolist() == whole.ratio.tolist()
    assert former.standard_error.tolist() == whole.standard_error.tolist()


def test_measured_lidar_ratios_of_clouds_are_left_out(tmp_path: Path) -> None:
    ratio = [[70.0, 18.0, 70.0], [20.0, 18.0, 70.0], [70.0, 18.0, 70.0]]
    cloud, partly = RamanQuality.CLOUD, RamanQuality.PARTLY_CLOUDY
    _product(tmp_path, ratio, 5.0, 1, [[0, cloud, 0], [partly, cloud, 0], [0, cloud, 0]])
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    assert profile.altitude.tolist() == [1000.0, 3000.0]
    assert profile.ratio.tolist() == [70.0, 70.0]
    _product(tmp_path, ratio, 5.0, 1, cloud)
    with pytest.raises(AncillaryError, match="outside of clouds"):
        lidar_ratio_profile(tmp_path, "night.nc")


def test_means_of_lidar_ratios_below_their_error_are_left_out(tmp_path: Path) -> None:
    _product(tmp_path, [[48.5, 60.0]], [[54.7, 20.0]], 0)
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    assert profile.ratio.tolist() == [60.0]


def test_products_without_resolution_are_refused_by_name(tmp_path: Path) -> None:
    _product(tmp_path, [[60.0]], 5.0, 0)
    with xr.open_dataset(tmp_path / "night.nc") as product:
        product.drop_vars("vertical_resolution").to_netcdf(tmp_path / "cut.nc")
    with pytest.raises(AncillaryError, match="without vertical_resolution") as caught:
        lidar_ratio_profile(tmp_path, "cut.nc")
    assert caught.value.file == "cut.nc"
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("times", "of_backscatter", "of_extinction"), [(20, 0.25, 0.12), (20, 0.05, 0.3), (4, 0.1, 0.1)]
)
def test_means_of_measured_lidar_ratios_have_no_bias(
    tmp_path: Path, times: int, of_backscatter: float, of_extinction: float
) -> None:
    rng, shape = np.random.default_rng(1), (times, 3000)
    backscatter = 1.0 + of_backscatter * rng.standard_normal(shape)
    extinction = 60.0 * (1.0 + of_extinction * rng.standard_normal(shape))
    errors = {"backscatter": backscatter, "noise": of_backscatter}
    _product(tmp_path, extinction, 60.0 * of_extinction, 0, **errors)
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    assert profile.ratio.mean() == pytest.approx(60.0, abs=0.5)
    by_noise = np.sqrt(profile.standard_error**2 - 2.0**2 - (0.02 * profile.ratio) ** 2)
    away = np.abs(profile.ratio - 60.0) / by_noise
    assert 0.92 < np.mean(away < 1.96) < 0.985


def test_only_the_stated_error_of_the_reference_remains_for_many_profiles(tmp_path: Path) -> None:
    _product(tmp_path, np.full((100, 2), 60.0), 0.0, 0, reference=np.hypot(0.3, 0.02))
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    by_reference = np.hypot(0.02, np.hypot(0.3, 0.02) / 10.0)
    np.testing.assert_allclose(profile.standard_error, np.hypot(60.0 * by_reference, 2.0))


@pytest.mark.parametrize("few", [1, 2])
def test_values_of_few_profiles_and_those_beyond_the_last_height_are_not_held(
    tmp_path: Path, few: int
) -> None:
    ratio = np.full((47, 4), 60.0)
    ratio[few:, 3] = np.nan
    ratio[:few, 3] = 26.0
    _product(tmp_path, ratio, 5.0, 0)
    profile, _ = lidar_ratio_profile(tmp_path, "night.nc")
    assert profile.altitude.tolist() == [1000.0, 2000.0, 3000.0]
    found, error = profile.at(np.array([3000.0, 3100.0, 9000.0]), (50.0, 10.0))
    assert found.tolist() == pytest.approx([60.0, 50.0, 50.0])
    assert error.tolist()[1:] == [10.0, 10.0]


@pytest.mark.parametrize(
    ("rows", "field", "words"),
    [
        ("1000,50,5\n1000,50,5\n", "altitude", "does not rise"),
        ("1,50,5\n3,50,5\n", "altitude", "in km"),
        ("1000,0.02,5\n", "lidar_ratio", "from 1 to 200 sr"),
        ("1000,500,5\n", "lidar_ratio", "from 1 to 200 sr"),
        ("1000,50,-5\n", "lidar_ratio_standard_error", "from 0 to 200 sr"),
        ("1000,x,5\n", "lidar_ratio", "finite numbers"),
    ],
)
def test_impossible_lidar_ratios_are_refused_by_name(
    tmp_path: Path, rows: str, field: str, words: str
) -> None:
    (tmp_path / "s.csv").write_text(f"altitude,lidar_ratio,lidar_ratio_standard_error\n{rows}")
    with pytest.raises(AncillaryError) as caught:
        lidar_ratio_profile(tmp_path, "s.csv")
    assert (caught.value.file, caught.value.field) == ("s.csv", field)
    assert words in str(caught.value)


def _text(content: str | bytes, name: str = "o.csv") -> Callable[[Path], str]:
    def write(folder: Path) -> str:
        data = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(data)
        return name

    return write


def _folder(folder: Path) -> str:
    (folder / "o.csv").mkdir()
    return "o.csv"


def _escape(folder: Path) -> str:
    (folder.parent / "secret.csv").write_text(OVERLAP)
    return "../secret.csv"


def _link(folder: Path) -> str:
    outside = folder.parent / "outside.csv"
    outside.write_text(OVERLAP)
    (folder / "o.csv").symlink_to(outside)
    return "o.csv"


def _loop(folder: Path) -> str:
    (folder / "o.csv").symlink_to(folder / "o.csv")
    return "o.csv"


def _unequal(folder: Path) -> str:
    xr.Dataset({"range": ("a", [1.0, 2.0, 3.0]), "overlap": ("b", [0.5, 1.0])}).to_netcdf(
        folder / "o.nc"
    )
    return "o.nc"


def _two_dimensions(folder: Path) -> str:
    xr.Dataset({"range": ("a", [1.0, 2.0]), "overlap": (("t", "a"), np.ones((3, 2)))}).to_netcdf(
        folder / "o.nc"
    )
    return "o.nc"


def _pipe(folder: Path) -> str:
    os.mkfifo(folder / "o.csv")
    return "o.csv"


def _bomb(chunk: int, values: int) -> Callable[[Path], str]:
    """Return the function that writes a file of some kB whose variable is huge in memory."""

    def write(folder: Path) -> str:
        with netCDF4.Dataset(folder / "o.nc", "w") as file:
            file.createDimension("range", None)
            file.createVariable("range", "f8", "range", chunksizes=[2])[values - 1] = 1.0
            file.createVariable("overlap", "f8", "range", chunksizes=[chunk])
        assert (folder / "o.nc").stat().st_size < 10_000
        return "o.nc"

    return write


_GARBAGE = np.random.default_rng(0).bytes(5000)
REFUSED = [
    pytest.param(lambda _: "none.csv", "none.csv: cannot be read", id="absent"),
    pytest.param(_folder, "cannot be read", id="folder"),
    pytest.param(_escape, "lies outside", id="dots"),
    pytest.param(_link, "lies outside", id="link"),
    pytest.param(_loop, "o.csv", id="loop"),
    pytest.param(_pipe, "is no regular file", id="pipe"),
    pytest.param(_bomb(2, 8_000_000), "range: is larger than any", id="variables together"),
    pytest.param(_bomb(2, 10**10), "range: is larger than any", id="bomb"),
    pytest.param(_bomb(10**8, 2), "overlap: is larger than any", id="bomb of a chunk"),
    pytest.param(lambda _: "a\0b", "cannot be read", id="nul"),
    pytest.param(_text(_GARBAGE), "not text", id="garbage"),
    pytest.param(_text(_GARBAGE, "o.nc"), "cannot be read as NetCDF", id="garbage.nc"),
    pytest.param(_text(b"\x89HDF\r\n\x1a\n" + bytes(500), "o.nc"), "read as NetCDF", id="cut.nc"),
    pytest.param(
        _text(b"CDF\x01" + b"\xff" * 500, "o.nc"), "cannot be read as NetCDF", id="classic.nc"
    ),
    pytest.param(_text(OVERLAP, "o.nc"), "cannot be read as NetCDF", id="text.nc"),
    pytest.param(_text("x" * 200_000 + "\n1\n"), "o.csv", id="long"),
    pytest.param(_text(""), "no rows", id="empty"),
    pytest.param(_text("range,overlap\n# 100,1\n"), "no rows", id="comments"),
    pytest.param(_text("range,overlap\n100,0.5,1\n"), "3 values for 2 columns", id="ragged"),
    pytest.param(_text("range;overlap\n100;0.5\n"), "no column 'range'", id="semicolons"),
    pytest.param(_text("height,overlap\n1,0.5\n2,1\n"), "columns are height, overlap", id="name"),
    pytest.param(_text("range [feet],overlap\n1,0.5\n2,1\n"), "the unknown unit 'feet'", id="feet"),
    pytest.param(_text("range,overlap [%]\n1,50\n2,100\n"), "the unknown unit '%'", id="percent"),
    pytest.param(_text("range,overlap\n1,0.5\n2,x\n"), "overlap: is not a column", id="word"),
    pytest.param(_text("range,overlap\n1,0.5\n2,inf\n"), "overlap: is not a column", id="inf"),
    pytest.param(_text("range,overlap\n1,0.5\n1,1\n"), "range: does not rise", id="twice"),
    pytest.param(_text("range,overlap\n1,0.5\n"), "range: does not rise", id="single"),
    pytest.param(_text("range,overlap\n1,0\n2,1\n"), "from 0 to 1", id="zero"),
    pytest.param(_text("range,overlap\n1,0.5\n2,1.01\n"), "from 0.5 to 1.01", id="above 1"),
    pytest.param(_text("range,overlap,overlap\n1,0.1,0.5\n2,1,1\n"), "overlap", id="double"),
    pytest.param(_text("range [m],overlap,range [km]\n1,0.1,5\n2,1,6\n"), "range", id="both"),
    pytest.param(_unequal, "overlap", id="unequal"),
    pytest.param(_two_dimensions, "overlap: is not a column", id="matrix"),
]


@pytest.mark.parametrize(("make", "words"), REFUSED)
def test_invalid_overlap_functions_are_refused_by_name(
    tmp_path: Path, make: Callable[[Path], str], words: str
) -> None:
    folder = tmp_path / "campaign"
    folder.mkdir()
    name = make(folder)
    with pytest.raises(AncillaryError) as caught:
        overlap_profile(folder, name)
    assert words in str(caught.value)
    assert caught.value.file == name


@pytest.mark.parametrize(
    ("head", "scales", "field", "words"),
    [
        ("altitude [ft],pressure,temperature", (1, 1, 0), "altitude", "'ft'"),
        ("altitude,pressure [bar],temperature", (1, 1e-5, 0), "pressure", "'bar'"),
        ("altitude,pressure,temperature [F]", (1, 1, 0), "temperature", "'F'"),
        # Units that the numbers contradict.
        ("altitude,pressure,temperature", (1, 1, -273.15), "temperature", "Celsius"),
        ("altitude,pressure,temperature", (1e-3, 1, 0), "altitude", "km"),
        ("altitude,pressure,temperature", (3.2808, 1, 0), "altitude", "feet"),
        ("altitude,pressure [Pa],temperature", (1, 1e-2, 0), "pressure_unit", "hPa, not Pa"),
        ("altitude,pressure [hPa],temperature", (1, 1, 0), "pressure", "neither Pa nor hPa"),
    ],
)
def test_wrong_units_of_a_sounding_are_refused_by_name(
    tmp_path: Path, head: str, scales: tuple[float, float, float], field: str, words: str
) -> None:
    length, force, zero = scales
    name = _sounding(tmp_path, head, ALTITUDE * length, PRESSURE * force, TEMPERATURE + zero)
    with pytest.raises(AncillaryError, match=words) as caught:
        molecular_profile(tmp_path, name)
    assert (caught.value.file, caught.value.field) == (name, field)


def test_a_file_too_large_for_a_profile_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "o.csv").open("wb") as file:
        os.truncate(file.fileno(), 200_000_000)
    with pytest.raises(AncillaryError, match="larger than any profile"):
        overlap_profile(tmp_path, "o.csv")


def test_files_of_a_plan_are_read_once_and_recorded(tmp_path: Path) -> None:
    _sounding(tmp_path, "altitude,pressure,temperature", ALTITUDE, PRESSURE, TEMPERATURE)
    (tmp_path / "o.csv").write_text(OVERLAP)
    (tmp_path / "s.csv").write_text(RATIOS)
    campaign = factories.campaign(
        facts=[
            {
                "molecular_profile": "air.csv",
                "overlap_profile": "o.csv",
                "zenith_angle": 0,
                "channels": {"photon_532o": {"lidar_ratio_profile": "s.csv"}},
            }
        ],
        products={"elastic": {"channels": ["analog_532o", "photon_532o"]}},
    )
    scene = cut_scenes(campaign, (factories.granule(0),)).scenes[0]
    files = Ancillaries.read(tmp_path, ancillary_files(plan_scene(scene, campaign).steps))
    assert list(files.profiles) == ["air.csv"]
    assert list(files.overlaps) == ["o.csv"]
    assert [(file.path, file.role) for file in files.inputs] == [
        ("air.csv", Role.MOLECULAR),
        ("o.csv", Role.OVERLAP),
        ("s.csv", Role.LIDAR_RATIO),
    ]
    assert list(files.lidar_ratios) == ["s.csv"]
    for file in files.inputs:
        assert file.sha256 == hashlib.sha256((tmp_path / file.path).read_bytes()).hexdigest()
    bare = factories.campaign()
    none = ancillary_files(plan_scene(scene, bare).steps)
    assert Ancillaries.read(tmp_path, none) == Ancillaries({}, {}, {}, ())
