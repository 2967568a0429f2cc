"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import polygamma, stdtrit

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression, windowed
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
_SUMS: Final = 5
"""Number of the sums of `_gradient_sums`."""


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
    label = np.full(fit.inhomogeneity.size, -1)
    label[tested[:third]], label[tested[-third:]] = 0, 1
    low = float(np.mean(fit.inhomogeneity[label == 0]))
    lower, upper = _beam_means(beams, fit, label, low)
    known = (lower.freedom > 0) & (upper.freedom > 0)
    lower, upper = lower.select(known), upper.select(known)
    if not _grows(lower, upper):
        return None
    if np.count_nonzero(known) < _FEWEST_PROFILES:
        return 0
    return 0 if _grows(lower.deviations(), upper.deviations()) else int(tested[third - 1]) + 1


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


@compiled
def _levers(
    noise: Array, tested: Booleans, inhomogeneity: Array, limit: float, design: Array,
    altitude: Array, lever: Array, arm: Array,
) -> None:  # fmt: skip
    """Fill what a residual adds to a gradient, and what a gradient adds to a residual.

    Parameters
    ----------
    noise : (angle, altitude) float
    tested : (altitude,) bool
    inhomogeneity, altitude : (altitude,) float
    limit : float
        Noise from which a sample is left out.
    design : (2, angle, altitude) float
        Distance and path.
    lever, arm : (angle, altitude) float
        Outputs; 0 where the sample is too noisy, or constant and path explain the distance.
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


@compiled
def _subtract_line(noise: Array, limit: float, path: Array, left: Array) -> None:
    """Subtract the line over the path through samples with less noise than a limit.

    The weights are those of noise and an inhomogeneity of that limit; arrays are (angle, altitude).
    """
    angles, altitudes = left.shape
    weight, sums = np.empty((angles, altitudes)), np.zeros((5, altitudes))
    for a in range(angles):
        for k in range(altitudes):
            w = 1.0 / (noise[a, k] + limit) if noise[a, k] < limit else 0.0
            weight[a, k] = w
            sums[0, k] += w
            sums[1, k] += w * path[a, k]
            sums[2, k] += w * left[a, k]
    # Altitudes without such a sample become NaN, and are not used.
    sums[1] /= sums[0]
    sums[2] /= sums[0]
    for a in range(angles):
        for k in range(altitudes):
            arm = weight[a, k] * (path[a, k] - sums[1, k])
            sums[3, k] += arm * (path[a, k] - sums[1, k])
            sums[4, k] += arm * left[a, k]
    for k in range(altitudes):
        slope = sums[4, k] / sums[3, k] if sums[3, k] > 0.0 else 0.0
        for a in range(angles):
            left[a, k] -= sums[2, k] + slope * (path[a, k] - sums[1, k])


@compiled
def _sums_of_thirds(
    logarithm: Array, noise: Array, tested: Booleans, inhomogeneity: Array, design: Array,
    label: Integers, sums: Array, count: Integers,
) -> None:  # fmt: skip
    """Add scaled residuals of samples with less noise than inhomogeneity, and count them.

    They are left by a constant, the path and a gradient along each axis at each altitude.

    Parameters
    ----------
    logarithm, noise : (profile, angle, altitude) float
    tested : (profile, altitude) bool
    inhomogeneity : (altitude,) float
        The same at all.
    design : (1 + axis, angle, altitude) float
        Slant path, and horizontal distance along each axis over altitude.
    label : (altitude,) int
        Third: 0 or 1; other altitudes are not tested.
    sums, count : (2, profile, angle) float, (2, profile, altitude) int
        Outputs.
    """
    limit, path = inhomogeneity[0], design[0]
    both = np.stack((path, path))
    left, lever, arm = np.empty_like(path), np.empty_like(path), np.empty_like(path)
    over, under, ones = np.empty(label.size), np.empty(label.size), np.ones(label.size)
    for t in range(noise.shape[0]):
        left[:] = logarithm[t]
        _subtract_line(noise[t], limit, path, left)
        for axis in range(1, design.shape[0]):
            both[0] = design[axis]
            _levers(noise[t], tested[t], inhomogeneity, limit, both, ones, lever, arm)
            over[:], under[:] = 0.0, 0.0
            for a in range(path.shape[0]):
                for k in range(label.size):
                    over[k] += lever[a, k] * left[a, k] if lever[a, k] != 0.0 else 0.0
                    under[k] += lever[a, k] * arm[a, k]
            for a in range(path.shape[0]):
                for k in range(label.size):
                    left[a, k] -= over[k] / under[k] * arm[a, k] if under[k] > 0.0 else 0.0
        for a in range(path.shape[0]):
            for k in range(label.size):
                if tested[t, k] and noise[t, a, k] < limit:
                    size = left[a, k] / math.sqrt(noise[t, a, k] + limit)
                    sums[label[k], t, a] += min(max(size, -_CLIPPED), _CLIPPED)
                    count[label[k], t, k] += 1


def _beam_means(
    beams: BeamBlock, fit: Regression, label: Integers, inhomogeneity: float
) -> tuple[_Means, _Means]:
    """Average each beam of each profile over the lower and the upper third."""
    profiles, angles, altitudes = beams.noise.shape
    sums, count = np.zeros((2, profiles, angles)), np.zeros((2, profiles, altitudes), np.int64)
    axes = _along_axes(beams.design[:2])
    tested = (fit.column(kh.FREEDOM) > 0.0) & (label >= 0)
    _sums_of_thirds(
        beams.logarithm, beams.noise, tested, np.full(altitudes, inhomogeneity),
        np.stack([beams.path, *axes]), label, sums, count,
    )  # fmt: skip
    means = []
    for third in range(2):
        used = np.maximum(count[third] - 2 - len(axes), 0)
        filled = np.count_nonzero(used, axis=1)
        # With fewer altitudes the mean would not represent the third.
        on = 2 * filled >= np.count_nonzero(label == third)
        # The root gives white noise variance 1, however many altitudes are missing.
        mean = sums[third] / np.sqrt(np.maximum(filled, 1))[:, np.newaxis]
        freedom = used.sum(axis=1) / np.maximum(filled, 1)
        means.append(_Means(np.where(on[:, np.newaxis], mean, 0.0), np.where(on, freedom, 0.0)))
    return means[0], means[1]


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
    if not beams.noise.size:
        return 0.0
    # Empty blocks at both ends make windows of half the length there: near ranges are distorted.
    block = 1 + (2.0 * (altitude - altitude[0]) / THRESHOLDS.gradient_window).astype(np.int64)
    tested = (fit.column(kh.SIDES) == 0.0) & (fit.column(kh.FREEDOM) > 0.0)
    change = np.empty((0, *beams.noise.shape[1:]))
    if beams.dead_time_change is not None:
        expected = np.exp(beams.logarithm - np.nan_to_num(fit.residual))
        change = beams.dead_time_change / expected
    square = 0.0
    for distance in _along_axes(beams.design[:2]):
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

    Parameters
    ----------
    residual, leverage, noise : (profile, angle, altitude) float
    tested : (profile, altitude) bool
    inhomogeneity, altitude : (altitude,) float
    design : (2, angle, altitude) float
        Horizontal distance along the axis over altitude, and slant path.
    block : (altitude,) int
    change : (profile or 0, angle, altitude) float
        Of the logarithm, with one standard error of the dead time.
    sums : (5, profile, angle, block) float
        Output: of lever times residual and arm; of both with the lever over what a fit leaves of an
        error, because beams of large leverage keep less; and of lever times change.
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
    whose altitudes may be correlated. An error of the dead time is common to all beams.

    Parameters
    ----------
    sums : (5, window, profile times angle) float
        From `_gradient_sums`.
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
    chance = 0.5 * THRESHOLDS.gradient_false_alarm / max(int(np.count_nonzero(tested)), 1)
    limit = stdtrit(np.maximum(freedom, 1.0), 1.0 - chance)
    size = np.abs(gradient)
    explained = np.abs(shift.sum(axis=1)) / known
    return float(np.max(size, where=size - explained > limit * error, initial=0.0))


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
