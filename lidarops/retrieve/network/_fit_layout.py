"""Geometry of the fits: which range bins give the signal at each crossing, with which weights.

The bins of a fit, their weights and the fraction of a range cell that belongs to a segment follow
from geometry and range alone, so they are computed once for all profiles. Only the few bins of a
fit have weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network.geometry import Network, Passages
from lidarops.retrieve.network.thresholds import THRESHOLDS


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
