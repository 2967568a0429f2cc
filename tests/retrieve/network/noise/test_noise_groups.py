"""Blocks of which many profiles are far noisier than many others."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracle_network import (
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


def shuffled(count, of=50):
    """Return (profile,) True for some profiles, here and there in the block."""
    out = np.zeros(of, dtype=bool)
    out[np.random.default_rng(0).permutation(of)[:count]] = True
    return out


def alike(found, whole, where):
    for name in OUTCOME:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name)[where], name)
    np.testing.assert_array_equal(found.flags.flagged, whole.flags.flagged[where])


@pytest.mark.parametrize("factor", [3.0, 5.0])
@pytest.mark.parametrize("count", [20, 30])
def test_noisy_profiles_cost_quiet_ones_of_their_block_nothing(factor, count):
    """They lost their far crossings with the others, and all their values to flags."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, plume)
    power, variance = noisy(net, r, clean, 0.01, 50, seed=3)
    loud = shuffled(count)
    scale = np.where(loud, factor, 1.0)[:, np.newaxis, np.newaxis]
    heard, told = clean + scale * (power - clean), scale**2 * variance
    settings = {"full_overlap_range": 100.0}
    found = retrieve_network(heard, r, net, variance=told, **settings)
    for mine in (~loud, loud):
        alike(retrieve_network(heard[mine], r, net, variance=told[mine], **settings), found, mine)
    near = net.near_crossing
    assert not found.flags.flagged[~loud][:, near].any()
    stated = found.extinction_standard_error / at_crossings(net, plume)
    calm = retrieve_network(power, r, net, variance=variance, **settings)
    usual = calm.extinction_standard_error / at_crossings(net, plume)
    np.testing.assert_allclose(stated[~loud][:, near], usual[~loud][:, near], rtol=0.15)


def test_thick_air_costs_what_came_before_it_nothing():
    net = three_by_two()
    r = grid(net)
    dense = shuffled(30)
    shape = (50, net.beams, r.size)
    power, variance = np.empty(shape), np.empty(shape)
    for mine, extinction in ((~dense, 5e-4), (dense, 5e-3)):
        clean = signals(net, r, homogeneous(extinction))
        power[mine], variance[mine] = noisy(net, r, clean, 0.02, int(mine.sum()), 5)
    settings = {"variance": variance, "full_overlap_range": 100.0}
    found = retrieve_network(power, r, net, **settings)
    apart = retrieve_network(power, r, net, blocks=dense.astype(int), **settings)
    alike(apart, found, slice(None))
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    assert kept[~dense].sum() > 80
    truth = np.where(dense, 5e-3, 5e-4)[:, np.newaxis]
    score = (found.extinction - truth) / found.extinction_standard_error
    assert np.all(np.abs(score[kept]) < 4.0)


def parts(power, variance, net, r, block=None):
    """Return (profile,) blocks."""
    beams = _beam_signals.prepare_signals(
        power, r, net, variance=variance, overlap=None, full_overlap_range=100.0, exponent=1.0,
        blocks=block, bins=7,
    )  # fmt: skip
    return beams.block


@pytest.mark.parametrize("noise", [0.02, 0.3, 0.4, 0.5, 0.7, 1.0, 3.0])
@pytest.mark.parametrize("profiles", [50, 1000])
def test_chance_parts_no_block(noise, profiles):
    """About as noisy as can be used, levels differ by chance alone."""
    net = triangle()
    r = grid(net, 10.0)
    clean = signals(net, r, homogeneous())
    rng = np.random.default_rng(1)
    power = clean * (1.0 + noise * rng.standard_normal((profiles, *clean.shape)))
    told = np.broadcast_to((noise * clean) ** 2, power.shape)
    assert not parts(power, told, net, r).any()


def test_few_loud_profiles_energies_gaps_and_wild_bins_part_no_block():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.02, 50)
    told = np.broadcast_to(variance, power.shape).copy()
    assert not parts(power, told, net, r).any()
    rng = np.random.default_rng(3)
    energy = np.exp(rng.uniform(-2.0, 2.0, (50, net.beams, 1)))
    assert not parts(energy * power, energy**2 * told, net, r).any()
    lost = rng.random((50, net.beams, 1)) < 0.3
    assert not parts(np.where(lost, np.nan, power), told, net, r).any()
    assert not parts(power, np.where(lost, np.nan, told), net, r).any()
    wild = np.where(rng.random(power.shape) < 0.05, 1e3, 1.0)
    assert not parts(wild * power, told, net, r).any()
    told[:7] *= 1e4
    assert not parts(power, told, net, r).any()
    told[7] *= 1e4
    np.testing.assert_array_equal(parts(power, told, net, r), np.arange(50) < 8)


def test_blocks_are_parted_each_for_itself():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.02, 60)
    told = np.broadcast_to(variance, power.shape).copy()
    told[[*range(10), *range(20, 30), 40]] *= 50.0
    found = parts(power, told, net, r, np.repeat(["c", "a", "b"], 20))
    np.testing.assert_array_equal(found, np.repeat([4, 3, 1, 0, 2], [10, 10, 10, 10, 20]))
    assert parts(power[:0], told[:0], net, r).size == 0


def test_profiles_of_three_kinds_come_into_three_blocks():
    noise = np.repeat([[1e-4], [1e-3], [1e-1]], [10, 20, 15], axis=0)
    noise = noise * np.random.default_rng(2).uniform(0.8, 1.25, noise.shape)
    found = noise_groups._split(np.arange(45), noise)
    assert [mine.tolist() for mine in found] == [
        list(range(10)), list(range(10, 30)), list(range(30, 45))
    ]  # fmt: skip
