"""The time axis: proportional to time, or broken at marked gaps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.figures.time_axis import segments, time_axis, usual_step

ORIGIN = np.datetime64("2024-03-01T00:00:00", "ns")
SECOND = np.timedelta64(1_000_000_000, "ns")


def at(seconds) -> np.ndarray:
    return ORIGIN + np.asarray(np.round(np.asarray(seconds) * 1e9), dtype="timedelta64[ns]")


rising = st.lists(st.integers(1, 400_000), min_size=1, max_size=60).map(np.cumsum)


@given(seconds=rising)
def test_every_position_is_inside_and_in_order(seconds):
    time = at(seconds)
    axis = time_axis(time)
    x = axis.x(time)
    low, high = axis.limits
    assert (np.diff(x) > 0).all()
    assert ((x >= low) & (x <= high)).all()
    assert (axis.x(at([-1e9, 9e8])) == [low, high]).all()


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


@given(seconds=rising)
def test_ticks_are_few_and_in_order(seconds):
    axis = time_axis(at(seconds))
    ticks = axis.ticks()
    assert 1 <= len(ticks) <= 11
    positions = [tick.x for tick in ticks]
    assert positions == sorted(set(positions))
    assert "-" in ticks[0].label


def test_continuous_axis_is_proportional_to_time():
    axis = time_axis(at(np.r_[150:30_000:300, 39_750:86_400:300]))
    assert not axis.broken
    assert axis.breaks.size == 0
    span = axis.x(at([0, 43_200, 86_400]))
    np.testing.assert_allclose(np.diff(span), 0.5, rtol=1e-9)


def test_day_has_round_hours_and_names_each_day_once():
    ticks = time_axis(at(np.arange(150, 86_400, 300))).ticks()
    labels = [tick.label for tick in ticks]
    assert labels == [
        "00:00\n2024-03-01", "03:00", "06:00", "09:00", "12:00", "15:00", "18:00", "21:00",
        "00:00\n2024-03-02",
    ]  # fmt: skip
    np.testing.assert_allclose([tick.x for tick in ticks], np.arange(9) / 8, atol=1e-9)


def test_long_axis_has_round_months():
    ticks = time_axis(at(np.arange(0, 700 * 86_400, 3600))).ticks()
    assert [tick.label for tick in ticks][:3] == ["2024-04-01", "2024-07-01", "2024-10-01"]


def test_sparse_axis_is_cut_at_the_gaps():
    days = [np.arange(30, 3600, 60) + 86_400 * k for k in (0, 5, 6, 40)]
    axis = time_axis(at(np.concatenate(days)))
    assert axis.broken
    assert axis.breaks.size == 3
    starts, stops = axis.x(axis.starts), axis.x(axis.stops)
    # Each hour takes the same width, gaps of 5 and of 34 days too.
    np.testing.assert_allclose(stops - starts, (stops - starts)[0])
    np.testing.assert_allclose(starts[1:] - stops[:-1], (starts[1:] - stops[:-1])[0])
    assert ((axis.breaks > stops[:-1]) & (axis.breaks < starts[1:])).all()
    assert [tick.label.split("\n")[-1] for tick in axis.ticks() if "\n" in tick.label] == [
        "2024-03-01", "2024-03-06", "2024-03-07", "2024-04-10",
    ]  # fmt: skip


def test_hundreds_of_single_profiles_keep_a_width():
    axis = time_axis(np.sort(at(np.r_[np.arange(0, 3600, 60), 86_400 * np.arange(1, 300)])))
    assert axis.width.min() > 0
    assert len(axis.ticks()) <= 11


@pytest.mark.parametrize("seconds", [[0], [0, 0], [0, 0, 60]])
def test_repeated_times_are_accepted(seconds):
    axis = time_axis(at(seconds))
    assert np.isfinite(axis.x(at(seconds))).all()
    assert axis.limits[1] > axis.limits[0]


def test_usual_step_is_the_median():
    assert usual_step(at([0, 10, 20, 30, 500])) == 10 * SECOND
    assert usual_step(at([7])) == 60 * SECOND
    assert segments(at([])) == []


def test_an_axis_reaches_from_the_first_start_to_the_last_end():
    time = at([100, 3700, 7300])
    axis = time_axis(time, (time - 2 * SECOND, time + 3 * SECOND))
    assert (axis.starts[0], axis.stops[-1]) == (time[0] - 2 * SECOND, time[-1] + 3 * SECOND)
    single = time_axis(time[:1], (time[:1], time[:1]))
    assert single.limits[1] > single.limits[0]
