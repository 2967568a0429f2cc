"""A product that is made of a part of its scene states which raw files are not in it, and why."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import pytest
import xarray as xr
from support.archives.small_archive import Archive

from lidarops.campaign.model import Campaign
from lidarops.catalog.granules import DatedFile, Granules
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.context import MOST_UNUSED, UNUSED_INPUTS
from lidarops.records import Grade, Granule, Role, Status
from lidarops.reports import run_tables
from lidarops.reports.inspection import describe
from lidarops.run.archive import bring_up_to_date, reprocess
from lidarops.run.reproduction import reproduce_product
from lidarops.run.scenes import MOST_IN_DOUBT, dated
from lidarops.system.stores import RemoteStore

Fault = Callable[[Path, pytest.MonkeyPatch], None]
"""Makes raw/poor/h01 below a folder unusable."""


def _small(folder: Path) -> Archive:
    """Return an archive of one instrument, two days and three raw files a day."""
    archive = Archive(folder, days=2)
    del archive.tree["instruments"]["rich"]
    return archive


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return _small(tmp_path)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The products of the archive as it is."""
    campaign = _small(tmp_path_factory.mktemp("undisturbed")).write()
    assert reprocess(campaign) is not None
    return campaign.products_root


def _unused(campaign: Campaign) -> dict[str, str]:
    """Return the unused files that products state, by name of product and day."""
    stated = {}
    for path in sorted(campaign.products_root.rglob("*.nc")):
        with xr.open_dataset(path) as product:
            stated[path.stem.partition("T")[0]] = product.attrs.get(UNUSED_INPUTS, "")
    return stated


def _are_same(*roots: Path) -> bool:
    first, second = (
        sorted(path.relative_to(root) for path in root.rglob("*.nc")) for root in roots
    )
    return first == second and all(
        compare_products(*(root / name for root in roots)).grade is Grade.NONE for name in first
    )


def _denied(_: Path, patch: pytest.MonkeyPatch) -> None:
    opened = os.open

    def failing(path: Any, *arguments: Any, **options: Any) -> int:
        if str(path).endswith("poor/h01"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, *arguments, **options)

    patch.setattr(os, "open", failing)


def _failing_read(error: OSError) -> Fault:
    def fault(_: Path, patch: pytest.MonkeyPatch) -> None:
        read = Path.read_bytes

        def failing(path: Path) -> bytes:
            if path.match("poor/h01"):
                raise error
            return read(path)

        patch.setattr(Path, "read_bytes", failing)

    return fault


def _truncated(folder: Path, _: pytest.MonkeyPatch) -> None:
    file = folder / "raw/poor/h01"
    file.write_bytes(file.read_bytes()[:-100])


def _refused_by_a_store(_: Path, patch: pytest.MonkeyPatch) -> None:
    head = RemoteStore.head

    def failing(store: RemoteStore, path: str, size: int) -> bytes:
        if path == "poor/h01":
            raise PermissionError(f"https://user:secret@host/{path}?key=secret")
        return head(store, path, size)

    patch.setattr(RemoteStore, "head", failing)


def _gone_from_a_store(_: Path, patch: pytest.MonkeyPatch) -> None:
    fetch = RemoteStore.fetch

    def without(store: RemoteStore, paths: list[str], folder: Path) -> dict[str, str]:
        return fetch(store, [path for path in paths if path != "poor/h01"], folder)

    patch.setattr(RemoteStore, "fetch", without)


@contextmanager
def _disturbed(folder: Path, fault: Fault) -> Iterator[None]:
    file = folder / "raw/poor/h01"
    content = file.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        fault(folder, patch)
        yield
    file.write_bytes(content)


UNREADABLE = "poor/h01: cannot be read"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "remote", "words"),
    [
        (_denied, False, UNREADABLE),
        (_failing_read(OSError(errno.EIO, "Input/output error", "/secret/h01")), False, UNREADABLE),
        (_failing_read(FileNotFoundError(errno.ENOENT, "No such file")), False, UNREADABLE),
        (_truncated, False, "poor/h01: "),
        (_refused_by_a_store, True, UNREADABLE),
        (_gone_from_a_store, True, UNREADABLE),
    ],
    ids=[
        "denied",
        "unreadable",
        "vanished",
        "truncated",
        "refused by a store",
        "gone from a store",
    ],
)
def test_a_product_states_the_files_of_its_scene_that_are_not_in_it(
    archive: Archive, undisturbed: Path, tmp_path: Path, fault: Fault, remote: bool, words: str
) -> None:
    if remote:
        archive.tree["archive"] = f"file://{tmp_path}/raw"
    campaign = archive.write()
    with _disturbed(tmp_path, fault):
        assert bring_up_to_date(campaign).has_failures
        stated = _unused(campaign)
        second_day = [text for name, text in stated.items() if name.endswith("02")]
        first_day = [text for name, text in stated.items() if name.endswith("01")]
        assert second_day == ["", ""]
        assert len(first_day) == 2
        assert len(set(first_day)) == 1
        [text] = set(first_day)
        assert text == words if words[-1] != " " else text.startswith(words)
        assert "secret" not in text
        assert str(tmp_path) not in text
        product = next(campaign.products_root.rglob("*_20260301*.nc"))
        assert describe(product)["attributes"][UNUSED_INPUTS] == text
    assert reproduce_product(product, archive=tmp_path / "raw").identical
    # The file is back.
    assert not bring_up_to_date(campaign).has_failures
    assert set(_unused(campaign).values()) == {""}
    assert _are_same(undisturbed, campaign.products_root)
    assert reprocess(campaign) is None


def test_products_state_files_that_are_refused_later_and_forget_those_that_are_gone(
    archive: Archive, undisturbed: Path
) -> None:
    """Though nothing else of their days changes."""
    campaign = archive.write()
    assert reprocess(campaign) is not None
    assert set(_unused(campaign).values()) == {""}
    damaged = archive.folder / "raw/poor/h015\x1b]0;x\n"
    damaged.write_bytes(b"\0" * 1000)
    assert reprocess(campaign) is not None
    stated = {text for name, text in _unused(campaign).items() if name.endswith("01")}
    assert len(stated) == 1
    [text] = stated
    assert text.startswith("poor/h015\\x1b]0;x\\n: ")
    assert "\x1b" not in text
    assert "\n" not in text
    assert reprocess(campaign) is None
    damaged.unlink()
    assert reprocess(campaign) is not None
    assert set(_unused(campaign).values()) == {""}
    assert _are_same(undisturbed, campaign.products_root)


def test_products_do_not_depend_on_installed_formats(archive: Archive) -> None:
    (archive.folder / "raw/poor/h015").write_text("x = 1\n" * 100)
    campaign = archive.write()
    assert reprocess(campaign) is not None
    assert "poor/h015: is of no known raw format: it is text" in _unused(campaign).values()


def test_a_product_names_some_unused_files_and_counts_the_others(archive: Archive) -> None:
    for number in range(MOST_UNUSED + 3):
        (archive.folder / f"raw/poor/h01{number:02}").write_bytes(b"")
    campaign = archive.write()
    assert reprocess(campaign) is not None
    text = next(text for text in _unused(campaign).values() if text)
    assert len(text.splitlines()) == MOST_UNUSED + 1
    assert text.endswith("\n3 other raw files")


def test_a_product_states_dark_files_only_if_it_subtracts_some(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=1)
    archive.raw("rich/d2", 701, seed=98)
    (archive.folder / "raw/rich/d1").write_bytes(b"")
    campaign = archive.write()
    assert reprocess(campaign) is not None
    stated = _unused(campaign)
    assert {name for name, text in stated.items() if text.startswith("dark file rich/d1: ")}
    assert not any(text for name, text in stated.items() if "_poor_" in name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["h0640", "h0700"])
@pytest.mark.parametrize("was_good", [True, False])
def test_a_file_of_known_start_belongs_to_its_scene_whatever_its_name(
    tmp_path: Path, name: str, was_good: bool
) -> None:
    """The last one of an hour and the first of the next, of names that are numbered on.

    Its start is known because it was good, or because its header can be read.
    """
    archive = Archive(tmp_path, days=0)
    poor = archive.tree["instruments"]["poor"]
    archive.tree["instruments"] = {"poor": poor}
    # The clock runs ahead by a whole window.
    poor["facts"] = [{"zenith_angle": 0, "clock_offset": 3600}]
    archive.tree["scenes"] = {"window": "1h"}
    for minute in range(0, 120, 20):
        archive.raw(f"poor/h{600 + minute:04d}", 660 + minute, seed=minute)
    campaign = archive.write()
    file = archive.folder / "raw/poor" / name
    content = file.read_bytes()
    if was_good:
        assert reprocess(campaign) is not None
        file.write_bytes(bytes(9))
    else:
        file.write_bytes(content[:-100])
    assert reprocess(campaign) is not None
    hour = {"h0640": "T100000", "h0700": "T110000"}[name]
    stating = set()
    for path in campaign.products_root.rglob("*.nc"):
        with xr.open_dataset(path) as product:
            if f"poor/{name}: " in product.attrs.get(UNUSED_INPUTS, ""):
                stating.add(path.stem[-7:])
    assert stating == {hour}
    assert reprocess(campaign) is None
    file.write_bytes(content)
    reprocess(campaign)
    assert set(_unused(campaign).values()) == {""}


def test_the_report_names_the_day_of_which_no_file_can_be_read(archive: Archive) -> None:
    """No product can state it."""
    for number in range(3):
        file = archive.folder / f"raw/poor/h1{number}"
        file.write_bytes(file.read_bytes()[:-100])
    campaign = archive.write()
    result = bring_up_to_date(campaign)
    assert result.has_failures
    assert set(_unused(campaign).values()) == {""}
    record = result.record
    assert record is not None
    [row] = run_tables.refused(record)
    assert (len(row["files"]), row["days"]) == (3, "2026-03-02")
    assert "3 files refused" in run_tables.verdict(record)
    assert bring_up_to_date(campaign).has_failures


def test_many_dark_files_of_unknown_time_cost_little(archive: Archive) -> None:
    refused = [
        Granule(f"dark/{n:04}", 0, 0, "poor", Role.DARK, Status.REFUSED, "x") for n in range(1000)
    ]
    start = datetime(2026, 3, 1, tzinfo=UTC)
    days = [start + timedelta(days=day) for day in range(3650)]
    catalog = create_autospec(Granules, instance=True)
    catalog.refused.return_value, catalog.files_in.return_value = refused, []
    catalog.nearest_days.return_value = days
    assert sum(
        1 for _ in dated(archive.write(), catalog, catalog.refused())
    ) == MOST_IN_DOUBT * len(days)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("good", "cut", "days"),
    [
        ([], "rich/d0", {1, 2, 3, 4}),
        # Beside the other dark file as well.
        (["rich/d0"], "rich/d3", {1, 2, 3, 4}),
        # Days 1, 2 and 4 are within 24 h of the others.
        (["rich/d0", "rich/d3"], "rich/d1", {3}),
        ([], "rich/dark/d0", {1, 2, 3, 4}),
    ],
    ids=["the only one", "the last one", "others serve", "a folder of its own"],
)
def test_products_without_dark_subtraction_state_the_dark_file_that_may_be_theirs(
    tmp_path: Path, good: list[str], cut: str, days: set[int]
) -> None:
    archive = Archive(tmp_path, days=4)
    del archive.tree["instruments"]["poor"]
    rich = archive.tree["instruments"]["rich"]
    rich |= {"dark_files": ["rich/d*", "rich/dark/d*"], "products": {"signal": {}}}
    (archive.folder / "raw/rich/d0").unlink()
    for name in good:
        archive.raw(name, 700 + 1440 * int(name[-1]), seed=99)
    campaign = archive.write()
    assert reprocess(campaign) is not None
    whole = _unused(campaign)
    assert set(whole.values()) == {""}
    file = archive.raw(cut, 700 + 1440 * int(cut[-1]), seed=98)
    file.write_bytes(bytes(9))
    reprocess(campaign)
    stated = {
        name for name, text in _unused(campaign).items() if text.startswith(f"dark file {cut}: ")
    }
    assert {int(name[-2:]) for name in stated} == days
    assert all("analog" in name for name in stated)
    if not good:
        stating = (
            p for p in campaign.products_root.rglob("*.nc") if p.stem.partition("T")[0] in stated
        )
        product = next(stating)
        assert reproduce_product(product, archive=tmp_path / "raw").identical
        assert "no dark files that can be used within 24 h" in str(describe(product))
    assert reprocess(campaign) is None
    file.unlink()
    reprocess(campaign)
    gone = f"dark file {cut}: no longer in the archive"
    assert _unused(campaign) == {name: gone if name in stated else "" for name in whole}
    assert reprocess(campaign) is None


@pytest.mark.parametrize(
    ("path", "days"),
    [
        # Between files of one day, and the last one of a day, whose names have the hour in common.
        ("raw/RM16A0222.1", [2, 2]),
        ("raw/RM16A0223.9", [2]),
        ("raw/RM16A0100.0", [1]),
        # Of the day between two: it may be that none of its files can be read.
        ("raw/RM16A0312.0", []),
        ("raw/RM16A0500.0", []),
        # The names of days need not differ where a folder holds one.
        ("night/last", [7]),
        ("night/a", [7]),
        # No file of this folder, or of this instrument, is good.
        ("elsewhere/RM16A0222.1", []),
        ("other/a01", []),
    ],
)
def test_a_refused_file_belongs_beside_the_files_of_like_names(
    archive: Archive, path: str, days: list[int]
) -> None:
    names = ["0100.1", "0123.5", "0200.1", "0223.5", "0400.1", "0423.5"]
    start = datetime(2026, 3, 1, tzinfo=UTC)
    signals = [
        DatedFile(f"raw/RM16A{name}", "poor", Role.SIGNAL, start.replace(day=int(name[:2])))
        for name in reversed(names)
    ]
    files = {
        "raw": [
            *signals,
            DatedFile("raw/RM16A0222.0", "other", Role.SIGNAL, start.replace(day=9)),
            DatedFile("raw/RM16A0222.2", "poor", Role.DARK, start.replace(day=9)),
        ],
        "night": [DatedFile("night/h0", "poor", Role.SIGNAL, start.replace(day=7))],
        "other": [DatedFile("other/a01", "other", Role.SIGNAL, start)],
    }
    refused = Granule(path, 0, 0, "poor", Role.SIGNAL, Status.REFUSED, "cannot be read: Stale")
    catalog = create_autospec(Granules, instance=True)
    catalog.refused.return_value = [refused]
    catalog.files_in.side_effect = lambda folder: files.get(folder, [])
    assert [file.time.day for file in dated(archive.write(), catalog, catalog.refused())] == days
