"""What a network is told of a field before it looks: an empirical prior.

Along a beam, a gradient of extinction looks like attenuation, and what tells them apart is weak.
So a gradient over the network is held to tens of percent beforehand: that much must be said, for
no likelihood tells it. What else a crossing deviates by, the beams that cross there see: its size is
the one that makes all profiles of a block likeliest, and no less than their mean wants. Nothing
is said of the level of a profile. As a single field is no sample of many, errors are stated for
one that deviates by twice as much (`lidarops.retrieve.network._joint_solution`). Where beams are too few to
test the prior, the widest one that is tried is taken.
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
from lidarops.retrieve.network._beam_signals import LOUDER
from lidarops.retrieve.network._condensed_signals import Condensed, Layout

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.uint8]

GRADIENT: Final = 0.15
"""Standard deviation of ln extinction over the crossings that a gradient makes beforehand: 0.1 to
0.2 hold 99 percent of values within 3 standard errors in gradients, plumes and tilting fields."""
DEVIATIONS: Final = tuple(float(s) for s in np.geomspace(0.01, 1.0, 9))
"""Standard deviations of ln extinction of single crossings that are tried."""
_NOT_MUCH_LESS: Final = 4.0
"""Of -2 ln likelihood: two standard errors."""
_STRENGTHS: Final = (1.0, 2.0, 4.0)
"""Factors of the prior's standard deviations that are tried before it is given up."""
_WELL_TOLD: Final = 0.15
_CONTRADICTION: Final = 3.5
_HARMLESS: Final = 0.5
"""Of the standard error that is reported."""
_ENOUGH: Final = 8
"""Profiles that must see a beam for their mean to be asked."""
_TOLD_BY_MEAN: Final = 0.3
_TELLING: Final = 0.75
"""Share of the profiles, beyond which at least one has to test the prior."""
_UNTOLD: Final = 1.0
"""Standard error of ln extinction in the mean, from which on equations do not tell a crossing."""
_APART: Final = 2.5
"""Standard errors, of both, between the mean of solutions and the solution of the mean."""
_UNLIKELY: Final = 1e-2
"""Probability of a chi-square of the mean, told by the prior, below which the field is another."""
_UNDETERMINED_COST: Final = 1e3
_FIRST_PASSES: Final = 12
_NEXT_PASSES: Final = 4
_LAST_PASSES: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class PriorSolution:
    """Logarithms of extinction at the measured crossings."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1."""
    variance: Array
    """(profile, crossing), with doubt in the prior."""
    believed: Array
    """(profile, crossing) variance where the prior is true."""
    missed: Array
    """(profile, crossing) variance by fields that the prior rules out, where nothing else does."""
    chi_square: Array
    """(profile,) of the beams alone, whatever the prior."""
    degrees_of_freedom: Array
    """(profile,) of that."""
    prior_chi_square: Array
    """(profile,) of beams and prior together."""
    prior_degrees_of_freedom: Array
    """(profile,) of that."""
    deviation: Array
    """(profile,) of the prior; inf without one."""
    strength: Array
    """(profile,) by which that, and the gradient, were multiplied."""
    status: Codes
    """(profile,) of `lidarops.retrieve.network._joint_solution`."""
    left_out: Codes
    """(profile, beam) 1 where a beam was, because its covariance is singular or none."""
    doubtful: Booleans
    """(profile,) True where beams tell that the field is not as the prior has it, and not how."""


class _Problem:
    """Condensed profiles, and the constants of beams at which a solution starts."""

    def __init__(
        self, data: Condensed, layout: Layout, crossing: Indices, exponent: Array, position: Array
    ) -> None:
        self.data = data
        self.crossings = position.shape[0]
        self.gradient = _gradient(position)
        self.bends = _block_errors.bends(position)
        self.geometry = (layout.first_passage, layout.offset, crossing)
        self.constants = np.zeros((data.log_value.shape[0], exponent.size))
        self.likelihood = 0.0
        _joint_solution.start_constants(
            data.integral, data.usable, data.slope, lengths(layout), exponent,
            layout.first_passage, self.constants,
        )  # fmt: skip
        self.start = self.constants.copy()

    def afresh(self, deviation: float, strength: float = 1.0) -> PriorSolution:
        """Solve all profiles from where the first solution started."""
        self.constants[:] = self.start
        return self.solve(deviation, 2 * _FIRST_PASSES, strength)

    def solve(self, deviation: float, passes: int, strength: float = 1.0) -> PriorSolution:
        """Solve all profiles; move the constants."""
        shape = (self.constants.shape[0], self.crossings)
        logarithm, variance = np.full(shape, np.nan), np.full(shape, np.nan)
        believed, missed = np.full(shape, np.nan), np.full(shape, np.nan)
        summary, status = (
            np.full((shape[0], _joint_solution.COLUMNS), np.nan),
            np.zeros(shape[0], dtype=np.uint8),
        )
        left_out = np.zeros(self.constants.shape, dtype=np.uint8)
        precision, norm, flat = _precision(self.gradient, deviation, strength)
        data = self.data
        _joint_solution.solve_joint(
            data.log_value, data.integral, data.usable, data.covariance, self.geometry,
            precision, self.bends, norm, flat, passes, self.constants, logarithm, variance,
            believed, missed, summary, status, left_out,
        )  # fmt: skip
        fine = status != _joint_solution.UNDETERMINED
        # A profile that one prior leaves undetermined must not make it likelier than others.
        terms = np.where(fine, summary[:, _joint_solution.LIKELIHOOD], _UNDETERMINED_COST)
        self.likelihood = float(np.sum(terms))
        return PriorSolution(
            logarithm, variance, believed, missed, summary[:, 0], summary[:, 1],
            summary[:, 2], summary[:, 3], np.full(shape[0], strength * deviation),
            np.full(shape[0], strength), status, left_out, np.zeros(shape[0], dtype=np.bool_),
        )  # fmt: skip


def lengths(layout: Layout) -> Array:
    """Return the distance in m from each passage to the next on its beam, 0 for the last."""
    out = np.zeros(layout.passages.range.size)
    same = layout.passages.beam[:-1] == layout.passages.beam[1:]
    out[:-1][same] = np.diff(layout.passages.range)[same]
    return out


def solve_without_prior(
    data: Condensed, layout: Layout, crossing: Indices, exponent: Array, position: Array
) -> PriorSolution:
    """Solve each profile for itself; arguments as of `solve_blocks`."""
    problem = _Problem(data, layout, crossing, exponent, position)
    return problem.solve(np.inf, 2 * _FIRST_PASSES)


def solve_blocks(
    data: Condensed,
    layout: Layout,
    crossing: Indices,
    exponent: Array,
    position: Array,
    block: Indices,
) -> PriorSolution:
    """Solve the profiles of each block with the prior that makes them likeliest.

    Parameters
    ----------
    data : Condensed
    layout : Layout
    crossing : (passage,) intp
        Numbers of the measured crossings.
    exponent : (beam,) float64
    position : (crossing, 3) float64
        m, of the measured crossings.
    block : (profile,) intp
    """
    shape = (block.size, position.shape[0])

    def nothing(*size: int) -> Array:
        return np.full(size, np.nan)

    n = block.size
    out = PriorSolution(
        nothing(*shape), nothing(*shape), nothing(*shape), nothing(*shape), nothing(n),
        nothing(n), nothing(n), nothing(n), nothing(n), nothing(n),
        np.full(n, _joint_solution.UNDETERMINED, dtype=np.uint8),
        np.zeros((n, exponent.size), dtype=np.uint8), np.zeros(n, dtype=np.bool_),
    )  # fmt: skip
    for b in np.unique(block):
        mine = np.flatnonzero(block == b)
        told = data.take(mine)
        part = _solve_block(
            _Problem(told, layout, crossing, exponent, position),
            partial(_mean_problem, told, layout, crossing, exponent, position),
        )
        for field in fields(PriorSolution):
            getattr(out, field.name)[mine] = getattr(part, field.name)
    return out


def _mean_problem(
    data: Condensed, layout: Layout, crossing: Indices, exponent: Array, position: Array
) -> _Problem | None:
    """Return the mean of profiles as a problem; None where too few see the same."""
    pooled = _pooled(data, layout)
    return None if pooled is None else _Problem(pooled, layout, crossing, exponent, position)


def _pooled(data: Condensed, layout: Layout) -> Condensed | None:
    """Return the mean of profiles as one; None where too few see any beam.

    Beam by beam, up to the passage with which most values go into it, as hardly a profile may see
    all beams. Of values and integrals relative to each beam's first value: the energy of a laser
    changes from profile to profile.
    """
    usable = np.zeros((1, data.usable.shape[1]), dtype=np.uint8)
    log_value, integral = np.full(usable.shape, np.nan), np.zeros(usable.shape)
    covariance = np.zeros((1, data.covariance.shape[1]))
    slope = np.full((*usable.shape, 4), np.nan)
    for beam in range(layout.first_passage.size - 1):
        mine = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
        packed = slice(layout.offset[beam], layout.offset[beam + 1])
        reach = np.logical_and.accumulate(data.usable[:, mine] == 1, axis=1).sum(axis=1)
        depth = _depth(reach)
        if depth == 0:
            continue
        used = np.flatnonzero(reach >= depth)
        used = used[_quiet(data.covariance[used, packed], mine.stop - mine.start, depth)]
        number = used.size
        if number < _ENOUGH:
            continue
        usable[0, mine][:depth] = 1
        log_value[0, mine] = data.log_value[used, mine].sum(axis=0) / number
        integral[0, mine] = data.integral[used, mine].sum(axis=0) / number
        covariance[0, packed] = data.covariance[used, packed].sum(axis=0) / number / number
        slope[0, mine] = data.slope[used, mine].sum(axis=0) / number
        slope[0, mine, 1::2] /= number
    if not usable.any():
        return None
    return Condensed(
        log_value, integral, usable, covariance, slope, data.status[:1], data.bridged[:1]
    )


def _quiet(covariance: Array, passages: int, depth: int) -> Booleans:
    """Return (profile,) where a beam is not far louder than in most profiles.

    A single bin of huge or unknown variance in one profile would take a beam from the mean of
    all, which then speaks against no prior.

    Parameters
    ----------
    covariance : (profile, packed) float64
        Of a beam: of its log values and then its integrals, both up to a depth.
    passages, depth : int
        Of the beam, and those in the mean.
    """
    quantities = 2 * passages - 1
    mine = np.r_[:depth, passages : passages + depth - 1]
    variances = covariance[:, mine * (quantities + 1)]
    known = np.isfinite(variances)
    usual = np.median(np.where(known, variances, np.inf), axis=0)
    return np.asarray((known & (variances <= LOUDER * usual)).all(axis=1))


def _depth(reach: Indices) -> int:
    """Return how many passages of a beam the mean of profiles takes; 0 where too few see two.

    Parameters
    ----------
    reach : (profile,) intp
        Passages of the beam that each profile sees.
    """
    best, most = 0, 0
    for depth in range(2, int(reach.max(initial=0)) + 1):
        number = int(np.sum(reach >= depth))
        # Of the first passage, all values are zero.
        if number >= _ENOUGH and (depth - 1) * number > most:
            best, most = depth, (depth - 1) * number
    return best


def _solve_block(problem: _Problem, pool: Callable[[], _Problem | None]) -> PriorSolution:
    """Solve with the strongest prior that the beams do not contradict, each and on average."""
    alone = problem.afresh(np.inf)
    # What profiles tell well by themselves, their mean need not tell.
    with np.errstate(invalid="ignore"):
        mean = None if np.all(alone.variance < _WELL_TOLD**2) else pool()
    whole = None if mean is None else mean.afresh(np.inf)
    tested = _tests(problem, alone, whole)
    strengths = _STRENGTHS if tested else _STRENGTHS[-1:]
    if mean is None or whole is None:
        return _strongest(problem, alone, strengths)[0]
    result = _with_mean(problem, alone, mean, whole, strengths)
    doubtful = not tested and _unlikely(mean.afresh(DEVIATIONS[0]))
    return replace(result, doubtful=np.full_like(result.doubtful, doubtful))


def _with_mean(
    problem: _Problem,
    alone: PriorSolution,
    mean: _Problem,
    whole: PriorSolution,
    strengths: tuple[float, ...],
) -> PriorSolution:
    """Solve a block with the strongest prior that neither profiles nor their mean contradict."""
    if whole.status[0] == _joint_solution.UNDETERMINED:
        # A mean that tells nothing speaks against no prior.
        result, strength = _strongest(problem, alone, strengths)
        return _widened(result, strength, _told(mean, result, strength), whole)
    settled = bool(whole.status[0] == _joint_solution.SOLVED)
    for strength in strengths:
        least = _least(mean, strength) if settled else 0.0
        result = _likeliest(problem, strength, least)
        if _contradicted(result, alone) or _apart(result, whole):
            continue
        told = _told(mean, result, strength)
        if not _unlikely(told):
            return _widened(result, strength, told, whole)
    return _widened(alone, 1.0, whole, whole)


def _tests(problem: _Problem, alone: PriorSolution, whole: PriorSolution | None) -> bool:
    """Return whether the beams tell enough to test a prior.

    Where they are fewer equations than unknowns, or as many that do not tell all crossings, the
    prior decides what is left, and none of its tests asks for that: a steep field passes for
    large deviations about a slight gradient.
    """
    known = alone.status != _joint_solution.UNDETERMINED
    freedom = 0.0
    if known.any():
        # Of some profiles: they see the field of those that lost a beam.
        told_by = alone.degrees_of_freedom[known]
        freedom = float(np.quantile(told_by, _TELLING, method="higher"))
    if whole is None:
        return freedom >= 0
    freedom = max(freedom, float(whole.degrees_of_freedom[0]))
    seen = np.unique(problem.geometry[2][(problem.data.usable == 1).any(axis=0)])
    told = bool(np.all(whole.variance[0, seen] < _UNTOLD**2))
    return freedom > 0 or (freedom == 0 and told)


def _strongest(
    problem: _Problem, alone: PriorSolution, strengths: tuple[float, ...]
) -> tuple[PriorSolution, float]:
    """Solve with the strongest prior that no profile contradicts; return its strength, too."""
    for strength in strengths:
        result = _likeliest(problem, strength, 0.0)
        if not _contradicted(result, alone):
            return result, strength
    return alone, 1.0


def _told(mean: _Problem, result: PriorSolution, strength: float) -> PriorSolution:
    """Solve the mean of profiles with the prior that each of them was solved with."""
    return mean.afresh(float(result.deviation[0]) / strength, strength)


def _unlikely(told: PriorSolution) -> bool:
    """Return whether the mean of profiles does not fit the prior that each of them fits.

    Noise hides in each profile what a prior has wrong; in their mean there is less of it. Asked
    in values along beams, where `_apart` asks in extinction, of which thin air tells nothing.
    """
    if told.status[0] != _joint_solution.SOLVED:
        return True
    square, freedom = float(told.prior_chi_square[0]), float(told.prior_degrees_of_freedom[0])
    if freedom <= 0:
        return False
    return bool(special.gammaincc(freedom / 2.0, max(square, 0.0) / 2.0) < _UNLIKELY)


def _widened(
    result: PriorSolution, strength: float, told: PriorSolution, free: PriorSolution
) -> PriorSolution:
    """Return solutions with the errors that the mean of profiles knows of, told and free."""
    noise = _block_errors.of_noise(result.logarithm, result.variance, told.logarithm[0])
    field = _block_errors.of_field(
        result.missed, told.logarithm[0], free.logarithm[0], free.variance[0]
    )
    # Where nothing speaks against a prior, the weakest that is tried may be the true one.
    times = max(_STRENGTHS[-1] / strength, _joint_solution.DOUBT)
    more = (times**2 - 1.0) / (_joint_solution.DOUBT**2 - 1.0)
    factor = np.where(np.isfinite(free.variance[0]), 1.0, more)
    prior = (factor - 1.0) * (result.variance - result.believed)
    return replace(result, variance=result.variance + (noise + field + prior))


def _likeliest(problem: _Problem, strength: float, least: float) -> PriorSolution:
    """Solve with the largest deviation that is not much less likely than the likeliest.

    What is not told apart by the likelihood is told less sharply, rather than too sharply. Nor
    more sharply than by the mean of profiles, which wants this deviation at least.
    """
    costs, constants = _costs(problem, strength)
    chosen = int(np.flatnonzero(costs <= costs.min() + _NOT_MUCH_LESS)[-1])
    chosen = max(chosen, int(np.searchsorted(DEVIATIONS, least)))
    problem.constants[:] = constants[chosen]
    return problem.solve(DEVIATIONS[chosen], _LAST_PASSES, strength)


def _least(mean: _Problem, strength: float) -> float:
    """Return the least deviation that is not much less likely than the likeliest."""
    costs, _ = _costs(mean, strength)
    return DEVIATIONS[int(np.flatnonzero(costs <= costs.min() + _NOT_MUCH_LESS)[0])]


def _costs(problem: _Problem, strength: float) -> tuple[Array, list[Array]]:
    """Return -2 ln likelihood of each deviation, and the constants at which it was found."""
    problem.constants[:] = problem.start
    problem.solve(DEVIATIONS[-1], _FIRST_PASSES, strength)
    costs = np.empty(len(DEVIATIONS))
    constants: list[Array] = []
    for k in range(len(DEVIATIONS) - 1, -1, -1):
        problem.solve(DEVIATIONS[k], _NEXT_PASSES, strength)
        costs[k] = problem.likelihood
        constants.insert(0, problem.constants.copy())
    return costs, constants


def _contradicted(result: PriorSolution, alone: PriorSolution) -> bool:
    """Return whether solutions without the prior differ from it at a crossing, on average.

    Of two solutions of which one is told more, the variance of the difference is the difference
    of the variances (`hausman1978`). Only crossings that the beams tell well can contradict, and
    only by more than their variance: the solution without prior is biased by that much. A
    difference of less than half of the standard error that is reported does no harm.
    """
    known = np.isfinite(alone.variance) & np.isfinite(result.believed)
    known &= (alone.status == _joint_solution.SOLVED)[:, np.newaxis]
    number = np.maximum(known.sum(axis=0), 1)
    gap = np.where(known, alone.logarithm - result.logarithm, 0.0).sum(axis=0) / number
    whole = np.where(known, alone.variance, 0.0).sum(axis=0) / number
    less = np.where(known, result.believed, 0.0).sum(axis=0) / number
    apart = _CONTRADICTION * np.sqrt(np.maximum(whole - less, 0.0) / number)
    apart = np.maximum(apart, _HARMLESS * np.sqrt(less))
    told = (whole < _WELL_TOLD**2) & (known.sum(axis=0) > 0.9 * len(known))
    return bool(np.any(told & (np.abs(gap) > apart + whole)))


def _apart(result: PriorSolution, whole: PriorSolution) -> bool:
    """Return whether solutions are, on average, off that of their mean at a crossing.

    Noise that lets a prior decide each profile is less in the mean. What a prior has wrong, all
    profiles share.
    """
    known = np.isfinite(result.believed)
    number = np.maximum(known.sum(axis=0), 1)
    middle = np.where(known, result.logarithm, 0.0).sum(axis=0) / number
    stated = np.where(known, result.believed, 0.0).sum(axis=0) / number
    told = whole.variance[0] < _TOLD_BY_MEAN**2
    told &= (known.sum(axis=0) > 0.5 * len(known)) & (whole.status[0] == _joint_solution.SOLVED)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(stated + whole.variance[0])
        off = np.abs(whole.logarithm[0] - middle) > _APART * spread + 0.5 * whole.variance[0]
    return bool(np.any(told & off))


def _gradient(position: Array) -> Array:
    """Return the covariance of a linear field of unit variance and of any direction."""
    if position.shape[0] == 0:
        return np.zeros((0, 0))
    centred = position - position.mean(axis=0)
    covariance = np.sum(centred[:, np.newaxis, :] * centred[np.newaxis, :, :], axis=2)
    size = float(np.trace(covariance))
    # One crossing has no gradient.
    return np.asarray(covariance * (len(position) / size if size > 0 else 0.0))


def prior_of(position: Array, found: PriorSolution, profile: int) -> tuple[Array, bool]:
    """Return the precision of the prior that a profile was solved with, and whether it had none."""
    strength = float(found.strength[profile])
    deviation = float(found.deviation[profile]) / strength
    precision, _, flat = _precision(_gradient(position), deviation, strength)
    return precision, flat


def _precision(gradient: Array, deviation: float, strength: float) -> tuple[Array, float, bool]:
    """Return the precision of a prior, -ln of its determinant, and whether there is none."""
    if not np.isfinite(deviation):
        return np.zeros_like(gradient), 0.0, True
    return *_free_level(gradient, deviation, strength), False


def _free_level(gradient: Array, deviation: float, strength: float = 1.0) -> tuple[Array, float]:
    """Return the precision of the prior with its level left free, and -ln |precision|."""
    covariance = GRADIENT**2 * gradient + deviation**2 * np.eye(len(gradient))
    covariance *= strength**2
    precision = np.linalg.inv(covariance)
    sums = precision.sum(axis=0)
    norm = float(np.linalg.slogdet(covariance)[1] + np.log(sums.sum()))
    return precision - np.outer(sums, sums) / sums.sum(), norm
