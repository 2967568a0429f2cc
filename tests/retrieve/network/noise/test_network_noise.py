"""Noise of the signals of a network: estimated, correlated, and in noisy profiles."""

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
    """Return power with the same relative noise at all bins, and the power without noise."""
    clean = signals(net, grid(net), field)
    rng = np.random.default_rng(seed)
    return clean * (1.0 + relative * rng.standard_normal((profiles, *clean.shape))), clean


# Estimated noise ----------------------------------------------------------------------------


@pytest.mark.parametrize("profiles", [1, 50])
def test_outlying_bins_do_not_count_as_noise(profiles):
    power, _ = drawn(three_by_two(), 0.02, profiles, homogeneous())
    outlying = np.random.default_rng(4).random(power.shape) < 0.003
    noise, _ = estimated(np.where(outlying, 1e6, 1.0) * power)
    assert outlying.any()
    assert np.median(noise) == pytest.approx(0.02, rel=0.05)
    # The noise of one profile comes from 31 bins.
    assert noise.max() < 0.02 * (1.15 if profiles > 1 else 2.0)


@pytest.mark.parametrize("relative", [3e-3, 0.02, 0.1])
def test_normal_noise_counts_completely(relative):
    noise, _ = estimated(drawn(three_by_two(), relative, 50, homogeneous())[0])
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(relative, rel=0.05)


def test_noise_of_mostly_equal_counts_comes_from_the_others():
    power = np.full((4, 1, 100), 7.0)
    power[:, 0, ::10] = 8.0
    noise, _ = estimated(power)
    assert 0.02 < noise.min() < noise.max() < 0.1
    assert np.all(estimated(np.full((4, 1, 100), 7.0))[0] == 0.0)


@pytest.mark.parametrize("relative", [0.01, 0.1])
@pytest.mark.parametrize("factor", [1.0 / 3.0, 3.0, 1e6])
def test_an_outlying_bin_does_not_change_the_estimated_noise_of_others(factor, relative):
    """The errors of all others were once five times too large."""
    net = three_by_two()
    power, _ = drawn(net, relative, 50)
    noisy_power = power.copy()
    noisy_power[7, 2, 60] *= factor
    clean, result = (
        retrieve_network(signal, grid(net), net, **FULL) for signal in (power, noisy_power)
    )
    others, near = np.arange(50) != 7, net.near_crossing
    np.testing.assert_array_equal(result.flags.flagged[others], clean.flags.flagged[others])
    assert not result.flags.flagged[others][:, near].any()
    np.testing.assert_allclose(
        result.extinction_standard_error[others][:, near],
        clean.extinction_standard_error[others][:, near], rtol=0.02,
    )  # fmt: skip
    score = (result.extinction - at_crossings(net, plume)) / result.extinction_standard_error
    kept = np.isfinite(result.extinction[7]) & ~result.flags.flagged[7]
    assert np.all(np.abs(score[7, kept]) < 4.0)


def test_outlying_bins_count_as_noise_where_they_are_not_searched():
    """Without bridging, a hundredth of the values was once off by 5 errors."""
    net = three_by_two()
    power, clean = drawn(net, 0.1, 200, homogeneous())
    rng = np.random.default_rng(5)
    hit = rng.random(power.shape) < 0.01
    power += hit * rng.uniform(0.5, 10.0, power.shape) * clean
    result = retrieve_network(power, grid(net), net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(result.extinction) & ~result.flags.flagged
    score = (result.extinction - 2e-3) / result.extinction_standard_error
    assert kept.sum() > 500
    assert np.all(np.abs(score[kept]) < 4.0)


def test_a_noisy_profile_has_its_own_estimated_error():
    net = three_by_two()
    power, clean = drawn(net, 0.002, 400, homogeneous())
    noisy_profiles = np.arange(400) % 20 == 7
    power[noisy_profiles] += 11.0 * (power[noisy_profiles] - clean)
    result = retrieve_network(
        power, grid(net), net, prior="none", blocks=np.arange(400) // 20, **FULL
    )
    near = net.near_crossing
    assert result.flags.flagged[noisy_profiles][:, near].mean() < 0.2
    score = (result.extinction - 2e-3) / result.extinction_standard_error
    for selected in (noisy_profiles, ~noisy_profiles):
        kept = ~result.flags.flagged[selected] & near
        assert np.sqrt(np.mean(score[selected][kept] ** 2)) == pytest.approx(1.0, abs=0.2)


def half_noisier(ratio, first, profiles=16, seed=2):
    """Return power with `ratio` times the noise in every other profile, and the relative noise."""
    net = three_by_two()
    clean = signals(net, grid(net), plume)
    relative = np.where(np.arange(profiles) % 2 == first, 0.005, 0.005 * ratio)
    rng = np.random.default_rng(seed)
    noise = relative[:, np.newaxis, np.newaxis] * rng.standard_normal((profiles, *clean.shape))
    return clean * (1.0 + noise), relative


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("ratio", [6.0, 15.0])
def test_noise_of_half_the_profiles_is_not_outlying(ratio, first):
    """Only a sixth of it was once counted if a quiet profile came first."""
    power, relative = half_noisier(ratio, first)
    power[:, :2, -60:] = np.nan
    noise, row = estimated(power)
    stated = np.sqrt(np.nanmean(noise[row] ** 2))
    assert stated == pytest.approx(np.sqrt(np.mean(relative**2)), rel=0.1)


@pytest.mark.parametrize("first", [0, 1])
def test_noisy_profiles_are_kept_among_as_many_quiet_ones(first):
    net = three_by_two()
    power, relative = half_noisier(15.0, first, 64)
    result = retrieve_network(power, grid(net), net, blocks=np.arange(64) // 16, **FULL)
    kept = np.isfinite(result.extinction) & ~result.flags.flagged
    assert kept[:, net.near_crossing][relative > 0.01].mean() > 0.9
    score = (result.extinction - at_crossings(net, plume)) / result.extinction_standard_error
    assert np.all(np.abs(score[kept]) < 4.0)


@pytest.mark.parametrize("profiles", [16, 50])
@pytest.mark.parametrize("ratio", [1.0, 4.0, 15.0])
def test_the_order_of_profiles_does_not_change_their_noise(ratio, profiles):
    power, _ = half_noisier(ratio, 0, profiles)
    outlying = np.random.default_rng(4).random(power.shape) < 0.003
    power[outlying] *= 3.0
    power[5, 1, 40:] = np.nan
    noise, row = estimated(power)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(profiles)
        other, selected = estimated(power[order])
        np.testing.assert_allclose(other[selected], noise[row[order]], rtol=1e-9)


def test_profiles_of_equal_levels_are_selected_in_any_order():
    """Medians of counts are often equal, so they alone must not select the profiles."""
    rng = np.random.default_rng(6)
    squares = rng.random((40, 2, 90)) * np.where(np.arange(40) % 5, 1.0, 50.0)[:, None, None]
    known, level = rng.random(squares.shape) < 0.9, np.ones((40, 2))
    typical = _beam_signals._typical_squares(squares, known, level)
    for _ in range(3):
        order = rng.permutation(40)
        np.testing.assert_array_equal(
            _beam_signals._typical_squares(squares[order], known[order], level), typical
        )


@pytest.mark.parametrize("hit", [4, 5])
@pytest.mark.parametrize("ratio", [1.0, 15.0])
def test_an_outlying_bin_is_detected_among_quiet_and_noisy_profiles(ratio, hit):
    power, _ = half_noisier(ratio, 0)
    clean, _ = estimated(power)
    power[hit, 2, 60] *= 1e6
    noise, _ = estimated(power)
    np.testing.assert_allclose(noise[0], clean[0], rtol=0.03)


def test_few_mostly_outlying_bins_are_no_noisy_profile():
    power, _ = drawn(three_by_two(), 0.02, 20, homogeneous())
    clean, _ = estimated(power)
    power[4, :, 20:] = np.nan
    power[4, :, :20:2] *= 30.0
    noise, _ = estimated(power)
    np.testing.assert_allclose(noise[0], clean[0], rtol=0.05)


# Correlated bins ---------------------------------------------------------------------------


def correlated(shape, share, rng):
    """Return normal noise with a correlation of neighbours of share / (1 + share^2)."""
    plain = rng.standard_normal((*shape[:-1], shape[-1] + 1))
    return (plain[..., 1:] + share * plain[..., :-1]) / np.sqrt(1.0 + share**2)


def excess(logs):
    """Return (beam,) correlation factors, for the same noise in all profiles."""
    return _beam_signals._correlation_factor(logs, np.isfinite(logs), np.ones(logs.shape[:2]))


@pytest.mark.parametrize(("relative", "share"), [(0.003, 0.4), (0.02, 1.0)])
def test_errors_of_correlated_bins_come_from_their_sums(relative, share):
    """A tenth of the unflagged values was once off by more than 4 errors."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, plume)
    shape = (200, *clean.shape)
    power = clean * (1.0 + relative * correlated(shape, share, np.random.default_rng(3)))
    result = retrieve_network(power, r, net, blocks=np.arange(200) // 50, **FULL)
    kept = np.isfinite(result.extinction) & ~result.flags.flagged
    assert kept[:, net.near_crossing].mean() > 0.95
    score = (result.extinction - at_crossings(net, plume)) / result.extinction_standard_error
    assert np.mean(np.abs(score[kept]) > 4.0) < 0.002
    # Long sums have (1 + share)^2 / (1 + share^2) times the variance of independent bins.
    noise, _ = estimated(power[:50])
    sums = relative * (1.0 + share) / np.sqrt(1.0 + share**2)
    assert np.median(noise) == pytest.approx(sums, rel=0.15)


@pytest.mark.parametrize("lost", ["far third", "first profile", "both", "a twentieth"])
@pytest.mark.parametrize("bins", [1200, 6000])
def test_correlation_is_detected_with_unknown_bins(bins, lost):
    """Only second differences were once used, less than half of the noise."""
    rng = np.random.default_rng(1)
    logs = 0.02 * correlated((60, 3, bins), 1.0, rng)
    whole = excess(logs)
    chunk = logs.copy()
    if lost in {"far third", "both"}:
        chunk[:, 1, -bins // 3 :] = np.nan
    if lost in {"first profile", "both"}:
        chunk[0, 1] = np.nan
    if lost == "a twentieth":
        chunk[:, 1][rng.random((60, bins)) < 0.05] = np.nan
    chunk[:, 2] = np.nan
    result = excess(chunk)
    # Correlations of neighbours are 1/2, those of neighbouring sums 1/14.
    assert result[1] == pytest.approx(1.75 * (1.0 - 4.0 / 3.0 / 14.0) / (1.0 / 3.0), rel=0.25)
    assert result[0] == whole[0]
    assert result[2] == 1.0


@pytest.mark.parametrize("profiles", [1, 2, 12, 50])
def test_independent_bins_have_no_correlation(profiles):
    power, _ = drawn(three_by_two(), 0.05, profiles)
    np.testing.assert_array_equal(excess(np.log(power)), 1.0)


def test_noise_that_differs_between_profiles_is_no_correlation():
    """It was once taken for correlation in 2 to 6 percent of beams."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        level = np.where(rng.permutation(24) % 2, 1.0, 225.0)[:, np.newaxis] * np.ones(6)
        logs = 0.005 * np.sqrt(level)[..., np.newaxis] * rng.standard_normal((24, 6, 240))
        result = _beam_signals._correlation_factor(logs, np.isfinite(logs), level)
        np.testing.assert_array_equal(result, 1.0)
        level[::5] = [np.inf, 0.0, np.nan, 1.0, 1.0, 1.0]
        assert np.isfinite(_beam_signals._correlation_factor(logs, np.isfinite(logs), level)).all()


def test_air_that_drifts_is_no_correlated_noise():
    net = three_by_two()
    r = grid(net)
    fields = [lambda x, y, z, e=e: plume(x, y, z, e) for e in np.linspace(-200.0, 100.0, 50)]
    clean = np.array([signals(net, r, f) for f in fields])
    power = clean * (1.0 + 0.005 * np.random.default_rng(2).standard_normal(clean.shape))
    np.testing.assert_array_equal(excess(np.log(power)), 1.0)


def test_outlying_bins_are_no_correlated_noise():
    power, _ = drawn(three_by_two(), 0.02, 50, homogeneous())
    outlying = np.random.default_rng(4).random(power.shape) < 0.015
    noise, _ = estimated(np.where(outlying, 3.0, 1.0) * power)
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(0.02, rel=0.1)


def test_unknown_and_equal_counts_have_no_correlation():
    logs = np.full((50, 2, 200), np.nan)
    logs[:, 1] = 3.0
    np.testing.assert_array_equal(excess(logs), 1.0)
    logs[1::2, 1, ::7] = 3.1
    np.testing.assert_array_equal(excess(logs), 1.0)


# Noisy profiles and weak signals ------------------------------------------------------------


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
