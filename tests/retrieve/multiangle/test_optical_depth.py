"""The whole retrieval: error and coverage in scenes, extreme cases and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each
from support.oracles.multiangle import (
    ANGLES,
    clear,
    cloud,
    correlated,
    coverage,
    depth,
    rms,
    signals,
)
from support.scan_arguments import retrieve_optical_depth

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

METHODS = ("auto", "two_angle", "kano_hamilton", "joint", "mld", "mld_prior")
STEEP = np.linspace(0.0, 30.0, 6)
PROFILES = (
    "optical_depth",
    "optical_depth_standard_error",
    "optical_depth_gradient_error",
    "extinction",
    "extinction_standard_error",
    "extinction_gradient_error",
    "log_intercept",
    "log_intercept_standard_error",
    "data_share",
    "inhomogeneity",
    "reduced_chi_square",
    "effective_degrees_of_freedom",
    "reach",
    "residual",
    "layer_optical_depth",
    "layer_optical_depth_standard_error",
)


@pytest.fixture(scope="module")
def small():
    """Signals, variance, altitudes and optical depths of a small clear scene."""
    atmosphere = clear(80)
    signal, variance, tau = signals(
        np.random.default_rng(1), 16, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.03
    )
    return signal, variance, atmosphere[0], tau


def assert_same(first, second):
    for name in PROFILES:
        assert np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True), name
    assert np.array_equal(first.quality, second.quality)


def close(first, second):
    return first == pytest.approx(second, rel=1e-9, abs=1e-10, nan_ok=True)


# Scenes -------------------------------------------------------------------------------------


def test_clear_air_to_six_kilometres():
    atmosphere = clear()
    signal, variance, tau = signals(
        np.random.default_rng(2), 150, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.03
    )
    options = {"variance": variance}
    joint = retrieve_optical_depth(signal, ANGLES, atmosphere[0], **options)
    single = retrieve_optical_depth(
        signal, ANGLES, atmosphere[0], method="kano_hamilton", **options
    )
    error = joint.optical_depth - tau
    assert rms(error) <= 0.010
    assert rms(error) <= rms(single.optical_depth - tau) / 5
    assert rms(joint.extinction - atmosphere[1]) <= 0.010e-3
    assert joint.method == "joint"
    within_1, within_2 = coverage(error, joint.optical_depth_standard_error)
    assert 62 < within_1 < 78
    assert within_2 > 93
    assert coverage(joint.extinction - atmosphere[1], joint.extinction_standard_error)[1] > 93


def test_standard_errors_hold_in_weak_light():
    atmosphere = clear()
    signal, variance, tau = signals(
        np.random.default_rng(3), 150, ANGLES, atmosphere, ratio=300, inhomogeneity=0.03
    )
    joint = retrieve_optical_depth(signal, ANGLES, atmosphere[0], variance=variance)
    within_1, within_2 = coverage(joint.optical_depth - tau, joint.optical_depth_standard_error)
    assert 60 < within_1 < 82
    assert within_2 > 92
    assert np.isfinite(joint.inhomogeneity).any()
    # Where fewer of the 12 beams are bright, it includes what the series of the noise leaves out.
    bright = np.count_nonzero(signal.mean(axis=0) > 3.0 * np.sqrt(variance[0]), axis=0) > 7
    assert np.nanpercentile(joint.inhomogeneity[:, bright], 90) < 0.045
    assert not joint.raised(MultiAngleQuality.POOR_STRATIFICATION).any()


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_cloud_at_30_degrees(correlation):
    atmosphere = cloud()
    signal, variance, tau = signals(
        np.random.default_rng(4),
        150,
        STEEP,
        atmosphere,
        ratio=1e7,
        inhomogeneity=0.144,
        correlation=correlation,
    )
    joint = retrieve_optical_depth(signal, STEEP, atmosphere[0], variance=variance)
    error = joint.optical_depth - tau
    within_1, within_2 = coverage(error, joint.optical_depth_standard_error)
    assert 58 < within_1 < 78
    assert within_2 > 91
    if correlation == 0:
        assert rms(error) <= 0.16
        assert rms(joint.extinction - atmosphere[1]) <= 3.0e-3
        pair = retrieve_optical_depth(
            signal, STEEP, atmosphere[0], variance=variance, method="two_angle"
        )
        assert rms(error) <= rms(pair.optical_depth - tau) / 3


@pytest.mark.parametrize("total", [5.0, 20.0])
def test_thick_cloud_is_withheld_where_it_attenuates_the_beams(total):
    height = 10.0 * np.arange(1, 61)
    tau = depth(height, np.full(60, total / 600.0))
    rng = np.random.default_rng(5)
    path = 1 / np.cos(np.radians(STEEP))[:, np.newaxis]
    noise = 1e-4
    signal = np.exp(-2 * path * tau + 0.144 * rng.normal(size=(200, 6, 60)))
    signal += noise * rng.normal(size=signal.shape)
    for method in ("kano_hamilton", "joint"):
        result = retrieve_optical_depth(signal, STEEP, height, variance=noise**2, method=method)
        error = result.optical_depth - tau
        assert coverage(error, result.optical_depth_standard_error)[1] >= 93
        beyond = height > result.reach[:, np.newaxis]
        assert beyond.any()
        assert np.array_equal(result.raised(MultiAngleQuality.EXTRAPOLATED), beyond)
        assert not np.isfinite(result.optical_depth[beyond]).any()
        assert not np.isfinite(result.extinction[beyond]).any()
        assert 3.0 < np.median(np.interp(result.reach, height, tau)) < 4.5


@pytest.mark.parametrize(("last", "varies"), [(15, True), (30, True), (15, False), (30, False)])
def test_extinction_that_varies_along_the_paths_is_flagged(last, varies):
    height, extinction, _ = cloud()
    angles = np.linspace(0, last, 6)
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    air = 0.144 * correlated(np.random.default_rng(6), (60, 6, 40), 0.5)
    tau = np.cumsum(10.0 * extinction * np.exp(air if varies else 0.0 * air), axis=-1)
    result = retrieve_optical_depth(np.exp(air - 2 * path * tau), angles, height, variance=1e-12)
    assert result.raised(MultiAngleQuality.POOR_STRATIFICATION).all() == varies
    assert np.isfinite(result.extinction).any() != varies


def test_gradient_error_bounds_the_bias_by_the_declared_gradient():
    atmosphere = clear(100)
    signal, variance, tau = signals(
        np.random.default_rng(7), 32, ANGLES, atmosphere, inhomogeneity=0.03, gradient=0.04 / 1000
    )
    joint = retrieve_optical_depth(signal, ANGLES, atmosphere[0], variance=variance)
    bias = np.abs(np.mean(joint.optical_depth - tau, axis=0))
    assert np.all(bias < joint.optical_depth_gradient_error[0] + 0.01)
    assert bias.max() > 5 * np.median(joint.optical_depth_standard_error)


@pytest.mark.parametrize("gradient", [0.0, 0.05 / 1000, 0.2 / 1000])
def test_a_gradient_that_residuals_show_is_part_of_the_error(gradient):
    """Whatever the campaign declares; without one, nothing is added."""
    atmosphere = clear(100)
    signal, variance, tau = signals(
        np.random.default_rng(7), 32, ANGLES, atmosphere, inhomogeneity=0.03, gradient=gradient
    )
    for method in ("joint", "kano_hamilton"):
        result = retrieve_optical_depth(
            signal, ANGLES, atmosphere[0], variance=variance, largest_gradient=0.0, method=method
        )
        bias = np.abs(np.mean(result.optical_depth - tau, axis=0))
        error = result.optical_depth_gradient_error.mean(axis=0)
        assert error[10:] == pytest.approx(bias[10:] if gradient else 0.0, rel=0.3, abs=0.01)
        assert np.all((result.extinction_gradient_error > 0.0).any() == (gradient > 0.0))


@pytest.mark.parametrize("method", ["joint", "kano_hamilton"])
@pytest.mark.parametrize(("gradient", "rejected"), [(0.2 / 1000, False), (0.6 / 1000, True)])
def test_a_gradient_too_large_for_air_rejects_all_values(method, gradient, rejected):
    """Like a distorted analog signal, it hides what else curves the residuals."""
    atmosphere = clear(100)
    signal, variance, _ = signals(
        np.random.default_rng(8), 32, ANGLES, atmosphere, inhomogeneity=0.01, gradient=gradient
    )
    result = retrieve_optical_depth(signal, ANGLES, atmosphere[0], variance=variance, method=method)
    known = np.isfinite(result.optical_depth)
    assert (result.raised(MultiAngleQuality.POOR_STRATIFICATION)[known] == rejected).all()
    assert np.isfinite(result.extinction).any() != rejected


def test_layers_are_far_more_certain_than_differences():
    atmosphere = clear(120)
    signal, variance, tau = signals(
        np.random.default_rng(15), 100, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.03
    )
    layers = [(0.0, 900.0), (1500.0, 2500.0)]
    truth = [tau[25], np.interp(2500, atmosphere[0], tau) - np.interp(1500, atmosphere[0], tau)]
    options = {"variance": variance, "layers": layers}
    joint = retrieve_optical_depth(signal, ANGLES, atmosphere[0], **options)
    single = retrieve_optical_depth(
        signal, ANGLES, atmosphere[0], method="kano_hamilton", **options
    )
    for result in (joint, single):
        error = result.layer_optical_depth - truth
        assert coverage(error, result.layer_optical_depth_standard_error)[1] > 90
    assert rms(joint.layer_optical_depth[:, 1] - truth[1]) < 0.4 * rms(
        single.layer_optical_depth[:, 1] - truth[1]
    )
    assert single.layer_optical_depth[:, 0] == pytest.approx(single.optical_depth[:, 25])


# Extreme cases ------------------------------------------------------------------------------


@each("method", METHODS)
def test_one_path_gives_no_optical_depth(small, method):
    signal, variance, height, _ = small
    for angles in ([ANGLES[3]], [30.0, 30.0, 30.0], [88.0, 89.0]):
        n = len(angles)
        result = retrieve_optical_depth(
            signal[:, :n], angles, height, variance=variance[:, :n], method=method
        )
        assert np.all(np.isnan(result.optical_depth))
        assert np.all(np.isnan(result.reach))
        assert result.raised(MultiAngleQuality.NO_LEVERAGE).all()
        assert np.all(result.quality == MultiAngleQuality.NO_LEVERAGE)


def test_tiny_leverage_has_a_correct_error():
    path = 1 + np.linspace(0, 0.001, 12)
    height, extinction, _ = clear(60)
    tau = depth(height, extinction)
    rng = np.random.default_rng(8)
    signal = np.exp(-2 * path[:, np.newaxis] * tau + 0.03 * rng.normal(size=(100, 12, 60)))
    angles = np.degrees(np.arccos(1 / path))
    result = retrieve_optical_depth(signal, angles, height, variance=1e-12, method="kano_hamilton")
    assert np.median(result.optical_depth_standard_error) == pytest.approx(14.4, rel=0.05)
    assert rms(result.optical_depth - tau) == pytest.approx(14.4, rel=0.05)


@each("method", METHODS)
def test_beams_at_the_horizon_have_no_effect(small, method):
    signal, variance, height, _ = small
    horizon = np.concatenate([signal, np.ones_like(signal[:, :2])], axis=1)
    noise = np.concatenate([variance, np.ones_like(variance[:, :2])], axis=1)
    with_them = retrieve_optical_depth(
        horizon, [*ANGLES, 89.0, 90.0], height, variance=noise, method=method
    )
    without = retrieve_optical_depth(signal, ANGLES, height, variance=variance, method=method)
    assert close(with_them.optical_depth, without.optical_depth)
    assert close(with_them.optical_depth_standard_error, without.optical_depth_standard_error)


@each("method", METHODS)
def test_invalid_profiles_do_not_affect_others(small, method):
    signal, variance, height, tau = small
    broken = signal.copy()
    broken[0], broken[2], broken[3] = np.inf, -signal[2], np.nan
    broken[1, :, 50] = 1e300
    result = retrieve_optical_depth(broken, ANGLES, height, variance=variance, method=method)
    gone = [0, 2, 3]
    assert np.all(np.isnan(result.optical_depth[gone]))
    assert result.raised(MultiAngleQuality.NO_LEVERAGE)[gone].all()
    assert np.all(result.quality[[0, 3]] & Quality.INPUT_MISSING)
    whole = np.delete(np.arange(16), gone)
    values = np.delete(result.optical_depth[whole], 50, axis=1)
    assert np.all(np.isfinite(values))
    if method in {"auto", "joint"}:
        assert rms(result.optical_depth[whole] - tau) < 0.004
        assert result.raised(MultiAngleQuality.INTERPOLATED)[1, 50]


@each("method", METHODS)
@each("variance_of", [np.nan, np.inf])
def test_samples_without_a_variance_count_as_missing(small, method, variance_of):
    signal, variance, height, _ = small
    unknown = np.array(variance)
    unknown[3] = variance_of
    unknown[5, :, 20:30] = variance_of
    one_left = np.where(np.arange(ANGLES.size)[:, np.newaxis] > 0, np.nan, signal[6, :, 40:50])
    signal = signal.copy()
    signal[6, :, 40:50] = one_left
    result = retrieve_optical_depth(signal, ANGLES, height, variance=unknown, method=method)
    assert np.isnan(result.optical_depth[3]).all()
    assert np.all(result.quality[3] & Quality.INPUT_MISSING)
    withheld = np.isnan(result.optical_depth)
    assert np.all(result.quality[withheld] & rejecting((*Quality, *MultiAngleQuality)))
    assert not np.any(
        result.quality[~withheld] & (Quality.INPUT_MISSING | MultiAngleQuality.NO_LEVERAGE)
    )
    if method == "kano_hamilton":
        assert np.all(result.quality[5, 20:30] == Quality.INPUT_MISSING)
        assert np.all(result.quality[6, 40:50] == MultiAngleQuality.NO_LEVERAGE)


def test_gaps_are_interpolated_or_left(small):
    signal, variance, height, tau = small
    rng = np.random.default_rng(9)
    holes = np.where(rng.random(signal.shape) < 0.3, np.nan, signal)
    holes[:, :, 30:36] = np.nan
    holes[:, ::2, 60:] = np.nan
    single = retrieve_optical_depth(
        holes, ANGLES, height, variance=variance, method="kano_hamilton"
    )
    assert np.all(np.isnan(single.optical_depth[:, 30:36]))
    assert not single.raised(MultiAngleQuality.EXTRAPOLATED).any()
    joint = retrieve_optical_depth(holes, ANGLES, height, variance=variance)
    assert joint.raised(MultiAngleQuality.INTERPOLATED)[:, 30:36].all()
    assert rms(joint.optical_depth - tau) < 0.0125


def test_gaps_cost_no_more_than_the_samples_they_take():
    """Altitudes with different beams have less noise in common."""
    rng, atmosphere = np.random.default_rng(21), cloud()
    errors, with_gaps, deviations = [], [], []
    for _ in range(12):
        signal, variance, tau = signals(
            rng, 16, STEEP, atmosphere, ratio=1e7, inhomogeneity=0.144, correlation=0.8
        )
        gaps = np.where(rng.random(signal.shape) < 0.3, np.nan, signal)
        whole = retrieve_optical_depth(signal, STEEP, atmosphere[0], variance=variance)
        holed = retrieve_optical_depth(gaps, STEEP, atmosphere[0], variance=variance)
        errors.append(whole.optical_depth - tau)
        with_gaps.append(holed.optical_depth - tau)
        deviations.append(with_gaps[-1] / holed.optical_depth_standard_error)
    assert rms(np.array(with_gaps)) < 1.35 * rms(np.array(errors))
    assert np.mean(np.abs(deviations) > 4.0) < 0.01


@each("method", METHODS)
@each("altitudes", [1, 3])
def test_few_altitudes_and_one_profile_are_solved(small, method, altitudes):
    signal, variance, height, tau = small
    result = retrieve_optical_depth(
        signal[:1, :, :altitudes],
        ANGLES,
        height[:altitudes],
        variance=variance[:1, :, :altitudes],
        method=method,
    )
    assert result.optical_depth.shape == (1, altitudes)
    assert result.residual.shape == (1, 12, altitudes)
    assert result.reach.shape == (1,)
    if method != "mld":
        error = result.optical_depth - tau[:altitudes]
        assert np.all(np.abs(error) < 5 * result.optical_depth_standard_error)


def test_no_profile_at_all(small):
    signal, variance, height, _ = small
    result = retrieve_optical_depth(signal[:0], ANGLES, height, variance=variance[:0])
    assert result.optical_depth.shape == (0, height.size)


def test_constant_extinction_is_within_its_errors():
    height = 10.0 * np.arange(1, 41)
    atmosphere = (height, np.full(40, 0.24 / 400), np.ones(40))
    rng = np.random.default_rng(10)
    signal, variance, _ = signals(rng, 20, STEEP, atmosphere, ratio=1e9, inhomogeneity=1e-4)
    result = retrieve_optical_depth(signal, STEEP, height, variance=variance)
    assert result.optical_depth[:, -1] == pytest.approx(0.24, abs=0.002)
    score = (result.optical_depth - atmosphere[1] * height) / result.optical_depth_standard_error
    assert np.abs(score).max() < 4.5


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_units_of_the_signal_have_no_effect(small, scale):
    signal, variance, height, _ = small
    plain = retrieve_optical_depth(signal, ANGLES, height, variance=variance)
    other = retrieve_optical_depth(signal * scale, ANGLES, height, variance=variance * scale**2)
    assert other.optical_depth == pytest.approx(plain.optical_depth, abs=1e-10)
    assert other.log_intercept == pytest.approx(plain.log_intercept + np.log(scale), abs=1e-9)


def test_no_noise_is_taken_as_very_little(small):
    signal, _, height, _ = small
    nothing = retrieve_optical_depth(signal, ANGLES, height, variance=0.0)
    little = retrieve_optical_depth(signal, ANGLES, height, variance=(1e-6 * signal) ** 2)
    assert nothing.optical_depth == pytest.approx(little.optical_depth, abs=1e-11)


@pytest.mark.parametrize("beams", [1, 2])
@pytest.mark.parametrize("first", [0, 1])
def test_cycles_that_show_no_residual_do_not_stand_for_the_others(beams, first):
    """Every other one of 64: what a block has in common comes from at most 32."""
    atmosphere = clear()
    signal, variance, tau = signals(
        np.random.default_rng(4), 64, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.1
    )
    signal[first::2, beams:] = np.nan
    result = retrieve_optical_depth(
        signal, ANGLES, atmosphere[0], variance=variance, method="kano_hamilton"
    )
    whole = slice(1 - first, None, 2)
    deviation = (result.optical_depth - tau) / result.optical_depth_standard_error
    assert np.nanmean(deviation[whole] ** 2) == pytest.approx(1.0, abs=0.3)
    assert np.nanmedian(result.inhomogeneity) == pytest.approx(0.1, rel=0.1)


def test_two_beams_have_no_residual(small):
    signal, variance, height, _ = small
    ends = [0, 11]
    result = retrieve_optical_depth(
        signal[:, ends], ANGLES[ends], height, variance=variance[:, ends]
    )
    assert result.method == "two_angle"
    assert result.raised(MultiAngleQuality.NO_RESIDUAL).all()
    path = 1 / np.cos(np.radians(ANGLES[ends]))
    logarithm = np.log(signal[:, ends])
    expected = (logarithm[:, 0] - logarithm[:, 1]) / 2 / (path[1] - path[0])
    # The correction for noise is far smaller than the noise.
    assert result.optical_depth == pytest.approx(expected, abs=2e-3)


# Axes and layout ----------------------------------------------------------------------------


def test_layout_has_no_effect(small):
    signal, variance, height, _ = small
    plain = retrieve_optical_depth(signal, ANGLES, height, variance=variance)
    shaped = retrieve_optical_depth(
        np.asfortranarray(signal).astype(">f8"), ANGLES.tolist(), height, variance=variance[0]
    )
    assert_same(shaped, plain)
    signal.flags.writeable = False
    assert_same(retrieve_optical_depth(signal, ANGLES, height, variance=variance), plain)
    single = retrieve_optical_depth(signal.astype(np.float32), ANGLES, height, variance=variance)
    assert single.optical_depth == pytest.approx(plain.optical_depth, abs=1e-5)


def test_station_altitude_only_shifts_the_altitudes(small):
    signal, variance, height, _ = small
    plain = retrieve_optical_depth(signal, ANGLES, height, variance=variance)
    raised = retrieve_optical_depth(
        signal, ANGLES, height + 500.0, variance=variance, station_altitude=500.0
    )
    assert close(raised.optical_depth, plain.optical_depth)
    assert raised.reach == pytest.approx(plain.reach + 500.0)


@given(st.integers(0, 2**31), st.sampled_from(METHODS))
@settings(max_examples=20, deadline=None)
def test_any_input_gives_a_result(seed, method):
    rng = np.random.default_rng(seed)
    signal = rng.normal(size=(3, 5, 30)) * 10.0 ** rng.integers(-200, 200)
    signal[rng.random(signal.shape) < 0.2] = rng.choice([np.nan, np.inf, 0.0, -1.0, 1e308])
    variance = np.abs(rng.normal(size=signal.shape)) * 10.0 ** rng.integers(-300, 300)
    angles = rng.uniform(-90, 90, 5)
    height = 100.0 + 50.0 * np.arange(30)
    result = retrieve_optical_depth(signal, angles, height, variance=variance, method=method)
    valued = np.isfinite(result.optical_depth)
    assert np.all(result.optical_depth_standard_error[valued] > 0)
    missing = MultiAngleQuality.NO_LEVERAGE | MultiAngleQuality.EXTRAPOLATED
    assert not np.any(valued & result.raised(missing))


# Skipped steps and refusals -----------------------------------------------------------------


def test_known_inhomogeneity_is_not_estimated(small):
    signal, variance, height, _ = small
    result = retrieve_optical_depth(
        signal, ANGLES, height, variance=variance, inhomogeneity=0.06, method="kano_hamilton"
    )
    assert result.inhomogeneity == pytest.approx(0.06)
    assert np.mean(result.reduced_chi_square) < 0.5
    assert not result.raised(MultiAngleQuality.NO_RESIDUAL).any()


@each(
    ("change", "field"),
    [
        ({"signal": np.ones((2, 11, 80))}, "signal"),
        ({"signal": np.ones(80)}, "signal"),
        ({"signal": np.full((2, 12, 80), 1j)}, "signal"),
        ({"variance": -1.0}, "variance"),
        ({"variance": np.ones(7)}, "variance"),
        ({"method": "best"}, "method"),
        ({"inhomogeneity": -0.1}, "inhomogeneity"),
        ({"largest_gradient": np.nan}, "largest_gradient"),
        ({"station_altitude": 1e4}, "altitude"),
        ({"layers": [(500.0, 200.0)]}, "layers"),
        ({"layers": [(500.0, 2e4)]}, "layers"),
        ({"layers": [(500.0, np.nan)]}, "layers"),
        ({"layers": [(1.0, 2.0, 3.0)]}, "layers"),
        ({"layers": [(200.0, 500.0), (1.0, 2.0, 3.0)]}, "layers"),
        ({"layers": ["low"]}, "layers"),
    ],
)
def test_invalid_arguments_are_refused(small, change, field):
    signal, variance, height, _ = small
    arguments = {
        "signal": signal,
        "zenith_angle": ANGLES,
        "altitude": height,
        "variance": variance,
    }
    with pytest.raises(RetrievalInputError, match=field):
        retrieve_optical_depth(**{**arguments, **change})
