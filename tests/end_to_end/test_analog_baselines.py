"""Analog records with a baseline: the truth lies within the stated errors of all products."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.analog_baselines import decaying, record_with, undershoot
from support.archives.scan_campaign import ALTITUDE, TREE

from lidarops.campaign.model import load_campaign
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign

CHANNEL = "analog_532o"
ANGLES = [0, 30, 45, 60, 70, 75]
BLOCKED = 88
BASELINES = {
    "-10 uV": decaying(-0.01, 3000.0),
    "+10 uV": decaying(0.01, 10_000.0),
    "+40 uV": decaying(0.04, 3000.0),
    "undershoot": undershoot(0.003, 1000.0),
    "long undershoot": undershoot(0.003, 3000.0),
}


def made(
    folder: Path,
    angles: list[int],
    products: dict[str, Any],
    facts: dict[str, Any] | None = None,
    **scanner: Any,
) -> tuple[xr.Dataset, list[xr.Dataset]]:
    """Return the truth and the products of two hours of an analog channel."""
    tree = copy.deepcopy(TREE)
    tree["simulation"] |= {"duration": 2400, "fast": True}
    lidar = tree["simulation"]["instruments"]["scanner"]
    lidar["scan"] = {"zenith_angles": angles, "azimuth": 90}
    if len(angles) > 1:
        lidar["scan"]["further_azimuths"] = [210, 330]
    lidar["acquisition"] |= {"interval": 39, "shots": 700, **scanner}
    (detector,) = lidar["detectors"]
    del detector["photon"]
    detector["analog"] = {"gain": 0.005, "noise": 0.05, "dark_offset": 2.0, "adc_range": 100}
    detector["background"]["day"] = 0.1
    instrument = tree["instruments"]["scanner"]
    known = {"full_overlap_range": 300, "channels": {CHANNEL: facts or {}}}
    instrument |= {"facts": [known], "products": products}
    if "dark_files" in scanner:
        instrument["dark_files"] = "plain/dark/d*"
    folder.mkdir()
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    truth = simulate_campaign(campaign).truth.load()
    assert reprocess(campaign) is not None
    return truth, [xr.load_dataset(p) for p in sorted(campaign.products_root.rglob("*.nc"))]


SCAN = {"multiangle": {"channels": [CHANNEL], "highest": 4000}}


def scans(folder: Path, angles: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviations of optical depths in stated errors, and which are not rejected."""
    truth, (product,) = made(folder, angles, SCAN)
    granule = truth["profile_granule_scanner"].values
    upward = truth["zenith_angle"].values[granule] < 1.0
    depth = truth["profile_path_optical_depth_scanner"].values[upward, 0]
    time = truth["time"].values[granule][upward]
    nearest = np.abs(time - product["time"].values[:, np.newaxis]).argmin(axis=1)
    ends = np.append(0.0, truth["range_end_scanner"].values)
    height = product["altitude"].values - ALTITUDE
    true = np.array([np.interp(height, ends, np.append(0.0, depth[k])) for k in nearest])
    name = "vertical_optical_depth"
    errors = (product.get(f"{name}_{of}_error") for of in ("standard", "gradient", "baseline"))
    total = np.sqrt(sum(error.values**2 for error in errors if error is not None))
    good = (product["usable"].values < 2) & np.isfinite(product[name].values)
    return (product[name].values - true) / total, good


def test_scans_without_a_blocked_beam(tmp_path, monkeypatch):
    false, count = 0, 0
    for number, baseline in enumerate(BASELINES.values()):
        with monkeypatch.context() as patch:
            record_with(patch, baseline)
            score, good = scans(tmp_path / str(number), ANGLES)
        false, count = false + (np.abs(score[good]) > 4.0).sum(), count + good.sum()
    assert count > 200
    assert false <= 0.005 * count


@pytest.mark.slow
def test_scans_with_a_blocked_beam_stay_usable(tmp_path, monkeypatch):
    known = []
    for number, baseline in enumerate((None, *BASELINES.values())):
        with monkeypatch.context() as patch:
            record_with(patch, baseline)
            score, good = scans(tmp_path / str(number), [*ANGLES, BLOCKED])
        assert (np.abs(score[good]) > 4.0).sum() <= max(0.005 * good.sum(), 1)
        known.append(good.sum())
    assert min(known) >= 0.6 * known[0] > 30


def elastic(folder: Path, **scanner: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviations of backscatter in stated errors, and which are not rejected."""
    products = {"elastic": {"channels": [CHANNEL], "lidar_ratio": 50, "average": "30min"}}
    truth, (product,) = made(folder, [0], products, bins=3000, **scanner)
    granule = truth["profile_granule_scanner"].values
    light = np.array(["/dark/" not in str(path) for path in truth["path"].values[granule]])
    back = truth["profile_total_backscatter_scanner"].values[light, 0].mean(axis=0)
    ends = truth["range_end_scanner"].values
    middles = ends - 0.5 * np.diff(ends, prepend=0.0)
    name = "aerosol_backscatter"
    true = np.interp(product["range"], middles, back) - product["molecular_backscatter"].values
    score = (product[name].values - true) / product[f"{name}_standard_error"].values
    return score, (product["usable"].values < 2) & np.isfinite(score)


def test_backscatter_with_dark_files_stays_usable(tmp_path, monkeypatch):
    known = []
    for number, baseline in enumerate((None, decaying(-0.04, 10_000.0))):
        with monkeypatch.context() as patch:
            record_with(patch, baseline)
            score, good = elastic(tmp_path / str(number), dark_files=4)
        assert (np.abs(score[good]) > 4.0).mean() <= 0.005
        known.append(good.sum())
    assert known[1] >= 0.6 * known[0] > 1000


@pytest.mark.parametrize(
    "baseline",
    [
        decaying(-0.01, 3000.0),
        decaying(0.02, 5000.0),
        decaying(-0.02, 2000.0),
        decaying(0.04, 4000.0),
        decaying(0.04, 5000.0),
        decaying(-0.04, 500.0),
        undershoot(0.001, 2000.0),
        undershoot(0.003, 1000.0),
    ],
)
def test_no_backscatter_is_false_without_dark_files(tmp_path, monkeypatch, baseline):
    record_with(monkeypatch, baseline)
    score, good = elastic(tmp_path / "a")
    assert (np.abs(score[good]) > 4.0).sum() <= 0.005 * good.sum()
    assert (np.abs(score[good]) < 1.96).mean() > 0.94
    assert good.sum() > 1500


def test_a_stated_baseline_replaces_that_of_blocked_beams(tmp_path, monkeypatch):
    record_with(monkeypatch, decaying(0.01, 3000.0))
    errors = []
    for stated in (0.04, 0.08):
        facts = {"baseline_uncertainty": stated}
        _, (product,) = made(tmp_path / str(stated), [*ANGLES, BLOCKED], SCAN, facts)
        errors.append(product["vertical_optical_depth_baseline_error"].median())
    assert errors[1] / errors[0] == pytest.approx(2.0, rel=1e-3)


def test_good_optical_depths_exceed_their_errors_and_those_below(tmp_path, monkeypatch):
    name, good = "vertical_optical_depth", 0
    for number, baseline in enumerate((None, decaying(0.02, 1000.0), decaying(0.04, 3000.0))):
        with monkeypatch.context() as patch:
            record_with(patch, baseline)
            _, (product,) = made(tmp_path / str(number), ANGLES, SCAN)
        depth, error, of_baseline = (
            product[of].where(product["usable"] == 0).values
            for of in (name, f"{name}_standard_error", f"{name}_baseline_error")
        )
        assert not (depth < np.hypot(error, of_baseline)).any()
        fall = depth[:, :, np.newaxis] - depth[:, np.newaxis]
        allowed = 2.0 * np.hypot(error[:, :, np.newaxis], error[:, np.newaxis])
        assert not np.triu(fall > allowed, 1).any()
        good += np.isfinite(depth).sum()
    assert good > 20
