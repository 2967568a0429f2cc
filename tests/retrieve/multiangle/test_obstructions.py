"""Beams that end at an obstruction, and those that do not."""

from __future__ import annotations

import numpy as np
import pytest
from support.cases import each

from lidarops.retrieve.multiangle.analog_baseline import obstruction_range

DISTANCE = 100.0 + 3.75 * (np.arange(2000) + 0.5)


def counts(profiles, extinction, shots, *, target=None, width=15.0, seed=1):
    """Return rates in MHz, and their variances, of beams that a target may block."""
    rng = np.random.default_rng(seed)
    rate = 60.0 * (300.0 / DISTANCE) ** 2 * np.exp(-2.0 * extinction * DISTANCE)
    if target is not None:
        rate = np.where(target > DISTANCE, rate, 0.0)
        rate = np.where((target <= DISTANCE) & (target + width > DISTANCE), 150.0, rate)
    exposure = 0.025 * shots
    seen = rng.poisson(rate * exposure, (profiles, DISTANCE.size)) / exposure
    return seen, (seen + 1.0 / exposure) / exposure


@pytest.mark.parametrize("target", [200.0, 700.0, 1500.0])
def test_a_target_is_found_where_it_stands(target):
    power, variance = counts(50, 1e-4, 60, target=target)
    found = obstruction_range(power, variance, DISTANCE)
    assert np.isfinite(found).mean() > 0.95
    found = found[np.isfinite(found)]
    assert (found <= target + 2.0).all()
    assert (found > target - 130.0).all()


@each("extinction", [0.0, 1e-4, 3e-3, 1e-2])
@each("shots", [20, 60, 2000])
def test_air_is_no_obstruction(extinction, shots):
    """Up to fog with a visibility of 300 m."""
    found = obstruction_range(*counts(300, extinction, shots), DISTANCE)
    assert np.isinf(found).all()


def test_missing_bins_are_no_darkness():
    power, variance = counts(20, 1e-4, 600)
    power[:, 100:400] = np.nan
    assert np.isinf(obstruction_range(power, variance, DISTANCE)).all()
    power[:] = np.nan
    assert np.isinf(obstruction_range(power, variance, DISTANCE)).all()
    assert np.isinf(obstruction_range(power[:, :50], variance[:, :50], DISTANCE[:50])).all()
