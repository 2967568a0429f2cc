"""Profiles without light are told from weak light, clouds and gaps by the others of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.signal.light import Teller, all_dark, brightest, variation

R = 7.5 * (np.arange(2000) + 0.5)
SKY = 2.0
"""Counts of a bin by the sky."""


def profiles(rng, light, number=40, sky=SKY, cloud=0.0):
    """Return counts with this many counts by light at 300 m, and a cloud there."""
    mean = light * np.minimum(R / 300.0, 1.0) ** 2 * (300.0 / R) ** 2 * np.exp(-R / 4000.0)
    mean = mean * (1.0 + cloud * np.exp(-(((R - 300.0) / 30.0) ** 2)))
    mean[R > 300.0] *= np.exp(-0.5 * np.log1p(cloud))
    return rng.poisson(sky + mean, (number, R.size))


def lightless(counts, shots=None):
    shots = np.full(len(counts), 600) if shots is None else shots
    found = variation(counts, shots)
    teller = brightest({"channel": found})
    if teller is None and all_dark([counts.sum(axis=0)]):
        teller = Teller("channel", np.inf)
    return np.zeros(len(counts), np.bool_) if teller is None else teller.lightless(found)


@pytest.mark.parametrize("dark", [1, 10, 30])
def test_profiles_without_light_are_told_however_many(dark):
    rng = np.random.default_rng(1)
    counts = np.concatenate([profiles(rng, 5000.0), profiles(rng, 0.0, dark)])
    np.testing.assert_array_equal(lightless(counts), np.arange(len(counts)) >= 40)


def test_nothing_holds_light_where_the_laser_is_off_all_the_time():
    assert lightless(profiles(np.random.default_rng(2), 0.0)).all()


@pytest.mark.parametrize("light", [0.3, 1.0, 3.0, 30.0])
def test_weak_light_is_none(light):
    """The noise of each profile hides it; their sum does not."""
    assert not lightless(profiles(np.random.default_rng(3), light)).any()


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_cloud_near_the_ground_and_weak_laser_hold_light(share):
    rng = np.random.default_rng(4)
    some = int(40 * share)
    foggy = profiles(rng, 5000.0, some, cloud=1000.0)
    weak = profiles(rng, 250.0, 5)
    assert not lightless(np.concatenate([foggy, profiles(rng, 5000.0, 40 - some), weak])).any()


def test_a_gap_is_no_profile_without_light():
    rng = np.random.default_rng(5)
    counts, shots = profiles(rng, 5000.0), np.full(40, 600)
    counts[3], shots[4] = 0, 0
    assert not lightless(counts, shots).any()


def test_the_answer_of_a_profile_depends_on_no_other_of_its_chunk():
    rng = np.random.default_rng(6)
    counts, shots = profiles(rng, 5000.0, sky=0.3), np.full(40, 600)
    whole = variation(counts, shots)
    for size in (1, 3, 7):
        parts = [variation(counts[k : k + size], shots[k : k + size]) for k in range(0, 40, size)]
        for name in whole._fields:
            joined = np.concatenate([getattr(part, name) for part in parts])
            np.testing.assert_array_equal(joined, getattr(whole, name))
