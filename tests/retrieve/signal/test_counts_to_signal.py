"""Counts to signals against hand calculation, Monte Carlo, plain numpy and exact sums."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.oracles import counter
from support.oracles import signal as oracle

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.signal import _noise_kernels as noise_kernels
from lidarops.retrieve.signal import _signal_kernels as kernels
from lidarops.retrieve.signal import counts_to_signal

RANGE = (np.arange(400) + 0.5) * 7.5
SHOTS = np.array([600])


def test_analog_voltage_of_known_counts() -> None:
    counts = np.full((1, 400), 123_456, np.int32)
    result = counts_to_signal.analog_signal(
        counts, SHOTS, RANGE, adc_bits=12, input_range=np.array([0.5])
    )
    assert result.power == pytest.approx(123_456 * 500.0 / (600 * 4096))
    assert not result.quality.any()


def test_full_scale_and_integer_extremes_are_masked() -> None:
    counts = np.full((1, 400), 1000, np.int32)
    counts[0, :4] = [600 * 4095, 600 * 4000, 2**31 - 1, -(2**31)]
    result = counts_to_signal.analog_signal(
        counts, SHOTS, RANGE, adc_bits=12, input_range=np.array([0.5]), noise_variance=1e-4
    )
    assert result.quality[0, 0] == Quality.SATURATED
    assert result.quality[0, 1] == 0
    assert result.quality[0, 2] & Quality.INPUT_MISSING
    assert result.quality[0, 3] & Quality.INPUT_MISSING
    assert np.isnan(result.power[0, [0, 2, 3]]).all()
    assert np.isfinite(result.power[0, [1, 4]]).all()


def test_a_mean_with_clipped_shots_is_masked() -> None:
    rng = np.random.default_rng(8)
    shots, top, spread = 400, 4095.0, 200.0
    level = np.full(1200, 2000.0)
    level[:400], level[400:800] = 3600.0, 3200.0
    counts = np.zeros((1, level.size), np.int32)
    for _ in range(shots):
        shot = level + rng.normal(0.0, spread, level.size)
        counts[0] += np.rint(np.clip(shot, 0.0, top)).astype(np.int32)
    result = counts_to_signal.analog_signal(
        counts,
        np.array([shots]),
        7.5 * np.arange(1.0, level.size + 1),
        adc_bits=12,
        input_range=np.array([0.5]),
    )
    # 2.5, 4.5 and 10 deviations of a shot below full scale.
    for bins, clipped in ((slice(420), True), (slice(420, 780), False), (slice(820, None), False)):
        saturated = (result.quality[0, bins] & Quality.SATURATED) != 0
        assert saturated.mean() > 0.9 if clipped else not saturated.any()
    step = 500.0 / 4096.0
    bias = np.nanmean(result.power[0, 420:780]) / step - 3200.0
    assert abs(bias) < 4.0 * spread / np.sqrt(shots * 360)


@pytest.mark.parametrize("shots", [20, 600])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 1.0])
def test_rounding_of_each_shot_is_covered_at_every_level(noise: float, shots: int) -> None:
    rng = np.random.default_rng(round(1e3 * noise) + shots)
    level = 100.0 + np.linspace(0.0, 1.0, 41)[:, np.newaxis]
    sums = np.zeros((41, 400))
    for _ in range(shots):
        sums += np.rint(level + noise * rng.standard_normal(sums.shape))
    result = counts_to_signal.analog_signal(
        sums.astype(np.int32), np.full(41, shots), RANGE, adc_bits=12, input_range=np.full(41, 0.5)
    )
    step = 500.0 / 4096.0
    error = np.sqrt(result.variance)
    assert np.abs((result.power - level * step) / error).max() < 5.0
    if noise >= 0.5:
        ideal = step * np.sqrt((noise**2 + 1.0 / 12.0) / shots)
        assert np.median(error) == pytest.approx(ideal, rel=0.1)
    if noise == 0.0:
        assert error == pytest.approx(step * np.sqrt((1.0 + 1.0 / shots) / 12.0))


def test_rounding_raises_the_stated_noise_but_not_that_of_the_dark_signal() -> None:
    settings = {"adc_bits": 12, "input_range": np.array([0.5])}
    step = 500.0 / 4096.0
    counts = np.full((1, 400), 60_200, np.int32)
    quiet = counts_to_signal.analog_signal(counts, SHOTS, RANGE, noise_variance=0.0, **settings)
    assert quiet.variance == pytest.approx(step**2 * (1.0 + 1.0 / 600.0) / 12.0)
    noisy = counts_to_signal.analog_signal(
        counts, SHOTS, RANGE, noise_variance=step**2 / 600.0, **settings
    )
    assert noisy.variance == pytest.approx(step**2 / 600.0)
    dark = {"dark": np.zeros(400), "dark_variance": np.full(400, 7.0)}
    with_dark = counts_to_signal.analog_signal(
        counts, SHOTS, RANGE, noise_variance=0.0, **dark, **settings
    )
    assert with_dark.variance == pytest.approx(quiet.variance + 7.0)


def test_no_shots_is_missing_input_not_infinity() -> None:
    counts = np.full((2, 400), 1000, np.int32)
    result = counts_to_signal.photon_signal(
        counts, np.array([0, 600]), RANGE, bin_width=7.5, dead_time=0.0
    )
    assert (result.quality[0] & Quality.INPUT_MISSING).all()
    assert np.isnan(result.power[0]).all()
    assert np.isfinite(result.power[1]).all()


@given(rate=st.floats(0.01, 100.0), dead_time=st.floats(1e-9, 4e-9))
def test_dead_time_is_corrected(rate: float, dead_time: float) -> None:
    assume(abs(rate * dead_time * 1e6 - 0.1) > 1e-6)
    # A non-paralysable counter records r / (1 + r tau); many shots make rounding negligible.
    shots = np.array([10_000_000])
    measured = rate / (1.0 + rate * dead_time * 1e6)
    counts = np.full((1, 400), round(measured * shots[0] * 0.05), np.int32)
    result = counts_to_signal.photon_signal(
        counts, shots, RANGE, bin_width=7.5, dead_time=dead_time
    )
    assert result.power == pytest.approx(rate, rel=2e-4)
    assert bool((result.quality & Quality.PILE_UP).any()) is (rate * dead_time * 1e6 > 0.1)


def test_photon_variance_matches_the_scatter_of_poisson_counts() -> None:
    rng = np.random.default_rng(3)
    truth = 0.2 + 40.0 * (750.0 / RANGE) ** 2
    truth[:80] = truth[80]
    counts = rng.poisson(truth * 30.0, (4000, 400)).astype(np.int32)
    result = counts_to_signal.photon_signal(
        counts, np.full(4000, 600), RANGE, bin_width=7.5, dead_time=0.0
    )
    ratio = result.power.var(axis=0) / result.variance.mean(axis=0)
    # 4000 draws: 2.2 % per bin; smoothing over 10 % of range biases the variance by 1-3 %.
    assert np.abs(ratio[120:] - 1.0).max() < 0.12
    assert ratio[120:].mean() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("dead_time", [4e-9, None])
@pytest.mark.parametrize("rate", [20.0, 60.0, 120.0])
def test_photon_noise_is_that_of_single_events(rate: float, dead_time: float | None) -> None:
    bins, shots = 3000, 10
    counts = counter.counts(
        rate * 1e6,
        bins=bins,
        bin_time=50e-9,
        shots=shots,
        dead_time=4e-9,
        random=np.random.default_rng(round(rate)),
    )
    result = counts_to_signal.photon_signal(
        counts.astype(np.int32)[np.newaxis],
        np.array([shots]),
        7.5 * np.arange(1, bins + 1),
        bin_width=7.5,
        dead_time=dead_time,
        dead_time_uncertainty=0.0,
    )
    power = result.power[0] if dead_time else counts / (shots * 0.05)
    stated = np.sqrt(result.variance.mean())
    # Neighbouring bins share dead time: their scatter exceeds that of long windows by up to 2 %.
    # The standard deviation of 3000 bins is known to 1.3 %, and the few shots make it skew.
    assert stated / power.std() == pytest.approx(0.985, abs=0.045)
    mean = rate if dead_time else rate / (1.0 + rate * 4e-3)
    assert power.mean() == pytest.approx(mean, rel=0.01)


def test_zero_counts_have_a_variance() -> None:
    counts = np.zeros((2, 400), np.int32)
    counts[0, 7] = 1
    result = counts_to_signal.photon_signal(counts, np.full(2, 600), RANGE, bin_width=7.5)
    assert (result.variance[0] > 0).all()
    assert not result.quality[0].any()
    # A profile without counts: the recorder was off.
    assert (result.quality[1] == Quality.INPUT_MISSING).all()
    assert np.isnan(result.power[1]).all()


def test_paralysed_counters_are_masked() -> None:
    counts = np.full((1, 400), 200 * 30, np.int32)  # 200 MHz
    result = counts_to_signal.photon_signal(counts, SHOTS, RANGE, bin_width=7.5, dead_time=4e-9)
    assert (result.quality & Quality.SATURATED).all()
    assert np.isnan(result.power).all()


def test_noise_of_an_analog_signal_is_estimated() -> None:
    rng = np.random.default_rng(5)
    far = (np.arange(2000) + 60.5) * 7.5
    light = 0.5 + 300.0 * (450.0 / far) ** 2
    truth = 0.02 + 0.01 * light
    profiles = light + rng.normal(0, 1, (400, 2000)) * np.sqrt(truth)
    variance = counts_to_signal.difference_variance(profiles, far)
    # The smoothing window of the first bins has no near half.
    assert (variance.mean(axis=0) / truth)[40:] == pytest.approx(1.0, abs=0.08)
    assert (variance.std(axis=0) / truth)[40:].max() < 0.15


def test_constant_noise_does_not_follow_the_light() -> None:
    rng = np.random.default_rng(6)
    far = (np.arange(2000) + 60.5) * 7.5
    profiles = 300.0 * (450.0 / far) ** 2 + rng.normal(0, 0.3, (400, 2000))
    variance = counts_to_signal.difference_variance(profiles, far)
    assert np.median(variance, axis=0) / 0.09 == pytest.approx(1.0, abs=0.05)


def test_a_signal_without_noise_has_a_finite_variance() -> None:
    variance = counts_to_signal.difference_variance(np.zeros((2, 400)), RANGE)
    assert (variance == 0).all()
    gappy = np.full((1, 400), np.nan)
    gappy[0, :3] = 1.0
    assert np.isnan(counts_to_signal.difference_variance(gappy, RANGE)).all()


@pytest.mark.parametrize("section", [(750, 4500), (1500, 7500)])
def test_estimated_noise_serves_a_retrieval_as_well_as_known_noise(
    section: tuple[int, int],
) -> None:
    rng = np.random.default_rng(5)
    distance = (np.arange(2000) + 0.5) * 7.5
    shape = np.exp(-2 * 2e-4 * distance) * (1500.0 / distance) ** 2
    profiles = 0.1 + 0.15 * shape + rng.normal(0, 0.007, (2000, 2000))
    inside = (distance >= section[0]) & (distance < section[1])
    variance = counts_to_signal.difference_variance(profiles, distance)[:, inside]
    result = path_fit.fit_homogeneous_path(
        profiles[:, inside], distance[inside], variance=variance, noise=path_fit.Noise(True)
    )
    accepted = result.quality == 0
    score = (result.extinction - 2e-4) / result.extinction_standard_error
    assert accepted.mean() > 0.995
    # 2000 draws: the spread is known to 1.6 percent.
    assert score[accepted].std() == pytest.approx(1.0, abs=0.05)
    assert abs(score[accepted].mean()) < 0.1


def _analog(counts, shots, range=RANGE, **settings):  # noqa: A002
    volts = np.full(np.shape(shots), 0.5)
    return counts_to_signal.analog_signal(
        counts, shots, range, adc_bits=12, input_range=volts, **settings
    )


def _photon(counts, shots, range=RANGE, **settings):  # noqa: A002
    return counts_to_signal.photon_signal(counts, shots, range, bin_width=7.5, **settings)


def _assert_same_bits(result, other) -> None:
    np.testing.assert_array_equal(result.power, other.power)
    np.testing.assert_array_equal(result.variance, other.variance)
    np.testing.assert_array_equal(result.quality, other.quality)


def _damaged(counts, rng):
    """Make bins, stretches of bins and whole profiles missing."""
    counts = np.asarray(counts, np.int32)
    counts[0, rng.integers(0, counts.shape[1], 9)] = 2**31 - 1
    counts[1, 7:60] = -(2**31)
    counts[2] = 0
    counts[3] = 2**31 - 1
    counts[4, rng.random(counts.shape[1]) < 0.6] = -(2**31) + 1
    return counts


def _light(range):  # noqa: A002
    return (1000.0 / (range + 50.0)) ** 2 * np.exp(-2e-4 * range)


@given(
    seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 7), dead_time=st.sampled_from([None, 3e-9])
)
def test_a_profile_depends_neither_on_others_nor_on_order(seed, cut, dead_time) -> None:
    rng = np.random.default_rng(seed)
    counts = _damaged(rng.poisson(600 * 0.05 * (1 + 20 * _light(RANGE)), (7, 400)), rng)
    shots = rng.integers(0, 4, 7) * 300
    order = rng.permutation(7)
    for convert in (_analog, lambda *all: _photon(*all, dead_time=dead_time)):
        whole = convert(counts, shots, RANGE)
        for rows in (slice(0, cut), slice(cut, 7), order):
            part = convert(counts[rows], shots[rows], RANGE)
            _assert_same_bits(
                part,
                counts_to_signal.Signal(
                    whole.power[rows],
                    whole.variance[rows],
                    whole.quality[rows],
                    whole.correlation_length[rows],
                ),
            )


def _assert_agree(result, expected) -> None:
    np.testing.assert_array_equal(result.power, expected.power)
    np.testing.assert_array_equal(result.quality, expected.quality)
    np.testing.assert_allclose(result.variance, expected.variance, rtol=1e-9, atol=0.0)
    np.testing.assert_allclose(result.correlation_length, expected.correlation_length, rtol=1e-9)


@pytest.mark.parametrize("bins", [1, 2, 3, 4, 16, 17, 31, 33, 50, 1000, 4096])
@pytest.mark.parametrize("offset", [0.0, -37.5, 450.0])
def test_analog_agrees_with_plain_numpy(bins: int, offset: float) -> None:
    rng = np.random.default_rng(bins)
    distance = (np.arange(bins) + 0.5) * 7.5 + offset
    volts = 2.0 + 60.0 * _light(np.abs(distance)) + rng.normal(0, 0.15, (8, bins))
    counts = _damaged(np.minimum(volts * 600 * 4096 / 500, 600 * 4095), rng)
    shots = np.array([600, 600, 600, 600, 600, 600, 0, 599])
    volt = np.full(8, 0.5)
    settings = {"adc_bits": 12, "full_overlap_range": 200.0}
    for chosen in (settings, settings | {"dark": rng.normal(0, 0.1, bins)}):
        _assert_agree(
            counts_to_signal.analog_signal(counts, shots, distance, input_range=volt, **chosen),
            oracle.analog(counts, shots, distance, input_range=volt, **chosen),
        )
    known = settings | {"noise_variance": 1e-3, "dark_variance": rng.random(bins) * 1e-2}
    _assert_agree(
        counts_to_signal.analog_signal(counts, shots, distance, input_range=volt, **known),
        oracle.analog(counts, shots, distance, input_range=volt, **known),
    )


@pytest.mark.parametrize("bins", [1, 16, 17, 33, 1000, 4096])
@pytest.mark.parametrize("dead_time", [None, 0.0, 2e-9, 4e-9])
def test_photon_agrees_with_plain_numpy(bins: int, dead_time: float | None) -> None:
    rng = np.random.default_rng(bins)
    distance = (np.arange(bins) + 0.5) * 7.5 - 20.0
    rate = 0.3 + 150.0 * _light(np.abs(distance))
    counts = _damaged(rng.poisson(30.0 * rate / (1.0 + rate * 3e-3), (8, bins)), rng)
    counts[5, 1:90:7] = -3
    shots = np.array([600, 600, 600, 600, 600, 600, 0, 599])
    settings = {"bin_width": 7.5, "dead_time": dead_time, "full_overlap_range": 200.0}
    _assert_agree(
        counts_to_signal.photon_signal(counts, shots, distance, **settings),
        oracle.photon(counts, shots, distance, **settings),
    )


def test_a_constant_signal_has_no_noise_slope() -> None:
    # 18 bins hold no block, so one mean is taken.
    power = np.random.default_rng(2).normal(5.0, 1.0, (20, 18))
    variance = counts_to_signal.difference_variance(power, RANGE[:18])
    assert (np.ptp(variance, axis=-1) == 0.0).all()


def test_windows_do_not_reach_over_bins_that_were_left_on_disk() -> None:
    distance = (np.arange(4000) + 0.5) * 7.5
    counts = np.random.default_rng(9).poisson(1e5 * np.exp(-distance / 900.0) + 20.0, (3, 4000))
    counts, shots = counts.astype(np.int32), np.full(3, 600)
    settings = {"bin_width": 7.5, "dead_time": 3e-9}
    parts = [slice(0, 700), slice(2400, 2900), slice(3500, 4000)]
    kept = np.r_[tuple(parts)]
    result = counts_to_signal.photon_signal(counts[:, kept], shots, distance[kept], **settings)
    whole = counts_to_signal.photon_signal(counts, shots, distance, **settings)
    np.testing.assert_array_equal(result.power, whole.power[:, kept])
    start = 0
    for part in parts:
        stretch = slice(start, start + part.stop - part.start)
        alone = counts_to_signal.photon_signal(counts[:, part], shots, distance[part], **settings)
        np.testing.assert_allclose(result.variance[:, stretch], alone.variance, rtol=1e-12)
        start = stretch.stop
    # Light falls by nine decades over the gap: a window over it would take that for noise.
    np.testing.assert_allclose(result.variance, whole.variance[:, kept], rtol=0.2)


def test_every_layout_of_the_input_gives_the_same_bits() -> None:
    rng = np.random.default_rng(4)
    counts = rng.poisson(300, (6, 400)).astype(np.int32)
    shots = np.full(6, 600)
    frozen = counts.copy()
    frozen.setflags(write=False)
    unaligned = np.zeros(counts.nbytes + 1, np.uint8)[1:].view(np.int32).reshape(counts.shape)
    unaligned[:] = counts
    spread = np.zeros((12, 800), np.int32)
    spread[::2, ::2] = counts
    forms = [
        frozen,
        unaligned,
        spread[::2, ::2],
        np.asfortranarray(counts),
        counts.astype(">i4"),
        counts.astype(np.uint16),
        counts.astype(np.int64),
        np.ma.masked_array(counts),
    ]
    for convert in (_analog, _photon):
        plain = convert(counts, shots)
        for form in forms:
            _assert_same_bits(convert(form, shots.astype(">i2"), RANGE.astype(">f8")), plain)
    # One signature each: otherwise users would wait for repeated compilation.
    assert len(kernels.voltage_profiles.signatures) == 1
    assert len(kernels.photon_profiles.signatures) == 1
    assert len(noise_kernels.noise_profiles.signatures) == 1


def test_leading_axes_are_kept() -> None:
    counts = np.random.default_rng(9).poisson(300, (2, 3, 400)).astype(np.int32)
    for convert in (_analog, _photon):
        result = convert(counts, np.full((2, 3), 600))
        assert result.power.shape == result.variance.shape == result.quality.shape == (2, 3, 400)
        alone = convert(counts[1, 2], np.array(600))
        np.testing.assert_array_equal(alone.variance, result.variance[1, 2])
        assert convert(counts[:0], np.zeros((0, 3))).power.shape == (0, 3, 400)


def test_each_profile_may_have_its_own_dark_signal() -> None:
    rng = np.random.default_rng(10)
    counts = rng.poisson(3000, (2, 3, 400)).astype(np.int32)
    dark, spread = rng.random((2, 3, 400)) * 1e-3, rng.random((2, 3, 400))
    for known in ({}, {"noise_variance": 1e-3}):
        shots = np.full((2, 3), 600)
        whole = _analog(counts, shots, dark=dark, dark_variance=spread, **known)
        single = _analog(
            counts[1, 2], np.array(600), dark=dark[1, 2], dark_variance=spread[1, 2], **known
        )
        _assert_same_bits(
            single,
            counts_to_signal.Signal(
                whole.power[1, 2],
                whole.variance[1, 2],
                whole.quality[1, 2],
                whole.correlation_length[1, 2],
            ),
        )
    np.testing.assert_array_equal(whole.variance, np.maximum(1e-3 + spread, whole.variance.min()))


def test_every_missing_value_has_a_flag() -> None:
    counts = np.full((2, 400), 1000, np.int32)
    dark = np.zeros(400)
    dark[5] = np.nan
    volts = np.array([0.5, np.nan])
    result = counts_to_signal.analog_signal(
        counts, np.full(2, 600), RANGE, adc_bits=12, input_range=volts, dark=dark
    )
    np.testing.assert_array_equal(np.isnan(result.power), result.quality != 0)
    assert (np.flatnonzero(result.quality[0]) == [5]).all()
    assert (result.quality[1] & Quality.INPUT_MISSING).all()
    masked = np.ma.masked_array(counts, np.arange(400) == np.zeros((2, 1)))
    assert (_photon(masked, np.full(2, 600)).quality[:, 0] == Quality.INPUT_MISSING).all()


_COUNTS = np.ones((1, 400), np.int32)


@pytest.mark.parametrize(
    ("field", "call"),
    [
        ("counts", lambda: _photon(_COUNTS.astype(float), SHOTS)),
        ("counts", lambda: _photon(_COUNTS.astype(np.int64) << 40, SHOTS)),
        ("counts", lambda: _photon(_COUNTS, np.array([600, 600]))),
        ("range", lambda: _photon(_COUNTS, SHOTS, np.where(RANGE > 99, RANGE, np.nan))),
        ("range", lambda: _photon(_COUNTS, SHOTS, np.full(400, 7.5))),
        ("range", lambda: _photon(_COUNTS, SHOTS, RANGE[np.newaxis])),
        ("dark", lambda: _analog(_COUNTS, SHOTS, dark=np.zeros(399))),
        ("dark_variance", lambda: _analog(_COUNTS, SHOTS, noise_variance=1.0, dark_variance=[1.0])),
        ("power", lambda: counts_to_signal.difference_variance(np.zeros(399), RANGE)),
        ("counts", lambda: _analog(_COUNTS > 0, SHOTS)),
        ("counts", lambda: _photon(_COUNTS > 0, SHOTS)),
        ("bin_width", lambda: counts_to_signal.photon_signal(_COUNTS, SHOTS, RANGE, bin_width=0.0)),
        ("dead_time", lambda: _photon(_COUNTS, SHOTS, dead_time=-4e-9)),
        ("noise_variance", lambda: _analog(_COUNTS, SHOTS, noise_variance=np.nan)),
        ("full_overlap_range", lambda: _photon(_COUNTS, SHOTS, full_overlap_range=np.nan)),
        (
            "input_range",
            lambda: counts_to_signal.analog_signal(
                _COUNTS, SHOTS, RANGE, adc_bits=12, input_range=np.ones(2)
            ),
        ),
    ],
)
def test_invalid_arguments_are_refused(field, call) -> None:
    with pytest.raises(RetrievalInputError) as refused:
        call()
    assert refused.value.field == field


def test_shapes_that_do_not_match_are_named() -> None:
    with pytest.raises(RetrievalInputError, match="counts"):
        counts_to_signal.photon_signal(np.zeros((1, 399), np.int32), SHOTS, RANGE, bin_width=7.5)


@pytest.mark.parametrize("offset", [-40.0, 0.0, 3.0, 40.0])
def test_an_offset_of_the_electronics_makes_no_noise(offset):
    """Shot noise follows the light and not the voltage, whatever the offset is."""
    rng = np.random.default_rng(5)
    distance = 7.5 * np.arange(20, 4020)
    light = 60.0 * (1500.0 / distance) ** 2 + 0.02
    variance = 1e-4 + 2e-3 * light
    power = light + offset + rng.normal(0.0, np.sqrt(variance), (20, distance.size))
    result = counts_to_signal.difference_variance(power, distance)
    for low, high in ((1000, 2000), (3000, 5000), (8000, 12_000), (20_000, 28_000)):
        bins = (distance > low) & (distance < high)
        ratio = np.mean(result[:, bins] / variance[bins])
        assert 0.93 < ratio < 1.07
