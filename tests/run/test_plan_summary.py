"""What `lidarops plan` shows in a terminal: one screen, and names that stay whole."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from support import factories
from support.archives import raw_archives
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.cli.app import show_rows, wrapped

_STYLE = re.compile(r"\x1b\[[0-9;]*m")
SCREEN = 24


def terminal(width: int) -> dict[str, str]:
    return {"COLUMNS": str(width), "FORCE_COLOR": "1", "TERM": "xterm"}


def planned(file: Path, *options: str, width: int = 80) -> list[str]:
    shown = CliRunner().invoke(app, ["plan", str(file), *options], env=terminal(width))
    return _STYLE.sub("", shown.output).splitlines()


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of one scene."""
    folder = tmp_path_factory.mktemp("plan")
    raw_archives.write(folder / "raw" / "coast" / "h00", raw_archives.content(0.0, bins=1000))
    path = folder / "campaign.yaml"
    path.write_text(
        yaml.safe_dump(factories.campaign().model_dump(mode="json", exclude={"simulation"}))
    )
    return path


def words(lines: list[str]) -> set[str]:
    return set(re.findall(r"[A-Za-z0-9_]*_[A-Za-z0-9_]*", " ".join(lines)))


def test_one_scene_fills_at_most_a_screen(campaign: Path) -> None:
    lines = planned(campaign)
    assert len(lines) < SCREEN
    assert max(map(len, lines)) <= 80
    text = " ".join(lines)
    assert "to be made:" in text
    assert "steps: read" in text
    assert "--all" in text


@pytest.mark.parametrize("width", [80, 40])
def test_names_are_whole_at_any_width(campaign: Path, width: int) -> None:
    narrow = planned(campaign, "--all", width=width)
    assert words(narrow) == words(planned(campaign, "--all", width=300))


def test_all_shows_settings_and_reasons(campaign: Path) -> None:
    text = " ".join(planned(campaign, "--all", width=300))
    for expected in ("wavelength", "Left out", "[request]", "Estimated CPU time"):
        assert expected in text
        assert expected not in " ".join(planned(campaign, width=300))


def test_rows_become_paragraphs_where_columns_are_too_narrow(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in terminal(30).items():
        monkeypatch.setenv(name, value)
    path = "a/very/long/path/that/has/no/space.dat"
    show_rows("Refused", ("file", "reason"), [(path, "is truncated")])
    assert capsys.readouterr().out.splitlines() == [
        "Refused", "  file:", f"    {path}", "  reason: is truncated", "",
    ]  # fmt: skip
    assert wrapped("one two", "  ") == ["  one two"]
