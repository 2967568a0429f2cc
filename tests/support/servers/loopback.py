"""Servers for the deployment tests: on loopback, in temporary folders, always stopped."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from support.servers.ports import free_port

REPOSITORY = Path(__file__).parents[3]


def wait_until(
    condition: Callable[[], bool], seconds: float, problem: str, *, every: float = 0.5
) -> float:
    """Wait for a condition; return the time in s that it took."""
    started = time.monotonic()
    while not condition():
        if time.monotonic() - started > seconds:
            raise AssertionError(f"{problem} within {seconds:.0f} s")
        time.sleep(every)
    return time.monotonic() - started


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def descendants(process: int) -> list[int]:
    """Return all descendants of a process."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    processes, queue = [], [process]
    while queue:
        children = parents.get(queue.pop(), [])
        processes += children
        queue += children
    return processes


def kill_tree(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and its descendants as a power failure would."""
    victims = [process.pid, *descendants(process.pid)]
    for victim in victims:
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            continue
    process.wait()


@dataclass
class Site:
    """A folder and settings for a Prefect server, workers and maintenance."""

    folder: Path
    environment: dict[str, str]
    port: int
    _running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        log = (self.folder / f"{name}.log").open("ab")
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            cwd=REPOSITORY,
            env=self.environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        log.close()
        self._running.append(process)
        return process

    def call(self, *arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, "-m", *arguments],
            cwd=REPOSITORY,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def stop(self) -> None:
        for process in reversed(self._running):
            kill_tree(process)


@contextmanager
def prefect_site(folder: Path, **settings: str) -> Iterator[Site]:
    """Start a Prefect server on loopback that requires a password."""
    port = free_port()
    password = f"operator:{secrets.token_hex(8)}"
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment = kept | {
        "PREFECT_HOME": str(folder / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_API_AUTH_STRING": password,
        "PREFECT_API_AUTH_STRING": password,
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_SERVICES_SCHEDULER_LOOP_SECONDS": "5",
        "PREFECT_SERVER_SERVICES_SCHEDULER_DEPLOYMENT_BATCH_SIZE": "100",
        "PREFECT_SERVER_DEPLOYMENTS_CONCURRENCY_SLOT_WAIT_SECONDS": "10",
        "PREFECT_WORKER_QUERY_SECONDS": "2",
        "PREFECT_WORKER_PREFETCH_SECONDS": "2",
        "PREFECT_CLI_COLORS": "false",
        "DO_NOT_TRACK": "1",
        "OMP_NUM_THREADS": "1",
        **settings,
    }
    site = Site(folder, environment, port)
    try:
        server = site.start(
            "server", "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port)
        )
        wait_until(
            lambda: listens(port) or server.poll() is not None, 180, "the server does not listen"
        )
        assert server.poll() is None, (folder / "server.log").read_text()
        yield site
    finally:
        site.stop()
