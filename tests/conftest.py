"""Fixtures that several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.system import processes

pytest_plugins = ["support.products.report_fixtures", "support.servers.s3_fixtures"]

# Examples are derandomized, so that failures are reproducible; run times do not count as failures.
hypothesis.settings.register_profile("lidarops", deadline=None, derandomize=True)
hypothesis.settings.load_profile("lidarops")

# Tests run in as many processes as there are cores: more threads would wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Products state when they were written; equal inputs shall give equal bytes in tests.
os.environ.setdefault("SOURCE_DATE_EPOCH", "1700000000")

# pytest states the name of each test in the environment. Workers would take it for another one, and
# load all modules instead of being forked from a process that has loaded them.
processes._LIBRARY_VARIABLES |= {"PYTEST_CURRENT_TEST"}

REPOSITORY = Path(__file__).resolve().parents[1]

SLOW = {
    REPOSITORY / "tests" / name
    for name in ("benchmarks", "flows", "tools", "deploy/test_schedule.py")
}
"""Folders of slow tests alone, and a file of a deployment."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out slow tests where none is run: each process would load Prefect for them."""
    return True if collection_path in SLOW and "not slow" in config.option.markexpr else None


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of real raw files; skip if this machine has none."""
    root = Path(os.environ.get("LIDAROPS_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
    if not root.is_dir():
        pytest.skip("no real data here: set LIDAROPS_TEST_DATA")
    return root


@pytest.fixture(scope="session")
def server() -> None:
    """A process with the modules of workers, from which they are forked as in a run.

    Otherwise each of them loads the modules for a second.
    """
    from lidarops.run.processing import _WORKER_MODULES

    processes.preload_modules(_WORKER_MODULES)


@pytest.fixture(scope="session")
def demo_archive(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated demo archive, written by the command line."""
    archive = tmp_path_factory.mktemp("demo") / "raw"
    result = CliRunner().invoke(
        app, ["simulate", str(repository / "catalogs/demo.yaml"), "--archive", str(archive)]
    )
    assert result.exit_code == 0, result.output
    return archive
