"""Signals of beams condensed to values at crossings and integrals between them, with covariances.

Where a crossing lies, which bins a fit takes and with which weights, and what part of a cell
belongs to a segment follow from geometry and range alone: they are computed once. The weights
are kept sparse, because a fit takes 7 bins of a thousand, and applied in compiled loops, whose
result for a profile does not depend on the others.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _curvature_errors
from lidarops.retrieve.network.geometry import Network, Passages
from lidarops.retrieve.network.noise import outlying_bins, outlying_runs

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]
Codes = npt.NDArray[np.uint8]

MISSING: Final = 1
NOT_POSITIVE: Final = 2
OUTLYING: Final = 3
LOWEST_OVERLAP: Final = 0.5
"""1. Of an overlap function less than this, the error dominates what is left of the signal."""
_SERIES_BELOW: Final = 0.03

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Which bins make the values at the passages of beams, and with which weights."""

    passages: Passages
    """Those that can be measured, ordered along the beams."""
    crossings: int
    measured: Booleans
    """(crossing,) True where at least two beams can measure there."""
    near_crossing: Booleans
    """(crossing,) True where one of the kept beams goes on to a further crossing."""
    first_passage: Indices
    """(beam + 1,) where the passages of a beam start."""
    window: Indices
    """(passage,) first bin of the fit."""
    weights: Array
    """(passage, bin) of the logarithms, for the value at the crossing."""
    cell: Indices
    """(passage,) the bin at or before the crossing."""
    fraction: Array
    """(passage,) of the cell behind that bin, up to the crossing."""
    log_factor: Array
    """(beam, bin) logarithm of what turns power into range- and overlap-corrected signal."""
    range: Array
    """(beam, bin) m."""
    limits: Indices
    """(beam, 2) first bin that may be used, and the one behind the last."""
    neighbours: tuple[Indices, Array, Array]
    """(beam, bin, neighbour) bins that tell a bin, their shares, and (beam, bin) what air may
    leave; see `lidarops.retrieve.network.noise.outlying_bins.plan_neighbours`."""
    offset: Indices
    """(beam + 1,) where the covariances of a beam start."""


@dataclass(frozen=True, slots=True, eq=False)
class Condensed:
    """Values at passages and integrals between them, of each profile.

    The signal is (power / overlap * range^2)^m, scaled to 1 at the first crossing of each beam.
    """

    log_value: Array
    """(profile, passage)."""
    integral: Array
    """(profile, passage) m, 2 m times the integral from here to the next passage of the beam."""
    usable: Codes
    """(profile, passage) 1 where all bins up to the passage's are positive, and their variances
    known."""
    covariance: Array
    """(profile, packed) for each beam, of its log values and then its integrals."""
    slope: Array
    """(profile, passage, 4) m-1: extinction of the segment behind, if homogeneous, from all its
    bins and from its farther half, each followed by its variance."""
    status: Codes
    """(profile, beam) MISSING, NOT_POSITIVE or OUTLYING."""
    bridged: Codes
    """(profile, beam) 1 where a bin lay off its neighbours, which took its place."""
    departure: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """(profile, passage, 2) of `_curvature_errors.measure_curvature`; empty where profiles were pooled."""

    def take(self, profiles: Indices) -> Condensed:
        """Return some of the profiles."""
        return Condensed(
            self.log_value[profiles], self.integral[profiles], self.usable[profiles],
            self.covariance[profiles], self.slope[profiles], self.status[profiles],
            self.bridged[profiles], self.departure[profiles],
        )  # fmt: skip


def lay_out(
    net: Network, range_: Array, overlap: Array | None, nearest: Array, bins: int
) -> Layout:
    """Choose bins and weights.

    Parameters
    ----------
    net : Network
    range_ : (beam, bin) float64
        m, ascending; NaN behind the last bin of a beam.
    overlap : (beam, bin) float64, optional
        Overlap function; 1 where not given.
    nearest : (beam,) float64
        m; bins nearer are not used.
    bins : int
        Of a local fit.
    """
    factor = np.ones_like(range_) if overlap is None else overlap
    with np.errstate(invalid="ignore", divide="ignore"):
        usable = (range_ >= nearest[:, np.newaxis]) & (factor >= LOWEST_OVERLAP)
        log_factor = 2.0 * np.log(range_) - np.log(factor)
    limits = [_bounds(row) for row in usable]
    keep = np.zeros(net.passages.beam.size, dtype=np.bool_)
    for c, (beam, where) in enumerate(zip(net.passages.beam, net.passages.range, strict=True)):
        low, high = limits[beam]
        keep[c] = high - low >= bins and range_[beam, low] <= where <= range_[beam, high - 1]
    measured = np.bincount(net.passages.crossing[keep], minlength=net.crossings) >= 2
    keep &= measured[net.passages.crossing]
    kept = Passages(net.passages.beam[keep], net.passages.crossing[keep], net.passages.range[keep])
    first = np.searchsorted(kept.beam, np.arange(net.beams + 1)).astype(np.intp)
    count = np.diff(first)
    near = np.zeros(net.crossings, dtype=np.bool_)
    near[kept.crossing[:-1][kept.beam[:-1] == kept.beam[1:]]] = True
    window, weights, cell, fraction = _fits(kept, range_, limits, bins)
    sizes = np.maximum(2 * count - 1, 0) ** 2
    offset = np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)
    bounds = np.array(limits, dtype=np.intp).reshape(-1, 2)
    return Layout(
        kept, net.crossings, measured, near, first, window, weights, cell, fraction,
        np.where(np.isfinite(log_factor), log_factor, 0.0), range_, bounds,
        outlying_bins.planned(range_, bounds), offset,
    )  # fmt: skip


def _bounds(usable: Booleans) -> tuple[int, int]:
    """Return the first run of usable bins that reaches farthest, as start and stop."""
    if not usable.any():
        return 0, 0
    stop = int(usable.size - np.argmax(usable[::-1]))
    before = np.flatnonzero(~usable[:stop])
    return (int(before[-1]) + 1 if before.size else 0), stop


def _fits(
    kept: Passages, range_: Array, limits: list[tuple[int, int]], bins: int
) -> tuple[Indices, Array, Indices, Array]:
    total = kept.beam.size
    window, cell = np.zeros(total, dtype=np.intp), np.zeros(total, dtype=np.intp)
    weights, fraction = np.zeros((total, bins)), np.zeros(total)
    for c, (beam, where) in enumerate(zip(kept.beam, kept.range, strict=True)):
        grid, (low, high) = range_[beam], limits[beam]
        centre = low + int(np.argmin(np.abs(grid[low:high] - where)))
        start = min(max(centre - bins // 2, low), high - bins)
        window[c] = start
        about = grid[start : start + bins]
        lever = about - about.mean()
        weights[c] = 1.0 / bins + lever * (where - about.mean()) / np.sum(lever**2)
        before = low + int(np.searchsorted(grid[low:high], where, side="right")) - 1
        cell[c] = min(before, high - 2)
        fraction[c] = (where - grid[cell[c]]) / (grid[cell[c] + 1] - grid[cell[c]])
    return window, weights, cell, fraction


def condense(
    power: Array,
    variance: Array,
    variance_row: Indices,
    exponent: Array,
    layout: Layout,
    *,
    relative: bool,
    screened: bool,
) -> Condensed:
    """Condense power to values at crossings and integrals between them.

    The value at a crossing is that of a straight line through the logarithms of the bins about
    it; to second order, the logarithm is freed of what noise takes from it. The signal is taken
    as exponential within a cell: its integral is exact on a homogeneous beam.

    Parameters
    ----------
    power : (profile, beam, bin) float64
    variance : (row, beam, bin) float64
        Of the power of each bin, or relative; bins are independent.
    variance_row : (profile,) intp
        The row of variance that goes with a profile.
    exponent : (beam,) float64
        m of backscatter ~ extinction^(1/m).
    layout : Layout
    relative : bool
        Whether variances are relative.
    screened : bool
        Whether to look for single bins that lie off their neighbours, and to bridge them.
    """
    profiles, total = power.shape[0], layout.passages.beam.size
    out = Condensed(
        np.full((profiles, total), np.nan),
        np.zeros((profiles, total)),
        np.zeros((profiles, total), dtype=np.uint8),
        np.zeros((profiles, int(layout.offset[-1]))),
        np.full((profiles, total, 4), np.nan),
        np.zeros((profiles, power.shape[1]), dtype=np.uint8),
        np.zeros((profiles, power.shape[1]), dtype=np.uint8),
        np.zeros((profiles, total, 2)),
    )
    _condense(
        power, variance, variance_row, relative, exponent, layout.log_factor, layout.range,
        layout.first_passage, layout.window, layout.weights, layout.cell, layout.fraction,
        layout.offset, screened, layout.limits, layout.neighbours, _curvature_errors.weights(layout),
        out.log_value, out.integral, out.usable, out.covariance, out.slope, out.status, out.bridged,
        out.departure,
    )  # fmt: skip
    return out


@_compiled
def _part_of_cell(step: float, start: float, stop: float) -> tuple[float, float]:
    """Return the integrals of exp(step t) and t exp(step t) over t from start to stop."""
    if abs(step) < _SERIES_BELOW:
        plain = weighted = 0.0
        low, high, factor = start, stop, 1.0
        for n in range(1, 9):
            plain += factor * (high - low) / n
            weighted += factor * (high * stop - low * start) / (n + 1)
            low, high, factor = low * start, high * stop, factor * step / n
        return plain, weighted
    at_start, at_stop = math.exp(step * start), math.exp(step * stop)
    plain = at_start * math.expm1(step * (stop - start)) / step
    return plain, (stop * at_stop - start * at_start - plain) / step


@_compiled
def _first_bad(
    row: Array, log_factor: Array, exponent: float, low: int, high: int, logs: Array
) -> tuple[int, int]:
    """Fill logarithms of the signal up to the first bin that has none; say why."""
    for g in range(low, high):
        if not abs(row[g]) < 1e300:
            return g, MISSING
        if row[g] <= 0.0:
            return g, NOT_POSITIVE
        logs[g] = exponent * (math.log(row[g]) + log_factor[g])
    return high, 0


@_compiled
def _add_segment(
    logs: Array,
    scale: float,
    grid: Array,
    ends: tuple[int, float, int, float],
    factor: float,
    gradient: Array,
) -> float:
    """Return the integral between two points, and add its derivatives by the logarithms."""
    first, from_fraction, last, to_fraction = ends
    total = 0.0
    for g in range(first, last + 1):
        start = from_fraction if g == first else 0.0
        stop = to_fraction if g == last else 1.0
        if stop <= start:
            continue
        here = factor * (grid[g + 1] - grid[g]) * math.exp(logs[g] - scale)
        plain, weighted = _part_of_cell(logs[g + 1] - logs[g], start, stop)
        total += here * plain
        gradient[g] += here * (plain - weighted)
        gradient[g + 1] += here * weighted
    return total


@_compiled
def _slope_of(
    logs: Array, noise: Array, grid: Array, codes: Codes, first: int, last: int, exponent: float
) -> tuple[float, float]:
    """Return the extinction that a straight line through logarithms gives, and its variance."""
    count = 0
    for g in range(first, last + 1):
        count += codes[g] == outlying_bins.GOOD
    if count < 2:
        return math.nan, math.nan
    mean = 0.0
    for g in range(first, last + 1):
        if codes[g] == outlying_bins.GOOD:
            mean += grid[g] / count
    square = product = spread = 0.0
    for g in range(first, last + 1):
        if codes[g] != outlying_bins.GOOD:
            continue
        lever = grid[g] - mean
        square += lever * lever
        product += lever * logs[g]
        spread += lever * lever * noise[g]
    scale = -0.5 / (exponent * square)
    return scale * product, scale * scale * spread


@_compiled
def _covariance_of(
    gradients: Array, bounds: Indices, quantities: int, noise: Array, packed: Array
) -> None:
    """Fill the (quantity, quantity) covariance from derivatives that vanish out of bounds."""
    for i in range(quantities):
        for j in range(i + 1):
            low = max(bounds[i, 0], bounds[j, 0])
            high = min(bounds[i, 1], bounds[j, 1])
            total = 0.0
            for g in range(low, high):
                total += gradients[i, g] * gradients[j, g] * noise[g]
            packed[i * quantities + j] = total
            packed[j * quantities + i] = total


@_compiled
def _fit_points(
    logs: Array,
    noise: Array,
    exponent: float,
    stop: int,
    passages: tuple[int, int],
    window: Indices,
    weights: Array,
    values: Array,
    usable: Codes,
    gradients: Array,
    bounds: Indices,
) -> int:
    """Fill the values at passages whose bins are good; return how many there are."""
    first, last = passages
    bins = weights.shape[1]
    for c in range(first, last):
        if window[c] + bins > stop:
            return c - first
        value = 0.0
        for i in range(bins):
            g = window[c] + i
            # E ln(1 + e) = -e^2 / 2; noise is already multiplied by the exponent's square.
            value += weights[c, i] * (logs[g] + 0.5 * noise[g] / exponent)
            gradients[c - first, g] = weights[c, i]
        bounds[c - first, 0], bounds[c - first, 1] = window[c], window[c] + bins
        values[c] = value
        usable[c] = 1
    return last - first


@_compiled
def _join_points(
    logs: Array,
    noise: Array,
    exponent: float,
    grid: Array,
    codes: Codes,
    passages: tuple[int, int, int],
    cell: Indices,
    fraction: Array,
    scale: float,
    integrals: Array,
    slopes: Array,
    gradients: Array,
    bounds: Indices,
) -> None:
    """Fill integrals and slopes between the good passages of a beam."""
    first, count, good = passages
    for c in range(first, first + good - 1):
        q = count + c - first
        integrals[c] = _add_segment(
            logs, scale, grid, (cell[c], fraction[c], cell[c + 1], fraction[c + 1]),
            2.0 * exponent, gradients[q],
        )  # fmt: skip
        bounds[q, 0], bounds[q, 1] = cell[c], cell[c + 1] + 2
        middle = (cell[c] + cell[c + 1] + 1) // 2
        slopes[c, 0], slopes[c, 1] = _slope_of(
            logs, noise, grid, codes, cell[c], cell[c + 1], exponent
        )
        slopes[c, 2], slopes[c, 3] = _slope_of(
            logs, noise, grid, codes, middle, cell[c + 1], exponent
        )
    for q in range(count + max(good - 1, 0), 2 * count - 1):
        bounds[q, 0], bounds[q, 1] = 0, 0
    for q in range(good, count):
        bounds[q, 0], bounds[q, 1] = 0, 0


@_compiled
def _look_beyond(
    row: Array,
    variance: Array,
    log_factor: Array,
    exponent: float,
    relative: bool,
    span: tuple[int, int],
    out: tuple[Array, Array, Codes],
) -> None:
    """Fill logarithms, their variances and codes of bins that only judge others."""
    logs, noise, codes = out
    for g in range(span[0], span[1]):
        codes[g] = outlying_bins.LOST
        if not abs(row[g]) < 1e300 or row[g] <= 0.0:
            continue
        logs[g] = exponent * (math.log(row[g]) + log_factor[g])
        spread = variance[g]
        noise[g] = exponent * exponent * (spread if relative else spread / row[g] ** 2)
        if noise[g] < math.inf:
            codes[g] = outlying_bins.GOOD


@_compiled
def _screen(
    signal: tuple[Array, Array, Array],
    exponent: float,
    relative: bool,
    grid: Array,
    span: tuple[int, int, int, int],
    planned: tuple[Indices, Array, Array],
    row: tuple[Array, Array, Codes],
    other: tuple[Array, Array, Codes],
    work: tuple[Array, Array, Array, Indices, Array],
) -> tuple[int, int]:
    """Bridge bins that lie off their neighbours.

    Return behind which bin the beam is not to be believed, and how many are bridged before; LEFT
    where bins lie off that are left as they are and may be wild: the other row then is the one
    without them.
    """
    power, variance, log_factor = signal
    logs, noise, codes = row
    plain, wide, off, nodes, shares = work
    first, low, stop, last = span
    for beyond in ((first, low), (stop, last)):
        _look_beyond(power, variance, log_factor, exponent, relative, beyond, row)
    outlying_bins.make_plain(logs, noise, exponent, codes, span, plain, wide)
    number, end = outlying_bins.find_outliers(
        (logs, noise, plain, wide), exponent, relative, grid, span, planned, codes, other[2], off
    )
    end = min(end, stop)
    if number == outlying_bins.LEFT:
        for g in range(first, last):
            other[0][g], other[1][g] = logs[g], noise[g]
        outlying_runs.draw_lines(other[0], other[1], grid, other[2], (first, last))
        reached = outlying_bins.replace_outliers(
            other[0], other[1], exponent, grid, (first, last, end), other[2], nodes, shares
        )
        # Where nothing good is left, nothing is told.
        return (end, number) if reached == end else (low, 1)
    if number > 0:
        end = outlying_bins.replace_outliers(
            logs, noise, exponent, grid, (first, last, end), codes, nodes, shares
        )
    number = 0
    for g in range(low, end):
        number += codes[g] == outlying_bins.BRIDGED
    return end, number


@_compiled
def _widen(
    one: tuple[Array, Array, Array],
    other: tuple[Array, Array, Array],
    passages: tuple[int, int, int],
    packed: Array,
) -> None:
    """Add to covariances what two readings of a beam differ by, of which either may be true."""
    first, count, good = passages
    quantities = 2 * count - 1
    apart = np.zeros(quantities)
    for c in range(good):
        apart[c] = other[0][first + c] - one[0][first + c]
    for c in range(good - 1):
        apart[count + c] = other[1][first + c] - one[1][first + c]
        for k in (0, 2):
            step = other[2][first + c, k] - one[2][first + c, k]
            if abs(step) < math.inf:
                one[2][first + c, k + 1] += step * step
    for i in range(quantities):
        for j in range(quantities):
            packed[i * quantities + j] += apart[i] * apart[j]


@_compiled
def _condense(
    power: Array,
    variance: Array,
    variance_row: Indices,
    relative: bool,
    exponent: Array,
    log_factor: Array,
    range_: Array,
    first_passage: Indices,
    window: Indices,
    weights: Array,
    cell: Indices,
    fraction: Array,
    offset: Indices,
    screened: bool,
    limits: Indices,
    neighbours: tuple[Indices, Array, Array],
    departing: Array,
    values: Array,
    integrals: Array,
    usable: Codes,
    covariance: Array,
    slopes: Array,
    status: Codes,
    bridged: Codes,
    departures: Array,
) -> None:
    size, most = power.shape[2], 1
    for beam in range(exponent.size):
        most = max(most, first_passage[beam + 1] - first_passage[beam])
    gradients = np.zeros((2 * most, size))
    bounds = np.zeros((2 * most, 2), dtype=np.intp)
    logs, noise, codes = np.zeros(size), np.zeros(size), np.zeros(size, dtype=np.uint8)
    nodes = np.zeros((size, outlying_bins.NODES), dtype=np.intp)
    work = np.zeros(size), np.zeros(size), np.zeros(size), nodes, np.zeros(nodes.shape)
    other = np.zeros(size), np.zeros(size), np.zeros(size, dtype=np.uint8)
    total = values.shape[1]
    without = np.zeros(total), np.zeros(total), np.zeros((total, 4))
    reached = np.zeros(total, dtype=np.uint8)
    for n in range(power.shape[0]):
        for beam in range(exponent.size):
            first, last = first_passage[beam], first_passage[beam + 1]
            count = last - first
            if count == 0:
                continue
            low, high = window[first], window[last - 1] + weights.shape[1]
            m = exponent[beam]
            stop, reason = _first_bad(power[n, beam], log_factor[beam], m, low, high, logs)
            spread_row = variance[variance_row[n], beam]
            for g in range(low, stop):
                spread = spread_row[g]
                noise[g] = m * m * (spread if relative else spread / power[n, beam, g] ** 2)
                if not noise[g] < math.inf:
                    stop, reason = g, MISSING
                    break
                codes[g] = outlying_bins.GOOD
            start = max(limits[beam, 0], low - outlying_bins.MARGIN)
            end = min(limits[beam, 1], stop + outlying_bins.MARGIN)
            found = 0
            narrow = range_[beam, low + 1] - range_[beam, low] <= outlying_bins.WIDEST
            if screened and narrow and stop > low:
                believed, found = _screen(
                    (power[n, beam], spread_row, log_factor[beam]), m, relative, range_[beam],
                    (start, low, stop, end),
                    (neighbours[0][beam], neighbours[1][beam], neighbours[2][beam]),
                    (logs, noise, codes), other, work,
                )  # fmt: skip
                reason = OUTLYING if believed < stop else reason
                stop = believed
            status[n, beam] = reason
            bridged[n, beam] = min(abs(found), 1)
            gradients[:, start : max(end, high)] = 0.0
            good = _fit_points(
                logs, noise, m, stop, (first, last), window, weights, values[n], usable[n],
                gradients, bounds,
            )  # fmt: skip
            plain = other if found == outlying_bins.LEFT else (logs, noise, codes)
            _curvature_errors.measure_curvature(
                plain, m, (first, first + good), window, departing, departures[n]
            )
            _join_points(
                logs, noise, m, range_[beam], codes, (first, count, good), cell, fraction,
                values[n, first], integrals[n], slopes[n], gradients, bounds,
            )  # fmt: skip
            outlying_bins.hand_on(
                gradients, bounds, 2 * count - 1, (low, stop if found > 0 else low), codes, nodes,
                work[4],
            )  # fmt: skip
            _covariance_of(
                gradients, bounds, 2 * count - 1, noise,
                covariance[n, offset[beam] : offset[beam + 1]],
            )  # fmt: skip
            if found == outlying_bins.LEFT:
                _fit_points(
                    other[0], other[1], m, stop, (first, last), window, weights, without[0],
                    reached, gradients, bounds,
                )  # fmt: skip
                _join_points(
                    other[0], other[1], m, range_[beam], other[2], (first, count, good), cell,
                    fraction, values[n, first], without[1], without[2], gradients, bounds,
                )  # fmt: skip
                _widen(
                    (values[n], integrals[n], slopes[n]), without, (first, count, good),
                    covariance[n, offset[beam] : offset[beam + 1]],
                )  # fmt: skip
            for c in range(first + good - 1, first - 1, -1):
                values[n, c] -= values[n, first]
