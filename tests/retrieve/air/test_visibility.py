"""Visibility: Koschmieder's law, its interval, and the step to 550 nm against exact arithmetic."""

from __future__ import annotations

import itertools

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import visibility
from lidarops.retrieve.air.visibility import (
    at_reference_wavelength,
    visibility_from_extinction,
)

KM = 1e-3


@pytest.mark.parametrize(
    ("contrast", "kilometres"),
    [
        (visibility.MOR_CONTRAST, 2.995732273553991),
        (visibility.KOSCHMIEDER_CONTRAST, 3.912023005428146),
        (visibility.PAPER_CONTRAST, 3.0),
    ],
)
def test_visibility_of_one_per_kilometre(contrast, kilometres):
    result = visibility_from_extinction(1.0 * KM, contrast=contrast)
    assert result.visibility == pytest.approx(1000 * kilometres, rel=1e-14)


def test_meteorological_optical_range_is_the_default():
    assert visibility_from_extinction(3e-3).visibility == pytest.approx(
        np.log(20) / 3e-3, rel=1e-14
    )


def test_interval_follows_from_that_of_extinction():
    result = visibility_from_extinction([2e-3, 2e-3, 2e-3], [1e-5, 1e-3, 3e-3])
    np.testing.assert_allclose(
        result.visibility_lower, np.log(20) / np.array([2.01e-3, 3e-3, 5e-3]), rtol=1e-13
    )
    assert result.visibility_upper[0] == pytest.approx(np.log(20) / 1.99e-3)
    assert result.visibility_upper[1] == pytest.approx(np.log(20) / 1e-3)
    assert np.isinf(result.visibility_upper[2])


def test_linear_error_agrees_with_simulated_scatter_where_small_and_interval_where_large():
    rng = np.random.default_rng(3)
    draws = 2e-3 * (1 + 0.03 * rng.standard_normal(200_000))
    result = visibility_from_extinction(2e-3, 0.03 * 2e-3)
    scatter = np.std(visibility_from_extinction(draws).visibility)
    assert result.visibility_standard_error == pytest.approx(scatter, rel=0.01)
    # The interval holds 68 percent of the values from noisy extinction, however asymmetric.
    draws = 2e-3 * (1 + 0.3 * rng.standard_normal(200_000))
    result = visibility_from_extinction(2e-3, 0.3 * 2e-3)
    values = visibility_from_extinction(draws).visibility
    inside = (values > result.visibility_lower) & (values < result.visibility_upper)
    assert inside.mean() == pytest.approx(0.6827, abs=0.005)
    symmetric = np.abs(values - result.visibility) < result.visibility_standard_error
    assert abs(symmetric.mean() - 0.6827) > 0.01


def test_visibility_is_missing_where_extinction_is_not_positive_or_missing():
    result = visibility_from_extinction(
        [np.nan, 0.0, -1e-4, -2e-4, np.inf], [1e-4, 1e-4, 3e-4, 1e-4, 1.0]
    )
    assert np.isnan(result.visibility).all()
    assert np.isnan(result.visibility_standard_error).all()
    # An extinction that is zero within its error has a lower end of visibility.
    assert np.isfinite(result.visibility_lower[1:3]).all()
    assert np.isnan(result.visibility_lower[[0, 3]]).all()
    assert np.isinf(result.visibility_upper).tolist() == [False, True, True, True, False]


def test_missing_errors_stay_missing():
    result = visibility_from_extinction(np.float32([1e-3, 2e-3]))
    assert np.isfinite(result.visibility).all()
    assert np.isnan(result.visibility_standard_error).all()
    assert np.isnan(result.visibility_upper).all()
    assert result.visibility.dtype == np.float64


def exact_kruse(extinction, wavelength):
    """Return all extinctions at 550 nm that obey Kruse's law, in 40 digits."""
    with mp.workdps(40):
        ratio = mp.mpf(wavelength) / mp.mpf(550e-9)
        plain = mp.log(50) / mp.mpf(extinction)

        def near(v):
            return v - plain * ratio ** (-mp.mpf("0.585") * mp.cbrt(v / 1000))

        solutions = []
        grid = [mp.mpf(10) ** (mp.mpf(i) / 20) for i in range(-20, 76)] + [mp.mpf(6000)]
        grid = sorted(v for v in grid if v <= 6000)
        for low, high in itertools.pairwise(grid):
            if near(low) * near(high) < 0:
                solutions.append(mp.findroot(near, (low, high), solver="anderson"))
        for q, start, stop in ((mp.mpf("1.3"), 6000, 50_000), (mp.mpf("1.6"), 50_000, mp.inf)):
            v = plain * ratio**-q
            if start <= v < stop:
                solutions.append(v)
        return [float(mp.log(50) / v) for v in solutions]


@settings(max_examples=60, deadline=None)
@given(st.floats(-6.0, -1.5), st.sampled_from([355e-9, 532e-9, 550e-9, 905e-9, 1064e-9, 1550e-9]))
def test_kruse_obeys_its_implicit_equation(exponent, wavelength):
    extinction = 10.0**exponent
    value, _ = at_reference_wavelength(extinction, wavelength=wavelength, law="kruse")
    expected = exact_kruse(extinction, wavelength)
    if expected:
        assert float(value) == pytest.approx(max(expected), rel=1e-10)
    else:
        at_jump = np.log(50) / np.array([6000.0, 50_000.0])
        assert np.min(np.abs(value / at_jump - 1)) < 1e-12


def test_kruse_is_monotonic_beyond_550_nm():
    extinction = np.geomspace(1e-6, 1e-2, 4001)
    infrared, _ = at_reference_wavelength(extinction, wavelength=1064e-9, law="kruse")
    # Constant across a jump, except for rounding.
    assert np.all(np.diff(infrared) >= -1e-15 * infrared[1:])


@pytest.mark.parametrize("extinction", [3e-3, 1e-3, 2e-4, 2e-5])
def test_errors_at_550_nm_agree_with_finite_differences(extinction):
    def converted(x, wavelength=1064e-9):
        return float(at_reference_wavelength(x, wavelength=wavelength, law="kruse")[0])

    step = 1e-6 * extinction
    slope = (converted(extinction + step) - converted(extinction - step)) / (2 * step)
    _, error = at_reference_wavelength(extinction, 1e-6, wavelength=1064e-9, law="kruse")
    assert error == pytest.approx(slope * 1e-6, rel=1e-6)


def test_angstrom_law_propagates_the_error_of_its_exponent():
    value, error = at_reference_wavelength(
        1e-3, 2e-5, wavelength=1064e-9, law="angstrom", exponent=1.4, exponent_standard_error=0.3
    )
    assert value == pytest.approx(1e-3 * (1064 / 550) ** 1.4, rel=1e-14)
    rng = np.random.default_rng(5)
    draws = (1e-3 + 2e-5 * rng.standard_normal(400_000)) * (1064 / 550) ** (
        1.4 + 0.3 * rng.standard_normal(400_000)
    )
    relative = error / value
    assert relative == pytest.approx(np.std(np.log(draws)), rel=0.01)


def test_no_law_leaves_extinction_as_it_is():
    value, error = at_reference_wavelength(
        [1e-3, np.nan], [1e-5, 1e-5], wavelength=1064e-9, law="none"
    )
    assert value[0] == 1e-3
    assert error[0] == 1e-5
    assert np.isnan(value[1])


@each(
    ("arguments", "field"),
    [
        ({"wavelength": 532.0, "law": "none"}, "wavelength"),
        ({"wavelength": 532e-9, "law": "mie"}, "law"),
        ({"wavelength": 532e-9, "law": "angstrom"}, "exponent"),
        ({"wavelength": 532e-9, "law": "kruse", "exponent": 1.0}, "exponent"),
        ({"wavelength": 532e-9, "law": "angstrom", "exponent": [1.0, 2.0, 3.0]}, "exponent"),
        (
            {"wavelength": 532e-9, "law": "none", "exponent_standard_error": -1.0},
            "exponent_standard_error",
        ),
    ],
)
def test_wrong_settings_are_refused_by_name(arguments, field):
    with pytest.raises(RetrievalInputError) as raised:
        at_reference_wavelength([1e-3, 2e-3], **arguments)
    assert raised.value.field == field


@each(
    ("extinction", "error", "contrast", "field"),
    [
        (1e-3, None, 0.0, "contrast"),
        (1e-3, None, 1.0, "contrast"),
        (1e-3, None, float("nan"), "contrast"),
        (1e-3, -1e-4, 0.05, "standard_error"),
        ([1e-3, 1e-3], [1e-4, 1e-4, 1e-4], 0.05, "standard_error"),
        (20.0, None, 0.05, "extinction"),
        (["fog"], None, 0.05, "extinction"),
    ],
)
def test_wrong_arguments_are_refused_by_name(extinction, error, contrast, field):
    with pytest.raises(RetrievalInputError) as raised:
        visibility_from_extinction(extinction, error, contrast=contrast)
    assert raised.value.field == field
