"""A file whose date its neighbours by name contradict is refused as long as they do."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import xarray as xr
from support.archives.small_archive import DAY, Archive

from lidarops.campaign.model import Campaign
from lidarops.catalog import scan
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.run.archive import bring_up_to_date, remove_orphans

MINUTES = (600.0, 601.0, 602.0, 603.0 + 41 * DAY, 604.0, 605.0, 45 * DAY, 45 * DAY + 1.0)
"""Starts of the files h0 to h7; a later session is not wrong, h3 is."""
REASON = (
    "more than a day away from the files beside it by name, poor/h2 (2026-03-01 10:02) and poor/h4"
    " (2026-03-01 10:04): it starts 2026-04-11 10:03 (correct the date in its header; if it is"
    " right, rename the file or move it to another folder)"
)


def _archive(folder: Path) -> Archive:
    archive = Archive(folder, days=0)
    del archive.tree["instruments"]["rich"]
    (folder / "raw/poor").mkdir(parents=True, exist_ok=True)
    return archive


def _add(archive: Archive, *numbers: int) -> None:
    for number in numbers:
        archive.raw(f"poor/h{number}", MINUTES[number], seed=number)


def _refused(campaign: Campaign) -> dict[str, str]:
    with Store(campaign.catalog_url, campaign.name) as store:
        scan_archive(campaign, store)
        return {granule.path: granule.reason for granule in store.refused()}


def test_no_product_is_made_of_it_and_those_of_its_neighbours_state_it(tmp_path: Path) -> None:
    archive = _archive(tmp_path)
    _add(archive, *range(8))
    campaign = archive.write()
    result = bring_up_to_date(campaign)
    assert result.has_failures
    assert _refused(campaign) == {"poor/h3": REASON}
    products = sorted(campaign.products_root.rglob("*photon*.nc"))
    assert [path.stem.split("_")[-1][:8] for path in products] == ["20260301", "20260415"]
    with xr.open_dataset(products[0]) as product:
        assert product.sizes["time"] == 5
        assert "poor/h3: more than a day away" in product.attrs[UNUSED_INPUTS]
    again = bring_up_to_date(campaign)
    assert again.record is None
    assert [granule.reason for granule in again.refused] == [REASON]


@pytest.mark.parametrize("batch", [1, 2000])
@pytest.mark.parametrize("seed", range(3))
def test_the_order_in_which_files_come_and_go_does_not_matter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, batch: int
) -> None:
    """A file that counts on from none is right until its neighbours come, and when they go."""
    monkeypatch.setattr(scan, "_BATCH", batch)
    archive = _archive(tmp_path)
    campaign = archive.write()
    order = random.Random(seed).sample(range(8), 8)
    for number in order:
        _add(archive, number)
        refused = _refused(campaign)
    assert refused == {"poor/h3": REASON}
    for number in (0, 1, 2):
        (tmp_path / f"raw/poor/h{number}").unlink()
    assert _refused(campaign) == {}
    _add(archive, 0, 1, 2)
    assert _refused(campaign) == {"poor/h3": REASON}


def test_its_former_product_is_left_over_and_its_repair_is_made(tmp_path: Path) -> None:
    archive = _archive(tmp_path)
    _add(archive, 0, 1, 3)
    campaign = archive.write()
    assert not bring_up_to_date(campaign).has_failures
    wrong = {path.name for path in campaign.products_root.rglob("*_20260411*.nc")}
    assert len(wrong) == 2
    _add(archive, 2, 4, 5)
    result = bring_up_to_date(campaign)
    assert {Path(orphan.path).name for orphan in result.orphans} == wrong
    assert {orphan.reason for orphan in result.orphans} == {
        "its raw files are invalid or of another date"
    }
    assert remove_orphans(campaign, result) == 2
    archive.raw("poor/h3", 603.0, seed=3)
    assert not bring_up_to_date(campaign).has_failures
    for product in campaign.products_root.rglob("*.nc"):
        with xr.open_dataset(product) as opened:
            assert opened.sizes["time"] == 6


@pytest.mark.parametrize("folder", ["", "poor/", "poor/night/"])
def test_folders_are_judged_as_wholes_however_few_rows_are_written_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    """Of files before and after those of the folders in it; a scan may be killed between writes."""
    monkeypatch.setattr(scan, "_BATCH", 1)
    archive = _archive(tmp_path)
    archive.tree["instruments"]["poor"]["files"] = "**"
    for number, minutes in enumerate(MINUTES):
        archive.raw(f"{folder}h{number}", minutes, seed=number)
        archive.raw(f"{folder}h{number}.d/n1", minutes + 0.1, seed=number)
    campaign = archive.write()
    writes = iter([True] * 3)
    with Store(campaign.catalog_url, campaign.name) as store, pytest.raises(StopIteration):
        scan_archive(campaign, store, before_write=lambda: next(writes))
    assert _refused(campaign) == {f"{folder}h3": REASON.replace("poor/", folder)}


def test_unchanged_files_are_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = _archive(tmp_path)
    _add(archive, *range(8))
    campaign = archive.write()
    _refused(campaign)
    (tmp_path / "raw/poor/h7").unlink()

    def unreadable(*_: object) -> bytes:
        raise AssertionError

    monkeypatch.setattr("lidarops.catalog.raw_files.Source.head", unreadable)
    monkeypatch.setattr("lidarops.catalog.raw_files.Source.digest", unreadable)
    assert _refused(campaign) == {"poor/h3": REASON}
