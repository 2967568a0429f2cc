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

_SAME_PATH: Final = 1e-20
"""Variance of slant paths up to which they count as equal."""
_OPPOSITE: Final = 1e-6
"""radian, rounding by which the gap between opposite azimuths may exceed half a turn."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


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
    """Fit every altitude of every profile, with gradients where the beams surround the zenith.

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
    d : (2, angle, altitude) float
        Horizontal distance over altitude, eastward and northward.
    sides : bool
        Whether all beams of the scan together surround the zenith.
    out : (profile, COLUMNS, altitude) float
        Output.
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
