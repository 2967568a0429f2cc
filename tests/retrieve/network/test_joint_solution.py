"""Joint solution of a network: its steps against numpy, scipy and finite differences."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
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
    _fit_layout,
    _joint_solution,
)
from lidarops.retrieve.network.thresholds import THRESHOLDS

# Linear algebra -----------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 30), st.integers(0, 2**31))
def test_cholesky_agrees_with_numpy(size, seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((size, size + 3))
    matrix, side = root @ root.T, rng.standard_normal(size)
    factor, solution = matrix.copy(), side.copy()
    assert _joint_solution.factorise(factor, size)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-8, atol=1e-10)
    _joint_solution.substitute_factorised(factor, size, solution)
    np.testing.assert_allclose(matrix @ solution, side, atol=1e-6)


def test_a_singular_matrix_is_detected():
    assert not _joint_solution.factorise(np.ones((3, 3)), 3)
    assert not _joint_solution.factorise(np.full((2, 2), np.nan), 2)
    assert not _joint_solution.factorise(-np.eye(2), 2)


# Values at crossings and integrals between them ------------------------------------------------


def condensed(net, power, variance, exponent=1.0, bins=7, step=5.0):
    r = grid(net, step)
    layout = _fit_layout.lay_out_fits(
        net, np.tile(r, (net.beams, 1)), None, np.full(net.beams, 100.0), bins
    )
    data = _condensed_signals.condense(
        np.atleast_3d(power).reshape(-1, net.beams, r.size), variance[np.newaxis],
        np.zeros(power.size // (net.beams * r.size), dtype=np.intp),
        np.full(net.beams, exponent), layout, screened=False,
    )  # fmt: skip
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
    problem = _empirical_prior._Problem(
        data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing
    )
    return net, layout, data, problem


@pytest.mark.parametrize("deviation", [np.inf, 0.05])
def test_solution_agrees_with_least_squares(deviation):
    net, layout, data, problem = case()
    result = problem.solve(deviation, 60)
    assert np.all(result.status == _joint_solution.SOLVED)
    for n in range(3):
        oracle = Oracle(layout, data, n, net)
        root = np.linalg.cholesky(oracle.covariance(problem.constants[n]))
        prior = np.zeros((0, net.crossings))
        if np.isfinite(deviation):
            precision, _ = _empirical_prior._free_level(problem.gradient, deviation)
            values, vectors = np.linalg.eigh(precision)
            prior = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T

        def objective(x, oracle=oracle, root=root, prior=prior):
            gap = oracle.residual(x[: net.beams], x[net.beams :])
            return np.concatenate([np.linalg.solve(root, gap), prior @ x[net.beams :]])

        start = np.concatenate([problem.constants[n] + 0.05, result.logarithm[n] - 0.02])
        best = optimize.least_squares(objective, start, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        # Without prior, the kernel adds a hundredth of information on the level.
        bound = 1e-6 if np.isfinite(deviation) else 2e-3
        np.testing.assert_allclose(best.x[net.beams :], result.logarithm[n], atol=bound)
        covariance = np.linalg.inv(best.jac.T @ best.jac)[net.beams :, net.beams :]
        np.testing.assert_allclose(np.diag(covariance), result.prior_true_variance[n], rtol=0.02)
        if np.isfinite(deviation):
            # A field that deviates by twice the standard deviation of the prior.
            doubt = covariance @ precision @ covariance
            stated = np.diag(covariance + 3.0 * doubt)
            np.testing.assert_allclose(stated, result.variance[n], rtol=0.02)
            # Shifts of the solution by fields that the prior excludes.
            shift = problem.bends @ precision @ covariance
            np.testing.assert_allclose(
                np.sum(shift**2, axis=0), result.excluded_variance[n], rtol=0.02
            )
            assert 2 * best.cost == pytest.approx(result.prior_chi_square[n], rel=1e-5)
        else:
            np.testing.assert_array_equal(result.variance[n], result.prior_true_variance[n])
            np.testing.assert_array_equal(result.excluded_variance[n], 0.0)
            assert 2 * best.cost == pytest.approx(result.chi_square[n], rel=0.02)
    assert result.degrees_of_freedom[0] == layout.passages.beam.size - net.beams - net.crossings


def test_contradictory_beams_are_detected_when_their_constants_diverge():
    """Without prior, the constant of an outlying beam diverges; its equations become singular."""
    _, layout, data, problem = case(2)
    data.log_value[0, layout.first_passage[0] + 1] -= 3.0
    result = problem.solve(np.inf, 60)
    assert np.isnan(result.chi_square[0])
    assert result.prior_chi_square[0] > 50.0 * result.prior_degrees_of_freedom[0]
    assert result.prior_chi_square[1] == result.chi_square[1]


def test_likelihood_agrees_with_the_dense_linear_model():
    net, layout, data, problem = case(1)
    problem.solve(0.05, 60)
    fixed = problem.constants.copy()
    oracle = Oracle(layout, data, 0, net)
    noise = oracle.covariance(fixed[0])
    weight = np.exp(fixed[0][oracle.beam]) + oracle.beyond()
    design = np.zeros((oracle.size, net.beams + 1))
    design[np.arange(oracle.size), oracle.beam] = np.exp(fixed[0][oracle.beam]) / weight
    design[:, -1] = 1.0
    target = oracle.values - np.log(weight)
    choose = np.eye(net.crossings)[oracle.crossing]

    def dense(deviation):
        field = THRESHOLDS.gradient**2 * problem.gradient + deviation**2 * np.eye(net.crossings)
        total = noise + choose @ field @ choose.T
        inverse = np.linalg.inv(total)
        information = design.T @ inverse @ design
        rest = target - design @ np.linalg.solve(information, design.T @ inverse @ target)
        return (
            np.linalg.slogdet(total)[1] + np.linalg.slogdet(information)[1] + rest @ inverse @ rest
        )

    def measured(deviation):
        problem.constants[:] = fixed
        problem.solve(deviation, 1)
        return problem.likelihood

    for deviation in (0.01, 0.1, 0.5):
        difference = dense(deviation) - dense(0.05)
        assert measured(deviation) - measured(0.05) == pytest.approx(difference, abs=1e-4)


def test_standard_errors_are_the_scatter_of_solutions():
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, homogeneous()), 0.005, 400, additive=5e-4)
    layout, data = condensed(net, power, variance)
    problem = _empirical_prior._Problem(
        data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing
    )
    result = problem.solve(np.inf, 30)
    truth = np.log(at_crossings(net, homogeneous()))
    score = (result.logarithm - truth) / np.sqrt(result.variance)
    np.testing.assert_allclose(score[:, net.near_crossing].std(axis=0), 1.0, atol=0.15)
    assert np.mean(result.chi_square / result.degrees_of_freedom) == pytest.approx(1.0, abs=0.15)


def test_solution_does_not_depend_on_the_other_profiles():
    _, layout, data, problem = case(7)
    exponent, position = np.ones(6), problem_position()
    whole = problem.solve(0.05, 10)
    for selected in ([0], [3, 4], [6, 1]):
        chunk = _empirical_prior._Problem(
            data.take(np.array(selected)), layout, layout.passages.crossing, exponent, position
        ).solve(0.05, 10)
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
    problem = _empirical_prior._Problem(
        data, layout, layout.passages.crossing, np.ones(net.beams), net.crossing
    )
    seen = np.zeros(net.crossings, dtype=bool)
    for beam in (1, 2, 3, 5):
        seen[net.on_beam(beam)[0]] = True
    result = problem.solve(0.05, 10)
    assert np.array_equal(np.isfinite(result.logarithm[0]), seen)
    np.testing.assert_allclose(np.exp(result.logarithm[0, seen]), 2e-3, rtol=0.02)


@pytest.mark.parametrize("deviation", [np.inf, 0.1])
@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_a_beam_with_singular_covariance_is_left_out(deviation, bad):
    _, layout, data, problem = case(3)
    clean = problem.afresh(deviation)
    without = data.take(np.arange(3))
    without.usable[1, : layout.first_passage[1]] = 0
    data.covariance[1, : layout.offset[1]] = bad
    problem_arguments = (layout, layout.passages.crossing, np.ones(6), problem_position())
    result, expected = (
        _empirical_prior._Problem(entry, *problem_arguments).afresh(deviation)
        for entry in (data, without)
    )
    assert np.all(result.status == _joint_solution.SOLVED)
    np.testing.assert_array_equal(result.degrees_of_freedom, expected.degrees_of_freedom)
    assert np.array_equal(np.isfinite(result.logarithm), np.isfinite(expected.logarithm))
    np.testing.assert_allclose(result.logarithm, expected.logarithm, rtol=1e-4)
    np.testing.assert_allclose(result.variance, expected.variance, rtol=1e-2)
    for entry in ("logarithm", "variance", "chi_square", "prior_chi_square"):
        selected, others = getattr(result, entry)[[0, 2]], getattr(clean, entry)[[0, 2]]
        np.testing.assert_array_equal(selected, others)


def test_a_profile_with_singular_covariances_is_not_determined():
    _, layout, data, _ = case(3)
    data.covariance[1] = 0.0
    problem_arguments = (layout, layout.passages.crossing, np.ones(6), problem_position())
    for deviation in (np.inf, 0.1):
        result = _empirical_prior._Problem(data, *problem_arguments).afresh(deviation)
        assert result.status.tolist() == [
            _joint_solution.SOLVED, _joint_solution.UNDETERMINED, _joint_solution.SOLVED
        ]  # fmt: skip
        assert np.isnan(result.logarithm[1]).all()


def test_prior_with_a_single_crossing_is_finite():
    precision, norm = _empirical_prior._free_level(
        _empirical_prior._gradient_covariance(np.zeros((1, 3))), 0.1
    )
    assert np.isfinite(precision).all()
    assert np.isfinite(norm)


def steep(x, y, z):
    """Return thin air that decreases with height by more than the gradient of the prior."""
    return 1e-5 * np.exp(-(z - 500.0) / 250.0 + 0.0 * x)


@pytest.mark.parametrize(("field", "detected"), [(homogeneous(1e-3), False), (steep, True)])
def test_the_mean_of_profiles_detects_a_field_that_the_prior_excludes(field, detected):
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field), 0.15, 50, additive=0.0)
    layout, data = condensed(net, power, variance)
    problem_arguments = (layout, layout.passages.crossing, np.ones(net.beams), net.crossing)
    problem, mean = (
        _empirical_prior._Problem(data, *problem_arguments),
        _empirical_prior._mean_problem(data, *problem_arguments),
    )
    sharp = problem.afresh(THRESHOLDS.deviations[0])
    # Single profiles fit, even in the steep field.
    assert np.median(sharp.prior_chi_square / sharp.prior_degrees_of_freedom) < 2.0
    assert (
        _empirical_prior._mean_improbable(_empirical_prior._solve_mean(mean, sharp, 1.0))
        == detected
    )


def uneven(net):
    """Return a field with a different bump at every crossing."""
    size = 0.2 * np.sin(7.0 * np.arange(net.crossings))

    def field(x, y, z):
        separate = [(x - v[0]) ** 2 + (z - v[2]) ** 2 for v in net.crossing]
        bumps = [u * np.exp(-a / (2.0 * 40.0**2)) for u, a in zip(size, separate, strict=True)]
        return 2e-3 * np.exp(np.sum(bumps, axis=0))

    return field


def fifty(field, relative, lost=0.0):
    """Return 50 profiles, some with missing beams, and the other arguments of a problem."""
    net = three_by_two()
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, field(net)), relative, 50, additive=0.0)
    gone = np.random.default_rng(2).random((50, net.beams, 1)) < lost
    layout, data = condensed(net, np.where(gone, np.nan, power), variance)
    return data, (layout, layout.passages.crossing, np.ones(net.beams), net.crossing)


def test_the_mean_requires_the_deviation_of_an_uneven_field():
    data, problem_arguments = fifty(uneven, 0.05)
    least = _empirical_prior._least_deviation(
        _empirical_prior._mean_problem(data, *problem_arguments), 1.0
    )
    assert 0.03 < least < 0.4
    problem = _empirical_prior._Problem(data, *problem_arguments)
    assert _empirical_prior._likeliest_deviation(problem, 1.0, least).deviation[0] >= least


class Unsettled(_empirical_prior._Problem):
    """A mean whose solution without prior, or any, still moves in the last pass."""

    always = False

    def afresh(self, deviation, strength=1.0):
        solution = super().afresh(deviation, strength)
        if not (self.always or np.isinf(deviation)):
            return solution
        return replace(solution, status=np.full_like(solution.status, _joint_solution.UNSETTLED))


def test_a_prior_is_rejected_if_the_mean_does_not_converge():
    data, problem_arguments = fifty(lambda _: homogeneous(1e-3), 0.1)
    mean = Unsettled(_empirical_prior._mean_profile(data, problem_arguments[0]), *problem_arguments)
    result = _empirical_prior._Problem(data, *problem_arguments).afresh(0.1)
    assert not _empirical_prior._mean_improbable(_empirical_prior._solve_mean(mean, result, 1.0))
    mean.always = True
    assert _empirical_prior._mean_improbable(_empirical_prior._solve_mean(mean, result, 1.0))
    stated = _empirical_prior._solve_block(
        _empirical_prior._Problem(data, *problem_arguments), lambda: mean
    )
    assert np.all(np.isinf(stated.deviation))


def test_an_undetermined_mean_contradicts_no_prior():
    data, problem_arguments = fifty(lambda _: homogeneous(1e-3), 0.1)
    mean = _empirical_prior._Problem(
        _empirical_prior._mean_profile(data, problem_arguments[0]), *problem_arguments
    )
    mean.data.log_value[:] = np.nan
    assert mean.afresh(np.inf).status[0] == _joint_solution.UNDETERMINED
    stated = _empirical_prior._solve_block(
        _empirical_prior._Problem(data, *problem_arguments), lambda: mean
    )
    unasked = _empirical_prior._solve_block(
        _empirical_prior._Problem(data, *problem_arguments), lambda: None
    )
    assert np.isfinite(stated.deviation[0])
    np.testing.assert_array_equal(stated.logarithm, unasked.logarithm)
    # The errors allow a deviation as in the weakest prior, and curvature.
    more = unasked.variance - unasked.prior_true_variance
    wide = (
        unasked.prior_true_variance
        + (4.0**2 - 1.0) / (2.0**2 - 1.0) * more
        + unasked.excluded_variance
    )
    np.testing.assert_allclose(stated.variance, wide, rtol=1e-12)


def test_undetermined_crossings_have_errors_of_the_weakest_prior(monkeypatch):
    data, problem_arguments = fifty(lambda _: homogeneous(1e-3), 0.1)
    result = _empirical_prior._Problem(data, *problem_arguments).afresh(0.1)
    mean = _empirical_prior._mean_problem(data, *problem_arguments)
    stated, free = mean.afresh(0.1), mean.afresh(np.inf)
    free.variance[0, 2] = np.nan
    for other in ("noise_bias_variance", "excluded_field_variance"):
        monkeypatch.setattr(_empirical_prior._block_errors, other, lambda *_: 0.0)
    factor = np.ones(result.variance.shape[1])
    for strength, required in ((1.0, 5.0), (2.0, 1.0), (4.0, 1.0)):
        factor[2] = required
        solution = _empirical_prior._add_block_errors(result, strength, stated, free)
        expected = result.prior_true_variance + factor * (
            result.variance - result.prior_true_variance
        )
        np.testing.assert_allclose(solution.variance, expected, rtol=1e-12)


def can_test(freedoms, whole=None):
    """Return whether beams can test a prior.

    `freedoms` are the degrees of freedom of profiles, `whole` those of their mean with its errors.
    The last of four crossings has no beam."""
    data = SimpleNamespace(usable=np.array([[1, 1, 1, 0]], dtype=np.uint8))
    problem = SimpleNamespace(geometry=(None, None, np.arange(4)), data=data)
    status = np.full(len(freedoms), _joint_solution.SOLVED)
    alone = SimpleNamespace(status=status, degrees_of_freedom=np.array(freedoms, dtype=float))
    if whole is None:
        return _empirical_prior._can_test_prior(problem, alone, None)
    freedom, errors = whole
    variance = np.array([[*np.square(errors), np.nan]])
    mean = SimpleNamespace(degrees_of_freedom=np.array([float(freedom)]), variance=variance)
    return _empirical_prior._can_test_prior(problem, alone, mean)


@pytest.mark.parametrize(
    ("whole", "expected"),
    [((0, [0.1, 0.5, 0.9]), True), ((0, [0.1, 0.5, 1.1]), False), ((0, [0.1, np.nan, 0.1]), False),
     ((1, [0.1, 0.5, 1.1]), True), ((-1, [0.1, 0.1, 0.1]), False)],
)  # fmt: skip
def test_equal_equations_and_unknowns_test_a_prior_if_all_crossings_are_determined(whole, expected):
    assert can_test([-1.0] * 10, whole) == expected


@pytest.mark.parametrize(("share", "expected"), [(0.7, True), (0.8, False)])
def test_a_quarter_of_the_profiles_is_enough_to_test_a_prior(share, expected):
    number = round(50 * share)
    assert can_test([-1.0] * number + [2.0] * (50 - number)) == expected
    mean = (-1, [0.1, 0.1, 0.1])
    assert can_test([-1.0] * number + [2.0] * (50 - number), mean) == expected


def test_a_mean_that_does_not_converge_requires_no_deviation(monkeypatch):
    data, problem_arguments = fifty(lambda _: homogeneous(2e-3), 0.1)
    pooled = _empirical_prior._mean_profile(fifty(uneven, 0.1)[0], problem_arguments[0])
    for other in ("_mean_improbable", "_off_mean_solution"):
        monkeypatch.setattr(_empirical_prior, other, lambda *_: False)
    requested = [
        _empirical_prior._solve_block(
            _empirical_prior._Problem(data, *problem_arguments), lambda mean=mean: mean
        ).deviation[0]
        for mean in (
            Unsettled(pooled, *problem_arguments),
            _empirical_prior._Problem(pooled, *problem_arguments),
        )
    ]
    assert requested[0] < requested[1] < np.inf


# Profiles that lack beams --------------------------------------------------------------------


def test_the_mean_of_profiles_is_taken_beam_by_beam():
    data, (layout, *rest) = fifty(lambda _: homogeneous(), 0.05, lost=0.25)
    assert data.usable.all(axis=1).sum() < 20
    mean = _empirical_prior._mean_profile(data, layout)
    assert mean.usable.all()
    for beam in range(6):
        selected = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
        packed = slice(layout.offset[beam], layout.offset[beam + 1])
        seen = data.usable[:, selected].all(axis=1)
        np.testing.assert_allclose(
            mean.log_value[0, selected], data.log_value[seen, selected].mean(axis=0)
        )
        np.testing.assert_allclose(
            mean.integral[0, selected], data.integral[seen, selected].mean(axis=0)
        )
        expected = data.covariance[seen, packed].mean(axis=0) / seen.sum()
        np.testing.assert_allclose(mean.covariance[0, packed], expected)
    whole = _empirical_prior._Problem(mean, layout, *rest).afresh(np.inf)
    assert whole.status[0] == _joint_solution.SOLVED


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12, 20.0])
def test_a_mean_leaves_out_a_beam_that_is_far_noisier_than_most(bad):
    data, (layout, *_) = fifty(lambda _: homogeneous(), 0.05)
    quiet = data.take(np.arange(50))
    quiet.usable[7, : layout.first_passage[1]] = 0
    expected = _empirical_prior._mean_profile(quiet, layout)
    # Only the variance of the first integral of the beam.
    count = layout.first_passage[1]
    data.covariance[7, 2 * count * count] *= bad
    result = _empirical_prior._mean_profile(data, layout)
    for name in ("log_value", "integral", "covariance", "usable", "slope"):
        np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))


def test_a_mean_lacks_a_beam_with_too_few_known_profiles():
    data, (layout, *_) = fifty(lambda _: homogeneous(), 0.05)
    data.covariance[7:, : layout.offset[1]] = np.nan
    result = _empirical_prior._mean_profile(data, layout)
    assert not result.usable[0, : layout.first_passage[1]].any()
    assert result.usable[0, layout.first_passage[1] :].all()


def test_no_mean_without_usable_profiles():
    data, (layout, *_) = fifty(lambda _: homogeneous(), 0.05)
    data.usable[7:] = 0
    assert _empirical_prior._mean_profile(data, layout) is None
    # A value at the first crossing of a beam alone does not count.
    data, _ = fifty(lambda _: homogeneous(), 0.05)
    data.usable[:] = 0
    data.usable[:, layout.first_passage[:-1]] = 1
    assert _empirical_prior._mean_profile(data, layout) is None


@pytest.mark.parametrize(
    ("reach", "depth"),
    [
        ([3] * 50, 3),
        ([3] * 45 + [2] * 5, 3),
        ([3] * 9 + [2] * 41, 2),
        ([3] * 7, 0),
        ([1] * 50, 0),
        ([], 0),
    ],
)
def test_a_mean_extends_to_the_passage_with_most_values(reach, depth):
    assert _empirical_prior._mean_depth(np.array(reach, dtype=np.intp)) == depth
