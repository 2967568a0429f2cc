"""Solution of a block of profiles as one field that changes slowly.

1. The mean of the powers of each beam gives the mean field and the constants of the beams.
2. The profiles deviate little from this mean, so that their deviations are linear, with weights
   that do not depend on their noise.
3. All profiles together give the field of each (`_changing_field`).
4. Where air moves, the mean of a block is too far from its profiles: each profile is linear about
   a running mean, until the field stays.

A profile that disagrees with those before and after it is no part of steps 1 to 4. The solution is
linear in small changes of the signals, and states how it follows them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from lidarops.retrieve.common.arrays import Array, Booleans, Indices, median
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import _beam_fit, _changing_field
from lidarops.retrieve.network._beam_fit import Linear, Solution
from lidarops.retrieve.network._beam_signals import Block, Causes, Estimates, Response
from lidarops.retrieve.network._changing_field import Change
from lidarops.retrieve.network._condensed_signals import (
    Beams,
    CleanBeam,
    Condensed,
    FitLayout,
    condense,
)
from lidarops.retrieve.network.outlying_bins import GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

_FIELD_PASSES: Final = 16


# Means of powers ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScaledBeam:
    """Powers of one beam in the profiles of a block, over their energies."""

    source: CleanBeam
    factor: Array
    """(bin,) logarithm of range^2 / overlap."""
    place: Indices
    """(bin,) number of the bin."""
    stop: int
    """The bin behind the last one that means use."""
    energy: Array
    """(profile, 1) inf where nothing is known."""
    power: Array
    """(profile, bin) 0 where left out."""
    variance: Array
    """(profile, bin) 0 where left out."""
    kept: Booleans
    """(profile, bin) False where left out."""
    weight: Array
    """(profile, 1) of a mean; 0 where a profile is no part of it."""

    def mean(self, half: int | None = None) -> CleanBeam:
        """Return the mean as a profile of a beam, or running means of 2 half + 1 profiles."""
        weight, source, place = self.weight, self.source, self.place
        total = running_sums(weight * self.kept, half)
        power = running_sums(weight * self.power, half) / total
        variance = running_sums(weight**2 * self.variance, half) / total**2
        doubt = np.nan_to_num(running_sums(weight * self.kept * source.doubt, half) / total)
        known = (power > 0.0) & np.isfinite(variance)
        logs = np.where(known, source.exponent * (np.log(power) + self.factor), 0.0)
        noise = np.where(known, source.exponent**2 * variance / power**2, 0.0)
        lost = ~known & (place >= source.low) & (place < self.stop)
        stops = np.where(lost.any(axis=1), source.start + np.argmax(lost, axis=1), self.stop)
        codes = np.where(known, GOOD, LOST).astype(np.uint8)
        return CleanBeam(
            source.number, source.start, source.low, power, variance, logs, noise, doubt, codes,
            stops, np.zeros(len(logs), dtype=np.uint8), source.exponent,
        )  # fmt: skip

    def deviations(self, mean: CleanBeam) -> Array:
        """Return (profile, bin) deviations of logarithms from one mean, or one for each profile."""
        known = self.kept & (mean.codes == GOOD)
        return np.where(known, self.source.exponent * (self.power / mean.power - 1.0), 0.0)

    def noise_ratio(self, mean: CleanBeam) -> Array:
        """Return (profile,) variances of noise over those of a mean, for the bins of each."""
        inside = (self.place >= self.source.low) & (self.place < self.source.stops[:, np.newaxis])
        own = (self.variance * inside).sum(axis=1)
        ratio = own / np.where(inside & self.kept, mean.variance, 0.0).sum(axis=1)
        return np.where(np.isfinite(ratio) & (ratio > 0.0), ratio, np.inf)


def running_sums(values: Array, half: int | None) -> Array:
    """Return (1, item) sums of all profiles, or (profile, item) ones of those up to `half` away."""
    if half is None:
        return np.asarray(values.sum(axis=0, keepdims=True))
    total = values.copy()
    for k in range(1, half + 1):
        total[k:] += values[:-k]
        total[:-k] += values[k:]
    return total


def _scale(beam: CleanBeam, layout: FitLayout, reach: Indices) -> ScaledBeam:
    """Return the powers of a beam over their energies, for (profile,) numbers of passages."""
    depth = mean_depth(reach)
    complete = (reach >= depth) & (depth > 0)
    last = layout.first_passage[beam.number] + depth - 1
    stop = int(layout.window[last]) + layout.weights.shape[1] if depth else beam.low
    place = beam.start + np.arange(beam.power.shape[1])
    before = place < beam.stops[:, np.newaxis]
    known = (beam.codes != LOST) | (before & (beam.power <= 0.0))
    kept = known & (beam.codes != KEPT)
    # What deviates in most profiles is air.
    kept |= known & (2 * kept[complete].sum(axis=0) < complete.sum())
    power, variance = np.where(kept, beam.power, 0.0), np.where(kept, beam.variance, 0.0)
    inside = before & kept & (place >= beam.low) & (place < stop)
    part = inside * power
    typical = part[complete].sum(axis=0) / np.maximum(inside[complete].sum(axis=0), 1)
    energy = part.sum(axis=1) / (inside * typical).sum(axis=1) * typical.sum()
    energy = np.where(energy > 0.0, energy, np.inf)[:, np.newaxis]
    power, variance = power / energy, variance / energy**2
    noise = (variance * inside).sum(axis=1)
    weight = np.where(complete & np.isfinite(noise) & (noise > 0.0), 1.0 / noise, 0.0)
    factor = layout.log_factor[beam.number, place]
    return ScaledBeam(
        beam, factor, place, stop, energy, power, variance, kept & np.isfinite(energy),
        weight[:, np.newaxis],
    )  # fmt: skip


def _scaled(block: Block, reach: Indices) -> list[ScaledBeam]:
    return [_scale(beam, block.layout, reach[:, b]) for b, beam in enumerate(block.beams)]


def mean_depth(reach: Indices) -> int:
    """Return the number of passages of a beam in the mean; 0 where no profile has two."""
    depths = np.arange(2, int(reach.max(initial=1)) + 1)
    # At the first passage all values are zero.
    values = [(depth - 1) * np.sum(reach >= depth) for depth in depths]
    return int(depths[np.argmax(values)]) if values else 0


class _Means(NamedTuple):
    """Means of the powers of a block: one, or running means for each profile."""

    scaled: list[ScaledBeam]
    beams: list[CleanBeam]
    condensed: Condensed
    curvature: tuple[Array, Array]
    """(mean, beam, passage) errors of u by lines through curved signals, and what their correction
    leaves in the variance of u."""
    change: Array
    """(profile, beam, 2 passage, 1) deviations of u and I of profiles from the means."""
    ratio: Array
    """(profile, beam) variance of noise over that of the mean; inf where unknown."""

    @classmethod
    def of(cls, scaled: list[ScaledBeam], layout: FitLayout, half: int | None = None) -> _Means:
        """Return the mean of all profiles, or those of up to `half` before and after each.

        Where a signal is curved beyond noise, the polynomial replaces the straight line.
        """
        means = [each.mean(half) for each in scaled]
        condensed = condense(means, layout)
        error, noise = np.moveaxis(condensed.curvature, -1, 0)
        curved = error**2 > COMMON.significant**2 * noise
        left = noise + (THRESHOLDS.curvature_left * error) ** 2
        curvature = np.where(curved, error, 0.0), np.where(curved, left, 0.0)
        _straighten(condensed.beams, curvature)
        pairs = list(zip(scaled, means, condensed.derivatives, strict=True))
        change = [by_bin @ each.deviations(mean)[..., np.newaxis] for each, mean, by_bin in pairs]
        ratio = [each.noise_ratio(mean) for each, mean, _ in pairs]
        stacked = np.stack(change, axis=1), np.stack(ratio, axis=1)
        return cls(scaled, means, condensed, curvature, *stacked)

    def signals(self, constants: Array, reach: Indices) -> _Signals:
        """Return the signals of all profiles, linear about constants."""
        beams = self.condensed.beams
        reach = np.where(np.isfinite(self.ratio), np.minimum(reach, beams.reach), 0)
        alike = reach[:1] if np.all(reach == reach[0]) else reach
        linear = _beam_fit.linearise(beams, constants, alike)
        value = linear.value + (linear.turn @ self.change)[..., 0]
        # Errors by curvature are those of the mean, and count as its noise does.
        information = linear.information / self.ratio[..., np.newaxis, np.newaxis]
        energies = [each.energy for each in self.scaled]
        bins = Bins(len(reach), self.condensed, self.beams, energies)
        return _Signals(bins, beams, linear._replace(value=value, information=information), reach)


def _straighten(beams: Beams, curvature: tuple[Array, Array]) -> None:
    """Correct values of curved signals in place, and add what is left of these to the noise."""
    shift, variance = curvature
    beams.value[:] -= shift
    place = np.arange(variance.shape[2])
    beams.covariance[..., place, place] += variance


# Linear signals ----------------------------------------------------------------------------------


class Bins(NamedTuple):
    """How the signals of profiles follow their bins."""

    profiles: int
    condensed: Condensed
    """Of means: one, or one for each profile."""
    means: list[CleanBeam]
    energies: list[Array]
    """For each beam, (profile or 1, 1) power over that of the mean; inf where it is missing."""

    def changes(self, causes: Causes) -> Array:
        """Return (profile, beam, 2 passage, cause) changes of u and I."""
        (_, integral, covariance, *_), derivatives, _ = self.condensed
        out = np.zeros((self.profiles, *covariance.shape[1:3], len(causes)))
        most = integral.shape[2]
        for b, (mean, energy) in enumerate(zip(self.means, self.energies, strict=True)):
            bins = slice(mean.start, mean.start + mean.logs.shape[1])
            for c, cause in enumerate(causes):
                if mean.number in cause:
                    change = cause[mean.number]
                    logs = mean.exponent * change.of_power(bins, energy * mean.power)
                    logs = np.where(mean.codes == LOST, 0.0, logs + change.exponent * mean.logs)
                    out[:, b, :, c] = (derivatives[b] @ logs[..., np.newaxis])[..., 0]
                    out[:, b, most:, c] += change.exponent * integral[:, b]
        return out

    def response(self, layout: FitLayout, respond: Callable[[Array], Array]) -> Response:
        """Return how ln extinction follows causes.

        `respond` is how it follows changes of u and I, at the measured crossings.
        """

        def response(causes: Causes) -> Array:
            out = np.zeros((self.profiles, layout.crossings, len(causes)))
            out[:, layout.measured] = respond(self.changes(causes))
            return out

        return response


class _Signals(NamedTuple):
    """Signals of all profiles, linear about means."""

    bins: Bins
    beams: Beams
    """Of the means."""
    linear: Linear
    """Of each profile."""
    reach: Indices
    """(profile, beam)."""


# Blocks ------------------------------------------------------------------------------------------


def solve_alone(block: Block) -> Estimates:
    """Solve each profile without a prior."""
    out = Estimates.missing(len(block.reach), block.layout)
    condensed = condense_alone(block)
    beams, measured = condensed.beams, block.layout.measured
    solved = _beam_fit.fit_beams(beams, 0.0 * block.prior)
    variance = np.diagonal(solved.covariance, axis1=1, axis2=2)
    known = _beam_fit.seen(beams, beams.reach) & (variance < THRESHOLDS.largest_variance)
    extinction = np.where(known, np.exp(solved.logarithm), np.nan)
    out.extinction[:, measured] = extinction
    out.variance[:, measured] = extinction**2 * variance
    out.settled[:] = solved.settled & (beams.reach > 0).any(axis=1)
    out.leave_out(block, beams.reach)
    chi_square, freedom = _beam_fit.compare(beams, solved.linear, solved.logarithm, beams.reach)
    out.chi_square[:], out.degrees_of_freedom[:] = chi_square, freedom

    def respond(change: Array) -> Array:
        return solved.covariance @ solved.linear.sides(beams, change)

    return out.with_response(block, bins_alone(block, condensed).response(block.layout, respond))


def condense_alone(block: Block) -> Condensed:
    """Return the signals of each profile, with the curvature that the mean of the block shows."""
    condensed = condense(block.beams, block.layout, block.reach)
    _straighten(condensed.beams, _Means.of(_scaled(block, block.reach), block.layout).curvature)
    return condensed


def bins_alone(block: Block, condensed: Condensed) -> Bins:
    """Return how profiles follow their own bins."""
    return Bins(len(block.reach), condensed, block.beams, [np.ones((1, 1))] * len(block.beams))


def solve_block(block: Block) -> Estimates:
    """Solve a block as one field."""
    odd = np.zeros(len(block.reach), dtype=np.bool_)
    mean = _solve_mean(block, block.reach)
    if mean is not None:
        odd = _disagreeing(mean.signals)
    if odd.any():
        mean = _solve_mean(block, np.where(odd[:, np.newaxis], 0, block.reach))
    if mean is None:
        out = Estimates.missing(len(block.reach), block.layout)
        out.leave_out(block, np.where(odd[:, np.newaxis], block.reach, 0))
        # They have signals, but no solution that converged.
        out.chi_square[odd] = out.degrees_of_freedom[odd] = 0.0
        return out
    signals, field, settled = _solve_profiles(block, mean)
    out = _assess(block, signals, field, mean, settled & ~odd)
    out.left_out[odd] = False
    return out


class _Mean(NamedTuple):
    """The mean field of a block, and the profiles about it."""

    of_powers: _Means
    solution: Solution
    signals: _Signals


def _solve_mean(block: Block, reach: Indices) -> _Mean | None:
    """Return the mean field of the profiles with a reach; None where no beam has two passages."""
    means = _Means.of(_scaled(block, reach), block.layout)
    beams = means.condensed.beams
    if not beams.reach.any():
        return None
    solution = _beam_fit.fit_beams(beams, block.prior)
    return _Mean(means, solution, means.signals(solution.constants, reach))


def _disagreeing(signals: _Signals) -> Booleans:
    """Return (profile,) whether a beam is unlike those of the profiles before and after it.

    Signals may be anywhere between those before and after, or on the way that either of them goes.
    What is left is compared with noise, and with what typically changes from profile to profile.
    The worst profile is taken out, and the others are compared again without it.
    """
    lit = np.asarray((signals.reach > 1).any(axis=1))
    odd = ~lit
    inside = np.arange(signals.linear.value.shape[2]) < signals.reach[..., np.newaxis]
    every = np.where(inside, signals.linear.value, np.nan)
    freedom = np.maximum(signals.reach - 1, 1)
    each = np.arange(1, every.shape[2] + 1)
    limit = special.chdtri(each, THRESHOLDS.least_neighbourly)[freedom - 1]
    while np.sum(~odd) > 1:
        value = every[~odd]
        square, step = np.empty((2, *value.shape[:2]))
        _compare_neighbours(signals.linear.information[~odd], value, square, step)
        above = square / limit[~odd]
        # Of noise alone it is 1.
        step = step / freedom[~odd] - 1.0
        worst = int(np.argmax(above.max(axis=1)))
        others = np.isfinite(step)
        # The steps to and from it are not typical.
        others[[0, worst]] = others[worst + 1 : worst + 2] = False
        if not (above[worst] > np.fmax(median(step, others), 1.0)).any():
            break
        # Of two, either may be the odd one.
        odd[np.flatnonzero(~odd)[worst] if np.sum(~odd) > 2 else slice(None)] = True
    return odd & lit


@compiled
def _compare_neighbours(information: Array, value: Array, square: Array, step: Array) -> None:
    """Fill (profile, beam) chi-squares about neighbours, 0 without any, and about the last profile.

    The former are those of the nearest point between two fields: the medians before and after, or
    either of these and where it leads.
    """
    profiles, beams, most = value.shape
    number = THRESHOLDS.neighbours
    ends, work, known = np.empty((4, most)), np.empty((2, most)), np.empty(number)
    for t in range(profiles):
        for b in range(beams):
            own, matrix = value[t, b], information[t, b]
            for p in range(most):
                for side in range(2):
                    way = 2 * side - 1
                    near = _median_beside(value[:, b, p], t + way, way, known)
                    far = _median_beside(value[:, b, p], t + way * (1 + number), way, known)
                    ends[side, p] = near
                    ends[2 + side, p] = 2.0 * near - far if math.isfinite(far) else near
            least = np.inf
            for start, stop in ((0, 1), (0, 2), (1, 3)):
                apart = _apart(matrix, own, ends[start], ends[stop], work)
                least = apart if apart < least else least
            square[t, b] = least if least < np.inf else 0.0
            last = value[max(t - 1, 0), b]
            step[t, b] = _apart(matrix, own, last, last, work)


@compiled
def _median_beside(value: Array, first: int, way: int, known: Array) -> float:
    """Return the median of the known values of some profiles; NaN without any."""
    count = 0
    for t in range(first, first + way * len(known), way):
        if 0 <= t < len(value) and math.isfinite(value[t]):
            place = count
            while place > 0 and known[place - 1] > value[t]:
                known[place] = known[place - 1]
                place -= 1
            known[place] = value[t]
            count += 1
    return 0.5 * (known[(count - 1) // 2] + known[count // 2]) if count > 0 else np.nan


@compiled
def _apart(information: Array, value: Array, start: Array, stop: Array, work: Array) -> float:
    """Return the chi-square about the nearest point between two fields; NaN without them."""
    if not (math.isfinite(start[0]) and math.isfinite(stop[0])):
        return np.nan
    for p in range(len(value)):
        for k, change in enumerate((value[p] - start[p], stop[p] - start[p])):
            work[k, p] = change if math.isfinite(change) else 0.0
    rest, step = work
    length = along = 0.0
    for p in range(len(value)):
        for q in range(len(value)):
            length += step[p] * information[p, q] * step[q]
            along += rest[p] * information[p, q] * step[q]
    if length > 0.0:
        rest -= min(max(along / length, 0.0), 1.0) * step
    square = 0.0
    for p in range(len(value)):
        for q in range(len(value)):
            square += rest[p] * information[p, q] * rest[q]
    return square


class _Field(NamedTuple):
    """The solution of a block, and how it follows its signals."""

    x: Array
    """(profile, crossing) ln extinction."""
    covariance: Array
    """(profile, crossing, crossing)."""
    respond: Callable[[Array], Array]
    """From a (profile or 1, beam, 2 passage, case) change of u and I to a (profile, crossing, case)
    one of x."""
    change: Change | None = None


def _solve_profiles(block: Block, mean: _Mean) -> tuple[_Signals, _Field, Booleans]:
    """Return the signals and the field of each profile, and for which (profile,) this is right."""
    signals, middle = mean.signals, mean.solution.logarithm[0]
    field = _changing(block, signals, middle)
    if np.mean((field.x - middle) ** 2, axis=1).max() < THRESHOLDS.linear_change**2:
        return signals, field, np.isfinite(field.x).all(axis=1) & mean.solution.settled
    half = _profiles_beside(mean.of_powers)
    means = _Means.of(mean.of_powers.scaled, block.layout, half)
    number, x, beams = running_sums(np.ones_like(field.x), half), field.x, means.condensed.beams
    constants = np.broadcast_to(mean.solution.constants, signals.reach.shape)
    for _ in range(_FIELD_PASSES):
        smooth = running_sums(x, half) / number
        linear = _beam_fit.linearise(beams, constants, beams.reach)
        constants = constants + _beam_fit.step(beams, linear, smooth, constants)[0]
        signals = means.signals(constants, signals.reach)
        field = _changing(block, signals, x.mean(axis=0), field.change)
        error = np.sqrt(np.diagonal(field.covariance, axis1=1, axis2=2))
        moved = (np.abs(field.x - x) / error).max(axis=1)
        x = field.x
        if moved.max() < THRESHOLDS.settled_share:
            break
    # Beyond this, the second order of a deviation from the running mean exceeds its error.
    bent = 0.5 * (x - running_sums(x, half) / number) ** 2 / error
    return signals, field, (moved < THRESHOLDS.settled_share) & (bent < 1.0).all(axis=1)


def _profiles_beside(means: _Means) -> int:
    """Return the number of profiles before and after each one that its running mean holds.

    Air that changes fast is not linear about a mean; noise is not linear about a profile alone.
    """
    beams, ratio = means.condensed.beams, means.ratio
    noise = np.diagonal(beams.covariance[0], axis1=1, axis2=2)[:, : beams.value.shape[2]]
    noise = noise * median(ratio, np.isfinite(ratio))[:, np.newaxis]
    return int(noise[noise > 0.0].mean() > THRESHOLDS.linear_noise**2)


def _changing(
    block: Block, signals: _Signals, middle: Array, former: Change | None = None
) -> _Field:
    """Return the field about a middle that changes as is likeliest, or as formerly."""
    normal, side = signals.linear.normal(signals.beams)
    rest = side - normal @ middle
    seen = np.flatnonzero((signals.reach > 0).any(axis=1))
    change = former
    if seen.size >= COMMON.fewest_profiles:
        change = _changing_field.likeliest_change(
            normal[seen].mean(axis=0), rest[seen] - rest[seen].mean(axis=0), block.roots,
            tuple(seen.tolist()),
        ) or former  # fmt: skip
    pull = -(block.prior @ middle)[:, np.newaxis]
    x, covariance = _changing_field.solve_changing(
        normal, rest[..., np.newaxis], block.prior, change, pull
    )

    def respond(changed: Array) -> Array:
        sides = np.broadcast_to(
            signals.linear.sides(signals.beams, changed), (*x.shape[:2], changed.shape[3])
        )
        return _changing_field.solve_changing(normal, sides, block.prior, change)[0]

    # Bins that are left out count in the mean alone.
    moved = x[..., 0] if change else np.zeros(x.shape[:2])
    return _Field(middle + moved, covariance, respond, change)


def _misfit(mean: _Mean, signals: _Signals, chi_square: Array, freedom: Array) -> float:
    """Return the chi-square over its degrees of freedom, at least 1.

    About the field, and of the beams alone: of the mean where all profiles are linear about it.
    """
    alone = chi_square[:, 0], freedom[:, 0]
    if len(signals.beams.value) == 1:
        solution = mean.solution
        parts = _beam_fit.compare(
            signals.beams, solution.linear, solution.logarithm, signals.beams.reach
        )
        alone = parts[0][:, 0], parts[1][:, 0]
    pairs = alone, (chi_square[:, 1], freedom[:, 1])
    return max(1.0, *(float(square.sum() / max(number.sum(), 1.0)) for square, number in pairs))


def _assess(
    block: Block, signals: _Signals, field: _Field, mean: _Mean, settled: Booleans
) -> Estimates:
    """Return the solution with its errors and tests."""
    out, measured = Estimates.missing(len(block.reach), block.layout), block.layout.measured
    out.settled[:] = settled
    beams, x, reach = signals.beams, field.x, signals.reach
    variance = np.diagonal(field.covariance, axis1=1, axis2=2)
    known = _beam_fit.seen(beams, reach) & (variance < THRESHOLDS.largest_variance)
    out.extinction[:, measured] = extinction = np.where(known, np.exp(x), np.nan)
    out.leave_out(block, reach)
    parts = _beam_fit.compare(beams, signals.linear, x, reach)
    out.chi_square[:], out.degrees_of_freedom[:] = parts
    misfit = _misfit(mean, signals, *(part[settled] for part in parts))
    out.variance[:, measured] = extinction**2 * misfit * variance
    out = out.with_response(block, signals.bins.response(block.layout, field.respond))
    overlap = THRESHOLDS.default_overlap_error * out.overlap
    out.overlap_error[:] = np.where(np.isfinite(out.extinction), out.extinction * overlap, np.nan)
    out.variance[:] += out.overlap_error**2
    return out
