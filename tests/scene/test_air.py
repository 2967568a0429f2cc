"""The air of a scene: which source, which profiles, and the error that follows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support import factories
from support.archives import sounding_texts
from support.archives.sounding_texts import LATITUDE, LONGITUDE
from support.cases import each

from lidarops.campaign.atmosphere import AtmosphereReading
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.campaign.soundings import soundings
from lidarops.errors import CampaignError
from lidarops.records import Scene
from lidarops.retrieve.air.molecular import MolecularProfile, altitude_of
from lidarops.run.scenes import cut_scenes
from lidarops.scene.air import GROWTH, SLOPE, SOURCE_ERROR, STANDARD_ERROR, AirFiles, ChosenAir
from lidarops.scene.plan import plan_scene

MIDDLE = datetime(2026, 3, 1, 10, tzinfo=UTC)


def campaign(folder: Path, *sources: dict[str, Any], **facts: Any) -> Campaign:
    tree = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    key = next(iter(tree["stations"]))
    tree["stations"][key] |= {"latitude": LATITUDE, "longitude": LONGITUDE}
    tree["atmosphere"] = {key: list(sources)}
    for instrument in tree["instruments"].values():
        instrument["facts"][0] |= facts
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree))
    return load_campaign(path)


def scene_of(given: Campaign, *, hours: float = 0.0) -> Scene:
    """Return a scene whose measurements have their middle at `MIDDLE`."""
    begin = MIDDLE - timedelta(hours=hours / 2.0)
    granule = factories.granule(start=begin)
    granule = replace(granule, start=begin, stop=begin + timedelta(hours=hours))
    (scene,) = cut_scenes(given, [granule]).scenes
    return scene


def chosen(given: Campaign, *, hours: float = 0.0) -> ChosenAir | None:
    found = AirFiles(given).of_scene(scene_of(given, hours=hours))
    return found and found[0]


def error_of(given: Campaign, hours: float) -> float:
    found = AirFiles(given).of_scene(scene_of(given, hours=hours))
    assert found is not None
    return found[1]


def sonde(folder: Path, hour: float, *, shift: float = 0.0, east: float = 0.0) -> str:
    """Write a sounding so many hours after the middle of the scene, and return its name."""
    text = sounding_texts.wyoming_csv(MIDDLE + timedelta(hours=hour), shift)
    name = f"s{hour:+05.1f}_{east:g}.csv"
    (folder / name).write_text(text.replace(f",{LONGITUDE},", f",{LONGITUDE + east},"))
    return name


SONDES = {"files": "s*.csv"}


def test_air_is_linear_in_time_between_two_soundings(tmp_path: Path) -> None:
    names = [sonde(tmp_path, -3.0), sonde(tmp_path, 9.0, shift=8.0), sonde(tmp_path, -11.0)]
    given = campaign(tmp_path, SONDES)
    air = chosen(given)
    assert air is not None
    assert [(one.file, one.share) for one in air.profiles] == [(names[0], 0.75), (names[1], 0.25)]
    assert (air.age, air.origin) == (3 * 3600.0, "radiosounding")
    z = np.linspace(200.0, 10_000.0, 50)
    pressure, temperature = air.profile(tmp_path).at(z)
    # Of the levels themselves, by a calculation of its own.
    height, low, cold = sounding_texts.air()
    height = altitude_of(height, LATITUDE)
    _, high, warm = sounding_texts.air(8.0)
    logs = 0.75 * np.log(low) + 0.25 * np.log(high)
    np.testing.assert_allclose(pressure, np.exp(np.interp(z, height, logs)), rtol=1.5e-3)
    mean = np.interp(z, height, 0.75 * cold + 0.25 * warm)
    np.testing.assert_allclose(temperature, mean, atol=0.12)


@each(
    ("hours", "length", "variance"),
    [
        ([0.0], 0.0, 0.0),
        ([-4.0], 0.0, 4.0),
        ([6.0], 4.0, 7.0),
        # A bridge between two profiles: 3 * 9 / 12.
        ([-3.0, 9.0], 0.0, 2.25),
        ([-3.0, 9.0], 8.0, 4.25),
    ],
)
def test_the_error_grows_with_the_distance_in_time(
    tmp_path: Path, hours: list[float], length: float, variance: float
) -> None:
    for former in tmp_path.glob("s*.csv"):
        former.unlink()
    for hour in hours:
        sonde(tmp_path, hour)
    expected = np.sqrt(SOURCE_ERROR**2 + GROWTH**2 * variance)
    error = error_of(campaign(tmp_path, SONDES), length)
    assert error == pytest.approx(expected, rel=5e-3)
    expected = np.sqrt(0.01**2 + GROWTH**2 * variance)
    error = error_of(campaign(tmp_path, {**SONDES, "relative_error": 0.01}), length)
    assert error == pytest.approx(expected, rel=5e-3)
    # A stated error holds beyond that of the standard atmosphere.
    assert error_of(campaign(tmp_path, {**SONDES, "relative_error": 0.1}), length) == 0.1


def test_above_the_top_of_the_profile_the_error_is_that_of_the_standard_atmosphere(
    tmp_path: Path,
) -> None:
    sonde(tmp_path, -1.0)
    given = campaign(tmp_path, SONDES)
    air = chosen(given)
    assert air is not None
    assert air.top == round(float(altitude_of(sounding_texts.HEIGHTS[-1], LATITUDE)))
    height = air.top - next(iter(given.stations.values())).altitude
    errors = [AirFiles(given).of_scene(scene_of(given), at) for at in (height, height + 1.0)]
    assert [found and found[1] for found in errors] == [error_of(given, 0.0), STANDARD_ERROR]


def test_products_state_the_error_that_counts(tmp_path: Path) -> None:
    sonde(tmp_path, 0.0)
    campaign(tmp_path, SONDES, zenith_angle=0)
    tree = yaml.safe_load((tmp_path / "campaign.yaml").read_text())
    for highest, expected in ((9000, SOURCE_ERROR), (20_000, STANDARD_ERROR)):
        for instrument in tree["instruments"].values():
            reference = {"lowest": 1000, "highest": highest}
            instrument["products"] = {
                "elastic": {"channels": ["analog_532o"], "reference": reference}
            }
        (tmp_path / "campaign.yaml").write_text(yaml.safe_dump(tree))
        given = load_campaign(tmp_path / "campaign.yaml")
        steps = plan_scene(scene_of(given), given).steps
        (step,) = (step for step in steps if step.name == "elastic")
        assert step.settings["molecular_relative_error"] == expected
        assert "that of atmosphere" in step.reason


def test_plans_hold_whole_seconds(tmp_path: Path) -> None:
    sonde(tmp_path, -13.0 / 3.0)
    air = chosen(campaign(tmp_path, SONDES))
    assert air is not None
    assert air.age == 15_600.0


def test_the_first_source_that_holds_counts(tmp_path: Path) -> None:
    sonde(tmp_path, -5.0)
    sounding_texts.cloudnet(tmp_path / "m_ecmwf.nc", MIDDLE - timedelta(hours=1), (0.0, 1.0, 2.0))
    model = {"files": "m*.nc"}
    first = chosen(campaign(tmp_path, SONDES, model))
    assert first is not None
    assert first.origin == "radiosounding"
    near = {**SONDES, "greatest_age": "4h"}
    second = chosen(campaign(tmp_path, near, model))
    assert second is not None
    # One at the very time needs no neighbour.
    assert [(one.file, one.number, one.share) for one in second.profiles] == [("m_ecmwf.nc", 1, 1)]
    assert second.origin == "ecmwf"
    assert chosen(campaign(tmp_path, near, {**model, "files": "none*"})) is None


def test_the_nearest_place_counts_within_the_greatest_distance(tmp_path: Path) -> None:
    # One degree of longitude is 76.7 km here.
    far, near = sonde(tmp_path, -1.0, east=2.0), sonde(tmp_path, -6.0, east=1.0)
    air = chosen(campaign(tmp_path, SONDES))
    assert air is not None
    assert [one.file for one in air.profiles] == [near]
    assert air.distance == pytest.approx(76_700.0, rel=2e-3)
    assert "radiosounding, s-06.0_1.csv of 2026-03-01T04:00Z" in air.words(0.01)
    (tmp_path / near).unlink()
    assert chosen(campaign(tmp_path, {**SONDES, "greatest_distance": 150_000})) is None
    air = chosen(campaign(tmp_path, {**SONDES, "greatest_distance": 160_000}))
    assert air is not None
    assert [one.file for one in air.profiles] == [far]


def test_folders_are_walked_as_those_of_an_archive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither behind links, nor deeper than a pattern reaches."""
    folder = tmp_path / "sondes"
    (folder / "deep/deeper").mkdir(parents=True)
    name = sonde(folder, -1.0)
    for link in "ab":
        (folder / link).symlink_to(".")
    walked: list[str] = []
    walk = os.walk

    def counted(*given: Any, **more: Any) -> Iterator[Any]:
        for step in walk(*given, **more):
            walked.append(os.path.relpath(step[0], tmp_path))
            assert len(walked) < 20
            yield step

    monkeypatch.setattr(os, "walk", counted)
    whole = ["sondes", "sondes/deep", "sondes/deep/deeper"]
    found = f"sondes/{name}"
    for pattern, file, folders in (
        ("sondes/*.csv", found, whole[:1]),
        ("sondes/**/*.csv", found, whole),
        ("sondes/*/*.csv", None, whole[:2]),
    ):
        walked.clear()
        air = chosen(campaign(tmp_path, {"files": pattern}))
        assert (air and air.profiles[0].file) == file
        assert walked == folders


def test_a_file_is_read_once_for_all_channels_and_scenes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = sonde(tmp_path, -1.0)
    air = chosen(campaign(tmp_path, SONDES))
    assert air is not None
    read: list[str] = []

    def reading(folder: Path, file: str, *given: Any) -> Any:
        read.append(file)
        return soundings(folder, file, *given)

    monkeypatch.setattr("lidarops.campaign.soundings.soundings", reading)
    before = [air.profile(tmp_path).at(5000.0)[1] for _ in range(3)]
    assert read == [name]
    # Unless it changes.
    sonde(tmp_path, -1.0, shift=8.0)
    os.utime(tmp_path / name, (0, 0))
    assert air.profile(tmp_path).at(5000.0)[1] > before[0] + 5.0


def test_the_profile_of_the_facts_counts_before_sources(tmp_path: Path) -> None:
    sonde(tmp_path, 0.0)
    products = {"elastic": {"channels": ["analog_532o"]}}
    for facts, key in (({}, "atmosphere"), ({"molecular_profile": "air.csv"}, "molecular_profile")):
        given = campaign(tmp_path, SONDES, **facts)
        tree = yaml.safe_load((tmp_path / "campaign.yaml").read_text())
        for instrument in tree["instruments"].values():
            instrument["products"] = products
            instrument["facts"][0]["zenith_angle"] = 0
        (tmp_path / "campaign.yaml").write_text(yaml.safe_dump(tree))
        given = load_campaign(tmp_path / "campaign.yaml")
        steps = plan_scene(scene_of(given), given).steps
        (step,) = (step for step in steps if step.name == "molecular")
        assert step.settings.keys() & {"atmosphere", "molecular_profile"} == {key}


def test_a_station_that_is_none_is_refused(tmp_path: Path) -> None:
    tree = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    tree["atmosphere"] = {"nowhere": [SONDES]}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(tree))
    with pytest.raises(CampaignError, match="unknown station 'nowhere'"):
        load_campaign(tmp_path / "c.yaml")


def test_stated_errors_are_those_of_real_soundings(data_root: Path) -> None:
    """Soundings over Vienna, every 12 hours for five months: a random walk that saturates."""
    folder = data_root / "public/atmosphere"
    name = "AUM00011035-data.txt.gz"
    if not (folder / name).is_file():
        pytest.skip("no soundings here")
    z = np.arange(1000.0, 20_001.0, 500.0)
    found = [
        one
        for one in soundings(folder, name, AtmosphereReading(), (48.2, 16.4))[0]
        if one.profile.altitude[0] < z[0] and one.profile.altitude[-1] > z[-1]
    ]
    assert len(found) > 300
    hours = np.array([one.time.timestamp() for one in found]) / 3600.0
    logs = np.log([one.profile.number_density(z) for one in found])

    def errors(difference: np.ndarray) -> tuple[float, float]:
        slopes = (difference[:, 4:] - difference[:, :-4]) / 2000.0
        return tuple(float(np.sqrt((part**2).mean())) for part in (difference, slopes))

    def at(lag: float) -> dict[int, int]:
        away = np.abs(hours[None] - hours[:, None] - lag)
        return {n: int(row.argmin()) for n, row in enumerate(away) if row.min() < 1.5}

    for lag in (12.0, 24.0, 48.0):
        pairs = at(lag)
        density, slope = errors(logs[[*pairs.values()]] - logs[[*pairs]])
        stated = np.sqrt(2.0 * SOURCE_ERROR**2 + GROWTH**2 * lag)
        assert 0.9 < stated / density < 1.15
        assert 0.75 < SLOPE * stated / slope < 1.8
    for lag in (12.0, 24.0):
        before, after = at(-lag), at(lag)
        both = sorted(before.keys() & after.keys())
        middle = 0.5 * (logs[[before[n] for n in both]] + logs[[after[n] for n in both]])
        density, slope = errors(logs[both] - middle)
        stated = np.sqrt(1.5 * SOURCE_ERROR**2 + GROWTH**2 * lag / 2.0)
        assert 0.9 < stated / density < 1.2
        assert 0.75 < SLOPE * stated / slope < 1.8
    standard = np.log(MolecularProfile.us_standard().number_density(z))
    density, slope = errors(logs - standard)
    assert 0.9 < STANDARD_ERROR / density < 1.1
    assert slope < SLOPE * STANDARD_ERROR
