"""What a store answers for one file costs this file alone; what it answers for all ends a scan."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import factories
from support.archives import raw_archives
from support.servers.stand_ins import SCHEMES, StandIn, served

from lidarops.campaign.model import Campaign
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError, UnavailableError
from lidarops.records import Status
from lidarops.run.scenes import cut_scenes
from lidarops.scene.input_files import check_files, local_files
from lidarops.system import stores
from lidarops.system.stores import RemoteStore

FILES = 4


@pytest.fixture
def stand_in(tmp_path: Path) -> Iterator[StandIn]:
    """A server of four raw files."""
    for minute in range(FILES):
        path = tmp_path / "raw" / "coast" / f"h{minute}"
        raw_archives.write(path, raw_archives.content(minute))
    with served(tmp_path / "raw") as server:
        yield server


def _campaign(archive: str, tmp_path: Path) -> Campaign:
    return factories.campaign().model_copy(
        update={"archive": archive, "output": str(tmp_path / "out")}
    )


@pytest.fixture(params=["local", *SCHEMES])
def archive(request: pytest.FixtureRequest, stand_in: StandIn) -> str:
    """The same files in a folder, on a web server and in an object store."""
    local = request.param == "local"
    return str(stand_in.folder) if local else stand_in.url(request.param)


def test_an_empty_file_is_refused_alone_and_says_so(
    archive: str, stand_in: StandIn, tmp_path: Path
) -> None:
    (stand_in.folder / "coast" / "h1").write_bytes(b"")
    campaign = _campaign(archive, tmp_path)
    with Store(campaign.catalog_url, campaign.name) as store:
        for _ in range(2):
            summary = scan_archive(campaign, store)
            assert (summary.files, summary.refused) == (FILES, 1)
        (refused,) = store.refused()
    assert (refused.path, refused.size) == ("coast/h1", 0)
    assert not refused.reason.startswith("cannot be read")


@pytest.mark.parametrize("status", [400, 401, 403, 404, 409, 410, 416, 429, 500, 503])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_answer_about_one_file_costs_this_file_alone(
    stand_in: StandIn, scheme: str, status: int, tmp_path: Path
) -> None:
    campaign = _campaign(stand_in.url(scheme), tmp_path)
    stand_in.statuses["h1"] = status
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        good = [granule.path for granule in store.granules(status=Status.GOOD)]
        assert good == ["coast/h0", "coast/h2", "coast/h3"]
        (refused,) = store.refused()
        assert refused.reason == f"cannot be read: the server answers {status}"
        stand_in.statuses.clear()
        scan_archive(campaign, store)
        assert len(store.granules(status=Status.GOOD)) == FILES


@pytest.mark.parametrize("status", [429, 500, 503])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_answer_about_the_store_ends_the_scan(
    stand_in: StandIn, scheme: str, status: int, tmp_path: Path
) -> None:
    campaign = _campaign(stand_in.url(scheme), tmp_path)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        before = store.granules()
        (stand_in.folder / "coast" / "h1").write_bytes(raw_archives.content(9))

        def fail_after_listing(page: bytes) -> bytes:
            if b"h1" in page:
                stand_in.statuses[""] = status
            return page

        stand_in.damaged = fail_after_listing
        with pytest.raises(CatalogError, match="coast/h"):
            scan_archive(campaign, store)
        assert store.granules() == before


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_failure_concerns_one_object_if_the_one_read_before_is_still_given(
    stand_in: StandIn, scheme: str
) -> None:
    store = RemoteStore(stand_in.url(scheme))
    for before in ("coast/h1", "coast/h0"):
        stand_in.statuses.clear()
        store.head(before, 100)
        stand_in.statuses["h1"] = 500
        with pytest.raises(OSError, match="the server answers 500"):
            store.head("coast/h1", 100)
    # The list is still given.
    stand_in.statuses["h0"] = 500
    with pytest.raises(CatalogError):
        store.head("coast/h1", 100)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_store_that_gives_no_file_ends_the_scan(
    stand_in: StandIn, scheme: str, tmp_path: Path
) -> None:
    campaign = _campaign(stand_in.url(scheme), tmp_path)
    stand_in.statuses = {f"h{minute}": 403 for minute in range(FILES)}
    with Store(campaign.catalog_url, campaign.name) as store:
        with pytest.raises(CatalogError, match=f"gives none of its {FILES} files"):
            scan_archive(campaign, store)
        assert store.granules() == []


def test_a_web_server_that_never_answers_ends_the_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    http = pytest.importorskip("fsspec.implementations.http").HTTPFileSystem
    monkeypatch.setattr(stores, "_LONGEST_SILENCE", 0.2)
    http.clear_instance_cache()
    # The system accepts connections that no program takes.
    with socket.create_server(("127.0.0.1", 0)) as silent:
        campaign = _campaign(f"http://127.0.0.1:{silent.getsockname()[1]}", tmp_path)
        with Store(campaign.catalog_url, campaign.name) as store:
            with pytest.raises(UnavailableError, match=r"cannot be listed: .*Timeout"):
                scan_archive(campaign, store)
            assert store.granules() == []
    http.clear_instance_cache()


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (403, "cannot be read: the server answers 403"),
        (500, "cannot be read: the server answers 500"),
        (404, "cannot be read: vanished"),
    ],
)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_file_that_is_denied_while_its_scene_is_processed_costs_this_file_alone(
    stand_in: StandIn, scheme: str, status: int, reason: str, tmp_path: Path
) -> None:
    campaign = _campaign(stand_in.url(scheme), tmp_path)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        (scene,) = cut_scenes(campaign, store.granules()).scenes
    stand_in.statuses["h1"] = status
    with local_files(campaign.archive, scene) as (root, denied):
        usable, _, refused = check_files(scene, root, read_all=True, denied=denied)
    assert [granule.path for granule in usable.granules] == ["coast/h0", "coast/h2", "coast/h3"]
    assert [(granule.path, granule.reason[: len(reason)]) for granule in refused] == [
        ("coast/h1", reason)
    ]
