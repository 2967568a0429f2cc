"""A name of a channel means one recorder: telescopes that are off, and recorders exchanged."""

from __future__ import annotations

import itertools
import json
import random
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
import yaml
from support import damage
from support.archives.recorder_archive import BOTH, DAY, NEAR, RecorderArchive, periods
from typer.testing import CliRunner, Result

import lidarops
from lidarops.cli import app
from lidarops.errors import ProductError
from lidarops.run.reproduction import reproduce_product

SECOND_DAY = "2026-03-02T00:00:00Z"


@pytest.fixture
def archive(tmp_path: Path) -> RecorderArchive:
    return RecorderArchive(tmp_path)


def invoke(archive: RecorderArchive, *words: str) -> Result:
    archive.write()
    result = CliRunner().invoke(app, [words[0], str(archive.file), *words[1:]])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result


def recorders(archive: RecorderArchive) -> dict[str, set[str]]:
    """Return the recorders that the products of each channel state."""
    found: dict[str, set[str]] = {}
    for path in (archive.folder / "out/products").rglob("*.nc"):
        with xr.open_dataset(path, decode_times=False) as product:
            attributes = product.attrs
            found.setdefault(attributes["lidarops_channel"], set()).add(
                attributes["lidarops_recorder"]
            )
    return found


def nearest(path: Path) -> float:
    with xr.open_dataset(path, decode_times=False) as product:
        return float(product["signal"][:, 20].mean())


def missing(archive: RecorderArchive) -> dict[str, Any]:
    shown = json.loads(invoke(archive, "plan", "--json").output)
    unmet = [unmet for unmet in shown["not_in_files"] if unmet["requested_by"] == "signal"]
    return {request["channel"]: request for request in unmet}


def partly_off(archive: RecorderArchive) -> None:
    """Write a day whose first files, by name and by time, lack the far telescope."""
    for minute in range(3):
        archive.raw(f"h0{minute}", minute, NEAR)
        archive.raw(f"h1{minute}", 10 + minute, BOTH)
    archive.products["signal"] = {"channels": ["analog_532o", "analog_532o_2"]}


def taken_away(archive: RecorderArchive, pattern: str) -> dict[Path, bytes]:
    """Remove raw files and return their contents."""
    files = sorted((archive.folder / "raw").glob(pattern))
    kept = {file: file.read_bytes() for file in files}
    for file in files:
        file.unlink()
    return kept


def contents(archive: RecorderArchive) -> dict[str, bytes]:
    """Return the content of each product, by its name."""
    root = archive.folder / "out/products"
    return {path.name: path.read_bytes() for path in root.rglob("*.nc")}


def test_a_telescope_that_is_off_leaves_its_name_free(archive: RecorderArchive) -> None:
    partly_off(archive)
    archive.facts[0]["channels"] = {"analog_532o": {"wavelength": 530e-9}}
    shown = invoke(archive, "reprocess")
    assert shown.exit_code == 0
    assert recorders(archive) == {"analog_532o": {"BT5"}, "analog_532o_2": {"BT12"}}
    paths = sorted((archive.folder / "out/products").rglob("*analog_532o_2_*.nc"))
    assert len(paths) == 2
    assert nearest(paths[0]) == pytest.approx(nearest(paths[1]), rel=0.02)
    lacking = missing(archive)
    assert lacking.keys() == {"analog_532o"}
    assert lacking["analog_532o"]["files"] == 3
    assert "analog_532o_2 (recorder BT12)" in lacking["analog_532o"]["reason"]
    notes = json.loads(invoke(archive, "plan", "--json").output)["file_notes"]
    assert [(note["text"].split(":")[0], note["files"]) for note in notes] == [("analog_532o", 3)]
    assert "lidarops_polarisation" in xr.open_dataset(paths[0], decode_times=False).attrs


@pytest.mark.slow
def test_names_do_not_depend_on_the_order_in_which_files_come(tmp_path: Path) -> None:
    contents = []
    for number, late in enumerate(("h0", "h11", "")):
        archive = RecorderArchive(tmp_path / str(number))
        partly_off(archive)
        kept = taken_away(archive, f"{late}*") if late else {}
        if late:
            invoke(archive, "reprocess")
        for file, data in kept.items():
            file.write_bytes(data)
        assert invoke(archive, "reprocess", "--remove-orphans").exit_code == 0
        root = archive.folder / "out/products"
        names = {path.name for path in root.rglob("*.nc")}
        contents.append(names)
        assert recorders(archive) == {"analog_532o": {"BT5"}, "analog_532o_2": {"BT12"}}
        settled = invoke(archive, "plan", "--stale", "--json").output
        assert not [scene for scene in json.loads(settled)["scenes"] if scene["stale"]]
    assert contents[0] == contents[1] == contents[2]


def test_a_product_is_made_again_when_its_name_comes_to_mean_another_recorder(
    archive: RecorderArchive,
) -> None:
    archive.products["signal"] = {"channels": ["analog_532o", "analog_532o_2"]}
    for minute in range(3):
        archive.raw(f"h0{minute}", minute, ("BT1", "BT2"))
    invoke(archive, "reprocess")
    assert recorders(archive) == {"analog_532o": {"BT1"}, "analog_532o_2": {"BT2"}}
    archive.facts[0]["channels"] = {"analog_532o": {"recorder": "BT2"}}
    invoke(archive, "reprocess")
    assert recorders(archive) == {"analog_532o": {"BT2"}, "analog_532o_2": {"BT1"}}


def test_names_stay_when_a_recorder_comes(archive: RecorderArchive) -> None:
    for minute in range(3):
        archive.raw(f"h0{minute}", minute, NEAR)
    invoke(archive, "reprocess")
    before = contents(archive)
    for minute in range(3):
        archive.raw(f"h1{minute}", DAY + minute, BOTH)
    shown = invoke(archive, "reprocess", "--json")
    assert shown.exit_code == 0
    assert not json.loads(shown.stdout)["orphans"]
    assert before.items() <= contents(archive).items()
    assert recorders(archive) == {
        "analog_532o": {"BT12"},
        "photon_532o": {"BC12"},
        "analog_532o_2": {"BT5"},
        "photon_532o_2": {"BC5"},
    }


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.parametrize("recorder", ["BT5", None])
def test_files_that_are_lost_for_a_time_change_nothing(
    archive: RecorderArchive, recorder: str | None, damaged: bool
) -> None:
    pytest.importorskip("pyarrow")
    partly_off(archive)
    archive.facts[0]["channels"] = {"analog_532o": {"wavelength": 530e-9, "recorder": recorder}}
    invoke(archive, "reprocess")
    before = contents(archive)
    kept = taken_away(archive, "h1*")
    for file, data in kept.items() if damaged else ():
        file.write_bytes(damage.flip_line_end(data, random.Random(file.name)))
    invoke(archive, "reprocess")
    assert recorders(archive) == {"analog_532o": {"BT5"}, "analog_532o_2": {"BT12"}}
    # Products tell of damaged files.
    assert contents(archive).keys() == before.keys() if damaged else contents(archive) == before
    for file, data in kept.items():
        file.write_bytes(data)
    shown = invoke(archive, "reprocess", "--json")
    assert shown.exit_code == 0
    assert not json.loads(shown.stdout)["orphans"]
    assert contents(archive).keys() == before.keys()
    words = ["aggregate", str(archive.folder / "out"), "--means", "month", "--json"]
    means = CliRunner().invoke(app, words)
    assert means.exit_code == 0
    assert len(json.loads(means.stdout)["means"]) == 2


def test_means_join_no_recorders(archive: RecorderArchive) -> None:
    pytest.importorskip("pyarrow")
    partly_off(archive)
    invoke(archive, "reprocess")
    archive.facts = periods(
        SECOND_DAY,
        {"analog_532o": {"recorder": "BT5"}},
        {"analog_532o": {"recorder": "BT0"}},
    )
    for minute in range(3):
        archive.raw(f"h2{minute}", DAY + minute, ("BT0", "BT12"))
    assert invoke(archive, "reprocess").exit_code == 0
    assert recorders(archive) == {"analog_532o": {"BT5", "BT0"}, "analog_532o_2": {"BT12"}}
    out = str(archive.folder / "out")
    words = ["aggregate", out, "--means", "month", "--json"]
    made = json.loads(CliRunner().invoke(app, words).output)
    # Each has a file of its own.
    assert len({means["path"] for means in made["means"]}) == 3
    with pytest.raises(ProductError, match="BT0"):
        lidarops.open_products(out, kind="signal", channel="analog_532o")
    opened = lidarops.open_products(out, kind="signal", channel="analog_532o_2")
    assert opened.attrs["lidarops_recorder"] == "BT12"


def exchanged(archive: RecorderArchive) -> None:
    """Write two days, before and after a repair that exchanged a recorder."""
    for day, name in enumerate(("BT0", "BT1")):
        for minute in range(3):
            archive.raw(f"h{day}{minute}", day * DAY + minute, (name,))


def test_an_exchanged_recorder_is_noted_and_can_be_stated(archive: RecorderArchive) -> None:
    exchanged(archive)
    shown = invoke(archive, "plan")
    assert "no file holds both its recorder BT1 and BT0 of analog_532o" in " ".join(
        shown.output.replace("┃", " ").replace("│", " ").split()
    )
    invoke(archive, "reprocess")
    assert recorders(archive) == {"analog_532o": {"BT0"}, "analog_532o_2": {"BT1"}}
    archive.facts = periods(SECOND_DAY, {}, {"analog_532o": {"recorder": "BT1"}})
    assert invoke(archive, "reprocess", "--remove-orphans").exit_code == 0
    assert recorders(archive) == {"analog_532o": {"BT0", "BT1"}}
    assert "no file holds both" not in " ".join(invoke(archive, "plan").output.split())


def test_a_stated_recorder_that_is_off_gives_its_name_to_no_other(
    archive: RecorderArchive,
) -> None:
    for minute in range(3):
        archive.raw(f"h0{minute}", minute, NEAR)
    archive.facts[0]["channels"] = {"analog_532o": {"recorder": "BT5"}}
    archive.products["signal"] = {"channels": ["analog_532o", "photon_532o"]}
    shown = invoke(archive, "reprocess")
    assert shown.exit_code == 1
    assert recorders(archive) == {"photon_532o": {"BC12"}}
    assert "of the recorder BT5 that the facts state" in missing(archive)["analog_532o"]["reason"]


@pytest.mark.parametrize("damaged", [("BT7", *BOTH[1:]), ("BT12", "BC5", "BT5", "BC12")])
def test_one_damaged_header_names_no_channel(
    archive: RecorderArchive, damaged: tuple[str, ...]
) -> None:
    for minute in range(5):
        archive.raw(f"h{minute}", minute, BOTH if minute else damaged)
    archive.products["signal"] = {"channels": ["analog_532o", "analog_532o_2"]}
    shown = invoke(archive, "reprocess")
    found = recorders(archive)
    assert {"BT5"} == found["analog_532o"], shown.output
    assert {"BT12"} == found["analog_532o_2"]


def test_a_file_with_another_recorder_alone_is_refused(archive: RecorderArchive) -> None:
    for minute in range(7):
        archive.raw(f"h{minute}", minute, BOTH if minute != 3 else ("BT7", *BOTH[1:]))
    shown = invoke(archive, "reprocess")
    assert shown.exit_code == 1
    assert "analog_532o device BT7, the files around it BT5" in " ".join(shown.output.split())
    assert recorders(archive).keys() == {
        f"{mode}_532o{number}"
        for mode, number in itertools.product(("analog", "photon"), ("", "_2"))
    }


def test_dark_files_of_another_recorder_are_not_subtracted(archive: RecorderArchive) -> None:
    exchanged(archive)
    archive.raw("d0", DAY - 10, ("BT0",))
    archive.dark_files = ["d*"]
    archive.facts = periods(SECOND_DAY, {}, {"analog_532o": {"recorder": "BT1"}})
    scenes = json.loads(invoke(archive, "plan", "--json").output)["scenes"]
    dark = [any(step["name"] == "dark" for step in scene["steps"]) for scene in scenes]
    assert dark == [True, False]


def test_a_product_without_the_first_recorder_can_be_made_again(archive: RecorderArchive) -> None:
    partly_off(archive)
    invoke(archive, "reprocess")
    for path in (archive.folder / "out/products").rglob("*.nc"):
        assert reproduce_product(path, archive=archive.folder / "raw").identical


def test_files_are_opened_and_described_by_the_same_names(archive: RecorderArchive) -> None:
    partly_off(archive)
    opened = lidarops.open_archive(archive.folder / "raw", channels=["analog_532o_2"])
    assert opened["analog_532o_2"].attrs["device"] == "BT12"
    assert opened.sizes["time"] == 6
    shown = CliRunner().invoke(app, ["inspect", str(archive.folder / "raw"), "--json"])
    groups = json.loads(shown.output)["groups"]
    assert {group["channels"] for group in groups} == {
        "analog_532o_2, photon_532o_2",
        "analog_532o, photon_532o, analog_532o_2, photon_532o_2",
    }
    draft = archive.folder / "draft.yaml"
    words = ["init", str(archive.folder / "raw"), str(draft)]
    assert CliRunner().invoke(app, words).exit_code == 0
    (lidar,) = yaml.safe_load(draft.read_text())["instruments"].values()
    assert {name: facts["recorder"] for name, facts in lidar["facts"][0]["channels"].items()} == {
        "analog_532o": "BT5",
        "photon_532o": "BC5",
        "analog_532o_2": "BT12",
        "photon_532o_2": "BC12",
    }


@pytest.mark.slow
def test_a_real_lidar_whose_far_telescope_is_off(data_root: Path, tmp_path: Path) -> None:
    case = data_root / "cases" / "telescope_off" / "raw"
    if not case.is_dir():
        pytest.skip("this case is not here")
    archive = RecorderArchive(tmp_path)
    (tmp_path / "raw").symlink_to(case)
    draft = tmp_path / "campaign.yaml"
    CliRunner().invoke(app, ["init", str(case), str(draft)])
    tree = yaml.safe_load(draft.read_text())
    tree["archive"] = "raw"
    (lidar,) = tree["instruments"].values()
    lidar["products"] = {"signal": {"channels": ["analog_532o", "analog_532o_2", "analog_1064o"]}}
    draft.write_text(yaml.safe_dump(tree))
    assert CliRunner().invoke(app, ["reprocess", str(draft)]).exit_code == 0
    assert recorders(archive) == {
        "analog_532o": {"BT5"},
        "analog_532o_2": {"BT12"},
        "analog_1064o": {"BT0"},
    }
