"""Blocks of profiles as one field: air that changes, and profiles that disagree."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    gradient,
    grid,
    noisy,
    plume,
    signals,
    three_by_two,
    triangle,
)

from lidarops.retrieve.network import _block_solution
from lidarops.retrieve.network._beam_signals import SignalChange
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.flags import NetworkQuality

PROFILES = 36


def changing(net, factor, relative, seed=1):
    """Return range, power, variance and truth of a gradient that grows to a multiple of itself."""
    r = grid(net)
    gain = factor ** (np.arange(PROFILES) / (PROFILES - 1) - 0.5)
    drawn = []
    for n, each in enumerate(gain):
        clean = signals(net, r, lambda x, y, z, each=each: each * gradient(x, y, z))
        drawn.append(noisy(net, r, clean, relative, 1, seed=(seed, n), additive=1e-3))
    power = np.concatenate([power for power, _ in drawn])
    variance = np.stack([variance for _, variance in drawn])
    return r, power, variance, gain[:, None] * at_crossings(net, gradient)


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0, 10.0])
@pytest.mark.parametrize("build", [triangle, three_by_two])
def test_air_that_changes_everywhere_is_followed(build, factor):
    net = build()
    scores, errors = [], []
    for seed in range(4):
        r, power, variance, truth = changing(net, factor, 0.02, seed)
        result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
        kept = ~result.flagged & np.isfinite(result.extinction)
        assert kept[:, net.near_crossing].mean() > 0.95
        scores.append(((result.extinction - truth) / result.extinction_standard_error)[kept])
        errors.append((result.extinction / truth - 1.0)[kept])
    score = np.concatenate(scores)
    assert np.mean(np.abs(score) > 4.0) < 0.005
    assert np.sqrt(np.mean(score**2)) < 1.3
    # Three beams do not test each other.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < (0.15 if net.beams == 3 else 0.05)


def unflagged_scores(air, gains, relative, seeds=8):
    """Return errors over stated ones of unflagged values of a triangle, and the share of these."""
    net = triangle()
    r, near = grid(net), net.near_crossing
    clean = {each: signals(net, r, lambda *at, each=each: each * air(*at)) for each in set(gains)}
    truth = np.array(gains)[:, None] * at_crossings(net, air)[near]
    scores = []
    for seed in range(seeds):
        drawn = [
            noisy(net, r, clean[each], relative, 1, seed=(seed, n), additive=1e-3)
            for n, each in enumerate(gains)
        ]
        power, variance = np.concatenate([p for p, _ in drawn]), np.array([v for _, v in drawn])
        result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
        score = (result.extinction[:, near] - truth) / result.extinction_standard_error[:, near]
        scores.append(score[~result.flagged[:, near]])
    found = np.concatenate(scores)
    return found, found.size / (seeds * truth.size)


@pytest.mark.parametrize("factor", [3.0, 4.0])
@pytest.mark.parametrize("relative", [0.005])
def test_a_front_is_followed_where_noise_is_low(factor, relative, monkeypatch):
    score, share = unflagged_scores(plume, [1.0] * 18 + [factor] * 18, relative)
    assert share > 0.95
    assert np.mean(np.abs(score) > 4.0) < 0.01
    # About running means, profiles beside it are not linear.
    changed = _block_solution.THRESHOLDS._replace(linear_noise=0.0)
    monkeypatch.setattr(_block_solution, "THRESHOLDS", changed)
    assert unflagged_scores(plume, [1.0] * 18 + [factor] * 18, relative)[1] < 0.95


@pytest.mark.parametrize("factor", [4.0, 8.0])
def test_a_front_in_noise_is_flagged_rather_than_false(factor, monkeypatch):
    """Profiles beside it, of which the second order of the change exceeds the error."""
    gains = [1.0] * 18 + [factor] * 18
    score, share = unflagged_scores(plume, gains, 0.05)
    assert share < 0.95
    assert np.mean(np.abs(score) > 4.0) < 0.005


def test_a_solution_that_does_not_converge_is_flagged(monkeypatch):
    """One pass is too few at a front."""
    monkeypatch.setattr(_block_solution, "_FIELD_PASSES", 1)
    score, share = unflagged_scores(plume, [1.0] * 18 + [4.0] * 18, 0.005)
    assert share < 0.1
    assert not np.any(np.abs(score) > 4.0)


@pytest.mark.parametrize("build", [triangle, three_by_two])
@pytest.mark.parametrize("profiles", [3, 4])
def test_a_beam_that_is_wrong_by_a_third_in_a_short_block_makes_no_value_false(build, profiles):
    """With changes in time, the field followed it, and 7 of 372 values were false."""
    net = build()
    r, near = grid(net), net.near_crossing
    truth, clean = at_crossings(net, plume)[near], signals(net, r, plume)
    scores = []
    for bad, seed in itertools.product(range(profiles), range(5)):
        power, variance = noisy(net, r, clean, 0.05, profiles, seed=seed, additive=1e-3)
        power = damaged(net, r, power, "x 1.3", bad)
        result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
        score = (result.extinction[:, near] - truth) / result.extinction_standard_error[:, near]
        scores.append(score[~result.flagged[:, near]])
    found = np.concatenate(scores)
    assert found.size > 0.6 * profiles**2 * 5 * near.sum()
    assert np.all(np.abs(found) < 4.0)


@pytest.mark.parametrize("profiles", [1, 30])
def test_an_error_that_all_profiles_share_stays_in_their_mean(profiles):
    """The background is wrong in all profiles alike: more of them do not reduce its error."""
    net = three_by_two()
    r, near = grid(net), net.near_crossing
    power, variance = noisy(net, r, signals(net, r, plume), 0.02, profiles, additive=1e-3)
    result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    added = np.full((profiles, r.size), 1e-5 * power.max())
    response = result.respond([{0: SignalChange(power=added)}])[:, near, 0]
    alone, _ = noisy(net, r, signals(net, r, plume), 1e-6, 1)
    expected = retrieve_network(alone, r, net, variance=variance, full_overlap_range=100.0).respond(
        [{0: SignalChange(power=added[:1])}]
    )[:, near, 0]
    np.testing.assert_allclose(response, np.broadcast_to(expected, response.shape),
                               atol=0.15 * np.abs(expected).max())  # fmt: skip


@pytest.mark.parametrize("relative", [0.01, 0.05])
def test_air_that_changes_from_profile_to_profile_is_followed(relative):
    gains = np.exp(0.5 * np.sin(1.3 * np.arange(PROFILES))).tolist()
    score, share = unflagged_scores(plume, gains, relative)
    assert share > 0.9
    assert np.mean(np.abs(score) > 4.0) < 0.005


def test_one_step_about_the_mean_does_not_follow_air_that_changes_much(monkeypatch):
    net = triangle()
    r, power, variance, truth = changing(net, 10.0, 0.02)
    monkeypatch.setattr(_block_solution, "THRESHOLDS",
                        _block_solution.THRESHOLDS._replace(linear_change=1e30))  # fmt: skip
    result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    score = (result.extinction - truth) / result.extinction_standard_error
    assert np.nanmean(np.abs(score) > 4.0) > 0.05


def damaged(net, r, power, kind, profile=7):
    """Return powers with one bad beam in one profile."""
    power, at = power.copy(), net.on_beam(0)[1].mean()
    behind = 1.0 / (1.0 + np.exp((at - r) / 30.0))
    cloud = np.exp(-0.5 * ((r - at) / 30.0) ** 2)
    shapes = {
        "x 1.3": 1.3**behind,
        "x 2": 2.0**behind,
        "x 5": 5.0**behind,
        "cloud": (1.0 + 10.0 * cloud) * np.exp(-2.0 * behind),
    }
    power[profile, 0] *= shapes[kind]
    return power


@pytest.mark.parametrize("kind", ["x 1.3", "x 5", "cloud"])
@pytest.mark.parametrize("relative", [0.002, 0.02])
@pytest.mark.parametrize("build", [triangle, three_by_two])
def test_a_bad_profile_does_not_change_the_others(build, relative, kind):
    """It once moved them by 39 errors, or widened their errors 13 times."""
    net = build()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), relative, PROFILES, additive=1e-3)
    settings = {"variance": variance, "full_overlap_range": 100.0}
    clean = retrieve_network(power, r, net, **settings)
    result = retrieve_network(damaged(net, r, power, kind), r, net, **settings)
    near, others = net.near_crossing, np.arange(PROFILES) != 7
    assert result.raised(NetworkQuality.POOR_FIT)[7].all()
    np.testing.assert_array_equal(result.flagged[others], clean.flagged[others])
    error = clean.extinction_standard_error[others][:, near]
    shift = (result.extinction - clean.extinction)[others][:, near] / error
    assert np.abs(shift).max() < 0.3
    np.testing.assert_allclose(result.extinction_standard_error[others][:, near], error, rtol=0.1)


@pytest.mark.parametrize("profiles", [2, 3, 4, 6])
@pytest.mark.parametrize("build", [triangle, three_by_two])
def test_a_bad_profile_makes_no_other_one_of_a_short_block_false(build, profiles):
    """Its own two steps are most of those that are typical there."""
    net = build()
    r, near = grid(net), net.near_crossing
    truth, clean = at_crossings(net, plume)[near], signals(net, r, plume)
    scores = []
    for bad in (0, profiles // 2, profiles - 1):
        for seed in range(5):
            power, variance = noisy(net, r, clean, 0.05, profiles, seed=seed, additive=1e-3)
            power = damaged(net, r, power, "x 2", bad)
            result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
            # Of two profiles that disagree, either may be the bad one.
            lost = (np.arange(profiles) == bad) | (profiles == 2)
            np.testing.assert_array_equal(result.flagged[:, near].all(axis=1), lost)
            poor = result.raised(NetworkQuality.POOR_FIT)[:, near].all(axis=1)
            np.testing.assert_array_equal(poor, lost)
            score = (result.extinction[:, near] - truth) / result.extinction_standard_error[:, near]
            scores.append(score[~lost])
    assert np.all(np.abs(np.concatenate(scores)) < 4.0)


def test_profiles_without_a_fault_agree_with_their_neighbours():
    """In steady air, in a front, and at the turning points of a wave."""
    net = three_by_two()
    r = grid(net)
    time = np.arange(PROFILES) / PROFILES
    for course in (
        0.0 * time,
        np.sin(4.0 * np.pi * time),
        1.0 / (1.0 + np.exp((0.5 - time) / 0.05)),
    ):
        power, variance = [], []
        for n, each in enumerate(2.0**course):
            clean = signals(net, r, lambda x, y, z, each=each: each * gradient(x, y, z))
            drawn = noisy(net, r, clean, 0.005, 1, seed=n, additive=1e-3)
            power.append(drawn[0][0])
            variance.append(drawn[1])
        result = retrieve_network(
            np.array(power), r, net, variance=np.array(variance), full_overlap_range=100.0
        )
        assert not result.raised(NetworkQuality.POOR_FIT).any()


def test_a_beam_without_noise_in_all_profiles_is_left_out_and_flagged():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 12)
    variance = np.broadcast_to(variance, power.shape).copy()
    for beams in ([0], [0, 1, 2]):
        variance[:, beams] = 0.0
        result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
        for beam in beams:
            assert result.raised(NetworkQuality.LOW_LEVERAGE)[:, net.on_beam(beam)[0]].all()


def test_missing_profiles_stand_for_time():
    """In air that changes, profiles after a long gap are not those before it."""
    net = three_by_two()
    r, power, variance, _ = changing(net, 3.0, 0.02)
    settings = {"full_overlap_range": 100.0}
    gap = np.full((40, *power.shape[1:]), np.nan)
    apart = retrieve_network(
        np.concatenate([power[:18], gap, power[18:]]), r, net,
        variance=np.concatenate([variance[:18], np.ones_like(gap), variance[18:]]), **settings,
    )  # fmt: skip
    joined = retrieve_network(power, r, net, variance=variance, **settings)
    near = net.near_crossing
    assert np.isnan(apart.extinction[18:58]).all()
    given = np.r_[:18, 58:76]
    # A neighbour in time says something about the profile at the edge of the gap.
    ratio = apart.extinction_standard_error[given] / joined.extinction_standard_error
    assert np.all(ratio[[17, 18]][:, near] > 1.02)
    apart_by = (apart.extinction[given] - joined.extinction) / joined.extinction_standard_error
    assert np.abs(apart_by[[0, -1]][:, near]).max() < 1.0
