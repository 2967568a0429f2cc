"""Runs load only what they need, because modules take seconds to load."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from support.archives.small_archive import Archive

from lidarops.catalog.lock import Lock
from lidarops.catalog.store import Store
from lidarops.run.archive import bring_up_to_date

pytestmark = pytest.mark.usefixtures("quickly")


_LOADED = """
import sys
from lidarops.cli import app
try:
    app(["reprocess", sys.argv[1]])
except SystemExit as ended:
    print(ended.code, *sorted(sys.modules))
"""


def _reprocessed(archive: Archive) -> tuple[int, set[str], str]:
    """Reprocess in another process; return its exit code, its modules and its errors."""
    command = [sys.executable, "-c", _LOADED, str(archive.file)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    code, *modules = ended.stdout.splitlines()[-1].split()
    return int(code), set(modules), ended.stderr


def test_a_run_that_the_lock_refuses_loads_nothing_for_its_work(archive: Archive) -> None:
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        code, modules, errors = _reprocessed(archive)
    assert code == 3
    assert f"process {os.getpid()}" in errors
    _assert_light(modules)


def _assert_light(modules: set[str]) -> None:
    """Each of them takes a tenth of a second and more; numpy is needed to read headers."""
    of_others = {"dask", "distributed", "h5py", "jinja2", "matplotlib", "netCDF4", "numba"}
    of_others |= {"pandas", "pyarrow", "scipy", "xarray"}
    own = {"figures.browser", "retrieve.common"}
    own |= {"run.processing", "run.staleness", "scene.processing"}
    assert not (of_others | {f"lidarops.{name}" for name in own}) & modules


def test_a_run_with_nothing_to_do_loads_nothing_for_scenes_and_reports(archive: Archive) -> None:
    code, modules, _ = _reprocessed(archive)
    assert code == 0
    _assert_light(modules)


def test_a_run_knows_without_planning_why_a_product_is_not_made(archive: Archive) -> None:
    steep = {"channels": ["photon_532o"], "sections": [[750, 2000]]}
    archive.tree["instruments"]["poor"]["products"]["homogeneous"] = steep
    archive.raw("poor/h-twin", 600, seed=1)
    campaign = archive.write()
    first, again = (bring_up_to_date(campaign) for _ in range(2))
    (unmade,) = first.findings.unmade
    assert "the beam climbs" in unmade.reason
    assert list(first.set_aside) == ["poor/h00"]
    assert (again.findings, again.set_aside) == (first.findings, first.set_aside)
    code, modules, _ = _reprocessed(archive)
    assert code == 1
    _assert_light(modules)
