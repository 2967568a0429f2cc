"""Photon counters against single events in time order."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.oracles.counter import registered

from lidarops.simulate.counting import (
    BRIGHTEST,
    count_photons,
    counter_moments,
    release,
)
from lidarops.simulate.signal import SimulationInputError

BIN_WIDTH = 7.5
BIN_TIME = 50e-9
DEAD_TIME = 4e-9


@cache
def _events(rate, paralyzable, dead_time=DEAD_TIME, windows=300_000):
    """Return photoelectrons and counts in consecutive windows of one bin."""
    random = np.random.default_rng(11)
    span = windows * BIN_TIME
    arrivals = np.sort(random.random(random.poisson(rate * 1e6 * span)) * span)
    edges = np.arange(windows + 1) * BIN_TIME
    counted = registered(arrivals, dead_time, paralyzable)
    return np.histogram(arrivals, edges)[0], np.histogram(counted, edges)[0]


def _counted(rate, paralyzable, shots=500, bins=60_000, dead_time=DEAD_TIME, seed=12):
    random = np.random.default_rng(seed)
    light = release(np.full(bins, float(rate)), shots=shots, bin_width=BIN_WIDTH, random=random)
    counts = count_photons(light, dead_time=dead_time, random=random, paralyzable=paralyzable)
    return light.number, counts


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rate", [2, 20, 60, 100])
def test_counts_agree_with_single_events(rate, paralyzable):
    released, registered = _events(rate, paralyzable)
    number, counted = _counted(rate, paralyzable)
    # Per photoelectron, which removes the noise of their number.
    share = registered.mean() / released.mean()
    assert counted.mean() / number.mean() == pytest.approx(share, rel=0.005)
    ratio = counted.var() / 500 / registered.var()
    # Standard errors: sqrt(2 / 60 000) = 0.006 of ours, and of the events that of a Poisson.
    assert 0.97 < ratio < 1.03
    expected = np.cov(released, registered)[0, 1]
    assert np.cov(number, counted)[0, 1] / 500 == pytest.approx(expected, rel=0.03)
    # A dead time reaches into the next bin.
    next_bin = np.corrcoef(registered[:-1], registered[1:])[0, 1]
    assert np.corrcoef(counted[:-1], counted[1:])[0, 1] == pytest.approx(next_bin, abs=0.03)


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rate", [250, 600])
def test_the_mean_holds_far_into_saturation(rate, paralyzable):
    registered = _events(rate, paralyzable, windows=60_000)[1]
    counted = _counted(rate, paralyzable, bins=4000)[1]
    assert counted.mean() / 500 == pytest.approx(registered.mean(), rel=0.005)


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rate", [0.5, 20, 100, 250, 600])
def test_moments_of_renewal_theory_are_those_of_events(rate, paralyzable):
    registered = _events(rate, paralyzable, windows=300_000 if rate < 200 else 60_000)[1]
    mean, variance = counter_moments(
        np.array([float(rate)]), bin_time=BIN_TIME, dead_time=DEAD_TIME, paralyzable=paralyzable
    )
    size = registered.size
    assert mean[0] == pytest.approx(
        registered.mean(), abs=4.5 * np.sqrt(registered.var() / size) + 1e-4 * mean[0]
    )
    kurtosis = 2 + 1 / registered.mean()
    assert variance[0] == pytest.approx(registered.var(), rel=4.5 * np.sqrt(kurtosis / size))


def test_a_paralyzable_counter_folds_back():
    low, high = 60.0, 600.0
    fewer = _counted(900.0, paralyzable=True, bins=2000)[1].mean()
    most = _counted(250.0, paralyzable=True, bins=2000)[1].mean()
    assert fewer < 0.35 * most
    # Two rates on both sides of 1 / dead_time with the same counts: n exp(-n tau) is equal.
    for _ in range(60):
        middle = 0.5 * (low + high)
        lower = middle * np.exp(-middle * 4e-3) < 600 * np.exp(-2.4)
        low, high = (middle, high) if lower else (low, middle)
    assert low < 100
    folded = _counted(low, paralyzable=True, bins=4000, seed=1)[1].mean()
    assert _counted(600.0, paralyzable=True, bins=4000)[1].mean() == pytest.approx(folded, rel=4e-3)
    assert _counted(600.0, paralyzable=False, bins=2000)[1].mean() > 2 * folded


def test_two_photoelectrons_coincide_with_the_exact_probability():
    # One shot, no photoelectrons in the bin before: the chance that two at random places of a
    # bin are closer than the dead time.
    bins, dead_time = 600_000, 2e-9
    random = np.random.default_rng(6)
    light = release(np.full(bins, 30.0), shots=1, bin_width=BIN_WIDTH, random=random)
    pairs = (light.number == 2) & (np.roll(light.number, 1) == 0)
    lost = 2 - count_photons(light, dead_time=dead_time, random=random)[pairs].mean()
    share = dead_time / BIN_TIME
    assert lost == pytest.approx(2 * share - share**2, abs=4 * np.sqrt(2 * share / pairs.sum()))


@pytest.mark.parametrize("paralyzable", [False, True])
def test_a_bright_bin_blinds_the_start_of_the_next(paralyzable):
    rate = np.zeros(200_000)
    rate[::2] = 200.0
    rate[1::2] = 5.0
    random = np.random.default_rng(3)
    light = release(rate, shots=200, bin_width=BIN_WIDTH, random=random)
    counted = count_photons(light, dead_time=DEAD_TIME, random=random, paralyzable=paralyzable)
    ours = 1 - counted[1::2].sum() / light.number[1::2].sum()
    events = np.random.default_rng(4)
    sizes = events.poisson(rate * 0.05)
    starts = np.repeat(np.arange(rate.size) * BIN_TIME, sizes)
    arrivals = np.sort(starts + events.random(starts.size) * BIN_TIME)
    kept = registered(arrivals, DEAD_TIME, paralyzable)
    counted_in_dim = np.histogram(kept, np.arange(rate.size + 1) * BIN_TIME)[0][1::2]
    lost = 1 - counted_in_dim.sum() / sizes[1::2].sum()
    # On their own, the dim bins would lose 2 percent.
    assert ours == pytest.approx(lost, abs=4 * np.sqrt(lost / sizes[1::2].sum()))
    assert lost > 0.032


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rate", [0.02, 0.3, 2.0, 25.0, 200.0])
def test_fast_counts_have_the_moments_of_the_full_ones(rate, paralyzable):
    bins, shots = 100_000, 600
    light = release(np.full(bins, rate), shots=shots, bin_width=BIN_WIDTH, random=None)
    random = np.random.default_rng(8)
    fast = count_photons(light, dead_time=DEAD_TIME, paralyzable=paralyzable, random=random)
    full = _counted(rate, paralyzable, shots=shots, bins=bins)[1]
    error = full.std() * np.sqrt(2 / bins)
    # Negative draws of the faintest are cut at zero.
    cut = 0.15 if full.mean() < 1 else 0.0
    assert fast.mean() == pytest.approx(full.mean(), abs=4.5 * error + cut)
    assert fast.var() == pytest.approx(full.var(), rel=0.03 + 2 * cut)
    assert fast.min() >= 0


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.floats(0, 1e7), min_size=1, max_size=30),
    st.integers(0, 3000),
    st.floats(0, 2e-7),
    st.booleans(),
    st.integers(0, 2**32),
)
def test_counts_never_exceed_photoelectrons(rates, shots, dead_time, paralyzable, seed):
    random = np.random.default_rng(seed)
    light = release(np.array(rates), shots=shots, bin_width=BIN_WIDTH, random=random)
    assert light.rate.max() <= BRIGHTEST
    counted = count_photons(light, dead_time=dead_time, random=random, paralyzable=paralyzable)
    assert np.all((counted >= 0) & (counted <= light.number))
    if dead_time == 0:
        np.testing.assert_array_equal(counted, light.number)


def test_without_shots_nothing_is_measured():
    random = np.random.default_rng(0)
    light = release(np.full(100, 50.0), shots=0, bin_width=BIN_WIDTH, random=random)
    counted = count_photons(light, dead_time=DEAD_TIME, random=random)
    assert not counted.any()
    light = release(np.full(9, 3.0), shots=0, bin_width=BIN_WIDTH, random=None)
    assert not count_photons(light, dead_time=DEAD_TIME, random=random).any()


def test_impossible_light_is_refused():
    random = np.random.default_rng(0)
    for rate, shots, width, name in (
        ([-1.0], 5, 7.5, "rate"),
        ([np.nan], 5, 7.5, "rate"),
        ([1.0], -5, 7.5, "shots"),
        ([1.0], 5, 0.0, "bin_width"),
    ):
        with pytest.raises(SimulationInputError, match=name):
            release(np.array(rate), shots=shots, bin_width=width, random=random)
    light = release(np.ones(5), shots=5, bin_width=7.5, random=random)
    with pytest.raises(SimulationInputError, match="dead_time"):
        count_photons(light, dead_time=-1e-9, random=random)


def test_the_same_seed_gives_the_same_counts():
    both = [_counted(40.0, paralyzable=False, bins=500, seed=9)[1] for _ in range(2)]
    np.testing.assert_array_equal(*both)
