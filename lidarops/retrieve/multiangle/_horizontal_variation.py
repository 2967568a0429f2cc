"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import polygamma, stdtrit

from lidarops.retrieve.common.arrays import Array, Booleans, Indices, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
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
_SUMS: Final = 5
"""Number of the sums of `_gradient_sums`."""
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
    value, freedom = [], []
    for third in thirds:
        used = fit.column(kh.FREEDOM)[:, third]
        filled = np.count_nonzero(used, axis=1)
        # With fewer altitudes the mean would not represent the third.
        on = 2 * filled >= third.size
        # The root gives white noise variance 1, however many altitudes are missing.
        root = np.sqrt(np.maximum(filled, 1))
        size = fit.residual[..., third] / np.sqrt(clear.noise[..., third] + scatter[third])
        mean = np.nansum(np.clip(size, -_CLIPPED, _CLIPPED), axis=2) / root[:, np.newaxis]
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


@compiled
def _levers(
    noise: Array, tested: Booleans, inhomogeneity: Array, limit: float, design: Array,
    altitude: Array, lever: Array, arm: Array,
) -> None:  # fmt: skip
    """Fill what a residual adds to a gradient, and what a gradient adds to a residual.

    Both are (angle, altitude); 0 where the noise exceeds the limit, or constant and path explain
    the distance. `design`, (2, angle, altitude), are distance and path.
    """
    angles, altitudes = noise.shape
    sums, least = np.zeros((6, altitudes)), np.zeros(altitudes)
    for a in range(angles):
        for k in range(altitudes):
            clear = tested[k] and noise[a, k] < limit
            w = 1.0 / (noise[a, k] + inhomogeneity[k]) if clear else 0.0
            lever[a, k] = w
            sums[0, k] += w
            sums[1, k] += w * design[0, a, k]
            sums[2, k] += w * design[1, a, k]
            least[k] += w * design[0, a, k] * design[0, a, k]
    for k in range(altitudes):
        sums[1, k] /= sums[0, k]
        sums[2, k] /= sums[0, k]
    for a in range(angles):
        for k in range(altitudes):
            distance, path = design[0, a, k] - sums[1, k], design[1, a, k] - sums[2, k]
            sums[3, k] += lever[a, k] * path * path
            sums[4, k] += lever[a, k] * path * distance
            sums[5, k] += lever[a, k] * distance * distance
    for k in range(altitudes):
        slope = sums[4, k] / sums[3, k]
        left = sums[5, k] - slope * sums[4, k]
        sums[4, k], sums[5, k] = slope, 1.0 if left > _DEPENDENT * least[k] else 0.0
    for a in range(angles):
        for k in range(altitudes):
            distance, path = design[0, a, k] - sums[1, k], design[1, a, k] - sums[2, k]
            own = altitude[k] * (distance - sums[4, k] * path)
            arm[a, k] = own if sums[5, k] > 0.0 else 0.0
            lever[a, k] *= arm[a, k]


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
    if not beams.noise.size:
        return 0.0
    # Empty blocks at both ends make windows of half the length there: near ranges are distorted.
    block = 1 + (2.0 * (altitude - altitude[0]) / THRESHOLDS.gradient_window).astype(np.int64)
    # Where none is fitted.
    sloped = (fit.column(kh.SLOPES) != 0.0) | (fit.column(kh.SLOPES + 1) != 0.0)
    tested = sloped & (fit.column(kh.FREEDOM) > 0.0)
    change = np.empty((0, *beams.noise.shape[1:]))
    if beams.dead_time_change is not None:
        expected = np.exp(beams.logarithm - np.nan_to_num(fit.residual))
        change = beams.dead_time_change / expected
    square = 0.0
    for distance in beams.axes:
        sums = np.zeros((_SUMS, *beams.noise.shape[:2], int(block[-1]) + 2))
        _gradient_sums(
            fit.residual, fit.leverage, beams.noise, tested, fit.inhomogeneity,
            np.stack([distance, beams.path]), altitude, block, change, sums,
        )  # fmt: skip
        # Windows of two blocks each, every half a window.
        windows = sums[..., :-1] + sums[..., 1:]
        windows = np.moveaxis(windows, -1, 1).reshape(_SUMS, block[-1] + 1, -1)
        square += _gradient_beyond_chance(windows) ** 2
    return float(np.sqrt(square))


@compiled
def _gradient_sums(
    residual: Array, leverage: Array, noise: Array, tested: Booleans, inhomogeneity: Array,
    design: Array, altitude: Array, block: Integers, change: Array, sums: Array,
) -> None:  # fmt: skip
    """Add what the beams of each profile show of a gradient along an axis, in blocks of altitudes.

    `design`, (2, angle, altitude), are the distances along the axis over altitude, and the path;
    `change`, (profile or 0, angle, altitude), that of the logarithm with one standard error of the
    dead time. `sums`, (5, profile, angle, block), are those of lever times residual and arm; of
    both with the lever over what a fit leaves of an error, because beams of large leverage keep
    less; and of lever times change.
    """
    lever, arm = np.empty(noise.shape[1:]), np.empty(noise.shape[1:])
    for t in range(noise.shape[0]):
        _levers(
            noise[t], tested[t], inhomogeneity, THRESHOLDS.gradient_noise, design, altitude,
            lever, arm,
        )  # fmt: skip
        for a in range(noise.shape[1]):
            for k in range(altitude.size):
                if lever[a, k] != 0.0:
                    b, own, r = block[k], lever[a, k], residual[t, a, k]
                    whole = own / math.sqrt(max(1.0 - leverage[t, a, k], _LEAST_REST))
                    sums[0, t, a, b] += own * r
                    sums[1, t, a, b] += own * arm[a, k]
                    sums[2, t, a, b] += whole * r
                    sums[3, t, a, b] += whole * arm[a, k]
                    if change.shape[0] > 0:
                        sums[4, t, a, b] += own * change[t, a, k]


def _gradient_beyond_chance(sums: Array) -> float:
    """Return the largest gradient along an axis that is beyond chance and the dead time, m-1.

    The error by chance follows from the scatter of the beams of all profiles about the gradient,
    whose altitudes may be correlated. An error of the dead time is common to all beams. `sums`,
    (5, window, profile times angle), are those of `_gradient_sums`.
    """
    total, weight, product, part, shift = sums
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
    chance = 0.5 * COMMON.false_alarm / max(int(np.count_nonzero(tested)), 1)
    limit = stdtrit(np.maximum(freedom, 1.0), 1.0 - chance)
    size = np.abs(gradient)
    explained = np.abs(shift.sum(axis=1)) / known
    return float(np.max(size, where=size - explained > limit * error, initial=0.0))
