"""The vertical solution: identities, coverage in simulated scans, and withheld values."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erf
from support.cases import each
from support.oracles.angle_scenes import clear, clear_depth, cloud, estimates
from support.oracles.banded_matrices import dense
from support.oracles.multiangle import correlated

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlation_of_air
from lidarops.retrieve.multiangle.smooth_profile import (
    nearest_rising,
    smooth_optical_depth,
)

ALTITUDE = 150.0 + 30.0 * np.arange(60)
PER_KM = 1e-3


def solve(scene, single):
    """Solve with the estimates of single altitudes of a scene."""
    return smooth_optical_depth(
        single.optical_depth, single.information, scene.altitude, noise=single.noise
    )


def plain(profiles, rng, *, error=0.02, altitude=ALTITUDE):
    """Return estimates with equal, independent errors of a hazy atmosphere."""
    truth = clear_depth(altitude)
    depth = truth + error * rng.normal(size=(profiles, altitude.size))
    return depth, np.full(depth.shape, error**-2.0), truth


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


def truth_of(scene, result):
    """Return true optical depth and extinction, (profile, altitude)."""
    depth = np.broadcast_to(scene.truth, result.optical_depth.shape)
    steps = np.diff(scene.altitude, prepend=0.0)
    return depth, np.diff(depth, axis=1, prepend=0.0) / steps


def coverage(value, error, truth):
    """Return the shares of finite values within 1 and 1.96 standard errors."""
    score = np.abs(value - truth) / error
    score = score[np.isfinite(score)]
    return float((score < 1.0).mean()), float((score < 1.96).mean())


# Algebra ------------------------------------------------------------------------------------


def test_smoothing_after_kano_hamilton_equals_one_joint_fit():
    """The fit of all intercepts and optical depths together gives the same solution."""
    rng = np.random.default_rng(1)
    x, altitudes = 1.0 / np.cos(np.radians([0.0, 20.0, 40.0, 60.0])), 25
    weight = rng.uniform(50.0, 400.0, (x.size, altitudes))
    y = rng.normal(-8.0, 1.0, altitudes) - 2.0 * x[:, None] * np.linspace(0.01, 0.3, altitudes)
    y += rng.normal(size=y.shape) / np.sqrt(weight)
    total = weight.sum(axis=0)
    centred = x[:, None] - (weight * x[:, None]).sum(axis=0) / total
    square = (weight * centred**2).sum(axis=0)
    depth = -0.5 * (weight * centred * y).sum(axis=0) / square
    altitude = 100.0 + 30.0 * np.arange(altitudes)
    result = smooth_optical_depth(depth[None], 4.0 * square[None], altitude)
    shares = result.smoother.share
    stiffness = dense(_smoothing.penalty(altitude))
    together = np.zeros(altitudes)
    for lam, share in zip(result.weight, shares, strict=True):
        normal = np.zeros((2 * altitudes, 2 * altitudes))
        normal[:altitudes, :altitudes] = np.diag(total)
        cross = -2.0 * (weight * x[:, None]).sum(axis=0)
        normal[:altitudes, altitudes:] = normal[altitudes:, :altitudes] = np.diag(cross)
        normal[altitudes:, altitudes:] = np.diag(4.0 * (weight * x[:, None] ** 2).sum(axis=0))
        normal[altitudes:, altitudes:] += lam * stiffness
        right = np.concatenate([(weight * y).sum(axis=0), -2.0 * (weight * x[:, None] * y).sum(0)])
        together += share * np.linalg.solve(normal, right)[altitudes:]
    np.testing.assert_allclose(result.optical_depth[0], together, atol=1e-9)


def test_constant_extinction_is_returned_exactly():
    depth = np.tile(4e-5 * ALTITUDE, (10, 1))
    result = smooth_optical_depth(depth, np.full(depth.shape, 1e4), ALTITUDE)
    np.testing.assert_allclose(result.optical_depth, depth, rtol=1e-9)
    np.testing.assert_allclose(result.extinction, 4e-5, rtol=1e-7)
    np.testing.assert_allclose(result.data_share, 1.0, rtol=1e-9)


def test_noise_that_hides_all_structure_leaves_a_straight_line():
    depth = np.tile(4e-5 * ALTITUDE, (10, 1))
    result = smooth_optical_depth(depth, np.full(depth.shape, 1.0), ALTITUDE)
    assert result.effective_degrees_of_freedom == pytest.approx(2.0, abs=0.3)


def test_extinction_adds_up_to_the_optical_depth():
    depth, information, _ = plain(12, np.random.default_rng(0))
    result = smooth_optical_depth(depth, information, ALTITUDE)
    steps = np.diff(ALTITUDE, prepend=0.0)
    sums = np.cumsum(result.extinction * steps, axis=1)
    np.testing.assert_allclose(sums, result.optical_depth, atol=1e-12)


def test_response_is_linear_and_gives_the_solution():
    rng = np.random.default_rng(2)
    for profiles in (3, 12):
        depth, information, _ = plain(profiles, rng)
        information[0, 10:13] = 0.0
        result = smooth_optical_depth(depth, information, ALTITUDE)
        np.testing.assert_allclose(
            result.respond(depth), result.optical_depth, rtol=1e-9, atol=1e-12
        )
        other = rng.normal(size=depth.shape)
        both = result.respond(2.0 * depth + other)
        parts = 2.0 * result.optical_depth + result.respond(other)
        np.testing.assert_allclose(both, parts, atol=1e-10)
        line = np.tile(ALTITUDE, (profiles, 1))
        np.testing.assert_allclose(result.respond(line), line, rtol=1e-8)


# Simulated scans ----------------------------------------------------------------------------

SCENES = {
    "clear 3000": (clear(3000.0), 0.0),
    "clear 300": (clear(300.0), 0.0),
    "clear 3000, correlated": (clear(3000.0), 0.7),
    "clear 300, correlated": (clear(300.0), 0.7),
    "cloud 30": (cloud(), 0.0),
    "cloud 30, rho 0.5": (cloud(), 0.5),
    "cloud 30, rho 0.8": (cloud(), 0.8),
    "cloud 30, rho 0.95": (cloud(), 0.95),
    "cloud 15": (cloud(largest=15.0), 0.0),
    "cloud 15, rho 0.8": (cloud(largest=15.0), 0.8),
}


def joined(scene, correlation, profiles, blocks, seed):
    """Return results and truths of several blocks, each simulated and solved on its own."""
    rng = np.random.default_rng(seed)
    singles = [estimates(scene, profiles, rng, correlation) for _ in range(blocks)]
    solutions = [solve(scene, single) for single in singles]
    names = ("optical_depth", "optical_depth_standard_error", "extinction")
    names += ("extinction_standard_error",)
    rows = {name: np.concatenate([getattr(s, name) for s in solutions]) for name in names}
    rows["correlation"] = np.array([single.noise.correlation for single in singles])
    depth, extinction = truth_of(scene, solutions[0])
    return rows, depth[:1], extinction[:1]


# A block has one truth, and errors of neighbouring altitudes are correlated: the shares of few
# blocks scatter by about 2 percent around those of many blocks (64-74 and 93-97 percent).
DEPTH_68, DEPTH_95 = (0.60, 0.78), (0.91, 0.985)


@each(("profiles", "blocks"), [(300, 2), (32, 12), (8, 30)])
@each("name", SCENES)
def test_standard_errors_cover_the_truth(name, profiles, blocks):
    rows, depth, extinction = joined(*SCENES[name], profiles, blocks, seed=1)
    within_1, within_2 = coverage(
        rows["optical_depth"], rows["optical_depth_standard_error"], depth
    )
    assert DEPTH_68[0] <= within_1 <= DEPTH_68[1]
    assert DEPTH_95[0] <= within_2 <= DEPTH_95[1]
    within_1, within_2 = coverage(rows["extinction"], rows["extinction_standard_error"], extinction)
    assert within_2 >= 0.90
    assert within_1 >= 0.57
    if profiles == 300:
        assert within_1 <= 0.84


@pytest.mark.parametrize("name", ["clear 3000", "clear 300, correlated", "cloud 30"])
def test_standard_errors_of_single_profiles_cover_the_truth(name):
    rows, depth, extinction = joined(*SCENES[name], 1, 120, seed=1)
    within_1, within_2 = coverage(
        rows["optical_depth"], rows["optical_depth_standard_error"], depth
    )
    assert 0.60 <= within_1 <= 0.80
    assert within_2 >= 0.89
    assert coverage(rows["extinction"], rows["extinction_standard_error"], extinction)[1] >= 0.93


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_standard_errors_cover_truths_that_differ_within_a_block(correlation):
    rng = np.random.default_rng(3)
    aerosol = np.exp(0.7 * rng.normal(size=256))
    scene = clear(3000.0, aerosol=aerosol, layer=rng.uniform(1500.0, 4500.0, 256))
    result = solve(scene, estimates(scene, 256, rng, correlation))
    depth, extinction = truth_of(scene, result)
    within_1, within_2 = coverage(result.optical_depth, result.optical_depth_standard_error, depth)
    assert 0.62 <= within_1 <= 0.80
    assert DEPTH_95[0] <= within_2 <= DEPTH_95[1]
    assert coverage(result.extinction, result.extinction_standard_error, extinction)[1] >= 0.87


def test_profiles_of_one_shape_are_not_smoothed_too_much_in_a_correlated_cloud():
    """By the likelihood alone, without Cp, 58 percent of extinctions are within their errors."""
    shares = []
    for seed in range(10):
        result = solve(cloud(), estimates(cloud(), 32, np.random.default_rng(seed), 0.5))
        _, extinction = truth_of(cloud(), result)
        shares.append(coverage(result.extinction, result.extinction_standard_error, extinction)[0])
    assert np.mean(shares) > 0.65


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_standard_errors_are_as_right_for_thick_hazes_as_for_thin_ones(correlation):
    rng = np.random.default_rng(3)
    amounts, deviations = [], []
    for _ in range(12):
        aerosol = np.exp(0.7 * rng.normal(size=32))
        scene = clear(3000.0, aerosol=aerosol, layer=rng.uniform(1500.0, 4500.0, 32))
        result = solve(scene, estimates(scene, 32, rng, correlation))
        error = result.extinction - truth_of(scene, result)[1]
        amounts.append(aerosol)
        deviations.append(error / result.extinction_standard_error)
    amount, deviation = np.concatenate(amounts), np.concatenate(deviations)
    thin, thick = (amount < np.quantile(amount, 0.25)), (amount > np.quantile(amount, 0.75))
    assert 0.7 < rms(deviation[thick]) / rms(deviation[thin]) < 1.4
    assert rms(deviation) < 1.0
    assert np.nanmax(np.abs(deviation)) < 5.0


def test_standard_errors_of_sharp_layers_in_thin_hazes_hold_beside_thick_hazes():
    """Smooth, thick hazes in a block do not hide the smoothing error of thin ones."""
    thin, extinction = 8, 1e-4
    deviations = []
    for seed in range(8):
        scene = clear(3000.0)
        amount = np.where(np.arange(32) < thin, 0.3, 5.0)[:, np.newaxis]
        haze = 0.05e-3 * 1200.0 * -np.expm1(-scene.altitude / 1200.0)
        air = 0.0131e-3 * 8000.0 * -np.expm1(-scene.altitude / 8000.0)
        sharp = extinction * 100.0 * np.sqrt(0.5 * np.pi)
        sharp = sharp * (erf((scene.altitude - 2500.0) / (100.0 * np.sqrt(2.0))) + 1.0)
        scene = dataclasses.replace(scene, truth=air + amount * haze + (amount < 1.0) * sharp)
        result = solve(scene, estimates(scene, 32, np.random.default_rng(seed), 0.3))
        score = (result.extinction - truth_of(scene, result)[1]) / result.extinction_standard_error
        deviations.append(score[:thin])
    deviation = np.concatenate(deviations)
    assert rms(deviation) < 1.0
    assert np.mean(np.abs(deviation[np.isfinite(deviation)]) > 4.0) < 0.01


@pytest.mark.parametrize("correlation", [0.5, 0.8, 0.95])
def test_correlation_is_estimated_within_2_percent(correlation):
    estimated = joined(cloud(), correlation, 32, 8, seed=2)[0]["correlation"]
    assert np.abs(estimated.mean() - correlation) <= 0.02
    estimated = joined(clear(3000.0), 0.7, 32, 2, seed=2)[0]["correlation"]
    assert np.abs(estimated.mean() - 0.7) <= 0.02


def test_clear_profile_is_far_better_than_single_altitudes():
    scene = clear(3000.0)
    single = estimates(scene, 300, np.random.default_rng(4))
    result = solve(scene, single)
    depth, extinction = truth_of(scene, result)
    reached = np.isfinite(result.optical_depth)
    error = rms(result.optical_depth - depth)
    assert error <= 0.010
    # A ninth in the study; the scenes differ in the noise of the highest altitudes.
    assert error <= rms(np.where(reached, single.optical_depth - depth, np.nan)) / 7.5
    assert rms(result.extinction - extinction) <= 0.010 * PER_KM


def test_cloud_at_30_degrees_is_resolved():
    scene = cloud()
    result = solve(scene, estimates(scene, 300, np.random.default_rng(5)))
    depth, extinction = truth_of(scene, result)
    assert rms(result.optical_depth - depth) <= 0.16
    assert rms(result.extinction - extinction) <= 3.0 * PER_KM
    two_angles = 0.144 * np.sqrt(2.0) / (2.0 * (scene.secant[-1] - 1.0))
    assert rms(result.optical_depth - depth) <= two_angles / 3.0


def test_smoothing_error_is_less_than_the_standard_error():
    scene = clear(3000.0)
    result = solve(scene, estimates(scene, 600, np.random.default_rng(6)))
    bias = np.nanmean(result.optical_depth - scene.truth, axis=0)
    typical = np.nanmean(result.optical_depth_standard_error, axis=0)
    assert np.nanmax(np.abs(bias) / typical) < 1.0


# Layers, gradients, outliers ----------------------------------------------------------------


@pytest.mark.parametrize("profiles", [2, 300])
def test_standard_errors_of_layers_cover_the_truth(profiles):
    scene = clear(3000.0)
    rng = np.random.default_rng(8)
    scores = []
    for _ in range(max(2, 120 // profiles)):
        result = solve(scene, estimates(scene, profiles, rng))
        for bottom, top in ((600.0, 1590.0), (1500.0, 2010.0), (2400.0, 3600.0)):
            depth, error = result.layer(*np.searchsorted(scene.altitude, (bottom, top)))
            lower, upper = np.interp((bottom, top), scene.altitude, scene.truth)
            scores.append((depth - upper + lower) / error)
    score = np.abs(np.concatenate(scores))
    assert 0.5 <= (score < 1.0).mean() <= 0.93
    assert (score < 1.96).mean() >= 0.88


@pytest.mark.parametrize("profiles", [3, 12])
def test_layer_from_the_station_is_the_optical_depth(profiles):
    depth, information, _ = plain(profiles, np.random.default_rng(0))
    result = smooth_optical_depth(depth, information, ALTITUDE)
    depth, error = result.layer(-1, 20)
    np.testing.assert_allclose(depth, result.optical_depth[:, 20])
    # Of all altitudes of a profile, factors are interpolated.
    np.testing.assert_allclose(error, result.optical_depth_standard_error[:, 20], rtol=0.01)
    depth, error = result.layer(20, 21)
    np.testing.assert_allclose(depth, 30.0 * result.extinction[:, 21], rtol=1e-9)
    np.testing.assert_allclose(error, 30.0 * result.extinction_standard_error[:, 21], rtol=0.01)


def test_monotone_profile_is_near_and_never_decreases():
    depth, information, truth = plain(40, np.random.default_rng(12), error=0.1)
    result = smooth_optical_depth(depth, information, ALTITUDE)
    rising = nearest_rising(result.optical_depth)
    assert np.all(np.diff(rising, axis=1) >= 0.0)
    assert rms(rising - truth) <= 1.001 * rms(result.optical_depth - truth)


# Missing and extreme estimates ---------------------------------------------------------------


@pytest.mark.parametrize("profiles", [3, 12])
def test_missing_estimates_are_interpolated_and_flagged(profiles):
    depth, information, truth = plain(profiles, np.random.default_rng(20))
    depth[0, :4] = np.nan
    information[0, 20:26] = np.nan
    depth[1, 50:] = np.nan
    result = smooth_optical_depth(depth, information, ALTITUDE)
    np.testing.assert_array_equal(
        np.flatnonzero(result.interpolated[0]), [*range(4), *range(20, 26)]
    )
    assert np.isfinite(result.optical_depth[0]).all()
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(result.optical_depth[1])), range(50))
    for values in (
        result.optical_depth,
        result.optical_depth_standard_error,
        result.extinction,
        result.extinction_standard_error,
        result.data_share,
    ):
        assert np.isnan(values[1, 50:]).all()
    assert np.abs(result.optical_depth - truth)[0].max() < 0.05
    middle = result.optical_depth_standard_error[0, 22]
    assert middle > 0.9 * result.optical_depth_standard_error[2, 22]


@pytest.mark.parametrize("altitudes", [1, 2, 3, 4])
@pytest.mark.parametrize("profiles", [1, 9])
def test_few_altitudes_are_solved(altitudes, profiles):
    depth, information, truth = plain(
        profiles, np.random.default_rng(23), altitude=ALTITUDE[:altitudes]
    )
    result = smooth_optical_depth(depth, information, ALTITUDE[:altitudes])
    assert (np.abs(result.optical_depth - truth) < 0.1).all()
    assert (result.optical_depth_standard_error > 0.0).all()
    assert (result.optical_depth_standard_error < 0.03).all()
    if altitudes == 1:
        np.testing.assert_allclose(result.optical_depth, depth, rtol=1e-9)
        np.testing.assert_allclose(result.optical_depth_standard_error, 0.02, rtol=1e-6)


@given(seed=st.integers(0, 2**32 - 1), profiles=st.integers(1, 12), altitudes=st.integers(1, 30))
@settings(max_examples=60, deadline=None)
def test_any_pattern_of_estimates_is_solved_or_withheld(seed, profiles, altitudes):
    rng = np.random.default_rng(seed)
    shape = (profiles, altitudes)
    depth = rng.normal(size=shape) * 10.0 ** rng.uniform(-6.0, 5.0, shape)
    information = 10.0 ** (rng.uniform(-9.0, 9.0) + rng.uniform(-2.0, 2.0, shape))
    information[rng.random(shape) < rng.random()] = rng.choice([0.0, np.nan])
    information[:, rng.integers(altitudes)] = 1.0
    result = smooth_optical_depth(depth, information, ALTITUDE[:altitudes])
    known = np.isfinite(information) & (information > 0.0)
    within = np.cumsum(known[:, ::-1], axis=1)[:, ::-1] > 0
    for values in (result.optical_depth, result.extinction):
        np.testing.assert_array_equal(np.isfinite(values), within)
    for values in (result.optical_depth_standard_error, result.extinction_standard_error):
        np.testing.assert_array_equal(np.isfinite(values), within)
        assert (values[within] > 0.0).all()
    np.testing.assert_array_equal(result.interpolated, within & ~known)


# Blocks -------------------------------------------------------------------------------------


def test_unit_of_the_noise_scales_the_errors_only():
    depth, information, _ = plain(12, np.random.default_rng(33))
    base = smooth_optical_depth(depth, information, ALTITUDE)
    scaled = smooth_optical_depth(1e3 * depth, 1e-6 * information, ALTITUDE)
    np.testing.assert_allclose(scaled.optical_depth, 1e3 * base.optical_depth, rtol=1e-9)
    np.testing.assert_allclose(
        scaled.extinction_standard_error, 1e3 * base.extinction_standard_error, rtol=1e-7
    )


# Residuals and flags ------------------------------------------------------------------------


def test_data_share_is_the_response_to_the_solution_where_that_is_significant():
    depth = np.where(ALTITUDE > 1500.0, (ALTITUDE - 1500.0) * 2e-3, 0.0) + 1e-5 * ALTITUDE
    noisy = depth + 0.3 * np.random.default_rng(45).normal(size=(40, 60))
    result = smooth_optical_depth(noisy, np.full(noisy.shape, 0.3**-2.0), ALTITUDE)
    response = result.respond(result.optical_depth)
    known = np.isfinite(result.data_share)
    np.testing.assert_allclose(
        result.data_share[known], (response / result.optical_depth)[known], rtol=1e-9
    )
    significant = np.abs(result.optical_depth) > result.optical_depth_standard_error
    np.testing.assert_array_equal(known, significant)


def test_common_residuals_in_noise_are_no_correlation_of_the_air():
    """The far half is noise, with a common error along each beam, as of the background."""
    rng = np.random.default_rng(41)
    shape = (30, 8, 60)
    noise = np.where(np.arange(60) < 30, 1e-4, 0.04)
    variance = np.full(60, 0.03**2)
    residual = np.sqrt(noise + variance) * rng.normal(size=shape)
    columns = np.ones((2, 8, 60)) * np.arange(8)[:, np.newaxis]
    residual += 0.5 * np.sqrt(noise) * (noise > 1e-3) * rng.normal(size=(30, 8, 1))
    noise = np.broadcast_to(noise, shape).copy()
    assert correlation_of_air(residual, noise, np.zeros(shape), variance, columns) < 0.1


@pytest.mark.parametrize("missing", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_correlation_is_that_of_the_air_though_beams_are_missing(correlation, missing):
    rng, shape = np.random.default_rng(40), (200, 6, 40)
    path = 1.0 / np.cos(np.radians(np.linspace(0.0, 60.0, 6)))
    air = 0.1 * correlated(rng, shape, correlation)
    there = rng.random(shape) >= missing
    residual, leverage = np.full(shape, np.nan), np.ones(shape)
    for t, k in np.ndindex(200, 40):
        on = there[t, :, k]
        columns = np.linalg.qr(np.stack([np.ones(on.sum()), path[on]], axis=1))[0]
        residual[t, on, k] = air[t, on, k] - columns @ (columns.T @ air[t, on, k])
        leverage[t, on, k] = (columns**2).sum(axis=1)
    noise = np.where(there, 1e-12, np.inf)
    columns = np.stack([np.ones((6, 40)), np.repeat(path[:, np.newaxis], 40, axis=1)])
    found = correlation_of_air(residual, noise, leverage, np.full(40, 0.01), columns)
    assert found == pytest.approx(correlation, abs=0.03)


def noise_of(profiles, *, correlation=0.0, shared=1.0, freedom=1e9):
    """Return noise of the shape of `plain`."""
    shape = (profiles, ALTITUDE.size - 1)
    return AltitudeNoise(correlation, np.full(shape, shared), np.full(ALTITUDE.size, freedom))


@pytest.mark.parametrize("freedom", [1e9, 30.0, 0.0])
def test_noise_estimated_from_few_residuals_widens_the_errors(freedom):
    depth, information, _ = plain(12, np.random.default_rng(41))
    known = smooth_optical_depth(depth, information, ALTITUDE)
    result = smooth_optical_depth(depth, information, ALTITUDE, noise=noise_of(12, freedom=freedom))
    number = max(freedom, 4.1)
    ratio = (result.optical_depth_standard_error / known.optical_depth_standard_error)[:, 20]
    np.testing.assert_allclose(ratio**2, number / (number - 2.0), rtol=1e-9)


def test_correlated_noise_has_wider_errors():
    depth, information, _ = plain(12, np.random.default_rng(42))
    errors = [
        smooth_optical_depth(
            depth, information, ALTITUDE, noise=noise_of(12, correlation=correlation)
        ).optical_depth_standard_error.mean()
        for correlation in (0.0, 0.6, 0.9)
    ]
    assert errors[0] < errors[1] < errors[2]


def test_detector_noise_is_taken_as_uncorrelated():
    depth, information, _ = plain(12, np.random.default_rng(43))
    uncorrelated = smooth_optical_depth(depth, information, ALTITUDE)
    noise = noise_of(12, correlation=0.8, shared=0.0)
    result = smooth_optical_depth(depth, information, ALTITUDE, noise=noise)
    np.testing.assert_allclose(result.optical_depth, uncorrelated.optical_depth, rtol=1e-12)


# Refusals -----------------------------------------------------------------------------------


def test_altitudes_that_are_not_uniform_are_refused():
    with pytest.raises(RetrievalInputError) as caught:
        smooth_optical_depth(np.zeros((4, 60)), np.ones((4, 60)), ALTITUDE**1.1)
    assert caught.value.field == "altitude"
