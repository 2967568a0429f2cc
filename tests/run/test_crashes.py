"""Runs that are killed, run out of disk space or lack permission leave no partial products."""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import time
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from support.archives import crash_archive, crash_runs

from lidarops.catalog.lock import Lock
from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.store import RunStatus, Store
from lidarops.errors import CatalogError
from lidarops.run.archive import Options, bring_up_to_date, reprocess

NO_PROCESS = 2**22 + 1
"""Larger than the number of any process."""
KILLS = int(os.environ.get("LIDAROPS_TEST_KILLS", "30"))


def _kill(process: subprocess.Popen[bytes]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_kills_at_random_points_do_no_damage(tmp_path: Path) -> None:
    calm = tmp_path / "calm"
    whole_campaign = crash_archive.make(calm)
    reprocess(whole_campaign)
    whole = crash_archive.products(calm)
    rng = random.Random(20261121)
    kills = rounds = 0
    landed = {"serial": 0, "cluster": 0, "flow": 0}
    while kills < KILLS:
        folder = tmp_path / f"round{rounds}"
        campaign = crash_archive.make(folder)
        mode = ("serial", "cluster", "flow")[rounds % 3]
        rounds += 1
        # A flow starts its own server, which takes longer than the archive.
        for _ in range(3 if mode == "flow" else 8):
            process = crash_archive.start(folder, mode)
            began = time.monotonic()
            # Wait for the start, then kill at a random time.
            while process.poll() is None and not (folder / "out/products").exists():
                time.sleep(0.01)
            if (folder / "out/products").exists():
                time.sleep(rng.uniform(0.0, 3.0))
            if process.poll() is not None:
                break
            _kill(process)
            kills += 1
            landed[mode] += 1
            assert time.monotonic() > began
            assert crash_archive.wrong_rows(folder) == []
            assert crash_archive.visible_partial(folder, whole) == []
        result = bring_up_to_date(campaign)
        assert not result.has_failures
        assert crash_archive.products(folder) == whole
        assert crash_archive.wrong_rows(folder) == []
        assert bring_up_to_date(campaign).record is None
    assert min(landed.values()) >= min(3, KILLS // 10)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_gets_a_signal_finishes_its_scene_and_reports(
    tmp_path: Path, number: int
) -> None:
    campaign = crash_archive.make(tmp_path)
    process = crash_archive.start(tmp_path, "serial")
    while not list((tmp_path / "out").rglob("*.nc")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    process.wait(timeout=120)
    assert process.returncode == 128 + number
    assert crash_archive.wrong_rows(tmp_path) == []
    assert not [name for name in crash_archive.products(tmp_path) if name.endswith(".tmp")]
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        (run,) = store.runs()
        assert run.status is RunStatus.INTERRUPTED
        assert 0 < run.scenes < crash_archive.SCENES
        assert lock.holder() is None
    assert not bring_up_to_date(campaign).has_failures


def test_temporary_files_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    campaign = crash_archive.make(tmp_path, scenes=2)
    reprocess(campaign)
    product = next((tmp_path / "out/products").rglob("*.nc"))
    left = product.with_name(f".{product.name}.{NO_PROCESS}-abcd.tmp")
    left.write_bytes(b"half of a product")
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        with pytest.raises(CatalogError, match="held by"):
            reprocess(campaign)
        assert left.exists(), "another run may write it"
    assert reprocess(campaign) is None
    assert not left.exists(), "a run with nothing to do removes it"
    left.write_bytes(b"half of a product")
    product.unlink()
    reprocess(campaign)
    assert not left.exists()
    assert product.exists()


def test_temporary_files_that_another_campaign_may_write_stay(tmp_path: Path) -> None:
    campaign = crash_archive.make(tmp_path, scenes=2)
    reprocess(campaign)
    product = next((tmp_path / "out/products").rglob("*.nc"))
    left = product.with_name(f".{product.name}.{NO_PROCESS}-abcd.tmp")
    left.write_bytes(b"half of a product")
    with Store(campaign.catalog_url, "other") as store, Lock(store) as lock:
        lock.acquire()
        assert reprocess(campaign) is None
        product.unlink()
        assert reprocess(campaign) is not None
        assert left.exists(), "a run of another machine may write it"
        with Store(campaign.catalog_url, campaign.name) as own:
            assert not [file for file in verify_archive(campaign, own) if file.problem]
    assert reprocess(campaign) is None
    assert not left.exists()


def test_temporary_files_of_living_processes_stay(tmp_path: Path) -> None:
    """They may be of a campaign with another catalog."""
    campaign = crash_archive.make(tmp_path, scenes=2)
    reprocess(campaign)
    product = next((tmp_path / "out/products").rglob("*.nc"))
    with subprocess.Popen(["sleep", "60"]) as writer:
        files = [
            product.with_name(f".{product.name}.{number}-abcd.tmp")
            for number in (writer.pid, os.getpid())
        ]
        for file in files:
            file.write_bytes(b"half of a product")
        assert reprocess(campaign) is None
        product.unlink()
        assert reprocess(campaign) is not None
        assert all(file.exists() for file in files)
        writer.kill()
    os.utime(files[1], (0, 0))
    assert reprocess(campaign) is None
    assert not any(file.exists() for file in files), "also of an earlier process of this number"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Products of an undisturbed run over eight scenes."""
    folder = tmp_path_factory.mktemp("calm")
    reprocess(crash_archive.make(folder, scenes=8))
    return crash_archive.products(folder)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "after"), [("fsync", 3), ("replace", 2), ("fsync", 0)])
def test_a_disk_that_fills_up_is_reported_and_the_next_run_recovers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, str], name: str, after: int
) -> None:
    campaign = crash_archive.make(tmp_path, scenes=8)
    before, calls = getattr(os, name), count()

    def failing(*arguments: Any) -> None:
        if next(calls) >= after:
            raise OSError(errno.ENOSPC, "No space left on device")
        before(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, failing)
        assert crash_runs.run(tmp_path, "serial") == 1
    assert crash_archive.wrong_rows(tmp_path) == []
    assert crash_archive.visible_partial(tmp_path, whole) == []
    with Store(campaign.catalog_url, campaign.name) as store:
        assert all("No space left" in error for error in store.failures().values())
        assert store.failures()
        assert store.runs()[0].status is RunStatus.STOPPED
        assert store.runs()[0].scenes < 8
    assert not bring_up_to_date(campaign).has_failures
    assert crash_archive.products(tmp_path) == whole


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Path:
    """A file system of 400 kB; skip if this user may not mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("no right to mount a file system")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=False)


@pytest.mark.slow
def test_a_full_file_system_is_reported_and_nothing_is_damaged(
    tmp_path: Path, tiny_disk: Path
) -> None:
    campaign = crash_archive.make(tmp_path, scenes=8).model_copy(update={"output": str(tiny_disk)})
    # Either a product fails its scene, or the catalog needs the space first.
    with suppress(CatalogError):
        assert bring_up_to_date(campaign).has_failures
    for path in (tiny_disk / "products").rglob("*"):
        assert path.is_dir() or path.suffix == ".nc", path
    subprocess.run(["mount", "-o", "remount,size=60m", str(tiny_disk)], check=True)
    assert not bring_up_to_date(campaign).has_failures
    assert len(list((tiny_disk / "products").rglob("*.nc"))) == 24


@pytest.mark.slow
def test_a_target_that_cannot_be_written_is_reported(tmp_path: Path, tiny_disk: Path) -> None:
    campaign = crash_archive.make(tmp_path, scenes=2).model_copy(update={"output": str(tiny_disk)})
    subprocess.run(["mount", "-o", "remount,ro", str(tiny_disk)], check=True)
    with pytest.raises(CatalogError, match=r"read-only|unable to open"):
        bring_up_to_date(campaign)
    subprocess.run(["mount", "-o", "remount,rw,size=60m", str(tiny_disk)], check=True)
    assert not bring_up_to_date(campaign).has_failures


def test_a_second_run_is_refused_with_the_name_of_the_first(tmp_path: Path) -> None:
    campaign = crash_archive.make(tmp_path, scenes=1)
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        assert lock.acquire() is False
        with pytest.raises(CatalogError, match=f"process {os.getpid()}"):
            bring_up_to_date(campaign)
    assert bring_up_to_date(campaign, options=Options(wait=5.0)).record is not None
