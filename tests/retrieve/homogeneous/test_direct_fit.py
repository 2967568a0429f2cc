"""Profiles with and without gaps, against a slow fit and the information bound."""

import numpy as np
import pytest
from support.cases import each
from support.oracles.homogeneous import GEOMETRIES, iterated_fit, lowest_errors, section, signal
from support.weights import by_weights

from lidarops.retrieve.homogeneous.path_fit import fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

KM = 1e-3
CASES = [
    (2500.0, 8000.0, 1e3, 0.03),
    (2500.0, 8000.0, 1e4, 1.0),
    (2500.0, 1700.0, 1e4, 0.03),
    (10500.0, 2500.0, 3e4, 0.1),
]


def weights_of(kind, count, seed=0):
    weights = np.ones((count, 225))
    if kind in ("scattered", "all"):
        weights[np.random.default_rng(seed).random(weights.shape) < 0.3] = 0.0
    if kind in ("near", "all"):
        weights[:, :20] = 0.0
    if kind in ("gap", "all"):
        weights[:, 80:120] = 0.0
    if kind == "uneven":
        weights *= np.random.default_rng(seed).uniform(0.2, 5.0, weights.shape)
    return weights


KINDS = ("dense", "scattered", "near", "gap", "all", "uneven")


def measured(case, kind, count, seed=1):
    start, length, height, extinction = case
    r = section(start, length)
    weights = weights_of(kind, count)
    with np.errstate(divide="ignore"):
        scale = 1.0 / np.sqrt(weights)
    power = np.random.default_rng(seed).normal(size=(count, 225)) * np.where(weights, scale, 1.0)
    power += 370.0 + signal(r, height, extinction * KM)
    return r, np.where(weights > 0.0, power, np.nan), np.where(weights > 0.0, 1.0 / weights, 1.0)


def slow_fit(r, power, weights):
    bounds = THRESHOLDS.lowest_extinction / r[-1], THRESHOLDS.highest_optical_depth / np.ptp(r)
    return iterated_fit(r, power, weights, bounds)


@each("kind", KINDS)
@each("case", CASES)
def test_result_is_the_least_squares_minimum_with_the_errors_of_its_information(case, kind):
    r, power, variance = measured(case, kind, 10)
    weights = np.where(np.isfinite(power), 1.0 / variance, 0.0)
    fit = fit_homogeneous_path(power, r, variance=variance)
    unscaled = fit_homogeneous_path(power, r, **by_weights(3.0 * weights))
    np.testing.assert_allclose(unscaled.extinction, fit.extinction, rtol=1e-9)
    relative_error = fit.amplitude_standard_error / fit.amplitude
    stated = fit.background_standard_error, relative_error, fit.extinction_standard_error
    for k in range(10):
        background, height, extinction = slow_fit(r, power[k], weights[k])
        errors = lowest_errors(r, height, extinction, weights[k])
        assert abs(fit.background[k] - background) < 1e-4 * errors[0]
        assert abs(fit.extinction[k] - extinction) < 1e-4 * errors[2]
        np.testing.assert_allclose([error[k] for error in stated], errors, rtol=1e-4)
        residuals = power[k] - background - signal(r, height, extinction)
        bins = np.count_nonzero(weights[k])
        chi2 = np.nansum(weights[k] * residuals**2) / (bins - 3)
        assert fit.reduced_chi2[k] == pytest.approx(chi2, rel=1e-6)
        assert fit.valid_bins[k] == bins


@each("known", [True, False])
@each("bins", [12, 40, 225])
@each("level", [-1e6, -5.0, 0.0, 1e6])
@each("extinction", [0.0, 0.05, 2.0])
def test_profiles_with_gaps_are_at_the_global_minimum(extinction, level, bins, known):
    r = section(2500.0, 3000.0, bins)
    rng = np.random.default_rng([bins, known])
    power = level + signal(r, 1e4, extinction * KM) + rng.normal(size=(6, bins))
    power[rng.random(power.shape) < 0.3] = np.nan
    fit = fit_homogeneous_path(power, r, variance=1.0 if known else None)
    for k in range(6):
        background, _, expected = slow_fit(r, power[k], np.isfinite(power[k]).astype(float))
        assert abs(fit.extinction[k] - expected) < 1e-3 * fit.extinction_standard_error[k]
        assert abs(fit.background[k] - background) < 1e-3 * fit.background_standard_error[k]


@pytest.mark.filterwarnings("ignore:divide by zero")
@each("kind", KINDS)
@each("case", CASES)
def test_scatter_is_the_least_that_the_bins_allow(case, kind):
    _, _, height, extinction = case
    count = 4000
    r, power, variance = measured(case, kind, count, seed=2)
    fit = fit_homogeneous_path(power, r, variance=variance)
    weights = np.where(np.isfinite(power), 1.0 / variance, 0.0)
    lowest = np.mean([lowest_errors(r, height, extinction * KM, w)[2] for w in weights[:50]])
    error = fit.extinction - extinction * KM
    assert np.sqrt(np.mean(error**2)) < 1.05 * lowest
    pull = error / fit.extinction_standard_error
    assert 0.935 < np.mean(np.abs(pull) < 1.96) < 0.965


@each("kind", KINDS)
@each("level", [0.0, 100.0])
@each(("start", "length"), GEOMETRIES)
def test_noise_free_extinction_is_exact(start, length, level, kind):
    r = section(start, length)
    truth = np.geomspace(1e-5, 20.0 / length, 120)[:, np.newaxis]
    power = level + np.exp(-2.0 * truth * (r - start)) * (start / r) ** 2
    weights = weights_of(kind, truth.size)
    fit = fit_homogeneous_path(power, r, **by_weights(weights))
    if kind in ("near", "all"):
        # A signal that has decayed before the first valid bin holds no information.
        valid = truth[:, 0] * (r[20] - start) < 3.0
    else:
        valid = np.ones(truth.size, bool)
    np.testing.assert_allclose(fit.extinction[valid], truth[valid, 0], rtol=2e-9)


def test_bits_do_not_depend_on_the_batch():
    r, power, variance = measured(CASES[0], "all", 60)
    whole = fit_homogeneous_path(power, r, variance=variance)
    for rows in (slice(0, 1), slice(7, 50), slice(None, None, -1)):
        batch = fit_homogeneous_path(power[rows], r, variance=variance[rows])
        np.testing.assert_array_equal(batch.extinction, whole.extinction[rows])
        np.testing.assert_array_equal(batch.quality, whole.quality[rows])


def test_a_step_that_is_small_by_chance_does_not_end_the_search():
    r = np.linspace(704.7309, 869.1879, 225)
    extinction = 0.0204685 / 164.457
    shape = (r[0] / r) ** 2 * np.exp(-2.0 * extinction * (r - r[0]))
    power = 1e6 + 54_205.0 * shape + np.random.default_rng(0).normal(size=(4000, r.size))
    power[:, :35] = np.nan
    fit = fit_homogeneous_path(power, r, variance=1.0)
    pull = np.abs(fit.extinction - extinction) / fit.extinction_standard_error
    for k in np.argsort(pull)[-10:]:
        found = slow_fit(r, power[k], np.isfinite(power[k]).astype(float))[2]
        assert abs(fit.extinction[k] - found) < 0.01 * fit.extinction_standard_error[k]


@each(("start", "length", "bins"), [(500.0, 200.0, 32), (30.0, 15e3, 2000)])
@each("level", [0.0, 1.0, 10.0, 100.0])
def test_noise_free_extinction_of_profiles_without_gaps_is_exact(start, length, bins, level):
    r = np.linspace(start, start + length, bins)
    truth = np.geomspace(1e-5, 50.0 / length, 300)[:, np.newaxis]
    power = level + np.exp(-2.0 * truth * (r - start)) * (start / r) ** 2
    fit = fit_homogeneous_path(power, r)
    np.testing.assert_allclose(fit.extinction, truth[:, 0], rtol=1e-9)
    assert np.max(np.abs(fit.background - level)) < 1e-9


@pytest.mark.parametrize("scale", [1e-150, 1e-30, 1e30, 1e150])
def test_scale_of_the_power_does_not_matter(scale):
    r = section(2500.0, 8000.0)
    power = 370.0 + signal(r, 100.0, 0.1 * KM)
    power = power + np.random.default_rng(7).normal(size=(20, 225))
    expected = fit_homogeneous_path(power, r)
    fit = fit_homogeneous_path(power * scale, r)
    np.testing.assert_allclose(fit.extinction, expected.extinction, rtol=1e-9)
    np.testing.assert_allclose(fit.background, expected.background * scale, rtol=1e-9)
    np.testing.assert_array_equal(fit.quality, expected.quality)
    if 1e-38 < scale < 1e30:
        single = fit_homogeneous_path((power * scale).astype(np.float32), r)
        np.testing.assert_allclose(single.extinction, expected.extinction, rtol=1e-2)
        np.testing.assert_array_equal(single.quality, expected.quality)
