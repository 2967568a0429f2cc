"""Isolated outlying bins are replaced; noise, layers and clouds are left unchanged."""

from __future__ import annotations

import numpy as np
import pytest
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.clouds.outlying_bins import bridge_outliers

RANGE = 300.0 + 15.0 * np.arange(800)
AIR = 1e10 * np.exp(-RANGE / 8000.0) / RANGE**2
PLACE = np.arange(RANGE.size)


def noisy(signal, ratio, profiles=1, *, seed=1):
    """Return profiles and their variance; the ratio is that of the air to its noise."""
    deviation = AIR / ratio
    rng = np.random.default_rng(seed)
    return signal + deviation * rng.normal(size=(profiles, RANGE.size)), deviation**2


# Detected -----------------------------------------------------------------------------------


@each("size", [15.0, 100.0, 1e4, -15.0, -1e4])
def test_an_outlying_bin_is_interpolated_from_its_neighbours(size):
    power, variance = noisy(AIR, 50.0, 400)
    at = np.random.default_rng(2).integers(10, RANGE.size - 10, 400)
    rows = np.arange(400)
    power[rows, at] += size * np.sqrt(variance[at])
    bridged = bridge_outliers(power, RANGE, variance)
    assert np.mean(bridged.outlying[rows, at]) > 0.97
    assert bridged.outlying.sum() == bridged.outlying[rows, at].sum()
    detected = bridged.outlying[rows, at]
    deviation = (bridged.power[rows, at] - AIR[at])[detected] / np.sqrt(variance[at][detected])
    # The mean of two bins, each with the noise of one.
    assert np.std(deviation) == pytest.approx(np.sqrt(0.5), rel=0.1)
    assert abs(np.mean(deviation)) < 0.15
    assert np.array_equal(bridged.power[~bridged.outlying], power[~bridged.outlying])


def test_sums_over_a_bridged_bin_have_the_variance_that_is_stated():
    power, variance = noisy(AIR, 50.0, 20_000)
    bins = slice(399, 402)
    power[:, 400] += 100.0 * np.sqrt(variance[400])
    bridged = bridge_outliers(power[:, 380:420], RANGE[380:420], variance[380:420])
    total = bridged.power[:, 19:22].sum(axis=1)
    stated = np.median(bridged.variance[:, 19:22].sum(axis=1))
    assert np.var(total) == pytest.approx(stated, rel=0.04)
    assert stated > 1.4 * variance[bins].sum()


def test_two_outliers_within_reach_of_each_other_are_both_detected():
    power, variance = noisy(AIR, 50.0, 100)
    for at in (300, 303):
        power[:, at] += 40.0 * np.sqrt(variance[at])
    outlying = bridge_outliers(power, RANGE, variance).outlying
    assert outlying[:, [300, 303]].all()
    assert outlying.sum() == 200


def test_missing_bins_are_skipped():
    power, variance = noisy(AIR, 50.0, 50)
    power[:, 500] += 40.0 * np.sqrt(variance[500])
    power[:, [498, 501]] = np.nan
    bridged = bridge_outliers(power, RANGE, variance)
    assert bridged.outlying[:, 500].all()
    assert np.isnan(bridged.power[:, [498, 501]]).all()
    deviation = (bridged.power[:, 500] - AIR[500]) / np.sqrt(variance[500])
    assert abs(np.mean(deviation)) < 0.5


def test_a_background_is_restored():
    power, variance = noisy(AIR, 50.0, 20)
    power[:, 500] += 40.0 * np.sqrt(variance[500])
    plain = bridge_outliers(power, RANGE, variance)
    offset = bridge_outliers(power + 64.0, RANGE, variance, background=np.full(20, 64.0))
    assert np.array_equal(offset.outlying, plain.outlying)
    np.testing.assert_allclose(offset.power - 64.0, plain.power, rtol=1e-9)


# Left unchanged -----------------------------------------------------------------------------


def test_normal_noise_is_left_unchanged():
    power, variance = noisy(AIR, 50.0, 5000)
    assert not bridge_outliers(power, RANGE, variance).outlying.any()


@pytest.mark.parametrize("mean", [0.01, 0.1, 3.0])
def test_single_counts_among_empty_bins_are_left_unchanged(mean):
    counts = np.random.default_rng(3).poisson(mean, (3000, RANGE.size))
    assert bridge_outliers(counts - mean, RANGE, np.full(RANGE.size, mean)).outlying.sum() <= 2


@pytest.mark.parametrize("width", [2.0, 3.0, 5.0], ids="{:g} bins".format)
@pytest.mark.parametrize("peak", [3.0, 100.0])
def test_thin_layers_are_left_unchanged(width, peak):
    """The middle of the layer lies anywhere between two bins."""
    at = np.random.default_rng(4).uniform(50.0, 750.0, (500, 1))
    layer = peak * np.exp(-4.0 * np.log(2.0) * ((PLACE - at) / width) ** 2)
    power, variance = noisy(AIR * (1.0 + layer), 50.0, 500)
    assert not bridge_outliers(power, RANGE, variance).outlying.any()


@each("bins", [1, 2, 8])
@each("depth", [0.1, 1.0, 5.0])
def test_clouds_of_any_width_are_left_unchanged(bins, depth):
    """The signal behind a cloud is attenuated."""
    at = np.random.default_rng(5).integers(50, 750, (500, 1))
    inside = (at <= PLACE) & (at + bins > PLACE)
    behind = np.exp(-2.0 * depth * np.clip((PLACE - at + 1) / bins, 0.0, 1.0))
    power, variance = noisy(AIR * (1.0 + 200.0 * inside) * behind, 200.0, 500)
    assert not bridge_outliers(power, RANGE, variance).outlying.any()


def test_noise_larger_than_stated_makes_few_outliers():
    power, variance = noisy(AIR, 50.0, 1000)
    assert bridge_outliers(power, RANGE, variance / 100.0).outlying.mean() < 1e-3


@pytest.mark.parametrize("step", [3.75, 15.0])
def test_rounding_makes_no_outliers_where_the_noise_is_zero(step):
    """Range-corrected, a signal of 1 / R^2 is the same in all bins up to rounding."""
    place = step * np.arange(1, 1001)
    power = 1e12 / place**2
    power[500] *= 3.0
    assert np.flatnonzero(bridge_outliers(power, place, 0.0).outlying).tolist() == [500]


def test_profiles_without_data_stay_unchanged():
    power, variance = noisy(AIR, 50.0, 3)
    power[0], power[1, 4:] = np.nan, np.inf
    bridged = bridge_outliers(power, RANGE, variance)
    assert not bridged.outlying.any()
    assert np.array_equal(bridged.power, power, equal_nan=True)
    assert bridge_outliers(power[:, :3], RANGE[:3], variance[:3]).outlying.shape == (3, 3)


def test_negative_variances_are_refused():
    with pytest.raises(RetrievalInputError) as caught:
        bridge_outliers(AIR, RANGE, -np.ones(RANGE.size))
    assert caught.value.field == "variance"
