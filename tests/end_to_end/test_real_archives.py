"""Two real archives from raw files to products."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.archives.scene_jobs import catalogued_scenes

from lidarops.campaign.model import load_campaign
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.records import Role, RunRecord
from lidarops.run.archive import report_run, reprocess
from lidarops.scene.plan import plan_scene

CAMPAIGNS = Path(__file__).parent / "campaigns"
LOW = np.int32(Quality.LOW_SIGNAL_TO_NOISE)


def _reprocess(name: str, data_root: Path, out: Path) -> RunRecord:
    campaign = load_campaign(CAMPAIGNS / f"{name}.yaml", archive=data_root / name, output=out)
    # Sections that a plan would leave out have to be flagged by the retrieval.
    campaign = campaign.model_copy(update={"all_steps": True})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record = reprocess(campaign)
    assert record is not None
    report_run(campaign, record)
    return record


@pytest.fixture(scope="module")
def pilar(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    """A run over 120 files of Pilar."""
    return _reprocess("pilar", data_root, tmp_path_factory.mktemp("pilar"))


@pytest.fixture(scope="module")
def saopaulo(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    """A run over 16 files of Sao Paulo, with 12 dark files."""
    return _reprocess("saopaulo", data_root, tmp_path_factory.mktemp("saopaulo"))


def _open(record: RunRecord, kind: str, channel: str) -> xr.Dataset:
    paths = [
        product.path
        for scene in record.scenes
        for product in scene.products
        if product.kind == kind and product.channel == channel
    ]
    assert len(paths) == 1
    product = xr.load_dataset(Path(record.products) / paths[0])
    return product.swap_dims(altitude="range") if "altitude" in product.dims else product


def test_pilar_loses_no_file(pilar: RunRecord) -> None:
    (scene,) = pilar.scenes
    assert scene.error == ""
    assert scene.granules == 120
    assert not pilar.failed
    # The header states 53200 nm; the campaign corrects it for one of the two channels only.
    channels = [
        left.channel
        for left in (*(scene.plan.left_out if scene.plan else ()), *scene.left_out)
        if "wavelength" in left.reason
    ]
    assert channels == ["photon_53200o"]
    assert len(scene.products) == 11 + 2 + 3


def test_inputs_are_digested(pilar: RunRecord, data_root: Path) -> None:
    for used in pilar.scenes[0].inputs[:3]:
        content = (data_root / "pilar" / used.path).read_bytes()
        assert used.sha256 == hashlib.sha256(content).hexdigest()


def test_daylight_saturates_the_photon_counting_of_pilar(pilar: RunRecord) -> None:
    signal = _open(pilar, "signal", "photon_532p")
    flags = signal["quality_flag"].values
    assert ((flags & Quality.PILE_UP) != 0).mean() > 0.9
    assert signal["background"].min() > 40.0
    homogeneous = _open(pilar, "homogeneous", "photon_532p")
    assert (homogeneous["quality_flag"].values != 0).all()


def test_analog_at_full_scale_is_flagged(pilar: RunRecord) -> None:
    signal = _open(pilar, "signal", "analog_1064o")
    saturated = (signal["quality_flag"].values & Quality.SATURATED) != 0
    assert saturated.any()
    assert np.isnan(signal["signal"].values[saturated]).all()
    near = signal["range"].values < 600
    assert ((signal["quality_flag"].values[:, near] & Quality.INCOMPLETE_OVERLAP) != 0).all()


@pytest.mark.parametrize("channel", ["analog_532p", "photon_532p"])
def test_a_vertical_atmosphere_is_not_taken_for_homogeneous(pilar: RunRecord, channel: str) -> None:
    product = _open(pilar, "homogeneous", channel)
    assert (product["quality_flag"].values != 0).all()
    assert product["time"].size == 120


def test_saopaulo_has_physical_values(saopaulo: RunRecord) -> None:
    assert not saopaulo.failed
    photon = _open(saopaulo, "signal", "photon_532o")
    rate = photon["signal"] / photon["range"] ** 2 + photon["background"]
    # Dead-time corrected; measured rates stay below 140 MHz, and above 125 MHz are masked.
    assert 5.0 < float(rate.max()) < 280.0
    assert photon["signal"].attrs["units"].startswith("MHz")
    analog = _open(saopaulo, "signal", "analog_532o")
    assert analog["signal"].attrs["units"].startswith("mV")
    voltage = analog["signal"] / analog["range"] ** 2 + analog["background"]
    assert float(voltage.min()) > -5.0
    assert float(voltage.max()) < 500.0
    assert analog["time"].size == 16
    assert str(analog["time"].values[0]) == "2017-09-28T16:17:06.000000000"


def test_dark_files_are_subtracted(saopaulo: RunRecord) -> None:
    (scene,) = saopaulo.scenes
    assert sum(used.role is Role.DARK for used in scene.inputs) == 12
    analog = _open(saopaulo, "signal", "analog_532o")
    # The dark offset of this channel is several mV; the sky above Sao Paulo adds less than that.
    assert abs(analog["background"].values).max() < 2.0


def test_saopaulo_is_not_homogeneous(saopaulo: RunRecord) -> None:
    product = _open(saopaulo, "homogeneous", "analog_532o")
    assert (product["quality_flag"].values != 0).all()


@pytest.mark.parametrize("name", ["pilar", "saopaulo"])
def test_sections_of_a_vertical_path_are_left_out(
    data_root: Path, tmp_path: Path, name: str
) -> None:
    campaign = load_campaign(CAMPAIGNS / f"{name}.yaml", archive=data_root / name, output=tmp_path)
    (scene,) = catalogued_scenes(campaign)
    planned = plan_scene(scene, campaign)
    assert not [step for step in planned.steps if step.name == "homogeneous"]
    left = [item for item in planned.left_out if item.rule == "section_level"]
    assert left
    assert all(item.number is not None and item.number > 100.0 for item in left)


def test_by_day_the_analog_record_of_pilar_is_inverted_alone(pilar: RunRecord) -> None:
    photon = _open(pilar, "elastic", "photon_532p")
    flags = photon["quality_flag"].values
    assert (flags & Quality.PILE_UP).all()
    assert (flags != 0).all()
    glued, analog = (_open(pilar, "elastic", f"{record}_532p") for record in ("glued", "analog"))
    assert (glued["quality_flag"].values & Quality.SINGLE_RECORD).all()
    assert (glued["glue_top"].values > glued["range"].values[-1]).all()
    rejected = glued["quality_flag"].values & flags_of("elastic").rejecting
    assert ((rejected == 0).mean(axis=1) > 0.5).all()
    value, error = ("aerosol_backscatter", "aerosol_backscatter_standard_error")
    difference = np.abs(glued[value] - analog[value]).values
    both = np.isfinite(difference)
    assert both.mean() > 0.5
    assert (difference < 0.5 * analog[error].values)[both].all()


def test_pilar_has_aerosol_below_clean_air(pilar: RunRecord) -> None:
    product = _open(pilar, "elastic", "analog_532p")
    values = product[["aerosol_backscatter", "scattering_ratio"]]
    good = values.where(product["quality_flag"] & ~LOW == 0)
    assert float(good["aerosol_backscatter"].count()) > 0.5 * product["aerosol_backscatter"].size
    near = good["scattering_ratio"].sel(range=slice(800, 2000)).mean()
    far = good["scattering_ratio"].sel(range=slice(8000, 10_000)).mean()
    assert 1.2 < float(near) < 20.0
    assert abs(float(far) - 1.0) < 0.5
    assert product["profiles"].sum() == 120
    # The lidar ratio of the campaign determines the extinction.
    ratio = product["aerosol_extinction"] / product["aerosol_backscatter"]
    np.testing.assert_allclose(ratio.values[np.isfinite(ratio.values)], 60.0, rtol=1e-3)


def test_saopaulo_is_glued_with_the_lag_of_its_noise(saopaulo: RunRecord) -> None:
    product = _open(saopaulo, "signal", "glued_532o")
    slope, error = product["glue_slope"].values, product["glue_slope_standard_error"].values
    assert np.isfinite(slope).all()
    # Headers and campaign give no lag.
    assert np.abs(product["glue_lag"].values - 8.6).max() < 0.2
    assert product["glue_lag_standard_error"].values.max() < 0.2
    # One detector and one recorder: the same slope in all profiles, but for their errors.
    assert np.abs(slope / np.median(slope) - 1.0).max() < 0.1
    assert (np.abs(slope - np.median(slope)) < 8.0 * error).all()
    photon = _open(saopaulo, "signal", "photon_532o")
    far = slice(float(product["glue_top"].max()) + 100.0, 12_000.0)
    joined, alone = (item["signal"].sel(range=far).values for item in (product, photon))
    np.testing.assert_allclose(joined, alone, rtol=1e-3, atol=1e-3 * np.nanmax(np.abs(alone)))
    # Photon counting alone is paralysed near the lidar, and the joined signal is not.
    near = {"range": slice(700.0, 900.0)}
    assert ((photon["quality_flag"].sel(near).values & Quality.PILE_UP) != 0).mean() > 0.9
    assert (product["quality_flag"].sel(near).values == 0).all()


def test_saopaulo_has_aerosol_in_its_mixed_layer(saopaulo: RunRecord) -> None:
    product = _open(saopaulo, "elastic", "glued_532o")
    good = product["aerosol_backscatter"].where(product["quality_flag"] & ~LOW == 0)
    low = good.sel(range=slice(700, 1500)).mean("range")
    assert (low > 1e-6).all()
    assert (low < 2e-5).all()
    budget = [
        array
        for name, array in product.items()
        if str(name).startswith("aerosol_backscatter_error_")
    ]
    total = np.sqrt(sum(part**2 for part in budget))
    stated = product["aerosol_backscatter_standard_error"]
    known = np.isfinite(stated.values)
    np.testing.assert_allclose(total.values[known], stated.values[known], rtol=0.01)
