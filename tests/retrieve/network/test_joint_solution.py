"""Joint solution of a network: its steps against numpy, scipy and finite differences."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from scipy import integrate, optimize
from support.oracles.network import (
    at_crossings,
    gradient,
    grid,
    homogeneous,
    noisy,
    signals,
    three_by_two,
    triangle,
)

from lidarops.retrieve.network import (
    _condensed_signals,
    _empirical_prior,
    outlying_bins,
)
from lidarops.retrieve.network._empirical_prior import NO_PRIOR, Prior, Problem
from lidarops.retrieve.network.thresholds import THRESHOLDS

# Values at crossings and integrals between them ------------------------------------------------


def condensed(net, power, variance, exponent=1.0, bins=7, step=5.0):
    r = grid(net, step)
    layout = _condensed_signals.lay_out_fits(
        net, np.tile(r, (net.beams, 1)), None, np.full(net.beams, 100.0), bins
    )
    power = np.atleast_3d(power).reshape(-1, net.beams, r.size)
    with patch.object(outlying_bins, "search"):
        data = _condensed_signals.condense(
            power, np.broadcast_to(variance, power.shape), np.full(net.beams, exponent), layout
        )
    return layout, data


def test_value_at_a_crossing_comes_from_a_line_through_logarithms():
    net = triangle()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.02, 1)
    layout, data = condensed(net, power, 1e-30 * variance)
    for c, (beam, problem_arguments) in enumerate(
        zip(layout.passages.beam, layout.passages.range, strict=True)
    ):
        near = np.argsort(np.abs(r - problem_arguments))[:7]
        line = np.polyfit(
            r[near] - problem_arguments, np.log(power[0, beam, near] * r[near] ** 2), 1
        )
        first = layout.first_passage[beam]
        start = layout.passages.range[first]
        near = np.argsort(np.abs(r - start))[:7]
        base = np.polyfit(r[near] - start, np.log(power[0, beam, near] * r[near] ** 2), 1)
        assert data.log_value[0, c] == pytest.approx(line[1] - base[1], abs=1e-10)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.8])
def test_integral_agrees_with_quadrature_of_the_interpolated_signal(exponent):
    net = triangle()
    r = grid(net, 10.0)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.05, 1)
    layout, data = condensed(net, power, 1e-30 * variance, exponent, step=10.0)
    for beam in range(3):
        c = layout.first_passage[beam]
        low, high = layout.passages.range[c : c + 2]
        logs = exponent * np.log(power[0, beam] * r**2)
        near = np.argsort(np.abs(r - low))[:7]
        scale = np.polyfit(r[near] - low, logs[near], 1)[1]
        inner = r[(r > low) & (r < high)]
        expected = integrate.quad(
            lambda x, logs=logs, scale=scale: np.exp(np.interp(x, r, logs) - scale),
            low, high, points=inner, limit=200,
        )[0]  # fmt: skip
        assert data.integral[0, c] == pytest.approx(2 * exponent * expected, rel=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 1.6])
def test_covariance_agrees_with_finite_differences(exponent):
    net = three_by_two()
    r = grid(net, 8.0)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.03, 1)
    layout, data = condensed(net, power, variance, exponent, step=8.0)
    relative = variance / power[0] ** 2
    step = 1e-6
    for beam in (0, 5):
        first, last = layout.first_passage[beam], layout.first_passage[beam + 1]
        count = last - first
        slopes = np.zeros((2 * count - 1, r.size))
        quiet = np.zeros_like(variance)
        shifted = np.repeat(power, 2 * r.size, axis=0)
        for g in range(r.size):
            shifted[2 * g, beam, g] *= 1 + step
            shifted[2 * g + 1, beam, g] *= 1 - step
        _, shift = condensed(net, shifted, quiet, exponent, step=8.0)
        # Integrals are scaled to 1 at the first crossing: undo this.
        scale = np.exp(first_value(layout, beam, shifted, r, exponent))
        values = shift.log_value[:, first:last] + np.log(scale)[:, None]
        sums = shift.integral[:, first : last - 1] * scale[:, None]
        window = slice(layout.window[first], layout.window[first] + 7)
        mend = 0.5 * exponent * relative[beam, window] @ layout.weights[first]
        centre = np.exp(first_value(layout, beam, power, r, exponent) + mend)
        slopes[:count] = (values[::2] - values[1::2]).T / (2 * step)
        slopes[count:] = (sums[::2] - sums[1::2]).T / (2 * step) / centre
        expected = (slopes * relative[beam]) @ slopes.T
        packed = data.covariance[0, layout.offset[beam] : layout.offset[beam + 1]]
        measured = packed.reshape(expected.shape)
        size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(measured / size, expected / size, atol=1e-5)


def first_value(layout, beam, power, r, exponent):
    c = layout.first_passage[beam]
    window = slice(layout.window[c], layout.window[c] + layout.weights.shape[1])
    logs = exponent * np.log(power[:, beam, window] * r[window] ** 2)
    return logs @ layout.weights[c]


# Least squares ------------------------------------------------------------------------------


class Oracle:
    """Objective of a network in dense numpy, without elimination and packing."""

    def __init__(self, layout, data, profile, net):
        self.layout, self.net = layout, net
        self.crossing = layout.passages.crossing
        self.beam = layout.passages.beam
        self.values = data.log_value[profile]
        self.integrals = data.integral[profile]
        self.packed = data.covariance[profile]
        self.size = self.crossing.size

    def beyond(self):
        out = np.zeros(self.size)
        for c in range(self.size - 2, -1, -1):
            if self.beam[c] == self.beam[c + 1]:
                out[c] = out[c + 1] + self.integrals[c]
        return out

    def residual(self, constants, logarithms):
        weight = np.exp(constants[self.beam]) + self.beyond()
        return self.values - np.log(weight) - logarithms[self.crossing]

    def covariance(self, constants):
        weight = np.exp(constants[self.beam]) + self.beyond()
        out = np.zeros((self.size, self.size))
        for beam in range(self.net.beams):
            first, last = self.layout.first_passage[beam : beam + 2]
            n = last - first
            turn = np.zeros((n, 2 * n - 1))
            turn[:, :n] = np.eye(n)
            for i in range(n):
                turn[i, n + i :] = -1.0 / weight[first + i]
            packed = self.packed[self.layout.offset[beam] : self.layout.offset[beam + 1]]
            out[first:last, first:last] = turn @ packed.reshape(2 * n - 1, -1) @ turn.T
        return out


def case(profiles=3, relative=0.01, net=None):
    net = net or three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), relative, profiles, additive=0.002)
    layout, data = condensed(net, power, variance)
    problem = Problem(data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing)
    return net, layout, data, problem


@pytest.mark.parametrize("deviation", [np.inf, 0.05])
def test_solution_agrees_with_least_squares(deviation):
    net, layout, data, problem = case()
    result = problem.solve(Prior(deviation), 60)
    assert np.all(result.settled)
    precision, _ = Prior(deviation).precision(net.crossing)
    values, vectors = np.linalg.eigh(precision)
    prior = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    for n in range(3):
        oracle = Oracle(layout, data, n, net)
        root = np.linalg.cholesky(oracle.covariance(result.constants[n]))

        def objective(x, oracle=oracle, root=root, prior=prior):
            gap = oracle.residual(x[: net.beams], x[net.beams :])
            return np.concatenate([np.linalg.solve(root, gap), prior @ x[net.beams :]])

        start = np.concatenate([result.constants[n] + 0.05, result.logarithm[n] - 0.02])
        best = optimize.least_squares(objective, start, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        # Without prior, the kernel adds a hundredth of information on the level.
        bound = 1e-6 if np.isfinite(deviation) else 2e-3
        np.testing.assert_allclose(best.x[net.beams :], result.logarithm[n], atol=bound)
        covariance = np.linalg.inv(best.jac.T @ best.jac)[net.beams :, net.beams :]
        np.testing.assert_allclose(np.diag(covariance), result.variance[n], rtol=0.02)
        share = np.diag(covariance @ precision @ covariance)
        np.testing.assert_allclose(share, result.prior_share[n], rtol=0.02, atol=1e-12)
        assert 2 * best.cost == pytest.approx(result.total_chi_square[n], rel=1e-3)
        if not np.isfinite(deviation):
            assert 2 * best.cost == pytest.approx(result.chi_square[n], rel=0.02)
    assert result.degrees_of_freedom[0] == layout.passages.beam.size - net.beams - net.crossings


@pytest.mark.parametrize("deviation", [0.03, 0.3, np.inf])
@pytest.mark.parametrize("build", [three_by_two, triangle])
def test_errors_of_values_are_carried_as_a_new_solution_shows(build, deviation):
    net = build()
    r = grid(net)
    # Without noise, because weights that follow the constant would change its residuals.
    power = signals(net, r, gradient)
    layout, data = condensed(net, power, (0.01 * power) ** 2)
    error = np.random.default_rng(6).normal(0.0, 1e-4, layout.passages.beam.size)
    # Values and integrals are relative to the first value of their beam.
    first = error[layout.first_passage[layout.passages.beam]]
    changed = replace(
        data, log_value=data.log_value + error - first, integral=data.integral * np.exp(-first)
    )
    numbers = (np.cumsum(layout.measured) - 1)[layout.passages.crossing].astype(np.intp)
    before, after = (
        Problem(d, layout, numbers, np.ones(net.beams), net.crossing[layout.measured]).solve(
            Prior(deviation), 40
        )
        for d in (data, changed)
    )
    shift = (after.logarithm - before.logarithm)[0]
    known = np.isfinite(shift)
    assert known.any()
    np.testing.assert_allclose(
        (before.carried[0] @ error)[known], shift[known], rtol=0.01, atol=1e-5
    )


def test_contradictory_beams_are_detected_when_their_constants_diverge():
    """Without prior, the constant of an outlying beam diverges; its equations become singular."""
    _, layout, data, problem = case(2)
    data.log_value[0, layout.first_passage[0] + 1] -= 3.0
    result = problem.solve(NO_PRIOR, 60)
    assert np.isnan(result.chi_square[0])
    assert result.total_chi_square[0] > 50.0 * result.total_degrees_of_freedom[0]
    assert result.total_chi_square[1] == pytest.approx(result.chi_square[1], rel=0.01)


def test_likelihood_agrees_with_the_dense_linear_model():
    net, layout, data, problem = case(1)
    fixed = problem.solve(Prior(0.05), 60).constants
    oracle = Oracle(layout, data, 0, net)
    noise = oracle.covariance(fixed[0])
    weight = np.exp(fixed[0][oracle.beam]) + oracle.beyond()
    design = np.zeros((oracle.size, net.beams + 1))
    design[np.arange(oracle.size), oracle.beam] = np.exp(fixed[0][oracle.beam]) / weight
    design[:, -1] = 1.0
    target = oracle.values - np.log(weight)
    choose = np.eye(net.crossings)[oracle.crossing]

    def dense(deviation):
        gradient_field = _empirical_prior._gradient_covariance(net.crossing)
        field = THRESHOLDS.gradient**2 * gradient_field + deviation**2 * np.eye(net.crossings)
        total = noise + choose @ field @ choose.T
        inverse = np.linalg.inv(total)
        information = design.T @ inverse @ design
        rest = target - design @ np.linalg.solve(information, design.T @ inverse @ target)
        return (
            np.linalg.slogdet(total)[1] + np.linalg.slogdet(information)[1] + rest @ inverse @ rest
        )

    def measured(deviation):
        return problem.solve(Prior(deviation), 1, fixed).cost.sum()

    for deviation in (0.01, 0.1, 0.5):
        difference = dense(deviation) - dense(0.05)
        assert measured(deviation) - measured(0.05) == pytest.approx(difference, abs=1e-4)


def test_standard_errors_are_the_scatter_of_solutions():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.005, 400, additive=5e-4)
    layout, data = condensed(net, power, variance)
    problem = Problem(data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing)
    result = problem.solve(NO_PRIOR, 30)
    truth = np.log(at_crossings(net, homogeneous()))
    score = (result.logarithm - truth) / np.sqrt(result.variance)
    np.testing.assert_allclose(score[:, net.near_crossing].std(axis=0), 1.0, atol=0.15)
    assert np.mean(result.chi_square / result.degrees_of_freedom) == pytest.approx(1.0, abs=0.15)


def test_solution_does_not_depend_on_the_other_profiles():
    _, layout, data, problem = case(7)
    exponent, position = np.ones(6), problem_position()
    whole = problem.solve(Prior(0.05), 10)
    for selected in ([0], [3, 4], [6, 1]):
        chunk = Problem(
            data.take(np.array(selected)), layout, layout.passages.crossing, exponent, position
        ).solve(Prior(0.05), 10)
        assert np.array_equal(chunk.logarithm, whole.logarithm[selected])
        assert np.array_equal(chunk.variance, whole.variance[selected])


def problem_position():
    return three_by_two().crossing


def test_crossings_of_missing_beams_only_are_missing():
    net = three_by_two()
    r = grid(net)
    power = signals(net, r, homogeneous())[np.newaxis].copy()
    power[0, 0, :] = np.nan
    power[0, 4, :] = np.nan
    layout, data = condensed(net, power, 1e-8 * np.nan_to_num(power[0]) ** 2 + 1e-60)
    problem = Problem(data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing)
    seen = np.zeros(net.crossings, dtype=bool)
    for beam in (1, 2, 3, 5):
        seen[net.on_beam(beam)[0]] = True
    result = problem.solve(Prior(0.05), 10)
    assert np.array_equal(np.isfinite(result.logarithm[0]), seen)
    np.testing.assert_allclose(np.exp(result.logarithm[0, seen]), 2e-3, rtol=0.02)


@pytest.mark.parametrize("deviation", [np.inf, 0.1])
@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_a_beam_with_singular_covariance_is_left_out(deviation, bad):
    _, layout, data, problem = case(3)
    clean = problem.solve(Prior(deviation))
    without = data.take(np.arange(3))
    without.usable[1, : layout.first_passage[1]] = 0
    data.covariance[1, : layout.offset[1]] = bad
    problem_arguments = (layout, layout.passages.crossing, np.ones(6), problem_position())
    result, expected = (
        Problem(entry, *problem_arguments).solve(Prior(deviation)) for entry in (data, without)
    )
    assert np.all(result.settled)
    np.testing.assert_array_equal(result.degrees_of_freedom, expected.degrees_of_freedom)
    assert np.array_equal(np.isfinite(result.logarithm), np.isfinite(expected.logarithm))
    np.testing.assert_allclose(result.logarithm, expected.logarithm, rtol=1e-4)
    np.testing.assert_allclose(result.variance, expected.variance, rtol=1e-2)
    for entry in ("logarithm", "variance", "chi_square", "total_chi_square"):
        selected, others = getattr(result, entry)[[0, 2]], getattr(clean, entry)[[0, 2]]
        np.testing.assert_array_equal(selected, others)


def test_a_profile_with_singular_covariances_is_not_determined():
    _, layout, data, _ = case(3)
    data.covariance[1] = 0.0
    problem_arguments = (layout, layout.passages.crossing, np.ones(6), problem_position())
    for deviation in (np.inf, 0.1):
        result = Problem(data, *problem_arguments).solve(Prior(deviation))
        assert result.settled.tolist() == [True, False, True]
        assert result.determined.tolist() == [True, False, True]
        assert np.isnan(result.logarithm[1]).all()


def test_prior_with_a_single_crossing_is_finite():
    precision, norm = Prior(0.1).precision(np.zeros((1, 3)))
    assert np.isfinite(precision).all()
    assert np.isfinite(norm)


# Blocks and their means ------------------------------------------------------------------------


def steep(x, y, z):
    """Return thin air that decreases with height by more than the gradient of the prior."""
    return 1e-5 * np.exp(-(z - 500.0) / 250.0 + 0.0 * x)


def fifty(field, relative, lost=0.0):
    """Return a problem of 50 profiles, some with missing beams."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field), relative, 50, additive=0.0)
    gone = np.random.default_rng(2).random((50, net.beams, 1)) < lost
    layout, data = condensed(net, np.where(gone, np.nan, power), variance)
    return Problem(data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing)


@pytest.mark.parametrize(("field", "detected"), [(homogeneous(1e-3), False), (steep, True)])
def test_the_mean_of_profiles_detects_a_field_that_the_prior_excludes(field, detected):
    problem, prior = fifty(field, 0.15), Prior(THRESHOLDS.deviations[0])
    sharp = problem.solve(prior)
    # Single profiles fit, even in the steep field.
    assert np.median(sharp.total_chi_square / sharp.total_degrees_of_freedom) < 2.0
    solved = _empirical_prior.solve_block(problem)
    accepted = solved.profiles.prior
    assert detected or accepted.strength == 1.0
    assert _empirical_prior._improbable(problem.mean().solve(prior)) == detected


def test_a_profile_that_does_not_converge_has_no_say_in_the_prior():
    problem = fifty(homogeneous(1e-3), 0.05)
    data = problem.data.take(np.arange(6))
    data.log_value[0] += 3.0 * np.random.default_rng(0).standard_normal(data.log_value.shape[1])
    whole, others = (
        _empirical_prior._likeliest(replace(problem, data=data.take(rows)), 1.0)
        for rows in (np.arange(6), np.arange(1, 6))
    )
    assert whole.settled.tolist() == [False, *[True] * 5]
    # With its likelihood, which jumps from deviation to deviation, this was 1.
    assert whole.prior == others.prior
    np.testing.assert_array_equal(whole.logarithm[1:], others.logarithm)


def test_the_mean_of_profiles_is_taken_beam_by_beam():
    problem = fifty(homogeneous(), 0.05, lost=0.25)
    data, layout = problem.data, problem.layout
    assert data.usable.all(axis=1).sum() < 20
    mean = problem.mean()
    assert mean.data.usable.all()
    for beam in range(6):
        selected = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
        packed = slice(layout.offset[beam], layout.offset[beam + 1])
        seen = data.usable[:, selected].all(axis=1)
        for name, part in (("log_value", selected), ("integral", selected)):
            np.testing.assert_allclose(
                getattr(mean.data, name)[0, part], getattr(data, name)[seen, part].mean(axis=0)
            )
        expected = data.covariance[seen, packed].mean(axis=0) / seen.sum()
        np.testing.assert_allclose(mean.data.covariance[0, packed], expected)
    assert mean.solve(NO_PRIOR).settled[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12, 20.0])
def test_a_mean_leaves_out_a_beam_that_is_far_noisier_than_most(bad):
    problem = fifty(homogeneous(), 0.05)
    data, layout = problem.data, problem.layout
    quiet = data.take(np.arange(50))
    quiet.usable[7, : layout.first_passage[1]] = False
    expected = replace(problem, data=quiet).mean().data
    # Only the variance of the first integral of the beam.
    count = layout.first_passage[1]
    data.covariance[7, 2 * count * count] *= bad
    result = problem.mean().data
    for name in ("log_value", "integral", "covariance", "usable"):
        np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))


def test_a_block_without_two_passages_on_any_beam_is_not_determined():
    problem = fifty(homogeneous(), 0.05)
    # A value at the first crossing of a beam alone does not count.
    problem.data.usable[:] = False
    problem.data.usable[:, problem.layout.first_passage[:-1]] = True
    solved = _empirical_prior.solve_block(problem)
    assert not solved.profiles.determined.any()
    assert np.isnan(solved.profiles.logarithm).all()


@pytest.mark.parametrize(
    ("reach", "depth"),
    [
        ([3] * 50, 3),
        ([3] * 45 + [2] * 5, 3),
        ([3] * 9 + [2] * 41, 2),
        ([3] * 7, 3),
        ([1] * 50, 0),
        ([], 0),
    ],
)
def test_a_mean_extends_to_the_passage_with_most_values(reach, depth):
    assert _empirical_prior._mean_depth(np.array(reach, dtype=np.intp)) == depth
