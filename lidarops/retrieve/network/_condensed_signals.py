"""Signals of beams condensed to values at crossings and integrals between them, with covariances.

Bins, weights and cell fractions come from `_fit_layout`. Outlying bins are bridged first. The
loops are compiled, and the result of a profile does not depend on the other profiles.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _curvature_errors, outlying_bins
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

MISSING: Final = 1
NOT_POSITIVE: Final = 2
OUTLYING: Final = 3
"""Reasons why a beam ends before its last bin."""
_SERIES_BELOW: Final = THRESHOLDS.series_below

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True, eq=False)
class CondensedSignals:
    """Values at passages and integrals between them, for each profile.

    The signal is (power / overlap * range^2)^m, scaled to 1 at the first crossing of each beam.
    """

    log_value: Array
    """(profile, passage) logarithm of the signal."""
    integral: Array
    """(profile, passage) m, 2 m times the integral from this to the next passage of the beam."""
    usable: Codes
    """(profile, passage) 1 where all bins up to and around the passage are positive, and their
    variances known."""
    covariance: Array
    """(profile, packed) for each beam, covariance of its log values, then its integrals."""
    slope: Array
    """(profile, passage, 2) m-1: extinction of the segment behind the passage, if homogeneous, and
    its variance."""
    status: Codes
    """(profile, beam) MISSING, NOT_POSITIVE or OUTLYING."""
    bridged: Codes
    """(profile, beam) 1 where an outlying bin was interpolated from its neighbours."""
    curvature_error: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """(profile, passage, 2) from `_curvature_errors.measure_curvature`; empty for a mean."""

    def take(self, profiles: Indices) -> CondensedSignals:
        """Return the selected profiles."""
        return CondensedSignals(
            self.log_value[profiles], self.integral[profiles], self.usable[profiles],
            self.covariance[profiles], self.slope[profiles], self.status[profiles],
            self.bridged[profiles], self.curvature_error[profiles],
        )  # fmt: skip


def condense(
    power: Array,
    variance: Array,
    variance_row: Indices,
    exponent: Array,
    layout: FitLayout,
    *,
    screened: bool,
) -> CondensedSignals:
    """Condense power to values at crossings and integrals between them.

    The value at a crossing comes from a straight line through the logarithms of the bins around
    it; the bias of the logarithm by noise is corrected to second order. The signal is assumed
    exponential within a cell: its integral is exact on a homogeneous beam.

    Parameters
    ----------
    power : (profile, beam, bin) float64
    variance : (row, beam, bin) float64
        Variance of the power of each bin; bins are independent.
    variance_row : (profile,) intp
        Row of `variance` of each profile.
    exponent : (beam,) float64
        m of backscatter ~ extinction^(1/m).
    layout : FitLayout
    screened : bool
        Whether to search for outlying bins and bridge them.
    """
    profiles, total = power.shape[0], layout.passages.beam.size
    out = CondensedSignals(
        np.full((profiles, total), np.nan),
        np.zeros((profiles, total)),
        np.zeros((profiles, total), dtype=np.uint8),
        np.zeros((profiles, int(layout.offset[-1]))),
        np.full((profiles, total, 2), np.nan),
        np.zeros((profiles, power.shape[1]), dtype=np.uint8),
        np.zeros((profiles, power.shape[1]), dtype=np.uint8),
        np.zeros((profiles, total, 2)),
    )
    _condense(
        power, variance, variance_row, exponent, layout.log_factor, layout.range,
        layout.first_passage, layout.window, layout.weights, layout.cell, layout.fraction,
        layout.offset, screened, layout.limits, layout.neighbours,
        _curvature_errors.curvature_weights(layout),
        out.log_value, out.integral, out.usable, out.covariance, out.slope, out.status, out.bridged,
        out.curvature_error,
    )  # fmt: skip
    return out


@_compiled
def _integrate_cell(step: float, start: float, stop: float) -> tuple[float, float]:
    """Return the integrals of exp(step t) and t exp(step t) over t from start to stop."""
    if abs(step) < _SERIES_BELOW:
        integral = first_moment = 0.0
        low_power, high_power, factor = start, stop, 1.0
        for n in range(1, 9):
            integral += factor * (high_power - low_power) / n
            first_moment += factor * (high_power * stop - low_power * start) / (n + 1)
            low_power, high_power, factor = low_power * start, high_power * stop, factor * step / n
        return integral, first_moment
    at_start, at_stop = math.exp(step * start), math.exp(step * stop)
    integral = at_start * math.expm1(step * (stop - start)) / step
    return integral, (stop * at_stop - start * at_start - integral) / step


@_compiled
def _take_logarithms(
    row: Array, log_factor: Array, exponent: float, low: int, high: int, logs: Array
) -> tuple[int, int]:
    """Fill logarithms of the signal; return the first bin without one, and the reason."""
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
    """Return the integral between two points; add its derivatives by the logarithms."""
    first, from_fraction, last, to_fraction = ends
    total = 0.0
    for g in range(first, last + 1):
        start = from_fraction if g == first else 0.0
        stop = to_fraction if g == last else 1.0
        if stop <= start:
            continue
        near_signal = factor * (grid[g + 1] - grid[g]) * math.exp(logs[g] - scale)
        integral, first_moment = _integrate_cell(logs[g + 1] - logs[g], start, stop)
        total += near_signal * integral
        gradient[g] += near_signal * (integral - first_moment)
        gradient[g + 1] += near_signal * first_moment
    return total


@_compiled
def _slope_extinction(
    logs: Array, noise: Array, grid: Array, codes: Codes, first: int, last: int, exponent: float
) -> tuple[float, float]:
    """Return the extinction from a straight line through the logarithms, and its variance."""
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
def _fill_covariance(
    gradients: Array, bounds: Indices, quantities: int, noise: Array, packed: Array
) -> None:
    """Fill the (quantity, quantity) covariance from derivatives that are 0 out of bounds."""
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
    """Fill the values at passages whose bins are good; return the number of these passages."""
    first, last = passages
    bins = weights.shape[1]
    for c in range(first, last):
        if window[c] + bins > stop:
            return c - first
        value = 0.0
        for i in range(bins):
            g = window[c] + i
            # E ln(1 + e) = -e^2 / 2; noise already contains the square of the exponent.
            value += weights[c, i] * (logs[g] + 0.5 * noise[g] / exponent)
            gradients[c - first, g] = weights[c, i]
        bounds[c - first, 0], bounds[c - first, 1] = window[c], window[c] + bins
        values[c] = value
        usable[c] = 1
    return last - first


@_compiled
def _integrate_segments(
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
    """Fill integrals and slopes between the usable passages of a beam."""
    first, count, usable = passages
    for c in range(first, first + usable - 1):
        row = count + c - first
        integrals[c] = _add_segment(
            logs, scale, grid, (cell[c], fraction[c], cell[c + 1], fraction[c + 1]),
            2.0 * exponent, gradients[row],
        )  # fmt: skip
        bounds[row, 0], bounds[row, 1] = cell[c], cell[c + 1] + 2
        slopes[c, 0], slopes[c, 1] = _slope_extinction(
            logs, noise, grid, codes, cell[c], cell[c + 1], exponent
        )
    for row in range(count + max(usable - 1, 0), 2 * count - 1):
        bounds[row, 0], bounds[row, 1] = 0, 0
    for row in range(usable, count):
        bounds[row, 0], bounds[row, 1] = 0, 0


@_compiled
def _take_outer_logarithms(
    row: Array,
    variance: Array,
    log_factor: Array,
    exponent: float,
    span: tuple[int, int],
    out: tuple[Array, Array, Codes],
) -> None:
    """Fill logarithms, variances and codes of bins outside the span that only test others."""
    logs, noise, codes = out
    for g in range(span[0], span[1]):
        codes[g] = outlying_bins.LOST
        if not abs(row[g]) < 1e300 or row[g] <= 0.0:
            continue
        logs[g] = exponent * (math.log(row[g]) + log_factor[g])
        noise[g] = exponent * exponent * (variance[g] / row[g] ** 2)
        if noise[g] < math.inf:
            codes[g] = outlying_bins.GOOD


@_compiled
def _bridge_outliers(
    signal: tuple[Array, Array, Array],
    exponent: float,
    grid: Array,
    span: tuple[int, int, int, int],
    neighbour_plan: tuple[Indices, Array, Array],
    beam_row: tuple[Array, Array, Codes],
    without_outliers: tuple[Array, Array, Codes],
    work: tuple[Array, Array, Array, Indices, Array],
) -> tuple[int, int]:
    """Interpolate outlying bins from their neighbours.

    Returns
    -------
    int
        End of the reliable bins of the beam.
    int
        Number of bridged bins before it. LEFT_IN_PLACE where several outlying bins lie together
        and may be air: they stay, and `without_outliers` holds the beam without them.
    """
    power, variance, log_factor = signal
    logs, noise, codes = beam_row
    scaled, scaled_variance, deviations, nodes, weights = work
    first, low, stop, last = span
    for outer_span in ((first, low), (stop, last)):
        _take_outer_logarithms(power, variance, log_factor, exponent, outer_span, beam_row)
    outlying_bins.scale_signal(logs, noise, exponent, codes, span, scaled, scaled_variance)
    number, end = outlying_bins.find_outliers(
        (logs, noise, scaled, scaled_variance),
        exponent,
        grid,
        span,
        neighbour_plan,
        codes,
        without_outliers[2],
        deviations,
    )
    end = min(end, stop)
    if number == outlying_bins.LEFT_IN_PLACE:
        for g in range(first, last):
            without_outliers[0][g], without_outliers[1][g] = logs[g], noise[g]
        first_unbridged = outlying_bins.replace_outliers(
            without_outliers[0],
            without_outliers[1],
            exponent,
            grid,
            (first, last, end),
            without_outliers[2],
            nodes,
            weights,
        )
        if first_unbridged < end:
            # Without neighbours there is no second reading.
            for g in range(first, last):
                without_outliers[0][g], without_outliers[1][g] = logs[g], noise[g]
        return end, number
    if number > 0:
        end = outlying_bins.replace_outliers(
            logs, noise, exponent, grid, (first, last, end), codes, nodes, weights
        )
    number = 0
    for g in range(low, end):
        number += codes[g] == outlying_bins.BRIDGED
    return end, number


@_compiled
def _add_reading_difference(
    with_outliers: tuple[Array, Array, Array],
    without_outliers: tuple[Array, Array, Array],
    passages: tuple[int, int, int],
    packed: Array,
) -> None:
    """Add the difference of two possible readings of a beam to its covariance."""
    first, count, usable = passages
    quantities = 2 * count - 1
    difference = np.zeros(quantities)
    for c in range(usable):
        difference[c] = without_outliers[0][first + c] - with_outliers[0][first + c]
    for c in range(usable - 1):
        difference[count + c] = without_outliers[1][first + c] - with_outliers[1][first + c]
        step = without_outliers[2][first + c, 0] - with_outliers[2][first + c, 0]
        if abs(step) < math.inf:
            with_outliers[2][first + c, 1] += step * step
    for i in range(quantities):
        for j in range(quantities):
            packed[i * quantities + j] += difference[i] * difference[j]


@_compiled
def _condense(
    power: Array,
    variance: Array,
    variance_row: Indices,
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
    curvature_weights: Array,
    values: Array,
    integrals: Array,
    usable: Codes,
    covariance: Array,
    slopes: Array,
    status: Codes,
    bridged: Codes,
    curvature_errors: Array,
) -> None:
    size, most_passages = power.shape[2], 1
    for beam in range(exponent.size):
        most_passages = max(most_passages, first_passage[beam + 1] - first_passage[beam])
    gradients = np.zeros((2 * most_passages, size))
    bounds = np.zeros((2 * most_passages, 2), dtype=np.intp)
    logs, noise, codes = np.zeros(size), np.zeros(size), np.zeros(size, dtype=np.uint8)
    nodes = np.zeros((size, outlying_bins.NODES), dtype=np.intp)
    work = np.zeros(size), np.zeros(size), np.zeros(size), nodes, np.zeros(nodes.shape)
    without_outliers = np.zeros(size), np.zeros(size), np.zeros(size, dtype=np.uint8)
    total = values.shape[1]
    other_reading = np.zeros(total), np.zeros(total), np.zeros((total, 2))
    unused_codes = np.zeros(total, dtype=np.uint8)
    for n in range(power.shape[0]):
        for beam in range(exponent.size):
            first, last = first_passage[beam], first_passage[beam + 1]
            count = last - first
            if count == 0:
                continue
            low, high = window[first], window[last - 1] + weights.shape[1]
            m = exponent[beam]
            stop, reason = _take_logarithms(power[n, beam], log_factor[beam], m, low, high, logs)
            spread_row = variance[variance_row[n], beam]
            for g in range(low, stop):
                noise[g] = m * m * (spread_row[g] / power[n, beam, g] ** 2)
                if not noise[g] < math.inf:
                    stop, reason = g, MISSING
                    break
                codes[g] = outlying_bins.GOOD
            start = max(limits[beam, 0], low - outlying_bins.MARGIN)
            end = min(limits[beam, 1], stop + outlying_bins.MARGIN)
            outliers = 0
            narrow = range_[beam, low + 1] - range_[beam, low] <= outlying_bins.WIDEST_BIN
            if screened and narrow and stop > low:
                end_bin, outliers = _bridge_outliers(
                    (power[n, beam], spread_row, log_factor[beam]), m, range_[beam],
                    (start, low, stop, end),
                    (neighbours[0][beam], neighbours[1][beam], neighbours[2][beam]),
                    (logs, noise, codes), without_outliers, work,
                )  # fmt: skip
                reason = OUTLYING if end_bin < stop else reason
                stop = end_bin
            status[n, beam] = reason
            bridged[n, beam] = min(abs(outliers), 1)
            gradients[:, start : max(end, high)] = 0.0
            reached = _fit_points(
                logs, noise, m, stop, (first, last), window, weights, values[n], usable[n],
                gradients, bounds,
            )  # fmt: skip
            smooth_row = (
                (without_outliers[0], without_outliers[1])
                if outliers == outlying_bins.LEFT_IN_PLACE
                else (logs, noise)
            )
            _curvature_errors.measure_curvature(
                smooth_row,
                m,
                (first, first + reached),
                window,
                curvature_weights,
                curvature_errors[n],
            )
            _integrate_segments(
                logs, noise, m, range_[beam], codes, (first, count, reached), cell, fraction,
                values[n, first], integrals[n], slopes[n], gradients, bounds,
            )  # fmt: skip
            outlying_bins.transfer_derivatives(
                gradients, bounds, 2 * count - 1, (low, stop if outliers > 0 else low), codes,
                nodes, work[4],
            )  # fmt: skip
            _fill_covariance(
                gradients, bounds, 2 * count - 1, noise,
                covariance[n, offset[beam] : offset[beam + 1]],
            )  # fmt: skip
            if outliers == outlying_bins.LEFT_IN_PLACE:
                _fit_points(
                    without_outliers[0], without_outliers[1], m, stop, (first, last), window,
                    weights, other_reading[0], unused_codes, gradients, bounds,
                )  # fmt: skip
                _integrate_segments(
                    without_outliers[0], without_outliers[1], m, range_[beam], without_outliers[2],
                    (first, count, reached), cell, fraction, values[n, first], other_reading[1],
                    other_reading[2], gradients, bounds,
                )  # fmt: skip
                _add_reading_difference(
                    (values[n], integrals[n], slopes[n]), other_reading, (first, count, reached),
                    covariance[n, offset[beam] : offset[beam + 1]],
                )  # fmt: skip
            for c in range(first + reached - 1, first - 1, -1):
                values[n, c] -= values[n, first]
