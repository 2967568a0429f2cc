"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

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
    windowed,
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


def gradient_scale(optical_depth: Array, standard_error: Array, gradient_error: Array) -> Array:
    r"""Return the factor by which gradient errors of planes explain the scatter between them.

    With the weights :math:`w = 1 / (\sigma^2 + \epsilon^2)` of standard and gradient errors, the
    share :math:`h` of a plane in their sum, and deviations :math:`r` from the weighted mean over
    planes (`dersimonian1986`),

    .. math:: f^2 = \max\Big(0, \frac{\sum w r^2 - \sum w (1 - h) \sigma^2}
        {\sum w (1 - h) \epsilon^2}\Big),

    with sums over planes, all cycles, and the window of altitudes of the inhomogeneity.
    Three planes are the fewest that surround the zenith. Where gradients are all of the scatter,
    and all altitudes see the same, :math:`2 f^2` of one cycle has a chi-square distribution of 2
    degrees of freedom: in 22 percent of such scenes f is too small by half or more.

    Parameters
    ----------
    optical_depth, standard_error, gradient_error : (plane, profile, altitude) float
        NaN where there is no value.

    Returns
    -------
    (altitude,) float
        1 where no altitude of the window has two planes with a gradient error.
    """
    depth, noise, slope = optical_depth, standard_error**2, gradient_error**2
    known = np.isfinite(depth + noise + slope) & (noise + slope > 0.0)
    depth, noise, slope = (np.where(known, values, 0.0) for values in (depth, noise, slope))
    weights = np.where(known, 1.0, 0.0) / np.where(known, noise + slope, 1.0)
    whole = weights.sum(axis=0)
    whole = np.where(whole > 0.0, whole, 1.0)
    deviation = depth - (weights * depth).sum(axis=0) / whole
    free = weights * (1.0 - weights / whole)
    excess = windowed((weights * deviation**2 - free * noise).sum(axis=(0, 1)))
    unit = windowed((free * slope).sum(axis=(0, 1)))
    shown = unit > 0.0
    square = np.maximum(excess, 0.0) / np.where(shown, unit, 1.0)
    return np.where(shown, np.sqrt(square), 1.0)
