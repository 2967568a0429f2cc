"""Both outputs of one detector together: shared photoelectrons, lags, laser, extreme cases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from lidarops.campaign.simulated_instrument import AnalogRecorder, LaserDrift
from lidarops.simulate.analog import digitise
from lidarops.simulate.counting import count_photons, delay_recorder, release
from lidarops.simulate.signal import SimulationInputError, backscatter_signal, bin_centres

BIN_WIDTH = 7.5
DEAD_TIME = 4e-9
RECORDER = AnalogRecorder(gain=0.05, noise=0.3, dark_offset=3.0, adc_range=100, excess_noise=1.3)


def test_both_outputs_see_the_same_photoelectrons():
    shots, bins, rate = 600, 50_000, 10.0
    random = np.random.default_rng(51)
    light = release(np.full(bins, rate), shots=shots, bin_width=BIN_WIDTH, random=random)
    analog = digitise(light, RECORDER, random=random)
    photon = count_photons(light, dead_time=DEAD_TIME, random=random)
    load = rate * 1e6 * DEAD_TIME
    steps = RECORDER.gain / RECORDER.step / light.exposure * shots
    variance = steps**2 * RECORDER.excess_noise * rate * light.exposure
    variance += shots * ((RECORDER.noise / RECORDER.step) ** 2 + 1 / 12)
    shared = steps * rate * light.exposure / (1 + load) ** 2
    expected = shared / np.sqrt(variance * rate * light.exposure / (1 + load) ** 3)
    assert np.corrcoef(analog, photon)[0, 1] == pytest.approx(expected, abs=0.015)
    assert expected > 0.5


def _profile(bins, offset=0.0):
    distance = bin_centres(bins, BIN_WIDTH, offset)
    signal = backscatter_signal(
        distance,
        extinction=np.full(bins, 1e-4),
        backscatter=np.full(bins, 2e-6),
        system_constant=5e12,
        full_overlap_range=400.0,
    )
    return signal + 2.0


def _lag(first, second, bins, reach=14):
    """Return the lag of the noise of `second` behind that of `first`: the correlation peak."""
    noise = [x - x.mean(axis=0) for x in (first, second)]
    noise = [x / x.std(axis=0) for x in noise]
    inside = slice(reach, bins - reach)
    lags = np.arange(-reach, reach + 1)
    score = np.array([
        (noise[0][:, inside] * noise[1][:, reach + k : bins - reach + k]).mean() for k in lags
    ])  # fmt: skip
    peak = int(np.argmax(score))
    around = slice(peak - 1, peak + 2)
    # The photoelectrons of a bin spread over two, so the centroid of the peak is the lag.
    weight = np.where(score[around] > 0.25 * score[peak], score[around], 0.0)
    others = np.delete(score, np.arange(peak - 2, peak + 3))
    assert score[peak] > 5 * np.abs(others).max()
    return lags[around] @ weight / weight.sum()


@pytest.mark.parametrize("lag", [0.0, 3.0, -2.0, 2.4, 8.6, 9.9])
def test_the_lag_of_two_recorders_is_in_their_noise(lag):
    # The axis begins 12 bins before the pulse leaves; the analog bins come `lag` bins late.
    bins, shots, files, lead = 900, 600, 80, 12
    axis = _profile(bins + 2 * lead, offset=-lead * BIN_WIDTH)
    random = np.random.default_rng(61)
    photon, analog = [], []
    for _ in range(files):
        light = release(axis, shots=shots, bin_width=BIN_WIDTH, random=random)
        early = delay_recorder(light, lead, bins, random=random)
        late = delay_recorder(light, lead - lag, bins, random=random)
        photon.append(count_photons(early, dead_time=DEAD_TIME, random=random))
        analog.append(digitise(late, RECORDER, random=random))
    estimate = _lag(np.array(photon, float), np.array(analog, float), bins)
    assert estimate == pytest.approx(lag, abs=0.2)


@settings(deadline=None, max_examples=40)
@given(st.floats(0, 10), st.integers(0, 2**32))
def test_a_cut_bin_loses_no_photoelectrons(first, seed):
    random = np.random.default_rng(seed)
    light = release(_profile(60), shots=50, bin_width=BIN_WIDTH, random=random)
    delayed = delay_recorder(light, first, 40, random=random)
    assert delayed.number.shape == delayed.rate.shape == (40,)
    assert np.all(delayed.number >= 0)
    whole = int(np.floor(first + 1e-9))
    outer = light.number[whole : whole + 41].sum()
    inner = light.number[whole + 1 : whole + 40].sum()
    assert inner <= delayed.number.sum() <= outer
    np.testing.assert_allclose(
        delayed.rate,
        np.interp(first + np.arange(40), np.arange(60), light.rate),
        rtol=0.12,
        atol=1.0,
    )


def test_a_shifted_recorder_records_the_light_of_its_own_bins():
    # Poisson numbers in bins cut anew have the mean of the bins themselves.
    bins, first = 300, 20.35
    random = np.random.default_rng(71)
    total = np.zeros(bins)
    axis, own = _profile(400), _profile(400, offset=0.35 * BIN_WIDTH)[20 : 20 + bins]
    for _ in range(400):
        light = release(axis, shots=600, bin_width=BIN_WIDTH, random=random)
        delayed = delay_recorder(light, first, bins, random=random)
        total += delayed.number
    expected = own * 400 * 600 * 0.05
    error = (total - expected) / np.sqrt(expected)
    # The straight line within a bin leaves 3e-4 of the signal where it bends most.
    bend = 3e-4 * np.sqrt(expected)
    assert np.all(np.abs(error) < 4.5 + bend)
    assert error.std() < 1.4
    np.testing.assert_allclose(delayed.rate, own, rtol=1e-3)


def test_recorders_off_the_axis_are_refused():
    random = np.random.default_rng(0)
    light = release(np.ones(50), shots=5, bin_width=BIN_WIDTH, random=random)
    for first, bins in ((-0.5, 10), (41, 10), (40.5, 10), (0, 0), (np.nextafter(40, 50), 11)):
        with pytest.raises(SimulationInputError, match="first"):
            delay_recorder(light, first, bins, random=random)
    assert delay_recorder(light, 40, 10, random=random).number.size == 10


def test_a_lag_of_whole_bins_draws_no_random_number():
    random, other = np.random.default_rng(5), np.random.default_rng(5)
    light = release(_profile(60), shots=50, bin_width=BIN_WIDTH, random=random)
    release(_profile(60), shots=50, bin_width=BIN_WIDTH, random=other)
    np.testing.assert_array_equal(
        delay_recorder(light, 7.0, 40, random=random).number, light.number[7:47]
    )
    assert random.random() == other.random()


def _file(seed):
    random = np.random.default_rng(seed)
    light = release(_profile(400), shots=600, bin_width=BIN_WIDTH, random=random)
    first, second = (delay_recorder(light, start, 350, random=random) for start in (12.0, 3.4))
    counts = count_photons(first, dead_time=DEAD_TIME, random=random)
    return counts.tobytes() + digitise(second, RECORDER, random=random).tobytes()


def test_the_same_seed_gives_the_same_bytes_on_any_thread():
    alone = [_file(seed) for seed in range(24)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(_file, range(24))) == alone
        assert list(pool.map(_file, reversed(range(24)))) == alone[::-1]
    assert len(set(alone)) == 24


def test_the_energy_of_a_laser_drifts_and_jitters():
    random = np.random.default_rng(81)
    drift = LaserDrift(per_hour=-0.1)
    assert drift.energy(2.0, 600, random) == pytest.approx(0.8)
    assert drift.energy(20.0, 600, random) == 0.0
    shots = LaserDrift(shot_jitter=0.1)
    energies = [shots.energy(0.0, 100, random) for _ in range(4000)]
    assert np.mean(energies) == pytest.approx(1.0, abs=4.5 * 0.01 / 4000**0.5)
    assert np.std(energies) == pytest.approx(0.01, rel=0.06)
    both = LaserDrift(shot_jitter=0.1, jitter=0.03)
    energies = [both.energy(0.0, 100, random) for _ in range(4000)]
    assert np.std(energies) == pytest.approx(np.hypot(0.01, 0.03), rel=0.06)
    for change in ({"per_hour": np.nan}, {"jitter": -0.1}, {"shot_jitter": 3.0}):
        with pytest.raises(ValidationError, match=next(iter(change))):
            LaserDrift(**change)


def test_jitter_of_shots_is_one_factor_for_a_file():
    # Shot by shot against the factor: variance and covariance of two bins.
    random = np.random.default_rng(91)
    shots, files, mean, jitter = 50, 4000, np.array([40.0, 15.0]), 0.2
    energy = 1 + jitter * random.standard_normal((files, shots, 1))
    single = random.poisson(np.maximum(energy, 0) * mean).sum(axis=1)
    drift = LaserDrift(shot_jitter=jitter)
    rate = [drift.energy(0.0, shots, random) * mean / 0.05 for _ in range(files)]
    ours = np.array([
        release(r, shots=shots, bin_width=BIN_WIDTH, random=random).number for r in rate
    ])  # fmt: skip
    expected, covariance = np.cov(single.T), np.cov(ours.T)
    np.testing.assert_allclose(covariance, expected, rtol=0.13)
    assert covariance[0, 1] > 0.3 * covariance[1, 1]


def test_a_thick_cloud_hides_what_is_above():
    # 10 /km from 3 km on.
    bins, shots = 1000, 600
    distance = bin_centres(bins, BIN_WIDTH)
    extinction = np.where((distance > 3000) & (distance < 3500), 1e-2, 5e-5)
    signal = backscatter_signal(
        distance,
        extinction=extinction,
        backscatter=np.where(extinction > 1e-3, 5e-4, 1e-6),
        system_constant=5e12,
        full_overlap_range=400.0,
    )
    random = np.random.default_rng(101)
    light = release(signal, shots=shots, bin_width=BIN_WIDTH, random=random)
    photon = count_photons(light, dead_time=DEAD_TIME, random=random)
    analog = digitise(light, RECORDER, random=random)
    above = distance > 3550
    assert signal[above].max() * RECORDER.gain < 1e-3 * RECORDER.step
    assert signal[distance < 3000][-1] > 0.3
    assert photon[above].sum() < 10
    offset = RECORDER.dark_offset / RECORDER.step * shots
    spread = np.sqrt(shots * ((RECORDER.noise / RECORDER.step) ** 2 + 1 / 12))
    rest = analog[above] - offset
    assert rest.mean() == pytest.approx(0.0, abs=4.5 * spread / np.sqrt(above.sum()))
    assert rest.std() == pytest.approx(spread, rel=0.15)
