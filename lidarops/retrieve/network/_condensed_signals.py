r"""Signals of beams, condensed to values at crossings and integrals between them.

With the signal a = (P r^2 / O)^m of a beam, the value at crossing p is u_p = ln a, from a straight
line through the logarithms of the bins around it, and the integral from there to the next one is
I_p = 2 m (integral of a). Both are linear in small errors of the logarithms, so that with the
derivatives G their covariance is G diag(variance) G'. Bins, weights and cells follow from geometry
and range alone (`lay_out_fits`), so they are computed once for all profiles. The result of a
profile does not depend on the other profiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Codes, Indices
from lidarops.retrieve.network import _matrices, outlying_bins
from lidarops.retrieve.network.geometry import Network, Passages
from lidarops.retrieve.network.outlying_bins import BRIDGED, GOOD, KEPT, LOST
from lidarops.retrieve.network.thresholds import THRESHOLDS

MISSING: Final = 1
NOT_POSITIVE: Final = 2
OUTLYING: Final = 3
"""Reasons why a beam ends before its last bin."""
_SMALLEST_STEP: Final = 1e-12
_NEIGHBOURS: Final = 7
"""Bins whose mean is the level of a bin that is not positive."""
_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""


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
    curvature_error: Array
    """(profile, passage, 2) difference of line and polynomial, and its variance by noise."""


@dataclass(frozen=True, slots=True, eq=False)
class CleanBeam:
    """Bins of one beam that are used, and of a margin, with single outlying bins bridged."""

    number: int
    start: int
    """Number of the first bin."""
    low: int
    """Number of the first bin that a fit uses; those before it are a margin."""
    power: Array
    """(profile, bin) and its variance, as given."""
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

    def clear(self, layout: FitLayout) -> Booleans:
        """Return (profile, passage) where noise does not hide the signal at a passage."""
        passages = slice(*layout.first_passage[self.number : self.number + 2])
        at = layout.window[passages, np.newaxis] + np.arange(layout.weights.shape[1]) - self.start
        level, spread = (each[:, at].mean(axis=2) for each in (self.power, self.variance))
        return np.asarray(spread <= (THRESHOLDS.largest_bin_error * np.maximum(level, 0.0)) ** 2)

    def values(self, bins: slice, weights: Array) -> tuple[Array, Array]:
        """Return sums of logarithms, corrected for their bias by noise, and their variances."""
        inside = slice(bins.start - self.start, bins.stop - self.start)
        noise = self.noise[:, inside]
        # E ln(1 + e) = -e^2 / 2; the noise contains the square of the exponent.
        logs = self.logs[:, inside] + 0.5 * noise / self.exponent
        doubt = (weights * self.doubt[:, inside]).sum(axis=1)
        return (weights * logs).sum(axis=1), (weights * weights * noise).sum(axis=1) + doubt**2


def clean(
    power: Array, variance: Array, exponent: Array, layout: FitLayout, *, together: bool
) -> list[CleanBeam]:
    """Return the beams that have passages, with outlying bins found.

    Parameters
    ----------
    power, variance : (profile, beam, bin) float64
        Bins are independent.
    exponent : (beam,) float64
        m of backscatter ~ extinction^(1/m).
    layout : FitLayout
    together : bool
        Whether profiles are averaged, so that a bin which noise makes negative is no end of a beam.
    """
    with np.errstate(all="ignore"):
        beams = []
        for beam in np.flatnonzero(np.diff(layout.first_passage)):
            row = _take_logarithms(
                int(beam), power[:, beam], variance[:, beam], float(exponent[beam]), layout,
                together=together,
            )  # fmt: skip
            _bridge(row, layout.range[beam], layout.window[layout.first_passage[beam]])
            beams.append(row)
    return beams


def condense(beams: Sequence[CleanBeam], layout: FitLayout) -> tuple[CondensedSignals, list[Array]]:
    """Condense clean beams to values at crossings and integrals between them.

    Returns
    -------
    CondensedSignals
    list of (profile, 2 passage - 1, bin) float64
        For each beam, derivatives of its values and integrals by the logarithms of its bins.
    """
    profiles, total = len(beams[0].logs) if beams else 0, layout.passages.beam.size
    out = CondensedSignals(
        np.full((profiles, total), np.nan),
        np.zeros((profiles, total)),
        np.zeros((profiles, total), dtype=np.bool_),
        np.zeros((profiles, int(layout.offset[-1]))),
        np.zeros((profiles, total, 2)),
    )
    # Signals out of bounds have no value.
    with np.errstate(all="ignore"):
        return out, [_condense_beam(row, layout, out) for row in beams]


def _condense_beam(row: CleanBeam, layout: FitLayout, out: CondensedSignals) -> Array:
    """Fill the signals of a beam, and return their derivatives."""
    beam = row.number
    on_beam = slice(layout.first_passage[beam], layout.first_passage[beam + 1])
    bins = layout.weights.shape[1]
    count = on_beam.stop - on_beam.start
    derivatives = np.zeros((len(row.logs), 2 * count - 1, row.logs.shape[1]))
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
    first = on_beam.start
    scale = np.where(out.usable[:, first], out.log_value[:, first], 0.0)
    for c in range(on_beam.start, on_beam.stop - 1):
        usable = out.usable[:, c + 1]
        cells = slice(layout.cell[c] - row.start, layout.cell[c + 1] - row.start + 1)
        ends = layout.fraction[c], layout.fraction[c + 1]
        steps = np.diff(layout.range[beam, layout.cell[c] : layout.cell[c + 1] + 2])
        logs = row.logs[:, cells.start : cells.stop + 1] - scale[:, np.newaxis]
        parts, centroid = _integrate_cells(logs, ends)
        parts *= np.where(usable[:, np.newaxis], 2.0 * row.exponent * steps, 0.0)
        parts = np.where(usable[:, np.newaxis], parts, 0.0)
        out.integral[:, c] = parts.sum(axis=1)
        derivative = derivatives[:, count + c - on_beam.start]
        derivative[:, cells] += parts * (1.0 - centroid)
        derivative[:, cells.start + 1 : cells.stop + 1] += parts * centroid
    _transfer_derivatives(derivatives, row, layout.range[beam])
    covariance = _matrices.product(
        derivatives * row.noise[:, np.newaxis], derivatives.transpose(0, 2, 1)
    )
    # The deviations of bins that stay are of one direction.
    shift = (derivatives * row.doubt[:, np.newaxis]).sum(axis=2)
    covariance += shift[:, :, np.newaxis] * shift[:, np.newaxis]
    packed = slice(layout.offset[beam], layout.offset[beam + 1])
    out.covariance[:, packed] = covariance.reshape(len(covariance), covariance.shape[1] ** 2)
    out.log_value[:, on_beam] -= scale[:, np.newaxis]
    return derivatives


def _take_logarithms(
    beam: int, power: Array, variance: Array, exponent: float, layout: FitLayout, *,
    together: bool,
) -> CleanBeam:  # fmt: skip
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
    used = slice(low - start, high - start)
    lost = ~(known | _negative_by_noise(power, variance) if together else known)[:, used]
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
    negative = (power <= 0.0) & (variance < np.inf)
    if negative.any():
        known = np.isfinite(power) & np.isfinite(variance)
        values, noise = (np.where(known, array, 0.0) for array in (power, variance))
        level = uniform_filter1d(values, _NEIGHBOURS, axis=1, mode="nearest")
        negative &= level - power < THRESHOLDS.outlier * np.sqrt(noise)
        whole = values.sum(axis=1) > THRESHOLDS.outlier * np.sqrt(noise.sum(axis=1))
        negative &= whole[:, np.newaxis]
    return np.asarray(negative)


def _bridge(row: CleanBeam, grid: Array, low: int) -> None:
    """Replace single outlying bins by what their neighbours predict, in place."""
    if not grid[low + 1] - grid[low] <= THRESHOLDS.widest_bin:
        return
    grid = np.ascontiguousarray(grid[row.start : row.start + row.logs.shape[1]])
    ends = row.stops - row.start
    outlying_bins.search(
        row.logs, row.noise, row.exponent, grid, int(low) - row.start, ends, row.codes, row.doubt
    )
    row.status[ends + row.start < row.stops] = OUTLYING
    row.stops[:] = ends + row.start
    profiles, bins, nodes, weights = _bridged_bins(row, grid)
    noise = row.noise[profiles[:, np.newaxis], nodes]
    logs = row.logs[profiles[:, np.newaxis], nodes]
    row.logs[profiles, bins] = (weights * logs).sum(axis=1)
    row.noise[profiles, bins] = (weights * weights * noise).sum(axis=1)


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


# Curved signals ----------------------------------------------------------------------------------


def curvature_variance(curvature_error: Array, usable: Booleans, carried: Array) -> Array:
    r"""Return (profile, crossing) variances from curved signals within a fit.

    Where the logarithm f of the signal is curved along the beam, a line through equal weights of
    bins is too high by about f'' (bins^2 - 1) step^2 / 24. A polynomial of degree 4 through the
    same bins has almost none of this error, but twice the noise, so it is not a better value.
    Their difference, carried to the solution, shows the error. The result is the largest of
    three, each less the contribution of noise: the square of the shift by the median of the block,
    the mean square of the shifts of its profiles (a layer may rise or sink), and the square of the
    shift of the profile itself.

    Parameters
    ----------
    curvature_error : (profile, passage, 2) float64
        Difference of line and polynomial, and its variance by noise, in the profiles of a block.
    usable : (profile, passage) bool
    carried : (profile, crossing, passage) float64
        Derivatives of ln extinction by the log values.
    """
    error, noise = np.moveaxis(curvature_error, -1, 0)
    number = usable.sum(axis=0)
    shared, shared_noise = (np.nan_to_num(median(values, usable)) for values in (error, noise))
    # The median of one or two is their mean.
    shared_noise *= np.where(number > 2, _MEDIAN_OVER_MEAN, 1.0) / np.maximum(number, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = carried * carried
        own_shift, own_noise = (
            (values * of[:, np.newaxis]).sum(axis=2)
            for values, of in ((carried, error), (squares, noise))
        )
        shared_shift = (carried * shared).sum(axis=2)
        shared_excess = shared_shift**2 - THRESHOLDS.shared_noise * (squares * shared_noise).sum(2)
        # A noisy profile would hide the shift of the others, or imitate one.
        counted = own_noise > 0.0
        counted &= own_noise <= THRESHOLDS.noisy_profile * np.median(own_noise, axis=0)
        number = np.maximum(counted.sum(axis=0), 1)
        by_chance = (1.0 + THRESHOLDS.chance * np.sqrt(2.0 / number)) * own_noise
        excess = np.where(counted, own_shift**2 - by_chance, 0.0).sum(axis=0) / number
        largest = np.fmax(shared_excess, own_shift**2 - THRESHOLDS.profile_noise * own_noise)
        return np.asarray(np.fmax(np.fmax(largest, excess), 0.0))


def median(values: Array, known: Booleans) -> Array:
    """Return medians over profiles of the known values; NaN where there is none."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    number, columns = known.sum(axis=0), np.arange(values.shape[1])
    ordered = np.sort(np.where(known, values, np.inf), axis=0)
    low, high = (ordered[place, columns] for place in (np.maximum(number - 1, 0) // 2, number // 2))
    return np.where(number > 0, 0.5 * (low + high), np.nan)
