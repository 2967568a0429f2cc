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


INDEX = np.arange(GRID.size)
FREEDOM = np.geomspace(20.0, 1.0, GRID.size)
FEWEST = float(np.interp(-2.0, -FREEDOM, INDEX))
"""Place of the weight that leaves two degrees of freedom."""


def chosen(likely, risky, freedom=FREEDOM, *, one=True):
    """Return the choice from parabolas with minima at given places."""
    scores = Scores(GRID, (INDEX - likely) ** 2.0, (INDEX - risky) ** 2.0, freedom)
    return choose_smoothing(scores, one=one)


def place_of(choice):
    """Return the place on the grid of the one weight that is chosen."""
    (weight,), share = choice
    np.testing.assert_array_equal(share, [1.0])
    return float(np.interp(np.log(weight), np.log(GRID), INDEX))


def test_likelihood_and_risk_together_decide():
    for likely, risky in ((30, 30), (30, 20), (20, 30), (30, 21)):
        middle = 0.5 * (likely + risky)
        assert place_of(chosen(likely, risky)) == pytest.approx(middle, abs=1e-6)


@pytest.mark.parametrize("tilt", [-0.1, 0.0, 0.1])
def test_one_weight_is_the_mean_of_two_that_are_as_good(tilt):
    risk = np.full(GRID.size, 200.0)
    risk[20], risk[26] = -tilt, tilt
    scores = Scores(GRID, np.zeros(GRID.size), risk, FREEDOM)
    assert place_of(choose_smoothing(scores, one=True)) == pytest.approx(
        23.0 - 1.5 * tilt, rel=0.01
    )


@pytest.mark.parametrize("one", [False, True])
def test_two_degrees_of_freedom_are_left_within_half_a_step(one):
    weights, _ = chosen(66, 66, one=one)
    assert abs(np.interp(np.log(weights[-1]), np.log(GRID), INDEX) - FEWEST) < 0.5


@pytest.mark.parametrize("one", [False, True])
def test_the_choice_moves_with_the_limit_of_freedom_and_never_jumps(one):
    def mean(factor):
        weight, share = chosen(52, 52, factor * FREEDOM, one=one)
        return share @ np.log(weight)

    # Over two steps of the grid.
    moved = np.diff([mean(factor) for factor in np.linspace(1.0, 1.1, 200)])
    assert np.all(moved > 0.0)
    assert moved.max() < 0.02 * np.log(10.0)


def test_weights_rise_in_equal_ratios_to_the_largest_one():
    weights = weights_up_to(1.2 * GRID[15], 1.0)
    assert weights[-1] == 1.2 * GRID[15]
    np.testing.assert_allclose(weights, 1.2 * GRID[:16], rtol=1e-12)
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0), [1e-12])


def test_small_block_is_averaged_by_likelihood():
    weights, share = chosen(30, 5, one=False)
    assert share.sum() == pytest.approx(1.0)
    weight = np.exp(-0.5 * (INDEX - 30.0) ** 2)
    where = np.searchsorted(GRID, weights)
    expected = weight[where] / weight[where].sum()
    np.testing.assert_allclose(share, expected, rtol=1e-12)
    assert weight[where].sum() / weight.sum() > 1.0 - 1e-4


def test_data_that_never_reach_two_degrees_of_freedom_are_smoothed_least():
    assert place_of(chosen(66, 66, np.geomspace(1.9, 1.0, GRID.size))) == 0.0
