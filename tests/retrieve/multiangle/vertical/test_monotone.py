"""The projection on profiles that never decrease."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import isotonic_regression

from lidarops.retrieve.multiangle.vertical.monotone import project

ROWS = arrays(
    np.float64,
    st.tuples(st.integers(1, 3), st.integers(1, 30)),
    elements=st.floats(-5.0, 5.0, allow_subnormal=False),
)


@settings(deadline=None)
@given(ROWS)
def test_equals_isotonic_regression_cut_at_zero(profiles):
    for row, found in zip(profiles, project(profiles), strict=True):
        expected = np.maximum(isotonic_regression(row).x, 0.0)
        np.testing.assert_allclose(found, expected, atol=1e-12)


@settings(deadline=None)
@given(ROWS, st.integers(0, 2**32 - 1))
def test_is_the_nearest_admissible_profile(profiles, seed):
    found = project(profiles)
    other = np.sort(np.abs(np.random.default_rng(seed).normal(size=profiles.shape)), axis=1)
    # The admissible profiles are a convex cone: no direction into it comes nearer.
    gain = ((profiles - found) * (other - found)).sum(axis=1)
    assert np.all(gain <= 1e-9)
    assert np.all(np.diff(found, axis=1) >= 0.0)
    assert np.all(found >= 0.0)


@settings(deadline=None)
@given(ROWS, st.data())
def test_missing_heights_are_passed_over(profiles, data):
    holes = data.draw(arrays(np.bool_, profiles.shape))
    found = project(np.where(holes, np.nan, profiles))
    np.testing.assert_array_equal(np.isnan(found), holes)
    for row, hole, got in zip(profiles, holes, found, strict=True):
        if not hole.all():
            alone = project(row[np.newaxis, ~hole])[0]
            np.testing.assert_array_equal(got[~hole], alone)


def test_profile_that_is_admissible_stays():
    row = np.array([[0.0, 0.1, 0.1, 0.4]])
    np.testing.assert_array_equal(project(row), row)
