"""Gluing in xarray returns the truth that both channels record, within its errors."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.signal import labeled_gluing
from lidarops.retrieve.signal.labeled import actual_noise, correct_for_range
from lidarops.retrieve.signal.labeled_gluing import ChannelLag

DIMS = ("time", "range")
BIN = 7.5
distance = BIN * (np.arange(2000) + 0.5)
RATIO = 20.0
"""MHz per mV."""
SHOTS = 600
DEAD_TIME = 4e-3
"""Microseconds."""
FULL_SCALE = 100.0


def truth(constant=4e8, sky=0.2):
    """Count rate in MHz of aerosol-free air over a sky."""
    return constant * np.exp(-distance / 8000.0) / (distance + 60.0) ** 2 + sky


def channel(power, variance, bits, unit, offset=0.0):
    variance = np.broadcast_to(variance, power.shape).copy()
    return xr.Dataset(
        {
            "power": (DIMS, np.where(bits != 0, np.nan, power), {"units": unit}),
            "variance": (DIMS, variance, {"units": f"{unit}2"}),
            "quality": (DIMS, np.broadcast_to(bits, power.shape).astype(np.int32)),
            "noise_correlation_length": (DIMS[:-1], np.ones(power.shape[:-1])),
        },
        coords={"range": ("range", distance + offset, {"units": "m"})},
    )


def recorded(rate, *, profiles=6, lag=0.0, noise=0.02, dark=2.0, seed=0, common=False):
    """Return a count rate as both recorders see it; `common`: from the same photoelectrons."""
    rng = np.random.default_rng(seed)
    exposure = SHOTS * BIN / 150.0
    measured = rate / (1.0 + rate * DEAD_TIME)
    counts = rng.poisson(np.broadcast_to(measured * exposure, (profiles, distance.size)))
    observed = np.minimum(counts / exposure, 0.9 / DEAD_TIME)
    corrected = observed / (1.0 - observed * DEAD_TIME)
    light = corrected if common else np.broadcast_to(rate, corrected.shape)
    index = np.arange(distance.size)
    shifted = np.stack([np.interp(index - lag, index, row) for row in light])
    voltage = shifted / RATIO + dark + noise * rng.standard_normal(shifted.shape)
    paralysed = measured * DEAD_TIME > 0.5
    return (
        channel(
            voltage,
            noise**2,
            np.where(voltage > FULL_SCALE, int(Quality.SATURATED), 0),
            "mV",
        ),
        channel(
            corrected,
            rate * (1.0 + rate * DEAD_TIME) / exposure,
            np.where(paralysed, int(Quality.SATURATED), 0),
            "MHz",
        ),
    )


@pytest.mark.parametrize("lag", [0.0, 7.0, -4.0, 3.4])
def test_the_truth_is_returned_within_its_errors(lag):
    rate = truth()
    result = labeled_gluing.glue(*recorded(rate, profiles=60, lag=lag), ChannelLag(lag))
    score = ((result["power"] - rate) / np.sqrt(result["variance"])).to_numpy()
    bottom, top = (float(result[f"glue_{end}"].mean()) for end in ("bottom", "top"))
    near = (distance > 500.0) & (distance < bottom - 300.0)
    far = (distance > top + 300.0) & (distance < 0.9 * distance[-1])
    assert np.isfinite(score[:, near | far]).all()
    # All near bins of a profile share the error of its line: 60 values, not 60 x 400.
    assert np.sqrt(np.mean(score[:, near] ** 2)) < 1.3
    assert abs(score[:, near].mean(axis=1).mean()) < 3.0 / np.sqrt(60.0) + 0.1
    assert 0.95 < np.sqrt(np.mean(score[:, far] ** 2)) < 1.05
    assert not result["quality"].to_numpy()[:, near | far].any()
    slope = (result["glue_slope"] - RATIO) / result["glue_slope_standard_error"]
    assert 0.7 < float(np.sqrt((slope**2).mean())) < 1.4
    units = {name: result[name].attrs.get("units") for name in result if name != "quality"}
    assert units == {
        "power": "MHz",
        "variance": "MHz2",
        "glue_slope": "MHz mV-1",
        "glue_slope_standard_error": "MHz mV-1",
        "glue_bottom": "m",
        "glue_top": "m",
        "glue_lag": "1",
        "glue_lag_standard_error": "1",
        "noise_correlation_length": "1",
    }


def test_means_of_glued_bins_allow_for_the_correlation_of_analog_noise():
    analog, photon = recorded(truth(), profiles=5)
    analog["noise_correlation_length"][:] = 2.5
    glued = labeled_gluing.glue(analog, photon)
    assert (glued["noise_correlation_length"] == 2.5).all()
    assert (actual_noise(glued).correlation_length >= 2.5).all()
    product = correct_for_range(glued, (0.9 * distance[-1], distance[-1]))
    assert (product["noise_correlation_length"] >= 2.5).all()


def test_the_background_of_photon_counting_remains():
    rate = truth(sky=3.0)
    result = labeled_gluing.glue(*recorded(rate, profiles=30))
    tail = result["power"].to_numpy()[:, -200:].mean()
    assert tail == pytest.approx(rate[-200:].mean(), abs=0.01)


def test_near_bins_are_analog_and_far_ones_photon_counting():
    analog, photon = recorded(truth())
    result = labeled_gluing.glue(analog, photon)
    far = distance > float(result["glue_top"].max())
    np.testing.assert_allclose(
        result["power"].to_numpy()[:, far], photon["power"].to_numpy()[:, far], rtol=1e-12
    )
    spoiled = photon.copy(deep=True)
    near = float(result["glue_bottom"].min())
    # Photon counting below the window is not used.
    spoiled["power"][:, distance < 0.5 * near] = 1e3
    again = labeled_gluing.glue(analog, spoiled)
    np.testing.assert_array_equal(
        again["power"].to_numpy()[:, distance < 0.4 * near],
        result["power"].to_numpy()[:, distance < 0.4 * near],
    )


@pytest.mark.parametrize(
    "make",
    [
        # Too weak for analog, too bright for counting, sky at the limit of counting.
        lambda: recorded(truth(constant=2e4)),
        lambda: recorded(truth(sky=60.0)),
        lambda: recorded(truth(), noise=30.0),
    ],
)
def test_no_gluing_where_no_range_is_linear_in_both(make):
    result = labeled_gluing.glue(*make())
    quality = result["quality"].to_numpy()
    assert (quality & int(Quality.NO_GLUING) != 0).all()
    assert np.isnan(result["power"]).all()


def test_channels_that_receive_different_light_are_not_glued():
    analog, photon = recorded(truth())
    # A curve within the window, as by an uncorrected dead time.
    photon["power"] = photon["power"] / (1.0 + 0.03 * photon["power"])
    result = labeled_gluing.glue(analog, photon)
    assert (result["quality"] & int(Quality.NO_GLUING) != 0).all()
    assert np.isnan(result["power"]).all()


def test_every_missing_value_has_a_bit_of_its_source_channel():
    analog, photon = recorded(truth(constant=2e9), profiles=4)
    analog["power"][0] = np.nan
    analog["quality"][0] = int(Quality.INPUT_MISSING)
    photon["power"][1] = np.nan
    photon["quality"][1] = int(Quality.INPUT_MISSING)
    photon["quality"][2, -30:] |= int(Quality.PILE_UP)
    analog["quality"][2, -30:] |= int(Quality.INCOMPLETE_OVERLAP)
    analog["quality"][2, :30] |= int(Quality.INCOMPLETE_OVERLAP)
    analog["power"][3, 40] = np.nan
    analog["quality"][3, 40] = int(Quality.INPUT_MISSING)
    result = labeled_gluing.glue(analog, photon)
    power, quality = result["power"].to_numpy(), result["quality"].to_numpy()
    assert (quality[np.isnan(power)] != 0).all()
    assert (quality[:2] & int(Quality.NO_GLUING) != 0).all()
    assert np.isnan(power[:2]).all()
    assert (quality[2, -30:] == int(Quality.PILE_UP)).all()
    assert (quality[2, :30] & int(Quality.INCOMPLETE_OVERLAP) != 0).all()
    assert quality[3, 40] == int(Quality.INPUT_MISSING)
    # Nearest to the lidar analog is saturated; photon counting is farther on, where analog is used.
    saturated = (quality[2] & int(Quality.SATURATED)) != 0
    counted_out = (photon["quality"].to_numpy()[2] & int(Quality.SATURATED)) != 0
    assert saturated.any()
    assert saturated.sum() < counted_out.sum()
    np.testing.assert_array_equal(
        saturated, (analog["quality"].to_numpy()[2] & int(Quality.SATURATED)) != 0
    )


def test_bits_move_with_the_lag_and_ends_without_source_are_missing():
    analog, photon = recorded(truth(), lag=5.0)
    analog["power"][:, 105] = np.nan
    analog["quality"][:, 105] = int(Quality.INPUT_MISSING)
    result = labeled_gluing.glue(analog, photon, ChannelLag(5.0))
    hit = (result["quality"].to_numpy()[0] & int(Quality.INPUT_MISSING)) != 0
    assert np.flatnonzero(hit).tolist() == [100]
    between = labeled_gluing.glue(analog, photon, ChannelLag(4.5))
    hit = (between["quality"].to_numpy()[0] & int(Quality.INPUT_MISSING)) != 0
    assert np.flatnonzero(hit).tolist() == [100, 101]
    ahead = labeled_gluing.glue(analog, photon, ChannelLag(-3.0))
    hit = (ahead["quality"].to_numpy()[0] & int(Quality.INPUT_MISSING)) != 0
    assert np.flatnonzero(hit).tolist() == [0, 1, 2, 108]


def test_bins_at_negative_ranges_are_missing():
    analog, photon = recorded(truth())
    moved = [
        channel_.assign_coords(range=channel_["range"] - 45.0) for channel_ in (analog, photon)
    ]
    result = labeled_gluing.glue(*moved)
    behind = moved[1]["range"].to_numpy() <= 0
    assert behind.sum() == 6
    assert np.isnan(result["power"].to_numpy()[:, behind]).all()
    assert (result["quality"].to_numpy()[:, behind] & int(Quality.INPUT_MISSING) != 0).all()
    power_ahead = result["power"].to_numpy()[:, ~behind]
    assert np.isfinite(power_ahead[:, 60:]).all()
    np.testing.assert_array_equal(
        np.isnan(power_ahead), result["quality"].to_numpy()[:, ~behind] != 0
    )


def test_channels_of_unequal_length_are_glued_over_the_shorter():
    analog, photon = recorded(truth())
    result = labeled_gluing.glue(analog, photon.isel(range=slice(1500)))
    assert result.sizes["range"] == 1500
    np.testing.assert_array_equal(result["range"], distance[:1500])


@pytest.mark.parametrize("profiles", [1, 4])
def test_each_profile_is_glued_by_itself(profiles):
    analog, photon = recorded(truth())
    whole = labeled_gluing.glue(analog, photon, ChannelLag(1.5))
    rows = [slice(first, first + profiles) for first in range(0, whole.sizes["time"], profiles)]
    parts = [
        labeled_gluing.glue(analog.isel(time=r), photon.isel(time=r), ChannelLag(1.5)) for r in rows
    ]
    xr.testing.assert_identical(xr.concat(parts, "time", data_vars="minimal"), whole)


def powers(channels):
    return (part["power"].to_numpy() for part in channels)


class TestLag:
    @pytest.mark.parametrize("lag", [0.0, 7.0, -4.0, 2.5])
    def test_estimate_is_the_lag_of_shared_noise(self, lag):
        analog, photon = powers(recorded(truth(), profiles=40, lag=lag, noise=1e-3, common=True))
        estimate = labeled_gluing.estimate_lag([(analog, photon)], known=100.0)
        assert estimate.bins == pytest.approx(lag, abs=0.15)
        assert abs(estimate.bins - lag) < 3.0 * estimate.standard_error < 0.3

    @pytest.mark.parametrize("known", [0.0, 3.0])
    def test_estimate_falls_back_on_the_known_lag(self, known):
        analog, photon = powers(recorded(truth(), lag=7.0))
        estimate = labeled_gluing.estimate_lag([(analog, photon)], known=known)
        assert estimate.bins == known
        assert np.isnan(estimate.standard_error)

    def test_range_lag_is_the_difference_of_the_ranges(self):
        farther = distance - 5.5 * BIN
        lag = labeled_gluing.range_lag(farther, distance)
        assert lag == pytest.approx(5.5)
        # The analog bin that the lag leads to has the range of the photon counting one.
        range_at_lag = np.interp(100 + lag, np.arange(distance.size), farther)
        assert range_at_lag == pytest.approx(distance[100])

    def test_a_wrong_lag_of_a_falling_signal_shows(self):
        analog, photon = recorded(truth(), lag=7.0, profiles=20)
        right = labeled_gluing.glue(analog, photon, ChannelLag(7.0))["glue_slope"]
        wrong = labeled_gluing.glue(analog, photon)["glue_slope"]
        assert abs(float(wrong.mean() - right.mean())) > 0.01 * RATIO


def test_a_sky_that_saturates_most_bins_of_the_tail_is_not_glued():
    analog, photon = recorded(truth())
    tail = distance > 0.9 * distance[-1]
    bits = np.where(tail & (np.arange(distance.size) % 3 > 0), np.int32(Quality.SATURATED), 0)
    photon["quality"] = photon["quality"] | xr.DataArray(bits.astype(np.int32), dims="range")
    glued = labeled_gluing.glue(analog, photon)
    assert np.isnan(glued["power"].to_numpy()).all()
    assert ((glued["quality"].to_numpy() & np.int32(Quality.NO_GLUING)) != 0).all()
