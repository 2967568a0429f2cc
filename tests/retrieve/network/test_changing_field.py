"""A field that changes slowly: its priors and its solution, against dense normal equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import _changing_field
from lidarops.retrieve.network._changing_field import (
    Change,
    change_roots,
    field_precision,
    solve_changing,
)
from lidarops.retrieve.network.thresholds import THRESHOLDS

POSITION = np.array([[0.0, 0.0, 300.0], [200.0, 0.0, 500.0], [-100.0, 0.0, 900.0]])

# The mean field -----------------------------------------------------------------------------------


def test_the_prior_says_nothing_about_the_level():
    precision = field_precision(POSITION)
    np.testing.assert_allclose(precision.sum(axis=-1), 0.0, atol=1e-9)
    apart = np.linalg.norm(POSITION[0] - POSITION[1])
    (layers, depth), (volumes, length) = THRESHOLDS.stratified, THRESHOLDS.volumes
    contrast = np.array([1.0, -1.0, 0.0])
    # Differences have the variance of the covariance: its inverse on the space of differences.
    expected = layers**2 * (1.0 - np.exp(-0.5 * (200.0 / depth) ** 2))
    expected += volumes**2 * (1.0 - np.exp(-apart / length)) + THRESHOLDS.least_deviation**2
    found = contrast @ np.linalg.pinv(precision) @ contrast
    np.testing.assert_allclose(found, 2.0 * expected, rtol=1e-6)


def test_crossings_at_one_place_have_a_prior():
    precision = field_precision(POSITION[[0, 0, 1]])
    assert np.isfinite(precision).all()
    assert precision[0, 0] > 100.0


def changed(size, length, rho):
    """Return a change of a size, with one of the lengths."""
    return Change(size * change_roots(POSITION)[length], rho)


def test_the_roots_are_those_of_the_correlations():
    roots = change_roots(POSITION)
    expected = _changing_field.correlations(POSITION, THRESHOLDS.lengths)
    np.testing.assert_allclose(roots @ roots.swapaxes(1, 2), expected, atol=1e-12)


# Changes ------------------------------------------------------------------------------------------


def informed(rng, profiles, *, missing=0):
    """Return normal matrices and right sides of profiles, some of which know nothing."""
    root = rng.standard_normal((profiles, 3, 4))
    normal = np.exp(rng.uniform(-1.0, 5.0)) * root @ root.swapaxes(1, 2)
    normal[rng.permutation(profiles)[:missing]] = 0.0
    return normal, (normal @ rng.standard_normal((profiles, 3, 1)))[..., 0]


def dense(normal, side, prior, change, pull):
    """Return fields and covariances from the normal equations of all profiles and their mean."""
    profiles, size = normal.shape[:2]
    place = np.arange(profiles)
    in_time = change.correlation ** np.abs(place[:, None] - place)
    total = np.zeros(((profiles + 1) * size,) * 2)
    covariance = change.root @ change.root.T
    total[size:, size:] = np.linalg.inv(np.kron(in_time, covariance))
    total[:size, :size] = prior + THRESHOLDS.weak_precision * np.eye(size)
    right = np.concatenate([pull, np.zeros(profiles * size)])
    take = np.zeros((profiles, size, len(total)))
    for t in range(profiles):
        take[t, :, :size] = np.eye(size)
        take[t, :, (t + 1) * size : (t + 2) * size] = np.eye(size)
        total += take[t].T @ normal[t] @ take[t]
        right += take[t].T @ side[t]
    covariance = np.linalg.inv(total)
    return take @ covariance @ right, take @ covariance @ take.swapaxes(1, 2)


@given(
    st.integers(0, 10_000), st.integers(2, 9), st.sampled_from(THRESHOLDS.correlations),
    st.sampled_from(THRESHOLDS.changes), st.integers(0, 8),
)  # fmt: skip
@settings(deadline=None, max_examples=60)
def test_a_changing_field_agrees_with_dense_normal_equations(seed, profiles, rho, size, missing):
    rng = np.random.default_rng(seed)
    normal, side = informed(rng, profiles, missing=min(missing, profiles - 1))
    prior = field_precision(POSITION)
    change = changed(size, int(rng.integers(3)), rho)
    pull = rng.standard_normal(3)
    field, covariance = solve_changing(normal, side[..., None], prior, change, pull[:, None])
    expected, spread = dense(normal, side, prior, change, pull)
    error = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    assert np.all(np.abs(field[..., 0] - expected) < 1e-4 * error + 1e-9 * np.abs(expected))
    np.testing.assert_allclose(covariance, spread, rtol=1e-4, atol=1e-6 * spread.max())


@pytest.mark.parametrize("gap", [1, 20])
def test_a_gap_in_time_loosens_the_field(gap):
    """Profiles that know nothing stand for time: what is before them says less of what follows."""
    change = Change(0.3 * np.eye(1), 0.95)
    normal = np.zeros((gap + 1, 1, 1))
    normal[0] = 1e6
    prior = np.full((1, 1), 1e6)
    field, covariance = solve_changing(normal, 1e5 * (normal > 0.0), prior, change)
    # The mean is 0 by its prior, and the first profile is known.
    assert field[-1, 0, 0] == pytest.approx(field[0, 0, 0] * 0.95**gap, rel=1e-3)
    assert covariance[-1, 0, 0] == pytest.approx(0.3**2 * (1.0 - 0.95 ** (2 * gap)), rel=1e-3)


def marginal(normal, side, change, places):
    """Return -2 ln likelihood of right sides about their mean, over that without a change."""
    profiles, size = side.shape
    place = np.array(places)
    in_time = change.correlation ** np.abs(place[:, None] - place)
    centre = np.eye(profiles) - 1.0 / profiles
    # Right sides are N d + noise of the covariance N; their mean is taken out of both.
    noise = np.kron(centre, normal)
    signal = np.kron(centre @ in_time @ centre, normal @ change.root @ change.root.T @ normal)

    def cost(covariance):
        return -2.0 * multivariate_normal(cov=covariance, allow_singular=True).logpdf(side.ravel())

    assert side.shape == (profiles, size)
    return cost(noise + signal) - cost(noise)


@pytest.mark.parametrize("seed", range(6))
def test_the_change_is_the_largest_of_the_likeliest_by_dense_likelihoods(seed):
    rng = np.random.default_rng(seed)
    places = tuple(int(n) for n in np.sort(rng.permutation(30)[:16]))
    root = rng.standard_normal((3, 5))
    normal = 300.0 * root @ root.T
    true = changed(0.18, seed % 3, 0.95)
    in_time = true.correlation ** np.abs(np.subtract.outer(places, places))
    deviation = np.linalg.cholesky(in_time) @ rng.standard_normal((16, 3))
    deviation = deviation @ true.root.T
    noise = rng.standard_normal((16, 3)) @ np.linalg.cholesky(normal).T
    side = deviation @ normal + noise
    side = side - side.mean(axis=0)
    found = _changing_field.likeliest_change(normal, side, change_roots(POSITION), places)
    assert found is not None
    costs = {
        (n, size, rho): marginal(normal, side, changed(size, n, rho), places)
        for n in range(len(THRESHOLDS.lengths))
        for size in THRESHOLDS.changes
        for rho in THRESHOLDS.correlations
    }
    least = min(costs.values())
    assert least < -(COMMON.significant**2)
    # Of the changes that are about as likely, the largest, and of these the likeliest.
    likely = {key: cost for key, cost in costs.items() if cost <= least + COMMON.significant**2}
    size = max(key[1] for key in likely)
    best = min(cost for key, cost in likely.items() if key[1] == size)
    assert marginal(normal, side, found, places) == pytest.approx(best, abs=1e-3)


def test_noise_alone_is_no_change():
    rng = np.random.default_rng(4)
    normal = np.diag([100.0, 300.0, 50.0])
    found = 0
    for _ in range(200):
        side = rng.standard_normal((30, 3)) @ np.sqrt(normal)
        side = side - side.mean(axis=0)
        change = _changing_field.likeliest_change(
            normal, side, change_roots(POSITION), tuple(range(30))
        )
        found += change is not None
    assert found <= 2


@pytest.mark.slow
def test_the_field_does_not_depend_on_the_direction_of_time():
    rng = np.random.default_rng(7)
    normal, side = informed(rng, 12, missing=3)
    change = changed(0.1, 1, 0.95)
    prior = field_precision(POSITION)
    forward, spread = solve_changing(normal, side[..., None], prior, change)
    backward, other = solve_changing(normal[::-1], side[::-1, :, None], prior, change)
    np.testing.assert_allclose(backward[::-1], forward, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other[::-1], spread, rtol=1e-6)
