"""Changed code makes exactly the products stale that it makes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.archives.small_archive import Archive, made
from support.sources import Copy

from lidarops.catalog.store import Store
from lidarops.run.archive import assess, reprocess, update_catalog
from lidarops.run.day_states import Signature
from lidarops.run.staleness import Judge
from lidarops.system import code_version as versions

pytestmark = pytest.mark.usefixtures("quickly")


class Installed(Copy):
    """A copy of the sources that the run takes for the installed ones."""

    def reload(self, patch: pytest.MonkeyPatch) -> None:
        """Let the run see the sources as they are now, as a new process would."""
        sources = self.sources()
        patch.setattr(versions, "_installed", lambda: sources)
        versions.code_version.cache_clear()


@pytest.fixture
def installed(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Installed]:
    """Sources that the test may change."""
    copy = Installed(repository, tmp_path / "installed")
    copy.reload(monkeypatch)
    yield copy
    versions.code_version.cache_clear()


@pytest.mark.parametrize(
    ("module", "kinds"),
    [
        ("retrieve/elastic/inversion.py", {"elastic"}),
        ("products/homogeneous/variables.py", {"homogeneous"}),
        ("retrieve/network/geometry.py", set()),
        ("netcdf/write.py", {"elastic", "homogeneous", "signal"}),
        ("run/scenes.py", set()),
        ("run/processing.py", set()),
        ("site/pages.py", set()),
    ],
)
def test_changed_code_makes_its_kinds_stale(
    archive: Archive,
    installed: Installed,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    kinds: set[str],
) -> None:
    campaign = archive.write()
    # The place of the sources does not count.
    assert reprocess(campaign) is None
    installed.change(module)
    installed.reload(monkeypatch)
    stale = [product for judged in assess(campaign) for product in judged.stale]
    assert {product.kind for product in stale} == kinds
    assert all(product.reason.startswith("the code changed, from ") for product in stale)
    products = made(reprocess(campaign))
    assert {name.split()[2] for name in products} == kinds
    assert len(products) == len(stale)
    assert reprocess(campaign) is None


def test_files_are_read_again_if_their_parser_changed(
    archive: Archive, installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = archive.write()
    for module, read in (("reports/sources.py", False), ("raw/licel_header.py", True)):
        installed.change(module)
        installed.reload(monkeypatch)
        summary = update_catalog(campaign)
        assert summary.changed == (summary.files if read else 0)
        assert not update_catalog(campaign).changed


def test_a_day_is_judged_again_if_the_planning_changed(
    archive: Archive, installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although no product may be stale."""
    campaign = archive.write()

    def state() -> dict[int, Signature]:
        with Store(campaign.catalog_url, campaign.name) as store:
            return Judge(campaign, store).signatures()

    before = state()
    installed.change("retrieve/network/geometry.py")
    installed.reload(monkeypatch)
    assert state() == before
    installed.change("run/scenes.py")
    installed.reload(monkeypatch)
    after = state()
    assert before.keys() == after.keys()
    assert all(after[day] != before[day] for day in before)
