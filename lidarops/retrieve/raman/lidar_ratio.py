"""Lidar ratio of one profile, with the covariance of extinction and backscatter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.backscatter import Backscatter, inverse_of_weak
from lidarops.retrieve.raman.depth_fit import Extinction, root_of_squares
from lidarops.retrieve.raman.errors import RANDOM, Cause, Quotient
from lidarops.retrieve.raman.thresholds import THRESHOLDS

_MOST_UNKNOWN: Final = 0.05
"""Weight of cells without backscatter in the lidar ratio of a cell."""
_NODES: Final = np.linspace(-6.0, 6.0, 49)
"""Standard deviations at which chances of lidar ratios are compared."""


def lidar_ratio_of(
    extinction: Extinction,
    calibrated: Backscatter,
    value: Array,
    noise: Array,
    causes: Sequence[Cause],
    usable: Booleans,
) -> Quotient:
    r"""Return the lidar ratio, from equally smoothed extinction and backscatter.

    Its change is :math:`\delta S = (\delta\alpha - S\,\delta b) / b`, of noise and of each cause.
    The error is not that at the value, which noise that makes the value small makes small as well:
    see `_chances`.

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
        of_both = np.einsum("ij,ij->i", extinction.noise, of_noise)
        random = np.stack([extinction.noise_error**2, of_both, error**2])
        systematic = np.zeros(value.size)
        for cause in causes:
            change = weights @ cause.backscatter[known]
            if cause.name in RANDOM:
                both = np.stack([cause.extinction, change])
                random += both[[0, 0, 1]] * both[[0, 1, 1]]
            else:
                systematic += (cause.extinction - ratio * change) ** 2
        systematic *= inverse**2
        true, chance = _chances(extinction.value, smooth, random)
        # The expected deviation from the value, in place of an error of the first order.
        scatter = (chance * (true - ratio) ** 2).sum(axis=0)
        likely = _likely(extinction, smooth, error, complete & usable)
        # The error is in proportion to total backscatter: this is that of the likely one.
        least = THRESHOLDS.least_ratio_certainty * error * (1.0 + (likely - smooth) / total)
    certain = complete & (smooth > 0.0) & (likely > least)
    parts = (ratio, np.sqrt(scatter), np.sqrt(systematic))
    return Quotient(*(np.where(certain, part, np.nan) for part in parts))


def _chances(extinction: Array, backscatter: Array, random: Array) -> tuple[Array, Array]:
    r"""Return lidar ratios that may be true, (node, cell), and the chance of each.

    For a true lidar ratio :math:`S`, the noise of :math:`\alpha - S b` is normal, with a variance
    :math:`v(S)` (`fieller1954`). That is the likelihood of :math:`S` with the extinction that is
    most likely for it. Beforehand, lidar ratios are distributed log-normally about the typical one
    :math:`S_0`:

    .. math:: p(S) \propto \exp\left(
        -\frac{(\alpha - S b)^2}{2 v} - \frac{\ln^2 (S / S_0)}{2 s^2}\right)

    per :math:`\mathrm{d} \ln S`.

    Parameters
    ----------
    extinction, backscatter : (cell,) float
        Equally smoothed.
    random : (3, cell) float
        Variance of extinction, covariance, and variance of backscatter.
    """

    def variance(ratio: Array) -> Array:
        return np.asarray(random[0] - 2.0 * ratio * random[1] + ratio**2 * random[2])

    middle, spread = np.log(THRESHOLDS.typical_lidar_ratio), THRESHOLDS.lidar_ratio_spread
    # Nodes around the mean of both logarithms, weighted by errors of the first order.
    value = np.maximum(extinction / backscatter, np.finfo(float).tiny)
    known = 1.0 / (1.0 + variance(value) / (spread * value * backscatter) ** 2)
    centre = middle + known * (np.log(value) - middle)
    logarithm = centre + spread * np.sqrt(1.0 - known) * _NODES[:, np.newaxis]
    ratio = np.exp(logarithm)
    score = (extinction - ratio * backscatter) ** 2 / variance(ratio)
    score += ((logarithm - middle) / spread) ** 2
    chance = np.exp(-0.5 * (score - score.min(axis=0)))
    return ratio, chance / chance.sum(axis=0)


def _likely(extinction: Extinction, backscatter: Array, error: Array, known: Booleans) -> Array:
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
