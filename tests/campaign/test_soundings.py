"""Soundings and profiles of models: every format is read, and other files are refused."""

from __future__ import annotations

import contextlib
import gzip
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.archives import sounding_texts
from support.archives.sounding_texts import COLUMNS, HEIGHTS, LATITUDE, LONGITUDE, TEXTS
from support.cases import each

from lidarops.campaign.atmosphere import AtmosphereReading
from lidarops.campaign.soundings import TimedProfile, soundings
from lidarops.errors import AncillaryError
from lidarops.retrieve.air.molecular import MolecularProfile, us_standard

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
PLACE = LATITUDE, LONGITUDE
GIVEN = {"latitude": LATITUDE, "longitude": LONGITUDE}


def read(path: Path, **given: object) -> tuple[TimedProfile, ...]:
    return soundings(path.parent, path.name, AtmosphereReading.model_validate(given), PLACE)[0]


def damage(path: Path) -> tuple[list[datetime], str]:
    """Return the times of what is used of a file, and what is damaged."""
    found, words = soundings(path.parent, path.name, AtmosphereReading(), PLACE)
    return [one.time for one in found], words


def check(found: TimedProfile, *, geometric: bool = False) -> None:
    """Compare with the standard atmosphere, of which the stand-ins are, up to 10 km."""
    z = np.array([500.0, 3000.0, 6000.0, 10_000.0])
    expected = MolecularProfile.us_standard().number_density(z)
    np.testing.assert_allclose(found.profile.number_density(z), expected, rtol=3e-3)
    assert (found.profile.altitude[-1] == pytest.approx(HEIGHTS[-1])) == geometric


@each("name", [*TEXTS])
def test_text_formats_are_told_by_their_content(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"20260301_{name}"
    path.write_text(TEXTS[name](NOON, 0.0))
    given = {"name_time": f"%Y%m%d_{name}"}
    if name == "chain.csv":
        given["columns"] = list(COLUMNS)
    (found,) = read(path, **given, **GIVEN)
    assert found.time == (NOON.replace(hour=0) if name == "chain.csv" else NOON)
    check(found, geometric=name == "chain.csv")
    # The point of the grid, not the place that was asked for.
    place = (46.0, 31.0) if name == "place.gdas1" else PLACE
    assert (found.latitude, found.longitude) == pytest.approx(place)
    assert found.origin == ("gdas" if name == "place.gdas1" else "radiosounding")
    humidity = found.profile.water_vapour
    assert (humidity is None) == (name == "chain.csv")
    if humidity is not None:
        assert 0.003 < humidity[0] < 0.012


def test_netcdf_formats_are_told_by_their_variables(tmp_path: Path) -> None:
    sounding_texts.cloudnet(tmp_path / "20260301_coast_ecmwf.nc", NOON, (0.0, 0.0))
    sounding_texts.arm(tmp_path / "arm.cdf", NOON)
    sounding_texts.era5(tmp_path / "era5.nc", NOON)
    first, second = read(tmp_path / "20260301_coast_ecmwf.nc")
    assert (first.time, second.time) == (NOON, NOON.replace(hour=13))
    (arm,), (era5,) = read(tmp_path / "arm.cdf"), read(tmp_path / "era5.nc")
    for found, origin, place in (
        (first, "ecmwf", PLACE),
        (second, "ecmwf", PLACE),
        (arm, "radiosounding", PLACE),
        (era5, "ecmwf", (46.5, 30.75)),
    ):
        check(found, geometric=found is arm)
        assert found.origin == origin
        assert (found.latitude, found.longitude) == pytest.approx(place)
        assert found.profile.water_vapour is not None


def test_heights_of_a_model_count_from_its_ground(tmp_path: Path) -> None:
    """Else density would be off by half a percent over ground of 40 m."""
    sounding_texts.cloudnet(tmp_path / "m.nc", NOON, (0.0,))
    (found,) = read(tmp_path / "m.nc")
    assert found.profile.altitude[0] == pytest.approx(HEIGHTS[0], abs=0.1)


def test_geopotential_height_becomes_altitude(tmp_path: Path) -> None:
    """At the pole gravity is larger, and geopotential heights are above altitudes."""
    path = tmp_path / "s.csv"
    text = sounding_texts.wyoming_csv(NOON)
    heights = []
    for latitude in ("0.0", "89.9"):
        path.write_text(text.replace(f",{LATITUDE},", f",{latitude},"))
        heights.append(read(path)[0].profile.altitude[-1])
    # Height 11300 m: with gravity of 9.7803 and 9.8322 m s-2 at the ground.
    expected = [
        r * 11_300.0 / (r * g / 9.80665 - 11_300.0)
        for r, g in ((6_335_038.0, 9.780325), (6_377_560.0, 9.832185))
    ]
    np.testing.assert_allclose(heights, expected, atol=0.5)


def test_several_soundings_of_one_file_and_packed_files(tmp_path: Path) -> None:
    times = [NOON.replace(hour=0), NOON]
    for name in ("wyoming.txt", "igra.txt"):
        text = "\n".join(TEXTS[name](time, 0.0) for time in times)
        (tmp_path / name).write_text(text)
        assert [found.time for found in read(tmp_path / name)] == times
    (tmp_path / "i.txt.gz").write_bytes(gzip.compress(text.encode()))
    with zipfile.ZipFile(tmp_path / "i.zip", "w") as packed:
        packed.writestr("i.txt", text)
    for name in ("i.txt.gz", "i.zip"):
        assert [found.time for found in read(tmp_path / name)] == times


def test_packed_netcdf_is_read(tmp_path: Path) -> None:
    sounding_texts.arm(tmp_path / "arm.cdf", NOON)
    content = (tmp_path / "arm.cdf").read_bytes()
    (tmp_path / "arm.cdf.gz").write_bytes(gzip.compress(content))
    (found,) = read(tmp_path / "arm.cdf.gz")
    check(found, geometric=True)


def test_a_table_with_several_times_holds_several_soundings(tmp_path: Path) -> None:
    """As one, its levels would be those of both, sorted by pressure."""
    times = [NOON.replace(hour=0), NOON]
    (head, *first), (_, *second) = (
        sounding_texts.wyoming_csv(time, shift).splitlines()
        for time, shift in zip(times, (0.0, 15.0), strict=True)
    )
    expected = sounding_texts.air(15.0)[2]
    for rows in (first + second, [row for pair in zip(first, second, strict=True) for row in pair]):
        path = text(tmp_path / "s.csv", "\n".join([head, *rows]))
        early, late = read(path)
        assert [early.time, late.time] == times
        check(early)
        np.testing.assert_allclose(late.profile.temperature, expected, atol=0.06)
    # Without times, another one begins where pressure is again that of the ground; a single wrong
    # pressure is none.
    rows = [sounding_texts.chain(NOON, shift) for shift in (0.0, 15.0)]
    given = {"columns": list(COLUMNS), "name_time": "s_%Y.csv", **GIVEN}
    with pytest.raises(AncillaryError, match="pressure: begins again: these are several soundings"):
        read(text(tmp_path / "s_2026.csv", "\n".join(rows)), **given)
    one = rows[0].splitlines()
    one[5] = "3600.0,265.0,100.0"
    (found,) = read(text(tmp_path / "s_2026.csv", "\n".join(one)), **given)
    assert found.profile.altitude.size == HEIGHTS.size - 1


@each("name", ["wyoming.txt", "igra.txt"])
def test_a_damaged_sounding_costs_itself(tmp_path: Path, name: str) -> None:
    times = [NOON.replace(hour=hour) for hour in (0, 6, 12)]
    first, second, third = (TEXTS[name](time, 0.0) for time in times)
    path, left = tmp_path / name, [times[0], times[2]]
    for damaged in {
        "wyoming.txt": [
            second.replace("PRES", "PR#S"),
            second.replace("Mar", "Mer"),
            second.replace("Observations at 06Z", "Observations at 0?Z"),
        ],
        "igra.txt": [second.replace("2026", "20X6"), second.replace(" 06 0600", " 99 9999")],
    }[name]:
        text(path, "\n".join([first, damaged, third]))
        used, words = damage(path)
        assert used == left
        begin = "UPM00033837 20" if name == "igra.txt" else "Observations at 0"
        assert words.startswith("sounding 2: ")
        assert f"it begins with '{begin}" in words
        assert words.endswith("the rest of the file is used")
        assert "substring" not in words
        text(path, damaged)
        with pytest.raises(AncillaryError, match=r"sounding 1: .*compare it with its origin"):
            read(path)
    # In Celsius by the file, but in K.
    warm = TEXTS[name](times[1], 273.15)
    used, words = damage(text(path, "\n".join([first, warm, warm, third])))
    assert used == left
    assert words.startswith("sounding of 2026-03-01T06:00Z: temperature: ")
    assert ", and 1 more;" in words
    assert damage(text(path, "\n".join([first, third]))) == (left, "")


def test_levels_under_a_damaged_header_are_not_those_of_the_sounding_before(tmp_path: Path) -> None:
    first, second, third = (
        TEXTS["igra.txt"](NOON.replace(hour=hour), 10.0 * number)
        for number, hour in enumerate((0, 6, 12))
    )
    path = text(tmp_path / "i.txt", "\n".join([first, second.replace("#", " "), third]))
    used, words = damage(path)
    assert used == [NOON]
    assert words.startswith("sounding 1: has 35 levels, but states 17")


def test_rows_with_other_numbers_of_cells_are_told(tmp_path: Path) -> None:
    head, *rows = sounding_texts.wyoming_csv(NOON).splitlines()
    rows[3] += ",1"
    path = text(tmp_path / "s.csv", "\n".join([head, *rows]))
    assert damage(path)[0] == [NOON]
    assert damage(path)[1].startswith("row 5: has 9 values for 8 columns (give one value for each")
    text(path, "\n".join([head, *(f"{row},1" for row in rows)]))
    with pytest.raises(AncillaryError, match="row 2: has 9 values for 8 columns"):
        read(path)


@each(
    "title, cell",
    [
        ("relative_humidity [%]", "50"),
        ("relative_humidity_%", "50"),
        ("dew_point [degC]", "-1.0"),
        ("dew_point_C", "-1.0"),
        ("specific_humidity [g/kg]", "5.0"),
        ("mixing_ratio (g/kg)", "5.0"),
        ("dew_point [degC],rh [%]", "-9999,50"),
    ],
)
def test_units_stand_in_titles_of_two_words(tmp_path: Path, title: str, cell: str) -> None:
    """Else the air would be dry without a word."""
    rows = [
        f"{p:.0f},{t:.2f},{z:.0f},{cell}" for z, p, t in zip(*sounding_texts.air(), strict=True)
    ]
    head = f"pressure [Pa],temperature [K],geopotential_height [m],{title}"
    path = text(tmp_path / "s_2026.csv", "\n".join([head, *rows]))
    (found,) = read(path, name_time="s_%Y.csv", **GIVEN)
    check(found)
    assert found.profile.water_vapour is not None
    assert 0.004 < found.profile.water_vapour[0] < 0.01


def test_rules_of_igra(tmp_path: Path) -> None:
    """Hours of releases, temperatures below -88.8 degC, and the surface without height."""
    path, whole = tmp_path / "i.txt", TEXTS["igra.txt"](NOON, 0.0)
    for hour, release, day, clock in (
        ("12", "1134", 1, (11, 34)),
        ("00", "2315", 0, (23, 15)),
        ("99", "2315", 1, (23, 15)),
        ("23", "0008", 2, (0, 8)),
        ("12", "1199", 1, (12, 0)),
        ("12", "9999", 1, (12, 0)),
    ):
        text(path, whole.replace(" 12 1200", f" {hour} {release}"))
        expected = datetime(2026, 3, 1, *clock, tzinfo=UTC) + timedelta(days=day - 1)
        assert read(path)[0].time == expected
    # Of the levels with a height, the last one is at -88.9 degC.
    head, *rows = whole.splitlines()
    rows[-1] = f"{rows[-1][:22]} -889{rows[-1][27:]}"
    (found,) = read(text(path, "\n".join([head, *rows])))
    assert found.profile.temperature[-1] == pytest.approx(184.25)
    rows[0] = f"{rows[0][:16]}-9999{rows[0][21:]}"
    (found,) = read(text(path, "\n".join([head, *rows])))
    assert found.profile.altitude[0] == pytest.approx(HEIGHTS[0], abs=2.0)


def test_rounded_pressures_bias_no_density(tmp_path: Path) -> None:
    """Levels of 3 m, in whole hPa: of 38 levels at 20 km the lowest has too low a height."""
    z = np.arange(100.0, 25_000.0, 3.0)
    pressure, temperature = us_standard(z)
    rows = [f"{a},{t},{p:.0f}" for a, t, p in zip(z, temperature, pressure / 100.0, strict=True)]
    given = {"columns": ["altitude [m]", "temperature [K]", "pressure [hPa]"], **GIVEN}
    path = text(tmp_path / "s_2026.csv", "\n".join(rows))
    (found,) = read(path, name_time="s_%Y.csv", **given)
    at = np.arange(1000.0, 20_001.0, 500.0)
    expected = MolecularProfile.us_standard().number_density(at)
    np.testing.assert_allclose(found.profile.number_density(at), expected, rtol=2e-3)


@each(
    "unit",
    [
        "hours since 2026-03-01 14:00:00 +02:00",
        "hours since 2026-03-01T08:30:00.0-0330",
        "minutes since 2026-03-01 12:00:00 0:00",
        "days since 2026-03-01T12:00Z",
        "seconds since 2026-03-01 07:00 -5",
    ],
)
def test_times_of_netcdf_have_a_zone(tmp_path: Path, unit: str) -> None:
    sounding_texts.arm(tmp_path / "a.nc", NOON)
    since(tmp_path / "a.nc", unit)
    assert read(tmp_path / "a.nc")[0].time == NOON


def test_a_sounding_that_bursts_early_is_left_out(tmp_path: Path) -> None:
    """Of a file with others; the air above 3 km would be that of the standard atmosphere."""
    whole = TEXTS["igra.txt"](NOON, 0.0)
    short = "\n".join(TEXTS["igra.txt"](NOON.replace(hour=18), 0.0).splitlines()[:6])
    path = tmp_path / "i.txt"
    path.write_text(f"{whole}\n{short}")
    assert [found.time for found in read(path)] == [NOON]
    path.write_text(short)
    with pytest.raises(AncillaryError, match=r"complete levels over \d+ m \(give at least 5"):
        read(path)


def text(path: Path, words: str) -> Path:
    path.write_text(words)
    return path


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "of other content": (
        lambda path: path.write_text("a,b\n1,2\n"),
        r"pressure: is missing; columns are a, b",
    ),
    "in GRIB": (lambda path: path.write_bytes(b"GRIB\0\0\1\2"), "is GRIB, .*convert it to NetCDF"),
    "in BUFR": (lambda path: path.write_bytes(b"IUKX\r\nBUFR\0\0"), "is BUFR, .*convert it"),
    "of another unit": (
        lambda path: path.write_text("pressure [psi],temperature,altitude\n14,280,0\n"),
        r"pressure: has the unknown unit 'psi' \(use pa, hpa",
    ),
    "without time": (
        lambda path: path.write_text(sounding_texts.wyoming_csv(NOON).replace("time,", "day,")),
        "time: is not stated .*name_time",
    ),
    "without place": (
        lambda path: path.write_text(sounding_texts.spc(NOON)),
        "place: is not stated .*latitude and longitude",
    ),
    "in Celsius": (
        lambda path: path.write_text(
            sounding_texts.wyoming_csv(NOON).replace("ature_C", "ature_K")
        ),
        "temperature: reaches from .* Celsius: add 273.15",
    ),
    "with dew points in Celsius": (
        lambda path: path.write_text(
            sounding_texts.wyoming_csv(NOON).replace("dew point temperature_C", "dew_point")
        ),
        "dew_point: is 4.* K at most .*looks like Celsius: name the unit",
    ),
    "with decimal commas": (
        lambda path: path.write_text(
            sounding_texts.wyoming_csv(NOON).replace(",", ";").replace(".", ",")
        ),
        r"longitude: has a decimal comma: 30,7 \(write 30\.7\)",
    ),
    "with a zone that is not known": (
        lambda path: (sounding_texts.arm(path, NOON), since(path, "hours since 2026-03-01 CET")),
        "time: has the unit 'hours since 2026-03-01 CET'",
    ),
    "of several files": (
        lambda path: pack(path, ("a.csv", "b.csv")),
        r"holds 2 files: a\.csv, b\.csv \(pack each file alone",
    ),
    "empty": (lambda path: path.write_text(""), "pressure: is missing"),
    "with a broken packing": (
        lambda path: path.write_bytes(gzip.compress(b"x" * 100)[:20]),
        "cannot be unpacked",
    ),
    "of a model without ground": (
        lambda path: (
            sounding_texts.cloudnet(path, NOON, (0.0,)),
            drop(path, "sfc_geopotential"),
        ),
        "sfc_geopotential: is missing",
    ),
}


def pack(path: Path, names: tuple[str, ...]) -> None:
    with zipfile.ZipFile(path, "w") as packed:
        for name in names:
            packed.writestr(name, sounding_texts.wyoming_csv(NOON))


def since(path: Path, unit: str) -> None:
    import xarray as xr

    with xr.open_dataset(path, decode_times=False) as opened:
        changed = opened.load()
    changed["time"].attrs["units"] = unit
    changed.to_netcdf(path)


def drop(path: Path, name: str) -> None:
    import xarray as xr

    with xr.open_dataset(path, decode_times=False) as opened:
        left = opened.load().drop_vars(name)
    left.to_netcdf(path)


@each("what", [*REFUSED])
def test_other_files_are_refused_with_field_and_remedy(tmp_path: Path, what: str) -> None:
    make, words = REFUSED[what]
    make(tmp_path / "s.nc")
    with pytest.raises(AncillaryError, match=rf"^s\.nc: {words}"):
        read(tmp_path / "s.nc")


def _attempt(path: Path, **given: object) -> None:
    """Read a damaged file, which is refused, or of which something is left."""
    with contextlib.suppress(AncillaryError):
        assert read(path, **given)


@each("name", [*TEXTS, "m_ecmwf.nc"])
def test_damaged_files_are_refused_or_give_what_is_left(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "m_ecmwf.nc":
        sounding_texts.cloudnet(path, NOON, (0.0, 0.0))
    else:
        path.write_text(TEXTS[name](NOON, 0.0))
    given = {"columns": list(COLUMNS)} if name == "chain.csv" else {}
    content = path.read_bytes()
    rng = np.random.default_rng(1)
    for end in np.linspace(0, len(content) - 1, 40).astype(int):
        path.write_bytes(content[:end])
        _attempt(path, **given, **GIVEN)
        changed = bytearray(content)
        for place in rng.integers(0, len(content), 5):
            changed[place] = rng.integers(32, 127)
        path.write_bytes(changed)
        _attempt(path, **given, **GIVEN)


# Real files

CHAIN = {"columns": list(COLUMNS), "latitude": 40.6, "longitude": 15.72}
REAL: dict[str, dict[str, object]] = {
    "14061619.OAX": {"latitude": 41.32, "longitude": -96.37},
    "20201022_bucharest_ecmwf.nc": {},
    "20201022_bucharest_gdas1.nc": {},
    "AUM00011035-data.txt.gz": {},
    "ECMWF_height_Temp_Press_HR_asl_20240916.csv": {
        **CHAIN,
        "name_time": "ECMWF_height_Temp_Press_HR_asl_%Y%m%d.csv",
    },
    "ERA-5_2018_03_27_T13_00_00.nc": {},
    "UWyoming_202109_87576.snd": {},
    "melpitz_20190701_00_51.5_12.9.gdas1": {},
    "melpitz_20190723_09_51.5_12.9.gdas1": {},
    "melpitz_20190724_06_51.5_12.9.gdas1": {},
    "munich_20211120_ecmwf.nc": {},
    "oun_uwyo.html": {},
    "rad_pot_20120710.csv": {**CHAIN, "name_time": "rad_pot_%Y%m%d.csv"},
    "rad_pot_20120710_Range_Temp_Press_HYSPLIT.csv": {
        **CHAIN,
        "name_time": "rad_pot_%Y%m%d_Range_Temp_Press_HYSPLIT.csv",
    },
    "sgpsondewnpnC1.b1.20190101.053200.cdf": {},
    "twpsondewnpnC3.b1.20060119.112000.custom.cdf": {},
}
"""Files that are read, with what they do not state."""
NOT_READ: dict[str, tuple[str, str]] = {
    "ERA5_N30_N40_E120_E140_20101017_14.grb": ("", "is GRIB"),
    "bufr309052_20250224_1101_0.bfr": ("", "is BUFR"),
    "igra2_sounding": ("pressure", "is missing"),
    "molecular_20120615200000.nc": ("pressure", "is missing"),
    # 273.15 K were subtracted twice.
    "rad_AltaFloresta_20110902.dat": ("temperature", "not air in K"),
    "regular_gg_ml.grib": ("", "is GRIB"),
    "sonde_data.txt": ("time", "is not stated"),
    "time_pressure_20120615200000.nc": ("altitude", "is missing"),
    # Only the lowest level has a temperature.
    "twpsondewnpnC3.b1.20060119.050300.custom.cdf": ("altitude", "1 complete levels"),
    "twpsondewnpnC3.b1.20060119.163300.custom.cdf": ("altitude", "1 complete levels"),
    "wyoming_missing_station_info": ("pressure", "is missing"),
    "wyoming_sounding": ("pressure", "is missing"),
}


@pytest.fixture(scope="module")
def real(data_root: Path) -> Path:
    folder = data_root / "public/atmosphere"
    if not folder.is_dir():
        pytest.skip("no soundings here")
    return folder


def test_every_real_file_is_read_or_refused(real: Path) -> None:
    assert {path.name for path in real.iterdir()} == REAL.keys() | NOT_READ.keys()
    for name, given in REAL.items():
        for found in read(real / name, **given):
            z = np.linspace(max(found.profile.altitude[0], 0.0), 15_000.0, 50)
            standard = MolecularProfile.us_standard().number_density(z)
            ratio = found.profile.number_density(z) / standard
            assert 0.75 < ratio.min() < ratio.max() < 1.25, name
    titles = ["pressure [hPa]", "altitude [m]", "temperature [K]"]
    given = {"columns": titles, "name_time": "rad_AltaFloresta_%Y%m%d.dat", **GIVEN}
    for name, (field, problem) in NOT_READ.items():
        with pytest.raises(AncillaryError) as refused:
            read(real / name, **(given if name.endswith(".dat") else {}))
        assert refused.value.file == name
        assert (refused.value.field or "") == field
        assert problem in refused.value.problem
        assert refused.value.remedy


def test_answers_of_servers_are_read(real: Path, tmp_path: Path) -> None:
    """The body of the answers that two of the files hold."""
    for name, given, levels in (
        ("wyoming_sounding", {}, 40),
        ("wyoming_missing_station_info", {"latitude": -2.43, "longitude": -54.72}, 50),
    ):
        answers = yaml.safe_load((real / name).read_text())["interactions"]
        path = text(tmp_path / "s.csv", answers[-1]["response"]["body"]["string"])
        (found,) = read(path, **given)
        assert found.profile.altitude.size > 0.5 * levels
    answers = yaml.safe_load((real / "igra2_sounding").read_text())["interactions"]
    (tmp_path / "i.zip").write_bytes(answers[0]["response"]["body"]["string"])
    assert len(read(tmp_path / "i.zip")) >= 1


Z = np.arange(1000.0, 20_001.0, 500.0)


def _logs(real: Path, name: str) -> np.ndarray:
    return np.log([one.profile.number_density(Z) for one in read(real / name, **REAL[name])])


def test_two_models_agree_within_the_stated_error(real: Path) -> None:
    """Each states 0.3 %; GDAS1 has levels of 50 hPa, between which the tropopause lies."""
    ecmwf = _logs(real, "20201022_bucharest_ecmwf.nc")[::3]
    gdas = _logs(real, "20201022_bucharest_gdas1.nc")
    difference = gdas - ecmwf
    assert np.sqrt((difference**2).mean()) < 1.1 * np.sqrt(2.0) * 0.003
    assert np.sqrt((difference[:, Z <= 12_000.0] ** 2).mean()) < 0.002


def test_a_sounding_agrees_with_a_model_that_is_interpolated(real: Path) -> None:
    """Potenza: within 1 % below 10 km.

    Above, the second file has pressures that are linear between levels far apart: up to 7 % off.
    """
    (sonde,), (model,) = (_logs(real, name) for name in REAL if name.startswith("rad_pot"))
    low = Z <= 10_000.0
    assert np.sqrt(((sonde - model)[low] ** 2).mean()) < 0.01
    assert 0.05 < np.abs(sonde - model)[~low].max() < 0.08
