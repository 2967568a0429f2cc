"""The demo campaign: simulate, catalog, process, and compare with the truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import fsspec
import numpy as np
import pytest
import xarray as xr
from support import factories
from support.archives import raw_archives
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.flags import Quality
from lidarops.records import RunRecord, Status
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.run.archive import (
    Options,
    Selection,
    bring_up_to_date,
    reprocess,
    update_catalog,
)


def _campaign(repository: Path, archive: Path, out: Path) -> Campaign:
    return load_campaign(repository / "catalogs/demo.yaml", archive=archive, output=out)


@pytest.fixture(scope="session")
def demo(
    repository: Path, demo_archive: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Campaign, RunRecord]]:
    """Campaign and record of one serial run over the demo archive."""
    campaign = _campaign(repository, demo_archive, tmp_path_factory.mktemp("serial"))
    return campaign, reprocess(campaign)


def _products(record: RunRecord, kind: str, instrument: str) -> xr.Dataset:
    parts = [
        xr.load_dataset(Path(record.products) / product.path).assign_coords(channel=product.channel)
        for scene in record.scenes
        if scene.instrument == instrument
        for product in scene.products
        if product.kind == kind
    ]
    assert parts
    return xr.concat(
        [
            part[["total_extinction", "total_extinction_standard_error", "quality_flag"]]
            for part in parts
        ],
        dim="time",
        coords="minimal",
        compat="override",
    )


def test_extinction_agrees_with_the_truth(demo: tuple[Campaign, RunRecord]) -> None:
    campaign, record = demo
    retrieved = _products(record, "homogeneous", "coast-horizontal")
    truth = xr.load_dataset(campaign.truth_path)
    truth = truth.isel(granule=(truth["instrument"] == "coast-horizontal").values)
    truth = truth.swap_dims(granule="time").sortby("time")["total_extinction"]
    expected = truth.sel(time=retrieved["time"], method="nearest").values[:, np.newaxis]
    good = retrieved["quality_flag"].values == 0
    score = (retrieved["total_extinction"].values - expected) / retrieved[
        "total_extinction_standard_error"
    ].values
    assert good.mean() > 0.5
    assert (np.abs(score[good]) < 3).mean() >= 0.99
    # The stated error is neither too small nor too large.
    assert 0.8 < score[good].std() < 1.2


def test_every_retrieval_gives_usable_values(demo: tuple[Campaign, RunRecord]) -> None:
    campaign, record = demo
    usable = dict.fromkeys(("homogeneous", "elastic", "raman", "multiangle", "visibility"), 0.0)
    for scene in record.scenes:
        for product in scene.products:
            with xr.open_dataset(campaign.products_root / product.path) as opened:
                share = float((opened["usable"] < 2).mean())
            if product.kind in usable:
                usable[product.kind] = max(share, usable[product.kind])
    # Raman signals are weak from 6 km on; the product reaches to 15 km.
    assert usable.pop("raman") > 0.5
    assert min(usable.values()) > 0.8, usable


def test_a_vertical_path_is_left_out_of_homogeneous_retrievals(
    demo: tuple[Campaign, RunRecord],
) -> None:
    _, record = demo
    scenes = [scene for scene in record.scenes if scene.instrument == "hill-vertical"]
    assert scenes
    for scene in scenes:
        assert all(product.kind != "homogeneous" for product in scene.products)
        assert scene.plan is not None
        omitted = (*scene.plan.left_out, *scene.left_out)
        (left,) = (left for left in omitted if left.rule == "section_level")
        assert left.channel == "analog_532o"
        assert "climbs 3750 m" in left.reason
        assert left.number == pytest.approx(3750.0)


def test_a_vertical_path_that_is_retrieved_nevertheless_is_flagged(
    repository: Path, demo_archive: Path, tmp_path: Path
) -> None:
    campaign = _campaign(repository, demo_archive, tmp_path).model_copy(update={"all_steps": True})
    one_day = Selection(instruments=("hill-vertical",), until=datetime(2024, 9, 22, tzinfo=UTC))
    record = reprocess(campaign, selection=one_day)
    retrieved = _products(record, "homogeneous", "hill-vertical")
    assert (retrieved["quality_flag"].values != 0).mean() > 0.99


def test_every_damaged_file_is_refused_and_no_other(demo: tuple[Campaign, RunRecord]) -> None:
    campaign, record = demo
    truth = xr.load_dataset(campaign.truth_path)
    harmless = ("", "no_final_newline")
    damaged = {
        str(path)
        for path, damage in zip(truth["path"].values, truth["damage"].values, strict=True)
        if damage not in harmless
    }
    assert damaged
    assert {granule.path for granule in record.refused} == damaged
    assert all(granule.is_expected for granule in record.refused)
    assert not record.failed
    assert not any(scene.error or scene.refused for scene in record.scenes)


def test_every_good_file_is_in_a_product(demo: tuple[Campaign, RunRecord]) -> None:
    campaign, _record = demo
    store = Store(campaign.catalog_url, campaign.name)
    good = {granule.path for granule in store.granules(status=Status.GOOD)}
    used = {
        used.path for product in store.products() for used in store.inputs_of(str(product["path"]))
    }
    store.close()
    assert used == good
    assert len(used) > 100


def _hashes(record: RunRecord) -> dict[str, str]:
    return {product.path: product.sha256 for scene in record.scenes for product in scene.products}


@pytest.mark.slow
def test_products_do_not_depend_on_workers_and_chunks(
    demo: tuple[Campaign, RunRecord], repository: Path, demo_archive: Path, tmp_path: Path
) -> None:
    campaign = _campaign(repository, demo_archive, tmp_path)
    options = Options(workers=2, profiles_per_chunk=47)
    again = reprocess(campaign, options=options)
    assert _hashes(again) == _hashes(demo[1])


def test_the_command_line_reprocesses_and_reports(
    repository: Path, demo_archive: Path, tmp_path: Path, demo: tuple[Campaign, RunRecord]
) -> None:
    runner = CliRunner()
    where = ["--archive", str(demo_archive), "--out", str(tmp_path)]
    name = str(repository / "catalogs/demo.yaml")
    result = runner.invoke(app, ["catalog", name, *where, "--json"])
    assert result.exit_code == 0
    summary = json.loads(result.stdout)
    # The campaign acknowledges its damaged files.
    assert summary["refused"] == 0
    assert len(summary["refused_files"]) == len(demo[1].refused)
    result = runner.invoke(app, ["reprocess", name, *where, "--instrument", "hill-raman", "--json"])
    assert result.exit_code == 0
    output = json.loads(result.stdout)
    assert output["scenes"] > 0
    assert all(path.startswith("hill/") for path in output["products"])
    assert len(output["refused_files"]) == len(demo[1].refused)
    page = Path(output["report"])
    assert page.is_file()
    result = runner.invoke(app, ["report", str(page.parent), "--workers", "2"])
    assert result.exit_code == 0
    assert result.stdout.strip() == str(page)
    product = tmp_path / "products" / output["products"][0]
    assert runner.invoke(app, ["inspect", str(product)]).exit_code == 0
    result = runner.invoke(app, ["inspect", str(product), "--provenance"])
    assert "wasGeneratedBy" in json.loads(result.stdout)
    raw = next((demo_archive / "hill").rglob("v*"), None) or next(demo_archive.rglob("h2*"))
    assert "Channels" in runner.invoke(app, ["inspect", str(raw)]).stdout


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["catalog", "nowhere.yaml"], 2, "nowhere.yaml"),
        (["reprocess", "CAMPAIGN", "--workers", "0"], 2, "workers"),
        (["reprocess", "CAMPAIGN", "--archive", "/nowhere"], 2, "/nowhere"),
        (
            ["reprocess", "CAMPAIGN", "--archive", "/", "--product", "integrated"],
            2,
            "requested: visibility, homogeneous, multiangle, elastic, raman, signal",
        ),
        (["inspect", "/nowhere"], 2, "/nowhere"),
        (["plot", "/"], 2, "directory"),
        (["inspect", "/nowhere", "--provenance"], 2, "/nowhere"),
        (["reproduce", "/nowhere"], 2, "/nowhere"),
        (["reproduce", "CAMPAIGN"], 2, "a product of lidarops"),
        (["report", "/nowhere"], 2, "/nowhere"),
        (["report", "/"], 2, "run.json"),
        (["site", "/nowhere"], 2, "/nowhere"),
    ],
)
def test_wrong_use_is_reported(
    repository: Path, tmp_path: Path, arguments: list[str], code: int, said: str
) -> None:
    campaign = str(repository / "catalogs/demo.yaml")
    words = [campaign if word == "CAMPAIGN" else word for word in arguments]
    if words[0] == "reprocess":
        words += ["--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == code
    assert said in result.output


def test_the_examples_of_the_help_name_files_that_the_demo_makes(
    demo_archive: Path, demo: tuple[Campaign, RunRecord]
) -> None:
    roots = {"demo/raw/": demo_archive, "demo/products/": demo[0].products_root}
    named = 0
    for command in app.registered_commands:
        for word in (command.callback.__doc__ or "").split() if command.callback else ():
            for prefix, root in roots.items():
                if word.startswith(prefix):
                    named += 1
                    assert list(root.glob(word.removeprefix(prefix))), word
    assert named >= 3


def test_a_profile_without_shots_is_flagged_and_others_are_not(tmp_path: Path) -> None:
    for k in range(4):
        data = raw_archives.content(k, bins=1000)
        if k == 2:
            data = data.replace(b" 000600 ", b" 000000 ")
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{k}", data)
    products = {
        "signal": {},
        "homogeneous": {"channels": ["photon_532o", "analog_532o"], "sections": [[750, 4500]]},
    }
    campaign = factories.campaign(products=products)
    lidar = campaign.instruments["lidar"].model_copy(update={"dark_files": []})
    campaign = campaign.model_copy(
        update={
            "archive": str(tmp_path / "raw"),
            "output": str(tmp_path / "out"),
            "instruments": {"lidar": lidar},
            "all_steps": True,
        }
    )
    record = reprocess(campaign)
    assert not record.failed
    for product in record.scenes[0].products:
        opened = xr.load_dataset(Path(record.products) / product.path)
        flags = opened["quality_flag"].values
        assert (flags[2] & Quality.INPUT_MISSING != 0).all()
        assert (flags[[0, 1, 3]] & Quality.INPUT_MISSING == 0).all()


def test_a_file_that_changes_after_cataloguing_is_refused(tmp_path: Path) -> None:
    for k in range(3):
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{k}", raw_archives.content(k, bins=1000))
    campaign = factories.campaign().model_copy(
        update={"archive": str(tmp_path / "raw"), "output": str(tmp_path / "out")}
    )

    def damage(_granules: int) -> None:
        raw_archives.write(tmp_path / "raw" / "coast" / "h1", b"grown")
        (tmp_path / "raw" / "coast" / "h2").unlink(missing_ok=True)

    record = reprocess(campaign, options=Options(expect=damage))
    assert record.failed
    assert record.scenes[0].error == ""
    reasons = {granule.path: granule.reason for granule in record.scenes[0].refused}
    assert set(reasons) == {"coast/h1", "coast/h2"}
    assert "catalog" in reasons["coast/h1"]
    assert record.scenes[0].products[0].values == 1


def test_a_disk_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    raw_archives.write(tmp_path / "raw" / "coast" / "h0", raw_archives.content(0, bins=1000))
    campaign = factories.campaign().model_copy(
        update={"archive": str(tmp_path / "raw"), "output": str(tmp_path / "out")}
    )
    update_catalog(campaign)
    (tmp_path / "out" / "products").write_text("a file where a folder should be")
    record = reprocess(campaign)
    assert record.failed
    assert "products" in record.scenes[0].error
    assert not record.scenes[0].products


def test_an_archive_behind_a_url_gives_the_same_products(
    tmp_path: Path,
) -> None:
    memory = fsspec.filesystem("memory")
    for k in range(3):
        data = raw_archives.content(k, bins=1000, seed=k)
        raw_archives.write(tmp_path / "raw" / "coast" / f"h{k}", data)
        memory.pipe(f"/lidar-url/coast/h{k}", data)
    hashes = []
    try:
        for where in (str(tmp_path / "raw"), "memory://lidar-url"):
            out = tmp_path / f"out{len(hashes)}"
            campaign = factories.campaign().model_copy(
                update={"archive": where, "output": str(out)}
            )
            hashes.append(_hashes(reprocess(campaign)))
    finally:
        memory.rm("/lidar-url", recursive=True)
    assert hashes[0] == hashes[1]
    assert hashes[0]


def test_the_campaign_knows_the_pointing_better_than_the_header(tmp_path: Path) -> None:
    raw_archives.write(
        tmp_path / "raw" / "coast" / "h0", raw_archives.content(0, bins=1000, zenith_angle=0.0)
    )
    for zenith_angle, level in ((90.0, True), (89.0, True), (85.0, False), (None, False)):
        facts = {} if zenith_angle is None else {"zenith_angle": zenith_angle, "azimuth": 12.0}
        campaign = factories.campaign(facts=[facts]).model_copy(
            update={"archive": str(tmp_path / "raw"), "output": str(tmp_path / f"{zenith_angle}")}
        )
        if not level:
            result = bring_up_to_date(campaign)
            assert result.record is None
            (reason,) = result.empty_scenes.values()
            assert reason.startswith("nothing to do: homogeneous of photon_532o: section")
        campaign = campaign.model_copy(update={"all_steps": True})
        record = reprocess(campaign)
        (path,) = (product.path for product in record.scenes[0].products)
        product = xr.load_dataset(Path(record.products) / path)
        assert product["zenith_angle"] == (0.0 if zenith_angle is None else zenith_angle)
        raised = (product["quality_flag"].values & HomogeneousQuality.NOT_LEVEL) != 0
        assert raised.all() == (not level)
