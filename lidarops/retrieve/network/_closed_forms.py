"""Crossings of a network by the closed forms: cycles of beams, and single beams for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.network import _cycle_kernels, _empirical_prior, _multiplier
from lidarops.retrieve.network._beam_signals import BeamSignals
from lidarops.retrieve.network._condensed_signals import Condensed
from lidarops.retrieve.network.geometry import Cycle

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

_LARGEST_RELATIVE_ERROR: Final = 1.0 / 3.0
"""Beyond, no linear error tells how far off a value is."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossingEstimate:
    """Extinction at crossings, before it is judged. NaN where there is none."""

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
class Rows:
    """A cycle, profile by profile, as `lidarops.retrieve.network._cycle_kernels` takes it."""

    starts: Array
    """(profile, row)."""
    ends: Array
    integrals: Array
    """m, negative where the row runs towards its lidar."""
    covariances: Array
    """(profile, row, 3, 3) of the logarithms of the three."""
    depths: Array
    """(row,) optical depth times exponent per unit of extinction, with the row's sign, m."""
    distinct: bool
    """Whether the fits at the two crossings of each row share no bins."""

    def rotated(self, first: int) -> Rows:
        """Return the rows in the order that starts with another crossing."""
        order = np.roll(np.arange(self.starts.shape[1]), -first)
        return Rows(
            np.ascontiguousarray(self.starts[:, order]),
            np.ascontiguousarray(self.ends[:, order]),
            np.ascontiguousarray(self.integrals[:, order]),
            np.ascontiguousarray(self.covariances[:, order]),
            self.depths[order],
            self.distinct,
        )


def rows_of(data: Condensed, beams: BeamSignals, cycle: Cycle) -> Rows:
    """Collect the rows of a cycle; NaN where a signal is missing.

    Raises
    ------
    RetrievalInputError
        Where a crossing of the cycle cannot be measured on a beam of its.
    """
    profiles, k = data.log_value.shape[0], cycle.beam.size
    here = [
        _passage(beams, int(r), int(v)) for r, v in zip(cycle.beam, cycle.crossing, strict=True)
    ]
    there = [
        _passage(beams, int(r), int(v))
        for r, v in zip(cycle.beam, np.roll(cycle.crossing, -1), strict=True)
    ]
    apart = np.abs(beams.layout.window[here] - beams.layout.window[there])
    out = Rows(
        np.empty((profiles, k)), np.empty((profiles, k)), np.empty((profiles, k)),
        np.empty((profiles, k, 3, 3)), np.empty(k),
        distinct=bool(np.all(apart >= beams.layout.weights.shape[1])),
    )  # fmt: skip
    lengths = _empirical_prior.lengths(beams.layout)
    for j in range(k):
        sign = 1.0 if there[j] > here[j] else -1.0
        between = slice(min(here[j], there[j]), max(here[j], there[j]))
        usable = (data.usable[:, here[j]] & data.usable[:, there[j]]) == 1
        total = np.where(usable, np.cumsum(data.integral[:, between], axis=1)[:, -1], np.nan)
        logs = np.where(usable, data.log_value[:, [here[j], there[j]]].T, np.nan)
        # A value that overflows is infinite, and flagged as not finite.
        with np.errstate(over="ignore"):
            out.starts[:, j], out.ends[:, j] = np.exp(logs)
        out.integrals[:, j] = sign * total
        out.depths[j] = sign * beams.exponent[cycle.beam[j]] * float(lengths[between].sum())
        out.covariances[:, j] = _row_covariance(
            data, beams, int(cycle.beam[j]), here[j], there[j], between, total
        )
    return out


def _passage(beams: BeamSignals, beam: int, crossing: int) -> int:
    kept = beams.layout.passages
    found = np.flatnonzero((kept.beam == beam) & (kept.crossing == crossing))
    if found.size == 0:
        raise RetrievalInputError(
            f"passes crossing {crossing}, which beam {beam} cannot measure",
            field="cycle",
            remedy="give signals that reach there with full overlap, or choose other beams",
        )
    return int(found[0])


def _row_covariance(
    data: Condensed,
    beams: BeamSignals,
    beam: int,
    here: int,
    there: int,
    between: slice,
    total: Array,
) -> Array:
    layout = beams.layout
    first, count = int(layout.first_passage[beam]), int(np.diff(layout.first_passage)[beam])
    size = 2 * count - 1
    packed = data.covariance[:, layout.offset[beam] : layout.offset[beam + 1]]
    full = packed.reshape(-1, size, size)
    parts = np.arange(count + between.start - first, count + between.stop - first)
    points = (here - first, there - first)
    out = np.empty((full.shape[0], 3, 3))
    for a, p in enumerate(points):
        for b, q in enumerate(points):
            out[:, a, b] = full[:, p, q]
        cross = np.cumsum(full[:, p, parts], axis=1)[:, -1] / total
        out[:, a, 2] = out[:, 2, a] = cross
    square = np.cumsum(np.cumsum(full[:, parts][:, :, parts], axis=2)[:, :, -1], axis=1)[:, -1]
    out[:, 2, 2] = square / total**2
    return out


def by_cycle(
    beams: BeamSignals, cycle: Cycle, multiplier: float | None, *, unbiased: bool, only_start: bool
) -> CrossingEstimate:
    """Solve for the start crossing of a cycle, and in turn for its other near crossings.

    Parameters
    ----------
    beams : Beams
    cycle : Cycle
    multiplier : float, optional
        The best one for each block where not given.
    unbiased : bool
    only_start : bool
        Whether to leave the other crossings out.
    """
    rows, mean = rows_of(beams.data, beams, cycle), rows_of(beams.mean, beams, cycle)
    profiles, crossings = rows.starts.shape[0], beams.layout.crossings
    shape = (profiles, crossings)
    out = CrossingEstimate(
        np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_),
        np.zeros(shape, dtype=np.bool_), np.zeros(crossings, dtype=np.bool_), np.ones(profiles),
    )  # fmt: skip
    weak = _weak_attenuation(rows) | (not rows.distinct)
    for j in [0] if only_start else np.flatnonzero(cycle.sign > 0):
        turned, crossing = rows.rotated(int(j)), int(cycle.crossing[j])
        if multiplier is None:
            chosen = _best(mean.rotated(int(j)), beams)[beams.block]
        else:
            chosen = np.full(profiles, multiplier)
        value, determinant, variance, pole, spread = _solved(turned, chosen, unbiased=unbiased)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            out.extinction[:, crossing] = 1.0 / value
            out.variance[:, crossing] = variance / value**4
            amplified = shaky(
                out.extinction[:, [crossing]], out.variance[:, [crossing]], beams.block
            )
            if not unbiased:
                bias = _modelled_bias(turned, beams, chosen)
                out.variance[:, crossing] += (bias * out.extinction[:, crossing]) ** 2
            singular = ~(np.abs(determinant) >= 3.0 * np.sqrt(spread))
        out.weak_attenuation[:, crossing] = amplified[:, 0] | (singular if unbiased else weak)
        out.pole[:, crossing] = pole
        out.far_start[crossing] = cycle.sign[j] < 0
        if j == 0:
            out.multiplier[:] = chosen
    return out


def shaky(extinction: Array, variance: Array, block: Indices) -> Booleans:
    """Return which values have an error above a third of them, or typically in their block.

    Where noise is amplified beyond that, a value comes to lie anywhere, and the error that is
    taken where it lies says nothing: of such profiles of a block, none is to be believed.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float
        m-1 and m-2; NaN where there is none.
    block : (profile,) int
    """
    with np.errstate(invalid="ignore"):
        out = np.asarray(variance > (_LARGEST_RELATIVE_ERROR * extinction) ** 2)
    for number in np.unique(block):
        mine = np.flatnonzero(block == number)
        known = np.isfinite(variance[mine])
        for crossing in np.flatnonzero(known.any(axis=0)):
            rows = mine[known[:, crossing]]
            error = np.sqrt(np.median(variance[rows, crossing]))
            typical = np.median(extinction[rows, crossing])
            out[mine, crossing] |= error > _LARGEST_RELATIVE_ERROR * typical
    return out


def _solved(
    rows: Rows, multiplier: Array, *, unbiased: bool
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


def _weak_attenuation(rows: Rows) -> Booleans:
    """Return where the attenuation around the cycle is less than 3 standard errors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.cumsum(np.log(rows.ends / rows.starts), axis=1)[:, -1]
        c = rows.covariances
        spread = np.cumsum(c[:, :, 0, 0] + c[:, :, 1, 1] - 2.0 * c[:, :, 0, 1], axis=1)[:, -1]
        return np.asarray(~(np.abs(logarithm) >= 3.0 * np.sqrt(spread)))


def _best(mean: Rows, beams: BeamSignals) -> Array:
    """Return the best multiplier of each block, from a homogeneous model of its mean field."""
    model = mean_extinction(beams.mean)
    depths = model[:, np.newaxis] * mean.depths
    single = mean.covariances * beams.averaged[:, np.newaxis, np.newaxis, np.newaxis]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        best = _multiplier.optimal(
            mean.starts, mean.ends, mean.integrals, single, depths, 1.0 / model,
            beams.noise > _multiplier.LOUDEST_CLOSED,
        )  # fmt: skip
    return np.where(np.isfinite(model) & (model > 0), best, 1.0)


def _modelled_bias(rows: Rows, beams: BeamSignals, multiplier: Array) -> Array:
    """Return the relative systematic error that a homogeneous mean field would have."""
    depths = mean_extinction(beams.mean)[beams.block, np.newaxis] * rows.depths
    return np.where(multiplier < 1.0, _multiplier.relative_bias(depths, multiplier), 0.0)


def inhomogeneous(beams: BeamSignals, estimate: CrossingEstimate) -> Booleans:
    """Return where the segments of the mean field differ by more than a profile's errors.

    They must also differ by more than their noise: by 4 standard errors of their chi-square.
    """
    known = (beams.mean.slope[:, :, 1] > 0) & np.isfinite(beams.mean.slope[:, :, 1])
    weight = np.where(known, 1.0 / np.where(known, beams.mean.slope[:, :, 1], 1.0), 0.0)
    number = known.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = mean_extinction(beams.mean)[:, np.newaxis]
        square = np.where(known, beams.mean.slope[:, :, 0] - middle, 0.0) ** 2
        chi_square = _total(square * weight)
        spread = _total(square) / np.maximum(number - 1, 1)
        differ = chi_square > number - 1 + 4.0 * np.sqrt(2.0 * np.maximum(number - 1, 1))
        larger = (spread[beams.block, np.newaxis] > estimate.variance).any(axis=1)
    told = (differ & (number > 1))[beams.block] & larger
    return np.broadcast_to(told[:, np.newaxis], estimate.variance.shape)


def mean_extinction(data: Condensed) -> Array:
    """Return (profile,) the mean extinction of all segments, weighted by their variances."""
    known = (data.slope[:, :, 1] > 0) & np.isfinite(data.slope[:, :, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(known, 1.0 / data.slope[:, :, 1], 0.0)
        return _total(np.where(known, data.slope[:, :, 0], 0.0) * weight) / _total(weight)


def _total(values: Array) -> Array:
    """Sum over passages one by one, so that the digits do not depend on the profiles."""
    start = np.zeros((values.shape[0], 1))
    return np.asarray(np.cumsum(np.concatenate([start, values], axis=1), axis=1)[:, -1])


def by_single_beams(beams: BeamSignals, *, far_end: bool) -> CrossingEstimate:
    """Take each beam for itself: its slope, or Klett's solution from its far end.

    At each crossing, the segments that lead away from it are averaged, weighted by their
    variances. Klett's solution takes the extinction at the far end of a segment from the slope
    of its farther half; what its errors share is neglected.
    """
    data, kept = beams.data, beams.layout.passages
    shape = (data.log_value.shape[0], beams.layout.crossings)
    weights, total = np.zeros(shape), np.zeros(shape)
    for c in np.flatnonzero(kept.beam[:-1] == kept.beam[1:]):
        value, variance = _far_end(data, beams, int(c)) if far_end else data.slope[:, c, :2].T
        usable = (data.usable[:, c] & data.usable[:, c + 1]) == 1
        good = usable & np.isfinite(value) & (variance > 0) & np.isfinite(variance)
        weight = 1.0 / variance[good]
        weights[good, kept.crossing[c]] += weight
        total[good, kept.crossing[c]] += weight * value[good]
    none = np.zeros(shape, dtype=np.bool_)
    with np.errstate(divide="ignore", invalid="ignore"):
        extinction = np.where(weights > 0, total / weights, np.nan)
        variance = np.where(weights > 0, 1.0 / weights, np.nan)
    return CrossingEstimate(
        extinction, variance, none, none, np.zeros(shape[1], dtype=np.bool_), np.ones(shape[0])
    )


def _far_end(data: Condensed, beams: BeamSignals, c: int) -> tuple[Array, Array]:
    """Return the extinction at a passage from that at the next, and its variance."""
    beam = int(beams.layout.passages.beam[c])
    first, count = (
        int(beams.layout.first_passage[beam]),
        int(np.diff(beams.layout.first_passage)[beam]),
    )
    size, at = 2 * count - 1, c - first
    full = data.covariance[:, beams.layout.offset[beam] : beams.layout.offset[beam + 1]]
    full = full.reshape(-1, size, size)
    boundary, spread = data.slope[:, c, 2], data.slope[:, c, 3]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        near, far = np.exp(data.log_value[:, c]), np.exp(data.log_value[:, c + 1])
        share = far / boundary
        value = near / (share + data.integral[:, c])
        # Derivatives of ln value by ln near, ln far, the integral, and the boundary.
        d = (1.0, -share * value / near, -value / near, share * value / near / boundary)
        index = (at, at + 1, count + at)
        variance = d[3] ** 2 * spread
        for a, p in enumerate(index):
            for b, q in enumerate(index):
                variance = variance + d[a] * d[b] * full[:, p, q]
        return value, value**2 * variance
