"""Errors from curved signals at crossings, and their part in the stated error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    gradient,
    grid,
    noisy,
    plume,
    signals,
    three_by_two,
    triangle,
)

from lidarops.retrieve.network import (
    _condensed_signals,
    _curvature_errors,
    _empirical_prior,
    _fit_layout,
    extinction_field,
)
from lidarops.retrieve.network.thresholds import THRESHOLDS


def layer(deep, height):
    """Return 1.5 per km with a layer of three times that and a standard deviation `deep` in m."""

    def field(x, y, z):
        return 1.5e-3 * (1.0 + 2.0 * np.exp(-((z - height) ** 2) / (2.0 * deep**2)) + 0.0 * x)

    return field


def solved(net, field, relative, profiles, *, step=5.0, additive=0.0, seed=1, **settings):
    r = grid(net, step)
    power, variance = noisy(
        net, r, signals(net, r, field), relative, profiles, seed=seed, additive=additive
    )
    return extinction_field.retrieve_network(
        power, r, net, variance=variance, full_overlap_range=100.0, **settings
    )


def deviations(net, result, field):
    """Return errors over stated ones, relative errors and stated ones, of unflagged values."""
    truth = at_crossings(net, field)
    unflagged = np.isfinite(result.extinction) & ~result.flags.flagged
    stated = result.extinction_standard_error
    return (
        (np.abs(result.extinction - truth) / stated)[unflagged],
        (np.abs(result.extinction / truth - 1.0))[unflagged],
        (stated / truth)[unflagged],
    )


# Passages ------------------------------------------------------------------------------------


@pytest.mark.parametrize("bins", [3, 4, 5, 7, 20, 99])
def test_a_curvature_error_is_the_difference_of_a_line_and_the_truth(bins):
    net = triangle()
    r = np.tile(grid(net, 3.0), (net.beams, 1)) + np.array([[0.0], [0.7], [1.9]])
    layout = _fit_layout.lay_out_fits(net, r, None, np.full(3, 100.0), bins)
    weights = _curvature_errors.curvature_weights(layout)
    rng = np.random.default_rng(4)
    for c, (beam, location) in enumerate(
        zip(layout.passages.beam, layout.passages.range, strict=True)
    ):
        window_ranges = r[beam, layout.window[c] : layout.window[c] + bins]
        # A polynomial that fits through so few bins.
        polynomial = np.polynomial.Polynomial(rng.normal(size=min(bins - 1, 4) + 1))
        logs = polynomial((window_ranges - location) / 50.0)
        line = np.polynomial.Polynomial.fit(window_ranges, logs, 1)(location)
        assert weights[c] @ logs == pytest.approx(line - polynomial(0.0), rel=1e-6, abs=1e-8)
        np.testing.assert_allclose(
            weights[c] @ np.stack([window_ranges, 0.0 * window_ranges + 1.0]).T, 0.0, atol=1e-9
        )


def test_the_noise_of_a_curvature_error_is_as_stated():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.02, 3000, additive=0.0)
    layout = _fit_layout.lay_out_fits(net, np.tile(r, (6, 1)), None, np.full(6, 100.0), 7)
    data = _condensed_signals.condense(
        power, variance[np.newaxis], np.zeros(3000, dtype=np.intp), np.ones(6), layout,
        screened=False,
    )  # fmt: skip
    stated = np.median(data.curvature_error[..., 1], axis=0)
    np.testing.assert_allclose(np.var(data.curvature_error[..., 0], axis=0), stated, rtol=0.12)
    for number in (3000, 9):
        medians = np.stack(
            [
                _curvature_errors.block_medians(
                    data.curvature_error[n : n + number], data.usable[n : n + number]
                )
                for n in range(0, 3000 // number * number, number)
            ]
        )
        expected = stated * np.pi / 2.0 / number
        np.testing.assert_allclose(medians[0, :, 1], expected, rtol=0.05)
        if number == 9:
            np.testing.assert_allclose(np.var(medians[..., 0], axis=0), expected, rtol=0.4)


# Solutions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("strength", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("deviation", [*THRESHOLDS.deviations, np.inf])
def test_the_prior_of_a_solution_is_recovered(deviation, strength):
    net = three_by_two()
    shape = (1, net.crossings)
    layout = _fit_layout.lay_out_fits(
        net, np.tile(grid(net), (net.beams, 1)), None, np.full(net.beams, 100), 7
    )
    power = signals(net, grid(net), gradient)[np.newaxis]
    data = _condensed_signals.condense(
        power, ((0.01 * power[0]) ** 2)[np.newaxis], np.zeros(1, dtype=np.intp), np.ones(net.beams),
        layout, screened=False,
    )  # fmt: skip
    crossing = layout.passages.crossing.astype(np.intp)
    problem = _empirical_prior._Problem(data, layout, crossing, np.ones(net.beams), net.crossing)
    result = problem.solve(deviation, 4, strength)
    precision, without_prior = _empirical_prior.prior_of(net.crossing, result, 0)
    assert result.logarithm.shape == shape
    assert without_prior == np.isinf(deviation)
    if without_prior:
        assert not precision.any()
    else:
        expected = _empirical_prior._free_level(
            _empirical_prior._gradient_covariance(net.crossing), deviation, strength
        )[0]
        np.testing.assert_allclose(precision, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("deviation", [0.03, 0.3, np.inf])
@pytest.mark.parametrize("build", [three_by_two, triangle])
def test_errors_of_values_shift_solutions_as_a_new_solution_does(build, deviation):
    net = build()
    r = grid(net)
    # Without noise, because weights that follow the constant would change its residuals.
    power = signals(net, r, gradient)[np.newaxis]
    variance = (0.01 * power[0]) ** 2
    layout = _fit_layout.lay_out_fits(
        net, np.tile(r, (net.beams, 1)), None, np.full(net.beams, 100), 7
    )
    data = _condensed_signals.condense(
        power, variance[np.newaxis], np.zeros(1, dtype=np.intp), np.ones(net.beams), layout,
        screened=False,
    )  # fmt: skip
    shared = np.random.default_rng(6).normal(0.0, 1e-4, (layout.passages.beam.size, 2))
    shared[:, 1] = 1e-8
    # Values and integrals are relative to the first value of their beam.
    first = shared[layout.first_passage[layout.passages.beam], 0]
    changed = replace(
        data, log_value=data.log_value + shared[:, 0] - first,
        integral=data.integral * np.exp(-first),
    )  # fmt: skip
    numbers = np.cumsum(layout.measured) - 1
    problem_arguments = (
        layout,
        numbers[layout.passages.crossing].astype(np.intp),
        np.ones(net.beams),
        net.crossing,
    )
    before, after = (
        _empirical_prior._Problem(d, *problem_arguments).solve(deviation, 40)
        for d in (data, changed)
    )
    precision, without_prior = _empirical_prior.prior_of(net.crossing, before, 0)
    assert without_prior == (not np.isfinite(deviation))

    def carried(shared, own):
        out = np.zeros((1, net.crossings, 4))
        _curvature_errors.carry_errors(
            data.log_value, data.integral, data.usable, data.covariance,
            (layout.first_passage, layout.offset, problem_arguments[1]), precision, without_prior,
            before.logarithm,
            shared, own[np.newaxis], out,
        )  # fmt: skip
        return out[0]

    out = carried(shared, shared * [2.0, 4.0])
    shift = (after.logarithm - before.logarithm)[0]
    known = np.isfinite(shift)
    assert known.any()
    np.testing.assert_allclose(out[..., 0][known], shift[known], rtol=0.01, atol=1e-5)
    np.testing.assert_allclose(out[..., 2:], out[..., :2] * [2.0, 4.0], rtol=1e-9)
    # Noise of independent passages adds in squares.
    single = [carried(row[:, np.newaxis] * [1.0, 0.0], 0.0 * shared) for row in np.eye(len(shared))]
    spread = sum(s[:, 0] ** 2 * v for s, v in zip(single, shared[:, 1], strict=True))
    np.testing.assert_allclose(out[:, 1], spread, rtol=1e-9)


@pytest.mark.parametrize(
    ("build", "deep", "height", "relative", "profiles"),
    [
        (three_by_two, 20.0, 420.0, 0.003, 50),
        (three_by_two, 20.0, 420.0, 0.01, 50),
        (three_by_two, 20.0, 420.0, 0.003, 3),
        (three_by_two, 60.0, 420.0, 0.003, 50),
        (triangle, 10.0, 500.0, 0.003, 50),
        (triangle, 10.0, 700.0, 0.003, 1),
    ],
)
@pytest.mark.parametrize("prior", ["block", "none"])
def test_the_error_covers_a_layer_that_a_line_cannot_fit(
    build, deep, height, relative, profiles, prior
):
    """Values were once off by up to 18 stated errors, in some cases mostly by more than 4."""
    net, field = build(), layer(deep, height)
    chunks = [
        deviations(net, solved(net, field, relative, profiles, seed=s, prior=prior), field)
        for s in range(max(4, 40 // profiles))
    ]
    errors, relative_errors, stated = (np.concatenate(chunk) for chunk in zip(*chunks, strict=True))
    assert errors.size > 20
    assert np.mean(errors > 4.0) < 0.005
    # The stated errors are not much too large.
    assert np.median(stated) < 1.5 * np.median(relative_errors) + 3.0 * relative


@pytest.mark.parametrize(("deep", "rise"), [(20.0, 40.0), (20.0, 100.0), (10.0, 100.0)])
def test_the_error_covers_a_layer_that_rises_within_a_block(deep, rise):
    net, r = three_by_two(), grid(three_by_two())
    heights = 420.0 + rise * np.linspace(-0.5, 0.5, 50)
    fields = [layer(deep, height) for height in heights]
    power = np.stack([signals(net, r, field) for field in fields])
    truth = np.stack([at_crossings(net, field) for field in fields])
    deviation = 0.003 * power
    power = power + deviation * np.random.default_rng(8).standard_normal(power.shape)
    result = extinction_field.retrieve_network(
        power, r, net, variance=deviation**2, full_overlap_range=100.0
    )
    kept = np.isfinite(result.extinction) & ~result.flags.flagged
    errors = (np.abs(result.extinction - truth) / result.extinction_standard_error)[kept]
    assert kept.sum() > 30
    assert np.mean(errors > 4.0) < 0.02


@pytest.mark.parametrize("profiles", [1, 2, 50])
def test_noise_does_not_count_as_curvature(profiles):
    rng = np.random.default_rng(9)
    noise = np.array([1e-4, 4e-4])
    shift = np.zeros((profiles, 2000, 2, 4))
    shift[..., 1], shift[..., 3] = noise / profiles, noise
    shift[..., 0] = np.sqrt(noise / profiles) * rng.standard_normal((2000, 2))
    shift[..., 2] = np.sqrt(noise) * rng.standard_normal(shift.shape[:-1])
    quiet = shift.copy()
    shift[:, 1:] += [1.0, 0.0, 1.0, 0.0]
    result = np.stack(
        [_curvature_errors.curvature_variance(shift[:, k]) for k in range(2000)], axis=1
    )
    np.testing.assert_allclose(np.mean(result[:, 1:]), 1.0, rtol=0.05)
    result = np.stack(
        [_curvature_errors.curvature_variance(quiet[:, k]) for k in range(2000)], axis=1
    )
    assert np.all(np.mean(result, axis=(0, 1)) < (0.15 if profiles < 3 else 0.02) * noise)


def test_a_noisy_profile_neither_hides_nor_imitates_curvature():
    shift = np.zeros((20, 1, 4))
    shift[:, 0, 3], shift[::2, 0, 2] = 1e-4, 0.1
    noisy_profiles = shift.copy()
    noisy_profiles[1, 0] = [0.0, 0.0, 3.0, 100.0]
    np.testing.assert_allclose(
        _curvature_errors.curvature_variance(noisy_profiles)[2:],
        _curvature_errors.curvature_variance(shift)[2:],
        0.1,
    )
    noisy_profiles[:, 0, 2] = [0.0, 100.0] + 18 * [0.0]
    assert not np.any(_curvature_errors.curvature_variance(noisy_profiles)[2:])


@pytest.mark.parametrize("field", [gradient, plume])
@pytest.mark.parametrize(("relative", "profiles"), [(0.003, 50), (0.05, 50), (0.05, 1)])
def test_errors_of_smooth_signals_do_not_change(field, relative, profiles, monkeypatch):
    def both():
        chunks = [
            solved(three_by_two(), field, relative, profiles, seed=s, additive=0.01)
            for s in range(max(1, 20 // profiles))
        ]
        return [
            np.concatenate([np.ravel(getattr(p, name)) for p in chunks])
            for name in ("extinction", "extinction_standard_error")
        ]

    value, stated = both()
    monkeypatch.setattr(
        _curvature_errors, "curvature_variance", lambda moved: np.zeros(moved.shape[:-1])
    )
    value_without, stated_without = both()
    np.testing.assert_array_equal(value, value_without)
    ratio = (stated / stated_without)[np.isfinite(stated_without)]
    assert np.all(ratio >= 1.0)
    assert np.median(ratio) < 1.03
    assert np.quantile(ratio, 0.9) < 1.1


def test_errors_of_a_block_do_not_depend_on_other_blocks():
    net, field = three_by_two(), layer(20.0, 420.0)
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field), 0.003, 30, additive=0.0)
    arguments = {"variance": variance, "full_overlap_range": 100.0}
    whole = extinction_field.retrieve_network(
        power, r, net, blocks=np.arange(30) // 10, **arguments
    )
    chunk = extinction_field.retrieve_network(power[10:20], r, net, **arguments)
    np.testing.assert_array_equal(
        whole.extinction_standard_error[10:20], chunk.extinction_standard_error
    )
