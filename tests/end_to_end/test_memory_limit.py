"""A memory limit: chunks shrink to fit it, products stay the same, and too large scenes end."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from support.archives.scene_jobs import scene_jobs
from support.archives.small_archive import Archive, made
from support.counts_read import counts_read
from typer.testing import CliRunner

from benchmarks.throughput import memory as peaks
from lidarops.cli.app import app
from lidarops.errors import SceneError
from lidarops.run.archive import Options, reprocess
from lidarops.run.clusters import local_client
from lidarops.run.executor import USABLE, fitted
from lidarops.scene.job import PROCESS, Job, SceneMemory, scene_memory


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """A small archive."""
    return Archive(tmp_path, days=1)


@pytest.fixture
def job(archive: Archive) -> Job:
    """Its largest scene."""
    campaign = archive.write()
    return max(scene_jobs(campaign), key=lambda job: len(job.scene.granules))


def _limit(job: Job, profiles: int) -> int:
    """Return the least limit within which a chunk of some profiles fits."""
    return int(scene_memory(job.scene, job.plan).of(profiles) / USABLE) + 1


def test_chunks_follow_the_limit(job: Job) -> None:
    sizes = [fitted(job, _limit(job, number)).profiles_per_chunk for number in (1, 2)]
    assert sizes == [1, 2]
    assert fitted(job, None) is job
    assert fitted(job, 10 * PROCESS) is job


def test_a_requested_chunk_overrides_the_limit(job: Job) -> None:
    requested = replace(job, profiles_per_chunk=5)
    assert fitted(requested, 1) is requested


def test_a_scene_that_cannot_fit_is_refused_with_a_remedy(job: Job) -> None:
    with pytest.raises(SceneError, match="even with one profile in a chunk") as caught:
        fitted(job, 100_000_000)
    message = str(caught.value)
    for words in ("--memory-limit", "window", "averaging", "--profiles-per-chunk 1", "100 MB"):
        assert words in message


def test_what_products_hold_leaves_less_for_chunks() -> None:
    free = SceneMemory(held=0.0, profile=64_000.0, profiles=5000)
    full = replace(free, held=100e6)
    assert free.total < full.total
    limit = PROCESS + 110e6
    assert free.profiles_within(limit) > full.profiles_within(limit) > 0
    assert full.profiles_within(PROCESS + 100e6) == 0
    assert full.of(full.profiles_within(limit)) <= limit


def test_products_are_the_same_within_a_limit(archive: Archive) -> None:
    campaign = archive.write()
    limit = max(_limit(job, 1) for job in scene_jobs(campaign))
    free = reprocess(campaign.model_copy(update={"output": str(archive.folder / "free")}))
    options = Options(memory=f"{limit}B")
    tight = reprocess(campaign, options=options)
    assert tight is not None
    assert not [scene.error for scene in tight.scenes if "memory" in scene.error]
    assert made(free) == made(tight)
    assert archive.contents("free/products") == archive.contents("out/products")


def test_a_refused_scene_is_tried_again_with_a_larger_limit(archive: Archive) -> None:
    campaign = archive.write()
    with counts_read() as sizes:
        refused = reprocess(campaign, options=Options(memory="100MB"))
    assert refused is not None
    assert refused.scenes
    assert all("raise --memory-limit" in scene.error for scene in refused.scenes)
    assert not sizes
    again = reprocess(campaign)
    assert again is not None
    assert any(scene.products for scene in again.scenes)


def test_workers_refuse_by_their_own_limit(archive: Archive) -> None:
    campaign = archive.write()
    with local_client(1, memory="400MiB") as client:
        record = reprocess(campaign, options=Options(cluster=lambda: nullcontext(client)))
    assert record is not None
    assert record.scenes
    assert all("the limit of the workers" in scene.error for scene in record.scenes)


def test_the_plan_states_the_memory_of_each_scene(archive: Archive) -> None:
    archive.write()
    command = ["plan", str(archive.file)]
    scenes = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)["scenes"]
    needs = [scene["estimated_memory_bytes"]["everything"] for scene in scenes]
    assert needs
    assert all(PROCESS <= size < 2 * PROCESS for size in needs)
    assert "MB of memory" in CliRunner().invoke(app, command).output


@pytest.mark.slow
def test_the_memory_of_a_process_does_not_grow_with_its_scene() -> None:
    """A whole scene in memory took ten times its counts: 400 MB above the base."""
    small, large = peaks.measure_peaks([10, 40], ["signal"])
    assert large.above < 150
    assert large.above - small.above < 60


@pytest.mark.slow
def test_a_worker_of_700_mib_processes_a_scene_of_101_mb(tmp_path: Path) -> None:
    campaign = peaks.campaign_of(
        tmp_path / "raw", "signal, homogeneous and elastic", tmp_path / "out"
    )
    peaks.write_files(tmp_path / "raw", 101)
    with local_client(1, memory="700MiB") as client:
        record = reprocess(campaign, options=Options(cluster=lambda: nullcontext(client)))
    assert record is not None
    assert [scene.error for scene in record.scenes] == [""]
    assert {product.kind for product in record.scenes[0].products} == {
        "signal",
        "homogeneous",
        "elastic",
    }
