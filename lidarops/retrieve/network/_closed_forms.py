"""Crossings of a network from closed forms: cycles of beams, and single beams for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.network import _cycle_kernels, _empirical_prior, _multiplier
from lidarops.retrieve.network._beam_signals import BeamSignals
from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network.geometry import Cycle

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

_LARGEST_RELATIVE_ERROR: Final = 1.0 / 3.0
"""Beyond this, a linear error does not describe the deviation of a value."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossingEstimate:
    """Extinction at crossings before flags are set. NaN where there is none."""

    extinction: Array
    """(profile, crossing) m-1; may be negative."""
    variance: Array
    """(profile, crossing) m-2."""
    weak_attenuation: Booleans
    """(profile, crossing)."""
    pole: Booleans
    """(profile, crossing)."""
    far_start: Booleans
    """(crossing,)."""
    multiplier: Array
    """(profile,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _CycleRows:
    """Rows of a cycle for each profile: the input of `lidarops.retrieve.network._cycle_kernels`."""

    starts: Array
    """(profile, row) signal at the first crossing of the row."""
    ends: Array
    """(profile, row) signal at its second crossing."""
    integrals: Array
    """(profile, row) m, negative where the row leads towards its lidar."""
    covariances: Array
    """(profile, row, 3, 3) covariances of the logarithms of the three."""
    depths: Array
    """(row,) m, exponent times optical depth per unit of extinction, with the sign of the row."""
    distinct: bool
    """Whether the fits at the two crossings of each row share no bins."""

    def rotated(self, first: int) -> _CycleRows:
        """Return the rows in the order that starts with row `first`."""
        order = np.roll(np.arange(self.starts.shape[1]), -first)
        return _CycleRows(
            np.ascontiguousarray(self.starts[:, order]),
            np.ascontiguousarray(self.ends[:, order]),
            np.ascontiguousarray(self.integrals[:, order]),
            np.ascontiguousarray(self.covariances[:, order]),
            self.depths[order],
            self.distinct,
        )


def _cycle_rows(data: CondensedSignals, beams: BeamSignals, cycle: Cycle) -> _CycleRows:
    """Return the rows of a cycle; NaN where a signal is missing.

    Raises
    ------
    RetrievalInputError
        If a crossing of the cycle cannot be measured on one of its beams.
    """
    profiles, k = data.log_value.shape[0], cycle.beam.size
    from_passage = [
        _passage(beams, int(b), int(c)) for b, c in zip(cycle.beam, cycle.crossing, strict=True)
    ]
    to_passage = [
        _passage(beams, int(b), int(c))
        for b, c in zip(cycle.beam, np.roll(cycle.crossing, -1), strict=True)
    ]
    bins_between = np.abs(beams.layout.window[from_passage] - beams.layout.window[to_passage])
    rows = _CycleRows(
        np.empty((profiles, k)), np.empty((profiles, k)), np.empty((profiles, k)),
        np.empty((profiles, k, 3, 3)), np.empty(k),
        distinct=bool(np.all(bins_between >= beams.layout.weights.shape[1])),
    )  # fmt: skip
    lengths = _empirical_prior.segment_lengths(beams.layout)
    for j in range(k):
        sign = 1.0 if to_passage[j] > from_passage[j] else -1.0
        between = slice(min(from_passage[j], to_passage[j]), max(from_passage[j], to_passage[j]))
        usable = (data.usable[:, from_passage[j]] & data.usable[:, to_passage[j]]) == 1
        total = np.where(usable, np.cumsum(data.integral[:, between], axis=1)[:, -1], np.nan)
        logs = np.where(usable, data.log_value[:, [from_passage[j], to_passage[j]]].T, np.nan)
        # A value that overflows is flagged as not finite.
        with np.errstate(over="ignore"):
            rows.starts[:, j], rows.ends[:, j] = np.exp(logs)
        rows.integrals[:, j] = sign * total
        rows.depths[j] = sign * beams.exponent[cycle.beam[j]] * float(lengths[between].sum())
        rows.covariances[:, j] = _row_covariance(
            data, beams, int(cycle.beam[j]), from_passage[j], to_passage[j], between, total
        )
    return rows


def _passage(beams: BeamSignals, beam: int, crossing: int) -> int:
    """Return the passage of a beam through a crossing."""
    passages = beams.layout.passages
    matches = np.flatnonzero((passages.beam == beam) & (passages.crossing == crossing))
    if matches.size == 0:
        raise RetrievalInputError(
            f"passes crossing {crossing}, which beam {beam} cannot measure",
            field="cycle",
            remedy="give signals that reach there with full overlap, or choose other beams",
        )
    return int(matches[0])


def _row_covariance(
    data: CondensedSignals,
    beams: BeamSignals,
    beam: int,
    from_passage: int,
    to_passage: int,
    between: slice,
    total: Array,
) -> Array:
    """Return (profile, 3, 3) covariance of the logarithms of start, end and integral."""
    layout = beams.layout
    first, count = int(layout.first_passage[beam]), int(np.diff(layout.first_passage)[beam])
    size = 2 * count - 1
    packed = data.covariance[:, layout.offset[beam] : layout.offset[beam + 1]]
    full = packed.reshape(-1, size, size)
    segments = np.arange(count + between.start - first, count + between.stop - first)
    points = (from_passage - first, to_passage - first)
    out = np.empty((full.shape[0], 3, 3))
    for a, p in enumerate(points):
        for b, q in enumerate(points):
            out[:, a, b] = full[:, p, q]
        cross = np.cumsum(full[:, p, segments], axis=1)[:, -1] / total
        out[:, a, 2] = out[:, 2, a] = cross
    square = np.cumsum(np.cumsum(full[:, segments][:, :, segments], axis=2)[:, :, -1], axis=1)[
        :, -1
    ]
    out[:, 2, 2] = square / total**2
    return out


def solve_cycle_crossings(
    beams: BeamSignals, cycle: Cycle, multiplier: float | None, *, unbiased: bool, only_start: bool
) -> CrossingEstimate:
    """Solve for the start crossing of a cycle, and for its other near crossings in turn.

    Parameters
    ----------
    beams : BeamSignals
    cycle : Cycle
    multiplier : float, optional
        By default, the best one of each block.
    unbiased : bool
    only_start : bool
        Whether to solve for the start crossing only.
    """
    rows, mean = _cycle_rows(beams.data, beams, cycle), _cycle_rows(beams.mean, beams, cycle)
    profiles, crossings = rows.starts.shape[0], beams.layout.crossings
    shape = (profiles, crossings)
    estimate = CrossingEstimate(
        np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_),
        np.zeros(shape, dtype=np.bool_), np.zeros(crossings, dtype=np.bool_), np.ones(profiles),
    )  # fmt: skip
    weak = _weak_attenuation(rows) | (not rows.distinct)
    for j in [0] if only_start else np.flatnonzero(cycle.sign > 0):
        rotated, crossing = rows.rotated(int(j)), int(cycle.crossing[j])
        if multiplier is None:
            multipliers = _best_multiplier(mean.rotated(int(j)), beams)[beams.block]
        else:
            multipliers = np.full(profiles, multiplier)
        value, determinant, variance, pole, spread = _solve_rows(
            rotated, multipliers, unbiased=unbiased
        )
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            estimate.extinction[:, crossing] = 1.0 / value
            estimate.variance[:, crossing] = variance / value**4
            amplified = poorly_determined(
                estimate.extinction[:, [crossing]], estimate.variance[:, [crossing]], beams.block
            )
            if not unbiased:
                bias = _modelled_bias(rotated, beams, multipliers)
                estimate.variance[:, crossing] += (bias * estimate.extinction[:, crossing]) ** 2
            singular = ~(np.abs(determinant) >= 3.0 * np.sqrt(spread))
        estimate.weak_attenuation[:, crossing] = amplified[:, 0] | (singular if unbiased else weak)
        estimate.pole[:, crossing] = pole
        estimate.far_start[crossing] = cycle.sign[j] < 0
        if j == 0:
            estimate.multiplier[:] = multipliers
    return estimate


def poorly_determined(extinction: Array, variance: Array, block: Indices) -> Booleans:
    """Return where an error exceeds a third of the value, in the profile or its typical block.

    With noise amplified beyond that, values and the errors computed from them are meaningless,
    so all profiles of such a block are doubted.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float
        m-1 and m-2; NaN where there is none.
    block : (profile,) int
    """
    with np.errstate(invalid="ignore"):
        doubted = np.asarray(variance > (_LARGEST_RELATIVE_ERROR * extinction) ** 2)
    for number in np.unique(block):
        profiles = np.flatnonzero(block == number)
        known = np.isfinite(variance[profiles])
        for crossing in np.flatnonzero(known.any(axis=0)):
            rows = profiles[known[:, crossing]]
            error = np.sqrt(np.median(variance[rows, crossing]))
            typical = np.median(extinction[rows, crossing])
            doubted[profiles, crossing] |= error > _LARGEST_RELATIVE_ERROR * typical
    return doubted


def _solve_rows(
    rows: _CycleRows, multiplier: Array, *, unbiased: bool
) -> tuple[Array, Array, Array, Booleans, Array]:
    """Return solutions, determinants, variances, poles, and variances of the determinants."""
    count, k = rows.starts.shape
    value, determinant, variance = np.empty(count), np.empty(count), np.empty(count)
    gradient, codes = np.empty((count, k, 3)), np.empty(count, dtype=np.uint8)
    _cycle_kernels.solve_with_sensitivities(
        rows.starts, rows.ends, rows.integrals, multiplier, unbiased, value, determinant,
        gradient, codes,
    )  # fmt: skip
    _cycle_kernels.variance_of(gradient, rows.covariances, variance)
    spread = np.empty(count)
    _cycle_kernels.determinant_variance(
        rows.starts, rows.ends, multiplier, unbiased, rows.covariances, spread
    )
    return value, determinant, variance, codes == _cycle_kernels.POLE, spread


def _weak_attenuation(rows: _CycleRows) -> Booleans:
    """Return where the attenuation around the cycle is below 3 standard errors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.cumsum(np.log(rows.ends / rows.starts), axis=1)[:, -1]
        c = rows.covariances
        spread = np.cumsum(c[:, :, 0, 0] + c[:, :, 1, 1] - 2.0 * c[:, :, 0, 1], axis=1)[:, -1]
        return np.asarray(~(np.abs(logarithm) >= 3.0 * np.sqrt(spread)))


def _best_multiplier(mean: _CycleRows, beams: BeamSignals) -> Array:
    """Return the best multiplier of each block for a homogeneous model of its mean field."""
    model = _mean_extinction(beams.mean)
    depths = model[:, np.newaxis] * mean.depths
    profile_covariances = mean.covariances * beams.averaged[:, np.newaxis, np.newaxis, np.newaxis]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        multiplier = _multiplier.optimal_multiplier(
            mean.starts, mean.ends, mean.integrals, profile_covariances, depths, 1.0 / model,
            beams.noise > _multiplier.LARGEST_CLOSED_FORM_NOISE,
        )  # fmt: skip
    return np.where(np.isfinite(model) & (model > 0), multiplier, 1.0)


def _modelled_bias(rows: _CycleRows, beams: BeamSignals, multiplier: Array) -> Array:
    """Return the relative systematic error of a homogeneous mean field."""
    depths = _mean_extinction(beams.mean)[beams.block, np.newaxis] * rows.depths
    return np.where(multiplier < 1.0, _multiplier.relative_bias(depths, multiplier), 0.0)


def inhomogeneous(beams: BeamSignals, estimate: CrossingEstimate) -> Booleans:
    """Return where segments of the mean field differ by more than the errors of a profile.

    They must also differ by more than their noise: by 4 standard errors of their chi-square.
    """
    known = (beams.mean.slope[:, :, 1] > 0) & np.isfinite(beams.mean.slope[:, :, 1])
    weight = np.where(known, 1.0 / np.where(known, beams.mean.slope[:, :, 1], 1.0), 0.0)
    number = known.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = _mean_extinction(beams.mean)[:, np.newaxis]
        square = np.where(known, beams.mean.slope[:, :, 0] - mean, 0.0) ** 2
        chi_square = _total(square * weight)
        spread = _total(square) / np.maximum(number - 1, 1)
        differ = chi_square > number - 1 + 4.0 * np.sqrt(2.0 * np.maximum(number - 1, 1))
        larger = (spread[beams.block, np.newaxis] > estimate.variance).any(axis=1)
    detected = (differ & (number > 1))[beams.block] & larger
    return np.broadcast_to(detected[:, np.newaxis], estimate.variance.shape)


def _mean_extinction(data: CondensedSignals) -> Array:
    """Return (profile,) mean extinction of all segments, weighted by inverse variance."""
    known = (data.slope[:, :, 1] > 0) & np.isfinite(data.slope[:, :, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(known, 1.0 / data.slope[:, :, 1], 0.0)
        return _total(np.where(known, data.slope[:, :, 0], 0.0) * weight) / _total(weight)


def _total(values: Array) -> Array:
    """Sum over passages in order, so that the digits do not depend on the profiles."""
    start = np.zeros((values.shape[0], 1))
    return np.asarray(np.cumsum(np.concatenate([start, values], axis=1), axis=1)[:, -1])


def solve_single_beams(beams: BeamSignals, *, far_end: bool) -> CrossingEstimate:
    """Solve each beam alone: from its slope, or by Klett's method from its far end.

    At each crossing, the segments that lead away from it are averaged, weighted by inverse
    variance. Klett's method takes the extinction at the far end of a segment from the slope of
    its farther half; correlations of its errors are neglected.
    """
    data, passages = beams.data, beams.layout.passages
    shape = (data.log_value.shape[0], beams.layout.crossings)
    weights, total = np.zeros(shape), np.zeros(shape)
    for c in np.flatnonzero(passages.beam[:-1] == passages.beam[1:]):
        value, variance = _far_end(data, beams, int(c)) if far_end else data.slope[:, c, :2].T
        usable = (data.usable[:, c] & data.usable[:, c + 1]) == 1
        valid = usable & np.isfinite(value) & (variance > 0) & np.isfinite(variance)
        weight = 1.0 / variance[valid]
        weights[valid, passages.crossing[c]] += weight
        total[valid, passages.crossing[c]] += weight * value[valid]
    no_flag = np.zeros(shape, dtype=np.bool_)
    with np.errstate(divide="ignore", invalid="ignore"):
        extinction = np.where(weights > 0, total / weights, np.nan)
        variance = np.where(weights > 0, 1.0 / weights, np.nan)
    return CrossingEstimate(
        extinction,
        variance,
        no_flag,
        no_flag,
        np.zeros(shape[1], dtype=np.bool_),
        np.ones(shape[0]),
    )


def _far_end(data: CondensedSignals, beams: BeamSignals, c: int) -> tuple[Array, Array]:
    """Return extinction at a passage from that at the next one, and its variance."""
    beam = int(beams.layout.passages.beam[c])
    first, count = (
        int(beams.layout.first_passage[beam]),
        int(np.diff(beams.layout.first_passage)[beam]),
    )
    size, position = 2 * count - 1, c - first
    covariance = data.covariance[:, beams.layout.offset[beam] : beams.layout.offset[beam + 1]]
    covariance = covariance.reshape(-1, size, size)
    boundary, spread = data.slope[:, c, 2], data.slope[:, c, 3]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        near, far = np.exp(data.log_value[:, c]), np.exp(data.log_value[:, c + 1])
        share = far / boundary
        value = near / (share + data.integral[:, c])
        # Derivatives of ln value by ln near, ln far, the integral, and the boundary.
        d = (1.0, -share * value / near, -value / near, share * value / near / boundary)
        index = (position, position + 1, count + position)
        variance = d[3] ** 2 * spread
        for a, p in enumerate(index):
            for b, q in enumerate(index):
                variance = variance + d[a] * d[b] * covariance[:, p, q]
        return value, value**2 * variance
