"""Test whether extinction varies along the horizontal, from the scatter of the beams of a scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import polygamma

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import (
    BeamBlock,
    Regression,
    orthogonal_columns,
    sum_over_beams,
)
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


def path_variation_from(beams: BeamBlock, fit: Regression) -> int | None:
    """Return the lowest altitude affected by extinction that varies along paths; None if none is.

    Formula 9 of ``docs/algorithms/multiangle.md``. If the deviations from the mean over profiles
    grow, all altitudes are affected. Growth common to all profiles of a block may also be an
    instrumental error that increases with range, such as of the background; it affects altitudes
    above the lower third.
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

    def select(self, profiles: Booleans) -> _Means:
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
    noise = beams.noise[..., altitudes]
    kept = fit.keep[..., altitudes] if fit.keep.shape[1] > 0 else 1.0
    used = (noise < inhomogeneity) & (kept > THRESHOLDS.least_weight)
    weights = np.where(used, kept / (noise + inhomogeneity), 0.0)
    left = beams.logarithm[..., altitudes]
    known = np.zeros(weights.shape[::2], dtype=np.int64)
    for column, square in orthogonal_columns(
        weights, (np.ones(altitudes.size), *beams.design[..., altitudes])
    ):
        left = left - sum_over_beams(weights * column, left) / square * column
        known += np.isfinite(square[:, 0])
    freedom = np.maximum(used.sum(axis=1) - known, 0)
    limit = np.where(freedom > 0, THRESHOLDS.clipped, 0.0)[:, np.newaxis]
    residual = np.clip(left * np.sqrt(weights), -limit, limit)
    filled = np.count_nonzero(freedom > 0, axis=1)
    # With fewer altitudes the mean would not represent the third.
    on = 2 * filled >= altitudes.size
    # The root gives white noise variance 1, however many altitudes are missing.
    mean = residual.sum(axis=2) / np.sqrt(np.maximum(filled, 1))[:, np.newaxis]
    mean_freedom = freedom.sum(axis=1) / np.maximum(filled, 1)
    return _Means(np.where(on[:, np.newaxis], mean, 0.0), np.where(on, mean_freedom, 0.0))
