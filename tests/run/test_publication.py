"""Raw files in a store and products copied to a store: the same bytes as on a disk."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml
from support import factories
from support.archives import raw_archives
from typer.testing import CliRunner

from lidarops.campaign.model import load_campaign
from lidarops.catalog.product_files import publish_products
from lidarops.cli import app
from lidarops.run.archive import reprocess
from lidarops.system.stores import RemoteStore


@pytest.fixture
def campaign_file(tmp_path: Path) -> Path:
    """A campaign of two scenes and a damaged file."""
    for hour in (0, 30):
        content = raw_archives.content(60.0 * hour, bins=1000)
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{hour:02d}", content)
    raw_archives.write(tmp_path / "raw" / "coast" / "h99", b"broken")
    path = tmp_path / "campaign.yaml"
    path.write_text(
        yaml.safe_dump(factories.campaign().model_dump(mode="json", exclude={"simulation"}))
    )
    return path


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*.nc")
    }


@pytest.mark.slow
def test_raw_from_s3_and_products_to_s3(tmp_path: Path, campaign_file: Path, s3: str) -> None:
    import fsspec

    url = f"{s3}/{tmp_path.name}"
    fs, prefix = fsspec.core.url_to_fs(url)
    raw = tmp_path / "raw"
    for path in raw.rglob("h*"):
        fs.put_file(str(path), f"{prefix}/raw/{path.relative_to(raw)}")
    on_disk = load_campaign(campaign_file, output=tmp_path / "disk")
    in_store = load_campaign(campaign_file, archive=f"{url}/raw", output=tmp_path / "store")
    assert reprocess(on_disk) is not None
    record = reprocess(in_store)
    assert record is not None
    expected = digests(on_disk.products_root)
    assert len(expected) == 2
    # No product contains the name of the archive.
    assert digests(in_store.products_root) == expected

    done = publish_products(in_store, f"{url}/products")
    assert sorted(done.uploaded) == sorted(expected)
    store = RemoteStore(f"{url}/products")
    store.fetch(list(expected), tmp_path / "fetched")
    assert digests(tmp_path / "fetched") == expected
    assert reprocess(in_store) is None
    again = publish_products(in_store, f"{url}/products")
    assert (again.uploaded, again.unchanged, again.others) == ((), 2, 0)


def test_the_command_line_publishes_and_says_what_it_did(
    tmp_path: Path, campaign_file: Path
) -> None:
    campaign = load_campaign(campaign_file)
    assert reprocess(campaign) is not None
    runner, store = CliRunner(), tmp_path / "store"
    words = ["publish", str(campaign_file), store.as_uri()]
    first = runner.invoke(app, [*words, "--json"])
    assert first.exit_code == 0, first.output
    expected = digests(campaign.products_root)
    assert sorted(json.loads(first.stdout)["uploaded"]) == sorted(expected)
    assert digests(store) == expected
    (store / "note.txt").write_text("of somebody else")
    again = runner.invoke(app, words, env={"COLUMNS": "300"})
    assert "0 sent, 2 unchanged, 1 other files left alone" in again.stdout
    product = next(campaign.products_root.rglob("*.nc"))
    product.write_bytes(product.read_bytes()[:-1] + b"?")
    next(store.rglob(product.name)).unlink()
    damaged = runner.invoke(app, words)
    assert damaged.exit_code == 1
    assert "differs from the ledger" in damaged.output
    assert digests(store).items() <= expected.items()


def test_publishing_before_any_run_is_refused(tmp_path: Path, campaign_file: Path) -> None:
    words = ["publish", str(campaign_file), (tmp_path / "store").as_uri()]
    refused = CliRunner().invoke(app, words, env={"COLUMNS": "300"})
    assert refused.exit_code == 1
    assert "there is no catalog yet (run lidarops reprocess first)" in refused.output
    assert not list(tmp_path.rglob("catalog.sqlite"))
    assert not (tmp_path / "store").exists()


def test_a_vanished_product_is_reported_before_and_after_it_was_sent(
    tmp_path: Path, campaign_file: Path
) -> None:
    campaign = load_campaign(campaign_file)
    assert reprocess(campaign) is not None
    words = ["publish", str(campaign_file), (tmp_path / "store").as_uri()]
    product = next(campaign.products_root.rglob("*.nc"))
    content = product.read_bytes()
    for _ in range(2):
        product.unlink()
        refused = CliRunner().invoke(app, words, env={"COLUMNS": "300"})
        assert refused.exit_code == 1
        assert f"{product}: is missing (run lidarops reprocess)" in refused.output
        product.write_bytes(content)
        assert CliRunner().invoke(app, words).exit_code == 0


def test_keys_in_the_url_are_not_shown(campaign_file: Path) -> None:
    campaign = load_campaign(campaign_file)
    assert reprocess(campaign) is not None
    place = f"bucket/{campaign_file.parent.name}"
    done = CliRunner().invoke(app, ["publish", str(campaign_file), f"memory://{place}"])
    assert done.exit_code == 0, done.output
    assert done.output.startswith(f"memory://{place}: 2 sent")
    for scheme in ("memory", "http", "luck"):
        url = f"{scheme}://key:sec/ret@{place}"
        refused = CliRunner().invoke(app, ["publish", str(campaign_file), url])
        assert refused.exit_code == 2
        assert "://bucket" in refused.output
        assert "ret" not in refused.output


def test_the_site_is_published_beside_the_products(tmp_path: Path, campaign_file: Path) -> None:
    campaign = load_campaign(campaign_file)
    assert reprocess(campaign) is not None
    runner, store = CliRunner(), tmp_path / "store"
    words = ["publish", str(campaign_file), store.as_uri(), "--site"]
    refused = runner.invoke(app, words, env={"COLUMNS": "300"})
    assert refused.exit_code == 1
    assert "there is no complete site" in refused.output
    assert runner.invoke(app, ["site", str(campaign.output)]).exit_code == 0
    refused = runner.invoke(app, words, env={"COLUMNS": "300"})
    assert refused.exit_code == 1
    assert "--products-at .." in refused.output
    for dead in ("products", "../../archive"):
        words_of_site = ["site", str(campaign.output), "--products-at", dead]
        assert runner.invoke(app, words_of_site).exit_code == 0
        assert "--products-at .." in runner.invoke(app, words, env={"COLUMNS": "300"}).output
    made = runner.invoke(app, ["site", str(campaign.output), "--products-at", ".."])
    assert made.exit_code == 0, made.output
    sent = runner.invoke(app, words)
    assert sent.exit_code == 0, sent.output
    for page in (store / "site").rglob("*.html"):
        for href in re.findall(r'<a [^>]*href="([^"#]+)', page.read_text(encoding="utf-8")):
            file = (page.parent / unquote(href)).resolve()
            assert file.is_relative_to(store.resolve()), href
            assert file.is_file(), href
    again = runner.invoke(app, words).output
    assert "0 sent" in again.splitlines()[-1]
    assert "other files" not in again
    elsewhere = ["--products-at", "https://example.org/products"]
    assert runner.invoke(app, ["site", str(campaign.output), *elsewhere]).exit_code == 0
    assert runner.invoke(app, words).exit_code == 0
