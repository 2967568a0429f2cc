"""Whether neighbouring beams scatter alike: patches of air that are wider than beams are apart."""

from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from lidarops.retrieve.multiangle._block import BeamBlock, Regression
from lidarops.retrieve.multiangle._path_variation import taken_away

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CHANCE: Final = 1e-3
"""Probability of the test where beams are independent."""
LEAST: Final = 0.1
"""Correlation of neighbouring beams that counts as none."""
_FEWEST_PROFILES: Final = 4
_CLIP: Final = 3.0
_COLUMNS: Final = 4

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def neighbours_alike(beams: BeamBlock, fit: Regression) -> bool:
    r"""Tell whether the scatter of neighbouring beams goes together.

    Residuals about a constant, the slant path and the horizontal distances are multiplied with
    those of the next beam along the horizontal, and count by the share of inhomogeneity. Of
    independent beams, the projection P that takes residuals makes the mean of these products
    :math:`s^2 \sum P_{l,l+1}`, which is negative. The excess is summed over altitudes; profiles
    tell by their spread how certain it is.

    Parameters
    ----------
    beams : Beams
    fit : Regression

    Returns
    -------
    bool
    """
    profiles, _, bins = beams.noise.shape
    if profiles < _FEWEST_PROFILES:
        return False
    away = beams.distance[:, :, bins // 2]
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
    told = sums[sums[:, 3] > 0.0]
    if len(told) < _FEWEST_PROFILES:
        return False
    product, expected, square, freedom = told.T
    variance = float(square.sum() / freedom.sum())
    excess = product - variance * expected
    mean, spread = float(excess.mean()), float(excess.std(ddof=1))
    certain = -float(stdtrit(len(told) - 1.0, CHANCE))
    # White noise has 1; of less, what is left may be rounding alone.
    alike = mean / (max(variance, 1.0) * float(freedom.mean()))
    return alike > LEAST and mean > certain * spread / math.sqrt(len(told))


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
    """Sum products of the residuals of neighbours, their expectation, squares and freedom.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
    keep : (profile, angle or 0, altitude) float
    inhomogeneity : (altitude,) float
        Variance.
    path : (angle, altitude) float
    distance : (2, angle, altitude) float
    order : (angle,) int
        Along the horizontal.
    sums : (profile, 4) float
    """
    profiles, angles, bins = noise.shape
    left, share = np.empty(angles), np.empty(angles)
    columns = np.empty((_COLUMNS, angles))
    basis = np.empty((_COLUMNS, angles))
    for t in range(profiles):
        for k in range(bins):
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
            known = taken_away(columns, basis, count, left)
            if count <= known:
                continue
            _add(left[:count], share, basis[:known], sums[t])


@_compiled
def _add(left: Array, share: Array, basis: Array, total: Array) -> None:
    """Add what one altitude tells: residuals in order, their shares, and what was fitted."""
    for i in range(left.size):
        value = min(max(left[i], -_CLIP), _CLIP)
        total[2] += share[i] * value * value
        total[3] += share[i]
        for c in range(len(basis)):
            total[3] -= share[i] * basis[c, i] * basis[c, i]
        if i > 0:
            both = math.sqrt(share[i] * share[i - 1])
            total[0] += both * value * min(max(left[i - 1], -_CLIP), _CLIP)
            for c in range(len(basis)):
                total[1] -= both * basis[c, i] * basis[c, i - 1]
