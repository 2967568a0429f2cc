"""Noise of the signals of a network: told by themselves, and loud profiles among others."""

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
)

from lidarops.retrieve.network import _beam_signals
from lidarops.retrieve.network.extinction_field import retrieve_network

FULL = {"full_overlap_range": 100.0}


def estimated(power):
    """Return (row, beam, bin) relative standard deviations of one block."""
    rows, row = _beam_signals._estimate_variances(
        power, [np.arange(len(power))], np.zeros(len(power), np.intp)
    )
    return np.sqrt(rows), row


def drawn(net, relative, profiles, field=plume, seed=2):
    """Return power whose relative noise is the same at all bins, and the power without."""
    clean = signals(net, grid(net), field)
    rng = np.random.default_rng(seed)
    return clean * (1.0 + relative * rng.standard_normal((profiles, *clean.shape))), clean


# Told by the signals ------------------------------------------------------------------------


@pytest.mark.parametrize("profiles", [1, 50])
def test_wild_bins_are_not_taken_for_noise(profiles):
    power, _ = drawn(three_by_two(), 0.02, profiles, homogeneous())
    wild = np.random.default_rng(4).random(power.shape) < 0.003
    noise, _ = estimated(np.where(wild, 1e6, 1.0) * power)
    assert wild.any()
    assert np.median(noise) == pytest.approx(0.02, rel=0.05)
    # Of one profile, 31 bins tell the noise.
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
def test_a_wild_bin_costs_no_other_profile_anything_where_signals_tell_the_noise(factor, relative):
    """The errors of all others were five times as large."""
    net = three_by_two()
    power, _ = drawn(net, relative, 50)
    heard = power.copy()
    heard[7, 2, 60] *= factor
    clean, found = (retrieve_network(one, grid(net), net, **FULL) for one in (power, heard))
    others, near = np.arange(50) != 7, net.near_crossing
    np.testing.assert_array_equal(found.flags.flagged[others], clean.flags.flagged[others])
    assert not found.flags.flagged[others][:, near].any()
    np.testing.assert_allclose(
        found.extinction_standard_error[others][:, near],
        clean.extinction_standard_error[others][:, near], rtol=0.02,
    )  # fmt: skip
    score = (found.extinction - at_crossings(net, plume)) / found.extinction_standard_error
    kept = np.isfinite(found.extinction[7]) & ~found.flags.flagged[7]
    assert np.all(np.abs(score[7, kept]) < 4.0)


def test_wild_bins_are_told_where_noise_is_too_high_to_look_for_them():
    """Not bridged, they left values 5 errors off in a hundredth of all."""
    net = three_by_two()
    power, clean = drawn(net, 0.1, 200, homogeneous())
    rng = np.random.default_rng(5)
    hit = rng.random(power.shape) < 0.01
    power += hit * rng.uniform(0.5, 10.0, power.shape) * clean
    found = retrieve_network(power, grid(net), net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    score = (found.extinction - 2e-3) / found.extinction_standard_error
    assert kept.sum() > 500
    assert np.all(np.abs(score[kept]) < 4.0)


def test_a_loud_profile_states_its_own_error_where_signals_tell_the_noise():
    net = three_by_two()
    power, clean = drawn(net, 0.002, 400, homogeneous())
    loud = np.arange(400) % 20 == 7
    power[loud] += 11.0 * (power[loud] - clean)
    found = retrieve_network(
        power, grid(net), net, prior="none", blocks=np.arange(400) // 20, **FULL
    )
    near = net.near_crossing
    assert found.flags.flagged[loud][:, near].mean() < 0.2
    score = (found.extinction - 2e-3) / found.extinction_standard_error
    for mine in (loud, ~loud):
        kept = ~found.flags.flagged[mine] & near
        assert np.sqrt(np.mean(score[mine][kept] ** 2)) == pytest.approx(1.0, abs=0.2)


def half_louder(ratio, first, profiles=16, seed=2):
    """Return power of which every other profile has that many times the noise, and the noise."""
    net = three_by_two()
    clean = signals(net, grid(net), plume)
    relative = np.where(np.arange(profiles) % 2 == first, 0.005, 0.005 * ratio)
    rng = np.random.default_rng(seed)
    noise = relative[:, np.newaxis, np.newaxis] * rng.standard_normal((profiles, *clean.shape))
    return clean * (1.0 + noise), relative


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("ratio", [6.0, 15.0])
def test_noise_of_half_the_profiles_is_not_wild(ratio, first):
    """A sixth of it was told, and no value of the noisy profiles left, where a quiet one led."""
    power, relative = half_louder(ratio, first)
    power[:, :2, -60:] = np.nan
    noise, row = estimated(power)
    told = np.sqrt(np.nanmean(noise[row] ** 2))
    assert told == pytest.approx(np.sqrt(np.mean(relative**2)), rel=0.1)


@pytest.mark.parametrize("first", [0, 1])
def test_noisy_profiles_are_kept_among_as_many_quiet_ones(first):
    net = three_by_two()
    power, relative = half_louder(15.0, first, 64)
    found = retrieve_network(power, grid(net), net, blocks=np.arange(64) // 16, **FULL)
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    assert kept[:, net.near_crossing][relative > 0.01].mean() > 0.9
    score = (found.extinction - at_crossings(net, plume)) / found.extinction_standard_error
    assert np.all(np.abs(score[kept]) < 4.0)


@pytest.mark.parametrize("profiles", [16, 50])
@pytest.mark.parametrize("ratio", [1.0, 4.0, 15.0])
def test_the_order_of_profiles_does_not_change_their_noise(ratio, profiles):
    power, _ = half_louder(ratio, 0, profiles)
    wild = np.random.default_rng(4).random(power.shape) < 0.003
    power[wild] *= 3.0
    power[5, 1, 40:] = np.nan
    noise, row = estimated(power)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(profiles)
        other, mine = estimated(power[order])
        np.testing.assert_allclose(other[mine], noise[row[order]], rtol=1e-9)


def test_profiles_of_equal_levels_are_asked_in_any_order():
    """Medians of counts are often equal: they alone do not tell which profiles are asked."""
    rng = np.random.default_rng(6)
    squares = rng.random((40, 2, 90)) * np.where(np.arange(40) % 5, 1.0, 50.0)[:, None, None]
    known, level = rng.random(squares.shape) < 0.9, np.ones((40, 2))
    usual = _beam_signals._typical_squares(squares, known, level)
    for _ in range(3):
        order = rng.permutation(40)
        np.testing.assert_array_equal(
            _beam_signals._typical_squares(squares[order], known[order], level), usual
        )


@pytest.mark.parametrize("hit", [4, 5])
@pytest.mark.parametrize("ratio", [1.0, 15.0])
def test_a_wild_bin_is_told_among_quiet_and_noisy_profiles(ratio, hit):
    power, _ = half_louder(ratio, 0)
    clean, _ = estimated(power)
    power[hit, 2, 60] *= 1e6
    noise, _ = estimated(power)
    np.testing.assert_allclose(noise[0], clean[0], rtol=0.03)


def test_few_bins_that_are_mostly_wild_are_no_noisy_profile():
    power, _ = drawn(three_by_two(), 0.02, 20, homogeneous())
    clean, _ = estimated(power)
    power[4, :, 20:] = np.nan
    power[4, :, :20:2] *= 30.0
    noise, _ = estimated(power)
    np.testing.assert_allclose(noise[0], clean[0], rtol=0.05)


# Bins that are not independent -------------------------------------------------------------


def correlated(shape, share, rng):
    """Return normal noise of which neighbours have a correlation of share / (1 + share^2)."""
    plain = rng.standard_normal((*shape[:-1], shape[-1] + 1))
    return (plain[..., 1:] + share * plain[..., :-1]) / np.sqrt(1.0 + share**2)


def excess(logs):
    """Return (beam,) what sums of bins of the same noise in all profiles have more."""
    return _beam_signals._correlation_factor(logs, np.isfinite(logs), np.ones(logs.shape[:2]))


@pytest.mark.parametrize(("relative", "share"), [(0.003, 0.4), (0.02, 1.0)])
def test_correlated_bins_state_what_their_sums_have(relative, share):
    """A tenth of the values lay off by more than 4 errors, without a flag."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, plume)
    shape = (200, *clean.shape)
    power = clean * (1.0 + relative * correlated(shape, share, np.random.default_rng(3)))
    found = retrieve_network(power, r, net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(found.extinction) & ~found.flags.flagged
    assert kept[:, net.near_crossing].mean() > 0.95
    score = (found.extinction - at_crossings(net, plume)) / found.extinction_standard_error
    assert np.mean(np.abs(score[kept]) > 4.0) < 0.002
    # Sums of many have (1 + share)^2 / (1 + share^2) times the variance of independent ones.
    noise, _ = estimated(power[:50])
    sums = relative * (1.0 + share) / np.sqrt(1.0 + share**2)
    assert np.median(noise) == pytest.approx(sums, rel=0.15)


@pytest.mark.parametrize("lost", ["far third", "first profile", "both", "a twentieth"])
@pytest.mark.parametrize("bins", [1200, 6000])
def test_bins_are_correlated_also_where_some_are_unknown(bins, lost):
    """Second differences alone were told, less than half of the noise."""
    rng = np.random.default_rng(1)
    logs = 0.02 * correlated((60, 3, bins), 1.0, rng)
    whole = excess(logs)
    part = logs.copy()
    if lost in {"far third", "both"}:
        part[:, 1, -bins // 3 :] = np.nan
    if lost in {"first profile", "both"}:
        part[0, 1] = np.nan
    if lost == "a twentieth":
        part[:, 1][rng.random((60, bins)) < 0.05] = np.nan
    part[:, 2] = np.nan
    found = excess(part)
    # Correlations of neighbours are 1/2, those of neighbouring sums 1/14.
    assert found[1] == pytest.approx(1.75 * (1.0 - 4.0 / 3.0 / 14.0) / (1.0 / 3.0), rel=0.25)
    assert found[0] == whole[0]
    assert found[2] == 1.0


@pytest.mark.parametrize("profiles", [1, 2, 12, 50])
def test_independent_bins_are_not_taken_for_correlated(profiles):
    power, _ = drawn(three_by_two(), 0.05, profiles)
    np.testing.assert_array_equal(excess(np.log(power)), 1.0)


def test_noise_that_differs_between_profiles_is_not_taken_for_correlated():
    """By chance it was, of 2 to 6 beams in a hundred."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        level = np.where(rng.permutation(24) % 2, 1.0, 225.0)[:, np.newaxis] * np.ones(6)
        logs = 0.005 * np.sqrt(level)[..., np.newaxis] * rng.standard_normal((24, 6, 240))
        found = _beam_signals._correlation_factor(logs, np.isfinite(logs), level)
        np.testing.assert_array_equal(found, 1.0)
        level[::5] = [np.inf, 0.0, np.nan, 1.0, 1.0, 1.0]
        assert np.isfinite(_beam_signals._correlation_factor(logs, np.isfinite(logs), level)).all()


def test_air_that_drifts_is_no_correlated_noise():
    net = three_by_two()
    r = grid(net)
    fields = [lambda x, y, z, e=e: plume(x, y, z, e) for e in np.linspace(-200.0, 100.0, 50)]
    clean = np.array([signals(net, r, f) for f in fields])
    power = clean * (1.0 + 0.005 * np.random.default_rng(2).standard_normal(clean.shape))
    np.testing.assert_array_equal(excess(np.log(power)), 1.0)


def test_wild_bins_are_no_correlated_noise():
    power, _ = drawn(three_by_two(), 0.02, 50, homogeneous())
    wild = np.random.default_rng(4).random(power.shape) < 0.015
    noise, _ = estimated(np.where(wild, 3.0, 1.0) * power)
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(0.02, rel=0.1)


def test_of_unknown_and_equal_counts_no_correlation_is_told():
    logs = np.full((50, 2, 200), np.nan)
    logs[:, 1] = 3.0
    np.testing.assert_array_equal(excess(logs), 1.0)
    logs[1::2, 1, ::7] = 3.1
    np.testing.assert_array_equal(excess(logs), 1.0)


# Loud profiles and weak signals -------------------------------------------------------------


def test_profiles_are_loud_by_more_than_their_signal_is_strong():
    """Noise of counts grows with the signal: it is not what a detector out of order has."""
    signal, variances = np.ones((50, 40)), np.ones((50, 40))
    variances[3] = 90.0
    np.testing.assert_allclose(_beam_signals._typical_variance(variances, signal, signal[0]), 1.0)
    signal[3] = 4.0
    np.testing.assert_allclose(
        _beam_signals._typical_variance(variances, signal, signal[0]), (49.0 + 90.0) / 50.0
    )
    variances[3] = 110.0
    np.testing.assert_allclose(_beam_signals._typical_variance(variances, signal, signal[0]), 1.0)


def test_a_beam_of_which_nothing_is_known_is_missing_and_not_weak():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 20)
    told = np.broadcast_to(variance, power.shape).copy()
    power[3, 0], told[3, 0] = np.nan, np.nan
    found = retrieve_network(power, r, net, variance=told, **FULL)
    assert not found.flags.weak_signal.any()
    mine = np.zeros_like(found.flags.signal_missing)
    mine[3, net.on_beam(0)[0]] = True
    np.testing.assert_array_equal(found.flags.signal_missing, mine)


def test_what_noise_alone_makes_negative_is_weak():
    """A beam that is out of order is told from one of which little is left."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(8e-3)), 0.01, 20, additive=0.05)
    found = retrieve_network(power, r, net, variance=variance, **FULL)
    assert (np.median(power, axis=0) <= 0.0).any()
    assert found.flags.weak_signal.any(axis=0).any()
    assert not found.flags.signal_not_positive.any()
    power[:, 0] -= 10.0 * np.sqrt(variance[0])
    found = retrieve_network(power, r, net, variance=variance, **FULL)
    assert found.flags.signal_not_positive[:, net.on_beam(0)[0][1:]].all()
