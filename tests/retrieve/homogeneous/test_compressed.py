"""The compressed solver against exact shapes, converged least squares and plain loops."""

import numpy as np
import pytest
from scipy import stats
from support.oracles.homogeneous import GEOMETRIES, lowest_errors, section, signal

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousResult, fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

KM = 1e-3
LONG = section(2500.0, 8000.0)
FIELDS = tuple(HomogeneousResult.__dataclass_fields__)


def test_long_profiles_are_solved_as_by_the_direct_fit():
    r = 2500.0 + 2.0 * np.arange(THRESHOLDS.most_compressed_bins + 1.0)
    power = signal(r, 100.0, 3e-5) + np.random.default_rng(8).standard_normal((3, r.size))
    fit, direct = (
        fit_homogeneous_path(power, r, variance=1.0, method=name) for name in ("auto", "direct")
    )
    np.testing.assert_allclose(
        fit.extinction, direct.extinction, atol=1e-3 * direct.extinction_standard_error.min()
    )
    np.testing.assert_array_equal(fit.quality, direct.quality)


# Exactness ----------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.0, 1.0, 10.0, 100.0])
@pytest.mark.parametrize(
    ("start", "length", "bins"),
    [*((*geometry, 225) for geometry in GEOMETRIES), (500.0, 200.0, 32), (30.0, 15e3, 2000)],
)
def test_noise_free_extinction_is_exact(start, length, bins, level):
    r = np.linspace(start, start + length, bins)
    truth = np.geomspace(1e-5, 50.0 / length, 300)[:, np.newaxis]
    power = level + np.exp(-2.0 * truth * (r - start)) * (start / r) ** 2
    fit = fit_homogeneous_path(power, r)
    np.testing.assert_allclose(fit.extinction, truth[:, 0], rtol=1e-9)
    assert np.max(np.abs(fit.background - level)) < 1e-9
    if bins == 225:
        rounded = fit_homogeneous_path(power.astype(np.float32), r)
        apart = np.abs(rounded.extinction / truth[:, 0] - 1.0)
        assert apart.max() < 5e-5 * max(1.0, level) or apart.max() < 2e-3
        assert apart.max() < 5e-5 * max(1.0, 10.0 * level)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("start", "length"), GEOMETRIES)
def test_result_is_that_of_converged_least_squares(start, length, known):
    r = section(start, length)
    random = np.random.default_rng(2)
    count = 3000
    extinction = np.exp(random.uniform(np.log(1e-5), np.log(5e-3), count))[:, np.newaxis]
    height = np.exp(random.uniform(np.log(30.0), np.log(1e5), count))[:, np.newaxis]
    power = height * np.exp(-2.0 * extinction * (r - start)) * (start / r) ** 2
    power += 370.0 + random.normal(size=power.shape)
    variance = 1.0 if known else None
    exact = fit_homogeneous_path(power, r, variance=variance, method="direct")
    fit = fit_homogeneous_path(power, r, variance=variance)
    undetermined = (
        Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED | HomogeneousQuality.AT_BOUND
    )
    valid = (exact.quality & int(undetermined)) == 0
    assert valid.sum() > 1000
    for name in ("extinction", "background", "amplitude"):
        error = getattr(exact, f"{name}_standard_error")[valid]
        difference = np.abs(getattr(fit, name) - getattr(exact, name))[valid]
        assert np.max(difference / error) < 0.01
        ratio = getattr(fit, f"{name}_standard_error")[valid] / error
        np.testing.assert_allclose(ratio, 1.0, rtol=5e-3)
    same = (fit.quality & int(undetermined)) == (exact.quality & int(undetermined))
    assert np.mean(same) > 0.998
    np.testing.assert_allclose(fit.reduced_chi2[valid], exact.reduced_chi2[valid], rtol=1e-3)


# Statistics ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "length", "height", "extinction"),
    [
        (2500.0, 8000.0, 107.0, 0.03),
        (2500.0, 8000.0, 1e5, 0.03),
        (2500.0, 1700.0, 1e4, 0.03),
        (2500.0, 8000.0, 1e4, 5.0),
        (10500.0, 2500.0, 3e4, 0.1),
    ],
)
def test_scatter_is_the_least_possible_and_stated(start, length, height, extinction):
    r = section(start, length)
    count = 10_000
    power = 370.0 + signal(r, height, extinction * KM)
    power = power + np.random.default_rng(3).normal(size=(count, r.size))
    fit = fit_homogeneous_path(power, r, variance=1.0)
    lowest = lowest_errors(r, height, extinction * KM)
    amplitude = height * start**2 * np.exp(2.0 * extinction * KM * start)
    truths = {"background": 370.0, "extinction": extinction * KM, "amplitude": amplitude}
    for name, truth in truths.items():
        pull = (getattr(fit, name) - truth) / getattr(fit, f"{name}_standard_error")
        assert 0.94 <= np.mean(np.abs(pull) < 1.96) <= 0.96
    error = fit.extinction - extinction * KM
    assert np.sqrt(np.mean(error**2)) < 1.04 * lowest[2]
    assert abs(np.mean(error)) < 0.05 * lowest[2]


@pytest.mark.parametrize("height", [100.0, 1e6])
def test_curvature_misfit_is_chi_square(height):
    power = 370.0 + signal(LONG, height, 0.03 * KM)
    power = power + np.random.default_rng(4).normal(size=(20_000, 225))
    fit = fit_homogeneous_path(power, LONG, variance=1.0)
    dof = 5
    assert np.mean(fit.curvature_misfit) == pytest.approx(dof, rel=0.02)
    assert stats.kstest(fit.curvature_misfit, stats.chi2(dof).cdf).pvalue > 1e-4


def test_common_weights_serve_counts():
    shots = 51
    mean = 10.0 + signal(LONG, 20.0, 0.03 * KM)
    power = np.random.default_rng(5).poisson(shots * mean, (10_000, 225)) / shots
    fit = fit_homogeneous_path(power, LONG, variance=mean / shots, method="compressed")
    direct = fit_homogeneous_path(power[:300], LONG, variance=mean / shots, method="direct")
    apart = np.abs(fit.extinction[:300] - direct.extinction)
    assert np.max(apart / direct.extinction_standard_error) < 0.01
    pull = (fit.extinction - 0.03 * KM) / fit.extinction_standard_error
    assert 0.94 <= np.mean(np.abs(pull) < 1.96) <= 0.96


# Bits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variance", [1.0, None])
def test_bits_do_not_depend_on_size_or_start_of_the_batch(dtype, variance):
    power = 370.0 + signal(LONG, 50.0, 0.1 * KM)
    power = (power + np.random.default_rng(6).normal(size=(1000, 225))).astype(dtype)
    power[17, 30] = np.nan
    power[400] = 5.0
    whole = fit_homogeneous_path(power, LONG, variance=variance)
    for size in (*range(1, 100), *range(100, 1000, 37)):
        batch = fit_homogeneous_path(power[:size], LONG, variance=variance)
        np.testing.assert_array_equal(batch.extinction, whole.extinction[:size])
    for start in range(1, 120, 7):
        batch = fit_homogeneous_path(power[start : start + 60], LONG, variance=variance)
        for name in FIELDS:
            np.testing.assert_array_equal(
                getattr(batch, name), getattr(whole, name)[start : start + 60], err_msg=name
            )


@pytest.mark.parametrize("scale", [1e-150, 1e-30, 1e30, 1e150])
def test_scale_of_the_power_does_not_matter(scale):
    power = 370.0 + signal(LONG, 100.0, 0.1 * KM)
    power = power + np.random.default_rng(7).normal(size=(20, 225))
    expected = fit_homogeneous_path(power, LONG)
    fit = fit_homogeneous_path(power * scale, LONG)
    # Beyond 1e140 the squares leave the float range, and the direct fit takes over.
    close = 1e-9 if 1e-50 < scale < 1e50 else 1e-2
    np.testing.assert_allclose(fit.extinction, expected.extinction, rtol=close)
    np.testing.assert_allclose(fit.background, expected.background * scale, rtol=close)
    np.testing.assert_array_equal(fit.quality, expected.quality)
    if 1e-38 < scale < 1e30:
        single = fit_homogeneous_path((power * scale).astype(np.float32), LONG)
        np.testing.assert_allclose(single.extinction, expected.extinction, rtol=1e-2)
        np.testing.assert_array_equal(single.quality, expected.quality)


def test_profiles_without_tables_are_solved_by_the_direct_fit():
    uneven = LONG + np.linspace(0.0, 3.0, 225) ** 2
    thin = section(10_500.0, 50.0)
    short = LONG[:20]
    for r in (uneven, thin, short):
        power = 370.0 + signal(r, 1e4, 0.1 * KM)
        power = power + np.random.default_rng(8).normal(size=(3, r.size))
        fit = fit_homogeneous_path(power, r, variance=1.0)
        exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
        np.testing.assert_array_equal(fit.extinction, exact.extinction)


@pytest.mark.parametrize(
    ("start", "length", "step", "extinction", "amplitude"),
    [
        (10_000.0, 200.0, 3.75, 5e-6, 3e5),
        (5000.0, 200.0, 6.06, 1e-6, 3e4),
        (5000.0, 200.0, 6.06, -1e-5, 1e5),
        (6000.0, 300.0, 3.75, 1e-5, 1e5),
        (10_000.0, 110.0, 2.5, 3e-5, 1e6),
    ],
)
def test_a_thin_section_settles_far_from_its_start(start, length, step, extinction, amplitude):
    r = np.arange(start, start + length, step)
    shape = (start / r) ** 2 * np.exp(-2.0 * extinction * (r - start))
    noise = np.random.default_rng(5).normal(size=(400, r.size))
    power = 50.0 + amplitude * shape + noise
    fit = fit_homogeneous_path(power, r, variance=1.0)
    exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
    off = np.abs(fit.extinction - exact.extinction) / exact.extinction_standard_error
    assert off.max() < 0.01
