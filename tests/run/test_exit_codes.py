"""Exit codes tell what is wrong with the archive from what does not serve."""

from __future__ import annotations

import errno
import os
import re
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import netCDF4
import pytest
import sqlalchemy as sa
from support.archives.small_archive import Archive
from typer.testing import CliRunner, Result

from lidarops.catalog import lock as lock_module
from lidarops.catalog.database import LOCK
from lidarops.catalog.lock import Lock
from lidarops.catalog.store import Store
from lidarops.cli import app

pytestmark = pytest.mark.usefixtures("quickly")
REFUSED, WRONG_USE, UNAVAILABLE = 1, 2, 3


def invoke(archive: Archive, command: str, *options: str) -> Result:
    archive.write()
    return CliRunner().invoke(app, [command, str(archive.file), *options])


@contextmanager
def refusing_database() -> Iterator[str]:
    """Yield the URL of a PostgreSQL that refuses every password."""
    fields = b"SFATAL\0VFATAL\0C28P01\0Mpassword authentication failed for user\0\0"

    def serve(server: socket.socket) -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                # Whoever asks for encryption is told that there is none, and asks again.
                while len(asked := connection.recv(4096)) == 8:
                    connection.sendall(b"N")
                if asked:
                    connection.sendall(b"E" + struct.pack("!I", 4 + len(fields)) + fields)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server,), daemon=True).start()
        yield f"postgresql+psycopg://user:wrong@127.0.0.1:{server.getsockname()[1]}/name"
        server.shutdown(socket.SHUT_RDWR)


def test_a_refused_file_is_told_from_wrong_use(archive: Archive) -> None:
    archive.raw("poor/h09", 630, seed=9).write_bytes(b"no raw file")
    assert invoke(archive, "reprocess").exit_code == REFUSED
    assert invoke(archive, "reprocess", "--nothing").exit_code == WRONG_USE


def test_a_dry_run_that_should_remove_is_wrong_use(archive: Archive) -> None:
    refused = invoke(archive, "reprocess", "--dry-run", "--remove-orphans")
    assert refused.exit_code == WRONG_USE
    assert "--remove-orphans" in refused.output


@pytest.mark.parametrize("content", [b"", b"no catalog " * 500])
def test_a_folder_whose_catalog_names_no_campaign_is_wrong_use(
    tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "catalog.sqlite").write_bytes(content)
    shown = CliRunner().invoke(app, ["plan", str(tmp_path)])
    assert shown.exit_code == WRONG_USE
    assert re.fullmatch(r"error: .*catalog\.sqlite: .* \(give a campaign file\)\n", shown.output)


@pytest.mark.parametrize("command", ["catalog", "plan", "reprocess", "runs"])
def test_a_dead_database_and_a_wrong_password_do_not_serve(archive: Archive, command: str) -> None:
    dead = invoke(archive, command, "--catalog", "postgresql+psycopg://user@127.0.0.1:1/name")
    with refusing_database() as url:
        refused = invoke(archive, command, "--catalog", url)
    assert (dead.exit_code, refused.exit_code) == (UNAVAILABLE, UNAVAILABLE)
    assert "password authentication failed" in refused.output


def test_a_disk_that_is_full_as_the_report_is_written_does_not_serve(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive.raw("poor/h09", 630, seed=9)

    def full(*_: object) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    result = invoke(archive, "reprocess")
    assert result.exit_code == UNAVAILABLE
    assert "No space left" in result.output


def _pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.csv")
    return "pipe.csv"


def _bomb(folder: Path) -> str:
    with netCDF4.Dataset(folder / "bomb.nc", "w") as file:
        file.createDimension("range", None)
        file.createVariable("range", "f8", "range", chunksizes=[2])[10**10 - 1] = 1.0
        file.createVariable("overlap", "f8", "range", chunksizes=[2])
    assert (folder / "bomb.nc").stat().st_size < 10_000
    return "bomb.nc"


@pytest.mark.parametrize(
    ("make", "words"), [(_pipe, "is no regular file"), (_bomb, "is larger than any")]
)
def test_an_ancillary_file_that_would_hang_or_fill_memory_is_named_and_the_others_are_made(
    archive: Archive, make: Callable[[Path], str], words: str
) -> None:
    name = make(archive.folder)
    for facts in archive.tree["instruments"]["rich"]["facts"]:
        facts["overlap_profile"] = name
    archive.raw("poor/h09", 630, seed=9)
    for command in ("plan", "reprocess"):
        result = invoke(archive, command)
        assert result.exit_code == REFUSED
        shown = " ".join(result.output.replace("\u2502", " ").split())
        assert name in shown
        assert words in shown
    assert "of poor: 1 product" in result.output


def test_the_codes_are_in_one_table(repository: Path) -> None:
    pages = [
        page for page in (repository / "docs").rglob("*.md") if "| exit code" in page.read_text()
    ]
    (page,) = pages
    codes = re.findall(r"^\| (\d) \|", page.read_text(), re.MULTILINE)
    assert codes == ["0", "1", "2", "3"]


def test_a_dead_holder_whose_clock_was_a_day_ahead_is_shown_and_overtaken(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lost:
        lost.acquire()
        lost._stop.set()
        with store.transaction() as connection:
            ahead = {"machine": "container", "heartbeat": LOCK.c.heartbeat + 86_400.0}
            connection.execute(sa.update(LOCK).values(ahead))
        assert "The catalog is held by" in invoke(archive, "runs").output
        archive.raw("poor/h09", 630, seed=9)
        assert invoke(archive, "catalog").exit_code == UNAVAILABLE
        monkeypatch.setattr(lock_module, "SILENCE", 1.0)
        assert invoke(archive, "catalog", "--wait", "20").exit_code == 0


@pytest.mark.parametrize("command", ["plan", "verify", "runs"])
def test_a_folder_that_cannot_be_read_is_told_in_a_line(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    archive.write()

    def broken(path: Path) -> NoReturn:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "is_file", broken)
        result = CliRunner().invoke(app, [command, str(archive.folder)])
    assert result.exit_code == UNAVAILABLE
    assert "campaign.yaml: Input/output error" in result.output
    assert isinstance(result.exception, SystemExit)
