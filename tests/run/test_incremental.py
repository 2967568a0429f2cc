"""Incremental runs: each kind of change makes exactly the products stale that depend on it."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from support import quick
from support.archives.small_archive import DAY, SOUNDING, Archive, made
from typer.testing import CliRunner

from lidarops.catalog import product_files
from lidarops.catalog.lock import Lock
from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import RunStatus, Store, Verdict
from lidarops.cli import app
from lidarops.records import SceneOutcome, day_of
from lidarops.run import executor, staleness
from lidarops.run.archive import (
    Options,
    Selection,
    assess,
    bring_up_to_date,
    remove_orphans,
    reprocess,
)
from lidarops.run.staleness import DaysJudged, Judge
from lidarops.scene.job import Job
from lidarops.system.files import sha256_of

RICH = ("signal analog", "signal photon", "homogeneous photon", "elastic analog")


def _all(days: range, products: tuple[str, ...] = RICH) -> set[str]:
    return {f"rich {day} {product}" for day in days for product in products}


def _poor(days: range) -> set[str]:
    return {f"poor {day} signal {channel}" for day in days for channel in ("analog", "photon")}


EVERYTHING = _all(range(1, 5)) | _poor(range(1, 5))


pytestmark = pytest.mark.usefixtures("quickly")


def test_a_forced_run_makes_everything(archive: Archive) -> None:
    assert made(reprocess(archive.write(), options=Options(force=True))) == EVERYTHING


def test_a_run_with_nothing_to_do_writes_nothing(archive: Archive) -> None:
    before = archive.contents()
    stamps = {path: path.stat().st_mtime_ns for path in (archive.folder / "out").rglob("*")}
    assert reprocess(archive.write()) is None
    assert archive.contents() == before
    after = {path: path.stat().st_mtime_ns for path in (archive.folder / "out").rglob("*")}
    folders = {path for path in after if path.is_dir() or path.suffix == ".nc"}
    assert {path: after[path] for path in folders} == {path: stamps[path] for path in folders}


def test_threads_that_judge_different_scenes_share_no_part_of_a_plan(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the next days are judged while the scenes of others end."""
    campaign, product = archive.write(), ("signal", "photon")
    within, done = threading.Event(), threading.Event()
    settings = staleness.recorded_settings

    def interrupted(*words: Any) -> dict[str, Any]:
        if threading.current_thread() is not threading.main_thread():
            within.set()
            assert done.wait(60)
        return settings(*words)

    with Store(campaign.catalog_url, campaign.name) as store, ThreadPoolExecutor(1) as thread:
        judge = Judge(campaign, store)
        first, second = judge.days(sorted(judge.signatures())).judgements[:2]
        monkeypatch.setattr(staleness, "recorded_settings", interrupted)
        ahead = thread.submit(judge.plan_and_settings, first.scene, first.plan, product)
        assert within.wait(60)
        judge.plan_and_settings(second.scene, second.plan, product)
        done.set()
        assert ahead.result()[0].scene == first.scene.id
        assert judge.plan_and_settings(second.scene, second.plan, product)[0].scene == (
            second.scene.id
        )


def _dead_time(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["facts"][1]["channels"]["photon_532o"]["dead_time"] = 5e-9


def _lidar_ratio(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["products"]["elastic"]["lidar_ratio"] = 42


def _sections(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["products"]["homogeneous"]["sections"] = [[750, 825]]


def _closed_period(archive: Archive) -> None:
    """Add a calibration that is valid from the last day on."""
    facts = archive.tree["instruments"]["rich"]["facts"]
    facts[1]["valid_to"] = "2026-03-04T00:00:00Z"
    facts.append({**facts[1], "valid_from": "2026-03-04T00:00:00Z", "azimuth": 12.0})
    del facts[2]["valid_to"]


def _new_overlap(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["facts"][0]["full_overlap_range"] = 500.0


def _title(archive: Archive) -> None:
    archive.tree["title"] = "Another title"


def _name(archive: Archive) -> None:
    archive.tree["instruments"]["poor"]["name"] = "Poor lidar"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda a: a.flip("raw/rich/h11"), _all(range(2, 3))),
        (lambda a: a.flip("raw/poor/h30"), _poor(range(4, 5))),
        # Taken on the first day: used on that day and the next, for analog channels only.
        (
            lambda a: a.flip("raw/rich/d0", -(4 * 1500 + 60)),
            _all(range(1, 3), ("signal analog", "elastic analog")),
        ),
        (lambda a: a.flip("air.csv", -2), _all(range(1, 3), ("elastic analog",))),
        (lambda a: a.flip("overlap.csv", -7), _all(range(1, 5))),
        (_lidar_ratio, _all(range(1, 5), ("elastic analog",))),
        (_sections, _all(range(1, 5), ("homogeneous photon",))),
        (_dead_time, _all(range(3, 5), ("signal photon", "homogeneous photon"))),
        (_closed_period, _all(range(4, 5))),
        (_new_overlap, _all(range(1, 3))),
        (_title, EVERYTHING),
        (_name, _poor(range(1, 5))),
    ],
    ids=[
        "raw", "raw of another", "dark", "molecular", "overlap", "lidar ratio", "sections",
        "dead time of a period", "new period", "overlap range", "title", "name",
    ],
)  # fmt: skip
def test_exactly_the_products_that_depend_on_a_change_are_made_again(
    archive: Archive, change: Callable[[Archive], None], expected: set[str]
) -> None:
    change(archive)
    campaign = archive.write()
    judged = {
        f"{each.scene.instrument} {each.scene.start.day} {stale.kind} {stale.channel[:6]}"
        for each in assess(campaign)
        for stale in each.stale
    }
    assert judged == expected
    assert made(reprocess(campaign)) == expected
    assert reprocess(campaign) is None


def test_incremental_runs_give_the_products_of_one_full_run(
    archive: Archive, tmp_path: Path
) -> None:
    for change in (_lidar_ratio, _sections, _dead_time):
        change(archive)
        reprocess(archive.write())
    other = Archive(tmp_path / "other")
    other.tree = archive.tree
    reprocess(other.write())
    assert archive.contents("out/products") == other.contents("out/products")


def test_touched_and_moved_files_make_nothing_stale(archive: Archive) -> None:
    raw = archive.folder / "raw"
    os.utime(raw / "rich" / "h00", ns=(1, 1))
    (raw / "rich" / "h01").rename(raw / "rich" / "h-renamed")
    result = bring_up_to_date(archive.write())
    assert result.record is None
    assert (result.summary.moved, result.summary.added, result.summary.vanished) == (1, 0, 0)
    assert result.summary.changed == 0
    before = archive.contents()
    assert reprocess(archive.write()) is None
    assert archive.contents() == before


def test_a_lost_catalog_row_is_judged_by_content(archive: Archive) -> None:
    rich = archive.folder / "raw" / "rich"
    # For example, one of two disks is not mounted during one run.
    rich.rename(archive.folder / "away")
    result = bring_up_to_date(archive.write())
    assert result.record is None
    assert len(result.orphans) == len(_all(range(1, 5)))
    (archive.folder / "away").rename(rich)
    assert reprocess(archive.write()) is None


def test_products_that_are_damaged_or_lost_are_made_again(archive: Archive) -> None:
    before = archive.contents("out/products")
    first, second, third = sorted((archive.folder / "out/products").rglob("*.nc"))[:3]
    first.unlink()
    second.write_bytes(second.read_bytes()[:-1])
    os.utime(third)
    record = reprocess(archive.write())
    assert len(made(record)) == 2
    assert archive.contents("out/products") == before
    assert reprocess(archive.write()) is None


def test_new_files_join_their_scene_and_lost_ones_leave_it(archive: Archive) -> None:
    archive.raw("rich/h09", 610, seed=77)
    (archive.folder / "raw/poor/h10").unlink()
    reasons = {
        (each.scene.instrument, stale.reason)
        for each in assess(archive.write())
        for stale in each.stale
    }
    assert ("rich", "new: signal rich/h09") in reasons
    assert ("poor", "gone: signal poor/h10") in reasons
    assert made(reprocess(archive.write())) == _all(range(1, 2)) | _poor(range(2, 3))


def test_products_of_vanished_inputs_are_listed_and_kept_until_removal_is_requested(
    archive: Archive,
) -> None:
    for path in (archive.folder / "raw/poor").glob("h1*"):
        path.unlink()
    archive.tree["vanished_share"] = 1
    campaign = archive.write()
    before = archive.contents("out/products")
    for _ in range(2):
        result = bring_up_to_date(campaign)
        assert result.record is None
        assert len(result.orphans) == 2
        assert archive.contents("out/products") == before
    assert remove_orphans(campaign, result) == 2
    assert set(before) - set(archive.contents("out/products")) == {
        orphan.path for orphan in result.orphans
    }
    assert bring_up_to_date(campaign).orphans == ()


def test_a_selection_is_made_and_the_rest_stays_stale(archive: Archive) -> None:
    _title(archive)
    campaign = archive.write()
    parts = [
        (Selection(instruments=("poor",)), _poor(range(1, 5))),
        (Selection(kinds=("elastic",)), _all(range(1, 5), ("elastic analog",))),
    ]
    for selection, expected in parts:
        assert made(reprocess(campaign, selection=selection)) == expected
        assert reprocess(campaign, selection=selection) is None
    rest = made(reprocess(campaign))
    assert rest == EVERYTHING - parts[0][1] - parts[1][1]
    assert reprocess(campaign) is None


def _planned(archive: Archive, *options: str) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["plan", str(archive.file), "--json", *options])
    assert result.exit_code == 0
    return dict(json.loads(result.stdout))


def test_the_plan_of_a_selection_shows_its_products_only(archive: Archive) -> None:
    archive.write()
    summary = _planned(archive, "--product", "homogeneous")
    for scene in summary["scenes"]:
        rich = scene["scene"].startswith("rich")
        assert (scene["fresh"], len(scene["stale"])) == (int(rich), 0)
        names = {step["name"] for step in scene["steps"]}
        assert ("homogeneous" in names) == bool(names) == rich
        assert not names & {"signal", "background", "elastic", "reference"}
        assert {left["name"] for left in scene["left_out"]} >= {"homogeneous"} - names
    nothing = _planned(archive, "--product", "homogeneous", "--instrument", "poor")
    assert {scene["fresh"] for scene in nothing["scenes"]} == {0}


def _window_effects(summary: dict[str, Any]) -> list[str]:
    steps = [step for scene in summary["scenes"] for step in scene["steps"]]
    return [step.get("no_effect", "") for step in steps if step["name"] == "range_window"]


def test_a_plan_marks_a_range_window_without_effect(archive: Archive) -> None:
    archive.write()
    assert _window_effects(_planned(archive)) == ["signal needs all bins"] * 4
    assert _window_effects(_planned(archive, "--product", "homogeneous")) == [""] * 4
    shown = CliRunner().invoke(app, ["plan", str(archive.file), "--all"], env={"COLUMNS": "300"})
    assert shown.stdout.count("no effect: signal needs all bins") == 4


def test_a_plan_shows_its_hash_and_what_each_step_needs(archive: Archive) -> None:
    archive.write()
    selection = ["--instrument", "poor", "--until", "2026-03-02T00:00:00"]
    (scene,) = _planned(archive, *selection)["scenes"]
    command = ["plan", str(archive.file), *selection, "--all"]
    shown = CliRunner().invoke(app, command, env={"COLUMNS": "100"}).stdout
    assert f"plan {scene['hash'][:12]}" in " ".join(shown.split())
    rows = [[cell.strip() for cell in line.split("│")] for line in shown.splitlines()]
    rows = [row for row in rows if len(row) > 4]
    lines = {(row[1], channel): row[3] for row in rows for channel in row[2].split(", ")}
    planned = {other["name"] for other in scene["steps"]}
    for step in scene["steps"]:
        needs = {name for name in step.get("needs", ()) if name in planned}
        line = lines[step["name"], step["channel"]]
        assert set(filter(None, line.partition("; after ")[2].split(", "))) == needs


def test_a_kind_that_nothing_requests_is_wrong_use(archive: Archive) -> None:
    archive.write()
    for command in ("plan", "reprocess"):
        refused = CliRunner().invoke(app, [command, str(archive.file), "--product", "visibility"])
        assert refused.exit_code == 2
        assert "requested: homogeneous, elastic, signal" in refused.stderr


@pytest.mark.slow
def test_products_that_were_never_made_are_not_fresh(archive: Archive, tmp_path: Path) -> None:
    archive.write()
    for kinds in ([], ["--product", "signal"], ["--product", "homogeneous"]):
        summary = _planned(archive, "--out", str(tmp_path / "new"), *kinds)
        assert {scene["fresh"] for scene in summary["scenes"]} == {0}
        assert all(scene["stale"] for scene in summary["scenes"] if scene["steps"])


def test_a_selection_without_scene_is_reported_as_text_and_json(archive: Archive) -> None:
    archive.write()
    said = "the selection contains no scene of the archive"
    for command in ("plan", "reprocess"):
        for options, none in ((["--since", "2030-01-01"], True), (["--station", "coast"], False)):
            line = [command, str(archive.file), *options]
            assert (said in CliRunner().invoke(app, line).stdout) is none
            summary = json.loads(CliRunner().invoke(app, [*line, "--json"]).stdout)
            assert summary["no_scene_selected"] is none


def test_force_makes_what_is_fresh(archive: Archive) -> None:
    before = archive.contents("out/products")
    selection = Selection(stations=("coast",), instruments=("poor",))
    record = reprocess(archive.write(), selection=selection, options=Options(force=True))
    assert made(record) == _poor(range(1, 5))
    assert archive.contents("out/products") == before


def test_refused_files_are_reported_by_a_run_with_nothing_to_do(archive: Archive) -> None:
    (archive.folder / "raw/rich/h-broken").write_bytes(b"broken")
    archive.raw("poor/h-twin", 600, seed=1)
    first = bring_up_to_date(archive.write())
    assert first.has_failures
    before = archive.contents()
    again = bring_up_to_date(archive.write())
    assert again.record is None
    assert again.has_failures
    assert (again.summary.refused, list(again.set_aside)) == (1, ["poor/h00"])
    assert archive.contents() == before


def test_unusable_scenes_are_reported_by_a_run_with_nothing_to_do(
    archive: Archive,
) -> None:
    campaign = archive.write()
    record = reprocess(campaign, options=Options(force=True))
    assert record is not None
    usable = {each.path: each.usable for scene in record.scenes for each in scene.products}
    with Store(campaign.catalog_url, campaign.name) as store:
        rows = {row["path"]: row for row in store.products()}
        assert {path: row["usable"] for path, row in rows.items()} == usable
        assert store.unusable_scenes() == [scene.scene for scene in record.scenes if scene.unusable]
    poorest = next(path for path, row in rows.items() if row["kind"] == "elastic")
    with sqlite3.connect(archive.folder / "out" / "catalog.sqlite") as connection:
        connection.execute("update product set usable = 0 where kind = 'elastic'")
        connection.execute("update product set usable = 1 where path = ?", (poorest,))
    scenes = {row["scene"] for path, row in rows.items() if row["kind"] == "elastic"}
    again = bring_up_to_date(campaign)
    assert again.record is None
    assert set(again.unusable) == scenes - {rows[poorest]["scene"]}
    assert again.has_failures


def test_the_run_that_makes_an_unusable_scene_reports_it(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(job: Job) -> tuple[SceneOutcome, bool]:
        outcome, final = quick.attempt(job)
        return replace(
            outcome, products=tuple(replace(each, usable=0) for each in outcome.products)
        ), final

    monkeypatch.setattr(executor, "attempt", nothing)
    archive.write()
    command = ["reprocess", str(archive.file), "--instrument", "rich", "--force"]
    command += ["--until", "2026-03-02"]
    shown = CliRunner().invoke(app, [*command, "--product", "homogeneous"])
    assert (shown.exit_code, "gave a usable value" in shown.stdout) == (0, False)
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 1
    assert shown.stdout.count("gave a usable value") == 1
    assert "earlier runs" not in shown.stdout
    summary = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert summary["unusable_scenes"] == ["rich_20260301T000000"]


def test_orphaned_products_are_not_reported_as_unusable(archive: Archive) -> None:
    archive.write()
    with sqlite3.connect(archive.folder / "out" / "catalog.sqlite") as connection:
        connection.execute("update product set usable = 0 where kind = 'elastic'")
    assert bring_up_to_date(archive.write()).unusable
    del archive.tree["instruments"]["rich"]["products"]["elastic"]
    for _ in range(2):
        result = bring_up_to_date(archive.write())
        assert result.orphans
        assert not result.unusable
        assert not result.has_failures


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_wait_for_a_cluster_at_once(archive: Archive, number: int) -> None:
    ended = []

    @contextmanager
    def cluster() -> Iterator[Any]:
        try:
            os.kill(os.getpid(), number)
            time.sleep(60.0)
            yield None
        finally:
            ended.append(True)

    before = archive.contents("out/products")
    handler = signal.getsignal(number)
    next((archive.folder / "out/products").rglob("*poor*signal*.nc")).unlink()
    began = time.monotonic()
    result = bring_up_to_date(archive.write(), options=Options(cluster=cluster))
    assert time.monotonic() - began < 30.0
    assert ended == [True]
    assert (result.signal, result.status) == (number, RunStatus.INTERRUPTED)
    assert result.has_failures
    assert signal.getsignal(number) is handler
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        assert lock.holder() is None
        assert (store.runs()[0].status, store.runs()[0].scenes) == (RunStatus.INTERRUPTED, 0)
        assert store.failures() == {}
    assert len(made(reprocess(campaign))) == 1
    assert archive.contents("out/products") == before


def test_a_cluster_is_started_only_if_something_is_stale(archive: Archive) -> None:
    started = []

    @contextmanager
    def cluster() -> Iterator[Any]:
        started.append(True)
        yield client

    with Client(processes=False, n_workers=1, dashboard_address=None) as client:
        options = Options(cluster=cluster)
        assert reprocess(archive.write(), options=options) is None
        assert not started
        next((archive.folder / "out/products").rglob("*poor*signal*.nc")).unlink()
        assert len(made(reprocess(archive.write(), options=options))) == 1
        assert started == [True]


def test_a_scene_that_failed_for_good_is_not_tried_until_something_changes(
    archive: Archive,
) -> None:
    _failing(archive)
    first = bring_up_to_date(archive.write())
    assert sum(bool(scene.error) for scene in first.record.scenes) == 2
    before = archive.contents()
    again = bring_up_to_date(archive.write())
    assert again.record is None
    assert len(again.failures) == 2
    assert "air.csv" in next(iter(again.failures.values()))
    assert again.has_failures
    assert archive.contents() == before
    (archive.folder / "air.csv").write_text(SOUNDING)
    healed = bring_up_to_date(archive.write())
    assert not healed.has_failures
    assert healed.status is RunStatus.FINISHED


def test_replaced_versions_are_kept_if_the_campaign_says_so(archive: Archive) -> None:
    archive.tree["superseded"] = "keep"
    assert reprocess(archive.write()) is None
    before = archive.contents("out/products")
    _lidar_ratio(archive)
    campaign = archive.write()
    reprocess(campaign)
    kept = archive.contents("out/superseded")
    assert kept == {
        path.replace(".nc", f".{sha256[:12]}.nc"): sha256
        for path, sha256 in before.items()
        if "elastic" in path
    }
    with Store(campaign.catalog_url, campaign.name) as store:
        checked = [file for file in verify_archive(campaign, store) if file.what == "superseded"]
    assert [file.path for file in checked] == [f"superseded/{path}" for path in sorted(kept)]
    assert not any(file.problem for file in checked)
    # A forced run gives the same bytes, so no further version is kept.
    reprocess(campaign, options=Options(force=True))
    assert archive.contents("out/superseded") == kept


@pytest.mark.slow
def test_a_version_that_a_killed_run_kept_is_not_mistaken_for_the_one_that_it_wrote(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.tree["superseded"] = "keep"
    first = set(archive.contents("out/products").values())
    archive.raw("poor/h03", 604, seed=9)
    campaign = archive.write()
    with monkeypatch.context() as patch:
        patch.setattr(Store, "record", lambda *_, **__: sys.exit("dies before it enters products"))
        with pytest.raises(SystemExit):
            reprocess(campaign)
    assert set(archive.contents("out/products").values()) - first
    archive.raw("poor/h04", 605, seed=10)
    assert reprocess(campaign) is not None
    kept = archive.contents("out/superseded")
    assert set(kept.values()) <= first
    with Store(campaign.catalog_url, campaign.name) as store:
        assert [file for file in verify_archive(campaign, store) if file.problem] == []


def test_a_version_that_a_killed_run_has_not_replaced_is_not_kept(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.tree["superseded"] = "keep"
    campaign = archive.write()
    with monkeypatch.context() as patch:
        patch.setattr(executor, "attempt", lambda _job: sys.exit("dies within a scene"))
        with pytest.raises(SystemExit):
            reprocess(campaign, options=Options(force=True))
    assert archive.contents("out/superseded")
    archive.raw("poor/h39", 3 * DAY + 630, seed=9)
    before = archive.contents("out/products")
    assert reprocess(campaign) is not None
    assert set(archive.contents("out/superseded").values()) <= set(before.values()) - set(
        archive.contents("out/products").values()
    )


def test_replaced_versions_are_kept_for_a_month(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = archive.contents("out/products")
    _lidar_ratio(archive)
    reprocess(archive.write())
    (name, *_) = [name for name in before if "elastic" in name]
    kept = product_files.last_kept(archive.folder / "out" / "products" / name)
    assert before[name] == sha256_of(kept)
    of_elastic = sum("elastic" in name for name in before)
    for days, left in ((29, of_elastic), (31, 0)):
        later = time.time() + days * 86400.0
        with monkeypatch.context() as patch:
            patch.setattr(product_files.time, "time", lambda later=later: later)
            archive.raw(f"rich/h9{days}", days * DAY, seed=3)
            reprocess(archive.write())
        assert len(archive.contents("out/superseded")) == left


def test_a_new_day_is_processed_alone(archive: Archive) -> None:
    for k in range(3):
        archive.raw(f"rich/h9{k}", 9 * DAY + k, seed=k)
    assert made(reprocess(archive.write())) == _all(range(10, 11))


def _expected_verdicts(archive: Archive) -> dict[int, Verdict]:
    """Return the verdicts on days on which nothing is stale."""
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store)
        signatures = judge.signatures()
        judged = [judge.days(batch) for batch in judge.batches(signatures)]
    return {
        day: verdict._replace(signature=signatures[day].whole)
        for days in judged
        for day, verdict in days.verdicts.items()
        if day not in {scene.day for scene in days.judgements if scene.due}
    }


def _verdicts(archive: Archive) -> dict[int, Verdict]:
    """Return the verdicts of days whose state is unchanged."""
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store)
        now = judge.signatures()
        known = store.verdicts()
    return {
        day: verdict
        for day, verdict in known.items()
        if day in now and judge.is_settled(now[day], verdict)
    }


def _unreadable_later(archive: Archive) -> None:
    """Add a file with a good header and without data."""
    path = archive.raw("rich/h19", 2 * DAY + 620, seed=7)
    header = path.read_bytes()
    path.write_bytes(header[:400] + bytes(len(header) - 400))


def _failing(archive: Archive) -> None:
    (archive.folder / "air.csv").write_text(SOUNDING + quick.REFUSED)


def _unusable(archive: Archive) -> None:
    (archive.folder / "air.csv").write_text("altitude,pressure\n0,1013\n")


def _twin(archive: Archive) -> None:
    archive.raw("poor/h-twin", 600, seed=1)


def _vanished(archive: Archive) -> None:
    for path in (archive.folder / "raw/poor").glob("h1*"):
        path.unlink()


def _nothing_requested(archive: Archive) -> None:
    archive.tree["instruments"]["poor"]["products"] = {}
    _title(archive)


def _dark(archive: Archive) -> None:
    archive.flip("raw/rich/d0")


@pytest.mark.parametrize(
    "change",
    [_title, _sections, _lidar_ratio, _dark, _twin, _vanished, _failing, _unusable,
     _unreadable_later, _nothing_requested],
)  # fmt: skip
def test_days_are_settled_as_a_new_judgement_would_settle_them(
    archive: Archive, change: Callable[[Archive], object]
) -> None:
    assert _verdicts(archive)
    change(archive)
    reprocess(archive.write())
    assert _verdicts(archive) == _expected_verdicts(archive)
    reprocess(archive.write(), options=Options(force=True))
    assert _verdicts(archive) == _expected_verdicts(archive)


def test_only_days_with_failures_are_judged_again(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []
    days = Judge.days

    def counting(judge: Judge, requested_days: Sequence[int]) -> DaysJudged:
        looked.extend(requested_days)
        return days(judge, requested_days)

    monkeypatch.setattr(Judge, "days", counting)
    _title(archive)
    reprocess(archive.write())
    every = sorted(_verdicts(archive))
    assert looked == every
    looked.clear()
    _failing(archive)
    record = reprocess(archive.write())
    failed = {day_of(scene.start) for scene in record.scenes if scene.error}
    assert len(failed) == 2
    # Only these days use the sounding; they are judged before and after.
    assert looked == sorted(failed) * 2


def _elsewhere(archive: Archive) -> None:
    """Change the sounding."""
    (archive.folder / "air.csv").write_text(SOUNDING.replace("288.15", "287.15"))


def _without_dark(archive: Archive) -> None:
    (archive.folder / "raw/rich/d0").unlink()


def _joined(archive: Archive) -> None:
    """Add a file that another process enters in the catalog."""
    campaign = archive.write()
    archive.raw("rich/h08", 620, seed=44)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)


@pytest.mark.parametrize("change", [_elsewhere, _without_dark, _joined])
def test_a_change_during_processing_leaves_the_day_unsettled(
    archive: Archive, change: Callable[[Archive], None]
) -> None:
    archive.tree["vanished_share"] = 1
    _title(archive)

    def once(outcome: SceneOutcome) -> None:
        if outcome.instrument == "rich" and not changed:
            changed.append(outcome.start.day)
            change(archive)

    changed: list[int] = []
    reprocess(archive.write(), options=Options(progress=once))
    assert changed == [1]
    assert _verdicts(archive).items() <= _expected_verdicts(archive).items()
    assert f"rich {changed[0]} elastic analog" in made(reprocess(archive.write()))
