"""Profiles without light are told from weak light, clouds and gaps by all channels of a scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.light_counts import RANGE as R
from support.light_counts import SHAPE, draw_counts

from lidarops.retrieve.signal.light import Light, excess_over_far, light_of, lightless

DAY, NIGHT = 30.0, 0.02
"""Counts of a bin by the sky."""


def shape(nearest=0.0, cloud=0.0):
    """Return light along range, 1 at 300 m; from a range on, or behind a cloud at 300 m."""
    light = SHAPE * np.exp(-R / 4000.0) * (1.0 + cloud * np.exp(-(((R - 300.0) / 30.0) ** 2)))
    light[R > 300.0] *= 1.0 / (1.0 + cloud)
    return light * (nearest <= R)


def photons(rng, light, sky=DAY, number=40, **of_shape):
    """Return counts of profiles, with these by light at 300 m."""
    rows = np.broadcast_to(light * shape(**of_shape), (number, R.size))
    return draw_counts(rng, rows, analog=False, level=sky)


def analog(rng, light, number=40, noise=50.0, **of_shape):
    """Return summed counts of a digitiser, with these by light at 300 m."""
    rows = np.broadcast_to(light * shape(**of_shape), (number, R.size))
    return draw_counts(rng, rows, analog=True, level=noise)


def found(counts, shots=None):
    shots = np.full(len(counts), 600) if shots is None else shots
    return light_of(*excess_over_far(counts), np.asarray(shots) > 0)


def dark_of(channels, lasers=None):
    """Return the profiles without light by channel."""
    of_laser = dict.fromkeys(channels, "1") | (lasers or {})
    return lightless({name: found(counts) for name, counts in channels.items()}, of_laser)


def with_dark(rng, made, dark, light=5000.0, lit=40, **settings):
    parts = made(rng, light, number=lit, **settings), made(rng, 0.0, number=dark, **settings)
    return np.concatenate(parts)


@pytest.mark.parametrize("dark", [1, 10, 200])
@pytest.mark.parametrize("sky", [DAY, NIGHT])
def test_profiles_without_light_are_told_however_many(dark, sky):
    rng = np.random.default_rng(1)
    counts = with_dark(rng, photons, dark, sky=sky)
    weak = with_dark(rng, photons, dark, light=1.0, sky=sky)
    for rows in dark_of({"elastic": counts, "raman": weak}).values():
        np.testing.assert_array_equal(rows, np.arange(len(counts)) >= 40)


def test_of_a_thousand_profiles_without_light_ten_at_most_are_missed():
    rng = np.random.default_rng(2)
    for made in (photons, analog):
        counts = with_dark(rng, made, 1000, light=20000.0, lit=120)
        assert dark_of({"elastic": counts})["elastic"][120:].sum() >= 990


@pytest.mark.slow
@pytest.mark.parametrize("made", [photons, analog])
def test_light_that_a_profile_shows_itself_is_never_none(made):
    """Attenuated as dust on the window does, however much: at 11 errors, none of 20,000 is dark."""
    rng = np.random.default_rng(3)
    bright = found(made(rng, 20000.0))
    assert bright.tells
    light = 20000.0 * 11.0 / np.median(bright.excess)
    if made is photons:
        # The noise of a weak profile is that of the sky.
        clear = found(made(rng, light, number=200))
        light *= 11.0 / np.median(clear.excess)
    weak = [found(made(rng, light, number=1000)) for _ in range(20)]
    excess = np.concatenate([one.excess for one in weak])
    assert 9.0 < np.median(excess) < 13.0
    assert not (excess < 6.0).sum() > 2
    dusty = np.concatenate([made(rng, 20000.0), made(rng, 1000.0, number=500)])
    assert not dark_of({"elastic": dusty})["elastic"].any()


@pytest.mark.parametrize(("made", "light"), [(photons, 250.0), (analog, 2200.0)])
def test_a_channel_tells_if_a_twentieth_of_its_light_would_show(made, light):
    """Of weaker light, a twentieth of what most profiles show is lost in the noise."""
    rng = np.random.default_rng(15)

    def with_few_of_a_twentieth(most):
        parts = (most, 40), (0.05 * most, 4), (0.0, 20)
        counts = np.concatenate([made(rng, x, number=n) for x, n in parts])
        (dark,) = dark_of({"weak": counts}).values()
        return np.median(found(counts[:40]).excess), dark

    excess, dark = with_few_of_a_twentieth(light)
    assert 230.0 < excess < 390.0
    np.testing.assert_array_equal(np.flatnonzero(dark), np.arange(44, 64))
    excess, dark = with_few_of_a_twentieth(0.4 * light)
    assert 90.0 < excess < 120.0
    assert not dark.any()


@given(
    light=st.floats(0.0, 30.0),
    share=st.floats(0.0, 1.0),
    nearest=st.sampled_from([0.0, 3000.0, 8000.0]),
    sky=st.sampled_from([DAY, NIGHT]),
    seed=st.integers(0, 1000),
)
def test_weak_light_alone_is_never_none_in_part(light, share, nearest, sky, seed):
    """Scenes of weak light, stronger in some profiles: all have light, or none shows any."""
    rng = np.random.default_rng(seed)
    some = round(40 * share)
    parts = [(light, some), (3.0 * light, 40 - some)]
    counts = np.concatenate([photons(rng, x, sky, n, nearest=nearest) for x, n in parts if n])
    (dark,) = dark_of({"weak": counts}).values()
    assert not dark.any() or (dark.all() and found(counts).of_sum < 6.0)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7])
@pytest.mark.parametrize("cloud", [30.0, 1000.0])
def test_fog_and_a_dirty_window_hold_light(share, cloud):
    rng = np.random.default_rng(4)
    some = int(40 * share)
    foggy = photons(rng, 5000.0, number=some, cloud=cloud)
    counts = np.concatenate([foggy, photons(rng, 5000.0, number=40 - some), photons(rng, 250.0)])
    weak = photons(rng, 1.0, number=len(counts))
    assert not any(rows.any() for rows in dark_of({"elastic": counts, "raman": weak}).values())


def test_a_channel_that_sees_only_clouds_tells_nothing():
    """Of clear air it shows nothing; clouds differ, and are rare."""
    rng = np.random.default_rng(5)
    clouds = [photons(rng, 10.0 ** rng.uniform(0.0, 4.0), number=1) for _ in range(30)]
    counts = np.concatenate([*clouds, photons(rng, 0.0, number=70)])
    bird = np.concatenate([photons(rng, 1e4, number=4), photons(rng, 0.1, number=96)])
    assert not dark_of({"far": counts})["far"].any()
    assert not dark_of({"far": bird})["far"].any()


def test_another_laser_tells_nothing_of_a_weak_channel():
    rng = np.random.default_rng(6)
    counts = {"green": with_dark(rng, photons, 10), "raman": photons(rng, 3.0, number=50)}
    same = dark_of(counts)
    np.testing.assert_array_equal(same["raman"], same["green"])
    other = dark_of(counts, {"raman": "2"})
    assert not other["raman"].any()
    np.testing.assert_array_equal(other["green"], same["green"])


def test_a_weak_channel_holds_light_where_one_of_its_laser_does():
    """A blocked telescope is dark by itself."""
    rng = np.random.default_rng(7)
    blocked = with_dark(rng, photons, 10)
    seen = analog(rng, 20000.0, number=50)
    dark = dark_of({"near": blocked, "far": seen, "raman": photons(rng, 1.0, number=50)})
    np.testing.assert_array_equal(dark["near"], np.arange(50) >= 40)
    assert not dark["far"].any()
    assert not dark["raman"].any()


def test_nothing_holds_light_where_no_channel_of_a_laser_shows_any():
    rng = np.random.default_rng(8)
    counts = {"photon": photons(rng, 0.0), "analog": analog(rng, 0.0)}
    assert all(rows.all() for rows in dark_of(counts).values())
    # Weak light that only the sum of all profiles shows is light.
    counts["analog"] = analog(rng, 60.0)
    assert found(counts["analog"]).of_sum > 6.0
    assert not any(rows.any() for rows in dark_of(counts).values())
    # Of few profiles nothing is said.
    assert not dark_of({"photon": photons(rng, 0.0, number=4)})["photon"].any()


def test_a_gap_is_no_profile_without_light():
    rng = np.random.default_rng(9)
    counts, shots = with_dark(rng, photons, 5), np.full(45, 600)
    shots[[3, 42]] = 0
    (dark,) = lightless({"photon": found(counts, shots)}, {"photon": "1"}).values()
    np.testing.assert_array_equal(np.flatnonzero(dark), [40, 41, 43, 44])


def test_a_recorder_that_is_off_is_a_gap_unless_others_show_no_light():
    rng = np.random.default_rng(13)
    counts = with_dark(rng, photons, 10)
    # Off at first, and without a count of dark sky at the end.
    counts[[2, 3, 44, 45]] = 0
    weak = photons(rng, 1.0, number=50)
    alone = dark_of({"photon": counts, "raman": weak})
    for rows in alone.values():
        np.testing.assert_array_equal(np.flatnonzero(rows), [40, 41, 42, 43, 46, 47, 48, 49])
    both = dark_of({"photon": counts, "analog": with_dark(rng, analog, 10, 1e5), "raman": weak})
    for rows in both.values():
        np.testing.assert_array_equal(np.flatnonzero(rows), np.arange(40, 50))
    # So for a whole scene without a count.
    assert not dark_of({"photon": np.zeros_like(counts)})["photon"].any()


def test_too_few_bins_tell_nothing():
    rng = np.random.default_rng(10)
    counts = with_dark(rng, photons, 5)[:, :100]
    assert not dark_of({"photon": counts})["photon"].any()


@given(cuts=st.sets(st.integers(1, 49)))
def test_profiles_may_come_in_any_parts(cuts):
    counts = with_dark(np.random.default_rng(11), photons, 10)
    parts = [excess_over_far(part) for part in np.split(counts, sorted(cuts))]
    for whole, several in zip(excess_over_far(counts), zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(np.concatenate(several), whole)


def test_light_states_the_errors_of_noise():
    """Of constant counts, windows differ by the errors that are stated, in a sum as in profiles."""
    rng = np.random.default_rng(12)
    for counts in (photons(rng, 0.0, number=2000), analog(rng, 0.0, number=2000)):
        excess, variance, _ = excess_over_far(counts)
        spread = (excess / np.sqrt(variance)).std()
        assert 0.97 < spread < 1.03
        assert isinstance(found(counts), Light)


@pytest.mark.parametrize("value", [np.iinfo(np.int32).min, np.iinfo(np.int32).max, 30_000])
@pytest.mark.parametrize("rows", [slice(7, 8), slice(None)])
def test_a_bad_bin_of_the_far_range_hides_no_light(value, rows):
    rng = np.random.default_rng(11)
    counts = photons(rng, 5000.0).astype(np.int32)
    counts[rows, 1900] = value
    assert not dark_of({"elastic": counts})["elastic"].any()


@pytest.mark.parametrize("light", [200.0, 20_000.0])
@pytest.mark.parametrize("bins", [400, 1000, 2000])
def test_a_target_in_the_far_range_is_light(light, bins):
    """As of a wall that a level beam meets, or a cloud at the end of a short record."""
    rng = np.random.default_rng(12)
    counts = photons(rng, 5000.0, number=30)[:, :bins]
    target = np.arange(bins) > 0.93 * bins
    counts[10:20] += rng.poisson(light * target, (10, bins))
    assert not dark_of({"elastic": counts})["elastic"].any()


def test_counts_at_full_scale_in_all_bins_are_not_dark():
    rng = np.random.default_rng(13)
    counts = analog(rng, 20000.0, number=30)
    counts[:10] = 2_457_000
    assert not dark_of({"analog": counts})["analog"].any()


def test_faint_pick_up_beside_others_without_light_is_none():
    rng = np.random.default_rng(14)
    channels = {name: with_dark(rng, analog, 10, light=20000.0) for name in "abc"}
    channels["a"][40:, :50] += 65
    excess = found(channels["a"]).excess[40:]
    assert 6.0 < np.median(excess) < 12.0
    assert dark_of(channels)["a"][40:].mean() > 0.8
    assert not dark_of({"a": channels["a"]})["a"][40:].mean() > 0.2
