"""Variation of the air along the horizontal, from the scatter of beams and of vertical planes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import polygamma

from lidarops.retrieve.common.arrays import Array, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._block import BeamBlock, Regression, refit
from lidarops.retrieve.multiangle.altitude_correlation import windowed
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

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
    fit = refit(clear, scatter, np.zeros_like(scatter))
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
