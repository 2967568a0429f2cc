"""Campaign files: what is accepted, and how a mistake is told."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml

from lidarops.campaign import Campaign, load
from lidarops.errors import CampaignError

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


def test_paths_are_relative_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LIDAROPS_ARCHIVE", raising=False)
    path = _write(tmp_path, MINIMAL)
    assert load(path).archive == str(tmp_path / "raw")
    assert load(path, output="/elsewhere").products_root == Path("/elsewhere/products")
    monkeypatch.setenv("LIDAROPS_ARCHIVE", "/archive")
    assert load(path).archive == "/archive"
    assert load(path, archive="/given").archive == "/given"
    assert load(path, archive="memory://raw").archive == "memory://raw"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("latitude: 46.4", "latitude: 146.4", r"line 6: stations\.coast\.latitude"),
        ("station: coast", "station: cost", "known: coast"),
        ('files: "h*"', 'files: "../h*"', "inside its folder"),
        ('files: "h*"', 'files: "/h*"', "inside its folder"),
        ("archive: raw", "archve: raw", "line 3: archve"),
        ("output: out", "output: s3://bucket/out", "output: is a URL"),
        ("title: A small campaign", "title: [", "not valid YAML"),
        ("title: A small campaign", "title: 2024-02-30", "not YAML"),
        ("name: small", "name: !!python/object/apply:os.getcwd []", "not valid YAML"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = _write(tmp_path, MINIMAL.replace(old, new))
    with pytest.raises(CampaignError, match=expected) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"none\.yaml"):
        load(tmp_path / "none.yaml")


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
def test_odd_windows_are_refused(window: str) -> None:
    raw = yaml.safe_load(MINIMAL) | {"scenes": {"window": window}}
    with pytest.raises(ValueError, match="window"):
        Campaign.model_validate(raw)
