"""Positions of times, and where measurements pause."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lidarops.figures.panels import time_axis
from lidarops.figures.time_axis import days, segments, usual_step

ORIGIN = np.datetime64("2024-03-01T00:00:00", "ns")
SECOND = np.timedelta64(1_000_000_000, "ns")


def at(seconds) -> np.ndarray:
    return ORIGIN + np.asarray(np.round(np.asarray(seconds) * 1e9), dtype="timedelta64[ns]")


rising = st.lists(st.integers(1, 400_000), min_size=1, max_size=60).map(np.cumsum)


@given(seconds=rising)
def test_segments_cover_all_and_hold_no_gap(seconds):
    time = at(seconds)
    parts = segments(time)
    assert np.concatenate([time[part] for part in parts]).tolist() == time.tolist()
    limit = 2.5 * usual_step(time)
    for part in parts:
        assert (np.diff(time[part]) <= limit).all()
    for before, after in pairwise(parts):
        assert time[after.start] - time[before.stop - 1] > limit


def test_usual_step_is_the_median():
    assert usual_step(at([0, 10, 20, 30, 500])) == 10 * SECOND
    assert usual_step(at([7])) == 60 * SECOND
    assert segments(at([])) == []


def test_an_axis_reaches_from_the_first_start_to_the_last_end():
    time = at([100, 3700, 7300])
    axis = time_axis(time - 2 * SECOND, time + 3 * SECOND)
    assert (axis.low, axis.high) == (days(time)[0] - 2 / 86_400, days(time)[-1] + 3 / 86_400)
    single = time_axis(time[:1], time[:1])
    assert single.high > single.low


def test_positions_are_days_since_1970():
    seconds = (at([0, 43_200, 86_400]) - np.datetime64(0, "ns")) / SECOND
    np.testing.assert_allclose(days(at([0, 43_200, 86_400])), seconds / 86_400, rtol=1e-14)
