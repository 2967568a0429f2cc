"""Fit of the beams of a network: its steps against numpy, scipy and finite differences."""

from __future__ import annotations

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

from lidarops.retrieve.network import _beam_fit, _changing_field, _condensed_signals, outlying_bins
from lidarops.retrieve.network._block_solution import mean_depth

# Values at crossings and integrals between them ------------------------------------------------


def condensed(net, power, variance, exponent=1.0, bins=7, step=5.0):
    r = grid(net, step)
    layout = _condensed_signals.lay_out_fits(
        net, np.tile(r, (net.beams, 1)), None, np.full(net.beams, 100.0), bins
    )
    power = np.atleast_3d(power).reshape(-1, net.beams, r.size)
    with patch.object(outlying_bins, "search"):
        beams = _condensed_signals.clean(
            power, np.broadcast_to(variance, power.shape), np.full(net.beams, exponent), layout,
            together=False,
        )  # fmt: skip
    return layout, _condensed_signals.condense(beams, layout).beams


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
        assert data.value[0, beam, c - first] == pytest.approx(line[1] - base[1], abs=1e-10)


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
        assert data.integral[0, beam, 0] == pytest.approx(2 * exponent * expected, rel=1e-9)


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
        values = shift.value[:, beam, :count] + np.log(scale)[:, None]
        sums = shift.integral[:, beam, : count - 1] * scale[:, None]
        window = slice(layout.window[first], layout.window[first] + 7)
        mend = 0.5 * exponent * relative[beam, window] @ layout.weights[first]
        centre = np.exp(first_value(layout, beam, power, r, exponent) + mend)
        slopes[:count] = (values[::2] - values[1::2]).T / (2 * step)
        slopes[count:] = (sums[::2] - sums[1::2]).T / (2 * step) / centre
        expected = (slopes * relative[beam]) @ slopes.T
        measured = dense(data, beam, count)
        size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(measured / size, expected / size, atol=1e-5)


def dense(data, beam, count, profile=0):
    """Return the covariance of the values and integrals of a beam."""
    into = np.r_[:count, data.value.shape[2] : data.value.shape[2] + count - 1]
    return data.covariance[profile, beam][np.ix_(into, into)]


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
        place = np.arange(self.beam.size) - layout.first_passage[self.beam]
        self.values = data.value[profile, self.beam, place]
        self.integrals = data.integral[profile, self.beam, place]
        self.data, self.profile = data, profile
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
            covariance = dense(self.data, beam, n, self.profile)
            out[first:last, first:last] = turn @ covariance @ turn.T
        return out


def taken(data, profiles):
    """Return a copy of some profiles."""
    return data._replace(**{name: getattr(data, name)[profiles] for name in data._fields[:4]})


def case(profiles=3, relative=0.01):
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), relative, profiles, additive=0.002)
    return net, *condensed(net, power, variance)


def prior_precision(net, deviation):
    (covariance,) = 0.3**2 * _changing_field.correlations(net.crossing, (500.0,))
    inverse = np.linalg.inv(covariance + deviation**2 * np.eye(net.crossings))
    sums = inverse.sum(axis=0)
    return inverse - np.outer(sums, sums) / sums.sum()


@pytest.mark.parametrize("deviation", [np.inf, 0.05])
def test_solution_agrees_with_least_squares(deviation):
    net, layout, data = case()
    precision = np.zeros((net.crossings, net.crossings))
    if np.isfinite(deviation):
        precision = prior_precision(net, deviation)
    result = _beam_fit.fit_beams(data, precision)
    assert np.all(result.settled)
    chi_square, freedom = _beam_fit.compare(data, result.linear, result.logarithm, data.reach)
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
        # The fit adds a hundredth of information on the level.
        np.testing.assert_allclose(best.x[net.beams :], result.logarithm[n], atol=2e-3)
        covariance = np.linalg.inv(best.jac.T @ best.jac)[net.beams :, net.beams :]
        np.testing.assert_allclose(np.diag(covariance), np.diag(result.covariance[n]), rtol=0.02)
        if not np.isfinite(deviation):
            assert 2 * best.cost == pytest.approx(chi_square[n, 0], rel=0.02)
    assert freedom[0, 0] == layout.passages.beam.size - net.beams - net.crossings


def test_standard_errors_are_the_scatter_of_solutions():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.005, 400, additive=5e-4)
    _, data = condensed(net, power, variance)
    result = _beam_fit.fit_beams(data, np.zeros((net.crossings, net.crossings)))
    truth = np.log(at_crossings(net, homogeneous()))
    errors = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    score = (result.logarithm - truth) / errors
    np.testing.assert_allclose(score[:, net.near_crossing].std(axis=0), 1.0, atol=0.15)
    chi_square, freedom = _beam_fit.compare(data, result.linear, result.logarithm, data.reach)
    assert np.mean(chi_square[:, 0] / freedom[:, 0]) == pytest.approx(1.0, abs=0.15)


def test_solution_does_not_depend_on_the_other_profiles():
    net, _, data = case(7)
    precision = prior_precision(net, 0.05)
    whole = _beam_fit.fit_beams(data, precision)
    for selected in ([0], [3, 4], [6, 1]):
        chunk = _beam_fit.fit_beams(taken(data, selected), precision)
        np.testing.assert_allclose(chunk.logarithm, whole.logarithm[selected], rtol=1e-9)
        np.testing.assert_allclose(chunk.covariance, whole.covariance[selected], rtol=1e-7)


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_a_beam_with_singular_covariance_is_left_out(bad):
    net, _, data = case(3)
    without = taken(data, [0, 1, 2])
    without.reach[1, 0] = 0
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, gradient), 0.01, 3, additive=0.002)
    variance = np.broadcast_to(variance, power.shape).copy()
    variance[1, 0] = bad
    _, damaged = condensed(net, power, variance)
    assert damaged.reach[1, 0] == 0
    result, expected = (
        _beam_fit.fit_beams(entry, prior_precision(net, 0.1)) for entry in (damaged, without)
    )
    np.testing.assert_allclose(result.logarithm, expected.logarithm, rtol=1e-9)
    np.testing.assert_allclose(result.covariance, expected.covariance, rtol=1e-7)


def test_the_information_of_a_shorter_beam_is_that_of_its_passages():
    """A passage that is not used only hides the constant behind the last one in use."""
    net, _, data = case(1)
    result = _beam_fit.fit_beams(data, prior_precision(net, 0.1))
    shorter = taken(data, [0])
    shorter.reach[0, 0] -= 1
    reach = shorter.reach.copy()
    constants = result.constants.copy()
    last = data.integral[0, 0, reach[0, 0] - 1]
    constants[0, 0] = np.log(np.exp(constants[0, 0]) + last)
    shorter.integral[0, 0, reach[0, 0] - 1 :] = 0.0
    ours = _beam_fit.linearise(data, result.constants, reach)
    alone = _beam_fit.linearise(shorter, constants, shorter.reach)
    np.testing.assert_allclose(ours.information, alone.information, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(ours.value, alone.value, rtol=1e-9)


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
    assert mean_depth(np.array(reach, dtype=np.intp)) == depth
