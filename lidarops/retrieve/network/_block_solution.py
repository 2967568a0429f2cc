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
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _beam_fit, _beam_means, _changing_field
from lidarops.retrieve.network._beam_fit import Beams, Linear, Solution
from lidarops.retrieve.network._beam_means import ScaledBeam
from lidarops.retrieve.network._changing_field import Change, ChangingField, MeanPrior
from lidarops.retrieve.network._condensed_signals import CleanBeam, FitLayout, condense
from lidarops.retrieve.network._curvature import median
from lidarops.retrieve.network.thresholds import THRESHOLDS

_CONSTANT_PASSES: Final = 6
_ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The beams of the profiles of a block."""

    beams: list[CleanBeam]
    layout: FitLayout
    usable: Booleans
    """(profile, passage)."""
    lengths: Array
    """(beam, passage) `_beam_fit.optical_lengths`."""
    position: Array
    """(crossing, 3) m, of the measured crossings."""
    priors: list[MeanPrior]


@dataclass(frozen=True, slots=True, eq=False)
class _Signals:
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


@dataclass(frozen=True, slots=True, eq=False)
class BlockSolution:
    """The field of a block, at the measured crossings."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1; NaN where no usable beam of a profile passes."""
    variance: Array
    """(profile, crossing) by noise and prior."""
    curvature: Array
    """(profile, crossing) variance by curved signals within a fit."""
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
    prior: MeanPrior


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
        scaled.append(_beam_means.scale(beam, layout, complete, stops[-1]))
    profiles = len(reach)
    whole = np.ones((1, profiles))
    means = [each.mean(whole, stop) for each, stop in zip(scaled, stops, strict=True)]
    beams, derivatives, curvature = _arrange_means(means, layout)
    if not beams.reach.any():
        return None
    curved = _with_curvature(beams, curvature)
    constants = _beam_fit.start_constants(beams, block.lengths)
    first = _beam_fit.solve(curved, block.priors[-1].precision, constants)
    normal, side = first.linear.normal(beams.select)
    spare = beams.reach.sum() - np.sum(beams.reach > 0) - np.sum(np.diagonal(normal[0]) > 0.0)
    prior = _changing_field.likeliest_prior(
        normal[0], side[0], block.priors, tested=bool(spare >= 0)
    )
    mean = _beam_fit.solve(curved, prior.precision, first.constants)
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
    return _assess(block, signals, field, mean, prior)


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
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


def _changing(signals: _Signals, change: Change, prior: MeanPrior, mean: Array) -> _Field:
    """Return the field about a mean that changes as stated."""
    normal, side = signals.normal()
    field = ChangingField(normal, prior.precision, change)
    x, covariance = field.solve(
        (side - normal @ mean)[..., np.newaxis], (-prior.precision @ mean)[:, np.newaxis]
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
    return replace(beams, covariance=covariance)


def _arrange_means(means: list[CleanBeam], layout: FitLayout) -> tuple[Beams, list[Array], Array]:
    """Return means of powers, condensed, the derivatives of each beam by its bins, and curvature.

    Where a signal is curved beyond noise, the polynomial replaces the straight line. Curvature is
    the (mean, beam, passage) variance that this adds to a value.
    """
    data, derivatives = condense(means, layout)
    beams = _beam_fit.arrange(data, layout, reaches(data.usable, layout))
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
        linear = Linear(*(getattr(linear, name)[index.ravel()] for name in linear.__slots__))
    else:
        linear = _beam_fit.linearise(noisy, constants, reach)
    value = linear.value + (linear.turn @ change[..., np.newaxis])[..., 0]
    information = linear.information * (typical / ratio)[..., np.newaxis, np.newaxis]
    linear = Linear(value, linear.turn, information, linear.gain, linear.slope, linear.determinant)
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
    block: Block, signals: _Signals, field: _Field,
    mean: Solution, prior: MeanPrior,
) -> BlockSolution:  # fmt: skip
    """Return the solution with its errors and tests."""
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
        np.where(known, x, np.nan), np.where(known, variance, np.nan), curvature, overlap,
        (reach == 0) & (reaches(block.usable, block.layout) > 1),
        chi_square, freedom, (misfit, float(misfit_freedom)),
        bool(mean.settled[0]), prior,
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
