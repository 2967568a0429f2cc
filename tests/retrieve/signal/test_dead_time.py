"""The dead time by which photon counting is proportional to analog."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.signal.dead_time import estimate_dead_time

DISTANCE = 7.5 * (np.arange(4000) + 0.5)
LIGHT = 400.0 * (300.0 / DISTANCE) ** 2 * np.exp(-2e-4 * DISTANCE)
"""MHz."""
LAG = 10
SLOPE = 60.0
"""MHz mV-1."""


def record(
    rng, dead_time, *, light=LIGHT, sky=0.5, groups=4, shots=600, paralysable=False, baseline=0.0
):
    """Return counts, exposure, and analog with its variance, of groups of profiles."""
    true = np.where(DISTANCE > 150.0, light, 0.0) + sky
    load = dead_time * 1e6 * true
    rate = true * np.exp(-load) if paralysable else true / (1.0 + load)
    exposure = np.full(groups, shots * 0.05)
    counts = rng.poisson(rate * exposure[:, np.newaxis]).astype(np.float64)
    noise = 2e-3
    clear = np.interp(np.arange(DISTANCE.size) - LAG, np.arange(DISTANCE.size), true) / SLOPE
    clear += baseline * np.exp(-DISTANCE / 3000.0)
    analog = 4.8 + clear + rng.normal(0.0, noise, (groups, DISTANCE.size))
    return counts, exposure, analog, np.full(analog.shape, noise**2)


@pytest.mark.parametrize("dead_time", [2e-9, 6e-9, 1.2e-8])
@pytest.mark.parametrize("sky", [0.0, 5.0])
def test_the_dead_time_lies_within_its_error(dead_time, sky):
    rng = np.random.default_rng(1)
    deviations = []
    for _ in range(20):
        estimate = estimate_dead_time(*record(rng, dead_time, sky=sky), LAG)
        assert estimate.standard_error < 0.1 * dead_time
        deviations.append((estimate.dead_time - dead_time) / estimate.standard_error)
    assert np.sqrt(np.mean(np.square(deviations))) < 1.5


def test_a_distorted_analog_record_widens_the_error():
    """Analog 3 percent too large beyond 1 km: true within the error, which is larger."""
    counts, exposure, analog, variance = record(np.random.default_rng(2), 6e-9)
    clean = estimate_dead_time(counts, exposure, analog, variance, LAG)
    bent = 4.8 + (analog - 4.8) * np.where(DISTANCE > 1000.0, 1.03, 1.0)
    estimate = estimate_dead_time(counts, exposure, bent, variance, LAG)
    assert estimate.standard_error > 2.0 * clean.standard_error
    assert abs(estimate.dead_time - 6e-9) < 2.0 * estimate.standard_error


def test_a_paralysable_counter_has_no_certain_dead_time():
    parts = record(np.random.default_rng(3), 6e-9, paralysable=True)
    estimate = estimate_dead_time(*parts, LAG)
    assert estimate.standard_error > 0.1 * estimate.dead_time


def test_weak_light_shows_no_dead_time():
    parts = record(np.random.default_rng(4), 4e-9, light=0.01 * LIGHT)
    assert estimate_dead_time(*parts, LAG) is None


@pytest.mark.parametrize("light", [0.001, 0.003])
def test_noise_shows_no_dead_time(light):
    rng = np.random.default_rng(1)
    for _ in range(40):
        assert estimate_dead_time(*record(rng, 6e-9, light=light * LIGHT), LAG) is None


# The largest load is 0.08 and 0.10.
@pytest.mark.parametrize(("light", "baseline", "shown"), [(0.015, 1e-3, False), (0.02, 0.0, True)])
def test_a_baseline_shows_no_dead_time(light, baseline, shown):
    """At low loads, where 1 uV would change it by many stated errors."""
    rng = np.random.default_rng(1)
    for _ in range(4):
        night = {"groups": 40, "shots": 6000, "baseline": baseline}
        estimate = estimate_dead_time(*record(rng, 4e-9, light=light * LIGHT, **night), LAG)
        assert (estimate is not None) is shown
        assert not shown or abs(estimate.dead_time - 4e-9) < 3.0 * estimate.standard_error


def test_few_bins_with_light_show_a_dead_time_within_its_error():
    rng = np.random.default_rng(1)
    light = np.where(DISTANCE < 900.0, LIGHT, 0.0)
    deviations = []
    for _ in range(20):
        estimate = estimate_dead_time(*record(rng, 6e-9, light=light, groups=1), LAG)
        deviations.append((estimate.dead_time - 6e-9) / estimate.standard_error)
    assert np.sqrt(np.mean(np.square(deviations))) < 1.5


@pytest.mark.parametrize("clipped", [5.5, 7.0, 8.0])
def test_a_clipped_analog_record_shows_no_dead_time(clipped):
    """All bins with light have the same analog signal."""
    counts, exposure, analog, variance = record(np.random.default_rng(3), 6e-9)
    analog = np.where(analog > clipped, clipped, 4.8)
    assert estimate_dead_time(counts, exposure, analog, variance, LAG) is None


def test_missing_analog_bins_do_not_count():
    counts, exposure, analog, variance = record(np.random.default_rng(5), 6e-9)
    analog[:, :60] = np.nan
    estimate = estimate_dead_time(counts, exposure, analog, variance, LAG)
    assert abs(estimate.dead_time - 6e-9) < 3.0 * estimate.standard_error
    assert estimate_dead_time(counts, exposure, np.full_like(analog, np.nan), variance, LAG) is None
