"""What a disk or a network does for a moment is tried again, and nothing is lost by it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from support.archives.small_archive import Archive, made

from lidarops.campaign.model import Campaign
from lidarops.netcdf.comparison import compare_products
from lidarops.records import Grade
from lidarops.run.archive import bring_up_to_date, reprocess
from lidarops.run.session import Session


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """A campaign of one instrument, one day and three raw files."""
    archive = Archive(tmp_path, days=1)
    del archive.tree["instruments"]["rich"]
    return archive.write()


def _undisturbed(campaign: Campaign, tmp_path: Path) -> dict[str, Path]:
    """Return the products of a run without hiccups by their relative paths."""
    settings = campaign.model_copy(update={"output": str(tmp_path / "undisturbed")})
    record = reprocess(settings)
    assert record is not None
    paths = [product.path for scene in record.scenes for product in scene.products]
    return {path: settings.products_root / path for path in paths}


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
    for path, expected in _undisturbed(campaign, tmp_path).items():
        # One that was made from part of its files is a version before.
        grade = compare_products(expected, campaign.products_root / path).grade
        assert grade is Grade.NONE
    assert reprocess(campaign) is None


def test_a_scene_whose_counts_could_not_be_read_is_tried_again(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any) -> int:
        raise OSError(errno.ESTALE, "Stale file handle")

    with monkeypatch.context() as patch:
        patch.setattr(os, "preadv", failing)
        patch.setattr(os, "pread", failing)
        assert "Stale file handle" in str(bring_up_to_date(campaign).failures)
    later = bring_up_to_date(campaign)
    assert not later.has_failures
    assert made(later.record)


def test_products_that_are_gone_when_their_scene_ends_are_made_again(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example because the folder of products was mounted over."""
    end = Session.end

    def without_products(session: Session, judged: Any, outcome: Any, *, final: bool) -> Any:
        for product in outcome.products:
            (campaign.products_root / product.path).unlink()
        return end(session, judged, outcome, final=final)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "end", without_products)
        assert "vanished or changed" in str(bring_up_to_date(campaign).failures)
    later = bring_up_to_date(campaign)
    assert not later.has_failures
    assert made(later.record)
