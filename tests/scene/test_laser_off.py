"""A laser that is off for some minutes or all the time: told from gaps, and in no mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives import network_campaigns as networks
from support.archives import scan_campaign as scans
from support.counts_read import counts_read

import lidarops
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.flags import Quality
from lidarops.netcdf.variables import judging
from lidarops.raw.formats import RawFile, read_raw_header
from lidarops.retrieve.raman.flags import CONCERNING
from lidarops.run.archive import Options, reprocess
from lidarops.run.reproduction import explain_difference, reproduce_product
from lidarops.scene.profiles import lightless_profiles
from lidarops.simulate.campaign import simulate_campaign

DARK = np.arange(20, 30)
"""Profiles of 10:20 to 10:30."""
NO_SIGNAL, MISSING = int(Quality.NO_SIGNAL), int(Quality.INPUT_MISSING)
PRODUCTS = {
    "signal": {"channels": ["photon_532o", "analog_532o", "glued_532o"]},
    "homogeneous": {"channels": ["photon_532o"], "sections": [[500, 1500]]},
    "elastic": {"channels": ["photon_532o", "glued_532o"], "lidar_ratio": 50, "average": 1200},
}
Made = dict[tuple[str, str], tuple[xr.Dataset, str]]


def made(
    folder: Path, archive: Path, zenith: float = 0.0, products: Any = None, **options: Any
) -> tuple[Campaign, Made, tuple[str, ...]]:
    """Return the products of a folder of the case by kind and channel, and the notes."""
    channels = {"photon_532o": {"dead_time": 3.6e-9}}
    tree = {
        "name": "harbour",
        "title": "Harbour",
        "archive": str(archive),
        "output": "out",
        "stations": {
            "harbour": {"name": "Harbour", "latitude": 54.4, "longitude": 10.2, "altitude": 15}
        },
        "instruments": {
            "lidar": {
                "station": "harbour",
                "files": "h*",
                "facts": [
                    {"zenith_angle": zenith, "full_overlap_range": 300, "channels": channels}
                ],
                "products": products or PRODUCTS,
            }
        },
    }
    folder.mkdir()
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    (scene,) = reprocess(campaign, options=Options(**options)).scenes
    assert scene.error == ""
    root = campaign.products_root
    opened = {
        (one.kind, one.channel): (xr.load_dataset(root / one.path), one.sha256)
        for one in scene.products
    }
    return campaign, opened, scene.notes


@pytest.fixture(scope="module")
def case(data_root: Path) -> Path:
    folder = data_root / "cases/laser_off"
    if not folder.exists():
        pytest.skip("no case of a laser that was off")
    return folder


@pytest.fixture(scope="module")
def products(case: Path, tmp_path_factory: pytest.TempPathFactory):
    return made(tmp_path_factory.mktemp("laser") / "one", case / "raw")


def test_profiles_without_light_are_rejected_and_others_are_not(products):
    for (kind, channel), (product, _) in products[1].items():
        if kind == "signal":
            bits = product["quality_flag"].values
            without = (bits & NO_SIGNAL) != 0
            np.testing.assert_array_equal(np.flatnonzero(without.all(axis=1)), DARK, channel)
            assert not np.delete(without, DARK, axis=0).any()
            assert (product["usable"].values[DARK] == 2).all()
            assert np.isnan(product["signal"].values[DARK]).all()
            # They are no gaps in the raw data, and hold no shots of light.
            assert not (bits[DARK] & MISSING).any()
            assert np.flatnonzero(product["shots"] == 0).tolist() == DARK.tolist()


def test_the_run_counts_profiles_without_light_apart(products):
    for channel in ("analog_532o", "photon_532o"):
        words = f"without light: 10 of 50 profiles of {channel}"
        assert products[2].count(words) == 1


def test_sections_of_level_beams_tell_them_from_gaps(case, tmp_path):
    _, level, _ = made(tmp_path / "level", case / "raw", zenith=90.0)
    bits = level["homogeneous", "photon_532o"][0]["quality_flag"].values
    assert ((bits[DARK] & NO_SIGNAL) != 0).all()
    assert not (bits & MISSING).any()
    assert not (np.delete(bits, DARK, axis=0) & NO_SIGNAL).any()


def test_no_mean_holds_them_and_each_counts_them(products):
    for channel in ("photon_532o", "glued_532o"):
        product, _ = products[1]["elastic", channel]
        # 10:00 to 10:20, 10:20 to 10:40 half without light, 10:50 to 11:00 after a gap.
        assert product["profiles"].values.tolist() == [20, 10, 10]
        assert product["profiles_left_out"].values.tolist() == [0, 10, 0]
        assert product["shots"].values.tolist() == [12_000, 6000, 6000]
        assert not (product["quality_flag"] & NO_SIGNAL).any()
        attenuated = product["attenuated_backscatter"].swap_dims(altitude="range")
        attenuated = attenuated.sel(range=slice(500.0, 1000.0)).mean("range")
        np.testing.assert_allclose(attenuated / attenuated[0], 1.0, atol=0.02)


@pytest.mark.slow
def test_chunks_and_a_limit_of_memory_change_nothing(products, case, tmp_path):
    for number, options in enumerate(({"profiles_per_chunk": 7}, {"memory": "600MB"})):
        _, again, _ = made(tmp_path / str(number), case / "raw", **options)
        assert {key: sha for key, (_, sha) in again.items()} == {
            key: sha for key, (_, sha) in products[1].items()
        }


def test_what_else_is_requested_changes_nothing(products, case, tmp_path):
    """A product alone has the flags that it has beside others, and is made again from its own
    provenance."""
    alone = {"elastic": PRODUCTS["elastic"] | {"channels": ["photon_532o"]}}
    _, found, _ = made(tmp_path / "alone", case / "raw", products=alone)
    one, both = found["elastic", "photon_532o"][0], products[1]["elastic", "photon_532o"][0]
    xr.testing.assert_equal(one.drop_vars("provenance"), both.drop_vars("provenance"))
    campaign = products[0]
    for file in sorted(campaign.products_root.rglob("*.nc")):
        result = reproduce_product(file, archive=campaign.archive)
        assert result.identical, explain_difference(result)


def test_nothing_is_usable_where_the_laser_was_off_all_the_time(case, tmp_path):
    for product, _ in made(tmp_path / "off", case / "rawoff")[1].values():
        assert (product["usable"] == 2).all()
        assert (product["quality_flag"] & NO_SIGNAL).all()
        assert not (product["quality_flag"] & MISSING).any()


def test_counts_are_read_once_to_tell_light(case, tmp_path):
    """Of files of known content, beside what products read."""
    only = {"elastic": PRODUCTS["elastic"] | {"channels": ["photon_532o"]}}
    campaign, _, _ = made(tmp_path / "read", case / "raw", products=only)
    with counts_read() as sizes:
        reprocess(campaign, options=Options(force=True))
    assert sum(sizes) == 50 * 2000 * 4 * (2 + 1)


# Other archives -------------------------------------------------------------------------------


def darken(path: Path) -> None:
    """Give a file the counts of a laser that is off: those of its far range everywhere."""
    content, random = path.read_bytes(), np.random.default_rng(len(path.name))
    with RawFile(path) as file:
        channels = read_raw_header(file).channels
    head, body = content.split(b"\r\n\r\n", 1)
    parts, first = [head, b"\r\n\r\n"], 0
    for channel in channels:
        counts = np.frombuffer(body, "<i4", channel.bins, first)
        far = counts[-channel.bins // 10 :]
        parts += [random.choice(far, channel.bins).astype("<i4").tobytes(), b"\r\n"]
        first += 4 * channel.bins + 2
    path.write_bytes(b"".join(parts))


def written(folder: Path, tree: dict[str, Any]) -> Campaign:
    folder.mkdir(exist_ok=True)
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_campaign(path)


def product_of(campaign: Campaign, kind: str) -> xr.Dataset:
    outcomes = reprocess(campaign).scenes
    assert not [outcome.error for outcome in outcomes if outcome.error]
    (path,) = (one.path for outcome in outcomes for one in outcome.products if one.kind == kind)
    return xr.load_dataset(campaign.products_root / path)


def test_visits_of_scans_hold_no_profile_without_light(tmp_path):
    """Values are those of the other beams; a cycle without any light is rejected."""
    tree = scans.TREE | {"simulation": scans.TREE["simulation"] | {"duration": 4000}}
    campaign = written(tmp_path / "dark", tree)
    simulate_campaign(campaign)
    lit = product_of(campaign, "multiangle")
    files = sorted(Path(campaign.archive).rglob("m*"))
    for file in files[3:8]:
        darken(file)
    dark = product_of(campaign, "multiangle")
    np.testing.assert_array_equal(dark["time_bnds"], lit["time_bnds"])
    np.testing.assert_array_equal(lit["shots"] - dark["shots"], [3500, *[0] * 9])
    assert not (dark["quality_flag"] & NO_SIGNAL).any()
    known = ((dark["quality_flag"] | lit["quality_flag"]) == 0).values
    error = dark["vertical_optical_depth_standard_error"].values[known]
    name = "vertical_optical_depth"
    change = (dark[name] - lit[name]).values[known] / error
    assert known[0].any()
    assert (np.abs(change) < 1.0).all()
    # A whole cycle and more.
    for file in files[20:60]:
        darken(file)
    several = product_of(campaign, "multiangle")
    assert several.sizes["time"] == dark.sizes["time"]
    bits = several["quality_flag"].values
    without = ((bits & NO_SIGNAL) != 0).any(axis=1)
    assert 1 <= without.sum() < len(bits) - 1
    assert (several["shots"].values[without] == 0).all()
    assert np.isnan(several["vertical_optical_depth"].values[without]).all()
    assert not (bits[((bits & NO_SIGNAL) != 0)] & MISSING).any()


def test_raman_products_hold_no_profile_without_light(repository, tmp_path):
    """All channels of the laser: in a mean without any light, and in one that lacks a part."""
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text(encoding="utf-8"))
    tree["simulation"]["duration"] = 10_800
    request = tree["instruments"]["valley-raman"]["products"]["raman"]
    tree["instruments"]["valley-raman"]["products"] = {"raman": request | {"average": 3600}}
    campaign = written(tmp_path, tree | {"archive": "raw", "output": "out"})
    simulate_campaign(campaign)
    # 21:00 to 22:00, and 22:20 to 22:40.
    files = sorted(Path(campaign.archive).rglob("r*"))
    for file in files[:6] + files[8:10]:
        darken(file)
    product = product_of(campaign, "raman")
    assert product["profiles"].values.tolist() == [0, 4, 6]
    assert product["profiles_left_out"].values.tolist() == [6, 2, 0]
    assert product["shots"].values.tolist() == [0, 48_000, 72_000]
    for name in CONCERNING:
        bits = product[judging(name, product.variables)].values
        assert (bits[0] & NO_SIGNAL).all(), name
        assert not (bits[1:] & NO_SIGNAL).any(), name
        assert not (bits[0] & MISSING).any(), name
        assert np.isnan(product[name].values[0]).all(), name
        assert np.isfinite(product[name].values[1:]).any(axis=1).all(), name


def test_a_beam_without_light_is_no_gap_of_a_network(tmp_path):
    campaign, _ = networks.written(tmp_path, networks.tree(networks.HOMOGENEOUS))
    for file in sorted((Path(campaign.archive) / "east").iterdir())[20:40]:
        darken(file)
    (path,) = [one.path for scene in reprocess(campaign).scenes for one in scene.products]
    product = xr.load_dataset(campaign.products_root / path)
    bits = product["quality_flag"].values
    minutes = (product["time"] - product["time"][0]).values / np.timedelta64(60, "s")
    dark = (minutes >= 20.0) & (minutes < 40.0)
    of_beam = np.isfinite(product["beam_range"].sel(beam=1)).values
    assert (bits[np.ix_(dark, of_beam)] & NO_SIGNAL).all()
    assert not (bits[dark] & MISSING).any()
    assert not (bits[~dark] & NO_SIGNAL).any()
    assert np.isfinite(product["total_extinction"].values[~dark]).any()


REAL = [
    "saopaulo/20170928/signals/*",
    "pilar/20241002/*",
    "manaus_raman/RM*",
    "public/manaus_20111017_day/RM*",
    "savant/2018-10-18-0703tRANSITION/R*",
    "cases/pre_trigger/raw/*",
    "cases/scan_without_line/raw/*",
]


@pytest.mark.slow
@pytest.mark.parametrize("files", REAL)
def test_no_real_profile_of_a_laser_that_was_on_is_without_light(data_root, files):
    paths = sorted(data_root.glob(files))
    if not paths:
        pytest.skip("no such files")
    of_layout: dict[str, list[Path]] = {}
    for path in paths:
        opened = lidarops.open_archive(path)
        key = str({name: array.shape for name, array in opened.items()})
        of_layout.setdefault(key, []).append(path)
    for alike in of_layout.values():
        archive = lidarops.open_archive(alike, mask_and_scale=False)
        assert not [n for n, rows in lightless_profiles(archive, None).items() if rows.any()]


def test_real_dark_files_among_profiles_by_day_are_found(data_root):
    folder = data_root / "saopaulo/20170928"
    if not folder.exists():
        pytest.skip("no files of Sao Paulo")
    files = [path for part in ("signals", "dark") for path in sorted(folder.glob(f"{part}/*"))]
    archive = lidarops.open_archive(files, mask_and_scale=False)
    on = {str(path) for path in folder.glob("signals/*")}
    lit = np.array([path in on for path in map(str, sorted_by_start(files))])
    found = lightless_profiles(archive, None)
    assert len(found) == 12
    for name, rows in found.items():
        # Those of Raman channels follow the elastic ones, by day too.
        np.testing.assert_array_equal(rows, ~lit, name)


def sorted_by_start(files: list[Path]) -> list[Path]:
    starts = [lidarops.open_archive(path)["time"].values[0] for path in files]
    return [files[index] for index in np.argsort(starts, kind="stable")]
