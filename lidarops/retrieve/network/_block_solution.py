"""Solution of a block of profiles as one field that changes slowly.

1. The mean of the powers of each beam gives the mean field and the constants of the beams.
2. The profiles deviate little from this mean, so that their deviations are linear, with weights
   that do not depend on their noise.
3. All profiles together give the field of each (`_changing_field`).
4. Where air moves, the mean of a block is too far from its profiles: running means replace it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _beam_fit, _beam_means, _changing_field
from lidarops.retrieve.network._beam_fit import Beams, Linear
from lidarops.retrieve.network._beam_means import ScaledBeam
from lidarops.retrieve.network._changing_field import ChangingField, MeanPrior
from lidarops.retrieve.network._condensed_signals import CleanBeam, FitLayout, condense
from lidarops.retrieve.network._curvature import curvature_variance
from lidarops.retrieve.network.thresholds import THRESHOLDS

_CONSTANT_PASSES: Final = 6


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
    curvature_error: Array
    """(mean, passage, 2)."""
    reach: Indices
    """(profile, beam)."""

    def normal(self) -> tuple[Array, Array]:
        """Return normal matrices and right sides of the profiles."""
        return self.linear.normal(self.beams.select)

    def sides(self, change: Array) -> Array:
        """Return (profile, crossing, case) changes of the right sides.

        `change` is the (case, beam, 2 passage) change of u and I in all profiles.
        """
        turned = np.einsum("tbpq,sbq->tbps", self.linear.turn, change)
        weighted = self.linear.information @ turned
        flat = self.beams.select.reshape(-1, self.beams.select.shape[2])
        return np.asarray(flat.T @ weighted.reshape(len(weighted), len(flat), -1))


def reaches(usable: Booleans, layout: FitLayout) -> Indices:
    """Return (profile, beam) numbers of usable passages before the first one that is not."""
    first = layout.first_passage
    return np.stack(
        [
            np.logical_and.accumulate(usable[:, a:b], axis=1).sum(axis=1)
            for a, b in zip(first, first[1:], strict=False)
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
    changes: bool


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
    data, derivatives = condense(means, layout)
    beams = _beam_fit.arrange(data, layout, reaches(data.usable, layout))
    if not beams.reach.any():
        return None
    constants = _beam_fit.start_constants(beams, block.lengths)
    first = _beam_fit.solve(beams, block.priors[-1].precision, constants)
    normal, side = first.linear.normal(beams.select)
    prior = _changing_field.likeliest_prior(normal[0], side[0], block.priors)
    mean = _beam_fit.solve(beams, prior.precision, first.constants)
    signals = _about(beams, mean.constants, derivatives, data.curvature_error, reach, scaled, means)
    field, x, covariance = _solve_field(signals, prior, block.position, mean.logarithm[0])
    moved = np.sqrt(np.mean((x - x.mean(axis=0)) ** 2))
    if field.change is not None and moved > THRESHOLDS.linear_change:
        signals = _about_running_means(signals, x, scaled, stops, layout)
        field, x, covariance = _solve_field(signals, prior, block.position, x.mean(axis=0))
    return _assess(block, signals, field, (x, covariance), prior, bool(mean.settled[0]))


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
    if len(beams.value) == 1:
        patterns, index = np.unique(reach, axis=0, return_inverse=True)
        linear = _beam_fit.linearise(beams, constants, patterns)
        linear = Linear(*(getattr(linear, name)[index.ravel()] for name in linear.__slots__))
    else:
        linear = _beam_fit.linearise(beams, constants, reach)
    value = linear.value + (linear.turn @ change[..., np.newaxis])[..., 0]
    information = linear.information / ratio[..., np.newaxis, np.newaxis]
    linear = Linear(
        value, linear.turn, information, linear.gain, linear.slope, linear.determinant
    )
    return _Signals(beams, linear, derivatives, curvature, reach)


def _about_running_means(
    signals: _Signals, x: Array, scaled: list[ScaledBeam], stops: list[int], layout: FitLayout
) -> _Signals:
    """Return the signals of all profiles about running means, with constants that fit a field."""
    shares = _running_shares(x)
    means = [each.mean(shares, stop) for each, stop in zip(scaled, stops, strict=True)]
    data, derivatives = condense(means, layout)
    beams = _beam_fit.arrange(data, layout, reaches(data.usable, layout))
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
    return _about(
        beams, constants, derivatives, data.curvature_error, signals.reach, scaled, means
    )


def _running_shares(x: Array) -> Array:
    """Return (profile, profile) shares of running means, of as many as change a field little."""
    place = np.arange(len(x))
    for length in THRESHOLDS.running_profiles:
        shares = (np.abs(place[:, np.newaxis] - place) <= length // 2).astype(np.float64)
        number = shares.sum(axis=1, keepdims=True)
        spread = shares @ x**2 / number - (shares @ x / number) ** 2
        if np.sqrt(spread.mean(axis=0).max()) < THRESHOLDS.linear_change:
            break
    return shares


def _solve_field(
    signals: _Signals, prior: MeanPrior, position: Array, mean: Array
) -> tuple[ChangingField, Array, Array]:
    """Return the field with its likeliest change, its values and their covariances."""
    normal, side = signals.normal()
    rest = side - normal @ mean
    change = _changing_field.likeliest_change(
        normal.mean(axis=0), rest - rest.mean(axis=0), position
    )
    field = ChangingField(normal, prior.precision, change)
    pull = -prior.precision @ mean
    x, covariance = field.solve(rest[..., np.newaxis], pull[:, np.newaxis])
    return field, mean + x[..., 0], covariance


def _assess(
    block: Block, signals: _Signals, field: ChangingField, solved: tuple[Array, Array],
    prior: MeanPrior, settled: bool,
) -> BlockSolution:  # fmt: skip
    """Return the solution with its errors and tests."""
    x, covariance = solved
    select, reach = signals.beams.select, signals.reach
    information = signals.linear.information
    chi_square, freedom, seen = _beam_fit.test(signals.beams, signals.linear, x, reach)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    known = seen & (variance < THRESHOLDS.largest_variance)
    # The misfit of the mean: residuals of all profiles together.
    inside = np.arange(select.shape[1]) < reach[..., np.newaxis]
    residual = np.where(inside, signals.linear.value - x[:, signals.beams.crossing], 0.0)
    weighted = (information @ residual[..., np.newaxis])[..., 0]
    pooled = weighted.sum(axis=0)
    inverse = np.linalg.pinv(information.sum(axis=0), rcond=1e-9, hermitian=True)
    misfit = float(np.einsum("bp,bpq,bq->", pooled, inverse, pooled))
    left = weighted.sum(axis=0).ravel() @ select.reshape(-1, select.shape[2])
    misfit -= float(_beam_fit.taken_up(field.normal.sum(axis=0)[np.newaxis], left[np.newaxis])[0])
    deepest = signals.beams.reach.max(axis=0)
    misfit_freedom = deepest.sum() - (deepest > 0).sum() - np.sum(seen.any(axis=0))
    curvature, overlap = _systematic(block, signals, field)
    return BlockSolution(
        np.where(known, x, np.nan), np.where(known, variance, np.nan), curvature, overlap,
        (reach == 0) & (reaches(block.usable, block.layout) > 1),
        chi_square, freedom, (misfit, float(misfit_freedom)),
        settled, prior, field.change is not None,
    )  # fmt: skip


def _systematic(block: Block, signals: _Signals, field: ChangingField) -> tuple[Array, Array]:
    """Return variances by curved signals, and changes by overlap errors at the near ends of beams."""
    layout, shape = block.layout, signals.beams.value.shape
    beam, place = _beam_fit.places(layout)
    passages = beam.size
    change = np.zeros((passages + shape[1], shape[1], 2 * shape[2]))
    change[np.arange(passages), beam, place] = 1.0
    for b, (row, derivative) in enumerate(zip(block.beams, signals.derivatives, strict=True)):
        first, last = layout.first_passage[row.number : row.number + 2]
        ranges = layout.range[row.number, row.start : row.start + derivative.shape[2]]
        ends = layout.passages.range[[first, last - 1]]
        weights = row.exponent * np.interp(ranges, ends, [1.0, 0.0])
        count = (derivative.shape[1] + 1) // 2
        into = np.r_[:count, shape[2] : shape[2] + count - 1]
        change[passages + b, b, into] = derivative.mean(axis=0) @ weights
    response, _ = field.solve(signals.sides(change))
    carried, by_overlap = response[..., :passages], response[..., passages:]
    if len(signals.curvature_error) == 1:
        carried = carried[:1]
    curvature = curvature_variance(
        signals.curvature_error, np.ones(signals.curvature_error.shape[:2], dtype=np.bool_), carried
    )
    return (
        np.broadcast_to(curvature, response.shape[:2]),
        np.sqrt((by_overlap**2).sum(axis=2)),
    )
