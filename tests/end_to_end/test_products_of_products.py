"""Kinds of product that are made of other products: of the same scene, and of a month."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives.small_campaign import TREE
from support.products.made_products import METADATA
from typer.testing import CliRunner

import lidarops
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.kinds import kinds
from lidarops.netcdf.read import read_provenance
from lidarops.run.archive import assess, reprocess
from lidarops.simulate.campaign import simulate_campaign

PHOTON = {"channels": ["photon_532o"]}
PRODUCTS: dict[str, Any] = {"signal": PHOTON, "averaged": PHOTON, "monthly": PHOTON}


def tree() -> dict[str, Any]:
    """One lidar around a midnight within a month: two scenes, and no file on the first day."""
    settings = copy.deepcopy(TREE) | {"archive": "raw", "output": "out"}
    for part in (settings, settings["simulation"]):
        del part["instruments"]["hill-lidar"]
    settings["instruments"]["coast-lidar"]["products"] = copy.deepcopy(PRODUCTS)
    settings["simulation"] |= {"start": "2025-01-12T23:58:00Z", "duration": 480}
    settings["metadata"] = METADATA.model_dump()
    return settings


def campaign_in(folder: Path, settings: Mapping[str, Any]) -> Campaign:
    folder.mkdir(exist_ok=True)
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump(settings), encoding="utf-8")
    return load_campaign(file)


def requesting(folder: Path, **products: Any) -> Campaign:
    """Return the campaign of a folder, with other products."""
    settings = tree()
    settings["instruments"]["coast-lidar"]["products"] = products
    return campaign_in(folder, settings)


@pytest.fixture(scope="module")
def processed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    made = campaign_in(tmp_path_factory.mktemp("derived") / "archive", tree())
    simulate_campaign(made)
    reprocess(made)
    return made


@pytest.fixture
def campaign(processed: Campaign, tmp_path: Path) -> Campaign:
    """A copy of the processed campaign, which a test may change."""
    shutil.copytree(processed.folder, tmp_path / "copy", symlinks=True)
    return load_campaign(tmp_path / "copy" / "campaign.yaml")


def command(*words: object, exit_code: int = 0) -> str:
    result = CliRunner().invoke(lidarops.cli.app, [str(word) for word in words])
    assert result.exit_code == exit_code, result.output
    return result.output


def file_of(campaign: Campaign) -> Path:
    return campaign.folder / "campaign.yaml"


def products(campaign: Campaign, kind: str) -> list[Path]:
    return sorted(Path(campaign.products_root).rglob(f"*_{kind}_*.nc"))


def content(campaign: Campaign) -> dict[str, bytes]:
    root = Path(campaign.products_root)
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*.nc")}


def stale(campaign: Campaign) -> dict[tuple[str, str], str]:
    """Return scene and kind of the stale products -> reason."""
    return {
        (judged.scene.id.removeprefix("coast-lidar_"), product.kind): product.reason
        for judged in assess(campaign)
        for product in judged.stale
    }


DAYS = ("20250112T000000", "20250113T000000")
MONTH = "20250101T000000-month"


def test_each_is_made_of_the_products_that_it_reads(processed: Campaign) -> None:
    signals, means, (month,) = (products(processed, kind) for kind in PRODUCTS)
    assert [path.stem[-15:] for path in means] == list(DAYS)
    expected = []
    for signal, mean in zip(signals, means, strict=True):
        with xr.open_dataset(signal) as one, xr.open_dataset(mean) as own:
            expected.append(one.signal.astype(float).mean("time").values)
            np.testing.assert_allclose(own.mean_signal.values[0], expected[-1], rtol=1e-5)
            assert own.wavelength == one.wavelength
    with xr.open_dataset(month) as series:
        np.testing.assert_allclose(series.mean_signal.values, expected, rtol=1e-5)
        assert series.attrs["lidarops_window_start"] == "2025-01-01T00:00:00Z"
        assert series.attrs["lidarops_window_end"] == "2025-02-01T00:00:00Z"
        assert series.attrs["source"] == "surface observation: products of the lidar coast-lidar"


def test_provenance_names_the_products_and_no_raw_file(processed: Campaign) -> None:
    root = processed.products_root
    for kind, read in (("averaged", "signal"), ("monthly", "averaged")):
        for path in products(processed, kind):
            entities = read_provenance(path)["entity"].values()
            inputs = {one["lidarops:path"]: one for one in entities if "lidarops:path" in one}
            assert {one["prov:type"]["$"] for one in inputs.values()} == {"lidarops:Product"}
            same = [
                source for source in products(processed, read) if source.stem[-15:] in path.stem
            ]
            expected = products(processed, read) if kind == "monthly" else same
            assert sorted(inputs) == [one.relative_to(root).as_posix() for one in expected]


def test_nothing_is_stale_afterwards(campaign: Campaign) -> None:
    assert stale(campaign) == {}
    assert reprocess(campaign) is None


def test_a_changed_product_makes_those_stale_that_read_it(campaign: Campaign) -> None:
    signal = {**PHOTON, "background_range": [4000, 4500]}
    changed = requesting(campaign.folder, **PRODUCTS | {"signal": signal})
    reasons = stale(changed)
    assert set(reasons) == {
        *((day, kind) for day in DAYS for kind in ("signal", "averaged")), (MONTH, "monthly")
    }  # fmt: skip
    assert reasons[DAYS[0], "averaged"].startswith("changed: product coast/coast-lidar/signal/")
    assert reasons[MONTH, "monthly"].endswith("and 1 more")
    before = content(changed)
    record = reprocess(changed)
    assert record is not None
    assert sum(len(scene.products) for scene in record.scenes) == 5
    after = content(changed)
    assert before.keys() == after.keys()
    assert all(before[path] != after[path] for path in before)
    assert stale(changed) == {}


def test_a_product_made_again_with_the_same_content_changes_no_other(campaign: Campaign) -> None:
    before = content(campaign)
    products(campaign, "signal")[0].unlink()
    assert set(stale(campaign)) == {(DAYS[0], "signal")}
    reprocess(campaign)
    assert content(campaign) == before
    assert stale(campaign) == {}


def test_what_reads_a_missing_product_waits_for_it(processed: Campaign, tmp_path: Path) -> None:
    shutil.copytree(Path(processed.archive), tmp_path / "new" / "raw")
    # No signal is left within the range of this background.
    lacking = requesting(
        tmp_path / "new", **PRODUCTS | {"signal": {**PHOTON, "background_range": [9000, 9900]}}
    )
    reprocess(lacking)
    assert content(lacking) == {}
    scenes = json.loads(command("plan", file_of(lacking), "--json"))["scenes"]
    for scene in scenes:
        (left,) = (one for one in scene["left_out"] if one["name"] == "averaged")
        assert left["reason"] == "made of products that the scene lacks: signal of photon_532o"
        assert (left["rule"], left["number"]) == ("products_read", 1.0)
    whole = campaign_in(tmp_path / "new", tree())
    assert set(stale(whole)) == {
        *((day, kind) for day in DAYS for kind in ("signal", "averaged")), (MONTH, "monthly")
    }  # fmt: skip
    reprocess(whole)
    assert {path.rpartition("/")[2] for path in content(whole)} == {
        path.rpartition("/")[2] for path in content(processed)
    }


def test_a_month_without_its_products_states_so(campaign: Campaign) -> None:
    settings = {"signal": PHOTON, "monthly": {"channels": ["analog_532o"]}}
    lacking = requesting(campaign.folder, **settings)
    (month,) = (
        scene
        for scene in json.loads(command("plan", file_of(lacking), "--json"))["scenes"]
        if scene["scene"].endswith("-month")
    )
    (left,) = month["left_out"]
    assert left["reason"] == "made of products that the month lacks: averaged of analog_532o"
    assert left["number"] == 1.0


def test_a_selected_kind_brings_those_that_it_reads(processed: Campaign, tmp_path: Path) -> None:
    shutil.copytree(Path(processed.archive), tmp_path / "new" / "raw")
    new = campaign_in(tmp_path / "new", tree())
    command("reprocess", file_of(new), "--product", "monthly")
    assert len(content(new)) == len(content(processed))


def test_workers_and_chunks_give_the_same_bytes(campaign: Campaign) -> None:
    before = content(campaign)
    for path in before:
        (Path(campaign.products_root) / path).unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidarops.scene.profiles.IN_MEMORY", 0)
        words = ("--workers", "2", "--profiles-per-chunk", "1", "--force")
        command("reprocess", file_of(campaign), *words)
    after = content(campaign)
    assert before.keys() == after.keys()
    different = [
        name for path in before for name in differing(before[path], after[path], campaign.folder)
    ]
    assert set(different) <= {"provenance"}


def differing(before: bytes, after: bytes, folder: Path) -> list[str]:
    """Return the variables of two products that differ."""
    files = [folder / "before.nc", folder / "after.nc"]
    for file, data in zip(files, (before, after), strict=True):
        file.write_bytes(data)
    with (
        xr.open_dataset(files[0], decode_cf=False) as old,
        xr.open_dataset(files[1], decode_cf=False) as new,
    ):
        return [
            str(name) for name in old.variables
            if old[name].values.tobytes() != new[name].values.tobytes()
        ]  # fmt: skip


def test_the_ledger_is_rebuilt_and_products_are_reproduced(campaign: Campaign) -> None:
    command("verify", file_of(campaign))
    for kind in PRODUCTS:
        for path in products(campaign, kind):
            assert "identical in every byte" in command("reproduce", path)
    before = content(campaign)
    Path(campaign.output, "catalog.sqlite").unlink()
    output = command("catalog", file_of(campaign), "--rebuild")
    assert "without" not in output, output
    assert stale(campaign) == {}
    assert reprocess(campaign) is None
    assert content(campaign) == before


def test_products_that_are_requested_no_more_are_left_over(campaign: Campaign) -> None:
    fewer = requesting(campaign.folder, signal=PHOTON)
    output = command("reprocess", file_of(fewer), "--remove-orphans")
    assert "no longer requests it" in output
    assert {path.split("/")[2] for path in content(fewer)} == {"signal"}


def test_pages_reports_and_means_show_them(campaign: Campaign) -> None:
    command("site", campaign.output)
    pages = [page.name for page in Path(campaign.output, "site", "product").rglob("*.html")]
    assert sum("monthly" in page for page in pages) == 1
    command("aggregate", campaign.output)
    index = Path(campaign.output) / "aggregates" / "products.parquet"
    assert len(lidarops.find_products(index, kind="monthly")) == 1


def test_kinds_are_made_after_those_that_they_read() -> None:
    order = list(kinds())
    assert all(
        order.index(read) < order.index(kind.name)
        for kind in kinds().values()
        for read in kind.reads
    )
