"""What tests of whole runs share: a small archive that was processed without its physics."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import quick
from support.small_archive import Archive, made

from lidarops.run import executor
from lidarops.run.archive import reprocess


@pytest.fixture(scope="module")
def quickly() -> Iterator[None]:
    """Leave the physics out: other tests show that products are what their plans say."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "attempt", quick.attempt)
        yield


@pytest.fixture(scope="module")
def processed(quickly: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small archive, processed."""
    made_here = Archive(tmp_path_factory.mktemp("processed"))
    assert made(reprocess(made_here.write()))
    return made_here.folder


@pytest.fixture
def archive(processed: Path, tmp_path: Path) -> Archive:
    """A copy of it, with the same modification times."""
    shutil.copytree(processed, tmp_path / "archive")
    return Archive(tmp_path / "archive")
