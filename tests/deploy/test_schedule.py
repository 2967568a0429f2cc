"""The schedule of deploy/prefect.yaml runs, and a dead worker cannot block it."""

from __future__ import annotations

import http.server
import os
import re
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

import httpx
import pytest
import yaml
from support import factories
from support.archives import raw_archives
from support.pages import blocks
from support.servers import loopback
from support.servers.ports import free_port

from flows import WITH_FAILURES, notifications

pytestmark = [pytest.mark.deployment, pytest.mark.timeout(900)]


class Api:
    """The requests of the tests to a Prefect server."""

    def __init__(self, site: loopback.Site) -> None:
        user, _, password = site.environment["PREFECT_API_AUTH_STRING"].partition(":")
        self._client = httpx.Client(
            base_url=site.environment["PREFECT_API_URL"], auth=(user, password), timeout=60
        )

    def runs(self, *states: str) -> list[dict[str, Any]]:
        query: dict[str, Any] = {"sort": "START_TIME_DESC"}
        query["flow_runs"] = {"state": {"type": {"any_": list(states)}}}
        answer = self._client.post("/flow_runs/filter", json=query)
        return list(answer.raise_for_status().json())

    def pools(self) -> set[str]:
        answer = self._client.post("/work_pools/filter", json={})
        return {each["name"] for each in answer.raise_for_status().json()}

    def ended(self, deployment: str, state: str) -> None:
        """Let a run of a nightly deployment end at once in a state."""
        tags = {"tags": ["lidarops", "nightly"]}
        flow = self._client.post("/flows/", json={"name": "stand-in"}).raise_for_status().json()
        made = {"name": deployment, "flow_id": flow["id"], **tags}
        id_ = self._client.post("/deployments/", json=made).raise_for_status().json()["id"]
        run = self._client.post(f"/deployments/{id_}/create_flow_run", json=tags)
        path = f"/flow_runs/{run.raise_for_status().json()['id']}/set_state"
        type_ = "FAILED" if state == "Failed" else "COMPLETED"
        for each in ({"type": "RUNNING"}, {"type": type_, "name": state}):
            self._client.post(path, json={"state": each, "force": True}).raise_for_status()

    def hasten(self, automation: str, within: float) -> None:
        """Let an automation wait for so many seconds only."""
        known = self._client.post("/automations/filter", json={}).raise_for_status().json()
        (found,) = [each for each in known if each["name"] == automation]
        found["trigger"]["within"] = within
        kept = ("name", "description", "enabled", "trigger", "actions", "tags")
        changed = {name: found[name] for name in kept if name in found}
        self._client.put(f"/automations/{found['id']}", json=changed).raise_for_status()

    def artifacts(self) -> set[str]:
        answer = self._client.post("/artifacts/filter", json={})
        return {each["type"] for each in answer.raise_for_status().json()}


def campaign_file(folder: Path) -> Path:
    for minute in range(3):
        content = raw_archives.content(minute, bins=1000)
        raw_archives.write(folder / "raw" / "coast" / f"h{minute}", content)
    path = folder / "campaign.yaml"
    campaign = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    path.write_text(yaml.safe_dump(campaign))
    return path


class Sink(http.server.BaseHTTPRequestHandler):
    """A web hook that keeps the posted messages."""

    posted: ClassVar[list[str]] = []

    def do_POST(self) -> None:
        self.posted.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
        self.send_response(200)
        self.end_headers()

    def log_message(self, *args: object) -> None:
        """Do not log."""


def notified(problem: str) -> bool:
    return any("lidarops: a run failed" in each and problem in each for each in Sink.posted)


def schedule(site: loopback.Site, api: Api) -> subprocess.Popen[bytes]:
    """Deploy the file with a 45 s schedule and the campaign of the test; start a worker.

    The worker makes the pool while the file is read: each takes ten seconds to start.
    """
    shipped = yaml.safe_load((loopback.REPOSITORY / "deploy" / "prefect.yaml").read_text())
    file = str(campaign_file(site.folder))
    for deployment in shipped["deployments"]:
        if "campaign" in deployment.get("parameters", {}):
            deployment["parameters"] |= {"campaign": file, "workers": 1}
        deployment.pop("schedules", None)
        if deployment["name"] == "demo-nightly":
            deployment["schedules"] = [{"interval": 45}]
    described = site.folder / "prefect.yaml"
    described.write_text(yaml.safe_dump(shipped))
    worker = work(site, "first")
    loopback.wait_until(lambda: "lidarops" in api.pools(), 120, "the worker made no pool")
    site.call("prefect", "--no-prompt", "deploy", "--all", "--prefect-file", str(described))
    return worker


def work(site: loopback.Site, name: str) -> subprocess.Popen[bytes]:
    pool = ("--pool", "lidarops", "--type", "process", "--limit", "4")
    return site.start(name, "prefect", "worker", "start", *pool, "--name", name)


SILENCE = 60.0
"""s without heartbeat after which maintenance ends a run in these tests."""
RECOVERY = 120.0
"""s from then within which the next run must be completed."""


def scheduled_run_starts_and_dead_run_is_ended(
    site: loopback.Site, record_testsuite_property: Any
) -> None:
    refused = httpx.post(site.environment["PREFECT_API_URL"] + "/flow_runs/filter", json={})
    assert refused.status_code == 401
    api = Api(site)
    worker = schedule(site, api)
    loopback.wait_until(lambda: bool(api.runs("RUNNING")), 240, "no run started", every=0.1)
    dead_run = api.runs("RUNNING")[0]
    loopback.kill_tree(worker)
    killed = time.monotonic()
    site.start("reaper", "flows.maintenance", "--every", "5", "--silence", f"{SILENCE:.0f}")
    work(site, "second")
    time.sleep(5)
    assert [run["id"] for run in api.runs("RUNNING")] == [dead_run["id"]]
    loopback.wait_until(
        lambda: dead_run["id"] in {run["id"] for run in api.runs("CRASHED")}, 150, "not reaped"
    )
    reaped = time.monotonic() - killed

    def completed_later() -> bool:
        return any(run["start_time"] > dead_run["start_time"] for run in api.runs("COMPLETED"))

    # It was alive when it was killed, so it is ended after the silence at the latest.
    left = SILENCE + RECOVERY - reaped
    loopback.wait_until(completed_later, left, "no later run completed")
    completed = time.monotonic() - killed
    done = api.runs("COMPLETED")[-1]
    assert done["auto_scheduled"]
    assert done["name"].startswith("campaign-incremental-")
    assert {"table", "progress", "markdown", "image"} <= api.artifacts()
    assert list((site.folder / "out" / "products").rglob("*.nc"))
    record_testsuite_property(f"{site.folder.name} reaped_after", round(reaped))
    record_testsuite_property(f"{site.folder.name} next_run_completed_after", round(completed))


def test_the_block_of_the_page_starts_a_schedule(tmp_path: Path) -> None:
    """As pasted, on a machine without profile of Prefect; only the port is another one."""
    page = loopback.REPOSITORY / "docs" / "howto" / "schedule.md"
    block = next(blocks(page)).text.replace("4200", str(free_port()))
    # What stays goes on in the background, as in a terminal of its own.
    block = re.sub(r"#\s+stays", "> ${PREFECT_HOME}/$((++n)).log 2>&1 & pids+=($!)", block)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    script = f"""set -euo pipefail
    n=0 pids=()
    trap 'kill "${{pids[@]}}"; .venv/bin/prefect server stop' EXIT
    {block}
    for try in {{1..120}}; do
        .venv/bin/prefect work-pool inspect lidarops | grep -q READY && break
        sleep 1
    done
    .venv/bin/prefect deployment inspect lidarops-reprocess/demo-nightly > /dev/null
    test "$(jobs -r | wc -l)" = 2
    .venv/bin/prefect work-pool inspect lidarops | grep READY"""
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=loopback.REPOSITORY,
        env=kept | {"PREFECT_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_on_sqlite(tmp_path: Path, record_testsuite_property: Any) -> None:
    """Notifications of failed runs are sent, too."""
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), Sink) as sink,
        loopback.prefect_site(tmp_path) as site,
    ):
        threading.Thread(target=sink.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{sink.server_port}/hook"
        for line in ("new: lidarops: a run failed", ""):
            said = site.call("flows.notifications", url)
            assert line in said
        scheduled_run_starts_and_dead_run_is_ended(site, record_testsuite_property)
        (site.folder / "campaign.yaml").unlink()
        # Prefect needs minutes to activate automations: the first failure may not be reported.
        loopback.wait_until(lambda: notified("cannot be read"), 300, "no notification")
        sink.shutdown()


def test_on_postgresql(tmp_path: Path, postgresql: str, record_testsuite_property: Any) -> None:
    pytest.importorskip("asyncpg")
    pytest.importorskip("psycopg")
    urls = {
        "PREFECT_SERVER_DATABASE_CONNECTION_URL": f"postgresql+asyncpg://{postgresql}",
        "LIDAROPS_CATALOG": f"postgresql+psycopg://{postgresql}",
    }
    with loopback.prefect_site(tmp_path, **urls) as site:
        scheduled_run_starts_and_dead_run_is_ended(site, record_testsuite_property)
        assert not (tmp_path / "prefect" / "prefect.db").exists()


def test_an_archive_that_stops_is_reported_though_another_runs_and_each_end_with_failures(
    tmp_path: Path,
) -> None:
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), Sink) as sink,
        loopback.prefect_site(tmp_path) as site,
    ):
        threading.Thread(target=sink.serve_forever, daemon=True).start()
        site.call("flows.notifications", f"http://127.0.0.1:{sink.server_port}/", "--failures")
        api = Api(site)
        api.hasten(notifications.ABSENT, 30.0)

        def told(subject: str) -> list[str]:
            return [each for each in Sink.posted if subject in each]

        def both_run() -> bool:
            for name in ("runs on", "stops"):
                api.ended(name, "Completed")
            api.ended("runs on", WITH_FAILURES)
            return bool(told(notifications.COMPLETED_WITH_FAILURES))

        loopback.wait_until(both_run, 400, "the automations were not activated", every=5.0)
        Sink.posted.clear()
        both_run()
        for _ in range(20):
            api.ended("runs on", WITH_FAILURES)
            time.sleep(4.0)
        loopback.wait_until(lambda: bool(told(notifications.ABSENT)), 60, "no alarm")
        (alarm,) = told(notifications.ABSENT)
        assert "stops completed no run" in alarm
        loopback.wait_until(
            lambda: len(told(notifications.COMPLETED_WITH_FAILURES)) >= 21, 60, "one was lost"
        )
        sink.shutdown()
