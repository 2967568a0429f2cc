r"""Signals of beams, condensed to values at crossings and integrals between them.

With the signal a = (P r^2 / O)^m of a beam, the value at crossing p is u_p = ln a, from a straight
line through the logarithms of the bins around it, and the integral from there to the next one is
I_p = 2 m (integral of a). Both are linear in small errors of the logarithms, so that with the
derivatives G their covariance is G diag(variance) G'. Bins, weights and cells follow from geometry
and range alone (`lay_out_fits`), so they are computed once for all profiles. The result of a
profile does not depend on the other profiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Codes, Indices
from lidarops.retrieve.network import outlying_bins
from lidarops.retrieve.network.geometry import Network, Passages
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

MISSING: Final = 1
NOT_POSITIVE: Final = 2
OUTLYING: Final = 3
"""Reasons why a beam ends before its last bin."""
_SMALLEST_STEP: Final = 1e-12


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
    offset: Indices
    """(beam + 1,) start of the packed covariance of each beam."""


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
    count = np.diff(first)
    continues = np.zeros(net.crossings, dtype=np.bool_)
    continues[measurable.crossing[:-1][measurable.beam[:-1] == measurable.beam[1:]]] = True
    window, weights, cell, fraction = _fits(measurable, range_, limits, bins)
    sizes = np.maximum(2 * count - 1, 0) ** 2
    offset = np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)
    bounds = np.array(limits, dtype=np.intp).reshape(-1, 2)
    return FitLayout(
        measurable, net.crossings, measured, continues, first, window, weights,
        _curvature_weights(measurable, range_, window, weights), cell, fraction,
        np.where(np.isfinite(log_factor), log_factor, 0.0), range_, bounds, offset,
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


@dataclass(frozen=True, slots=True, eq=False)
class CondensedSignals:
    """Values at passages and integrals between them, for each profile.

    The signal is scaled to 1 at the first crossing of each beam.
    """

    log_value: Array
    """(profile, passage) logarithm of the signal."""
    integral: Array
    """(profile, passage) m, 2 m times the integral from this to the next passage of the beam."""
    usable: Booleans
    """(profile, passage) True where all bins up to and around the passage are positive, and their
    variances known."""
    covariance: Array
    """(profile, packed) for each beam, covariance of its log values, then its integrals."""
    status: Codes
    """(profile, beam) MISSING, NOT_POSITIVE or OUTLYING."""
    bridged: Booleans
    """(profile, beam) True where a beam has outlying bins."""
    curvature_error: Array
    """(profile, passage, 2) difference of line and polynomial, and its variance by noise."""

    def take(self, profiles: Indices) -> CondensedSignals:
        """Return the selected profiles."""
        return CondensedSignals(*(getattr(self, name)[profiles] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class _Beam:
    """Logarithms of the bins of one beam that are used, and of a margin."""

    start: int
    """Number of the first bin."""
    logs: Array
    """(profile, bin)."""
    noise: Array
    """(profile, bin) their variances."""
    doubt: Array
    """(profile, bin) deviations of outlying bins that stay, because they may be air."""
    codes: Codes
    """(profile, bin) codes of `outlying_bins`."""
    stops: Indices
    """(profile,) behind the last bin that can be used."""
    exponent: float

    def values(self, bins: slice, weights: Array) -> tuple[Array, Array]:
        """Return sums of logarithms, corrected for their bias by noise, and their variances."""
        inside = slice(bins.start - self.start, bins.stop - self.start)
        noise = self.noise[:, inside]
        # E ln(1 + e) = -e^2 / 2; the noise contains the square of the exponent.
        logs = self.logs[:, inside] + 0.5 * noise / self.exponent
        doubt = (weights * self.doubt[:, inside]).sum(axis=1)
        return (weights * logs).sum(axis=1), (weights * weights * noise).sum(axis=1) + doubt**2


def condense(power: Array, variance: Array, exponent: Array, layout: FitLayout) -> CondensedSignals:
    """Condense power to values at crossings and integrals between them.

    Parameters
    ----------
    power, variance : (profile, beam, bin) float64
        Bins are independent.
    exponent : (beam,) float64
        m of backscatter ~ extinction^(1/m).
    layout : FitLayout
    """
    profiles, total = power.shape[0], layout.passages.beam.size
    out = CondensedSignals(
        np.full((profiles, total), np.nan),
        np.zeros((profiles, total)),
        np.zeros((profiles, total), dtype=np.bool_),
        np.zeros((profiles, int(layout.offset[-1]))),
        np.zeros((profiles, power.shape[1]), dtype=np.uint8),
        np.zeros((profiles, power.shape[1]), dtype=np.bool_),
        np.zeros((profiles, total, 2)),
    )
    # Signals out of bounds have no value.
    with np.errstate(all="ignore"):
        for beam in range(exponent.size):
            if layout.first_passage[beam] < layout.first_passage[beam + 1]:
                _condense_beam(
                    beam, power[:, beam], variance[:, beam], float(exponent[beam]), layout, out
                )
    return out


def _condense_beam(
    beam: int, power: Array, variance: Array, exponent: float, layout: FitLayout,
    out: CondensedSignals,
) -> None:  # fmt: skip
    on_beam = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
    row, out.status[:, beam] = _take_logarithms(beam, power, variance, exponent, layout)
    _bridge(row, layout.range[beam], out.status[:, beam], layout.window[on_beam.start])
    outlying = (row.codes == BRIDGED) | (row.codes == KEPT)
    out.bridged[:, beam] = outlying.any(axis=1)
    bins = layout.weights.shape[1]
    count = on_beam.stop - on_beam.start
    derivatives = np.zeros((len(power), 2 * count - 1, row.logs.shape[1]))
    for c in range(on_beam.start, on_beam.stop):
        window = slice(layout.window[c], layout.window[c] + bins)
        usable = window.stop <= row.stops
        value, _ = row.values(window, layout.weights[c])
        out.log_value[:, c] = np.where(usable, value, np.nan)
        out.usable[:, c] = usable
        inside = slice(window.start - row.start, window.stop - row.start)
        derivatives[:, c - on_beam.start, inside] = usable[:, np.newaxis] * layout.weights[c]
        for column, error in enumerate(row.values(window, layout.curvature_weights[c])):
            out.curvature_error[:, c, column] = np.where(usable, error, 0.0)
    scale = out.log_value[:, on_beam.start].copy()
    for c in range(on_beam.start, on_beam.stop - 1):
        usable = out.usable[:, c + 1]
        cells = slice(layout.cell[c] - row.start, layout.cell[c + 1] - row.start + 1)
        ends = layout.fraction[c], layout.fraction[c + 1]
        steps = np.diff(layout.range[beam, layout.cell[c] : layout.cell[c + 1] + 2])
        logs = row.logs[:, cells.start : cells.stop + 1] - scale[:, np.newaxis]
        parts, centroid = _integrate_cells(logs, ends)
        parts *= np.where(usable[:, np.newaxis], 2.0 * exponent * steps, 0.0)
        parts = np.where(usable[:, np.newaxis], parts, 0.0)
        out.integral[:, c] = parts.sum(axis=1)
        derivative = derivatives[:, count + c - on_beam.start]
        derivative[:, cells] += parts * (1.0 - centroid)
        derivative[:, cells.start + 1 : cells.stop + 1] += parts * centroid
    _transfer_derivatives(derivatives, row, layout.range[beam])
    covariance = (derivatives * row.noise[:, np.newaxis]) @ derivatives.transpose(0, 2, 1)
    # The deviations of bins that stay are of one direction.
    shift = (derivatives * row.doubt[:, np.newaxis]).sum(axis=2)
    covariance += shift[:, :, np.newaxis] * shift[:, np.newaxis]
    packed = slice(layout.offset[beam], layout.offset[beam + 1])
    out.covariance[:, packed] = covariance.reshape(len(power), covariance.shape[1] ** 2)
    out.log_value[:, on_beam] -= scale[:, np.newaxis]


def _take_logarithms(
    beam: int, power: Array, variance: Array, exponent: float, layout: FitLayout
) -> tuple[_Beam, Codes]:
    """Return the logarithms of a beam, and why they end before its last used bin."""
    first, last = layout.first_passage[beam], layout.first_passage[beam + 1] - 1
    low, high = layout.window[first], layout.window[last] + layout.weights.shape[1]
    start = max(layout.limits[beam, 0], low - THRESHOLDS.margin)
    end = min(layout.limits[beam, 1], high + THRESHOLDS.margin)
    power, variance = power[:, start:end], variance[:, start:end]
    positive = (power > 0.0) & (power < HUGE)
    safe = np.where(positive, power, 1.0)
    noise = exponent**2 * (variance / safe**2)
    known = positive & (noise < np.inf)
    logs = np.where(known, exponent * (np.log(safe) + layout.log_factor[beam, start:end]), 0.0)
    lost = ~known[:, low - start : high - start]
    stops = np.where(lost.any(axis=1), np.argmax(lost, axis=1) + low, high)
    at_stop = power[np.arange(len(power)), np.minimum(stops, end - 1) - start]
    reason = np.where((at_stop <= 0.0) & (at_stop > -HUGE), NOT_POSITIVE, MISSING)
    status = np.where(stops < high, reason, 0).astype(np.uint8)
    codes = np.where(known, GOOD, LOST).astype(np.uint8)
    noise = np.where(known, noise, 0.0)
    return _Beam(start, logs, noise, np.zeros_like(noise), codes, stops, exponent), status


def _bridge(row: _Beam, grid: Array, status: Codes, low: int) -> None:
    """Replace single outlying bins by what their neighbours predict, in place."""
    if not grid[low + 1] - grid[low] <= THRESHOLDS.widest_bin:
        return
    grid = np.ascontiguousarray(grid[row.start : row.start + row.logs.shape[1]])
    ends = row.stops - row.start
    outlying_bins.search(
        row.logs, row.noise, row.exponent, grid, int(low) - row.start, ends, row.codes, row.doubt
    )
    status[ends + row.start < row.stops] = OUTLYING
    row.stops[:] = ends + row.start
    profiles, bins, nodes, weights = _bridged_bins(row, grid)
    noise = row.noise[profiles[:, np.newaxis], nodes]
    logs = row.logs[profiles[:, np.newaxis], nodes]
    row.logs[profiles, bins] = (weights * logs).sum(axis=1)
    row.noise[profiles, bins] = (weights * weights * noise).sum(axis=1)


def _bridged_bins(row: _Beam, grid: Array) -> tuple[Indices, Indices, Indices, Array]:
    """Return profile and bin of each bridged bin, its neighbours and their weights."""
    profiles, bins = np.nonzero(row.codes == BRIDGED)
    nodes = np.zeros((bins.size, outlying_bins.NODES), dtype=np.intp)
    weights = np.zeros(nodes.shape)
    outlying_bins.find_neighbours(grid, row.codes, profiles, bins, nodes, weights)
    return profiles, bins, nodes, weights


def _transfer_derivatives(derivatives: Array, row: _Beam, grid: Array) -> None:
    """Transfer the derivatives by bridged bins to the neighbours they come from, in place."""
    if np.any(row.codes == BRIDGED):
        grid = np.ascontiguousarray(grid[row.start : row.start + row.logs.shape[1]])
        profiles, bins, nodes, weights = _bridged_bins(row, grid)
        own = derivatives[profiles, :, bins][:, np.newaxis]
        by_bin = derivatives.transpose(0, 2, 1)
        np.add.at(by_bin, (profiles[:, np.newaxis], nodes), weights[..., np.newaxis] * own)
        by_bin[profiles, bins] = 0.0


def _integrate_cells(logs: Array, ends: tuple[float, float]) -> tuple[Array, Array]:
    """Return integrals over cells, in cells, and the places of their centroids, from 0 to 1.

    The signal is exponential within a cell, so that the integral is exact in homogeneous air. The
    centroid is a series in the step, x / 12 - x^3 / 720 + x^5 / 30240 from the middle. It only
    divides derivatives between the ends of a cell.

    Parameters
    ----------
    logs : (profile, cell + 1) float64
        Logarithms of the signal at the ends of the cells.
    ends : two float
        Where the integral starts in the first cell, and stops in the last one.
    """
    step = np.diff(logs, axis=1)
    step = np.where(np.abs(step) < _SMALLEST_STEP, _SMALLEST_STEP, step)
    start, stop = np.zeros(step.shape[1]), np.ones(step.shape[1])
    start[0], stop[-1] = ends
    width = stop - start
    whole = np.exp(logs[:, :-1] + step * start) * np.expm1(step * width) / step
    square = (step * width) ** 2
    shift = step * width * (1.0 - square / 60.0 * (1.0 - square / 42.0)) / 12.0
    return whole, start + width * (0.5 + np.clip(shift, -0.5, 0.5))
