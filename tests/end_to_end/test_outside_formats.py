"""An archive in a raw format that a package outside of lidarops adds, from catalog to report."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives.csv_archives import convert
from support.archives.small_campaign import TREE
from typer.testing import CliRunner

from lidarops import open_archive
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.errors import RawFormatError
from lidarops.raw import formats
from lidarops.raw.backend import LicelBackendEntrypoint
from lidarops.records import Granule, Status
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign

PRODUCTS = {
    "signal": {},
    "homogeneous": {"channels": ["photon_532o"], "sections": [[600, 3000]]},
}


def tree() -> dict[str, Any]:
    """One lidar with an analog and a photon channel, and with dark files."""
    settings = copy.deepcopy(TREE) | {"archive": "raw", "output": "out"}
    for part in (settings, settings["simulation"]):
        del part["instruments"]["hill-lidar"]
    settings["instruments"]["coast-lidar"]["products"] = PRODUCTS
    return settings


def campaign_in(folder: Path) -> Campaign:
    folder.mkdir()
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump(tree()), encoding="utf-8")
    return load_campaign(file)


@pytest.fixture(scope="module")
def licel(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The campaign with Licel files, processed."""
    campaign = campaign_in(tmp_path_factory.mktemp("formats") / "licel")
    simulate_campaign(campaign)
    reprocess(campaign)
    return campaign


@pytest.fixture(scope="module")
def text(licel: Campaign) -> Campaign:
    """The campaign with the same counts in CSV files, catalogued and processed by command."""
    campaign = campaign_in(licel.folder.parent / "text")
    convert(Path(licel.archive), Path(campaign.archive))
    run("catalog", campaign)
    plan = run("plan", campaign)
    assert "homogeneous" in plan
    assert "photon_532o" in plan
    run("reprocess", campaign)
    return campaign


def run(command: str, campaign: Campaign, *, exit_code: int = 0) -> str:
    result = CliRunner().invoke(app, [command, str(campaign.folder / "campaign.yaml"), "--json"])
    assert result.exit_code == exit_code, result.output
    return result.output


def products(campaign: Campaign) -> dict[str, Path]:
    root = Path(campaign.products_root)
    return {str(path.relative_to(root)): path for path in sorted(root.rglob("*.nc"))}


def granules(campaign: Campaign, status: Status = Status.GOOD) -> dict[str, Granule]:
    with Store(campaign.catalog_url, campaign.name) as store:
        return {granule.path: granule for granule in store.granules(status=status)}


@pytest.mark.slow
def test_the_catalog_knows_the_format_of_every_file(licel: Campaign, text: Campaign) -> None:
    by_format = {"licel": granules(licel), "csv": granules(text)}
    assert by_format["licel"].keys() == by_format["csv"].keys()
    for name, catalogued in by_format.items():
        assert {granule.format for granule in catalogued.values()} == {name}
    for path, granule in by_format["csv"].items():
        same = by_format["licel"][path]
        # A CSV file names no recorders.
        unnamed = tuple(replace(channel, recorder="") for channel in same.layout)
        assert granule.layout == unnamed != same.layout
        assert (granule.start, granule.stop) == (same.start, same.stop)
        assert (granule.zenith_angle, granule.latitude) == (same.zenith_angle, same.latitude)


def test_products_equal_those_of_licel_files_in_every_bit(licel: Campaign, text: Campaign) -> None:
    pairs = {path: (file, products(text)[path]) for path, file in products(licel).items()}
    assert {path.split("/")[2] for path in pairs} == {"signal", "homogeneous"}
    assert pairs.keys() == products(text).keys()
    for before, after in pairs.values():
        with (
            xr.open_dataset(before, decode_cf=False) as expected,
            xr.open_dataset(after, decode_cf=False) as found,
        ):
            assert found.attrs["source"] == expected.attrs["source"].replace("Licel", "CSV")
            recorders = {"photon_532o": "BC0", "analog_532o": "BT0"}
            stated = expected.attrs["lidarops_recorder"]
            assert stated == recorders[expected.attrs["lidarops_channel"]]
            assert "lidarops_recorder" not in found.attrs
            sizes = [data.drop_vars("provenance").sizes for data in (found, expected)]
            assert sizes[0] == sizes[1]
            for name in set(expected.variables) - {"provenance"}:
                old, new = expected[name].values, found[name].values
                assert old.dtype == new.dtype
                assert old.tobytes() == new.tobytes(), name
            if "signal" in found.data_vars:
                assert np.isfinite(found["signal"]).any()


def test_products_are_verified_and_reproduced(text: Campaign) -> None:
    run("verify", text)
    for product in products(text).values():
        result = CliRunner().invoke(app, ["reproduce", str(product)])
        assert result.exit_code == 0, result.output
        assert "identical in every byte" in result.output


def test_a_run_is_reported(text: Campaign) -> None:
    (page,) = Path(text.output).glob("report/*/index.html")
    page.unlink()
    assert CliRunner().invoke(app, ["report", str(page.parent)]).exit_code == 0
    assert "coast-lidar" in page.read_text(encoding="utf-8")


def test_a_file_is_inspected(text: Campaign) -> None:
    path = sorted(Path(text.archive).rglob("h*"))[0]
    result = CliRunner().invoke(app, ["inspect", str(path), "--json"])
    description = json.loads(result.output)
    assert description["format"] == "csv"
    assert [row["name"] for row in description["channels"]] == ["analog_532o", "photon_532o"]
    assert "photon_532o" in CliRunner().invoke(app, ["inspect", str(path)]).output


def test_stretches_of_bins_are_those_of_licel_files(licel: Campaign, text: Campaign) -> None:
    stretches = {"photon_532o": ((3, 40), (500, 700))}
    expected, found = (
        open_archive(f"{campaign.archive}/coast/h*", header_position="ignore", stretches=stretches)
        for campaign in (licel, text)
    )
    for name in ("photon_532o", "analog_532o"):
        assert np.array_equal(found[name], expected[name])


def test_one_dataset_has_one_format(licel: Campaign, text: Campaign) -> None:
    files = [sorted(Path(campaign.archive).rglob("h*"))[0] for campaign in (licel, text)]
    with pytest.raises(RawFormatError, match=r"is of raw format .*, the files before it of"):
        open_archive(files)
    assert [LicelBackendEntrypoint().guess_can_open(file) for file in files] == [True, False]


def damaged(text: str) -> dict[str, tuple[str, str]]:
    """Return the damaged forms of a CSV file, and what the reason states of each."""
    rows = text.splitlines(keepends=True)
    return {
        "h-truncated": ("".join(rows[:-9]), "bins: holds 591 rows of counts instead of 600"),
        "h-nan": (text[: text.rindex(",") + 1] + "nan\n", "row 600, photon_532o: 'nan' is not"),
        "h-shots": (text.replace("# shots: 600", "# shots: -600"), "shots: -600 is not a whole"),
        "h-zenith": (text.replace("# zenith_angle", "# zenith"), "zenith_angle: is missing"),
        "h-bare": (
            "".join(rows[8:]),
            "is of no known raw format: it is text (formats",
        ),
    }


def test_damaged_files_are_refused_with_field_and_remedy(text: Campaign, tmp_path: Path) -> None:
    campaign = campaign_in(tmp_path / "damaged")
    good = sorted(Path(text.archive).rglob("h*"))[0].read_text(encoding="ascii")
    folder = Path(campaign.archive) / "coast"
    folder.mkdir(parents=True)
    cases = damaged(good)
    for name, (content, _) in cases.items():
        (folder / name).write_text(content, encoding="ascii")
    output = run("catalog", campaign, exit_code=1)
    refused = granules(campaign, Status.REFUSED)
    assert refused.keys() == {f"coast/{name}" for name in cases}
    for name, (_, reason) in cases.items():
        assert refused[f"coast/{name}"].reason.startswith(reason)
        assert "leave" in refused[f"coast/{name}"].reason
        assert refused[f"coast/{name}"].format == ""
        with pytest.raises(RawFormatError, match=f"{name}: "):
            open_archive(folder / name)
    assert all(name in output for name in cases)


def test_damage_beyond_the_header_is_found_when_counts_are_read(
    licel: Campaign, tmp_path: Path
) -> None:
    campaign = campaign_in(tmp_path / "long")
    names = convert(Path(licel.archive), Path(campaign.archive))

    def padded(row: re.Match[str]) -> str:
        return ",".join(count.zfill(20) for count in row[0].split(","))

    # Longer than the first bytes by which files are catalogued.
    for name in names:
        content = name.read_text(encoding="ascii")
        name.write_text(re.sub(r"^\d.*", padded, content, flags=re.MULTILINE), encoding="ascii")
    file = next(name for name in names if name.name.startswith("h"))
    content = file.read_text(encoding="ascii")
    file.write_text(content[: content.rindex(",") + 1] + "nan\n", encoding="ascii")
    record = reprocess(campaign)
    assert record is not None
    refused = [granule for scene in record.scenes for granule in scene.refused]
    assert [granule.path for granule in refused] == [str(file.relative_to(campaign.archive))]
    assert refused[0].reason.startswith("row 600, photon_532o: 'nan' is not a number of counts")
    assert "copy the file again" in refused[0].reason


def test_a_file_is_tried_again_when_its_format_is_added(
    text: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = campaign_in(tmp_path / "later")
    convert_one = sorted(Path(text.archive).rglob("h*"))[0]
    file = Path(campaign.archive) / "coast" / "h0"
    file.parent.mkdir(parents=True)
    file.write_bytes(convert_one.read_bytes())
    known = formats.raw_formats()
    with Store(campaign.catalog_url, campaign.name) as store, monkeypatch.context() as patch:
        patch.setattr(formats, "raw_formats", lambda: {"licel": known["licel"]})
        patch.setattr("lidarops.catalog.scan.reading_version", lambda: "without the package")
        assert scan_archive(campaign, store).refused == 1
        assert scan_archive(campaign, store).unchanged == 1
        (refused,) = store.refused()
        assert "formats are licel; install the package of any other format" in refused.reason
        patch.undo()
        assert scan_archive(campaign, store).refused == 0
