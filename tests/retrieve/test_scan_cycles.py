"""Cycles and directions of scans."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.scan_cycles import cycles, directions

SWEEP = [0.0, 15.0, 30.0, 45.0, 60.0]


def numbered(zenith, azimuth=None, seconds=None):
    clock = np.arange(len(zenith)) * 60.0 if seconds is None else np.asarray(seconds)
    return cycles(zenith, azimuth, clock).tolist()


def test_a_cycle_begins_where_a_direction_returns():
    assert numbered(SWEEP * 3) == [0] * 5 + [1] * 5 + [2] * 5


def test_times_may_be_dates():
    times = np.datetime64("2026-01-01") + 30 * np.arange(10).astype("timedelta64[s]")
    assert cycles(SWEEP * 2, None, times).tolist() == [0] * 5 + [1] * 5


def test_incomplete_cycles_stay():
    assert numbered(SWEEP[3:] + SWEEP + SWEEP[:2]) == [0, 0, 0, 0, 0, 1, 1, 1, 1]
    assert numbered(SWEEP + SWEEP[:2]) == [0] * 5 + [1] * 2
    missing = SWEEP + [SWEEP[i] for i in (0, 1, 3, 4)] + SWEEP
    assert numbered(missing) == [0] * 5 + [1] * 4 + [2] * 5


def test_a_gap_begins_a_cycle():
    seconds = np.r_[np.arange(3), 3 + 10 + np.arange(2), 60 + np.arange(5)]
    assert numbered(SWEEP * 2, seconds=seconds) == [0] * 3 + [1] * 2 + [2] * 5
    short = np.r_[np.arange(3), 5 + np.arange(2)]
    assert numbered(SWEEP, seconds=short) == [0] * 5


def test_a_sweep_over_the_zenith_is_one_cycle():
    zenith = [60.0, 30.0, 0.0, 30.0, 60.0]
    azimuth = [270.0, 270.0, 12.3, 90.0, 90.0]
    assert numbered(zenith * 2, azimuth * 2) == [0] * 5 + [1] * 5
    # Without azimuths the second half looks where the first half did.
    assert numbered(zenith) == [0, 0, 0, 1, 1]


def test_signed_zenith_angles_lead_to_both_sides():
    signed = [-60.0, -30.0, 0.0, 30.0, 60.0]
    found = directions(signed, [90.0] * 5)
    np.testing.assert_array_equal(found.index, np.arange(5))
    np.testing.assert_allclose(found.azimuth, [270.0, 270.0, 90.0, 90.0, 90.0])
    np.testing.assert_allclose(found.zenith_angle, np.abs(signed))
    with pytest.raises(RetrievalInputError, match="azimuth"):
        directions(signed)


def test_back_and_forth_has_a_cycle_for_each_way():
    there_and_back = [0.0, 20.0, 40.0, 60.0, 40.0, 20.0]
    assert numbered([*there_and_back, *there_and_back]) == [0] * 4 + [1] * 3 + [2] * 3 + [3] * 2
    twice_at_the_ends = [0.0, 20.0, 40.0, 60.0, 60.0, 40.0, 20.0, 0.0, 0.0, 20.0, 40.0, 60.0]
    assert numbered(twice_at_the_ends) == [0] * 4 + [1] * 4 + [2] * 4


def test_several_profiles_in_each_direction_are_one_visit():
    assert numbered(np.repeat(SWEEP * 2, 3)) == [0] * 15 + [1] * 15
    assert numbered([30.0] * 7) == [0] * 7


def test_directions_are_told_apart_to_five_hundredths_of_a_degree():
    found = directions([30.0, 30.02, 30.04, 29.98, 0.01, 0.0], [10.0, 370 - 360, 10.0, 10.01, 3, 9])
    assert found.index.tolist() == [1, 1, 2, 1, 0, 0]
    np.testing.assert_allclose(found.zenith_angle, [0.005, 30.0, 30.04], atol=1e-12)


def test_azimuth_goes_around():
    assert directions([30.0, 30.0, 30.0], [0.0, 360.0, 359.99]).index.tolist() == [0, 0, 0]


def test_the_zenith_lies_in_the_first_plane():
    found = directions([50.0, 0.0, 50.0, 50.0, 50.0], [40.0, 0.0, 220.0, 130.0, 310.0])
    assert found.index.tolist() == [2, 1, 0, 4, 3]
    assert found.azimuth.tolist() == pytest.approx([220.0, 40.0, 40.0, 310.0, 130.0])


def test_profiles_without_a_direction_go_with_the_one_before():
    zenith = [0.0, np.nan, 30.0, 0.0, 30.0]
    assert numbered(zenith) == [0, 0, 0, 1, 1]
    assert directions(zenith).index.tolist() == [0, -1, 1, 0, 1]
    assert directions([0.0, 30.0, 30.0], [np.nan, 5.0, np.nan]).index.tolist() == [0, 1, -1]
    assert numbered([np.nan, np.nan]) == [0, 0]
    assert numbered([]) == []


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.sampled_from([0.0, 10.0, 20.0, 30.0, 90.0]), min_size=1, max_size=40),
    st.lists(st.floats(1.0, 20.0), min_size=40, max_size=40),
)
def test_cycles_are_runs_without_a_return_or_a_long_gap(zenith, steps):
    seconds = np.cumsum(steps)[: len(zenith)]
    found = np.array(numbered(zenith, seconds=seconds))
    assert found[0] == 0
    assert set(np.diff(found)) <= {0, 1}
    index = directions(zenith).index
    gaps = np.diff(seconds)
    longest = 3 * np.median(gaps) if gaps.size else 0.0
    for number in range(found[-1] + 1):
        members = np.flatnonzero(found == number)
        visits = index[members][np.append(True, np.diff(index[members]) != 0)]
        assert len(set(visits)) == visits.size
        assert np.all(gaps[members[:-1]] <= longest)


@pytest.mark.parametrize(
    ("zenith", "azimuth", "times", "field"),
    [
        ([0.0, 181.0], None, [0, 1], "zenith_angle"),
        ([0.0, 10.0], [1.0], [0, 1], "azimuth"),
        ([[0.0, 10.0]], None, [0, 1], "zenith_angle"),
        ([0.0, 10.0], None, [1, 0], "times"),
        ([0.0, 10.0], None, [1, 1], "times"),
        ([0.0, 10.0], None, [1, 2, 3], "times"),
        ([0.0, 10.0], None, ["a", "b"], "times"),
        ([0.0, 10.0], [0.0, 500.0], [0, 1], "azimuth"),
    ],
)
def test_what_cannot_be_right_is_refused(zenith, azimuth, times, field):
    with pytest.raises(RetrievalInputError) as caught:
        cycles(zenith, azimuth, times)
    assert caught.value.field == field
