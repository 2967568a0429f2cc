"""Noise of the signals of a network: told by themselves, and loud profiles among others."""

from __future__ import annotations

import numpy as np
import pytest
from oracle_multiposition import (
    at_vertices,
    grid,
    homogeneous,
    noisy,
    plume,
    signals,
    three_by_two,
)

from lidarops.retrieve import _rays
from lidarops.retrieve.multiposition import solve

FULL = {"full_overlap_range": 100.0}


def estimated(power):
    """Return (row, ray, bin) relative standard deviations of one block."""
    rows, row = _rays._estimated(power, [np.arange(len(power))], np.zeros(len(power), np.intp))
    return np.sqrt(rows), row


def drawn(net, relative, profiles, field=plume, seed=2):
    """Return power whose relative noise is the same at all gates, and the power without."""
    clean = signals(net, grid(net), field)
    rng = np.random.default_rng(seed)
    return clean * (1.0 + relative * rng.standard_normal((profiles, *clean.shape))), clean


# Told by the signals ------------------------------------------------------------------------


@pytest.mark.parametrize("profiles", [1, 50])
def test_wild_gates_are_not_taken_for_noise(profiles):
    power, _ = drawn(three_by_two(), 0.02, profiles, homogeneous())
    wild = np.random.default_rng(4).random(power.shape) < 0.003
    noise, _ = estimated(np.where(wild, 1e6, 1.0) * power)
    assert wild.any()
    assert np.median(noise) == pytest.approx(0.02, rel=0.05)
    # Of one profile, 31 gates tell the noise.
    assert noise.max() < 0.02 * (1.15 if profiles > 1 else 2.0)


@pytest.mark.parametrize("relative", [3e-3, 0.02, 0.1])
def test_noise_is_all_counted_that_is_normal(relative):
    noise, _ = estimated(drawn(three_by_two(), relative, 50, homogeneous())[0])
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(relative, rel=0.05)


def test_noise_of_mostly_equal_counts_is_what_the_others_have():
    power = np.full((4, 1, 100), 7.0)
    power[:, 0, ::10] = 8.0
    noise, _ = estimated(power)
    assert 0.02 < noise.min() < noise.max() < 0.1
    assert np.all(estimated(np.full((4, 1, 100), 7.0))[0] == 0.0)


@pytest.mark.parametrize("relative", [0.01, 0.1])
@pytest.mark.parametrize("factor", [1.0 / 3.0, 3.0, 1e6])
def test_a_wild_gate_costs_no_other_profile_anything_where_signals_tell_the_noise(factor, relative):
    """The errors of all others were five times as large."""
    net = three_by_two()
    power, _ = drawn(net, relative, 50)
    heard = power.copy()
    heard[7, 2, 60] *= factor
    clean, found = (solve(one, grid(net), net, **FULL) for one in (power, heard))
    others, near = np.arange(50) != 7, net.near_vertex
    np.testing.assert_array_equal(found.flags.flagged[others], clean.flags.flagged[others])
    assert not found.flags.flagged[others][:, near].any()
    np.testing.assert_allclose(
        found.extinction_standard_error[others][:, near],
        clean.extinction_standard_error[others][:, near], rtol=0.02,
    )  # fmt: skip
    score = (found.extinction - at_vertices(net, plume)) / found.extinction_standard_error
    kept = np.isfinite(found.extinction[7]) & ~found.flags.flagged[7]
    assert np.all(np.abs(score[7, kept]) < 4.0)


def test_wild_gates_are_told_where_noise_is_too_high_to_look_for_them():
    """Not bridged, they left values 5 errors off in a hundredth of all."""
    net = three_by_two()
    power, clean = drawn(net, 0.1, 200, homogeneous())
    rng = np.random.default_rng(5)
    hit = rng.random(power.shape) < 0.01
    power += hit * rng.uniform(0.5, 10.0, power.shape) * clean
    found = solve(power, grid(net), net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    score = (found.extinction - 2e-3) / found.extinction_standard_error
    assert kept.sum() > 500
    assert np.all(np.abs(score[kept]) < 4.0)


def test_a_loud_profile_states_its_own_error_where_signals_tell_the_noise():
    net = three_by_two()
    power, clean = drawn(net, 0.002, 400, homogeneous())
    loud = np.arange(400) % 20 == 7
    power[loud] += 11.0 * (power[loud] - clean)
    found = solve(power, grid(net), net, prior="none", blocks=np.arange(400) // 20, **FULL)
    near = net.near_vertex
    assert found.flags.flagged[loud][:, near].mean() < 0.2
    score = (found.extinction - 2e-3) / found.extinction_standard_error
    for mine in (loud, ~loud):
        kept = ~found.flags.flagged[mine] & near
        assert np.sqrt(np.mean(score[mine][kept] ** 2)) == pytest.approx(1.0, abs=0.2)


# Gates that are not independent -------------------------------------------------------------


def correlated(shape, share, rng):
    """Return normal noise of which neighbours have a correlation of share / (1 + share^2)."""
    plain = rng.standard_normal((*shape[:-1], shape[-1] + 1))
    return (plain[..., 1:] + share * plain[..., :-1]) / np.sqrt(1.0 + share**2)


@pytest.mark.parametrize(("relative", "share"), [(0.003, 0.4), (0.02, 1.0)])
def test_correlated_gates_state_what_their_sums_have(relative, share):
    """A tenth of the values lay off by more than 4 errors, without a flag."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, plume)
    shape = (200, *clean.shape)
    power = clean * (1.0 + relative * correlated(shape, share, np.random.default_rng(3)))
    found = solve(power, r, net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    assert kept[:, net.near_vertex].mean() > 0.95
    score = (found.extinction - at_vertices(net, plume)) / found.extinction_standard_error
    assert np.mean(np.abs(score[kept]) > 4.0) < 0.002
    # Sums of many have (1 + share)^2 / (1 + share^2) times the variance of independent ones.
    noise, _ = estimated(power[:50])
    sums = relative * (1.0 + share) / np.sqrt(1.0 + share**2)
    assert np.median(noise) == pytest.approx(sums, rel=0.15)


@pytest.mark.parametrize("profiles", [1, 2, 12, 50])
def test_independent_gates_are_not_taken_for_correlated(profiles):
    power, _ = drawn(three_by_two(), 0.05, profiles)
    np.testing.assert_array_equal(_rays._excess(np.log(power), np.isfinite(power)), 1.0)


def test_air_that_drifts_is_no_correlated_noise():
    net = three_by_two()
    r = grid(net)
    fields = [lambda x, y, z, e=e: plume(x, y, z, e) for e in np.linspace(-200.0, 100.0, 50)]
    clean = np.array([signals(net, r, f) for f in fields])
    power = clean * (1.0 + 0.005 * np.random.default_rng(2).standard_normal(clean.shape))
    np.testing.assert_array_equal(_rays._excess(np.log(power), np.isfinite(power)), 1.0)


def test_wild_gates_are_no_correlated_noise():
    power, _ = drawn(three_by_two(), 0.02, 50, homogeneous())
    wild = np.random.default_rng(4).random(power.shape) < 0.015
    noise, _ = estimated(np.where(wild, 3.0, 1.0) * power)
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(0.02, rel=0.1)


def test_of_unknown_and_equal_counts_no_correlation_is_told():
    logs = np.full((50, 2, 200), np.nan)
    logs[:, 1] = 3.0
    np.testing.assert_array_equal(_rays._excess(logs, np.isfinite(logs)), 1.0)
    logs[1::2, 1, ::7] = 3.1
    np.testing.assert_array_equal(_rays._excess(logs, np.isfinite(logs)), 1.0)


# Loud profiles and weak signals -------------------------------------------------------------


def test_profiles_are_loud_by_more_than_their_signal_is_strong():
    """Noise of counts grows with the signal: it is not what a detector out of order has."""
    signal, variances = np.ones((50, 40)), np.ones((50, 40))
    variances[3] = 90.0
    np.testing.assert_allclose(_rays._usual(variances, signal, signal[0]), 1.0)
    signal[3] = 4.0
    np.testing.assert_allclose(_rays._usual(variances, signal, signal[0]), (49.0 + 90.0) / 50.0)
    variances[3] = 110.0
    np.testing.assert_allclose(_rays._usual(variances, signal, signal[0]), 1.0)


def test_a_ray_of_which_nothing_is_known_is_missing_and_not_weak():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 20)
    told = np.broadcast_to(variance, power.shape).copy()
    power[3, 0], told[3, 0] = np.nan, np.nan
    found = solve(power, r, net, variance=told, **FULL)
    assert not found.flags.weak_signal.any()
    mine = np.zeros_like(found.flags.signal_missing)
    mine[3, net.on_ray(0)[0]] = True
    np.testing.assert_array_equal(found.flags.signal_missing, mine)


def test_what_noise_alone_makes_negative_is_weak():
    """A ray that is out of order is told from one of which little is left."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(8e-3)), 0.01, 20, additive=0.05)
    found = solve(power, r, net, variance=variance, **FULL)
    assert (np.median(power, axis=0) <= 0.0).any()
    assert found.flags.weak_signal.any(axis=0).any()
    assert not found.flags.signal_not_positive.any()
    power[:, 0] -= 10.0 * np.sqrt(variance[0])
    found = solve(power, r, net, variance=variance, **FULL)
    assert found.flags.signal_not_positive[:, net.on_ray(0)[0][1:]].all()
