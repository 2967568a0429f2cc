"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import polygamma, stdtrit

from lidarops.retrieve.common.arrays import Array, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression, refit
from lidarops.retrieve.multiangle.altitude_correlation import windowed
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNKNOWNS: Final = 3
"""Constant, optical depth and a gradient."""
_LEAST_REST: Final = 1e-3
"""Least share of an error that a fit leaves in a residual."""
_DEPENDENT: Final = 1e-8
"""Squared length of a column outside those before it, over its own, up to which it depends on
them."""
_CLIPPED: Final = 3.0
"""Standard errors to which residuals are clipped in the test of growth."""
_FEWEST_PROFILES: Final = 4
"""Profiles below which growth is not tested over profiles."""
_FEWEST_ALTITUDES: Final = 6
"""Altitudes below which growth is not tested."""
_THIRDS: Final = 3


def path_variation_from(beams: BeamBlock, fit: Regression) -> int | None:
    """Return the lowest altitude affected by extinction that varies along paths; None if none is.

    Formula 9 of ``docs/algorithms/multiangle.md``. If the deviations from the mean over profiles
    grow, all altitudes are affected. Growth common to all profiles of a block may also be an
    instrumental error that increases with range, such as of the background; it affects altitudes
    above the lower third.
    """
    tested = np.flatnonzero((fit.column(kh.FREEDOM) > 0).any(axis=0))
    if tested.size < _FEWEST_ALTITUDES:
        return None
    third = tested.size // _THIRDS
    value, freedom = _beam_means(beams, fit.inhomogeneity, tested[:third], tested[-third:])
    known = (freedom > 0.0).all(axis=0)
    value, freedom = value[:, known], freedom[:, known]
    if not _grows(value, freedom):
        return None
    profiles = np.count_nonzero(known)
    seen = value != 0.0
    mean = value.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    away = np.where(seen, value - mean, 0.0)
    own = profiles < _FEWEST_PROFILES or _grows(away, (1.0 - 1.0 / profiles) * freedom)
    return 0 if own else int(tested[third - 1]) + 1


def _grows(value: Array, freedom: Array) -> bool:
    """Return whether means of the upper third scatter more than those of the lower one."""
    squares, total = (value**2).sum(axis=(1, 2)), freedom.sum(axis=1)
    if min(squares.min(), total.min()) <= 0.0:
        return False
    # White noise has variance 1. A smaller one comes from an overestimated inhomogeneity, and
    # growth from there to 1 is that of detector noise.
    growth = squares[1] / total[1] / max(squares[0] / total[0], 1.0)
    spread = math.sqrt(polygamma(1, 0.5 * total).sum())
    return bool(
        growth > THRESHOLDS.growth and math.log(growth) > THRESHOLDS.growth_certainty * spread
    )


def _beam_means(beams: BeamBlock, inhomogeneity: Array, *thirds: Indices) -> tuple[Array, Array]:
    """Return means of beams over thirds of the altitudes, (third, profile, beam), and freedoms.

    Of what the fit with gradients leaves of samples with less noise than the inhomogeneity of the
    lower third, scaled to variance 1 for white noise. Degrees of freedom are (third, profile).
    """
    scatter = np.full(inhomogeneity.size, inhomogeneity[thirds[0]].mean())
    some = beams.typical()
    clear = replace(some, noise=np.where(some.noise < scatter, some.noise, np.inf), sides=True)
    fit = refit(clear, scatter, np.zeros_like(scatter), np.inf)
    size = np.nan_to_num(fit.residual) / np.sqrt(clear.noise + scatter)
    size = np.clip(size, -_CLIPPED, _CLIPPED)
    value, freedom = [], []
    for third in thirds:
        used = fit.column(kh.FREEDOM)[:, third]
        filled = np.count_nonzero(used, axis=1)
        # With fewer altitudes the mean would not represent the third.
        on = 2 * filled >= third.size
        # The root gives white noise variance 1, however many altitudes are missing.
        root = np.sqrt(np.maximum(filled, 1))
        mean = size[..., third].sum(axis=2) / root[:, np.newaxis]
        value.append(np.where(on[:, np.newaxis], mean, 0.0))
        freedom.append(np.where(on, used.sum(axis=1) / np.maximum(filled, 1), 0.0))
    return np.stack(value), np.stack(freedom)


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

    It is the largest that is shown in any window of 1000 m of the block, or of 500 m at its ends,
    by all profiles, beyond what an error of the dead time explains; 0 if none is shown. It holds at
    all altitudes: an optical depth is that of the air below, too.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    altitude : (altitude,) float
        m.
    """
    # Where none is fitted.
    tested = (fit.table[:, kh.SLOPES :] != 0.0).any(axis=1) & (fit.column(kh.FREEDOM) > 0.0)
    clear = tested[:, np.newaxis] & (beams.noise < THRESHOLDS.gradient_noise)
    if not clear.any():
        return 0.0
    weight = np.where(clear, 1.0 / (beams.noise + fit.inhomogeneity), 0.0)
    residual = np.nan_to_num(fit.residual)
    change = np.zeros(1)
    if beams.dead_time_change is not None:
        change = beams.dead_time_change / np.exp(beams.logarithm - residual)
    # Beams of large leverage keep less of an error.
    whole = 1.0 / np.sqrt(np.maximum(1.0 - fit.leverage, _LEAST_REST))
    # Windows of two blocks each, every half a window; near ranges, at one end, are distorted.
    block = (2.0 * (altitude - altitude[0]) / THRESHOLDS.gradient_window).astype(np.int64)
    first = np.arange(-1, block[-1] + 1)
    inside = (block[:, np.newaxis] == first) | (block[:, np.newaxis] == first + 1)
    square = 0.0
    for distance in beams.axes:
        arm = altitude * _beside_path(weight, distance, beams.path)
        lever = weight * arm
        of_beams = [
            np.einsum("tak,kw->wta", lever * part, 1.0 * inside).reshape(first.size, -1)
            for part in (residual, arm, whole * residual, whole * arm, change)
        ]
        square += _gradient_beyond_chance(*of_beams) ** 2
    return float(np.sqrt(square))


def _beside_path(weight: Array, distance: Array, path: Array) -> Array:
    """Return the part of distances that no constant and path explain, 0 where they explain all.

    Parameters
    ----------
    weight : (profile, angle, altitude) float
    distance, path : (angle, altitude) float

    Returns
    -------
    (profile, angle, altitude) float
    """
    total = np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    aside, along = (
        values - (weight * values).sum(axis=1, keepdims=True) / total for values in (distance, path)
    )
    squares = (weight * along**2).sum(axis=1, keepdims=True)
    slope = (weight * along * aside).sum(axis=1, keepdims=True)
    left = aside - slope / np.where(squares > 0.0, squares, np.inf) * along
    least = _DEPENDENT * (weight * distance**2).sum(axis=1, keepdims=True)
    return np.where((weight * left**2).sum(axis=1, keepdims=True) > least, left, 0.0)


def _gradient_beyond_chance(
    total: Array, weight: Array, product: Array, part: Array, shift: Array
) -> float:
    """Return the largest gradient along an axis that is beyond chance and the dead time, m-1.

    The error by chance follows from the scatter of the beams of all profiles about the gradient,
    whose altitudes may be correlated. An error of the dead time is common to all beams.

    Parameters
    ----------
    total, weight, product, part, shift : (window, profile times angle) float
        Sums over altitudes of the lever of a sample times its residual, and times its arm; of both
        over what the fit leaves of an error; and of the lever times the change by the dead time.
    """
    information = weight.sum(axis=1)
    known = np.where(information > 0.0, information, np.inf)
    gradient = total.sum(axis=1) / known
    own = np.minimum(weight / known[:, np.newaxis], 1.0 - _LEAST_REST)
    scatter = (((product - gradient[:, np.newaxis] * part) / (1.0 - own)) ** 2).sum(axis=1)
    squares = (own**2).sum(axis=1)
    # Beams with little weight do not tell the scatter of those that decide.
    freedom = 1.0 / np.where(squares > 0.0, squares, np.inf) - _UNKNOWNS
    tested = freedom >= 1.0
    error = np.where(tested, np.sqrt(scatter) / known, np.inf)
    chance = 0.5 * THRESHOLDS.gradient_false_alarm / max(int(np.count_nonzero(tested)), 1)
    limit = stdtrit(np.maximum(freedom, 1.0), 1.0 - chance)
    size = np.abs(gradient)
    explained = np.abs(shift.sum(axis=1)) / known
    return float(np.max(size, where=size - explained > limit * error, initial=0.0))
