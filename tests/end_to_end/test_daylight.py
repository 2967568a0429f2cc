"""Glued channels from night to day, when the photon counter is past its limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives import mixed_campaign
from support.archives.scene_jobs import scene_jobs

from lidarops.campaign.model import load_campaign
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.scene.job import Job
from lidarops.scene.processing import process_scene
from lidarops.simulate.campaign import simulate_campaign

ALONE = int(Quality.SINGLE_RECORD)
CHANNELS = ["glued_532o", "analog_532o"]


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> list[Job]:
    """Jobs of a vertical and a scanning lidar over a sunrise."""
    folder = tmp_path_factory.mktemp("daylight")
    tree = mixed_campaign.tree(profiles=42, bins=2000)
    for settings in (tree["instruments"], tree["simulation"]["instruments"]):
        for name in settings.keys() - {"vertical", "scanner"}:
            del settings[name]
    del tree["networks"]
    tree["instruments"]["vertical"]["products"] = {
        "elastic": {"channels": CHANNELS, "average": "10min"},
        "signal": {"channels": CHANNELS},
    }
    tree["instruments"]["scanner"]["products"] = {
        "multiangle": {"channels": CHANNELS, "highest": 3000}
    }
    tree["simulation"] |= {"start": "2025-06-01T02:20:00Z", "duration": 42 * 150}
    for simulated in tree["simulation"]["instruments"].values():
        simulated["acquisition"] |= {"interval": 150, "shots": 3000}
        (detector,) = simulated["detectors"]
        detector["background"]["day"] = 400.0
    path = folder / "daylight.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    simulate_campaign(campaign)
    return scene_jobs(campaign)


def digests(jobs: list[Job]) -> dict[str, str]:
    """Process scenes, and return the sha256 of their products by path."""
    return {product.path: product.sha256 for job in jobs for product in process_scene(job).products}


@pytest.fixture(scope="module")
def written(jobs: list[Job]) -> dict[str, str]:
    """The digests of the products."""
    return digests(jobs)


@pytest.fixture(scope="module")
def products(jobs: list[Job], written: dict[str, str]) -> dict[tuple[str, str], xr.Dataset]:
    """The products by kind and channel."""
    opened = (xr.load_dataset(jobs[0].campaign.products_root / path) for path in written)
    return {(p.attrs["lidarops_kind"], p.attrs["lidarops_channel"]): p for p in opened}


def pair(products: dict[tuple[str, str], xr.Dataset], kind: str) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the products of the glued and of the analog channel."""
    glued, analog = (products[kind, channel] for channel in CHANNELS)
    return glued, analog


def of_day(product: xr.Dataset) -> np.ndarray:
    """Return the rows in which one record alone gives the signal."""
    alone = (product["quality_flag"].to_numpy() & ALONE) != 0
    assert (alone.all(axis=1) | ~alone.any(axis=1)).all()
    return alone.all(axis=1)


def usable(product: xr.Dataset, kind: str) -> np.ndarray:
    """Return the share of usable values in each row."""
    flags = product["quality_flag"].to_numpy()
    return np.asarray(((flags & flags_of(kind).rejecting) == 0).mean(axis=1))


def test_inversions_by_day_are_those_of_the_analog_record(products) -> None:
    glued, analog = pair(products, "elastic")
    day = of_day(glued)
    assert 2 <= day.sum() <= 9
    np.testing.assert_array_equal(np.flatnonzero(day), np.arange(day.size - day.sum(), day.size))
    assert (usable(glued, "elastic")[day] > 0.9).all()
    for name in ("aerosol_backscatter", "aerosol_backscatter_standard_error"):
        ours, others = glued[name].to_numpy(), analog[name].to_numpy()
        np.testing.assert_allclose(ours[day], others[day], rtol=1e-4, atol=1e-11)
    difference = glued["aerosol_backscatter"] - analog["aerosol_backscatter"]
    score = (difference / analog["aerosol_backscatter_standard_error"]).to_numpy()[~day]
    assert np.sqrt(np.nanmean(score**2)) < 1.3
    assert (glued["glue_top"].to_numpy()[day] == glued["glue_bottom"].to_numpy()[day]).all()
    # The scale of a mean is not known, and its offset is no light of the sky.
    assert np.isnan(glued["glue_slope"].to_numpy()[day]).all()
    assert np.isnan(glued["background"].to_numpy()[day]).all()
    assert np.isfinite(glued["background"].to_numpy()[~day]).all()


def test_signals_of_night_and_day_have_one_scale(products) -> None:
    glued, analog = pair(products, "signal")
    day = of_day(glued)
    assert 5 <= day.sum() <= 20
    assert (usable(glued, "signal") > 0.9).all()
    slope, error = (glued[f"glue_slope{end}"].to_numpy() for end in ("", "_standard_error"))
    # The gain of the simulation is 0.05 mV MHz-1.
    assert (np.abs(slope - 20.0) < 4.0 * error).all()
    assert np.unique(slope[day]).size == 1
    near = (glued["range"] > 800.0) & (glued["range"] < 2000.0)
    ratio = (glued["signal"] / analog["signal"]).to_numpy()[:, near.to_numpy()]
    np.testing.assert_allclose(np.median(ratio, axis=1) / slope, 1.0, atol=0.05)


def test_cycles_of_night_and_day_are_not_mixed_in_scale(products) -> None:
    glued, analog = pair(products, "multiangle")
    day = ((glued["quality_flag"].to_numpy() & ALONE) != 0).any(axis=1)
    assert day.any()
    assert not day.all()
    assert (usable(glued, "multiangle") > 0.9).all()
    names = ("total_extinction", "total_extinction_standard_error")
    (value, error), (other, its_error) = (
        (product[name].to_numpy() for name in names) for product in (glued, analog)
    )
    score = (value - other) / np.hypot(error, its_error)
    for rows in (day, ~day):
        assert np.sqrt(np.nanmean(score[rows] ** 2)) < 1.5


@pytest.mark.slow
def test_chunks_do_not_change_what_is_glued(
    jobs: list[Job], written: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidarops.scene.profiles.IN_MEMORY", 0)
    for profiles in (1, 5):
        assert digests([replace(job, profiles_per_chunk=profiles) for job in jobs]) == written
