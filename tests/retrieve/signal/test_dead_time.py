"""The dead time by which photon counting is proportional to analog."""

from __future__ import annotations

import numpy as np
import pytest
from support.dead_times import DISTANCE, LAG, LIGHT, NONLINEAR, SCENES, draw_scene, record

from lidarops.retrieve.signal.dead_time import estimate_dead_time


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("dead_time", [4e-9, 8e-9])
def test_profiles_need_not_be_alike(scene, dead_time):
    """Errors are those of noise: a mean over profiles of different light has another rate."""
    rng = np.random.default_rng(7)
    deviations = []
    for _ in range(4):
        estimate = estimate_dead_time(draw_scene(rng, scene, dead_time), LAG)
        assert estimate.standard_error < 0.01 * dead_time
        deviations.append((estimate.dead_time - dead_time) / estimate.standard_error)
    assert np.max(np.abs(deviations)) < 2.0


@pytest.mark.parametrize("scene", SCENES)
def test_a_nonlinear_analog_record_lies_within_the_error(scene):
    """One percent at the largest signal."""
    rng = np.random.default_rng(8)
    estimate = estimate_dead_time(draw_scene(rng, scene, 4e-9, NONLINEAR), LAG)
    assert abs(estimate.dead_time - 4e-9) < 2.0 * estimate.standard_error


@pytest.mark.parametrize("dead_time", [2e-9, 6e-9, 1.2e-8])
@pytest.mark.parametrize("sky", [0.0, 5.0])
def test_the_dead_time_lies_within_its_error(dead_time, sky):
    rng = np.random.default_rng(1)
    deviations = []
    for _ in range(20):
        estimate = estimate_dead_time(record(rng, dead_time, sky=sky), LAG)
        assert estimate.standard_error < 0.1 * dead_time
        deviations.append((estimate.dead_time - dead_time) / estimate.standard_error)
    assert np.sqrt(np.mean(np.square(deviations))) < 1.5


def test_a_distorted_analog_record_widens_the_error():
    """Analog 3 percent too large beyond 1 km: true within the error, which is larger."""
    groups = record(np.random.default_rng(2), 6e-9)
    clean = estimate_dead_time(groups, LAG)
    gain = np.where(DISTANCE > 1000.0, 1.03, 1.0)
    bent = [group._replace(analog=4.8 + (group.analog - 4.8) * gain) for group in groups]
    estimate = estimate_dead_time(bent, LAG)
    assert estimate.standard_error > 2.0 * clean.standard_error
    assert abs(estimate.dead_time - 6e-9) < 2.0 * estimate.standard_error


def test_a_paralysable_counter_has_no_certain_dead_time():
    parts = record(np.random.default_rng(3), 6e-9, paralysable=True)
    estimate = estimate_dead_time(parts, LAG)
    assert estimate.standard_error > 0.1 * estimate.dead_time


def test_weak_light_shows_no_dead_time():
    parts = record(np.random.default_rng(4), 4e-9, light=0.01 * LIGHT)
    assert estimate_dead_time(parts, LAG) is None


@pytest.mark.parametrize("light", [0.001, 0.003])
def test_noise_shows_no_dead_time(light):
    rng = np.random.default_rng(1)
    for _ in range(40):
        assert estimate_dead_time(record(rng, 6e-9, light=light * LIGHT), LAG) is None


# The largest load is 0.08 and 0.10.
@pytest.mark.parametrize(("light", "baseline", "shown"), [(0.015, 1e-3, False), (0.02, 0.0, True)])
def test_a_baseline_shows_no_dead_time(light, baseline, shown):
    """At low loads, where 1 uV would change it by many stated errors."""
    rng = np.random.default_rng(1)
    for _ in range(4):
        night = {"groups": 40, "shots": 6000, "baseline": baseline}
        estimate = estimate_dead_time(record(rng, 4e-9, light=light * LIGHT, **night), LAG)
        assert (estimate is not None) is shown
        assert not shown or abs(estimate.dead_time - 4e-9) < 3.0 * estimate.standard_error


def test_few_bins_with_light_show_a_dead_time_within_its_error():
    rng = np.random.default_rng(1)
    light = np.where(DISTANCE < 900.0, LIGHT, 0.0)
    deviations = []
    for _ in range(20):
        estimate = estimate_dead_time(record(rng, 6e-9, light=light, groups=1), LAG)
        deviations.append((estimate.dead_time - 6e-9) / estimate.standard_error)
    assert np.sqrt(np.mean(np.square(deviations))) < 1.5


@pytest.mark.parametrize("clipped", [5.5, 7.0, 8.0])
def test_a_clipped_analog_record_shows_no_dead_time(clipped):
    """All bins with light have the same analog signal."""
    groups = [
        group._replace(analog=np.where(group.analog > clipped, clipped, 4.8))
        for group in record(np.random.default_rng(3), 6e-9)
    ]
    assert estimate_dead_time(groups, LAG) is None


def test_missing_analog_bins_do_not_count():
    groups = record(np.random.default_rng(5), 6e-9)
    for group in groups:
        group.analog[:60] = np.nan
    estimate = estimate_dead_time(groups, LAG)
    assert abs(estimate.dead_time - 6e-9) < 3.0 * estimate.standard_error
    for group in groups:
        group.analog[:] = np.nan
    assert estimate_dead_time(groups, LAG) is None
