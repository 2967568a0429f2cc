"""An archive that cannot be written is read, and commands that only look leave nothing behind."""

from __future__ import annotations

import json
import shutil
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from support.archives.small_archive import Archive
from typer.testing import CliRunner

from lidarops.campaign.model import load_campaign
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.run.archive import reprocess


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Archive:
    """An archive of one day with signal products only."""
    archive = Archive(tmp_path_factory.mktemp("made"), days=1)
    del archive.tree["instruments"]["rich"]
    reprocess(archive.write())
    return archive


@pytest.fixture
def read_only(made: Archive, tmp_path: Path) -> Iterator[Archive]:
    """A copy on a read-only file system; skip if this user may not mount one."""
    place = tmp_path / "mounted"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("no right to mount a file system")
    shutil.copytree(made.folder, place / "archive")
    yield Archive(place / "archive")
    subprocess.run(["umount", "--lazy", str(place)], check=False)


def _closed(archive: Archive) -> None:
    command = ["mount", "-o", "remount,ro", str(archive.folder.parent)]
    subprocess.run(command, check=True)


def _run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert isinstance(result.exception, SystemExit | None), result.exception
    return result.exit_code, result.output


@pytest.mark.parametrize("journal", [False, True])
def test_an_archive_that_cannot_be_written_is_verified_and_planned(
    read_only: Archive, *, journal: bool
) -> None:
    catalog = read_only.folder / "out/catalog.sqlite"
    holder = sqlite3.connect(catalog)
    if journal:
        # What a killed process leaves: rows that are only in the journal.
        holder.execute("update run set version = 'of the journal'")
        holder.commit()
        copy = {name: Path(f"{catalog}{name}").read_bytes() for name in ("", "-wal")}
        holder.close()
        for name, content in copy.items():
            Path(f"{catalog}{name}").write_bytes(content)
    holder.close()
    _closed(read_only)
    code, output = _run("verify", read_only.file, "--json")
    assert (code, json.loads(output)["mismatches"]) == (0, [])
    code, output = _run("runs", read_only.file, "--json")
    assert (json.loads(output)[0]["version"] == "of the journal") is journal
    code, output = _run("plan", read_only.file, "--json")
    assert (code, [scene["fresh"] for scene in json.loads(output)["scenes"]]) == (0, [2])


def test_a_catalog_is_read_beside_its_living_writer(read_only: Archive, tmp_path: Path) -> None:
    """A user who may read the folder sees what another one writes now."""
    (tmp_path / "readable").mkdir()
    command = ["mount", "--bind", read_only.folder.parent, tmp_path / "readable"]
    subprocess.run(command, check=True)
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", tmp_path / "readable"], check=True)
        _read_beside_a_writer(read_only, Archive(tmp_path / "readable/archive"))
    finally:
        subprocess.run(["umount", "--lazy", tmp_path / "readable"], check=False)


def _read_beside_a_writer(own: Archive, readable: Archive) -> None:
    campaign = load_campaign(readable.file)
    with closing(sqlite3.connect(own.folder / "out/catalog.sqlite")) as writer:
        writer.execute("select * from run").fetchall()
        with Store(campaign.catalog_url, campaign.name, create=False) as store:
            before = store.runs()[0].version
            writer.execute("update run set version = 'written since'")
            writer.commit()
            assert store.runs()[0].version == "written since" != before
            writer.execute("update run set version = 'checkpointed'")
            writer.commit()
            writer.execute("pragma wal_checkpoint(truncate)")
            assert store.runs()[0].version == "checkpointed"
        code, output = _run("runs", readable.file, "--json")
        assert (code, json.loads(output)[0]["version"]) == (0, "checkpointed")


def test_a_journal_that_goes_while_it_is_copied_is_needed_no_more(
    made: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(made.folder, tmp_path / "archive")
    archive = Archive(tmp_path / "archive")
    journal = archive.folder / "out/catalog.sqlite-wal"
    journal.write_bytes(b"rows")
    copy = shutil.copy

    def close_first(source: Path, target: str) -> object:
        journal.unlink(missing_ok=True)
        return copy(source, target)

    monkeypatch.setattr("os.access", lambda *_: False)
    monkeypatch.setattr("shutil.copy", close_first)
    campaign = load_campaign(archive.file)
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        assert len(store.runs()) == 1


def test_a_bug_within_a_transaction_is_not_blamed_on_the_catalog(made: Archive) -> None:
    campaign = load_campaign(made.file)
    with (
        Store(campaign.catalog_url, campaign.name) as store,
        pytest.raises(KeyError, match="a bug"),
        store.transaction(),
    ):
        raise KeyError("a bug")


def test_what_cannot_be_written_is_one_line(read_only: Archive) -> None:
    _closed(read_only)
    for command in (
        ["aggregate", read_only.folder / "out"],
        ["site", read_only.folder / "out"],
        ["reprocess", read_only.file, "--force"],
        ["publish", read_only.file, f"file://{read_only.folder}/copy"],
    ):
        code, output = _run(*command)
        assert code == 3
        assert output.startswith("error: ")
        assert "writ" in output or "ead-only" in output


def test_a_plan_makes_no_folder(made: Archive, tmp_path: Path) -> None:
    code, output = _run("plan", made.file, "--out", tmp_path / "out", "--json")
    assert (code, len(json.loads(output)["scenes"])) == (0, 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("granule", "path", b"\xc3(\xff"),
        ("product", "path", b"\xc3(\xff"),
        ("granule", "notes", b"no JSON"),
        ("granule", "start", b"no time"),
        ("product", "written", b"no time"),
        ("verdict", "facts", b"[1"),
        ("granule", "role", b"no role"),
        ("run", "status", b"no status"),
    ],
)
def test_a_catalog_that_cannot_be_decoded_is_named(
    made: Archive, tmp_path: Path, table: str, column: str, value: bytes
) -> None:
    shutil.copytree(made.folder, tmp_path / "archive")
    archive = Archive(tmp_path / "archive")
    with sqlite3.connect(archive.folder / "out/catalog.sqlite") as connection:
        # One row, because paths are a key.
        row = f"{column} = (select min({column}) from {table})"
        connection.execute(f"update {table} set {column} = cast(? as text) where {row}", [value])
    command = {"run": "runs", "product": "verify"}.get(table, "plan")
    code, output = _run(command, archive.file, *([] if table == "run" else ["--json"]))
    assert code == 1
    assert "catalog.sqlite: the catalog cannot be used" in output
    assert "move it away" in output


@pytest.mark.parametrize("url", ["ftp://127.0.0.1:1/x", "s3://bucket/x"])
def test_publishing_to_a_dead_host_is_one_line(
    made: Archive, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FSSPEC_S3_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    code, output = _run("publish", made.file, url)
    assert code == 3
    assert output.startswith(f"error: {url}: cannot be ")


def test_control_characters_in_names_do_not_reach_the_terminal(made: Archive) -> None:
    raw = made.folder / "raw/poor" / "h\x1b[2J\x9b31m"
    raw.write_bytes(b"broken")
    try:
        shown = [_run(command, made.file)[1] for command in ("catalog", "plan", "reprocess")]
        shown.append(_run("inspect", raw)[1])
    finally:
        raw.unlink()
    for text in shown:
        assert "\x1b" not in text
        assert "\x9b" not in text
    assert "\\x1b[2J\\x9b31m" in shown[0]
