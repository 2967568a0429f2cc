"""Files and scenes that are gone or unused: what runs report, forget and remove."""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn

import pytest
from support.archives.small_archive import DAY, Archive
from typer.testing import CliRunner

from lidarops.catalog import product_files
from lidarops.catalog.lock import Lock
from lidarops.catalog.store import Run, RunStatus, Store
from lidarops.cli import app
from lidarops.errors import CatalogError
from lidarops.reports import gallery, run_record
from lidarops.run import archive as pipeline
from lidarops.run import ledger_run, staleness
from lidarops.run.archive import (
    Options,
    Selection,
    bring_up_to_date,
    remove_orphans,
    report_run,
    reprocess,
)
from lidarops.run.ledger_run import LedgerRun
from lidarops.scene.dependence import plan_closure
from lidarops.system.files import only_one

FIRST = datetime(2026, 3, 1, tzinfo=UTC)


pytestmark = pytest.mark.usefixtures("quickly")


# Reported ----------------------------------------------------------------------------------------


def _json_output(archive: Archive) -> dict[str, object]:
    """Return the JSON output of the command; exit code 1 must come with a reason."""
    result = CliRunner().invoke(app, ["reprocess", str(archive.file), "--json"])
    summary = json.loads(result.stdout)
    reasons = (
        "failed_scenes",
        "internal_errors",
        "unusable_scenes",
        "refused_files",
        "files_set_aside",
        "empty_scenes",
    )
    nowhere = any(each["nowhere"] for each in summary["not_in_files"])
    assert result.exit_code == int(nowhere or any(summary[name] for name in reasons))
    return dict(summary)


def test_a_file_in_no_scene_is_named_by_every_run(archive: Archive) -> None:
    archive.raw("poor/h-twin", 600, seed=1)
    archive.write()
    for _ in range(3):
        summary = _json_output(archive)["files_set_aside"]
        assert list(summary) == ["poor/h00"]
        assert "poor/h-twin" in summary["poor/h00"]
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file)])
    assert "poor/h-twin" in shown.stdout
    assert shown.exit_code == 1


def test_an_empty_scene_is_named_by_every_run(archive: Archive) -> None:
    archive.tree["instruments"]["poor"]["products"] = {
        "homogeneous": {"channels": ["photon_355o"], "sections": [[750, 840]]}
    }
    archive.write()
    for _ in range(2):
        summary = _json_output(archive)["empty_scenes"]
        assert len(summary) == 4
        assert all("photon_355o" in why for why in summary.values())


def test_a_run_records_why_products_are_left_out(archive: Archive) -> None:
    """The reasons for products that were left out are in the record of the run only."""
    archive.tree["instruments"]["rich"]["products"]["homogeneous"]["sections"] = [[750, 1500]]
    archive.tree["instruments"]["rich"]["products"]["elastic"]["lidar_ratio"] = 42
    record = reprocess(archive.write())
    assert record is not None
    assert {scene.instrument for scene in record.scenes} == {"rich"}
    for scene in record.scenes:
        assert scene.plan is not None
        assert scene.plan.hash == plan_closure(scene.plan, scene.plan.product_keys).hash
        summary = [left.reason for left in scene.left_out if left.rule == "section_level"]
        assert len(summary) == 1
        assert "the beam climbs 750 m" in summary[0]
        every = (*scene.plan.left_out, *scene.left_out)
        assert len(set(every)) == len(every)
    # One entry for all scenes with the same reason.
    assert len({id(scene.left_out) for scene in record.scenes}) < len(record.scenes)
    page = report_run(archive.write(), record).page
    assert "the beam climbs 750 m" in page.read_text()
    assert "the beam climbs 750 m" in (page.parent / "run.json").read_text()


def test_a_report_names_empty_scenes(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_run, "MOST_EMPTY_SCENES", 3)
    archive.tree["instruments"]["poor"]["products"] = {
        "homogeneous": {"channels": ["photon_532o"], "sections": [[50_000, 60_000]]}
    }
    record = reprocess(archive.write(), options=Options(force=True))
    assert record is not None
    assert list(record.empty_scenes) == [f"poor_2026030{day}T000000" for day in (1, 2, 3)]
    assert record.more_empty_scenes == 1
    assert record.failed
    page = report_run(archive.write(), record).page.read_text()
    assert "section 50000-60000 m extends beyond the last bin" in page
    assert "poor_20260303T000000" in page
    assert "1 more without product" in page
    assert "4 scenes without product" in page


def _misspelt_product(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["products"]["homogeneous"]["channels"].append("photon_999o")


def _misspelt_facts(archive: Archive) -> None:
    facts = archive.tree["instruments"]["rich"]["facts"][1]
    facts["channels"] = {"photon_533o": facts["channels"]["photon_532o"]}


@pytest.mark.parametrize(
    ("misspell", "channel", "requested_by"),
    [
        (_misspelt_product, "photon_999o", "homogeneous"),
        (_misspelt_facts, "photon_533o", "facts from 2026-03-03T00:00:00Z"),
    ],
)
def test_a_channel_that_no_file_holds_is_named_by_every_run(
    archive: Archive, misspell: Callable[[Archive], None], channel: str, requested_by: str
) -> None:
    assert _json_output(archive)["not_in_files"] == []
    misspell(archive)
    result = bring_up_to_date(archive.write(), options=Options(force=True))
    assert result.record is not None
    assert result.record.failed
    page = report_run(archive.write(), result.record).page.read_text()
    assert page.count(channel) >= 2
    assert "Requested, but not in the files" in page
    for _ in range(2):
        (summary,) = _json_output(archive)["not_in_files"]
        assert (summary["channel"], summary["requested_by"], summary["nowhere"]) == (
            channel,
            requested_by,
            True,
        )
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file)], env={"COLUMNS": "200"})
    assert channel in shown.stdout
    assert shown.exit_code == 1
    # Selection of another lidar, or of a time outside the period of these facts.
    other = CliRunner().invoke(app, ["reprocess", str(archive.file), "--instrument", "poor"])
    assert other.exit_code == 0
    early = ["reprocess", str(archive.file), "--until", "2026-03-02"]
    assert CliRunner().invoke(app, early).exit_code == int(requested_by == "homogeneous")


def test_a_channel_of_a_new_laser_is_reported_without_failure(archive: Archive) -> None:
    for path in (archive.folder / "raw/rich").glob("h3*"):
        path.write_bytes(path.read_bytes().replace(b"00532.o", b"00533.o"))
    archive.tree["instruments"]["rich"]["facts"][1]["channels"]["photon_533o"] = {"dead_time": 3e-9}
    archive.write()
    summary = _json_output(archive)
    assert any("photon_533o" in path for path in summary["products"])
    files = {(each["channel"], each["requested_by"][:5]): each for each in summary["not_in_files"]}
    assert files["photon_533o", "facts"]["files"] == 3
    assert files["photon_533o", "facts"]["files_expected"] == 6
    assert files["photon_532o", "homog"]["files"] == 3
    assert files["photon_532o", "homog"]["files_expected"] == 12
    assert not any(each["nowhere"] for each in files.values())


def test_unused_files_of_unchanged_days_are_named_without_judging_them(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    for day in range(4):
        archive.raw(f"poor/h-twin{day}", day * DAY + 600, seed=1)
    campaign = archive.write()
    first = bring_up_to_date(campaign)
    assert len(first.set_aside) == 4
    monkeypatch.setattr(staleness.Judge, "days", None)
    again = bring_up_to_date(campaign)
    assert (again.set_aside, again.has_failures) == (first.set_aside, True)


# Forgotten -----------------------------------------------------------------------------------


def _fail(archive: Archive, scenes: str, *, unmade: bool = False) -> None:
    """Mark scenes as failed for good."""
    with sqlite3.connect(archive.folder / "out" / "catalog.sqlite") as connection:
        connection.execute(
            "update scene set error = 'bad', final = 1 where scene like ?", (scenes,)
        )
        if unmade:
            connection.execute(
                "delete from product_input where product in"
                " (select path from product where scene like ?)",
                (scenes,),
            )
            connection.execute("delete from product where scene like ?", (scenes,))


def test_failures_are_removed_on_days_between_others(archive: Archive) -> None:
    _fail(archive, "poor_%", unmade=True)
    for day in (0, 2):
        for path in (archive.folder / "raw/poor").glob(f"h{day}*"):
            path.unlink()
    campaign = archive.write()
    assert set(bring_up_to_date(campaign).failures) == {
        "poor_20260302T000000",
        "poor_20260304T000000",
    }


def test_failures_are_removed_with_the_last_files_of_their_day(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["dark_files"] = []
    reprocess(archive.write())
    _fail(archive, "%_20260304T%", unmade=True)
    assert len(bring_up_to_date(archive.write()).failures) == 2
    for path in (archive.folder / "raw").glob("*/h3*"):
        path.unlink()
    for _ in range(2):
        result = bring_up_to_date(archive.write())
        assert not result.failures
        assert not result.has_failures


# Removed -------------------------------------------------------------------------------------


def _without(archive: Archive, instrument: str) -> None:
    for path in (archive.folder / "raw" / instrument).glob("h*"):
        path.unlink()


def test_products_outside_the_selection_are_not_orphaned(archive: Archive) -> None:
    _without(archive, "rich")
    _without(archive, "poor")
    archive.raw("other", 0, seed=1)
    campaign = archive.write()
    day = FIRST.replace(day=2)
    parts = [
        (Selection(instruments=("poor",)), 8),
        (Selection(stations=("coast",)), 24),
        (Selection(kinds=("elastic",)), 4),
        (Selection(since=day, until=day.replace(day=4)), 12),
        (Selection(until=day), 6),
    ]
    for selection, number in parts:
        assert len(bring_up_to_date(campaign, selection=selection).orphans) == number


def _leave_over(archive: Archive) -> None:
    """Make orphans: of present scenes and of scenes that are gone."""
    del archive.tree["instruments"]["rich"]["products"]["homogeneous"]
    _without(archive, "poor")


@pytest.mark.parametrize(
    ("since", "until", "number"),
    [
        (FIRST.replace(hour=12), None, 8 + 4),
        (FIRST.replace(hour=12), FIRST.replace(hour=13), 2 + 1),
        (FIRST.replace(day=2), FIRST.replace(day=2, hour=1), 2 + 1),
        (FIRST.replace(day=4, hour=23), None, 2 + 1),
        (FIRST.replace(day=5), None, 0),
    ],
)
def test_leftovers_of_selected_scenes_are_reported(
    archive: Archive, since: datetime, until: datetime | None, number: int
) -> None:
    _leave_over(archive)
    campaign = archive.write()
    result = bring_up_to_date(campaign, selection=Selection(since=since, until=until))
    assert len(result.orphans) == number


def test_a_product_that_another_run_made_again_is_not_removed(archive: Archive) -> None:
    kept = {path: path.read_bytes() for path in (archive.folder / "raw/poor").glob("h1*")}
    for path in kept:
        path.unlink()
    campaign = archive.write()
    before = archive.contents("out/products")
    result = bring_up_to_date(campaign)
    assert len(result.orphans) == 2
    for path, content in kept.items():
        path.write_bytes(content)
    assert reprocess(campaign, options=Options(force=True))
    assert remove_orphans(campaign, result) == 0
    assert archive.contents("out/products") == before
    assert reprocess(campaign) is None


def _vanish(archive: Archive, instrument: str, day: int) -> None:
    for path in (archive.folder / "raw" / instrument).glob(f"h{day}*"):
        path.unlink()


def _empty(archive: Archive) -> None:
    _without(archive, "rich")
    _without(archive, "poor")
    (archive.folder / "raw/rich/d0").unlink()


@pytest.mark.parametrize("command", ["catalog", "plan", "reprocess"])
def test_an_emptied_archive_fails_and_its_catalog_stays(archive: Archive, command: str) -> None:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        known = store.granules()
    _empty(archive)
    before = archive.contents("out/products")
    options = ["--remove-orphans"] if command == "reprocess" else []
    result = CliRunner().invoke(app, [command, str(archive.file), *options])
    assert result.exit_code == 3
    for words in ("the catalog stays unchanged", "mounted", "on purpose", campaign.catalog_url):
        assert words in result.stderr
    with Store(campaign.catalog_url, campaign.name) as store:
        assert store.granules() == known
    assert archive.contents("out/products") == before
    # The remedy of the message.
    other = ["--catalog", f"sqlite:///{archive.folder}/other.sqlite"]
    shown = CliRunner().invoke(app, [command, str(archive.file), *other])
    assert shown.exit_code == 1
    assert "matches no file of the archive" in shown.stdout


def test_products_without_raw_file_are_failures_until_they_are_removed(
    archive: Archive,
) -> None:
    _without(archive, "poor")
    archive.raw("poor/h90", 9 * 1440, seed=1)
    archive.tree["vanished_share"] = 1
    campaign = archive.write()
    for _ in range(2):
        result = bring_up_to_date(campaign)
        assert result.has_failures
        assert set(result.lost) == {each.path for each in result.orphans}
        assert len(result.lost) == 8
    command = ["reprocess", str(archive.file)]
    # Also if all selected scenes are gone.
    for options in ([], ["--instrument", "poor"]):
        shown = CliRunner().invoke(app, [*command, *options])
        assert shown.exit_code == 1
        assert "--remove-orphans" in shown.stdout
        assert "no raw file" in shown.stdout
    assert CliRunner().invoke(app, [*command, "--instrument", "rich"]).exit_code == 0
    assert CliRunner().invoke(app, [*command, "--remove-orphans"]).exit_code == 0
    assert CliRunner().invoke(app, command).exit_code == 0
    assert not bring_up_to_date(campaign).orphans


@pytest.mark.parametrize("how", ["truncated", "unreadable"])
def test_products_whose_files_became_unusable_are_kept(archive: Archive, how: str) -> None:
    campaign = archive.write()
    before = archive.contents("out/products")
    for path in (archive.folder / "raw/poor").glob("h2*"):
        if how == "truncated":
            path.write_bytes(path.read_bytes()[:-100])
        else:
            path.unlink()
            path.symlink_to("nowhere")
    for _ in range(2):
        result = bring_up_to_date(campaign)
        (orphan,) = {(each.reason, each.requested, each.lost) for each in result.orphans}
        assert orphan == ("its raw files are refused, or belong to no scene", True, False)
        assert len(result.orphans) == 2
        assert result.has_failures
        assert not result.lost
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file), "--remove-orphans"])
    assert shown.exit_code == 1
    assert archive.contents("out/products") == before


def test_products_of_scenes_that_are_cut_differently_are_not_reported_as_lost(
    archive: Archive,
) -> None:
    archive.tree["scenes"] = {"window": "6h"}
    result = bring_up_to_date(archive.write())
    assert {each.reason for each in result.orphans} == {"its files belong to other scenes now"}
    assert len(result.orphans) == 24
    assert not result.has_failures


def test_products_that_get_another_name_are_made_again_and_the_old_ones_removed(
    archive: Archive,
) -> None:
    before = archive.contents("out/products")
    archive.tree["stations"]["shore"] = archive.tree["stations"].pop("coast")
    for instrument in archive.tree["instruments"].values():
        instrument["station"] = "shore"
    result = bring_up_to_date(archive.write())
    assert {orphan.path for orphan in result.orphans} == before.keys()
    assert {orphan.reason for orphan in result.orphans} == {"it has another name now"}
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file), "--remove-orphans"])
    assert shown.exit_code == 0
    after = archive.contents("out/products")
    assert set(after) == {path.replace("coast", "shore") for path in before}
    assert bring_up_to_date(archive.write()).orphans == ()


def test_nothing_is_removed_if_the_archive_is_missing(archive: Archive) -> None:
    _empty(archive)
    with sqlite3.connect(archive.folder / "out" / "catalog.sqlite") as connection:
        # A catalog that knows no file of the archive.
        connection.execute("delete from granule")
    campaign = archive.write()
    result = bring_up_to_date(campaign)
    before = archive.contents("out/products")
    assert len(result.orphans) == len(before) == 24
    assert remove_orphans(campaign, result) == 0
    assert archive.contents("out/products") == before


# The page ------------------------------------------------------------------------------------


def _full(*_: object, **__: object) -> NoReturn:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _stopped(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


@pytest.mark.parametrize(("fails", "code"), [(_full, 3), (_stopped, 130)])
@pytest.mark.parametrize("as_json", [False, True])
def test_a_failed_report_hides_nothing_and_the_next_run_says_how_to_make_it(
    archive: Archive,
    monkeypatch: pytest.MonkeyPatch,
    fails: Callable[..., NoReturn],
    code: int,
    *,
    as_json: bool,
) -> None:
    archive.raw("poor/h09", 630, seed=9)
    _vanish(archive, "poor", 1)
    archive.tree["vanished_share"] = 1
    archive.write()
    command = ["reprocess", str(archive.file), *(["--json"] if as_json else [])]
    with monkeypatch.context() as patch:
        patch.setattr(gallery, "fill", fails)
        failed = CliRunner().invoke(app, command, env={"COLUMNS": "300"})
    assert failed.exit_code == code
    (folder,) = (archive.folder / "out/report").glob("*")
    if fails is _full:
        assert f"lidarops report {folder}" in failed.stderr
    if as_json:
        summary = json.loads(failed.stdout)
        assert (summary["report"], len(summary["products"]), len(summary["orphans"])) == (
            None,
            2,
            2,
        )
    else:
        assert "of poor: 1 product" in failed.stdout
        assert "_20260302T000000.nc" in failed.stdout
        assert "report:" not in failed.stdout
    shown = CliRunner().invoke(app, command)
    page = str(folder / "index.html")
    if as_json:
        assert json.loads(shown.stdout)["earlier_reports"] == [page]
    else:
        assert f"report of an earlier run: {page}" in shown.stdout
    assert "poor_20260301T000000" in (folder / "index.html").read_text()
    assert str(folder) not in CliRunner().invoke(app, command).stdout


def test_a_report_that_fails_again_can_be_made_by_hand(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.raw("poor/h09", 630, seed=9)
    archive.write()
    command = ["reprocess", str(archive.file), "--json"]
    with monkeypatch.context() as patch:
        patch.setattr(gallery, "fill", _full)
        CliRunner().invoke(app, command)
        shown = CliRunner().invoke(app, command)
    (folder,) = (archive.folder / "out/report").glob("*")
    assert f"run {folder.name} has no report" in shown.stderr
    assert f"lidarops report {folder}" in shown.stderr
    assert CliRunner().invoke(app, ["report", str(folder)]).exit_code == 0
    assert "has no report" not in CliRunner().invoke(app, command).stderr


@pytest.mark.parametrize("by_hand", [True, False])
def test_a_run_whose_record_could_not_be_saved_is_reported_without_making_it_again(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, *, by_hand: bool
) -> None:
    """Its disk was full, or it was killed, after its last product."""
    archive.raw("poor/h09", 630, seed=9)
    archive.write()
    command = ["reprocess", str(archive.file)]
    with monkeypatch.context() as patch:
        patch.setattr(run_record, "write_atomically", _full)
        failed = CliRunner().invoke(app, command)
    assert failed.exit_code == 3
    assert "of poor: 1 product" in failed.stdout
    (folder,) = (archive.folder / "out/report").glob("*")
    assert f"lidarops report {folder}" in failed.stderr
    before = archive.contents("out/products")
    shown = CliRunner().invoke(app, ["report", str(folder)] if by_hand else command)
    assert shown.exit_code == 0
    assert str(folder / "index.html") in shown.stdout
    page = (folder / "index.html").read_text()
    assert "was killed or met a full disk" in page
    assert "poor_20260301T000000" in page
    assert archive.contents("out/products") == before
    if not by_hand:
        record = run_record.load_run_record(folder)
        assert [scene.scene for scene in record.scenes] == ["poor_20260301T000000"]
        assert record.scenes[0].products
        assert not (folder / run_record.JOURNAL).exists()
    assert "index.html" not in CliRunner().invoke(app, command).stdout


def test_a_journal_that_is_cut_gives_the_scenes_before(archive: Archive) -> None:
    for day in range(3):
        archive.raw(f"poor/h{day}9", day * DAY + 630, seed=9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_record, "write_atomically", _full)
        CliRunner().invoke(app, ["reprocess", str(archive.file)])
    (folder,) = (archive.folder / "out/report").glob("*")
    journal = folder / run_record.JOURNAL
    os.truncate(journal, journal.stat().st_size - 10)
    assert len(run_record.load_run_record(folder).scenes) == 2
    journal.write_text("{}\n")
    with pytest.raises(CatalogError, match=r"scenes\.jsonl: cannot be read"):
        run_record.load_run_record(folder)


def test_a_full_disk_for_the_journal_does_not_stop_the_run(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.raw("poor/h09", 630, seed=9)
    opened = Path.open

    def full_for_the_journal(path: Path, *how: str, **more: str) -> object:
        return _full() if path.name == run_record.JOURNAL else opened(path, *how, **more)

    monkeypatch.setattr(Path, "open", full_for_the_journal)
    options = Options(journal=True)
    assert not bring_up_to_date(archive.write(), options=options).has_failures


def _killed(archive: Archive) -> None:
    """Leave the ledger as a killed run does."""
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        started = FIRST.replace(year=2030)
        run = Run("killed", started, None, RunStatus.RUNNING, "me", "0", "0", "", "")
        store.begin_run(run, lock.token)


def test_a_killed_run_is_reported_by_the_next_one(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LedgerRun, "conclude", _stopped)
        with pytest.raises(KeyboardInterrupt):
            bring_up_to_date(archive.write(), options=Options(journal=True))
    assert not list((archive.folder / "out/report").glob("*/index.html"))
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file)])
    assert shown.exit_code == 0
    (page,) = (archive.folder / "out/report").glob("*/index.html")
    assert f"report of an earlier run: {page}" in shown.stdout
    assert "poor_20260301T000000" in page.read_text()


def test_a_record_that_cannot_be_read_keeps_no_other_page_from_being_made(
    archive: Archive,
) -> None:
    for day in range(3):
        archive.raw(f"poor/h{day}9", day * DAY + 630, seed=9)
        _reprocess_without_page(archive)
    old, empty, foreign = sorted((archive.folder / "out/report").glob("*"))
    for record in (empty / run_record.FILE_NAME, foreign / run_record.FILE_NAME):
        record.unlink()
    (empty / run_record.JOURNAL).touch()
    document = {"format": "lidarops run record", "version": 3}
    (foreign / run_record.FILE_NAME).write_text(json.dumps(document))
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file), "--json"])
    assert shown.exit_code == 0
    assert json.loads(shown.stdout)["earlier_reports"] == [str(old / "index.html")]
    for folder in (empty, foreign):
        assert f"run {folder.name} has no report" in shown.stderr


def _reprocess_without_page(archive: Archive) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gallery, "fill", _full)
        CliRunner().invoke(app, ["reprocess", str(archive.file)])


def test_the_record_of_a_run_is_saved_before_others_see_that_it_has_ended(
    archive: Archive,
) -> None:
    archive.raw("poor/h09", 630, seed=9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "end_run", _stopped)
        with pytest.raises(KeyboardInterrupt):
            bring_up_to_date(archive.write(), options=Options(journal=True))
    (folder,) = (archive.folder / "out/report").glob("*")
    record = run_record.load_run_record(folder)
    assert not record.cut_short
    assert [scene.scene for scene in record.scenes] == ["poor_20260301T000000"]


def test_a_page_that_another_process_builds_is_left_to_it(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9)
    campaign = archive.write()
    _reprocess_without_page(archive)
    (folder,) = (archive.folder / "out/report").glob("*")
    with only_one(folder / pipeline.PAGE_LOCK, wait=False):
        assert pipeline.report_earlier_runs(campaign) == []
    assert pipeline.report_earlier_runs(campaign) == [folder / "index.html"]
    assert pipeline.report_earlier_runs(campaign) == []


def test_pages_are_built_beside_a_run_at_work(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9)
    campaign = archive.write()
    _reprocess_without_page(archive)
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        assert len(pipeline.report_earlier_runs(campaign)) == 1


def test_temporary_files_of_a_killed_run_are_named_by_verify_and_removed_by_the_next_run(
    archive: Archive,
) -> None:
    left = archive.folder / "out/products/.half.nc.0123.tmp"
    left.write_bytes(b"half of a product")
    command = ["verify", str(archive.file), "--json"]
    _killed(archive)
    found = json.loads(CliRunner().invoke(app, command).stdout)["mismatches"]
    assert [(file["what"], file["path"]) for file in found] == [
        ("temporary", "products/.half.nc.0123.tmp")
    ]
    assert reprocess(archive.write()) is None
    assert not left.exists()
    assert CliRunner().invoke(app, command).exit_code == 0


def test_a_temporary_file_that_could_not_be_removed_is_removed_by_a_later_run(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = archive.folder / "out/products/.half.nc.0123.tmp"
    left.write_bytes(b"half of a product")
    _killed(archive)
    next((archive.folder / "out/products").rglob("[!.]*.nc")).unlink()
    unlink = Path.unlink

    def failing(path: Path, missing_ok: bool = False) -> None:
        if path.name == left.name:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", failing)
        assert reprocess(archive.write()) is not None
    assert left.exists()
    assert reprocess(archive.write()) is None
    assert not left.exists()


def test_temporary_files_of_a_run_at_work_are_left_alone(archive: Archive) -> None:
    campaign = archive.write()
    left = archive.folder / "out/products/.half.nc.0123.tmp"
    left.write_bytes(b"half of a product")
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        run = Run("works", FIRST, None, RunStatus.RUNNING, "me", "0", "0", "", "")
        store.begin_run(run, lock.token)
        with pytest.raises(CatalogError, match="held by"):
            reprocess(campaign, options=Options(wait=0.1))
        assert CliRunner().invoke(app, ["verify", str(archive.file)]).exit_code == 0
    assert left.exists()


def test_a_run_that_another_one_precludes_says_so_at_once(archive: Archive) -> None:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        with pytest.raises(CatalogError, match="held by"):
            reprocess(campaign)


def test_a_report_that_somebody_builds_keeps_its_temporary_files(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9)
    folder = archive.folder / "out/report/20260301T000000-abc"
    folder.mkdir(parents=True)
    half, old = (folder / f".index.html.{name}.tmp" for name in ("half", "old"))
    for file in (half, old):
        file.write_bytes(b"half of a page")
    long_ago = time.time() - 2 * product_files.LONGEST_WRITE
    os.utime(old, (long_ago, long_ago))
    assert reprocess(archive.write()) is not None
    assert (half.exists(), old.exists()) == (True, False)
    assert CliRunner().invoke(app, ["verify", str(archive.file)]).exit_code == 0


def test_a_failed_removal_does_not_hide_the_products(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9)
    _vanish(archive, "poor", 1)
    archive.write()

    def held(*_: object, **__: object) -> NoReturn:
        raise CatalogError("is held")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "remove_orphans", held)
        failed = CliRunner().invoke(app, ["reprocess", str(archive.file), "--remove-orphans"])
    assert failed.exit_code == 1
    assert "is held" in failed.stderr
    assert "of poor: 1 product" in failed.stdout
    (page,) = (archive.folder / "out/report").glob("*/index.html")
    assert "report:" in failed.stdout
    assert page.exists()


# Runs and scans ------------------------------------------------------------------------------


def test_a_run_whose_process_is_gone_is_listed_as_died(archive: Archive) -> None:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        with Lock(store) as lock:
            lock.acquire()
            started = FIRST.replace(year=2030)
            begun = Run("x", started, None, RunStatus.RUNNING, "me", "0", "0", "", "")
            store.begin_run(begun, lock.token)
            assert store.runs()[0].status is RunStatus.RUNNING
        assert [run.status for run in store.runs()] == [RunStatus.DIED, RunStatus.FINISHED]


def test_a_known_file_is_not_counted_as_moved(archive: Archive) -> None:
    content = (archive.folder / "raw/poor/h00").read_bytes()
    (archive.folder / "raw/poor/h-copy").write_bytes(content)
    campaign = archive.write()
    assert pipeline.update_catalog(campaign).added == 1
    (archive.folder / "raw/poor/h00").unlink()
    archive.raw("poor/h-new", 900, seed=77)
    summary = pipeline.update_catalog(campaign)
    assert (summary.added, summary.moved, summary.vanished) == (1, 0, 1)
