"""Regression on the slant path at single altitudes: against numpy, exact numbers, simulations."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each
from support.oracles.multiangle import (
    ANGLES,
    PATHS,
    clear,
    coverage,
    least_squares,
    rms,
    signals,
)
from support.scan_arguments import retrieve_optical_depth

from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.retrieve.multiangle import _kano_hamilton as kh

SIDES = np.array([-70.0, -55.0, -40.0, -20.0, 0.0, 15.0, 35.0, 50.0, 65.0, 75.0])
HEIGHT = np.arange(300.0, 2100.0, 30.0)


def fit(y, variance, path, distance=None, *, sides=False):
    """Return table, residuals and leverages of a block of such beams."""
    columns = _block.fit_columns(path, np.zeros((2, *path.shape)) if distance is None else distance)
    alive = np.full((len(y), y.shape[2]), y.shape[1])
    beams = _block.BeamBlock(y, variance, columns, alive, sides, 3)
    nothing = np.zeros(y.shape[2])
    result = _block.refit(beams, nothing, nothing)
    return result.table, result.residual, result.leverage


def fitted(y, variance, path):
    """Return the table of the kernel."""
    return fit(y, variance, path)[0]


def some_beams(rng, profiles=3, angles=7, altitudes=70):
    path = np.repeat(np.sort(rng.uniform(1, 4, angles))[:, np.newaxis], altitudes, axis=1)
    y = rng.normal(size=(profiles, angles, altitudes)) - 20
    return y, rng.uniform(0.5, 2, y.shape), path


# Algebra ------------------------------------------------------------------------------------


def test_the_kernel_agrees_with_numpy():
    y, variance, path = some_beams(np.random.default_rng(1))
    table, residual, leverage = fit(y, variance, path)
    for t, k in ((0, 0), (1, 63), (2, 64), (2, 69)):
        columns = [np.ones(7), -2 * path[:, k]]
        solution, covariance = least_squares(columns, y[t, :, k], variance[t, :, k])
        row = table[t, :, k]
        assert row[kh.TAU] == pytest.approx(solution[1], abs=1e-11)
        assert row[kh.INTERCEPT] == pytest.approx(solution[0], abs=1e-11)
        assert 1 / row[kh.INFORMATION] == pytest.approx(covariance[1, 1], rel=1e-11)
        assert row[kh.INTERCEPT_VARIANCE] == pytest.approx(covariance[0, 0], rel=1e-11)
        left = y[t, :, k] - np.stack(columns, axis=-1) @ solution
        assert residual[t, :, k] == pytest.approx(left, abs=1e-11)
        assert row[kh.CHI2] == pytest.approx(np.sum(left**2 / variance[t, :, k]), rel=1e-10)
        design = np.stack(columns, axis=-1)
        hat = np.einsum("ai,ij,aj->a", design, covariance, design) / variance[t, :, k]
        assert leverage[t, :, k] == pytest.approx(hat, rel=1e-10)
        assert row[kh.TRACE] == pytest.approx(np.sum((1 - hat) / variance[t, :, k]), rel=1e-10)


def test_gradients_agree_with_numpy():
    rng = np.random.default_rng(2)
    scan = slant_paths.make_scan(SIDES, HEIGHT, rng.uniform(0, 360, SIDES.size))
    distance = np.stack([scan.east, scan.north])
    y = rng.normal(size=(2, SIDES.size, HEIGHT.size))
    variance = rng.uniform(0.5, 2, y.shape)
    table, residual, _ = fit(y, variance, scan.path, distance, sides=True)
    assert np.all(table[:, kh.FREEDOM] == SIDES.size - 4)
    assert np.all(table[:, kh.SLOPES :] == 0.0)
    columns = [np.ones(SIDES.size), -2 * scan.path[:, 7], distance[0, :, 7], distance[1, :, 7]]
    solution, covariance = least_squares(columns, y[1, :, 7], variance[1, :, 7])
    assert table[1, kh.TAU, 7] == pytest.approx(solution[1], abs=1e-11)
    assert table[1, kh.INTERCEPT, 7] == pytest.approx(solution[0], abs=1e-11)
    assert 1 / table[1, kh.INFORMATION, 7] == pytest.approx(covariance[1, 1], rel=1e-10)
    assert table[1, kh.INTERCEPT_VARIANCE, 7] == pytest.approx(covariance[0, 0], rel=1e-10)
    left = y[1, :, 7] - np.stack(columns, axis=-1) @ solution
    assert residual[1, :, 7] == pytest.approx(left, abs=1e-11)


@given(st.integers(0, 2**31), st.permutations(range(7)))
@settings(max_examples=25, deadline=None)
def test_order_of_the_beams_has_no_effect(seed, order):
    y, variance, path = some_beams(np.random.default_rng(seed), altitudes=5)
    ordered, permuted = (
        fitted(y, variance, path),
        # In C order, for which the kernel is compiled already.
        fitted(np.take(y, order, axis=1), np.take(variance, order, axis=1), path[list(order)]),
    )
    assert permuted == pytest.approx(ordered, rel=1e-11, abs=1e-12)


def test_missing_beams_have_no_effect():
    rng = np.random.default_rng(3)
    y, variance, path = some_beams(rng)
    missing = rng.random(7) < 0.4
    variance[:, missing], y[:, missing] = np.inf, 0.0
    whole, subset = (
        fitted(y, variance, path),
        fitted(
            np.compress(~missing, y, axis=1),
            np.compress(~missing, variance, axis=1),
            path[~missing],
        ),
    )
    assert whole == pytest.approx(subset, rel=1e-9, abs=1e-9)


def test_two_beams_are_the_two_angle_formula():
    y, variance, path = some_beams(np.random.default_rng(4), angles=2)
    expected = -(y[:, 1] - y[:, 0]) / (2 * (path[1] - path[0]))
    tau = fitted(y, variance, path)[:, kh.TAU]
    assert tau == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("last", [15.0, 2.56, 60.0])
def test_noise_free_beams_give_the_truth(last):
    path = 1 / np.cos(np.radians(np.linspace(0.0, last, 6)))
    tau = np.linspace(0.0, 5.0, 40)
    with mp.workdps(40):
        y = np.array([[float(-20 - 2 * mp.mpf(x) * mp.mpf(t)) for t in tau] for x in path])
    x = np.repeat(path[:, np.newaxis], tau.size, axis=1)
    error = fitted(y[np.newaxis], np.ones((1, *y.shape)), x)[0, kh.TAU] - tau
    assert np.max(np.abs(error)) < 1e-12 / np.ptp(path)


@pytest.mark.parametrize("path", [[2.0, 2.0, 2.0], [1.5]])
def test_equal_paths_give_no_optical_depth(path):
    x = np.repeat(np.array(path)[:, np.newaxis], 3, axis=1)
    table = fitted(np.ones((1, *x.shape)), np.ones((1, *x.shape)), x)
    assert np.all(np.isnan(table[:, kh.TAU]))
    assert np.all(table[:, kh.INFORMATION] == 0)


# Noise --------------------------------------------------------------------------------------


def test_regression_reaches_the_bound_and_states_its_error():
    rng = np.random.default_rng(5)
    path = 1 / np.cos(np.radians(np.linspace(0, 30, 6)))
    x = np.repeat(path[:, np.newaxis], 8, axis=1)
    y = 0.147 * rng.normal(size=(4000, 6, 8))
    table = fitted(y, np.full(y.shape, 0.147**2), x)
    bound = 0.147 / 2 / np.sqrt(np.sum((path - path.mean()) ** 2))
    assert rms(table[:, kh.TAU]) == pytest.approx(bound, rel=0.02)
    np.testing.assert_allclose(1 / np.sqrt(table[:, kh.INFORMATION]), bound, rtol=1e-10)
    within_1, within_2 = coverage(table[:, kh.TAU], bound)
    assert within_1 == pytest.approx(68, abs=2)
    assert within_2 == pytest.approx(95, abs=1.5)


def test_inhomogeneity_is_estimated_and_standard_errors_are_right():
    atmosphere = clear(60)
    signal, variance, tau = signals(
        np.random.default_rng(6), 200, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.03
    )
    result = retrieve_optical_depth(
        signal, ANGLES, atmosphere[0], variance=variance, method="kano_hamilton"
    )
    np.testing.assert_allclose(result.inhomogeneity, 0.03, rtol=0.06)
    within_1, within_2 = coverage(result.optical_depth - tau, result.optical_depth_standard_error)
    assert within_1 == pytest.approx(68, abs=2)
    assert within_2 == pytest.approx(95, abs=1.5)
    intercept = result.log_intercept - np.log(atmosphere[2])
    within_1, within_2 = coverage(intercept, result.log_intercept_standard_error)
    assert within_1 == pytest.approx(68, abs=2)
    assert within_2 == pytest.approx(95, abs=1.5)
    assert np.nanmean(result.reduced_chi_square) == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("ratio", [30.0, 10.0])
def test_weak_signals_are_not_biased(ratio):
    rng = np.random.default_rng(7)
    noise = np.exp(-0.4) / ratio * PATHS[:, np.newaxis] ** 2
    mean = np.exp(-0.4 * PATHS)[:, np.newaxis]
    signal = mean + noise * rng.normal(size=(2500, 12, 12))
    height = 1000.0 + 30.0 * np.arange(12)
    result = retrieve_optical_depth(
        signal, ANGLES, height, variance=noise**2, method="kano_hamilton"
    )
    error = result.optical_depth[:, 2:] - 0.2
    assert abs(np.nanmean(error)) < 0.05 * np.nanstd(error)
    # Selecting samples above twice their noise has a far larger bias.
    strong = signal > 2 * noise
    y = np.where(strong, np.log(np.where(strong, signal, 1.0)), 0.0)
    x = np.repeat(PATHS[:, np.newaxis], 12, axis=1)
    naive = fitted(y, np.where(strong, (noise / mean) ** 2, np.inf), x)[:, kh.TAU] - 0.2
    assert np.nanmean(naive) < -0.1 * np.nanstd(naive)


# Standard errors ----------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["kano_hamilton", "joint"])
def test_errors_in_a_thin_cloud_are_those_of_its_counts(method):
    """A cloud of one altitude in air of 15 to 350 counts, whose noise is less than that of it."""
    rng, height = np.random.default_rng(11), 200.0 + 50.0 * np.arange(60)
    depth, beta = 5e-5 * height, np.where(np.arange(60) == 30, 300.0, 1.0)
    square = (height * PATHS[:, np.newaxis]) ** 2
    counts = 1.0 + 1.2e9 / square * beta * np.exp(-2.0 * PATHS[:, np.newaxis] * depth)
    signal = (rng.poisson(counts, (320, *counts.shape)) - 1.0) * square
    away = []
    for cycles in np.split(signal, 40):
        result = retrieve_optical_depth(
            cycles, ANGLES, height, variance=counts * square**2, method=method
        )
        error = result.optical_depth - depth
        away.append((error / result.optical_depth_standard_error)[:, 30])
    assert 0.7 < np.sqrt(np.mean(np.square(away))) < 1.1


@each("method", ["kano_hamilton", "two_angle"])
@each("correlation", [0.0, 0.6, 0.9])
def test_extinction_allows_for_errors_that_neighbouring_altitudes_share(method, correlation):
    """As differences of independent errors, 95 percent intervals covered 99.6 and 100 percent."""
    atmosphere, rng = clear(100), np.random.default_rng(23)
    options = {"ratio": 1e4, "inhomogeneity": 0.05, "correlation": correlation}
    error, stated = [], []
    for _ in range(8):
        signal, variance, _ = signals(rng, 8, ANGLES, atmosphere, **options)
        result = retrieve_optical_depth(
            signal, ANGLES, atmosphere[0], variance=variance, method=method
        )
        error.append(result.extinction - atmosphere[1])
        stated.append(result.extinction_standard_error)
    one, two = coverage(np.array(error), np.array(stated))
    assert 66 < one < 72
    assert 94 < two < 97


# Gradients ----------------------------------------------------------------------------------


def test_gradient_does_not_affect_scans_to_both_sides():
    rng = np.random.default_rng(10)
    angles = np.concatenate([-ANGLES[1::2], ANGLES[::2]])
    atmosphere = clear(60)
    known = {"ratio": 1e5, "inhomogeneity": 0.03}
    signal, variance, tau = signals(rng, 200, angles, atmosphere, gradient=0.05 / 1000, **known)
    options = {"variance": variance, "method": "kano_hamilton"}
    both = retrieve_optical_depth(signal, angles, atmosphere[0], **options)
    error = (both.optical_depth - tau)[:, 28]
    assert abs(error.mean()) < 0.001 + 3 * error.std() / np.sqrt(200)
    signal, variance, _ = signals(rng, 200, np.abs(angles), atmosphere, **known)
    alone = retrieve_optical_depth(signal, np.abs(angles), atmosphere[0], **options)
    ratio = both.optical_depth_standard_error / alone.optical_depth_standard_error
    assert np.nanmedian(ratio) < 1.05
    assert np.nanmax(both.optical_depth_gradient_error) < 1e-12


def test_scans_to_one_side_bound_a_gradient():
    rng = np.random.default_rng(11)
    atmosphere = clear(100)
    results = []
    for gradient in (0.0, 0.05 / 1000):
        signal, variance, tau = signals(
            rng, 100, ANGLES, atmosphere, ratio=1e5, inhomogeneity=0.03, gradient=gradient
        )
        options = {"variance": variance, "method": "kano_hamilton"}
        results.append(retrieve_optical_depth(signal, ANGLES, atmosphere[0], **options))
    clean, tilted = results
    bias = np.mean(tilted.optical_depth - tau, axis=0)
    bound = tilted.optical_depth_gradient_error.mean(axis=0)
    # The bound for 5 percent per km is the bias by that gradient.
    assert bound == pytest.approx(np.abs(bias), abs=0.006)
    assert bound[28] > 3 * clean.optical_depth_standard_error[:, 28].mean()


def test_beams_to_all_sides_fit_the_gradient_at_no_cost():
    rng = np.random.default_rng(12)
    angles = np.tile([0.0, 40.0, 60.0, 75.0], 3)
    height = np.array([1000.0])
    y = rng.normal(size=(1, 12, 1))
    for azimuths, free in (([0, 120, 240], True), ([0, 180, 180], True), ([0, 0, 0], False)):
        scan = slant_paths.make_scan(angles, height, np.repeat(azimuths, 4))
        distance = np.stack([scan.east, scan.north])
        plain, fitted = (
            fit(y, np.ones_like(y), scan.path, distance, sides=sides)[0][0, :, 0]
            for sides in (False, True)
        )
        assert np.all(fitted[kh.SLOPES :] == 0.0) == free
        if free:
            assert plain[kh.INFORMATION] / fitted[kh.INFORMATION] < 1.05**2


def test_inhomogeneity_that_changes_with_altitude_is_followed():
    rng = np.random.default_rng(13)
    height = np.arange(100.0, 4100.0, 50.0)
    spread = np.where(height < 2000, 0.01, 0.2)
    signal = np.exp(spread * rng.normal(size=(8, 3, height.size)))
    result = retrieve_optical_depth(
        signal, [0.0, 35.0, 66.0], height, variance=1e-12, method="kano_hamilton"
    )
    inhomogeneity = result.inhomogeneity[0]
    assert inhomogeneity[:30] == pytest.approx(0.01, rel=0.3)
    assert inhomogeneity[-30:] == pytest.approx(0.2, rel=0.3)


def test_student_factor_widens_for_few_residuals():
    factor = _block.student_factor(np.array([0.0, 5.0, 30.0, 1e6]))
    assert factor == pytest.approx([1.0, np.sqrt(5 / 3), np.sqrt(30 / 28), 1.0], rel=1e-5)
