"""One writer at a time, and the database that holds the lock."""

from __future__ import annotations

import multiprocessing
import socket
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import synchronize
from pathlib import Path
from threading import Barrier

import pytest
import sqlalchemy as sa

from lidarops.catalog import database
from lidarops.catalog import lock as lock_module
from lidarops.catalog.database import LOCK, PRODUCT_INPUT, SCHEMA_VERSION
from lidarops.catalog.lock import Lock
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, UnavailableError
from lidarops.records import Role


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/catalog.sqlite"


def test_a_lock_is_one_s_and_comes_back(url: str) -> None:
    with Store(url, "test") as store:
        with Lock(store) as first:
            assert first.acquire() is False
            assert first.acquire() is False, "held already"
            with pytest.raises(CatalogError, match=r"held by .*@.* process"):
                Lock(store).acquire()
            Lock(store).release()
            assert Lock(store).holder().token == first.token
        assert Lock(store).holder() is None


def test_campaigns_of_one_database_do_not_wait_for_each_other(url: str) -> None:
    with Store(url, "one") as one, Store(url, "two") as two, Lock(one) as first, Lock(two) as other:
        first.acquire()
        assert other.acquire() is False


def test_the_lock_of_a_dead_process_is_taken_over_at_once(url: str) -> None:
    code = (
        "import os; from lidarops.catalog.lock import Lock; from lidarops.catalog.store import"
        f" Store; store = Store({url!r}, 'test'); Lock(store).acquire(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    with Store(url, "test") as store, Lock(store) as lock:
        left = lock.holder()
        assert left is not None
        assert not lock.is_taken()
        assert lock.acquire() is False
        assert lock.holder().token == lock.token


def test_a_silent_holder_on_another_machine_is_dead_and_may_not_write(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(url, "test") as store, Lock(store) as lost:
        lost.acquire()
        with store.transaction() as connection:
            connection.execute(sa.update(LOCK).values(machine="elsewhere"))
        with pytest.raises(CatalogError):
            Lock(store).acquire()
        with store.transaction() as connection:
            silent = LOCK.c.heartbeat - lock_module.SILENCE - 1.0
            connection.execute(sa.update(LOCK).values(heartbeat=silent))
        with Lock(store) as taken:
            taken.acquire()
            with pytest.raises(CatalogError, match="taken over"):
                store.forget_products([], lost.token)
            store.forget_products([], taken.token)


def test_a_dead_holder_whose_clock_was_ahead_is_overtaken(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store(url, "test") as store, Lock(store) as lost:
        lost.acquire()
        lost._stop.set()
        with store.transaction() as connection:
            ahead = {"machine": "elsewhere", "heartbeat": LOCK.c.heartbeat + 86_400.0}
            connection.execute(sa.update(LOCK).values(ahead))
        with pytest.raises(CatalogError, match="held by"):
            Lock(store, wait=1.0).acquire()
        monkeypatch.setattr(lock_module, "SILENCE", 1.0)
        with Lock(store, wait=20.0) as lock:
            assert lock.acquire() is True


def test_a_holder_gives_signs_of_life(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock_module, "HEARTBEAT", 0.05)
    with Store(url, "test") as store, Lock(store) as lock:
        lock.acquire()
        with store.transaction() as connection:
            connection.execute(sa.update(LOCK).values(heartbeat=0.0))
        for _ in range(200):
            if lock.holder().silent < 10.0:
                break
            lock_module.time.sleep(0.05)
        else:
            pytest.fail("no heartbeat came")


def test_a_lock_is_waited_for_for_the_given_time(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(url, "test") as store, Lock(store) as first, Lock(store, wait=30.0) as second:
        first.acquire()
        monkeypatch.setattr(lock_module.time, "sleep", lambda _: first.release())
        assert second.acquire() is True


@pytest.mark.parametrize("version", [SCHEMA_VERSION - 1, SCHEMA_VERSION + 1])
def test_a_catalog_of_another_schema_version_is_refused(
    url: str, tmp_path: Path, version: int
) -> None:
    Store(url, "test").close()
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        connection.execute("update schema_version set version = ?", (version,))
    with pytest.raises(CatalogError, match=rf"schema version {version}.*move it away"):
        Store(url, "test")


def test_a_catalog_whose_making_was_killed_is_made(url: str, tmp_path: Path) -> None:
    Store(url, "test").close()
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        connection.executescript("delete from schema_version; drop table verdict")
    with pytest.raises(CatalogError, match="there is no catalog yet"):
        Store(url, "test", create=False)
    with Store(url, "test") as store:
        assert store.verdicts() == {}
    Store(url, "test", create=False).close()


def test_every_role_fits_into_its_column() -> None:
    # SQLite does not mind; PostgreSQL refused a product with a file of lidar ratios.
    longest = PRODUCT_INPUT.c.role.type
    assert isinstance(longest, sa.String)
    assert longest.length is not None
    assert max(map(len, Role)) <= longest.length


def test_a_catalog_is_not_made_where_it_is_only_read(tmp_path: Path) -> None:
    with pytest.raises(CatalogError, match=r"there is no catalog yet.*reprocess"):
        Store(f"sqlite:///{tmp_path}/none/catalog.sqlite", "test", create=False)
    assert not (tmp_path / "none").exists()
    (tmp_path / "other.sqlite").touch()
    with pytest.raises(CatalogError, match="there is no catalog yet"):
        Store(f"sqlite:///{tmp_path}/other.sqlite", "test", create=False)


def test_a_server_that_does_not_answer_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_PATIENCE", 2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"postgresql+psycopg://me@127.0.0.1:{silent.getsockname()[1]}/catalog"
        with pytest.raises(CatalogError, match=r"timeout expired.*check that the server runs"):
            Store(url, "test")


@pytest.mark.parametrize(
    ("said", "remedy"),
    [
        ('FATAL: password authentication failed for user "me"', "PGPASSWORD"),
        ("fe_sendauth: no password supplied", "PGPASSWORD"),
        ('FATAL: no pg_hba.conf entry for host "10.0.0.7"', "ask who runs the server"),
        ('FATAL: database "catalog" does not exist', "createdb NAME"),
        ('FATAL: role "me" does not exist', "correct user and name"),
        ("ERROR: permission denied for schema public", "the right to make and change tables"),
        ("FATAL: sorry, too many clients already", "when fewer programs use the server"),
        ("FATAL: terminating connection due to administrator command", "when the server runs"),
        ("FATAL: the database system is starting up", "when the server runs"),
        ("could not extend file: No space left on device", "make space on the disk"),
        ("connection refused", "check that the server runs"),
    ],
)
def test_what_a_server_says_has_its_own_remedy(
    said: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    psycopg = pytest.importorskip("psycopg")

    def refuse(*_: object, **__: object) -> None:
        raise psycopg.OperationalError(said)

    monkeypatch.setattr(psycopg, "connect", refuse)
    with pytest.raises(UnavailableError, match=remedy):
        Store("postgresql+psycopg://me@127.0.0.1:1/catalog", "test")


def test_an_invalid_url_is_refused() -> None:
    with pytest.raises(CatalogError, match="postgresql"):
        Store("not a url", "test")


def test_opening_an_existing_catalog_writes_nothing(url: str, tmp_path: Path) -> None:
    Store(url, "test").close()
    before = (tmp_path / "catalog.sqlite").read_bytes()
    with Store(url, "test") as store:
        assert store.runs() == []
        assert store.verdicts() == {}
    assert (tmp_path / "catalog.sqlite").read_bytes() == before


def test_several_users_start_on_a_catalog_that_does_not_exist(tmp_path: Path) -> None:
    """Each of them makes it, or waits for the one that does."""
    for number in range(5):
        start, url = Barrier(4), f"sqlite:///{tmp_path}/{number}/catalog.sqlite"
        with ThreadPoolExecutor(4) as pool:

            def use(start: Barrier = start, url: str = url) -> list[str]:
                start.wait()
                with Store(url, "test") as store:
                    return [run.id for run in store.runs()]

            assert [user.result() for user in [pool.submit(use) for _ in range(4)]] == [[]] * 4


def _open_fresh_catalogs(folder: Path, start: synchronize.Barrier) -> None:
    for number in range(8):
        start.wait()
        with Store(f"sqlite:///{folder}/{number}/catalog.sqlite", "test") as store:
            assert store.runs() == []
            with Lock(store, wait=30.0) as lock:
                lock.acquire()


def test_processes_that_start_together_on_a_fresh_catalog_make_one(tmp_path: Path) -> None:
    several = multiprocessing.get_context("fork")
    start = several.Barrier(3)
    processes = [
        several.Process(target=_open_fresh_catalogs, args=(tmp_path, start)) for _ in range(3)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60.0)
    assert [process.exitcode for process in processes] == [0, 0, 0]
