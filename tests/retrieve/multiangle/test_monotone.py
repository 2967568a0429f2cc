"""The projection on profiles that never decrease."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lidarops.retrieve.multiangle.smooth_profile import nearest_rising

ROWS = arrays(
    np.float64,
    st.tuples(st.integers(1, 3), st.integers(1, 30)),
    elements=st.floats(-5.0, 5.0, allow_subnormal=False),
)


@settings(deadline=None)
@given(ROWS, st.integers(0, 2**32 - 1))
def test_is_the_nearest_admissible_profile(profiles, seed):
    projection = nearest_rising(profiles)
    other = np.sort(np.abs(np.random.default_rng(seed).normal(size=profiles.shape)), axis=1)
    # The admissible profiles are a convex cone: no direction into it leads nearer.
    gain = ((profiles - projection) * (other - projection)).sum(axis=1)
    assert np.all(gain <= 1e-9)
    assert np.all(np.diff(projection, axis=1) >= 0.0)
    assert np.all(projection >= 0.0)


@settings(deadline=None)
@given(ROWS, st.data())
def test_missing_altitudes_are_skipped(profiles, data):
    holes = data.draw(arrays(np.bool_, profiles.shape))
    projection = nearest_rising(np.where(holes, np.nan, profiles))
    np.testing.assert_array_equal(np.isnan(projection), holes)
    for row, hole, values in zip(profiles, holes, projection, strict=True):
        if not hole.all():
            alone = nearest_rising(row[np.newaxis, ~hole])[0]
            np.testing.assert_array_equal(values[~hole], alone)


def test_profile_that_is_admissible_stays():
    row = np.array([[0.0, 0.1, 0.1, 0.4]])
    np.testing.assert_array_equal(nearest_rising(row), row)
