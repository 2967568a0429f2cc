"""What a disk or a network does for a moment is tried again, and nothing is lost by it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from support.archives.small_archive import Archive, made

from lidarops.campaign.model import Campaign
from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.store import Store
from lidarops.netcdf.comparison import compare_products
from lidarops.records import Grade
from lidarops.run.archive import Options, bring_up_to_date, reprocess
from lidarops.run.ledger_run import LedgerRun
from lidarops.scene import processing


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """A campaign of one instrument, one day and three raw files."""
    archive = Archive(tmp_path, days=1)
    del archive.tree["instruments"]["rich"]
    return archive.write()


def _is_undisturbed(campaign: Campaign, tmp_path: Path) -> bool:
    """Return whether the products are those of a run that nothing disturbed, but for their version.

    A product that was made of a part of its scene first is its second version; any other has the
    same bytes.
    """
    other = campaign.model_copy(update={"output": str(tmp_path / "undisturbed")})
    assert reprocess(other) is not None
    names = [
        {path.relative_to(root) for path in root.rglob("*") if path.is_file()}
        for root in (other.products_root, campaign.products_root)
    ]
    return names[0] == names[1] and all(
        _is_same(other.products_root / name, campaign.products_root / name) for name in names[0]
    )


def _is_same(undisturbed: Path, product: Path) -> bool:
    with xr.open_dataset(product, decode_cf=False) as opened:
        version = int(opened.attrs["product_version"])
    if version == 1:
        return undisturbed.read_bytes() == product.read_bytes()
    return version == 2 and compare_products(undisturbed, product).grade is Grade.NONE


@pytest.mark.parametrize("names", [("h01",), ("h00", "h01", "h02")])
def test_files_that_could_not_be_read_once_are_used_by_the_next_run(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
) -> None:
    read = Path.read_bytes

    def failing(path: Path) -> bytes:
        if path.name in names:
            raise OSError(errno.EIO, "Input/output error")
        return read(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", failing)
        disturbed = bring_up_to_date(campaign)
    assert disturbed.has_failures
    assert len(made(disturbed.record)) == (0 if len(names) == 3 else 2)
    later = bring_up_to_date(campaign)
    assert not later.has_failures
    assert later.summary.refused == 0
    assert later.record is not None
    assert _is_undisturbed(campaign, tmp_path)
    assert reprocess(campaign) is None


def test_a_scene_whose_counts_could_not_be_read_is_tried_again(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any) -> int:
        raise OSError(errno.ESTALE, "Stale file handle")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", failing)
        record = bring_up_to_date(campaign).record
    assert record is not None
    [outcome] = record.scenes
    assert outcome.error
    assert {file.reason for file in outcome.refused} == {"cannot be read: Stale file handle"}
    later = bring_up_to_date(campaign)
    assert not later.has_failures
    assert made(later.record)


def test_products_before_a_failure_are_those_of_the_ledger(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forced run read a file less, and then failed after it had replaced the first product."""
    assert len(made(reprocess(campaign))) == 2
    read, created = Path.read_bytes, processing.create_product

    def failing(path: Path) -> bytes:
        if path.name == "h01":
            raise OSError(errno.EIO, "Input/output error")
        return read(path)

    def create(frame: xr.Dataset, context: Any, *arguments: Any) -> Any:
        if context.channel == "photon_532o":
            raise OSError(errno.EIO, "Input/output error")
        return created(frame, context, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", failing)
        patch.setattr(processing, "create_product", create)
        result = bring_up_to_date(campaign, options=Options(force=True))
    assert "Input/output error" in str(result.failures)
    assert made(result.record) == {"poor 1 signal analog"}
    store = Store(campaign.catalog_url, campaign.name)
    assert [checked for checked in verify_archive(campaign, store) if checked.problem] == []
    store.close()
    assert not bring_up_to_date(campaign).has_failures
    assert _is_undisturbed(campaign, tmp_path)


def test_a_forced_run_that_could_not_read_does_not_fail_the_runs_after_it(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its products of before are right."""
    assert made(reprocess(campaign))
    open_file = os.open

    def failing(path: Any, *arguments: Any, **options: Any) -> int:
        if str(path).endswith("h01"):
            raise OSError(errno.EIO, "Input/output error")
        return open_file(path, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", failing)
        forced = bring_up_to_date(campaign, options=Options(force=True))
    assert forced.has_failures
    assert made(forced.record)
    later = bring_up_to_date(campaign)
    assert not later.failures
    assert not later.has_failures
    assert reprocess(campaign) is None


def test_products_that_are_gone_when_their_scene_ends_are_made_again(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example because the folder of products was mounted over."""
    end = LedgerRun.end

    def without_products(
        run: LedgerRun, judge: Any, judged: Any, outcome: Any, *, final: bool
    ) -> Any:
        for product in outcome.products:
            (campaign.products_root / product.path).unlink()
        return end(run, judge, judged, outcome, final=final)

    with monkeypatch.context() as patch:
        patch.setattr(LedgerRun, "end", without_products)
        assert "vanished or changed" in str(bring_up_to_date(campaign).failures)
    later = bring_up_to_date(campaign)
    assert not later.has_failures
    assert made(later.record)
