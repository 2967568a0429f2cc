r"""Signals of beams, condensed to values at crossings and integrals between them.

With the signal a = (P r^2 / O)^m of a beam, the value at crossing p is u_p = ln a, from a straight
line through the logarithms of the bins around it, and the integral from there to the next one is
I_p = 2 m (integral of a). Both are linear in small errors of the logarithms, so that with the
derivatives G their covariance is G diag(variance) G'. Bins, weights and cells follow from geometry
and range alone (`lay_out_fits`), so they are computed once for all profiles. The result of a
profile does not depend on the other profiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Codes, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import outlying_bins
from lidarops.retrieve.network.geometry import Network, Passages
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST, MARGIN
from lidarops.retrieve.network.thresholds import THRESHOLDS

MISSING: Final = 1
NOT_POSITIVE: Final = 2
OUTLYING: Final = 3
"""Reasons why a beam ends before its last bin."""
_SMALLEST_STEP: Final = 1e-12
_NEIGHBOURS: Final = 7
"""Bins whose mean is the level of a bin that is not positive."""


# Bins and weights --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class FitLayout:
    """Bins and weights of the fits that give the signal at each passage of a beam."""

    passages: Passages
    """The measurable passages, in order along the beams."""
    crossings: int
    """Number of all crossings of the network."""
    measured: Booleans
    """(crossing,) True where at least two beams can measure."""
    near_crossing: Booleans
    """(crossing,) True where a measurable beam continues to a farther crossing."""
    first_passage: Indices
    """(beam + 1,) where the passages of a beam start."""
    window: Indices
    """(passage,) first bin of the fit."""
    weights: Array
    """(passage, bin) weights of the logarithms for the value at the crossing."""
    curvature_weights: Array
    """(passage, bin) weights for the difference of line and polynomial; 0 for linear functions."""
    cell: Indices
    """(passage,) the bin at or before the crossing."""
    fraction: Array
    """(passage,) fraction of the cell behind that bin, up to the crossing."""
    log_factor: Array
    """(beam, bin) logarithm of range^2 / overlap, the factor from power to corrected signal."""
    range: Array
    """(beam, bin) m."""
    limits: Indices
    """(beam, 2) first usable bin, and the one behind the last."""


def lay_out_fits(
    net: Network, range_: Array, overlap: Array | None, nearest: Array, bins: int
) -> FitLayout:
    """Return the bins and weights of the fits at all measurable passages.

    Parameters
    ----------
    net : Network
    range_ : (beam, bin) float64
        m, ascending; NaN behind the last bin of a beam.
    overlap : (beam, bin) float64, optional
        Overlap function; 1 where not given.
    nearest : (beam,) float64
        m; nearer bins are not used.
    bins : int
        Number of bins of a fit.
    """
    factor = np.ones_like(range_) if overlap is None else overlap
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = (range_ >= nearest[:, np.newaxis]) & (factor >= THRESHOLDS.lowest_overlap)
        log_factor = 2.0 * np.log(range_) - np.log(factor)
    limits = [_bounds(row) for row in usable]
    keep = np.zeros(net.passages.beam.size, dtype=np.bool_)
    for c, (beam, distance) in enumerate(zip(net.passages.beam, net.passages.range, strict=True)):
        low, high = limits[beam]
        keep[c] = high - low >= bins and range_[beam, low] <= distance <= range_[beam, high - 1]
    measured = np.bincount(net.passages.crossing[keep], minlength=net.crossings) >= 2
    keep &= measured[net.passages.crossing]
    measurable = Passages(
        net.passages.beam[keep], net.passages.crossing[keep], net.passages.range[keep]
    )
    first = np.searchsorted(measurable.beam, np.arange(net.beams + 1)).astype(np.intp)
    continues = np.zeros(net.crossings, dtype=np.bool_)
    continues[measurable.crossing[:-1][measurable.beam[:-1] == measurable.beam[1:]]] = True
    window, weights, cell, fraction = _fits(measurable, range_, limits, bins)
    bounds = np.array(limits, dtype=np.intp).reshape(-1, 2)
    return FitLayout(
        measurable, net.crossings, measured, continues, first, window, weights,
        _curvature_weights(measurable, range_, window, weights), cell, fraction,
        np.where(np.isfinite(log_factor), log_factor, 0.0), range_, bounds,
    )  # fmt: skip


def _bounds(usable: Booleans) -> tuple[int, int]:
    """Return start and stop of the usable run of bins that ends farthest."""
    if not usable.any():
        return 0, 0
    stop = int(usable.size - np.argmax(usable[::-1]))
    before = np.flatnonzero(~usable[:stop])
    return (int(before[-1]) + 1 if before.size else 0), stop


def _fits(
    kept: Passages, range_: Array, limits: list[tuple[int, int]], bins: int
) -> tuple[Indices, Array, Indices, Array]:
    """Return the first bins and weights of the fits, and the cells and fractions of crossings."""
    total = kept.beam.size
    window, cell = np.zeros(total, dtype=np.intp), np.zeros(total, dtype=np.intp)
    weights, fraction = np.zeros((total, bins)), np.zeros(total)
    for c, (beam, distance) in enumerate(zip(kept.beam, kept.range, strict=True)):
        grid, (low, high) = range_[beam], limits[beam]
        centre = low + int(np.argmin(np.abs(grid[low:high] - distance)))
        start = min(max(centre - bins // 2, low), high - bins)
        window[c] = start
        window_ranges = grid[start : start + bins]
        lever = window_ranges - window_ranges.mean()
        weights[c] = 1.0 / bins + lever * (distance - window_ranges.mean()) / np.sum(lever**2)
        cell_start = low + int(np.searchsorted(grid[low:high], distance, side="right")) - 1
        cell[c] = min(cell_start, high - 2)
        fraction[c] = (distance - grid[cell[c]]) / (grid[cell[c] + 1] - grid[cell[c]])
    return window, weights, cell, fraction


def _curvature_weights(kept: Passages, range_: Array, window: Indices, weights: Array) -> Array:
    """Return the weights of the logarithms for the difference of line and polynomial."""
    bins = weights.shape[1]
    at = window[:, np.newaxis] + np.arange(bins)
    distance = range_[kept.beam[:, np.newaxis], at] - kept.range[:, np.newaxis]
    order = np.arange(min(THRESHOLDS.curvature_degree, bins - 1) + 1)
    powers = (distance / np.ptp(distance, axis=1, keepdims=True))[..., np.newaxis] ** order
    return np.asarray(weights - np.linalg.pinv(powers)[:, 0])


# Signals -----------------------------------------------------------------------------------------


class Beams(NamedTuple):
    """Condensed signals of beams with the same number of passages each; the last ones are empty.

    The signal is scaled to 1 at the first crossing of each beam.
    """

    value: Array
    """(profile, beam, passage) u."""
    integral: Array
    """(profile, beam, passage) I in m, 0 behind the last passage."""
    covariance: Array
    """(profile, beam, 2 passage, 2 passage) of u, then of I."""
    reach: Indices
    """(profile, beam) number of passages in use; 0 where there is only one, or no known noise."""
    crossing: Indices
    """(beam, passage) number of the crossing, of those that are measured; 0 where empty."""
    select: Array
    """(beam, passage, crossing) 1 where a passage is at a crossing."""


@dataclass(frozen=True, slots=True, eq=False)
class CleanBeam:
    """Bins of one beam that are used, and of a margin, with single outlying bins bridged."""

    number: int
    start: int
    """Number of the first bin."""
    low: int
    """Number of the first bin that a fit uses; those before it are a margin."""
    power: Array
    """(profile, bin) and its variance, as given, but for bridged bins."""
    variance: Array
    logs: Array
    """(profile, bin) logarithms of the signal; 0 where it is not positive."""
    noise: Array
    """(profile, bin) their variances."""
    doubt: Array
    """(profile, bin) deviations of outlying bins that stay, because they may be air."""
    codes: Codes
    """(profile, bin) codes of `outlying_bins`."""
    stops: Indices
    """(profile,) behind the last bin that can be used."""
    status: Codes
    """(profile,) why a beam ends before its last used bin."""
    exponent: float

    @property
    def bridged(self) -> Booleans:
        """(profile,) True where a beam has outlying bins."""
        return np.asarray(((self.codes == BRIDGED) | (self.codes == KEPT)).any(axis=1))

    def take(self, profiles: Indices) -> CleanBeam:
        """Return the selected profiles."""
        arrays = ("power", "variance", "logs", "noise", "doubt", "codes", "stops", "status")
        return replace(self, **{name: getattr(self, name)[profiles] for name in arrays})


def clean(
    power: Array, variance: Array, exponent: Array, layout: FitLayout, *, together: bool
) -> list[CleanBeam]:
    """Return the beams that have passages, with outlying bins found.

    Where profiles are averaged together, a bin which noise makes negative is no end of a beam.
    """
    with np.errstate(all="ignore"):
        beams = []
        for beam in np.flatnonzero(np.diff(layout.first_passage)):
            row = _take_logarithms(
                int(beam), power[:, beam], variance[:, beam], float(exponent[beam]), layout,
                together=together,
            )  # fmt: skip
            inside = slice(row.start, row.start + row.logs.shape[1])
            _bridge(row, layout.range[beam, inside], layout.log_factor[beam, inside])
            beams.append(row)
    return beams


class Condensed(NamedTuple):
    """Condensed signals, and how they follow their bins."""

    beams: Beams
    derivatives: list[Array]
    """For each beam, (profile, 2 passage, bin) derivatives of u and I by the logarithms."""
    curvature: Array
    """(profile, beam, passage, 2) difference of line and polynomial, and its variance by noise."""


def condense(beams: list[CleanBeam], layout: FitLayout, reach: Indices | None = None) -> Condensed:
    """Condense clean beams to values at crossings and integrals between them.

    The (profile, beam) `reach` is the number of passages that are used at most.
    """
    beam, place = places(layout)
    shape = len(beams[0].logs), len(beams), int(place.max(initial=0)) + 1
    most = shape[2]
    value, integral, curvature = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 2))
    covariance = np.zeros((*shape[:2], 2 * most, 2 * most))
    reach, derivatives = np.full(shape[:2], most) if reach is None else reach.copy(), []
    for b, row in enumerate(beams):
        on_beam = slice(*layout.first_passage[row.number : row.number + 2])
        ends = layout.window[on_beam] + layout.weights.shape[1]
        usable = (ends[:, np.newaxis] <= row.stops).sum(axis=0)
        reach[:, b] = np.minimum(reach[:, b], usable)
        derivative = np.zeros((len(reach), 2 * most, row.logs.shape[1]))
        inside = slice(row.start, row.start + row.logs.shape[1])
        steps = np.diff(layout.range[row.number, inside])
        _condense_beam(
            (row.logs, row.noise, row.doubt, row.exponent),
            (layout.window[on_beam] - row.start, layout.weights[on_beam],
             layout.curvature_weights[on_beam]),
            (layout.cell[on_beam] - row.start, layout.fraction[on_beam], steps),
            reach[:, b],
            (value[:, b], integral[:, b], derivative, curvature[:, b]),
        )  # fmt: skip
        _transfer_derivatives(derivative, row, layout.range[row.number, inside])
        # The deviations of bins that stay are of one direction.
        shift = (derivative * row.doubt[:, np.newaxis]).sum(axis=2)
        spread = (derivative * row.noise[:, np.newaxis]) @ derivative.swapaxes(1, 2)
        covariance[:, b] = spread + shift[:, :, np.newaxis] * shift[:, np.newaxis]
        noise = np.diagonal(covariance[:, b], axis1=1, axis2=2)
        known = np.isfinite(noise) & ((noise > 0.0) | (np.arange(2 * most) >= reach[:, b : b + 1]))
        reach[:, b] = np.where(known.all(axis=1) & (reach[:, b] > 1), reach[:, b], 0)
        derivatives.append(derivative)
    crossing = np.zeros(shape[1:], dtype=np.intp)
    crossing[beam, place] = number = (np.cumsum(layout.measured) - 1)[layout.passages.crossing]
    select = np.zeros((*shape[1:], int(np.sum(layout.measured))))
    select[beam, place, number] = 1.0
    return Condensed(
        Beams(value, integral, covariance, reach, crossing, select), derivatives, curvature
    )


def places(layout: FitLayout) -> tuple[Indices, Indices]:
    """Return beam and place on the beam of each passage, with beams that have passages only."""
    counts = np.diff(layout.first_passage)
    beam = np.repeat(np.arange(np.sum(counts > 0)), counts[counts > 0])
    place = np.arange(beam.size) - layout.first_passage[:-1][layout.passages.beam]
    return beam, place


@compiled
def _condense_beam(
    signal: tuple[Array, Array, Array, float],
    fits: tuple[Indices, Array, Array],
    cells: tuple[Indices, Array, Array],
    reach: Indices,
    out: tuple[Array, Array, Array, Array],
) -> None:
    """Fill u, I, their derivatives and the errors by curvature of one beam.

    The signal is exponential within a cell, so that the integral is exact in homogeneous air. The
    centroid of a cell is a series in the step, x / 12 - x^3 / 720 + x^5 / 30240 from the middle. It
    only divides derivatives between the ends of a cell.
    """
    (logs, noise, doubt, exponent), (window, weights, curved) = signal, fits
    (cell, fraction, steps), (value, integral, derivative, curvature) = cells, out
    most = value.shape[1]
    for t in range(reach.size):
        for p in range(reach[t]):
            shift = 0.0
            for k in range(weights.shape[1]):
                g = window[p] + k
                # E ln(1 + e) = -e^2 / 2; the noise contains the square of the exponent.
                log = logs[t, g] + 0.5 * noise[t, g] / exponent
                value[t, p] += weights[p, k] * log
                derivative[t, p, g] = weights[p, k]
                curvature[t, p, 0] += curved[p, k] * log
                curvature[t, p, 1] += curved[p, k] * curved[p, k] * noise[t, g]
                shift += curved[p, k] * doubt[t, g]
            curvature[t, p, 1] += shift * shift
        scale = value[t, 0]
        for p in range(reach[t]):
            value[t, p] -= scale
        for p in range(reach[t] - 1):
            for g in range(cell[p], cell[p + 1] + 1):
                start = fraction[p] if g == cell[p] else 0.0
                width = (fraction[p + 1] if g == cell[p + 1] else 1.0) - start
                step = logs[t, g + 1] - logs[t, g]
                step = step if abs(step) >= _SMALLEST_STEP else _SMALLEST_STEP
                part = math.exp(logs[t, g] - scale + step * start) * math.expm1(step * width) / step
                part *= 2.0 * exponent * steps[g]
                square = (step * width) ** 2
                shift = step * width * (1.0 - square / 60.0 * (1.0 - square / 42.0)) / 12.0
                centroid = start + width * (0.5 + min(max(shift, -0.5), 0.5))
                integral[t, p] += part
                derivative[t, most + p, g] += part * (1.0 - centroid)
                derivative[t, most + p, g + 1] += part * centroid


def _take_logarithms(
    beam: int, power: Array, variance: Array, exponent: float, layout: FitLayout, *,
    together: bool,
) -> CleanBeam:  # fmt: skip
    """Return the logarithms of a beam, and why they end before its last used bin."""
    first, last = layout.first_passage[beam], layout.first_passage[beam + 1] - 1
    low, high = layout.window[first], layout.window[last] + layout.weights.shape[1]
    start = max(layout.limits[beam, 0], low - MARGIN)
    end = min(layout.limits[beam, 1], high + MARGIN)
    power, variance = power[:, start:end].copy(), variance[:, start:end].copy()
    positive = (power > 0.0) & (power < HUGE)
    safe = np.where(positive, power, 1.0)
    noise = exponent**2 * (variance / safe**2)
    known = positive & (noise < np.inf)
    logs = np.where(known, exponent * (np.log(safe) + layout.log_factor[beam, start:end]), 0.0)
    used = slice(low - start, high - start)
    lost = ~known
    rows = np.flatnonzero(together & lost[:, used].any(axis=1))
    lost[rows] &= ~_negative_by_noise(power[rows], variance[rows])
    lost = lost[:, used]
    stops = np.where(lost.any(axis=1), np.argmax(lost, axis=1) + low, high)
    at_stop = power[np.arange(len(power)), np.minimum(stops, end - 1) - start]
    reason = np.where((at_stop <= 0.0) & (at_stop > -HUGE), NOT_POSITIVE, MISSING)
    status = np.where(stops < high, reason, 0).astype(np.uint8)
    codes = np.where(known, GOOD, LOST).astype(np.uint8)
    noise = np.where(known, noise, 0.0)
    doubt = np.zeros_like(noise)
    return CleanBeam(
        beam, int(start), int(low), power, variance, logs, noise, doubt, codes, stops, status,
        exponent,
    )  # fmt: skip


def _negative_by_noise(power: Array, variance: Array) -> Booleans:
    """Return (profile, bin) where a bin is not positive, but no outlier among its neighbours.

    The beam as a whole has a signal.
    """
    known = np.isfinite(power) & np.isfinite(variance)
    values, noise = np.where(known, power, 0.0), np.where(known, variance, 0.0)
    level = uniform_filter1d(values, _NEIGHBOURS, axis=1, mode="nearest")
    whole = values.sum(axis=1) > COMMON.outlier * np.sqrt(noise.sum(axis=1))
    near = known & (level - power < COMMON.outlier * np.sqrt(noise))
    return np.asarray(near & (power <= 0.0) & whole[:, np.newaxis])


def _bridge(row: CleanBeam, grid: Array, factor: Array) -> None:
    """Replace single outlying bins by what their neighbours predict, in place."""
    low = row.low - row.start
    if not grid[low + 1] - grid[low] <= THRESHOLDS.widest_bin:
        return
    ends = row.stops - row.start
    outlying_bins.search(row.logs, row.noise, row.exponent, grid, low, ends, row.codes, row.doubt)
    row.status[ends + row.start < row.stops] = OUTLYING
    row.stops[:] = ends + row.start
    profiles, bins, nodes, weights = _bridged_bins(row, grid)
    noise = row.noise[profiles[:, np.newaxis], nodes]
    logs = row.logs[profiles[:, np.newaxis], nodes]
    row.logs[profiles, bins] = line = (weights * logs).sum(axis=1)
    row.noise[profiles, bins] = noise = (weights * weights * noise).sum(axis=1)
    row.power[profiles, bins] = power = np.exp(line / row.exponent - factor[bins])
    row.variance[profiles, bins] = noise * (power / row.exponent) ** 2


def _bridged_bins(row: CleanBeam, grid: Array) -> tuple[Indices, Indices, Indices, Array]:
    """Return profile and bin of each bridged bin, its neighbours and their weights."""
    profiles, bins = np.nonzero(row.codes == BRIDGED)
    nodes = np.zeros((bins.size, outlying_bins.NODES), dtype=np.intp)
    weights = np.zeros(nodes.shape)
    outlying_bins.find_neighbours(grid, row.codes, profiles, bins, nodes, weights)
    return profiles, bins, nodes, weights


def _transfer_derivatives(derivatives: Array, row: CleanBeam, grid: Array) -> None:
    """Transfer the derivatives by bridged bins to the neighbours they come from, in place."""
    if np.any(row.codes == BRIDGED):
        profiles, bins, nodes, weights = _bridged_bins(row, grid)
        own = derivatives[profiles, :, bins][:, np.newaxis]
        by_bin = derivatives.transpose(0, 2, 1)
        np.add.at(by_bin, (profiles[:, np.newaxis], nodes), weights[..., np.newaxis] * own)
        by_bin[profiles, bins] = 0.0
