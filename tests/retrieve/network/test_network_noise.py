"""Weak signals, and profiles far noisier than their block."""

from __future__ import annotations

import numpy as np
from support.oracles.network import grid, homogeneous, noisy, plume, signals, three_by_two

from lidarops.retrieve.network import _beam_signals
from lidarops.retrieve.network.extinction_field import retrieve_network

FULL = {"full_overlap_range": 100.0}


def test_profiles_are_noisy_only_beyond_the_noise_of_their_signal():
    """The noise of photon counts grows with the signal; this is no detector fault."""
    signal, variances = np.ones((50, 40)), np.ones((50, 40))
    variances[3] = 90.0
    np.testing.assert_allclose(_beam_signals._typical_variance(variances, signal, signal[0]), 1.0)
    signal[3] = 4.0
    np.testing.assert_allclose(
        _beam_signals._typical_variance(variances, signal, signal[0]), (49.0 + 90.0) / 50.0
    )
    variances[3] = 110.0
    np.testing.assert_allclose(_beam_signals._typical_variance(variances, signal, signal[0]), 1.0)


def test_an_unknown_beam_is_missing_and_not_weak():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 20)
    stated = np.broadcast_to(variance, power.shape).copy()
    power[3, 0], stated[3, 0] = np.nan, np.nan
    result = retrieve_network(power, r, net, variance=stated, **FULL)
    assert not result.flags.weak_signal.any()
    selected = np.zeros_like(result.flags.signal_missing)
    selected[3, net.on_beam(0)[0]] = True
    np.testing.assert_array_equal(result.flags.signal_missing, selected)


def test_a_signal_that_noise_makes_negative_is_weak():
    """A faulty beam differs from one with little signal."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(8e-3)), 0.01, 20, additive=0.05)
    result = retrieve_network(power, r, net, variance=variance, **FULL)
    assert (np.median(power, axis=0) <= 0.0).any()
    assert result.flags.weak_signal.any(axis=0).any()
    assert not result.flags.signal_not_positive.any()
    power[:, 0] -= 10.0 * np.sqrt(variance[0])
    result = retrieve_network(power, r, net, variance=variance, **FULL)
    assert result.flags.signal_not_positive[:, net.on_beam(0)[0][1:]].all()
