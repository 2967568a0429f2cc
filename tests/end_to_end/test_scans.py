"""Scans from raw files to products: truth within stated errors, and reproducible bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives.scan_campaign import ALTITUDE, TREE
from support.archives.scene_jobs import scene_jobs

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.constants import KNOWN_SHAPE_PAPERS
from lidarops.flags import Quality
from lidarops.reports.findings import disagreement_rows
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.run.archive import Options, bring_up_to_date, reprocess
from lidarops.run.reproduction import reproduce_product
from lidarops.scene.dependence import plan_closure
from lidarops.simulate.campaign import simulate_campaign
from lidarops.system.files import sha256_of


def campaign(folder: Path, **simulation: Any) -> tuple[Campaign, xr.Dataset]:
    """Return a campaign that is simulated in a folder, and its truth."""
    tree = TREE | {"simulation": TREE["simulation"] | simulation}
    path = folder / "scans.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    settings = load_campaign(path)
    return settings, simulate_campaign(settings).truth


def scores(settings: Campaign, truth: xr.Dataset, paths: list[str]) -> np.ndarray[Any, Any]:
    """(retrieved - true) / stated error of the unflagged optical depths."""
    granule = truth["profile_granule_scanner"].values
    upward = truth["zenith_angle"].values[granule] < 1.0
    time = truth["time"].values[granule][upward]
    depth = truth["profile_path_optical_depth_scanner"].values[upward, 0]
    ends = np.append(0.0, truth["range_end_scanner"].values)
    found = []
    for path in paths:
        product = xr.load_dataset(settings.products_root / path)
        error = np.hypot(
            product["vertical_optical_depth_standard_error"],
            product["vertical_optical_depth_gradient_error"],
        ).values
        for cycle in range(product.sizes["time"]):
            nearest = np.argmin(np.abs(time - product["time"].values[cycle]))
            true = np.interp(
                product["altitude"].values - ALTITUDE, ends, np.append(0.0, depth[nearest])
            )
            score = (product["vertical_optical_depth"].values[cycle] - true) / error[cycle]
            # Values below their noise are right within their errors, too.
            bits = product["quality_flag"].values[cycle] & ~int(Quality.LOW_SIGNAL_TO_NOISE)
            found.append(score[bits == 0])
    return np.concatenate(found)


def test_scans_become_optical_depths_within_their_errors(tmp_path):
    settings, truth = campaign(tmp_path)
    (outcome,) = reprocess(settings).scenes
    assert outcome.error == ""
    (product,) = outcome.products
    score = scores(settings, truth, [product.path])
    assert score.size > 300
    assert (np.abs(score) < 3.0).mean() > 0.97
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.3
    # The plan states that the beam scans.
    assert any(step.name == "multiangle" and "scans" in step.reason for step in outcome.plan.steps)
    for chunk in (1, 7):
        # Elsewhere: a file whose values do not change stays as it is.
        other = settings.model_copy(update={"output": str(tmp_path / f"by-{chunk}")})
        (again,) = reprocess(other, options=Options(profiles_per_chunk=chunk)).scenes
        assert again.products[0].sha256 == product.sha256


def test_a_product_names_the_paper_and_the_steps_of_its_own_method(tmp_path):
    settings, _ = campaign(tmp_path, duration=1200)
    lidar = settings.instruments["scanner"]
    shown, variables = {}, {}
    backgrounds = {"mld": "known_shape", "two_angle": "tail_mean", "joint": "known_shape"}
    for method, background in backgrounds.items():
        changes = {"method": method, "background": background}
        scan = lidar.products.multiangle.model_copy(update=changes)
        products = lidar.products.model_copy(update={"multiangle": scan})
        instruments = {"scanner": lidar.model_copy(update={"products": products})}
        again = settings.model_copy(
            update={"instruments": instruments, "output": str(tmp_path / method)}
        )
        (outcome,) = reprocess(again).scenes
        (path,) = (product.path for product in outcome.products if product.kind == "multiangle")
        with xr.open_dataset(again.products_root / path) as product:
            shown[method] = product.attrs["references"], product.attrs["lidarops_steps"]
            variables[method] = set(product.variables)
    assert {method for method, (cited, _) in shown.items() if "Gobrusenko" in cited} == {"mld"}
    for paper in KNOWN_SHAPE_PAPERS.splitlines():
        of_shape = {method for method, (cited, _) in shown.items() if paper in cited}
        assert of_shape == {"mld", "joint"}
    fitted = {m for m, (_, steps) in shown.items() if "left out horizontal_gradient" not in steps}
    assert fitted == {"joint"}
    assert {method for method, names in variables.items() if "regularisation" in names} == {"mld"}


def test_a_campaign_fixes_the_regularisation(tmp_path):
    settings, _ = campaign(tmp_path, duration=600)
    lidar = settings.instruments["scanner"]
    share = []
    for strength in (1e-3, 1.0):
        changes = {"method": "mld", "regularisation": strength}
        scan = lidar.products.multiangle.model_copy(update=changes)
        products = lidar.products.model_copy(update={"multiangle": scan})
        instruments = {"scanner": lidar.model_copy(update={"products": products})}
        again = settings.model_copy(
            update={"instruments": instruments, "output": str(tmp_path / f"{strength}")}
        )
        (outcome,) = reprocess(again).scenes
        with xr.open_dataset(again.products_root / outcome.products[0].path) as product:
            share.append(product["data_share"].median())
            used = product["regularisation"].values
            np.testing.assert_allclose(used[np.isfinite(used)], strength, rtol=1e-3)
            assert np.isfinite(used).any()
            prior = product["prior_vertical_optical_depth"].values
            assert (prior[np.isfinite(prior)] == 0.0).all()
    assert 0.99 < share[0] <= 1.0
    assert share[1] < 0.9


def test_a_fixed_beam_is_not_a_scan(tmp_path):
    simulation = dict(TREE["simulation"])
    instrument = simulation["instruments"]["scanner"]
    still = instrument | {"scan": {"zenith_angles": [0], "azimuth": 90}}
    settings, _ = campaign(tmp_path, duration=400, instruments={"scanner": still})
    (reason,) = bring_up_to_date(settings).empty_scenes.values()
    assert "does not scan" in reason


CHANNELS = ("photon_532p", "analog_532p", "photon_532s")
AGREEMENT = int(Quality.CONTRADICTED | Quality.DISAGREES)


@pytest.fixture(scope="module")
def polarised(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of simulated scans of two polarisations, one of which has an analog record."""
    folder = tmp_path_factory.mktemp("polarised")
    simulate_campaign(of_channels(folder, "out"))
    return folder


def of_channels(
    folder: Path, output: str, channels: tuple[str, ...] = CHANNELS, range_offset: float = 0.0
) -> Campaign:
    """Return a campaign that states the range offset of one channel, wrongly if not 0."""
    lidar, scanner = TREE["instruments"]["scanner"], TREE["simulation"]["instruments"]["scanner"]
    (detector,) = scanner["detectors"]
    analog = {"analog": {"gain": 0.5, "noise": 0.02, "dark_offset": 2.0}}
    detectors = [
        detector | {"signal_rate": 60, "polarisation": name} | recorders
        for name, recorders in (("p", analog), ("s", {}))
    ]
    counting = {"dead_time": 3e-9, "dead_time_uncertainty": 0.01}
    facts = {"photon_532p": counting, "photon_532s": counting | {"range_offset": range_offset}}
    layers = [[0, 1200], [2000, 3000]]
    request = lidar["products"]["multiangle"] | {"channels": list(channels), "layers": layers}
    changed = lidar | {
        "facts": [{"full_overlap_range": 300, "channels": facts}],
        "products": {"multiangle": request},
    }
    tree = TREE | {
        "output": output,
        "instruments": {"scanner": changed},
        "simulation": TREE["simulation"]
        | {"duration": 600, "instruments": {"scanner": scanner | {"detectors": detectors}}},
    }
    path = folder / f"{output}.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_campaign(path)


def opened(settings: Campaign) -> dict[str, xr.Dataset]:
    """Return the products of a campaign by channel."""
    products = map(xr.load_dataset, settings.products_root.rglob("*.nc"))
    return {product.attrs["lidarops_channel"]: product for product in products}


def digests(settings: Campaign) -> dict[str, str]:
    """Return the SHA-256 of the products of a campaign, by name of the file."""
    return {path.name: sha256_of(path) for path in settings.products_root.rglob("*.nc")}


def test_values_of_a_channel_that_others_contradict_are_not_good(polarised):
    settings = of_channels(polarised, "third")
    assert reprocess(settings).scenes[0].disagreements == ()
    agreeing = digests(settings)
    for product in opened(settings).values():
        assert not (product["quality_flag"] & AGREEMENT).any()
    settings = of_channels(polarised, "third", range_offset=40.0)
    run = reprocess(settings)
    pairs = run.scenes[0].disagreements
    assert {pair.outlier for pair in pairs} == {"photon_532s"}
    assert {name for pair in pairs for name in pair.channels} == set(CHANNELS)
    rows = list(disagreement_rows(run.scenes))
    assert len(rows) == len(pairs)
    words = "photon_532s is wrong, as other channels contradict it too"
    assert all(words in row.problem for row in rows)
    wrong = opened(settings)["photon_532s"]
    contradicted = (wrong["quality_flag"] & int(Quality.CONTRADICTED)) != 0
    assert (wrong["usable"].values[contradicted.values] == 2).all()
    assert contradicted.all("time").any()
    assert not (wrong["usable"] == 0).any()
    assert words in wrong.attrs["lidarops_steps"]
    # A layer has no flags of its own.
    top = wrong["layer_bnds"].values.max(axis=1)
    for layer, altitude in enumerate(top):
        rejected = wrong["usable"].sel(altitude=altitude).values == 2
        values = wrong["layer_vertical_optical_depth"].values[rejected, layer]
        assert np.isnan(values).all()
    # The others are judged again, and nothing of them has changed.
    assert {product.channel for product in run.scenes[0].products} == set(CHANNELS)
    changed = {name for name, sha256 in digests(settings).items() if agreeing[name] != sha256}
    assert {name.split("_")[3:5] == ["photon", "532s"] for name in changed} == {True}


def test_a_product_depends_on_the_channels_of_its_wavelength(polarised):
    (job,) = scene_jobs(of_channels(polarised, "plan"))
    needed = {}
    for channel in CHANNELS:
        closure = plan_closure(job.plan, [("multiangle", channel)])
        assert {step.channel for step in closure.steps} == set(CHANNELS)
        assert closure.product_keys == job.plan.product_keys
        needed[channel] = {n for step in closure.steps for n in step.needs if "/" in n}
    assert needed["photon_532s"] == {f"{channel}/multiangle" for channel in CHANNELS}
    (alone,) = scene_jobs(of_channels(polarised, "plan", CHANNELS[:1]))
    assert not any("/" in need for step in alone.plan.steps for need in step.needs)


def test_two_channels_that_disagree_are_both_to_be_used_with_care(polarised):
    pair = ("photon_532p", "photon_532s")
    settings = of_channels(polarised, "two", pair, 40.0)
    (found,) = reprocess(settings).scenes[0].disagreements
    assert (found.channels, found.outlier) == (pair, "")
    for product in opened(settings).values():
        flags = product["quality_flag"]
        assert ((flags & AGREEMENT) == int(Quality.DISAGREES)).all()
        assert (product["usable"] == 1).any()
        assert "one of the two is wrong" in product.attrs["lidarops_steps"]


@pytest.mark.slow
def test_verdicts_on_channels_are_the_same_whatever_is_made_with_them(polarised):
    settings = of_channels(polarised, "alone", range_offset=40.0)
    reprocess(settings)
    made = digests(settings)
    for path in settings.products_root.rglob("*.nc"):
        assert reproduce_product(path, archive=settings.archive).identical
        path.unlink()
        (scene,) = reprocess(settings).scenes
        assert [settings.products_root / product.path for product in scene.products] == [path]
        names = {name for pair in scene.disagreements for name in pair.channels}
        assert scene.products[0].channel in names
        assert digests(settings) == made
    # Elsewhere: a file whose values do not change stays as it is.
    other = settings.model_copy(update={"output": f"{settings.output}-by-2"})
    reprocess(other, options=Options(workers=2, profiles_per_chunk=7))
    assert digests(other) == made
    # A channel that is no longer requested is no witness.
    reprocess(of_channels(polarised, "alone", ("photon_532s", "analog_532p"), 40.0))
    flags = opened(settings)["photon_532s"]["quality_flag"]
    assert ((flags & AGREEMENT) == int(Quality.DISAGREES)).all()


@pytest.mark.slow
def test_two_hundred_scans(tmp_path):
    settings, truth = campaign(tmp_path, duration=86_400)
    outcomes = reprocess(settings).scenes
    assert [outcome.error for outcome in outcomes] == [""] * 4
    paths = [product.path for outcome in outcomes for product in outcome.products]
    cycles = sum(xr.open_dataset(settings.products_root / path).sizes["time"] for path in paths)
    assert cycles >= 200
    score = scores(settings, truth, paths)
    assert score.size > 5000
    assert (np.abs(score) < 3.0).mean() >= 0.99


def low_scan(folder: Path, zenith_angles: list[float]) -> Campaign:
    """Return a simulated campaign that scans over these angles to one side."""
    instrument = TREE["simulation"]["instruments"]["scanner"]
    scan = {"zenith_angles": zenith_angles, "azimuth": 90}
    return campaign(folder, duration=800, instruments={"scanner": instrument | {"scan": scan}})[0]


def test_beams_near_the_horizon_are_left_out_with_a_reason(tmp_path):
    (outcome,) = reprocess(low_scan(tmp_path, [88.0, 87.5, 83.0, 80.0, 70.0])).scenes
    (step,) = (step for step in outcome.plan.steps if step.name == "multiangle")
    assert "less than 3.0 degree above the horizon, left out: 2 of 5 (40%)" in step.warning
    assert "a range-height scan (RHI) at azimuth 90 degree, 3 directions" in step.reason
    with xr.open_dataset(next(tmp_path.rglob("*multiangle*.nc"))) as product:
        np.testing.assert_allclose(product["beam_zenith_angle"], [70.0, 80.0, 83.0])


@pytest.mark.parametrize(
    "angles", [[89.9, 88.0, 84.0], [89.0, 87.2, 80.0], [88.0, 80.0, 80.1], [20.0, 24.0, 26.0]]
)
def test_a_scan_without_leverage_is_known_before_it_is_read(tmp_path, angles):
    record = bring_up_to_date(low_scan(tmp_path, angles))
    (reason,) = record.empty_scenes.values()
    assert ("less than 3.0 degree above the horizon" in reason) == (max(angles) > 87.0)
    assert "no leverage" in reason


def test_a_scan_of_one_elevation_is_named(tmp_path):
    instrument = TREE["simulation"]["instruments"]["scanner"]
    scan = {"zenith_angles": [80.0], "azimuth": 0, "further_azimuths": [60, 120, 180, 240, 300]}
    settings, _ = campaign(
        tmp_path, duration=800, instruments={"scanner": instrument | {"scan": scan}}
    )
    (reason,) = bring_up_to_date(settings).empty_scenes.values()
    assert "a plan-position scan (PPI) at 10 degree above the horizon" in reason
    assert "azimuth sector of 300 degree" in reason
    assert "does not scan" not in reason


def level_scan(folder: Path, sections: list[list[float]]) -> tuple[Campaign, xr.Dataset]:
    """Return a simulated campaign with level and steep beams to two sides, and its truth."""
    lidar, instrument = TREE["instruments"]["scanner"], TREE["simulation"]["instruments"]["scanner"]
    scan = {"zenith_angles": [90, 89, 88.6, 88, 60, 45], "azimuth": 20, "further_azimuths": [140]}
    homogeneous = {"channels": ["photon_532o"], "sections": sections}
    tree = TREE | {
        "instruments": {"scanner": lidar | {"products": {"homogeneous": homogeneous}}},
        "simulation": TREE["simulation"]
        | {"duration": 12 * 39 * 4, "instruments": {"scanner": instrument | {"scan": scan}}},
    }
    path = folder / "level.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    settings = load_campaign(path)
    return settings, simulate_campaign(settings).truth


def test_level_beams_of_a_scan_give_extinction_by_direction(tmp_path):
    sections = [[1000.0, 2000.0], [2000.0, 4000.0]]
    settings, truth = level_scan(tmp_path, sections)
    (outcome,) = reprocess(settings).scenes
    reasons = [out.reason for out in outcome.plan.left_out if out.rule == "beam_level"]
    assert [reason.split(", whose")[0] for reason in reasons] == [
        "section 1000-2000 m: values of 16 of 48 files are rejected",
        "section 2000-4000 m: values of 16 of 48 files are rejected",
    ]
    (step,) = (step for step in outcome.plan.steps if step.name == "homogeneous")
    assert "far range, because the beam moves" in step.reason
    product = xr.load_dataset(settings.products_root / outcome.products[0].path)
    means = product["total_extinction"].groupby(["zenith_angle", "azimuth"]).mean()
    assert means.sizes == {"zenith_angle": 6, "azimuth": 2, "section": 2}
    steep = product["quality_flag"] & int(HomogeneousQuality.NOT_LEVEL) != 0
    assert (steep == (product["zenith_angle"] < 88.0)).all()
    of_path = truth["total_extinction"].values
    granule, ends = truth["profile_granule_scanner"].values, truth["range_end_scanner"].values
    paths = truth["profile_path_optical_depth_scanner"].values[:, 0]
    score = []
    for number, (near, far) in enumerate(sections):
        expected = of_path.copy()
        expected[granule] = [
            np.subtract(*np.interp([far, near], ends, path)) / (far - near) for path in paths
        ]
        part = product.isel(section=number, time=~steep[:, number].values)
        deviation = part["total_extinction"] - expected[~steep[:, number].values]
        score.append((deviation / part["total_extinction_standard_error"]).values)
    assert (product["usable"].values[~steep.values] < 2).all()
    assert 0.8 < np.sqrt(np.mean(np.square(score))) < 1.2


def test_gradient_errors_of_planes_pool_over_the_scene_whatever_the_chunks(tmp_path):
    instrument = TREE["simulation"]["instruments"]["scanner"]
    scan = {"zenith_angles": [75, 60, 30], "azimuth": 20, "further_azimuths": [140, 260]}
    settings, _ = campaign(
        tmp_path, duration=18 * 39, instruments={"scanner": instrument | {"scan": scan}}
    )
    digests = []
    for chunk in (1, 7, 100):
        other = settings.model_copy(update={"output": str(tmp_path / f"by-{chunk}")})
        (outcome,) = reprocess(other, options=Options(profiles_per_chunk=chunk)).scenes
        digests.append(outcome.products[0].sha256)
    assert digests == digests[:1] * 3
    (step,) = (step for step in outcome.plan.steps if step.name == "gradient")
    assert "scatter between them, pooled over all cycles of the scene and 15" in step.reason
    product = xr.load_dataset(other.products_root / outcome.products[0].path)
    assert product.sizes["plane"] == 3
    # The air is level: planes differ by noise alone, a tenth of what the declared gradient allows.
    error = product["plane_vertical_optical_depth_gradient_error"]
    noise = product["plane_vertical_optical_depth_standard_error"].where(error.notnull())
    assert error.notnull().sum() > 400
    assert error.mean() < 0.1 * noise.mean()
