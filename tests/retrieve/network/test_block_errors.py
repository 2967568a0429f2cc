"""What a block of profiles tells about the errors of each of them in a network."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracle_network import grid, noisy, plume, signals, three_by_two

from lidarops.bench.stability import random_networks as draws
from lidarops.retrieve.network import _block_errors
from lidarops.retrieve.network.extinction_field import retrieve_network

# Fields that a prior rules out ----------------------------------------------------------------


def places(crossings, axes=3, seed=1):
    rng = np.random.default_rng(seed)
    return np.pad(rng.normal(0.0, 200.0, (crossings, axes)), ((0, 0), (0, 3 - axes)))


@pytest.mark.parametrize("axes", [2, 3])
def test_bends_are_what_no_level_and_no_gradient_describes(axes):
    position = places(14, axes)
    fields = _block_errors.bent_fields(position)
    plain = np.column_stack([np.ones(14), position])
    np.testing.assert_allclose(fields @ plain, 0.0, atol=1e-9)
    assert np.sum(fields**2) / 14 == pytest.approx(_block_errors.BEND**2)
    # Any quadratic field is made of them, but for what is plain.
    quadratic = (position[:, 0] - 0.3 * position[:, 1] + 20.0) ** 2 / 1e4
    design = np.column_stack([plain, fields.T])
    fitted, *_ = np.linalg.lstsq(design, quadratic, rcond=None)
    np.testing.assert_allclose(design @ fitted, quadratic, atol=1e-9)


def test_bends_are_alike_in_all_directions_and_sizes_of_a_network():
    position = places(14)
    turn, _ = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))
    one = _block_errors.bent_fields(position)
    other = _block_errors.bent_fields(3.0 * position @ turn.T + [500.0, -70.0, 9.0])
    np.testing.assert_allclose(other.T @ other, one.T @ one, atol=1e-12)


@pytest.mark.parametrize("crossings", [0, 1, 2, 3])
def test_few_crossings_in_a_plane_have_no_bends(crossings):
    assert _block_errors.bent_fields(places(crossings, 2)).size == 0


# Errors ---------------------------------------------------------------------------------------


def test_what_noise_moves_all_profiles_by_is_told_where_it_matters():
    logarithm = np.full((40, 3), -7.0) + np.random.default_rng(3).normal(0.0, 1e-3, (40, 3))
    variance = np.full((40, 3), 0.2**2)
    logarithm[::2, 1] = np.nan
    found = _block_errors.noise_bias_variance(logarithm, variance, np.array([-7.09, -7.5, np.nan]))
    np.testing.assert_allclose(found, [0.0, 0.25, 0.0], rtol=0.01)


def test_fields_move_profiles_by_no_more_than_the_mean_leaves_open():
    excluded_variance = np.array([[0.01, 0.01, 0.01, np.nan], [0.5, 0.5, 0.5, 0.5]])
    told, free = np.full(4, -7.0), np.array([-7.0, -7.2, np.nan, -7.0])
    found = _block_errors.excluded_field_variance(
        excluded_variance, told, free, np.array([0.1, 0.1, np.nan, 0.1])
    )
    np.testing.assert_allclose(found, [[0.01, 0.01, 0.01, np.nan], [0.1, 0.14, 0.5, 0.1]])


def test_a_profile_that_came_out_high_states_no_less_than_its_block():
    extinction = np.array([[1.0, 1.0], [1.1, 1.1], [4.0, 4.0], [np.nan, 1.0], [9.0, 9.0]]) * 1e-4
    relative = np.array([[0.4, 0.04], [0.5, 0.05], [0.1, 0.01], [np.nan, 0.04], [0.1, 0.1]])
    variance, block = (relative * extinction) ** 2, np.array([0, 0, 0, 0, 1])
    alike = np.ones((5, 3), dtype=bool)
    found = _block_errors.at_least_typical(extinction, variance, block, alike)
    np.testing.assert_allclose(np.sqrt(found[:3, 0]), [4e-5, 5.5e-5, 4e-5])
    # Small errors, and other blocks, are left alone.
    np.testing.assert_array_equal(found[:, 1], variance[:, 1])
    np.testing.assert_array_equal(found[3:], variance[3:])


def test_a_profile_is_compared_with_those_that_see_what_it_sees():
    extinction = np.full((6, 1), 1e-4)
    variance = (np.array([[0.2], [0.3], [0.8], [0.9], [0.1], [0.7]]) * 1e-4) ** 2
    # All beams, all, one lost (4 times).
    seen = np.array([[1, 1, 1]] * 2 + [[1, 1, 0]] * 3 + [[0, 1, 1]], dtype=bool)
    block = np.zeros(6, dtype=np.intp)
    found = _block_errors.at_least_typical(extinction, variance, block, seen)
    typical = np.sqrt((0.2**2 + 0.3**2) / 2.0)
    # The last but one came out high, and is told by those that see as much, and more.
    wanted = [typical, 0.3, 0.8, 0.9, 0.3, 0.7]
    np.testing.assert_allclose(np.sqrt(found[:, 0]), np.array(wanted) * 1e-4)


# Networks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cluster", "failure", "before"),
    [
        # Air that bends over the network, which the beams take for attenuation.
        (89, "none, plume", 863),
        # Three crossings in thin air, of which nothing but the prior tells.
        (523, "outliers", 96),
        # Thin air, in which noise moves all profiles to one side of their mean.
        (647, "plume that drifts within a block", 124),
        (169, "outliers", 106),
        # The same, in profiles that came out highest.
        (623, "none, layered", 127),
        # A profile in which a beam has nearly nothing left at a bin.
        (338, "plume that drifts within a block", 22),
    ],
)
def test_networks_that_once_stated_too_little_state_their_errors(cluster, failure, before):
    """Of the random networks of the benchmark, in which nearly all false values stood."""
    judged = next(j for j, _ in draws.score_networks(cluster, 50) if j.failure.name == failure)
    kept = np.isfinite(judged.error) & (judged.bits == 0)
    false = kept & (np.abs(judged.error) > 4.0 * judged.random)
    assert false.sum() <= 0.01 * before
    if kept.sum() > 50:
        # Not by errors that say nothing.
        assert np.median((judged.random / np.abs(judged.error))[kept]) < 2.0


def test_errors_are_told_without_touching_a_value_or_a_clear_case(monkeypatch):
    def both():
        found = [
            j
            for j, _ in draws.score_networks(0, 50)
            if j.failure.name in {"none, plume", "outliers"}
        ]
        return [np.concatenate([np.ravel(getattr(j, n)) for j in found]) for n in NAMES]

    NAMES = ("error", "random")
    error, stated = both()
    monkeypatch.setattr(_block_errors, "noise_bias_variance", lambda *_: 0.0)
    monkeypatch.setattr(_block_errors, "excluded_field_variance", lambda *_: 0.0)
    monkeypatch.setattr(_block_errors, "at_least_typical", lambda _, variance, *__: variance)
    plain_error, plain = both()
    np.testing.assert_array_equal(error, plain_error)
    known = np.isfinite(plain)
    assert np.all(stated[known] >= plain[known])
    assert np.median(stated[known] / plain[known]) < 1.1


@pytest.mark.parametrize("off", [1.0, 30.0, -30.0, 1e3])
def test_a_profile_that_is_far_off_moves_no_other(off):
    """A twentieth of what it was off by stood in the errors of all."""
    rng = np.random.default_rng(3)
    logarithm = -7.0 + rng.normal(0.0, 0.02, (50, 1))
    variance = np.full((50, 1), 0.02**2)
    logarithm[7] += off
    variance[7] *= 1e6
    assert _block_errors.noise_bias_variance(logarithm, variance, np.array([-7.0]))[0] == 0.0
    # Where many are off to one side, by little, all are told so.
    logarithm[:20] += 0.1
    told = _block_errors.noise_bias_variance(logarithm, variance, np.array([-7.0]))[0]
    assert 0.02**2 < told < 0.06**2


@pytest.mark.parametrize("factor", [1e4, 1e8])
def test_beams_that_contradict_each_other_in_a_profile_cost_the_others_nothing(factor):
    """The others stated up to 26 times their errors."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.003, 50, seed=4)
    heard = power.copy()
    heard[7, 0, 133:136] *= factor
    settings = {"variance": variance, "full_overlap_range": 100.0}
    clean, found = (retrieve_network(one, r, net, **settings) for one in (power, heard))
    others, near = np.arange(50) != 7, net.near_crossing
    ratio = found.extinction_standard_error / clean.extinction_standard_error
    np.testing.assert_allclose(ratio[others][:, near], 1.0, rtol=0.05)
    np.testing.assert_array_equal(found.flags.flagged[others], clean.flags.flagged[others])
