"""The reference window lies in clean air, does not follow noise; rejections give reasons."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from support.cases import each
from support.inversions import invert_elastic

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.air.reference_window import (
    Rejection,
    candidate_windows,
    choose_reference,
)
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON

AIR = MolecularProfile.us_standard()
RANGE = 15.0 * (np.arange(900) + 0.5)[20:]
BACKSCATTER = AIR.backscatter(RANGE, 532e-9)
EXTINCTION = AIR.extinction(RANGE, 532e-9)
SHAPE = BACKSCATTER * np.exp(-2.0 * np.cumsum(EXTINCTION) * 15.0) / RANGE**2
WINDOWS = candidate_windows(3e3, 12e3, 1e3, 250.0)
CLEAN = {"molecular_attenuated": SHAPE, "candidates": WINDOWS}


def attenuated(particles, lidar_ratio=50.0):
    depth = np.cumsum(EXTINCTION + lidar_ratio * particles, axis=-1) * 15.0
    return (BACKSCATTER + particles) * np.exp(-2.0 * depth) / RANGE**2


def layered(count, rng):
    """Mixed layers of all depths and, in most profiles, a layer aloft up to 7 km."""
    top, soft = rng.uniform(800.0, 2500.0, (2, count, 1)) * np.array([1.0, 0.05])[:, None, None]
    mixed = 10.0 ** rng.uniform(-6.5, -5.3, (count, 1)) / (1.0 + np.exp((RANGE - top) / soft))
    height, width = rng.uniform(2e3, 6e3, (count, 1)), rng.uniform(150.0, 500.0, (count, 1))
    strength = rng.uniform(0.0, 1.3, (count, 1)) * np.interp(height, RANGE, BACKSCATTER)
    return mixed + strength * np.exp(-0.5 * ((RANGE - height) / width) ** 2)


def counted(expected, background, rng):
    """Return photon counts minus their background, and their variance."""
    counts = rng.poisson(expected + background)
    return counts - background, np.broadcast_to(expected + background, counts.shape)


def mean_over(values, window):
    bottom, top = window
    return values[..., np.logical_and(bottom <= RANGE, top >= RANGE)].mean(axis=-1)


@pytest.mark.parametrize("counts", [1e17, 1e18, 1e19])
def test_chosen_windows_hold_few_particles(counts):
    rng = np.random.default_rng(1)
    signal = attenuated(layered(600, rng))
    window = choose_reference(*with_range(counted(counts * signal, 2.0, rng)), **CLEAN)
    assert np.all(window.chosen)
    ratio = signal / SHAPE
    clean = mean_over(ratio, (11e3, 12e3))
    excess = [
        mean_over(profile_ratio, (a, b)) / c - 1.0
        for profile_ratio, a, b, c in zip(ratio, window.bottom, window.top, clean, strict=True)
    ]
    # The remaining particles are within the noise of the windows.
    relative = window.scale_standard_error / window.scale
    assert np.percentile(excess / relative, 95) < 3.0
    assert np.percentile(excess, 95) < 0.01


def with_range(powers):
    return powers[0], RANGE, powers[1]


def test_noise_hardly_biases_the_choice():
    rng = np.random.default_rng(2)
    expected = np.broadcast_to(3e17 * SHAPE, (4000, RANGE.size))
    window = choose_reference(*with_range(counted(expected, 5.0, rng)), **CLEAN)
    assert np.mean(window.chosen) > 0.999
    deviation = (window.scale / 3e17 - 1.0) / (window.scale_standard_error / window.scale)
    usable = deviation[window.chosen]
    assert abs(np.mean(usable)) < 0.15
    assert np.std(usable) < 1.1


def test_scale_is_that_of_a_weighted_fit():
    rng = np.random.default_rng(3)
    power, variance = counted(1e18 * SHAPE, 30.0, rng)
    window = choose_reference(
        power, RANGE, variance, molecular_attenuated=SHAPE, candidates=np.array([[6e3, 8e3]])
    )
    inside = (RANGE >= 6e3) & (RANGE <= 8e3)
    p, phi, v = power[inside], SHAPE[inside], variance[inside]
    scale = np.sum(p * phi / v) / np.sum(phi**2 / v)
    assert window.scale == pytest.approx(scale, rel=1e-10)
    assert window.scale_standard_error == pytest.approx(np.sum(phi**2 / v) ** -0.5, rel=1e-10)


def test_clean_windows_pass_at_the_rate_of_the_tests():
    rng = np.random.default_rng(4)
    inside = (RANGE >= 6e3) & (RANGE <= 7e3)
    r, shape, count = RANGE[inside], SHAPE[inside], 60_000
    spread = 0.05 * shape
    power = shape + spread * rng.standard_normal((count, r.size))
    window = choose_reference(
        power, r, spread**2, molecular_attenuated=shape, candidates=np.array([[6e3, 7e3]])
    )
    most, freedom = COMMON.significant, r.size - 1
    of_scatter = stats.chi2.sf(freedom * (1.0 + most * np.sqrt(2.0 / freedom)), freedom)
    of_shape = 2.0 * stats.norm.sf(most)
    for reason, expected in (
        (Rejection.SLOPE, of_shape),
        (Rejection.CURVATURE, of_shape),
        (Rejection.SCATTER, of_scatter),
    ):
        rate = np.mean((window.rejections[:, 0] & reason) != 0)
        assert rate == pytest.approx(expected, abs=4.0 * np.sqrt(expected / count))


@each(
    ("spoil", "reason"),
    [
        (lambda z: np.exp(-(z - 7e3) / 4e3), Rejection.SLOPE),
        (lambda z: 1.0 + 0.6 * ((z - 7e3) / 1e3) ** 2, Rejection.CURVATURE),
        (lambda z: np.where((z > 6.4e3) & (z < 6.5e3), 1.4, 1.0), Rejection.SCATTER),
        (lambda z: 1e-3 * np.ones_like(z), Rejection.LOW_SIGNAL),
        (lambda z: np.where(z > 6.45e3, np.nan, 1.0), Rejection.TOO_FEW_BINS),
    ],
)
def test_each_fault_is_reported_and_no_window_chosen(spoil, reason):
    rng = np.random.default_rng(5)
    spread = 0.03 * SHAPE
    power = SHAPE * spoil(RANGE) + spread * rng.standard_normal(RANGE.size)
    window = choose_reference(
        power, RANGE, spread**2, molecular_attenuated=SHAPE, candidates=np.array([[6e3, 7.9e3]])
    )
    assert not window.chosen
    assert window.rejections[0] & reason
    for value in (window.bottom, window.top, window.scale):
        assert np.isnan(value)


def test_windows_with_excluded_bins_are_rejected():
    power = 1e18 * SHAPE
    exclude = (RANGE > 3.5e3) & (RANGE < 5e3)
    restricted = choose_reference(power, RANGE, power, **CLEAN, exclude=exclude)
    assert restricted.bottom >= 5e3
    touched = (WINDOWS[:, 0] < 5e3) & (WINDOWS[:, 1] > 3.5e3)
    assert np.array_equal((restricted.rejections & Rejection.EXCLUDED) != 0, touched)


def test_of_equally_clean_windows_the_highest_certain_one_is_taken():
    rng = np.random.default_rng(9)
    power, variance = counted(np.broadcast_to(3e17 * SHAPE, (300, RANGE.size)), 5.0, rng)
    window = choose_reference(power, RANGE, variance, **CLEAN)
    weight = SHAPE**2 / variance[0]
    error = np.array([mean_over(weight, edges) * 1e3 / 15.0 for edges in WINDOWS]) ** -0.5
    expected = WINDOWS[error < 1.3 * error.min(), 0].max()
    assert expected > 3e3
    # The tests of shape reject some.
    assert np.mean(window.bottom == expected) > 0.8


def test_a_single_candidate_states_no_particles_that_a_comparison_may_miss():
    power = 1e17 * SHAPE
    several = choose_reference(power, RANGE, power, **CLEAN)
    hidden = 0.5 * several.comparison_standard_error / several.scale
    assert several.excess == 0.0
    assert several.undetected_particles == pytest.approx(hidden)
    assert hidden > 0.0
    one = choose_reference(power, RANGE, power, **{**CLEAN, "candidates": WINDOWS[:1]})
    assert one.undetected_particles == 0.0


def test_cleaner_air_is_preferred_to_a_uniform_layer():
    # Backscatter of air times 1.2 from 3 to 6 km has the shape of air but for its extinction.
    particles = np.where((RANGE > 3e3) & (RANGE < 6e3), 0.2 * BACKSCATTER, 0.0)
    true = 1e19 * attenuated(particles, lidar_ratio=8.4)
    rng = np.random.default_rng(6)
    window = choose_reference(*with_range(counted(true, 1.0, rng)), **CLEAN)
    assert window.bottom >= 6e3
    inside = WINDOWS[:, 1] <= 6e3
    rejections = window.rejections[inside]
    assert np.all(rejections != 0)


def test_a_noisy_window_shows_particles_in_less_noisy_ones():
    # Twice the backscatter of air up to 6 km; beyond, a window has only 8 times its noise.
    particles = np.where(RANGE < 6e3, BACKSCATTER, 0.0)
    signal = attenuated(particles, lidar_ratio=8.4)
    spread = np.where(RANGE < 6e3, 0.02, 1.0) * SHAPE
    rng = np.random.default_rng(8)
    power = signal + spread * rng.standard_normal((200, RANGE.size))
    window = choose_reference(power, RANGE, spread**2, **CLEAN)
    assert np.mean(window.bottom >= 6e3) > 0.99
    # A background that may be too low by as much as the far signal explains the difference.
    unknown = mean_over(signal, (6e3, 7e3))
    same = choose_reference(power, RANGE, spread**2, **CLEAN, background_standard_error=unknown)
    assert np.mean(same.bottom < 6e3) > 0.9


def test_particles_at_the_detection_limit_are_found_as_often_as_stated():
    """Of two windows of equal noise, the nearer one holds particles."""
    rng = np.random.default_rng(10)
    windows, noise = np.array([[3e3, 4e3], [6e3, 7e3]]), 0.5 * SHAPE
    settings = {"molecular_attenuated": SHAPE, "candidates": windows}
    limit = choose_reference(SHAPE, RANGE, noise**2, **settings).detection_limit
    alone = settings | {"candidates": windows[:1]}
    assert choose_reference(SHAPE, RANGE, noise**2, **alone).detection_limit == np.inf
    for share, least, most in ((1.0, 0.93, 0.97), (0.3, 0.0, 0.15)):
        signal = SHAPE * (1.0 + np.where(RANGE < 5e3, share * float(limit), 0.0))
        power = signal + noise * rng.standard_normal((2000, RANGE.size))
        rejections = choose_reference(power, RANGE, noise**2, **settings).rejections[:, 0]
        # Of the windows that pass the tests of shape.
        tested = (rejections & ~np.int32(Rejection.MORE_PARTICLES)) == 0
        flagged = np.mean(rejections[tested] == Rejection.MORE_PARTICLES)
        assert least < flagged < most


def test_profiles_are_independent_and_their_windows_fit_the_inversion():
    rng = np.random.default_rng(7)
    true = attenuated(layered(20, rng))
    power, variance = counted(1e19 * true, 2.0, rng)
    power = power.astype(float)
    power[3] = np.nan
    power[5] = rng.standard_normal(RANGE.size)
    whole = choose_reference(power.reshape(4, 5, -1), RANGE, variance.reshape(4, 5, -1), **CLEAN)
    assert whole.chosen.shape == (4, 5)
    assert whole.rejections.shape == (4, 5, len(WINDOWS))
    assert not whole.chosen[0, 3]
    assert not whole.chosen[1, 0]
    assert np.all(whole.rejections[0, 3] == Rejection.TOO_FEW_BINS)
    alone = choose_reference(power[7], RANGE, variance[7], **CLEAN)
    assert alone.scale == whole.scale[1, 2]

    solution = invert_elastic(
        power, RANGE, molecular_backscatter=BACKSCATTER, molecular_extinction=EXTINCTION,
        lidar_ratio=50.0, reference=(whole.bottom.reshape(20), whole.top.reshape(20)),
    )  # fmt: skip
    assert np.array_equal(solution.calibrated, whole.chosen.reshape(20))


def test_candidates_are_made_within_their_bounds():
    windows = candidate_windows(3e3, 6e3, 1e3, 500.0)
    assert windows.tolist() == [[3000 + 500 * k, 4000 + 500 * k] for k in range(5)]
    for bad in ((6e3, 3e3, 1e3, 500.0), (3e3, 3.5e3, 1e3, 1e2), (0.0, 1e4, 1e3, 0.0)):
        with pytest.raises(RetrievalInputError, match="window"):
            candidate_windows(*bad)


@each(
    ("change", "field"),
    [
        ({"molecular_attenuated": -SHAPE}, "molecular_attenuated"),
        ({"exclude": np.zeros(3, dtype=bool)}, "exclude"),
    ],
)
def test_impossible_arguments_are_refused_by_name(change, field):
    with pytest.raises(RetrievalInputError) as caught:
        choose_reference(SHAPE, RANGE, SHAPE**2, **{**CLEAN, **change})
    assert caught.value.field == field
