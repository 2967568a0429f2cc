"""Means of half an hour that hold a cloud for a while, or a profile that is unlike the others."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.labeled import (
    Reference,
    constant_ratio,
    invert_elastic,
)
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled_averaging import (
    ClockAverage,
    IntervalSums,
    Screening,
)
from lidarops.retrieve.signal.thresholds import THRESHOLDS

GREEN = 532e-9
AIR = MolecularProfile.us_standard()
DISTANCE = 7.5 * (np.arange(2000) + 0.5)
MOLECULES = AIR.backscatter(DISTANCE, GREEN)
BRIGHT, SKY, LIDAR_RATIO = 1e13, 0.02, 50.0
PHOTONS = {"units": "MHz", "dead_time_standard_error": 0.0}
EXPOSURE = 128.0
"""Counts per MHz: 128 s at 20 Hz and 7.5 m."""
PROFILES = 14
"""Of half an hour, 128 s each."""


def layer(bottom, top, backscatter):
    return np.where((bottom < DISTANCE) & (top > DISTANCE), backscatter, 0.0)


HAZE = 2e-6 / (1.0 + np.exp(np.clip((DISTANCE - 1500.0) / 120.0, -50.0, 50.0)))
CIRRUS = layer(8000.0, 8600.0, 2.6e-6)


def light(particles, cloud=0.0):
    """Return the power in MHz without sky; `cloud` has a lidar ratio of 20 sr."""
    extinction = LIDAR_RATIO * particles + 20.0 * cloud + AIR.extinction(DISTANCE, GREEN)
    depth = np.cumsum(extinction) * 7.5 - 0.5 * 7.5 * extinction
    return BRIGHT * (particles + cloud + MOLECULES) * np.exp(-2.0 * depth) / DISTANCE**2


def profiles(signals, *, seed=1):
    """Return conditioned profiles of these signals, (time, range), with their counting noise.

    Each half hour has `PROFILES` of them.
    """
    signals = np.asarray(signals)
    counts = np.random.default_rng(seed).poisson((signals + SKY) * EXPOSURE)
    length = np.timedelta64(128, "s")
    half_hour, within = np.divmod(np.arange(len(signals)), PROFILES)
    begin = np.datetime64("2026-03-01", "ns") + half_hour * np.timedelta64(1800, "s")
    begin = begin + within * length
    plane = ("time", "range")
    return xr.Dataset(
        {
            "power": (plane, counts / EXPOSURE, PHOTONS),
            "variance": (plane, (signals + SKY) / EXPOSURE, {"units": "MHz2"}),
            "quality": (plane, np.zeros(signals.shape, np.int32)),
            "noise_correlation_length": ("time", np.ones(len(signals))),
        },
        coords={
            "time": begin + length // 2,
            "time_bnds": (("time", "nv"), np.stack([begin, begin + length], axis=-1)),
            "range": ("range", DISTANCE, {"units": "m"}),
        },
    )


def averages(conditioned, edges=(), contrast=None):
    """Return screened means over half an hour; profiles come in chunks that end at `edges`."""
    count = conditioned.sizes["time"]
    shots = xr.DataArray(np.full(count, 2560), dims="time")
    means = IntervalSums(
        conditioned[["time", "time_bnds"]],
        DISTANCE,
        seconds=1800,
        shots=shots,
        parts=THRESHOLDS.most_parts,
    )
    screening = Screening(contrast or cloud_contrast(GREEN), 12_000.0)
    average = ClockAverage([means], screening)
    for first, past in itertools.pairwise([0, *edges, count]):
        average.add([conditioned.isel(time=slice(first, past))])
    return xr.concat([batch for (batch,) in average.completed()], dim="time", data_vars="minimal")


def retrieved(means, overlap=None, highest=12_000.0):
    return invert_elastic(
        means.assign_coords(zenith_angle=0.0),
        molecules=AIR,
        wavelength=GREEN,
        station_altitude=0.0,
        lidar_ratio=constant_ratio(LIDAR_RATIO, 0.0),
        molecular_relative_error=0.0,
        reference=Reference(3000.0, highest, 1000.0, 1.0, 0.02),
        overlap=overlap,
        overlap_is_stated=True,
    )


def between(low, high):
    return (low < DISTANCE) & (high > DISTANCE)


def raised(product, bit):
    return (product["quality_flag"].to_numpy() & np.int32(bit)) != 0


# A cloud for a while -----------------------------------------------------------------------------


def cirrus_of(count):
    return [light(HAZE, CIRRUS if k < count else 0.0) for k in range(PROFILES)]


def test_a_cirrus_that_ends_before_the_middle_is_stated():
    """Six of 14 profiles: the mean alone shows too small a rise to be called a cloud."""
    product = retrieved(averages(profiles(cirrus_of(6))))
    inside = between(8060.0, 8540.0)
    fraction = product["cloud_fraction"].to_numpy()[0]
    np.testing.assert_allclose(fraction[inside], 6 / 14)
    assert not fraction[between(0.0, 7900.0) | between(9000.0, 15000.0)].any()
    assert product["cloud_base_altitude"][0] == pytest.approx(8000.0, abs=60.0)
    assert product["cloud_top_altitude"][0] == pytest.approx(8600.0, abs=120.0)
    assert product["profiles_left_out"][0] == 0
    window = float(product["reference_bottom"][0]), float(product["reference_top"][0])
    assert window[1] < 8000.0 or window[0] > 8600.0
    flagged = raised(product, ElasticQuality.PARTLY_CLOUDY)[0]
    assert flagged[inside].all()
    # With a start of the inversion beyond the cloud, what lies nearer depends on its lidar ratio.
    assert flagged[between(500.0, 7900.0)].all() == (window[0] > 8600.0)


def test_the_edges_of_a_cloud_are_to_be_used_with_care():
    """Up to 300 m below and above it, also where the reference lies below."""
    edges = between(7730.0, 8870.0)
    for cloudy, bit in ((6, ElasticQuality.PARTLY_CLOUDY), (PROFILES, ElasticQuality.CLOUD)):
        product = retrieved(averages(profiles(cirrus_of(cloudy))), highest=7000.0)
        assert product["reference_top"][0] <= 7000.0
        assert raised(product, bit)[0, edges].all()


def test_a_cloud_in_all_profiles_is_no_partial_one():
    product = retrieved(averages(profiles(cirrus_of(PROFILES))))
    inside = between(8060.0, 8540.0)
    assert (product["cloud_mask"].to_numpy()[0, inside] == 2).all()
    assert raised(product, ElasticQuality.CLOUD)[0, inside].all()
    assert not raised(product, ElasticQuality.PARTLY_CLOUDY)[0, inside].any()


def test_few_counts_need_the_same_margin_whatever_the_overlap():
    """Cirrus of a few counts in a cell: a factor on the signal decides nothing."""
    signals = [0.2 * light(HAZE, CIRRUS if k % 2 else 0.0) for k in range(10 * PROFILES)]
    means = averages(profiles(signals))
    fractions = [
        retrieved(means, overlap)["cloud_fraction"].to_numpy()
        for overlap in (None, np.full(DISTANCE.size, 0.02))
    ]
    assert 0.1 < fractions[0][:, between(8060.0, 8540.0)].mean() < 0.4
    known = np.isfinite(fractions).all(axis=0)
    assert known[:, between(8060.0, 8540.0)].all()
    np.testing.assert_array_equal(*np.array(fractions)[:, known])


# Where nothing can show a cloud ------------------------------------------------------------------

CLEAR, UNKNOWN = 0, 3


def test_profiles_without_data_in_a_cell_do_not_count():
    """Six of 14 profiles with a cirrus, and four of the others without data there."""
    conditioned = profiles(cirrus_of(6))
    gap = between(7950.0, 8650.0)
    conditioned["quality"][10:, gap] = np.int32(Quality.INPUT_MISSING)
    conditioned["power"][10:, gap] = np.nan
    product = retrieved(averages(conditioned))
    fraction = product["cloud_fraction"].to_numpy()[0]
    np.testing.assert_allclose(fraction[between(8060.0, 8540.0)], 6 / 10)


def test_bins_without_usable_data_are_not_clear():
    conditioned = profiles([light(HAZE)] * PROFILES)
    near = between(300.0, 900.0)
    conditioned["quality"][:, near] = np.int32(Quality.SATURATED)
    product = retrieved(averages(conditioned))
    state, fraction = (product[name].to_numpy()[0] for name in ("cloud_mask", "cloud_fraction"))
    assert (state[near] == UNKNOWN).all()
    assert np.isnan(fraction[near]).all()
    beside = between(0.0, 270.0) | between(930.0, 15_000.0)
    assert (state[beside] == CLEAR).all()
    assert (fraction[beside] == 0.0).all()


def test_bins_in_which_noise_would_hide_a_cloud_are_not_clear():
    """Of a weak lidar: a cloud that is found beyond the clear air stays one."""
    cirrus = layer(9000.0, 9480.0, 30.0 * MOLECULES)
    clear, cloudy = (
        retrieved(averages(profiles([light(HAZE, cloud) / 150.0] * PROFILES)))
        for cloud in (0.0, cirrus)
    )
    state = clear["cloud_mask"].to_numpy()[0]
    assert (state[between(0.0, 4000.0)] == CLEAR).all()
    assert (state[between(9000.0, 15_000.0)] == UNKNOWN).all()
    fraction = clear["cloud_fraction"].to_numpy()[0]
    np.testing.assert_array_equal(fraction, np.where(state == UNKNOWN, np.nan, 0.0))
    assert (cloudy["cloud_mask"].to_numpy()[0, between(9060.0, 9420.0)] == 2).all()


def test_the_mean_alone_shows_bins_beyond_the_last_whole_cell():
    means = averages(profiles([light(HAZE)] * PROFILES)).isel(range=slice(0, 1998))
    assert means["part_power"].attrs["bins"] == 4
    product = retrieved(means)
    assert (product["cloud_mask"] == CLEAR).all()
    assert np.isnan(product["cloud_fraction"]).to_numpy()[0].nonzero()[0].tolist() == [1996, 1997]


# A profile unlike the others ---------------------------------------------------------------------


def with_spike(conditioned, factor, at=(2000.0, 2060.0), of=(5,)):
    """Return profiles, some of which have a larger signal at some ranges."""
    spiked = conditioned.copy(deep=True)
    rows = np.ix_(of, np.flatnonzero(between(*at)))
    spiked["power"].to_numpy()[rows] *= factor
    spiked["variance"].to_numpy()[rows] *= factor
    return spiked


def test_a_profile_with_a_spike_is_left_out():
    near = between(1900.0, 2150.0)
    conditioned = profiles([light(HAZE)] * PROFILES)
    clean, spiked = (averages(with_spike(conditioned, factor)) for factor in (1.0, 9.0))
    clean, product = retrieved(clean), retrieved(spiked)
    assert product["profiles_left_out"][0] == 1
    assert product["profiles"][0] == PROFILES - 1
    assert product["shots"][0] == 2560 * (PROFILES - 1)
    error = clean["aerosol_backscatter_standard_error"].to_numpy()[0, near]
    moved = (product["aerosol_backscatter"] - clean["aerosol_backscatter"]).to_numpy()[0, near]
    assert np.abs(moved / error).max() < 1.0
    # What it does to a mean of all.
    biased = retrieved(averages(with_spike(conditioned, 9.0), contrast=1e9))
    assert biased["profiles_left_out"][0] == 0
    of_all = (biased["aerosol_backscatter"] - clean["aerosol_backscatter"]).to_numpy()[0, near]
    assert (of_all / error).max() > 5.0


def test_a_signal_below_zero_is_left_out():
    conditioned = profiles([light(HAZE)] * PROFILES)
    conditioned["power"][3, between(4000.0, 4100.0)] -= 1.0
    assert averages(conditioned)["profiles_left_out"][0] == 1


def test_a_burst_beyond_the_reference_costs_no_profile():
    """As in Manaus: 12 counts in a cell at 82 km, where 0.02 are expected."""
    conditioned = profiles([light(HAZE)] * PROFILES)
    for at, left_out in ((11_000.0, 1), (13_000.0, 0)):
        means = averages(with_spike(conditioned, 50.0, (at, at + 30.0)))
        assert means["profiles_left_out"][0] == left_out


def test_two_of_fourteen_profiles_are_left_out_and_three_are_not():
    for count, left_out in ((2, 2), (3, 0)):
        spiked = with_spike(profiles([light(HAZE)] * PROFILES), 9.0, of=range(count))
        means = averages(spiked)
        assert means["profiles_left_out"][0] == left_out
        flagged = raised(retrieved(means), ElasticQuality.PARTLY_CLOUDY)[0]
        assert flagged[between(2020.0, 2040.0)].all() == (left_out == 0)


def test_of_four_profiles_none_is_left_out():
    spiked = with_spike(profiles([light(HAZE)] * 4), 9.0, of=[2])
    assert averages(spiked)["profiles_left_out"][0] == 0


@pytest.mark.parametrize("edges", [(), (1,), (5, 6), (13, 15, 27), tuple(range(1, 42))])
def test_chunks_do_not_change_a_bit(edges):
    conditioned = with_spike(profiles([*cirrus_of(0), *cirrus_of(6), *cirrus_of(0)]), 9.0)
    xr.testing.assert_identical(averages(conditioned, edges), averages(conditioned))


def test_without_outliers_the_mean_is_that_of_all_profiles():
    conditioned = profiles(cirrus_of(6))
    means = averages(conditioned)
    shots = xr.DataArray(np.full(PROFILES, 2560), dims="time")
    sums = IntervalSums(conditioned[["time", "time_bnds"]], DISTANCE, seconds=1800, shots=shots)
    plain = ClockAverage([sums])
    plain.add([conditioned])
    ((whole,),) = plain.completed()
    for name, values in whole.items():
        np.testing.assert_allclose(means[name], values, rtol=1e-12, err_msg=str(name))


# What must not be taken for it -------------------------------------------------------------------


def variable_air(rng):
    """Haze whose depth wanders by 150 m between profiles, whose load by 20 %, with plumes aloft."""
    for _ in range(PROFILES):
        top, load = 1500.0 + rng.normal(0.0, 150.0), np.exp(rng.normal(0.0, 0.2))
        edge = np.exp(np.clip((DISTANCE - top) / 60.0, -50.0, 50.0))
        plume = np.exp(-0.5 * ((DISTANCE - rng.uniform(2000.0, 4000.0)) / 150.0) ** 2)
        yield load * light(2e-6 / (1.0 + edge) + rng.uniform(0.0, 1.5) * MOLECULES * plume)


def test_variable_aerosol_is_kept():
    """200 half hours: no part is left out by 80 000 cells below 12 km, no cloud is in 100 000."""
    rng = np.random.default_rng(5)
    means = averages(profiles([light for _ in range(200) for light in variable_air(rng)]))
    assert means.sizes["time"] == 200
    assert not means["profiles_left_out"].any()
    assert not retrieved(means)["cloud_mask"].any()


def test_saturated_profiles_raise_no_false_alarm():
    conditioned = profiles([light(HAZE)] * PROFILES)
    conditioned["quality"][4, between(300.0, 900.0)] = np.int32(Quality.SATURATED)
    conditioned["power"][4, between(300.0, 900.0)] = np.nan
    assert averages(conditioned)["profiles_left_out"][0] == 0
