"""Lag estimates from shared photoelectrons, independent noise and a real station; shifts."""

from __future__ import annotations

import numpy as np
import pytest
from support.lags import lag_of
from support.physical import read_physical

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.signal import lag
from lidarops.simulate.counting import delay_recorder, release

BINS = 1500


def recorded(rng, true_lag, *, profiles=12, gain_noise=0.5, electronics=2.0):
    """Return analog and photon counting that share photoelectrons, analog late by `true_lag`."""
    distance = 7.5 * (np.arange(BINS + 40) + 60.0)
    rate = 4.0 + 3e7 * np.exp(-distance / 4000.0) / distance**2
    analog, photon = np.empty((2, profiles, BINS))
    for k in range(profiles):
        electrons = release(rate * rng.uniform(0.95, 1.05), shots=400, bin_width=7.5, random=rng)
        early, late = (max(-true_lag, 0.0), max(true_lag, 0.0))
        electrons_of_analog = delay_recorder(electrons, early, BINS, random=rng).number
        photon[k] = delay_recorder(electrons, late, BINS, random=rng).number
        spread = np.sqrt(gain_noise**2 * electrons_of_analog + electronics**2)
        analog[k] = 0.01 * (electrons_of_analog + spread * rng.normal(size=BINS)) + 3.0
    return analog, photon


@pytest.mark.parametrize("true_lag", [0.0, 3.0, 8.6, -5.25, 9.5, 29.0])
def test_a_known_lag_is_estimated(true_lag):
    rng = np.random.default_rng(1)
    estimate = lag_of(*recorded(rng, true_lag))
    assert estimate.significant
    assert estimate.confidence > 0.9999
    assert abs(estimate.bins - true_lag) < 3.0 * estimate.standard_error
    assert estimate.standard_error < 0.1


def test_the_standard_error_covers_the_scatter():
    rng = np.random.default_rng(2)
    deviations, errors = [], []
    for _ in range(60):
        estimate = lag_of(*recorded(rng, 8.3, profiles=3, electronics=10.0))
        deviations.append(estimate.bins - 8.3)
        errors.append(estimate.standard_error)
    deviations, errors = np.array(deviations), np.array(errors)
    assert abs(deviations.mean()) < 4.0 * deviations.std() / np.sqrt(60) + 0.01
    assert np.sqrt(np.mean((deviations / errors) ** 2)) < 1.1
    assert errors.mean() < 4.0 * deviations.std()


def test_one_profile_is_enough():
    rng = np.random.default_rng(3)
    estimate = lag_of(*recorded(rng, 6.4, profiles=1))
    assert estimate.significant
    assert abs(estimate.bins - 6.4) < 3.0 * estimate.standard_error


def test_noise_without_a_common_cause_has_no_lag():
    rng = np.random.default_rng(4)
    analog, photon = rng.normal(size=(2, 1500, 3, 500))
    estimates = [lag_of(*pair) for pair in zip(analog, photon, strict=True)]
    assert sum(estimate.significant for estimate in estimates) <= 6
    # The confidence is uniform without a common cause.
    confidence = np.array([estimate.confidence for estimate in estimates])
    assert confidence.mean() == pytest.approx(0.5, abs=0.05)
    assert (confidence > 0.9).mean() == pytest.approx(0.1, abs=0.035)


def test_profiles_of_different_times_have_no_lag():
    rng = np.random.default_rng(5)
    analog, photon = recorded(rng, 8.6)
    assert not lag_of(analog[1:], photon[:-1]).significant


def test_a_lag_beyond_the_largest_is_not_significant():
    rng = np.random.default_rng(6)
    assert not lag_of(*recorded(rng, 34.0)).significant


def test_a_lag_that_parts_of_the_range_contradict_is_not_significant():
    """Both of two lags are far above noise, and a part of the range decides which is higher."""
    rng = np.random.default_rng(9)
    for _ in range(8):
        light, *others = rng.normal(size=(3, 12, BINS))
        analog, photon = (light + other for other in others)
        analog = np.where(np.arange(BINS) < BINS // 2, analog, np.roll(analog, 8, axis=1))
        estimate = lag_of(analog, photon)
        assert estimate.confidence > 0.999
        assert not estimate.significant


def test_gaps_dead_channels_and_spikes_do_not_mislead():
    rng = np.random.default_rng(7)
    analog, photon = recorded(rng, 8.6)
    analog[rng.random(analog.shape) < 0.05] = np.nan
    photon[3] = np.nan
    analog[:, 700] = 1e6 * rng.normal(size=12)
    photon[:, 705] = 1e6 * rng.normal(size=12)
    estimate = lag_of(analog, photon)
    assert estimate.significant
    assert abs(estimate.bins - 8.6) < 3.0 * estimate.standard_error
    for dead in (np.full(photon.shape, np.nan), np.zeros(photon.shape)):
        without_signal = lag_of(analog, dead)
        assert np.isnan(without_signal.bins)
        assert np.isnan(without_signal.standard_error)
        assert without_signal.confidence == 0.0
        assert not without_signal.significant


def test_groups_one_after_another_give_the_bits_of_all_profiles():
    analog, photon = recorded(np.random.default_rng(8), 5.3, profiles=70)
    groups = lag.profile_groups(70)
    assert [group.stop - group.start for group in groups] == [23, 23, 24]
    whole = lag_of(analog, photon)
    parts = lag.estimate_lag((analog[rows], photon[rows]) for rows in groups)
    assert parts == whole
    assert abs(whole.bins - 5.3) < 3.0 * whole.standard_error


def test_a_real_station(data_root):
    """Sao Paulo 532 nm: headers say 0."""
    files = sorted((data_root / "saopaulo" / "20170928" / "signals").iterdir())
    names = ["analog_532o", "photon_532o"]
    headers, values = read_physical(files, names, dtype=np.float64)
    assert {d.bin_shift for d in headers[0].channels if d.name in names} == {0.0}
    estimate = lag_of(*(values[name] for name in names))
    assert estimate.significant
    assert abs(estimate.bins - 8.6) < 0.2
    assert estimate.standard_error < 0.2
    for profiles in (slice(0, 8), slice(8, 16)):
        estimate_of_half = lag_of(*(values[name][profiles] for name in names))
        assert estimate_of_half.significant
        assert abs(estimate_of_half.bins - estimate.bins) < 0.05
    assert not lag_of(values[names[0]][1:], values[names[1]][:-1]).significant


# The shift ----------------------------------------------------------------------------------


def test_a_whole_shift_moves_bins():
    values = np.arange(10.0) ** 2
    variance = np.arange(10.0) + 1.0
    moved, noise = lag.shift_signal(values, 3, variance=variance)
    np.testing.assert_array_equal(moved[:7], values[3:])
    np.testing.assert_array_equal(noise[:7], variance[3:])
    assert np.isnan(moved[7:]).all()
    assert np.isnan(noise[7:]).all()
    back, _ = lag.shift_signal(values, -2.0)
    np.testing.assert_array_equal(back[2:], values[:-2])
    assert np.isnan(back[:2]).all()


def test_a_shift_by_a_fraction_of_a_bin_is_exact_on_a_line():
    index = np.arange(40.0)
    values = 0.5 - 0.02 * index
    for amount in (0.3, 8.6, -4.75):
        moved, _ = lag.shift_signal(values, amount)
        expected = 0.5 - 0.02 * (index + amount)
        inside = np.isfinite(moved)
        assert inside.sum() >= 40 - abs(amount) - 1
        np.testing.assert_allclose(moved[inside], expected[inside], rtol=1e-11)


def test_variance_follows_the_noise():
    rng = np.random.default_rng(9)
    sigma = np.linspace(1.0, 3.0, 30)
    values = sigma * rng.normal(size=(20000, 30))
    moved, noise = lag.shift_signal(values, 2.4, variance=sigma**2)
    inside = np.isfinite(moved[0])
    np.testing.assert_allclose(moved[:, inside].var(axis=0), noise[0, inside], rtol=0.06)


def test_gaps_stay_gaps_and_spread_only_where_they_are_used():
    values = np.arange(12.0)
    values[5] = np.nan
    whole, _ = lag.shift_signal(values, 2)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(whole)), [3, 10, 11])
    fractional, noise = lag.shift_signal(values, 2.5, variance=1.0)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(fractional)), [2, 3, 9, 10, 11])
    np.testing.assert_array_equal(np.isnan(noise), np.isnan(fractional))
    far, _ = lag.shift_signal(values, 1e9)
    assert np.isnan(far).all()


def test_the_estimated_lag_aligns_the_signals():
    """Shifted by its lag, the analog signal has no lag."""
    rng = np.random.default_rng(11)
    analog, photon = recorded(rng, 8.6)
    estimate = lag_of(analog, photon)
    moved, _ = lag.shift_signal(analog, estimate.bins)
    remaining = lag_of(moved, photon)
    assert remaining.significant
    assert abs(remaining.bins) < 3.0 * remaining.standard_error
    assert abs(remaining.bins) < 0.3


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"analog": np.ones((2, 200)), "photon": np.ones((2, 200))}, "analog"),
    ],
)
def test_impossible_arguments_are_refused(change, field):
    arguments = {"analog": np.ones((2, 500)), "photon": np.ones((2, 500))} | change
    with pytest.raises(RetrievalInputError) as error:
        lag_of(**arguments)
    assert error.value.field == field


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"profile": 1.0}, "profile"),
        ({"lag": np.nan}, "lag"),
        ({"variance": np.ones(3)}, "variance"),
    ],
)
def test_impossible_shifts_are_refused(change, field):
    arguments = {"profile": np.ones((2, 20)), "lag": 1.0} | change
    with pytest.raises(RetrievalInputError) as error:
        lag.shift_signal(arguments.pop("profile"), arguments.pop("lag"), **arguments)
    assert error.value.field == field
