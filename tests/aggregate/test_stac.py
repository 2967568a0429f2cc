"""The STAC catalog, validated with the schemas of pystac without a network."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path

import pytest
from support.archives.aggregate_archive import add_day, facts_of

from lidarops.aggregate.stac import write_stac
from lidarops.errors import ProductError

pystac = pytest.importorskip("pystac")


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    for day in range(2):
        add_day(tmp_path / "out", day)
        add_day(tmp_path / "out", day, "signal")
    return tmp_path / "out"


def test_the_catalog_is_valid_and_links_to_products_after_a_move(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = write_stac(archive, facts_of(archive))
    moved = tmp_path / "moved"
    shutil.move(archive, moved)

    def refuse(*_args: object) -> None:
        raise OSError("no network here")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    catalog = pystac.Catalog.from_file(str(moved / path))
    assert catalog.validate_all() == 4
    items = list(catalog.get_items(recursive=True))
    assert {item.collection_id for item in items} == {"homogeneous", "signal"}
    by_id = {facts.id: facts for facts in facts_of(moved)}
    for item in items:
        facts = by_id[item.properties["lidarops:id"]]
        product = Path(item.assets["product"].get_absolute_href())
        assert product.resolve() == (moved / facts.path).resolve()
        assert item.assets["product"].extra_fields["lidarops:sha256"] == facts.sha256
        assert item.geometry["coordinates"] == [30.76, 46.44]
        assert item.common_metadata.start_datetime == facts.start


def test_every_link_is_relative(archive: Path):
    catalog = archive / write_stac(archive, facts_of(archive))
    for file in catalog.parent.rglob("*.json"):
        document = json.loads(file.read_text())
        hrefs = [link["href"] for link in document["links"]]
        hrefs += [asset["href"] for asset in document.get("assets", {}).values()]
        assert all(href.startswith(("./", "../")) for href in hrefs), hrefs


def test_a_published_catalog_links_published_products(archive: Path):
    catalog = archive / write_stac(archive, facts_of(archive), "https://example.org/lidar/")
    items = [json.loads(file.read_text()) for file in catalog.parent.glob("*/*/*.json")]
    published = {item["assets"]["product"]["href"] for item in items}
    paths = [facts.path.removeprefix("products/") for facts in facts_of(archive)]
    assert published == {f"https://example.org/lidar/{path}" for path in paths}
    with pytest.raises(ProductError, match="is no address"):
        write_stac(archive, facts_of(archive), "../products")


def test_a_second_catalog_replaces_the_first(archive: Path):
    catalog = archive / write_stac(archive, facts_of(archive))
    first = {file: file.read_bytes() for file in catalog.parent.rglob("*.json")}
    assert write_stac(archive, facts_of(archive))
    assert {file: file.read_bytes() for file in catalog.parent.rglob("*.json")} == first
    write_stac(archive, [facts for facts in facts_of(archive) if facts.kind == "signal"])
    assert not (catalog.parent / "homogeneous").exists()


def test_equal_names_are_refused(archive: Path):
    facts = facts_of(archive)
    other = archive / "products/copy" / Path(facts[0].path).name
    other.parent.mkdir()
    shutil.copy(archive / facts[0].path, other)
    with pytest.raises(ProductError, match="has the file name of"):
        write_stac(archive, facts_of(archive))
