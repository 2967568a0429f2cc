"""Signals without background from simulated counts, by both methods for the background."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

import lidarops
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.signal.labeled import condition, correct_for_range

SHOTS, PROFILES = 20_000, 150
SKY = {"photon_532o": 3.0, "analog_532o": 40.0}
"""MHz and mV."""
RANGE = 7.5 * (np.arange(1600) + 0.5)
SPANS = {"tail_mean": (10_800.0, 12_000.0), "cubic": (500.0, 4000.0)}
ADC = {"detection_mode": "analog", "bin_width": 7.5, "adc_bits": 12}
NAMES = ("signal", "signal_standard_error", "quality_flag", "background")


def path(extinction, amount):
    """Return the signal of a homogeneous path, in the unit of the sky."""
    return amount * (500.0 / RANGE) ** 2 * np.exp(-2 * extinction * (RANGE - 500.0))


def archive(extinction=4e-4, seed=0, chunk=PROFILES):
    """Return raw counts of a photon-counting and an analog channel."""
    rng = np.random.default_rng(seed)
    rate = SKY["photon_532o"] + path(extinction, 20.0)
    counts = rng.poisson(np.broadcast_to(rate * SHOTS * 0.05, (PROFILES, RANGE.size)))
    voltage = SKY["analog_532o"] + np.minimum(path(extinction, 60.0), 400.0)
    voltage = voltage + 0.05 * rng.standard_normal((PROFILES, RANGE.size))
    data = {"photon_532o": counts, "analog_532o": voltage * SHOTS * 4096 / 500.0}
    attributes = {"photon_532o": {"detection_mode": "photon", "bin_width": 7.5}, "analog_532o": ADC}
    dims = ("time", "range")
    result = xr.Dataset(
        {name: (dims, np.rint(x).astype(np.int32), attributes[name]) for name, x in data.items()},
        coords={"range": RANGE, "time": np.arange(PROFILES).astype("datetime64[ns]")},
    ).chunk({"time": chunk})
    shots = {f"{name}_shots": ("time", np.full(PROFILES, SHOTS, np.int32)) for name in data}
    return result.assign(shots).assign(analog_532o_input_range=("time", np.full(PROFILES, 0.5)))


def corrected(data, channel, method):
    settings = {"dead_time": 1e-12} if channel.startswith("photon") else {}
    conditioned = condition(data, channel, full_overlap_range=200.0, **settings)
    return correct_for_range(conditioned, SPANS[method], method).compute(scheduler="synchronous")


def has(result, bit):
    return (result["quality_flag"].to_numpy() & np.int32(bit)) != 0


@pytest.mark.parametrize("channel", SKY)
@pytest.mark.parametrize("extinction", [1e-4, 4e-4, 1e-3])
def test_the_cubic_gives_the_background_and_signal_within_their_errors(channel, extinction):
    result = corrected(archive(extinction), channel, "cubic")
    score = (result["background"] - SKY[channel]) / result["background_standard_error"]
    assert (np.abs(score) < 4.0).all()
    assert float(score.std()) == pytest.approx(1.0, abs=0.2)
    at = slice(100, 600)
    truth = path(extinction, 20.0 if channel.startswith("photon") else 60.0) * RANGE**2
    wrong = (result["signal"] - truth)[:, at] / result["signal_standard_error"][:, at]
    assert float((np.abs(wrong) < 4.0).mean()) > 0.999
    assert has(result, Quality.BACKGROUND_UNCERTAIN).mean() < 0.05
    assert result.attrs["steps"] == "background: cubic of a homogeneous section from 500 to 4000 m"


@pytest.mark.parametrize("channel", SKY)
def test_the_mean_of_a_tail_with_signal_is_flagged_where_the_cubic_is_not(channel):
    data = archive(1e-5)
    tail, cubic = (corrected(data, channel, method) for method in ("tail_mean", "cubic"))
    score = (tail["background"] - SKY[channel]) / tail["background_standard_error"]
    assert float(score.min()) > 4.0
    assert has(tail, Quality.BACKGROUND_UNCERTAIN).all()
    assert has(cubic, Quality.BACKGROUND_UNCERTAIN).mean() < 0.05
    assert tail.attrs["steps"] == "background: mean of the bins from 10800 to 12000 m"


@pytest.mark.parametrize("channel", SKY)
def test_the_mean_of_a_dark_tail_is_not_flagged(channel):
    result = corrected(archive(1e-3), channel, "tail_mean")
    score = (result["background"] - SKY[channel]) / result["background_standard_error"]
    assert float(score.std()) == pytest.approx(1.0, abs=0.2)
    assert has(result, Quality.BACKGROUND_UNCERTAIN).mean() < 0.02


@pytest.mark.parametrize("method", SPANS)
@pytest.mark.parametrize("channel", SKY)
def test_chunks_do_not_change_a_bit(channel, method):
    expected = corrected(archive(chunk=PROFILES), channel, method)
    for chunk in (1, 7, 64):
        result = corrected(archive(chunk=chunk), channel, method)
        for name in NAMES:
            np.testing.assert_array_equal(result[name], expected[name])
        assert result.attrs == expected.attrs


def test_a_profile_whose_cubic_has_no_root_is_withheld():
    data = archive().compute()
    counts = data["photon_532o"].to_numpy().copy()
    counts[3] = 3000
    data["photon_532o"] = data["photon_532o"].copy(data=counts)
    result = corrected(data, "photon_532o", "cubic")
    lost = np.isnan(result["signal"].to_numpy()).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [3])
    assert has(result, Quality.NO_REAL_SOLUTION)[3].all()
    assert np.isnan(result["background"].to_numpy()[3])


def test_another_method_is_refused():
    conditioned = condition(archive(), "photon_532o")
    with pytest.raises(RetrievalInputError, match=r"background_method.*tail_mean, cubic"):
        correct_for_range(conditioned, (1e3, 2e3), "median")


@pytest.mark.parametrize("channel", ["photon_387o", "photon_532p"])
def test_a_background_of_the_lowest_bins_of_a_paralysed_counter_is_withheld(data_root, channel):
    files = sorted((data_root / "pilar" / "20241002").glob("h*"))[:30]
    data = lidarops.open_archive(files, mask_and_scale=False)
    settings = {"dead_time": 4e-9, "dead_time_uncertainty": 0.0}
    conditioned = condition(data, channel, **settings).load()
    span = (0.9 * float(conditioned["range"][-1]), float(conditioned["range"][-1]))
    result = correct_for_range(conditioned, span)
    tail = conditioned["quality"].sel(range=slice(*span))
    saturated = ((tail & np.int32(Quality.SATURATED)) != 0).mean("range").to_numpy()
    counts, shots = data[channel].to_numpy()[:, -tail.sizes["range"] :], data[f"{channel}_shots"]
    measured = counts / (shots.to_numpy()[:, np.newaxis] * 0.05)
    rate = (measured / (1.0 - measured * 4e-3)).mean(axis=1)
    few = saturated > 0.5
    # All bins together show more than the few that are left.
    assert (few & (saturated < 1.0)).sum() > 3
    assert np.isnan(result["background"].to_numpy()[few]).all()
    assert has(result, Quality.INPUT_MISSING)[few].all()
    off = np.abs(result["background"].to_numpy() - rate) / result["background_standard_error"]
    doubted = has(result, Quality.BACKGROUND_UNCERTAIN).all(axis=-1)
    assert (off[~few & ~doubted] < 4.0).all()
