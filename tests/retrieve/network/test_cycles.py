"""Cycles of beams: the closed form against linear algebra and exact arithmetic."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.oracles.network import triangle

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.network.cycles import (
    solve_cycle,
    systematic_error,
    values_and_variances,
)


def rows(rng, count, k, depth=0.3, spread=0.3, signs=None):
    """Return exact random rows: start, end, integral, reciprocal extinction, signed depth."""
    reciprocal = np.exp(rng.normal(0.0, spread, (count, k)))
    depths = rng.uniform(0.05, depth, (count, k))
    if signs is None:
        signs = np.ones(k)
    starts = np.exp(rng.normal(0.0, 1.0, (count, k)))
    following = np.roll(reciprocal, -1, axis=1)
    ends = starts * reciprocal / following * np.exp(-2 * signs * depths)
    return starts, ends, starts * reciprocal - ends * following, reciprocal, signs * depths


def matrices(starts, ends):
    count, k = starts.shape
    out = np.zeros((count, k, k))
    for j in range(k):
        out[:, j, j] = starts[:, j]
        out[:, j, (j + 1) % k] = -ends[:, j]
    return out


# Algebra ------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [2, 3, 5, 12, 40])
def test_closed_form_agrees_with_linear_algebra(k):
    starts, ends, integrals, reciprocal, _ = rows(np.random.default_rng(k), 200, k)
    result = solve_cycle(starts, ends, integrals)
    dense = np.linalg.solve(matrices(starts, ends), integrals[..., np.newaxis])[:, 0, 0]
    np.testing.assert_allclose(result.value, dense, rtol=1e-14)
    np.testing.assert_allclose(result.value, reciprocal[:, 0], rtol=2e-14)


@pytest.mark.parametrize("k", [3, 7])
@pytest.mark.parametrize(("multiplier", "unbiased"), [(1.0, False), (0.6, False), (0.3, True)])
def test_sensitivities_agree_with_exact_derivatives(k, multiplier, unbiased):
    rng = np.random.default_rng(5)
    starts, ends, integrals, _, _ = rows(rng, 4, k, signs=rng.choice([1.0, 1.0, -1.0], k))
    result = solve_cycle(starts, ends, integrals, multiplier=multiplier, unbiased=unbiased)

    def value(logs, n):
        a, e, b = (
            [
                mp.mpf(float(x)) * mp.e**y
                for x, y in zip(chunk[n], logs[i * k : i * k + k], strict=True)
            ]
            for i, chunk in enumerate((starts, ends, integrals))
        )
        lam, numerator, product, determinant = mp.mpf(multiplier), mp.mpf(0), mp.mpf(1), mp.mpf(1)
        for j in range(k):
            numerator += lam**j * product * b[j] / a[j]
            product *= e[j] / a[j]
            if unbiased and j < k - 1:
                determinant -= (lam**j - lam ** (j + 1)) * product
        return numerator / (determinant - lam ** (k - 1) * product)

    with mp.workdps(30):
        for n in range(4):
            assert float(result.value[n]) == pytest.approx(float(value([0] * 3 * k, n)), rel=1e-13)
            for i in range(3):
                for j in range(k):
                    at = [mp.mpf(0)] * (3 * k)
                    step = mp.mpf(10) ** -10
                    at[i * k + j] = step
                    upper = value(at, n)
                    at[i * k + j] = -step
                    slope = float((upper - value(at, n)) / (2 * step))
                    scale = np.abs(result.sensitivities[n]).max()
                    assert abs(result.sensitivities[n, j, i] - slope) < 1e-12 * scale


def test_variance_follows_independent_relative_errors():
    rng = np.random.default_rng(8)
    starts, ends, integrals, _, _ = rows(rng, 1, 3, depth=0.6)
    relative = np.full((3, 3), 1e-8) * rng.uniform(0.5, 2.0, (3, 3))
    result = solve_cycle(starts, ends, integrals, relative_variance=relative)
    draws = 1 + np.sqrt(relative) * rng.standard_normal((200_000, 3, 3))
    scattered = solve_cycle(starts * draws[..., 0], ends * draws[..., 1], integrals * draws[..., 2])
    assert np.sqrt(result.variance[0]) == pytest.approx(np.std(scattered.value), rel=0.01)
    value, variance = values_and_variances(starts, ends, integrals, relative)
    assert value[0] == result.value[0]
    assert variance[0] == pytest.approx(result.variance[0], rel=1e-14)


def test_result_does_not_depend_on_the_other_cycles():
    starts, ends, integrals, _, _ = rows(np.random.default_rng(2), 257, 3)
    variance = np.random.default_rng(3).uniform(0, 1e-3, (257, 3, 3))
    whole = solve_cycle(starts, ends, integrals, relative_variance=variance)
    for chunk in (slice(0, 1), slice(100, 157), slice(256, 257)):
        piece = solve_cycle(
            starts[chunk], ends[chunk], integrals[chunk], relative_variance=variance[chunk]
        )
        assert np.array_equal(piece.value, whole.value[chunk])
        assert np.array_equal(piece.variance, whole.variance[chunk])


# The lambda family --------------------------------------------------------------------------


def test_three_beams_give_the_equation_of_the_paper():
    starts, ends, b, _, _ = rows(np.random.default_rng(4), 50, 3)
    lam = 0.8
    (a11, a22, a33), (a12, a23, a31) = starts.T, ends.T
    numerator = a22 * a33 * b[:, 0] + lam * a12 * a33 * b[:, 1] + lam**2 * a12 * a23 * b[:, 2]
    expected = numerator / (a11 * a22 * a33 - lam**2 * a12 * a23 * a31)
    result = solve_cycle(starts, ends, b, multiplier=lam)
    np.testing.assert_allclose(result.value, expected, rtol=1e-13)


@settings(max_examples=80, deadline=None)
@given(st.integers(3, 8), st.floats(0.0, 0.99), st.integers(0, 2**31))
def test_bias_formula_is_exact_in_any_field(k, multiplier, seed):
    rng = np.random.default_rng(seed)
    signs = rng.choice([1.0, -1.0], k)
    starts, ends, integrals, reciprocal, depths = rows(rng, 20, k, 0.8, 0.7, signs)
    result = solve_cycle(starts, ends, integrals, multiplier=multiplier)
    predicted = systematic_error(depths, multiplier)
    measured = (reciprocal[:, 0] - result.value) / reciprocal[:, 0]
    np.testing.assert_array_equal(np.isnan(predicted), result.pole)
    good = ~result.pole & (np.abs(measured) < 1e3)
    np.testing.assert_allclose(measured[good], predicted[good], rtol=1e-8, atol=1e-11)


@settings(max_examples=80, deadline=None)
@given(st.integers(3, 8), st.floats(0.0, 1.0), st.integers(0, 2**31))
def test_unbiased_estimate_is_exact_in_homogeneous_air(k, multiplier, seed):
    rng = np.random.default_rng(seed)
    signs = rng.choice([1.0, -1.0], k)
    signs[0] = 1.0
    starts, ends, integrals, _, depths = rows(rng, 20, k, 0.5, 0.0, signs)
    result = solve_cycle(starts, ends, integrals, multiplier=multiplier, unbiased=True)
    good = ~result.pole & (np.abs(depths.sum(axis=1)) > 0.05)
    well = good & (np.abs(result.sensitivities).max(axis=(1, 2)) < 1e4)
    np.testing.assert_allclose(result.value[well], 1.0, rtol=1e-9)


def test_values_of_the_papers_second_figure():
    table = {
        200.0: [0.220, 0.462, 0.976, 0.447, 0.209, 0.091, 0.037],
        300.0: [0.082, 0.170, 0.370, 0.897, 0.417, 0.150, 0.050],
        400.0: [0.034, 0.071, 0.154, 0.370, 0.903, 0.255, 0.068],
    }
    for l13, row in table.items():
        for angle, absolute in zip(range(15, 76, 10), row, strict=True):
            lengths = corrected_lengths(angle, l13)
            folded = np.abs(lengths) * [1.0, 1.0, -1.0] * 2e-3
            assert systematic_error(folded, 0.8) == pytest.approx(absolute, abs=6e-4)


def corrected_lengths(second, l13, l23=500.0, first=120.0, third=90.0):
    """Return equation 19 of the paper with its third label and denominator corrected."""
    a1, a2, a3 = np.radians([first, second, third])
    l12 = (l13 + l23) * np.sin(a2) / np.sin(a1 - a2) - l13 * np.sin(a3) / np.sin(a1 - a3)
    far = l23 * np.sin(a3) / np.sin(a3 - a2) - (l13 + l23) * np.sin(a1) / np.sin(a1 - a2)
    l13_ = l23 * np.sin(a2) / np.sin(a3 - a2) - l13 * np.sin(a1) / np.sin(a1 - a3)
    return np.array([l12, far, l13_])


@pytest.mark.parametrize("angle", [50.0, 60.0, 75.0])
def test_equation_19_with_its_misprints_corrected_is_the_geometry(angle):
    net = triangle(angle)
    lengths = [np.ptp(net.on_beam(beam)[1]) for beam in range(3)]
    np.testing.assert_allclose(lengths, corrected_lengths(angle, 300.0), rtol=1e-12)


# Errors and flags ---------------------------------------------------------------------------


def test_no_value_beyond_the_pole():
    # Towards the lidars: Q = e^0.6, and 0.9^2 Q > 1.
    ends = np.exp([[0.2, 0.2, 0.2]])
    starts = np.ones((1, 3))
    integrals = starts - ends
    result = solve_cycle(starts, ends, integrals, multiplier=0.9)
    assert np.isnan(result.value[0])
    assert result.pole[0]
    assert result.far_start[0]
    assert result.not_finite[0]
    exact = solve_cycle(starts, ends, integrals)
    assert exact.value[0] == pytest.approx(1.0, rel=1e-13)
    assert exact.far_start[0]
    assert not exact.pole[0]


def test_singular_cycle_is_flagged():
    starts, ends = np.ones((1, 3)), np.array([[0.8, 1.0, 1.25]])
    result = solve_cycle(starts, ends, starts - ends, relative_variance=np.full((3, 3), 1e-4))
    assert result.attenuation[0] == 1.0
    assert result.ill_conditioned[0]
    assert result.not_finite[0] or result.uncertain[0]


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, np.inf])
@pytest.mark.parametrize("place", [0, 1])
def test_a_bad_signal_is_always_flagged(bad, place):
    starts, ends, integrals, _, _ = rows(np.random.default_rng(1), 1, 3)
    (starts, ends)[place][0, 1] = bad
    for multiplier in (1.0, 0.5):
        result = solve_cycle(starts, ends, integrals, multiplier=multiplier)
        assert result.flagged[0]
        assert result.signal_not_positive[0]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((np.ones(3), np.ones(4), np.ones(3)), "start, end and integral"),
        ((np.ones(1), np.ones(1), np.ones(1)), "start"),
        ((1.0, 1.0, 1.0), "start"),
        ((["a"], ["b"], ["c"]), "start"),
    ],
)
def test_invalid_rows_raise_with_the_field_name(arguments, field):
    with pytest.raises(RetrievalInputError) as raised:
        solve_cycle(*arguments)
    assert raised.value.field == field


@pytest.mark.parametrize(
    ("settings_", "field"),
    [
        ({"multiplier": 1.5}, "multiplier"),
        ({"multiplier": np.nan}, "multiplier"),
        ({"multiplier": [0.5, 0.6, 0.7]}, "multiplier"),
        ({"relative_variance": -np.ones((3, 3))}, "relative_variance"),
        ({"relative_variance": np.ones((4, 3))}, "relative_variance"),
    ],
)
def test_invalid_settings_raise_with_the_field_name(settings_, field):
    with pytest.raises(RetrievalInputError) as raised:
        solve_cycle(np.ones((2, 3)), np.full((2, 3), 0.8), np.ones((2, 3)), **settings_)
    assert raised.value.field == field


def test_invalid_depths_raise_with_the_field_name():
    for depths, multiplier, field in (
        (0.1, 0.5, "optical_depth"),
        ([0.1, 0.2, 0.3], -0.5, "multiplier"),
        (np.ones((2, 3)), [0.5, 0.6, 0.7], "optical_depth and multiplier"),
    ):
        with pytest.raises(RetrievalInputError) as raised:
            systematic_error(depths, multiplier)
        assert raised.value.field == field
