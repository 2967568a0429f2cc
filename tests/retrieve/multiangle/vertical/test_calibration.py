"""The calibration of standard errors against dense algebra and known smoothing errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.banded_matrices import dense

from lidarops.retrieve.multiangle.vertical import _banded, _calibration
from lidarops.retrieve.multiangle.vertical._correlation import correlated_precision

HEIGHTS = 30
EVERY = np.arange(HEIGHTS)


def calibration(correlation=0.6, profiles=1, heights=HEIGHTS):
    rng = np.random.default_rng(3)
    information = rng.uniform(20.0, 80.0, heights)
    information[7] = 0.0
    share = rng.uniform(0.2, 1.0, heights)
    bands = correlated_precision(information[np.newaxis], share[np.newaxis], correlation)
    stiffness = _banded.penalty(30.0 * np.arange(1, heights + 1), 0.0)
    return _calibration.Calibration(
        np.ascontiguousarray(bands[:, 0]),
        information,
        share,
        correlation,
        stiffness,
        1e7,
        np.zeros((profiles, heights)),
        np.ones(profiles),
    )


def noise_covariance(c):
    there = c.information > 0.0
    error = np.sqrt(np.divide(1.0, c.information, where=there, out=np.zeros(there.size)))
    apart = np.abs(np.subtract.outer(np.arange(there.size), np.arange(there.size)))
    both = np.outer(np.sqrt(c.share) * error, np.sqrt(c.share) * error)
    return both * c.correlation**apart + np.diag((1.0 - c.share) * error**2)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
@pytest.mark.parametrize("lower", [np.full(HEIGHTS, -1), EVERY - 1, np.maximum(EVERY - 5, -1)])
def test_sandwich_equals_dense_algebra(correlation, lower):
    c = calibration(correlation)
    found = _calibration.sandwich(
        c.bands, c.information, c.share, correlation, c.stiffness, c.smoothing, EVERY, lower
    )
    weight, covariance = dense(c.bands), noise_covariance(c)
    inverse = np.linalg.inv(weight + c.smoothing * dense(c.stiffness))
    pilot = np.linalg.inv(weight + _calibration.PILOT * c.smoothing * dense(c.stiffness))
    for k in EVERY:
        a = np.eye(HEIGHTS)[k] - (np.eye(HEIGHTS)[lower[k]] if lower[k] >= 0 else 0.0)
        x = weight @ inverse @ a
        y = weight @ pilot @ (a - x)
        model = a @ inverse @ a - (inverse @ a) @ weight @ (inverse @ a)
        expected = (a @ inverse @ a, x @ covariance @ x, model, y @ covariance @ y)
        np.testing.assert_allclose(found[:, k], expected, rtol=1e-7)


def test_pilot_variance_is_that_of_simulated_noise():
    c = calibration()
    rng = np.random.default_rng(0)
    noise = rng.multivariate_normal(np.zeros(HEIGHTS), noise_covariance(c), size=4000)
    weight = dense(c.bands)
    smoother = np.linalg.solve(weight + c.smoothing * dense(c.stiffness), weight)
    rough = np.linalg.solve(weight + _calibration.PILOT * c.smoothing * dense(c.stiffness), weight)
    bias = noise @ (rough - smoother @ rough).T
    found = _calibration.sandwich(
        c.bands, c.information, c.share, 0.6, c.stiffness, c.smoothing, EVERY, np.full(HEIGHTS, -1)
    )
    np.testing.assert_allclose(bias.var(axis=0), found[3], rtol=0.1)
    spread = (noise @ smoother.T).var(axis=0)
    np.testing.assert_allclose(spread, found[1], rtol=0.1)


def observed(shared, own, profiles, model=1.0, noise=4.0):
    """Square of the smoothing error found at 400 heights that are alike."""
    rng = np.random.default_rng(7)
    shape = (profiles, 400)
    bias = shared + own * rng.normal(size=shape) + np.sqrt(noise) * rng.normal(size=shape)
    known = np.array([2.0, 1.0, model, noise])[:, np.newaxis] * np.ones((4, 400))
    return _calibration._observed(bias, known)


def test_shared_smoothing_error_is_found_below_the_noise_of_a_profile():
    assert np.sqrt(np.mean(observed(1.5, 0.0, 300))) == pytest.approx(1.5, rel=0.1)
    assert np.percentile(observed(1.5, 0.0, 300), 1) > 1.0


def test_smoothing_error_of_each_profile_is_found():
    assert np.mean(observed(0.0, 1.5, 300)) == pytest.approx(1.5**2, rel=0.15)


def test_few_profiles_leave_the_square_of_the_model():
    assert np.median(observed(0.0, 0.0, 8)) == pytest.approx(1.0, rel=0.3)
    assert np.mean(observed(0.0, 0.0, 3000)) < 0.25


def test_one_broken_profile_is_limited():
    bias = np.zeros((300, 1))
    bias[0] = 1e9
    known = np.array([[2.0], [1.0], [1.0], [4.0]])
    assert _calibration._observed(bias, known)[0] < 1.5


def test_rows_left_out_are_interpolated():
    every = np.arange(600)
    c = replace(
        calibration(heights=600),
        bias=np.tile(np.sin(every / 60.0), (20, 1)),
        information=np.geomspace(80.0, 2.0, 600),
        share=np.linspace(1.0, 0.2, 600),
        scale=np.linspace(0.3, 3.0, 20),
    )
    bands = correlated_precision(c.information[np.newaxis], c.share[np.newaxis], c.correlation)
    c = replace(c, bands=np.ascontiguousarray(bands[:, 0]))
    for lower in (np.full(600, -1), every - 1):
        bias = c.bias - np.where(lower >= 0, c.bias[:, np.maximum(lower, 0)], 0.0)
        thinned = _calibration.variance_ratio(c, every, lower, bias)
        exact = np.array(
            [
                _calibration.variance_ratio(
                    c, every[k : k + 1], lower[k : k + 1], bias[:, k : k + 1]
                )[:, 0]
                for k in every
            ]
        ).T
        error = np.abs(thinned / exact - 1.0)
        assert np.median(error) < 0.003
        assert np.percentile(error, 95) < 0.04
        assert np.ptp(exact) > 0.1


def test_typical_profile_leaves_out_what_few_have():
    information = np.array([[2.0, 4.0, 1.0], [4.0, 0.0, 0.0], [6.0, 8.0, 0.0]])
    share = np.array([[0.2, 0.4, 0.5], [0.4, 9.0, 9.0], [0.6, 0.8, 9.0]])
    mean, part = _calibration.typical_profile(information, share)
    np.testing.assert_allclose(mean, [4.0, 6.0, 0.0])
    np.testing.assert_allclose(part, [0.4, 0.6, 0.5])


# In proportion to the optical depth ------------------------------------------------------------


def hazes(amounts, heights=20):
    """Optical depths of one shape, well known, within reach everywhere."""
    depth = np.outer(amounts, np.linspace(0.01, 0.2, heights))
    return depth, np.full(depth.shape, 1e-12), np.ones(depth.shape, dtype=np.bool_)


def test_smoothing_error_goes_with_the_square_of_the_optical_depth():
    amounts = np.array([2.1, 2.2, 2.6, 2.2])
    scale = _calibration.relative_squares(*hazes(amounts))
    assert scale.min() < 0.9
    np.testing.assert_allclose(scale, amounts**2 / np.mean(amounts**2), rtol=1e-6)


def test_little_optical_depth_does_not_make_the_smoothing_error_small():
    """A thin haze may have a layer as sharp as any."""
    scale = _calibration.relative_squares(*hazes(np.array([1.0, 1e-3, 1.0, 0.5])))
    np.testing.assert_array_equal(scale[[1, 3]], 0.7)


def test_smoothing_error_is_scaled_and_noise_is_not():
    c = replace(calibration(profiles=2), scale=np.array([1.0, 4.0]))
    bias = np.full((2, HEIGHTS), 5.0)
    one, four = _calibration.variance_ratio(c, EVERY, np.full(HEIGHTS, -1), bias)
    known = _calibration.sandwich(
        c.bands, c.information, c.share, 0.6, c.stiffness, c.smoothing, EVERY, np.full(HEIGHTS, -1)
    )
    noise = known[1] / known[0]
    np.testing.assert_allclose(four - noise, 4.0 * (one - noise), rtol=1e-9)


def test_noise_that_hides_the_optical_depth_leaves_the_scale_alone():
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
    """What a thick cloud swallows low down is compared with the others down there."""
    depth, variance, within = hazes(np.array([1.0, 1.0, 1.0, 4.0]))
    within[3, 5:] = False
    depth[3, 5:] = variance[3, 5:] = np.nan
    scale = _calibration.relative_squares(depth, variance, within)
    np.testing.assert_allclose(scale, [1.0, 1.0, 1.0, 16.0 / 4.75], rtol=1e-6)


@pytest.mark.parametrize("farther", [1, 2])
def test_profiles_that_reach_farther_are_not_compared_with_themselves(farther):
    """Thick hazes that alone are seen one bin higher are as thick as without that bin."""
    amounts = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 3.0, 2.0])
    depth, variance, within = hazes(amounts)
    equal = _calibration.relative_squares(depth[:, :-1], variance[:, :-1], within[:, :-1])
    few = slice(0, amounts.size - farther)
    within[few, -1] = False
    depth[few, -1] = variance[few, -1] = np.nan
    scale = _calibration.relative_squares(depth, variance, within)
    np.testing.assert_allclose(scale, equal, rtol=1e-9)
    np.testing.assert_allclose(scale[5], 9.0 / np.mean(amounts**2), rtol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_profiles_without_optical_depth_are_as_usual(noise):
    within = np.ones((9, 4), dtype=bool)
    depth = np.zeros((9, 4))
    one = _calibration.relative_squares(depth, np.full((9, 4), noise), within)
    np.testing.assert_array_equal(one, 1.0)
    depth[4] = 0.1
    beside = _calibration.relative_squares(depth, np.full((9, 4), noise), within)
    assert np.isfinite(beside).all()
    assert beside[4] >= 1.0
    assert (np.delete(beside, 4) <= 1.0).all()


def test_profiles_without_an_error_are_as_usual():
    within = np.ones((3, 4), dtype=bool)
    variance = np.full((3, 4), 1e-6)
    variance[1] = np.inf
    found = _calibration.relative_squares(np.full((3, 4), 0.2), variance, within)
    assert found[1] == 1.0
    np.testing.assert_allclose(found, 1.0)
