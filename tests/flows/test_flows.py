"""The Prefect flows, on one test server for the session."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import factories
import pytest
import rawfiles
import yaml

from flows.catalog import catalog
from flows.reprocess import reprocess


@pytest.fixture(scope="session")
def prefect_server() -> Iterator[None]:
    """An ephemeral server on a throw-away database: it takes 15 s to start."""
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.fixture
def campaign_file(tmp_path: Path) -> Path:
    """A campaign of three good files and a broken one."""
    for k in range(3):
        rawfiles.write(tmp_path / "raw" / "coast" / f"h{k}", rawfiles.content(k, bins=1000))
    rawfiles.write(tmp_path / "raw" / "coast" / "h9", b"broken")
    campaign = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.safe_dump(campaign))
    return path


@pytest.mark.usefixtures("prefect_server")
def test_flows_catalog_and_reprocess(campaign_file: Path) -> None:
    summary = catalog(str(campaign_file))
    assert (summary.files, summary.refused) == (4, 1)
    record, page = reprocess(str(campaign_file), workers=1)
    assert page.is_file()
    assert [scene.error for scene in record.scenes] == [""]
    assert [granule.path for granule in record.refused] == ["coast/h9"]
    assert record.failed
    assert len(list(Path(record.products).rglob("*.nc"))) == 1
