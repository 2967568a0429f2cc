"""Empirical prior of the extinction field of a network.

Along a beam, a gradient of extinction looks like attenuation, and only weak information separates
them. The prior therefore limits a gradient over the network to tens of percent; this limit is
fixed, because the likelihood cannot give it. Deviations of single crossings are visible to the
beams that cross there: their standard deviation is the most likely one for all profiles of a
block, and at least the one that their mean requires. The level of a profile is free. One field is
no sample of many, so errors are stated for a field that deviates twice as much
(`lidarops.retrieve.network._joint_solution`). Where the beams are too few to test the prior, the
weakest prior is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.retrieve.network import _block_errors, _joint_solution
from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.uint8]

_UNDETERMINED_COST: Final = 1e3
"""-2 ln likelihood of a profile that is not determined."""
_FIRST_PASSES: Final = 12
_NEXT_PASSES: Final = 4
_LAST_PASSES: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class PriorSolution:
    """Logarithms of extinction at the measured crossings."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1."""
    variance: Array
    """(profile, crossing), including the doubt in the prior."""
    prior_true_variance: Array
    """(profile, crossing) variance if the prior is true."""
    excluded_variance: Array
    """(profile, crossing) variance from fields that only the prior excludes."""
    chi_square: Array
    """(profile,) of the beams alone, without the prior."""
    degrees_of_freedom: Array
    """(profile,) of that."""
    prior_chi_square: Array
    """(profile,) of beams and prior together."""
    prior_degrees_of_freedom: Array
    """(profile,) of that."""
    deviation: Array
    """(profile,) standard deviation of the prior; inf without one."""
    strength: Array
    """(profile,) factor of that standard deviation and of the gradient."""
    status: Codes
    """(profile,) status code of `lidarops.retrieve.network._joint_solution`."""
    left_out: Codes
    """(profile, beam) 1 where a beam was left out: its covariance is singular or missing."""
    prior_contradicted: Booleans
    """(profile,) True where the beams contradict the prior but cannot replace it."""


class _Problem:
    """Condensed profiles, and the constants of their beams where a solution starts."""

    def __init__(
        self,
        data: CondensedSignals,
        layout: FitLayout,
        crossing: Indices,
        exponent: Array,
        position: Array,
    ) -> None:
        self.data = data
        self.crossings = position.shape[0]
        self.gradient = _gradient_covariance(position)
        self.bends = _block_errors.bent_fields(position)
        self.geometry = (layout.first_passage, layout.offset, crossing)
        self.constants = np.zeros((data.log_value.shape[0], exponent.size))
        self.likelihood = 0.0
        _joint_solution.start_constants(
            data.integral, data.usable, data.slope, segment_lengths(layout), exponent,
            layout.first_passage, self.constants,
        )  # fmt: skip
        self.start = self.constants.copy()

    def afresh(self, deviation: float, strength: float = 1.0) -> PriorSolution:
        """Solve all profiles from the first start constants."""
        self.constants[:] = self.start
        return self.solve(deviation, 2 * _FIRST_PASSES, strength)

    def solve(self, deviation: float, passes: int, strength: float = 1.0) -> PriorSolution:
        """Solve all profiles from the present constants, and update these."""
        shape = (self.constants.shape[0], self.crossings)
        logarithm, variance = np.full(shape, np.nan), np.full(shape, np.nan)
        prior_true_variance, excluded_variance = np.full(shape, np.nan), np.full(shape, np.nan)
        summary, status = (
            np.full((shape[0], _joint_solution.COLUMNS), np.nan),
            np.zeros(shape[0], dtype=np.uint8),
        )
        left_out = np.zeros(self.constants.shape, dtype=np.uint8)
        precision, norm, without_prior = _precision(self.gradient, deviation, strength)
        data = self.data
        _joint_solution.solve_joint(
            data.log_value, data.integral, data.usable, data.covariance, self.geometry,
            precision, self.bends, norm, without_prior, passes, self.constants, logarithm, variance,
            prior_true_variance, excluded_variance, summary, status, left_out,
        )  # fmt: skip
        determined = status != _joint_solution.UNDETERMINED
        # A prior must not become likelier by leaving a profile undetermined.
        terms = np.where(determined, summary[:, _joint_solution.LIKELIHOOD], _UNDETERMINED_COST)
        self.likelihood = float(np.sum(terms))
        return PriorSolution(
            logarithm, variance, prior_true_variance, excluded_variance, summary[:, 0],
            summary[:, 1], summary[:, 2], summary[:, 3], np.full(shape[0], strength * deviation),
            np.full(shape[0], strength), status, left_out, np.zeros(shape[0], dtype=np.bool_),
        )  # fmt: skip


def segment_lengths(layout: FitLayout) -> Array:
    """Return the distance in m from each passage to the next on its beam; 0 for the last."""
    out = np.zeros(layout.passages.range.size)
    same = layout.passages.beam[:-1] == layout.passages.beam[1:]
    out[:-1][same] = np.diff(layout.passages.range)[same]
    return out


def solve_without_prior(
    data: CondensedSignals, layout: FitLayout, crossing: Indices, exponent: Array, position: Array
) -> PriorSolution:
    """Solve each profile alone. Arguments are those of `solve_blocks`."""
    problem = _Problem(data, layout, crossing, exponent, position)
    return problem.solve(np.inf, 2 * _FIRST_PASSES)


def solve_blocks(
    data: CondensedSignals,
    layout: FitLayout,
    crossing: Indices,
    exponent: Array,
    position: Array,
    block: Indices,
) -> PriorSolution:
    """Solve the profiles of each block with its most likely prior.

    Parameters
    ----------
    data : Condensed
    layout : FitLayout
    crossing : (passage,) intp
        Number of the measured crossing at each passage.
    exponent : (beam,) float64
    position : (crossing, 3) float64
        m, of the measured crossings.
    block : (profile,) intp
    """
    shape = (block.size, position.shape[0])

    def missing(*size: int) -> Array:
        return np.full(size, np.nan)

    count = block.size
    out = PriorSolution(
        missing(*shape), missing(*shape), missing(*shape), missing(*shape), missing(count),
        missing(count), missing(count), missing(count), missing(count), missing(count),
        np.full(count, _joint_solution.UNDETERMINED, dtype=np.uint8),
        np.zeros((count, exponent.size), dtype=np.uint8), np.zeros(count, dtype=np.bool_),
    )  # fmt: skip
    for number in np.unique(block):
        profiles = np.flatnonzero(block == number)
        block_data = data.take(profiles)
        solution = _solve_block(
            _Problem(block_data, layout, crossing, exponent, position),
            partial(_mean_problem, block_data, layout, crossing, exponent, position),
        )
        for field in fields(PriorSolution):
            getattr(out, field.name)[profiles] = getattr(solution, field.name)
    return out


def _mean_problem(
    data: CondensedSignals, layout: FitLayout, crossing: Indices, exponent: Array, position: Array
) -> _Problem | None:
    """Return the mean of profiles as a problem; None where too few share a beam."""
    mean = _mean_profile(data, layout)
    return None if mean is None else _Problem(mean, layout, crossing, exponent, position)


def _mean_profile(data: CondensedSignals, layout: FitLayout) -> CondensedSignals | None:
    """Return the mean of profiles as one profile; None where too few have any beam.

    The mean is taken beam by beam, up to the passage that brings most values into it, because few
    profiles may have all beams. Values and integrals are relative to the first value of each
    beam, because laser energy changes from profile to profile.
    """
    usable = np.zeros((1, data.usable.shape[1]), dtype=np.uint8)
    log_value, integral = np.full(usable.shape, np.nan), np.zeros(usable.shape)
    covariance = np.zeros((1, data.covariance.shape[1]))
    slope = np.full((*usable.shape, 2), np.nan)
    for beam in range(layout.first_passage.size - 1):
        on_beam = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
        packed = slice(layout.offset[beam], layout.offset[beam + 1])
        reach = np.logical_and.accumulate(data.usable[:, on_beam] == 1, axis=1).sum(axis=1)
        depth = _mean_depth(reach)
        if depth == 0:
            continue
        used = np.flatnonzero(reach >= depth)
        used = used[_not_noisy(data.covariance[used, packed], on_beam.stop - on_beam.start, depth)]
        number = used.size
        if number < THRESHOLDS.fewest_profiles:
            continue
        usable[0, on_beam][:depth] = 1
        log_value[0, on_beam] = data.log_value[used, on_beam].sum(axis=0) / number
        integral[0, on_beam] = data.integral[used, on_beam].sum(axis=0) / number
        covariance[0, packed] = data.covariance[used, packed].sum(axis=0) / number / number
        slope[0, on_beam] = data.slope[used, on_beam].sum(axis=0) / number
        slope[0, on_beam, 1] /= number
    if not usable.any():
        return None
    return CondensedSignals(
        log_value, integral, usable, covariance, slope, data.status[:1], data.bridged[:1]
    )


def _not_noisy(covariance: Array, passages: int, depth: int) -> Booleans:
    """Return (profile,) where a beam is not far noisier than in most profiles.

    One bin of huge or unknown variance in one profile would otherwise remove a beam from the
    mean, which then could not contradict any prior.

    Parameters
    ----------
    covariance : (profile, packed) float64
        Of a beam: its log values, then its integrals.
    passages, depth : int
        Number of passages of the beam, and number of those in the mean.
    """
    quantities = 2 * passages - 1
    columns = np.r_[:depth, passages : passages + depth - 1]
    variances = covariance[:, columns * (quantities + 1)]
    known = np.isfinite(variances)
    typical = np.median(np.where(known, variances, np.inf), axis=0)
    return np.asarray((known & (variances <= THRESHOLDS.noisy_profile * typical)).all(axis=1))


def _mean_depth(reach: Indices) -> int:
    """Return the number of passages of a beam in the mean; 0 where too few profiles have two.

    Parameters
    ----------
    reach : (profile,) intp
        Number of usable passages of the beam in each profile.
    """
    best, best_count = 0, 0
    for depth in range(2, int(reach.max(initial=0)) + 1):
        number = int(np.sum(reach >= depth))
        # At the first passage all values are zero.
        if number >= THRESHOLDS.fewest_profiles and (depth - 1) * number > best_count:
            best, best_count = depth, (depth - 1) * number
    return best


def _solve_block(problem: _Problem, mean_problem: Callable[[], _Problem | None]) -> PriorSolution:
    """Solve a block with the strongest prior that neither profiles nor their mean contradict."""
    without_prior = problem.afresh(np.inf)
    # Profiles that determine the crossings well alone need no mean.
    with np.errstate(invalid="ignore"):
        mean = (
            None
            if np.all(without_prior.variance < THRESHOLDS.well_determined**2)
            else mean_problem()
        )
    mean_without_prior = None if mean is None else mean.afresh(np.inf)
    testable = _can_test_prior(problem, without_prior, mean_without_prior)
    strengths = THRESHOLDS.strengths if testable else THRESHOLDS.strengths[-1:]
    if mean is None or mean_without_prior is None:
        return _strongest_prior(problem, without_prior, strengths)[0]
    result = _solve_with_mean(problem, without_prior, mean, mean_without_prior, strengths)
    prior_contradicted = not testable and _mean_improbable(mean.afresh(THRESHOLDS.deviations[0]))
    return replace(
        result, prior_contradicted=np.full_like(result.prior_contradicted, prior_contradicted)
    )


def _solve_with_mean(
    problem: _Problem,
    without_prior: PriorSolution,
    mean: _Problem,
    mean_without_prior: PriorSolution,
    strengths: tuple[float, ...],
) -> PriorSolution:
    """Solve a block that has a mean with the strongest prior that is not contradicted."""
    if mean_without_prior.status[0] == _joint_solution.UNDETERMINED:
        # An undetermined mean contradicts no prior.
        result, strength = _strongest_prior(problem, without_prior, strengths)
        return _add_block_errors(
            result, strength, _solve_mean(mean, result, strength), mean_without_prior
        )
    converged = bool(mean_without_prior.status[0] == _joint_solution.SOLVED)
    for strength in strengths:
        smallest = _least_deviation(mean, strength) if converged else 0.0
        result = _likeliest_deviation(problem, strength, smallest)
        if _contradicted(result, without_prior) or _off_mean_solution(result, mean_without_prior):
            continue
        mean_with_prior = _solve_mean(mean, result, strength)
        if not _mean_improbable(mean_with_prior):
            return _add_block_errors(result, strength, mean_with_prior, mean_without_prior)
    return _add_block_errors(without_prior, 1.0, mean_without_prior, mean_without_prior)


def _can_test_prior(
    problem: _Problem, without_prior: PriorSolution, mean_without_prior: PriorSolution | None
) -> bool:
    """Return whether the beams can test a prior.

    With fewer equations than unknowns, or as many that leave crossings undetermined, the prior
    decides the rest, and no test covers that: a steep field looks like large deviations about a
    slight gradient.
    """
    known = without_prior.status != _joint_solution.UNDETERMINED
    freedom = 0.0
    if known.any():
        # Some profiles are enough: they share the field with those that lost a beam.
        solved_freedom = without_prior.degrees_of_freedom[known]
        freedom = float(np.quantile(solved_freedom, THRESHOLDS.testing_quantile, method="higher"))
    if mean_without_prior is None:
        return freedom >= 0
    freedom = max(freedom, float(mean_without_prior.degrees_of_freedom[0]))
    crossings = np.unique(problem.geometry[2][(problem.data.usable == 1).any(axis=0)])
    determined = bool(
        np.all(mean_without_prior.variance[0, crossings] < THRESHOLDS.open_in_mean**2)
    )
    return freedom > 0 or (freedom == 0 and determined)


def _strongest_prior(
    problem: _Problem, without_prior: PriorSolution, strengths: tuple[float, ...]
) -> tuple[PriorSolution, float]:
    """Solve with the strongest prior that the profiles do not contradict; return its strength."""
    for strength in strengths:
        result = _likeliest_deviation(problem, strength, 0.0)
        if not _contradicted(result, without_prior):
            return result, strength
    return without_prior, 1.0


def _solve_mean(mean: _Problem, result: PriorSolution, strength: float) -> PriorSolution:
    """Solve the mean of profiles with the prior of the profiles."""
    return mean.afresh(float(result.deviation[0]) / strength, strength)


def _mean_improbable(mean_with_prior: PriorSolution) -> bool:
    """Return whether the mean of profiles contradicts the prior that each of them fits.

    Noise hides the errors of a prior in each profile; their mean has less noise. The test is in
    values along beams; the one of `_off_mean_solution` is in extinction, which thin air does not
    determine.
    """
    if mean_with_prior.status[0] != _joint_solution.SOLVED:
        return True
    square, freedom = (
        float(mean_with_prior.prior_chi_square[0]),
        float(mean_with_prior.prior_degrees_of_freedom[0]),
    )
    if freedom <= 0:
        return False
    return bool(
        special.gammaincc(freedom / 2.0, max(square, 0.0) / 2.0)
        < THRESHOLDS.least_probability_of_mean
    )


def _add_block_errors(
    result: PriorSolution,
    strength: float,
    mean_with_prior: PriorSolution,
    mean_without_prior: PriorSolution,
) -> PriorSolution:
    """Return solutions with the errors that the mean, with and without prior, shows."""
    noise = _block_errors.noise_bias_variance(
        result.logarithm, result.variance, mean_with_prior.logarithm[0]
    )
    field = _block_errors.excluded_field_variance(
        result.excluded_variance,
        mean_with_prior.logarithm[0],
        mean_without_prior.logarithm[0],
        mean_without_prior.variance[0],
    )
    # Where nothing can contradict a prior, the weakest one may be the true one.
    doubt = max(THRESHOLDS.strengths[-1] / strength, THRESHOLDS.doubt)
    untested = (doubt**2 - 1.0) / (THRESHOLDS.doubt**2 - 1.0)
    factor = np.where(np.isfinite(mean_without_prior.variance[0]), 1.0, untested)
    prior = (factor - 1.0) * (result.variance - result.prior_true_variance)
    return replace(result, variance=result.variance + (noise + field + prior))


def _likeliest_deviation(problem: _Problem, strength: float, smallest: float) -> PriorSolution:
    """Solve with the largest deviation that is not much less likely than the likeliest one.

    Where the likelihood does not separate deviations, the weaker prior is used. `smallest` is the
    deviation that the mean of profiles requires.
    """
    costs, constants = _deviation_costs(problem, strength)
    index = int(np.flatnonzero(costs <= costs.min() + THRESHOLDS.likelihood_tolerance)[-1])
    index = max(index, int(np.searchsorted(THRESHOLDS.deviations, smallest)))
    problem.constants[:] = constants[index]
    return problem.solve(THRESHOLDS.deviations[index], _LAST_PASSES, strength)


def _least_deviation(mean: _Problem, strength: float) -> float:
    """Return the smallest deviation that is not much less likely than the likeliest one."""
    costs, _ = _deviation_costs(mean, strength)
    return THRESHOLDS.deviations[
        int(np.flatnonzero(costs <= costs.min() + THRESHOLDS.likelihood_tolerance)[0])
    ]


def _deviation_costs(problem: _Problem, strength: float) -> tuple[Array, list[Array]]:
    """Return -2 ln likelihood of each deviation, and the constants of its solution."""
    problem.constants[:] = problem.start
    problem.solve(THRESHOLDS.deviations[-1], _FIRST_PASSES, strength)
    costs = np.empty(len(THRESHOLDS.deviations))
    constants: list[Array] = []
    for k in range(len(THRESHOLDS.deviations) - 1, -1, -1):
        problem.solve(THRESHOLDS.deviations[k], _NEXT_PASSES, strength)
        costs[k] = problem.likelihood
        constants.insert(0, problem.constants.copy())
    return costs, constants


def _contradicted(result: PriorSolution, without_prior: PriorSolution) -> bool:
    """Return whether solutions with and without the prior differ at a crossing, on average.

    The variance of the difference is the difference of the variances, because one solution uses
    all the information of the other (`hausman1978`). Only crossings that the beams determine well
    can contradict, and only by more than their variance, which is the bias of the solution
    without prior. A difference below half the reported standard error is harmless.
    """
    known = np.isfinite(without_prior.variance) & np.isfinite(result.prior_true_variance)
    known &= (without_prior.status == _joint_solution.SOLVED)[:, np.newaxis]
    number = np.maximum(known.sum(axis=0), 1)
    gap = np.where(known, without_prior.logarithm - result.logarithm, 0.0).sum(axis=0) / number
    free_variance = np.where(known, without_prior.variance, 0.0).sum(axis=0) / number
    prior_variance = np.where(known, result.prior_true_variance, 0.0).sum(axis=0) / number
    allowed = THRESHOLDS.contradiction * np.sqrt(
        np.maximum(free_variance - prior_variance, 0.0) / number
    )
    allowed = np.maximum(allowed, THRESHOLDS.harmless * np.sqrt(prior_variance))
    determined = (free_variance < THRESHOLDS.well_determined**2) & (
        known.sum(axis=0) > THRESHOLDS.determined_share * len(known)
    )
    return bool(np.any(determined & (np.abs(gap) > allowed + free_variance)))


def _off_mean_solution(result: PriorSolution, mean_without_prior: PriorSolution) -> bool:
    """Return whether the average of solutions differs from the solution of the mean.

    In the mean, noise is lower and the prior decides less. All profiles share the errors of a
    prior.
    """
    known = np.isfinite(result.prior_true_variance)
    number = np.maximum(known.sum(axis=0), 1)
    average = np.where(known, result.logarithm, 0.0).sum(axis=0) / number
    stated = np.where(known, result.prior_true_variance, 0.0).sum(axis=0) / number
    determined = mean_without_prior.variance[0] < THRESHOLDS.determined_by_mean**2
    determined &= (known.sum(axis=0) > 0.5 * len(known)) & (
        mean_without_prior.status[0] == _joint_solution.SOLVED
    )
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(stated + mean_without_prior.variance[0])
        differs = (
            np.abs(mean_without_prior.logarithm[0] - average)
            > THRESHOLDS.largest_mean_gap * spread + 0.5 * mean_without_prior.variance[0]
        )
    return bool(np.any(determined & differs))


def _gradient_covariance(position: Array) -> Array:
    """Return the covariance of a linear field of unit variance in any direction."""
    if position.shape[0] == 0:
        return np.zeros((0, 0))
    centred = position - position.mean(axis=0)
    covariance = np.sum(centred[:, np.newaxis, :] * centred[np.newaxis, :, :], axis=2)
    size = float(np.trace(covariance))
    # One crossing has no gradient.
    return np.asarray(covariance * (len(position) / size if size > 0 else 0.0))


def prior_of(position: Array, solution: PriorSolution, profile: int) -> tuple[Array, bool]:
    """Return the precision of the prior of a solved profile, and whether it had none."""
    strength = float(solution.strength[profile])
    deviation = float(solution.deviation[profile]) / strength
    precision, _, without_prior = _precision(_gradient_covariance(position), deviation, strength)
    return precision, without_prior


def _precision(gradient: Array, deviation: float, strength: float) -> tuple[Array, float, bool]:
    """Return the precision of a prior, -ln of its determinant, and whether there is none."""
    if not np.isfinite(deviation):
        return np.zeros_like(gradient), 0.0, True
    return *_free_level(gradient, deviation, strength), False


def _free_level(gradient: Array, deviation: float, strength: float = 1.0) -> tuple[Array, float]:
    """Return the precision of the prior with a free level, and -ln |precision|."""
    covariance = THRESHOLDS.gradient**2 * gradient + deviation**2 * np.eye(len(gradient))
    covariance *= strength**2
    precision = np.linalg.inv(covariance)
    sums = precision.sum(axis=0)
    norm = float(np.linalg.slogdet(covariance)[1] + np.log(sums.sum()))
    return precision - np.outer(sums, sums) / sums.sum(), norm
