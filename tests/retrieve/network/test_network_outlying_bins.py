"""Outlying bins of the beams of a network: detection, bridging and flags."""

from __future__ import annotations

from contextlib import nullcontext
from unittest.mock import patch

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from support.oracles.network import (
    FIELDS,
    fan,
    grid,
    noisy,
    signals,
    three_by_two,
    triangle,
)

from lidarops.flags import Quality
from lidarops.retrieve.network import _condensed_signals, outlying_bins
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.flags import NetworkQuality

BINS = 7


def narrow(x, y, z):
    """Return a plume of 50 m, four times its surroundings, in air with a scale height of 300 m."""
    separate = ((x + 40.0) ** 2 + (z - 650.0) ** 2) / (2 * 50.0**2)
    return 1e-3 * (1 + 3 * np.exp(-separate)) * np.exp(-z / 300.0)


ALL = {**FIELDS, "narrow plume": narrow}


def scene(field=ALL["homogeneous"], relative=0.01, profiles=50, step=5.0, seed=3, additive=0.01):
    net = triangle()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), relative, profiles, seed, additive)
    return net, r, power, variance


def solved(net, r, power, variance, **settings):
    settings = {"full_overlap_range": 100.0, **settings}
    return retrieve_network(power, r, net, variance=variance, **settings)


class Condensed:
    """Condensed signals with what is known about each beam."""

    def __init__(self, data, beams):
        self.log_value, self.integral, self.covariance, self.reach = data.beams[:4]
        self.bridged = np.stack([beam.bridged for beam in beams], axis=1)
        self.status = np.stack([beam.status for beam in beams], axis=1)


def condensed(net, r, power, variance, *, screened=True, nearest=100.0):
    ranges = np.tile(r, (net.beams, 1))
    layout = _condensed_signals.lay_out_fits(net, ranges, None, np.full(net.beams, nearest), BINS)
    variances = np.broadcast_to(variance, power.shape)
    patched = nullcontext() if screened else patch.object(outlying_bins, "search")
    with patched:
        beams = _condensed_signals.clean(
            power, variances, np.ones(net.beams), layout, together=False
        )
    return Condensed(_condensed_signals.condense(beams, layout), beams), layout


def hit(power, variance, profile, beam, index, size):
    """Return power with bins of a beam changed by `size` standard errors."""
    out = power.copy()
    out[profile, beam, index] += size * np.sqrt(
        np.broadcast_to(variance, power.shape[1:])[beam, index]
    )
    return out


def bin_at(r, distance):
    return int(np.argmin(np.abs(r - distance)))


def apart(first, second):
    """Return the difference of two results in standard errors of the first."""
    return np.abs(first.extinction - second.extinction) / first.extinction_standard_error


# Without outlying bins ----------------------------------------------------------------------


@pytest.mark.parametrize("name", list(ALL))
@pytest.mark.parametrize("step", [5.0, 7.5])
def test_air_and_noise_do_not_change_at_all(name, step):
    for relative in (1e-3, 0.02, 0.1, 0.3):
        net, r, power, variance = scene(ALL[name], relative, 60, step)
        screened, _ = condensed(net, r, power, variance)
        unscreened, _ = condensed(net, r, power, variance, screened=False)
        assert not screened.bridged.any()
        for quantity in ("log_value", "integral", "reach", "covariance", "status"):
            np.testing.assert_array_equal(
                getattr(screened, quantity), getattr(unscreened, quantity)
            )


def test_low_photon_counts_are_no_outliers():
    rng = np.random.default_rng(6)
    net = triangle()
    r = grid(net)
    level = signals(net, r, ALL["homogeneous"])
    counts = rng.poisson(np.maximum(60 * level / level[:, [60]], 15), (300, *level.shape))
    data, _ = condensed(net, r, counts.astype(float), counts.astype(float))
    assert not data.bridged.any()
    assert not (data.status == _condensed_signals.OUTLYING).any()


# With outlying bins ------------------------------------------------------------------------


@pytest.mark.parametrize("relative", [1e-3, 0.02, 0.1])
@pytest.mark.parametrize("size", [15.0, 40.0, 1e3, 1e9])
def test_a_spike_at_a_crossing_is_bridged_and_flagged(relative, size):
    net, r, power, variance = scene(relative=relative)
    at = bin_at(r, net.on_beam(0)[1][0])
    clean = solved(net, r, power, variance)
    result = solved(net, r, hit(power, variance, 7, 0, at, size), variance)
    selected = net.on_beam(0)[0]
    assert result.raised(Quality.OUTLIER)[7, selected].all()
    assert not result.raised(Quality.OUTLIER)[np.arange(50) != 7].any()
    np.testing.assert_array_equal(result.flagged, clean.flagged)
    assert np.nanmax(apart(result, clean)[7]) < 1.0
    np.testing.assert_allclose(
        result.extinction_standard_error[7], clean.extinction_standard_error[7], rtol=0.3
    )


@pytest.mark.parametrize("size", [-20.0, 15.0, 100.0])
def test_a_spike_in_the_middle_of_a_long_beam_changes_nothing(size):
    net, r, power, variance = scene(relative=0.02)
    low, high = net.on_beam(1)[1][[0, -1]]
    at = bin_at(r, (low + high) / 2)
    clean = solved(net, r, power, variance)
    result = solved(net, r, hit(power, variance, 3, 1, at, size), variance)
    np.testing.assert_array_equal(result.flagged, clean.flagged)
    assert np.nanmax(apart(result, clean)[3]) < 0.3


def spiked(net, r, power, variance, sizes):
    """Return power with adjacent spikes on the first beam of all profiles, at a crossing."""
    at = bin_at(r, net.on_beam(0)[1][0])
    for k, size in enumerate(sizes):
        power = hit(power, variance, slice(None), 0, at + k, size)
    return power


@pytest.mark.parametrize("sizes", [(40.0, 40.0), (90.0, 30.0), (25.0, -25.0), (60.0, 0.0, 60.0)])
def test_adjacent_spikes_are_flagged_and_left_in_place(sizes):
    """They may be the edge of a layer of air."""
    net, r, power, variance = scene(relative=0.02)
    damaged = spiked(net, r, power, variance, sizes)
    result, _ = condensed(net, r, damaged, variance)
    unscreened, _ = condensed(net, r, damaged, variance, screened=False)
    assert result.bridged[:, 0].mean() > 0.95
    left = np.all(result.log_value == unscreened.log_value, axis=(1, 2))
    assert left.mean() > 0.95


@pytest.mark.parametrize("place", ["first", "last"])
def test_the_ends_of_a_beam_are_tested_too(place):
    """A bin is missing beyond the last crossing; there are no bins before the first."""
    net, r, power, variance = scene(relative=0.02)
    ranges = net.on_beam(0)[1]
    first, last = bin_at(r, ranges[0]), bin_at(r, ranges[-1])
    if place == "first":
        at, nearest = first - 3, np.array([r[first - 3] - 0.1, 100.0, 100.0])
    else:
        at, nearest = last + 3, 100.0
        power[:, 0, last + 4 :] = np.nan
    clean = solved(net, r, power, variance, full_overlap_range=nearest)
    result = solved(
        net, r, hit(power, variance, 9, 0, at, 120.0), variance, full_overlap_range=nearest
    )
    assert result.raised(Quality.OUTLIER | NetworkQuality.POOR_FIT)[9, net.on_beam(0)[0]].any()
    kept = ~result.flagged & ~clean.flagged & np.isfinite(result.extinction)
    assert (apart(result, clean)[9][kept[9]] < 1.5).all()


def test_gaps_among_neighbours_are_skipped():
    net, r, power, variance = scene(relative=0.02)
    last = bin_at(r, net.on_beam(0)[1][-1])
    power[:, 0, last + 5] = np.nan
    clean = solved(net, r, power, variance)
    result = solved(net, r, hit(power, variance, 9, 0, last + 3, 60.0), variance)
    assert result.raised(Quality.OUTLIER)[9, net.on_beam(0)[0]].all()
    assert np.nanmax(apart(result, clean)[9]) < 1.0


def test_many_adjacent_spikes_are_flagged_and_left_in_place():
    net, r, power, variance = scene(relative=0.01)
    ranges = net.on_beam(0)[1]
    at = bin_at(r, (ranges[0] + ranges[-1]) / 2)
    rng = np.random.default_rng(1)
    damaged = power.copy()
    damaged[4, 0, at : at + 6] *= rng.uniform(0.3, 3.0, 6)
    result, _ = condensed(net, r, damaged, variance)
    unscreened, _ = condensed(net, r, damaged, variance, screened=False)
    assert result.bridged[4, 0]
    assert result.bridged.sum() == 1
    np.testing.assert_array_equal(result.integral, unscreened.integral)


def layer(x, y, z):
    """Return 1.5 per km with a layer of 60 m of three times its surroundings."""
    return 1.5e-3 + 3e-3 * np.exp(-((z - 600.0) ** 2) / (2 * 60.0**2)) + 0.0 * x


@pytest.mark.parametrize("step", [5.0, 2.0])
@pytest.mark.parametrize(("field", "most"), [(ALL["plume"], 3.2), (layer, 5.0)])
def test_single_outlying_bins_in_curved_air_change_little(field, most, step):
    """Lines from one to the next would remove the plume and raise the errors."""
    net = three_by_two()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), 0.01, 60, 3, 0.003)
    clean = solved(net, r, power, variance)
    rng = np.random.default_rng(5)
    outlying = np.zeros(power.shape, dtype=bool)
    for beam in outlying.reshape(-1, r.size):
        beam[rng.integers(5, 25) : -4 : 25] = True
    result = solved(net, r, power + outlying * 30.0 * np.sqrt(variance), variance)
    near = result.near_crossing
    ratio = result.extinction_standard_error / clean.extinction_standard_error
    assert np.nanmedian(ratio[:, near]) < most


@pytest.mark.parametrize("share", [0.02, 0.04])
@pytest.mark.parametrize("step", [5.0, 2.0])
@pytest.mark.parametrize("field", [ALL["plume"], layer])
def test_outlying_bins_in_curved_air_leave_values_within_their_errors(field, step, share):
    net = three_by_two()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), 0.01, 150, 3, 0.003)
    rng = np.random.default_rng(50)
    outlying = 30.0 * (rng.random(power.shape) < share)
    result = solved(
        net, r, power + outlying * np.sqrt(variance), variance, blocks=np.arange(150) // 50
    )  # fmt: skip
    near = result.near_crossing
    kept = (~result.flagged & np.isfinite(result.extinction))[:, near]
    score = (result.extinction - field(*net.crossing.T)) / result.extinction_standard_error
    assert kept.mean() > 0.95
    assert np.mean(np.abs(score[:, near][kept]) > 4.0) <= 7e-3


@pytest.mark.parametrize("step", [0.3, 1.1, 4.0])
def test_an_edge_of_a_layer_does_not_change(step):
    net, r, power, variance = scene(relative=0.01)
    ranges = net.on_beam(0)[1]
    beyond = r > (ranges[0] + ranges[-1]) / 2
    power[:, 0, beyond] *= step
    variance[0, beyond] *= step**2
    result, _ = condensed(net, r, power, variance)
    unscreened, _ = condensed(net, r, power, variance, screened=False)
    np.testing.assert_array_equal(result.integral, unscreened.integral)


@pytest.mark.parametrize("step", [0.1, 0.5, 3.0, 20.0])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_an_edge_inside_a_bin_does_not_change(step, share):
    net, r, power, variance = scene(relative=0.01)
    at = bin_at(r, net.on_beam(0)[1][0]) + 1
    scale = np.where(np.arange(r.size) > at, step, 1.0)
    scale[at] = 1.0 + share * (step - 1.0)
    power[:, 0] *= scale
    variance[0] *= scale**2
    result, _ = condensed(net, r, power, variance)
    unscreened, _ = condensed(net, r, power, variance, screened=False)
    np.testing.assert_array_equal(result.integral, unscreened.integral)
    np.testing.assert_array_equal(result.log_value, unscreened.log_value)


def test_a_layer_may_fill_one_wide_bin():
    net, r, power, variance = scene(relative=0.01)
    wide = slice(None, None, 4)
    at = r[wide].size // 3
    layer = power[..., wide].copy()
    layer[:, 0, at] *= 5.0
    result, _ = condensed(net, r[wide], layer, variance[..., wide])
    assert not result.bridged.any()


def test_noise_far_above_the_stated_one_is_flagged():
    net, r, power, variance = scene(relative=0.05)
    result = solved(net, r, power, variance / 400.0)
    used = np.isfinite(result.extinction)
    assert (result.raised(NetworkQuality.POOR_FIT) | ~used).all()


def test_a_variance_of_zero_sets_no_flag_of_outlying_bins():
    net, r, power, _ = scene(ALL["plume"], relative=0.02)
    result = solved(net, r, power, 0.0)
    assert not result.raised(Quality.OUTLIER).any()
    assert not result.raised(NetworkQuality.POOR_FIT).any()


# Stated errors ------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["crossing", "between"])
@pytest.mark.parametrize("relative", [0.01, 0.2])
def test_variances_of_bridged_beams_agree_with_their_scatter(where, relative):
    net, r, power, variance = scene(relative=relative, profiles=3000)
    ranges = net.on_beam(0)[1]
    at = bin_at(r, ranges[0] if where == "crossing" else (ranges[0] + ranges[-1]) / 2)
    damaged = hit(power, variance, slice(None), 0, [at, at + 5], 100.0)
    data, layout = condensed(net, r, damaged, variance)
    unscreened, _ = condensed(net, r, damaged, variance, screened=False)
    assert data.bridged[:, 0].all()
    left = np.all(data.integral == unscreened.integral, axis=(1, 2))
    assert left.mean() < 0.1
    count = layout.first_passage[1]
    stated = data.covariance[:, 0]
    good = (data.reach[:, 0] == count) & ~left
    truth, _ = condensed(
        net, r, signals(net, r, ALL["homogeneous"])[None], variance, screened=False
    )
    for c in range(1, count):
        # The far value and the integral, relative to the near value.
        difference = data.log_value[good, 0, c] - truth.log_value[0, 0, c]
        spread = stated[good, c, c] + stated[good, 0, 0] - 2 * stated[good, 0, c]
        assert np.std(difference / np.sqrt(spread)) == pytest.approx(1.0, abs=0.08)
        assert (
            abs(np.mean(difference))
            < 4 * np.std(difference) / np.sqrt(good.sum()) + 0.02 * relative
        )


def test_a_jump_is_seen_from_the_farthest_bins_within_reach():
    reach = 2 * outlying_bins.MARGIN
    bins = 2 * reach + 1
    codes = np.full(bins, outlying_bins.GOOD + 1, dtype=np.uint8)
    codes[[0, -1]] = outlying_bins.GOOD
    logs = np.where(np.arange(bins) < reach, 0.0, -5.0)
    noise = np.full(bins, 1e-6)
    assert outlying_bins._jumps(logs, noise, 1.0, codes, reach)
    assert not outlying_bins._jumps(np.zeros(bins), noise, 1.0, codes, reach)


def test_weights_agree_with_polynomials():
    rng = np.random.default_rng(2)
    x = np.cumsum(rng.uniform(3.0, 9.0, 9))
    nodes, weights = np.array([0, 1, 3, 5, 6, 8, 0, 0]), np.empty(8)
    y = rng.standard_normal(9)
    outlying_bins.fit_weights(x, 4, nodes, 6, 5, weights)
    through = BarycentricInterpolator(x[nodes[:6]], y[nodes[:6]])(x[4])
    assert weights[:6] @ y[nodes[:6]] == pytest.approx(through, rel=1e-10)
    outlying_bins.fit_weights(x, 4, nodes, 6, 3, weights)
    fitted = np.polynomial.Polynomial.fit(x[nodes[:6]], y[nodes[:6]], 3)(x[4])
    assert weights[:6] @ y[nodes[:6]] == pytest.approx(fitted, rel=1e-10)


def test_results_do_not_depend_on_other_profiles():
    net, r, power, variance = scene(relative=0.05, profiles=24)
    rng = np.random.default_rng(8)
    damaged = power + (rng.random(power.shape) < 0.02) * 50 * np.sqrt(variance)
    together = solved(net, r, damaged, variance, prior="none")
    assert together.raised(Quality.OUTLIER).any()
    for n in (0, 11, 23):
        single = solved(net, r, damaged[n], variance, prior="none")
        np.testing.assert_allclose(single.extinction, together.extinction[n], rtol=1e-9)
        np.testing.assert_array_equal(
            single.raised(Quality.OUTLIER), together.raised(Quality.OUTLIER)[n]
        )
    reversed_result = solved(net, r, damaged[::-1], variance, prior="none")
    np.testing.assert_allclose(reversed_result.extinction[::-1], together.extinction, rtol=1e-9)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.6])
def test_one_percent_of_outlying_bins_leaves_values_within_their_errors(exponent):
    net = fan([-500.0, 0.0, 400.0], [(50, 68), (78, 103), (112, 130)], farthest=1000.0)
    r = grid(net)
    clean = signals(net, r, ALL["homogeneous"], exponent)
    power, variance = noisy(net, r, clean, 0.02, 150)
    rng = np.random.default_rng(9)
    outlying = (rng.random(power.shape) < 0.01) * rng.uniform(5.0, 100.0, power.shape)
    result = solved(
        net, r, power + outlying * np.sqrt(variance), variance, exponent=exponent,
        blocks=np.arange(150) // 50,
    )  # fmt: skip
    kept = ~result.flagged & np.isfinite(result.extinction)
    score = ((result.extinction - 2e-3) / result.extinction_standard_error)[kept]
    assert kept[:, result.near_crossing].mean() > 0.9
    assert np.mean(np.abs(score) > 4.0) <= 3e-3


@pytest.mark.parametrize("sizes", [(40.0, 40.0), (90.0, 30.0), (60.0, 0.0, 60.0)])
def test_spikes_left_in_place_are_part_of_the_standard_error(sizes):
    net, r, power, variance = scene(relative=0.02)
    damaged = spiked(net, r, power, variance, sizes)
    result, _ = condensed(net, r, damaged, variance)
    unscreened, _ = condensed(net, r, damaged, variance, screened=False)
    clean, _ = condensed(net, r, power, variance)
    reported, own = result.covariance[:, 0], unscreened.covariance[:, 0]
    left = result.bridged[:, 0] & np.all(result.log_value == unscreened.log_value, axis=(1, 2))
    assert left.all()
    added = (reported - own)[left]
    # One direction, by the shift of the beam through the spikes, except for noise.
    assert np.all(np.linalg.matrix_rank(added, tol=1e-9 * np.abs(added).max()) == 1)
    shift = (unscreened.log_value - clean.log_value)[left, 0, 1]
    stated = np.sqrt(added[:, 0, 0] + added[:, 1, 1] - 2.0 * added[:, 0, 1])
    np.testing.assert_allclose(stated, np.abs(shift), rtol=0.3)
    assert not np.allclose(reported[left], own[left], rtol=0.1)


def test_beams_without_outlying_bins_keep_their_covariance():
    net, r, power, variance = scene(ALL["narrow plume"], relative=0.02)
    result, _ = condensed(net, r, power, variance)
    unscreened, _ = condensed(net, r, power, variance, screened=False)
    quiet = result.bridged == 0
    assert quiet.mean() > 0.99
    whole = quiet.all(axis=1)
    np.testing.assert_array_equal(result.covariance[whole], unscreened.covariance[whole])
