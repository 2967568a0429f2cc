"""Whether a fit of a homogeneous path can be believed: noise level, misfit, quality bits.

Every test on residuals has a false-alarm rate of `FALSE_ALARM` at any number of bins. Where the
variance of the noise is not known, it is estimated from second differences of the residuals,
which smooth misfit hardly touches, and the tests allow for the scatter of that estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import _estimate
from lidarops.retrieve.homogeneous._estimate import PathEstimate

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

FALSE_ALARM: Final = 4e-4
"""Rate at which one test flags a profile that is as it should be."""
LOWEST_SIGNAL: Final = 5.0
"""Amplitude over its standard error at known extinction."""
LARGEST_RELATIVE_ERROR: Final = 0.15
"""Standard error of extinction over extinction plus 1 / mean range."""
OUTLIER: Final = 5.0
"""Least deviation, in standard deviations of the noise, that makes an outlier."""
FEWEST_BINS: Final = 8
FEWEST_BENDS: Final = 5
"""Second differences below which the noise is taken from the residuals themselves."""

FAR: Final = 4.0
"""Standard errors beyond which a value must not lie more often than with a known variance."""
_BEND_DOF: Final = 18.0 / 35.0
"""Degrees of freedom per second difference: 2 / (2 sum of their squared correlations)."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Noise variance (of unit weight), reduced chi-square and quality of a batch."""

    noise: Array
    widening: Array
    """Of standard errors that rest on `noise`: 1 where the variance is known."""
    reduced_chi2: Array
    quality: Flags


@dataclass(frozen=True, slots=True)
class _Limits:
    """Beyond which values the tests fail."""

    least_misfit: Array
    """Of the reduced chi-square."""
    most_misfit: Array
    trend: Array
    outlier: Array
    widening: Array


class CommonLimits(NamedTuple):
    """Beyond which values the tests fail, for profiles that share their number of bins."""

    lowest_signal: float
    largest_relative_error: float
    least_misfit: float
    most_misfit: float
    curvature: float
    square: float
    """Of the residuals along the square of the shape, in standard deviations."""
    outlier: float
    widening: float
    """Of standard errors, which is no limit but depends on the same counts."""


def common_limits(bins: int, shapes: int, *, known_variance: bool) -> CommonLimits:
    """Return the limits for profiles of `bins` bins without gaps.

    Parameters
    ----------
    bins : int
    shapes : int
        Degrees of freedom of the curvature misfit.
    known_variance : bool
    """
    of_kind = _known_limits if known_variance else _estimated_limits
    one, bends, other = (np.array([float(count)]) for count in (bins, bins - 2, shapes))
    tests = (float(limit[0]) for limit in of_kind(one, bends, other, 3))
    least, most, _, outlier, widening = tests
    curvature, square = _shape_limits(bins, shapes, known_variance=known_variance)
    return CommonLimits(
        LOWEST_SIGNAL, LARGEST_RELATIVE_ERROR, least, most, curvature, square, outlier, widening
    )


def _shape_limits(bins: int, shapes: int, *, known_variance: bool) -> tuple[float, float]:
    """Return the limits of two tests for shapes, which share the rate of one."""
    rate = 0.5 * FALSE_ALARM
    if known_variance:
        return float(special.chdtri(shapes, rate)), -float(special.ndtri(0.5 * rate))
    dof = _BEND_DOF * (bins - 2)
    energy = shapes * special.fdtri(shapes, dof, 1.0 - rate)
    return float(energy), -float(special.stdtrit(dof, 0.5 * rate))


def judge_fit(fit: PathEstimate, *, known_variance: bool, unknowns: int = 3) -> Verdict:
    """Judge a batch of fits.

    Parameters
    ----------
    fit : Estimate
    known_variance : bool
        Whether the weights were inverse variances.
    unknowns : int
        Parameters that were fitted.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        noise = np.ones_like(fit.status) if known_variance else _estimated_noise(fit, unknowns)
        reduced = fit.misfit / _residual_dof(fit.bins, unknowns) / noise
        limits = _limits(fit, unknowns, known_variance=known_variance)
        tests = (
            (Quality.LOW_SIGNAL, fit.signal_energy / noise > LOWEST_SIGNAL**2),
            (Quality.POORLY_DETERMINED, _determined(fit, noise, limits.widening)),
            (Quality.NEGATIVE_AMPLITUDE, fit.amplitude > 0),
            (Quality.AT_BOUND, fit.bounded == 0),
            (Quality.POOR_FIT, reduced >= limits.least_misfit),
            (Quality.POOR_FIT, reduced <= limits.most_misfit),
            (Quality.NOT_HOMOGENEOUS, fit.trend / noise <= limits.trend),
            (Quality.OUTLIER, fit.largest / np.sqrt(noise) <= limits.outlier),
        )
        # Passed, not failed, is asked for: what compares with NaN does not pass.
        quality = np.zeros(fit.status.shape, dtype=np.int32)
        fitted = fit.status == _estimate.FITTED
        for bit, passed in tests:
            quality[fitted & ~passed] |= np.int32(bit)
    quality[fit.status == _estimate.CONSTANT] |= np.int32(Quality.NO_SIGNAL)
    quality[fit.status == _estimate.EMPTY] |= np.int32(Quality.INPUT_MISSING)
    quality[(fit.bins > 0) & (fit.bins < FEWEST_BINS)] |= np.int32(Quality.TOO_FEW_BINS)
    return Verdict(noise, limits.widening, reduced, quality)


def _residual_dof(bins: Array, unknowns: int) -> Array:
    return np.maximum(bins - unknowns, 1.0)


def _estimated_noise(fit: PathEstimate, unknowns: int) -> Array:
    from_bends = fit.bends / (6.0 * fit.bend_count)
    from_residuals = fit.misfit / _residual_dof(fit.bins, unknowns)
    variance = np.where(fit.bend_count >= FEWEST_BENDS, from_bends, from_residuals)
    return np.maximum(variance, fit.rounding)


def _determined(fit: PathEstimate, noise: Array, widening: Array) -> npt.NDArray[np.bool_]:
    error = np.sqrt(fit.extinction_variance * noise) * widening
    scale = fit.extinction + 1.0 / fit.mean_range
    finite = np.isfinite(fit.amplitude * np.sqrt(fit.amplitude_relative_variance * noise))
    determined: npt.NDArray[np.bool_] = finite & (error < LARGEST_RELATIVE_ERROR * scale)
    return determined


def _limits(fit: PathEstimate, unknowns: int, *, known_variance: bool) -> _Limits:
    counts = [np.nan_to_num(count) for count in (fit.bins, fit.bend_count, fit.trend_count)]
    # Limits depend on counts alone, which most profiles share: evaluate each kind once.
    key = np.zeros(fit.status.shape, dtype=np.int64)
    for count in counts:
        key = (key << 20) + count.astype(np.int64)
    _, sample, kind = np.unique(key, return_index=True, return_inverse=True)
    of_kinds = _known_limits if known_variance else _estimated_limits
    bins, bends, shapes = (count[sample] for count in counts)
    limits = of_kinds(bins, bends, shapes, unknowns)
    return _Limits(*(limit[kind] for limit in limits))


def _known_limits(bins: Array, _: Array, shapes: Array, unknowns: int) -> tuple[Array, ...]:
    dof = _residual_dof(bins, unknowns)
    return (
        special.chdtri(dof, 1.0 - 0.5 * FALSE_ALARM) / dof,
        special.chdtri(dof, 0.5 * FALSE_ALARM) / dof,
        np.where(shapes > 0, special.chdtri(shapes, FALSE_ALARM), np.inf),
        np.maximum(OUTLIER, -special.ndtri(0.5 * FALSE_ALARM / np.maximum(bins, 1.0))),
        np.ones_like(bins),
    )


def _estimated_limits(bins: Array, bends: Array, shapes: Array, unknowns: int) -> tuple[Array, ...]:
    independent = bends >= FEWEST_BENDS
    dof = np.where(independent, _BEND_DOF * bends, _residual_dof(bins, unknowns))
    # The ratio of two estimates of one variance from the same residuals: the logarithm of its
    # quantile, 4.611 = 3.353 sqrt(17 / 9), with a term for short sections fitted to simulations.
    neighbours = bends + 2.0
    ratio = np.exp(4.611 / np.sqrt(neighbours) + 7.3 / neighbours)
    return (
        np.zeros_like(bins),
        np.where(independent, ratio, np.inf),
        np.where(shapes > 0, shapes * special.fdtri(shapes, dof, 1.0 - FALSE_ALARM), np.inf),
        np.maximum(OUTLIER, -special.stdtrit(dof, 0.5 * FALSE_ALARM / np.maximum(bins, 1.0))),
        # An error over its estimate follows Student's distribution.
        -special.stdtrit(dof, special.ndtr(-FAR)) / FAR,
    )
