"""Users that start on an empty PostgreSQL at once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import sqlalchemy as sa

from lidarops.catalog.database import METADATA
from lidarops.catalog.store import Store

pytestmark = pytest.mark.deployment


def test_several_users_start_on_a_database_without_a_catalog(postgresql: str) -> None:
    url = f"postgresql+psycopg://{postgresql}"
    for _ in range(5):
        start = Barrier(4)
        with ThreadPoolExecutor(4) as pool:

            def use(start: Barrier = start) -> list[str]:
                start.wait()
                with Store(url, "test") as store:
                    return [run.id for run in store.runs()]

            assert [user.result() for user in [pool.submit(use) for _ in range(4)]] == [[]] * 4
        METADATA.drop_all(sa.create_engine(url))
