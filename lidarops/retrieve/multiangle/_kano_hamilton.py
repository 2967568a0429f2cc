"""Compiled weighted regression of logarithms on slant path, one altitude at a time.

The formulas are in ``docs/algorithms/multiangle.md``. Altitudes are the innermost loop: they are
contiguous, and independent of each other.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled

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
SLOPE_EAST: Final = 7
"""Change of the optical depth per unit of a gradient to the east that is not fitted."""
SLOPE_NORTH: Final = 8
SIDES: Final = 9
"""Number of fitted gradients: 0, 1 or 2."""
SHARED: Final = 10
"""Covariance with the error of the altitude above, of errors of unit variance, if the air of each
beam had unit variance and were the same at both."""
AIR: Final = 11
"""The same with the error at the altitude itself: its variance by air of unit variance."""
COLUMNS: Final = 12

_SAME_PATH: Final = 1e-20
"""Variance of slant paths up to which they count as equal."""
_DEPENDENT: Final = 1e-12
"""Squared length of a distance outside the columns before it, over that of both distances, up to
which it depends on them."""
_OPPOSITE: Final = 1e-6
"""radian, rounding by which the gap between opposite azimuths may exceed half a turn."""
_PATH: Final = 2
"""Number of the column of slant paths, after those of the distances."""


@compiled
def _surrounds_zenith(weights: Array, design: Array, k: int) -> bool:
    """Return whether every half turn around the zenith has a beam with weight at an altitude."""
    tilted = 0
    azimuths = np.empty(weights.shape[0])
    for a in range(weights.shape[0]):
        if weights[a, k] > 0.0 and math.hypot(design[0, a, k], design[1, a, k]) > 1e-9:
            azimuths[tilted] = math.atan2(design[0, a, k], design[1, a, k])
            tilted += 1
    if tilted < 2:
        return False
    azimuths = np.sort(azimuths[:tilted])
    widest = azimuths[0] + 2.0 * math.pi - azimuths[tilted - 1]
    for i in range(1, tilted):
        widest = max(widest, azimuths[i] - azimuths[i - 1])
    return bool(widest <= math.pi + _OPPOSITE)


@compiled
def _surrounded_altitudes(weights: Array, design: Array, surrounded: Array) -> None:
    """Fill 1 at the altitudes where the beams with weight surround the zenith, else 0."""
    for k in range(surrounded.size):
        changed = k == 0
        for a in range(weights.shape[0]):
            changed |= (weights[a, k] > 0.0) != (weights[a, k - 1] > 0.0)
        if changed:
            surrounded[k] = 1.0 if _surrounds_zenith(weights, design, k) else 0.0
        else:
            surrounded[k] = surrounded[k - 1]


@compiled
def _sums(weights: Array, first: Array, second: Array, out: Array) -> None:
    """Fill the weighted sums over beams of products."""
    out[:] = 0.0
    for a in range(weights.shape[0]):
        for k in range(out.size):
            out[k] += weights[a, k] * first[a, k] * second[a, k]


@compiled
def _subtract_projection(
    weights: Array, values: Array, column: Array, inverse: Array, share: Array
) -> None:
    """Subtract from values their part along a column, and fill the part of each altitude."""
    _sums(weights, values, column, share)
    for k in range(share.size):
        share[k] *= inverse[k]
    for a in range(values.shape[0]):
        for k in range(share.size):
            values[a, k] -= share[k] * column[a, k]


@compiled
def _orthogonal_column(
    weights: Array, design: Array, least: Array, q: Array, inverse: Array, mean: Array,
    first: int, c: int,
) -> None:  # fmt: skip
    """Make a column orthogonal to a constant and to the columns from `first` to it.

    Parameters
    ----------
    weights : (angle, altitude) float
    design : (3, angle, altitude) float
        Distance to the east and north, slant path.
    least : (altitude,) float
        Squared length up to which the column is left out.
    q : (3, angle, altitude) float
        The columns; 0 if left out.
    inverse, mean : (3, altitude) float
        Their reciprocal squared lengths, 0 if left out, and the coordinates of path 0 and distance
        0 on them.
    first, c : int
        The first column and the output.
    """
    whole, share = np.zeros(least.size), np.zeros(least.size)
    for a in range(weights.shape[0]):
        for k in range(whole.size):
            whole[k] += weights[a, k]
            share[k] += weights[a, k] * design[c, a, k]
    for k in range(whole.size):
        share[k] /= whole[k]
        mean[c, k] = -share[k]
    for a in range(weights.shape[0]):
        for k in range(whole.size):
            q[c, a, k] = design[c, a, k] - share[k]
    for b in range(first, c):
        _subtract_projection(weights, q[c], q[b], inverse[b], share)
        for k in range(whole.size):
            mean[c, k] -= share[k] * mean[b, k]
    _sums(weights, q[c], q[c], share)
    for k in range(whole.size):
        inverse[c, k] = 1.0 / share[k] if share[k] > least[k] else 0.0
    _leave_out(inverse[c], q[c], mean[c])


@compiled
def _leave_out(inverse: Array, column: Array, mean: Array) -> None:
    """Set a column to 0 where its reciprocal length is 0."""
    for k in range(inverse.size):
        if inverse[k] == 0.0:
            mean[k] = 0.0
            column[:, k] = 0.0


@compiled
def _gradients(
    weights: Array, design: Array, beams: Array, q: Array, inverse: Array, mean: Array, sides: Array
) -> None:
    """Fill the columns of the gradients, and their number `sides` at each altitude."""
    surrounded, lever, share = np.empty(sides.size), np.empty(sides.size), np.empty(sides.size)
    _surrounded_altitudes(weights, design, surrounded)
    _sums(weights, design[0], design[0], lever)
    _sums(weights, design[1], design[1], share)
    for k in range(sides.size):
        lever[k] = _DEPENDENT * (lever[k] + share[k]) if surrounded[k] > 0.0 else np.inf
    for c in range(_PATH):
        _orthogonal_column(weights, design, lever, q, inverse, mean, 0, c)
        for k in range(sides.size):
            sides[k] += 1.0 if inverse[c, k] > 0.0 else 0.0
    # Otherwise no residual would be left to check the optical depth.
    for k in range(sides.size):
        if not beams[k] > 2.0 + sides[k]:
            sides[k] = inverse[0, k] = inverse[1, k] = 0.0
    for c in range(_PATH):
        _leave_out(inverse[c], q[c], mean[c])


@compiled
def _fill_precision(
    weights: Array, design: Array, q: Array, inverse: Array, mean: Array, first: int, out: Array
) -> None:
    """Fill the columns of a fit that do not depend on the signal."""
    angles, altitudes = weights.shape
    lever, before = np.empty(altitudes), np.empty(altitudes)
    for c in range(first, _PATH + 1):
        for k in range(altitudes):
            out[INTERCEPT_VARIANCE, k] += mean[c, k] * mean[c, k] * inverse[c, k]
    for k in range(altitudes):
        out[INFORMATION, k] = 4.0 / inverse[_PATH, k] if inverse[_PATH, k] > 0.0 else 0.0
        before[k] = math.sqrt(inverse[_PATH, k])
    for a in range(angles):
        for k in range(altitudes):
            lever[k] = weights[a, k] * q[_PATH, a, k] * before[k]
            out[SLOPE_EAST, k] += lever[k] * design[0, a, k]
            out[SLOPE_NORTH, k] += lever[k] * design[1, a, k]
            out[AIR, k] += lever[k] * lever[k]
        for k in range(altitudes - 1):
            out[SHARED, k] += lever[k] * lever[k + 1]
    for k in range(altitudes):
        scale = -0.5 * before[k] if out[SIDES, k] == 0.0 else 0.0
        out[SLOPE_EAST, k] *= scale
        out[SLOPE_NORTH, k] *= scale


@compiled
def _fill_fit(
    y: Array, weights: Array, q: Array, inverse: Array, mean: Array, first: int,
    residual: Array, hat: Array, out: Array,
) -> None:  # fmt: skip
    """Fill optical depth, intercept, residuals and leverages."""
    angles, altitudes = weights.shape
    slope = np.zeros(altitudes)
    for a in range(angles):
        for k in range(altitudes):
            slope[k] += weights[a, k] * y[a, k]
    for k in range(altitudes):
        out[INTERCEPT, k] = slope[k] * out[INTERCEPT_VARIANCE, k]
    for a in range(angles):
        for k in range(altitudes):
            residual[a, k] = y[a, k] - out[INTERCEPT, k]
            hat[a, k] = weights[a, k] * out[INTERCEPT_VARIANCE, k]
    for c in range(first, _PATH + 1):
        _subtract_projection(weights, residual, q[c], inverse[c], slope)
        for k in range(altitudes):
            out[INTERCEPT, k] += slope[k] * mean[c, k]
            out[TAU, k] = -0.5 * slope[k]
        for a in range(angles):
            for k in range(altitudes):
                hat[a, k] += weights[a, k] * q[c, a, k] * q[c, a, k] * inverse[c, k]


@compiled
def _fill_scatter(weights: Array, beams: Array, residual: Array, hat: Array, out: Array) -> None:
    """Fill chi2 and its increase where residuals are left."""
    angles, altitudes = weights.shape
    for a in range(angles):
        for k in range(altitudes):
            out[TRACE, k] += weights[a, k] * (1.0 - hat[a, k])
            out[CHI2, k] += weights[a, k] * residual[a, k] * residual[a, k]
    for k in range(altitudes):
        out[FREEDOM, k] = beams[k] - 2.0 - out[SIDES, k]
        if not out[FREEDOM, k] > 0.0:
            out[TRACE, k] = out[CHI2, k] = 0.0


@compiled
def _empty(inverse: Array, residual: Array, hat: Array, out: Array) -> None:
    """Mark the altitudes where the slant paths do not differ."""
    for k in range(inverse.size):
        if not inverse[k] > 0.0:
            sides = out[SIDES, k]
            out[:, k] = 0.0
            out[TAU, k] = out[INTERCEPT, k] = out[INTERCEPT_VARIANCE, k] = np.nan
            out[SIDES, k] = sides
            residual[:, k] = np.nan
            hat[:, k] = 1.0


@compiled
def _fill_weights(
    noise: Array, inhomogeneity: Array, weights: Array, whole: Array, beams: Array
) -> None:
    """Fill the weights, their sum over beams, and the number of beams with weight."""
    whole[:] = 0.0
    beams[:] = 0.0
    for a in range(weights.shape[0]):
        for k in range(whole.size):
            weights[a, k] = 1.0 / (noise[a, k] + inhomogeneity[k])
            whole[k] += weights[a, k]
            beams[k] += 1.0 if weights[a, k] > 0.0 else 0.0


@compiled
def fit_levels(
    y: Array,
    noise: Array,
    inhomogeneity: Array,
    design: Array,
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
    inhomogeneity : (altitude,) float
        Variance of the logarithms on top of the noise.
    design : (3, angle, altitude) float
        Horizontal distance over altitude, eastward and northward, and slant path, all finite.
    sides : bool
        Whether all beams of the scan together surround the zenith.
    out : (profile, COLUMNS, altitude) float
        Output.
    residuals, leverages : (profile or 0, angle, altitude) float
        Outputs: residuals of the logarithms (NaN where there is no sample) and the diagonal of the
        hat matrix; not filled if they have no profile.
    """
    count, angles, altitudes = y.shape
    weights, q = np.empty((angles, altitudes)), np.zeros((_PATH + 1, angles, altitudes))
    residual, hat = np.empty((angles, altitudes)), np.empty((angles, altitudes))
    inverse, mean = np.zeros((_PATH + 1, altitudes)), np.zeros((_PATH + 1, altitudes))
    whole, beams = np.empty(altitudes), np.empty(altitudes)
    first = 0 if sides else _PATH
    for t in range(count):
        out[t] = 0.0
        _fill_weights(noise[t], inhomogeneity, weights, whole, beams)
        if sides:
            _gradients(weights, design, beams, q, inverse, mean, out[t, SIDES])
        _orthogonal_column(weights, design, _SAME_PATH * whole, q, inverse, mean, first, _PATH)
        out[t, INTERCEPT_VARIANCE] = 1.0 / whole
        _fill_fit(y[t], weights, q, inverse, mean, first, residual, hat, out[t])
        _fill_scatter(weights, beams, residual, hat, out[t])
        _fill_precision(weights, design, q, inverse, mean, first, out[t])
        _empty(inverse[_PATH], residual, hat, out[t])
        if residuals.shape[0] > 0:
            for a in range(angles):
                for k in range(altitudes):
                    on = noise[t, a, k] < np.inf
                    residuals[t, a, k] = residual[a, k] if on else np.nan
                    leverages[t, a, k] = hat[a, k] if on else np.nan
