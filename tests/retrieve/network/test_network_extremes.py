"""Networks of lidars: flags and extreme cases."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    fan,
    grid,
    homogeneous,
    noisy,
    relative_errors,
    root_mean_square,
    signals,
    triangle,
    with_noise,
)

from lidarops.flags import Quality
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.flags import NetworkQuality


def test_extreme_d_clear_air_is_flagged():
    net = triangle()
    network = with_noise(net, homogeneous(2e-5), 0.005, 200)
    assert network.raised(NetworkQuality.POORLY_DETERMINED)[:, 0].any()
    usable = ~network.flagged[:, 0]
    score = (network.extinction[:, 0] - 2e-5) / network.extinction_standard_error[:, 0]
    assert not usable.any() or np.mean(np.abs(score[usable]) < 3) >= 0.98


def test_extreme_g_steep_power_law():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(), 2.0), 0.01, 200, additive=0.0)
    result = retrieve_network(power, r, net, prior="none", variance=variance, exponent=2.0,
                   full_overlap_range=100.0)  # fmt: skip
    assert root_mean_square(relative_errors(result, 2e-3))[0] < 0.06


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, np.inf, -np.inf])
@pytest.mark.parametrize("prior", ["block", "none"])
def test_extreme_h_a_bad_signal_is_always_flagged(bad, prior):
    net = triangle()
    r = grid(net)
    clean = signals(net, r, homogeneous())
    power, variance = noisy(net, r, clean, 0.005, 12)
    power[3, 0, np.searchsorted(r, 700.0)] = bad
    power[5, :, :] = bad
    whole = retrieve_network(
        power, r, net, prior=prior, variance=variance, full_overlap_range=100.0
    )
    assert np.isnan(whole.extinction[5]).all()
    assert whole.no_solution[5].all()
    missing = whole.raised(Quality.LOW_SIGNAL if np.isfinite(bad) else Quality.INPUT_MISSING)
    assert missing[[3, 5], 1].all()
    assert whole.flagged[3, 1]
    # The other profiles do not change.
    assert np.isfinite(whole.extinction[[0, 1, 2, 4], 0]).all()
    assert not missing[[0, 1, 2, 4]].any()


def test_extreme_i_too_few_beams_without_prior_have_no_values():
    net = fan([-500.0, 500.0], [(45.0, 55.0), (135.0,)])
    assert net.crossings == 2
    result = with_noise(net, homogeneous(), 0.01, 20, prior="none")
    assert np.isnan(result.extinction).all()
    assert result.no_solution.all()
