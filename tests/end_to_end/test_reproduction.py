"""Reproduction of a product from its provenance, and reports of what differs."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives import network_campaigns as networks
from support.archives import scan_campaign as scans
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.cli import app
from lidarops.errors import CatalogError, ProductError
from lidarops.netcdf.read import read_origin, read_provenance
from lidarops.netcdf.write import write_product
from lidarops.run.archive import Selection, reprocess
from lidarops.run.reproduction import Reproduction, explain_difference, reproduce_product
from lidarops.settings import ReferenceSettings
from lidarops.simulate.campaign import simulate_campaign

SOUNDING = "altitude [m],pressure [hPa],temperature [K]\n" + "".join(
    f"{km * 1000},{1013.25 * (1 - 0.0065 * km * 1000 / 288.15) ** 5.256:.4f},{288.15 - 6.5 * km}\n"
    for km in range(12)
)
RATIO = "altitude,lidar_ratio,lidar_ratio_standard_error\n0,40,5\n2000,60,10\n"
OVERLAP = "range [m],overlap\n100,0.2\n300,0.7\n600,1\n"
COAST = Selection(instruments=("coast-horizontal",))
KINDS = ["signal", "homogeneous", "elastic", "multiangle"]


def tree(repository: Path) -> dict[str, Any]:
    """The level and the vertical lidar of the demo, and a scanner, for half an hour."""
    found = yaml.safe_load((repository / "catalogs/demo.yaml").read_text(encoding="utf-8"))
    found |= {"archive": "raw", "output": "out", "name": "again"}
    found.pop("networks")
    for lidars in (found["instruments"], found["simulation"]["instruments"]):
        for name in set(lidars) - {"coast-horizontal", "hill-vertical"}:
            del lidars[name]
    vertical = found["instruments"]["hill-vertical"]
    vertical["facts"][0] |= {"molecular_profile": "air.csv", "overlap_profile": "overlap.csv"}
    channels = vertical["facts"][0].setdefault("channels", {})
    channels["photon_532o"] = channels.get("photon_532o", {}) | {"lidar_ratio_profile": "ratio.csv"}
    found["stations"] |= scans.TREE["stations"]
    found["instruments"] |= scans.TREE["instruments"]
    simulation = found["simulation"]
    simulation |= {"start": "2024-09-21T20:00:00Z", "duration": 1800}
    scanner = copy.deepcopy(scans.TREE["simulation"])
    scanner["atmosphere"].pop("layers")
    simulation["atmosphere"] = scanner["atmosphere"]
    simulation["instruments"] |= scanner["instruments"]
    for instrument in simulation["instruments"].values():
        instrument.pop("damage", None)
    return found


@pytest.fixture(scope="module")
def campaign(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The campaign, simulated and processed."""
    folder = tmp_path_factory.mktemp("again")
    (folder / "air.csv").write_text(SOUNDING, encoding="utf-8")
    (folder / "overlap.csv").write_text(OVERLAP, encoding="utf-8")
    (folder / "ratio.csv").write_text(RATIO, encoding="utf-8")
    path = folder / "again.yaml"
    path.write_text(yaml.safe_dump(tree(repository)), encoding="utf-8")
    loaded = load_campaign(path)
    simulate_campaign(loaded)
    record = reprocess(loaded)
    assert not [outcome.error for outcome in record.scenes if outcome.error]
    return loaded


def of_kind(campaign: Campaign, kind: str) -> Path:
    return sorted(campaign.products_root.rglob(f"{kind}/**/*.nc"))[-1]


def names(result: Reproduction, what: str) -> list[str]:
    return [each.name for each in result.differences if each.what == what]


@pytest.fixture
def moved(campaign: Campaign, tmp_path: Path) -> Campaign:
    """A copy of the archive that tests may change, without the campaign file."""
    shutil.copytree(campaign.archive, tmp_path / "raw")
    for name in ("air.csv", "overlap.csv", "ratio.csv"):
        shutil.copy(campaign.folder / name, tmp_path)
    return campaign.model_copy(update={"archive": str(tmp_path / "raw")})


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_made_again_to_the_last_byte(kind: str, campaign: Campaign):
    # Raw files and soundings are found by themselves, in folders above the product.
    result = reproduce_product(of_kind(campaign, kind))
    assert result.identical, explain_difference(result)
    assert result.differences == ()
    assert "identical" in explain_difference(result)


def states(product: xr.Dataset, name: str) -> str:
    """Return the state of a coded variable, by the attributes of the file alone."""
    attrs = product[name].attrs
    meanings = dict(zip(attrs["flag_values"].tolist(), attrs["flag_meanings"].split(), strict=True))
    return meanings[product[name].item()]


def test_files_state_methods_reference_and_source_of_the_air(campaign: Campaign):
    opened = {kind: xr.load_dataset(of_kind(campaign, kind)) for kind in KINDS}
    elastic = opened["elastic"]
    assert states(elastic, "atmospheric_molecular_calculation_source") == "radiosounding"
    assert states(elastic, "background_method") == "known_shape"
    assert states(opened["signal"], "background_method") == "tail_mean"
    assert states(opened["homogeneous"], "retrieval_method") == "direct"
    # The method that ran, not auto, which was requested.
    ran = states(opened["multiangle"], "retrieval_method")
    assert f"; {ran}: " in opened["multiangle"].attrs["lidarops_steps"]
    bins = np.diff(elastic["range"].values)
    np.testing.assert_allclose(elastic["vertical_resolution"], bins, rtol=1e-6)
    assert np.isfinite(elastic["reference_top"]).any()
    for end in ("bottom", "top"):
        rise = np.cos(np.deg2rad(elastic["zenith_angle"])) * elastic[f"reference_{end}"]
        stated = elastic[f"reference_{end}_altitude"]
        np.testing.assert_allclose(stated, elastic["station_altitude"] + rise, rtol=1e-6)
    assumed = ReferenceSettings()
    ratio = assumed.scattering_ratio
    assert elastic["reference_scattering_ratio"].item() == pytest.approx(ratio)
    error = elastic["reference_scattering_ratio_standard_error"].item()
    assert error == pytest.approx(ratio * assumed.relative_error)


@pytest.mark.slow
@pytest.mark.parametrize("six_beams", [False, True], ids=["triangle", "six_beams"])
def test_the_product_of_a_network_is_made_again(six_beams: bool, tmp_path: Path):
    loaded, _ = networks.written(tmp_path, networks.tree(networks.HOMOGENEOUS, six_beams=six_beams))
    reprocess(loaded)
    product = of_kind(loaded, "visibility")
    result = reproduce_product(product)
    assert result.identical, explain_difference(result)
    with xr.open_dataset(product) as opened:
        paths = json.loads(opened["provenance"].item())["entity"].values()
    changed = Path(loaded.archive) / max(str(each.get("lidarops:path", "")) for each in paths)
    content = bytearray(changed.read_bytes())
    content[-3] ^= 1
    changed.write_bytes(content)
    assert len(names(reproduce_product(product), "input")) == 1


def test_the_date_from_the_environment_is_reproduced(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    dated = campaign.model_copy(update={"output": str(tmp_path / "out")})
    reprocess(dated, selection=COAST)
    product = of_kind(dated, "homogeneous")
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert reproduce_product(product, archive=campaign.archive).identical
    # And the other way: what was not dated so must not be.
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    assert reproduce_product(of_kind(campaign, "homogeneous")).identical


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_byte_and_a_missing_file_are_named(kind: str, moved: Campaign, tmp_path: Path):
    product = of_kind(moved, kind)
    with xr.open_dataset(product) as opened:
        document = json.loads(opened["provenance"].item())
    paths = [
        entity["lidarops:path"]
        for entity in document["entity"].values()
        if str(entity.get("lidarops:path", "")).startswith(("coast/", "hill/", "plain/"))
    ]
    changed, missing = sorted(paths)[-2:]
    raw = Path(moved.archive)
    content = bytearray((raw / changed).read_bytes())
    content[-3] ^= 1
    (raw / changed).write_bytes(content)
    (raw / missing).unlink()
    result = reproduce_product(product, archive=raw, ancillary=tmp_path)
    assert not result.identical
    assert sorted(names(result, "input")) == [changed, missing]
    text = explain_difference(result)
    assert f"input {changed}: changed" in text
    assert f"input {missing}: missing" in text


@pytest.mark.parametrize(
    ("name", "content"),
    [("air.csv", SOUNDING.replace("288.15", "289.15")), ("ratio.csv", RATIO.replace("60", "65"))],
)
def test_a_changed_profile_is_reported(moved: Campaign, tmp_path: Path, name: str, content: str):
    (tmp_path / name).write_text(content, encoding="utf-8")
    product = of_kind(moved, "elastic")
    result = reproduce_product(product, archive=moved.archive, ancillary=tmp_path)
    assert names(result, "input") == [name]


def test_one_changed_byte_of_an_input_changes_the_id(moved: Campaign, tmp_path: Path):
    file = sorted(Path(moved.archive).glob("coast/h*"))[0]
    content = bytearray(file.read_bytes())
    content[-3] ^= 1
    file.write_bytes(content)
    other = moved.model_copy(update={"output": str(tmp_path / "out")})
    reprocess(other, selection=COAST)
    for product in sorted(other.products_root.rglob("*.nc")):
        before = moved.products_root / product.relative_to(other.products_root)
        with xr.open_dataset(product) as after, xr.open_dataset(before) as original:
            assert after.attrs["id"] != original.attrs["id"]


def test_other_software_is_reported_where_bytes_differ(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
):
    for module in ("lidarops.run.reproduction", "lidarops.scene.job"):
        monkeypatch.setattr(f"{module}.code_version", lambda _kind: "0" * 16)
    for module in ("lidarops.run.reproduction", "lidarops.scene.job"):
        monkeypatch.setattr(f"{module}.package_versions", lambda: {"numpy": "0.1"})
    result = reproduce_product(of_kind(campaign, "homogeneous"))
    assert not result.identical
    assert names(result, "code") == ["lidarops"]
    assert "numpy" in names(result, "package")
    assert ":lidarops_code_version" in names(result, "attribute")


def test_a_tampered_value_is_detected(campaign: Campaign, tmp_path: Path):
    source = of_kind(campaign, "homogeneous")
    copied = Path(shutil.copy(source, tmp_path / "tampered.nc"))
    with netCDF4.Dataset(copied, "a") as file:
        file.set_auto_maskandscale(False)
        file["background"][0, 0] = 42.0
        file.title = "Another title"
    result = reproduce_product(copied, archive=campaign.archive)
    assert names(result, "variable") == ["background"]
    assert names(result, "attribute") == [":title"]
    assert "1 of" in explain_difference(result)


def test_variables_that_come_and_go_are_named(campaign: Campaign, tmp_path: Path):
    copied = Path(shutil.copy(of_kind(campaign, "homogeneous"), tmp_path / "renamed.nc"))
    with netCDF4.Dataset(copied, "a") as file:
        file.renameVariable("background", "sky")
    text = explain_difference(reproduce_product(copied, archive=campaign.archive))
    assert "variable background: is new\n" in text
    assert "variable sky: no longer exists" in text


def test_the_same_content_in_other_bytes_is_reported(campaign: Campaign, tmp_path: Path):
    source = of_kind(campaign, "homogeneous")
    copied = Path(shutil.copy(source, tmp_path / "same.nc"))
    copied.write_bytes(copied.read_bytes() + b"\0")
    with h5py.File(copied):
        pass
    result = reproduce_product(copied, archive=campaign.archive)
    assert names(result, "bytes") == ["same.nc"]


def test_a_product_whose_settings_nest_too_deep_is_refused(tmp_path: Path):
    product = {"lidarops:settings": "[" * 100_000}
    names = ("lidarops:kind", "lidarops:channel", "lidarops:campaign")
    document = {
        "entity": {"lidarops:product": product | dict.fromkeys(names, "a")},
        "agent": {"lidarops:software": {}},
    }
    xr.Dataset({"provenance": json.dumps(document)}).to_netcdf(tmp_path / "deep.nc")
    with pytest.raises(ProductError, match="RecursionError"):
        reproduce_product(tmp_path / "deep.nc")


def test_a_product_with_too_little_provenance_is_refused(campaign: Campaign, tmp_path: Path):
    source = of_kind(campaign, "homogeneous")
    with xr.open_dataset(source, decode_cf=False) as opened:
        product = opened.load()
    text = product["provenance"].values.tobytes().decode()
    document = json.loads(text)
    settings = json.loads(document["entity"]["lidarops:product"]["lidarops:settings"])
    del settings["keys"]
    document["entity"]["lidarops:product"]["lidarops:settings"] = json.dumps(settings)
    characters = xr.Variable("provenance_strlen", list(json.dumps(document).encode())).astype("u1")
    product = product.drop_vars("provenance").assign(
        provenance=(
            "provenance_strlen",
            characters.values.view("S1"),
            opened["provenance"].attrs,
        )
    )
    write_product(product, tmp_path / "old.nc")
    with pytest.raises(ProductError, match="not sufficient"):
        reproduce_product(tmp_path / "old.nc", archive=campaign.archive)


def test_an_error_names_the_option_for_missing_inputs(campaign: Campaign, tmp_path: Path):
    lost = shutil.copy(of_kind(campaign, "signal"), tmp_path / "deep.nc")
    with pytest.raises(ProductError, match="--archive"):
        reproduce_product(lost)


def test_raw_files_may_be_behind_a_url(campaign: Campaign):
    product = of_kind(campaign, "multiangle")
    assert reproduce_product(product, archive=f"file://{campaign.archive}").identical


def test_a_store_that_cannot_be_reached_lacks_nothing(campaign: Campaign) -> None:
    """Of no file it is known that it is missing, so none is named."""
    pytest.importorskip("aiohttp")
    product = of_kind(campaign, "homogeneous")
    with pytest.raises(CatalogError, match=r"^http://127\.0\.0\.1:1/: cannot be read") as caught:
        reproduce_product(product, archive="http://127.0.0.1:1/")
    assert not caught.value.wrong_use


def test_a_missing_file_of_a_store_is_reported_with_its_url(
    campaign: Campaign, moved: Campaign
) -> None:
    (gone, *_) = sorted(Path(moved.archive).glob("coast/h*"))
    gone.unlink()
    product = of_kind(campaign, "homogeneous")
    result = reproduce_product(product, archive=f"file://{moved.archive}")
    (lost,) = result.differences
    assert lost.name == f"coast/{gone.name}"
    assert lost.problem.startswith(f"missing from file://{moved.archive}: ")


@pytest.mark.parametrize(
    "words", [["--archive", "s3x://foo"], ["--archive", "nowhere"], ["--ancillary", "nowhere"]]
)
def test_an_unknown_folder_is_wrong_use(words: list[str], campaign: Campaign) -> None:
    product = of_kind(campaign, "elastic")
    refused = CliRunner().invoke(app, ["reproduce", str(product), *words])
    assert refused.exit_code == 2
    assert refused.output.startswith(f"error: {words[1]}: ")
    assert len(refused.output.splitlines()) == 1


def test_a_damaged_product_is_not_wrong_use(campaign: Campaign, tmp_path: Path) -> None:
    whole = of_kind(campaign, "signal").read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[:20_000])
    (tmp_path / "log.nc").write_bytes(b"no product")
    for name, code in (("cut.nc", 1), ("log.nc", 2), ("nowhere.nc", 2), (".", 2)):
        for command in (["reproduce"], ["inspect", "--provenance"]):
            assert CliRunner().invoke(app, [*command, str(tmp_path / name)]).exit_code == code


def test_the_exit_code_states_the_result(campaign: Campaign, moved: Campaign):
    product = of_kind(campaign, "homogeneous")
    good = CliRunner().invoke(app, ["reproduce", str(product)])
    assert (good.exit_code, "identical" in good.output) == (0, True)
    gone = sorted(Path(moved.archive).glob("coast/h*"))[0]
    gone.unlink()
    bad = CliRunner().invoke(app, ["reproduce", str(product), "--archive", moved.archive, "--json"])
    assert bad.exit_code == 1
    output = json.loads(bad.output)
    assert not output["identical"]
    assert output["differences"][0]["name"] == f"coast/{gone.name}"


def _forge(monkeypatch: pytest.MonkeyPatch, product: Path, renamed: dict[str, str]) -> None:
    """Let the provenance of a product name other paths."""
    document, attributes = read_origin(product)
    for entity in document["entity"].values():
        path = entity.get("lidarops:path")
        if path in renamed:
            entity["lidarops:path"] = renamed.pop(path)
    assert not renamed
    monkeypatch.setattr("lidarops.run.reproduction.read_origin", lambda _: (document, attributes))


@pytest.mark.parametrize("escape", ["{outside}", "../outside", "coast/h\0"])
@pytest.mark.parametrize("name", ["raw", "overlap.csv", "air.csv"])
def test_a_product_that_names_inputs_elsewhere_is_refused(
    escape: str, name: str, campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    outside = tmp_path / "outside"
    outside.write_bytes(b"of somebody else")
    product = of_kind(campaign, "elastic" if name != "raw" else "homogeneous")
    entities = read_provenance(product)["entity"].values()
    paths = [entity["lidarops:path"] for entity in entities if "lidarops:path" in entity]
    path = next(path for path in paths if path == name or (name == "raw" and "/h" in path))
    _forge(monkeypatch, product, {path: escape.format(outside=outside)})
    with pytest.raises(ProductError, match="outside its archive"):
        reproduce_product(product, archive=campaign.archive, catalog=campaign.catalog_url)
    assert outside.read_bytes() == b"of somebody else"


def test_control_characters_of_names_are_shown_as_escapes(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    product = of_kind(campaign, "homogeneous")
    entities = read_provenance(product)["entity"].values()
    paths = [entity["lidarops:path"] for entity in entities if "lidarops:path" in entity]
    _forge(monkeypatch, product, {next(path for path in paths if "/h" in path): "coast/h\x1b]0;x"})
    result = CliRunner().invoke(app, ["reproduce", str(product), "--archive", str(tmp_path)])
    assert "h\\x1b]0;x" in result.output
    assert "\x1b" not in result.output


def test_a_product_cannot_name_a_file_that_every_machine_has(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A system file was hashed, and its digest shown: any folder at the root was searched."""
    product = Path(shutil.copy(of_kind(campaign, "elastic"), tmp_path))
    names = {"air.csv": "group", "overlap.csv": "passwd", "ratio.csv": "hosts"}
    _forge(monkeypatch, product, names)
    with pytest.raises(ProductError, match="in no folder above"):
        reproduce_product(product, archive=campaign.archive)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_pipes_and_devices_are_no_inputs(
    make: Callable[[Path], None], campaign: Campaign, tmp_path: Path
):
    """The first blocks whoever opens it, the second has no end."""
    for name in ("air.csv", "ratio.csv"):
        shutil.copy(Path(campaign.folder) / name, tmp_path)
    make(tmp_path / "overlap.csv")
    product = of_kind(campaign, "elastic")
    result = reproduce_product(product, archive=campaign.archive, ancillary=tmp_path)
    assert names(result, "input") == ["overlap.csv"]
    assert "no regular file" in result.differences[0].problem
