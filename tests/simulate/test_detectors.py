"""Detectors against event-by-event and shot-by-shot simulation."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.simulate.instrument import count_photons, digitise, release
from lidarops.simulate.settings import AnalogRecorder

BIN_WIDTH = 7.5
BIN_TIME = 50e-9


def _events(rate, dead_time, windows, seed):
    """Counts of photoelectrons and of what a counter registers, in windows of one bin."""
    random = np.random.default_rng(seed)
    span = windows * BIN_TIME
    arrivals = np.sort(random.random(random.poisson(rate * span)) * span)
    registered, last = [], -1.0
    for arrival in arrivals.tolist():
        if arrival - last >= dead_time:
            registered.append(arrival)
            last = arrival
    edges = np.arange(windows + 1) * BIN_TIME
    return np.histogram(arrivals, edges)[0], np.histogram(registered, edges)[0]


@pytest.mark.parametrize(("rate", "dead_time"), [(20e6, 4e-9), (30e6, 4e-9), (80e6, 3e-9)])
def test_dead_time_agrees_with_single_events(rate, dead_time):
    windows = 400_000
    released, registered = _events(rate, dead_time, windows, seed=11)
    shots, bins = 500, 40_000
    random = np.random.default_rng(12)
    light = release(np.full(bins, rate * 1e-6), shots=shots, bin_width=BIN_WIDTH, random=random)
    counted = count_photons(light, dead_time=dead_time, random=random)

    error = np.hypot(
        registered.std() / registered.mean() / np.sqrt(windows),
        counted.std() / counted.mean() / np.sqrt(bins),
    )
    assert counted.mean() / shots == pytest.approx(registered.mean(), rel=4 * error)
    # Windows of different shots are independent, so the variance of their sum adds up.
    assert counted.var() / shots == pytest.approx(registered.var(), rel=0.035)
    expected = np.cov(released, registered)[0, 1]
    assert np.cov(light.number, counted)[0, 1] / shots == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("rate", [0.02, 0.3, 2.0, 25.0, 200.0])
def test_mean_and_variance_of_renewal_theory(rate):
    shots, bins, dead_time = 600, 200_000, 4e-9
    random = np.random.default_rng(5)
    light = release(np.full(bins, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    counted = count_photons(light, dead_time=dead_time, random=random)
    load = rate * 1e6 * dead_time
    mean = rate * light.exposure / (1 + load)
    variance = rate * light.exposure / (1 + load) ** 3
    assert counted.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(variance / bins))
    # The standard error of a variance is larger for few counts, where the kurtosis is 1 / mean.
    assert counted.var() == pytest.approx(variance, rel=4.5 * np.sqrt((2 + 1 / mean) / bins) + 2e-3)
    assert np.all((counted >= 0) & (counted <= light.number))


def test_two_photoelectrons_coincide_as_often_as_they_must():
    # Two events at random in the exposure: lost with probability 2 tau / T to first order.
    shots, bins, dead_time = 1, 400_000, 1e-9
    random = np.random.default_rng(6)
    light = release(np.full(bins, 40.0), shots=shots, bin_width=BIN_WIDTH, random=random)
    pairs = light.number == 2
    lost = 1 - count_photons(light, dead_time=dead_time, random=random)[pairs].mean() / 2
    expected = dead_time / BIN_TIME
    assert lost == pytest.approx(expected, abs=4 * np.sqrt(expected / pairs.sum()))


def test_without_light_nothing_is_counted():
    random = np.random.default_rng(0)
    light = release(np.zeros(100), shots=600, bin_width=BIN_WIDTH, random=random)
    assert not count_photons(light, dead_time=4e-9, random=random).any()


def _shot_by_shot(rate, recorder, shots, bins, seed):
    """Every sample of every shot, with gamma-distributed charges, rounded and clipped."""
    random = np.random.default_rng(seed)
    number = random.poisson(rate * 1e6 * BIN_TIME, (shots, bins))
    spread = recorder.excess_noise - 1.0
    charge = random.gamma(number / spread, spread)
    voltage = recorder.gain * charge / (BIN_TIME * 1e6)
    voltage += recorder.dark_offset + recorder.noise * random.standard_normal((shots, bins))
    top = 2**recorder.adc_bits - 1
    return np.clip(np.rint(voltage / recorder.step), 0, top).sum(axis=0)


RECORDER = AnalogRecorder(gain=0.05, noise=0.3, dark_offset=3.0, adc_range=100, excess_noise=1.3)


@pytest.mark.parametrize("rate", [0.0, 3.0, 40.0])
def test_the_digitiser_agrees_with_single_shots(rate):
    shots, bins = 400, 4000
    oracle = _shot_by_shot(rate, RECORDER, shots, bins, seed=21)
    random = np.random.default_rng(22)
    light = release(np.full(bins * 10, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, RECORDER, random=random)
    error = oracle.std() / np.sqrt(bins)
    assert summed.mean() == pytest.approx(oracle.mean(), abs=4.5 * error)
    assert summed.var() == pytest.approx(oracle.var(), rel=4.5 * np.sqrt(2.2 / bins))
    expected = (RECORDER.gain * rate + RECORDER.dark_offset) / RECORDER.step
    assert summed.mean() / shots == pytest.approx(expected, abs=4.5 * error / shots)


def test_half_a_step_of_noise_is_enough_to_average_out_the_steps():
    # Gaussian noise on an offset between two steps, where the rounding is most biased.
    recorder = AnalogRecorder(
        gain=1.0, noise=0.5 * 100 / 4096, dark_offset=10.25 * 100 / 4096, adc_range=100
    )
    shots, bins = 2000, 3000
    oracle = _shot_by_shot(0.0, recorder, shots, bins, seed=31)
    bias = oracle.mean() / shots - 10.25
    assert abs(bias) < np.exp(-2 * np.pi**2 * 0.25) / np.pi + 4 * 0.58 / np.sqrt(shots * bins)
    random = np.random.default_rng(32)
    light = release(np.zeros(bins * 10), shots=shots, bin_width=BIN_WIDTH, random=random)
    assert digitise(light, recorder, random=random).var() == pytest.approx(oracle.var(), rel=0.15)


@pytest.mark.parametrize("above", [-2.0, 0.0, 1.0, 20.0])
def test_near_full_scale_some_shots_are_clipped(above):
    # Electronic noise only: a rate so high that the noise of one shot is nearly that.
    recorder = AnalogRecorder(gain=1e-4, noise=0.5, dark_offset=100 + above * 0.5, adc_range=100)
    shots, bins = 300, 3000
    oracle = _shot_by_shot(0.0, recorder, shots, bins, seed=41)
    random = np.random.default_rng(42)
    light = release(np.zeros(bins * 10), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    assert summed.max() <= shots * 4095
    assert summed.mean() == pytest.approx(
        oracle.mean(), abs=4.5 * oracle.std() / np.sqrt(bins) + 15
    )
    if above < 10:
        assert summed.std() == pytest.approx(oracle.std(), rel=0.08)
    else:
        assert np.all(summed == shots * 4095)


def test_both_outputs_see_the_same_photoelectrons():
    shots, bins, rate = 600, 50_000, 10.0
    random = np.random.default_rng(51)
    light = release(np.full(bins, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    analog = digitise(light, RECORDER, random=random)
    photon = count_photons(light, dead_time=4e-9, random=random)
    load = rate * 1e6 * 4e-9
    steps = RECORDER.gain / RECORDER.step / light.exposure * shots
    variance = steps**2 * RECORDER.excess_noise * rate * light.exposure
    variance += shots * ((RECORDER.noise / RECORDER.step) ** 2 + 1 / 12)
    shared = steps * rate * light.exposure / (1 + load) ** 2
    expected = shared / np.sqrt(variance * rate * light.exposure / (1 + load) ** 3)
    assert np.corrcoef(analog, photon)[0, 1] == pytest.approx(expected, abs=0.015)
    assert expected > 0.5
