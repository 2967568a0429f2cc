"""The banded solution against dense algebra and arithmetic of 60 digits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each
from support.oracles.banded_matrices import dense

from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle.altitude_correlation import correlated_precision

STATION = 35.0


def systems(rng, profiles, heights, correlation=0.7, missing=0.2):
    """Return precision bands, estimates, penalty and weights of random profiles."""
    information = rng.uniform(1.0, 100.0, (heights, profiles))
    information[rng.random((heights, profiles)) < missing] = 0.0
    information[heights // 2] = 5.0
    estimates = np.where(information > 0.0, rng.normal(size=(heights, profiles)), 0.0)
    bands = correlated_precision(
        information, rng.uniform(0.3, 1.0, (heights - 1, profiles)), correlation
    )
    altitude = STATION + 120.0 + 30.0 * np.arange(heights)
    stiffness = _smoothing.penalty(altitude - STATION)
    return bands, estimates, stiffness, 10.0 ** rng.uniform(3.0, 8.0, profiles)


def solved(bands, estimates, stiffness, lam):
    """Return solution, diagonal and first off-diagonal of the inverse, (3, altitude, profile)."""
    factors = _smoothing.factor_bands(bands, stiffness, lam)
    right = _smoothing.multiply(bands, estimates)
    return np.stack([_smoothing.solve_bands(factors, right), *_smoothing.invert_bands(factors)])


@each("heights", [1, 2, 3, 7, 60])
@each("correlation", [0.0, 0.8])
def test_solution_and_inverse_equal_dense_algebra(heights, correlation):
    rng = np.random.default_rng(heights)
    bands, estimates, stiffness, lam = systems(rng, 19, heights, correlation)
    out = solved(bands, estimates, stiffness, lam)
    for t in range(19):
        weight = dense(bands[..., t])
        inverse = np.linalg.inv(weight + lam[t] * dense(stiffness))
        scale = np.abs(inverse).max()
        expected = inverse @ weight @ estimates[:, t]
        np.testing.assert_allclose(out[0, :, t], expected, rtol=1e-8, atol=1e-9)
        for step in range(min(2, heights)):
            off = np.diag(inverse, step)
            np.testing.assert_allclose(out[1 + step, : off.size, t], off, atol=1e-9 * scale)


def test_freedom_equals_dense_algebra():
    bands, _, stiffness, lam = systems(np.random.default_rng(1), 21, 33)
    freedom = _smoothing.freedom(bands[..., 3:4].copy(), stiffness, lam)
    weight = dense(bands[..., 3])
    expected = [np.trace(np.linalg.inv(weight + of * dense(stiffness)) @ weight) for of in lam]
    np.testing.assert_allclose(freedom, expected, rtol=1e-8)


@each("smoothing", [1e-10, 1e-3, 1.0])
@each("correlation", [0.0, 0.8])
def test_solution_keeps_8_digits_of_60(smoothing, correlation):
    heights = 200
    rng = np.random.default_rng(4)
    information = 10.0 ** rng.uniform(-4.0, 4.0, (heights, 1))
    # The same air everywhere, beside noise that differs.
    shared = 0.9 * np.sqrt(information[1:] * information[:-1]) / information.max()
    altitude = 150.0 + 30.0 * np.arange(heights)
    truth = 1e-4 * altitude
    estimates = (truth + rng.normal(size=heights) / np.sqrt(information[:, 0]))[:, np.newaxis]
    bands = correlated_precision(information, shared, correlation)
    stiffness = _smoothing.penalty(altitude)
    lam = np.array([smoothing * information.mean() * altitude[-1] ** 3])
    out = solved(bands, estimates, stiffness, lam)
    with mp.workdps(60):
        exact, inverse_last = _exact(bands[..., 0], stiffness, float(lam[0]), estimates[:, 0])
    assert np.abs(out[0, :, 0] - exact).max() <= 1e-8 * np.abs(exact).max()
    assert abs(out[1, -1, 0] / inverse_last - 1.0) <= 1e-8


def _exact(bands, stiffness, lam, estimates):
    """Return the solution and the last variance, computed by mpmath."""
    heights = estimates.size
    a = [[mp.mpf(float(b)) for b in row] for row in bands]
    k = [[mp.mpf(float(b)) for b in row] for row in stiffness]
    t = [mp.mpf(float(v)) for v in estimates]
    right = [
        a[0][i] * t[i]
        + (a[1][i] * t[i + 1] if i + 1 < heights else 0)
        + (a[1][i - 1] * t[i - 1] if i > 0 else 0)
        for i in range(heights)
    ]
    zero = [mp.mpf(0)] * heights
    a.append(zero)
    m = [[a[s][i] + mp.mpf(lam) * k[s][i] for i in range(heights)] for s in range(3)]
    pivot, near, far = [], [], []
    for i in range(heights):
        d = m[0][i]
        across = m[1][i]
        if i > 0:
            d -= near[i - 1] ** 2 * pivot[i - 1]
            across -= near[i - 1] * far[i - 1] * pivot[i - 1]
            right[i] -= near[i - 1] * right[i - 1]
        if i > 1:
            d -= far[i - 2] ** 2 * pivot[i - 2]
            right[i] -= far[i - 2] * right[i - 2]
        pivot.append(d)
        near.append(across / d)
        far.append(m[2][i] / d)
    x = [mp.mpf(0)] * (heights + 2)
    for i in range(heights - 1, -1, -1):
        x[i] = right[i] / pivot[i] - near[i] * x[i + 1] - far[i] * x[i + 2]
    return np.array([float(v) for v in x[:heights]]), float(1 / pivot[-1])


def test_penalty_is_the_integral_of_the_squared_slope_of_extinction():
    altitude = STATION + np.array([120.0, 150.0, 180.0, 240.0, 250.0])
    rng = np.random.default_rng(0)
    depth = rng.normal(size=5)
    levels = np.concatenate([[STATION], altitude])
    extinction = np.diff(np.concatenate([[0.0], depth])) / np.diff(levels)
    middle = 0.5 * (levels[1:] + levels[:-1])
    expected = (np.diff(extinction) ** 2 / np.diff(middle)).sum()
    stiffness = dense(_smoothing.penalty(altitude - STATION))
    assert depth @ stiffness @ depth == pytest.approx(expected, rel=1e-12)
    constant = altitude - STATION
    assert np.abs(stiffness @ constant).max() < 1e-12 * np.abs(stiffness).max() * constant.max()


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 40))
@settings(max_examples=25, deadline=None)
def test_systems_are_independent_of_each_other(seed, count):
    rng = np.random.default_rng(seed)
    bands, estimates, stiffness, lam = systems(rng, count, 12)
    together = solved(bands, estimates, stiffness, lam)
    chosen = int(rng.integers(count))
    alone = solved(
        np.ascontiguousarray(bands[..., chosen : chosen + 1]),
        np.ascontiguousarray(estimates[:, chosen : chosen + 1]),
        stiffness,
        lam[chosen : chosen + 1],
    )
    np.testing.assert_array_equal(alone[..., 0], together[..., chosen])


@pytest.mark.parametrize("missing", [(), (3,), (3, 4), (0, 9)])
def test_precision_is_the_inverse_of_the_covariance_of_an_autoregressive_process(missing):
    information = np.full((10, 1), 5.0)
    information[list(missing)] = 0.0
    bands = correlated_precision(information, np.ones((9, 1)), 0.6)
    known = np.flatnonzero(information)
    apart = np.abs(np.subtract.outer(known, known))
    # A gap separates the altitudes below it from those above.
    if 3 in missing:
        apart = np.where((known[:, None] < 3) == (known < 3), apart, 99)
    decay = np.where(apart < 99, 0.6**apart, 0.0)
    error = 1.0 / np.sqrt(information[known, 0])
    covariance = decay * np.outer(error, error)
    precision = dense(bands[..., 0])[np.ix_(known, known)]
    np.testing.assert_allclose(precision @ covariance, np.eye(known.size), atol=1e-12)
