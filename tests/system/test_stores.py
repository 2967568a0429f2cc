"""Read from and publish to stores: S3 (a server on loopback), HTTP, other URLs."""

from __future__ import annotations

import functools
import hashlib
import http.server
import threading
from pathlib import Path

import pytest
from support.servers.ports import KEYS, free_port

from lidarops.errors import CatalogError, ProductError, UnavailableError
from lidarops.system.stores import RemoteStore, without_keys


@pytest.fixture(params=[pytest.param("s3", marks=pytest.mark.slow), "memory", "file"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty store of each kind."""
    name = tmp_path.name
    if request.param == "s3":
        return f"{request.getfixturevalue('s3')}/{name}"
    return f"memory://{name}" if request.param == "memory" else f"file://{tmp_path}/store"


def products(root: Path, **content: bytes) -> dict[str, str]:
    digests = {}
    for name, data in content.items():
        path = root / "coast" / f"{name}.nc"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        digests[f"coast/{name}.nc"] = hashlib.sha256(data).hexdigest()
    return digests


def test_publish_sends_what_is_missing_or_changed_and_nothing_else(
    tmp_path: Path, url: str
) -> None:
    root, journal = tmp_path / "products", tmp_path / "journal"
    made = products(root, a=b"one", b=b"two")
    store = RemoteStore(url)
    assert store.publish(root, made, journal).uploaded == tuple(made)
    assert store.publish(root, made, journal).uploaded == ()
    # The same size within the same second: neither shows the change.
    made |= products(root, a=b"ONE", c=b"three")
    again = store.publish(root, made, journal)
    assert again.uploaded == ("coast/a.nc", "coast/c.nc")
    assert again.unchanged == 1
    assert {each.path: store.head(each.path, 9) for each in store.files()} == {
        "coast/a.nc": b"ONE",
        "coast/b.nc": b"two",
        "coast/c.nc": b"three",
    }


def test_publish_leaves_other_objects_alone_and_counts_them(tmp_path: Path, url: str) -> None:
    made = products(tmp_path / "products", a=b"one", b=b"two")
    store = RemoteStore(url)
    store.publish(tmp_path / "products", made, tmp_path / "journal")
    made.pop("coast/b.nc")
    assert store.publish(tmp_path / "products", made, tmp_path / "journal").others == 1
    assert len(list(store.files())) == 2


def test_publish_repairs_a_store_that_lost_or_cut_an_object(tmp_path: Path, url: str) -> None:
    import fsspec

    root, journal = tmp_path / "products", tmp_path / "journal"
    made = products(root, a=b"one", b=b"two", c=b"three")
    store = RemoteStore(url)
    store.publish(root, made, journal)
    fs, prefix = fsspec.core.url_to_fs(url)
    fs.rm_file(f"{prefix}/coast/a.nc")
    fs.pipe_file(f"{prefix}/coast/b.nc", b"t")
    assert store.publish(root, made, journal).uploaded == ("coast/a.nc", "coast/b.nc")


def test_publish_repairs_an_object_that_another_of_its_size_replaced(
    tmp_path: Path, url: str
) -> None:
    import fsspec

    root, journal = tmp_path / "products", tmp_path / "journal"
    made = products(root, a=b"one", b=b"two")
    store = RemoteStore(url)
    store.publish(root, made, journal)
    assert store.publish(root, made, journal).uploaded == ()
    fs, prefix = fsspec.core.url_to_fs(url)
    # S3 states times in seconds, so only the tag shows this.
    fs.pipe_file(f"{prefix}/coast/a.nc", b"ONE")
    assert store.publish(root, made, journal).uploaded == ("coast/a.nc",)
    assert store.head("coast/a.nc", 9) == b"one"
    assert store.publish(root, made, journal).uploaded == ()


def test_publish_after_a_crash_in_the_journal(tmp_path: Path, url: str) -> None:
    root, journal = tmp_path / "products", tmp_path / "journal"
    made = products(root, a=b"one", b=b"two")
    store = RemoteStore(url)
    store.publish(root, made, journal)
    # The digests come first, then what the store states of its copies.
    digests = journal.read_text().splitlines()[:3]
    journal.write_text("\n".join(digests)[:-4])
    assert store.publish(root, made, journal).uploaded == ("coast/b.nc",)
    journal.write_text(journal.read_text()[:-4])
    assert store.publish(root, made, journal).uploaded == ()


def test_publish_refuses_a_product_that_differs_from_the_ledger(tmp_path: Path, url: str) -> None:
    made = products(tmp_path, a=b"one")
    (tmp_path / "coast" / "a.nc").write_bytes(b"eno")
    with pytest.raises(ProductError, match="differs from the ledger"):
        RemoteStore(url).publish(tmp_path, made, tmp_path / "journal")
    with pytest.raises(CatalogError, match="cannot be listed"):
        list(RemoteStore(url).files())


@pytest.mark.slow
def test_publish_of_many_parts(tmp_path: Path, s3: str) -> None:
    # Above twice the part size, S3 assembles an object from parts.
    data = bytes(range(256)) * 4096 * 120
    made = products(tmp_path / "products", big=data)
    store = RemoteStore(f"{s3}/{tmp_path.name}")
    store.publish(tmp_path / "products", made, tmp_path / "journal")
    store.fetch(list(made), tmp_path / "back")
    assert (tmp_path / "back" / "coast" / "big.nc").read_bytes() == data


def test_a_failed_upload_leaves_the_old_object(
    tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fsspec

    root, journal = tmp_path / "products", tmp_path / "journal"
    store = RemoteStore(url)
    store.publish(root, products(root, a=b"one"), journal)
    fs, _ = fsspec.core.url_to_fs(url)

    def broken(*args, **kwargs):
        raise ConnectionResetError("cut")

    for name in ("put", "mv"):
        monkeypatch.setattr(fs, name, broken)
    changed = products(root, a=b"another")
    with pytest.raises(UnavailableError, match="cannot be written"):
        store.publish(root, changed, journal)
    assert [(each.path, each.size) for each in store.files()] == [("coast/a.nc", 3)]
    monkeypatch.undo()
    assert store.publish(root, changed, journal).uploaded == ("coast/a.nc",)


def test_fetch_leaves_out_what_the_store_lacks(tmp_path: Path, url: str) -> None:
    made = products(tmp_path / "products", a=b"one", b=b"two")
    store = RemoteStore(url)
    store.publish(tmp_path / "products", made, tmp_path / "journal")
    store.fetch(["coast/a.nc", "coast/gone.nc", "coast/b.nc"], tmp_path / "back")
    fetched = sorted(path.name for path in (tmp_path / "back").rglob("*") if path.is_file())
    assert fetched == ["a.nc", "b.nc"]
    assert (tmp_path / "back" / "coast" / "b.nc").read_bytes() == b"two"


def test_http_is_read_and_never_written(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp")
    made = products(tmp_path / "served", a=b"one", b=b"two!")
    handler = functools.partial(QuietHandler, directory=str(tmp_path / "served"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        try:
            store = RemoteStore(f"http://127.0.0.1:{server.server_port}")
            assert [(f.path, f.size) for f in store.files()] == [
                ("coast/a.nc", 3),
                ("coast/b.nc", 4),
            ]
            store.fetch([*made, "coast/gone.nc"], tmp_path / "back")
            assert (tmp_path / "back" / "coast" / "b.nc").read_bytes() == b"two!"
            assert not (tmp_path / "back" / "coast" / "gone.nc").exists()
            with pytest.raises(ProductError, match="read-only"):
                store.publish(tmp_path / "served", made, tmp_path / "journal")
        finally:
            server.shutdown()


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        """Do not log."""


@pytest.mark.parametrize(
    "unknown",
    ["nothing://bucket", "s3x://bucket/a", "http://[::1", "http://host:99999/a", "reference://a",
     "github://a", "dir://a"],
)  # fmt: skip
def test_a_url_that_no_driver_can_open_is_wrong_use(unknown: str) -> None:
    with pytest.raises(CatalogError, match="cannot be opened") as caught:
        RemoteStore(unknown)
    assert caught.value.wrong_use


def test_a_url_whose_driver_lists_nothing_is_reported() -> None:
    with pytest.raises(UnavailableError, match="cannot be listed"):
        list(RemoteStore("data://a").files())


def test_a_store_that_does_not_answer_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    s3fs = pytest.importorskip("s3fs")
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    s3fs.S3FileSystem.clear_instance_cache()
    store = RemoteStore("s3://archive/nowhere")
    with pytest.raises(CatalogError, match="cannot be listed"):
        list(store.files())
    with pytest.raises(CatalogError, match="cannot be read"):
        store.fetch(["a"], tmp_path)
    with pytest.raises(UnavailableError, match="cannot be listed"):
        store.publish(tmp_path, products(tmp_path, a=b"1"), tmp_path / "journal")
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("s3://key:secret@bucket/a", "s3://bucket/a"),
        ("s3://key:se/c@ret@bucket/a", "s3://bucket/a"),
        ("https://token@host:8080/a", "https://host:8080/a"),
        (
            "get https://host/a?sig=x%2By&t=1 and 'https://host/b?t=2'",
            "get https://host/a and 'https://host/b'",
        ),
        ("simplecache::s3://key:secret@bucket", "simplecache::s3://bucket"),
        ("HTTPS://host/a?sig=x", "HTTPS://host/a"),
        ("webhdfs://host/a?delegation=x", "webhdfs://host/a"),
        ("https://host/a'b?sig=x'y", "https://host/a'b"),
        ("(https://host/a#token=x).", "(https://host/a)."),
        ("simplecache::file:///folder/a?b#c", "simplecache::file:///folder/a?b#c"),
        ("s3://bucket/a@b", "s3://bucket/a@b"),
        ("file:///folder/a@b", "file:///folder/a@b"),
        ("file:///folder/a?b", "file:///folder/a?b"),
        ("abfs://container@account.dfs.core.windows.net/a",) * 2,
        ("no address at all", "no address at all"),
    ],
)
def test_keys_are_left_out_of_messages(url: str, shown: str) -> None:
    assert without_keys(url) == shown


@pytest.mark.parametrize(
    "url",
    [
        "s3://key:swordfish@bucket/a",
        "s3://key:sword/swordfish@bucket/a",
        "https://swordfish@host/a",
        "https://host/a?sig=swordfish",
        "s3://bucket/a?secret=swordfish",
        "abfs://container@account/a?sig=swordfish",
        "simplecache::s3://key:swordfish@bucket",
        "S3://bucket/a?secret=swordfish",
        "oss://bucket/a?secret=swordfish",
        "https://host/a'b?sig=swordfish",
        "https://host/a#token=swordfish",
    ],
)
def test_a_url_with_keys_is_refused_with_the_way_to_give_them(url: str) -> None:
    with pytest.raises(CatalogError, match="AWS_ACCESS_KEY_ID") as caught:
        RemoteStore(url)
    assert caught.value.wrong_use
    assert "swordfish" not in str(caught.value)
