"""Solution of a block of profiles as one field that changes slowly.

1. The mean of the powers of each beam gives the mean field and the constants of the beams.
2. The profiles deviate little from this mean, so that their deviations are linear, with weights
   that do not depend on their noise.
3. All profiles together give the field of each (`_changing_field`).
4. Where air moves, the mean of a block is too far from its profiles: each profile is linear about
   its own powers, or about a running mean where these are noisy, until the field stays.

A profile that disagrees with its neighbours before and after it is no part of steps 1 to 4. The
solution is linear in small changes of the signals, and states how it follows them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import special
from scipy.ndimage import convolve1d

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _beam_fit, _changing_field
from lidarops.retrieve.network._beam_fit import Linear, Solution, product
from lidarops.retrieve.network._beam_signals import Block, Causes, Estimates, Response
from lidarops.retrieve.network._changing_field import Change, Posterior
from lidarops.retrieve.network._condensed_signals import (
    Beams,
    CleanBeam,
    Condensed,
    FitLayout,
    condense,
    median,
)
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

_FIELD_PASSES: Final = 16


# Means of powers ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScaledBeam:
    """Powers of one beam in the profiles of a block, over their energies."""

    source: CleanBeam
    factor: Array
    """(bin,) logarithm of range^2 / overlap."""
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
        weight, source = self.weight, self.source
        kept = self.kept.astype(np.float64)
        total = running_sums(weight * kept, half)
        power = running_sums(weight * self.power, half) / total
        variance = running_sums(weight**2 * self.variance, half) / total**2
        known = (power > 0.0) & np.isfinite(variance)
        logs = np.where(known, source.exponent * (np.log(power) + self.factor), 0.0)
        noise = np.where(known, source.exponent**2 * variance / power**2, 0.0)
        doubt = np.zeros(logs.shape)
        if source.doubt.any():
            doubt = np.nan_to_num(running_sums(weight * kept * source.doubt, half) / total)
        place = source.start + np.arange(known.shape[1])
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
        ratio = self.power / np.where(mean.codes == GOOD, mean.power, 1.0)
        return np.where(known, self.source.exponent * (ratio - 1.0), 0.0)

    def noise_ratio(self, mean: CleanBeam) -> Array:
        """Return (profile,) variances of noise over those of a mean, for the bins of each."""
        place = np.arange(self.source.start, self.source.start + self.power.shape[1])
        inside = (place >= self.source.low) & (place < self.source.stops[:, np.newaxis])
        own = (self.variance * inside).sum(axis=1)
        ratio = own / np.where(inside & self.kept, mean.variance, 0.0).sum(axis=1)
        return np.where(np.isfinite(ratio) & (ratio > 0.0), ratio, np.inf)


def running_sums(values: Array, half: int | None) -> Array:
    """Return (1, item) sums of all profiles, or (profile, item) ones of those up to `half` away."""
    if half is None:
        return np.asarray(values.sum(axis=0, keepdims=True))
    return np.asarray(convolve1d(values, np.ones(2 * half + 1), axis=0, mode="constant"))


def _scale(beam: CleanBeam, layout: FitLayout, reach: Indices) -> ScaledBeam:
    """Return the powers of a beam over their energies, with weights for means.

    Parameters
    ----------
    beam : CleanBeam
    layout : FitLayout
    reach : (profile,) intp
        Number of passages in use.
    """
    depth = mean_depth(reach)
    complete = (reach >= depth) & (depth > 0)
    last = layout.first_passage[beam.number] + depth - 1
    stop = int(layout.window[last]) + layout.weights.shape[1] if depth else beam.low
    factor = layout.log_factor[beam.number, beam.start : beam.start + beam.logs.shape[1]]
    power, variance = beam.power, beam.variance
    bridged = beam.codes == BRIDGED
    if bridged.any():
        line = np.exp(beam.logs / beam.exponent - factor)
        power = np.where(bridged, line, power)
        variance = np.where(bridged, beam.noise * (line / beam.exponent) ** 2, variance)
    before = np.arange(power.shape[1]) < (beam.stops - beam.start)[:, np.newaxis]
    known = (beam.codes != LOST) | (before & (power <= 0.0))
    kept = known & (beam.codes != KEPT)
    if not kept[complete].all():
        kept |= known & (2 * kept[complete].sum(axis=0) < complete.sum())
    power, variance = np.where(kept, power, 0.0), np.where(kept, variance, 0.0)
    used = slice(beam.low - beam.start, stop - beam.start)
    inside = (before & kept)[:, used]
    part = power[:, used] * inside
    energy = part.sum(axis=1)
    if not inside.all():
        counted = complete & (energy > 0.0)
        first = (part[counted] / energy[counted, np.newaxis]).sum(axis=0) / counted.sum()
        energy = energy / (inside * first).sum(axis=1)
    energy = np.where(energy > 0.0, energy, np.inf)[:, np.newaxis]
    kept &= np.isfinite(energy)
    power, variance = power / energy, variance / energy**2
    noise = (variance[:, used] * inside).sum(axis=1)
    able = complete & np.isfinite(noise) & (noise > 0.0)
    weight = np.where(able, 1.0 / np.where(able, noise, 1.0), 0.0)[:, np.newaxis]
    return ScaledBeam(beam, factor, stop, energy, power, variance, kept, weight)


def mean_depth(reach: Indices) -> int:
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


class _Means(NamedTuple):
    """Means of the powers of a block: one, or running means for each profile."""

    scaled: list[ScaledBeam]
    beams: list[CleanBeam]
    condensed: Condensed
    shift: Array
    """(mean, beam, passage) errors of u by lines through curved signals."""
    curvature: Array
    """(mean, beam, passage) what these leave in the variance of u."""
    change: Array
    """(profile, beam, 2 passage) deviations of u and I of profiles from the means."""
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
        curved = error**2 > THRESHOLDS.profile_noise * noise
        left = noise + (THRESHOLDS.curvature_left * error) ** 2
        shift, curvature = np.where(curved, error, 0.0), np.where(curved, left, 0.0)
        _straighten(condensed.beams, shift, curvature)
        profiles = len(scaled[0].power)
        change = np.zeros((profiles, *condensed.beams.covariance.shape[1:3]))
        for b, (each, mean) in enumerate(zip(scaled, means, strict=True)):
            deviations = each.deviations(mean)[..., np.newaxis]
            change[:, b] = product(condensed.derivatives[b], deviations)[..., 0]
        ratios = [each.noise_ratio(mean) for each, mean in zip(scaled, means, strict=True)]
        return cls(scaled, means, condensed, shift, curvature, change, np.stack(ratios, axis=1))

    def signals(
        self, constants: Array, reach: Indices, x: Array | None = None
    ) -> tuple[_Signals, Array]:
        """Return the signals of all profiles, linear about constants, and these.

        The constants are those given, or nearer to (profile, crossing) ln extinction.
        """
        beams = self.condensed.beams
        reach = np.where(np.isfinite(self.ratio), np.minimum(reach, beams.reach), 0)
        *_, constants, linear, _ = _beam_fit.linearise(beams, constants, reach, x)
        linear.value[:] += product(linear.turn, self.change[..., np.newaxis])[..., 0]
        # Errors by curvature are those of the mean, and count as its noise does.
        linear.information[:] /= self.ratio[..., np.newaxis, np.newaxis]
        energies = [each.energy for each in self.scaled]
        bins = Bins(len(reach), self.condensed, self.beams, energies)
        return _Signals(bins, beams, linear, reach), constants


def _straighten(beams: Beams, shift: Array, curvature: Array) -> None:
    """Correct values of curved signals in place, and add what is left of these to the noise."""
    beams.value[:] -= shift
    place = np.arange(curvature.shape[2])
    beams.covariance[..., place, place] += curvature


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
                    out[:, b, :, c] = product(derivatives[b], logs[..., np.newaxis])[..., 0]
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

    def about_mean(self, mean: Array) -> tuple[Array, Array]:
        """Return normal matrices, and right sides less those of a mean field."""
        normal, side = self.linear.normal(self.beams)
        return normal, side - product(normal, mean[:, np.newaxis])[..., 0]


# Blocks ------------------------------------------------------------------------------------------


def solve_alone(block: Block) -> Estimates:
    """Solve each profile without a prior."""
    out = Estimates.of_block(block)
    condensed = condense_alone(block)
    beams, measured = condensed.beams, block.layout.measured
    start = _beam_fit.start_constants(beams, block.lengths)
    nothing = np.zeros((beams.crossings, beams.crossings))
    solved = _beam_fit.fit_beams(beams, nothing, start)
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
        return product(solved.covariance, solved.linear.sides(beams, change))

    return out.with_response(block, bins_alone(block, condensed).response(block.layout, respond))


def condense_alone(block: Block) -> Condensed:
    """Return the signals of each profile, with the curvature that the mean of the block shows."""
    condensed = condense(block.beams, block.layout, block.reach)
    scaled = [_scale(*each) for each in block.each_beam(block.reach)]
    means = _Means.of(scaled, block.layout)
    _straighten(condensed.beams, means.shift, means.curvature)
    return condensed


def bins_alone(block: Block, condensed: Condensed) -> Bins:
    """Return how profiles follow their own bins."""
    return Bins(len(block.reach), condensed, block.beams, [np.ones((1, 1))] * len(block.beams))


def solve_block(block: Block) -> Estimates:
    """Solve a block as one field."""
    mean = _solve_mean(block, block.reach)
    if mean is None:
        out = Estimates.of_block(block)
        out.leave_out(block, np.zeros_like(block.reach))
        return out
    odd = _disagreeing(mean.signals)
    if odd.any():
        mean = _solve_mean(block, np.where(odd[:, np.newaxis], 0, block.reach)) or mean
    signals, field, alone, settled = _solve_profiles(block, mean)
    out = _assess(block, signals, field, mean, alone)
    out.left_out[odd] = False
    out.settled[:] = settled & np.isfinite(field.x).all(axis=1) & ~odd
    return out


class _Mean(NamedTuple):
    """The mean field of a block, and the profiles about it."""

    of_powers: _Means
    solution: Solution
    posterior: Posterior
    prior: Array
    """(crossing, crossing) precision of ln extinction."""
    signals: _Signals


def _solve_mean(block: Block, reach: Indices) -> _Mean | None:
    """Return the mean field of the profiles with a reach; None where no beam has two passages."""
    scaled = [_scale(*each) for each in block.each_beam(reach)]
    means = _Means.of(scaled, block.layout)
    if not means.condensed.beams.reach.any():
        return None
    beams = means.condensed.beams
    constants = _beam_fit.start_constants(beams, block.lengths)
    first = _beam_fit.fit_beams(beams, block.priors.widest, constants)
    posterior = block.priors.posterior(beams, first)
    prior = posterior.expected(block.priors)
    solution = _beam_fit.fit_beams(beams, prior, first.constants)
    signals, _ = means.signals(solution.constants, reach)
    return _Mean(means, solution, posterior, prior, signals)


def _disagreeing(signals: _Signals) -> Booleans:
    """Return (profile,) whether a beam is unlike those of the profiles before and after it.

    Signals may be anywhere between those before and after, or on the way that either of them goes.
    What is left is compared with noise, and with what typically changes between other profiles.
    """
    inside = np.arange(signals.linear.value.shape[2]) < signals.reach[..., np.newaxis]
    value = np.where(inside, signals.linear.value, np.nan)
    before, onward = _neighbours(value)
    after, back = (each[::-1] for each in _neighbours(value[::-1]))
    segments = (before, after), (before, onward), (after, back)
    information = signals.linear.information
    square = np.fmin.reduce([_apart(information, value, *ends) for ends in segments])
    freedom = np.maximum(signals.reach - 1, 1)
    last = np.concatenate([np.full_like(value[:1], np.nan), value[:-1]])
    step = 0.5 * _apart(information, value, last, last) / freedom
    known = np.isfinite(step) & (signals.reach > 1)
    above = square / special.chdtri(freedom, THRESHOLDS.least_neighbourly)
    odd = np.asarray((above > 1.0).any(axis=1))
    for n in np.flatnonzero(odd):
        # In a short block, the steps to and from a bad profile would be typical.
        others = known.copy()
        others[n : n + 2] = False
        odd[n] = (above[n] > np.fmax(median(step, others), 1.0)).any()
    return odd


def _neighbours(value: Array) -> tuple[Array, Array]:
    """Return medians of the profiles before each one, and these continued; NaN without any."""
    number, profiles = THRESHOLDS.neighbours, len(value)
    padded = np.concatenate([np.full((2 * number, *value.shape[1:]), np.nan), value])
    earlier = np.stack([padded[k : k + number + profiles] for k in range(number)])
    medians = median(earlier.reshape(number, -1), np.isfinite(earlier).reshape(number, -1))
    far, near = (medians.reshape(-1, *value.shape[1:])[k : k + profiles] for k in (0, number))
    return near, np.where(np.isfinite(far), 2.0 * near - far, near)


def _apart(information: Array, value: Array, start: Array, stop: Array) -> Array:
    """Return (profile, beam) chi-squares about the nearest point between two fields."""
    rest, step = np.nan_to_num(value - start), np.nan_to_num(stop - start)
    weighted = product(information, step[..., np.newaxis])[..., 0]
    length, along = ((each * weighted).sum(axis=2) for each in (step, rest))
    share = np.clip(along / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    rest = rest - share[..., np.newaxis] * step
    known = np.isfinite(start[..., 0]) & np.isfinite(stop[..., 0])
    square = (rest * product(information, rest[..., np.newaxis])[..., 0]).sum(axis=2)
    return np.where(known, square, np.nan)


def _solve_profiles(block: Block, mean: _Mean) -> tuple[_Signals, _Field, Solution, Booleans]:
    """Return the signals and the field of each profile, and the fit of the means of these alone.

    The last array tells for which (profile or 1,) profiles the solution converged.
    """
    signals, middle = mean.signals, mean.solution.logarithm[0]
    field = _changing(block, signals, mean, middle)
    if _difference(field.x, field.x.mean(axis=0)) < THRESHOLDS.linear_change:
        return signals, field, mean.solution, mean.solution.settled
    half = _profiles_beside(mean.of_powers)
    means = _Means.of(mean.of_powers.scaled, block.layout, half)
    beams = means.condensed.beams
    alone = _beam_fit.fit_beams(beams, mean.prior, _beam_fit.start_constants(beams, block.lengths))
    x, number = alone.logarithm, running_sums(np.ones_like(alone.logarithm), half)
    x, constants = np.where(np.isfinite(x), x, middle), np.nan_to_num(alone.constants)
    share, left = 1.0, np.inf
    for _ in range(_FIELD_PASSES):
        smooth = running_sums(x, half) / number
        signals, constants = means.signals(constants, mean.signals.reach, smooth)
        field = _changing(block, signals, mean, x.mean(axis=0), field.change)
        last, left = left, _difference(field.x, x)
        settled = np.sqrt(np.mean((field.x - x) ** 2, axis=1)) < THRESHOLDS.linear_change
        if left < THRESHOLDS.linear_change:
            settled[:] = True
            break
        # A front may be missed in turns on either side.
        share *= 0.5 if left >= last else 1.0
        x = x + share * (field.x - x)
    return signals, field, alone, settled


def _profiles_beside(means: _Means) -> int:
    """Return the number of profiles before and after each one that its running mean holds.

    Air that changes fast is not linear about a mean; noise is not linear about a profile alone.
    """
    beams, ratio = means.condensed.beams, means.ratio
    inside = np.arange(beams.value.shape[2]) < beams.reach[0][:, np.newaxis]
    noise = np.diagonal(beams.covariance[0], axis1=1, axis2=2)[:, : inside.shape[1]]
    noise = (noise - means.curvature[0]) * median(ratio, np.isfinite(ratio))[:, np.newaxis]
    alone = noise[inside].mean() < THRESHOLDS.linear_noise**2
    return 0 if alone else THRESHOLDS.running_profiles // 2


def _misfit(beams: Beams, alone: Solution) -> float:
    """Return the chi-square of means over its degrees of freedom, at least 1."""
    parts = _beam_fit.compare(beams, alone.linear, alone.logarithm, beams.reach)
    chi_square, freedom = (part[:, 0] for part in parts)
    tested = alone.settled & (freedom > 0)
    return max(float(chi_square[tested].sum() / max(freedom[tested].sum(), 1.0)), 1.0)


def _difference(x: Array, other: Array) -> float:
    """Return the root mean square difference of fields."""
    return float(np.sqrt(np.mean((x - other) ** 2)))


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


def _changing(
    block: Block, signals: _Signals, mean: _Mean, middle: Array, former: Change | None = None
) -> _Field:
    """Return the field about a middle that changes as is likeliest, or as formerly."""
    normal, rest = signals.about_mean(middle)
    seen = np.flatnonzero((signals.reach > 0).any(axis=1))
    change = _likeliest_change(block, normal[seen], rest[seen], tuple(seen.tolist())) or former
    if change is None:
        return _steady(mean, len(signals.reach))
    pull = -product(mean.prior, middle[:, np.newaxis])
    x, covariance = _changing_field.solve_changing(
        normal, rest[..., np.newaxis], mean.prior, change, pull
    )

    def respond(changed: Array) -> Array:
        sides = signals.linear.sides(signals.beams, changed)
        return _changing_field.solve_changing(normal, sides, mean.prior, change)[0]

    return _Field(middle + x[..., 0], covariance, respond, change)


def _likeliest_change(
    block: Block, normal: Array, rest: Array, seen: tuple[int, ...]
) -> Change | None:
    """Return how the profiles that are seen change about a mean field; None where they do not."""
    if not seen:
        return None
    return _changing_field.likeliest_change(
        normal.mean(axis=0), rest - rest.mean(axis=0), block.priors.roots, seen
    )


def _steady(mean: _Mean, profiles: int) -> _Field:
    """Return the field of the mean for all profiles."""
    solution, beams = mean.solution, mean.signals.beams
    shape = profiles, beams.crossings
    weight = np.stack([each.weight[:, 0] for each in mean.of_powers.scaled], axis=1)
    share = (weight / np.maximum(weight.sum(axis=0), 1e-300))[..., np.newaxis, np.newaxis]

    def respond(change: Array) -> Array:
        # A change that is the same in all profiles is that of the mean.
        of_mean = change if len(change) == 1 else (share * change).sum(axis=0, keepdims=True)
        response = product(solution.covariance, solution.linear.sides(beams, of_mean))
        return np.broadcast_to(response, (*shape, change.shape[3]))

    return _Field(
        np.broadcast_to(solution.logarithm, shape),
        np.broadcast_to(solution.covariance, (*shape, shape[1])), respond,
    )  # fmt: skip


def _assess(
    block: Block, signals: _Signals, field: _Field, mean: _Mean, alone: Solution
) -> Estimates:
    """Return the solution with its errors and tests."""
    out, measured = Estimates.of_block(block), block.layout.measured
    beams, x, reach = signals.beams, field.x, signals.reach
    # The covariance of the mean field is that with one prior.
    missing = mean.posterior.square_error(mean.solution.logarithm[0])
    missing = np.maximum(missing - np.diagonal(mean.solution.covariance[0]), 0.0)
    seen = _beam_fit.seen(beams, reach)
    variance = np.diagonal(field.covariance, axis1=1, axis2=2)
    extinction = np.exp(x)
    extinction[~(seen & (variance < THRESHOLDS.largest_variance))] = np.nan
    out.extinction[:, measured] = extinction
    relative = _misfit(signals.beams, alone) * variance + missing
    out.variance[:, measured] = extinction**2 * relative
    out.leave_out(block, reach)
    parts = _beam_fit.compare(beams, signals.linear, x, reach)
    out.chi_square[:], out.degrees_of_freedom[:] = parts
    out.deviation[:] = block.priors.deviation[np.argmax(mean.posterior.weight)]
    out = out.with_response(block, signals.bins.response(block.layout, field.respond))
    overlap = THRESHOLDS.default_overlap_error * out.overlap
    out.overlap_error[:] = np.where(np.isfinite(out.extinction), out.extinction * overlap, np.nan)
    out.variance[:] += out.overlap_error**2
    return out
