"""Whether extinction varies along the paths of a scan: a test of how its beams scatter.

Where the extinction of level air varies along the horizontal, what a beam has lost adds up on its
way: it differs from that of other beams, the more the higher they are, and alike at neighbouring
altitudes. Scatter of backscatter averages out over altitudes; this does not, and no smoothing over
altitude takes it away. Scatter that grows by chance, by a gradient, by noise or by a few outliers
must not pass for it.
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

Array = npt.NDArray[np.float64]
Bins = npt.NDArray[np.intp]

GROWTH: Final = 1.5**2
"""Ratio of the variances in the upper and the lower third below which they count as alike."""
CERTAINTY: Final = 2.5
"""Standard errors by which the logarithm of that ratio must exceed zero. In simulated scenes
without variation, 0.3 percent exceed both."""
_FEWEST_BINS: Final = 6
_FEWEST_PROFILES: Final = 4
_CLIP: Final = 3.0
"""Standard errors to which residuals are cut, so that no outlier decides."""
_DEPENDENT: Final = 1e-8
_LEAST_WEIGHT: Final = 1e-3
_COLUMNS: Final = 4

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def doubted_from(beams: BeamBlock, fit: Regression) -> int | None:
    r"""Return the altitude from which on extinction varies along paths; None where it does not.

    With the inhomogeneity of the lower third of the altitudes, residuals are formed anew about a
    constant, the slant path and the horizontal distances, which take a gradient away. Each beam is
    averaged over the altitudes of a third, as far as inhomogeneity exceeds its noise; the sums of
    squares Q of these means over beams and profiles are compared,

    .. math:: \ln \frac{Q_u / \nu_u}{Q_l / \nu_l}, \qquad
              \sigma^2 = \psi'(\nu_u / 2) + \psi'(\nu_l / 2) ,

    with the degrees of freedom :math:`\nu` that an altitude has, as a beam has one mean, however
    its altitudes are correlated.

    Where this holds of what differs from profile to profile, all altitudes are doubted. What all
    profiles of a block share may as well be an error of the instrument, as of a background,
    which grows with the range; it counts for altitudes above the lower third.

    Parameters
    ----------
    beams : Beams
    fit : Regression

    Returns
    -------
    int, optional
        Index.
    """
    seen = np.flatnonzero((fit.column(kh.FREEDOM) > 0).any(axis=0))
    if seen.size < _FEWEST_BINS:
        return None
    third = seen.size // 3
    thirds = seen[:third], seen[-third:]
    low = float(np.mean(fit.inhomogeneity[thirds[0]]))
    lower, upper = (_beam_means(beams, fit, part, low) for part in thirds)
    told = (lower.freedom > 0) & (upper.freedom > 0)
    if not _grows(lower.of(told), upper.of(told)):
        return None
    if np.count_nonzero(told) < _FEWEST_PROFILES:
        return 0
    return (
        0 if _grows(lower.of(told).varying(), upper.of(told).varying()) else int(thirds[0][-1]) + 1
    )


@dataclass(frozen=True, slots=True)
class _Means:
    """Means of beams over a third of the altitudes, in units that are 1 for white noise."""

    value: Array
    """(profile, beam)"""
    freedom: Array
    """(profile,)"""

    def of(self, profiles: npt.NDArray[np.bool_]) -> _Means:
        """Return those of some profiles."""
        return _Means(self.value[profiles], self.freedom[profiles])

    def varying(self) -> _Means:
        """Return what differs from profile to profile."""
        there = self.value != 0.0
        mean = self.value.sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        left = 1.0 - 1.0 / self.freedom.size
        return _Means(np.where(there, self.value - mean, 0.0), left * self.freedom)


def _grows(lower: _Means, upper: _Means) -> bool:
    squares = [float((one.value**2).sum()) for one in (lower, upper)]
    freedom = [float(one.freedom.sum()) for one in (lower, upper)]
    if min(squares + freedom) <= 0.0:
        return False
    # White noise has 1: less is of an inhomogeneity that was told too large, and growth from
    # there is that of the detector's noise.
    growth = squares[1] / freedom[1] / max(squares[0] / freedom[0], 1.0)
    spread = math.sqrt(sum(polygamma(1, 0.5 * one) for one in freedom))
    return growth > GROWTH and math.log(growth) > CERTAINTY * spread


def _beam_means(beams: BeamBlock, fit: Regression, bins: Bins, inhomogeneity: float) -> _Means:
    """Average each beam of each profile over a third."""
    count, angles, _ = beams.noise.shape
    residual = np.zeros((count * angles, bins.size))
    freedom = np.zeros((count, bins.size))
    _standardise(
        beams.logarithm,
        beams.noise,
        fit.keep,
        inhomogeneity,
        beams.path,
        beams.distance,
        bins,
        residual,
        freedom,
    )
    filled = np.count_nonzero(freedom > 0, axis=1)
    # Fewer altitudes would be another third of another air.
    on = 2 * filled >= bins.size
    # Of white noise, too, all have one variance, however many altitudes they miss.
    mean = residual.sum(axis=1).reshape(count, angles) / np.sqrt(np.maximum(filled, 1))[:, None]
    each = freedom.sum(axis=1) / np.maximum(filled, 1)
    return _Means(np.where(on[:, np.newaxis], mean, 0.0), np.where(on, each, 0.0))


@_compiled
def _standardise(
    y: Array,
    noise: Array,
    keep: Array,
    inhomogeneity: float,
    path: Array,
    distance: Array,
    bins: Any,
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
    bins : (bin,) int
        Altitudes wanted.
    residual : (profile * angle, bin) float
        Zeros, where there is no sample they stay.
    freedom : (profile, bin) float
    """
    profiles, angles, _ = noise.shape
    root, left = np.empty(angles), np.empty(angles)
    columns, basis = np.empty((_COLUMNS, angles)), np.empty((_COLUMNS, angles))
    beams = np.empty(angles, np.int64)
    for t in range(profiles):
        for j in range(bins.size):
            k = bins[j]
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
            known = taken_away(columns, basis, count, left)
            freedom[t, j] = max(count - known, 0)
            if count > known:
                for i in range(count):
                    residual[t * angles + beams[i], j] = min(max(left[i], -_CLIP), _CLIP)


@_compiled
def taken_away(columns: Array, basis: Array, count: int, left: Array) -> int:
    """Take columns out of residuals, fill an orthonormal basis of them, and return its size."""
    known = 0
    for one in columns:
        basis[known] = one
        known += 1 if _orthogonal(basis, known, count, left) else 0
    return known


@_compiled
def _orthogonal(basis: Array, known: int, count: int, left: Array) -> bool:
    """Make a column orthogonal to those before, and take it out of what is left of the data."""
    one = basis[known]
    raw = _dot(one, one, count)
    for c in range(known):
        share = _dot(basis[c], one, count)
        for i in range(count):
            one[i] -= share * basis[c, i]
    square = _dot(one, one, count)
    if not square > _DEPENDENT * raw:
        return False
    norm = 1.0 / math.sqrt(square)
    for i in range(count):
        one[i] *= norm
    share = _dot(one, left, count)
    for i in range(count):
        left[i] -= share * one[i]
    return True


@_compiled
def _dot(first: Array, second: Array, count: int) -> float:
    total = 0.0
    for i in range(count):
        total += first[i] * second[i]
    return total
