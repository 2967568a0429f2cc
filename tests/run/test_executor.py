"""Processing many scenes: the same on workers; no scene stops others; each entered as it ends."""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import httpx
import pytest
from distributed import Client, Nanny
from distributed.core import Status
from distributed.deploy.spec import SpecCluster
from support.archives.scene_jobs import scene_jobs
from support.archives.small_archive import Archive
from support.poison import HALF, Poison, Sleep

from lidarops.catalog.store import RunStatus, Store
from lidarops.records import SceneOutcome
from lidarops.run import executor
from lidarops.run.archive import Options, Selection, bring_up_to_date, reprocess
from lidarops.run.clusters import ClusterError, local_client
from lidarops.run.executor import (
    EndedScene,
    StopRequest,
    process_jobs,
)
from lidarops.run.staleness import Judge
from lidarops.scene.job import Failure, Job


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """A client of two local workers."""
    with local_client(2) as started:
        yield started


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """A small archive."""
    return Archive(tmp_path, days=2)


@pytest.mark.parametrize("page", ["json/identity.json", "info/main/workers.html"])
def test_a_scheduler_has_no_pages_for_other_users(client: Client, page: str) -> None:
    address = f"http://127.0.0.1:{client.cluster.scheduler.http_server.port}/{page}"
    assert httpx.get(address).status_code == 404


def test_a_signal_while_workers_start_leaves_no_cluster_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise Python closes the cluster at exit, with tracebacks."""
    start = Nanny.instantiate

    async def interrupted(nanny: Nanny) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        return await start(nanny)

    monkeypatch.setattr(Nanny, "instantiate", interrupted)
    others = set(SpecCluster._instances)
    with StopRequest() as stop:
        with stop.idle(), local_client(1):
            raise AssertionError
        assert stop.signal == signal.SIGINT
    left = set(SpecCluster._instances) - others
    assert not [each for each in left if each.status is not Status.closed]


def test_a_file_that_vanishes_after_the_scan_is_refused(archive: Archive) -> None:
    campaign = archive.write()

    def remove_file(_granules: int) -> None:
        (archive.folder / "raw/poor/h10").unlink(missing_ok=True)

    selection = Selection(instruments=("poor",))
    record = reprocess(campaign, selection=selection, options=Options(expect=remove_file))
    (granule,) = (granule for outcome in record.scenes for granule in outcome.refused)
    assert granule.path == "poor/h10"
    assert granule.reason.startswith("cannot be read: vanished after it was catalogued")


@pytest.mark.slow
def test_a_scene_that_kills_its_worker_is_refused_by_name(
    archive: Archive, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = logging.getLogger("distributed.scheduler").level
    # The loggers of dask do not propagate.
    monkeypatch.setattr(logging.getLogger("distributed"), "handlers", [caplog.handler])
    campaign = archive.write()
    scene = "rich_20260302T000000"
    # A separate cluster, because dask may lose workers that it restarts.
    with local_client(2) as client:
        client.register_plugin(Poison(scene))
        result = bring_up_to_date(campaign, options=Options(cluster=lambda: nullcontext(client)))
    assert set(result.failures) == {scene}
    assert "died 3 times" in result.failures[scene]
    assert "its worker died" in caplog.text
    assert not (campaign.products_root / HALF).exists()
    # lidarops tried the scene again; it had not failed yet.
    assert "marked as failed" not in caplog.text
    assert logging.getLogger("distributed.scheduler").level == before
    others = {outcome.scene for outcome in result.record.scenes if not outcome.error}
    assert others == {"rich_20260301T000000", "poor_20260301T000000", "poor_20260302T000000"}
    assert bring_up_to_date(campaign).record is None
    forced = Selection(instruments=("rich",))
    healed = bring_up_to_date(campaign, selection=forced, options=Options(force=True))
    assert not healed.failures


@pytest.mark.slow
def test_the_pages_of_dask_are_served_to_this_machine_where_they_are_asked_for(
    archive: Archive,
) -> None:
    told: list[str] = []
    pages: list[bytes] = []

    def look(_: SceneOutcome) -> None:
        address = told[0].removeprefix("dashboard: ")
        pages.append(httpx.get(address).content)

    options = Options(dashboard=told.append, progress=look)
    assert bring_up_to_date(archive.write(), options=options).record is not None
    assert len(told) == 1
    assert told[0].startswith("dashboard: http://127.0.0.1:")
    assert b"Dask" in pages[0]


@pytest.mark.slow
def test_a_scene_that_hangs_is_ended_and_tried_once_more(archive: Archive) -> None:
    archive.tree["scenes"] = {"time_limit": "8 s"}
    campaign = archive.write()
    scene = "rich_20260302T000000"
    with local_client(2) as client:
        client.register_plugin(Sleep(scene))
        begin = time.monotonic()
        result = bring_up_to_date(campaign, options=Options(cluster=lambda: nullcontext(client)))
        assert time.monotonic() - begin < 60.0
    assert set(result.failures) == {scene}
    assert "takes longer than 8 s" in result.failures[scene]
    assert sum(not outcome.error for outcome in result.record.scenes) == 3
    assert not bring_up_to_date(campaign).failures


def test_the_time_limit_of_a_scene_grows_with_its_files(archive: Archive) -> None:
    job = scene_jobs(archive.write())[0]
    size = sum(file.size for file in (*job.scene.granules, *job.scene.dark))
    assert executor.time_limit(job) == pytest.approx(600.0 + 2e-6 * size)


@pytest.mark.parametrize(
    "crashed", [pytest.param(1, id="one"), pytest.param(4, id="all", marks=pytest.mark.slow)]
)
def test_scenes_that_killed_their_process_are_tried_in_another(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, crashed: int
) -> None:
    campaign = archive.write()
    with monkeypatch.context() as patch:
        # The next run leaves the suspect for later, and dies within another scene.
        patch.setattr(executor, "attempt", lambda _job: sys.exit("dies within a scene"))
        for _ in range(crashed):
            with pytest.raises(SystemExit):
                bring_up_to_date(campaign)
    with Store(campaign.catalog_url, campaign.name) as store:
        again = Judge(campaign, store)
        judgements = again.days(sorted(again.signatures())).judgements
        assert len([each for each in judgements if each.suspect]) == crashed
    result = bring_up_to_date(campaign)
    assert [scene.error for scene in result.record.scenes] == [""] * 4
    assert result.status is RunStatus.FINISHED
    assert bring_up_to_date(campaign).record is None
    with Store(campaign.catalog_url, campaign.name) as store:
        assert [run.status.value for run in store.runs()] == ["finished", *["died"] * crashed]


def test_jobs_are_consumed_one_by_one(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = scene_jobs(archive.write()) * 50
    taken = 0

    def counted() -> Iterator[Job]:
        nonlocal taken
        for job in jobs:
            taken += 1
            yield job

    monkeypatch.setattr(
        executor, "attempt", lambda job: (Failure("no").outcome(job.scene, job.plan), True)
    )
    ended: list[EndedScene] = []
    for each in process_jobs(counted()):
        ended.append(each)
        assert taken == len(ended)
    assert len(ended) == len(jobs)


def test_a_cluster_gets_a_few_scenes_at_a_time_whatever_their_number(
    archive: Archive, client: Client
) -> None:
    jobs = scene_jobs(archive.write()) * 4
    at_hand = most = done = 0

    def took(_job: Job) -> None:
        nonlocal at_hand, most
        at_hand += 1
        most = max(most, at_hand)

    for _ in process_jobs(jobs, client=client, taken=took):
        at_hand -= 1
        done += 1
    assert done == len(jobs)
    assert most <= executor.LEAST_SCENES_AHEAD + 1


def test_lost_local_workers_are_not_waited_for(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = archive.write()
    jobs = scene_jobs(campaign)
    with local_client(1) as client:
        # Only now, because the first worker may take longer to start.
        monkeypatch.setattr(executor, "WORKER_TIMEOUT", 1.0)
        monkeypatch.setattr(executor, "RECOUNT_INTERVAL", 0.5)
        client.retire_workers()
        with pytest.raises(ClusterError, match="workers on this machine are gone"):
            list(process_jobs(jobs, client=client))
        with pytest.raises(ClusterError, match="workers on this machine are gone"):
            list(process_jobs(jobs, client=client, alone=True))


class GrowingCluster:
    """A cluster whose workers join later, and that ends no scene before eight have started."""

    def __init__(self) -> None:
        self.calls = 0
        self.open = False
        self.submitted: list[Callable[[], None]] = []

    def nthreads(self) -> dict[str, int]:
        self.calls += 1
        assert self.calls < 60, "no scene was handed on to the workers that came"
        return {} if self.calls == 1 else {"worker": 4}

    def begin(self, end: Callable[[], None]) -> None:
        self.submitted.append(end)
        self.open = self.open or len(self.submitted) == 8
        while self.open and self.submitted:
            self.submitted.pop()()


class SubmittedScene:
    """A scene that was submitted to the cluster."""

    def __init__(self, cluster: GrowingCluster, _job: Job) -> None:
        self.cluster = cluster

    def add_done_callback(self, callback: Callable[[SubmittedScene], None]) -> None:
        self.cluster.begin(lambda: callback(self))

    def release(self) -> None:
        """Do nothing."""


def test_workers_that_join_later_get_scenes_before_any_has_ended(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "RECOUNT_INTERVAL", 0.0)
    monkeypatch.setattr(executor, "_submit", SubmittedScene)
    monkeypatch.setattr(
        executor,
        "_outcome_of",
        lambda _, job: EndedScene.failed(Failure("no"), job.scene, job.plan),
    )
    jobs = scene_jobs(archive.write()) * 4
    assert len(list(process_jobs(jobs, client=GrowingCluster()))) == len(jobs)


def test_a_worker_with_other_code_makes_nothing(
    archive: Archive, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "joint_code_version", lambda: "newer")
    campaign = archive.write()
    ended = list(process_jobs(scene_jobs(campaign)[:1], client=client))
    assert [each.final for each in ended] == [False]
    assert "the worker has other code of lidarops" in ended[0].outcome.error
    assert not (archive.folder / "out" / "products").exists()


def test_a_request_to_stop_leaves_the_remaining_scenes_for_the_next_run(archive: Archive) -> None:
    campaign = archive.write()
    stop = StopRequest()
    ended = []
    for each in process_jobs(scene_jobs(campaign), stop=stop):
        ended.append(each)
        stop.now("enough")
    assert len(ended) == 1


def test_every_scene_is_entered_as_it_ends(archive: Archive) -> None:
    campaign = archive.write()
    entered = []

    def look(_outcome: object) -> None:
        with Store(campaign.catalog_url, campaign.name) as store:
            entered.append((len({row["scene"] for row in store.products()}), store.runs()[0]))

    reprocess(campaign, options=Options(progress=look))
    assert [number for number, _ in entered] == [1, 2, 3, 4]
    assert [run.scenes for _, run in entered] == [1, 2, 3, 4]
    assert {run.status.value for _, run in entered} == {"running"}
    assert {"digest", "retrieve", "write"} <= set(entered[-1][1].seconds)


def test_a_suspect_scene_waits_for_a_running_worker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waited: list[float] = []
    counted = iter([{}, {}, {"tcp://worker": 1}])

    class Cluster:
        def nthreads(self) -> dict[str, int]:
            return next(counted)

    monkeypatch.setattr(executor.time, "sleep", waited.append)
    executor._Workers(Cluster()).ready(StopRequest())
    assert not list(counted)
    assert waited[-1] == executor.START_DELAY
