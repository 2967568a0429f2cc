"""The calibration of standard errors against dense algebra and known smoothing errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from support.cases import each
from support.oracles.banded_matrices import dense

from lidarops.retrieve.multiangle import _calibration, _smoothing
from lidarops.retrieve.multiangle.altitude_correlation import correlated_precision
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

HEIGHTS = 30
ROWS = np.arange(HEIGHTS)


@dataclass
class Typical:
    """A profile and its systems."""

    information: np.ndarray
    shared: np.ndarray
    correlation: float
    smoothing: float = 1e7

    def __post_init__(self):
        both = self.information[:, np.newaxis], self.shared[:, np.newaxis]
        self.stiffness = _smoothing.penalty(30.0 * np.arange(1, HEIGHTS + 1))
        bands = correlated_precision(*both, self.correlation)
        self.bands = bands[..., 0]
        self.sandwich = _calibration.Sandwich.of(
            both, bands, self.correlation, self.stiffness, self.smoothing
        )


def typical(correlation=0.6):
    rng = np.random.default_rng(3)
    information = rng.uniform(20.0, 80.0, HEIGHTS)
    information[7] = 0.0
    return Typical(information, rng.uniform(0.2, 1.0, HEIGHTS - 1), correlation)


def air_and_noise_covariances(c):
    there = c.information > 0.0
    error = np.sqrt(np.divide(1.0, c.information, where=there, out=np.zeros(there.size)))
    apart = np.abs(np.subtract.outer(np.arange(there.size), np.arange(there.size)))
    ends = np.concatenate([c.shared[:1], c.shared, c.shared[-1:]])
    share = 0.5 * (ends[1:] + ends[:-1])
    both = np.outer(np.sqrt(share) * error, np.sqrt(share) * error)
    return both * c.correlation**apart, np.diag((1.0 - share) * error**2)


@each("correlation", [0.0, 0.6])
@each("lower", [np.full(HEIGHTS, -1), ROWS - 1, np.maximum(ROWS - 5, -1)])
def test_sandwich_equals_dense_algebra(correlation, lower):
    c = typical(correlation)
    components = c.sandwich.parts(ROWS, lower)
    air, noise = air_and_noise_covariances(c)
    weight, covariance = dense(c.bands), air + noise
    inverse = np.linalg.inv(weight + c.smoothing * dense(c.stiffness))
    pilot = np.linalg.inv(weight + THRESHOLDS.pilot * c.smoothing * dense(c.stiffness))
    for k in ROWS:
        a = np.eye(HEIGHTS)[k] - (np.eye(HEIGHTS)[lower[k]] if lower[k] >= 0 else 0.0)
        x = weight @ inverse @ a
        y = weight @ pilot @ (a - x)
        model = a @ inverse @ a - (inverse @ a) @ weight @ (inverse @ a)
        expected = (a @ inverse @ a, x @ covariance @ x, model, y @ covariance @ y, x @ air @ x)
        np.testing.assert_allclose(components[:, k], expected, rtol=1e-7)


def test_pilot_variance_is_that_of_simulated_noise():
    c = typical()
    rng = np.random.default_rng(0)
    covariance = np.add(*air_and_noise_covariances(c))
    noise = rng.multivariate_normal(np.zeros(HEIGHTS), covariance, size=4000)
    weight = dense(c.bands)
    smoother = np.linalg.solve(weight + c.smoothing * dense(c.stiffness), weight)
    rough = np.linalg.solve(weight + THRESHOLDS.pilot * c.smoothing * dense(c.stiffness), weight)
    bias = noise @ (rough - smoother @ rough).T
    components = c.sandwich.parts(ROWS, np.full(HEIGHTS, -1))
    np.testing.assert_allclose(bias.var(axis=0), components[3], rtol=0.1)
    spread = (noise @ smoother.T).var(axis=0)
    np.testing.assert_allclose(spread, components[1], rtol=0.1)


def observed(shared, own, profiles, model=1.0, noise=4.0):
    """Return the estimated square of the smoothing error at 400 equal altitudes."""
    rng = np.random.default_rng(7)
    shape = (profiles, 400)
    bias = shared + own * rng.normal(size=shape) + np.sqrt(noise) * rng.normal(size=shape)
    known = np.array([2.0, 1.0, model, noise, 0.5])[:, np.newaxis] * np.ones((5, 400))
    return _calibration._smoothing_square(bias, known)


def test_common_smoothing_error_is_detected_below_the_noise_of_a_profile():
    assert np.sqrt(np.mean(observed(1.5, 0.0, 300))) == pytest.approx(1.5, rel=0.1)
    assert np.percentile(observed(1.5, 0.0, 300), 1) > 1.0


def test_smoothing_error_of_single_profiles_is_detected():
    assert np.mean(observed(0.0, 1.5, 300)) == pytest.approx(1.5**2, rel=0.15)


def test_few_profiles_leave_the_square_of_the_model():
    assert np.median(observed(0.0, 0.0, 8)) == pytest.approx(1.0, rel=0.3)
    assert np.mean(observed(0.0, 0.0, 3000)) < 0.25


# In proportion to the optical depth ------------------------------------------------------------


def hazes(amounts, heights=20):
    """Return optical depths of one shape, with small variances, within reach everywhere."""
    depth = np.outer(amounts, np.linspace(0.01, 0.2, heights))
    return depth, np.full(depth.shape, 1e-12), np.ones(depth.shape, dtype=np.bool_)


def test_smoothing_error_scales_with_the_square_of_the_optical_depth():
    amounts = np.array([2.1, 2.2, 2.6, 2.2])
    scale = _calibration.relative_squares(*hazes(amounts))
    assert scale.min() < 0.9
    np.testing.assert_allclose(scale, amounts**2 / np.mean(amounts**2), rtol=1e-6)


def test_small_optical_depth_does_not_make_the_smoothing_error_small():
    """A thin haze may have a sharp layer."""
    scale = _calibration.relative_squares(*hazes(np.array([1.0, 1e-3, 1.0, 0.5])))
    np.testing.assert_array_equal(scale[[1, 3]], 0.7)


def test_smoothing_error_is_scaled_and_noise_is_not():
    sandwich, ones, ground = typical().sandwich, np.ones(HEIGHTS), np.full(HEIGHTS, -1)
    change, scale = np.full((2, HEIGHTS), 5.0), np.array([1.0, 4.0])
    calibration = _calibration.Calibration(sandwich, ones, change, scale)
    unscaled, fourfold = calibration.factors(ROWS, ground)[0]
    known = sandwich.parts(ROWS, ground)
    noise = known[1] / known[0]
    np.testing.assert_allclose(fourfold - noise, 4.0 * (unscaled - noise), rtol=1e-9)


def test_scale_is_1_where_noise_exceeds_the_optical_depth():
    depth, _, within = hazes(np.array([1.0, 2.0, 3.0, 2.0]))
    scale = _calibration.relative_squares(depth, np.full(depth.shape, 1e3), within)
    np.testing.assert_allclose(scale, 1.0, rtol=1e-3)


def test_one_noisy_profile_does_not_make_the_others_look_thin():
    depth, variance, within = hazes(np.ones(8))
    depth[3], variance[3] = 5.0, 20.0
    scale = _calibration.relative_squares(depth, variance, within)
    np.testing.assert_allclose(np.delete(scale, 3), 1.0, rtol=0.02)
    assert scale[3] < 3.0


def test_profiles_are_compared_at_the_reach_of_each():
    """A profile that ends in a thick cloud is compared with the others at that altitude."""
    depth, variance, within = hazes(np.array([1.0, 1.0, 1.0, 4.0]))
    within[3, 5:] = False
    depth[3, 5:] = variance[3, 5:] = np.nan
    scale = _calibration.relative_squares(depth, variance, within)
    np.testing.assert_allclose(scale, [1.0, 1.0, 1.0, 16.0 / 4.75], rtol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_profiles_without_optical_depth_have_scale_1(noise):
    within = np.ones((9, 4), dtype=bool)
    depth = np.zeros((9, 4))
    scale = _calibration.relative_squares(depth, np.full((9, 4), noise), within)
    np.testing.assert_array_equal(scale, 1.0)
    depth[4] = 0.1
    beside = _calibration.relative_squares(depth, np.full((9, 4), noise), within)
    assert np.isfinite(beside).all()
    assert beside[4] >= 1.0
    assert (np.delete(beside, 4) <= 1.0).all()


def test_profiles_without_an_error_have_scale_1():
    within = np.ones((3, 4), dtype=bool)
    variance = np.full((3, 4), 1e-6)
    variance[1] = np.inf
    scale = _calibration.relative_squares(np.full((3, 4), 0.2), variance, within)
    assert scale[1] == 1.0
    np.testing.assert_allclose(scale, 1.0)
