"""Networks from raw files to products: truth within stated errors, and reproducible bits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.archives import network_campaigns as made
from support.archives.scene_jobs import scene_jobs
from support.counts_read import counts_read

from lidarops.campaign.model import Campaign
from lidarops.kinds import flags_of
from lidarops.records import RunRecord, SceneOutcome
from lidarops.run.archive import Options, Selection, reprocess
from lidarops.scene.processing import process_scene

AIRS = {"homogeneous": made.HOMOGENEOUS, "gradient": made.GRADIENT, "plume": made.PLUME}


def reprocess_network(campaign: Campaign, **options: int) -> RunRecord:
    """Make all visibility products of a campaign, also those that are up to date."""
    selection = Selection(kinds=("visibility",))
    record = reprocess(campaign, selection=selection, options=Options(force=True, **options))
    assert record is not None
    return record


def opened(campaign: Campaign, outcome: SceneOutcome) -> xr.Dataset:
    assert outcome.error == ""
    (product,) = outcome.products
    return xr.load_dataset(campaign.products_root / product.path)


def beams_of(outcome: SceneOutcome) -> list[str]:
    (step,) = (step for step in outcome.plan.steps if step.name == "visibility")
    return [beam["instrument"] for beam in step.settings["beams"]]


def scores(product: xr.Dataset, truth: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """(retrieved - true) / stated error of visibility, of unflagged values."""
    whole = np.hypot(
        product["total_extinction_standard_error"], product["total_extinction_systematic_error"]
    )
    score = ((product["total_extinction"] - truth) / whole).values
    return score[product["quality_flag"].values == 0]


@pytest.mark.parametrize("six_beams", [False, True], ids=["triangle", "six_beams"])
def test_visibility_agrees_with_the_truth_within_its_errors(six_beams, tmp_path):
    found, inside = [], []
    for air, settings in AIRS.items():
        tree = made.tree(settings, six_beams=six_beams)
        # The simulated lidar ratio hardly varies, and the score shall show other errors.
        tree["networks"]["valley"]["visibility"]["lidar_ratio_relative_error"] = 0.02
        campaign, truth = made.written(tmp_path / air, tree)
        (outcome,) = reprocess_network(campaign).scenes
        product = opened(campaign, outcome)
        true = made.truth_at(product, truth, beams_of(outcome))
        usable = product["usable"].values < 2
        assert usable.mean() > 0.95
        error = (product["total_extinction"].values / true - 1.0)[usable]
        assert np.sqrt(np.mean(error**2)) < 0.08
        seen = -np.log(0.05) / true
        within = (product["visibility_in_air_lower"] <= seen) & (
            seen <= product["visibility_in_air_upper"]
        )
        inside.append(within.values[usable])
        found.append(scores(product, true))
    # The values of a block share most of their error.
    assert np.concatenate(inside).mean() > 0.5
    score = np.concatenate(found)
    assert score.size > 100
    assert (np.abs(score) < 3.0).mean() >= 0.98
    assert 0.6 < np.sqrt(np.mean(score**2)) < 1.4


def test_the_same_bits_for_any_chunks_and_workers(tmp_path):
    settings = made.tree(made.PLUME, duration=1200)
    settings["scenes"] = {"window": "10min"}
    campaign, _ = made.written(tmp_path, settings)
    # Each elsewhere: a file whose values do not change stays as it is.
    records = [
        reprocess_network(campaign.model_copy(update={"output": str(tmp_path / name)}), **options)
        for name, options in (
            ("whole", {}),
            ("parts", {"profiles_per_chunk": 4, "workers": 2}),
        )
    ]
    digests = [
        {outcome.scene: outcome.products[0].sha256 for outcome in record.scenes}
        for record in records
    ]
    assert len(digests[0]) == 2
    assert digests[0] == digests[1]


def test_the_range_window_does_not_change_the_product(tmp_path):
    settings = made.tree(made.PLUME, duration=1200)
    campaign, _ = made.written(tmp_path, settings)
    (job,) = (job for job in scene_jobs(campaign) if job.scene.members)
    windows = [step for step in job.plan.steps if step.rule == "member_window"]
    assert windows
    steps = tuple(step for step in job.plan.steps if step not in windows)
    with counts_read() as of_window:
        windowed = process_scene(job)
    near = opened(campaign, windowed)
    with counts_read() as of_all:
        whole = process_scene(replace(job, plan=replace(job.plan, steps=steps)))
    full = opened(campaign, whole)
    assert sum(of_window) < sum(of_all)
    np.testing.assert_array_equal(near["quality_flag"], full["quality_flag"])
    for name in (
        "total_extinction",
        "total_extinction_standard_error",
        "total_extinction_systematic_error",
    ):
        # Sums over windows begin elsewhere, and are rounded differently.
        np.testing.assert_allclose(near[name], full[name], rtol=1e-6)


def test_optically_thin_air_is_flagged(tmp_path):
    air = {
        "homogeneous": {
            "extinction": {"minimum": 2e-5, "maximum": 2e-5, "hour_of_maximum": 12},
            "molecules_constant": True,
        }
    }
    campaign, truth = made.written(tmp_path, made.tree(air, rate=0.1))
    (outcome,) = reprocess_network(campaign).scenes
    product = opened(campaign, outcome)
    true = made.truth_at(product, truth, beams_of(outcome))
    usable = product["usable"].values < 2
    wrong = np.abs(product["total_extinction"].values / true - 1.0) > 0.5
    assert usable.mean() < 0.2
    assert not (usable & wrong).any()


def test_values_are_flagged_after_a_lidar_stops(tmp_path):
    campaign, _ = made.written(tmp_path, made.tree(made.HOMOGENEOUS, duration=1800))
    raw = Path(campaign.archive)
    # North stops after ten files.
    for path in sorted((raw / "north").iterdir())[10:]:
        path.unlink()
    (outcome,) = reprocess_network(campaign).scenes
    product = opened(campaign, outcome)
    bits = product["quality_flag"].values
    assert (bits[:2] == 0).all()
    assert (bits[2:] != 0).all()
    assert ((bits[2:] & flags_of("visibility").rejecting) != 0).any(axis=1).all()
    assert (np.isnan(product["visibility_in_air"]) <= (product["usable"] == 2)).all()


def test_attributes_of_the_product_name_inputs_and_steps(tmp_path):
    settings = made.tree(made.HOMOGENEOUS, duration=900)
    campaign, _ = made.written(tmp_path, settings)
    (outcome,) = reprocess_network(campaign).scenes
    product = opened(campaign, outcome)
    assert product.attrs["lidarops_input_count"] == 45
    assert product.attrs["lidarops_kind"] == "visibility"
    assert product.attrs["lidarops_station"] == "valley"
    history = product.attrs["history"]
    for name in beams_of(outcome):
        assert f"dead_time: {name}: given by the campaign" in history
    assert "averaged before the retrieval" in history


def test_a_level_path_gives_visibility_too(tmp_path):
    settings = made.tree(made.HOMOGENEOUS, duration=600, rate=2.0)
    instrument = settings["instruments"]["west-lidar"]
    instrument["products"] = {
        "homogeneous": {
            "channels": ["photon_532o"],
            "sections": [[600, 4500]],
            "visibility": {"contrast": 0.02},
        }
    }
    campaign, truth = made.written(tmp_path, settings)
    (outcome,) = reprocess(campaign, selection=Selection(instruments=("west-lidar",))).scenes
    product = opened(campaign, outcome)
    usable = product["usable"].values < 2
    assert usable.any()
    seen = product["visibility_in_air"].values
    np.testing.assert_allclose(
        (seen * product["total_extinction"].values)[usable], -np.log(0.02), rtol=3e-4
    )
    true = -np.log(0.02) / float(truth["total_extinction"].mean())
    inside = (product["visibility_in_air_lower"] <= true) & (
        true <= product["visibility_in_air_upper"]
    )
    assert inside.values[usable].mean() > 0.6
    assert "contrast 0.02" in product.attrs["lidarops_steps"]


def test_a_campaign_chooses_the_multiplier(tmp_path):
    tree = made.tree(made.HOMOGENEOUS)
    for network in tree["networks"].values():
        network["visibility"]["multiplier"] = "chosen"
    campaign, truth = made.written(tmp_path, tree)
    (outcome,) = reprocess_network(campaign).scenes
    product = opened(campaign, outcome)
    known = product["multiplier"].values[np.isfinite(product["multiplier"].values)]
    assert known.size > 0
    assert (known > 0.5).all()
    assert (known < 1.0).all()
    score = scores(product, made.truth_at(product, truth, beams_of(outcome)))
    assert score.size > 0
    assert (abs(score) < 3).all()
    (reason,) = (step.reason for step in outcome.plan.left_out if step.name == "prior")
    assert "multiplier" in reason
