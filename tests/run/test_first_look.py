"""What `init` proposes after a look at data: what gives usable values, and full overlap as seen."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support import factories
from support.archives import raw_archives
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.cli import app
from lidarops.raw import licel
from lidarops.records import is_glued
from lidarops.retrieve.signal.light import light_begins, rise_ends
from lidarops.run.archive import Selection, reprocess
from lidarops.simulate.atmosphere import clock_of_sky, sky_brightness, solar_elevation

RANGES = np.arange(3.75, 12_000.0, 7.5)
"""m."""


def drafted(folder: Path, campaign: Path) -> tuple[Campaign, str]:
    shown = CliRunner().invoke(app, ["init", str(folder), str(campaign)])
    assert shown.exit_code == 0, shown.output
    return load_campaign(campaign), campaign.read_text(encoding="utf-8")


@given(
    full=st.floats(200.0, 2500.0),
    extinction=st.floats(3e-5, 3e-4),
    power=st.floats(1.0, 3.0),
    noise=st.floats(0.0, 0.002),
)
def test_a_signal_stops_rising_where_overlap_gains_less_than_air_takes(
    full: float, extinction: float, power: float, noise: float
) -> None:
    """At full overlap, or before it where the logarithm of r^p falls with the air."""
    overlap = np.minimum(RANGES / full, 1.0) ** power
    signal = overlap * np.exp(-(RANGES / 8000.0) - 2.0 * extinction * RANGES)
    signal += noise * np.random.default_rng(1).standard_normal(RANGES.size)
    signal[RANGES < 50.0] = np.nan
    end = rise_ends(RANGES, signal)
    assert end is not None
    expected = min(full, power / (1.0 / 8000.0 + 2.0 * extinction))
    assert 0.8 * expected - 70.0 <= end <= 1.1 * expected + 100.0


def test_a_signal_that_rises_to_the_end_shows_no_overlap() -> None:
    assert rise_ends(RANGES, RANGES**2) is None
    assert rise_ends(RANGES, np.full(RANGES.size, np.nan)) is None


@given(
    pulse=st.floats(0.0, 3000.0),
    blind=st.floats(0.0, 800.0),
    brightest=st.floats(3.0, 6.0),
    seed=st.integers(0, 100),
)
def test_light_begins_after_the_pulse_and_the_blind_range(
    pulse: float, blind: float, brightest: float, seed: int
) -> None:
    true = RANGES - pulse - blind
    light = np.where(true > 0.0, (300.0 / np.maximum(RANGES - pulse, 300.0)) ** 2, 0.0)
    noise = np.random.default_rng(seed).standard_normal(RANGES.size)
    begin = light_begins(RANGES, RANGES**2 * (10.0**brightest * light + noise))
    assert begin is not None
    assert abs(begin - pulse - blind) <= 15.0
    assert light_begins(RANGES, RANGES**2 * noise) is None


MANAUS = -3.1, -60.0
"""degree; latitude and longitude."""


@given(
    clock=st.integers(-22, 22),
    day=st.integers(0, 360),
    noise=st.floats(0.0, 0.3),
    saturated=st.floats(1e-2, 1.0),
)
def test_the_clock_that_the_light_of_the_sky_fits_is_the_true_one(
    clock: int, day: int, noise: float, saturated: float
) -> None:
    """A file each half hour of a day, by a counter that is blind in bright light."""
    start = datetime(2024, 1, 1, tzinfo=UTC) + timedelta(days=day)
    utc = [start + timedelta(minutes=30 * number + 15) for number in range(48)]
    sun = [solar_elevation(moment, *MANAUS) for moment in utc]
    sky = np.minimum([sky_brightness(elevation) for elevation in sun], saturated) + 1e-4
    sky *= np.random.default_rng(day).lognormal(sigma=noise, size=48)
    by_clock = [moment + timedelta(hours=clock / 2.0) for moment in utc]
    found = clock_of_sky(sky, by_clock, *MANAUS)
    if abs(clock) <= 1:
        assert found is None or found[0] <= clock / 2.0 <= found[1]
    else:
        assert found is not None
        assert found[0] <= clock / 2.0 <= found[1]
        # Or of the day before, too.
        assert not 2.0 < found[1] - found[0] < 22.0


def test_a_lamp_before_dawn_does_not_exclude_the_true_clock() -> None:
    """A file an hour by a clock 4 h late; the last of the night is lit."""
    utc = [datetime(2024, 3, 1, hour, 30, tzinfo=UTC) for hour in range(8, 18)]
    sun = [solar_elevation(moment, *MANAUS) for moment in utc]
    sky = np.array([1e-3 + sky_brightness(elevation) for elevation in sun])
    sky[1] = 1.0
    found = clock_of_sky(sky, [moment - timedelta(hours=4) for moment in utc], *MANAUS)
    assert found is not None
    assert found[0] <= -4.0 <= found[1]


@pytest.mark.parametrize("hours", [range(12, 16), range(1, 5)])
def test_a_sky_that_stays_as_it_is_tells_no_clock(hours: range) -> None:
    utc = [datetime(2024, 3, 1, hour, tzinfo=UTC) for hour in hours]
    sky = np.array([1e-3 + sky_brightness(solar_elevation(moment, *MANAUS)) for moment in utc])
    later = [moment + timedelta(hours=12) for moment in utc]
    assert clock_of_sky(sky, later, *MANAUS) is None


def test_nothing_is_proposed_of_records_that_begin_before_the_pulse(
    data_root: Path, tmp_path: Path
) -> None:
    """The pulse is 1875 m after their start."""
    case = data_root / "cases/pre_trigger"
    if not case.is_dir():
        pytest.skip("no records that begin before the pulse")
    campaign, text = drafted(case, tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert lidar.products.model_dump(exclude_none=True).keys() == {"signal"}
    question = "# pre_trigger: 1967 m  # ? light begins there, in bin 524 of 3.75 m: at which range"
    assert question in text
    # Nobody answers: the plan tells.
    path = tmp_path / "campaign.yaml"
    row = ["all of city-lidar", "no light", "below 1967 m"]
    assert [one[:3] for one in told("plan", path)["empty_in_first_file"]] == [row]
    path.write_text(text.replace("# pre_trigger: 1967 m", "pre_trigger: 0"))
    assert told("plan", path)["empty_in_first_file"] == []


def told(command: str, path: Path) -> Any:
    return json.loads(CliRunner().invoke(app, [command, str(path), "--json"]).output)


def test_light_that_begins_late_is_a_question_beside_proposals(tmp_path: Path) -> None:
    """A telescope that sees far air only, or a record that begins before the pulse."""
    ranges = 7.5 * (np.arange(2000) + 0.5)
    air = np.where(ranges > 600.0, np.exp(-ranges / 4000.0) * np.square(600.0 / ranges), 0.0)
    for number in range(3):
        rng = np.random.default_rng(number)
        data = raw_archives.content(number, bins=2000, zenith_angle=0.0)
        header = licel.parse_header(data)
        counts = {name: rng.poisson(1000.0 + 3e5 * air).astype(np.int32)
                  for name in ("analog_532o", "photon_532o")}  # fmt: skip
        raw_archives.write(tmp_path / f"raw/h26{number}", licel.encode(header, counts))
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert "elastic" in lidar.products.requested
    assert "# pre_trigger: 604 m  # ? light begins there, in bin 80 of 7.5 m" in text


def test_channels_without_light_are_not_proposed_and_named(tmp_path: Path) -> None:
    """Random counts, the same at all ranges."""
    for number in range(3):
        data = raw_archives.content(number, bins=1500, seed=number, zenith_angle=0.0)
        raw_archives.write(tmp_path / f"raw/h26{number}", data)
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (lidar,) = campaign.instruments.values()
    assert set(lidar.products.requested) == {"signal"}
    assert "# glued_532o: no usable value in 3 files" in text


QUESTIONS = {
    "saopaulo": ["BT1; ? range_offset: -64 m, it lags photon counting by 8.5 bins"],
    "public/manaus_20111017_day": ["; the light of the sky fits -5 to -3.5 h"],
}
"""Manaus has the time of UTC-4, by which this day was recorded."""


@pytest.mark.parametrize(
    ("name", "elastic", "least", "raman"),
    [
        ("pilar", {"analog_532p": 510, "analog_53200o": 510, "analog_355p": 510}, 0.6, set()),
        ("saopaulo", {"glued_532o": 1010, "analog_355o": 1010}, 0.6, set()),
        ("manaus_raman", {"glued_355o": 1610}, 0.6, {"photon_355o"}),
        ("public/manaus_20111017_day", {"analog_355o": 1610}, 0.05, {"photon_355o"}),
    ],
)
def test_what_is_proposed_of_real_archives_is_usable(
    name: str,
    elastic: dict[str, float],
    least: float,
    raman: set[str],
    data_root: Path,
    tmp_path: Path,
) -> None:
    """By day but for the third; nobody answered a question.

    Photon counting of Pilar gives no usable value.
    """
    campaign, text = drafted(data_root / name, tmp_path / "campaign.yaml")
    assert all(question in text for question in QUESTIONS.get(name, ()))
    assert ("the light of the sky fits" in text) == (name == "public/manaus_20111017_day")
    (lidar,) = campaign.instruments.values()
    proposed = lidar.products.requested["elastic"].channels
    assert set(proposed) == set(elastic)
    assert ("dead_time: estimate" in text) == any(map(is_glued, proposed))
    found = lidar.products.requested.get("raman")
    assert set(found.channels if found else ()) == raman
    record = reprocess(campaign, selection=Selection(kinds=("elastic",)))
    assert record is not None
    products = [product for scene in record.scenes for product in scene.products]
    assert {product.channel for product in products} == set(proposed)
    for product in products:
        with xr.open_dataset(campaign.products_root / product.path) as opened:
            known = (opened["usable"] <= 1) & opened["aerosol_backscatter"].notnull()
            low = known.where(opened["range"] < 8000.0, drop=True)
            first = opened["range"][known.any("time")].min().item()
        assert low.mean().item() >= least
        assert first <= elastic[product.channel]


def test_what_the_first_file_leaves_empty_is_named_with_its_setting(tmp_path: Path) -> None:
    """Nothing is nearer than 100 km; whether anybody checked that is stated, too."""
    raw_archives.write(tmp_path / "raw/coast/h00", raw_archives.content(0.0, bins=1000))
    facts = {"full_overlap_range": 1e5, "full_overlap_assumed": True}
    products = {"signal": {"channels": ["photon_532o"]}}
    settings = factories.campaign(facts=[facts], products=products)
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.safe_dump(settings.model_dump(mode="json", exclude={"simulation"})))

    words = "bins nearer than full overlap, which is assumed, are flagged and excluded"
    setting = f"overlap: full_overlap_range 100000 m, {words}"
    row = ["signal photon_532o of lidar", "incomplete_overlap", "100 %", setting]
    assert row in told("plan", path)["empty_in_first_file"]
    assert row in told("reprocess", path)["rejections"]
    assert told("plan", path)["empty_in_first_file"] == []
    shown = CliRunner().invoke(app, ["plan", str(path)], env={"COLUMNS": "300"})
    assert f"  {setting}\n" in shown.output


def test_files_without_light_and_packed_ones_are_questions(data_root: Path, tmp_path: Path) -> None:
    case = data_root / "cases/laser_off"
    if not case.is_dir():
        pytest.skip("no case of a laser that was off")
    (tmp_path / "raw/night").mkdir(parents=True)
    for path in (*sorted((case / "raw").glob("h*"))[:30], *sorted((case / "rawoff").glob("h*"))):
        target = tmp_path / "raw" / ("night" if path.parent.name == "rawoff" else "") / path.name
        target.symlink_to(path)
    for name in ("session.ZIP", "notes.txt", "log.txt"):
        (tmp_path / "raw" / name).touch()
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert [lidar.files for lidar in campaign.instruments.values()] == [["h*"]]
    assert "# 30 files, ? without light of the laser by path or counts, left out" in text
    some = '# ? 10 of 30 files show no light of the laser, such as "h2141610.200000": dark files?'
    assert some in text
    assert "# 1 file, ? packed and not read: unpack them, and run init again:" in text
    assert "# 2 files, not read, unknown format (.txt 2):" in text
    (tmp_path / "raw/alone").mkdir()
    (tmp_path / "raw/alone/session.zip").touch()
    shown = CliRunner().invoke(app, ["init", str(tmp_path / "raw/alone"), str(tmp_path / "b.yaml")])
    assert "unpack session.zip" in shown.output


@pytest.mark.slow
def test_a_plan_looks_at_a_whole_cycle_of_a_scan(data_root: Path, tmp_path: Path) -> None:
    """The first files are beams of their own, by which no scan can be judged."""
    if not (data_root / "savant").is_dir():
        pytest.skip("no real scan")
    path = tmp_path / "campaign.yaml"
    CliRunner().invoke(app, ["init", "--headers-only", str(data_root / "savant"), str(path)])
    rows = [row for row in told("plan", path)["empty_in_first_file"] if "multiangle" in row[0]]
    words = "dark: no dark files within 24 h of the scene"
    product = "multiangle analog_355p of u-c-vol-lidar"
    assert rows == [[product, "poor_stratification", "100 %", words]]


def test_a_plan_tells_that_a_laser_was_off(data_root: Path, tmp_path: Path) -> None:
    case = data_root / "cases/laser_off/rawoff"
    if not case.is_dir():
        pytest.skip("no case of a laser that was off")
    path = tmp_path / "campaign.yaml"
    CliRunner().invoke(app, ["init", "--headers-only", str(case), str(path)])
    words = "none: the laser was off; leave these files out, or name them as dark_files"
    rows = told("plan", path)["empty_in_first_file"]
    assert ["signal analog_532o of harbour-lidar", "no_signal", "100 %", words] in rows


AIR = 7.5 * (np.arange(2000) + 0.5)
"""m."""


def write_light(path: Path, minute: float, light: float, overlap: float = 300.0) -> None:
    """Write a raw file with so much light, of which nearer than an overlap (m) some is missing."""
    seen = (
        light * np.exp(-AIR / 4000.0) * np.square(500.0 / AIR) * np.minimum(AIR / overlap, 1) ** 2
    )
    data = raw_archives.content(minute, bins=AIR.size, zenith_angle=0.0)
    header, rng = licel.parse_header(data), np.random.default_rng(100 + round(minute))
    counts = {name: rng.poisson(1000.0 + seen).astype(np.int32)
              for name in ("analog_532o", "photon_532o")}  # fmt: skip
    raw_archives.write(path, licel.encode(header, counts))


def test_few_files_without_light_beside_others_are_a_question(tmp_path: Path) -> None:
    """Their folder tells nothing, and four are too few to tell by themselves."""
    for minute in range(12):
        write_light(tmp_path / f"raw/h26{minute:02d}", minute, 3e4)
    for minute in range(4):
        write_light(tmp_path / f"raw/cover/h27{minute}", minute - 10, 0.0)
        write_light(tmp_path / f"raw/other/h28{minute}", minute + 20, 3e4)
    campaign, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    assert "# 4 files, ? without light of the laser by path or counts, left out of `files`:" in text
    assert '#   "cover/h270"' in text
    (lidar,) = campaign.instruments.values()
    assert set(lidar.files) == {"h*", "other/h*"}


def test_a_plan_looks_at_the_first_files_with_light(tmp_path: Path) -> None:
    for minute in range(16):
        write_light(tmp_path / f"raw/h26{minute:02d}", minute, 3e4 * (minute > 3))
    path = tmp_path / "campaign.yaml"
    CliRunner().invoke(app, ["init", "--headers-only", str(tmp_path / "raw"), str(path)])
    rows = told("plan", path)["empty_in_first_file"]
    words = "none: the laser was off; leave these files out, or name them as dark_files"
    assert ["all of coast-lidar", "no light", "4 of the first 16 files", words] in rows
    assert not [row for row in rows if row[1] == "no_signal"]


@pytest.mark.parametrize(
    ("overlaps", "stated"),
    [((990, 990, 990, 990, 990), "1020  "), ((800, 900, 1000, 1100, 1200), "1200  ")],
)
def test_full_overlap_is_rounded_up_to_what_it_is_known_to(
    tmp_path: Path, overlaps: tuple[float, ...], stated: str
) -> None:
    for minute, overlap in enumerate(overlaps):
        write_light(tmp_path / f"raw/h26{minute}", minute, 1e6, overlap)
    _, text = drafted(tmp_path / "raw", tmp_path / "campaign.yaml")
    (line,) = (one for one in text.splitlines() if " full_overlap_range: " in one)
    assert f"full_overlap_range: {stated}# ? m" in line


def test_all_questions_of_a_draft_are_counted(tmp_path: Path) -> None:
    for minute in range(5):
        write_light(tmp_path / f"raw/h26{minute}", minute, 1e6)
        write_light(tmp_path / f"raw/tc/h27{minute}", minute + 10, 1e6)
    (tmp_path / "raw/sonde.csv").touch()
    path = tmp_path / "campaign.yaml"
    shown = CliRunner().invoke(app, ["init", "--headers-only", str(tmp_path / "raw"), str(path)])
    lines = [line for line in path.read_text().splitlines() if " ? " in line or line.endswith(" ?")]
    assert (
        sum(line.startswith(("# 5 files, ? test of", "# 1 file, ? soundings")) for line in lines)
        == 2
    )
    assert f"{len(lines)} questions to check, marked ?" in shown.output
