"""Raman products from raw files: a simulated night and morning, and a real night."""

from __future__ import annotations

import itertools
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.raman_signals import mean_over

from lidarops.campaign.ancillary_files import lidar_ratio_profile
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.constants import KNOWN_SHAPE_PAPERS
from lidarops.flags import Quality, rejecting
from lidarops.netcdf.variables import judging, summary_of
from lidarops.records import RunRecord
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.flags import CONCERNING, RamanQuality
from lidarops.retrieve.raman.thresholds import THRESHOLDS
from lidarops.run.archive import Options, reprocess
from lidarops.simulate.campaign import simulate_campaign
from lidarops.simulate.signal import sine_overlap

STEP = 15.0
SURFACE, SCALE_HEIGHT = 0.008, 2000.0
"""Simulated mixing ratio of water vapour at the ground, and its scale height, m."""


def simulated(
    repository: Path, folder: Path, start: str, hours: float
) -> tuple[Campaign, xr.Dataset]:
    """Return the example campaign, simulated for some hours, and its truth."""
    path = repository / "catalogs/raman.yaml"
    campaign = load_campaign(path, archive=folder / "raw", output=folder / "out")
    assert campaign.simulation is not None
    changes = {"start": datetime.fromisoformat(start), "duration": hours * 3600.0}
    simulation = campaign.simulation.model_copy(update=changes)
    campaign = campaign.model_copy(update={"simulation": simulation})
    return campaign, simulate_campaign(campaign).truth


@pytest.fixture(scope="module")
def night(repository, tmp_path_factory):
    """Two hours of a simulated night: campaign, truth, run."""
    folder = tmp_path_factory.mktemp("night")
    campaign, truth = simulated(repository, folder, "2024-09-20T21:00:00+00:00", 2.0)
    record = reprocess(campaign)
    assert record is not None
    return campaign, truth, record


def product_of(campaign: Campaign, record: RunRecord, kind: str = "raman") -> xr.Dataset:
    """Return the product of the only scene."""
    (scene,) = record.scenes
    assert scene.error == ""
    (path,) = (made.path for made in scene.products if made.kind == kind)
    return xr.load_dataset(campaign.products_root / path)


def particles(truth: xr.Dataset) -> dict[str, Any]:
    """Return mean extinction and backscatter of particles in bins of 15 m, at 355 nm."""
    r = truth["range_valley_raman"].values
    air = MolecularProfile.us_standard()
    fine = STEP * (np.arange(1000) + 0.5)
    found = {}
    for name in ("extinction", "backscatter"):
        values = truth[f"profile_total_{name}_valley_raman"].values[:, 0].mean(axis=0)
        values = values - getattr(air, name)(500.0 + r, 355e-9)
        found[f"aerosol_{name}"] = np.interp(fine, r, values)
    return found


def deviations(product: xr.Dataset, name: str, true: Any) -> Any:
    """Return deviations over stated errors of values below 6 km that are not rejected."""
    usable = product[summary_of(judging(name, product.variables))].values < 2
    usable &= product["range"].values < 6000.0
    z = (product[name].values - true) / product[f"{name}_standard_error"].values
    return z[usable & np.isfinite(z)]


def test_a_simulated_night_agrees_with_the_truth(night):
    campaign, truth, record = night
    product, true = product_of(campaign, record), particles(truth)
    assert (product["profiles_left_out"].values == 0).all()
    r = product["range"].values
    length = np.nan_to_num(product["vertical_resolution"].values, nan=60.0)
    nearest = r[np.isfinite(product["aerosol_extinction"].values).any(axis=0)][0] - 30.0
    extinction = mean_over(true["aerosol_extinction"], STEP, r, length, nearest)
    backscatter = mean_over(true["aerosol_backscatter"], STEP, r, np.full(r.size, 60.0))
    resolved = mean_over(true["aerosol_backscatter"], STEP, r, length, nearest)
    ratio = extinction / np.maximum(resolved, 1e-12)
    water = SURFACE * np.exp(-r / SCALE_HEIGHT)
    cases = (
        ("aerosol_extinction", extinction),
        ("aerosol_backscatter", backscatter),
        ("lidar_ratio", ratio),
        ("water_vapour_mixing_ratio", water),
    )
    for name, values in cases:
        z = deviations(product, name, values)
        assert z.size > 50, name
        assert np.mean(np.abs(z) < 1.96) > 0.9, name
        assert np.sqrt(np.mean(z**2)) < 1.2, name
    # Errors are not just large: the boundary layer is known to 15 %.
    layer = (r > 600.0) & (r < 1000.0)
    error = product["aerosol_extinction_standard_error"].values[:, layer]
    assert np.all(error < 0.15 * extinction[:, layer])


def test_the_file_states_its_reference_and_the_source_of_the_air(night):
    campaign, _, record = night
    product = product_of(campaign, record)
    # Without a sounding, the slope of density is known to 1.6e-5 m-1, of both wavelengths.
    error = product["aerosol_extinction_error_molecular"].values
    assert np.nanmin(error) == pytest.approx(1.6e-5 / 1.9, rel=0.05)
    sources = product["atmospheric_molecular_calculation_source"].attrs["flag_meanings"].split()
    assert (
        sources[product["atmospheric_molecular_calculation_source"].item()]
        == "US_standard_atmosphere"
    )
    # The station lies at 500 m, and the beam is vertical.
    altitude = product["reference_bottom_altitude"].values
    np.testing.assert_allclose(altitude, 500.0 + product["reference_bottom"].values, rtol=1e-6)
    assert np.isfinite(altitude).all()
    assert product["reference_scattering_ratio"].item() >= 1.0


@pytest.mark.parametrize("background", ["known_shape", "tail_mean"])
def test_products_cite_the_papers_of_the_known_shape_where_it_runs(
    repository, tmp_path, background
):
    campaign, _ = simulated(repository, tmp_path, "2024-09-20T21:00:00+00:00", 0.5)
    (name, lidar), *_ = campaign.instruments.items()
    requests = {
        kind: getattr(lidar.products, kind).model_copy(update={"background": background})
        for kind in ("elastic", "raman")
    }
    products = lidar.products.model_copy(update=requests)
    changed = {name: lidar.model_copy(update={"products": products})}
    campaign = campaign.model_copy(update={"instruments": changed})
    record = reprocess(campaign)
    for kind in requests:
        cited = product_of(campaign, record, kind).attrs["references"]
        assert (KNOWN_SHAPE_PAPERS in cited) == (background == "known_shape")
        assert "Appl. Opt." in cited


def test_a_product_states_the_estimated_dead_time_of_its_nitrogen_channel(repository, tmp_path):
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text())
    lidar = tree["instruments"]["valley-raman"]
    del lidar["products"]["signal"]
    tree["simulation"]["duration"] = 1800
    detectors = tree["simulation"]["instruments"]["valley-raman"]["detectors"]
    detectors[1]["analog"] = {"gain": 0.5, "noise": 0.05, "dark_offset": 1.0}
    path = tmp_path / "estimate.yaml"

    def campaign() -> Campaign:
        path.write_text(yaml.safe_dump(tree))
        return load_campaign(path, archive=tmp_path / "raw", output=tmp_path / "out")

    simulate_campaign(campaign())
    lidar["facts"][0]["channels"]["photon_387o"] = {"dead_time": "estimate"}
    record = reprocess(campaign())
    stated = {
        kind: product_of(campaign(), record, kind).attrs.get("lidarops_steps", "")
        for kind in ("elastic", "raman")
    }
    assert "of photon_387o" in stated["raman"]
    assert "dead_time" not in stated["elastic"]
    # The analog record is too noisy for an estimate: the run says so, with the remedy.
    assert "no estimate" in stated["raman"]
    (note,) = record.scenes[0].notes
    assert "dead_time: estimate of photon_387o" in note
    assert "give dead_time, such as 4 ns" in note


def test_each_value_below_its_error_has_a_bit(night):
    campaign, _, record = night
    product = product_of(campaign, record)
    for name in CONCERNING:
        flags = product[judging(name, product.variables)]
        weak = np.abs(product[name]) < product[f"{name}_standard_error"]
        np.testing.assert_array_equal((flags & Quality.LOW_SIGNAL_TO_NOISE) != 0, weak)
    assert weak.sum() > 100


def test_a_quantity_is_not_doubted_for_another(night):
    campaign, _, record = night
    product = product_of(campaign, record)
    extinction = product["aerosol_extinction"]
    precise = extinction > 3.0 * product["aerosol_extinction_standard_error"]
    assert precise.sum() > 80
    # Without a lidar ratio for want of backscatter, which says nothing of extinction.
    assert (precise & product["lidar_ratio"].isnull()).sum() > 5
    assert (product["usable"].where(precise, 0) == 0).all()
    assert set(np.unique(product["lidar_ratio_usable"])) > {0, 1}


def test_water_vapour_needs_no_overlap(night):
    campaign, _, record = night
    product = product_of(campaign, record)
    near = (product["range"].values > 100.0) & (product["range"].values < 400.0)
    true = SURFACE * np.exp(-product["range"].values / SCALE_HEIGHT)
    away = product["water_vapour_mixing_ratio"].values[:, near] / true[near] - 1.0
    # The noise of a cell is 3 %; a signal without overlap correction is up to 60 % off.
    assert np.nanmax(np.abs(away)) < 0.15


def test_the_overlap_of_the_pair_is_the_simulated_one(night):
    campaign, _, record = night
    product = product_of(campaign, record)
    near = (product["range"].values > 60.0) & (product["range"].values < 400.0)
    true = sine_overlap(product["range"].values, 400.0)
    away = product["overlap"].values - true
    # Cells of 60 m average a curved function.
    error = np.hypot(product["overlap_standard_error"].values, 0.01)
    assert np.all(np.abs(away / error)[:, near] < 4.0)
    assert np.abs(away[:, near]).max() < 0.15


def test_results_do_not_depend_on_chunks(night, tmp_path):
    campaign, _, record = night
    digests = {made.path: made.sha256 for scene in record.scenes for made in scene.products}
    # Elsewhere: a file whose values do not change stays as it is.
    other = campaign.model_copy(update={"output": str(tmp_path)})
    again = reprocess(other, options=Options(profiles_per_chunk=5))
    assert {made.path: made.sha256 for s in again.scenes for made in s.products} == digests


def test_the_elastic_inversion_takes_the_measured_lidar_ratio(repository, night, tmp_path):
    campaign, _, record = night
    (path,) = (made.path for made in record.scenes[0].products if made.kind == "raman")
    measured = tmp_path / "night.nc"
    measured.write_bytes((campaign.products_root / path).read_bytes())
    profile, digest = lidar_ratio_profile(tmp_path, "night.nc")
    layer = (profile.altitude > 1000.0) & (profile.altitude < 1700.0)
    # The simulated boundary layer has 60 sr.
    z = (profile.ratio - 60.0)[layer] / profile.standard_error[layer]
    assert np.abs(z).max() < 3.0
    assert profile.standard_error[layer].max() < 25.0
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text(encoding="utf-8"))
    channels = tree["instruments"]["valley-raman"]["facts"][0]["channels"]
    channels["photon_355o"]["lidar_ratio_profile"] = "night.nc"
    path = tmp_path / "day.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    day = load_campaign(path, archive=campaign.archive, output=tmp_path / "out")
    again = reprocess(day)
    product = product_of(day, again, "elastic")
    beyond = tree["instruments"]["valley-raman"]["products"]["elastic"].get("lidar_ratio", 50.0)
    at, _ = profile.at(product["altitude"].values, (beyond, 10.0))
    np.testing.assert_allclose(product["lidar_ratio"].values, at, rtol=1e-4)
    made = {record.path: record.sha256 for record in again.scenes[0].inputs}
    assert made["night.nc"] == digest


def test_extinction_reaches_down_with_the_measured_overlap(repository, night, tmp_path):
    campaign, truth, record = night
    (path,) = (made.path for made in record.scenes[0].products if made.kind == "raman")
    (tmp_path / "night.nc").write_bytes((campaign.products_root / path).read_bytes())
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text(encoding="utf-8"))
    lidar = tree["instruments"]["valley-raman"]
    lidar["facts"][0] |= {"full_overlap_range": 150, "overlap_profile": "night.nc"}
    lidar["products"] = {"raman": lidar["products"]["raman"]}
    # Simulated files have the overlap of the facts they were made with.
    del tree["simulation"]
    path = tmp_path / "again.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    again = load_campaign(path, archive=campaign.archive, output=tmp_path / "out")
    product = product_of(again, reprocess(again))
    r = product["range"].values
    near = (r > 180.0) & (r < 400.0)
    true = mean_over(particles(truth)["aerosol_extinction"], STEP, r, np.full(r.size, 60.0))
    found = product["aerosol_extinction"].values[:, near]
    assert np.isfinite(found).all()
    # 4 % here; with lines between the means of cells of the overlap, 25 %.
    assert np.abs(found.mean(axis=0) / true[near] - 1.0).max() < 0.1
    error = product["aerosol_extinction_standard_error"].values[:, near]
    assert np.abs((found - true[near]) / error).max() < 3.0


def test_daylight_gives_an_empty_product_with_the_reason(repository, tmp_path):
    campaign, _ = simulated(repository, tmp_path, "2024-09-21T09:00:00+00:00", 0.5)
    record = reprocess(campaign)
    product = product_of(campaign, record)
    assert np.isnan(product["aerosol_extinction"].values).all()
    assert np.isnan(product["aerosol_backscatter"].values).all()
    assert np.all(product["quality_flag"].values & int(RamanQuality.WEAK_SIGNAL))
    # It is up to date, although it is empty.
    assert reprocess(campaign) is None or not reprocess(campaign).scenes


def test_a_missing_raman_channel_leaves_the_product_out(repository, tmp_path):
    tree = yaml.safe_load((repository / "catalogs/raman.yaml").read_text(encoding="utf-8"))
    tree["simulation"]["duration"] = 1200
    tree["simulation"]["instruments"]["valley-raman"]["detectors"].pop(1)
    path = tmp_path / "raman.yaml"
    path.write_text(yaml.safe_dump(tree | {"archive": "raw", "output": "out"}), encoding="utf-8")
    campaign = load_campaign(path)
    simulate_campaign(campaign)
    (scene,) = reprocess(campaign).scenes
    assert {made.kind for made in scene.products} == {"signal", "elastic"}
    (left,) = (
        left
        for left in (*scene.plan.left_out, *scene.left_out)
        if left.name == "raman" and left.channel == "photon_355o"
    )
    assert "photon_387o" in left.reason


@pytest.fixture(scope="module")
def manaus(data_root, tmp_path_factory):
    """The real night of Manaus, with elastic inversion and Raman retrieval."""
    archive = data_root / "manaus_raman"
    if not archive.exists():
        pytest.skip("no files of Manaus")
    folder = tmp_path_factory.mktemp("manaus")
    levels = np.genfromtxt(archive / "sounding.csv", delimiter=",", names=True)
    rising = np.concatenate([[True], np.diff(np.maximum.accumulate(levels["alt"])) > 0])
    lines = ["altitude,pressure,temperature"]
    lines += [f"{a},{p},{t}" for p, t, a in levels[rising].tolist()]
    (folder / "sounding.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    counting = {"dead_time": 4e-9}
    reference = {"lowest": 7000, "highest": 11_000, "width": 2000}
    station = {"name": "Manaus", "latitude": -2.89, "longitude": -59.97, "altitude": 100}
    tree = {
        "name": "manaus",
        "title": "Night of Manaus",
        "archive": str(archive),
        "output": "out",
        "stations": {"manaus": station},
        "instruments": {
            "lidar": {
                "station": "manaus",
                "files": "RM12616*",
                "header_position": "ignore",
                "facts": [
                    {
                        "zenith_angle": 0,
                        "full_overlap_range": 2500,
                        "molecular_profile": "sounding.csv",
                        "channels": {
                            "photon_355o": counting,
                            "photon_387o": counting,
                            "analog_355o": {"baseline_uncertainty": 0.002},
                        },
                    }
                ],
                "products": {
                    "elastic": {
                        "channels": ["glued_355o"], "lidar_ratio": 55, "reference": reference,
                    },
                    "raman": {
                        "channels": ["glued_355o"],
                        "nitrogen": {"glued_355o": "photon_387o"},
                        "reference": reference,
                    },
                },
            }
        },
    }  # fmt: skip
    path = folder / "manaus.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    record = reprocess(campaign)
    assert record is not None
    scene = max(record.scenes, key=lambda one: one.granules)
    return tuple(
        xr.load_dataset(campaign.products_root / made.path)
        for kind in ("elastic", "raman")
        for made in scene.products
        if made.kind == kind
    )


def test_the_night_of_manaus_agrees_with_clean_air_and_the_elastic_inversion(manaus):
    elastic, raman = (product.isel(time=0) for product in manaus)
    assert raman["profiles_left_out"] == 0
    # Not at 82 km, where one file has 12 counts in 4 bins.
    assert raman["cloud_top_altitude"] == pytest.approx(14_500.0, abs=600.0)
    r = raman["range"].values
    usable = (raman["quality_flag"].values & rejecting((*RamanQuality, *Quality))) == 0
    # Up to 6 km the signal falls less than air explains, as where overlap is not complete: no
    # value is below zero by more than its error and still good.
    negative = (raman["quality_flag"].values & RamanQuality.NEGATIVE_EXTINCTION) != 0
    assert negative[(r > 2520.0) & (r < 6000.0)].all()
    assert not negative[r > 6000.0].any()
    assert (usable & (r < 8500.0)).sum() > 15
    # Clean air above the aerosol, rejected values too: no extinction within the errors.
    clean = (r > 6000.0) & (r < 8500.0)
    assert clean.sum() > 30
    z = raman["aerosol_extinction"].values / raman["aerosol_extinction_standard_error"].values
    assert np.mean(np.abs(z[clean]) < 1.96) > 0.85
    assert np.mean(np.abs(z[clean & usable]) < 1.96) > 0.85
    # Aerosol of the free atmosphere, by both methods.
    haze = (r > 2600.0) & (r < 5000.0)
    with_55 = np.interp(r, elastic["range"].values, elastic["aerosol_backscatter"].values)
    away = raman["aerosol_backscatter"].values - with_55
    error = raman["aerosol_backscatter_standard_error"].values
    assert np.nanmean(np.abs(away[haze] / error[haze])) < 3.0


def test_backscatters_of_manaus_are_rejected_for_their_own_flags_only(manaus):
    """Not where extinction is, below a signal that falls less than that of air."""
    raman = manaus[1]
    value, error = (raman[f"aerosol_backscatter{end}"] for end in ("", "_standard_error"))
    significant = (value > 3.0 * error).values
    assert significant.sum() > 60
    rejected = raman["aerosol_backscatter_usable"].values == 2
    saturated = (raman["aerosol_backscatter_quality_flag"].values & Quality.SATURATED) != 0
    np.testing.assert_array_equal(rejected[significant], saturated[significant])
    assert rejected[significant].mean() < 0.05
    assert (raman["usable"].values == 2)[significant].mean() > 0.2


def test_the_slope_of_the_standard_atmosphere_is_off_by_its_stated_error(data_root):
    levels = np.genfromtxt(data_root / "manaus_raman/sounding.csv", delimiter=",", names=True)
    temperature = levels["temp"] + (273.15 if levels["temp"].max() < 100.0 else 0.0)
    sounding = MolecularProfile.from_profile(levels["alt"], levels["pres"], temperature)
    z = np.arange(130.0, 12_000.0, 60.0)
    densities = (air.number_density(z) for air in (sounding, MolecularProfile.us_standard()))
    slopes = [np.gradient(np.log(density), z) for density in densities]
    away = np.sqrt(np.mean((slopes[0] - slopes[1]) ** 2))
    assert away == pytest.approx(THRESHOLDS.standard_slope_error, rel=0.02)
    edges = np.array([100.0, 1000.0, 2000.0, 4000.0, 8000.0, 12_000.0])
    parts = [(z > low) & (z < high) for low, high in itertools.pairwise(edges)]
    of_parts = [np.sqrt(np.mean((slopes[0] - slopes[1])[part] ** 2)) for part in parts]
    np.testing.assert_allclose(np.multiply(of_parts, 1e6), [4.3, 5.9, 7.0, 10.2, 24.8], atol=0.3)


def test_the_night_of_manaus_has_the_extinction_of_the_page(manaus):
    heights = 1000.0 * np.array([3, 4, 5, 6, 8, 10])
    rows = {
        "raman": ((-20, -21, -2, -8, 0, 1), (10, 5, 5, 5, 5, 6)),
        "elastic": ((-2, -6, -6, -1, 1, -3), (3, 4, 4, 3, 10, 6)),
    }
    for product, stated in zip(manaus, (rows["elastic"], rows["raman"]), strict=True):
        near = np.abs(product["range"].values - heights[:, np.newaxis]) <= 30.0
        for name, figures in zip(("", "_standard_error"), stated, strict=True):
            values = 1e6 * product[f"aerosol_extinction{name}"].values[0]
            means = [values[cells].mean() for cells in near]
            np.testing.assert_allclose(means, figures, atol=0.6)
