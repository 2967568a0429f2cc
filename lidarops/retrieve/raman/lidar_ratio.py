"""Lidar ratio of one profile, with the covariance of extinction and backscatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.raman.backscatter import Backscatter, inverse_of_weak
from lidarops.retrieve.raman.depth_fit import root_of_squares
from lidarops.retrieve.raman.errors import RANDOM, Cause
from lidarops.retrieve.raman.extinction import Extinction
from lidarops.retrieve.raman.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_MOST_UNKNOWN: Final = 0.05
"""Weight of cells without backscatter in the lidar ratio of a cell."""


@dataclass(frozen=True, slots=True)
class LidarRatio:
    """Lidar ratio, (cell,), sr; NaN where backscatter is too uncertain."""

    value: Array
    random: Array
    """Standard error by random causes."""
    systematic: Array
    """Standard error by all others."""


def lidar_ratio_of(
    extinction: Extinction,
    calibrated: Backscatter,
    value: Array,
    noise: Array,
    causes: Sequence[Cause],
    usable: Mask,
) -> LidarRatio:
    r"""Return the lidar ratio, from equally smoothed extinction and backscatter.

    Its change is :math:`\delta S = (\delta\alpha - S\,\delta b) / b`, of noise and of each cause.

    Parameters
    ----------
    extinction : Extinction
    calibrated : Backscatter
    value : (cell,) float
        m-1 sr-1, backscatter of particles.
    noise : (cell, noise of a cell) float
        Response of backscatter to the noise of the depth.
    causes : sequence of Cause
    usable : (cell,) bool
        Cells that help to tell the lidar ratio of the profile.

    References
    ----------
    `voinov1985` (reciprocal of a weak value).
    """
    known = np.isfinite(value)
    weights = extinction.kernel[:, known]
    complete = np.abs(extinction.kernel[:, ~known]).sum(axis=1) < _MOST_UNKNOWN
    smooth, total = weights @ value[known], weights @ calibrated.total[known]
    of_noise = weights @ noise[known]
    own = weights**2 @ calibrated.own[known] ** 2 + (calibrated.reference * total) ** 2
    error = np.sqrt(root_of_squares(of_noise) ** 2 + own)
    # The reciprocal of backscatter far below zero overflows; no value is given there.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = inverse_of_weak(smooth, error)
        ratio = extinction.value * inverse
        by_noise = extinction.noise - ratio[:, np.newaxis] * of_noise
        random = root_of_squares(by_noise) ** 2 + own * ratio**2
        systematic = np.zeros(value.size)
        for cause in causes:
            change = cause.extinction - ratio * (weights @ cause.backscatter[known])
            if cause.name in RANDOM:
                random += change**2
            else:
                systematic += change**2
        # The variance of a reciprocal to the second order.
        random *= inverse**2 * (1.0 + 8.0 * (error / smooth) ** 2)
        systematic *= inverse**2
        likely = _likely(extinction, smooth, error, complete & usable)
        # The error is in proportion to total backscatter: this is that of the likely one.
        least = THRESHOLDS.least_ratio_certainty * error * (1.0 + (likely - smooth) / total)
    certain = complete & (smooth > 0.0) & (likely > least)
    parts = (ratio, np.sqrt(random), np.sqrt(systematic))
    return LidarRatio(*(np.where(certain, part, np.nan) for part in parts))


def _likely(extinction: Extinction, backscatter: Array, error: Array, known: Mask) -> Array:
    """Return the weighted mean of backscatter and of what extinction lets expect, m-1 sr-1.

    With weights by the lidar ratio of all `known` cells together, its noise and that of the lidar
    ratio of a cell are independent, so that it selects no lidar ratios by their noise; backscatter
    alone would keep those whose backscatter is too high.
    """
    variance = extinction.noise_error**2 + extinction.resolution_error**2
    weight = np.where(known, extinction.value / variance, 0.0)
    least, most = THRESHOLDS.plausible_lidar_ratios
    total, scattered = (float(weight @ values) for values in (extinction.value, backscatter))
    together = min(max(total / scattered, least), most) if scattered > 0.0 else most
    typical = THRESHOLDS.typical_lidar_ratio
    share = error**2 / (error**2 + variance / (typical * together))
    return np.asarray(backscatter + share * (extinction.value / typical - backscatter))
