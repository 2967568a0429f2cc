"""What a run did otherwise than those before it, and how the report shows outcomes first."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
from support.products import fabricated as fab
from support.products.fabricated import START

from lidarops.records import Change, Grade, ProductRecord, RunRecord, Stamp
from lidarops.reports import run_page
from lidarops.reports.difference import difference
from lidarops.reports.run_record import load_run_record, save_run_record

PRODUCT = ProductRecord("h/a.nc", "homogeneous", "c", "a" * 64, 9, 100, {}, 90, 90)


def run(folder: Path, number: int, *products: ProductRecord, **changes: object) -> RunRecord:
    """Save the record of a run of one scene."""
    fields: dict[str, object] = {
        "id": f"2024030{number}T000000-x",
        "started": START + timedelta(days=number),
    }
    record = fab.run_record(folder, [fab.outcome("one", products=products)], **(fields | changes))
    save_run_record(record, folder / record.id)
    return record


def compared(folder: Path, record: RunRecord) -> str:
    return " ".join(difference(record, folder / record.id).sentences)


def test_the_first_run_says_so(tmp_path: Path) -> None:
    record = run(tmp_path, 1, PRODUCT)
    assert not difference(record, tmp_path / record.id).previous
    assert "first run" in compared(tmp_path, record)


def test_products_are_compared_with_the_files_that_they_replace(tmp_path: Path) -> None:
    run(tmp_path, 1, PRODUCT)
    same, other = (Change(grade, 0.0, "", 0.0, ()) for grade in (Grade.NONE, Grade.MINOR))
    stamps = [(1, None), (3, same), (3, same), (4, other), (2, None)]
    products = [
        replace(PRODUCT, path=f"h/{number}.nc", stamp=Stamp(version), change=change)
        for number, (version, change) in enumerate(stamps)
    ]
    now = run(tmp_path, 2, *products)
    words = (
        "1 product new, 1 with other content, 2 made again with the same content,"
        " 1 made again without a file to compare with."
    )
    assert words in compared(tmp_path, now)


def test_refused_files_and_failed_scenes_are_compared_with_the_run_before(tmp_path: Path) -> None:
    run(tmp_path, 1, refused=(fab.granule("raw/1", "cut"), fab.granule("raw/2", "cut")))
    failed = [fab.outcome("two", error="the far range is empty", seconds={})]
    now = run(tmp_path, 2, refused=(fab.granule("raw/2", "cut"), fab.granule("raw/3", "cut")))
    now = replace(now, scenes=tuple(failed))
    words = compared(tmp_path, now)
    assert "1 file newly refused, 1 no longer refused." in words
    assert "newly failed: two." in words
    assert difference(now, tmp_path / now.id).newly_refused == ("raw/3",)


def test_runs_of_other_campaigns_and_later_runs_are_passed_over(tmp_path: Path) -> None:
    run(tmp_path, 1, PRODUCT)
    run(tmp_path, 2, PRODUCT, campaign="another")
    now = run(tmp_path, 3, PRODUCT)
    run(tmp_path, 4, PRODUCT)
    assert difference(now, tmp_path / now.id).previous == "20240301T000000-x"


@pytest.mark.parametrize("content", ["{", '{"format": "lidarops run record", "version": 1}'])
def test_a_run_before_that_cannot_be_read_is_said(tmp_path: Path, content: str) -> None:
    run(tmp_path, 1, PRODUCT)
    run(tmp_path, 2, PRODUCT)
    (tmp_path / "20240302T000000-x" / "run.json").write_text(content)
    now = run(tmp_path, 3, PRODUCT)
    words = compared(tmp_path, now)
    assert "The report of the run before cannot be read." in words
    assert "first run" not in words
    assert "1 product new" in words
    assert not difference(now, tmp_path / now.id).previous


def test_the_report_begins_with_outcome_difference_and_figures(
    simulated: RunRecord, tmp_path: Path
) -> None:
    page = run_page.build_report(simulated, tmp_path / "report").page.read_text("utf-8")
    places = [page.index(f'id="{name}"') for name in (
        "main", "different", "figures", "summary", "failed", "refused", "processed",
        "left-out", "flagged", "provenance",
    )]  # fmt: skip
    assert places == sorted(places)
    assert page.index('<div class="fig"') < page.index("<table")
    assert '<a class="skip" href="#main">' in page
    for landmark in ("<header>", "<main", "<footer>", '<nav aria-label="Sections">'):
        assert page.count(landmark) == 1
    assert "default-src 'none'" in page


@pytest.mark.parametrize(("usable", "css"), [(50, "good"), (0, "care")])
def test_the_outcome_is_amber_where_a_product_is_empty(
    tmp_path: Path, usable: int, css: str
) -> None:
    fog = replace(PRODUCT, usable=usable)
    record = fab.run_record(tmp_path, [fab.outcome("one", products=(fog,))])
    page = run_page.build_report(record, tmp_path / "report").page.read_text("utf-8")
    assert f'<p class="verdict {css}">' in page
    assert ("no usable value" in page) == (usable == 0)


def test_the_report_names_frozen_products_that_would_be_replaced(tmp_path: Path) -> None:
    record = run(tmp_path, 1, frozen={"h/old.nc": "its plan changed"})
    assert "1 product of frozen periods would be replaced." in compared(tmp_path, record)
    page = run_page.build_report(record, tmp_path / record.id).page.read_text(encoding="utf-8")
    assert "h/old.nc" in page
    assert "its plan changed" in page
    assert load_run_record(tmp_path / record.id).frozen == record.frozen
