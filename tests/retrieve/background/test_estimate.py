"""Background of profiles and the signal left in it, against simulated signals of known parts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import molecular_shape
from lidarops.retrieve.background.estimate import (
    from_bounded_tail,
    from_cubic,
    from_far_range,
    from_known_shape,
    from_tail,
    shifts,
    window_before,
)
from lidarops.retrieve.background.thresholds import THRESHOLDS

RANGE = 7.5 * (np.arange(2000) + 0.5)
TAIL = (13_500.0, 15_000.0)
SECTION = (1000.0, 5000.0)
SKY = 20.0
IN_TAIL = np.greater_equal(RANGE, TAIL[0])


def square_law(amount):
    """Return the signal of air without extinction, whose mean over the tail is `amount`."""
    shape = RANGE**-2.0
    return amount * shape / shape[IN_TAIL].mean()


def path(extinction=3e-4, amount=300.0):
    """Return the signal of a homogeneous path."""
    return amount * (SECTION[0] / RANGE) ** 2 * np.exp(-2 * extinction * (RANGE - SECTION[0]))


def noisy(signal, profiles=400, *, noise=1.0, seed=0):
    power = (
        SKY + signal + noise * np.random.default_rng(seed).standard_normal((profiles, RANGE.size))
    )
    return power, np.full(power.shape, noise**2)


def air():
    fall = np.exp(-RANGE / 8000.0)
    return molecular_shape(1.4e-6 * fall, 1.2e-5 * fall, RANGE)


def flagged(result, bit=Quality.BACKGROUND_UNCERTAIN):
    return (result.quality & np.int32(bit)) != 0


METHODS = {
    "tail": lambda power, variance: from_tail(power, RANGE, variance, TAIL),
    "known shape": lambda power, variance: from_known_shape(power, RANGE, variance, air(), TAIL),
    "cubic": lambda power, variance: from_cubic(power, RANGE, variance, SECTION),
}


# Signal left in a tail ------------------------------------------------------------------------


@pytest.mark.parametrize("amount", [0.0, 0.05, 0.5, 50.0])
def test_the_most_signal_is_that_of_the_square_law_within_its_noise(amount):
    result = from_tail(*_with_range(noisy(square_law(amount))), TAIL)
    score = (result.left - amount) / result.left_standard_error
    assert abs(score.mean()) < 4.0 / np.sqrt(score.size)
    assert 0.9 < score.std() < 1.1


@pytest.mark.parametrize("extinction", [1e-5, 1e-4, 1e-3])
def test_the_most_signal_bounds_that_of_air_with_extinction(extinction):
    signal = path(extinction, 1e4)
    result = from_tail(*_with_range(noisy(signal, 20, noise=1e-6)), TAIL)
    assert (result.left >= signal[IN_TAIL].mean() - 1e-6).all()


@pytest.mark.parametrize("shots", [1, 100])
def test_counts_are_flagged_only_with_signal_in_the_tail(shots):
    """Photon counts of single profiles, and of averages."""
    rng = np.random.default_rng(shots)
    for amount, least, most in ((0.0, 0.0, 0.01), (8.0 * np.sqrt(2.0 / 200 / shots), 0.99, 1.0)):
        mean = 2.0 + square_law(amount)
        power = rng.poisson(np.broadcast_to(mean * shots, (500, RANGE.size))) / shots
        variance = np.broadcast_to(mean / shots, power.shape)
        assert least <= flagged(from_tail(power, RANGE, variance, TAIL)).mean() <= most


def test_a_biased_background_is_flagged():
    """The flag is missing at few backgrounds that are off by more than 4 standard errors."""
    results = [
        from_tail(*_with_range(noisy(square_law(amount), 1000, seed=number)), TAIL)
        for number, amount in enumerate(np.geomspace(0.01, 10.0, 12))
    ]
    score = np.concatenate([(r.background - SKY) / r.standard_error for r in results])
    flags = np.concatenate([flagged(result) for result in results])
    assert np.mean(score > 4.0) > 0.4
    assert np.mean((score > 4.0) & ~flags) < 0.02
    assert flags[score > 6.0].mean() > 0.99


def test_a_tail_that_cannot_be_compared_is_uncertain():
    power, variance = noisy(square_law(0.0), 4)
    near, far = window_before(TAIL[0])
    power[1, slice(*np.searchsorted(RANGE, (near, far)))] = np.nan
    power[2, IN_TAIL] = np.nan
    result = from_tail(power, RANGE, variance, TAIL)
    np.testing.assert_array_equal(flagged(result), [False, True, False, False])
    np.testing.assert_array_equal(result.unjudged, [False, True, False, False])
    np.testing.assert_array_equal(
        flagged(result, Quality.INPUT_MISSING), [False, False, True, False]
    )
    beginning = from_tail(power[:, :60], RANGE[:60], variance[:, :60], (5.0, 450.0))
    assert beginning.unjudged[[0, 3]].all()


def test_the_last_tenth_is_the_tail_where_none_is_given():
    power, variance = noisy(square_law(1.0), 5)
    given_, default = from_tail(power, RANGE, variance, TAIL), from_tail(power, RANGE, variance)
    np.testing.assert_array_equal(default.background, given_.background)
    np.testing.assert_array_equal(default.background, power[:, 1800:].mean(axis=1))


@pytest.mark.parametrize("name", ["tail", "known shape"])
def test_a_background_of_selected_bins_is_withheld_or_flagged(name):
    signal = 0.01 * air() / air()[1500]
    for margin, withheld in ((-0.5, True), (0.5, False), (2.0, False), (6.0, False)):
        power, variance = noisy(signal, 100)
        # As a paralysed counter, which leaves out what exceeds a limit.
        power[power > SKY + margin] = np.nan
        result = METHODS[name](power, variance)
        assert np.isnan(result.background).all() == withheld
        assert flagged(result, Quality.INPUT_MISSING).all() == withheld
        trusted = ~flagged(result) & np.isfinite(result.background)
        score = (result.background - SKY) / result.standard_error
        assert (np.abs(score[trusted]) < 4.0).all()
        assert trusted.all() == (margin == 6.0)


def test_a_shift_matters_from_half_a_standard_error_on():
    share = THRESHOLDS.share_of_error
    shift = np.array([0.99, 1.01, -1.01, np.nan]) * share
    np.testing.assert_array_equal(shifts(shift, np.ones(4)), [False, True, True, False])


# Known shape ----------------------------------------------------------------------------------


def test_the_shape_of_air_gives_the_background_below_its_signal():
    signal = 40.0 * air() / air()[600]
    power, variance = noisy(signal)
    tail, shaped = (METHODS[name](power, variance) for name in ("tail", "known shape"))
    score = (shaped.background - SKY) / shaped.standard_error
    assert np.mean(np.abs(score) < 4.0) > 0.995
    assert not flagged(shaped).any()
    assert flagged(tail).all()
    in_tail = signal[IN_TAIL].mean()
    assert np.median(shaped.left) == pytest.approx(0.2 * in_tail, rel=0.3)


def test_a_window_without_shape_falls_back_on_the_tail():
    power, variance = noisy(square_law(0.0), 6)
    mask = np.zeros(power.shape, dtype=bool)
    mask[:, -8:] = True
    shaped = from_known_shape(power, RANGE, variance, air(), TAIL, mask=mask)
    tail = from_tail(power, RANGE, variance, TAIL)
    np.testing.assert_array_equal(shaped.background, tail.background)
    np.testing.assert_array_equal(shaped.quality, tail.quality)


# Cubic ----------------------------------------------------------------------------------------


@each("extinction", [1e-5, 3e-4, 1e-3])
@each("noise", [0.02, 0.5])
def test_the_cubic_gives_the_background_within_its_error(extinction, noise):
    result = METHODS["cubic"](*noisy(path(extinction), noise=noise))
    score = (result.background - SKY) / result.standard_error
    assert np.mean(np.abs(score) < 4.0) > 0.995
    assert 0.9 < score.std() < 1.1
    assert flagged(result).mean() < 0.02
    assert not flagged(result, ~int(Quality.BACKGROUND_UNCERTAIN)).any()


@pytest.mark.parametrize("centre", [1500.0, 2500.0, 4000.0])
def test_a_plume_in_the_section_is_flagged(centre):
    plume = 1.0 + 0.1 * np.exp(-0.5 * ((RANGE - centre) / 300.0) ** 2)
    result = METHODS["cubic"](*noisy(path() * plume, noise=0.1))
    wrong = np.abs(result.background - SKY) > 4.0 * result.standard_error
    assert wrong.mean() > 0.5
    assert np.mean(wrong & ~flagged(result)) < 0.01


def test_profiles_without_an_admissible_root_are_withheld():
    power, variance = noisy(path(), 5, noise=0.1)
    power[1] = SKY
    power[2, 200] = np.nan
    power[3] = SKY + 10.0 * np.random.default_rng(3).standard_normal(RANGE.size)
    result = METHODS["cubic"](power, variance)
    withheld = flagged(result, Quality.INPUT_MISSING | Quality.NO_REAL_SOLUTION)
    np.testing.assert_array_equal(withheld, ~np.isfinite(result.background))
    assert flagged(result, Quality.NO_REAL_SOLUTION)[1]
    assert flagged(result, Quality.INPUT_MISSING)[2]
    assert (flagged(result) | withheld)[3]
    assert not result.quality[[0, 4]].any()


@pytest.mark.parametrize("bins", [1, 2, 3, 7])
def test_a_short_section_is_never_trusted(bins):
    power, variance = noisy(path(), 4, noise=0.1)
    result = from_cubic(power, RANGE, variance, (RANGE[200], RANGE[199 + bins]))
    assert (result.quality != 0).all()
    assert (np.isfinite(result.background) == (bins >= 3)).all()


def test_the_cubic_requires_a_uniform_range():
    power, variance = noisy(path(), 2)
    with pytest.raises(RetrievalInputError, match="not uniform"):
        from_cubic(power, RANGE**1.01, variance, SECTION)


# All methods ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", METHODS)
def test_results_do_not_depend_on_the_other_profiles(name):
    power, variance = noisy(square_law(0.2) + path(), 70)
    whole = METHODS[name](power, variance)
    order = np.random.default_rng(5).permutation(70)
    shuffled = METHODS[name](power[order], variance[order])
    pieces = [METHODS[name](power[a:b], variance[a:b]) for a, b in ((0, 1), (1, 8), (8, 70))]
    for get in (
        lambda result: result.background,
        lambda result: result.standard_error,
        lambda result: result.left,
        lambda result: result.left_standard_error,
        lambda result: result.quality,
    ):
        np.testing.assert_array_equal(get(shuffled), get(whole)[order])
        np.testing.assert_array_equal(np.concatenate([get(p) for p in pieces]), get(whole))


@pytest.mark.parametrize("name", METHODS)
@settings(max_examples=15, deadline=None)
@given(power_of_two=st.integers(-30, 30), seed=st.integers(0, 20))
def test_results_scale_with_the_unit(name, power_of_two, seed):
    scale = 2.0**power_of_two
    power, variance = noisy(square_law(0.2) + path(), 3, seed=seed)
    one, scaled = METHODS[name](power, variance), METHODS[name](scale * power, scale**2 * variance)
    np.testing.assert_allclose(scaled.background, scale * one.background, rtol=1e-12)
    np.testing.assert_allclose(scaled.standard_error, scale * one.standard_error, rtol=1e-9)
    np.testing.assert_allclose(scaled.left, scale * one.left, rtol=1e-6)
    np.testing.assert_array_equal(scaled.quality, one.quality)


@pytest.mark.parametrize("method", [from_tail, from_cubic])
def test_an_empty_span_is_refused(method):
    power, variance = noisy(path(), 2)
    with pytest.raises(RetrievalInputError, match="no bin from 20000 to 30000 m"):
        method(power, RANGE, variance, (20_000.0, 30_000.0))


def _with_range(data):
    power, variance = data
    return power, RANGE, variance


# Bounds by the tail ---------------------------------------------------------------------------


@each("noise", [0.01, 1.0])
@each("amount", [0.0, 1.0, 20.0])
@each("attenuation", [0.0, 5e-5, 3e-4])
def test_the_bounded_tail_holds_the_background(amount, attenuation, noise):
    """Of air of constant scattering and any attenuation, from none to what leaves no signal."""
    signal = square_law(amount) * np.exp(-2.0 * attenuation * (RANGE - TAIL[0]))
    signal = np.minimum(signal, 1e6)
    power, variance = noisy(signal, noise=noise)
    found = from_bounded_tail(power, RANGE, variance, None, TAIL)
    largest = np.sqrt(3.0) * found.left + 4.0 * found.standard_error
    assert np.all(np.abs(found.background - SKY) < largest)
    assert not flagged(found).any()
    # The middle of the interval, and no more than its width.
    tail = from_tail(power, RANGE, variance, TAIL)
    assert np.all(found.background <= tail.background)
    np.testing.assert_allclose(
        tail.background - found.background, 0.5 * np.maximum(tail.left, 0.0), atol=1e-9
    )


def test_bounds_by_clean_air_are_narrower():
    power, variance = noisy(50.0 * air() / air()[IN_TAIL].mean(), noise=0.1)
    plain, clean = (from_bounded_tail(power, RANGE, variance, s, TAIL) for s in (None, air()))
    assert np.all(clean.left < 0.8 * plain.left)
    # Clean air itself is the upper end.
    ends = np.sqrt(3.0) * clean.left
    np.testing.assert_allclose(clean.background - ends, SKY, atol=1.0)


def test_the_better_known_background_of_the_far_range_is_taken():
    everywhere = np.ones((1, RANGE.size), dtype=bool)
    clean = 50.0 * air() / air()[IN_TAIL].mean()
    for noise in (0.1, 30.0):
        power, variance = noisy(clean, noise=noise)
        found = from_far_range(power, RANGE, variance, air(), TAIL, mask=everywhere)
        fit = from_known_shape(power, RANGE, variance, air(), TAIL)
        tail = from_bounded_tail(power, RANGE, variance, air(), TAIL)
        errors = [np.hypot(sky.standard_error, sky.left) for sky in (found, fit, tail)]
        judged = ~fit.unjudged
        assert judged.mean() > 0.95
        np.testing.assert_array_equal(errors[0][judged], np.minimum(*errors[1:])[judged])
        assert np.mean(np.abs(found.background - SKY) < 4.0 * errors[0]) > 0.99
    # Where no bin may be taken as clean.
    power, variance = noisy(clean, noise=0.1)
    hazy = from_far_range(power, RANGE, variance, air(), TAIL, mask=~everywhere)
    bounded = from_bounded_tail(power, RANGE, variance, air(), TAIL)
    np.testing.assert_array_equal(hazy.background, bounded.background)


def test_haze_in_the_far_range_does_not_bias_the_background():
    """Haze that the fit of clean air takes for background: its value is far below."""
    haze = 1.0 + 30.0 * np.exp(-(((RANGE - 9000.0) / 2500.0) ** 2))
    power, variance = noisy(50.0 * haze * air() / air()[IN_TAIL].mean(), noise=1.0)
    fit = from_known_shape(power, RANGE, variance, air(), TAIL)
    found = from_far_range(
        power, RANGE, variance, air(), TAIL, mask=np.broadcast_to(RANGE > 14e3, power.shape)
    )
    total = np.hypot(found.standard_error, found.left)
    assert np.all(np.abs(found.background - SKY) < 2.0 * total)
    assert np.median(np.abs(found.background - SKY)) < np.median(np.abs(fit.background - SKY))


@pytest.mark.parametrize(("near", "extinction"), [(750.0, 1e-4), (2500.0, 3e-5)])
def test_the_cubic_doubts_weak_signals(near, extinction):
    """The plan states these limits."""
    distance = np.arange(near, near + 6000.0, 7.5)
    shape = (near / distance) ** 2 * np.exp(-2 * extinction * (distance - near))
    doubted = {}
    for strength in (30.0, 300.0):
        rng = np.random.default_rng(1)
        power = SKY + strength * shape + rng.standard_normal((200, distance.size))
        span = (distance[0], distance[-1])
        doubted[strength] = flagged(from_cubic(power, distance, np.ones_like(power), span)).mean()
    assert doubted[30.0] == 1.0
    assert doubted[300.0] < 0.02
