"""Dark profiles: their mean, their error against simulations, and those of a real station."""

from __future__ import annotations

from datetime import timedelta
from types import SimpleNamespace

import numpy as np
import pytest
from support.physical import read_physical

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.signal.dark import DarkSignals

HOUR = 3600.0


def moments(seconds):
    return np.datetime64("2024-10-02T00:00:00", "ns") + (np.array(seconds) * 1e9).astype("m8[ns]")


def dark_profile(dark_signals, dark_times, times, method="nearest"):
    signals = DarkSignals(dark_signals, moments(dark_times), method=method)
    dark, variance = signals.at(moments(times))
    return SimpleNamespace(dark=dark, variance=variance)


def sessions(rng, *, first=5, second=4, bins=400, noise=0.1, level=0.0):
    """Return two sessions of dark files of 1 mV and 3 mV, an hour apart, and their times."""
    times = np.concatenate([60.0 * np.arange(first), HOUR + 60.0 * np.arange(second)])
    truth = np.where(times < HOUR / 2, 1.0, 3.0)
    signals = truth[:, np.newaxis] + rng.normal(0.0, noise, (times.size, bins))
    return signals + rng.normal(0.0, level, (times.size, 1)), times


def test_nearest_is_the_mean_of_the_session_nearest_in_time():
    signals, times = sessions(np.random.default_rng(1))
    result = dark_profile(signals, times, [-50.0, 1000.0, 3000.0])
    expected = [signals[:5].mean(axis=0)] * 2 + [signals[5:].mean(axis=0)]
    np.testing.assert_allclose(result.dark, expected, rtol=1e-14)


def test_interpolated_lies_between_the_sessions_and_is_nearest_outside():
    signals, times = sessions(np.random.default_rng(2))
    first, second = 120.0, HOUR + 90.0
    requested = np.array([0.0, first, first + 0.25 * (second - first), second, 9e3])
    result = dark_profile(signals, times, requested, method="interpolated")
    before, after = signals[:5].mean(axis=0), signals[5:].mean(axis=0)
    expected = [before, before, 0.75 * before + 0.25 * after, after, after]
    np.testing.assert_allclose(result.dark, expected, rtol=1e-13)


@pytest.mark.parametrize("method", ["nearest", "interpolated"])
def test_variance_is_that_of_the_mean(method):
    """Over many realisations the scatter of the dark signal matches the stated variance."""
    rng = np.random.default_rng(3)
    darks, variances = [], []
    for _ in range(60):
        signals, times = sessions(rng, level=0.5)
        signals -= signals.mean(axis=1, keepdims=True)
        result = dark_profile(signals, times, [1500.0], method=method)
        darks.append(result.dark[0])
        variances.append(result.variance[0])
    ratio = np.mean(np.var(darks, axis=0, ddof=1)) / np.mean(variances)
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_a_drifting_level_is_separated_from_noise():
    rng = np.random.default_rng(4)
    noise = []
    for _ in range(200):
        times = 60.0 * np.arange(6)
        signals = rng.normal(0.0, 0.1, (6, 300)) + rng.normal(0.0, 2.0, (6, 1))
        result = dark_profile(signals, times, [0.0])
        noise.append(result.variance.mean())
    assert np.mean(noise) == pytest.approx(0.1**2 / 6, rel=0.02)


def test_the_noise_of_a_single_file_is_that_of_its_far_bins():
    rng = np.random.default_rng(5)
    signal = rng.normal(0.0, 0.3, (1, 4000)) + 1.0
    signal[0, :200] += 50.0 * np.exp(-np.arange(200) / 40.0)
    result = dark_profile(signal, [0.0], [10.0, 20.0])
    np.testing.assert_array_equal(result.dark, signal[[0, 0]])
    assert result.variance[0, 100] == pytest.approx(0.3**2, rel=0.1)


def test_a_single_file_has_the_scatter_of_other_sessions():
    rng = np.random.default_rng(6)
    signals, times = sessions(rng, first=20, second=1, bins=2000, noise=0.2)
    signals[:, 0] = signals[:, 1000]
    result = dark_profile(signals, times, [HOUR])
    assert result.variance[0].mean() == pytest.approx(0.2**2, rel=0.05)


def test_gaps_are_skipped_and_not_filled():
    signals, times = sessions(np.random.default_rng(8))
    signals[0, 10] = np.nan
    signals[:5, 20] = np.inf
    result = dark_profile(signals, times, [0.0, HOUR])
    assert result.dark[0, 10] == pytest.approx(signals[1:5, 10].mean())
    assert np.isnan(result.dark[0, 20])
    assert np.isnan(result.variance[0, 20])
    assert np.isfinite(result.dark[1, 20])
    empty = dark_profile(np.full((3, 50), np.nan), [0.0, 1.0, 2.0], [0.0])
    assert np.isnan(empty.dark).all()
    assert np.isnan(empty.variance).all()


def test_order_and_cutting_change_nothing():
    rng = np.random.default_rng(9)
    signals, times = sessions(rng)
    requested = np.linspace(-100.0, 5000.0, 13)
    order = rng.permutation(times.size)
    whole = dark_profile(signals[order], times[order], requested, method="interpolated")
    alone = dark_profile(signals, times, requested[4:6], method="interpolated")
    np.testing.assert_allclose(whole.dark[4:6], alone.dark, rtol=1e-14)
    cut = dark_profile(signals[order], times[order], requested[4:6], method="interpolated")
    np.testing.assert_array_equal(whole.dark[4:6], cut.dark)
    np.testing.assert_array_equal(whole.variance[4:6], cut.variance)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"dark_signals": np.ones((0, 5)), "dark_times": []}, "dark_signals"),
        ({"dark_times": [0.0]}, "dark_signals"),
        ({"dark_times": [0.0, np.nan]}, "dark_times"),
        ({"times": [np.nan]}, "times"),
        ({"method": "latest"}, "method"),
    ],
)
def test_impossible_arguments_are_refused(change, field):
    arguments = {"dark_signals": np.ones((2, 5)), "dark_times": [0.0, 1.0], "times": [0.0]}
    with pytest.raises(RetrievalInputError) as error:
        dark_profile(**(arguments | change))
    assert error.value.field == field


def _channel(folder, name):
    headers, values = read_physical(sorted(folder.iterdir()), [name], dtype=np.float64)
    middles = [(h.start + timedelta(seconds=30)).timestamp() for h in headers]
    return values[name], np.array(middles)


@pytest.mark.parametrize("wavelength", ["1064", "532", "355"])
def test_the_far_range_of_a_real_station_holds_only_sky(data_root, wavelength):
    """Sao Paulo: without the dark signal, the offset is the sky seen by photon counting."""
    folder = data_root / "saopaulo" / "20170928"
    signals, times = _channel(folder / "signals", f"analog_{wavelength}o")
    rates, _ = _channel(folder / "signals", f"photon_{wavelength}o")
    result = dark_profile(*_channel(folder / "dark", f"analog_{wavelength}o"), times)
    far, near = slice(3000, 4000), slice(400, 420)
    clean = (signals - result.dark).mean(axis=0)
    rate = rates.mean(axis=0)
    gain = (clean[near].mean() - clean[far].mean()) / (rate[near].mean() - rate[far].mean())
    residual = clean[far].mean() - gain * rate[far].mean()
    assert signals[:, far].mean() > 2.0
    # The level of a dark file scatters by less than 0.1 mV.
    assert abs(residual) < 0.25
