"""The Prefect flows, on one test server for the session."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID, uuid4

import factories
import pytest
import rawfiles
import yaml
from prefect import Flow, get_client
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.objects import State, StateType
from prefect.exceptions import ParameterTypeError
from prefect.states import Completed, Pending, Running

from flows import maintenance
from flows.catalog import catalog
from flows.maintenance import reap_runs
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


@pytest.mark.parametrize("flow", [catalog, reprocess])
@pytest.mark.parametrize("wrong", [{"workers": 0}, {"wait": -1.0}])
def test_parameters_out_of_range_are_refused(flow: Flow, wrong: dict[str, float]) -> None:
    with pytest.raises(ParameterTypeError, match=next(iter(wrong))):
        flow.validate_parameters({"campaign": "campaign.yaml"} | wrong)


@pytest.mark.usefixtures("prefect_server")
def test_flows_catalog_and_reprocess(campaign_file: Path) -> None:
    summary = catalog(str(campaign_file))
    assert (summary.files, summary.refused) == (4, 1)
    result, page = reprocess(str(campaign_file), workers=1)
    record = result.record
    assert record is not None
    assert page is not None
    assert page.is_file()
    assert [scene.error for scene in record.scenes] == [""]
    assert [granule.path for granule in record.refused] == ["coast/h9"]
    assert result.troubled
    assert len(list(Path(record.products).rglob("*.nc"))) == 1
    again, no_page = reprocess(str(campaign_file))
    assert again.record is None
    assert no_page is None
    forced, _ = reprocess(str(campaign_file), full=True)
    assert forced.record is not None


def claimed(client: SyncPrefectClient, state: State, *tags: str) -> UUID:
    """Make a run of a deployment that comes to a state now."""
    flow_id = client.create_flow_from_name("stand-in")
    deployment = client.create_deployment(flow_id, f"stand-in-{uuid4()}", tags=list(tags))
    run = client.create_flow_run_from_deployment(deployment, tags=list(tags))
    client.set_flow_run_state(run.id, state, force=True)
    return run.id


@pytest.mark.usefixtures("prefect_server")
def test_reaper_ends_the_silent_and_spares_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    with get_client(sync_client=True) as client:
        dead = claimed(client, Running(), "lidarops", "nightly")
        starts = claimed(client, Pending(), "lidarops")
        claimed(client, Running(), "elsewhere")
        claimed(client, Completed(), "lidarops")
        assert reap_runs(client, silence=90.0, start=600.0) == []
        later = datetime.now(UTC) + timedelta(seconds=300)
        monkeypatch.setattr(maintenance, "_now", lambda: later)
        (reaped,) = reap_runs(client, silence=90.0, start=600.0)
        assert reaped.id == dead
        assert reaped.silent > 90
        assert client.read_flow_run(dead).state_type is StateType.CRASHED
        assert reap_runs(client, silence=90.0, start=600.0) == []
        # What was claimed and never ran blocks as well, only later.
        assert [run.id for run in reap_runs(client, silence=90.0, start=60.0)] == [starts]
