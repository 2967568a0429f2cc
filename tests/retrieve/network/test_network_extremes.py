"""Networks of lidars: flags and extreme cases."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    fan,
    gradient,
    grid,
    homogeneous,
    noisy,
    relative_errors,
    root_mean_square,
    signals,
    triangle,
    with_noise,
    without_noise,
)

from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.extinction_field import retrieve_network

# Flags --------------------------------------------------------------------------------------


def pooled(relative):
    """Return errors and flags of exact cycles of well and poorly conditioned triangles."""
    errors, flags = [], []
    for angle in (48.0, 50.0, 53.0, 57.0, 62.0, 66.0, 70.0):
        net = triangle(angle)
        for field in (homogeneous(), gradient):
            start = int(geometry.build_cycle(net).crossing[0])
            r = grid(net)
            power, variance = noisy(
                net, r, signals(net, r, field), relative, 150, int(angle), additive=1e-4
            )
            result = retrieve_network(
                power, r, net, method="cycle", variance=variance, full_overlap_range=100.0
            )
            error = relative_errors(result, at_crossings(net, field))[:, start]
            errors.append(np.where(np.isnan(error), 3.0, np.abs(error)))
            flags.append(result.flags.flagged[:, start])
    return np.concatenate(errors), np.concatenate(flags)


@pytest.mark.parametrize("relative", [0.01, 0.03, 0.06])
def test_flags_reject_large_errors_and_keep_small_ones(relative):
    error, flagged = pooled(relative)
    assert flagged[error > 0.5].mean() >= 0.95
    if relative <= 0.03:
        assert flagged[error < 0.1].mean() <= 0.10
    assert error[~flagged].max() <= 0.8


# Extreme cases ------------------------------------------------------------------------------


def test_extreme_a_degenerate_triangle_is_always_flagged():
    net = triangle(46.1024, tolerance=1e-6)
    result = with_noise(net, homogeneous(), 0.01, 200, method="cycle")
    start = geometry.build_cycle(net).crossing[0]
    assert result.flags.ill_conditioned[:, start].mean() > 0.97
    assert result.flags.flagged[:, start].mean() > 0.97


def test_extreme_b_nearly_degenerate_triangle_is_flagged():
    net = triangle(47.0)
    result = with_noise(net, homogeneous(), 0.01, 300, method="cycle")
    assert result.flags.flagged[:, geometry.build_cycle(net).crossing[0]].mean() > 0.95


def test_extreme_c_far_start_is_flagged_and_useful_only_if_exact():
    net = triangle(30.0)
    upper = int(np.argmax(net.crossing[:, 2]))
    middle = [v for v in range(3) if geometry.build_cycle(net, start=v).far_start]
    assert upper in middle
    start = middle[0]
    exact = with_noise(net, homogeneous(), 0.01, 200, method="cycle", start=start)
    assert exact.flags.far_start[:, start].all()
    assert root_mean_square(relative_errors(exact, 2e-3))[start] < 0.35
    single = with_noise(net, homogeneous(), 0.01, 200, method="multiplier", multiplier=0.0,
                        start=start)  # fmt: skip
    assert single.flags.flagged[:, start].all()
    assert not single.flags.not_positive[:, geometry.build_cycle(net).crossing[0]].any()


def test_extreme_d_clear_air_is_flagged():
    net = triangle()
    result = with_noise(net, homogeneous(2e-5), 0.005, 200, method="cycle")
    assert result.flags.flagged[:, 0].mean() > 0.95
    network = with_noise(net, homogeneous(2e-5), 0.005, 200)
    usable = ~network.flags.flagged[:, 0]
    score = (network.extinction[:, 0] - 2e-5) / network.extinction_standard_error[:, 0]
    assert not usable.any() or np.mean(np.abs(score[usable]) < 3) >= 0.98


def test_extreme_e_dense_air_is_exact_at_the_near_crossing():
    exact = without_noise(triangle(), homogeneous(2e-2))
    single = without_noise(triangle(), homogeneous(2e-2), method="multiplier", multiplier=0.0)
    assert exact.extinction[0] == pytest.approx(2e-2, rel=1e-10)
    assert single.extinction[0] == pytest.approx(2e-2, rel=4e-4)


def test_extreme_g_steep_power_law():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous(), 2.0), 0.01, 200, additive=0.0)
    result = retrieve_network(power, r, net, method="cycle", variance=variance, exponent=2.0,
                   full_overlap_range=100.0)  # fmt: skip
    assert root_mean_square(relative_errors(result, 2e-3))[0] < 0.06


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, np.inf, -np.inf])
@pytest.mark.parametrize("method", ["network", "cycle", "multiplier", "unbiased", "slope", "klett"])
def test_extreme_h_a_bad_signal_is_always_flagged(bad, method):
    net = triangle()
    r = grid(net)
    clean = signals(net, r, homogeneous())
    power, variance = noisy(net, r, clean, 0.005, 12)
    power[3, 0, np.searchsorted(r, 700.0)] = bad
    power[5, :, :] = bad
    whole = retrieve_network(
        power, r, net, method=method, variance=variance, full_overlap_range=100.0
    )
    assert np.isnan(whole.extinction[5]).all()
    assert whole.flags.not_finite[5].all()
    missing = (
        whole.flags.signal_missing if not np.isfinite(bad) else whole.flags.signal_not_positive
    )
    assert missing[[3, 5], 1].all()
    assert whole.flags.flagged[3, 1]
    # The other profiles do not change.
    assert np.isfinite(whole.extinction[[0, 1, 2, 4], 0]).all()
    assert not missing[[0, 1, 2, 4]].any()


def test_extreme_i_too_few_beams_without_prior_have_no_values():
    net = fan([-500.0, 500.0], [(45.0, 55.0), (135.0,)])
    assert net.crossings == 2
    result = with_noise(net, homogeneous(), 0.01, 20, prior="none")
    assert np.isnan(result.extinction).all()
    assert result.flags.not_finite.all()


def test_extreme_j_no_value_beyond_the_pole():
    net = triangle(30.0)
    # Against the attenuation, through the far crossing.
    forward = geometry.build_cycle(net)
    order = forward.crossing[[0, 2, 1]]
    backward = geometry.Cycle(
        forward.beam[::-1].copy(), order.copy(), forward.end_range[::-1].copy(),
        forward.start_range[::-1].copy(),
    )  # fmt: skip
    result = without_noise(
        net, homogeneous(8e-3), method="multiplier", multiplier=0.95, cycle=backward
    )
    refused = result.flags.pole
    assert refused.any()
    assert np.isnan(result.extinction[refused]).all()


@pytest.mark.parametrize("method", ["cycle", "multiplier"])
@pytest.mark.parametrize("relative", [0.01, 0.03])
def test_a_crossing_reached_against_strong_attenuation_is_flagged(method, relative):
    net, field = triangle(60.0), homogeneous(0.02)
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field), relative, 200, 7, additive=0.0)
    result = retrieve_network(
        power, r, net, method=method, variance=variance, full_overlap_range=100.0
    )
    error = relative_errors(result, at_crossings(net, field))
    stated = result.extinction_standard_error / result.extinction
    start = int(geometry.build_cycle(net).crossing[0])
    other = [v for v in np.flatnonzero(result.near_crossing) if v != start]
    # Many values differ by more than their linear error.
    assert (np.abs(error[:, other]) > 4.0 * stated[:, other]).mean() > 0.1
    assert result.flags.ill_conditioned[:, other].mean() > 0.6
    assert result.flags.flagged[:, other].all()
    assert not result.flags.flagged[:, start].any()
