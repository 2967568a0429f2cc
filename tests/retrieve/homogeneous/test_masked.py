"""Profiles with gaps or weights of their own, against the direct fit and the information bound."""

import numpy as np
import pytest
from support.oracles.homogeneous import GEOMETRIES, lowest_errors, section, signal

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import fit_homogeneous_path

KM = 1e-3
CASES = [
    (2500.0, 8000.0, 1e3, 0.03),
    (2500.0, 8000.0, 1e4, 1.0),
    (2500.0, 1700.0, 1e4, 0.03),
    (10500.0, 2500.0, 3e4, 0.1),
]
UNDETERMINED = int(
    Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED | HomogeneousQuality.AT_BOUND
)


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


KINDS = ("scattered", "near", "gap", "all", "uneven")


def measured(case, kind, count, seed=1):
    start, length, height, extinction = case
    r = section(start, length)
    weights = weights_of(kind, count)
    with np.errstate(divide="ignore"):
        scale = 1.0 / np.sqrt(weights)
    power = np.random.default_rng(seed).normal(size=(count, 225)) * np.where(weights, scale, 1.0)
    power += 370.0 + signal(r, height, extinction * KM)
    return r, np.where(weights > 0.0, power, np.nan), np.where(weights > 0.0, 1.0 / weights, 1.0)


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_result_is_that_of_the_direct_fit(case, kind, known):
    r, power, variance = measured(case, kind, 600)
    noise = {"variance": variance} if known else {"weights": 1.0 / variance}
    fit = fit_homogeneous_path(power, r, **noise)
    exact = fit_homogeneous_path(power, r, **noise, method="direct")
    valid = (exact.quality & UNDETERMINED) == 0
    assert valid.mean() > 0.95
    for name in ("extinction", "background", "amplitude"):
        error = getattr(exact, f"{name}_standard_error")[valid]
        apart = np.abs(getattr(fit, name) - getattr(exact, name))[valid]
        assert np.max(apart / error) < 1e-4
        ratio = getattr(fit, f"{name}_standard_error")[valid] / error
        np.testing.assert_allclose(ratio, 1.0, rtol=1e-4)
    np.testing.assert_allclose(fit.reduced_chi2, exact.reduced_chi2, rtol=1e-5)
    np.testing.assert_array_equal(fit.valid_bins, exact.valid_bins)
    np.testing.assert_array_equal(fit.quality[valid], exact.quality[valid])


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("level", [0.0, 100.0])
@pytest.mark.parametrize(("start", "length"), GEOMETRIES)
def test_noise_free_extinction_is_exact(start, length, level, kind):
    r = section(start, length)
    truth = np.geomspace(1e-5, 20.0 / length, 120)[:, np.newaxis]
    power = level + np.exp(-2.0 * truth * (r - start)) * (start / r) ** 2
    weights = weights_of(kind, truth.size)
    fit = fit_homogeneous_path(power, r, weights=weights)
    if kind in ("near", "all"):
        # A signal that has decayed before the first valid bin holds no information.
        valid = truth[:, 0] * (r[20] - start) < 3.0
    else:
        valid = np.ones(truth.size, bool)
    np.testing.assert_allclose(fit.extinction[valid], truth[valid, 0], rtol=2e-9)


def test_profiles_without_convergence_are_left_to_the_direct_fit():
    r = section(2500.0, 8000.0)
    power = np.random.default_rng(3).normal(size=(40, 225))
    power[:10] += 370.0 + signal(r, 1e4, 0.1 * KM)
    power[10:20] = 5.0
    power[20:30, 7:] = np.nan
    power[:, 100] = np.nan
    fit = fit_homogeneous_path(power, r, variance=1.0)
    exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
    np.testing.assert_array_equal(fit.quality[:30], exact.quality[:30])
    np.testing.assert_array_equal(fit.background[10:30], exact.background[10:30])


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
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(size=(4000, r.size))
        power = 1e6 + 54_205.0 * shape + noise
        power[:, :35] = np.nan
        fit = fit_homogeneous_path(power, r, variance=1.0)
        exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
        off = np.abs(fit.extinction - exact.extinction) / exact.extinction_standard_error
        assert off.max() < 0.01
