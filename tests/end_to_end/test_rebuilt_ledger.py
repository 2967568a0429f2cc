"""A ledger that is lost is made again from the products' own provenance."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import netCDF4
import pytest
from support.archives.small_archive import Archive, made
from support.products.damaged_products import damage_values
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.run import ledger_run
from lidarops.run.archive import bring_up_to_date, reprocess, update_catalog
from lidarops.run.ledger_run import rebuild_ledger

_OF_THE_RUN = {"run"}


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    archive = Archive(tmp_path_factory.mktemp("processed"), days=2)
    assert len(made(reprocess(archive.write()))) == 12
    return archive.folder


@pytest.fixture
def archive(processed: Path, tmp_path: Path) -> Archive:
    """A copy of a processed archive, with the same modification times."""
    shutil.copytree(processed, tmp_path / "archive")
    return Archive(tmp_path / "archive")


def _lose(archive: Archive) -> None:
    for file in (archive.folder / "out").glob("catalog.sqlite*"):
        file.unlink()


def _rows(campaign: Campaign) -> list[dict[str, Any]]:
    with Store(campaign.catalog_url, campaign.name) as store:
        rows = [
            {key: value for key, value in row.items() if key not in _OF_THE_RUN}
            for row in store.products()
        ]
        return [{**row, "inputs": store.inputs_of(row["path"])} for row in rows]


def test_a_lost_ledger_is_restored_row_by_row(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Quality flags are read a profile at a time.
    monkeypatch.setattr(ledger_run, "_BLOCK", 1)
    campaign = archive.write()
    before = _rows(campaign)
    contents = archive.contents("out/products")
    _lose(archive)
    update_catalog(campaign)
    rebuilt = rebuild_ledger(campaign)
    assert (rebuilt.entered, rebuilt.known, rebuilt.without_scene) == (len(before), 0, 0)
    assert rebuilt.problems == {}
    assert _rows(campaign) == before
    assert reprocess(campaign) is None
    assert archive.contents("out/products") == contents
    assert rebuild_ledger(campaign).known == len(before)


def test_an_interrupted_rebuild_keeps_the_days_that_it_has_entered(archive: Archive) -> None:
    _lose(archive)
    campaign = archive.write()
    update_catalog(campaign)
    read = 0

    def interrupt(_done: int) -> None:
        nonlocal read
        read += 1
        if read > 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rebuild_ledger(campaign, progress=interrupt)
    rebuilt = rebuild_ledger(campaign)
    assert (rebuilt.known, rebuilt.entered) == (6, 6)
    assert reprocess(campaign) is None


def test_products_made_otherwise_are_stale_after_it(archive: Archive) -> None:
    _lose(archive)
    archive.tree["instruments"]["rich"]["products"]["elastic"]["lidar_ratio"] = 42
    archive.flip("raw/poor/h01")
    campaign = archive.write()
    update_catalog(campaign)
    rebuild_ledger(campaign)
    record = reprocess(campaign)
    assert made(record) == {
        "rich 1 elastic analog", "rich 2 elastic analog",
        "poor 1 signal analog", "poor 1 signal photon",
    }  # fmt: skip


def test_products_whose_raw_files_are_gone_are_known(archive: Archive) -> None:
    _lose(archive)
    for file in (archive.folder / "raw/poor").glob("h1*"):
        file.unlink()
    shown = CliRunner().invoke(app, ["catalog", str(archive.file), "--rebuild", "--json"])
    assert json.loads(shown.stdout)["rebuilt"]["without_scene"] == 2
    archive.tree["vanished_share"] = 1
    result = bring_up_to_date(archive.write())
    assert {Path(path).name for path in result.lost} == {
        f"coast_poor_signal_{channel}_20260302T000000.nc"
        for channel in ("analog_532o", "photon_532o")
    }
    assert CliRunner().invoke(app, ["verify", str(archive.file), "--products-only"]).exit_code == 0


def test_files_that_products_state_as_unused_count_as_lost(archive: Archive) -> None:
    damaged = [archive.folder / f"raw/poor/h{day}1" for day in (0, 1)]
    for path in damaged:
        path.write_bytes(path.read_bytes()[:-100])
    assert len(made(reprocess(archive.write()))) == 4
    for path in damaged:
        path.unlink()
    _lose(archive)
    campaign = archive.write()
    update_catalog(campaign)
    rebuild_ledger(campaign)
    result = bring_up_to_date(campaign)
    assert made(result.record) == set()
    (lost,) = result.findings.lost_files
    assert (lost.files, lost.kept) == (2, 4)


def test_files_that_are_not_products_of_the_campaign_are_named(archive: Archive) -> None:
    _lose(archive)
    products = archive.folder / "out/products"
    first, second, third, fourth = sorted(products.rglob("*poor*.nc"))
    first.write_bytes(first.read_bytes()[:2000])
    shutil.copy(second, products / "copy.nc")
    damage_values(third, "quality_flag")
    with netCDF4.Dataset(fourth, "a") as product:
        product["provenance"][...] = '{"entity": {"lidarops:product": []}}'
    shown = CliRunner().invoke(app, ["catalog", str(archive.file), "--rebuild"])
    assert isinstance(shown.exception, SystemExit)
    assert shown.exit_code == 1
    for words in (first.name, "copy.nc", "should have the name", third.name, fourth.name):
        assert words in shown.stdout
    assert made(reprocess(archive.write())) == {
        "poor 1 signal analog", "poor 1 signal photon", "poor 2 signal photon",
    }  # fmt: skip
