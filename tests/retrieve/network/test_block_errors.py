"""Errors of single profiles of a network that only their block shows."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from support.oracles.network import gradient, grid, noisy, plume, signals, three_by_two

from lidarops.retrieve.network import _block_errors
from lidarops.retrieve.network.extinction_field import retrieve_network

# Errors ---------------------------------------------------------------------------------------


def noise_bias(logarithm, variance, mean):
    block = SimpleNamespace(
        profiles=SimpleNamespace(logarithm=logarithm, variance=variance),
        mean=SimpleNamespace(logarithm=np.array([mean])),
    )
    return _block_errors.noise_bias_variance(block)


def test_bias_by_noise_counts_where_it_is_significant():
    logarithm = np.full((40, 3), -7.0) + np.random.default_rng(3).normal(0.0, 1e-3, (40, 3))
    variance = np.full((40, 3), 0.2**2)
    logarithm[::2, 1] = np.nan
    result = noise_bias(logarithm, variance, [-7.09, -7.5, np.nan])
    np.testing.assert_allclose(result, [0.0, 0.25, 0.0], rtol=0.01)


# Networks -------------------------------------------------------------------------------------


def test_block_errors_change_no_value_and_hardly_a_clear_case(monkeypatch):
    net = three_by_two()
    r = grid(net)
    scenes = [
        noisy(net, r, signals(net, r, field), relative, 50, seed=seed)
        for seed, (field, relative) in enumerate(product((gradient, plume), (0.01, 0.05)))
    ]

    def solve_all():
        results = [
            retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
            for power, variance in scenes
        ]
        return [
            np.concatenate([getattr(result, name) for result in results])
            for name in ("extinction", "extinction_standard_error")
        ]

    value, stated = solve_all()
    monkeypatch.setattr(_block_errors, "noise_bias_variance", lambda *_: 0.0)
    value_without, stated_without = solve_all()
    np.testing.assert_array_equal(value, value_without)
    known = np.isfinite(stated_without)
    assert np.all(stated[known] >= stated_without[known])
    assert np.median(stated[known] / stated_without[known]) < 1.1


@pytest.mark.parametrize("offset", [1.0, 30.0, -30.0, 1e3])
def test_an_outlying_profile_does_not_change_the_others(offset):
    """A twentieth of its deviation was once in the errors of all."""
    rng = np.random.default_rng(3)
    logarithm = -7.0 + rng.normal(0.0, 0.02, (50, 1))
    variance = np.full((50, 1), 0.02**2)
    logarithm[7] += offset
    variance[7] *= 1e6
    assert noise_bias(logarithm, variance, [-7.0])[0] == 0.0
    # A small common shift of many profiles counts for all.
    logarithm[:20] += 0.1
    stated = noise_bias(logarithm, variance, [-7.0])[0]
    assert 0.02**2 < stated < 0.06**2


@pytest.mark.parametrize("factor", [1e4, 1e8])
def test_contradictory_beams_of_a_profile_do_not_change_the_others(factor):
    """The errors of the others were once up to 26 times too large."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.003, 50, seed=4)
    noisy_power = power.copy()
    noisy_power[7, 0, 133:136] *= factor
    settings = {"variance": variance, "full_overlap_range": 100.0}
    clean, result = (
        retrieve_network(signal, r, net, **settings) for signal in (power, noisy_power)
    )
    others, near = np.arange(50) != 7, net.near_crossing
    ratio = result.extinction_standard_error / clean.extinction_standard_error
    np.testing.assert_allclose(ratio[others][:, near], 1.0, rtol=0.05)
    np.testing.assert_array_equal(result.flags.flagged[others], clean.flags.flagged[others])
