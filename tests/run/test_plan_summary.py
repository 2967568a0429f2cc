"""What `lidarops plan` shows in a terminal: one screen, and names that stay whole."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from support import factories, quick
from support.archives import raw_archives
from support.archives.small_archive import Archive
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.cli.app import from_here, show_rows, show_tables, wrapped
from lidarops.kinds import flags_of
from lidarops.records import SceneOutcome
from lidarops.run import executor
from lidarops.scene.job import Job

_STYLE = re.compile(r"\x1b\[[0-9;]*m")
SCREEN = 24
MOST_LINES = 60
"""Whatever the number of scenes."""


def terminal(width: int) -> dict[str, str]:
    return {"COLUMNS": str(width), "FORCE_COLOR": "1", "TERM": "xterm"}


def planned(file: Path, *options: str, width: int = 80) -> list[str]:
    shown = CliRunner().invoke(app, ["plan", str(file), *options], env=terminal(width))
    return _STYLE.sub("", shown.output).splitlines()


def written(folder: Path, **changes: Any) -> Path:
    """Return the file of a campaign of one scene; `changes` replace keys of its instrument."""
    raw_archives.write(folder / "raw" / "coast" / "h00", raw_archives.content(0.0, bins=1000))
    path = folder / "campaign.yaml"
    settings = factories.campaign(**changes).model_dump(mode="json", exclude={"simulation"})
    path.write_text(yaml.safe_dump(settings))
    return path


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of one scene."""
    return written(tmp_path_factory.mktemp("plan"))


def words(lines: list[str]) -> set[str]:
    return set(re.findall(r"[A-Za-z0-9_]*_[A-Za-z0-9_]*", " ".join(lines)))


def test_one_scene_fills_at_most_a_screen(campaign: Path) -> None:
    lines = planned(campaign)
    assert len(lines) < SCREEN
    assert max(map(len, lines)) <= 80
    text = " ".join(lines)
    assert "to be made:" in text
    assert "steps: read" in text
    assert re.search(r"about [0-9]+ MB of memory", text)
    assert "1 stale scene of 1" in text
    assert "--all" in text


@pytest.mark.parametrize("width", [80, 40])
def test_names_are_whole_at_any_width(campaign: Path, width: int) -> None:
    narrow = planned(campaign, "--all", width=width)
    assert words(narrow) == words(planned(campaign, "--all", width=300))


def test_all_shows_settings_and_reasons(campaign: Path) -> None:
    text, short = (" ".join(planned(campaign, *all_, width=300)) for all_ in (["--all"], []))
    for expected in ("wavelength", "Left out", "[request]"):
        assert expected in text
        assert expected not in short


@pytest.mark.slow
@pytest.mark.usefixtures("quickly")
def test_many_scenes_and_products_fill_a_screen_or_two(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=25)
    for day in range(0, 20, 2):
        path = tmp_path / f"raw/poor/h{day}1"
        path.write_bytes(path.read_bytes()[:-100])
    archive.write()
    first = planned(archive.file)
    assert len(first) <= MOST_LINES
    # One block for each instrument and period of its facts, however its scenes differ.
    titles = [line for line in first if re.match(r"\w+_\d{8}T\d{6}( to|:)", line)]
    assert [title.partition("_")[0] for title in titles] == ["poor", "rich", "rich"]
    words = "poor_20260301T000000 to poor_20260325T000000: 25 scenes, 65 files, 0 dark"
    assert titles[0].startswith(words)
    assert len(planned(archive.file, "--all")) > MOST_LINES
    for options in ([], ["--force"]):
        run = CliRunner().invoke(app, ["reprocess", str(archive.file), *options], env=terminal(80))
        assert len(run.output.splitlines()) <= MOST_LINES
        assert "150 products, summed (--all lists them)" in run.output
        assert re.search(r"Refused, the first [3-9] of 10 \(--all\)", run.output)
    whole = CliRunner().invoke(app, ["reprocess", str(archive.file), "--force", "--all"])
    assert len(whole.output.splitlines()) > 150


def test_a_block_is_of_one_period_of_facts_and_says_how_many_scenes_a_line_is_of(
    tmp_path: Path,
) -> None:
    for day in range(6):
        data = raw_archives.content(1440.0 * day, bins=1000)
        raw_archives.write(tmp_path / f"raw/coast/h{day}", data)
    # On one day of the second period, no analog record.
    path = tmp_path / "raw/coast/h4"
    path.write_bytes(path.read_bytes().replace(b"00532.o 0 0 00 000 12", b"00600.o 0 0 00 000 12"))
    change = "2026-03-03T00:00:00Z"
    facts = [{"valid_to": change, "full_overlap_range": 300.0}]
    facts.append({"valid_from": change, "full_overlap_range": 450.0})
    settings = factories.campaign(products={"signal": {"channels": "all"}}, facts=facts)
    file = tmp_path / "campaign.yaml"
    file.write_text(yaml.safe_dump(settings.model_dump(mode="json", exclude={"simulation"})))
    lines = planned(file, width=300)
    titles = [line.partition(" files")[0] for line in lines if "of memory" in line]
    assert titles == [
        "lidar_20260301T000000 to lidar_20260302T000000: 2 scenes, 2",
        "lidar_20260303T000000 to lidar_20260306T000000: 4 scenes, 4",
    ]
    shares = [re.search(r"\(. of . scenes\)", line) for line in lines if "made: signal" in line]
    assert [share and share[0] for share in shares] == [None, "(3 of 4 scenes)", "(1 of 4 scenes)"]


@pytest.mark.usefixtures("quickly")
def test_a_dry_run_shows_what_is_stale_and_makes_nothing(tmp_path: Path) -> None:
    file = written(tmp_path)
    command = ["reprocess", str(file), "--dry-run"]
    first = CliRunner().invoke(app, command, env=terminal(300))
    assert "1 stale scene" in first.output
    assert not (tmp_path / "out").exists()
    CliRunner().invoke(app, ["reprocess", str(file)])
    again, forced = (CliRunner().invoke(app, [*command, *more]) for more in ([], ["--force"]))
    assert "0 stale scenes" in again.output
    assert "1 stale scene" in forced.output
    assert ": forced" in forced.output


@pytest.mark.usefixtures("quickly")
def test_commands_find_the_campaign_of_a_folder_and_of_an_output_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path)
    monkeypatch.chdir(tmp_path)

    def output(*words: str) -> str:
        shown = CliRunner().invoke(app, list(words))
        return f"{shown.exit_code}: {shown.output}"

    assert "products: " in output("reprocess")
    for place in ("campaign.yaml", ".", "out"):
        assert output("runs", place) == output("runs")
    assert "Runs of " in output("runs")
    (tmp_path / "campaign.yaml").rename(tmp_path / "other.yaml")
    assert "Runs of " in output("runs", "out")
    assert output("site", "other.yaml") == output("site", "out")
    missing = output("plan")
    assert missing.startswith("2: ")
    assert "holds no campaign.yaml" in missing


def without_usable_values(job: Job) -> tuple[SceneOutcome, bool]:
    """Stand in for the processing of a scene: all values have flags, and reject them."""
    outcome, counted = quick.attempt(job)
    products = tuple(
        replace(
            product,
            values=100,
            unflagged=0,
            usable=0,
            flagged={bit.name or "": 90 for bit in flags_of(product.kind)},
        )
        for product in outcome.products
    )
    return replace(outcome, products=products), counted


@pytest.mark.parametrize("width", [80, 160])
@pytest.mark.parametrize("days", [24, pytest.param(330, marks=pytest.mark.slow)])
def test_scenes_that_all_differ_fill_a_screen_or_two(
    tmp_path: Path, width: int, days: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each day lacks another channel, and states another altitude; files are cut at random."""
    monkeypatch.setattr(executor, "attempt", without_usable_values)
    products = {"signal": {"channels": "all"}, "elastic": {"channels": ["glued_532o"]}}
    for day in range(days):
        data = raw_archives.content(1440.0 * day, bins=1000, altitude=1000.0 + day)
        # Of the analog record another wavelength each day, which the campaign does not name.
        data = data.replace(b"00532.o 0 0 00 000 12", f"00{600 + day}.o 0 0 00 000 12".encode())
        raw_archives.write(tmp_path / f"raw/coast/h{day:03}", data)
        raw_archives.write(tmp_path / f"raw/coast/h{day:03}b", data[: -100 - day])
    facts = [{"full_overlap_range": 1e4, "channels": {"analog_532o": {"lag": 1.0}}}]
    settings = factories.campaign(products=products, facts=facts)
    file = tmp_path / "campaign.yaml"
    file.write_text(yaml.safe_dump(settings.model_dump(mode="json", exclude={"simulation"})))
    lines = planned(file, width=width)
    assert on_screen(lines, width) <= MOST_LINES
    text = " ".join(lines)
    # Files of a day to come are refused.
    assert re.search(r"(\d+) scenes, \1 files", text)
    assert "of memory" not in text.partition("of memory")[2]
    assert re.search(r"[0-9]+ further lines \(--all\)", text)
    assert re.search(r"The archive is not what .*, the first [0-5] of [0-9]+ \(--all\)", text)
    run = CliRunner().invoke(app, ["reprocess", str(file)], env=terminal(width))
    shown = _STYLE.sub("", run.output)
    assert on_screen(shown.splitlines(), width) <= MOST_LINES
    assert re.search(r"[0-9]+ products, summed \(--all lists them\), the first [1-9]", shown)
    assert re.search(r"Refused, the first [0-9] of [0-9]+ \(--all\)", shown)
    assert len(planned(file, "--all", width=width)) > MOST_LINES


def on_screen(lines: list[str], width: int) -> int:
    """Return how many lines of a screen lines of text fill."""
    return sum(max(-(-len(line) // width), 1) for line in lines)


PATH = {"channels": ["photon_532o"], "sections": [[750, 4500]]}
CUBIC = {"background": "cubic", "background_range": [750, 4500]}


@pytest.mark.parametrize(
    ("products", "warning"),
    [
        ({"homogeneous": {**PATH, "method": "cubic"}}, "warning: homogeneous photon_532o: the"),
        ({"signal": {**CUBIC}}, "warning: background analog_532o, photon_532o: the"),
        ({"homogeneous": PATH, "signal": {}}, ""),
    ],
)
def test_the_cubic_is_warned_of_by_default(
    tmp_path: Path, products: dict[str, Any], warning: str
) -> None:
    text = " ".join(planned(written(tmp_path, products=products), width=300))
    assert ("less than 30 times its noise" in text) == bool(warning)
    assert ("warning: " in text) == bool(warning)
    assert warning in text


def test_a_channel_without_a_plausible_wavelength_is_shown_with_the_reason(tmp_path: Path) -> None:
    file = written(tmp_path, products={"signal": {}})
    raw = tmp_path / "raw" / "coast" / "h00"
    raw.write_bytes(raw.read_bytes().replace(b"00532.o", b"00001.o", 1))
    text = " ".join(planned(file, width=300))
    assert "without product: analog_1o: the wavelength" in text
    assert "steps: read" in text


def test_refused_files_are_counted_by_reason_and_fail(tmp_path: Path) -> None:
    file = written(tmp_path)
    folder = tmp_path / "raw" / "coast"
    whole = (folder / "h00").read_bytes()
    for number in range(5):
        (folder / f"h{number + 1:02}").write_bytes(whole[: -100 - number // 2])
    shown = CliRunner().invoke(app, ["plan", str(file)], env=terminal(300))
    text = _STYLE.sub("", shown.output)
    assert shown.exit_code == 1
    assert "5 files refused (lidarops catalog --all names them):" in text
    assert len(re.findall(r"^  5 files: .*truncated.*, and the like", text, re.MULTILINE)) == 1
    document = json.loads(CliRunner().invoke(app, ["plan", str(file), "--json"]).output)
    assert len(document["refused_files"]) == 5


def test_a_catalog_of_many_refused_files_lists_some_and_how_to_list_all(tmp_path: Path) -> None:
    file = written(tmp_path)
    folder = tmp_path / "raw" / "coast"
    for number in range(30):
        (folder / f"h{number + 1:02}").write_bytes(b"damaged")
    shown = {}
    for options in ((), ("--all",)):
        command = ["catalog", str(file), *options]
        shown[options] = CliRunner().invoke(app, command, env=terminal(300)).output
    named = {options: len(re.findall(r"coast/h\d\d", text)) for options, text in shown.items()}
    assert named == {(): 20, ("--all",): 30}
    assert "Refused, the first 20 of 30 (--all)" in _STYLE.sub("", shown[()])
    assert "31 files: 31 added" in shown[()]


def test_a_catalog_lists_each_kind_of_reason_first(tmp_path: Path) -> None:
    file = written(tmp_path)
    folder = tmp_path / "raw" / "coast"
    whole = (folder / "h00").read_bytes()
    for number in range(30):
        (folder / f"h{number + 1:02}").write_bytes(whole[: -100 - number])
    (folder / "h99").write_bytes(b"damaged")
    shown = CliRunner().invoke(app, ["catalog", str(file)], env=terminal(300)).output
    assert set(re.findall(r"coast/h\d\d", shown)[:2]) == {"coast/h01", "coast/h99"}


def test_a_plan_names_the_second_of_two_copies_of_a_profile(tmp_path: Path) -> None:
    file = written(tmp_path)
    folder = tmp_path / "raw" / "coast"
    (folder / "h01").write_bytes((folder / "h00").read_bytes())
    document = json.loads(CliRunner().invoke(app, ["plan", str(file), "--json"]).output)
    reason = "starts at the same time as coast/h00, which is used"
    assert document["files_set_aside"] == {"coast/h01": reason}
    shown = CliRunner().invoke(app, ["plan", str(file)], env=terminal(300))
    assert shown.exit_code == 1
    assert f"coast/h01 │ {reason}" in _STYLE.sub("", shown.output)


def test_a_campaign_whose_only_file_is_refused_says_why_nothing_is_planned(tmp_path: Path) -> None:
    file = written(tmp_path)
    raw = tmp_path / "raw" / "coast" / "h00"
    raw.write_bytes(raw.read_bytes()[:-100])
    codes, texts = set(), []
    for command in ("plan", "catalog", "reprocess"):
        shown = CliRunner().invoke(app, [command, str(file)], env=terminal(300))
        codes.add(shown.exit_code)
        texts.append(shown.output)
    assert codes == {1}
    assert "1 file refused" in texts[0]


def test_main_tables_are_cut_after_the_others(capsys: pytest.CaptureFixture[str]) -> None:
    tables = [(title, ("",), [(title,)] * 6) for title in ("sum", "other")]
    for lines, sums, others in ((9, 6, 1), (8, 6, 0), (3, 1, 0)):
        assert show_tables(tables, 45, lines, main=1) == lines
        shown = capsys.readouterr().out
        assert (shown.count("  sum\n"), shown.count("  other\n")) == (sums, others)


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


def test_help_fills_its_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sentences of the documentation of a command do not break where its lines do."""
    monkeypatch.setenv("COLUMNS", "80")
    shown = CliRunner().invoke(app, ["plan", "--help"]).output
    assert re.search(r"settings and reasons\. Exit code 1 if a file is", shown)


def test_places_within_the_working_folder_are_relative_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert from_here(tmp_path / "out/products") == "out/products"
    assert from_here(tmp_path.parent / "out") == str(tmp_path.parent / "out")
    assert from_here("s3://bucket/raw") == "s3://bucket/raw"
