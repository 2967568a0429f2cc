r"""Solutions of a block of profiles with an empirical prior of the extinction field.

Along a beam, a gradient of extinction looks like attenuation, and only weak information separates
them. The prior therefore limits a gradient over the network to tens of percent; this limit is
fixed, because the likelihood cannot give it. Deviations of single crossings are visible to the
beams that cross there: their standard deviation is the most likely one for all profiles of a
block. The level of a profile is free. Where the mean of the profiles contradicts the prior, it is
weakened, then dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy import special

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _joint_solution
from lidarops.retrieve.network._condensed_signals import CondensedSignals, FitLayout
from lidarops.retrieve.network.thresholds import THRESHOLDS

_UNDETERMINED_COST: Final = 1e3
"""-2 ln likelihood of a profile that is not determined."""
_FIRST_PASSES: Final = 12
_NEXT_PASSES: Final = 4
_LAST_PASSES: Final = 8
_ALL_PASSES: Final = 24


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior of ln extinction over the crossings, with a free level."""

    deviation: float
    """Standard deviation at single crossings; inf for no prior."""
    strength: float = 1.0
    """Factor of that, and of the standard deviation by a gradient."""

    @property
    def exists(self) -> bool:
        """Whether there is a prior."""
        return bool(np.isfinite(self.deviation))

    def precision(self, position: Array) -> tuple[Array, float]:
        """Return the (crossing, crossing) precision, and -ln of its determinant.

        Parameters
        ----------
        position : (crossing, 3) float64
            m.
        """
        if not self.exists:
            return np.zeros((len(position), len(position))), 0.0
        covariance = THRESHOLDS.gradient**2 * _gradient_covariance(position)
        covariance += self.deviation**2 * np.eye(len(position))
        covariance *= self.strength**2
        precision = np.linalg.inv(covariance)
        sums = precision.sum(axis=0)
        norm = float(np.linalg.slogdet(covariance)[1] + np.log(sums.sum()))
        return precision - np.outer(sums, sums) / sums.sum(), norm


NO_PRIOR: Final = Prior(np.inf)


def _gradient_covariance(position: Array) -> Array:
    """Return the covariance of a linear field of unit variance in any direction."""
    centred = position - position.mean(axis=0)
    covariance = centred @ centred.T
    size = float(np.trace(covariance))
    # One crossing has no gradient.
    return np.asarray(covariance * (len(position) / size if size > 0 else 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Logarithms of extinction at the measured crossings, with one prior for all profiles."""

    prior: Prior
    logarithm: Array
    """(profile, crossing) of extinction in m-1; NaN where undetermined or unseen."""
    variance: Array
    """(profile, crossing) if the prior is true."""
    prior_share: Array
    """(profile, crossing) variance by a field that deviates as the prior states."""
    prior_response: Array
    """(profile, crossing, crossing) shifts of the solution by fields that the prior excludes: C P,
    with the covariance C of the solution and the precision P of the prior."""
    carried: Array
    """(profile, crossing, passage) derivatives by the log values."""
    chi_square: Array
    """(profile,) of the beams alone, without the prior."""
    degrees_of_freedom: Array
    """(profile,) of that."""
    total_chi_square: Array
    """(profile,) of beams and prior together."""
    total_degrees_of_freedom: Array
    """(profile,) of that."""
    determined: Booleans
    """(profile,) False without crossings, or where the system is singular."""
    settled: Booleans
    """(profile,) True where the solution converged."""
    left_out: Booleans
    """(profile, beam) True where the covariance of a beam is singular or missing."""
    constants: Array
    """(profile, beam) logarithms of signal over extinction at the last passages."""
    cost: Array
    """(profile,) -2 ln likelihood."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Condensed signals of profiles that share a field."""

    data: CondensedSignals
    layout: FitLayout
    crossing: Indices
    """(passage,) number of the measured crossing at each passage."""
    exponent: Array
    """(beam,)."""
    position: Array
    """(crossing, 3) m, of the measured crossings."""

    @cached_property
    def counts(self) -> Indices:
        """(profile, beam) Number of usable passages; 0 where there is only one."""
        counts = reaches(self.data.usable, self.layout)
        return np.where(counts >= 2, counts, 0)

    def start_constants(self) -> Array:
        """Return (profile, beam) constants of homogeneous air.

        Along all beams of a profile, the fall of the signal over the integral is its extinction.
        """
        counts, first = self.counts, self.layout.first_passage[:-1]
        last = first + np.maximum(counts - 1, 0)
        rows = np.arange(len(counts))[:, np.newaxis]
        ranges = np.append(self.layout.passages.range, 0.0)
        passages = np.minimum(last, ranges.size - 2)
        usable = counts > 0
        # A start need only be finite.
        rise = np.minimum(self.data.log_value[rows, passages], THRESHOLDS.thickest_beam)
        fall = np.where(usable, -np.expm1(rise), 0.0)
        sums = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(self.data.integral, 1)], axis=1)
        total = np.where(usable, sums[rows, last] - sums[rows, first], 0.0)
        with np.errstate(all="ignore"):
            extinction = fall.sum(axis=1, keepdims=True) / total.sum(axis=1, keepdims=True)
            depth = 2.0 * self.exponent * extinction * (ranges[last] - ranges[first])
            depth = np.fmin(np.fmax(depth, THRESHOLDS.thinnest_beam), THRESHOLDS.thickest_beam)
            constants = np.log(total / np.expm1(depth))
        return np.where(usable, constants, 0.0)

    def solve(
        self, prior: Prior, passes: int = _ALL_PASSES, constants: Array | None = None
    ) -> Solution:
        """Solve all profiles, from the constants of homogeneous air or from the given ones."""
        profiles, crossings = len(self.data.usable), len(self.position)
        precision, norm = prior.precision(self.position)
        weak = 0.0 if prior.exists else THRESHOLDS.weak_precision
        counts = self.counts.copy()
        constants = self.start_constants() if constants is None else constants.copy()
        logarithm = np.zeros((profiles, crossings))
        covariance = np.zeros((profiles, crossings, crossings))
        carried = np.zeros((profiles, crossings, self.crossing.size))
        seen = np.zeros(logarithm.shape, dtype=np.bool_)
        summary = np.zeros((profiles, _joint_solution.COLUMNS))
        _joint_solution.solve_joint(
            self.data.log_value, self.data.integral, self.data.covariance,
            (self.layout.first_passage, self.layout.offset, self.crossing),
            precision + weak * np.eye(crossings), weak, passes, counts, constants, logarithm,
            covariance, carried, seen, summary,
        )  # fmt: skip
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        cost = summary[:, _joint_solution.LIKELIHOOD] + norm
        determined = np.isfinite(cost)
        known = determined[:, np.newaxis] & seen & (variance < THRESHOLDS.largest_variance)
        response = covariance @ precision
        shares = np.diagonal(response @ covariance, axis1=1, axis2=2)
        chi_square = summary[:, _joint_solution.CHI_SQUARE]
        spare = counts.sum(axis=1) - (counts > 0).sum(axis=1)
        free = spare - seen.sum(axis=1)
        # Beams may disagree even if crossings stay undetermined or constants diverged.
        alone = not prior.exists and np.isfinite(chi_square)
        return Solution(
            prior,
            np.where(known, logarithm, np.nan),
            np.where(known, variance, np.nan),
            np.where(known, np.maximum(shares, 0.0), np.nan),
            response,
            carried,
            chi_square,
            free.astype(np.float64),
            summary[:, _joint_solution.TOTAL_CHI_SQUARE],
            np.where(alone, free, spare - 1).astype(np.float64),
            determined,
            summary[:, _joint_solution.STEP] < THRESHOLDS.converged_step,
            (counts == 0) & (self.counts > 0),
            constants,
            # A prior must not become likelier by leaving a profile undetermined.
            np.where(determined, cost, _UNDETERMINED_COST),
        )

    def mean(self) -> Problem:
        """Return the mean of the profiles as one profile.

        It is taken beam by beam, up to the passage that brings most values into it, because few
        profiles may have all beams. Values and integrals are relative to the first value of each
        beam, because laser energy changes from profile to profile.
        """
        data, layout = self.data, self.layout
        out = CondensedSignals(*(np.zeros_like(getattr(data, n)[:1]) for n in data.__slots__))
        reach = reaches(data.usable, layout)
        for beam in range(reach.shape[1]):
            on_beam = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
            packed = slice(layout.offset[beam], layout.offset[beam + 1])
            depth = _mean_depth(reach[:, beam])
            used = np.flatnonzero(reach[:, beam] >= depth)
            count = on_beam.stop - on_beam.start
            used = used[_not_noisy(data.covariance[used, packed], count, depth)]
            if depth == 0 or used.size == 0:
                continue
            out.usable[0, on_beam][:depth] = True
            for mean, values, part in (
                (out.log_value, data.log_value, on_beam),
                (out.integral, data.integral, on_beam),
                (out.covariance, data.covariance, packed),
            ):
                mean[0, part] = values[used, part].sum(axis=0) / used.size
            out.covariance[0, packed] /= used.size
        return Problem(out, layout, self.crossing, self.exponent, self.position)


def reaches(usable: Booleans, layout: FitLayout) -> Indices:
    """Return (profile, beam) numbers of usable passages before the first one that is not."""
    return np.stack(
        [
            np.logical_and.accumulate(usable[:, first:last], axis=1).sum(axis=1)
            for first, last in zip(layout.first_passage, layout.first_passage[1:], strict=False)
        ],
        axis=1,
    ).astype(np.intp)


def _mean_depth(reach: Indices) -> int:
    """Return the number of passages of a beam in the mean; 0 where no profile has two.

    Parameters
    ----------
    reach : (profile,) intp
        Number of usable passages of the beam in each profile.
    """
    depths = np.arange(2, int(reach.max(initial=1)) + 1)
    # At the first passage all values are zero.
    values = [(depth - 1) * np.sum(reach >= depth) for depth in depths]
    return int(depths[np.argmax(values)]) if values else 0


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
    columns = np.r_[:depth, passages : passages + max(depth - 1, 0)]
    variances = covariance[:, columns * 2 * passages]
    known = np.isfinite(variances)
    typical = np.median(np.where(known, variances, np.inf), axis=0) if len(variances) else 0.0
    return np.asarray((known & (variances <= THRESHOLDS.noisy_profile * typical)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class BlockSolution:
    """The solutions of a block, of its mean, and of its mean without a prior."""

    profiles: Solution
    mean: Solution
    free_mean: Solution
    contradicted: bool
    """Whether the beams contradict the prior but cannot replace it."""


def solve_block(problem: Problem) -> BlockSolution:
    """Solve a block with the strongest prior that the mean of its profiles does not contradict."""
    mean = problem.mean()
    free, free_mean = problem.solve(NO_PRIOR), mean.solve(NO_PRIOR)
    testable = _can_test_prior(problem, free, free_mean)
    strengths = THRESHOLDS.strengths if testable else THRESHOLDS.strengths[-1:]
    contradicted = not testable and _improbable(mean.solve(Prior(THRESHOLDS.deviations[0])))
    for strength in strengths:
        solution = _likeliest(problem, strength)
        mean_solution = mean.solve(solution.prior)
        # An undetermined mean contradicts no prior.
        if not free_mean.determined[0] or not (
            _improbable(mean_solution) or _contradicted(solution, free)
        ):
            return BlockSolution(solution, mean_solution, free_mean, contradicted)
    return BlockSolution(free, free_mean, free_mean, contradicted)


def _can_test_prior(problem: Problem, free: Solution, free_mean: Solution) -> bool:
    """Return whether the beams can test a prior.

    With fewer equations than unknowns, or as many that leave crossings undetermined, the prior
    decides the rest, and no test covers that: a steep field looks like large deviations about a
    slight gradient.
    """
    # Some profiles are enough: they share the field with those that lost a beam.
    freedoms = free.degrees_of_freedom[free.determined]
    freedom = float(free_mean.degrees_of_freedom[0])
    if freedoms.size:
        quantile = np.quantile(freedoms, THRESHOLDS.testing_quantile, method="higher")
        freedom = max(freedom, float(quantile))
    crossings = np.unique(problem.crossing[problem.data.usable.any(axis=0)])
    open_crossings = ~(free_mean.variance[0, crossings] < THRESHOLDS.open_in_mean**2)
    return freedom > 0 or (freedom == 0 and not open_crossings.any())


def _improbable(mean: Solution) -> bool:
    """Return whether the mean of profiles contradicts the prior that each of them fits.

    Noise hides the errors of a prior in each profile; their mean has less noise.
    """
    if not mean.settled[0]:
        return True
    freedom = mean.total_degrees_of_freedom[0]
    square = max(float(mean.total_chi_square[0]), 0.0)
    return bool(
        freedom > 0
        and special.gammaincc(freedom / 2.0, square / 2.0) < THRESHOLDS.least_probability_of_mean
    )


def _contradicted(solution: Solution, free: Solution) -> bool:
    """Return whether solutions with and without the prior differ at a crossing, on average.

    The variance of the difference is the difference of the variances, because one solution uses
    all the information of the other (`hausman1978`). Only crossings that the beams determine well
    can contradict. A difference below half the standard error is harmless.
    """
    gap = free.logarithm - solution.logarithm
    known = np.isfinite(gap) & free.settled[:, np.newaxis]
    number = np.maximum(known.sum(axis=0), 1)
    average, free_variance, variance = (
        np.where(known, values, 0.0).sum(axis=0) / number
        for values in (gap, free.variance, solution.variance)
    )
    noise = np.sqrt(np.maximum(free_variance - variance, 0.0) / number)
    allowed = np.maximum(THRESHOLDS.contradiction * noise, THRESHOLDS.harmless * np.sqrt(variance))
    # Profiles that are left are no fair sample of the block.
    determined = known.sum(axis=0) > THRESHOLDS.determined_share * len(known)
    determined &= free_variance < THRESHOLDS.well_determined**2
    return bool(np.any(determined & (np.abs(average) > allowed)))


def median(values: Array) -> Array:
    """Return medians over profiles of the finite values; NaN where there is none."""
    known = np.isfinite(values)
    if known.all() and len(values):
        return np.asarray(np.median(values, axis=0))
    out = np.full(values.shape[1], np.nan)
    for column in np.flatnonzero(known.any(axis=0)):
        out[column] = np.median(values[known[:, column], column])
    return out


def _likeliest(problem: Problem, strength: float) -> Solution:
    """Solve with the largest deviation that is not much less likely than the likeliest one.

    Where the likelihood does not separate deviations, the weaker prior is used. Profiles whose
    solution does not converge with every deviation do not count where others do: their likelihoods
    follow from rounding errors.
    """
    solution = problem.solve(Prior(THRESHOLDS.deviations[-1], strength), _FIRST_PASSES)
    tried = []
    for deviation in reversed(THRESHOLDS.deviations):
        solution = problem.solve(Prior(deviation, strength), _NEXT_PASSES, solution.constants)
        tried.append(solution)
    settled = np.all([solution.settled for solution in tried], axis=0)
    counted = settled if settled.any() else np.ones_like(settled)
    costs = [float(np.sum(solution.cost[counted])) for solution in tried]
    limit = min(costs) + THRESHOLDS.likelihood_tolerance
    likely = next(solution for solution, cost in zip(tried, costs, strict=True) if cost <= limit)
    return problem.solve(likely.prior, _LAST_PASSES, likely.constants)
