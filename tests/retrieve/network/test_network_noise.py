"""Weak signals, and profiles far noisier than their block."""

from __future__ import annotations

import numpy as np
from support.oracles.network import grid, homogeneous, noisy, plume, signals, three_by_two

from lidarops.flags import Quality
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.flags import NetworkQuality

FULL = {"full_overlap_range": 100.0}


def test_a_profile_far_noisier_than_its_block_is_weak_only_where_its_own_signal_is():
    """The noise of photon counts grows with the signal; this is no detector fault."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.02, 50)
    variances = np.broadcast_to(variance, power.shape).copy()
    power[3], variances[3] = 30.0 * power[3], 900.0 * variances[3]
    variances[7] = power[7] ** 2
    weak = retrieve_network(power, r, net, variance=variances, **FULL).raised(
        NetworkQuality.LOW_LEVERAGE
    )
    assert weak[7].any()
    assert not weak[np.arange(50) != 7].any()


def test_an_unknown_beam_is_missing_and_not_weak():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 20)
    stated = np.broadcast_to(variance, power.shape).copy()
    power[3, 0], stated[3, 0] = np.nan, np.nan
    result = retrieve_network(power, r, net, variance=stated, **FULL)
    assert not result.raised(NetworkQuality.LOW_LEVERAGE).any()
    selected = np.zeros_like(result.raised(Quality.INPUT_MISSING))
    selected[3, net.on_beam(0)[0]] = True
    np.testing.assert_array_equal(result.raised(Quality.INPUT_MISSING), selected)


def test_a_signal_that_noise_makes_negative_is_weak():
    """A faulty beam differs from one with little signal."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(8e-3)), 0.01, 20, additive=0.05)
    result = retrieve_network(power, r, net, variance=variance, **FULL)
    assert (np.median(power, axis=0) <= 0.0).any()
    assert result.raised(NetworkQuality.LOW_LEVERAGE).any(axis=0).any()
    assert not result.raised(Quality.LOW_SIGNAL).any()
    power[:, 0] -= 10.0 * np.sqrt(variance[0])
    result = retrieve_network(power, r, net, variance=variance, **FULL)
    assert result.raised(Quality.LOW_SIGNAL)[:, net.on_beam(0)[0][1:]].all()
