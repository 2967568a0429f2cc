"""Test whether extinction varies along the horizontal, from the scatter of the beams of a scan.

If extinction varies along the horizontal, the attenuation of beams differs. The difference
accumulates along the path: it grows with altitude and is similar at neighbouring altitudes. Unlike
scatter of backscatter, it does not average out over altitudes, and smoothing over altitude does not
remove it. Scatter that grows by chance, a gradient, noise or a few outliers must not be mistaken
for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import polygamma

from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_CLIP: Final = THRESHOLDS.clipped
_DEPENDENT: Final = 1e-8
"""Squared length of a column outside those before it, over its own, up to which it depends on
them."""
_LEAST_WEIGHT: Final = THRESHOLDS.least_weight
_COLUMNS: Final = 4
"""Constant, slant path, distance to the east and to the north."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def path_variation_from(beams: BeamBlock, fit: Regression) -> int | None:
    r"""Return the lowest altitude affected by extinction that varies along paths; None if none is.

    Residuals are formed about a constant, the slant path and the horizontal distances (which
    removes a gradient), weighted with the inhomogeneity of the lower third of the altitudes. The
    residuals of each beam are averaged over the altitudes of a third where inhomogeneity exceeds
    noise. The sums of squares Q of these means over beams and profiles are compared,

    .. math:: \ln \frac{Q_u / \nu_u}{Q_l / \nu_l}, \qquad
              \sigma^2 = \psi'(\nu_u / 2) + \psi'(\nu_l / 2) ,

    with the degrees of freedom :math:`\nu` of one altitude, because a beam has one mean, however
    correlated its altitudes are.

    If the deviations from the mean over profiles grow in this way, all altitudes are affected.
    Growth common to all profiles of a block may also be an instrumental error that increases with
    range, such as of the background; it affects altitudes above the lower third.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression

    Returns
    -------
    int, optional
        Index of the altitude.
    """
    tested = np.flatnonzero((fit.column(kh.FREEDOM) > 0).any(axis=0))
    if tested.size < THRESHOLDS.fewest_altitudes:
        return None
    third = tested.size // 3
    thirds = tested[:third], tested[-third:]
    low = float(np.mean(fit.inhomogeneity[thirds[0]]))
    lower, upper = (_beam_means(beams, fit, altitudes, low) for altitudes in thirds)
    known = (lower.freedom > 0) & (upper.freedom > 0)
    lower, upper = lower.select(known), upper.select(known)
    if not _grows(lower, upper):
        return None
    if np.count_nonzero(known) < THRESHOLDS.fewest_profiles:
        return 0
    return 0 if _grows(lower.deviations(), upper.deviations()) else int(thirds[0][-1]) + 1


@dataclass(frozen=True, slots=True)
class _Means:
    """Means of beams over a third of the altitudes, scaled to variance 1 for white noise."""

    value: Array
    """(profile, beam)"""
    freedom: Array
    """(profile,)"""

    def select(self, profiles: npt.NDArray[np.bool_]) -> _Means:
        """Return the means of some profiles."""
        return _Means(self.value[profiles], self.freedom[profiles])

    def deviations(self) -> _Means:
        """Return the deviations from the mean over profiles."""
        known = self.value != 0.0
        mean = self.value.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        left = 1.0 - 1.0 / self.freedom.size
        return _Means(np.where(known, self.value - mean, 0.0), left * self.freedom)


def _grows(lower: _Means, upper: _Means) -> bool:
    squares = [float((means.value**2).sum()) for means in (lower, upper)]
    freedom = [float(means.freedom.sum()) for means in (lower, upper)]
    if min(squares + freedom) <= 0.0:
        return False
    # White noise has variance 1. A smaller one comes from an overestimated inhomogeneity, and
    # growth from there to 1 is that of detector noise.
    growth = squares[1] / freedom[1] / max(squares[0] / freedom[0], 1.0)
    spread = math.sqrt(sum(polygamma(1, 0.5 * count) for count in freedom))
    return growth > THRESHOLDS.growth and math.log(growth) > THRESHOLDS.growth_certainty * spread


def _beam_means(
    beams: BeamBlock, fit: Regression, altitudes: Indices, inhomogeneity: float
) -> _Means:
    """Average each beam of each profile over a third."""
    count, angles, _ = beams.noise.shape
    residual = np.zeros((count * angles, altitudes.size))
    freedom = np.zeros((count, altitudes.size))
    _standardise(
        beams.logarithm,
        beams.noise,
        fit.keep,
        inhomogeneity,
        beams.path,
        beams.distance,
        altitudes,
        residual,
        freedom,
    )
    filled = np.count_nonzero(freedom > 0, axis=1)
    # With fewer altitudes the mean would not represent the third.
    on = 2 * filled >= altitudes.size
    # The root gives white noise variance 1, however many altitudes are missing.
    mean = residual.sum(axis=1).reshape(count, angles) / np.sqrt(np.maximum(filled, 1))[:, None]
    mean_freedom = freedom.sum(axis=1) / np.maximum(filled, 1)
    return _Means(np.where(on[:, np.newaxis], mean, 0.0), np.where(on, mean_freedom, 0.0))


@_compiled
def _standardise(
    y: Array,
    noise: Array,
    keep: Array,
    inhomogeneity: float,
    path: Array,
    distance: Array,
    altitudes: Any,
    residual: Array,
    freedom: Array,
) -> None:
    """Fill residuals over their standard errors, and the degrees of freedom of each altitude.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
    keep : (profile, angle or 0, altitude) float
    inhomogeneity : float
        Variance.
    path : (angle, altitude) float
    distance : (2, angle, altitude) float
    altitudes : (selected,) int
        Indices of the altitudes.
    residual : (profile * angle, selected) float
        Output; expected as zeros, which stay where there is no sample.
    freedom : (profile, selected) float
        Output.
    """
    profiles, angles, _ = noise.shape
    root, left = np.empty(angles), np.empty(angles)
    columns, basis = np.empty((_COLUMNS, angles)), np.empty((_COLUMNS, angles))
    beams = np.empty(angles, np.int64)
    for t in range(profiles):
        for j in range(altitudes.size):
            k = altitudes[j]
            count = 0
            for a in range(angles):
                kept = keep[t, a, k] if keep.shape[1] > 0 else 1.0
                if noise[t, a, k] < inhomogeneity and kept > _LEAST_WEIGHT:
                    beams[count] = a
                    root[count] = math.sqrt(kept / (noise[t, a, k] + inhomogeneity))
                    left[count] = y[t, a, k] * root[count]
                    count += 1
            for i in range(count):
                columns[0, i] = root[i]
                columns[1, i] = path[beams[i], k] * root[i]
                columns[2, i] = distance[0, beams[i], k] * root[i]
                columns[3, i] = distance[1, beams[i], k] * root[i]
            known = remove_columns(columns, basis, count, left)
            freedom[t, j] = max(count - known, 0)
            if count > known:
                for i in range(count):
                    residual[t * angles + beams[i], j] = min(max(left[i], -_CLIP), _CLIP)


@_compiled
def remove_columns(columns: Array, basis: Array, count: int, left: Array) -> int:
    """Project residuals off the columns, fill an orthonormal basis of these, return its size."""
    known = 0
    for column in columns:
        basis[known] = column
        known += 1 if _orthogonal(basis, known, count, left) else 0
    return known


@_compiled
def _orthogonal(basis: Array, known: int, count: int, left: Array) -> bool:
    """Make a column orthonormal to those before and project the residuals off it.

    Return False if the column depends on those before.
    """
    column = basis[known]
    raw = _dot(column, column, count)
    for c in range(known):
        share = _dot(basis[c], column, count)
        for i in range(count):
            column[i] -= share * basis[c, i]
    square = _dot(column, column, count)
    if not square > _DEPENDENT * raw:
        return False
    norm = 1.0 / math.sqrt(square)
    for i in range(count):
        column[i] *= norm
    share = _dot(column, left, count)
    for i in range(count):
        left[i] -= share * column[i]
    return True


@_compiled
def _dot(first: Array, second: Array, count: int) -> float:
    total = 0.0
    for i in range(count):
        total += first[i] * second[i]
    return total
