"""Gluing in xarray returns the truth that both channels record, within its errors."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.signal import labeled_gluing
from lidarops.retrieve.signal.labeled import (
    actual_noise,
    baseline_error,
    correct_for_range,
    counts_per_power,
)
from lidarops.retrieve.signal.lag import ChannelLag

DIMS = ("time", "range")
BIN = 7.5
distance = BIN * (np.arange(2000) + 0.5)
RATIO = 20.0
"""MHz per mV."""
SHOTS = 600
DEAD_TIME = 4e-3
"""Microseconds."""
FULL_SCALE = 100.0
INCOMPLETE = np.int32(Quality.INCOMPLETE_OVERLAP)


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


def test_no_gluing_where_neither_record_shows_light():
    result = labeled_gluing.glue(*recorded(truth(constant=2e3)))
    quality = result["quality"].to_numpy()
    assert (quality & int(Quality.NO_GLUING) != 0).all()
    assert np.isnan(result["power"]).all()


def lost(record):
    """Return a record without data."""
    bits = xr.full_like(record["quality"], int(Quality.INPUT_MISSING))
    return record.assign(power=xr.full_like(record["power"], np.nan), quality=bits)


def weak(record):
    """Return a record of a few dark counts, or of noise."""
    rng = np.random.default_rng(3)
    noise = np.sqrt(record["variance"].to_numpy().min())
    return record.assign(power=record["power"].copy(data=noise * rng.random(record["power"].shape)))


def alone(record, score):
    """Assert that profiles are those of a record, within their errors where it shows light."""
    assert (record["quality"].to_numpy() & int(Quality.SINGLE_RECORD) != 0).all()
    assert (record["quality"].to_numpy() & int(Quality.NO_GLUING) == 0).all()
    np.testing.assert_array_equal(record["glue_bottom"], record["glue_top"])
    assert np.isfinite(score).all()
    assert 0.95 < np.sqrt(np.mean(score**2)) < 1.05


@pytest.mark.parametrize(
    ("sky", "counter"), [(0.2, lost), (0.2, weak), (19.8, None), (25.0, None), (60.0, lost)]
)
def test_where_the_counter_cannot_be_used_analog_alone_is_the_signal(sky, counter):
    rate = truth(sky=sky)
    analog, photon = recorded(rate, profiles=30)
    result = labeled_gluing.glue(analog, photon if counter is None else counter(photon))
    unsaturated = (rate / RATIO + 2.0 < 0.98 * FULL_SCALE) & (distance < 0.9 * distance[-1])
    # Not scaled, and without its mean in the far range.
    expected = (rate - rate[-200:].mean()) / RATIO
    error = np.sqrt(result["variance"].to_numpy())
    alone(result, ((result["power"] - expected) / error).to_numpy()[:, unsaturated])
    assert (result["glue_top"] > distance[-1]).all()
    assert np.isnan(result["glue_slope"]).all()
    length = result["noise_correlation_length"]
    np.testing.assert_array_equal(length, analog["noise_correlation_length"])
    # As of the analog channel by itself, without a count and the dead time of a counter.
    product = correct_for_range(result, (0.9 * distance[-1], distance[-1]))
    own = correct_for_range(analog, (0.9 * distance[-1], distance[-1]))
    for name in ("signal", "signal_standard_error"):
        np.testing.assert_allclose(
            product[name][:, unsaturated], own[name][:, unsaturated], rtol=1e-5, atol=1e-2
        )
    assert np.isnan(product["background"]).all()
    assert np.isinf(counts_per_power(with_dead_time(result), np.full(30, SHOTS), glued=True)).all()


def with_dead_time(record, error=4e-9):
    return record.assign(power=record["power"].assign_attrs(dead_time_standard_error=error))


@pytest.mark.parametrize("lag", [0.0, 6.0])
def test_the_baseline_of_analog_is_an_error_of_its_part(lag):
    known = (RATIO, 0.0)
    for sky, slope in ((0.2, None), (60.0, None), (60.0, known)):
        analog, photon = recorded(truth(sky=sky), lag=lag)
        analog["power"].attrs["baseline_standard_error"] = (0.01, 7.5e-4)
        own = baseline_error(analog).to_numpy()
        # Ranges of files may state the lag.
        analog = analog.assign_coords(range=photon["range"] - lag * BIN)
        result = labeled_gluing.glue(analog, photon, ChannelLag(lag), slope)
        middle = 0.5 * (result["glue_bottom"] + result["glue_top"])
        used = result["glue_slope"].fillna(1.0).to_numpy()[:, np.newaxis]
        expected = np.where(distance <= middle.to_numpy()[:, np.newaxis], own * used, 0.0)
        np.testing.assert_allclose(baseline_error(result), expected, rtol=1e-12)
        assert (baseline_error(result)[:, :100] > 0.0).all()


def test_profiles_without_shots_have_no_light():
    analog, photon = recorded(truth(), profiles=4)
    for record in (analog, photon):
        record["power"][2:], record["variance"][2:] = np.nan, np.inf
        record["quality"][2:] = int(Quality.INPUT_MISSING)
    result = labeled_gluing.glue(analog, photon, slope=(RATIO, 0.1))
    assert np.isnan(result["power"][2:]).all()
    assert (result["quality"][2:].to_numpy() & int(Quality.NO_GLUING) != 0).all()
    some = {"time": slice(2)}
    others = labeled_gluing.glue(analog.isel(some), photon.isel(some), slope=(RATIO, 0.1))
    xr.testing.assert_identical(result.isel(some), others)


def test_each_record_alone_has_the_bit():
    analog, photon = recorded(truth())
    for records in ((lost(analog), photon), (analog, lost(photon))):
        quality = labeled_gluing.glue(*records)["quality"].to_numpy()
        assert (quality & int(Quality.SINGLE_RECORD) != 0).all()
    quality = labeled_gluing.glue(analog, photon)["quality"].to_numpy()
    assert (quality & int(Quality.SINGLE_RECORD) == 0).all()


def test_analog_alone_has_no_error_by_the_dead_time():
    rate = truth(sky=60.0)
    analog, photon = recorded(rate)
    glued = labeled_gluing.glue(analog, with_dead_time(photon))
    error = correct_for_range(glued, (0.9 * distance[-1], distance[-1]))["signal_dead_time_error"]
    np.testing.assert_allclose(error, 0.0, atol=1.0)


@pytest.mark.parametrize("analog_is", [None, lost, weak])
def test_where_analog_cannot_be_used_photon_counting_alone_is_the_signal(analog_is):
    rate = truth()
    analog, photon = recorded(rate, profiles=30, noise=30.0 if analog_is is None else 0.02)
    photon = with_dead_time(photon)
    result = labeled_gluing.glue(analog if analog_is is None else analog_is(analog), photon)
    linear = rate < 20.0
    error = np.sqrt(result["variance"].to_numpy())
    alone(result, ((result["power"] - rate) / error).to_numpy()[:, linear])
    counted = (photon["quality"].to_numpy() & int(Quality.SATURATED)) == 0
    np.testing.assert_allclose(
        result["power"].to_numpy()[counted], photon["power"].to_numpy()[counted], rtol=1e-12
    )
    assert (result["quality"].to_numpy()[~counted] & int(Quality.SATURATED) != 0).all()
    assert (result["glue_top"] == 0.0).all()
    assert (result["noise_correlation_length"] == 1.0).all()
    np.testing.assert_allclose(
        result["dead_time_error"].to_numpy()[counted],
        photon["power"].to_numpy()[counted] ** 2 * 4e-3,
        rtol=1e-9,
    )


def test_profiles_that_are_compared_have_the_slope_of_those_that_are_glued():
    lag = ChannelLag(3.0)
    night, day = recorded(truth(), lag=3.0, profiles=20), recorded(truth(sky=60.0), lag=3.0, seed=1)
    unknown = labeled_gluing.scene_slope([day], lag)
    known = labeled_gluing.scene_slope([day, night, day], lag)
    assert abs(known[0] - RATIO) < 2.0 * known[1] < 0.1 * RATIO
    # In MHz, or not at all.
    result = labeled_gluing.glue(*day, lag, known)
    rate = truth()
    seen = (distance > 500.0) & (distance < 4000.0)
    error = np.sqrt(result["variance"].to_numpy())
    score = ((result["power"] - rate + rate[-200:].mean()) / error).to_numpy()[:, seen]
    assert np.sqrt(np.mean(score**2)) < 1.3
    assert (result["quality"].to_numpy() & int(Quality.SINGLE_RECORD) != 0).all()
    assert (result["glue_slope"] == known[0]).all()
    nothing = labeled_gluing.glue(*day, lag, unknown)
    assert (nothing["quality"].to_numpy() & int(Quality.NO_GLUING) != 0).all()
    assert np.isnan(nothing["power"]).all()
    # Those with a line of their own are as without it.
    xr.testing.assert_identical(
        labeled_gluing.glue(*night, lag, unknown), labeled_gluing.glue(*night, lag)
    )


def test_a_misfit_by_an_unknown_dead_time_leaves_analog_alone():
    rate = truth()
    analog, photon = recorded(rate, profiles=400, noise=0.02)
    mean = [
        channel(
            record["power"].mean("time", skipna=False).to_numpy()[np.newaxis],
            record["variance"].to_numpy()[:1] / 400.0,
            np.bitwise_or.reduce(record["quality"].to_numpy(), axis=0)[np.newaxis],
            record["power"].attrs["units"],
        )
        for record in (analog, photon)
    ]
    mean[1]["power"] = mean[1]["power"] / (1.0 + mean[1]["power"] * DEAD_TIME)
    for error, bit in ((4e-9, Quality.SINGLE_RECORD), (1e-12, Quality.NO_GLUING)):
        glued = labeled_gluing.glue(mean[0], with_dead_time(mean[1], error))
        assert (glued["quality"].to_numpy() & int(bit) != 0).all()
    assert float(labeled_gluing.glue(mean[0], with_dead_time(mean[1]))["glue_top"][0]) > 1e4


def test_bins_that_saturate_in_some_profiles_of_a_mean_give_no_line():
    """They hold the counts of some of the profiles, the analog record those of all."""
    sky = np.linspace(2.0, 18.0, 40)
    rate = truth(sky=0.0) + sky[:, np.newaxis]
    analog, photon = recorded(rate, profiles=40)
    saturated = rate > 20.0
    bits = np.where(saturated.any(axis=0), int(Quality.SATURATED), 0)[np.newaxis]
    counted = np.where(saturated, np.nan, photon["power"].to_numpy())
    with np.errstate(invalid="ignore"):
        mean = np.nansum(counted, axis=0) / np.maximum((~saturated).sum(axis=0), 1)
    means = (
        channel(
            analog["power"].mean("time", skipna=False).to_numpy()[np.newaxis],
            analog["variance"].to_numpy()[:1] / 40.0,
            np.bitwise_or.reduce(analog["quality"].to_numpy(), axis=0)[np.newaxis],
            "mV",
        ),
        channel(mean[np.newaxis], photon["variance"].to_numpy().mean(axis=0) / 40.0, bits, "MHz"),
    )
    means[1]["power"][:] = mean
    result = labeled_gluing.glue(*means)
    assert (result["quality"].to_numpy() & int(Quality.NO_GLUING) == 0).all()
    slope = float(result["glue_slope"][0])
    if np.isfinite(slope):
        assert abs(slope - RATIO) < 4.0 * float(result["glue_slope_standard_error"][0])


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
    analog["quality"][2, -30:] |= int(Quality.OUTLIER)
    analog["quality"][2, :30] |= int(Quality.INCOMPLETE_OVERLAP)
    analog["power"][3, 40] = np.nan
    analog["quality"][3, 40] = int(Quality.INPUT_MISSING)
    result = labeled_gluing.glue(analog, photon)
    power, quality = result["power"].to_numpy(), result["quality"].to_numpy()
    assert (quality[np.isnan(power)] != 0).all()
    # One record alone gives them.
    assert (quality[:2] & int(Quality.SINGLE_RECORD) != 0).all()
    assert np.isfinite(power[:2, 1000:]).all()
    assert result["glue_top"].to_numpy()[0] == 0.0
    assert result["glue_top"].to_numpy()[1] > distance[-1]
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


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("lag", [-3.0, 0.0, 4.5, 8.0])
@pytest.mark.parametrize("unlit", [None, "analog", "photon"])
def test_incomplete_overlap_ends_at_its_range_whatever_the_lag(lag, stated, unlit):
    """The ranges of the analog bins may state the lag, or not."""
    full = distance[110]
    records = dict(zip(("analog", "photon"), recorded(truth(), lag=lag), strict=True))
    if stated:
        records["analog"] = records["analog"].assign_coords(range=distance - lag * BIN)
    for name, record in records.items():
        near = record["range"].to_numpy() < full
        record["quality"][:] = record["quality"] | np.where(near, INCOMPLETE, 0)
        if name == unlit:
            record["quality"][:] = int(Quality.NO_SIGNAL)
    result = labeled_gluing.glue(*records.values(), ChannelLag(lag), slope=(RATIO, 0.1))
    near = (result["quality"].to_numpy() & INCOMPLETE) != 0
    # Half a bin is known of the counter alone.
    assert near[:, :109].all()
    assert near[:, 109].all() or (lag, stated, unlit) == (4.5, True, "photon")
    assert not near[:, 110:].any()


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


def test_a_sky_that_saturates_most_bins_of_the_tail_leaves_analog_alone():
    analog, photon = recorded(truth())
    tail = distance > 0.9 * distance[-1]
    bits = np.where(tail & (np.arange(distance.size) % 3 > 0), np.int32(Quality.SATURATED), 0)
    photon["quality"] = photon["quality"] | xr.DataArray(bits.astype(np.int32), dims="range")
    glued = labeled_gluing.glue(analog, photon)
    assert ((glued["quality"].to_numpy() & np.int32(Quality.SINGLE_RECORD)) != 0).all()
    assert (glued["glue_top"] > distance[-1]).all()
