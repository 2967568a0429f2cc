"""An archive that is not what its campaign states: shown everywhere, and by the exit code."""

from __future__ import annotations

import json
from typing import Any

import pytest
from support.archives import raw_archives
from support.archives.small_archive import BINS, Archive
from typer.testing import CliRunner, Result

from lidarops.cli import app
from lidarops.records import RunRecord, SceneOutcome
from lidarops.reports.run_record import load_run_record
from lidarops.run import executor
from lidarops.scene.job import Failure, Job

pytestmark = pytest.mark.usefixtures("quickly")

COMMANDS = ("catalog", "plan", "reprocess")


def invoke(archive: Archive, command: str, *options: str) -> Result:
    archive.write()
    return CliRunner().invoke(app, [command, str(archive.file), *options])


def document(archive: Archive, command: str) -> dict[str, Any]:
    return json.loads(invoke(archive, command, "--json").output)


def last_run(archive: Archive) -> tuple[RunRecord, str]:
    """Return the record of the last run, and its report page."""
    folder = max((archive.folder / "out/report").iterdir())
    return load_run_record(folder), (folder / "index.html").read_text()


def test_an_archive_as_stated_has_no_findings(archive: Archive) -> None:
    for command in COMMANDS:
        shown = invoke(archive, command)
        assert shown.exit_code == 0, shown.output
        assert "not what the campaign states" not in shown.output


def _swapped(archive: Archive) -> None:
    archive.tree["stations"]["coast"] |= {"latitude": 30.7, "longitude": 46.4}


def _in_kilometres(archive: Archive) -> None:
    archive.tree["stations"]["coast"]["altitude"] = 0.75
    for path in sorted((archive.folder / "raw/poor").iterdir()):
        path.write_bytes(path.read_bytes().replace(b" 0020 ", b" 0750 ", 1))


def _elsewhere(archive: Archive) -> None:
    data = raw_archives.content(50.0, bins=BINS, position=(-31.4, -64.2), zenith_angle=0.0)
    raw_archives.write(archive.folder / "raw/poor/h-foreign", data)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_swapped, "they look swapped"),
        (_in_kilometres, "looks like km: give m"),
        (_elsewhere, "-31.4 N -64.2 E"),
    ],
    ids=["swapped", "kilometres", "a foreign station"],
)
def test_a_header_that_contradicts_the_station_fails_until_it_is_acknowledged(
    archive: Archive, change: Any, words: str
) -> None:
    change(archive)
    for command in COMMANDS:
        shown = invoke(archive, command)
        assert shown.exit_code == 1
        assert words in shown.output
        notes = [note for note in document(archive, command)["file_notes"] if note["contradicts"]]
        assert any(words in note["text"] for note in notes)
    record, page = last_run(archive)
    assert record.failed
    assert words in page
    assert 'class="verdict bad"' in page
    for instrument in archive.tree["instruments"].values():
        instrument["header_position"] = "ignore"
    for command in COMMANDS:
        assert invoke(archive, command).exit_code == 0


def test_a_tolerance_acknowledges_a_distance(archive: Archive) -> None:
    archive.tree["stations"]["coast"] |= {"latitude": 47.4, "altitude": 300.0}
    assert invoke(archive, "catalog").exit_code == 1
    for instrument in archive.tree["instruments"].values():
        instrument |= {"position_tolerance": 1.5, "altitude_tolerance": 500.0}
    assert invoke(archive, "catalog").exit_code == 0


@pytest.mark.parametrize(("key", "pattern"), [("files", "poor/x*"), ("dark_files", "poor/dark/d*")])
def test_a_pattern_without_file_is_named(archive: Archive, key: str, pattern: str) -> None:
    if key == "files":
        archive.tree["instruments"]["poor"]["files"] = pattern
    else:
        archive.tree["instruments"]["poor"]["dark_files"] = pattern
    for command in COMMANDS:
        shown = invoke(archive, command)
        assert shown.exit_code == 1
        assert f"{key}: {pattern}" in shown.output
        assert "matches no file of the archive" in shown.output
    assert invoke(archive, "reprocess", "--instrument", "rich").exit_code == 0


def test_facts_without_an_overlap_are_noted(archive: Archive) -> None:
    for facts in archive.tree["instruments"]["rich"]["facts"]:
        facts.pop("full_overlap_range", None)
    for command in ("plan", "reprocess"):
        shown = invoke(archive, command)
        assert shown.exit_code == 0
        assert "give neither full_overlap_range nor overlap_profile" in shown.output


def test_a_product_that_no_scene_gives_is_named_in_the_last_line_and_the_report(
    archive: Archive,
) -> None:
    rich = archive.tree["instruments"]["rich"]
    for facts in rich["facts"]:
        facts["zenith_angle"] = 90
    shown = invoke(archive, "reprocess", "--remove-orphans")
    assert "requested, but made in no scene: elastic analog_532o of rich" in shown.output
    assert "does not reach aerosol-free air" in shown.output
    assert "zenith_angle 90 degree of the campaign overrides 0 of the header" in shown.output
    record, page = last_run(archive)
    assert [unmade.kind for unmade in record.findings.unmade] == ["elastic"]
    assert "Requested, but made in no scene: elastic analog_532o of rich." in page
    assert '<p class="verdict care">' in page
    again = invoke(archive, "reprocess")
    assert "requested, but made in no scene: elastic analog_532o of rich" in again.output
    assert document(archive, "plan")["never_made"][0]["kind"] == "elastic"


def test_a_kind_that_no_channel_gives_is_named(archive: Archive) -> None:
    products = archive.tree["instruments"]["poor"]["products"]
    products["signal"] = {"channels": "all", "background_range": [20_000, 30_000]}
    shown = invoke(archive, "reprocess")
    assert "requested, but made in no scene: signal of all channels of poor" in shown.output


def test_products_of_other_times_do_not_count_for_a_selection(archive: Archive) -> None:
    rich = archive.tree["instruments"]["rich"]
    rich["facts"][1]["zenith_angle"] = 90
    whole = invoke(archive, "reprocess")
    assert "made in no scene" not in whole.output
    words = "requested, but made in no scene: elastic analog_532o of rich"
    assert words in invoke(archive, "reprocess", "--since", "2026-03-03").output
    assert words not in invoke(archive, "reprocess", "--until", "2026-03-03").output


def test_facts_that_hold_for_no_file_are_noted(archive: Archive) -> None:
    rich = archive.tree["instruments"]["rich"]
    rich["facts"][0]["valid_from"] = "2026-01-01T00:00:00Z"
    rich["facts"].append({"valid_to": "2020-01-01T00:00:00Z", "zenith_angle": 10})
    for command in COMMANDS[1:]:
        shown = invoke(archive, command)
        assert shown.exit_code == 0
        assert "facts to 2020-01-01T00:00:00Z" in " ".join(shown.output.split())
    (idle,) = document(archive, "plan")["unused_facts"]
    assert (idle["instrument"], idle["subject"]) == ("rich", "facts to 2020-01-01T00:00:00Z")


def test_a_lidar_ratio_that_a_glued_channel_does_not_take_is_named(archive: Archive) -> None:
    rich = archive.tree["instruments"]["rich"]
    rich["facts"][1]["channels"]["analog_532o"] = {"lidar_ratio": 70}
    rich["products"]["elastic"]["channels"] = ["glued_532o"]
    found = document(archive, "plan")
    (unused,) = found["unused_facts"]
    assert unused["subject"] == "lidar ratio of analog_532o"
    assert "takes the lidar ratio of photon_532o" in unused["reason"]
    assert not found["not_in_files"]
    rich["facts"][1]["channels"]["photon_532o"]["lidar_ratio"] = 70
    assert not document(archive, "plan")["unused_facts"]


def test_a_wavelength_that_contradicts_the_header_is_noted(archive: Archive) -> None:
    facts = archive.tree["instruments"]["rich"]["facts"]
    facts[1]["channels"]["photon_532o"]["wavelength"] = 355e-9
    shown = invoke(archive, "catalog")
    assert "photon_532o: wavelength 355 nm of the campaign overrides 532 nm" in shown.output
    assert shown.exit_code == 0


def test_a_bad_sounding_costs_only_the_products_that_need_it(archive: Archive) -> None:
    sounding = archive.folder / "air.csv"
    good = sounding.read_text()
    sounding.write_text(good.split("\n", 1)[1])
    rich = archive.tree["instruments"]["rich"]
    rich["products"]["signal"]["background_range"] = [9000, 11000]
    products = archive.folder / "out/products/coast/rich"
    before = {path: path.read_bytes() for path in products.rglob("*.nc")}
    for command in ("plan", "reprocess"):
        shown = invoke(archive, command)
        assert shown.exit_code == 1
        assert "molecular_profile: air.csv" in shown.output
        assert "give altitude, pressure, temperature in its first line" in shown.output
    after = {path: path.read_bytes() for path in products.rglob("*.nc")}
    changed = {path.name.split("_")[2] for path in before if after[path] != before[path]}
    # Products that were right stay, although they cannot be made now.
    assert before.keys() == after.keys()
    assert changed == {"signal"}
    invoke(archive, "reprocess", "--remove-orphans")
    assert before.keys() == set(products.rglob("*.nc"))
    sounding.write_text(good.replace("288.15", "288.25"))
    assert invoke(archive, "reprocess").exit_code == 0
    mended = {path: path.read_bytes() for path in products.rglob("*.nc")}
    assert {path.name.split("_")[2] for path in after if mended[path] != after[path]} == {"elastic"}


def test_a_file_of_lidar_ratios_is_checked_and_makes_elastic_stale(archive: Archive) -> None:
    for facts in archive.tree["instruments"]["rich"]["facts"]:
        facts.setdefault("channels", {})["analog_532o"] = {"lidar_ratio_profile": "ratio.csv"}
    ratio, head = archive.folder / "ratio.csv", "altitude,lidar_ratio,lidar_ratio_standard_error"
    for content, words in (
        (None, "No such file"),
        (f"{head} [%]\n0,40,5\n", "unknown unit '%'"),
    ):
        if content:
            ratio.write_text(content)
        shown = invoke(archive, "plan")
        assert shown.exit_code == 1
        assert "lidar_ratio_profile: ratio.csv" in shown.output
        assert words in shown.output
    made = {}
    for value in (40, 60):
        ratio.write_text(f"{head}\n0,{value},5\n")
        assert invoke(archive, "reprocess").exit_code == 0
        products = (archive.folder / "out/products/coast/rich").rglob("*.nc")
        made[value] = {path: path.read_bytes() for path in products}
    changed = {path.name.split("_")[2] for path in made[40] if made[40][path] != made[60][path]}
    assert changed == {"elastic"}


def test_a_plan_tells_of_scenes_that_failed_before(archive: Archive) -> None:
    def fails(job: Job) -> tuple[SceneOutcome, bool]:
        return Failure("the far range is empty").outcome(job.scene, job.plan), True

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "attempt", fails)
        invoke(archive, "reprocess", "--force", "--instrument", "rich")
    for options in ((), ("--stale",)):
        shown = invoke(archive, "plan", *options)
        assert shown.exit_code == 1
        assert "because nothing has changed" in shown.output
        assert "the far range is empty" in shown.output


def test_a_plan_prints_equal_lines_of_channels_once(archive: Archive) -> None:
    output = invoke(archive, "plan", "--all").output
    overlap = [line for line in output.splitlines() if line.split("│")[1:2] == [" overlap     "]]
    assert all("analog_532o, photon_532o" in line for line in overlap)
    assert max(map(len, output.splitlines())) > 80


def test_a_plan_states_the_units_of_settings(archive: Archive) -> None:
    shown = " ".join(invoke(archive, "plan", "--all", "--instrument", "rich").output.split())
    assert "wavelength 532 nm" in shown
    assert "dead_time 4 ns," in shown


def test_the_version_is_printed() -> None:
    shown = CliRunner().invoke(app, ["--version"])
    assert shown.exit_code == 0
    assert shown.output.strip().count(".") >= 2
