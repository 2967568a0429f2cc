"""Noise of single bins and of means over bins, from the far half of each profile.

Noise of electronics passes a filter, so that neighbouring bins are correlated. Differences of
neighbouring bins then underestimate the noise of a bin, and a mean over bins has more noise than
that of independent bins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, frozen
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True)
class NoiseCorrelation:
    """Noise of each profile relative to the stated variances."""

    excess: Array
    """(profile,): variance of single bins over the stated one, at least 1."""
    correlations: Array
    """(profile, distance): correlation of bins at distances from 1; 0 from the first one that is
    within its error."""
    relative_error: Array
    """(profile,): standard error of `length` over its value; 0 where bins are independent."""
    known: Booleans
    """(profile,); elsewhere independent noise of the stated variance is assumed."""

    @property
    def length(self) -> Array:
        r"""(profile,), bins: the integral correlation length :math:`1 + 2 \sum_k r_k`.

        A mean over many bins has the variance of a bin times this length over their number. It
        includes one standard error.
        """
        sums = 1.0 + 2.0 * self.correlations.sum(axis=-1)
        return np.asarray(sums * (1.0 + self.relative_error))

    def variance_of_means(self, bins: npt.ArrayLike) -> Array:
        r"""Return the variance of means of n bins over that of independent bins, (profile, n).

        It is :math:`1 + 2 \sum_k (1 - k / n) r_k`, with one standard error.

        Parameters
        ----------
        bins : (n,)
            Numbers of bins.
        """
        distances = np.arange(1, self.correlations.shape[-1] + 1)
        counts = np.asarray(bins, dtype=np.float64)[:, np.newaxis]
        weights = np.maximum(1.0 - distances / counts, 0.0)
        sums = 1.0 + 2.0 * self.correlations @ weights.T
        return np.asarray(sums * (1.0 + self.relative_error[:, np.newaxis]))


def estimate_noise_correlation(power: Array, variance: Array) -> NoiseCorrelation:
    r"""Return how the noise of profiles differs from independent noise of the stated variance.

    The far half of a profile is cut into 8 sections, and a parabola is subtracted from each. The
    residuals give chi-square per bin and the correlations :math:`r_k` of bins at the distance
    :math:`k`; those of the profile are the medians over sections, so that a cloud in some of them
    does not count as noise. Correlations are taken up to the first one that is within
    3 of its standard errors, :math:`n^{-1/2}`; chi-square
    counts as 1 below 1 plus as many of its own.

    Parameters
    ----------
    power : (profile, range) float
        NaN where missing; sections with gaps are left out. Without half of the sections, and
        where they would have fewer than `Thresholds.noise_sample`, nothing is known.
    variance : (profile or 1, range) float
        Stated noise variance, in the square of the unit of the power.

    References
    ----------
    bartlett1946
    """
    count, bins = power.shape
    reach = THRESHOLDS.most_correlated_bins
    excess, error = np.ones(count), np.zeros(count)
    known = np.zeros(count, dtype=np.bool_)
    correlations = np.zeros((count, reach))
    size = bins // (2 * THRESHOLDS.noise_sections)
    if size >= THRESHOLDS.noise_sample:
        far = slice(bins - THRESHOLDS.noise_sections * size, bins)
        _estimate(
            frozen(power[:, far].astype(np.float64, copy=False)),
            frozen(variance[:, far].astype(np.float64, copy=False)),
            frozen(_polynomials(size)),
            COMMON.significant,
            excess,
            correlations,
            error,
            known,
        )
    return NoiseCorrelation(excess, correlations, error, known)


@cache
def _polynomials(size: int) -> Array:
    """Return orthonormal polynomials of degree 0 to 2 over a section."""
    place = np.linspace(-1.0, 1.0, size)
    return np.linalg.qr(np.stack([place**0, place, place**2], axis=-1))[0].T


@compiled
def _subtract_parabola(values: Any, basis: Array, residual: Array) -> None:
    residual[:] = values
    for j in range(basis.shape[0]):
        product = 0.0
        for i in range(residual.size):
            product += basis[j, i] * residual[i]
        for i in range(residual.size):
            residual[i] -= product * basis[j, i]


@compiled
def _product(residual: Array, distance: int) -> float:
    total = 0.0
    for i in range(residual.size - distance):
        total += residual[i] * residual[i + distance]
    return total


@compiled
def _load_sections(
    power: Array, variance: Array, basis: Array, residuals: Array, moments: Array
) -> int:
    """Write residuals, chi-square, squares and kurtosis of sections; return their number.

    Sections with gaps, or without stated noise, are left out.
    """
    size, kept = residuals.shape[1], 0
    for section in range(residuals.shape[0]):
        first = section * size
        noise = 0.0
        complete = True
        for i in range(first, first + size):
            noise += variance[i]
            complete &= abs(power[i]) < HUGE
        if not complete or not 0.0 < noise < HUGE:
            continue
        _subtract_parabola(power[first : first + size], basis, residuals[kept])
        squares = fourth = 0.0
        for i in range(size):
            square = residuals[kept, i] * residuals[kept, i]
            squares += square
            fourth += square * square
        moments[0, kept] = squares / noise * size / (size - basis.shape[0])
        moments[1, kept] = squares
        moments[2, kept] = fourth * size / (squares * squares) if squares > 0.0 else size
        kept += 1
    return kept


@compiled
def _correlate(
    residuals: Array, squares: Array, fitted: int, limit: float, correlations: Array
) -> int:
    """Write correlations up to the first insignificant one; return their number."""
    sections, size = residuals.shape
    # The fit makes correlations of independent noise negative.
    limit -= fitted / size
    of_sections = np.empty(sections)
    for distance in range(1, correlations.size + 1):
        for section in range(sections):
            product = _product(residuals[section], distance) / (1.0 - distance / size)
            of_sections[section] = product / squares[section] if squares[section] > 0.0 else 0.0
        median = np.median(of_sections)
        if median < limit:
            return distance - 1
        correlations[distance - 1] = median
    return correlations.size


@compiled
def _estimate(
    power: Array,
    variance: Array,
    basis: Array,
    significant: float,
    excess: Array,
    correlations: Array,
    error: Array,
    known: Any,
) -> None:
    """Estimate the noise of each profile.

    Parameters
    ----------
    power : (profile, bin) float64
        Of whole sections.
    variance : (profile or 1, bin) float64
    basis : (coefficient, bin of a section) float64
        Orthonormal.
    significant : float
        Standard errors.
    excess, error : (profile,) float64
        Output; 1 and 0 before.
    correlations : (profile, distance) float64
        Output; 0 before.
    known : (profile,) bool
        Output; False before.
    """
    fitted, size = basis.shape
    residuals = np.empty((power.shape[1] // size, size))
    moments = np.empty((3, residuals.shape[0]))
    for k in range(power.shape[0]):
        sections = _load_sections(
            power[k], variance[k % variance.shape[0]], basis, residuals, moments
        )
        known[k] = 2 * sections >= residuals.shape[0]
        if not known[k]:
            continue
        bins = sections * size
        found = _correlate(
            residuals[:sections],
            moments[1],
            fitted,
            significant / math.sqrt(bins),
            correlations[k],
        )
        # The parabola takes up noise of the length of a section.
        taken = fitted / size * (1.0 + 2.0 * correlations[k].sum())
        for distance in range(found):
            correlations[k, distance] = (correlations[k, distance] + taken) / (1.0 + taken)
        if found:
            error[k] = math.sqrt(2.0 * (2.0 * found + 1.0) / bins)
        chi_square = np.median(moments[0, :sections]) * (1.0 + taken - fitted / size)
        spread = math.sqrt((np.median(moments[2, :sections]) - 1.0) / bins)
        if chi_square > 1.0 + significant * spread:
            excess[k] = chi_square
