"""The cubic against exact arithmetic and simulated noise; the tail mean."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each
from support.oracles.homogeneous import (
    lowest_errors,
    quartic_derivative,
    real_roots,
    section,
    signal,
)

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import _cubic_kernel
from lidarops.retrieve.background.cubic_and_tail import (
    cubic,
    default_lag,
    selection_bias,
    tail_mean,
)

LONG = section(2500.0, 8000.0)
KM = 1e-3


def without_noise(power, r, lag=None):
    """Return the background by the cubic, without correction for noise."""
    return cubic(power, r, lag=lag, variance=0.0)


# Algebra ------------------------------------------------------------------------------------


@each("lag", [1, 75, 90])
@each(
    ("start", "length", "bins", "ratio", "digits"),
    [
        (2500.0, 1000.0, 225, 25.0, 12),
        (2500.0, 8000.0, 225, 25.0, 12),
        (10500.0, 2500.0, 225, 700.0, 12),
        (2500.0, 8000.0, 225, 1e4, 12),
        (2500.0, 8000.0, 225, 1e6, 10),
    ],
)
def test_root_keeps_its_digits(start, length, bins, ratio, digits, lag):
    r = section(start, length, bins)
    power = ratio + signal(r, 1.0, 0.03 * KM)
    with mp.workdps(60):
        exact = real_roots(quartic_derivative(r, power, lag))[-1]
        error = abs(mp.mpf(float(without_noise(power, r, lag).background)) - exact)
    assert error < 10.0**-digits


def test_root_keeps_its_digits_on_a_long_grid():
    for bins, lag in ((1024, 341), (4096, 1), (4096, 1365)):
        r = section(2500.0, 8000.0, bins)
        power = 25.0 + signal(r, 1.0, 0.03 * KM)
        with mp.workdps(40):
            exact = real_roots(quartic_derivative(r, power, lag))[-1]
            assert abs(mp.mpf(float(without_noise(power, r, lag).background)) - exact) < 1e-12


def test_root_keeps_its_digits_on_random_sections():
    rng = np.random.default_rng(9)
    for _ in range(60):
        bins = int(rng.integers(7, 300))
        lag = int(rng.integers(max(bins // 8, 1), (bins - 1) // 2 + 1))
        r = section(rng.uniform(1000.0, 12000.0), rng.uniform(1500.0, 9000.0), bins)
        ratio = 10 ** rng.uniform(-1, 6)
        power = ratio + signal(r, 1.0, 10 ** rng.uniform(-2, -0.5) * KM)
        with mp.workdps(45):
            exact = real_roots(quartic_derivative(r, power, lag))[-1]
            error = abs(mp.mpf(float(without_noise(power, r, lag).background)) - exact)
        # The root of a power rounded to float64 is exact only within its own rounding.
        assert error < (1e-12 if ratio < 1e4 else 1e-10) + np.spacing(ratio)


def test_float32_profiles_are_solved_in_double_precision():
    power = (25.0 + signal(LONG, 1.0, 0.03 * KM)).astype(np.float32)
    with mp.workdps(50):
        exact = real_roots(quartic_derivative(LONG, power.astype(np.float64), 75))[-1]
        assert abs(mp.mpf(float(without_noise(power, LONG, 75).background)) - exact) < 1e-12


def spurious_distances(r, lag, extinction):
    """Return the distance of the second root below the background, and the weight, per triple."""
    r0, r1, r2 = (
        [mp.mpf(x) for x in ranges] for ranges in (r[: -2 * lag], r[lag:-lag], r[2 * lag :])
    )
    shape = [mp.e ** (-2 * extinction * x) / x**2 for x in [mp.mpf(x) for x in r]]
    distances, weights = [], []
    for i in range(len(r1)):
        u, v = (r0[i] * r2[i]) ** 2, r1[i] ** 4
        s0, s1, s2 = shape[i], shape[i + lag], shape[i + 2 * lag]
        distances.append(-(u * (s0 + s2) - 2 * v * s1) / (v - u) * -1)
        weights.append((v - u) ** 2)
    return distances, weights


def test_largest_real_root_is_the_background_and_spread_decides_the_root_class():
    rng = np.random.default_rng(1)
    counts = {True: 0, False: 0}
    with mp.workdps(50):
        for _ in range(400):
            bins = int(rng.integers(7, 20))
            lag = int(rng.integers(1, (bins - 1) // 2 + 1))
            # Exactly uniform, so that the identity of the triples is exact.
            start, step = int(rng.integers(500, 12000)), int(rng.integers(5, 400))
            r = [mp.mpf(start + step * i) for i in range(bins)]
            extinction = mp.mpf(float(10 ** rng.uniform(-8, -3)))
            background = mp.mpf(float(rng.uniform(0, 100)))
            shape = [mp.e ** (-2 * extinction * (x - r[0])) * (r[0] / x) ** 2 for x in r]
            power = [background + value for value in shape]
            roots = real_roots(quartic_derivative(r, power, lag))
            assert abs(roots[-1] - background) < mp.mpf(10) ** -15

            distances, weights = spurious_distances(r, lag, extinction)
            total = sum(weights)
            mean = sum(w * d for w, d in zip(weights, distances, strict=True)) / total
            square = sum(w * d * d for w, d in zip(weights, distances, strict=True)) / total
            spread = mp.sqrt(abs(square - mean * mean)) / abs(mean)
            if bins - 2 * lag > 1 and abs(spread * mp.sqrt(8) - 1) > 1e-6:
                three = spread < 1 / mp.sqrt(8)
                counts[bool(three)] += 1
                assert (len(roots) == 3) == three
    # What fails in one of a hundred cases is met with 97 %.
    assert sum(counts.values()) >= 350
    assert min(counts.values()) >= 35


@settings(max_examples=200, deadline=None)
@given(st.floats(-100, 100), st.floats(0.1, 100), st.floats(0.0, 100))
def test_largest_root_of_a_cubic_with_three_real_roots(largest, gap, further):
    roots = (largest, largest - gap, largest - gap - further)
    a, c = -sum(roots), -np.prod(roots)
    b = roots[0] * roots[1] + roots[0] * roots[2] + roots[1] * roots[2]
    assert _cubic_kernel.largest_root(a, b, c) == pytest.approx(largest, abs=1e-6)


@pytest.mark.parametrize(
    ("a", "b", "c", "largest"),
    [(7.0, 0.0, 0.0, 0.0), (-7.0, 0.0, 0.0, 7.0), (0.0, 0.0, 0.0, 0.0), (-3.0, 3.0, -1.0, 1.0)],
)
def test_largest_root_where_roots_coincide(a, b, c, largest):
    assert _cubic_kernel.largest_root(a, b, c) == pytest.approx(largest, abs=1e-5)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.1, 50))
def test_only_real_root_of_a_cubic(real, middle, imaginary):
    b = middle**2 + imaginary**2
    a, b, c = -real - 2 * middle, b + 2 * middle * real, -real * b
    assert _cubic_kernel.largest_root(a, b, c) == pytest.approx(real, abs=2e-3)


# Noise --------------------------------------------------------------------------------------


def mean_coefficients(power, variance, triples):
    linear, constant = [], []
    for profile, noise in zip(power, variance, strict=True):
        estimate = _cubic_kernel._coefficients(profile, noise, triples)
        linear.append(estimate.linear)
        constant.append(estimate.constant)
    return np.array([linear, constant])


def test_noise_is_subtracted_from_the_coefficients_without_bias():
    rng = np.random.default_rng(2)
    r = section(2500.0, 8000.0, 45)
    truth = 20.0 + signal(r, 30.0, 0.03 * KM)
    triples = _cubic_kernel.make_triples(r, 15)
    centre = 25.0
    count = 60_000
    variance = np.broadcast_to(np.linspace(1.0, 9.0, r.size), (count, r.size))
    power = truth + rng.normal(size=(count, r.size)) * np.sqrt(variance)
    exact = _cubic_kernel._coefficients(truth - centre, np.zeros(r.size), triples)
    expected = np.array([exact.linear, exact.constant])

    def score(noise):
        sums = mean_coefficients(power - centre, noise, triples)
        return (sums.mean(axis=1) - expected) / (sums.std(axis=1) / np.sqrt(count))

    assert np.all(np.abs(score(variance)) < 4)
    assert np.all(np.abs(score(np.zeros_like(power))) > 20)


@each(
    ("start", "length", "height", "extinction", "most"),
    [
        (2500.0, 8000.0, 107.0, 0.03 * KM, 2.3),
        (2500.0, 8000.0, 1e4, 0.03 * KM, 2.0),
        (2500.0, 1700.0, 1e4, 0.03 * KM, 1.6),
        (10500.0, 8000.0, 1e3, 0.03 * KM, 1.6),
        (2500.0, 8000.0, 107.0, 1.0 * KM, 3.7),
    ],
)
@each("variance", [1.0, None])
def test_cubic_is_unbiased_and_its_standard_error_honest(
    start, length, height, extinction, most, variance
):
    rng = np.random.default_rng(3)
    r, count = section(start, length), 3000
    power = 370.0 + signal(r, height, extinction) + rng.normal(size=(count, r.size))
    estimate = cubic(power, r, variance=variance)
    lowest = lowest_errors(r, height, extinction)[0]
    errors = estimate.background - 370.0
    assert np.sqrt(np.mean(errors**2)) < most * lowest
    assert abs(np.mean(errors)) < 0.2 * lowest
    covered = np.abs(errors) < 1.96 * estimate.background_standard_error
    assert 0.93 < np.mean(covered) < 0.975
    assert np.mean(estimate.quality == 0) > 0.995


@pytest.mark.parametrize("lag", [1, 3, 10, None])
def test_curvature_mistaken_for_noise_does_not_shift_unflagged_backgrounds(lag):
    kept = []
    for height in (1e6, 1e7, 1e8, 1e10):
        power = 1e3 + signal(LONG, height, 0.03 * KM)
        power = power + np.random.default_rng(9).standard_normal((300, LONG.size))
        estimate = cubic(power, LONG, lag=lag)
        off = np.abs(estimate.background - 1e3) / estimate.background_standard_error
        good = estimate.quality == 0
        assert np.max(off[good], initial=0.0) < 4.2
        # With a given variance, no curvature is mistaken for noise.
        known = cubic(power, LONG, lag=lag, variance=1.0)
        assert np.mean(known.quality == 0) == (0.0 if (lag, height) == (1, 1e6) else 1.0)
        kept.append(np.mean(good))
    assert kept == ([0.0] * 4 if lag == 1 else [1.0] * 4)


def test_lost_roots_are_flagged():
    rng = np.random.default_rng(6)
    noise = 370.0 + rng.normal(size=(3000, LONG.size))
    for height in (0.0, 20.0):
        estimate = cubic(noise + signal(LONG, height, 0.03 * KM), LONG, variance=1.0)
        assert np.mean(estimate.quality & Quality.LOW_SIGNAL != 0) > 0.999


def test_gradient_is_that_of_finite_differences():
    rng = np.random.default_rng(7)
    r = section(2500.0, 8000.0, 30)
    power = 370.0 + signal(r, 50.0, 0.1 * KM) + rng.normal(size=r.size)
    triples, variance = _cubic_kernel.make_triples(r, 12), np.full((1, 30), 0.5)

    def solve(rows):
        out = np.full((len(rows), _cubic_kernel.COLUMNS), np.nan)
        gradients = np.zeros_like(rows)
        _cubic_kernel.solve_cubic_profiles(rows, variance, True, triples, gradients, out)
        return out[:, _cubic_kernel.BACKGROUND], gradients

    step = 1e-4
    moved = solve(power + step * np.eye(30))[0] - solve(power - step * np.eye(30))[0]
    np.testing.assert_allclose(
        solve(power[np.newaxis])[1][0], moved / (2 * step), atol=1e-5, rtol=1e-4
    )


# Contracts ----------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.integers(-40, 40), st.floats(-1e3, 1e3))
def test_cubic_follows_scale_and_shift(exponent, shift):
    power = 5.0 + signal(LONG, 3.0, 0.05 * KM) + 1e-3 * np.sin(np.arange(LONG.size))
    factor = 2.0**exponent
    one = cubic(power, LONG, variance=1e-6)
    scaled = cubic(power * factor, LONG, variance=1e-6 * factor**2)
    assert scaled.background == one.background * factor
    assert scaled.background_standard_error == one.background_standard_error * factor
    shifted = cubic(power + shift, LONG, variance=1e-6)
    assert shifted.background - shift == pytest.approx(one.background, abs=1e-9)


@each("bins", [3, 4, 5, 6, 7, 8, 16, 225, 4096])
def test_default_lag_leaves_a_triple(bins):
    assert 1 <= default_lag(bins) <= (bins - 1) // 2


@each("bins", [1, 2, 3, 4, 7])
def test_few_bins_are_flagged(bins):
    r = np.linspace(2500.0, 10500.0, bins) if bins > 1 else np.array([2500.0])
    estimate = cubic(25.0 + signal(r, 1.0, 0.03 * KM), r, variance=1e-12)
    assert estimate.quality & Quality.TOO_FEW_BINS
    assert np.isnan(estimate.background) == (bins < 3)
    if bins >= 3:
        assert estimate.background == pytest.approx(25.0, abs=1e-4)


def test_missing_constant_and_infinite_profiles_are_flagged_and_do_not_affect_others():
    good = 5.0 + signal(LONG, 3.0, 0.05 * KM) + 1e-3 * np.cos(np.arange(LONG.size))
    rows = np.stack([good, good, np.full_like(good, 0.1), good])
    rows[1, 100] = np.nan
    rows[3, 3] = -np.inf
    estimate = cubic(rows, LONG)
    assert estimate.quality.tolist() == [0, Quality.INPUT_MISSING, Quality.NO_SIGNAL, 1]
    assert estimate.background[0] == cubic(good, LONG).background
    assert estimate.background[2] == 0.1
    assert np.isnan(estimate.background[[1, 3]]).all()
    assert np.isnan(estimate.background_standard_error[[1, 3]]).all()


def test_variance_that_is_not_finite_is_missing():
    variance = np.ones(LONG.size)
    variance[7] = np.nan
    estimate = cubic(5.0 + signal(LONG, 300.0, 0.05 * KM), LONG, variance=variance)
    assert estimate.quality == Quality.INPUT_MISSING


def test_shapes_follow_the_power():
    power = np.zeros((2, 3, LONG.size)) + 5.0 + signal(LONG, 3.0, 0.05 * KM)
    estimate = cubic(power, LONG)
    assert estimate.background.shape == estimate.quality.shape == (2, 3)
    assert cubic(power[0, 0], LONG).background.shape == ()
    assert cubic(power[:, :0], LONG).background.shape == (2, 0)


@each(
    ("arguments", "field"),
    [
        ({"range": np.delete(LONG, 100)}, "power"),
        ({"range": LONG + 5.0 * np.sin(np.arange(LONG.size))}, "range"),
        ({"range": LONG / 1000.0}, "range"),
        ({"lag": 0}, "lag"),
        ({"lag": 113}, "lag"),
        ({"variance": -1.0}, "variance"),
        ({"variance": np.ones(7)}, "variance"),
        ({"power": np.full(LONG.size, "x")}, "power"),
    ],
)
def test_invalid_arguments_are_refused(arguments, field):
    given_ = {"power": 5.0 + signal(LONG, 3.0, 0.05 * KM), "range": LONG} | arguments
    with pytest.raises(RetrievalInputError) as caught:
        cubic(given_.pop("power"), given_.pop("range"), **given_)
    assert caught.value.field == field


# Tail ---------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    st.integers(10, 60),
    st.floats(0.0, 0.9),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_tail_mean_is_the_mean_of_the_finite_bins_where_these_are_half_or_more(
    bins, missing, seed, known
):
    rng = np.random.default_rng(seed)
    r = section(1000.0, 5000.0, bins)
    power = rng.normal(10.0, 2.0, (3, bins))
    power[rng.random(power.shape) < missing] = np.nan
    start = float(r[bins // 3])
    estimate = tail_mean(power, r, start=start, variance=4.0 if known else None)
    for row, mean, error, quality in zip(
        power,
        estimate.background,
        estimate.background_standard_error,
        estimate.quality,
        strict=True,
    ):
        tail = row[(r >= start) & np.isfinite(row)]
        minority = 2 * tail.size < np.count_nonzero(r >= start)
        assert bool(quality & Quality.INPUT_MISSING) == (tail.size == 0)
        assert bool(quality & Quality.TOO_FEW_BINS) == (
            tail.size > 0 and (tail.size < 8 or minority)
        )
        if minority:
            assert np.isnan(mean)
            assert np.isnan(error)
        elif tail.size > 1:
            assert mean == pytest.approx(tail.mean(), rel=1e-12)
            scatter = 4.0 if known else tail.var(ddof=1)
            assert error == pytest.approx(np.sqrt(scatter / tail.size), rel=1e-9)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 0.9])
def test_bins_left_out_by_their_value_shift_the_mean_by_the_selection_bias(share):
    noise = np.sort(np.random.default_rng(3).standard_normal(400_000))
    kept = noise[: round(share * noise.size)]
    assert selection_bias(share) == pytest.approx(-kept.mean(), abs=0.01)
    assert selection_bias(1.0) == 0.0


def test_tail_mean_uses_the_last_tenth():
    power = np.arange(100.0)
    estimate = tail_mean(power, section(1000.0, 5000.0, 100))
    assert estimate.background == 94.5
    assert estimate.background_standard_error == pytest.approx(power[90:].std(ddof=1) / np.sqrt(10))
    assert estimate.quality == 0


def test_tail_mean_does_not_depend_on_its_batch():
    rng = np.random.default_rng(8)
    power = rng.normal(size=(57, 300))
    r = section(1000.0, 5000.0, 300)
    whole = tail_mean(power, r, start=2000.0).background
    for rows in (slice(0, 1), slice(3, 50), slice(10, 12)):
        assert np.array_equal(tail_mean(power[rows], r, start=2000.0).background, whole[rows])
    assert np.array_equal(tail_mean(np.asfortranarray(power), r, start=2000.0).background, whole)


@pytest.mark.parametrize("start", [7000.0, np.nan])
def test_tail_must_begin_within_the_range(start):
    with pytest.raises(RetrievalInputError, match="range ends at 6000 m"):
        tail_mean(np.ones(50), section(1000.0, 5000.0, 50), start=start)


def test_a_bin_with_an_unusable_variance_is_not_used():
    r = np.arange(100, 400) * 7.5
    power = 10.0 + 1e7 * r**-2.0 * np.exp(-2e-4 * r)
    power[150], power[-3] = 1000.0, 1000.0
    for bad in (0.0, np.inf, np.nan):
        variance = np.full(r.size, 0.01)
        variance[[150, -3]] = bad
        estimate = cubic(power, r, variance=variance)
        assert np.isnan(estimate.background)
        assert estimate.quality == Quality.INPUT_MISSING
        tail = tail_mean(power, r, variance=variance)
        keep = np.delete(power[-30:], -3)
        assert tail.background == pytest.approx(keep.mean(), rel=1e-12)
        assert tail.background_standard_error == pytest.approx(0.1 / np.sqrt(29), rel=1e-12)
