"""Campaign files: accepted settings and messages on errors."""

from __future__ import annotations

import pickle
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError
from support.cases import each
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.cli import app
from lidarops.errors import CampaignError, CatalogError
from lidarops.products.elastic import ElasticSettings
from lidarops.products.homogeneous import HomogeneousSettings
from lidarops.products.multiangle import MultiAngleSettings
from lidarops.products.visibility import VisibilityProductSettings

MINIMAL = """\
name: small
title: A small campaign
archive: raw
output: out
stations:
  coast: {name: Coast, latitude: 46.4, longitude: 30.7}
instruments:
  lidar:
    station: coast
    files: "h*"
"""


def _write(folder: Path, text: str) -> Path:
    path = folder / "campaign.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("settings", "accepted"),
    [
        ({"method": "linearized", "extinction": 1e-4}, True),
        ({"method": "known_extinction", "extinction": 1e-4}, True),
        ({"method": "known_extinction"}, False),
        ({"extinction": 1e-4}, False),
    ],
)
def test_an_extinction_is_given_where_the_method_needs_it(
    settings: dict[str, object], accepted: bool
) -> None:
    whole = {"channels": ["photon_532o"], "sections": [[750, 4500]], **settings}
    if accepted:
        assert HomogeneousSettings.model_validate(whole).extinction == 1e-4
    else:
        with pytest.raises(ValidationError, match="linearized and known_extinction"):
            HomogeneousSettings.model_validate(whole)


def test_a_regularisation_needs_a_method_with_a_penalty() -> None:
    whole = {"channels": ["photon_532o"], "regularisation": 0.1}
    assert MultiAngleSettings.model_validate(whole | {"method": "mld"}).regularisation == 0.1
    with pytest.raises(ValidationError, match="mld and mld_prior only"):
        MultiAngleSettings.model_validate(whole)


def test_paths_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LIDAROPS_ARCHIVE", raising=False)
    path = _write(tmp_path, MINIMAL)
    assert load_campaign(path).archive == str(tmp_path / "raw")
    assert load_campaign(path, output="/elsewhere").products_root == Path("/elsewhere/products")
    monkeypatch.setenv("LIDAROPS_ARCHIVE", "/archive")
    assert load_campaign(path).archive == "/archive"
    assert load_campaign(path, archive="/given").archive == "/given"
    assert load_campaign(path, archive="memory://raw").archive == "memory://raw"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("latitude: 46.4", "latitude: 146.4", r"line 6: stations\.coast\.latitude"),
        ("station: coast", "station: cost", "known stations: coast"),
        ('files: "h*"', 'files: "../h*"', "must be a relative path"),
        ('files: "h*"', 'files: "/h*"', "must be a relative path"),
        ("archive: raw", "archve: raw", "line 3: archve: .* keys here are archive, acknowledged, "),
        (
            "station: coast",
            "products: {elastik: {}}",
            r"elastik: .* keys here are elastic, (averaged, )?homogeneous",
        ),
        ("lidar:", "my_lidar:", r"line 8: instruments\.my_lidar: .*letters, digits and hyphens"),
        ("station: coast", "station: x y", r"line 9: .*letters, digits and hyphens.*not 'x y'"),
        ("output: out", "output: out\ntitle: B", "title: given twice, in lines 2 and 5"),
        ('"h*"', '"h*"\n    files: x', r"instruments\.lidar\.files: given twice, in lines 10 and"),
        ("output: out", "output: s3://bucket/out", "output: is a URL"),
        ("title: A small campaign", "title: [", "not valid YAML"),
        ("title: A small campaign", "title: 2024-02-30", "that YAML cannot read"),
        ("name: small", "name: !!python/object/apply:os.getcwd []", "not valid YAML"),
    ],
)
def test_an_error_is_named(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = _write(tmp_path, MINIMAL.replace(old, new))
    with pytest.raises(CampaignError, match=expected) as caught:
        load_campaign(path)
    assert str(path) in str(caught.value)


SIMULATED = """
simulation:
  start: 2026-01-01
  duration: 60
  instruments:
    lidar:
      aquisition: {}
"""


def test_an_unknown_key_is_reported_with_the_keys_there(tmp_path: Path) -> None:
    path = _write(tmp_path, MINIMAL + SIMULATED)
    with pytest.raises(CampaignError) as caught:
        load_campaign(path)
    (message,) = [line for line in str(caught.value).splitlines() if "aquisition" in line]
    assert message.strip().startswith("line 17: ")
    assert "keys here are acquisition, " in message
    assert "scan" in message
    assert "seed" not in message


def test_equal_keys_in_different_mappings_are_valid(tmp_path: Path) -> None:
    anchored = """
networks: {}
metadata: {license: x, comment: y}
"""
    path = _write(tmp_path, MINIMAL + anchored)
    assert load_campaign(path).metadata.comment == "y"
    merged = MINIMAL.replace('"h*"', '"h*"\n    <<: *a\n    <<: *b').replace(
        "instruments:", "x: [&a {name: A}, &b {header_position: ignore}]\ninstruments:"
    )
    with pytest.raises(CampaignError) as caught:
        load_campaign(_write(tmp_path, merged))
    assert "given twice" not in str(caught.value)
    loop = MINIMAL + "metadata: &a {comment: x, program: *a}\n"
    with pytest.raises(CampaignError, match="program"):
        load_campaign(_write(tmp_path, loop))


def test_a_url_for_output_is_refused(tmp_path: Path) -> None:
    path = _write(tmp_path, MINIMAL)
    for command in (["runs", str(path)], ["publish", str(path), "memory://there"]):
        message = CliRunner().invoke(app, [*command, "--out", "s3://bucket/out"])
        assert message.exit_code == 2
        assert "output: is a URL" in message.stderr


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"none\.yaml"):
        load_campaign(tmp_path / "none.yaml")


KNOWN = {"method": "known_background"}


def _with_facts(*facts: dict[str, object]) -> Campaign:
    raw = yaml.safe_load(MINIMAL)
    raw["instruments"]["lidar"]["facts"] = list(facts)
    return Campaign.model_validate(raw)


def test_facts_follow_time() -> None:
    campaign = _with_facts(
        {"valid_to": "2020-01-01", "zenith_angle": 10},
        {"valid_from": "2020-01-01", "zenith_angle": 20},
    )
    lidar = campaign.instruments["lidar"]
    assert lidar.facts_at(datetime(2019, 12, 31, 23, 59, 59, tzinfo=UTC)).zenith_angle == 10
    assert lidar.facts_at(datetime(2020, 1, 1, tzinfo=UTC)).zenith_angle == 20


@each(
    ("settings", "problem"),
    [
        ({"lag": 1}, "lag|method cubic only"),
        ({"background": {"photon_532o": [2.0, 0.1]}}, "background|known_background only"),
        ({**KNOWN, "background": {"photon_355o": [2.0, 0.1]}}, "background|photon_532o"),
        ({**KNOWN, "background": {"photon_532o": [2.0, -0.1]}}, "background|greater than"),
        (
            {**KNOWN, "background": {"photon_532o": [2.0, 0.1]}, "background_range": [900, 1500]},
            "background_range|give one",
        ),
    ],
)
def test_a_lag_and_a_background_need_their_method(settings: dict[str, Any], problem: str) -> None:
    path = {"channels": ["photon_532o"], "sections": [[750, 4500]]}
    with pytest.raises(ValidationError) as caught:
        HomogeneousSettings.model_validate({**path, **settings})
    (error,) = caught.value.errors()
    key, words = problem.split("|")
    located = [*error["loc"], *error.get("ctx", {}).get("keys", ())]
    assert key in located
    assert words in error["msg"]


def test_overlapping_periods_are_refused() -> None:
    with pytest.raises(ValueError, match="overlap"):
        _with_facts({"valid_to": "2020-01-02"}, {"valid_from": "2020-01-01"})
    with pytest.raises(ValueError, match="later"):
        _with_facts({"valid_from": "2020-01-01", "valid_to": "2019-01-01"})


@pytest.mark.parametrize(("window", "seconds"), [("6h", 21600), ("30min", 1800), ("day", None)])
def test_windows(window: str, seconds: float | None) -> None:
    raw = yaml.safe_load(MINIMAL) | {"scenes": {"window": window}}
    found = Campaign.model_validate(raw).scenes.window
    assert found == "day" if seconds is None else found.total_seconds() == seconds  # type: ignore[union-attr]


@pytest.mark.parametrize("window", ["7h", "10s", "fortnight", "2d"])
def test_invalid_windows_are_refused(window: str) -> None:
    raw = yaml.safe_load(MINIMAL) | {"scenes": {"window": window}}
    with pytest.raises(ValueError, match="window"):
        Campaign.model_validate(raw)


# Settings of the elastic product, and files beside the campaign file ---------------------------


def _instrument(**changes: object) -> Campaign:
    raw = yaml.safe_load(MINIMAL)
    raw["instruments"]["lidar"].update(changes)
    return Campaign.model_validate(raw)


def _elastic(**settings: object) -> ElasticSettings:
    products = {"elastic": {"channels": ["photon_532o"], **settings}}
    found = _instrument(products=products).instruments["lidar"].products.elastic
    assert found is not None
    return found


def test_elastic_defaults() -> None:
    found = _elastic()
    assert found.average == timedelta(minutes=30)
    assert (found.lidar_ratio, found.lidar_ratio_standard_error) == (50.0, 10.0)
    assert found.background == "known_shape"
    assert found.molecular_relative_error == 0.01
    window = found.reference
    assert (window.lowest, window.highest, window.width) == (3000.0, 12_000.0, 1000.0)
    assert (window.scattering_ratio, window.relative_error) == (1.0, 0.02)


@each(("text", "seconds"), [("10s", 10), ("5min", 300), ("2h", 7200), ("1d", 86400), (900, 900)])
def test_averages(text: object, seconds: float) -> None:
    assert _elastic(average=text).average.total_seconds() == seconds


@each(
    ("settings", "words"),
    [
        ({"average": "7min"}, "divide a day"),
        ({"average": "2d"}, "divide a day"),
        ({"average": "0s"}, "divide a day"),
        ({"average": "0.5s"}, "divide a day"),
        ({"average": "-30min"}, "average"),
        ({"average": "soon"}, "average"),
        ({"average": "infh"}, "average"),
        ({"average": "nanh"}, "average"),
        ({"average": "min"}, "average"),
        ({"average": "999999999999d"}, "average"),
        ({"lidar_ratio": 0}, "lidar_ratio"),
        ({"lidar_ratio": 250}, "lidar_ratio"),
        ({"lidar_ratio": "nan"}, "lidar_ratio"),
        ({"lidar_ratio_standard_error": -1}, "lidar_ratio_standard_error"),
        ({"lidar_ratio_standard_error": float("nan")}, "lidar_ratio_standard_error"),
        ({"molecular_relative_error": 1.5}, "molecular_relative_error"),
        ({"background": "cubic"}, "known_shape"),
        ({"channels": []}, "channels"),
        ({"lidar_ration": 40}, "lidar_ration"),
        ({"reference": {"lowest": 5000, "highest": 5999}}, "at least width above lowest"),
        ({"reference": {"lowest": -1}}, "lowest"),
        ({"reference": {"lowest": float("inf"), "highest": float("inf")}}, "lowest"),
        ({"reference": {"width": 50}}, "width"),
        ({"reference": {"width": float("nan")}}, "width"),
        ({"reference": {"scattering_ratio": 0.9}}, "scattering_ratio"),
        ({"reference": {"relative_error": -0.1}}, "relative_error"),
    ],
)
def test_invalid_elastic_settings_are_refused(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        _elastic(**settings)


@each("lag", [-100, 3.5, 0, "estimate", None])
def test_lags(lag: object) -> None:
    facts = _with_facts({"channels": {"analog_532o": {"lag": lag}}}).instruments["lidar"].facts[0]
    assert facts.channels["analog_532o"].lag == lag


@each("lag", [101, -101, "guess", float("nan"), float("inf")])
def test_invalid_lags_are_refused(lag: object) -> None:
    with pytest.raises(ValidationError, match="lag"):
        _with_facts({"channels": {"analog_532o": {"lag": lag}}})


@each("name", ["overlap_profile", "molecular_profile"])
@each("path", ["../air.csv", "/etc/air.csv", "~/air.csv", "a/../../air.csv"])
def test_profiles_stay_beside_the_campaign_file(name: str, path: str) -> None:
    with pytest.raises(ValidationError, match="must be a relative path"):
        _with_facts({name: path})
    assert getattr(_with_facts({name: "air/o.csv"}).instruments["lidar"].facts[0], name)


def test_the_folder_is_that_of_the_campaign_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _write(tmp_path, MINIMAL)
    monkeypatch.chdir(tmp_path)
    assert load_campaign("campaign.yaml").folder == tmp_path.resolve()
    assert (
        load_campaign(tmp_path / "campaign.yaml", output="/elsewhere").folder == tmp_path.resolve()
    )
    assert load_campaign("campaign.yaml").model_copy().folder == tmp_path.resolve()


@pytest.mark.parametrize("wrong_use", [False, True])
def test_an_error_survives_pickling(*, wrong_use: bool) -> None:
    error = CatalogError("is away", file="a", field="b", remedy="wait", wrong_use=wrong_use)
    message = pickle.loads(pickle.dumps(error))
    assert (str(message), message.wrong_use) == ("a: b: is away (wait)", wrong_use)
    assert pickle.loads(pickle.dumps(CampaignError("is no campaign"))).wrong_use


def test_the_folder_goes_with_a_campaign_to_other_processes(tmp_path: Path) -> None:
    campaign = load_campaign(_write(tmp_path, MINIMAL))
    assert pickle.loads(pickle.dumps(campaign)).folder == campaign.folder


def test_a_multiplier_replaces_the_prior() -> None:
    whole: dict[str, object] = {"channel": "photon_532o"}
    for value in (0.0, 0.8, "chosen"):
        settings = VisibilityProductSettings.model_validate(whole | {"multiplier": value})
        assert settings.multiplier == value
    for wrong in ({"multiplier": 1.2}, {"multiplier": "best"}, {"multiplier": 1, "prior": "none"}):
        with pytest.raises(ValidationError):
            VisibilityProductSettings.model_validate(whole | wrong)
