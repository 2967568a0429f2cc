"""Fixtures of the deployment tests."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.servers.loopback import free_port

POSTGRES = Path("/usr/lib/postgresql")


@pytest.fixture
def postgresql() -> Iterator[str]:
    """A PostgreSQL on loopback; gives ``USER:PASSWORD@HOST:PORT/NAME``."""
    programs = sorted(POSTGRES.glob("*/bin"))
    if not programs or os.geteuid() != 0 or shutil.which("runuser") is None:
        pytest.skip("needs PostgreSQL's binaries, and root to become the user postgres")
    port = free_port()
    # pytest's own folders are closed to the user postgres.
    folder = Path(tempfile.mkdtemp(prefix="lidarops-postgresql-"))
    shutil.chown(folder, "postgres", "postgres")
    secret = folder / "password"
    password = secrets.token_hex(8)
    secret.write_text(password)
    shutil.chown(secret, "postgres")

    def run(program: str, *arguments: str) -> None:
        subprocess.run(
            ["runuser", "-u", "postgres", "--", str(programs[-1] / program), *arguments],
            check=True,
            stdout=subprocess.DEVNULL,
            cwd=folder,
            timeout=120,
        )

    data = str(folder / "data")
    run("initdb", "-D", data, "--auth=scram-sha-256", f"--pwfile={secret}", "--no-sync")
    options = f"-c listen_addresses=127.0.0.1 -p {port} -c unix_socket_directories={folder}"
    try:
        run("pg_ctl", "-D", data, "-w", "-l", str(folder / "log"), "-o", options, "start")
        yield f"postgres:{password}@127.0.0.1:{port}/postgres"
    finally:
        run("pg_ctl", "-D", data, "-w", "-m", "immediate", "stop")
        shutil.rmtree(folder, ignore_errors=True)
