"""Means over intervals of the clock: numpy by hand, any chunks, errors that match the scatter."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.labeled_averaging import (
    ClockAverage,
    IntervalSums,
    joined,
)

BINS = 16
MIDNIGHT = np.datetime64("2026-03-01T00:00:00", "ns")
SECOND = np.timedelta64(1_000_000_000, "ns")


def clock_average(conditioned, **settings):
    """Return the means of profiles that come in one chunk."""
    return chunked([conditioned], conditioned, **settings)


def chunked(chunks, conditioned, **settings):
    """Return the means of conditioned profiles that come in chunks."""
    distance = conditioned["range"].to_numpy()
    sums = IntervalSums(conditioned[["time", "time_bnds"]], distance, **settings)
    average = ClockAverage([sums])
    for chunk in chunks:
        average.add([chunk])
    return joined(means for (means,) in average.completed())


def made(minutes, *, seed=0, length=60):
    """Return conditioned profiles that start at these minutes after midnight, and their shots."""
    rng = np.random.default_rng(seed)
    starts = MIDNIGHT + (np.asarray(minutes) * 60e9).astype("timedelta64[ns]")
    size = (starts.size, BINS)
    conditioned = xr.Dataset(
        {
            "power": (("time", "range"), rng.normal(10.0, 1.0, size), {"units": "mV"}),
            "variance": (("time", "range"), rng.uniform(0.5, 1.5, size), {"units": "mV2"}),
            "quality": (("time", "range"), np.zeros(size, np.int32)),
            "noise_correlation_length": ("time", np.ones(starts.size)),
        },
        coords={
            "time": starts + length * SECOND // 2,
            "time_bnds": (("time", "nv"), np.stack([starts, starts + length * SECOND], axis=-1)),
            "range": ("range", 7.5 * (np.arange(BINS) + 0.5), {"units": "m"}),
        },
    )
    return conditioned, xr.DataArray(rng.integers(100, 1000, starts.size), dims="time")


def by_hand(conditioned, shots, members):
    """Return mean, variance and bits of some profiles, bin by bin in plain Python."""
    mean, variance, bits = (np.zeros(BINS) for _ in range(3))
    for i in range(BINS):
        used = [t for t in members if np.isfinite(conditioned["power"].to_numpy()[t, i])]
        weight = sum(float(shots[t]) for t in used)
        mean[i] = variance[i] = np.nan
        if used:
            mean[i] = sum(float(shots[t] * conditioned["power"][t, i]) for t in used) / weight
            variance[i] = (
                sum(float(shots[t] ** 2 * conditioned["variance"][t, i]) for t in used) / weight**2
            )
        for t in members:
            bits[i] = int(bits[i]) | int(conditioned["quality"][t, i])
        bits[i] = int(bits[i]) & ~int(Quality.INPUT_MISSING)
        if not used:
            bits[i] = int(bits[i]) | int(Quality.INPUT_MISSING)
    return mean, variance, bits


def spoiled(conditioned):
    """Return the profiles with bins missing in one, in all profiles, and saturated bins."""
    changed = conditioned.copy(deep=True)
    for where, bit in (
        ((1, slice(0, 3)), Quality.INPUT_MISSING),
        ((slice(None), 4), Quality.INPUT_MISSING),
        ((2, 6), Quality.SATURATED),
        ((0, 8), Quality.PILE_UP),
    ):
        changed["quality"][where] |= int(bit)
        if bit is not Quality.PILE_UP:
            changed["power"][where] = np.nan
    return changed


def test_means_are_those_by_hand():
    conditioned, shots = made([0, 1, 4, 5, 7, 14.5])
    conditioned = spoiled(conditioned)
    result = clock_average(conditioned, seconds=300, shots=shots)
    for k, members in enumerate([(0, 1, 2), (3, 4), (5,)]):
        mean, variance, bits = by_hand(conditioned, shots, members)
        np.testing.assert_allclose(result["power"][k], mean, rtol=1e-14)
        np.testing.assert_allclose(result["variance"][k], variance, rtol=1e-14)
        np.testing.assert_array_equal(result["quality"][k], bits)
    np.testing.assert_array_equal(result["profiles"], [3, 2, 1])
    np.testing.assert_array_equal(
        result["shots"], [int(shots[:3].sum()), int(shots[3:5].sum()), int(shots[5])]
    )
    assert result["power"].attrs == {"units": "mV"}
    assert result["variance"].attrs == {"units": "mV2"}
    assert result["range"].attrs == {"units": "m"}


def test_a_saturated_profile_flags_the_mean_and_a_missing_one_does_not():
    conditioned, shots = made([0, 1, 2])
    result = clock_average(spoiled(conditioned), seconds=300, shots=shots)
    quality = result["quality"].to_numpy()[0]
    assert quality[6] == Quality.SATURATED
    assert quality[8] == Quality.PILE_UP
    assert not quality[:3].any()
    assert quality[4] == Quality.INPUT_MISSING
    assert np.isnan(result["power"].to_numpy()[0]).tolist() == (quality == 1).tolist()


def test_every_missing_mean_has_a_bit():
    conditioned, shots = made(np.arange(12))
    conditioned["power"][:] = np.nan
    conditioned["quality"][:] = int(Quality.INPUT_MISSING)
    result = clock_average(conditioned, seconds=600, shots=shots)
    assert np.isnan(result["power"]).all()
    assert (result["quality"] == int(Quality.INPUT_MISSING)).all()


def test_a_profile_without_shots_has_no_weight():
    conditioned, shots = made([0, 1, 2])
    shots[1] = 0
    result = clock_average(conditioned, seconds=300, shots=shots)
    mean, variance, _ = by_hand(conditioned, shots, (0, 2))
    np.testing.assert_allclose(result["power"][0], mean, rtol=1e-14)
    np.testing.assert_allclose(result["variance"][0], variance, rtol=1e-14)


class TestIntervals:
    def test_days_end_at_midnight(self):
        conditioned, shots = made([-2, -1, 0, 1])
        result = clock_average(conditioned, seconds=86400, shots=shots)
        np.testing.assert_array_equal(result["profiles"], [2, 2])
        minute = 60 * SECOND
        np.testing.assert_array_equal(
            result["time_bnds"],
            [[MIDNIGHT - 2 * minute, MIDNIGHT], [MIDNIGHT, MIDNIGHT + 2 * minute]],
        )
        np.testing.assert_array_equal(result["time"], [MIDNIGHT - minute, MIDNIGHT + minute])

    def test_a_profile_belongs_where_its_middle_lies(self):
        # The middle at 10:00 exactly belongs to the later interval.
        for start, profiles in ((9.5, [1, 1]), (9.49, [2])):
            conditioned, shots = made([5.0, start])
            result = clock_average(conditioned, seconds=600, shots=shots)
            np.testing.assert_array_equal(result["profiles"], profiles)

    def test_intervals_follow_the_clock_not_the_first_profile(self):
        conditioned, shots = made(np.arange(7, 37))
        result = clock_average(conditioned, seconds=600, shots=shots)
        np.testing.assert_array_equal(result["profiles"], [3, 10, 10, 7])

    def test_intervals_without_profiles_are_omitted(self):
        conditioned, shots = made([0, 1, 600, 601])
        result = clock_average(conditioned, seconds=600, shots=shots)
        np.testing.assert_array_equal(result["profiles"], [2, 2])
        assert result["time"].to_index().is_monotonic_increasing

    def test_bounds_span_overlapping_profiles(self):
        conditioned, shots = made([0, 1, 2])
        conditioned["time_bnds"][0, 1] = MIDNIGHT + 300 * SECOND
        result = clock_average(conditioned, seconds=3600, shots=shots)
        np.testing.assert_array_equal(result["time_bnds"], [[MIDNIGHT, MIDNIGHT + 300 * SECOND]])

    def test_times_before_1970_fall_into_the_right_interval(self):
        conditioned, shots = made([0, 1])
        moved = conditioned.assign_coords(
            time=conditioned["time"] - (MIDNIGHT - np.datetime64("1969-12-31T23:59", "ns")),
        )
        result = clock_average(moved, seconds=600, shots=shots)
        np.testing.assert_array_equal(result["profiles"], [1, 1])

    @pytest.mark.parametrize("seconds", [0, -600, 7000, 86401, 172800, np.nan])
    def test_an_interval_that_does_not_divide_a_day_is_refused(self, seconds):
        conditioned, shots = made([0, 1])
        with pytest.raises(RetrievalInputError, match="divide a day") as caught:
            clock_average(conditioned, seconds=seconds, shots=shots)
        assert caught.value.field == "average"


LONG = spoiled(made(np.sort(np.random.default_rng(5).uniform(0, 300, 700)), seed=1)[0])
LONG_SHOTS = made(np.arange(700), seed=2)[1]
WHOLE = clock_average(LONG, seconds=600, shots=LONG_SHOTS)


@settings(max_examples=8, deadline=None)
@given(edges=st.lists(st.integers(1, 699), max_size=6, unique=True).map(sorted), dark=st.booleans())
def test_chunks_do_not_change_a_bit(edges, dark):
    def shared(times):
        return np.full((times.size, BINS), 0.25)

    common = {"seconds": 600, "shots": LONG_SHOTS, "shared_variance": shared if dark else None}
    chunks = [LONG.isel(time=slice(*ends)) for ends in itertools.pairwise([0, *edges, 700])]
    xr.testing.assert_identical(chunked(chunks, LONG, **common), clock_average(LONG, **common))


def test_a_mean_may_hold_more_profiles_than_are_averaged_together():
    conditioned, shots = made(np.linspace(0, 500, 600))
    result = clock_average(conditioned, seconds=86400, shots=shots)
    assert result.sizes["time"] == 1
    weight = (shots / shots.sum()).to_numpy()
    np.testing.assert_allclose(
        result["power"][0], weight @ conditioned["power"].to_numpy(), rtol=1e-12
    )
    variance = weight**2 @ conditioned["variance"].to_numpy()
    np.testing.assert_allclose(result["variance"][0], variance, rtol=1e-12)


def test_the_means_of_an_interval_do_not_depend_on_other_intervals():
    profiles = LONG.isel(time=slice(100, 420))
    result = clock_average(profiles, seconds=600, shots=LONG_SHOTS[100:420])
    inner = result.isel(time=slice(1, -1))
    xr.testing.assert_identical(inner, WHOLE.sel(time=inner["time"]))


class TestSharedVariance:
    def test_it_does_not_average_down(self):
        conditioned, shots = made(np.arange(30))
        dark = 0.25

        def shared(times):
            return np.full((times.size, BINS), dark)

        result = clock_average(conditioned, seconds=900, shots=shots, shared_variance=shared)
        own = conditioned.assign(variance=conditioned["variance"] - dark)
        without = clock_average(own, seconds=900, shots=shots)
        np.testing.assert_allclose(result["variance"], without["variance"] + dark, rtol=1e-12)
        np.testing.assert_array_equal(result["power"], without["power"])

    def test_it_is_that_of_the_middle_of_the_interval(self):
        conditioned, shots = made([0, 1, 2, 60, 61])
        times_of_call = []

        def shared(times):
            times_of_call.extend(times)
            return np.full((times.size, BINS), 0.1 * len(times_of_call))

        result = clock_average(conditioned, seconds=600, shots=shots, shared_variance=shared)
        np.testing.assert_array_equal(times_of_call, result["time"])
        assert (result["variance"].to_numpy()[0] >= 0.1).all()
        assert (result["variance"].to_numpy()[1] >= 0.2).all()

    def test_a_share_larger_than_the_whole_leaves_the_share(self):
        conditioned, shots = made([0, 1])
        result = clock_average(
            conditioned,
            seconds=600,
            shots=shots,
            shared_variance=lambda times: np.full((times.size, BINS), 9.0),
        )
        np.testing.assert_allclose(result["variance"], 9.0)

    def test_means_with_a_dark_signal_scatter_as_stated(self):
        """The variance of the means over many draws of noise and dark files is the stated one."""
        rng = np.random.default_rng(11)
        profiles, darks, sigma = 20, 3, 0.3
        minutes = np.arange(profiles)
        errors, stated = [], []
        for draw in range(100):
            files = sigma * rng.standard_normal((darks, BINS))
            dark = DarkSignals(files, MIDNIGHT - np.arange(1, darks + 1) * 60 * SECOND)
            conditioned, shots = made(minutes, seed=draw)
            noise = sigma * rng.standard_normal((profiles, BINS))
            conditioned["power"][:] = noise - dark.at(conditioned["time"].to_numpy())[0]
            conditioned["variance"][:] = sigma**2 + sigma**2 / darks
            result = clock_average(
                conditioned,
                seconds=3600,
                shots=shots,
                shared_variance=lambda times: np.full((times.size, BINS), sigma**2 / darks),
            )
            errors.append(result["power"].to_numpy()[0])
            stated.append(result["variance"].to_numpy()[0])
        ratio = np.var(errors) / np.mean(stated)
        # 100 x 16 values: the ratio is known to sqrt(2 / 1600) = 3.5 %.
        assert abs(ratio - 1.0) < 0.12


def test_the_variance_of_a_dark_signal_is_that_of_its_files():
    rng = np.random.default_rng(3)
    files = rng.standard_normal((6, 400))
    times = MIDNIGHT + np.arange(6) * 60 * SECOND
    dark = DarkSignals(files, times)
    requested = MIDNIGHT + np.array([0, 3600]) * SECOND
    assert abs(dark.variance(requested).mean() * 6 - 1.0) < 0.15
