"""Test whether neighbouring beams scatter alike: patches of air wider than the beam distance."""

from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle._path_variation import remove_columns

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CHANCE: Final = 1e-3
"""Probability of the test where beams are independent."""
LEAST: Final = 0.1
"""Correlation of neighbouring beams up to which they count as independent."""
_FEWEST_PROFILES: Final = 4
_CLIP: Final = 3.0
"""Standard errors to which residuals are clipped, so that no outlier dominates."""
_COLUMNS: Final = 4
"""Constant, slant path, distance to the east and to the north."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def neighbours_alike(beams: BeamBlock, fit: Regression) -> bool:
    r"""Return whether the scatter of neighbouring beams is positively correlated.

    Residuals about a constant, the slant path and the horizontal distances are multiplied with
    those of the next beam along the horizontal, weighted by the share of inhomogeneity. For
    independent beams and the projection P onto residuals, the mean of these products is
    :math:`s^2 \sum P_{l,l+1}`, which is negative. The excess over it is summed over altitudes; its
    spread over profiles gives its standard error.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression

    Returns
    -------
    bool
    """
    profiles, _, altitudes = beams.noise.shape
    if profiles < _FEWEST_PROFILES:
        return False
    away = beams.distance[:, :, altitudes // 2]
    axis = int(np.argmax(np.ptp(away, axis=1)))
    order = np.argsort(away[axis], kind="stable")
    sums = np.zeros((profiles, 4))
    _products(
        beams.logarithm,
        beams.noise,
        fit.keep,
        fit.inhomogeneity,
        beams.path,
        beams.distance,
        order,
        sums,
    )
    known = sums[sums[:, 3] > 0.0]
    if len(known) < _FEWEST_PROFILES:
        return False
    product, expected, square, freedom = known.T
    variance = float(square.sum() / freedom.sum())
    excess = product - variance * expected
    mean, spread = float(excess.mean()), float(excess.std(ddof=1))
    limit = -float(stdtrit(len(known) - 1.0, CHANCE))
    # White noise has variance 1; with much less, the excess may be rounding alone.
    correlation = mean / (max(variance, 1.0) * float(freedom.mean()))
    return correlation > LEAST and mean > limit * spread / math.sqrt(len(known))


@_compiled
def _products(
    y: Array,
    noise: Array,
    keep: Array,
    inhomogeneity: Array,
    path: Array,
    distance: Array,
    order: Integers,
    sums: Array,
) -> None:
    """Sum products of residuals of neighbours, their expectation, squares and freedom.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
    keep : (profile, angle or 0, altitude) float
    inhomogeneity : (altitude,) float
        Variance.
    path : (angle, altitude) float
    distance : (2, angle, altitude) float
    order : (angle,) int
        Order of the beams along the horizontal.
    sums : (profile, 4) float
        Output.
    """
    profiles, angles, altitudes = noise.shape
    left, share = np.empty(angles), np.empty(angles)
    columns = np.empty((_COLUMNS, angles))
    basis = np.empty((_COLUMNS, angles))
    for t in range(profiles):
        for k in range(altitudes):
            count = 0
            for a in order:
                kept = keep[t, a, k] if keep.shape[1] > 0 else 1.0
                if noise[t, a, k] < np.inf and inhomogeneity[k] > 0.0 and kept > 0.5:
                    share[count] = inhomogeneity[k] / (noise[t, a, k] + inhomogeneity[k])
                    root = 1.0 / math.sqrt(noise[t, a, k] + inhomogeneity[k])
                    left[count] = y[t, a, k] * root
                    columns[0, count] = root
                    columns[1, count] = path[a, k] * root
                    columns[2, count] = distance[0, a, k] * root
                    columns[3, count] = distance[1, a, k] * root
                    count += 1
            known = remove_columns(columns, basis, count, left)
            if count <= known:
                continue
            _add(left[:count], share, basis[:known], sums[t])


@_compiled
def _add(left: Array, share: Array, basis: Array, total: Array) -> None:
    """Add one altitude to the sums.

    Parameters
    ----------
    left, share : (beam,) float
        Residuals in order along the horizontal, and their shares of inhomogeneity.
    basis : (column, beam) float
        Orthonormal columns that were fitted.
    total : (4,) float
    """
    for i in range(left.size):
        value = min(max(left[i], -_CLIP), _CLIP)
        total[2] += share[i] * value * value
        total[3] += share[i]
        for c in range(len(basis)):
            total[3] -= share[i] * basis[c, i] * basis[c, i]
        if i > 0:
            joint = math.sqrt(share[i] * share[i - 1])
            total[0] += joint * value * min(max(left[i - 1], -_CLIP), _CLIP)
            for c in range(len(basis)):
                total[1] -= joint * basis[c, i] * basis[c, i - 1]
