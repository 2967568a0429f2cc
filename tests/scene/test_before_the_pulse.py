"""Records that begin before the pulse: their products are those of records that begin with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives.scene_jobs import scene_jobs

from lidarops.campaign.model import Campaign, ChannelFacts, load_campaign
from lidarops.raw import licel
from lidarops.records import ChannelLayout, DetectionMode, after_pulse
from lidarops.run.archive import Options, reprocess
from lidarops.run.reproduction import explain_difference, reproduce_product
from lidarops.scene.case import channel_ranges
from lidarops.simulate.campaign import simulate_campaign

WIDTH, BINS, BEFORE = 7.5, 2000, 267
"""m and bins; the pulse leaves within the last of the bins before it."""
PULSE = BEFORE * WIDTH - 2.5
CHANNELS = ["analog_532o", "photon_532o", "glued_532o"]
SKY = {"photon_532o": 1.0, "analog_532o": 0.05}
"""Simulated background, MHz and mV."""
PRODUCTS = {
    "signal": {"channels": CHANNELS},
    "elastic": {"channels": CHANNELS, "average": "30min"},
}


def written(folder: Path, pre_trigger: float, **facts: Any) -> Campaign:
    """Return the campaign of a vertical lidar with some facts, without files."""
    detector = {
        "wavelength": 532,
        "signal_rate": 40,
        "background": {"night": 1.0, "day": 1.0},
        "photon": {},
        "analog": {"gain": 0.05, "noise": 0.2, "dark_offset": 3.0, "adc_range": 500},
    }
    grid = {"bins": BINS + BEFORE, "bin_width": WIDTH, "dark_files": 3}
    channels = {
        "photon_532o": {"dead_time": 4e-9, **facts},
        "analog_532o": {"lag": 0, **facts},
    }
    tree = {
        "name": "before",
        "title": "Before the pulse",
        "archive": "raw",
        "output": "out",
        "stations": {"hill": {"name": "Hill", "latitude": 47.8, "longitude": 11.0}},
        "instruments": {
            "lidar": {
                "station": "hill",
                "files": "v*",
                "dark_files": "dark/d*",
                "facts": [
                    {
                        "zenith_angle": 0,
                        "full_overlap_range": 300,
                        "pre_trigger": pre_trigger,
                        "channels": channels,
                    }
                ],
                "products": PRODUCTS,
            }
        },
        "simulation": {
            "seed": 3,
            "start": "2024-09-21T20:00:00Z",
            "duration": 3600,
            "instruments": {
                "lidar": {
                    "atmosphere": {"boundary_layer": {"extinction": 1.2e-4}},
                    "acquisition": {"interval": 300, "shots": 3000, **grid},
                    "detectors": [detector],
                }
            },
        },
    }
    folder.mkdir()
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_campaign(path)


Made = dict[tuple[str, str], tuple[Path, xr.Dataset]]


def made(campaign: Campaign, **options: Any) -> Made:
    """Process a campaign, and return its products by kind and channel."""
    record = reprocess(campaign, options=Options(**options))
    (scene,) = record.scenes
    assert scene.error == ""
    paths = {(one.kind, one.channel): campaign.products_root / one.path for one in scene.products}
    return {key: (path, xr.load_dataset(path)) for key, path in paths.items()}


def cut(source: Path, target: Path) -> None:
    """Write a raw file without the bins before the pulse."""
    header, counts = licel.read_counts(source)
    text = header.source.replace(f" {BINS + BEFORE:05d} ".encode(), f" {BINS:05d} ".encode())
    data = b"".join(own[BEFORE:].astype("<i4").tobytes() + b"\r\n" for own in counts.values())
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(text + data)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, Made, Made]:
    """A campaign with bins before the pulse, its products, and those of the files without them."""
    folder = tmp_path_factory.mktemp("before")
    whole = written(folder / "whole", PULSE)
    simulate_campaign(whole)
    later = written(folder / "cut", 0.0, range_offset=BEFORE * WIDTH - PULSE)
    raw = folder / "whole/raw"
    for path in (path for path in raw.rglob("[vd]*") if path.is_file()):
        cut(path, folder / "cut/raw" / path.relative_to(raw))
    return whole, made(whole), made(later)


def test_products_are_those_of_records_that_begin_with_the_pulse(both) -> None:
    """To the last bit where both have the background of the far range, as glued channels have."""
    _, whole, later = both
    assert whole.keys() == later.keys()
    assert len(whole) == 6
    for (kind, channel), (_, product) in whole.items():
        expected = later[kind, channel][1]
        assert product["range"].values[0] == expected["range"].values[0] == 6.25
        if channel == "glued_532o":
            for name in (name for name, own in product.items() if own.dtype.kind != "O"):
                np.testing.assert_array_equal(product[name].values, expected[name].values, name)
            continue
            continue
        assert product.background_method == 3
        score = (product.background - SKY[channel]) / product.background_standard_error
        assert bool((np.abs(score) < 4.0).all())
        name = {"signal": "signal", "elastic": "aerosol_backscatter"}[kind]
        error = np.hypot(*(one[f"{name}_standard_error"] for one in (product, expected)))
        score = (product[name] - expected[name]) / error
        assert float(np.sqrt((score**2).mean())) < 0.3
        assert bool((product.usable <= 1).mean() >= (expected.usable <= 1).mean() - 0.01)


def test_products_are_made_again_from_their_provenance(both) -> None:
    campaign, whole, _ = both
    for path, _ in whole.values():
        result = reproduce_product(path, archive=campaign.archive)
        assert result.identical, explain_difference(result)


def test_chunks_of_profiles_change_no_bit(both, tmp_path: Path) -> None:
    campaign, whole, _ = both
    parts = made(campaign.model_copy(update={"output": str(tmp_path)}), profiles_per_chunk=5)
    for key, (_, product) in whole.items():
        for name in (name for name, own in product.items() if own.dtype.kind != "O"):
            np.testing.assert_array_equal(product[name].values, parts[key][1][name].values, name)


def test_a_pulse_beyond_the_record_leaves_no_channel(both, tmp_path: Path) -> None:
    campaign, *_ = both
    late = written(tmp_path / "late", 1e5).model_copy(update={"archive": campaign.archive})
    (job,) = scene_jobs(late)
    assert job.plan.steps == ()
    reason = "pre_trigger of 100000 m leaves no bin: give what the record counts before the pulse"
    assert reason in {left.reason for left in job.plan.left_out}


def test_few_bins_before_the_pulse_give_no_background(both, tmp_path: Path) -> None:
    """Their mean would be noisier than that of the far range."""
    campaign, *_ = both
    for pulse, method in ((150 * WIDTH, "tail_mean"), (250 * WIDTH, "before_pulse")):
        own = written(tmp_path / method, pulse).model_copy(update={"archive": campaign.archive})
        (job,) = scene_jobs(own)
        methods = {
            step.channel: step.settings["method"]
            for step in job.plan.steps
            if (step.name, step.product) == ("background", "signal")
        }
        assert methods == {
            "analog_532o": method,
            "photon_532o": method,
            "glued_532o": "tail_mean",
        }


def test_bins_in_which_a_channel_sees_the_pulse_give_no_background(tmp_path: Path) -> None:
    """Its records are 90 m late, and hold light 90 m before the bin of the pulse."""
    late = written(tmp_path / "late", PULSE, range_offset=90.0)
    simulate_campaign(late)
    products = made(late)
    for channel, sky in SKY.items():
        _, product = products["signal", channel]
        score = (product.background - sky) / product.background_standard_error
        assert bool((np.abs(score) < 4.0).all())


@pytest.mark.parametrize(("stated", "first"), [(900.0, 3.75), (904.0, 7.25), (907.5, 3.75)])
def test_no_bin_that_begins_before_the_stated_pulse_is_kept(stated: float, first: float) -> None:
    """A pulse at 904 m leaves within the bin from 900 m on: stated as 0.9 km, that is the first."""
    record = ChannelLayout("photon_532o", DetectionMode.PHOTON, 532e-9, BINS, WIDTH, 0)
    (kept,) = after_pulse((record,), stated)
    assert channel_ranges(kept, ChannelFacts())[0] == pytest.approx(first)
    assert (BINS - kept.bins) * WIDTH == pytest.approx(stated + first - WIDTH / 2.0)
    assert 0.0 <= (BINS - kept.bins) * WIDTH - stated < WIDTH
