"""Fixtures of the tests of runs: a small archive, processed by a stand-in without retrievals."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import quick
from support.archives.small_archive import Archive, made

from lidarops.run import executor
from lidarops.run.archive import reprocess


@pytest.fixture(scope="module")
def quickly() -> Iterator[None]:
    """Replace the processing of scenes by `quick.attempt`; other tests prove the retrievals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "attempt", quick.attempt)
        yield


@pytest.fixture(scope="module")
def processed(quickly: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small, processed archive."""
    source = Archive(tmp_path_factory.mktemp("processed"))
    assert made(reprocess(source.write()))
    return source.folder


@pytest.fixture
def archive(processed: Path, tmp_path: Path) -> Archive:
    """A copy of the processed archive, with the same modification times."""
    shutil.copytree(processed, tmp_path / "archive")
    return Archive(tmp_path / "archive")
