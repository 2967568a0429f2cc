"""Compiled fit of straight lines to points with noise in both coordinates, for gluing."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled

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


@compiled
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


@compiled
def longest_runs(valid: Booleans, first: Indices, past: Indices) -> None:
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


@compiled
def _usable(x: float, y: float, x_variance: float, y_variance: float) -> bool:
    finite = abs(x) < HUGE and abs(y) < HUGE
    return finite and 0.0 < x_variance < HUGE and 0.0 < y_variance < HUGE


@compiled
def _centroid(x: Array, y: Array, xv: Array, yv: Array, slope: float) -> Any:
    """Return the sum of the weights, the weighted means, and the number of points."""
    total = x_mean = y_mean = 0.0
    points = 0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            weight = 1.0 / (yv[i] + slope * (slope * xv[i]))
            total += weight
            x_mean += weight * x[i]
            y_mean += weight * y[i]
            points += 1
    return total, x_mean / total, y_mean / total, points


@compiled
def _moments(
    x: Array, y: Array, xv: Array, yv: Array, slope: float, x_mean: float, y_mean: float
) -> Any:
    """Return the sums of York's equations: for y, x, the adjusted x, its square, and chi-square."""
    y_sum = x_sum = shift = square = chi2 = 0.0
    for i in range(x.size):
        if not _usable(x[i], y[i], xv[i], yv[i]):
            continue
        weight = 1.0 / (yv[i] + slope * (slope * xv[i]))
        u, v = x[i] - x_mean, y[i] - y_mean
        beta = weight * (u * yv[i] + slope * v * xv[i])
        y_sum += weight * beta * v
        x_sum += weight * beta * u
        shift += weight * beta
        square += weight * beta * beta
        chi2 += weight * (v - slope * u) ** 2
    return y_sum, x_sum, shift, square, chi2


@compiled
def _first_slope(x: Array, y: Array, xv: Array, yv: Array) -> float:
    """Return the ratio of the spreads of y and x, which depends little on noise in either."""
    points, x_mean, y_mean = 0, 0.0, 0.0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            points += 1
            x_mean += (x[i] - x_mean) / points
            y_mean += (y[i] - y_mean) / points
    spread = rise = 0.0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            spread += (x[i] - x_mean) ** 2
            rise += (y[i] - y_mean) ** 2
    return math.sqrt(rise / spread)


@compiled
def fit_lines(
    x: Array,
    y: Array,
    x_variance: Array,
    y_variance: Array,
    first: Indices,
    past: Indices,
    out: Array,
) -> None:
    """Fit one line to each profile, within its window.

    Parameters
    ----------
    x, y, x_variance, y_variance : (profile, bin) float64
        Points with a non-finite value or a variance that is not positive are skipped.
    first, past : (profile,) int
        Window of each profile.
    out : (profile, COLUMNS) float64
        NaN where there are fewer than 3 points.
    """
    for k in range(x.shape[0]):
        near, far, row = first[k], past[k], out[k]
        values = (x[k, near:far], y[k, near:far], x_variance[k, near:far], y_variance[k, near:far])
        row[:] = np.nan
        slope = _first_slope(*values)
        total, x_mean, y_mean, points = _centroid(*values, slope)
        row[POINTS] = points
        if points < 3:
            continue
        for _ in range(PASSES):
            y_sum, x_sum, _, _, _ = _moments(*values, slope, x_mean, y_mean)
            slope = y_sum / x_sum
            total, x_mean, y_mean, points = _centroid(*values, slope)
        _, _, shift, square, chi2 = _moments(*values, slope, x_mean, y_mean)
        row[SLOPE], row[INTERCEPT] = slope, y_mean - slope * x_mean
        row[SLOPE_VARIANCE] = 1.0 / (square - shift * shift / total)
        row[CENTRE_VARIANCE] = 1.0 / total
        row[CENTRE] = x_mean + shift / total
        row[CHI2] = chi2
