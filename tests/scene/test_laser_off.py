"""A laser that is off for some minutes or all the time: told from gaps, and in no mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import lidarops
from lidarops.campaign.model import load_campaign
from lidarops.flags import Quality
from lidarops.retrieve.signal.light import brightest, variation
from lidarops.run.archive import Options, reprocess

DARK = np.arange(20, 30)
"""Profiles of 10:20 to 10:30."""


def made(folder: Path, archive: Path, zenith: float = 0.0, **options):
    """Return the products of a folder of the case by kind and channel."""
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
                "products": {
                    "signal": {"channels": ["photon_532o", "analog_532o", "glued_532o"]},
                    "homogeneous": {"channels": ["photon_532o"], "sections": [[500, 1500]]},
                    "elastic": {
                        "channels": ["photon_532o", "glued_532o"],
                        "lidar_ratio": 50,
                        "average": 1200,
                    },
                },
            }
        },
    }
    folder.mkdir()
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    (scene,) = reprocess(campaign, options=Options(**options)).scenes
    assert scene.error == ""
    return {
        (one.kind, one.channel): (xr.load_dataset(campaign.products_root / one.path), one.sha256)
        for one in scene.products
    }


@pytest.fixture(scope="module")
def case(data_root):
    folder = data_root / "cases/laser_off"
    if not folder.exists():
        pytest.skip("no case of a laser that was off")
    return folder


@pytest.fixture(scope="module")
def products(case, tmp_path_factory):
    return made(tmp_path_factory.mktemp("laser") / "one", case / "raw")


def test_profiles_without_light_are_rejected_and_others_are_not(products):
    for (kind, channel), (product, _) in products.items():
        if kind == "signal":
            bits = product["quality_flag"].values
            without = (bits & int(Quality.NO_SIGNAL)) != 0
            np.testing.assert_array_equal(np.flatnonzero(without.all(axis=1)), DARK, channel)
            assert not np.delete(without, DARK, axis=0).any()
            assert (product["usable"].values[DARK] == 2).all()
            # They are no gaps in the raw data.
            assert not (bits[DARK] & int(Quality.INPUT_MISSING)).any()


def test_sections_of_level_beams_tell_them_from_gaps(case, tmp_path):
    level = made(tmp_path / "level", case / "raw", zenith=90.0)
    bits = level["homogeneous", "photon_532o"][0]["quality_flag"].values
    assert ((bits[DARK] & int(Quality.NO_SIGNAL)) != 0).all()
    assert not (bits & int(Quality.INPUT_MISSING)).any()
    assert not (np.delete(bits, DARK, axis=0) & int(Quality.NO_SIGNAL)).any()


def test_no_mean_holds_them_and_each_counts_them(products):
    for channel in ("photon_532o", "glued_532o"):
        product, _ = products["elastic", channel]
        # 10:00 to 10:20, 10:20 to 10:40 half without light, 10:50 to 11:00 after a gap.
        assert product["profiles"].values.tolist() == [20, 10, 10]
        assert product["profiles_left_out"].values.tolist() == [0, 10, 0]
        assert product["shots"].values.tolist() == [12_000, 6000, 6000]
        assert not (product["quality_flag"] & int(Quality.NO_SIGNAL)).any()
        attenuated = product["attenuated_backscatter"].sel(range=slice(500.0, 1000.0)).mean("range")
        np.testing.assert_allclose(attenuated / attenuated[0], 1.0, atol=0.02)


def test_chunks_change_nothing(products, case, tmp_path):
    again = made(tmp_path / "two", case / "raw", profiles_per_chunk=7)
    assert {key: sha for key, (_, sha) in again.items()} == {
        key: sha for key, (_, sha) in products.items()
    }


def test_nothing_is_usable_where_the_laser_was_off_all_the_time(case, tmp_path):
    for product, _ in made(tmp_path / "off", case / "rawoff").values():
        assert (product["usable"] == 2).all()
        assert (product["quality_flag"] & int(Quality.NO_SIGNAL)).all()


def test_real_dark_files_are_told_from_real_profiles_by_day(data_root):
    folder = data_root / "saopaulo/20170928"
    if not folder.exists():
        pytest.skip("no files of Sao Paulo")

    def variations(part):
        files = sorted(folder.glob(f"{part}/*"))
        archive = lidarops.open_archive(files, mask_and_scale=False)
        return {
            name: variation(archive[name].to_numpy(), archive[f"{name}_shots"].to_numpy())
            for name in map(str, archive)
            if f"{name}_shots" in archive
        }

    signals, dark = variations("signals"), variations("dark")
    teller = brightest(signals)
    assert teller is not None
    assert teller.channel == "analog_532o"
    assert teller.lightless(dark[teller.channel]).all()
    assert not teller.lightless(signals[teller.channel]).any()
    # Raman channels by day alone tell nothing.
    assert brightest({name: signals[name] for name in ("analog_387o", "photon_607o")}) is None
