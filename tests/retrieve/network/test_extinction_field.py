"""Extinction from the signals of networks of lidars: accuracy, blocks, weak signals, checks."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    FIELDS,
    QUIET,
    at_crossings,
    fan,
    gradient,
    grid,
    homogeneous,
    noisy,
    plume,
    relative_errors,
    root_mean_square,
    signals,
    three_by_two,
    triangle,
    with_noise,
    without_noise,
)

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.flags import NetworkQuality

# Without noise ------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [1.0, 5.0, 15.0])
@pytest.mark.parametrize("extinction", [2e-4, 2e-3, 6e-2])
def test_homogeneous_triangle_is_exact_at_any_step(step, extinction):
    result = without_noise(triangle(), homogeneous(extinction), step=step)
    np.testing.assert_allclose(result.extinction[:2], extinction, rtol=1e-10)
    assert np.isnan(result.extinction[2])


@pytest.mark.parametrize(("step", "bound"), [(15.0, 2e-2), (7.5, 5e-3), (3.75, 1e-3)])
def test_gradient_converges_with_the_step(step, bound):
    net = triangle()
    result = without_noise(net, gradient, step=step)
    np.testing.assert_allclose(result.extinction[:2], at_crossings(net, gradient)[:2], rtol=bound)


def test_plume_converges_with_the_step():
    net = triangle()
    errors = [
        np.max(
            np.abs(without_noise(net, plume, step=s).extinction / at_crossings(net, plume) - 1)[:2]
        )
        for s in (7.5, 3.75, 1.0)
    ]
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 1e-3


@pytest.mark.parametrize("name", FIELDS)
def test_larger_networks_agree_with_the_truth(name):
    net, field = three_by_two(), FIELDS[name]
    for prior, bound in (("none", 3e-3), ("block", 3e-3)):
        result = without_noise(net, field, step=1.0, prior=prior)
        near = net.near_crossing
        np.testing.assert_allclose(
            result.extinction[near], at_crossings(net, field)[near], rtol=bound
        )


def test_constants_of_lidars_cancel():
    net = triangle()
    r = grid(net)
    power = signals(net, r, gradient)
    gains = np.array([3e4, 1e-7, 2.0])[:, None]
    first, second = (
        retrieve_network(
            gain * power, r, net, variance=1e-6 * (gain * power) ** 2, full_overlap_range=100.0
        )
        for gain in (1.0, gains)
    )
    np.testing.assert_allclose(second.extinction, first.extinction, rtol=1e-9)


def test_error_of_the_overlap_does_not_cancel():
    net = triangle()
    r = grid(net)
    power = signals(net, r, homogeneous())
    truth = without_noise(net, homogeneous()).extinction[0]
    changes = []
    for error in (0.01, 0.03):
        wrong = power.copy()
        wrong[0, r < 620] *= 1 + error
        result = retrieve_network(wrong, r, net, prior="none", variance=QUIET * wrong**2,
                       full_overlap_range=100.0)  # fmt: skip
        changes.append(truth / result.extinction[0] - 1)
    np.testing.assert_allclose(changes, [-0.049, -0.135], atol=0.025)


def test_overlap_function_is_divided_out():
    net = triangle()
    r = grid(net)
    overlap = 1.0 - np.exp(-r / 300.0)
    power = signals(net, r, gradient)
    expected = without_noise(net, gradient).extinction
    result = retrieve_network(power * overlap, r, net, prior="none", variance=QUIET * power**2,
                   overlap=overlap)  # fmt: skip
    np.testing.assert_allclose(result.extinction, expected, rtol=1e-10)


def test_exponent_may_differ_from_beam_to_beam():
    net = triangle()
    r, exponent = grid(net, 1.0), np.array([0.7, 1.0, 1.5])
    power = np.stack([signals(net, r, gradient, m)[i] for i, m in enumerate(exponent)])
    result = retrieve_network(power, r, net, prior="none", variance=QUIET * power**2,
                   full_overlap_range=100.0, exponent=exponent)  # fmt: skip
    np.testing.assert_allclose(result.extinction[:2], at_crossings(net, gradient)[:2], rtol=1e-3)


# With noise ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "relative", "bound", "exact"),
    [("homogeneous", 0.10, 0.08, 0.3), ("plume", 0.05, 0.08, 0.1), ("gradient", 0.05, 0.08, 0.15)],
)
def test_a_prior_is_far_better_than_the_exact_triangle(name, relative, bound, exact):
    net, field = triangle(), FIELDS[name]
    truth = at_crossings(net, field)
    result = with_noise(net, field, relative)
    assert root_mean_square(relative_errors(result, truth))[0] <= bound
    assert result.flagged[:, 0].mean() < 0.02
    alone = with_noise(net, field, relative, prior="none")
    assert root_mean_square(relative_errors(alone, truth))[0] > exact
    # The stated error is correct.
    score = (result.extinction[:, :2] - truth[:2]) / result.extinction_standard_error[:, :2]
    assert np.mean(np.abs(score) < 3) >= 0.98


@pytest.mark.parametrize("name", FIELDS)
def test_three_lidars_with_two_beams(name):
    net, field = three_by_two(), FIELDS[name]
    near, truth = net.near_crossing, at_crossings(net, field)
    result = with_noise(net, field, 0.05, 300)
    assert np.median(root_mean_square(relative_errors(result, truth))[near]) <= 0.08
    assert 0.7 < np.mean(result.reduced_chi_square) < 1.3
    usable = ~result.flagged & np.isfinite(result.extinction)
    score = ((result.extinction - truth) / result.extinction_standard_error)[usable]
    assert np.mean(np.abs(score) < 3) >= 0.98
    assert usable[:, near].mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("relative", [0.02, 0.10])
def test_values_stay_within_3_errors_while_a_plume_moves(relative):
    net = triangle()
    r = grid(net)
    fields = [lambda x, y, z, e=e: plume(x, y, z, e) for e in np.linspace(-200.0, 100.0, 100)]
    clean = np.array([signals(net, r, f) for f in fields])
    truth = np.array([at_crossings(net, f) for f in fields])
    level = clean[:, :, 100:101]
    deviation = np.hypot(relative * clean, 0.01 * level)
    power = clean + deviation * np.random.default_rng(2).standard_normal(clean.shape)
    result = retrieve_network(power, r, net, variance=deviation**2, full_overlap_range=100.0,
                   blocks=np.arange(100) // 50)  # fmt: skip
    usable = ~result.flagged & np.isfinite(result.extinction)
    score = ((result.extinction - truth) / result.extinction_standard_error)[usable]
    assert np.mean(np.abs(score) < 3) >= 0.98
    assert usable[50:, 0].mean() > 0.9


def test_long_chains_are_not_biased():
    # 4 x 3 beams: rows that are linear in 1 / extinction have scores that spread by 2.5.
    net = fan(
        [-450.0, -150.0, 150.0, 450.0],
        [(42, 55, 68), (62, 78, 94), (86, 102, 118), (112, 125, 138)],
        farthest=900.0,
    )
    assert net.crossings > 20
    result = with_noise(net, homogeneous(1e-3), 0.01, 60, prior="none")
    usable = ~result.flagged & np.isfinite(result.extinction)
    error = (result.extinction - 1e-3) / result.extinction_standard_error
    assert usable[:, net.near_crossing].mean() > 0.5
    assert np.std(error[usable]) < 1.3
    assert 0.8 < np.mean(result.reduced_chi_square) < 1.2


def test_a_plume_over_many_crossings_is_within_its_errors():
    # Steps of 500 m hardly describe it.
    net = fan(
        np.linspace(-600, 600, 5),
        [(40, 52, 64), (55, 68, 81), (75, 90, 105), (99, 112, 125), (116, 128, 140)],
        farthest=1400.0,
    )
    truth = at_crossings(net, plume)
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.05, 80, additive=0.002)
    settings = {"variance": variance, "full_overlap_range": 100.0}
    # The profiles of a block share their error.
    result = retrieve_network(power, r, net, blocks=np.arange(80) // 10, **settings)
    usable = ~result.flagged & np.isfinite(result.extinction)
    score = ((result.extinction - truth) / result.extinction_standard_error)[usable]
    assert np.mean(np.abs(score) < 3) >= 0.98
    assert abs(np.mean(score)) < 0.5
    without_prior = retrieve_network(power, r, net, prior="none", **settings)
    errors = [root_mean_square(relative_errors(x, truth)) for x in (result, without_prior)]
    assert np.nanmedian(errors[0]) < 0.7 * np.nanmedian(errors[1])


def test_values_in_a_steep_field_and_high_noise_are_right_or_flagged():

    def steep(x, y, z):
        return 1e-3 * np.exp(-z / 350.0)

    net = fan([-600.0, -200.0, 200.0, 600.0], [(40, 55), (60, 85), (95, 120), (125, 140)],
              farthest=1500.0)  # fmt: skip
    result = with_noise(net, steep, 0.2, 100, seed=11)
    kept = ~result.flagged & np.isfinite(result.extinction)
    score = (result.extinction - at_crossings(net, steep)) / result.extinction_standard_error
    assert np.mean((np.abs(score) > 4.0) & kept) < 0.02


def scores_with_weak_far_crossings(scale, relative, net):
    """Return the result and errors over stated ones in a field that decreases with height."""
    r = grid(net)

    def field(_, __, z):
        return 1.5e-3 * np.exp(-(z - 500.0) / scale)

    power, variance = noisy(net, r, signals(net, r, field), relative, 40, 0, relative / 3.0)
    result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    score = (result.extinction - at_crossings(net, field)) / result.extinction_standard_error
    return result, score


@pytest.mark.parametrize(
    ("scale", "relative", "net"),
    [(200.0, 0.06, triangle()), (175.0, 0.03, three_by_two()), (150.0, 0.03, three_by_two()),
     (100.0, 0.03, three_by_two())],
)  # fmt: skip
def test_values_from_an_untested_prior_are_flagged(scale, relative, net):
    """All values were once unflagged, and half of them off by more than 4 errors."""
    result, score = scores_with_weak_far_crossings(scale, relative, net)
    kept = ~result.flagged & np.isfinite(result.extinction)
    assert np.mean((np.abs(score) > 4.0)[:, net.near_crossing] & kept[:, net.near_crossing]) < 0.01


def test_a_field_with_too_few_beams_has_large_errors():
    net = three_by_two()
    result, score = scores_with_weak_far_crossings(500.0, 0.1, net)
    kept = ~result.flagged & np.isfinite(result.extinction)
    assert kept.sum() > 40
    assert np.all(np.abs(score[kept]) < 4.0)
    stated = result.extinction_standard_error / result.extinction
    assert np.median(stated[kept]) > 0.1


@pytest.mark.parametrize("name", FIELDS)
def test_missing_beams_of_profiles_cost_only_their_crossings(name):
    net, field = three_by_two(), FIELDS[name]
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field), 0.02, 50, seed=2)
    missing = np.random.default_rng(2).random((50, net.beams, 1)) < 0.25
    result = [
        retrieve_network(entry, r, net, variance=variance, full_overlap_range=100.0)
        for entry in (power, np.where(missing, np.nan, power))
    ]
    kept = [np.isfinite(entry.extinction) & ~entry.flagged for entry in result]
    # At a crossing of two beams, at most (3 / 4)^2 of the values are unflagged.
    assert kept[1].sum() > 0.4 * kept[0].sum()
    score = (result[1].extinction - at_crossings(net, field)) / result[1].extinction_standard_error
    assert np.all(np.abs(score[kept[1]]) < 4.0)


def test_averaged_signals_are_better_than_averaged_solutions():
    net = triangle()
    r = grid(net)
    clean = signals(net, r, homogeneous())
    power, variance = noisy(net, r, clean, 0.1, 2000, seed=6)
    groups = power.reshape(20, 100, *clean.shape)
    before = retrieve_network(groups.mean(axis=1), r, net, prior="none", variance=variance / 100,
                   full_overlap_range=100.0)  # fmt: skip
    after = retrieve_network(
        power, r, net, prior="none", variance=variance, full_overlap_range=100.0
    )
    error = root_mean_square(2e-3 / before.extinction[:, 0] - 1)
    means = np.nanmean((2e-3 / after.extinction[:, 0]).reshape(20, 100), axis=1)
    assert error < 0.1
    assert root_mean_square(means - 1) > 2 * error


# Shapes, blocks and batches -----------------------------------------------------------------


def test_blocks_are_independent():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.05, 60)
    labels = np.repeat([1, 2, 3], [20, 10, 30])
    settings = {"full_overlap_range": 100.0}
    whole = retrieve_network(power, r, net, variance=variance, blocks=labels, **settings)
    shuffled = np.random.default_rng(0).permutation(60)
    for chunk in (slice(0, 20), slice(20, 60), slice(20, 30)):
        piece = retrieve_network(
            power[chunk], r, net, variance=variance, blocks=labels[chunk], **settings
        )
        for name in ("extinction", "extinction_standard_error"):
            a, b = getattr(whole, name)[chunk], getattr(piece, name)
            assert np.array_equal(a, b, equal_nan=True), name
    mixed = retrieve_network(
        power[shuffled], r, net, variance=variance, blocks=labels[shuffled], **settings
    )
    np.testing.assert_allclose(mixed.extinction, whole.extinction[shuffled], rtol=1e-9)


def test_unusual_arrays_are_accepted_and_shapes_kept():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.02, 6)
    expected = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    cube = power.reshape(2, 3, *power.shape[1:])
    swapped = np.asfortranarray(cube).astype(">f8")
    swapped.setflags(write=False)
    result = retrieve_network(swapped, r, net, variance=variance, full_overlap_range=[100.0] * 3)
    assert result.extinction.shape == (2, 3, 3)
    assert result.flagged.shape == (2, 3, 3)
    assert result.reduced_chi_square.shape == (2, 3)
    assert np.array_equal(result.extinction.reshape(6, 3), expected.extinction, equal_nan=True)
    rows = retrieve_network(power, np.tile(r, (3, 1)), net, variance=np.tile(variance, (6, 1, 1)),
                 full_overlap_range=100.0)  # fmt: skip
    assert np.array_equal(rows.extinction, expected.extinction, equal_nan=True)
    single_precision = retrieve_network(
        power.astype(np.float32), r, net, variance=variance, full_overlap_range=100.0
    )
    np.testing.assert_allclose(
        single_precision.extinction[:, 0], expected.extinction[:, 0], rtol=1e-3
    )
    one_profile = retrieve_network(power[0], r, net, variance=variance, full_overlap_range=100.0)
    assert one_profile.extinction.shape == (3,)
    no_profile = retrieve_network(power[:0], r, net, variance=variance, full_overlap_range=100.0)
    assert no_profile.extinction.shape == (0, 3)


def test_beams_may_have_different_ranges():
    net = triangle()
    fine, coarse = grid(net, 3.75), grid(net, 7.5)
    ranges = np.full((3, fine.size), np.nan)
    ranges[0], ranges[1] = fine, fine
    ranges[2, : coarse.size] = coarse
    power = signals(net, fine, gradient)
    power[2, : coarse.size] = signals(net, coarse, gradient)[2]
    power[2, coarse.size :] = np.nan
    result = retrieve_network(power, ranges, net, prior="none", variance=1e-12 * power**2,
                   full_overlap_range=100.0)  # fmt: skip
    np.testing.assert_allclose(result.extinction[:2], at_crossings(net, gradient)[:2], rtol=5e-3)


def test_crossings_without_full_overlap_are_not_measured():
    net = three_by_two()
    result = with_noise(net, homogeneous(), 0.02, 5)
    assert not result.raised(Quality.INPUT_MISSING).any()
    r = grid(net)
    power = signals(net, r, homogeneous())
    far = retrieve_network(power, r, net, variance=1e-6 * power**2, full_overlap_range=650.0)
    assert far.raised(Quality.INPUT_MISSING).any()
    assert np.isnan(far.extinction[far.raised(Quality.INPUT_MISSING)]).all()
    assert np.isfinite(far.extinction[~far.raised(Quality.INPUT_MISSING) & far.near_crossing]).any()


def apart(first, second):
    """Return the difference of two results in standard errors of the first."""
    return np.abs(first.extinction - second.extinction) / first.extinction_standard_error


def test_weak_signals_are_left_out_and_flagged():
    net = triangle()
    r = grid(net)
    clean = signals(net, r, homogeneous(4e-3))
    power, variance = noisy(net, r, clean, 0.02, 50, additive=0.2)
    result = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    assert result.raised(NetworkQuality.LOW_LEVERAGE).any()
    usable = ~result.flagged & np.isfinite(result.extinction)
    score = ((result.extinction - 4e-3) / result.extinction_standard_error)[usable]
    assert score.size == 0 or np.mean(np.abs(score) < 3) > 0.97


@pytest.mark.parametrize("factor", [30.0, 1e2, 1e4, 1e8, np.inf, np.nan])
def test_a_noisy_profile_does_not_change_the_others(factor):
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.05, 50, seed=4)
    stated = np.broadcast_to(variance, power.shape).copy()
    stated[3] *= factor
    noisy_power = power.copy()
    if np.isfinite(factor):
        rng = np.random.default_rng(0)
        noisy_power[3] += np.sqrt(stated[3] - variance) * rng.standard_normal(noisy_power[3].shape)
    clean = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    result = retrieve_network(noisy_power, r, net, variance=stated, full_overlap_range=100.0)
    without = retrieve_network(
        np.delete(power, 3, axis=0), r, net, variance=variance, full_overlap_range=100.0
    )
    others, kept = np.arange(50) != 3, np.isfinite(clean.extinction)
    np.testing.assert_array_equal(result.flagged[others], clean.flagged[others])
    # What one profile of 50 is worth.
    assert np.all(apart(result, clean)[others][kept[others]] < 0.25)
    stated_error = result.extinction_standard_error[others]
    np.testing.assert_allclose(
        stated_error[kept[others]],
        without.extinction_standard_error[kept[others]],
        rtol=1e-9 if factor > 50.0 or np.isnan(factor) else 0.025,
    )
    selected = np.isfinite(result.extinction[3]) & ~result.flagged[3]
    if factor > 50.0 or np.isnan(factor):
        assert not selected.any()
        stated = result.raised(
            NetworkQuality.LOW_LEVERAGE
            | Quality.LOW_SIGNAL
            | NetworkQuality.POOR_FIT
            | Quality.INPUT_MISSING
        )
        assert stated[3, net.near_crossing].all()
        np.testing.assert_allclose(result.extinction[others], without.extinction, rtol=1e-9)
    score = (result.extinction - 2e-3) / result.extinction_standard_error
    assert np.all(np.abs(score[3][selected]) < 4.0)


def between(net, r):
    """Return the bin of each beam halfway between its last two crossings."""
    last = [net.on_beam(beam)[1][-2:] for beam in range(net.beams)]
    return np.searchsorted(r, np.mean(last, axis=1))


@pytest.mark.parametrize("factor", [np.nan, np.inf, 1e12])
def test_a_bin_of_unknown_variance_does_not_change_the_other_profiles(factor):
    """Such a bin once removed its beams from the mean, which could not test the prior."""
    net = three_by_two()
    r = grid(net)
    clean = signals(net, r, lambda _, __, z: 1.5e-3 * np.exp(-(z - 500.0) / 250.0))
    power, variance = noisy(net, r, clean, 0.05, 60)
    stated = np.broadcast_to(variance, power.shape).copy()
    stated[7, np.arange(net.beams), between(net, r)] *= factor
    settings = {"full_overlap_range": 100.0}
    result = retrieve_network(power, r, net, variance=stated, **settings)
    whole = retrieve_network(power, r, net, variance=variance, **settings)
    others = np.arange(60) != 7
    np.testing.assert_array_equal(result.flagged[others], whole.flagged[others])
    kept = ~whole.flagged & np.isfinite(whole.extinction)
    assert np.all(apart(result, whole)[others][kept[others]] < 0.25)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bin_of_unknown_variance_counts_as_missing(bad):
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 50, seed=4)
    beam = int(np.argmax(np.bincount(net.passages.beam)))
    index = between(net, r)[beam]
    stated = np.broadcast_to(variance, power.shape).copy()
    stated[7, beam, index] = bad
    missing = power.copy()
    missing[7, beam, index] = np.nan
    result = retrieve_network(power, r, net, variance=stated, full_overlap_range=100.0)
    other = retrieve_network(missing, r, net, variance=variance, full_overlap_range=100.0)
    for name in ("extinction", "extinction_standard_error", "degrees_of_freedom"):
        np.testing.assert_allclose(getattr(result, name)[7], getattr(other, name)[7], rtol=1e-9)
    crossings = net.on_beam(beam)[0]
    assert result.raised(Quality.INPUT_MISSING)[7, crossings[-1]]
    assert not result.raised(Quality.INPUT_MISSING)[7, crossings[0]]
    assert np.delete(result.raised(Quality.INPUT_MISSING), 7, axis=0).sum() == 0


def test_a_beam_without_noise_is_left_out_and_flagged():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, 20)
    stated = np.broadcast_to(variance, power.shape).copy()
    stated[3, 0] = 0.0
    result = retrieve_network(power, r, net, variance=stated, full_overlap_range=100.0)
    clean = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    selected = np.zeros_like(result.raised(NetworkQuality.LOW_LEVERAGE))
    selected[3, net.on_beam(0)[0]] = True
    np.testing.assert_array_equal(result.raised(NetworkQuality.LOW_LEVERAGE), selected)
    assert result.degrees_of_freedom[3] < clean.degrees_of_freedom[3]


def test_a_profile_of_more_energy_is_not_noisy():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.05, 50, seed=4)
    scale = np.where(np.arange(50) == 3, 20.0, 1.0)[:, np.newaxis, np.newaxis]
    clean = retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0)
    result = retrieve_network(
        scale * power, r, net, variance=scale**2 * variance, full_overlap_range=100.0
    )
    assert not result.raised(NetworkQuality.LOW_LEVERAGE).any()
    np.testing.assert_allclose(result.extinction, clean.extinction, rtol=1e-9)


# Checks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"prior": "flat"}, "prior"),
        ({"full_overlap_range": None}, "overlap"),
        ({"full_overlap_range": -1.0}, "full_overlap_range"),
        ({"full_overlap_range": [1.0, 2.0]}, "full_overlap_range"),
        ({"overlap": np.ones(4)}, "overlap"),
        ({"overlap": -np.ones(100)}, "overlap"),
        ({"exponent": 0.0}, "exponent"),
        ({"exponent": [1.0, 1.0]}, "exponent"),
        ({"blocks": [1, 2]}, "blocks"),
        ({"blocks": [0.5] * 4}, "blocks"),
        ({"variance": -1.0}, "variance"),
        ({"variance": np.ones((4, 2, 100))}, "variance"),
    ],
)
def test_invalid_settings_raise_with_the_field_name(settings, field):
    net = triangle()
    r = np.linspace(100.0, 1200.0, 100)
    with pytest.raises(RetrievalInputError) as raised:
        retrieve_network(
            np.ones((4, 3, 100)),
            r,
            net,
            **{"variance": 1.0, "full_overlap_range": 100.0, **settings},
        )
    assert raised.value.field == field


@pytest.mark.parametrize(
    ("power", "range_", "field"),
    [
        (np.ones((4, 2, 100)), np.linspace(100.0, 1200.0, 100), "power"),
        (np.ones(100), np.linspace(100.0, 1200.0, 100), "power"),
        (np.ones((4, 3, 100)), np.linspace(0.1, 1.2, 100), "range"),
        (np.ones((4, 3, 100)), np.ones((2, 100)), "range"),
        (np.ones((4, 3, 100)), np.linspace(1200.0, 100.0, 100), "range"),
        (np.ones((4, 3, 100)), np.full((3, 100), np.nan), "range"),
        (np.full((4, 3, 100), "x"), np.linspace(100.0, 1200.0, 100), "power"),
    ],
)
def test_invalid_arrays_raise_with_the_field_name(power, range_, field):
    with pytest.raises(RetrievalInputError) as raised:
        retrieve_network(power, range_, triangle(), variance=1.0, full_overlap_range=100.0)
    assert raised.value.field == field


def test_signals_that_reach_no_crossing_have_no_values():
    net = triangle()
    r = np.arange(100.0, 400.0, 5.0)
    power = np.tile(1 / r**2, (4, 3, 1))
    result = retrieve_network(power, r, net, variance=power**2, full_overlap_range=100.0)
    assert np.isnan(result.extinction).all()
    assert result.raised(Quality.INPUT_MISSING).all()


def test_beams_that_do_not_meet_raise():
    net = fan([0.0, 100.0], [(60.0,), (60.0,)])
    r = np.arange(100.0, 400.0, 5.0)
    with pytest.raises(RetrievalInputError, match="do not meet"):
        retrieve_network(np.ones((2, r.size)), r, net, variance=1.0, full_overlap_range=100.0)
