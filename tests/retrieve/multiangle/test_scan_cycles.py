"""Cycles and directions of scans."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle.scan_cycles import cycles, directions, vertical_planes

SWEEP = [0.0, 15.0, 30.0, 45.0, 60.0]


def numbered(zenith, azimuth=None, seconds=None, lengths=0.5):
    clock = np.arange(len(zenith)) * 60.0 if seconds is None else np.asarray(seconds)
    return cycles(zenith, azimuth, np.stack([clock, clock + lengths], axis=-1)).tolist()


def test_a_cycle_begins_where_a_direction_returns():
    assert numbered(SWEEP * 3) == [0] * 5 + [1] * 5 + [2] * 5


def test_times_may_be_dates():
    starts = np.datetime64("2026-01-01") + 30 * np.arange(10).astype("timedelta64[s]")
    bounds = np.stack([starts, starts + np.timedelta64(29, "s")], axis=-1)
    assert cycles(SWEEP * 2, None, bounds).tolist() == [0] * 5 + [1] * 5
    bounds[5:] += np.timedelta64(120, "s")
    assert cycles([0.0, 10.0, *SWEEP[2:], *SWEEP], None, bounds).tolist() == [0] * 5 + [1] * 5
    bounds[3, 1] = np.datetime64("NaT")
    with pytest.raises(RetrievalInputError, match="ascending"):
        cycles(SWEEP * 2, None, bounds)


def test_profiles_without_a_duration_are_accepted():
    assert numbered(SWEEP * 2, lengths=0.0) == [0] * 5 + [1] * 5


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


def test_a_long_dwell_at_low_elevation_is_no_gap():
    """Scanners dwell longer where the signal is weak: 200 s among 20 s."""
    dwell = np.tile([20.0, 20.0, 20.0, 20.0, 200.0], 3)
    seconds = np.append(0.0, np.cumsum(dwell + 2.0)[:-1])
    assert numbered(SWEEP * 3, seconds=seconds, lengths=dwell) == [0] * 5 + [1] * 5 + [2] * 5
    # One of the long dwells is lost, in the middle of a cycle that begins with the second angle.
    turned = [SWEEP[i] for i in (3, 4, 0, 1, 2)] * 3
    dwell = np.tile([20.0, 200.0, 20.0, 20.0, 20.0], 3)
    seconds = np.append(0.0, np.cumsum(dwell + 2.0)[:-1])
    kept = np.arange(15) != 6
    numbers = numbered(np.array(turned)[kept], seconds=seconds[kept], lengths=dwell[kept])
    assert numbers == [0] * 5 + [1] * 4 + [2] * 5
    # A pause too long for a lost file.
    seconds[8:] += 400.0
    assert numbered(turned, seconds=seconds, lengths=dwell) == [0] * 5 + [1] * 3 + [2] * 5 + [3] * 2


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.floats(0.02, 0.05))
def test_encoder_noise_neither_splits_nor_merges_directions(seed, noise):
    rng = np.random.default_rng(seed)
    zenith = np.tile([60.0, 30.0, 0.0, 30.0, 60.0], 12)
    azimuth = np.tile([180.0, 180.0, 40.0, 0.0, 0.0], 12)
    shaky = np.abs(zenith + rng.normal(0.0, noise, 60))
    turned = (azimuth + rng.normal(0.0, noise, 60)) % 360.0
    result = directions(shaky, turned)
    assert result.index.tolist() == [0, 1, 2, 3, 4] * 12
    np.testing.assert_allclose(result.zenith_angle, [60, 30, 0, 30, 60], atol=0.08)
    off = (result.azimuth - [180.0, 180.0, 180.0, 0.0, 0.0] + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(off[[0, 1, 3, 4]], 0.0, atol=0.06)
    assert numbered(shaky, turned) == np.repeat(np.arange(12), 5).tolist()


def test_slow_sweeps_are_no_single_direction():
    fine = np.arange(0.0, 60.0, 0.1)
    assert directions(fine).zenith_angle.size == fine.size
    rng = np.random.default_rng(3)
    steps = np.tile(np.arange(10.0, 40.0, 0.2), 5)
    assert directions(steps + rng.normal(0.0, 0.01, steps.size)).zenith_angle.size == 150


def test_a_sweep_over_the_zenith_is_one_cycle():
    zenith = [60.0, 30.0, 0.0, 30.0, 60.0]
    azimuth = [270.0, 270.0, 12.3, 90.0, 90.0]
    assert numbered(zenith * 2, azimuth * 2) == [0] * 5 + [1] * 5
    # Without azimuths the second half has the directions of the first half.
    assert numbered(zenith) == [0, 0, 0, 1, 1]


def test_signed_zenith_angles_point_to_both_sides():
    signed = [-60.0, -30.0, 0.0, 30.0, 60.0]
    result = directions(signed, [90.0] * 5)
    np.testing.assert_array_equal(result.index, np.arange(5))
    np.testing.assert_allclose(result.azimuth, [270.0, 270.0, 90.0, 90.0, 90.0])
    np.testing.assert_allclose(result.zenith_angle, np.abs(signed))
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
    # Two profiles in some directions, anywhere in the sweep.
    for twice in ([0, 0, 30, 30, 60, 75], [0, 0, 30, 60, 75], [0, 30, 60, 75, 75], [0, 75, 75]):
        assert numbered(twice * 3) == np.repeat([0, 1, 2], len(twice)).tolist()
    # Back and forth, three profiles each: six follow each other where it turns.
    there = np.repeat([0.0, 20.0, 40.0], 3)
    assert numbered([*there, *there[::-1], *there]) == [0] * 9 + [1] * 9 + [2] * 9


def test_directions_differ_by_more_than_a_quarter_of_a_degree():
    result = directions([30.0, 30.2, 30.8, 29.9, 0.1, 0.0], [10.0, 370 - 360, 10.0, 10.1, 3, 9])
    assert result.index.tolist() == [1, 1, 2, 1, 0, 0]
    np.testing.assert_allclose(result.zenith_angle, [0.05, 30.1 - 0.2 / 3, 30.8], atol=1e-12)


def test_azimuth_goes_around():
    assert directions([30.0, 30.0, 30.0], [0.0, 360.0, 359.99]).index.tolist() == [0, 0, 0]


def test_the_zenith_lies_in_the_first_plane():
    result = directions([50.0, 0.0, 50.0, 50.0, 50.0], [40.0, 0.0, 220.0, 130.0, 310.0])
    assert result.index.tolist() == [2, 1, 0, 4, 3]
    assert result.azimuth.tolist() == pytest.approx([220.0, 40.0, 40.0, 310.0, 130.0])


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
    numbers = np.array(numbered(zenith, seconds=seconds))
    assert numbers[0] == 0
    assert set(np.diff(numbers)) <= {0, 1}
    index = directions(zenith).index
    gaps = np.diff(seconds)
    longest = 3 * np.median(gaps) if gaps.size else 0.0
    for number in range(numbers[-1] + 1):
        members = np.flatnonzero(numbers == number)
        visits = index[members][np.append(True, np.diff(index[members]) != 0)]
        assert len(set(visits)) == visits.size
        assert np.all(gaps[members[:-1]] - 0.5 <= longest)


@each(
    ("zenith", "azimuth", "bounds", "field"),
    [
        ([0.0, 181.0], None, [[0, 1], [1, 2]], "zenith_angle"),
        ([0.0, 10.0], [1.0], [[0, 1], [1, 2]], "azimuth"),
        ([[0.0, 10.0]], None, [[0, 1], [1, 2]], "zenith_angle"),
        ([0.0, 10.0], None, [[1, 2], [0, 1]], "time_bnds"),
        ([0.0, 10.0], None, [[1, 2], [1, 2]], "time_bnds"),
        ([0.0, 10.0], None, [[0, 1], [2, 1]], "time_bnds"),
        ([0.0, 10.0], None, [0, 1], "time_bnds"),
        ([0.0, 10.0], None, [["a", "b"], ["c", "d"]], "time_bnds"),
        ([0.0, 10.0], [0.0, 500.0], [[0, 1], [1, 2]], "azimuth"),
    ],
)
def test_invalid_arguments_are_refused(zenith, azimuth, bounds, field):
    with pytest.raises(RetrievalInputError) as caught:
        cycles(zenith, azimuth, bounds)
    assert caught.value.field == field


def test_slews_between_the_planes_of_a_volume_begin_no_cycle():
    """Two volumes of 6 azimuths: beams last 1.4 s, slews 15 s, the way back 40 s."""
    elevations = np.arange(5.0, 25.5, 0.5)
    zenith = np.tile(90.0 - elevations, 12)
    azimuth = np.tile(np.repeat(62.0 + 15.0 * np.arange(6), elevations.size), 2)
    steps = np.full(zenith.size, 1.5)
    steps[:: elevations.size] = 15.0
    steps[zenith.size // 2] = 40.0
    seconds = np.cumsum(steps)
    numbers = numbered(zenith, azimuth, seconds=seconds, lengths=1.4)
    assert numbers == [0] * (zenith.size // 2) + [1] * (zenith.size // 2)
    # A pause longer than the planes before it ends the volume.
    seconds[2 * elevations.size :] += 200.0
    numbers = numbered(zenith, azimuth, seconds=seconds, lengths=1.4)
    assert numbers[2 * elevations.size - 1 : 2 * elevations.size + 1] == [0, 1]


RHI = [0.0, 30.0, 60.0, 80.0]
AZIMUTHS = [0.0, 90.0, 180.0, 270.0]
UP = list(itertools.product(AZIMUTHS, RHI))
DOWN = list(itertools.product(AZIMUTHS, RHI[::-1]))


def volumes(beams, repeated=3, lost=()):
    """Return the cycles of repeated volumes of beams (azimuth, zenith angle), some of them lost."""
    azimuth, zenith = np.delete(np.tile(np.transpose(beams), repeated), lost, axis=1)
    return numbered(zenith, azimuth)


def whole(length, repeated=3):
    return np.repeat(np.arange(repeated), length).tolist()


@each(
    "beams",
    [
        UP,
        DOWN,
        # On one plane, to both sides one after the other.
        [beam for beam in UP if beam[0] in (0.0, 180.0)],
        # Each second azimuth the other way: two vertical beams follow each other.
        [*DOWN[:4], *UP[4:8], *DOWN[8:12], *UP[12:]],
        # The vertical between tilted beams of several azimuths.
        [(0.0, 0.0), (0.0, 20.0), (0.0, 0.0), (90.0, 20.0), (0.0, 0.0), (180.0, 20.0)],
        [(0.0, 20.0), (0.0, 0.0), (90.0, 20.0), (0.0, 0.0), (180.0, 20.0), (0.0, 0.0)],
        # Plan-position scans after one vertical beam.
        [(0.0, 0.0), *((azimuth, 60.0) for azimuth in range(0, 360, 20))],
        # Azimuths close together, of a sector scan.
        list(itertools.product([10.0, 12.0, 14.0, 16.0], RHI)),
    ],
)
def test_the_vertical_beam_of_each_azimuth_of_a_volume_ends_no_cycle(beams):
    assert volumes(beams) == whole(len(beams))


def test_encoder_noise_of_vertical_beams_ends_no_cycle():
    rng = np.random.default_rng(5)
    azimuth, zenith = np.tile(np.transpose(UP), 6)
    zenith = np.abs(zenith + rng.normal(0.0, 0.03, zenith.size))
    assert numbered(zenith, azimuth + 1.0) == whole(len(UP), 6)


def test_lost_beams_of_a_volume_with_vertical_beams_end_no_cycle():
    size = len(UP)
    for lost in (1, 4, 5, 7, size + 1, size + 4, size + 5, 2 * size - 1):
        assert volumes(UP, lost=[lost]) == np.delete(whole(size), lost).tolist()


def test_a_record_that_begins_within_a_volume_has_cycles_of_all_directions():
    for beams in (UP, DOWN):
        for lost in range(1, len(beams)):
            numbers = volumes(beams, 4, lost=range(lost))
            assert set(np.bincount(numbers)[:3]) <= {len(beams) - 1, len(beams), len(beams) + 1}


def test_a_return_to_the_vertical_at_one_azimuth_begins_a_cycle():
    assert numbered([0.0, 60.0, 70.0] * 3, [40.0] * 9) == whole(3)
    assert numbered([0.0, 60.0, 0.0, 70.0], [40.0] * 4) == [0, 0, 1, 1]
    # The azimuth of a vertical beam tells nothing.
    assert numbered([0.0, 60.0, 70.0] * 3, [0.0, 40.0, 40.0] * 3) == whole(3)
    # The first beams of the second sweep over the zenith are lost.
    azimuth = [270.0, 270.0, 90.0, 90.0, 90.0]
    assert numbered([60, 30, 0, 30, 60, 0, 30, 60], [*azimuth, 90, 90, 90]) == [0] * 5 + [1] * 3


def test_a_direction_along_the_vertical_belongs_to_all_planes():
    zenith = np.array([0.0, 30.0, 60.0, 30.0, 60.0, 45.0])
    azimuth = np.array([0.0, 10.0, 10.0, 100.0, 100.0, 190.0])
    planes = [plane.tolist() for plane in vertical_planes(zenith, azimuth)]
    assert planes == [[0, 1, 2, 5], [0, 3, 4]]
    assert vertical_planes(zenith[:1], azimuth[:1]) == []
