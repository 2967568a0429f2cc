"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import polygamma, stdtrit

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression, weights_of, windowed
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNKNOWNS: Final = 3
"""Constant, optical depth and a gradient."""
_LEAST_REST: Final = 1e-3
"""Least share of an error that a fit leaves in a residual."""
_DEPENDENT: Final = 1e-8
"""Squared length of a column outside those before it, over its own, up to which it depends on
them."""


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


def visible_gradient(beams: BeamBlock, fit: Regression, altitude: Array) -> float:
    """Return the largest horizontal gradient of ln backscatter that residuals of a block show, m-1.

    It is the largest that is shown at any altitude of the block, by all profiles within 500 m of
    it, beyond what an error of the dead time explains; 0 if none is shown. It holds at all
    altitudes: an optical depth is that of the air below, too.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    altitude : (altitude,) float
        m.
    """
    if not beams.noise.size:
        return 0.0
    # Selection and logarithms bias noisy samples, which together would look like a gradient. The
    # profiles decide together, lest a sample be selected by the noise around it.
    middle = np.count_nonzero(beams.noise < np.inf, axis=0, keepdims=True) // 2
    typical = np.take_along_axis(np.sort(beams.noise, axis=0), middle, axis=0)
    clear = np.isfinite(fit.residual) & (typical < THRESHOLDS.gradient_noise)
    weights = np.where(clear, weights_of(beams, fit), 0.0)
    weights *= ((fit.column(kh.SIDES) == 0.0) & (fit.column(kh.FREEDOM) > 0))[:, np.newaxis]
    plain = orthogonal_columns(weights, (np.ones(altitude.size), beams.path))
    square = 0.0
    for distance in _along_axes(beams.design[:2]):
        left, length = orthogonal_columns(weights, (distance,), plain)[-1]
        lever = np.where(np.isfinite(length), weights * left * altitude, 0.0)
        square += _gradient_beyond_chance(beams, fit, lever, left, altitude) ** 2
    return float(np.sqrt(square))


def _gradient_beyond_chance(
    beams: BeamBlock, fit: Regression, lever: Array, left: Array, altitude: Array
) -> float:
    """Return the largest gradient along an axis that is beyond chance and the dead time, m-1.

    The error by chance follows from the scatter of the beams of all profiles about the gradient,
    whose altitudes may be correlated. An error of the dead time is common to all beams.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    lever : (profile, angle, altitude) float
        Weight of a residual in the sum that gives the gradient.
    left : (profile, angle, altitude) float
        Horizontal distance over altitude that constant and path do not explain.
    altitude : (altitude,) float
        m.
    """
    residual = np.nan_to_num(fit.residual)
    # A fit leaves beams of large leverage less than their error.
    whole = lever / np.sqrt(np.maximum(1.0 - np.nan_to_num(fit.leverage), _LEAST_REST))
    arm = left * altitude
    total, weight, product, part = (
        _sums_nearby(values, altitude)
        for values in (lever * residual, lever * arm, whole * residual, whole * arm)
    )
    information = weight.sum(axis=1)
    known = np.where(information > 0.0, information, np.inf)
    gradient = total.sum(axis=1) / known
    own = np.minimum(weight / known[:, np.newaxis], 1.0 - _LEAST_REST)
    scatter = (((product - gradient[:, np.newaxis] * part) / (1.0 - own)) ** 2).sum(axis=1)
    shift = np.zeros(altitude.size)
    if beams.dead_time_change is not None:
        expected = np.exp(beams.logarithm - residual)
        change = np.where(lever != 0.0, beams.dead_time_change / expected, 0.0)
        shift = _sums_nearby(lever * change, altitude).sum(axis=1)
    squares = (own**2).sum(axis=1)
    # Beams with little weight do not tell the scatter of those that decide.
    freedom = 1.0 / np.where(squares > 0.0, squares, np.inf) - _UNKNOWNS
    tested = freedom >= 1.0
    error = np.where(tested, np.sqrt(scatter) / known, np.inf)
    chance = 0.5 * THRESHOLDS.gradient_false_alarm / max(int(np.count_nonzero(tested)), 1)
    limit = stdtrit(np.maximum(freedom, 1.0), 1.0 - chance)
    explained = THRESHOLDS.gradient_dead_time * np.abs(shift) / known
    size = np.abs(gradient)
    return float(np.max(size, where=size - explained > limit * error, initial=0.0))


def _sums_nearby(values: Array, altitude: Array) -> Array:
    """Return sums over the altitudes around each, (altitude, profile times angle)."""
    inside = np.abs(altitude[:, np.newaxis] - altitude) <= 0.5 * THRESHOLDS.gradient_window
    return np.asarray(inside @ values.reshape(-1, altitude.size).T)


def _along_axes(distances: Array) -> list[Array]:
    """Return horizontal distances along the axes of a scan, each (angle, altitude).

    Beams of one vertical plane have one axis.

    Parameters
    ----------
    distances : (2, angle, altitude) float
        To the east and north.
    """
    lengths, axes = np.linalg.eigh(np.einsum("iak,jak->ij", distances, distances))
    return [
        np.tensordot(axis, distances, axes=1)
        for length, axis in zip(lengths, axes.T, strict=True)
        if length > _DEPENDENT * lengths[-1]
    ]


def orthogonal_columns(
    weights: Array, columns: Iterable[Array], before: Sequence[tuple[Array, Array]] = ()
) -> list[tuple[Array, Array]]:
    """Return columns orthogonal to those before them, and their squared lengths.

    Parameters
    ----------
    weights : (profile, angle, altitude) float
    columns : iterable of (angle, altitude) or (altitude,) float
    before : sequence of (Array, Array)
        Columns returned earlier.

    Returns
    -------
    list of (profile, angle, altitude) float, (profile, 1, altitude) float
        Those before and the new ones. The squared length is infinite where a column depends on
        those before it.
    """
    basis = list(before)
    for column in columns:
        left = np.broadcast_to(column, weights.shape)
        weighted = weights * left
        least = _DEPENDENT * sum_over_beams(weighted, left)
        for other, square in basis:
            left = left - sum_over_beams(weighted, other) / square * other
        square = sum_over_beams(weights * left, left)
        basis.append((left, np.where(square > least, square, np.inf)))
    return basis


def sum_over_beams(first: Array, second: Array) -> Array:
    """Return the sums over beams of products, (profile, 1, altitude)."""
    return np.asarray(np.einsum("tak,tak->tk", first, second))[:, np.newaxis]
