"""Counts to signals: against formulas written out by hand and against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve import homogeneous, signal

RANGE = (np.arange(400) + 0.5) * 7.5
SHOTS = np.array([600])


def test_analog_voltage_of_known_counts() -> None:
    counts = np.full((1, 400), 123_456, np.int32)
    result = signal.analog(counts, SHOTS, RANGE, adc_bits=12, input_range=np.array([0.5]))
    assert result.power == pytest.approx(123_456 * 500.0 / (600 * 4096))
    assert not result.quality.any()


def test_full_scale_and_integer_extremes_are_masked() -> None:
    counts = np.full((1, 400), 1000, np.int32)
    counts[0, :4] = [600 * 4095, 600 * 4095 - 1, 2**31 - 1, -(2**31)]
    result = signal.analog(counts, SHOTS, RANGE, adc_bits=12, input_range=np.array([0.5]))
    assert result.quality[0, 0] == Quality.SATURATED
    assert result.quality[0, 1] == 0
    assert result.quality[0, 2] & Quality.INPUT_MISSING
    assert result.quality[0, 3] & Quality.INPUT_MISSING
    assert np.isnan(result.power[0, [0, 2, 3]]).all()
    assert np.isfinite(result.power[0, [1, 4]]).all()


def test_no_shots_is_missing_input_not_infinity() -> None:
    counts = np.full((2, 400), 1000, np.int32)
    result = signal.photon(counts, np.array([0, 600]), RANGE, bin_width=7.5)
    assert (result.quality[0] & Quality.INPUT_MISSING).all()
    assert np.isnan(result.power[0]).all()
    assert np.isfinite(result.power[1]).all()


@given(rate=st.floats(0.01, 100.0), dead_time=st.floats(1e-9, 4e-9))
def test_dead_time_is_undone(rate: float, dead_time: float) -> None:
    assume(abs(rate * dead_time * 1e6 - 0.1) > 1e-6)
    # A non-paralysable counter shows r / (1 + r tau); counts are scaled so that rounding is nil.
    shots = np.array([10_000_000])
    measured = rate / (1.0 + rate * dead_time * 1e6)
    counts = np.full((1, 400), round(measured * shots[0] * 0.05), np.int32)
    result = signal.photon(counts, shots, RANGE, bin_width=7.5, dead_time=dead_time)
    assert result.power == pytest.approx(rate, rel=2e-4)
    assert bool((result.quality & Quality.PILE_UP).any()) is (rate * dead_time * 1e6 > 0.1)


def test_photon_variance_matches_the_scatter_of_poisson_counts() -> None:
    rng = np.random.default_rng(3)
    truth = 0.2 + 40.0 * (750.0 / RANGE) ** 2
    truth[:80] = truth[80]
    counts = rng.poisson(truth * 30.0, (4000, 400)).astype(np.int32)
    result = signal.photon(counts, np.full(4000, 600), RANGE, bin_width=7.5)
    ratio = result.power.var(axis=0) / result.variance.mean(axis=0)
    # 4000 draws: 2.2 % a bin; smoothing over 10 % of range biases the variance by 1-3 %.
    assert np.abs(ratio[120:] - 1.0).max() < 0.12
    assert ratio[120:].mean() == pytest.approx(1.0, abs=0.02)


def test_zero_counts_do_not_claim_certainty() -> None:
    counts = np.zeros((2, 400), np.int32)
    counts[0, 7] = 1
    result = signal.photon(counts, np.full(2, 600), RANGE, bin_width=7.5)
    assert (result.variance[0] > 0).all()
    assert not result.quality[0].any()
    # Not a single count in a profile: the recorder was off.
    assert (result.quality[1] == Quality.INPUT_MISSING).all()
    assert np.isnan(result.power[1]).all()


def test_paralysed_counters_are_masked() -> None:
    counts = np.full((1, 400), 200 * 30, np.int32)  # 200 MHz
    result = signal.photon(counts, SHOTS, RANGE, bin_width=7.5, dead_time=4e-9)
    assert (result.quality & Quality.SATURATED).all()
    assert np.isnan(result.power).all()


def test_noise_of_an_analog_signal_is_found() -> None:
    rng = np.random.default_rng(5)
    far = (np.arange(2000) + 60.5) * 7.5
    light = 0.5 + 300.0 * (450.0 / far) ** 2
    truth = 0.02 + 0.01 * light
    profiles = light + rng.normal(0, 1, (400, 2000)) * np.sqrt(truth)
    variance = signal.difference_variance(profiles, far)
    # At the first bins the smoothing window has no near half.
    assert (variance.mean(axis=0) / truth)[40:] == pytest.approx(1.0, abs=0.08)
    assert (variance.std(axis=0) / truth)[40:].max() < 0.15


def test_constant_noise_does_not_follow_the_light() -> None:
    rng = np.random.default_rng(6)
    far = (np.arange(2000) + 60.5) * 7.5
    profiles = 300.0 * (450.0 / far) ** 2 + rng.normal(0, 0.3, (400, 2000))
    variance = signal.difference_variance(profiles, far)
    assert np.median(variance, axis=0) / 0.09 == pytest.approx(1.0, abs=0.05)


def test_a_signal_without_noise_has_a_finite_variance() -> None:
    variance = signal.difference_variance(np.zeros((2, 400)), RANGE)
    assert (variance == 0).all()
    gappy = np.full((1, 400), np.nan)
    gappy[0, :3] = 1.0
    assert np.isnan(signal.difference_variance(gappy, RANGE)).all()


@pytest.mark.parametrize("section", [(750, 4500), (1500, 7500)])
def test_estimated_noise_serves_a_retrieval_as_well_as_known_noise(
    section: tuple[int, int],
) -> None:
    rng = np.random.default_rng(5)
    distance = (np.arange(2000) + 0.5) * 7.5
    shape = np.exp(-2 * 2e-4 * distance) * (1500.0 / distance) ** 2
    profiles = 0.1 + 0.15 * shape + rng.normal(0, 0.007, (2000, 2000))
    inside = (distance >= section[0]) & (distance < section[1])
    variance = signal.difference_variance(profiles, distance)[:, inside]
    found = homogeneous.solve(profiles[:, inside], distance[inside], weights=1.0 / variance)
    good = found.quality == 0
    score = (found.extinction - 2e-4) / found.extinction_standard_error
    assert good.mean() > 0.995
    # 2000 draws: the spread is known to 1.6 percent.
    assert score[good].std() == pytest.approx(1.0, abs=0.05)
    assert abs(score[good].mean()) < 0.1


def test_smoothing_keeps_constants_and_passes_over_nan() -> None:
    values = np.full((2, 400), 3.0)
    values[0, 50:60] = np.nan
    assert signal.smooth(values, RANGE) == pytest.approx(3.0)
    assert np.isnan(signal.smooth(np.full((1, 400), np.nan), RANGE)).all()


@given(st.integers(0, 2**32 - 1))
def test_rows_do_not_depend_on_their_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.poisson(50, (5, 400)).astype(np.int32)
    counts[2] = 2**31 - 1
    whole = signal.photon(counts, np.full(5, 600), RANGE, bin_width=7.5, dead_time=3e-9)
    for row in range(5):
        alone = signal.photon(counts[row : row + 1], SHOTS, RANGE, bin_width=7.5, dead_time=3e-9)
        np.testing.assert_array_equal(alone.power[0], whole.power[row])
        np.testing.assert_array_equal(alone.variance[0], whole.variance[row])


def test_dark_mean_and_its_variance() -> None:
    rng = np.random.default_rng(8)
    profiles = 5.0 + rng.normal(0, 0.2, (50, 400))
    profiles[3, 7] = np.nan
    mean, variance = signal.dark_mean(profiles)
    assert mean == pytest.approx(5.0, abs=0.15)
    assert variance.mean() == pytest.approx(0.04 / 50, rel=0.05)
    assert np.isfinite(mean).all()
    single_mean, single_variance = signal.dark_mean(profiles[:1])
    np.testing.assert_array_equal(single_mean, profiles[0])
    assert (single_variance == 0).all()


def test_range_correction_carries_both_variances() -> None:
    counts = np.full((1, 400), 900, np.int32)
    raw = signal.photon(counts, SHOTS, RANGE, bin_width=7.5)
    result = signal.range_corrected(
        raw, RANGE, background=np.array([40.0]), background_variance=np.array([0.25])
    )
    # 30 MHz less 40 MHz: negative, and not clipped.
    assert result.power[0] == pytest.approx(-10.0 * RANGE**2)
    assert result.variance[0] == pytest.approx((raw.variance[0] + 0.25) * RANGE**4)


def test_shapes_that_do_not_fit_are_named() -> None:
    with pytest.raises(RetrievalInputError, match="counts"):
        signal.photon(np.zeros((1, 399), np.int32), SHOTS, RANGE, bin_width=7.5)
