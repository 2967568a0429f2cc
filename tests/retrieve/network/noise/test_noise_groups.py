"""Blocks in which many profiles are far noisier than many others."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    grid,
    homogeneous,
    noisy,
    plume,
    signals,
    three_by_two,
    triangle,
)

from lidarops.retrieve.network import _beam_signals
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.noise import noise_groups

OUTCOME = ("extinction", "extinction_standard_error", "degrees_of_freedom", "prior_deviation")


def shuffled(count, profiles=50):
    """Return (profile,) True for `count` randomly chosen profiles."""
    mask = np.zeros(profiles, dtype=bool)
    mask[np.random.default_rng(0).permutation(profiles)[:count]] = True
    return mask


def assert_equal(result, whole, where):
    for name in OUTCOME:
        np.testing.assert_array_equal(getattr(result, name), getattr(whole, name)[where], name)
    np.testing.assert_array_equal(result.flags.flagged, whole.flags.flagged[where])


@pytest.mark.parametrize("factor", [3.0, 5.0])
@pytest.mark.parametrize("count", [20, 30])
def test_noisy_profiles_do_not_change_quiet_ones_of_their_block(factor, count):
    """The quiet ones once lost their far crossings, and all their values were flagged."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, plume)
    power, variance = noisy(net, r, clean, 0.01, 50, seed=3)
    noisy_profiles = shuffled(count)
    scale = np.where(noisy_profiles, factor, 1.0)[:, np.newaxis, np.newaxis]
    noisy_power, stated_variance = clean + scale * (power - clean), scale**2 * variance
    settings = {"full_overlap_range": 100.0}
    result = retrieve_network(noisy_power, r, net, variance=stated_variance, **settings)
    for selected in (~noisy_profiles, noisy_profiles):
        assert_equal(
            retrieve_network(
                noisy_power[selected], r, net, variance=stated_variance[selected], **settings
            ),
            result,
            selected,
        )
    near = net.near_crossing
    assert not result.flags.flagged[~noisy_profiles][:, near].any()
    stated = result.extinction_standard_error / at_crossings(net, plume)
    quiet_result = retrieve_network(power, r, net, variance=variance, **settings)
    typical = quiet_result.extinction_standard_error / at_crossings(net, plume)
    np.testing.assert_allclose(
        stated[~noisy_profiles][:, near], typical[~noisy_profiles][:, near], rtol=0.15
    )


def test_dense_air_does_not_change_the_profiles_before_it():
    net = three_by_two()
    r = grid(net)
    dense = shuffled(30)
    shape = (50, net.beams, r.size)
    power, variance = np.empty(shape), np.empty(shape)
    for selected, extinction in ((~dense, 5e-4), (dense, 5e-3)):
        clean = signals(net, r, homogeneous(extinction))
        power[selected], variance[selected] = noisy(net, r, clean, 0.02, int(selected.sum()), 5)
    settings = {"variance": variance, "full_overlap_range": 100.0}
    result = retrieve_network(power, r, net, **settings)
    separate = retrieve_network(power, r, net, blocks=dense.astype(int), **settings)
    assert_equal(separate, result, slice(None))
    kept = np.isfinite(result.extinction) & ~result.flags.flagged
    assert kept[~dense].sum() > 80
    truth = np.where(dense, 5e-3, 5e-4)[:, np.newaxis]
    score = (result.extinction - truth) / result.extinction_standard_error
    assert np.all(np.abs(score[kept]) < 4.0)


def block_numbers(power, variance, net, r, block=None):
    """Return (profile,) block numbers after the split by noise."""
    beams = _beam_signals.prepare_signals(
        power, r, net, variance=variance, overlap=None, full_overlap_range=100.0, exponent=1.0,
        blocks=block, bins=7,
    )  # fmt: skip
    return beams.block


@pytest.mark.parametrize("noise", [0.02, 0.3, 0.4, 0.5, 0.7, 1.0, 3.0])
@pytest.mark.parametrize("profiles", [50, 1000])
def test_chance_splits_no_block(noise, profiles):
    """Near the largest usable noise, levels differ by chance."""
    net = triangle()
    r = grid(net, 10.0)
    clean = signals(net, r, homogeneous())
    rng = np.random.default_rng(1)
    power = clean * (1.0 + noise * rng.standard_normal((profiles, *clean.shape)))
    stated_variance = np.broadcast_to((noise * clean) ** 2, power.shape)
    assert not block_numbers(power, stated_variance, net, r).any()


def test_few_noisy_profiles_energies_gaps_and_outlying_bins_split_no_block():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.02, 50)
    stated_variance = np.broadcast_to(variance, power.shape).copy()
    assert not block_numbers(power, stated_variance, net, r).any()
    rng = np.random.default_rng(3)
    energy = np.exp(rng.uniform(-2.0, 2.0, (50, net.beams, 1)))
    assert not block_numbers(energy * power, energy**2 * stated_variance, net, r).any()
    missing = rng.random((50, net.beams, 1)) < 0.3
    assert not block_numbers(np.where(missing, np.nan, power), stated_variance, net, r).any()
    assert not block_numbers(power, np.where(missing, np.nan, stated_variance), net, r).any()
    outlying = np.where(rng.random(power.shape) < 0.05, 1e3, 1.0)
    assert not block_numbers(outlying * power, stated_variance, net, r).any()
    stated_variance[:7] *= 1e4
    assert not block_numbers(power, stated_variance, net, r).any()
    stated_variance[7] *= 1e4
    np.testing.assert_array_equal(block_numbers(power, stated_variance, net, r), np.arange(50) < 8)


def test_each_block_is_split_alone():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.02, 60)
    stated_variance = np.broadcast_to(variance, power.shape).copy()
    stated_variance[[*range(10), *range(20, 30), 40]] *= 50.0
    result = block_numbers(power, stated_variance, net, r, np.repeat(["c", "a", "b"], 20))
    np.testing.assert_array_equal(result, np.repeat([4, 3, 1, 0, 2], [10, 10, 10, 10, 20]))
    assert block_numbers(power[:0], stated_variance[:0], net, r).size == 0


def test_profiles_of_three_noise_levels_form_three_blocks():
    noise = np.repeat([[1e-4], [1e-3], [1e-1]], [10, 20, 15], axis=0)
    noise = noise * np.random.default_rng(2).uniform(0.8, 1.25, noise.shape)
    result = noise_groups._split(np.arange(45), noise)
    assert [selected.tolist() for selected in result] == [
        list(range(10)), list(range(10, 30)), list(range(30, 45))
    ]  # fmt: skip
