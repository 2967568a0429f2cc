"""Bins that lie off on their own are bridged; noise, layers and clouds are left as they are."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.elastic.outlying_bins import bridge_outliers

RANGE = 300.0 + 15.0 * np.arange(800)
AIR = 1e10 * np.exp(-RANGE / 8000.0) / RANGE**2
PLACE = np.arange(RANGE.size)


def noisy(signal, ratio, profiles=1, *, seed=1):
    """Return profiles and their variance; the ratio is that of the air to its noise."""
    deviation = AIR / ratio
    rng = np.random.default_rng(seed)
    return signal + deviation * rng.normal(size=(profiles, RANGE.size)), deviation**2


# What is found ------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [15.0, 100.0, 1e4, -15.0, -1e4])
def test_a_bin_that_lies_off_gets_what_its_neighbours_say(size):
    power, variance = noisy(AIR, 50.0, 400)
    at = np.random.default_rng(2).integers(10, RANGE.size - 10, 400)
    rows = np.arange(400)
    power[rows, at] += size * np.sqrt(variance[at])
    found = bridge_outliers(power, RANGE, variance)
    assert np.mean(found.found[rows, at]) > 0.97
    assert found.found.sum() == found.found[rows, at].sum()
    told = found.found[rows, at]
    off = (found.power[rows, at] - AIR[at])[told] / np.sqrt(variance[at][told])
    # The mean of two bins, each with the noise of one.
    assert np.std(off) == pytest.approx(np.sqrt(0.5), rel=0.1)
    assert abs(np.mean(off)) < 0.15
    assert np.array_equal(found.power[~found.found], power[~found.found])


def test_sums_over_a_bridged_bin_have_the_variance_that_is_stated():
    power, variance = noisy(AIR, 50.0, 20_000)
    at = slice(399, 402)
    power[:, 400] += 100.0 * np.sqrt(variance[400])
    found = bridge_outliers(power[:, 380:420], RANGE[380:420], variance[380:420])
    total = found.power[:, 19:22].sum(axis=1)
    stated = np.median(found.variance[:, 19:22].sum(axis=1))
    assert np.var(total) == pytest.approx(stated, rel=0.04)
    assert stated > 1.4 * variance[at].sum()


def test_two_close_ones_are_found_although_each_is_a_neighbour_of_the_other():
    power, variance = noisy(AIR, 50.0, 100)
    for at in (300, 303):
        power[:, at] += 40.0 * np.sqrt(variance[at])
    found = bridge_outliers(power, RANGE, variance).found
    assert found[:, [300, 303]].all()
    assert found.sum() == 200


def test_missing_bins_are_passed_over():
    power, variance = noisy(AIR, 50.0, 50)
    power[:, 500] += 40.0 * np.sqrt(variance[500])
    power[:, [498, 501]] = np.nan
    found = bridge_outliers(power, RANGE, variance)
    assert found.found[:, 500].all()
    assert np.isnan(found.power[:, [498, 501]]).all()
    off = (found.power[:, 500] - AIR[500]) / np.sqrt(variance[500])
    assert abs(np.mean(off)) < 0.5


def test_a_background_changes_nothing_but_itself():
    power, variance = noisy(AIR, 50.0, 20)
    power[:, 500] += 40.0 * np.sqrt(variance[500])
    plain = bridge_outliers(power, RANGE, variance)
    over = bridge_outliers(power + 64.0, RANGE, variance, background=np.full(20, 64.0))
    assert np.array_equal(over.found, plain.found)
    np.testing.assert_allclose(over.power - 64.0, plain.power, rtol=1e-9)


def test_descending_ranges_give_the_same():
    power, variance = noisy(AIR, 50.0, 20)
    power[:, 500] += 40.0 * np.sqrt(variance[500])
    plain = bridge_outliers(power, RANGE, variance)
    turned = bridge_outliers(power[:, ::-1], RANGE[::-1], variance[::-1])
    assert plain.found.any()
    assert np.array_equal(turned.power[:, ::-1], plain.power)
    assert np.array_equal(turned.variance[:, ::-1], plain.variance)


# What is left -------------------------------------------------------------------------------


def test_normal_noise_is_left():
    power, variance = noisy(AIR, 50.0, 5000)
    assert not bridge_outliers(power, RANGE, variance).found.any()


@pytest.mark.parametrize("mean", [0.01, 0.1, 3.0])
def test_single_counts_among_none_are_left(mean):
    counts = np.random.default_rng(3).poisson(mean, (3000, RANGE.size))
    assert bridge_outliers(counts - mean, RANGE, np.full(RANGE.size, mean)).found.sum() <= 2


@pytest.mark.parametrize("width", [2.0, 3.0, 5.0], ids="{:g} bins".format)
@pytest.mark.parametrize("peak", [3.0, 100.0])
def test_thin_layers_are_left(width, peak):
    """Wherever between two bins their middle lies."""
    at = np.random.default_rng(4).uniform(50.0, 750.0, (500, 1))
    layer = peak * np.exp(-4.0 * np.log(2.0) * ((PLACE - at) / width) ** 2)
    power, variance = noisy(AIR * (1.0 + layer), 50.0, 500)
    assert not bridge_outliers(power, RANGE, variance).found.any()


@pytest.mark.parametrize("bins", [1, 2, 8])
@pytest.mark.parametrize("depth", [0.1, 1.0, 5.0])
def test_clouds_are_left_even_of_one_bin(bins, depth):
    """Behind them there is less light."""
    at = np.random.default_rng(5).integers(50, 750, (500, 1))
    inside = (at <= PLACE) & (at + bins > PLACE)
    behind = np.exp(-2.0 * depth * np.clip((PLACE - at + 1) / bins, 0.0, 1.0))
    power, variance = noisy(AIR * (1.0 + 200.0 * inside) * behind, 200.0, 500)
    assert not bridge_outliers(power, RANGE, variance).found.any()


def test_noise_larger_than_stated_is_no_lone_bin():
    power, variance = noisy(AIR, 50.0, 1000)
    assert bridge_outliers(power, RANGE, variance / 100.0).found.mean() < 1e-3


@pytest.mark.parametrize("step", [3.75, 15.0])
def test_rounding_makes_no_lone_bins_where_no_noise_is_stated(step):
    """Times the square of its range, a signal of 1 / R^2 is the same in all bins but for that."""
    place = step * np.arange(1, 1001)
    power = 1e12 / place**2
    power[500] *= 3.0
    assert np.flatnonzero(bridge_outliers(power, place, 0.0).found).tolist() == [500]


def test_profiles_without_data_stay_so():
    power, variance = noisy(AIR, 50.0, 3)
    power[0], power[1, 4:] = np.nan, np.inf
    found = bridge_outliers(power, RANGE, variance)
    assert not found.found.any()
    assert np.array_equal(found.power, power, equal_nan=True)
    assert bridge_outliers(power[:, :3], RANGE[:3], variance[:3]).found.shape == (3, 3)


def test_negative_variances_are_refused():
    with pytest.raises(RetrievalInputError) as caught:
        bridge_outliers(AIR, RANGE, -np.ones(RANGE.size))
    assert caught.value.field == "variance"
