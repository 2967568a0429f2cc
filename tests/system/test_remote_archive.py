"""Scans of archives behind a URL: a failed listing ends the scan, an unreadable file does not."""

from __future__ import annotations

import functools
import http.server
import os
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from support import factories
from support.archives import raw_archives

from lidarops.campaign.model import Campaign
from lidarops.catalog.folder import instruments_of, read_folder
from lidarops.catalog.raw_files import Source
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError
from lidarops.records import Status
from lidarops.run.archive import assess, update_catalog
from lidarops.system.stores import RemoteStore


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        """Do not log."""


@pytest.fixture
def campaign(tmp_path: Path) -> Iterator[Campaign]:
    """A campaign over two files on a web server with a plain index."""
    pytest.importorskip("aiohttp")
    for minute in range(2):
        path = tmp_path / "raw" / "coast" / f"h{minute}"
        raw_archives.write(path, raw_archives.content(minute))
    handler = functools.partial(_Quiet, directory=str(tmp_path / "raw"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        # Its end is looked for every half a second otherwise.
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        yield factories.campaign().model_copy(
            update={"archive": url, "output": str(tmp_path / "out")}
        )
        server.shutdown()


def test_a_web_server_is_scanned_like_a_folder(campaign: Campaign, tmp_path: Path) -> None:
    with Store(campaign.catalog_url, campaign.name) as store:
        summary = scan_archive(campaign, store)
        assert (summary.files, summary.added, summary.refused) == (2, 2, 0)
        remote = store.granules()
    in_folder = campaign.model_copy(update={"archive": str(tmp_path / "raw"), "name": "folder"})
    with Store(campaign.catalog_url, "folder") as store:
        scan_archive(in_folder, store)
        local = store.granules()
    assert [(g.path, g.size, g.start) for g in remote] == [(g.path, g.size, g.start) for g in local]
    digests = [
        [Source.of(scanned.archive).digest(granule.path) for granule in local]
        for scanned in (campaign, in_folder)
    ]
    assert digests[0] == digests[1]


def test_files_of_a_web_server_are_asked_for_together(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    both, alone = threading.Barrier(2), []
    send = http.server.SimpleHTTPRequestHandler.send_head

    def waiting(self: http.server.SimpleHTTPRequestHandler) -> Any:
        if "/h" in self.path:
            try:
                both.wait(20)
            except threading.BrokenBarrierError:
                alone.append(self.path)
        return send(self)

    monkeypatch.setattr(_Quiet, "send_head", waiting)
    with Store(campaign.catalog_url, campaign.name) as store:
        assert scan_archive(campaign, store).added == 2
    assert not alone


def test_a_missing_server_ends_the_scan_and_the_catalog_stays(campaign: Campaign) -> None:
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        before = store.granules()
        away = campaign.model_copy(update={"archive": "http://127.0.0.1:1"})
        with pytest.raises(CatalogError, match="cannot be listed"):
            scan_archive(away, store)
        assert store.granules() == before


@pytest.mark.parametrize(
    ("error", "refused"), [(PermissionError("denied"), 1), (ConnectionResetError("cut"), None)]
)
def test_a_denied_file_is_refused_but_a_lost_connection_ends_the_scan(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch, error: OSError, refused: int | None
) -> None:
    head = RemoteStore.head

    def failing(self: RemoteStore, path: str, size: int) -> bytes:
        if path == "coast/h1":
            with self._one_object(path):
                raise error
        return head(self, path, size)

    monkeypatch.setattr(RemoteStore, "head", failing)
    with Store(campaign.catalog_url, campaign.name) as store:
        if refused is None:
            with pytest.raises(CatalogError, match="cut"):
                scan_archive(campaign, store)
            assert store.granules() == []
            return
        assert scan_archive(campaign, store).refused == refused
        monkeypatch.undo()
        # The next scan tries it again although it is unchanged.
        assert scan_archive(campaign, store).refused == 0
        assert len(store.granules(status=Status.GOOD)) == 2


@pytest.mark.parametrize(
    ("error", "ends"), [(PermissionError("denied"), False), (ConnectionResetError("cut"), True)]
)
def test_a_store_that_is_lost_while_headers_are_compared_ends_the_run(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: OSError, ends: bool
) -> None:
    """Otherwise the header that all others contradict would pass as good."""
    for minute in range(2, 6):
        content = raw_archives.content(minute, bins=900 if minute == 4 else 600)
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{minute}", content)
    update_catalog(campaign)

    def lost(self: RemoteStore, path: str, _size: int) -> bytes:
        with self._one_object(path):
            raise error

    monkeypatch.setattr(RemoteStore, "head", lost)
    with pytest.raises(CatalogError, match="cut") if ends else nullcontext():
        assert list(assess(campaign, update=False, everything=True))


def test_a_file_of_a_web_server_that_is_replaced_by_one_of_the_same_size_is_seen(
    campaign: Campaign, tmp_path: Path
) -> None:
    """By the time of its last change: a plain server gives no tag."""
    file = tmp_path / "raw" / "coast" / "h1"
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        assert scan_archive(campaign, store).unchanged == 2
        file.write_bytes(raw_archives.content(1, seed=1))
        os.utime(file, (1.0, 1.0))
        summary = scan_archive(campaign, store)
        assert (summary.changed, summary.unchanged) == (1, 1)


ESCAPES = ["../../x", "%2e%2e/x", "coast/../../x", "..%5Cx", "coast//x"]
"""Links of an index that lead out of its folder, or to a file of another name in it."""
ELSEWHERE = ["/x", "//elsewhere.example/x", "http://elsewhere.example/x"]
"""Paths of a root, and links to another host."""


def _campaign_of_everything(campaign: Campaign, archive: str) -> Campaign:
    ((name, instrument),) = campaign.instruments.items()
    everything = instrument.model_copy(update={"files": ["*", "**/*"]})
    return campaign.model_copy(update={"archive": archive, "instruments": {name: everything}})


def test_a_link_that_leads_out_of_the_archive_is_refused(
    campaign: Campaign, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    index = tmp_path / "raw" / "index.html"
    links = [*ESCAPES, *ELSEWHERE, "coast/h0"]
    index.write_text("".join(f'<a href="{link}">x</a>' for link in links))
    everything = _campaign_of_everything(campaign, campaign.archive)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(everything, store)
        granules = {granule.path: granule for granule in store.granules()}
    # The driver lists links that resolve to one address once, under any of their names, and links
    # to other folders and hosts not at all.
    assert len(granules) > 1
    assert granules.pop("coast/h0").status is Status.GOOD
    assert granules.pop("x").reason == "cannot be read: the server answers 404"
    for granule in granules.values():
        assert granule.status is Status.REFUSED
        assert "leads out of the archive" in granule.reason
    assert f"lists {len(granules)} names that lead out of it" in caplog.text


def test_a_dead_link_costs_no_other_file(campaign: Campaign, tmp_path: Path) -> None:
    links = "".join(f'<a href="{link}">x</a>' for link in ("coast/gone", "coast/h0"))
    (tmp_path / "raw" / "index.html").write_text(links)
    everything = _campaign_of_everything(campaign, campaign.archive)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(everything, store)
        gone, good = store.granules()
    assert (good.path, good.status) == ("coast/h0", Status.GOOD)
    assert (gone.path, gone.reason) == ("coast/gone", "cannot be read: the server answers 404")


def _failing_on(name: str, status: int, patch: pytest.MonkeyPatch) -> None:
    """Let the server answer with a status for one file."""
    send_head = _Quiet.send_head

    def failing(self: _Quiet) -> Any:
        return self.send_error(status) if self.path.endswith(name) else send_head(self)

    patch.setattr(_Quiet, "send_head", failing)


@pytest.mark.parametrize("status", [401, 403, 429, 500, 503])
def test_a_file_that_a_server_denies_is_refused_until_it_gives_it(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        before = store.granules()
        with monkeypatch.context() as patch:
            _failing_on("h1", status, patch)
            for _ in range(2):
                assert scan_archive(campaign, store).refused == 1
            assert store.granules(status=Status.GOOD) == before[:1]
            (refused,) = store.refused()
            assert refused.reason == f"cannot be read: the server answers {status}"
        assert scan_archive(campaign, store).refused == 0
        assert store.granules() == before


@pytest.mark.parametrize("status", [403, 503])
def test_a_file_that_no_instrument_claims_may_fail(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    (tmp_path / "raw" / "notes.txt").write_text("x")
    _failing_on("notes.txt", status, monkeypatch)
    with Store(campaign.catalog_url, campaign.name) as store:
        assert scan_archive(campaign, store).files == 2


def test_an_index_that_lists_its_own_folder_costs_no_file(
    campaign: Campaign, tmp_path: Path
) -> None:
    (tmp_path / "raw" / "index.html").write_text(
        '<a href="./">x</a><a href="/">z</a><a href="coast/h0">y</a>'
    )
    everything = _campaign_of_everything(campaign, campaign.archive)
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(everything, store)
        granules = {granule.path: granule.status for granule in store.granules()}
    assert granules == {"coast/h0": Status.GOOD, "./": Status.REFUSED}


S3 = pytest.param("s3", marks=pytest.mark.slow)
"""By a server of another package; the stand-in of `support.servers` answers as one by default."""


@pytest.fixture(params=["http", S3, "memory", "file"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> RemoteStore:
    """A store of each kind with the raw file ``coast/h0``."""
    if request.param == "http":
        return RemoteStore(request.getfixturevalue("campaign").archive)
    urls = {"memory": f"memory://{tmp_path.name}", "file": f"file://{tmp_path}/store"}
    if request.param == "s3":
        urls["s3"] = f"{request.getfixturevalue('s3')}/{tmp_path.name}"
    filled = RemoteStore(urls[request.param])
    filled._fs.makedirs(filled._name("coast"), exist_ok=True)
    filled._fs.pipe_file(filled._name("coast/h0"), raw_archives.content(0))
    return filled


NAMES = ["h6.0", "h7.0", "h8.0", "h6/h6.0", "+4 5/h6.0", "[a]/h6.0", "{a,b}/h6.0", "a/b/h6.0"]
"""Files whose folders and names hold characters that patterns and URLs use."""


@pytest.fixture(params=["folder", "http", S3, "memory", "file"])
def archive(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Folder or URL of each kind that holds one raw file under each of `NAMES`."""
    files = {f"n/{name}": raw_archives.content(0) for name in NAMES}
    if request.param in {"folder", "http"}:
        for path, content in files.items():
            raw_archives.write(tmp_path / "raw" / path, content)
        if request.param == "folder":
            return str(tmp_path / "raw" / "n")
        return f"{request.getfixturevalue('campaign').archive}/n"
    urls = {"memory": f"memory://{tmp_path.name}", "file": f"file://{tmp_path}/store"}
    if request.param == "s3":
        urls["s3"] = f"{request.getfixturevalue('s3')}/{tmp_path.name}"
    filled = RemoteStore(urls[request.param])
    for path, content in files.items():
        filled._fs.makedirs(filled._name(path.rpartition("/")[0]), exist_ok=True)
        filled._fs.pipe_file(filled._name(path), content)
    return f"{filled.url}/n"


PATTERNS = {
    "h6*": ["h6.0"],
    "h[67].0*": ["h6.0", "h7.0"],
    "h[!67].?": ["h8.0"],
    "h[^6-7].?": ["h8.0"],
    "h[7-6].0": [],
    "h{6,8}.0": ["h6.0", "h8.0"],
    "{h{7,8}.0,+4 5/h*,a/b/*}": ["+4 5/h6.0", "a/b/h6.0", "h7.0", "h8.0"],
    "*/h*": ["+4 5/h6.0", "[a]/h6.0", "h6/h6.0", "{a,b}/h6.0"],
    "h?[!x]h*": [],
    "[[]a]/h*": ["[a]/h6.0"],
    "[{]a,b}/h*": ["{a,b}/h6.0"],
    "[a]/**": ["a/b/h6.0"],
    "**/h[6]*": sorted(name for name in NAMES if "h6.0" in name),
}


def _claimed(archive: str, files: str | list[str], output: Path) -> list[str]:
    """Return the names that the patterns of a campaign file claim in an archive."""
    scanned = factories.campaign(files=files, dark_files=[]).model_copy(
        update={"archive": archive, "output": str(output)}
    )
    with Store(scanned.catalog_url, "c") as catalog:
        scan_archive(scanned, catalog)
        return sorted(unquote(granule.path) for granule in catalog.granules())


@pytest.mark.slow
def test_patterns_are_those_of_a_shell_in_each_store(archive: str, tmp_path: Path) -> None:
    for number, (pattern, names) in enumerate(PATTERNS.items()):
        assert _claimed(archive, pattern, tmp_path / f"out{number}") == names, pattern


def test_drafted_patterns_match_the_files_of_each_store(archive: str, tmp_path: Path) -> None:
    (instrument,) = instruments_of(read_folder(archive).groups)
    assert _claimed(archive, list(instrument.files), tmp_path) == sorted(NAMES)


@pytest.mark.parametrize("path", [*ESCAPES, *ELSEWHERE])
def test_no_name_of_a_store_leads_out_of_it(store: RemoteStore, tmp_path: Path, path: str) -> None:
    folder = tmp_path / "one" / "two"
    with pytest.raises(OSError, match="leads out"):
        store.fetch(["coast/h0", path], folder)
    assert not folder.exists()
    assert not list(tmp_path.rglob("x"))
    with pytest.raises(OSError, match="leads out"):
        store.head(path, 9)
    with pytest.raises(OSError, match="leads out"):
        store.digest(path)


def test_names_of_a_listing_that_lead_out_of_the_store_are_reported(
    store: RemoteStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    find = RemoteStore._find

    def hostile(store: RemoteStore) -> dict[str, Any]:
        info = {"size": 9, "mtime": 0.0}
        return find(store) | {store._name(path): info for path in [*ESCAPES, *ELSEWHERE]}

    monkeypatch.setattr(RemoteStore, "_find", hostile)
    campaign = factories.campaign().model_copy(update={"output": str(tmp_path / "out")})
    for patterns in (["coast/*"], ["**/*"]):
        ((name, instrument),) = campaign.instruments.items()
        claims = instrument.model_copy(update={"files": patterns})
        scanned = campaign.model_copy(
            update={"archive": store.url, "instruments": {name: claims}, "name": "c"}
        )
        caplog.clear()
        with Store(campaign.catalog_url, "c") as catalog:
            scan_archive(scanned, catalog)
            granules = {granule.path: granule for granule in catalog.granules()}
        # Whether or not an instrument claims them.
        assert f"lists {len(ESCAPES) + len(ELSEWHERE)} names that lead out of it" in caplog.text
        assert granules["coast/h0"].status is Status.GOOD
    refused = [granule for granule in granules.values() if granule.status is Status.REFUSED]
    assert len(refused) == len(ESCAPES) + len(ELSEWHERE)
    assert all("leads out" in granule.reason for granule in refused)
