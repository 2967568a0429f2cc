"""The choice of smoothness: criteria against dense algebra, and rules."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.banded_matrices import dense

from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle._smoothing import (
    Scores,
    choose_smoothing,
    score_smoothing,
    weights_up_to,
)
from lidarops.retrieve.multiangle.altitude_correlation import correlated_precision

GRID = weights_up_to(np.inf, 1.0)
A_DECADE = 6
SCORED = 32
"""Of 64 profiles: every second."""
HEIGHTS = 25
ALTITUDE = 100.0 + 30.0 * np.arange(HEIGHTS)


def block(profiles, correlation, rng):
    information = rng.uniform(20.0, 80.0, (profiles, HEIGHTS))
    truth = 2e-4 * ALTITUDE + 0.05 * np.sin(ALTITUDE / 200.0)
    estimates = truth + rng.normal(size=(profiles, HEIGHTS)) / np.sqrt(information)
    bands = correlated_precision(information, np.ones((profiles, HEIGHTS - 1)), correlation)
    unit = information.mean() * ALTITUDE[-1] ** 3
    return bands, estimates, _smoothing.penalty(ALTITUDE), unit


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_likelihood_is_the_restricted_one_of_the_marginal_distribution(correlation):
    """Gaussian model: estimates are a straight line, an integrated random walk and noise."""
    bands, estimates, stiffness, unit = block(3, correlation, np.random.default_rng(0))
    likelihood = score_smoothing(bands, estimates, stiffness, GRID * unit).likelihood
    prior = np.linalg.pinv(dense(stiffness), rcond=1e-11, hermitian=True)
    line = ALTITUDE[:, np.newaxis]
    expected = np.zeros(GRID.size)
    for t in range(3):
        noise = np.linalg.inv(dense(bands[:, t]))
        for i, smoothing in enumerate(GRID):
            covariance = noise + prior / (smoothing * unit)
            inverse = np.linalg.inv(covariance)
            inner = line.T @ inverse @ line
            rest = inverse - inverse @ line @ np.linalg.inv(inner) @ line.T @ inverse
            expected[i] += (
                np.linalg.slogdet(covariance)[1]
                + np.linalg.slogdet(inner)[1]
                + estimates[t] @ rest @ estimates[t]
            )
    difference = likelihood - expected
    np.testing.assert_allclose(difference, difference.mean(), atol=1e-5)


def test_risk_estimates_the_true_error_without_bias():
    rng = np.random.default_rng(1)
    information = np.full((64, HEIGHTS), 50.0)
    truth = 0.05 * np.sin(ALTITUDE / 100.0)
    bands = correlated_precision(information, np.ones((64, HEIGHTS - 1)), 0.5)
    covariance = np.linalg.inv(dense(bands[:, 0]))
    stiffness, unit = _smoothing.penalty(ALTITUDE), 50.0 * ALTITUDE[-1] ** 3
    noise = rng.multivariate_normal(np.zeros(HEIGHTS), covariance, size=64)
    scored = score_smoothing(bands, truth + noise, stiffness, GRID * unit)
    weight = dense(bands[:, 0])
    for i in range(0, GRID.size, 6):
        smoother = np.linalg.inv(weight + GRID[i] * unit * dense(stiffness)) @ weight
        error = (truth + noise) @ smoother.T - truth
        loss = np.einsum("ti,ij,tj->", error, weight, error)
        expected = (loss + 64 * HEIGHTS) * SCORED / 64
        assert scored.risk[i] == pytest.approx(expected, rel=0.1)
        assert scored.freedom[i] == pytest.approx(np.trace(smoother), rel=1e-6)


@pytest.mark.parametrize(("profiles", "every"), [(130, 5), (32, 1)])
def test_long_block_is_scored_on_every_nth_profile(profiles, every):
    estimates = np.random.default_rng(3).normal(size=(profiles, HEIGHTS))
    nothing = np.zeros((profiles, HEIGHTS - 1))
    bands = correlated_precision(np.ones_like(estimates), nothing, 0.0)
    stiffness, weight = _smoothing.penalty(ALTITUDE), 1e8 * GRID
    chosen = np.ascontiguousarray(bands[:, ::every])
    thinned = score_smoothing(chosen, estimates[::every].copy(), stiffness, weight)
    whole = score_smoothing(bands, estimates, stiffness, weight)
    np.testing.assert_array_equal(whole.likelihood, thinned.likelihood)


def scores(likely, risky):
    """Return parabolas with minima at given indices, and degrees of freedom from 20 down to 1."""
    index = np.arange(GRID.size)
    freedom = np.geomspace(20.0, 1.0, GRID.size)
    return Scores(GRID, (index - likely) ** 2.0, (index - risky) ** 2.0, freedom)


def test_likelihood_decides_where_the_risk_agrees():
    assert choose_smoothing(scores(30, 29), one=True).weight == GRID[30]
    assert choose_smoothing(scores(30, 35), one=True).weight == GRID[30]


def test_risk_decides_where_it_gives_more_freedom_up_to_a_decade():
    assert choose_smoothing(scores(30, 25), one=True).weight == GRID[25]
    assert choose_smoothing(scores(30, 5), one=True).weight == GRID[30 - A_DECADE]


def test_at_least_two_degrees_of_freedom_are_left():
    straight = scores(66, 66)
    choice = choose_smoothing(straight, one=True)
    assert 2.0 <= straight.freedom[choice.weight == GRID] < 2.1


def test_the_largest_weight_is_one_of_those_to_choose_from():
    weights = weights_up_to(1.2 * GRID[15], 1.0)
    np.testing.assert_array_equal(weights, [*GRID[:16], 1.2 * GRID[15]])
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0), [1e-12])


def test_an_average_is_over_the_grid_alone():
    """The limit beside the last weight of the grid would count twice."""
    np.testing.assert_array_equal(weights_up_to(1.2 * GRID[15], 1.0, one=False), GRID[:16])
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0, one=False), GRID[:1])


def test_small_block_is_averaged_by_likelihood():
    choice = choose_smoothing(scores(30, 5), one=False)
    assert choice.share.sum() == pytest.approx(1.0)
    weight = np.exp(-0.5 * (np.arange(GRID.size) - 30.0) ** 2)
    where = np.searchsorted(GRID, choice.weight)
    expected = weight[where] / weight[where].sum()
    np.testing.assert_allclose(choice.share, expected, rtol=1e-12)
    assert weight[where].sum() / weight.sum() > 1.0 - 1e-4


def test_data_that_never_reach_two_degrees_of_freedom_are_smoothed_least():
    low = Scores(GRID, np.arange(GRID.size)[::-1] * 1.0, np.zeros(GRID.size), np.ones(GRID.size))
    assert choose_smoothing(low, one=True).weight == GRID[0]
