r"""Compiled weighted regression of logarithms on slant path, one altitude at a time.

The model is :math:`y_l = c - 2 x_l \tau + g \cdot d_l + e_l` with the slant path x and the error
variance :math:`v_l + s^2` (detector noise and inhomogeneity of the air). A horizontal gradient g
over the horizontal distance d is included only where beams point to all sides.
"""

# ruff: noqa: FBT001, FBT003 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TAU: Final = 0
INFORMATION: Final = 1
"""Inverse variance of the optical depth."""
INTERCEPT: Final = 2
INTERCEPT_VARIANCE: Final = 3
CHI2: Final = 4
"""Sum of the squared residuals over their variances."""
FREEDOM: Final = 5
"""Number of beams minus unknowns; 0 where there is no fit."""
TRACE: Final = 6
"""Sum over beams of weight times (1 - leverage): increase of chi2 per unit of inhomogeneity
variance."""
SPAN: Final = 7
"""Largest minus smallest slant path."""
SLOPE_EAST: Final = 8
"""Change of the optical depth per unit of a gradient to the east that is not fitted."""
SLOPE_NORTH: Final = 9
SIDES: Final = 10
"""Number of fitted gradients: 0, 1 or 2."""
SHARE: Final = 11
"""Share of the variance of the optical depth per unit of inhomogeneity variance."""
EXPECTED: Final = 12
"""Expectation of chi2: the degrees of freedom, fewer where weights are reduced."""
COLUMNS: Final = 13

TILE: Final = 256
"""Altitudes processed together."""
_SAME_PATH: Final = 1e-20
"""Variance of slant paths up to which they count as equal."""
_OPPOSITE: Final = 1e-6
"""radian, rounding by which the gap between opposite azimuths may exceed half a turn."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _fill_weights(
    noise: Array, keep: Array, inhomogeneity: Array, first: int, last: int, weights: Array
) -> None:
    """Fill weights (angle, TILE) of the altitudes from `first` to before `last`."""
    angles, width = noise.shape[0], last - first
    added = inhomogeneity[first:last]
    for a in range(angles):
        row, variance = weights[a, :width], noise[a, first:last]
        for j in range(width):
            row[j] = 1.0 / (variance[j] + added[j])
        if keep.shape[0] > 0:
            kept = keep[a, first:last]
            for j in range(width):
                row[j] *= kept[j]


@_compiled
def _average_tile(y: Array, weights: Array, x: Array, first: int, last: int, sums: Array) -> None:
    """Fill the sums of weights, and the weighted means of path and logarithm."""
    width = last - first
    sw, mx, my = sums[0, :width], sums[1, :width], sums[2, :width]
    for j in range(width):
        sw[j] = mx[j] = my[j] = 0.0
    for a in range(x.shape[0]):
        w, xs, ys = weights[a, :width], x[a, first:last], y[a, first:last]
        for j in range(width):
            sw[j] += w[j]
            mx[j] += w[j] * xs[j]
            my[j] += w[j] * ys[j]
    for j in range(width):
        inverse = 1.0 / sw[j] if sw[j] > 0.0 else 0.0
        mx[j] *= inverse
        my[j] *= inverse


@_compiled
def _fit_tile(
    y: Array, weights: Array, x: Array, first: int, last: int, sums: Array, out: Array
) -> None:
    """Fit the altitudes from `first` to before `last` with sums centred on the weighted means.

    Parameters
    ----------
    y, x : (angle, altitude) float
    weights : (angle, TILE) float
    first, last : int
    sums : (8, TILE) float
        Output: sums of weights, means of path and logarithm, the inverse of the weighted squares
        of the path, the slope and the share of inhomogeneity.
    out : (COLUMNS, altitude) float
    """
    width = last - first
    _average_tile(y, weights, x, first, last, sums)
    sw, mx, my, sxx = sums[0, :width], sums[1, :width], sums[2, :width], sums[3, :width]
    sxy, sww = sums[4, :width], sums[5, :width]
    for j in range(width):
        sxx[j] = sxy[j] = sww[j] = 0.0
    for a in range(x.shape[0]):
        w, xs, ys = weights[a, :width], x[a, first:last], y[a, first:last]
        for j in range(width):
            wx = w[j] * (xs[j] - mx[j])
            sxx[j] += wx * (xs[j] - mx[j])
            sxy[j] += wx * (ys[j] - my[j])
            sww[j] += wx * wx
    columns = out[:, first:last]
    for j in range(width):
        fits = sxx[j] > _SAME_PATH * sw[j]
        inverse = 1.0 / sxx[j] if fits else 0.0
        tau = -0.5 * sxy[j] * inverse
        columns[TAU, j] = tau if fits else np.nan
        columns[INFORMATION, j] = 4.0 * sxx[j] if fits else 0.0
        columns[INTERCEPT, j] = my[j] + 2.0 * tau * mx[j] if fits else np.nan
        columns[INTERCEPT_VARIANCE, j] = 1.0 / sw[j] + mx[j] * mx[j] * inverse if fits else np.nan
        columns[SHARE, j] = sww[j] * inverse
        sxx[j] = inverse
        sxy[j] = -2.0 * tau


@_compiled
def _chi2_tile(
    y: Array, weights: Array, x: Array, first: int, last: int, sums: Array, out: Array
) -> None:
    """Fill CHI2, FREEDOM, EXPECTED and TRACE from the sums of `_fit_tile`.

    Parameters
    ----------
    y, x, weights, first, last, sums, out
        As in `_fit_tile`.
    """
    width = last - first
    sw, mx, my, inverse = sums[0, :width], sums[1, :width], sums[2, :width], sums[3, :width]
    slope, chi2, trace, beams = sums[4, :width], sums[5, :width], sums[6, :width], sums[7, :width]
    for j in range(width):
        chi2[j] = trace[j] = beams[j] = 0.0
        sw[j] = 1.0 / sw[j] if sw[j] > 0.0 else 0.0
    for a in range(x.shape[0]):
        w, xs, ys = weights[a, :width], x[a, first:last], y[a, first:last]
        for j in range(width):
            dx = xs[j] - mx[j]
            residual = ys[j] - my[j] - slope[j] * dx
            chi2[j] += w[j] * residual * residual
            trace[j] += w[j] * (1.0 - w[j] * (sw[j] + dx * dx * inverse[j]))
            beams[j] += 1.0 if w[j] > 0.0 else 0.0
    columns = out[:, first:last]
    for j in range(width):
        on = inverse[j] > 0.0 and beams[j] > 2.0
        columns[CHI2, j] = chi2[j] if on else 0.0
        columns[FREEDOM, j] = beams[j] - 2.0 if on else 0.0
        columns[EXPECTED, j] = beams[j] - 2.0 if on else 0.0
        columns[TRACE, j] = trace[j] if on else 0.0


@_compiled
def _expect_tile(
    keep: Array, weights: Array, x: Array, first: int, last: int, sums: Array, out: Array
) -> None:
    """Fill the expectation of chi2 with reduced weights, from the sums of `_chi2_tile`."""
    expected = out[EXPECTED, first:last]
    for j in range(last - first):
        if expected[j] > 0.0:
            expected[j] = 0.0
            for a in range(x.shape[0]):
                dx = x[a, first + j] - sums[1, j]
                hat = weights[a, j] * (sums[0, j] + dx * dx * sums[3, j])
                on = weights[a, j] > 0.0
                expected[j] += keep[a, first + j] * (1.0 - hat) if on else 0.0


@_compiled
def fit_kano_hamilton(
    y: Array, noise: Array, keep: Array, inhomogeneity: Array, x: Array, out: Array
) -> None:
    """Fit optical depth and intercept at every altitude of every profile.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
        Logarithms and their variances; 0 and inf where there is no sample.
    keep : (profile, angle or 0, altitude) float
        Factors of the weights.
    inhomogeneity : (altitude,) float
        Variance of the logarithms on top of the noise.
    x : (angle, altitude) float
        Slant path, finite.
    out : (profile, COLUMNS, altitude) float
        Output: all columns except those of `_geometry_tile`.
    """
    count, angles, altitudes = y.shape
    weights, sums = np.empty((angles, TILE)), np.empty((8, TILE))
    for t in range(count):
        for first in range(0, altitudes, TILE):
            last = min(first + TILE, altitudes)
            _fill_weights(noise[t], keep[t], inhomogeneity, first, last, weights)
            _fit_tile(y[t], weights, x, first, last, sums, out[t])
            _chi2_tile(y[t], weights, x, first, last, sums, out[t])
            if keep.shape[1] > 0:
                _expect_tile(keep[t], weights, x, first, last, sums, out[t])


@_compiled
def fit_details(
    y: Array,
    noise: Array,
    keep: Array,
    inhomogeneity: Array,
    x: Array,
    d: Array,
    out: Array,
    residuals: Array,
    leverages: Array,
) -> None:
    """Fit as `fit_kano_hamilton`, with all outputs of `fit_levels` but no gradient.

    Parameters
    ----------
    y, noise, keep, inhomogeneity, x, out
        As in `fit_kano_hamilton`.
    d, residuals, leverages
        As in `fit_levels`, for all profiles.
    """
    fit_kano_hamilton(y, noise, keep, inhomogeneity, x, out)
    count, angles, altitudes = y.shape
    weights, sums = np.empty((angles, TILE)), np.empty((8, TILE))
    for t in range(count):
        for first in range(0, altitudes, TILE):
            last = min(first + TILE, altitudes)
            _fill_weights(noise[t], keep[t], inhomogeneity, first, last, weights)
            _fit_tile(y[t], weights, x, first, last, sums, out[t])
            _geometry_tile(weights, x, d, first, last, sums, out[t])
            for a in range(angles):
                for k in range(first, last):
                    j = k - first
                    fits = sums[3, j] > 0.0
                    on = noise[t, a, k] < np.inf
                    dx = x[a, k] - sums[1, j]
                    left = y[t, a, k] - sums[2, j] - sums[4, j] * dx
                    hat = weights[a, j] * (1.0 / sums[0, j] + dx * dx * sums[3, j])
                    residuals[t, a, k] = left if on and fits else np.nan
                    leverages[t, a, k] = (hat if fits else 1.0) if on else np.nan


@_compiled
def _geometry_tile(
    weights: Array, x: Array, d: Array, first: int, last: int, sums: Array, out: Array
) -> None:
    """Fill the span of slant paths and the effect of a gradient, which depend on geometry only."""
    for k in range(first, last):
        j = k - first
        low, high, east, north = np.inf, -np.inf, 0.0, 0.0
        for a in range(x.shape[0]):
            if weights[a, j] > 0.0:
                low, high = min(low, x[a, k]), max(high, x[a, k])
                wx = weights[a, j] * (x[a, k] - sums[1, j])
                east += wx * d[0, a, k]
                north += wx * d[1, a, k]
        out[SPAN, k] = high - low if high >= low else 0.0
        out[SLOPE_EAST, k] = -0.5 * east * sums[3, j]
        out[SLOPE_NORTH, k] = -0.5 * north * sums[3, j]
        out[SIDES, k] = 0.0


@_compiled
def _surrounds_zenith(weights: Array, design: Array) -> bool:
    """Return whether every half turn around the zenith has a beam with weight.

    Parameters
    ----------
    weights : (angle,) float
    design : (4, angle) float
        The first two rows are the distances to the east and north.
    """
    tilted = 0
    azimuths = np.empty(weights.size)
    for a in range(weights.size):
        if weights[a] > 0.0 and math.hypot(design[0, a], design[1, a]) > 1e-9:
            azimuths[tilted] = math.atan2(design[0, a], design[1, a])
            tilted += 1
    if tilted < 2:
        return False
    azimuths = np.sort(azimuths[:tilted])
    widest = azimuths[0] + 2.0 * math.pi - azimuths[tilted - 1]
    for i in range(1, tilted):
        widest = max(widest, azimuths[i] - azimuths[i - 1])
    return bool(widest <= math.pi + _OPPOSITE)


@_compiled
def _dot(weights: Array, first: Array, second: Array) -> float:
    total = 0.0
    for a in range(weights.size):
        total += weights[a] * first[a] * second[a]
    return total


@_compiled
def _orthogonal(
    weights: Array, design: Array, sides: bool, q: Array, norm: Array, mean: Array
) -> int:
    """Fill orthogonal columns of one altitude, and the coordinates of the model's origin on them.

    Parameters
    ----------
    weights : (angle,) float
    design : (4, angle) float
        East, north, path, ones.
    sides : bool
        Whether to include the gradients.
    q : (3, angle) float
        Output: east, north and path, each orthogonal to the columns before it; 0 if left out.
    norm, mean : (3,) float
        Outputs: the squared lengths, and the coordinates of x = 0, d = 0.

    Returns
    -------
    int
        Number of gradients included.
    """
    ones = design[3]
    whole = _dot(weights, ones, ones)
    lever = _dot(weights, design[0], design[0]) + _dot(weights, design[1], design[1])
    included = 0
    for c in range(3):
        norm[c] = mean[c] = 0.0
        q[c] = 0.0
        if c < 2 and not sides:
            continue
        centre = _dot(weights, design[c], ones) / whole
        least = 1e-12 * lever if c < 2 else _SAME_PATH * whole
        for a in range(weights.size):
            q[c, a] = design[c, a] - centre
        mean[c] = -centre
        for b in range(c):
            if norm[b] > 0.0:
                share = _dot(weights, q[b], q[c]) / norm[b]
                for a in range(weights.size):
                    q[c, a] -= share * q[b, a]
                mean[c] -= share * mean[b]
        norm[c] = _dot(weights, q[c], q[c])
        if not norm[c] > least:
            norm[c] = mean[c] = 0.0
            q[c] = 0.0
        elif c < 2:
            included += 1
    return included


@_compiled
def _span(weights: Array, path: Array) -> float:
    low, high = np.inf, -np.inf
    for a in range(weights.size):
        if weights[a] > 0.0:
            low, high = min(low, path[a]), max(high, path[a])
    return high - low if high >= low else 0.0


@_compiled
def _slopes(weights: Array, design: Array, q: Array, norm: Array, mean: Array, out: Array) -> None:
    """Fill the variances, gradient slopes and span of the fit of one altitude."""
    whole = _dot(weights, design[3], design[3])
    out[INTERCEPT_VARIANCE] = 1.0 / whole
    for c in range(3):
        if norm[c] > 0.0:
            out[INTERCEPT_VARIANCE] += mean[c] * mean[c] / norm[c]
    out[INFORMATION] = 4.0 * norm[2]
    for a in range(weights.size):
        out[SHARE] += (weights[a] * q[2, a]) ** 2
    out[SHARE] /= norm[2]
    if out[SIDES] == 0.0:
        out[SLOPE_EAST] = -0.5 * _dot(weights, q[2], design[0]) / norm[2]
        out[SLOPE_NORTH] = -0.5 * _dot(weights, q[2], design[1]) / norm[2]
    out[SPAN] = _span(weights, design[2])


@_compiled
def _fit_level(
    y: Array,
    weights: Array,
    keep: Array,
    design: Array,
    sides: bool,
    q: Array,
    residual: Array,
    hat: Array,
    out: Array,
) -> None:
    """Fit one altitude, with gradients if `sides`; fill residuals and leverages.

    Parameters
    ----------
    y : (angle,) float
    weights, keep : (angle,) float
        Weights, and the factors by which outliers reduced them.
    design : (4, angle) float
        East, north, path, ones.
    sides : bool
    q : (3, angle) float
        Output: the orthogonal columns.
    residual, hat : (angle,) float
        Outputs; NaN and 1 if there is no fit.
    out : (COLUMNS,) float
        Output.
    """
    norm, mean = np.empty(3), np.empty(3)
    included = _orthogonal(weights, design, sides, q, norm, mean)
    beams = np.count_nonzero(weights)
    if included > 0 and beams <= 2 + included:
        # With the gradient no residual would be left to check the optical depth.
        included = _orthogonal(weights, design, False, q, norm, mean)
    out[:] = 0.0
    out[TAU] = out[INTERCEPT] = out[INTERCEPT_VARIANCE] = np.nan
    residual[:] = np.nan
    hat[:] = 1.0
    out[SIDES] = included
    if norm[2] == 0.0:
        return
    _slopes(weights, design, q, norm, mean, out)
    whole = _dot(weights, design[3], design[3])
    middle = _dot(weights, y, design[3]) / whole
    out[INTERCEPT] = middle
    for a in range(weights.size):
        residual[a] = y[a] - middle
        hat[a] = weights[a] / whole
    for c in range(3):
        if norm[c] > 0.0:
            slope = _dot(weights, q[c], residual) / norm[c]
            out[INTERCEPT] += slope * mean[c]
            out[TAU] = -0.5 * slope
            for a in range(weights.size):
                residual[a] -= slope * q[c, a]
                hat[a] += weights[a] * q[c, a] * q[c, a] / norm[c]
    out[FREEDOM] = beams - 2 - included
    if out[FREEDOM] > 0.0:
        for a in range(weights.size):
            out[CHI2] += weights[a] * residual[a] * residual[a]
            out[TRACE] += weights[a] * (1.0 - hat[a])
            out[EXPECTED] += keep[a] * (1.0 - hat[a]) if weights[a] > 0.0 else 0.0


@_compiled
def fit_levels(
    y: Array,
    noise: Array,
    keep: Array,
    inhomogeneity: Array,
    x: Array,
    d: Array,
    sides: bool,
    out: Array,
    residuals: Array,
    leverages: Array,
) -> None:
    """Fit as `fit_kano_hamilton`, with gradients at altitudes whose beams surround the zenith.

    Parameters
    ----------
    y, noise, keep, inhomogeneity, x, out
        As in `fit_kano_hamilton`.
    d : (2, angle, altitude) float
        Horizontal distance over altitude, eastward and northward.
    sides : bool
        Whether all beams of the scan together surround the zenith.
    residuals, leverages : (profile or 0, angle, altitude) float
        Outputs: residuals of the logarithms (NaN where there is no sample) and the diagonal of the
        hat matrix; not filled if they have no profile.
    """
    count, angles, altitudes = y.shape
    weights, before, kept, column = (
        np.empty(angles),
        np.empty(angles),
        np.ones(angles),
        np.empty(angles),
    )
    q, residual, hat = np.empty((3, angles)), np.empty(angles), np.empty(angles)
    design, row = np.ones((4, angles)), np.empty(COLUMNS)
    for t in range(count):
        before[:] = 0.0
        around = False
        for k in range(altitudes):
            changed = False
            for a in range(angles):
                weights[a] = 1.0 / (noise[t, a, k] + inhomogeneity[k])
                if keep.shape[1] > 0:
                    kept[a] = keep[t, a, k]
                    weights[a] *= kept[a]
                changed |= (weights[a] > 0.0) != (before[a] > 0.0)
                before[a] = weights[a]
                column[a] = y[t, a, k]
                design[0, a], design[1, a], design[2, a] = d[0, a, k], d[1, a, k], x[a, k]
            if sides and changed:
                around = _surrounds_zenith(weights, design)
            _fit_level(column, weights, kept, design, around, q, residual, hat, row)
            out[t, :, k] = row
            if residuals.shape[0] > 0:
                for a in range(angles):
                    on = noise[t, a, k] < np.inf
                    residuals[t, a, k] = residual[a] if on else np.nan
                    leverages[t, a, k] = hat[a] if on else np.nan
