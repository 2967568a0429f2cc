"""Solution of a block of profiles as one field that changes slowly.

1. The mean of the powers of each beam gives the mean field and the constants of the beams.
2. The profiles deviate little from this mean, so that their deviations are linear, with weights
   that do not depend on their noise.
3. All profiles together give the field of each (`_changing_field`).
4. Where air moves, the mean of a block is too far from its profiles: running means replace it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _beam_fit, _changing_field
from lidarops.retrieve.network._beam_fit import Beams, Linear, Solution
from lidarops.retrieve.network._changing_field import Change, ChangingField, MeanPriors
from lidarops.retrieve.network._condensed_signals import CleanBeam, FitLayout, condense, median
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

_CONSTANT_PASSES: Final = 6
_ROUNDING: Final = 1e-9


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
        total = weights @ self.kept
        power = weights @ self.power / total
        variance = weights**2 @ self.variance / total**2
        known = (power > 0.0) & np.isfinite(variance)
        logs = np.where(known, source.exponent * (np.log(power) + self.factor), 0.0)
        noise = np.where(known, source.exponent**2 * variance / power**2, 0.0)
        doubt = np.nan_to_num(weights @ self.doubt / total)
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
        ratio = self.power / np.where(mean.codes == GOOD, mean.power, 1.0)
        return np.where(known, self.source.exponent * (ratio - 1.0), 0.0)

    def noise_ratio(self, mean: CleanBeam) -> Array:
        """Return (profile,) variances of noise over those of a mean, for the bins of each."""
        own, start = self.source.stops - self.source.start, self.source.low - self.source.start
        sums = [
            np.concatenate([np.zeros((len(own), 1)), np.cumsum(values, axis=1)], axis=1)
            for values in (self.variance, self.kept * mean.variance)
        ]
        rows = np.arange(len(own))
        part, whole = (total[rows, own] - total[:, start] for total in sums)
        return np.asarray(part / whole)


def _scale(beam: CleanBeam, layout: FitLayout, complete: Booleans, stop: int) -> ScaledBeam:
    """Return the powers of a beam over their energies, with weights for means.

    Parameters
    ----------
    beam : CleanBeam
    layout : FitLayout
    complete : (profile,) bool
        Which profiles may count in a mean.
    stop : int
        The bin behind the last one that a mean uses.
    """
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
        kept & finite, doubt, weight,
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

    def normal(self) -> tuple[Array, Array]:
        """Return normal matrices and right sides of the profiles."""
        return self.linear.normal(self.beams.select)


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
    settled: bool
    deviation: float
    """Standard deviation of ln extinction in single volumes of air, by the prior."""


def solve_block(block: Block) -> BlockSolution | None:
    """Solve a block; None where no beam has two passages."""
    layout = block.layout
    reach = reaches(block.usable, layout)
    scaled, stops = [], []
    for b, beam in enumerate(block.beams):
        depth = mean_depth(reach[:, b])
        last = layout.first_passage[beam.number] + max(depth, 1) - 1
        stops.append(int(layout.window[last]) + layout.weights.shape[1] if depth else beam.low)
        complete = (reach[:, b] >= depth) & (depth > 0)
        scaled.append(_scale(beam, layout, complete, stops[-1]))
    profiles = len(reach)
    whole = np.ones((1, profiles))
    means = [each.mean(whole, stop) for each, stop in zip(scaled, stops, strict=True)]
    beams, derivatives, curvature = _arrange_means(means, layout)
    if not beams.reach.any():
        return None
    curved = _with_curvature(beams, curvature)
    constants = _beam_fit.start_constants(beams, block.lengths)
    first = _beam_fit.fit_beams(curved, block.priors.widest, constants)
    posterior = block.priors.posterior(curved, first)
    prior = posterior.expected(block.priors)
    mean = _beam_fit.fit_beams(curved, prior, first.constants)
    signals = _about(beams, mean.constants, derivatives, curvature, reach, scaled, means)
    change = _likeliest_change(signals, block.position, mean.logarithm[0])
    if change is None:
        field = _steady(mean, beams.select, profiles)
    else:
        field = _changing(signals, change, prior, mean.logarithm[0])
        if np.sqrt(np.mean((field.x - field.x.mean(axis=0)) ** 2)) > THRESHOLDS.linear_change:
            signals = _about_running_means(signals, field.x, scaled, stops, layout)
            middle = field.x.mean(axis=0)
            change = _likeliest_change(signals, block.position, middle) or change
            field = _changing(signals, change, prior, middle)
    missing = posterior.square_error(mean.logarithm[0]) - np.diagonal(mean.covariance[0])
    return _assess(
        block, signals, field, mean, np.maximum(missing, 0.0), posterior.deviation(block.priors)
    )


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


def _steady(mean: Solution, select: Array, profiles: int) -> _Field:
    """Return the field of the mean for all profiles."""
    shape = profiles, select.shape[2]

    def respond(change: Array) -> Array:
        response = mean.covariance @ _beam_fit.changed_sides(mean.linear, select, change)
        return np.broadcast_to(response, (*shape, len(change)))

    return _Field(
        np.broadcast_to(mean.logarithm, shape),
        np.broadcast_to(mean.covariance, (*shape, shape[1])), respond, 0.0,
    )  # fmt: skip


def _changing(signals: _Signals, change: Change, prior: Array, mean: Array) -> _Field:
    """Return the field about a mean that changes as stated."""
    normal, side = signals.normal()
    field = ChangingField(normal, prior, change)
    x, covariance = field.solve(
        (side - normal @ mean)[..., np.newaxis], (-prior @ mean)[:, np.newaxis]
    )

    def respond(changed: Array) -> Array:
        select = signals.beams.select
        return field.solve(_beam_fit.changed_sides(signals.linear, select, changed))[0]

    # Curved signals are alike in all profiles, which count them as noise.
    return _Field(mean + x[..., 0], covariance, respond, 1.0 - 1.0 / len(normal))


def _likeliest_change(signals: _Signals, position: Array, mean: Array) -> Change | None:
    """Return how the profiles change about a mean field; None where they do not."""
    normal, side = signals.normal()
    rest = side - normal @ mean
    return _changing_field.likeliest_change(normal.mean(axis=0), rest - rest.mean(axis=0), position)


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
            change[:, b, into] = deviations @ derivative[0].T
        else:
            change[:, b, into] = (derivative @ deviations[..., np.newaxis])[..., 0]
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
    value = linear.value + (linear.turn @ change[..., np.newaxis])[..., 0]
    information = linear.information * (typical / ratio)[..., np.newaxis, np.newaxis]
    linear = linear._replace(value=value, information=information)
    return _Signals(beams, linear, derivatives, curvature, reach)


def _about_running_means(
    signals: _Signals, x: Array, scaled: list[ScaledBeam], stops: list[int], layout: FitLayout
) -> _Signals:
    """Return the signals of all profiles about running means, with constants that fit a field."""
    shares = _running_shares(x)
    means = [each.mean(shares, stop) for each, stop in zip(scaled, stops, strict=True)]
    beams, derivatives, curvature = _arrange_means(means, layout)
    around = (shares @ x) / shares.sum(axis=1, keepdims=True)
    constants = np.zeros(beams.reach.shape)
    end = np.take_along_axis(beams.value, np.maximum(beams.reach - 1, 0)[..., np.newaxis], axis=2)
    last = np.take_along_axis(
        around[:, beams.crossing], np.maximum(beams.reach - 1, 0)[..., np.newaxis], axis=2
    )
    constants = (end - last)[..., 0]
    for _ in range(_CONSTANT_PASSES):
        linear = _beam_fit.linearise(beams, constants)
        step = (linear.gain * (linear.value - around[:, beams.crossing])).sum(axis=2)
        constants = constants + np.clip(step, -THRESHOLDS.longest_step, THRESHOLDS.longest_step)
    return _about(beams, constants, derivatives, curvature, signals.reach, scaled, means)


def _running_shares(x: Array) -> Array:
    """Return (profile, profile) shares of running means, of as many as change a field little."""
    place = np.arange(len(x))
    for length in THRESHOLDS.running_profiles:
        shares = (np.abs(place[:, np.newaxis] - place) <= length // 2).astype(np.float64)
        number = shares.sum(axis=1, keepdims=True)
        spread = shares @ x**2 / number - (shares @ x / number) ** 2
        if np.sqrt(spread.mean(axis=0).max()) < THRESHOLDS.running_change:
            break
    return np.asarray(shares)


def _assess(
    block: Block, signals: _Signals, field: _Field, mean: Solution, missing: Array,
    deviation: float,
) -> BlockSolution:  # fmt: skip
    """Return the solution with its errors and tests.

    `missing` is the (crossing,) variance that the covariance of the mean leaves out.
    """
    tested = mean.linear.information[0]
    x, select, reach = field.x, signals.beams.select, signals.reach
    information = signals.linear.information
    chi_square, freedom, seen = _beam_fit.compare(signals.beams, signals.linear, x, reach)
    variance = np.diagonal(field.covariance, axis1=1, axis2=2)
    known = seen & (variance < THRESHOLDS.largest_variance)
    # The misfit of the mean: residuals of all profiles together.
    inside = np.arange(select.shape[1]) < reach[..., np.newaxis]
    residual = np.where(inside, signals.linear.value - x[:, signals.beams.crossing], 0.0)
    weighted = (information @ residual[..., np.newaxis])[..., 0]
    pooled = weighted.sum(axis=0)[..., np.newaxis]
    average = np.linalg.pinv(information.sum(axis=0), rcond=_ROUNDING, hermitian=True) @ pooled
    weighted = (tested @ average)[np.newaxis, ..., 0]
    left = weighted.reshape(1, -1) @ select.reshape(-1, select.shape[2])
    normal = _beam_fit.normal_matrix(tested[np.newaxis], select)
    misfit = float((weighted * average[..., 0]).sum() - _beam_fit.taken_up(normal, left)[0])
    deepest = signals.beams.reach.max(axis=0)
    misfit_freedom = deepest.sum() - (deepest > 0).sum() - np.sum(seen.any(axis=0))
    curvature, overlap = _systematic(block, signals, field)
    return BlockSolution(
        np.where(known, x, np.nan), np.where(known, variance, np.nan), curvature + missing, overlap,
        (reach == 0) & (reaches(block.usable, block.layout) > 1),
        chi_square, freedom, (misfit, float(misfit_freedom)),
        bool(mean.settled[0]), deviation,
    )  # fmt: skip


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
        change[beam.size + b, b, into] = row.exponent * (derivative.mean(axis=0) @ weights)
    response = field.respond(change) ** 2
    curvature = (
        field.curved * response[..., : beam.size] @ signals.curvature[:, beam, place, np.newaxis]
    )
    return curvature[..., 0], np.sqrt(response[..., beam.size :].sum(axis=2))
