"""A bug of lidarops ends its scene only, and is reported apart from bad data."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from support import bugs
from support.archives.scene_jobs import scene_jobs
from support.archives.small_archive import Archive
from typer.testing import CliRunner

from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.records import RunRecord
from lidarops.run import staleness
from lidarops.run.archive import Options, bring_up_to_date, reprocess
from lidarops.run.clusters import local_client
from lidarops.scene.processing import process_scene

DAY = "2026-03-02"
SCENE = "rich_20260302T000000"
OTHERS = {"rich_20260301T000000", "poor_20260301T000000", "poor_20260302T000000"}


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """A small archive of four scenes, one of which will meet the bug."""
    archive = Archive(tmp_path, days=2)
    # Without a dead time, the near section would be too bright for a fit, and left out.
    facts = archive.tree["instruments"]["rich"]["facts"]
    facts[0]["channels"] = {"photon_532o": {"dead_time": 4e-9}}
    archive.write()
    return archive


def _made_in(record: RunRecord) -> set[str]:
    return {scene.scene for scene in record.scenes if scene.products and not scene.error}


@pytest.mark.slow
def test_a_bug_ends_its_scene_only_and_its_traceback_is_kept(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    bugs.insert(AssertionError("no such thing"), DAY, monkeypatch)
    log = archive.folder / "log"
    command = ["reprocess", str(archive.file), "--log-file", str(log)]
    run = CliRunner().invoke(app, [*command, "--json"])
    assert run.exit_code == 1
    summary = json.loads(run.stdout)
    (scene,) = summary["internal_errors"]
    found = summary["internal_errors"][scene]
    assert (scene, summary["failed_scenes"]) == (SCENE, {})
    assert "internal error: AssertionError: " in found["error"]
    assert "a bug of lidarops, not of the data" in found["error"]
    assert found["traceback"].startswith("Traceback (most recent call last)")
    assert "in fit_with_a_bug" in found["traceback"]
    assert "ERROR" in log.read_text()
    assert found["traceback"].strip() in log.read_text()
    with Store(archive.write().catalog_url, "small") as store:
        assert store.failures(internal=True) == {SCENE: found["traceback"]}
        # Products of other channels were complete before the bug.
        assert {row["scene"] for row in store.products()} == {*OTHERS, SCENE}
        assert not [file for file in verify_archive(archive.write(), store) if file.problem]
    page = Path(summary["report"]).read_text()
    assert "1 scene ended with an internal error" in page
    assert "in fit_with_a_bug" in page
    shown = CliRunner().invoke(app, [*command, "--force"])
    assert shown.exit_code == 1
    assert "1 scene ended with an internal error: please report it" in shown.stdout
    assert "index.html" in shown.stdout.partition("with the traceback in")[2]


def test_a_bug_is_met_again_only_after_the_code_has_changed(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        bugs.insert(TypeError("no such thing"), DAY, patch)
        first = bring_up_to_date(archive.write())
    again = bring_up_to_date(archive.write())
    assert again.record is None
    assert again.has_failures
    assert again.internal == first.internal
    assert (set(again.internal_errors), again.failed_scenes) == ({SCENE}, {})
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file)])
    assert shown.exit_code == 1
    assert "with the traceback in the output of the same command with --json" in shown.stdout
    monkeypatch.setattr(staleness, "source_version", lambda: "with the bug mended")
    healed = bring_up_to_date(archive.write())
    assert _made_in(healed.record) == {SCENE}
    assert not healed.failures


def test_a_bug_in_planning_ends_its_scene_only(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    campaign = archive.write()
    with monkeypatch.context() as patch:
        bugs.insert_in_planning(KeyError("no such thing"), DAY, patch)
        first = bring_up_to_date(campaign)
        assert _made_in(first.record) == OTHERS
        assert (set(first.internal_errors), first.failed_scenes) == ({SCENE}, {})
        assert "internal error: KeyError: 'no such thing'" in first.internal_errors[SCENE]
        assert "in decide_with_a_bug" in first.internal[SCENE]
        assert first.internal[SCENE] in caplog.text
        with Store(campaign.catalog_url, "small") as store:
            assert store.failures(internal=True) == first.internal
        again = bring_up_to_date(campaign)
        assert again.record is None
        assert again.internal == first.internal
        run = CliRunner().invoke(app, ["reprocess", str(archive.file)])
        assert run.exit_code == 1
        assert "1 scene ended with an internal error" in run.stdout
    healed = bring_up_to_date(campaign)
    assert _made_in(healed.record) == {SCENE}
    assert not healed.failures


def test_a_bug_in_planning_keeps_the_products_of_its_scene(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = archive.write()
    reprocess(campaign)
    archive.flip("raw/rich/h10")
    with monkeypatch.context() as patch:
        bugs.insert_in_planning(KeyError("no such thing"), DAY, patch)
        result = bring_up_to_date(campaign)
        assert set(result.internal) == {SCENE}
        assert not result.orphans
        shown = CliRunner().invoke(app, ["plan", str(archive.file), "--json"])
        assert shown.exit_code == 1
        failures = {
            scene["scene"]: scene["failure"]["internal"]
            for scene in json.loads(shown.stdout)["scenes"]
            if scene["failure"]
        }
        assert "in decide_with_a_bug" in failures.pop(SCENE)
        assert not failures
        assert "KeyError" in CliRunner().invoke(app, ["plan", str(archive.file)]).stdout


def test_a_bug_in_the_estimate_of_memory_ends_its_scene_only(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    bugs.insert_in_the_estimate(TypeError("no such thing"), DAY, monkeypatch)
    record = reprocess(archive.write(), options=Options(memory="1GiB"))
    assert _made_in(record) == OTHERS
    (failed,) = (scene for scene in record.scenes if scene.internal)
    assert failed.scene == SCENE
    assert "in held_with_a_bug" in failed.internal


def test_a_changed_input_is_tried_again(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        bugs.insert(TypeError("no such thing"), DAY, patch)
        bring_up_to_date(archive.write())
    archive.flip("raw/rich/h11")
    assert not bring_up_to_date(archive.write()).failures


def test_a_scene_that_is_not_tried_again_keeps_its_traceback_in_the_next_report(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    bugs.insert(TypeError("no such thing"), DAY, monkeypatch)
    first = bring_up_to_date(archive.write())
    archive.flip("raw/poor/h11")
    (held,) = (scene for scene in reprocess(archive.write()).scenes if scene.internal)
    assert {held.scene: held.internal} == first.internal
    assert "not tried again" in held.error


def test_bugs_on_a_worker_come_back_with_the_traceback_of_the_worker(
    archive: Archive, caplog: pytest.LogCaptureFixture
) -> None:
    for day in (2, 3):
        archive.raw(f"rich/h{day}0", day * 1440 + 600, seed=day)
    error = KeyError("no such thing")
    with local_client(1) as client:
        client.run(bugs.insert, error, DAY)
        client.run(bugs.insert_in_the_worker, error, "2026-03-03")
        result = bring_up_to_date(
            archive.write(), options=Options(cluster=lambda: nullcontext(client))
        )
    assert _made_in(result.record) >= {"rich_20260301T000000", "rich_20260304T000000"}
    assert set(result.internal) == {SCENE, "rich_20260303T000000"}
    for scene, module in ((SCENE, "processing.py"), ("rich_20260303T000000", "executor.py")):
        assert "internal error: KeyError: 'no such thing'" in result.internal_errors[scene]
        assert "_with_a_bug" in result.internal[scene]
        assert module in result.internal[scene]
        assert result.internal[scene] in caplog.text
    assert not result.failed_scenes


def test_too_little_memory_is_no_bug(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    bugs.insert(MemoryError("Unable to allocate 9 TiB"), DAY, monkeypatch)
    result = bring_up_to_date(archive.write())
    assert not result.internal
    assert "does not fit in memory: Unable to allocate 9 TiB" in result.failed_scenes[SCENE]
    assert "--profiles-per-chunk" in result.failed_scenes[SCENE]


def test_an_unexpected_error_of_a_disk_is_tried_again(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        bugs.insert(OSError(errno.EIO, "Input/output error"), DAY, patch)
        assert set(bring_up_to_date(archive.write()).internal) == {SCENE}
    assert not bring_up_to_date(archive.write()).failures


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit])
def test_a_request_to_stop_is_no_error(
    archive: Archive, kind: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    bugs.insert(kind(), DAY, monkeypatch)
    (job,) = (job for job in scene_jobs(archive.write()) if job.scene.id == SCENE)
    with pytest.raises(kind):
        process_scene(job)


def _cut(archive: Archive) -> None:
    path = archive.folder / "raw/rich/h10"
    path.write_bytes(path.read_bytes()[:500])


def _blank(archive: Archive) -> None:
    path = archive.folder / "raw/rich/h10"
    path.write_bytes(bytes(path.stat().st_size))


def _shift(archive: Archive) -> None:
    """Move the counts by one byte, so that no CRLF follows them."""
    path = archive.folder / "raw/rich/h10"
    data = path.read_bytes()
    path.write_bytes(data[:-9000] + b"\0" + data[-9000:-1])


def _no_sounding(archive: Archive) -> None:
    (archive.folder / "air.csv").unlink()


def _no_overlap(archive: Archive) -> None:
    (archive.folder / "overlap.csv").write_bytes(b"\xff\xfe\0range")


def _no_folder(archive: Archive) -> None:
    shutil.rmtree(archive.folder / "out/products", ignore_errors=True)
    (archive.folder / "out/products").write_text("a file where a folder should be")


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [_cut, _blank, _shift, _no_sounding, _no_overlap, _no_folder]
)  # fmt: skip
def test_damage_after_the_scan_is_bad_data_and_no_bug(
    archive: Archive, damage: Callable[[Archive], None]
) -> None:
    damaged = []

    def damage_once(_granules: int) -> None:
        if not damaged:
            damage(archive)
            damaged.append(True)

    result = bring_up_to_date(archive.write(), options=Options(expect=damage_once))
    assert result.has_failures
    assert not result.internal
    assert any(scene.error or scene.refused for scene in result.record.scenes)
