"""Compiled fit of straight lines to points with noise in both coordinates, for gluing."""

from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

HUGE: Final = 1e150
PASSES: Final = 4
"""Iterations; each multiplies the error of the slope by about the share of noise in the spread of
x."""

SLOPE: Final = 0
INTERCEPT: Final = 1
SLOPE_VARIANCE: Final = 2
CENTRE_VARIANCE: Final = 3
CENTRE: Final = 4
CHI2: Final = 5
POINTS: Final = 6
COLUMNS: Final = 7

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def running_means(values: Array, half: int, out: Array) -> None:
    """Average over windows of 2 half + 1 bins, shorter at the ends, skipping non-finite values.

    Parameters
    ----------
    values, out : (row, bin) float64
    half : int
    """
    bins = values.shape[1]
    for k in range(values.shape[0]):
        total, count = 0.0, 0
        for i in range(-half, bins):
            new, old = i + half, i - half - 1
            if new < bins and abs(values[k, new]) < HUGE:
                total += values[k, new]
                count += 1
            if old >= 0 and abs(values[k, old]) < HUGE:
                total -= values[k, old]
                count -= 1
            if i >= 0:
                out[k, i] = total / count if count > 0 else math.nan


@_compiled
def longest_runs(valid: npt.NDArray[np.bool_], first: Indices, past: Indices) -> None:
    """Write the longest run of true bins of each row, the first of equals; (0, 0) for none."""
    for k in range(valid.shape[0]):
        start = best = 0
        first[k] = past[k] = 0
        for i in range(valid.shape[1]):
            if not valid[k, i]:
                start = i + 1
            elif i + 1 - start > best:
                best = i + 1 - start
                first[k], past[k] = start, i + 1


@_compiled
def _usable(x: float, y: float, x_variance: float, y_variance: float) -> bool:
    finite = abs(x) < HUGE and abs(y) < HUGE
    return finite and 0.0 < x_variance < HUGE and 0.0 < y_variance < HUGE


@_compiled
def _weight(slope: float, x_variance: float, y_variance: float, correlation: float) -> float:
    common = correlation * math.sqrt(x_variance * y_variance)
    return 1.0 / (y_variance + slope * (slope * x_variance - 2.0 * common))


@_compiled
def _centroid(
    x: Array, y: Array, xv: Array, yv: Array, rows: Indices, window: Any, line: Any
) -> Any:
    """Return the sum of the weights, the weighted means, and the number of points."""
    slope, correlation = line
    total = x_mean = y_mean = 0.0
    points = 0
    for k in rows:
        for i in range(window[0], window[1]):
            if _usable(x[k, i], y[k, i], xv[k, i], yv[k, i]):
                weight = _weight(slope, xv[k, i], yv[k, i], correlation)
                total += weight
                x_mean += weight * x[k, i]
                y_mean += weight * y[k, i]
                points += 1
    return total, x_mean / total, y_mean / total, points


@_compiled
def _moments(
    x: Array, y: Array, xv: Array, yv: Array, rows: Indices, window: Any, line: Any, means: Any
) -> Any:
    """Return the sums of York's equations: for y, x, the adjusted x, its square, and chi-square."""
    slope, correlation = line
    y_sum = x_sum = shift = square = chi2 = 0.0
    for k in rows:
        for i in range(window[0], window[1]):
            if not _usable(x[k, i], y[k, i], xv[k, i], yv[k, i]):
                continue
            weight = _weight(slope, xv[k, i], yv[k, i], correlation)
            common = correlation * math.sqrt(xv[k, i] * yv[k, i])
            u, v = x[k, i] - means[0], y[k, i] - means[1]
            beta = weight * (u * yv[k, i] + slope * v * xv[k, i] - (slope * u + v) * common)
            y_sum += weight * beta * v
            x_sum += weight * beta * u
            shift += weight * beta
            square += weight * beta * beta
            chi2 += weight * (v - slope * u) ** 2
    return y_sum, x_sum, shift, square, chi2


@_compiled
def _first_slope(x: Array, y: Array, xv: Array, yv: Array, rows: Indices, window: Any) -> float:
    """Return the ratio of the spreads of y and x, which depends little on noise in either."""
    points, x_mean, y_mean = 0, 0.0, 0.0
    for k in rows:
        for i in range(window[0], window[1]):
            if _usable(x[k, i], y[k, i], xv[k, i], yv[k, i]):
                points += 1
                x_mean += (x[k, i] - x_mean) / points
                y_mean += (y[k, i] - y_mean) / points
    spread = rise = 0.0
    for k in rows:
        for i in range(window[0], window[1]):
            if _usable(x[k, i], y[k, i], xv[k, i], yv[k, i]):
                spread += (x[k, i] - x_mean) ** 2
                rise += (y[k, i] - y_mean) ** 2
    return math.sqrt(rise / spread)


@_compiled
def fit_lines(
    x: Array,
    y: Array,
    x_variance: Array,
    y_variance: Array,
    correlation: float,
    order: Indices,
    starts: Indices,
    first: Indices,
    past: Indices,
    out: Array,
) -> None:
    """Fit one line to each block of profiles, within the window of the block.

    Parameters
    ----------
    x, y, x_variance, y_variance : (profile, bin) float64
        Points with a non-finite value or a variance that is not positive are skipped.
    correlation : float
        Correlation of the noise of both coordinates.
    order : (profile,) int
        Indices of the profiles, sorted by block.
    starts : (block + 1,) int
        Start of each block in `order`.
    first, past : (block,) int
        Window of each block.
    out : (block, COLUMNS) float64
        NaN where there are fewer than 3 points.
    """
    for block in range(starts.size - 1):
        rows = order[starts[block] : starts[block + 1]]
        window = (first[block], past[block])
        row = out[block]
        row[:] = np.nan
        slope = _first_slope(x, y, x_variance, y_variance, rows, window)
        total, x_mean, y_mean, points = _centroid(
            x, y, x_variance, y_variance, rows, window, (slope, correlation)
        )
        row[POINTS] = points
        if points < 3:
            continue
        for _ in range(PASSES):
            y_sum, x_sum, _, _, _ = _moments(
                x, y, x_variance, y_variance, rows, window, (slope, correlation), (x_mean, y_mean)
            )
            slope = y_sum / x_sum
            total, x_mean, y_mean, points = _centroid(
                x, y, x_variance, y_variance, rows, window, (slope, correlation)
            )
        _, _, shift, square, chi2 = _moments(
            x, y, x_variance, y_variance, rows, window, (slope, correlation), (x_mean, y_mean)
        )
        row[SLOPE], row[INTERCEPT] = slope, y_mean - slope * x_mean
        row[SLOPE_VARIANCE] = 1.0 / (square - shift * shift / total)
        row[CENTRE_VARIANCE] = 1.0 / total
        row[CENTRE] = x_mean + shift / total
        row[CHI2] = chi2


@_compiled
def _analog_share(x: float, y: float, x_variance: float, y_variance: float) -> float:
    """Return the inverse-variance weight of scaled analog; 1 or 0 where only one is finite."""
    if not abs(y) < HUGE:
        return 1.0
    return y_variance / (y_variance + x_variance) if abs(x) < HUGE else 0.0


@_compiled
def combine(
    x: Array,
    y: Array,
    x_variance: Array,
    y_variance: Array,
    correlation: float,
    lines: Array,
    block: Indices,
    first: Indices,
    past: Indices,
    out: Array,
) -> None:
    """Take scaled x before the windows, y beyond them, and their weighted mean inside.

    Parameters
    ----------
    x, y, x_variance, y_variance : (profile, bin) float64
    correlation : float
        Correlation of the noise of both.
    lines : (block, COLUMNS) float64
        From `fit_lines`.
    block : (profile,) int
    first, past : (block,) int
    out : (3, profile, bin) float64
        Output: the mean, its noise variance and its variance by the error of the line; NaN
        without a line of positive slope.
    """
    for k in range(x.shape[0]):
        line = lines[block[k]]
        slope = line[SLOPE] if line[SLOPE] > 0.0 else math.nan
        for i in range(x.shape[1]):
            xv = slope * slope * x_variance[k, i]
            yv = y_variance[k, i]
            share = 1.0 if i < first[block[k]] else 0.0
            if first[block[k]] <= i < past[block[k]]:
                share = _analog_share(x[k, i], y[k, i], xv, yv)
            mean = variance = systematic = 0.0 * slope
            # NaN times a weight of 0 must not reach the mean.
            if share > 0.0:
                mean += share * (slope * x[k, i] + line[INTERCEPT])
                variance += share * share * xv
                lever = x[k, i] - line[CENTRE]
                systematic += line[SLOPE_VARIANCE] * lever * lever + line[CENTRE_VARIANCE]
            if share < 1.0:
                mean += (1.0 - share) * y[k, i]
                variance += (1.0 - share) ** 2 * yv
            if 0.0 < share < 1.0:
                variance += 2.0 * correlation * share * (1.0 - share) * math.sqrt(xv * yv)
            valid = abs(mean) < HUGE
            out[0, k, i] = mean if valid else math.nan
            out[1, k, i] = variance if valid else math.nan
            out[2, k, i] = share * share * systematic if valid else math.nan
