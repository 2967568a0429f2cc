"""The Prefect flows, on one test server for the session."""

from __future__ import annotations

import importlib.util
import logging
import multiprocessing
import os
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import UUID, uuid4

import httpx
import jsonschema
import pytest
import typer
import yaml
from click.testing import Result as Called
from prefect import Flow, get_client, runtime
from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import State, StateType
from prefect.exceptions import ParameterTypeError
from prefect.server.api.server import SubprocessASGIServer
from prefect.settings import PREFECT_API_URL, get_current_settings, temporary_settings
from prefect.states import Completed, Failed, Pending, Running
from prefect.utilities.callables import parameter_schema
from support import factories
from support.archives import raw_archives
from typer.main import get_command
from typer.testing import CliRunner

import flows.catalog
import flows.reprocess
from flows import NO_FILES, WITH_FAILURES, maintenance, notifications
from flows.catalog import catalog
from flows.maintenance import reap_runs
from flows.reprocess import process_task, reprocess
from flows.start import keep_main_module_out, tie_to_this_process
from lidarops.campaign.model import load_campaign
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import RunStatus, Store
from lidarops.cli import app as cli
from lidarops.errors import CatalogError, LidarOpsError, ProductError, SceneError
from lidarops.records import SceneOutcome
from lidarops.run import executor, processing
from lidarops.run.archive import Result, Selection, bring_up_to_date, update_catalog
from lidarops.run.clusters import Local
from lidarops.scene.job import Failure, Job

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def prefect_server() -> Iterator[None]:
    """A temporary Prefect server; it takes 15 s to start."""
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.fixture
def campaign_file(tmp_path: Path) -> Path:
    """A campaign of three good files and a damaged one."""
    for k in range(3):
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{k}", raw_archives.content(k, bins=1000))
    raw_archives.write(tmp_path / "raw" / "coast" / "h9", b"broken")
    campaign = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    campaign["instruments"]["lidar"]["dark_files"] = []
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.safe_dump(campaign))
    return path


@pytest.mark.usefixtures("prefect_server")
def test_a_temporary_server_refuses_whoever_has_no_password() -> None:
    """Any user of a machine reaches its loopback."""
    with get_client(sync_client=True) as client:
        assert client.hello().status_code == 200
        address = f"{client.api_url}/variables/filter"
    with httpx.Client() as stranger:
        assert stranger.post(address, json={}).status_code == 401


def test_a_configured_server_gets_no_password_of_a_temporary_one() -> None:
    code = "import flows, os; print(os.environ.get('PREFECT_API_AUTH_STRING'))"
    configured = os.environ | {"PREFECT_API_URL": "http://127.0.0.1:1/api"}
    for name in ("PREFECT_API_AUTH_STRING", "PREFECT_SERVER_API_AUTH_STRING"):
        configured.pop(name, None)
    process = subprocess.run(
        [sys.executable, "-c", code], env=configured, capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "None"


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="needs pidfd of Linux")
def test_a_temporary_server_ends_with_its_flow_however_that_ends(
    campaign_file: Path, tmp_path: Path
) -> None:
    environment = os.environ | {"PREFECT_HOME": str(tmp_path / "prefect")}
    for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "PREFECT_SERVER_API_AUTH_STRING"):
        environment.pop(name, None)
    flow_run = subprocess.Popen(
        [sys.executable, "-m", "flows.catalog", str(campaign_file)],
        env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    children: dict[str, int] = {}
    until = time.monotonic() + 120
    while not {"uvicorn", "watch.py"} <= children.keys():
        assert flow_run.poll() is None
        assert time.monotonic() < until
        time.sleep(0.05)
        children = _children(flow_run.pid)
    ended = os.pidfd_open(children["uvicorn"])
    flow_run.kill()
    flow_run.wait()
    assert select.select([ended], [], [], 30)[0]
    os.close(ended)


def _children(process: int) -> dict[str, int]:
    """Return word of the command line -> number, of the children of a process."""
    return {
        Path(word).name: int(child)
        for listing in Path(f"/proc/{process}/task").glob("*/children")
        for child in _read(listing).split()
        for word in _read(Path(f"/proc/{child}/cmdline")).split("\0")
    }


def _read(file: Path) -> str:
    """Return the text of a file of a thread or process; nothing once that has ended."""
    try:
        return file.read_text()
    except OSError:
        return ""


@pytest.mark.parametrize("name", ["flows.reprocess", "prefect.engine"])
def test_processes_of_a_flow_do_not_load_prefect(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a command, and in a deployment."""
    main = ModuleType("__main__")
    main.__spec__ = importlib.util.find_spec(name)
    monkeypatch.setitem(sys.modules, "__main__", main)
    keep_main_module_out()
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(eval, "'prefect' in __import__('sys').modules").result() is False


def test_the_main_module_of_other_programs_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own processes may need it."""
    main = ModuleType("__main__")
    main.__spec__ = spec = importlib.util.find_spec("support.factories")
    monkeypatch.setitem(sys.modules, "__main__", main)
    keep_main_module_out()
    assert main.__spec__ is spec


def test_a_prefect_that_starts_servers_otherwise_runs_flows(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delattr(SubprocessASGIServer, "_run_uvicorn_command")
    with temporary_settings(updates={PREFECT_API_URL: None}):
        tie_to_this_process()
    assert "starts servers otherwise" in caplog.text


@pytest.mark.parametrize("flow", [catalog, reprocess])
@pytest.mark.parametrize("wrong", [{"workers": 0}, {"wait": -1.0}])
def test_parameters_out_of_range_are_refused(flow: Flow, wrong: dict[str, float]) -> None:
    with pytest.raises(ParameterTypeError, match=next(iter(wrong))):
        flow.validate_parameters({"campaign": "campaign.yaml"} | wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"products": ["luck"]},
        {"memory_limit": "foo"},
        {"stations": "coast"},
    ],
)
def test_parameters_of_a_selection_are_validated_before_a_run_is_accepted(
    wrong: dict[str, Any],
) -> None:
    with pytest.raises(ParameterTypeError, match=next(iter(wrong))):
        reprocess.validate_parameters({"campaign": "campaign.yaml"} | wrong)
    # Refused by the server, without the code of the flow.
    schema = parameter_schema(reprocess).model_dump()
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"campaign": "campaign.yaml"} | wrong, schema)


def called(command: Callable[..., None], *words: str) -> Called:
    """Call a flow as its command line does."""
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, list(words))


@pytest.mark.parametrize("command", [flows.catalog.main, flows.reprocess.main])
@pytest.mark.parametrize("content", [None, "name: ["])
def test_a_missing_or_invalid_campaign_file_is_wrong_use(
    command: Callable[..., None], content: str | None, tmp_path: Path
) -> None:
    """The error is shown before any server is started."""
    file = tmp_path / "campaign.yaml"
    if content is not None:
        file.write_text(content)
    result = called(command, str(file))
    assert result.exit_code == 2
    assert result.output.startswith(f"error: {file}: ")
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--memory-limit", "foo"], "memory_limit"),
        (["--memory-limit", "2GiB", "--cluster", "slurm"], "memory_limit"),
        (["--product", "luck"], "homogeneous"),
        (["--product", "elastic"], "homogeneous"),
        (["--scheduler", "nowhere"], "address"),
        (["--station", "nope"], "coast"),
        (["--since", "2024-09-22", "--until", "2024-09-21"], "since"),
    ],
)
def test_wrong_options_of_the_flow_are_wrong_use(
    words: list[str], said: str, campaign_file: Path
) -> None:
    result = called(flows.reprocess.main, str(campaign_file), *words)
    assert result.exit_code == 2
    assert said in result.output


@pytest.mark.parametrize("command", [flows.catalog.main, flows.reprocess.main])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--catalog", "luck"], "postgresql"),
        (["--archive", "luck"], "not a folder"),
        (["--archive", "luck://bucket"], "cannot be opened"),
        (["--wait", "1e9"], "wait"),
    ],
)
def test_places_that_are_none_are_wrong_use_of_every_flow(
    command: Callable[..., None], words: list[str], said: str, campaign_file: Path
) -> None:
    """The error is shown before any server is started."""
    result = called(command, str(campaign_file), *words)
    assert result.exit_code == 2
    assert result.output.startswith("error: ")
    assert said in result.output


SECRET = "swordfish"


@pytest.mark.parametrize(
    ("flow", "name", "url"),
    [
        (reprocess, "publish", f"s3://key:{SECRET}@bucket"),
        (reprocess, "archive", f"s3://key:{SECRET}@bucket"),
        (reprocess, "archive", f"https://{SECRET}@host/a"),
        (reprocess, "archive", f"https://host/a?sig={SECRET}"),
        (reprocess, "publish", f"abfs://key:{SECRET}@account/a"),
        (reprocess, "catalog", f"postgresql+psycopg://user:{SECRET}@host/name"),
        (reprocess, "catalog", f"postgresql+psycopg://user@host/name?password={SECRET}"),
        (
            catalog,
            "catalog",
            f"postgresql+psycopg://host/name?sslmode=require&sslpassword={SECRET}",
        ),
        (catalog, "archive", f"s3://key:{SECRET}@bucket"),
        (catalog, "catalog", f"postgresql+psycopg://user:{SECRET}@host/name"),
    ],
)
def test_parameters_with_keys_are_refused_before_a_server_keeps_them(
    flow: Flow, name: str, url: str
) -> None:
    parameters = {"campaign": "campaign.yaml", name: url}
    with pytest.raises(CatalogError) as caught:
        flow.validate_parameters(parameters)
    assert SECRET not in str(caught.value)
    schema = parameter_schema(flow).model_dump()
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(parameters, schema)
    places = ("/folder", "s3://bucket/a", "abfs://container@account/a", "https://host/a")
    databases = (
        "postgresql+psycopg://user@host/name",
        "postgresql+psycopg://user@host/name?sslmode=require",
        "sqlite:////folder/catalog.sqlite",
    )
    for allowed in databases if name == "catalog" else places:
        jsonschema.validate({"campaign": "campaign.yaml", name: allowed}, schema)
        flow.validate_parameters({"campaign": "campaign.yaml", name: allowed})


@pytest.mark.parametrize("option", ["--archive", "--publish"])
def test_a_store_with_a_key_is_wrong_use_of_the_flow(option: str, campaign_file: Path) -> None:
    url = f"s3://key:{SECRET}@bucket"
    result = called(flows.reprocess.main, str(campaign_file), option, url)
    assert result.exit_code == 2
    assert "AWS_ACCESS_KEY_ID" in result.output
    assert SECRET not in result.output


@pytest.mark.usefixtures("prefect_server")
def test_the_password_of_a_catalog_is_not_stored_by_the_server(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So that what the command sets is gone afterwards.
    monkeypatch.setenv("LIDAROPS_CATALOG", "")
    url = f"postgresql+psycopg://user:{SECRET}@127.0.0.1:1/name"
    for command in (flows.catalog.main, flows.reprocess.main):
        result = called(command, str(campaign_file), "--catalog", url)
        assert result.exit_code == 3
        assert "the catalog cannot be used" in result.output
        assert SECRET not in result.output
    database = get_current_settings().server.database.connection_url
    assert database is not None
    file = Path(database.get_secret_value().partition(":///")[2])
    written = b"".join(part.read_bytes() for part in file.parent.glob(f"{file.name}*"))
    assert str(campaign_file).encode() in written
    assert SECRET.encode() not in written


@pytest.mark.parametrize("command", [flows.catalog.main, flows.reprocess.main])
def test_a_missing_archive_is_reported_before_any_server_is_started(
    command: Callable[..., None], campaign_file: Path
) -> None:
    (campaign_file.parent / "raw").rename(campaign_file.parent / "away")
    result = called(command, str(campaign_file))
    assert result.exit_code == 3
    assert result.output.startswith("error: ")
    assert "not a folder" in result.output


def test_the_scheduled_catalog_scan_waits_for_a_run_and_not_for_the_next_scan(
    repository: Path,
) -> None:
    described = yaml.safe_load((repository / "deploy" / "prefect.yaml").read_text())
    deployments = {each["name"]: each for each in described["deployments"]}
    for each in deployments.values():
        assert each.get("parameters", {"wait": 1})["wait"] > 0
    looks = deployments["demo-catalog"]
    assert looks["schedules"][0]["cron"] == "10 * * * *"
    assert 1800 < looks["parameters"]["wait"] < 3600
    catalog.validate_parameters(looks["parameters"])


@pytest.mark.usefixtures("prefect_server")
def test_the_catalog_flow_waits_for_a_run_for_the_given_time(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"sqlite:///{campaign_file.parent}/other.sqlite"
    words = [str(campaign_file), "--catalog", url]
    with Store(url, "test") as store, Lock(store) as held:
        held.acquire()
        refused = called(flows.catalog.main, *words)
        assert refused.exit_code == 3
        assert isinstance(refused.exception, SystemExit)
        assert "error: " in refused.output
        assert "held by" in refused.output
        assert store.granules() == []

        def released(*arguments: Any, wait: float, **options: Any) -> ScanSummary:
            assert wait == 60
            held.release()
            return update_catalog(*arguments, wait=wait, **options)

        monkeypatch.setattr(flows.catalog, "update_catalog", released)
        waited = called(flows.catalog.main, *words, "--wait", "60")
        # A file of the archive is refused.
        assert waited.exit_code == 1
        assert "error: " not in waited.output
        assert len(store.granules()) == 4


@pytest.mark.usefixtures("prefect_server")
def test_the_flow_takes_the_options_of_the_command_line(campaign_file: Path) -> None:
    def products(*words: str) -> int:
        folder = campaign_file.parent / "out"
        shutil.rmtree(folder, ignore_errors=True)
        options = ["--out", str(folder), "--catalog", f"sqlite:///{folder}/other.sqlite"]
        result = called(flows.reprocess.main, str(campaign_file), *options, *words)
        # A file of the archive is refused.
        assert result.exit_code == 1, result.output
        assert (folder / "other.sqlite").exists()
        return len(list(folder.rglob("*.nc")))

    selection = ["--station", "coast", "--instrument", "lidar", "--product", "homogeneous"]
    inside = ["--since", "2026-02-28", "--until", "2026-03-02"]
    assert products(*selection, *inside, "--wait", "1", "--memory-limit", "1GiB") == 1
    assert products("--since", "2026-03-05") == 0


def test_the_options_that_only_the_command_line_has_are_listed(repository: Path) -> None:
    app = typer.Typer()
    app.command()(flows.reprocess.main)
    flow, command = (
        {word for option in made.params for word in option.opts if word.startswith("--")}
        for made in (get_command(app), get_command(cli).commands["reprocess"])
    )
    page = (repository / "docs/howto/cluster.md").read_text("utf-8")
    lacking = page.partition("It has no")[2].partition("In `deploy")[0]
    listed = set(re.findall(r"`(--[\w*-]+)`", lacking))
    only = command - flow - {"--help"}
    assert {next((w for w in listed if fnmatch(word, w)), word) for word in only} == listed


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
    assert result.has_failures
    assert len(list(Path(record.products).rglob("*.nc"))) == 1
    again, no_page = reprocess(str(campaign_file))
    assert again.record is None
    assert no_page is None
    forced, _ = reprocess(str(campaign_file), full=True)
    assert forced.record is not None


@pytest.mark.usefixtures("prefect_server")
def test_each_batch_of_scenes_is_a_task_run_that_logs_how_scenes_ended(
    campaign_file: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for day in range(1, 3):
        data = raw_archives.content(1440.0 * day, bins=1000)
        raw_archives.write(campaign_file.parent / "raw/coast" / f"h{day}0", data)
    monkeypatch.setattr(processing, "MOST_OF_A_BATCH", 2)
    state = reprocess(str(campaign_file), return_state=True)
    with get_client(sync_client=True) as client:
        flow_run = FlowRunFilter(id=FlowRunFilterId(any_=[state.state_details.flow_run_id]))
        names = {run.name for run in client.read_task_runs(flow_run_filter=flow_run)}
    assert {"batch 1", "batch 2"} <= names
    assert "batch 3" not in names
    for words in ("lidar_20260301T000000: 1 product", "lidar_20260303T000000: 1 product"):
        assert words in caplog.text
    assert "batch 2: 1 scene" in caplog.text


@pytest.mark.usefixtures("prefect_server")
def test_an_instrument_without_new_files_raises_an_event(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr(
        flows.reprocess, "emit_event", lambda name, _, payload: events.append((name, payload))
    )
    for hour, expected in ((20, []), (30, ["lidar"])):
        events.clear()
        start = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(hours=hour)
        monkeypatch.setattr(runtime.flow_run, "scheduled_start_time", start, raising=False)
        reprocess(str(campaign_file), files_within=24.0)
        assert [payload["instrument"] for _, payload in events] == expected
    assert events[0][0] == NO_FILES
    assert events[0][1]["message"].startswith("no good file within the 24 h before 2026-03-02")


@pytest.mark.usefixtures("prefect_server")
def test_a_run_links_its_report_where_a_browser_finds_it(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    links: list[str] = []
    monkeypatch.setattr(
        flows.reprocess, "create_link_artifact", lambda link, *_, **__: links.append(link)
    )
    result, _ = reprocess(str(campaign_file))
    assert links == []
    result, _ = reprocess(str(campaign_file), full=True, pages_at="https://example.org/lidar/")
    assert result.record is not None
    assert links == [f"https://example.org/lidar/report/{result.record.id}/index.html"]


@pytest.mark.usefixtures("prefect_server")
def test_an_internal_error_is_reported_apart_with_its_traceback(
    campaign_file: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **_settings: object) -> None:
        raise TypeError("no such thing")

    monkeypatch.setattr("lidarops.retrieve.homogeneous.labeled.fit_homogeneous_path", broken)
    state = reprocess(str(campaign_file), return_state=True)
    assert (state.name, state.type) == (WITH_FAILURES, StateType.COMPLETED)
    assert state.message == "1 scenes ended with an internal error, 1 files refused"
    assert "internal error: TypeError: no such thing" in caplog.text
    assert "in broken" in caplog.text


def fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let scenes fail."""

    def failing(job: Job) -> tuple[SceneOutcome, bool]:
        return Failure("nowhere.csv: cannot be read").outcome(job.scene, job.plan), True

    monkeypatch.setattr(executor, "attempt", failing)


@pytest.mark.usefixtures("prefect_server")
def test_a_run_with_failures_ends_in_its_own_state_and_reports_them(
    campaign_file: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail(monkeypatch)
    for night in range(2):
        caplog.clear()
        state = reprocess(str(campaign_file), return_state=True)
        # The second run tries nothing again, but reports the failure.
        assert (state.name, state.type) == (WITH_FAILURES, StateType.COMPLETED)
        assert state.message == "1 scenes failed, 1 files refused"
        result, _ = state.result()
        assert (result.record is None) == (night == 1)
        assert "nowhere.csv" in caplog.text
        assert "coast/h9: " in caplog.text
        assert "up to date" not in caplog.text
    broken = campaign_file.parent / "raw" / "coast" / "h9"
    broken.unlink()
    monkeypatch.undo()
    mended = yaml.safe_load(campaign_file.read_text())
    mended["instruments"]["lidar"]["facts"][0]["full_overlap_range"] = 450.0
    campaign_file.write_text(yaml.safe_dump(mended))
    assert reprocess(str(campaign_file), return_state=True).name == "Completed"


@pytest.mark.usefixtures("prefect_server")
def test_a_night_without_the_raw_files_of_products_says_which_and_what_to_do(
    campaign_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = campaign_file.read_text()
    campaign_file.write_text(text.replace("vanished_share: 0.05", "vanished_share: 1"))
    reprocess(str(campaign_file))
    raw = campaign_file.parent / "raw" / "coast"
    for k in range(3):
        (raw / f"h{k}").unlink()
    (raw / "h9").write_bytes(raw_archives.content(2000, bins=1000))
    caplog.clear()
    state = reprocess(str(campaign_file), return_state=True)
    assert state.name == WITH_FAILURES
    assert state.message.startswith("1 products without a raw file")
    assert "--remove-orphans" in state.message
    assert "20260301T000000" in caplog.text
    (raw / "h9").unlink()
    with pytest.raises(CatalogError, match="the catalog stays unchanged"):
        reprocess(str(campaign_file))


@pytest.mark.usefixtures("prefect_server")
def test_the_log_of_a_run_with_failures_is_bounded(
    campaign_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for k in range(30):
        raw_archives.write(campaign_file.parent / "raw" / "coast" / f"hb{k:02d}", b"broken")
    reprocess(str(campaign_file))
    refused = [record for record in caplog.records if "coast/h" in record.getMessage()]
    assert len(refused) == 20
    assert "and 11 more files refused" in caplog.text


def test_a_run_reports_channels_that_no_file_holds(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tree = yaml.safe_load(campaign_file.read_text())
    tree["instruments"]["lidar"]["products"]["homogeneous"]["channels"].append("photon_999o")
    campaign_file.write_text(yaml.safe_dump(tree))
    (campaign_file.parent / "raw" / "coast" / "h9").unlink()
    campaign = load_campaign(campaign_file)
    result = bring_up_to_date(campaign)
    assert result.has_failures
    monkeypatch.setattr(flows.reprocess, "get_run_logger", lambda: logging.getLogger("night"))
    with caplog.at_level(logging.WARNING, "night"):
        message = flows.reprocess._log_problems(campaign, result)
    assert message.startswith("1 requested channels in no file")
    assert "photon_999o of lidar, for homogeneous: the files hold no such" in caplog.text


@pytest.mark.parametrize(
    ("status", "error", "again"),
    [(RunStatus.STOPPED, ProductError, True), (RunStatus.INTERRUPTED, SceneError, False)],
)
def test_a_run_that_gives_up_is_tried_again_and_one_that_is_stopped_is_not(
    status: RunStatus,
    error: type[LidarOpsError],
    *,
    again: bool,
    campaign_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fail(monkeypatch)

    def given_up(*arguments: Any, **options: Any) -> Result:
        return replace(bring_up_to_date(*arguments, **options), status=status)

    for name in ("create_progress_artifact", "update_progress_artifact"):
        monkeypatch.setattr(flows.reprocess, name, lambda *_, **__: None)
    monkeypatch.setattr(flows.reprocess, "bring_up_to_date", given_up)
    with pytest.raises(error) as raised:
        process_task.fn(load_campaign(campaign_file), Selection(), Local(), full=False, wait=0.0)
    assert ("nowhere.csv" in str(raised.value)) == again
    monkeypatch.setitem(runtime.deployment.FIELDS, "id", lambda: str(uuid4()))
    assert process_task.retry_condition_fn is not None
    state = Failed(data=raised.value)
    assert process_task.retry_condition_fn(process_task, None, state) == again


def test_a_run_with_failures_counts_as_completed() -> None:
    within = timedelta(hours=26)
    made = notifications.automations(uuid4(), within=within)
    plain = {automation.name: automation.trigger for automation in made}
    assert len(plain) == 3
    event = f"prefect.flow-run.{WITH_FAILURES}"
    absent = plain[notifications.ABSENT]
    assert event in absent.expect
    # Time counts from the last run of the same archive.
    assert absent.after == absent.expect
    assert absent.for_each == {"related:deployment:prefect.resource.id"}
    assert event not in plain[notifications.FAILED].expect
    assert plain[notifications.MISSING].expect == {NO_FILES}
    automations = notifications.automations(uuid4(), within=within, failures=True)
    (has_failures,) = [
        each for each in automations if each.name == notifications.COMPLETED_WITH_FAILURES
    ]
    assert has_failures.trigger.expect == {event}


def claimed(client: SyncPrefectClient, state: State, *tags: str) -> UUID:
    """Create a deployed run that enters a state now."""
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
        # A pending run blocks its deployment, too, but may take longer.
        assert [run.id for run in reap_runs(client, silence=90.0, start=60.0)] == [starts]
