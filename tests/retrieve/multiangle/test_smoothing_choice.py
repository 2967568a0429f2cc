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
HEIGHTS = 25
ALTITUDE = 100.0 + 30.0 * np.arange(HEIGHTS)


def block(profiles, correlation, rng):
    information = rng.uniform(20.0, 80.0, (HEIGHTS, profiles))
    truth = (2e-4 * ALTITUDE + 0.05 * np.sin(ALTITUDE / 200.0))[:, np.newaxis]
    estimates = truth + rng.normal(size=(HEIGHTS, profiles)) / np.sqrt(information)
    bands = correlated_precision(information, np.ones((HEIGHTS - 1, profiles)), correlation)
    unit = information.mean() * ALTITUDE[-1] ** 3
    return bands, estimates, _smoothing.penalty(ALTITUDE), unit


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_likelihood_is_the_restricted_one_of_the_marginal_distribution(correlation):
    """Gaussian model: estimates are a straight line, an integrated random walk and noise."""
    bands, estimates, stiffness, unit = block(3, correlation, np.random.default_rng(0))
    likelihood = score_smoothing(
        bands, estimates, bands[..., :1].copy(), stiffness, GRID * unit
    ).likelihood
    prior = np.linalg.pinv(dense(stiffness), rcond=1e-11, hermitian=True)
    line = ALTITUDE[:, np.newaxis]
    expected = np.zeros(GRID.size)
    for t in range(3):
        noise = np.linalg.inv(dense(bands[..., t]))
        for i, smoothing in enumerate(GRID):
            covariance = noise + prior / (smoothing * unit)
            inverse = np.linalg.inv(covariance)
            inner = line.T @ inverse @ line
            rest = inverse - inverse @ line @ np.linalg.inv(inner) @ line.T @ inverse
            expected[i] += (
                np.linalg.slogdet(covariance)[1]
                + np.linalg.slogdet(inner)[1]
                + estimates[:, t] @ rest @ estimates[:, t]
            )
    difference = likelihood - expected
    np.testing.assert_allclose(difference, difference.mean(), atol=1e-5)


def test_risk_estimates_the_true_error_without_bias():
    rng = np.random.default_rng(1)
    information = np.full((HEIGHTS, 64), 50.0)
    truth = 0.05 * np.sin(ALTITUDE / 100.0)
    bands = correlated_precision(information, np.ones((HEIGHTS - 1, 64)), 0.5)
    covariance = np.linalg.inv(dense(bands[..., 0]))
    stiffness, unit = _smoothing.penalty(ALTITUDE), 50.0 * ALTITUDE[-1] ** 3
    estimates = truth + rng.multivariate_normal(np.zeros(HEIGHTS), covariance, size=64)
    typical = bands[..., :1].copy()
    scored = score_smoothing(bands, estimates.T.copy(), typical, stiffness, GRID * unit)
    weight = dense(bands[..., 0])
    for i in range(0, GRID.size, 6):
        smoother = np.linalg.inv(weight + GRID[i] * unit * dense(stiffness)) @ weight
        error = estimates @ smoother.T - truth
        loss = np.einsum("ti,ij,tj->", error, weight, error)
        assert scored.risk[i] == pytest.approx(loss + 64 * HEIGHTS, rel=0.1)
        assert scored.freedom[i] == pytest.approx(np.trace(smoother), rel=1e-6)


FREEDOM = np.geomspace(20.0, 1.0, GRID.size)


def chosen(likely, risky, freedom=FREEDOM, *, one=True):
    """Return the choice from parabolas with minima at given indices."""
    index = np.arange(GRID.size)
    scores = Scores(GRID, (index - likely) ** 2.0, (index - risky) ** 2.0, freedom)
    return choose_smoothing(scores, one=one)


def test_likelihood_decides_where_the_risk_agrees():
    assert chosen(30, 29)[0] == GRID[30]
    assert chosen(30, 35)[0] == GRID[30]


def test_risk_decides_where_it_gives_more_freedom_up_to_a_decade():
    assert chosen(30, 25)[0] == GRID[25]
    assert chosen(30, 5)[0] == GRID[30 - A_DECADE]


def test_at_least_two_degrees_of_freedom_are_left():
    weight, _ = chosen(66, 66)
    assert 2.0 <= FREEDOM[weight == GRID] < 2.1


def test_the_largest_weight_is_one_of_those_to_choose_from():
    weights = weights_up_to(1.2 * GRID[15], 1.0)
    np.testing.assert_array_equal(weights, [*GRID[:16], 1.2 * GRID[15]])
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0), [1e-12])


def test_an_average_is_over_the_grid_alone():
    """The limit beside the last weight of the grid would count twice."""
    np.testing.assert_array_equal(weights_up_to(1.2 * GRID[15], 1.0, one=False), GRID[:16])
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0, one=False), GRID[:1])


def test_small_block_is_averaged_by_likelihood():
    weights, share = chosen(30, 5, one=False)
    assert share.sum() == pytest.approx(1.0)
    weight = np.exp(-0.5 * (np.arange(GRID.size) - 30.0) ** 2)
    where = np.searchsorted(GRID, weights)
    expected = weight[where] / weight[where].sum()
    np.testing.assert_allclose(share, expected, rtol=1e-12)
    assert weight[where].sum() / weight.sum() > 1.0 - 1e-4


def test_data_that_never_reach_two_degrees_of_freedom_are_smoothed_least():
    assert chosen(66, 66, np.ones(GRID.size))[0] == GRID[0]
