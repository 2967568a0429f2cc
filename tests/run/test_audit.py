"""Commands that read the ledger: history of runs and verification of files."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import Result
from support.archives.small_archive import DAY, Archive
from typer.testing import CliRunner

from lidarops.catalog import lock as lock_module
from lidarops.catalog.lock import Lock
from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.records import SceneOutcome
from lidarops.run import executor
from lidarops.run.archive import reprocess
from lidarops.scene.job import Failure, Job


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small archive, processed once with its retrievals."""
    source = Archive(tmp_path_factory.mktemp("processed"), days=2)
    reprocess(source.write())
    return source.folder


def _mismatches(archive: Archive) -> set[tuple[str, str]]:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        return {(file.what, file.path) for file in verify_archive(campaign, store) if file.problem}


def test_verify_names_every_file_that_is_not_as_recorded(archive: Archive) -> None:
    assert _mismatches(archive) == set()
    product = next((archive.folder / "out/products").rglob("*.nc"))
    product.write_bytes(product.read_bytes()[:-1] + b"?")
    archive.flip("raw/rich/h00")
    archive.flip("overlap.csv", -7)
    (archive.folder / "raw/poor/h11").unlink()
    (archive.folder / "raw/poor/h10").rename(archive.folder / "raw/poor/h-moved")
    name = str(product.relative_to(archive.folder / "out/products"))
    changed = {("product", name), ("signal", "rich/h00"), ("overlap", "overlap.csv")}
    lost = {("signal", "poor/h11"), ("signal", "poor/h10")}
    assert _mismatches(archive) == changed | lost
    # Once the catalog knows the new path, the moved file is no mismatch.
    CliRunner().invoke(app, ["catalog", str(archive.file)])
    assert _mismatches(archive) == changed | {("signal", "poor/h11")}


def test_verify_names_products_that_the_ledger_does_not_know(archive: Archive) -> None:
    """Such as those of a run that could not enter them."""
    products = archive.folder / "out/products"
    product = next(products.rglob("*.nc"))
    shutil.copy(product, product.with_name("stray.nc"))
    # What a killed process leaves is swept by the next run.
    shutil.copy(product, product.with_name(".stray.nc.1.tmp.nc"))
    stray = str(product.with_name("stray.nc").relative_to(products))
    assert _mismatches(archive) == {("unlisted", stray)}
    campaign = archive.write()
    with Store(campaign.catalog_url, "other") as store, Lock(store) as lock:
        lock.acquire()
        # A run of another campaign that shares the folder may yet enter it.
        assert _mismatches(archive) == set()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        # The run that holds the lock may yet enter it.
        assert _mismatches(archive) == set()
    # Another campaign of the same folder and database knows its own products.
    archive.tree["name"] = "other"
    archive.tree["instruments"]["rich"]["products"] = {}
    archive.tree["instruments"]["poor"]["products"] = {}
    other = {path for what, path in _mismatches(archive) if what == "unlisted"}
    assert other == {stray}


def test_the_history_of_runs_names_what_failed_and_the_newest_report(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(job: Job) -> tuple[SceneOutcome, bool]:
        return Failure("nowhere.csv: cannot be read").outcome(job.scene, job.plan), True

    monkeypatch.setattr(executor, "attempt", failing)
    file = str(archive.file)
    CliRunner().invoke(app, ["reprocess", file, "--force", "--instrument", "poor"])
    shown = CliRunner().invoke(app, ["runs", file], env={"COLUMNS": "300"}).stdout
    assert len(re.findall("poor_202603.*nowhere.csv: cannot be read", shown)) == 2
    (page,) = re.findall("newest report: (.*)", shown)
    assert Path(page).is_file()


def test_the_command_line_shows_runs_and_mismatches(archive: Archive) -> None:
    runner, file = CliRunner(), str(archive.file)
    summary = runner.invoke(app, ["runs", file, "--json"])
    assert summary.exit_code == 0
    (run,) = json.loads(summary.stdout)
    assert (run["status"], run["scenes"], run["products"]) == ("finished", 4, 12)
    assert {"digest", "retrieve", "write"} <= set(run["seconds"])
    shown = runner.invoke(app, ["runs", file], env={"COLUMNS": "300"}).stdout
    assert run["id"] in shown
    assert "held by" not in shown
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        shown = runner.invoke(app, ["runs", file], env={"COLUMNS": "300"}).stdout
    assert f"held by {Lock.holder_name()} since " in shown
    assert "with a sign of life 0 s ago" in shown
    assert runner.invoke(app, ["verify", file]).exit_code == 0
    archive.flip("raw/rich/h00")
    wrong = runner.invoke(app, ["verify", file, "--json"])
    assert wrong.exit_code == 1
    (mismatch,) = json.loads(wrong.stdout)["mismatches"]
    assert mismatch["path"] == "rich/h00"
    assert runner.invoke(app, ["verify", file, "--products-only"]).exit_code == 0


def test_the_command_line_makes_stale_products_and_states_why(archive: Archive) -> None:
    runner, file = CliRunner(), str(archive.file)
    nothing = runner.invoke(app, ["reprocess", file, "--json"])
    # Its elastic products have no usable value, which every run reports.
    assert nothing.exit_code == 1
    summary = json.loads(nothing.stdout)
    assert summary["run"] is None
    assert summary["unusable_scenes"] == ["rich_20260301T000000", "rich_20260302T000000"]
    assert not (archive.folder / "out/report").exists()
    planned = runner.invoke(app, ["plan", file, "--stale", "--json"])
    assert planned.exit_code == 1
    idle = json.loads(planned.stdout)
    assert idle["without_a_usable_value"] == summary["unusable_scenes"]
    archive.flip("raw/poor/h10")
    planned = runner.invoke(app, ["plan", file, "--stale", "--json"])
    summary = json.loads(planned.stdout)
    (scene,) = summary["scenes"]
    assert {stale["reason"] for stale in scene["stale"]} == {"changed: signal poor/h10"}
    log = archive.folder / "log.jsonl"
    words = ["--log-json", "--log-level", "info", "--log-file", str(log), "--json"]
    done = runner.invoke(app, ["reprocess", file, *words])
    assert done.exit_code == 1, done.output
    assert len(json.loads(done.stdout)["products"]) == 2
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert any("changed: signal poor/h10" in line["message"] for line in lines)
    (ended,) = [line for line in lines if line.get("granules") == 3]
    assert ended["scene"] == "poor_20260302T000000"


@pytest.mark.parametrize("command", ["runs", "verify"])
def test_commands_that_read_the_ledger_create_none(command: str, archive: Archive) -> None:
    """A wrong folder must not count as an archive without mismatches."""
    elsewhere = archive.folder / "elsewhere"
    result = CliRunner().invoke(app, [command, str(archive.file), "--out", str(elsewhere)])
    assert result.exit_code == 1
    assert "there is no catalog yet" in result.output
    assert not elsewhere.exists()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--product", "luck"], 2, "homogeneous"),
        (["--instrument", "luck"], 2, "poor"),
        (["--station", "luck"], 2, "coast"),
        (["--since", "2026-03-02", "--until", "2026-03-01"], 2, "earlier"),
        (["--since", "2026-03-02", "--until", "2026-03-02"], 2, "earlier"),
        (["--memory-limit", "foo"], 2, "2GiB"),
        (["--memory-limit", "2"], 2, "2GiB"),
        (["--log-level", "luck"], 2, "warning"),
        (["--catalog", "luck"], 2, "postgresql"),
        (["--catalog", "luck://host/name"], 2, "postgresql"),
        (["--archive", "luck"], 2, "luck"),
        (["--archive", "luck://bucket"], 2, "luck"),
        (["--cluster", "luck"], 2, "kubernetes"),
        (["--scheduler", "luck"], 2, "tls://head:8786"),
        (["--cluster", "slurm", "--memory-limit", "2GiB"], 2, "memory_limit"),
        (["--scheduler", "tls://head:8786", "--memory-limit", "2GiB"], 2, "memory_limit"),
        (["--scheduler", "tcp://head:8786"], 2, "unencrypted: true"),
    ],
)
def test_wrong_use_names_the_choices(
    archive: Archive, words: list[str], code: int, message: str
) -> None:
    result = CliRunner().invoke(app, ["reprocess", str(archive.file), *words])
    assert result.exit_code == code
    assert message in result.output


@pytest.mark.parametrize("command", ["catalog", "plan", "verify"])
def test_a_missing_archive_is_wrong_use_only_if_given_as_an_option(
    archive: Archive, command: str
) -> None:
    def code(*words: str) -> int:
        return CliRunner().invoke(app, [command, str(archive.file), *words]).exit_code

    usual = code()
    (archive.folder / "raw").rename(archive.folder / "away")
    # It verifies what does not need the archive.
    assert code() == (1 if command == "verify" else 3)
    assert code("--archive", str(archive.folder / "raw")) == 2
    assert code("--archive", str(archive.folder / "away")) == usual


def test_a_plan_waits_for_another_run_for_the_given_time(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    def planned(*words: str) -> Result:
        command = ["plan", str(archive.file), "--stale", "--instrument", "poor", *words]
        return CliRunner().invoke(app, command)

    campaign = archive.write()
    archive.raw("poor/h13", DAY + 603, seed=1)
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as held:
        held.acquire()
        refused = planned()
        assert refused.exit_code == 3
        assert "--wait" in refused.output
        monkeypatch.setattr(lock_module.time, "sleep", lambda _: held.release())
        waited = planned("--wait", "30")
    assert waited.exit_code == 0, waited.output
    assert "poor_20260302T000000" in waited.output


def test_a_size_of_memory_is_read_before_the_archive(tmp_path: Path) -> None:
    fresh = Archive(tmp_path, days=1)
    words = ["reprocess", str(fresh.file), "--workers", "2", "--memory-limit", "foo"]
    assert CliRunner().invoke(app, words).exit_code == 2
    assert not (tmp_path / "out").exists()


def test_a_selection_without_scene_is_reported_unlike_one_with_fresh_products(
    archive: Archive,
) -> None:
    def output(*words: str) -> str:
        return CliRunner().invoke(app, ["reprocess", str(archive.file), *words]).output

    none = "the selection contains no scene of the archive"
    assert none in output("--since", "2026-04-01")
    assert none in output("--until", "2026-03-01", "--instrument", "poor")
    kind = ["--product", "homogeneous"]
    for words in (["--since", "2026-03-02"], kind, [*kind, "--instrument", "poor"]):
        fresh = output(*words)
        assert "is fresh" in fresh
        assert none not in fresh


def test_a_product_is_reproduced_from_moved_raw_files(
    archive: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made(product: Path, *words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, ["reproduce", str(product), *words])
        return done.exit_code, done.output

    monkeypatch.delenv("LIDAROPS_CATALOG", raising=False)
    product = sorted((archive.folder / "out/products").rglob("poor/signal/**/*.nc"))[-1]
    raw = archive.folder / "raw" / "poor"
    (raw / "h10").rename(raw / "h-moved")
    code, output = made(product)
    assert code == 1
    assert "input poor/h10: missing" in output
    assert "--catalog" in output
    # Another file takes the name of an input.
    (raw / "h11").rename(raw / "h-too")
    (raw / "h00").rename(raw / "h11")
    before = product.stat().st_mtime_ns
    CliRunner().invoke(app, ["reprocess", str(archive.file)])
    assert product.stat().st_mtime_ns == before
    code, output = made(product)
    assert code == 0, output
    # No input is left under its name.
    (raw / "h12").rename(raw / "h-last")
    (raw / "h11").rename(raw / "h-first")
    CliRunner().invoke(app, ["catalog", str(archive.file)])
    assert made(product)[0] == 0
    elsewhere = Path(shutil.copy(product, tmp_path.parent / f"{tmp_path.name}.nc"))
    catalog = f"sqlite:///{archive.folder}/out/catalog.sqlite"
    for place in (str(archive.folder / "raw"), f"file://{archive.folder}/raw"):
        assert made(elsewhere, "--archive", place)[0] == 1
        assert made(elsewhere, "--archive", place, "--catalog", catalog)[0] == 0
    (raw / "h-last").unlink()
    code, output = made(product)
    assert code == 1
    assert "input poor/h12: missing" in output
    assert "h10" not in output
    nothing = made(product, "--catalog", f"sqlite:///{archive.folder}/none.sqlite")
    assert nothing[0] == 1
    assert "there is no catalog yet" in nothing[1]
