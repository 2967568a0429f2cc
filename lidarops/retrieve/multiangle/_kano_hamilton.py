"""Compiled weighted regression of logarithms on slant path, one altitude at a time.

The formulas are in ``docs/algorithms/multiangle.md``. Two passes over the samples: the sums of the
normal equations, then the residuals. Altitudes are the innermost loop: they are contiguous, and
independent of each other.
"""

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
SHARED: Final = 7
"""Covariance with the error of the altitude above, of errors of unit variance, if the air of each
beam had unit variance and were the same at both."""
AIR: Final = 8
"""The same with the error at the altitude itself: its variance by air of unit variance."""
SLOPES: Final = 9
"""First of two: change of the optical depth per unit of a gradient along an axis that is not
fitted."""
COLUMNS: Final = 11

_PATH: Final = 1
"""Number of the column of slant paths, after the ones; the axes follow."""
_DEPENDENT: Final = 1e-12
"""Squared length of a column outside those before it, over its own, up to which it depends on
them."""
_RIGHT: Final = 0
"""Right sides of the normal equations; then coefficients of the orthogonal columns."""
_INVERSE: Final = 1
"""Inverse squared lengths of the orthogonal columns; 0 if left out."""
_SHARE: Final = 2
"""Share of each of their coefficients in that of the path; then in an optical depth of unit
variance, per weight."""


# Loops that write one array are vectorised: of more, the compiler cannot tell whether they overlap.
# Slices in them would count references, which takes longer than a loop.


@compiled
def _add_sums(
    y: Array, noise: Array, scatter: Array, design: Array, used: int,
    weights: Array, spare: Array, a: Array, f: Array,
) -> None:  # fmt: skip
    """Fill the weights, and add all beams to the sums of the normal equations."""
    columns, altitudes = design.shape[1:]
    row = np.empty(altitudes)
    for beam in range(y.shape[0]):
        for k in range(altitudes):
            weights[beam, k] = 1.0 / (noise[beam, k] + scatter[k])
        for k in range(altitudes):
            spare[k] += 1.0 if weights[beam, k] > 0.0 else 0.0
        for c in range(columns):
            for k in range(altitudes):
                row[k] = weights[beam, k] * design[beam, c, k]
            for e in range(min(c + 1, used)):
                for k in range(altitudes):
                    a[c, e, k] += row[k] * design[beam, e, k]
            for k in range(altitudes if c < used else 0):
                f[_RIGHT, c, k] += row[k] * y[beam, k]


@compiled
def _factor(a: Array, f: Array, spare: Array, most_added: float) -> None:
    """Factor the normal equations as L D L', leaving out what depends on others, and fill `_SHARE`.

    `a`, (column, column, altitude), the lower triangle of the sums, becomes L with D on the
    diagonal; `f`, (3, column, altitude), the right sides, their solution; `spare` the residual
    degrees of freedom.
    """
    for c in range(a.shape[0]):
        for k in range(a.shape[2]):
            length = a[c, c, k]
            for e in range(c):
                link = a[c, e, k]
                for g in range(e):
                    link -= a[c, g, k] * a[e, g, k] * a[g, g, k]
                link *= f[_INVERSE, e, k]
                a[c, e, k] = link
                f[_RIGHT, c, k] -= link * f[_RIGHT, e, k]
                length -= link * link * a[e, e, k]
            share = 1.0 if c == _PATH else 0.0
            for e in range(_PATH, c):
                share -= a[c, e, k] * f[_SHARE, e, k]
            used = length > _DEPENDENT * a[c, c, k]
            if c > _PATH:
                # A gradient must leave a residual to check the optical depth.
                used &= spare[k] > 1.0 and (c == _PATH + 1 or f[_INVERSE, c - 1, k] > 0.0)
                used &= share * share <= most_added * f[_INVERSE, _PATH, k] * length
            a[c, c, k] = length if used else 0.0
            f[_INVERSE, c, k] = 1.0 / length if used else 0.0
            f[_SHARE, c, k] = share
            spare[k] -= 1.0 if used else 0.0
    f[_RIGHT] *= f[_INVERSE]


@compiled
def _solve(a: Array, f: Array, centre: Array, out: Array) -> None:
    """Fill optical depth and intercept with their variances, and finish `_SHARE`."""
    origin = np.empty(a.shape[1:])
    for c in range(a.shape[0]):
        for k in range(a.shape[2]):
            value = 1.0 if c == 0 else -centre[c, k]
            for e in range(c):
                value -= a[c, e, k] * origin[e, k]
            origin[c, k] = value
            share = f[_SHARE, c, k]
            if c > _PATH and not f[_INVERSE, c, k] > 0.0:
                out[SLOPES + c - _PATH - 1, k] = 0.5 * share
                value = share = 0.0
            f[_SHARE, c, k] = share
            out[TAU, k] -= 0.5 * share * f[_RIGHT, c, k]
            out[INFORMATION, k] += 0.25 * share * share * f[_INVERSE, c, k]
            out[INTERCEPT, k] += value * f[_RIGHT, c, k]
            out[INTERCEPT_VARIANCE, k] += value * value * f[_INVERSE, c, k]
    for k in range(a.shape[2]):
        out[INFORMATION, k] = 1.0 / out[INFORMATION, k]
        root = 0.5 * math.sqrt(out[INFORMATION, k]) if f[_INVERSE, _PATH, k] > 0.0 else 0.0
        for c in range(a.shape[0]):
            f[_SHARE, c, k] *= root * f[_INVERSE, c, k]


@compiled
def _fill_residuals(
    y: Array, weights: Array, design: Array, used: int, a: Array, f: Array,
    residual: Array, hat: Array, lever: Array,
) -> None:  # fmt: skip
    """Fill residuals, leverages, and the parts of beams in an optical depth of unit variance."""
    q = np.empty((used, y.shape[1]))
    lever[:] = 0.0
    for beam in range(y.shape[0]):
        for k in range(y.shape[1]):
            residual[beam, k] = y[beam, k] - f[_RIGHT, 0, k]
            hat[beam, k] = weights[beam, k] * f[_INVERSE, 0, k]
        for c in range(1, used):
            for k in range(y.shape[1]):
                q[c, k] = design[beam, c, k] - a[c, 0, k]
            for e in range(1, c):
                for k in range(y.shape[1]):
                    q[c, k] -= a[c, e, k] * q[e, k]
            for k in range(y.shape[1]):
                residual[beam, k] -= f[_RIGHT, c, k] * q[c, k]
            for k in range(y.shape[1]):
                hat[beam, k] += weights[beam, k] * f[_INVERSE, c, k] * q[c, k] * q[c, k]
            for k in range(y.shape[1]):
                lever[beam, k] += weights[beam, k] * f[_SHARE, c, k] * q[c, k]


@compiled
def _add_squares(weights: Array, residual: Array, hat: Array, lever: Array, out: Array) -> None:
    """Add up what residuals and parts of all beams tell."""
    for beam in range(weights.shape[0]):
        for k in range(weights.shape[1]):
            out[CHI2, k] += weights[beam, k] * residual[beam, k] * residual[beam, k]
        for k in range(weights.shape[1]):
            out[TRACE, k] += weights[beam, k] * (1.0 - hat[beam, k])
        for k in range(weights.shape[1]):
            out[AIR, k] += lever[beam, k] * lever[beam, k]
        for k in range(weights.shape[1] - 1):
            out[SHARED, k] += lever[beam, k] * lever[beam, k + 1]


@compiled
def fit_levels(
    y: Array, noise: Array, scatter: Array, design: Array, centre: Array,
    most_added: float,
    out: Array, residuals: Array, leverages: Array,
) -> None:  # fmt: skip
    """Fit every altitude of every profile.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
        Logarithms and their variances; 0 and inf where there is no sample.
    scatter : (altitude,) float
        Variance of the logarithms on top of the noise.
    design : (angle, column, altitude) float
        Ones, slant path, and horizontal distances over altitude, minus their means over beams.
    centre : (column, altitude) float
        Those means.
    most_added : float
        Largest variance of the optical depth that the fit of a gradient along a distance may add,
        over that without gradients; negative if none is fitted.
    out : (profile, COLUMNS, altitude) float
        Output.
    residuals, leverages : (profile, angle, altitude) float
        Outputs: residuals of the logarithms (NaN where there is no sample or fit) and the diagonal
        of the hat matrix.
    """
    angles, altitudes = y.shape[1:]
    columns = design.shape[1]
    used = columns if most_added >= 0.0 else _PATH + 1
    weights, lever = np.empty((angles, altitudes)), np.empty((angles, altitudes))
    spare = np.empty(altitudes)
    a, f = np.empty((columns, columns, altitudes)), np.empty((3, columns, altitudes))
    for t in range(y.shape[0]):
        out[t], spare[:], a[:], f[:] = 0.0, 0.0, 0.0, 0.0
        _add_sums(y[t], noise[t], scatter, design, used, weights, spare, a, f)
        _factor(a, f, spare, most_added)
        _solve(a, f, centre, out[t])
        own, hat = residuals[t], leverages[t]
        _fill_residuals(y[t], weights, design, used, a, f, own, hat, lever)
        _add_squares(weights, own, hat, lever, out[t])
        _clear(weights, f[_INVERSE, _PATH], spare, own, hat, out[t])


@compiled
def _clear(
    weights: Array, inverse: Array, spare: Array, residual: Array, hat: Array, out: Array
) -> None:
    """Mark what has no sample, no residual or no fit."""
    for k in range(spare.size):
        out[FREEDOM, k] = max(spare[k], 0.0)
        if not spare[k] > 0.0:
            out[TRACE, k] = out[CHI2, k] = 0.0
        if inverse[k] == 0.0:
            out[:, k] = 0.0
            out[TAU, k] = out[INTERCEPT, k] = out[INTERCEPT_VARIANCE, k] = np.nan
    for beam in range(weights.shape[0]):
        for k in range(spare.size):
            if not (weights[beam, k] > 0.0 and inverse[k] > 0.0):
                residual[beam, k] = np.nan
                hat[beam, k] = 1.0
