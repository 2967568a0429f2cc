"""Errors of single profiles of a network that only their block shows."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    gradient,
    grid,
    homogeneous,
    noisy,
    plume,
    signals,
    three_by_two,
    with_noise,
)

from lidarops.retrieve.network import _block_errors
from lidarops.retrieve.network._empirical_prior import Prior
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.thresholds import THRESHOLDS

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


def positions(crossings, axes=3):
    position = np.random.default_rng(1).normal(0.0, 200.0, (crossings, axes))
    return np.pad(position, ((0, 0), (0, 3 - axes)))


@pytest.mark.parametrize("axes", [2, 3])
def test_bent_fields_have_no_level_and_no_gradient(axes):
    position = positions(14, axes)
    fields = _block_errors.bent_fields(position)
    linear = np.column_stack([np.ones(14), position])
    np.testing.assert_allclose(fields @ linear, 0.0, atol=1e-9)
    assert np.sum(fields**2) / 14 == pytest.approx(THRESHOLDS.bend**2)
    # Every quadratic field is a sum of them and a linear field.
    quadratic = (position[:, 0] - 0.3 * position[:, 1] + 20.0) ** 2 / 1e4
    design = np.column_stack([linear, fields.T])
    fitted, *_ = np.linalg.lstsq(design, quadratic, rcond=None)
    np.testing.assert_allclose(design @ fitted, quadratic, atol=1e-9)


@pytest.mark.parametrize("crossings", [1, 2, 3])
def test_few_crossings_in_a_plane_have_no_bent_fields(crossings):
    np.testing.assert_array_equal(_block_errors.bent_fields(positions(crossings, 2)), 0.0)


def test_fields_beside_the_prior_count_only_as_far_as_the_mean_allows():
    """The doubt in the prior once counted in full, however well the mean shows the field."""
    position = positions(14)
    gap, variance, share = np.zeros(14), np.zeros(14), np.full(14, 0.1**2)
    gap[1], variance[2:4], variance[4], share[5], variance[5] = 0.05, 1e-4, np.nan, 0.0, 1.0
    # A profile unlike the others changes no gap.
    logarithm = np.tile(gap, (3, 1))
    logarithm[2] += 5.0
    block = SimpleNamespace(
        profiles=SimpleNamespace(
            prior=Prior(0.1), prior_response=np.eye(14)[np.newaxis],
            prior_share=share[np.newaxis], logarithm=logarithm,
        ),
        free_mean=SimpleNamespace(logarithm=np.zeros((1, 14)), variance=variance[np.newaxis]),
    )  # fmt: skip
    result = _block_errors.field_variance(block, position)[0]
    bends = (_block_errors.bent_fields(position) ** 2).sum(axis=0)
    weakest = (THRESHOLDS.strengths[-1] * 0.1) ** 2
    expected = [0.0, 0.05**2, 1e-4, 1e-4, weakest + bends[4], bends[5]]
    np.testing.assert_allclose(result[:6], expected)


def test_a_profile_with_high_values_has_at_least_the_error_of_its_block():
    extinction = np.array([[1.0, 1.0], [1.1, 1.1], [4.0, 4.0], [np.nan, 1.0]]) * 1e-4
    relative = np.array([[0.4, 0.04], [0.5, 0.05], [0.1, 0.01], [np.nan, 0.04]])
    variance = (relative * extinction) ** 2
    result = _block_errors.at_least_typical(extinction, variance, np.ones((4, 3), dtype=bool))
    np.testing.assert_allclose(np.sqrt(result[:3, 0]), [4e-5, 5.5e-5, 4e-5])
    # Small errors do not change.
    np.testing.assert_array_equal(result[:, 1], variance[:, 1])
    assert np.isnan(result[3, 0])


def test_a_profile_is_compared_with_profiles_of_at_least_its_passages():
    extinction = np.full((6, 1), 1e-4)
    variance = (np.array([[0.2], [0.3], [0.8], [0.9], [0.1], [0.7]]) * 1e-4) ** 2
    # All beams (twice), one beam missing (4 times).
    usable = np.array([[1, 1, 1]] * 2 + [[1, 1, 0]] * 3 + [[0, 1, 1]], dtype=bool)
    result = _block_errors.at_least_typical(extinction, variance, usable)
    typical = np.sqrt((0.2**2 + 0.3**2) / 2.0)
    # The last but one has high values and gets the error of those with at least its beams.
    expected = [typical, 0.3, 0.8, 0.9, 0.3, 0.7]
    np.testing.assert_allclose(np.sqrt(result[:, 0]), np.array(expected) * 1e-4)


# Networks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", [homogeneous(), gradient, plume])
def test_stated_errors_are_not_generous_where_a_block_shows_the_field(field):
    """Their errors were once 0.60 to 0.70 of the stated ones, and 99.4 to 99.8 percent covered."""
    net = three_by_two()
    near, truth = net.near_crossing, at_crossings(net, field)
    result = with_noise(net, field, 0.05, 500)
    ratio = ((result.extinction - truth) / result.extinction_standard_error)[:, near]
    kept = ~result.flagged[:, near]
    assert kept.mean() > 0.98
    ratio = ratio[kept]
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.1
    assert 0.94 < np.mean(np.abs(ratio) < 1.96) < 0.985


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
    monkeypatch.setattr(_block_errors, "at_least_typical", lambda _, variance, *__: variance)
    value_without, stated_without = solve_all()
    np.testing.assert_array_equal(value, value_without)
    known = np.isfinite(stated_without)
    assert np.all(stated[known] >= stated_without[known])
    monkeypatch.setattr(_block_errors, "bent_fields", lambda at: np.zeros((1, len(at))))
    value_without, stated_without = solve_all()
    np.testing.assert_array_equal(value, value_without)
    # Their limit is that of the median profile, so that without them some profiles have more.
    assert 0.99 < np.median(stated[known] / stated_without[known]) < 1.1


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
    np.testing.assert_array_equal(result.flagged[others], clean.flagged[others])
