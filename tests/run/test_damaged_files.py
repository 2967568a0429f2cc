"""A raw file whose data cannot be used costs itself only, until it is repaired."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import xarray as xr
from support import damage
from support.archives.small_archive import DAY, Archive, made
from support.damage import Damage

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.netcdf.read import read_provenance
from lidarops.records import Grade
from lidarops.reports import run_tables
from lidarops.run.archive import Options, bring_up_to_date, reprocess

PROFILES = 3


def _archive(folder: Path, days: int) -> Archive:
    """Return an archive of three files and a dark file on each of some days."""
    archive = Archive(folder, days=0)
    rich = archive.tree["instruments"]["rich"]
    rich["facts"] = [{"zenith_angle": 0}]
    rich["products"] = {"signal": {}}
    archive.tree["instruments"] = {"rich": rich}
    (folder / "raw/rich/d0").unlink()
    for day in range(days):
        for k in range(PROFILES):
            archive.raw(f"rich/h{day:03}{k}", day * DAY + 600 + k, seed=4 * day + k)
        archive.raw(f"rich/d{day:03}", day * DAY + 630, seed=4 * day + 3)
    return archive


def _undisturbed(campaign: Campaign, folder: Path) -> Campaign:
    """Return the campaign with the products of the archive as it is now, elsewhere."""
    other = campaign.model_copy(update={"output": str(folder / "undisturbed")})
    assert reprocess(other) is not None
    return other


def _is_same(campaign: Campaign, other: Campaign) -> bool:
    """Return whether two campaigns have products of the same content."""
    names = [
        sorted(path.relative_to(root) for path in root.rglob("*.nc"))
        for root in (campaign.products_root, other.products_root)
    ]
    pairs = [(other.products_root / name, campaign.products_root / name) for name in names[0]]
    return names[0] == names[1] and all(
        first.read_bytes() == second.read_bytes()
        or compare_products(first, second).grade is Grade.NONE
        for first, second in pairs
    )


def _stated(campaign: Campaign) -> dict[str, str]:
    """Return the unused files that products state, by name of product."""
    stated = {}
    for path in sorted(campaign.products_root.rglob("*.nc")):
        with xr.open_dataset(path) as product:
            stated[path.name] = product.attrs.get(UNUSED_INPUTS, "")
    return stated


def _inputs(product: Path) -> set[str]:
    """Return the raw files that the provenance of a product names."""
    entities = read_provenance(product)["entity"].values()
    files = {entity["lidarops:path"] for entity in entities if "lidarops:path" in entity}
    return {path for path in files if path.startswith("rich/")}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bool], tuple[Campaign, Campaign]]:
    """Return, of a folder or a store, a campaign without products and one with all of them."""

    @cache
    def campaigns(remote: bool) -> tuple[Campaign, Campaign]:
        folder = tmp_path_factory.mktemp("whole")
        archive = _archive(folder, days=2)
        if remote:
            archive.tree["archive"] = f"file://{folder}/raw"
        campaign = archive.write()
        return campaign, _undisturbed(campaign, folder)

    return campaigns


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "remote"),
    [
        ("h0000", False), ("h0001", False), ("h0002", False), ("d000", False),
        ("h0001", True), ("d000", True),
    ],
)  # fmt: skip
def test_a_damaged_line_end_between_datasets_costs_its_file_only(
    whole: Callable[[bool], tuple[Campaign, Campaign]],
    tmp_path: Path,
    request: pytest.FixtureRequest,
    name: str,
    remote: bool,
) -> None:
    campaign, other = whole(remote)
    campaign = campaign.model_copy(update={"output": str(tmp_path)})
    file = campaign.folder / "raw/rich" / name
    content = file.read_bytes()
    # The other cases share the file.
    request.addfinalizer(lambda: file.write_bytes(content))
    file.write_bytes(damage.flip_line_end(content, random.Random(name)))
    result = bring_up_to_date(campaign)
    assert result.has_failures
    assert not result.failures
    assert result.record is not None
    [row] = run_tables.refused(result.record)
    assert row["files"] == [f"rich/{name}"]
    assert "1 file refused" in run_tables.verdict(result.record)
    assert "no CRLF follows the counts" in row["reason"]
    assert len(made(result.record)) == 4
    stated = _stated(campaign)
    dark = name == "d000"
    stating = {product for product, text in stated.items() if f"rich/{name}: data: no" in text}
    first_day = {product for product in stated if "20260301" in product}
    analog = {product for product in stated if "analog" in product}
    assert stating == (analog if dark else first_day)
    # No run makes the same again, and the catalog knows the file.
    assert reprocess(campaign) is None
    with Store(campaign.catalog_url, campaign.name) as store:
        assert [granule.path for granule in store.refused()] == [f"rich/{name}"]
    # A backup restores the times of files, too.
    times = file.stat()
    file.write_bytes(content)
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert not bring_up_to_date(campaign).has_failures
    assert _is_same(campaign, other)
    assert reprocess(campaign) is None


def _damaged_at_random(archive: Archive, days: int) -> dict[str, tuple[bytes, Damage]]:
    """Damage a file of every day, each fourth time a dark file, and return what they held."""
    rng = random.Random(days)
    held = {}
    for day in range(days):
        name = f"rich/d{day:03}" if day % 4 == 3 else f"rich/h{day:03}{rng.randrange(PROFILES)}"
        file = archive.folder / "raw" / name
        how = damage.OF_RAW_FILES[day % len(damage.OF_RAW_FILES)]
        held[name] = file.read_bytes(), how
        file.write_bytes(how(held[name][0], rng))
    return held


@pytest.mark.parametrize("days", [12, pytest.param(60, marks=pytest.mark.slow)])
def test_what_random_damage_leaves_is_made_and_what_it_takes_is_stated(
    tmp_path: Path, days: int
) -> None:
    archive = _archive(tmp_path, days)
    campaign = archive.write()
    other = _undisturbed(campaign, tmp_path)
    whole = {path.name: _inputs(path) for path in other.products_root.rglob("*.nc")}
    held = _damaged_at_random(archive, days)
    result = bring_up_to_date(campaign)
    assert len(_stated(campaign)) == 2 * days
    assert not result.failures
    with Store(campaign.catalog_url, campaign.name) as store:
        refused = {granule.path for granule in store.refused()}
        # A header that is lost tells no time, so that only the report can state its dark file.
        untimed = {granule.path for granule in store.refused() if granule.start is None}
    unmistakable = {damage.flip_line_end, damage.truncate}
    assert {name for name, (_, how) in held.items() if how in unmistakable} <= refused
    assert refused <= held.keys()
    assert result.has_failures is bool(refused)
    assert result.record is not None
    rows = run_tables.refused(result.record)
    assert sorted(path for row in rows for path in row["files"]) == sorted(refused)
    stated = _stated(campaign)
    for product in campaign.products_root.rglob("*.nc"):
        missing = {path for path in refused if f"{path}: " in stated[product.name]}
        used = _inputs(product)
        assert not used & refused
        assert used <= whole[product.name] <= used | missing | untimed
    assert reprocess(campaign) is None
    for name, (content, _) in held.items():
        (tmp_path / "raw" / name).write_bytes(content)
    assert not bring_up_to_date(campaign).has_failures
    assert _is_same(campaign, other)
    assert reprocess(campaign) is None


def test_a_file_that_was_damaged_without_a_trace_is_refused_when_it_is_read(tmp_path: Path) -> None:
    """Its size and time are those that the catalog knows, so that only its use shows it."""
    archive = _archive(tmp_path, days=2)
    campaign = archive.write()
    assert reprocess(campaign) is not None
    other = _undisturbed(campaign, tmp_path)
    held = {}
    for name in ("h0001", "d001"):
        file = tmp_path / "raw/rich" / name
        times = file.stat()
        held[name] = file.read_bytes()
        file.write_bytes(damage.flip_line_end(held[name], random.Random(name)))
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    forced = bring_up_to_date(campaign, options=Options(force=True))
    assert forced.has_failures
    assert not forced.failures
    assert len(made(forced.record)) == 4
    assert all("rich/h0001: " in text for name, text in _stated(campaign).items() if "0301" in name)
    assert reprocess(campaign) is None
    for name, content in held.items():
        (tmp_path / "raw/rich" / name).write_bytes(content)
    assert not bring_up_to_date(campaign).has_failures
    assert _is_same(campaign, other)
    assert reprocess(campaign) is None


@pytest.mark.slow
def test_products_of_a_damaged_archive_do_not_depend_on_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1772323200")
    archive = _archive(tmp_path, days=5)
    _damaged_at_random(archive, days=5)
    contents = []
    for workers in (1, 2):
        archive.tree["output"] = f"out{workers}"
        campaign = archive.write()
        bring_up_to_date(campaign, options=Options(workers=workers))
        contents.append(archive.contents(f"out{workers}/products"))
        assert reprocess(campaign) is None
    assert len(contents[0]) == 10
    assert contents[0] == contents[1]
