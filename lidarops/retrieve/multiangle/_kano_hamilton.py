"""Compiled weighted regression of logarithms on slant path, one altitude at a time.

The formulas are in ``docs/algorithms/multiangle.md``. Altitudes are the innermost loop: they are
contiguous, and independent of each other.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
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
_DEPENDENT: Final = 1e-12
"""Squared length of a distance outside the columns before it, over that of both distances, up to
which it depends on them."""
_OPPOSITE: Final = 1e-6
"""radian, rounding by which the gap between opposite azimuths may exceed half a turn."""


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
def _ratio(over: Array, under: Array) -> None:
    """Divide in place; 0 where the divisor is not positive."""
    for k in range(over.size):
        over[k] = over[k] / under[k] if under[k] > 0.0 else 0.0


@compiled
def _subtract(values: Array, share: Array, column: Array) -> None:
    for a in range(values.shape[0]):
        for k in range(share.size):
            values[a, k] -= share[k] * column[a, k]


@compiled
def _orthogonal_columns(
    weights: Array, design: Array, least: Array, q: Array, norm: Array, mean: Array, c: int
) -> None:
    """Make a column orthogonal to a constant and to the columns before it, at every altitude.

    Parameters
    ----------
    weights : (angle, altitude) float
    design : (3, angle, altitude) float
        Distance to the east and north, slant path.
    least : (altitude,) float
        Squared length up to which the column is left out.
    q : (3, angle, altitude) float
        The columns; 0 if left out.
    norm, mean : (3, altitude) float
        Their squared lengths, and the coordinates of path 0 and distance 0 on them.
    c : int
        The column: those before it are inputs, it is output.
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
    for b in range(c):
        _sums(weights, q[b], q[c], share)
        _ratio(share, norm[b])
        _subtract(q[c], share, q[b])
        for k in range(whole.size):
            mean[c, k] -= share[k] * mean[b, k]
    _sums(weights, q[c], q[c], norm[c])
    _leave_out(norm[c] > least, q, norm, mean, c)


@compiled
def _leave_out(kept: Booleans, q: Array, norm: Array, mean: Array, c: int) -> None:
    """Set a column to 0 where it is not kept."""
    for k in range(kept.size):
        if not kept[k]:
            norm[c, k] = mean[c, k] = 0.0
            for a in range(q.shape[1]):
                q[c, a, k] = 0.0


@compiled
def _gradients(
    weights: Array, design: Array, beams: Array, q: Array, norm: Array, mean: Array, sides: Array
) -> None:
    """Fill the columns of the gradients, and their number `sides` at each altitude."""
    surrounded, lever, share = np.empty(sides.size), np.empty(sides.size), np.empty(sides.size)
    _surrounded_altitudes(weights, design, surrounded)
    _sums(weights, design[0], design[0], lever)
    _sums(weights, design[1], design[1], share)
    for k in range(sides.size):
        lever[k] = _DEPENDENT * (lever[k] + share[k]) if surrounded[k] > 0.0 else np.inf
    for c in range(2):
        _orthogonal_columns(weights, design, lever, q, norm, mean, c)
        for k in range(sides.size):
            sides[k] += 1.0 if norm[c, k] > 0.0 else 0.0
    # Otherwise no residual would be left to check the optical depth.
    spare = beams > 2.0 + sides
    for c in range(2):
        _leave_out(spare, q, norm, mean, c)
    for k in range(sides.size):
        sides[k] = sides[k] if spare[k] else 0.0


@compiled
def _fill_precision(
    weights: Array, design: Array, whole: Array, q: Array, norm: Array, mean: Array, out: Array
) -> None:
    """Fill the columns of a fit that do not depend on the signal."""
    angles, altitudes = weights.shape
    for k in range(altitudes):
        out[INTERCEPT_VARIANCE, k] = 1.0 / whole[k]
        out[INFORMATION, k] = 4.0 * norm[2, k]
    for c in range(3):
        for k in range(altitudes):
            if norm[c, k] > 0.0:
                out[INTERCEPT_VARIANCE, k] += mean[c, k] * mean[c, k] / norm[c, k]
    low, high = np.full(altitudes, np.inf), np.full(altitudes, -np.inf)
    for a in range(angles):
        for k in range(altitudes):
            lever = weights[a, k] * q[2, a, k]
            out[SHARE, k] += lever * lever
            out[SLOPE_EAST, k] += lever * design[0, a, k]
            out[SLOPE_NORTH, k] += lever * design[1, a, k]
            path = design[2, a, k]
            low[k] = min(low[k], path if weights[a, k] > 0.0 else np.inf)
            high[k] = max(high[k], path if weights[a, k] > 0.0 else -np.inf)
    for k in range(altitudes):
        out[SPAN, k] = high[k] - low[k]
        out[SHARE, k] /= norm[2, k]
        known = out[SIDES, k] == 0.0
        out[SLOPE_EAST, k] = -0.5 * out[SLOPE_EAST, k] / norm[2, k] if known else 0.0
        out[SLOPE_NORTH, k] = -0.5 * out[SLOPE_NORTH, k] / norm[2, k] if known else 0.0


@compiled
def _fill_fit(
    y: Array, weights: Array, whole: Array, q: Array, norm: Array, mean: Array,
    residual: Array, hat: Array, out: Array,
) -> None:  # fmt: skip
    """Fill optical depth, intercept, residuals and leverages."""
    angles, altitudes = weights.shape
    slope = np.zeros(altitudes)
    for a in range(angles):
        for k in range(altitudes):
            slope[k] += weights[a, k] * y[a, k]
    for k in range(altitudes):
        out[INTERCEPT, k] = slope[k] / whole[k]
    for a in range(angles):
        for k in range(altitudes):
            residual[a, k] = y[a, k] - out[INTERCEPT, k]
            hat[a, k] = weights[a, k] / whole[k]
    for c in range(3):
        _sums(weights, q[c], residual, slope)
        _ratio(slope, norm[c])
        _subtract(residual, slope, q[c])
        for k in range(altitudes):
            out[INTERCEPT, k] += slope[k] * mean[c, k]
            out[TAU, k] = -0.5 * slope[k]
        for a in range(angles):
            for k in range(altitudes):
                lever = weights[a, k] * q[c, a, k] * q[c, a, k]
                hat[a, k] += lever / norm[c, k] if norm[c, k] > 0.0 else 0.0


@compiled
def _fill_scatter(
    weights: Array, keep: Array, beams: Array, residual: Array, hat: Array, out: Array
) -> None:
    """Fill chi2 and its expectation where residuals are left."""
    angles, altitudes = weights.shape
    for k in range(altitudes):
        out[FREEDOM, k] = beams[k] - 2.0 - out[SIDES, k]
    for a in range(angles):
        kept = keep[a] if keep.shape[0] > 0 else np.ones(altitudes)
        for k in range(altitudes):
            if out[FREEDOM, k] > 0.0:
                free = 1.0 - hat[a, k]
                out[TRACE, k] += weights[a, k] * free
                out[EXPECTED, k] += kept[k] * free if weights[a, k] > 0.0 else 0.0
                out[CHI2, k] += weights[a, k] * residual[a, k] * residual[a, k]


@compiled
def _empty(fitted: Array, residual: Array, hat: Array, out: Array) -> None:
    """Mark the altitudes where the slant paths do not differ."""
    for k in range(fitted.size):
        if not fitted[k] > 0.0:
            sides = out[SIDES, k]
            out[:, k] = 0.0
            out[TAU, k] = out[INTERCEPT, k] = out[INTERCEPT_VARIANCE, k] = np.nan
            out[SIDES, k] = sides
            residual[:, k] = np.nan
            hat[:, k] = 1.0


@compiled
def _fill_weights(
    noise: Array, keep: Array, inhomogeneity: Array, weights: Array, whole: Array, beams: Array
) -> None:
    """Fill the weights, their sum over beams, and the number of beams with weight."""
    whole[:] = 0.0
    beams[:] = 0.0
    for a in range(weights.shape[0]):
        for k in range(whole.size):
            weights[a, k] = 1.0 / (noise[a, k] + inhomogeneity[k])
            if keep.shape[0] > 0:
                weights[a, k] *= keep[a, k]
            whole[k] += weights[a, k]
            beams[k] += 1.0 if weights[a, k] > 0.0 else 0.0


@compiled
def fit_levels(
    y: Array,
    noise: Array,
    keep: Array,
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
    keep : (profile, angle or 0, altitude) float
        Factors of the weights.
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
    weights, q = np.empty((angles, altitudes)), np.zeros((3, angles, altitudes))
    residual, hat = np.empty((angles, altitudes)), np.empty((angles, altitudes))
    norm, mean = np.zeros((3, altitudes)), np.zeros((3, altitudes))
    whole, beams = np.empty(altitudes), np.empty(altitudes)
    for t in range(count):
        out[t] = 0.0
        _fill_weights(noise[t], keep[t], inhomogeneity, weights, whole, beams)
        if sides:
            _gradients(weights, design, beams, q, norm, mean, out[t, SIDES])
        _orthogonal_columns(weights, design, _SAME_PATH * whole, q, norm, mean, 2)
        _fill_precision(weights, design, whole, q, norm, mean, out[t])
        _fill_fit(y[t], weights, whole, q, norm, mean, residual, hat, out[t])
        _fill_scatter(weights, keep[t], beams, residual, hat, out[t])
        _empty(norm[2], residual, hat, out[t])
        if residuals.shape[0] > 0:
            for a in range(angles):
                for k in range(altitudes):
                    on = noise[t, a, k] < np.inf
                    residuals[t, a, k] = residual[a, k] if on else np.nan
                    leverages[t, a, k] = hat[a, k] if on else np.nan
