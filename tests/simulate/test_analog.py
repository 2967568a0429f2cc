"""Digitisers against exact sums over their steps and against single shots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.special import ndtr
from scipy.stats import gamma, poisson

from lidarops.campaign.simulated_instrument import LEAST_NOISE, AnalogRecorder
from lidarops.simulate.analog import digitise, sample_moments
from lidarops.simulate.counting import release

BIN_WIDTH = 7.5
BIN_TIME = 50e-9


def _recorder(dark_offset, **keys):
    """Return a recorder whose offset may have drifted towards zero."""
    return AnalogRecorder(dark_offset=1000.0, **keys).model_copy(
        update={"dark_offset": dark_offset}
    )


def _steps(noise, offset, **more):
    """Return a recorder with steps of 1 mV."""
    return _recorder(offset, noise=noise, adc_range=4096.0, **({"gain": 1e-6} | more))


def _summed(mean, deviation):
    """Return mean and variance of a rounded normal variable by the sum over all steps."""
    steps = np.arange(np.floor(mean - 12 * deviation) - 1, np.ceil(mean + 12 * deviation) + 2)
    chance = ndtr((steps + 0.5 - mean) / deviation) - ndtr((steps - 0.5 - mean) / deviation)
    first = (steps - mean) @ chance
    return mean + first, (steps - mean) ** 2 @ chance - first**2


@settings(deadline=None)
@given(st.floats(50.0, 52.0), st.floats(LEAST_NOISE, 3.0))
def test_rounding_moments_are_those_of_the_exact_sum(mean, deviation):
    ours = sample_moments(np.zeros(1), _steps(deviation, mean), bin_time=BIN_TIME)
    exact = _summed(mean, deviation)
    tight = 5e-9 if deviation >= 0.25 else 3e-7
    assert ours[0][0] == pytest.approx(exact[0], abs=tight)
    assert ours[1][0] == pytest.approx(exact[1], abs=1e-6)


def test_noise_below_a_step_is_not_averaged_out():
    # 100.3 steps with a noise of 0.05: always 100.
    mean, variance = sample_moments(np.zeros(1), _steps(0.05, 100.3), bin_time=BIN_TIME)
    assert mean[0] == pytest.approx(100.0, abs=1e-4)
    assert variance[0] == pytest.approx(0.0, abs=1e-4)
    offsets = np.linspace(100.0, 101.0, 201)
    bias = [
        sample_moments(np.zeros(1), _steps(0.05, o), bin_time=BIN_TIME)[0][0] - o for o in offsets
    ]
    assert 0.3 < np.abs(bias).max() <= 0.5
    # Summed over any number of shots.
    random = np.random.default_rng(1)
    light = release(np.zeros(500), shots=5000, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, _steps(0.05, 100.3), random=random)
    # One sample in 30 000 reaches the next step, 4 deviations away.
    assert summed.mean() == pytest.approx(5000 * (100 + ndtr(-4.0)), abs=0.1)
    assert np.all(np.abs(summed - 500_000) < 4)
    # At a quarter of a step little is left, at a step nothing.
    for noise, left in ((0.25, 0.093), (0.5, 2.3e-3), (1.0, 1e-8)):
        quarter = sample_moments(np.zeros(1), _steps(noise, 100.25), bin_time=BIN_TIME)[0][0]
        assert abs(quarter - 100.25) == pytest.approx(left, rel=0.02, abs=2e-8)


@pytest.mark.parametrize("excess", [1.0, 1.3, 2.0])
@pytest.mark.parametrize(("rate", "noise"), [(0.5, 0.05), (4.0, 0.1), (30.0, 0.05), (3.0, 0.4)])
def test_the_charge_spread_of_few_photoelectrons_dithers(excess, rate, noise):
    # The exact mixture: Poisson numbers, gamma charges, Gaussian noise, steps.
    gain = 0.02  # 0.4 steps for a photoelectron in a bin
    recorder = _steps(noise, 20.3, gain=gain, excess_noise=excess)
    ours = sample_moments(np.array([rate]), recorder, bin_time=BIN_TIME)
    unit, events = gain / 0.05, rate * 0.05
    first = second = 0.0
    for number in range(int(poisson.isf(1e-13, events)) + 1):
        if excess > 1.0 and number:
            shape = number / (excess - 1)
            quantiles = (np.arange(4000) + 0.5) / 4000
            charges = gamma.ppf(quantiles, shape) * unit * (excess - 1)
        else:
            charges = np.array([number * unit])
        steps = np.arange(0.0, 120.0)[:, None]
        mean = 20.3 + charges
        chance = ndtr((steps + 0.5 - mean) / noise) - ndtr((steps - 0.5 - mean) / noise)
        weight = poisson.pmf(number, events)
        first += weight * (steps * chance).sum(axis=0).mean()
        second += weight * (steps**2 * chance).sum(axis=0).mean()
    assert ours[0][0] == pytest.approx(first, abs=1e-4)
    assert ours[1][0] == pytest.approx(second - first**2, rel=2e-3)


def _shot_by_shot(rate, recorder, shots, bins, seed):
    """Draw every sample of every shot: gamma-distributed charges, rounded and clipped."""
    random = np.random.default_rng(seed)
    number = random.poisson(rate * 1e6 * BIN_TIME, (shots, bins))
    spread = recorder.excess_noise - 1.0
    charge = random.gamma(number / spread, spread)
    voltage = recorder.gain * charge / (BIN_TIME * 1e6)
    voltage += recorder.dark_offset + recorder.noise * random.standard_normal((shots, bins))
    top = 2**recorder.adc_bits - 1
    return np.clip(np.rint(voltage / recorder.step), 0, top).sum(axis=0), number.sum(axis=0)


RECORDER = AnalogRecorder(gain=0.05, noise=0.3, dark_offset=3.0, adc_range=100, excess_noise=1.3)
QUIET = AnalogRecorder(gain=0.05, noise=0.004, dark_offset=3.007, adc_range=100, excess_noise=1.3)


@pytest.mark.parametrize("recorder", [RECORDER, QUIET], ids=["noisy", "quiet"])
@pytest.mark.parametrize("rate", [0.0, 0.4, 3.0, 40.0])
def test_the_digitiser_agrees_with_single_shots(rate, recorder):
    shots, bins = 400, 4000
    oracle, number = _shot_by_shot(rate, recorder, shots, bins, seed=21)
    random = np.random.default_rng(22)
    light = release(np.full(bins * 10, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    error = oracle.std() / np.sqrt(bins)
    assert summed.mean() == pytest.approx(oracle.mean(), abs=4.5 * error + 1e-9)
    assert summed.var() == pytest.approx(oracle.var(), rel=4.5 * np.sqrt(2.2 / bins))
    undrawn = replace(light, number=None)
    fast = digitise(undrawn, recorder, random=np.random.default_rng(23))
    assert fast.mean() == pytest.approx(oracle.mean(), abs=4.5 * error + 1e-9)
    assert fast.var() == pytest.approx(oracle.var(), rel=4.5 * np.sqrt(2.2 / bins))
    if rate > 0:
        expected = np.cov(oracle, number)[0, 1]
        ours = np.cov(summed, light.number)[0, 1]
        noise = np.sqrt(oracle.var() * number.var() / bins)
        assert ours == pytest.approx(expected, abs=5 * noise)
        assert ours > 10 * noise


@pytest.mark.parametrize("above", [-2.0, 0.0, 1.0, 20.0])
@pytest.mark.parametrize("end", ["top", "bottom"])
def test_near_the_ends_of_the_scale_some_shots_are_clipped(above, end):
    offset = 100 + above * 0.5 if end == "top" else max(-above * 0.5, 0.0)
    recorder = _recorder(offset, gain=1e-4, noise=0.5, adc_range=100)
    shots, bins = 300, 3000
    oracle, _ = _shot_by_shot(0.0, recorder, shots, bins, seed=41)
    random = np.random.default_rng(42)
    light = release(np.zeros(bins * 10), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    assert summed.min() >= 0
    assert summed.max() <= shots * 4095
    allowed = 4.5 * oracle.std() / np.sqrt(bins) + 15
    assert summed.mean() == pytest.approx(oracle.mean(), abs=allowed)
    if end == "top" and above > 10:
        assert np.all(summed == shots * 4095)
    else:
        assert summed.std() == pytest.approx(oracle.std(), rel=0.08)


def test_a_bright_cloud_is_partly_clipped_by_its_photoelectrons():
    recorder = AnalogRecorder(gain=0.5, noise=0.2, dark_offset=3.0, adc_range=100, excess_noise=1.3)
    shots, bins = 300, 3000
    rate = 190.0  # of 194 MHz at full scale: shot noise clips about half of the shots
    oracle, _ = _shot_by_shot(rate, recorder, shots, bins, seed=51)
    random = np.random.default_rng(52)
    light = release(np.full(bins * 4, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    assert summed.mean() == pytest.approx(oracle.mean(), rel=3e-3)
    assert summed.std() == pytest.approx(oracle.std(), rel=0.06)
    unclipped = shots * (rate * 0.5 + 3.0) / recorder.step
    assert summed.mean() < 0.93 * unclipped
    assert summed.max() < shots * 4095


def test_rare_photoelectrons_do_not_reach_below_the_offset():
    # One in 40 samples, each of 80 steps on an offset of 8: no sample is clipped at zero.
    recorder = _steps(0.8, 8.2, gain=4.0, excess_noise=1.2)
    shots, bins, rate = 400, 3000, 0.5
    oracle, _ = _shot_by_shot(rate, recorder, shots, bins, seed=55)
    random = np.random.default_rng(56)
    light = release(np.full(bins * 10, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    error = oracle.std() / np.sqrt(bins)
    assert summed.mean() == pytest.approx(oracle.mean(), abs=4.5 * error)
    assert summed.mean() / shots == pytest.approx(8.2 + 80 * 0.025, abs=4.5 * error / shots)
    # With an offset within the noise, the dark samples are clipped and the others are not.
    clipped = _steps(0.8, 0.4, gain=4.0, excess_noise=1.2)
    oracle, _ = _shot_by_shot(rate, clipped, shots, bins, seed=57)
    summed = digitise(light, clipped, random=random)
    assert summed.mean() == pytest.approx(oracle.mean(), abs=4.5 * error + 0.02 * shots)
    assert summed.std() == pytest.approx(oracle.std(), rel=0.06)
    assert summed.mean() / shots > 0.4 + 80 * 0.025 + 0.1


def test_a_signal_below_a_step_is_still_in_the_mean():
    # Above a cloud of 10 /km from 3 km on: 1e-3 steps, under noise of one step.
    recorder = _steps(1.0, 10.3, gain=1e-3)
    random = np.random.default_rng(61)
    light = release(np.full(200_000, 1.0), shots=2000, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, recorder, random=random)
    error = summed.std() / np.sqrt(summed.size) / 2000
    assert error < 1e-4
    assert summed.mean() / 2000 == pytest.approx(10.3 + 1e-3, abs=4.5 * error)


def test_without_shots_nothing_is_measured():
    random = np.random.default_rng(0)
    light = release(np.full(20, 5.0), shots=0, bin_width=BIN_WIDTH, random=random)
    summed = digitise(light, RECORDER, random=random)
    fast = digitise(replace(light, number=None), RECORDER, random=random)
    assert not summed.any()
    assert not fast.any()


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"gain": 0.0}, "gain"),
        ({"noise": -1.0}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"dark_offset": -1.0}, "dark_offset"),
        ({"excess_noise": 0.9}, "excess_noise"),
        ({"adc_range": 0.0}, "adc_range"),
        ({"noise": 0.5 * LEAST_NOISE * 500.0 / 4096.0}, "digitiser steps"),
        ({"adc_bits": 40}, "adc_bits"),
    ],
)
def test_impossible_digitisers_are_refused(change, name):
    with pytest.raises(ValidationError, match=name):
        AnalogRecorder(**({"gain": 1.0, "noise": 0.5, "dark_offset": 3.0} | change))
