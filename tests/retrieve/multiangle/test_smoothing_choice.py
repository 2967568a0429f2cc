"""The choice of smoothness: criteria against dense algebra, and rules."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from support.oracles import angle_scenes
from support.oracles.angle_scenes import clear, cloud
from support.oracles.banded_matrices import dense

from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle._smoothing import (
    choose_smoothing,
    freedom,
    score_smoothing,
    stiffest,
    weights_up_to,
)
from lidarops.retrieve.multiangle.altitude_correlation import correlated_precision
from lidarops.retrieve.multiangle.smooth_profile import smooth_optical_depth

GRID = weights_up_to(10.0, 1.0)
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
    likelihood, _ = score_smoothing(bands, estimates, bands[..., :1].copy(), stiffness, GRID * unit)
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
    _, risk = score_smoothing(bands, estimates.T.copy(), typical, stiffness, GRID * unit)
    left = freedom(typical, stiffness, GRID * unit)
    weight = dense(bands[..., 0])
    for i in range(0, GRID.size, 6):
        smoother = np.linalg.inv(weight + GRID[i] * unit * dense(stiffness)) @ weight
        error = estimates @ smoother.T - truth
        loss = np.einsum("ti,ij,tj->", error, weight, error)
        assert risk[i] == pytest.approx(loss + 64 * HEIGHTS, rel=0.1)
        assert left[i] == pytest.approx(np.trace(smoother), rel=1e-6)


INDEX = np.arange(GRID.size)


@pytest.mark.parametrize("last", [25, 40, 66])
def test_weights_are_averaged_by_likelihood_and_risk(last):
    weight = GRID[: last + 1]
    likelihood, risk = (INDEX - 30.0) ** 2, 0.5 * (INDEX - 10.0) ** 2
    weights, share = choose_smoothing(weight, likelihood[: last + 1], risk[: last + 1])
    expected = np.exp(-0.5 * (likelihood + risk)[: last + 1])
    expected[-1] /= 2.0
    where = np.searchsorted(weight, weights)
    np.testing.assert_array_equal(weight[where], weights)
    np.testing.assert_allclose(share, expected[where] / expected[where].sum(), rtol=1e-12)
    assert expected[where].sum() / expected.sum() > 1.0 - 1e-4


def test_weights_rise_in_equal_ratios_to_the_largest_one():
    weights = weights_up_to(1.2 * GRID[15], 1.0)
    assert weights[-1] == 1.2 * GRID[15]
    np.testing.assert_allclose(weights, 1.2 * GRID[:16], rtol=1e-12)
    np.testing.assert_array_equal(weights_up_to(1e-12, 1.0), [1e-12])


def test_the_stiffest_weight_leaves_two_degrees_of_freedom():
    bands, _, stiffness, unit = block(1, 0.3, np.random.default_rng(2))
    weight = stiffest(bands, stiffness, unit)
    assert freedom(bands, stiffness, np.array([weight])) == pytest.approx(2.0, abs=0.02)


def test_data_that_never_reach_two_degrees_of_freedom_are_smoothed_least():
    bands, _, stiffness, unit = block(1, 0.0, np.random.default_rng(2))
    assert stiffest(bands[:, :1], stiffness[:, :1], unit) == pytest.approx(GRID[0] * unit)


# A path between two draws of noise -----------------------------------------------------------

STEP = 6e-9
"""Shortest step along the path: far above the digits of values, and far below their errors."""
VALUES, ERRORS = 0.2, 0.2
"""Largest change of a value, in its error, and of the logarithm of an error."""


def solutions_between(scene, correlation, seed):
    """Return a function that solves 12 cycles at a place between two draws of their noise."""
    rng = np.random.default_rng(seed)
    first, second = (angle_scenes.estimates(scene, 12, rng, correlation) for _ in range(2))

    def solve(place):
        mixed = (1.0 - place) * first.optical_depth + place * second.optical_depth
        result = smooth_optical_depth(mixed, first.information, scene.altitude, noise=first.noise)
        return (
            (result.optical_depth, result.optical_depth_standard_error),
            (result.extinction, result.extinction_standard_error),
        )

    return solve


def jump(one, other):
    """Return the largest differences of values in errors, and of the logarithm of errors."""
    values = [np.abs(a - b) / np.fmin(e, f) for (a, e), (b, f) in zip(one, other, strict=True)]
    errors = [np.abs(np.log(e / f)) for (_, e), (_, f) in zip(one, other, strict=True)]
    return max(map(np.nanmax, values)), max(map(np.nanmax, errors))


@pytest.mark.parametrize(
    ("scene", "correlation", "seed"),
    [
        (cloud(), 0.8, 0),
        (cloud(), 0.0, 1),
        (cloud(largest=15.0), 0.8, 1),
        (clear(3000.0), 0.7, 0),
    ],
)
def test_a_hair_of_noise_changes_values_and_errors_by_little(scene, correlation, seed):
    """One weight, by the least of criteria with two minima, jumps up to 0.8 errors in clouds."""
    solve = solutions_between(scene, correlation, seed)
    places = np.linspace(0.0, 1.0, 41)
    solved = [solve(place) for place in places]
    at = int(np.argmax([sum(jump(*pair)) for pair in itertools.pairwise(solved)]))
    (low, high), (below, above) = places[at : at + 2], solved[at : at + 2]
    while high - low > STEP:
        middle = 0.5 * (low + high)
        between = solve(middle)
        if sum(jump(below, between)) > sum(jump(between, above)):
            high, above = middle, between
        else:
            low, below = middle, between
    values, errors = jump(below, above)
    assert values < VALUES
    assert errors < ERRORS
