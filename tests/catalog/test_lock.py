"""One writer an archive, and the database that says which."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa
from support import factories

from lidarops.catalog import lock as lock_module
from lidarops.catalog.ledger import Run, RunStatus
from lidarops.catalog.lock import Lock
from lidarops.catalog.rows import row_of
from lidarops.catalog.schema import LOCK, PRODUCT, SCHEMA_VERSION
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError


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
        assert left.dead
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


def test_a_lock_is_waited_for_as_long_as_asked(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store(url, "test") as store, Lock(store) as first, Lock(store, wait=30.0) as second:
        first.acquire()
        monkeypatch.setattr(lock_module.time, "sleep", lambda _: first.release())
        assert second.acquire() is True


def test_a_catalog_of_another_version_is_told(url: str, tmp_path: Path) -> None:
    Store(url, "test").close()
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        connection.execute("update schema_version set version = ?", (SCHEMA_VERSION + 1,))
    with pytest.raises(CatalogError, match=rf"version {SCHEMA_VERSION + 1}.*newer lidarops"):
        Store(url, "test")
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        connection.execute("drop table schema_version")
    with pytest.raises(CatalogError, match=r"version 1.*move it away"):
        Store(url, "test")


@pytest.mark.parametrize(
    ("version", "added"),
    [(2, ("product.usable", "granule.header_digest")), (3, ("granule.header_digest",))],
)
def test_a_catalog_of_an_older_version_is_brought_up_to_date(
    url: str, tmp_path: Path, version: int, added: tuple[str, ...]
) -> None:
    granule = factories.granule(header_digest="one")
    run = Run(
        "one", datetime(2026, 3, 1, tzinfo=UTC), None, RunStatus.RUNNING, "me", "0.1", "abc"
    )  # fmt: skip
    with Store(url, "test") as store, Lock(store) as lock:
        lock.acquire()
        store.begin_run(run, lock.token)
        with store.transaction() as connection:
            row = {
                column.name: 1 if isinstance(column.type, sa.Integer) else "one"
                for column in PRODUCT.columns
            }
            connection.execute(sa.insert(PRODUCT), {**row, "campaign": "test"})
            before = dict(connection.execute(sa.select(PRODUCT)).mappings().one())
        store.replace([row_of(granule, "test", "key")])
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        for table, _, column in (each.partition(".") for each in added):
            connection.execute(f"alter table {table} drop column {column}")
        connection.execute("update schema_version set version = ?", (version,))
    if "product.usable" in added:
        before["usable"] = None
    for _ in range(2):
        with Store(url, "test") as store:
            assert store.products() == [before]
            assert store.granules() == [replace(granule, header_digest=None)]
            assert [each.id for each in store.runs()] == ["one"]
            assert store.empty() == []
            with store.transaction() as connection:
                assert connection.scalars(sa.text("select version from schema_version")).all() == [
                    SCHEMA_VERSION
                ]


def test_a_catalog_that_cannot_be_brought_up_to_date_stays_as_it_was(
    url: str, tmp_path: Path
) -> None:
    Store(url, "test").close()
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        # The column is there already, so that adding it fails.
        connection.execute("update schema_version set version = 2")
    with pytest.raises(CatalogError, match="duplicate column"):
        Store(url, "test")
    with sqlite3.connect(tmp_path / "catalog.sqlite") as connection:
        assert connection.execute("select version from schema_version").fetchall() == [(2,)]


def test_a_catalog_is_not_made_where_it_is_only_read(tmp_path: Path) -> None:
    with pytest.raises(CatalogError, match=r"there is no catalog yet.*reprocess"):
        Store(f"sqlite:///{tmp_path}/none/catalog.sqlite", "test", create=False)
    assert not (tmp_path / "none").exists()
    (tmp_path / "other.sqlite").touch()
    with pytest.raises(CatalogError, match="there is no catalog yet"):
        Store(f"sqlite:///{tmp_path}/other.sqlite", "test", create=False)


def test_what_is_no_url_is_told() -> None:
    with pytest.raises(CatalogError, match="postgresql"):
        Store("not a url", "test")


def test_opening_an_existing_catalog_writes_nothing(url: str, tmp_path: Path) -> None:
    Store(url, "test").close()
    before = (tmp_path / "catalog.sqlite").read_bytes()
    with Store(url, "test") as store:
        assert store.runs() == []
        assert store.verdicts() == {}
    assert (tmp_path / "catalog.sqlite").read_bytes() == before
