"""Solution of a block of profiles as one field that changes slowly.

1. The mean of the powers of each beam gives the mean field and the constants of the beams.
2. The profiles deviate little from this mean, so that their deviations are linear, with weights
   that do not depend on their noise.
3. All profiles together give the field of each (`_changing_field`).
4. Where air moves, the mean of a block is too far from its profiles: each profile is linear about
   a running mean of the powers, each changed to the field of the profile, until the field stays.

A profile that disagrees with its neighbours before and after it is no part of steps 1 to 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _beam_fit, _changing_field, _matrices
from lidarops.retrieve.network._beam_fit import Beams, Linear, Solution
from lidarops.retrieve.network._changing_field import (
    Change,
    ChangingField,
    MeanPosterior,
    MeanPriors,
)
from lidarops.retrieve.network._condensed_signals import CleanBeam, FitLayout, condense, median
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

_CONSTANT_PASSES: Final = 6
_FIELD_PASSES: Final = 6


# Means of powers ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScaledBeam:
    """Powers of one beam in the profiles of a block, over their energies."""

    source: CleanBeam
    factor: Array
    """(bin,) logarithm of range^2 / overlap."""
    power: Array
    """(profile, bin) 0 where left out."""
    variance: Array
    """(profile, bin) 0 where left out."""
    kept: Booleans
    """(profile, bin) False where left out."""
    doubt: Array
    """(profile, bin) logarithmic deviations of outlying bins that are not left out."""
    shape: Array
    """(profile, bin) logarithmic change by the field of a profile, which the powers are without."""
    weight: Array
    """(profile,) of a mean; 0 where a profile is no part of it."""

    def mean(self, shares: Array, stop: int) -> CleanBeam:
        """Return means as profiles of a beam.

        Parameters
        ----------
        shares : (mean, profile) float64
            How much each profile counts, beside its weight.
        stop : int
            The bin behind the last one in use.
        """
        weights, source = shares * self.weight, self.source
        total = _sums(weights, self.kept)
        gain = np.exp(self.shape) if len(weights) > 1 else 1.0
        power = gain * _sums(weights, self.power) / total
        variance = gain**2 * _sums(weights**2, self.variance) / total**2
        known = (power > 0.0) & np.isfinite(variance)
        logs = np.where(known, source.exponent * (np.log(power) + self.factor), 0.0)
        noise = np.where(known, source.exponent**2 * variance / power**2, 0.0)
        doubt = np.nan_to_num(_sums(weights, self.doubt) / total)
        place = source.start + np.arange(known.shape[1])
        lost = ~known & (place >= source.low) & (place < stop)
        stops = np.where(lost.any(axis=1), source.start + np.argmax(lost, axis=1), stop)
        codes = np.where(known, GOOD, LOST).astype(np.uint8)
        return CleanBeam(
            source.number, source.start, source.low, power, variance, logs, noise, doubt, codes,
            stops, np.zeros(len(logs), dtype=np.uint8), source.exponent,
        )  # fmt: skip

    def deviations(self, mean: CleanBeam) -> Array:
        """Return (profile, bin) deviations of logarithms from one mean, or one for each profile."""
        known = self.kept & (mean.codes == GOOD)
        ratio = np.exp(self.shape) * self.power / np.where(mean.codes == GOOD, mean.power, 1.0)
        return np.where(known, self.source.exponent * (ratio - 1.0), 0.0)

    def noise_ratio(self, mean: CleanBeam) -> Array:
        """Return (profile,) variances of noise over those of a mean, for the bins of each."""
        own, start = self.source.stops - self.source.start, self.source.low - self.source.start
        sums = [
            np.concatenate([np.zeros((len(own), 1)), np.cumsum(values, axis=1)], axis=1)
            for values in (np.exp(2.0 * self.shape) * self.variance, self.kept * mean.variance)
        ]
        rows = np.arange(len(own))
        part, whole = (total[rows, own] - total[:, start] for total in sums)
        return np.asarray(part / whole)


def _sums(weights: Array, values: Array | Booleans) -> Array:
    """Return (mean, bin) sums over profiles, whose bits do not depend on the number of threads."""
    return np.asarray(np.einsum("mt,tb->mb", weights, values.astype(np.float64)))


def _scale(
    beam: CleanBeam, layout: FitLayout, complete: Booleans, stop: int, shape: Array | None = None
) -> ScaledBeam:
    """Return the powers of a beam over their energies, with weights for means.

    Parameters
    ----------
    beam : CleanBeam
    layout : FitLayout
    complete : (profile,) bool
        Which profiles may count in a mean.
    stop : int
        The bin behind the last one that a mean uses.
    shape : (profile, bin) float64, optional
        Logarithmic change of the power by the field of each profile; 0 where not given.
    """
    factor = layout.log_factor[beam.number, beam.start : beam.start + beam.logs.shape[1]]
    power, variance = beam.power, beam.variance
    bridged = beam.codes == BRIDGED
    if bridged.any():
        line = np.exp(beam.logs / beam.exponent - factor)
        power = np.where(bridged, line, power)
        variance = np.where(bridged, beam.noise * (line / beam.exponent) ** 2, variance)
    shape = np.zeros_like(power) if shape is None else shape
    power, variance = power * np.exp(-shape), variance * np.exp(-2.0 * shape)
    before = np.arange(power.shape[1]) < (beam.stops - beam.start)[:, np.newaxis]
    known = (beam.codes != LOST) | (before & (power <= 0.0))
    kept = known & (beam.codes != KEPT)
    if not kept[complete].all():
        kept |= known & (2 * kept[complete].sum(axis=0) < complete.sum())
    power, variance = np.where(kept, power, 0.0), np.where(kept, variance, 0.0)
    used = slice(beam.low - beam.start, max(stop, beam.low) - beam.start)
    inside = before & kept
    inside[:, : used.start], inside[:, used.stop :] = False, False
    energy = (power * inside).sum(axis=1)
    if not inside.all(axis=1).all():
        counted = complete & (energy > 0.0)
        first = (power[counted] / energy[counted, np.newaxis]).sum(axis=0) / counted.sum()
        energy = energy / (inside * first).sum(axis=1)
    energy = np.where(energy > 0.0, energy, np.nan)[:, np.newaxis]
    power, variance = power / energy, variance / energy**2
    noise = (variance * inside).sum(axis=1)
    able = complete & np.isfinite(noise) & (noise > 0.0)
    if able.any():
        able &= noise <= THRESHOLDS.noisy_profile * np.median(noise[able])
    weight = np.where(able, 1.0 / np.where(able, noise, 1.0), 0.0)
    doubt = np.where(kept, beam.doubt, 0.0)
    finite = np.isfinite(energy)
    return ScaledBeam(
        beam, factor, np.where(finite, power, 0.0), np.where(finite, variance, 0.0),
        kept & finite, doubt, shape, weight,
    )  # fmt: skip


# Blocks ------------------------------------------------------------------------------------------


class Block(NamedTuple):
    """The beams of the profiles of a block."""

    beams: list[CleanBeam]
    layout: FitLayout
    usable: Booleans
    """(profile, passage)."""
    lengths: Array
    """(beam, passage) `_beam_fit.optical_lengths`."""
    position: Array
    """(crossing, 3) m, of the measured crossings."""
    priors: MeanPriors


class _Signals(NamedTuple):
    """Signals of all profiles, linear about means."""

    beams: Beams
    """Of the means: one, or one for each profile."""
    linear: Linear
    """Of each profile."""
    derivatives: list[Array]
    """For each beam, (mean, 2 passage - 1, bin)."""
    curvature: Array
    """(mean, beam, passage) variance of u by curved signals within a fit."""
    reach: Indices
    """(profile, beam)."""
    change: Array
    """(profile, beam, 2 passage) deviations of u and I from the means."""

    def normal(self) -> tuple[Array, Array]:
        """Return normal matrices and right sides of the profiles."""
        return self.linear.normal(self.beams)


def reaches(usable: Booleans, layout: FitLayout) -> Indices:
    """Return (profile, beam) numbers of usable passages before the first one that is not."""
    first = layout.first_passage
    return np.stack(
        [
            np.logical_and.accumulate(usable[:, a:b], axis=1).sum(axis=1)
            for a, b in itertools.pairwise(first)
            if b > a
        ],
        axis=1,
    ).astype(np.intp)


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


class BlockSolution(NamedTuple):
    """The field of a block, at the measured crossings."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1; NaN where no usable beam of a profile passes."""
    variance: Array
    """(profile, crossing) by noise and prior."""
    further: Array
    """(profile, crossing) variance by other levels, and by curved signals within a fit."""
    overlap: Array
    """(profile, crossing) change by overlap errors of 1 at the near ends of beams."""
    left_out: Booleans
    """(profile, beam) True where a beam has no weight."""
    chi_square: Array
    """(profile, 2) of the beams alone, and about the field."""
    freedom: Array
    """(profile, 2) of these."""
    misfit: tuple[float, float]
    """Chi-square of the mean, and its degrees of freedom."""
    settled: Booleans
    """(profile,) False where the mean did not converge, or a profile is unlike its neighbours."""
    deviation: float
    """Standard deviation of ln extinction in single volumes of air, by the prior."""


def solve_block(block: Block) -> BlockSolution | None:
    """Solve a block; None where no beam has two passages."""
    reach = reaches(block.usable, block.layout)
    mean = _solve_mean(block, reach)
    if mean is None:
        return None
    odd = _disagreeing(mean.signals)
    if odd.any():
        mean = _solve_mean(block, np.where(odd[:, np.newaxis], 0, reach)) or mean
    signals, field = _solve_profiles(block, mean)
    solved = _assess(block, signals, field, mean)
    solved.left_out[odd] = False
    settled = solved.settled & np.isfinite(field.x).all(axis=1) & ~odd
    return solved._replace(settled=settled)


class _Mean(NamedTuple):
    """The mean field of a block, and the profiles about it."""

    scaled: list[ScaledBeam]
    stops: list[int]
    """The bins behind the last ones that means use."""
    solution: Solution
    posterior: MeanPosterior
    prior: Array
    """(crossing, crossing) precision of ln extinction."""
    signals: _Signals


def _solve_mean(block: Block, reach: Indices) -> _Mean | None:
    """Return the mean field of the profiles with a reach; None where no beam has two passages."""
    layout = block.layout
    scaled, stops = [], []
    for b, beam in enumerate(block.beams):
        depth = mean_depth(reach[:, b])
        last = layout.first_passage[beam.number] + max(depth, 1) - 1
        stops.append(int(layout.window[last]) + layout.weights.shape[1] if depth else beam.low)
        complete = (reach[:, b] >= depth) & (depth > 0)
        scaled.append(_scale(beam, layout, complete, stops[-1]))
    whole = np.ones((1, len(reach)))
    means = [each.mean(whole, stop) for each, stop in zip(scaled, stops, strict=True)]
    beams, derivatives, curvature = _arrange_means(means, layout)
    if not beams.reach.any():
        return None
    curved = _with_curvature(beams, curvature)
    constants = _beam_fit.start_constants(beams, block.lengths)
    first = _beam_fit.fit_beams(curved, block.priors.widest, constants)
    posterior = block.priors.posterior(curved, first)
    prior = posterior.expected(block.priors)
    solution = _beam_fit.fit_beams(curved, prior, first.constants)
    signals = _about(beams, solution.constants, derivatives, curvature, reach, scaled, means)
    return _Mean(scaled, stops, solution, posterior, prior, signals)


def _disagreeing(signals: _Signals) -> Booleans:
    """Return (profile,) whether a beam is unlike those of the profiles before and after it.

    Signals may be anywhere between those before and after, or on the way that either of them goes.
    What is left is compared with noise, and with what typically changes from profile to profile.
    """
    known = np.arange(signals.change.shape[2]) % signals.beams.value.shape[2]
    change = np.where(known < signals.reach[..., np.newaxis], signals.change, np.nan)
    before, onward = _neighbours(change)
    after, back = (each[::-1] for each in _neighbours(change[::-1]))
    segments = (before, after), (before, onward), (after, back)
    square = np.fmin.reduce([_apart(signals, change, *ends) for ends in segments])
    freedom = np.maximum(signals.reach - 1, 1)
    last = np.concatenate([np.full_like(change[:1], np.nan), change[:-1]])
    step = 0.5 * _apart(signals, change, last, last) / freedom
    typical = np.nan_to_num(median(step, np.isfinite(step) & (signals.reach > 1)))
    limit = special.chdtri(freedom, THRESHOLDS.least_neighbourly)
    return np.asarray((square > limit * np.maximum(typical, 1.0)).any(axis=1))


def _neighbours(change: Array) -> tuple[Array, Array]:
    """Return medians of the profiles before each one, and these continued; NaN without any."""
    number, profiles = THRESHOLDS.neighbours, len(change)
    padded = np.concatenate([np.full((2 * number, *change.shape[1:]), np.nan), change])
    earlier = np.stack([padded[k : k + number + profiles] for k in range(number)])
    medians = median(earlier.reshape(number, -1), np.isfinite(earlier).reshape(number, -1))
    far, near = (medians.reshape(-1, *change.shape[1:])[k : k + profiles] for k in (0, number))
    return near, np.where(np.isfinite(far), 2.0 * near - far, near)


def _apart(signals: _Signals, change: Array, start: Array, stop: Array) -> Array:
    """Return (profile, beam) chi-squares about the nearest point between two changes."""
    rest, step = (
        np.einsum("tbpq,tbq->tbp", signals.linear.turn, np.nan_to_num(each))
        for each in (change - start, stop - start)
    )

    def product(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("tbp,tbpq,tbq->tb", a, signals.linear.information, b))

    length = product(step, step)
    share = np.clip(product(rest, step) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    rest = rest - share[..., np.newaxis] * step
    known = np.isfinite(start[..., 0]) & np.isfinite(stop[..., 0])
    return np.where(known, product(rest, rest), np.nan)


def _solve_profiles(block: Block, mean: _Mean) -> tuple[_Signals, _Field]:
    """Return the field of each profile, and the signals that it follows."""
    signals, middle = mean.signals, mean.solution.logarithm[0]
    change = _likeliest_change(signals, block.position, middle)
    if change is None:
        return signals, _steady(mean.solution, signals.beams, len(signals.reach))
    field = _changing(signals, change, mean.prior, middle)
    if _difference(field.x, field.x.mean(axis=0)) < THRESHOLDS.linear_change:
        return signals, field
    x = _start(block, mean)
    for _ in range(_FIELD_PASSES):
        signals, before, middle = _about_fields(block, mean, x), x, x.mean(axis=0)
        change = _likeliest_change(signals, block.position, middle) or change
        field = _changing(signals, change, mean.prior, middle)
        x = field.x
        if not _difference(x, before) >= THRESHOLDS.linear_change:
            break
    return signals, field


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
    """From a (case, beam, 2 passage) change of u and I to a (profile, crossing, case) one of x."""
    curved: float
    """Share of the errors of curved signals that the covariance leaves out."""


def _steady(mean: Solution, beams: Beams, profiles: int) -> _Field:
    """Return the field of the mean for all profiles."""
    shape = profiles, beams.crossings

    def respond(change: Array) -> Array:
        sides = _beam_fit.changed_sides(mean.linear, beams, change)
        response = _matrices.product(mean.covariance, sides)
        return np.broadcast_to(response, (*shape, len(change)))

    return _Field(
        np.broadcast_to(mean.logarithm, shape),
        np.broadcast_to(mean.covariance, (*shape, shape[1])), respond, 0.0,
    )  # fmt: skip


def _changing(signals: _Signals, change: Change, prior: Array, mean: Array) -> _Field:
    """Return the field about a mean that changes as stated."""
    normal, rest = _about_mean(signals, mean)
    field = ChangingField(normal, prior, change)
    pull = -_matrices.product(prior, mean[:, np.newaxis])
    x, covariance = field.solve(rest[..., np.newaxis], pull)

    def respond(changed: Array) -> Array:
        return field.solve(_beam_fit.changed_sides(signals.linear, signals.beams, changed))[0]

    # Curved signals are alike in all profiles, which count them as noise.
    seen = np.sum((signals.reach > 0).any(axis=1))
    return _Field(mean + x[..., 0], covariance, respond, 1.0 - 1.0 / float(seen))


def _likeliest_change(signals: _Signals, position: Array, mean: Array) -> Change | None:
    """Return how the profiles change about a mean field; None where they do not."""
    normal, rest = _about_mean(signals, mean)
    seen = np.flatnonzero((signals.reach > 0).any(axis=1))
    if not seen.size:
        return None
    normal, rest = normal[seen], rest[seen]
    return _changing_field.likeliest_change(
        normal.mean(axis=0), rest - rest.mean(axis=0), position, tuple(seen.tolist())
    )


def _about_mean(signals: _Signals, mean: Array) -> tuple[Array, Array]:
    """Return normal matrices, and right sides less those of a mean field."""
    normal, side = signals.normal()
    return normal, side - _matrices.product(normal, mean[:, np.newaxis])[..., 0]


def _typical(ratio: Array) -> Array:
    """Return (1, beam) medians over profiles of the finite ratios; 1 where there is none."""
    middle = median(np.where(np.isfinite(ratio), ratio, 1.0), np.isfinite(ratio))
    return np.where(np.isfinite(middle), middle, 1.0)[np.newaxis]


def _with_curvature(beams: Beams, curvature: Array, ratio: Array | float = 1.0) -> Beams:
    """Return means with a multiple of their noise, and curved signals as noise."""
    covariance = beams.covariance * np.asarray(ratio)[..., np.newaxis, np.newaxis]
    place = np.arange(curvature.shape[2])
    covariance[..., place, place] += curvature
    return beams._replace(covariance=covariance)


def _arrange_means(means: list[CleanBeam], layout: FitLayout) -> tuple[Beams, list[Array], Array]:
    """Return means of powers, condensed, the derivatives of each beam by its bins, and curvature.

    Where a signal is curved beyond noise, the polynomial replaces the straight line. Curvature is
    the (mean, beam, passage) variance that this adds to a value. A mean ends where its own noise
    hides the signal.
    """
    data, derivatives = condense(means, layout)
    clear = np.concatenate([mean.clear(layout) for mean in means], axis=1)
    beams = _beam_fit.arrange(data, layout, reaches(data.usable & clear, layout))
    error, noise = np.moveaxis(data.curvature_error, -1, 0)
    curved = data.usable & (error**2 > THRESHOLDS.profile_noise * noise)
    curvature = np.zeros(beams.value.shape)
    beam, place = _beam_fit.places(layout)
    beams.value[:, beam, place] -= np.where(curved, error, 0.0)
    left = noise + (THRESHOLDS.curvature_left * error) ** 2
    curvature[:, beam, place] = np.where(curved, left, 0.0)
    return beams, derivatives, curvature


def _about(
    beams: Beams, constants: Array, derivatives: list[Array], curvature: Array, reach: Indices,
    scaled: list[ScaledBeam], means: list[CleanBeam],
) -> _Signals:  # fmt: skip
    """Return the signals of all profiles, linear about one mean or one for each profile."""
    most = beams.value.shape[2]
    profiles = len(reach)
    change = np.zeros((profiles, len(scaled), 2 * most))
    ratio = np.zeros((profiles, len(scaled)))
    for b, (each, mean, derivative) in enumerate(zip(scaled, means, derivatives, strict=True)):
        count = (derivative.shape[1] + 1) // 2
        into = np.r_[:count, most : most + count - 1]
        deviations = each.deviations(mean)
        if len(derivative) == 1:
            change[:, b, into] = _matrices.product(deviations, derivative[0].T)
        else:
            change[:, b, into] = _matrices.product(derivative, deviations[..., np.newaxis])[..., 0]
        ratio[:, b] = each.noise_ratio(mean)
    ratio = np.where(np.isfinite(ratio) & (ratio > 0.0), ratio, np.inf)
    reach = np.where(np.isfinite(ratio), np.minimum(reach, beams.reach), 0)
    alone = len(beams.value) == 1
    typical = _typical(ratio) if alone else np.where(np.isfinite(ratio), ratio, 1.0)
    noisy = _with_curvature(beams, curvature, typical)
    if alone:
        patterns, index = np.unique(reach, axis=0, return_inverse=True)
        linear = _beam_fit.linearise(noisy, constants, patterns)
        linear = Linear(*(each[index.ravel()] for each in linear))
    else:
        linear = _beam_fit.linearise(noisy, constants, reach)
    value = linear.value + _matrices.product(linear.turn, change[..., np.newaxis])[..., 0]
    information = linear.information * (typical / ratio)[..., np.newaxis, np.newaxis]
    linear = linear._replace(value=value, information=information)
    return _Signals(beams, linear, derivatives, curvature, reach, change)


def _shares(profiles: int) -> Array:
    """Return (profile, profile) shares of running means."""
    place = np.arange(profiles)
    apart = np.abs(place[:, np.newaxis] - place)
    return np.asarray(apart <= THRESHOLDS.running_profiles // 2, dtype=np.float64)


def _running_means(scaled: list[ScaledBeam], mean: _Mean) -> list[CleanBeam]:
    """Return means of the powers of neighbours for each profile."""
    shares = _shares(len(mean.signals.reach))
    return [each.mean(shares, stop) for each, stop in zip(scaled, mean.stops, strict=True)]


def _start(block: Block, mean: _Mean) -> Array:
    """Return (profile, crossing) fields of running means, each solved alone."""
    beams, _, curvature = _arrange_means(_running_means(mean.scaled, mean), block.layout)
    constants = _beam_fit.start_constants(beams, block.lengths)
    x = _beam_fit.fit_beams(_with_curvature(beams, curvature), mean.prior, constants).logarithm
    return np.where(np.isfinite(x), x, mean.solution.logarithm)


def _about_fields(block: Block, mean: _Mean, x: Array) -> _Signals:
    """Return the signals of all profiles, each about a running mean changed to its field."""
    layout, reach = block.layout, mean.signals.reach
    shares = _shares(len(x))
    shares = shares / shares.sum(axis=1, keepdims=True)
    smooth = _sums(shares, x)
    scaled = []
    for b, (beam, stop) in enumerate(zip(block.beams, mean.stops, strict=True)):
        shape = _shape(block, mean.signals.beams.crossing[b], b, smooth)
        depth = mean_depth(reach[:, b])
        complete = (reach[:, b] >= depth) & (depth > 0)
        scaled.append(_scale(beam, layout, complete, stop, shape))
    means = _running_means(scaled, mean)
    beams, derivatives, curvature = _arrange_means(means, layout)
    last = np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    along = (smooth + _sums(shares, x - smooth))[:, beams.crossing]
    constants = np.take_along_axis(beams.value - along, last, axis=2)[..., 0]
    for _ in range(_CONSTANT_PASSES):
        linear = _beam_fit.linearise(beams, constants)
        step = (linear.gain * (linear.value - along)).sum(axis=2)
        constants = constants + np.clip(step, -THRESHOLDS.longest_step, THRESHOLDS.longest_step)
    return _about(beams, constants, derivatives, curvature, reach, scaled, means)


def _shape(block: Block, crossing: Indices, b: int, x: Array) -> Array:
    """Return (profile, bin) logarithmic changes of the power of a beam by fields about their mean.

    ln extinction is linear between crossings, and constant beyond.
    """
    beam, layout = block.beams[b], block.layout
    passages = slice(*layout.first_passage[beam.number : beam.number + 2])
    at = layout.passages.range[passages]
    ranges = layout.range[beam.number, beam.start : beam.start + beam.logs.shape[1]]
    weights = np.stack([np.interp(ranges, at, unit) for unit in np.eye(at.size)], axis=1)
    fields = np.concatenate([x, x.mean(axis=0, keepdims=True)])[:, crossing[: at.size]]
    logarithm = np.einsum("tp,rp->tr", fields, weights)
    extinction = np.exp(logarithm)
    cells = 0.5 * (extinction[:, 1:] + extinction[:, :-1]) * np.diff(ranges)
    depth = np.concatenate([np.zeros((len(cells), 1)), np.cumsum(cells, axis=1)], axis=1)
    whole = logarithm / beam.exponent - 2.0 * depth
    change = whole[:-1] - whole[-1]
    limit = THRESHOLDS.thickest_beam
    return np.asarray(np.clip(change - change[:, :1], -limit, limit))


def _assess(block: Block, signals: _Signals, field: _Field, mean: _Mean) -> BlockSolution:
    """Return the solution with its errors and tests."""
    # The covariance of the mean field is that with one prior.
    missing = mean.posterior.square_error(mean.solution.logarithm[0])
    missing = np.maximum(missing - np.diagonal(mean.solution.covariance[0]), 0.0)
    x, reach = field.x, signals.reach
    chi_square, freedom, seen = _beam_fit.compare(signals.beams, signals.linear, x, reach)
    variance = np.diagonal(field.covariance, axis1=1, axis2=2)
    known = seen & (variance < THRESHOLDS.largest_variance)
    curvature, overlap = _systematic(block, signals, field)
    return BlockSolution(
        np.where(known, x, np.nan), np.where(known, variance, np.nan), curvature + missing, overlap,
        (reach == 0) & (reaches(block.usable, block.layout) > 1),
        chi_square, freedom, _misfit(signals, x, seen),
        np.full(len(reach), mean.solution.settled[0]), mean.posterior.deviation(block.priors),
    )  # fmt: skip


def _misfit(signals: _Signals, x: Array, seen: Booleans) -> tuple[float, float]:
    """Return the chi-square of the residuals of all profiles together, and its freedom."""
    beams, information = signals.beams, signals.linear.information
    inside = np.arange(beams.value.shape[2]) < signals.reach[..., np.newaxis]
    residual = np.where(inside, signals.linear.value - x[:, beams.crossing], 0.0)
    pooled = _matrices.product(information, residual[..., np.newaxis]).sum(axis=0)[..., 0]
    informed = np.maximum(signals.reach.max(axis=0) - 1, 0)
    whole, misfit = np.zeros((1, *information.shape[1:])), 0.0
    for b, matrix in enumerate(information.sum(axis=0)):
        # The constants take up what is left, which changes with the field.
        size, vector = _matrices.eigenvectors(matrix)
        kept = np.argsort(size)[len(size) - informed[b] :]
        size, vector = size[kept], vector[:, kept]
        along = (vector.T * pooled[b]).sum(axis=1)
        misfit += float((along**2 / size).sum())
        pooled[b] = (vector * along).sum(axis=1)
        whole[0, b] = _matrices.product(vector * size, vector.T)
    left = _beam_fit.gathered(pooled[np.newaxis, ..., np.newaxis], beams)[..., 0]
    misfit -= float(_beam_fit.taken_up(_beam_fit.normal_matrix(whole, beams), left)[0])
    return misfit, float(informed.sum() - np.sum(seen.any(axis=0)))


def _systematic(block: Block, signals: _Signals, field: _Field) -> tuple[Array, Array]:
    """Return variances by curved signals, and changes by overlap errors at the near ends of beams.

    Both are (profile, crossing); the overlap errors are 1.
    """
    layout, (beams, most) = block.layout, signals.beams.value.shape[1:]
    beam, place = _beam_fit.places(layout)
    passages = np.arange(beam.size)
    change = np.zeros((beam.size + beams, beams, 2 * most))
    change[passages, beam, place] = 1.0
    for b, (row, derivative) in enumerate(zip(block.beams, signals.derivatives, strict=True)):
        first, last = layout.first_passage[row.number : row.number + 2]
        ranges = layout.range[row.number, row.start : row.start + derivative.shape[2]]
        weights = np.interp(ranges, layout.passages.range[[first, last - 1]], [1.0, 0.0])
        count = (derivative.shape[1] + 1) // 2
        into = np.r_[:count, most : most + count - 1]
        by_signal = (derivative.mean(axis=0) * weights).sum(axis=1)
        change[beam.size + b, b, into] = row.exponent * by_signal
    response = field.respond(change) ** 2
    squares = response[..., : beam.size] * signals.curvature[:, np.newaxis, beam, place]
    return field.curved * squares.sum(axis=2), np.sqrt(response[..., beam.size :].sum(axis=2))
