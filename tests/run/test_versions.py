"""Versions of products: counted by content, graded, kept where nothing changed, and frozen."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import xarray as xr
from support.archives.small_archive import Archive
from typer.testing import CliRunner

from lidarops.aggregate.open_products import open_products
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.records import Grade, ProductRecord
from lidarops.run.archive import Options, Selection, bring_up_to_date
from lidarops.run.options import Result
from lidarops.run.reproduction import reproduce_product

SIGNALS = Selection(instruments=("poor",))


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small archive, whose signals are processed."""
    archive = Archive(tmp_path_factory.mktemp("versions"), days=2)
    brought(archive)
    return archive.folder


@pytest.fixture
def source(processed: Path, tmp_path: Path) -> Archive:
    """A copy of it, with the same modification times."""
    shutil.copytree(processed, tmp_path / "archive")
    return Archive(tmp_path / "archive")


def brought(archive: Archive, **options: bool) -> Result:
    return bring_up_to_date(archive.write(), selection=SIGNALS, options=Options(**options))


def products(result: Result) -> dict[str, ProductRecord]:
    scenes = () if result.record is None else result.record.scenes
    return {product.path: product for scene in scenes for product in scene.products}


def attributes(path: Path) -> dict[str, str]:
    with xr.open_dataset(path, decode_cf=False) as product:
        return {str(key): str(value) for key, value in product.attrs.items()}


def set_dead_time(archive: Archive, value: float) -> None:
    channels = {"photon_532o": {"dead_time": value}}
    archive.tree["instruments"]["poor"]["facts"] = [{"channels": channels}]


def test_versions_count_changes_of_content(
    source: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = source.write().products_root
    before = {path: (root / path).read_bytes() for path in _paths(root)}
    assert {attributes(root / path)["product_version"] for path in before} == {"1"}
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    set_dead_time(source, 5e-9)
    remade = products(brought(source))
    changes = {path: product.change for path, product in remade.items()}
    graded = {path: change.grade for path, change in changes.items() if change}
    major = [path for path, grade in graded.items() if grade is Grade.MAJOR]
    assert major
    for path, product in remade.items():
        change = changes[path]
        assert change is not None
        assert any("dead_time" in cause for cause in change.causes)
        if change.grade is Grade.NONE:
            assert (root / path).read_bytes() == before[path]
            assert product.stamp.version == 1
        else:
            assert product.stamp.version == 2
            stated = attributes(root / path)
            assert stated["product_version"] == "2"
            assert stated["date_modified"] > "2026"
            assert stated["history"].startswith(stated["date_modified"])
            assert reproduce_product(root / path).identical
    campaign = source.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        rows = {row["path"]: row for row in store.products() if row["path"] in major}
    assert {row["version"] for row in rows.values()} == {2}
    assert {json.loads(row["change"])["grade"] for row in rows.values()} == {"major"}
    assert products(brought(source)) == {}


def test_a_restored_file_is_the_same_version(source: Archive) -> None:
    root = source.write().products_root
    path = _paths(root)[0]
    content = (root / path).read_bytes()
    (root / path).unlink()
    (product,) = products(brought(source)).values()
    assert product.path == path
    assert (root / path).read_bytes() == content


def test_a_forced_run_keeps_files_whose_content_is_the_same(source: Archive) -> None:
    root = source.write().products_root
    times = {path: (root / path).stat().st_mtime_ns for path in _paths(root)}
    remade = products(brought(source, force=True))
    assert {product.change.grade for product in remade.values() if product.change} == {Grade.NONE}
    assert {path: (root / path).stat().st_mtime_ns for path in _paths(root)} == times


def test_products_made_again_without_a_change_are_only_counted(source: Archive) -> None:
    words = ["reprocess", str(source.file), "--instrument", "poor", "--force"]
    shown = CliRunner().invoke(app, words).output
    made = re.search(r"^(\d+ products), summed", shown, re.MULTILINE)
    assert made
    assert f"\n{made[1]} made again without a change\n" in shown
    assert "Products made again" not in shown


def test_plan_names_what_changed_since_a_product_was_made(source: Archive) -> None:
    set_dead_time(source, 3.7e-9)
    source.tree.setdefault("metadata", {})["institution"] = "another one"
    source.write()
    call = ["plan", str(source.file), "--instrument", "poor", "--stale"]
    scenes = json.loads(CliRunner().invoke(app, [*call, "--json"]).output)["scenes"]
    assert len(scenes) == 2
    for scene in scenes:
        reasons = {product["channel"]: product["reason"] for product in scene["stale"]}
        dead_time = "setting facts.channels.photon_532o.dead_time: "
        assert dead_time not in reasons["analog_532o"]
        assert f"plan changed; {dead_time}absent -> 3.7e-09" in reasons["photon_532o"]
        assert re.search('metadata.institution: .* -> "another one"', reasons["analog_532o"])
    text = CliRunner().invoke(app, call).output
    assert "dead_time: absent -> 3.7e-09" in " ".join(text.split())


@pytest.mark.parametrize("frozen", [True, False])
def test_stating_periods_makes_nothing_stale(source: Archive, frozen: bool) -> None:
    period = {"since": "2000-01-01", "until": "2100-01-01", "frozen": frozen}
    source.tree["periods"] = [period]
    source.write()
    call = ["plan", str(source.file), "--instrument", "poor", "--stale", "--json"]
    scenes = json.loads(CliRunner().invoke(app, call).output)["scenes"]
    assert not any(scene["stale"] or scene["frozen"] for scene in scenes)
    result = brought(source)
    assert not result.frozen
    assert products(result) == {}


def test_products_of_a_frozen_period_are_not_replaced(source: Archive) -> None:
    root = source.write().products_root
    before = {path: (root / path).read_bytes() for path in _paths(root)}
    source.tree["periods"] = [{"since": "2000-01-01", "until": "2100-01-01", "frozen": True}]
    set_dead_time(source, 7e-9)
    photon = {path for path in before if "photon" in path}
    for _ in range(2):
        result = brought(source)
        assert set(result.frozen) == photon
        assert products(result) == {}
    assert {path: (root / path).read_bytes() for path in _paths(root)} == before
    planned = CliRunner().invoke(app, ["plan", str(source.file), "--stale", "--json"])
    scenes = json.loads(planned.output)["scenes"]
    assert sum(len(scene["frozen"]) for scene in scenes) == len(photon)
    thawed = brought(source, thaw=True)
    assert set(products(thawed)) == photon
    assert not thawed.frozen
    assert not brought(source).frozen


def test_a_lost_file_of_a_frozen_product_is_missing(source: Archive) -> None:
    root = source.write().products_root
    source.tree["periods"] = [{"since": "2000-01-01", "until": "2100-01-01", "frozen": True}]
    set_dead_time(source, 7e-9)
    lost, kept = (path for path in _paths(root) if "photon" in path)
    (root / lost).unlink()
    frozen = brought(source).frozen
    assert set(frozen) == {lost, kept}
    assert frozen[lost].startswith("its file is missing; its plan changed; only a copy restores")
    assert frozen[kept] == "its plan changed"


def test_compare_prints_grade_and_cause(source: Archive, tmp_path: Path) -> None:
    set_dead_time(source, 3.6e-9)
    brought(source)
    root = source.write().products_root
    path = next(path for path in _paths(root) if "photon" in path)
    old = tmp_path / "old.nc"
    old.write_bytes((root / path).read_bytes())
    same = CliRunner().invoke(app, ["compare", str(old), str(root / path)])
    assert same.exit_code == 0
    assert same.output.startswith("none")
    set_dead_time(source, 4.5e-9)
    brought(source)
    found = CliRunner().invoke(app, ["compare", "--json", str(old), str(root / path)])
    assert found.exit_code == 1
    document = json.loads(found.output)
    assert document["grade"] == "major"
    assert document["largest"] > 0.1
    assert document["causes"] == [
        "setting facts.channels.photon_532o.dead_time: 3.6e-09 -> 4.5e-09",
        "step dead_time photon_532o dead_time: 3.6e-09 -> 4.5e-09",
    ]


def test_a_slightly_longer_dead_time_is_minor(source: Archive) -> None:
    set_dead_time(source, 3.6e-9)
    brought(source)
    set_dead_time(source, 3.601e-9)
    changes = [product.change for product in products(brought(source)).values()]
    assert changes
    for change in changes:
        assert change is not None
        assert change.grade is Grade.MINOR
        assert 0.0 < change.largest < 0.1
        assert change.variable
        assert 0.0 < change.share < 1.0
        assert change.lost == 0


def test_a_store_keeps_the_version_before_and_names_the_run(source: Archive) -> None:
    pytest.importorskip("icechunk")
    campaign = source.write()
    store = Path(campaign.output) / "stores/signal"
    first = snapshot_of(source)
    old = open_products(store, channel="photon_532o", usable=2).load()
    set_dead_time(source, 20e-9)
    result = brought(source)
    assert result.record is not None
    remade = [
        path
        for path, product in products(result).items()
        if product.change and product.change.grade is not Grade.NONE
    ]
    second = snapshot_of(source)
    assert first != second == snapshot_of(source)
    assert message_of(store).splitlines() == [
        f"run {result.record.id}: signal: {len(remade)} added, {len(remade)} dropped",
        *(f"products/{path} version 2" for path in sorted(remade)),
    ]
    new = open_products(store, channel="photon_532o", usable=2).load()
    assert not new.quality_flag.equals(old.quality_flag)
    before = open_products(store, channel="photon_532o", version=first, usable=2).load()
    xr.testing.assert_identical(before, old)


def snapshot_of(archive: Archive) -> str:
    """Update the store of signals and return its newest snapshot."""
    called = CliRunner().invoke(app, ["aggregate", str(archive.file), "--store", "--json"])
    assert called.exit_code == 0, called.output
    (store,) = json.loads(called.stdout)["stores"]
    return str(store["snapshot"])


def message_of(store: Path) -> str:
    import icechunk

    repository = icechunk.Repository.open(icechunk.local_filesystem_storage(str(store)))
    return str(next(repository.ancestry(branch="main")).message)


def _paths(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*.nc"))
