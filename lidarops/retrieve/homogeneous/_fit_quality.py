"""Judge the fit of a homogeneous path: residuals, noise level, misfit, quality bits.

Every test of residuals has the rate `Thresholds.false_alarm` at any number of bins. Where the noise
variance is not known, it is estimated from second differences of the residuals, which smooth misfit
hardly affects; the tests allow for the scatter of that estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import special

from lidarops.flags import Quality
from lidarops.retrieve.common.arrays import Array, Flags
from lidarops.retrieve.common.compiled_code import inlined, summing
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.homogeneous._problem import (
    CONSTANT,
    EMPTY,
    FITTED,
    PathEstimate,
    PathProblem,
)
from lidarops.retrieve.homogeneous._projection import (
    Point,
    Residuals,
    Scratch,
    Sums,
    fit_linear,
    largest_energy,
)
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_SECOND_DIFFERENCE: Final = 6.0
"""Variance of a second difference of white noise over that of the noise."""
_DIFFERENCE_DOF: Final = 18.0 / 35.0
"""Degrees of freedom per second difference: 2 / (2 sum of their squared correlations)."""
_OUTSIDE: Final = 0.025
"""Probability beyond either end of an interval of 95 percent."""
_FAR: Final = 4.0
"""Standard errors beyond which the stability benchmark counts a value as false."""
_SELECTED: Final = float(-special.ndtri(THRESHOLDS.false_curved))
"""Standard errors by which a curvature is too large at that rate."""
_RATIO: Final = 4.611
"""Quantile of the logarithm of the ratio of two estimates of one variance from the same residuals,
3.353 sqrt(17 / 9), times the root of the number of bins."""
_DEPENDENT: Final = 1e-9
"""Squared share of a shape outside the span of others, below which it is rounding."""
_RATIO_SHORT: Final = 7.3
"""The same times the number of bins, for short sections; fitted to simulations."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Noise variance (of unit weight), reduced chi-square and quality of a batch."""

    noise: Array
    widening: Array
    """Factor on standard errors, for the scatter of `noise`; 1 where the variance is known."""
    relative_error: Array
    """Standard error of extinction over its scale, as `Thresholds.largest_relative_error`."""
    reduced_chi2: Array
    quality: Flags


class _Limits(NamedTuple):
    """Limits beyond which the tests fail."""

    misfit: Array
    """Of the reduced chi-square."""
    trend: Array
    outlier: Array
    widening: Array
    far: Array
    """Share of the values beyond `_FAR` standard errors by the scatter of the noise."""


def judge_fit(
    fit: PathEstimate, problem: PathProblem, *, unknowns: int, added_variance: Array
) -> Verdict:
    """Judge a batch of fits.

    Parameters
    ----------
    fit : PathEstimate
    problem : PathProblem
    unknowns : int
        Number of fitted parameters.
    added_variance : (profile or 1,) float
        m-2, of the extinction, from sources other than the noise of the fit.
    """
    known_variance, bins = problem.known_variance, problem.range.size
    bin_width = np.ptp(problem.range) / (bins - 1) if bins > 1 else 1.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        noise = np.ones_like(fit.status)
        if not known_variance:
            noise = _estimated_noise(fit, unknowns)
        # Of means over many bins.
        mean_noise = noise * problem.correlation_length
        reduced = fit.misfit / _residual_dof(fit.bins, unknowns) / noise
        limits = _limits(fit, unknowns, known_variance=known_variance)
        if problem.exposure is not None:
            _allow_for_counts(limits, fit, reduced, problem, unknowns)
        variance = fit.extinction_variance * mean_noise * limits.widening**2 + added_variance
        # Where the signal dies within a bin, the error is that of the transmission of one bin.
        scale = np.minimum(fit.extinction + 1.0 / fit.mean_range, 0.5 / bin_width)
        relative_error = np.asarray(np.sqrt(variance) / scale)
        determined = np.isfinite(
            fit.amplitude * np.sqrt(fit.amplitude_relative_variance * mean_noise)
        )
        determined &= relative_error < THRESHOLDS.largest_relative_error
        tests = (
            (Quality.LOW_SIGNAL, fit.signal_energy / mean_noise > COMMON.first_order**2),
            (HomogeneousQuality.POORLY_DETERMINED, determined),
            (Quality.NEGATIVE_AMPLITUDE, fit.amplitude > 0),
            (HomogeneousQuality.AT_BOUND, fit.bounded == 0),
            (HomogeneousQuality.POOR_FIT, reduced <= limits.misfit),
            (Quality.NOT_HOMOGENEOUS, fit.trend / mean_noise <= limits.trend),
            (Quality.OUTLIER, fit.largest / np.sqrt(noise) <= limits.outlier),
            (HomogeneousQuality.NOISE_UNCERTAIN, limits.far <= THRESHOLDS.false_estimated),
        )
        # Test for a pass, not for a failure: a comparison with NaN does not pass.
        quality = np.zeros(fit.status.shape, dtype=np.int32)
        fitted = fit.status == FITTED
        for bit, passed in tests:
            quality[fitted & ~passed] |= np.int32(bit)
    quality[fit.status == CONSTANT] |= np.int32(Quality.NO_SIGNAL)
    quality[fit.status == EMPTY] |= np.int32(Quality.INPUT_MISSING)
    quality[(fit.bins > 0) & (fit.bins < COMMON.fewest_bins)] |= np.int32(Quality.TOO_FEW_BINS)
    return Verdict(noise, limits.widening, relative_error, reduced, quality)


def _residual_dof(bins: Array, unknowns: int) -> Array:
    return np.maximum(bins - unknowns, 1.0)


def _estimated_noise(fit: PathEstimate, unknowns: int) -> Array:
    from_differences = fit.second_differences / (_SECOND_DIFFERENCE * fit.difference_count)
    from_residuals = fit.misfit / _residual_dof(fit.bins, unknowns)
    enough = fit.difference_count >= THRESHOLDS.fewest_differences
    variance = np.where(enough, from_differences, from_residuals)
    return np.maximum(variance, fit.rounding)


def curved_widening(relative_error: Any) -> Any:
    """Return the factor on the error of the background that the error of extinction makes.

    In a thin section the background follows from the curvature of the signal, to whose inverse it
    is proportional. With the relative error q of a curvature that came out z errors too large,
    the background is off by ``z / (1 - q z)`` of the errors that follow from that curvature.
    The factor holds such values within 4 stated errors if z is less than the quantile of the normal
    distribution at `Thresholds.false_curved`. Of simulated thin sections near the limit of
    determination, 3 to 4 in a thousand are farther off.

    Parameters
    ----------
    relative_error : (...) float
        Of extinction; that of the curvature.
    """
    relative = np.minimum(relative_error, THRESHOLDS.largest_relative_error)
    return np.maximum(_SELECTED / (_FAR * (1.0 - _SELECTED * relative)), 1.0)


def _limits(fit: PathEstimate, unknowns: int, *, known_variance: bool) -> _Limits:
    counts = fit.bins, fit.difference_count, fit.trend_count
    # Limits depend on counts alone, which most profiles share: evaluate each combination once.
    key = np.zeros(fit.status.shape, dtype=np.int64)
    for count in counts:
        key = (key << 20) + count.astype(np.int64)
    sample, kind = np.zeros(min(key.size, 1), dtype=np.int64), np.zeros_like(key)
    if np.any(key != key[:1]):
        _, sample, kind = np.unique(key, return_index=True, return_inverse=True)
    limits_of = _known_limits if known_variance else _estimated_limits
    bins, differences, shapes = (count[sample] for count in counts)
    limits = limits_of(bins, differences, shapes, unknowns)
    return _Limits(*(limit[kind] for limit in limits))


def _allow_for_counts(
    limits: _Limits, fit: PathEstimate, reduced: Array, problem: PathProblem, unknowns: int
) -> None:
    """Raise limits that a profile exceeds to those with the same rates for Poisson noise.

    Its tail is longer than a normal one. The largest residual has the quantile of the counts of the
    darkest bin. Chi-square has the mean 1, the variance 2 + 1/N and the third cumulant
    8 + 22/N + 1/N^2 of a bin with N counts, and the quantile of the shifted gamma distribution with
    the same three.
    """
    doubted = np.flatnonzero((reduced > limits.misfit) | (fit.largest > limits.outlier))
    if not doubted.size:
        return
    noise, exposure = problem.noise, np.asarray(problem.exposure)
    counts = noise[doubted % len(noise)] * exposure[doubted % len(exposure), np.newaxis] ** 2
    used = np.isfinite(problem.power[doubted]) & (counts > 0.0)
    fewest = np.min(counts, axis=-1, where=used, initial=np.inf)
    bins = np.maximum(used.sum(axis=-1), 1)
    inverse = np.sum(1.0 / counts, axis=-1, where=used) / bins
    inverse_square = np.sum(counts**-2.0, axis=-1, where=used) / bins
    rate, dof = 0.5 * THRESHOLDS.false_alarm, _residual_dof(fit.bins[doubted], unknowns)
    highest = np.ceil(special.pdtrik(1.0 - rate / bins, fewest))
    variance = (2.0 + inverse) * dof
    shape = 4.0 * variance**3 / ((8.0 + 22.0 * inverse + inverse_square) * dof) ** 2
    above = (special.gammaincinv(shape, 1.0 - rate) - shape) / np.sqrt(shape)
    for limit, raised in (
        (limits.outlier, (highest - fewest) / np.sqrt(fewest)),
        (limits.misfit, 1.0 + above * np.sqrt(variance) / dof),
    ):
        limit[doubted] = np.fmax(limit[doubted], raised)


def _known_limits(bins: Array, _: Array, shapes: Array, unknowns: int) -> tuple[Array, ...]:
    dof = _residual_dof(bins, unknowns)
    return (
        special.chdtri(dof, 0.5 * THRESHOLDS.false_alarm) / dof,
        np.where(shapes > 0, special.chdtri(shapes, THRESHOLDS.false_alarm), np.inf),
        np.maximum(
            COMMON.single_bin,
            -special.ndtri(0.5 * THRESHOLDS.false_alarm / np.maximum(bins, 1.0)),
        ),
        np.ones_like(bins),
        np.zeros_like(bins),
    )


def _estimated_limits(
    bins: Array, differences: Array, shapes: Array, unknowns: int
) -> tuple[Array, ...]:
    independent = differences >= THRESHOLDS.fewest_differences
    dof = np.where(independent, _DIFFERENCE_DOF * differences, _residual_dof(bins, unknowns))
    neighbours = differences + 2.0
    ratio = np.exp(_RATIO / np.sqrt(neighbours) + _RATIO_SHORT / neighbours)
    # An error over its estimate follows Student's distribution; 1.96 of them hold 95 percent.
    widening = np.asarray(special.stdtrit(dof, _OUTSIDE) / special.ndtri(_OUTSIDE))
    return (
        np.where(independent, ratio, np.inf),
        np.where(
            shapes > 0, shapes * special.fdtri(shapes, dof, 1.0 - THRESHOLDS.false_alarm), np.inf
        ),
        np.maximum(
            COMMON.single_bin,
            -special.stdtrit(dof, 0.5 * THRESHOLDS.false_alarm / np.maximum(bins, 1.0)),
        ),
        widening,
        2.0 * special.stdtr(dof, -_FAR * widening),
    )


# Residuals ------------------------------------------------------------------------------------

_Triple = tuple[float, float, float]


class _TestShapes(NamedTuple):
    """Weighted products of two shapes that the model lacks with its orthogonal shapes.

    The bent signal is ``phi (x - centroid)^2``, as of backscatter that bends along the path, the
    square ``phi^2``, as of a nonlinear detector.
    """

    bent: _Triple
    """With level, shape and slope."""
    square: _Triple
    bent_norm: float
    shared: float
    square_norm: float


@inlined
def _test_shapes(p: Point, free: float) -> _TestShapes:
    c, (q0, q1, q2), (p0, p1, p2, p3, p4) = p.centroid, p.shapes.phi, p.shapes.square
    c0, c1, c2 = p.shapes.cube
    mean_phi, mean_slope = free * p.mean_phi, free * p.mean_slope
    b0 = q2 - c * (2.0 * q1 - c * q0)
    b1 = p2 - c * (2.0 * p1 - c * p0)
    b2 = p3 - c * (3.0 * p2 - c * (3.0 * p1 - c * p0))
    return _TestShapes(
        (b0, b1 - mean_phi * b0, -2.0 * b2 - mean_slope * b0),
        (p0, c0 - mean_phi * p0, -2.0 * (c1 - c * c0) - mean_slope * p0),
        p4 - c * (4.0 * p3 - c * (6.0 * p2 - c * (4.0 * p1 - c * p0))),
        c2 - c * (2.0 * c1 - c * c0),
        p.shapes.fourth,
    )


@summing
def _second_differences(s: Scratch, spacing: int) -> tuple[float, float]:
    """Sum the squared second differences of residuals that many bins apart; count them.

    In units of the noise: the residuals become those.
    """
    for i in range(s.w.size):
        s.residual[i] *= math.sqrt(s.w[i])
    total = terms = 0.0
    # Slices: an index that might be negative keeps a loop from vectorising.
    last, middle = s.residual[2 * spacing :], s.residual[spacing:]
    used_last, used_middle = s.w[2 * spacing :], s.w[spacing:]
    for i in range(last.size):
        difference = last[i] - 2.0 * middle[i] + s.residual[i]
        valid = (used_last[i] > 0.0) & (used_middle[i] > 0.0) & (s.w[i] > 0.0)
        total += difference * difference if valid else 0.0
        terms += 1.0 if valid else 0.0
    return total, terms


@inlined
def _remainder(product: float, a: _Triple, b: _Triple, per: _Triple) -> float:
    """Return the part of the product of two vectors that is orthogonal to the model.

    `per` are the inverse squared lengths of level, shape and slope.
    """
    return product - (a[0] * b[0] * per[0] + a[1] * b[1] * per[1] + a[2] * b[2] * per[2])


@inlined
def _trend(t: _TestShapes, p: Point, r: Residuals, w0: float) -> tuple[float, float]:
    """Return the energy of residuals in the two test shapes, and their number.

    Both are orthogonalised against the model, and the square against the bent signal.
    """
    energy = count = shared = 0.0
    slope = -2.0 * (r.lever - p.centroid * r.shape) - p.mean_slope * r.level
    model = (r.level, r.shape - p.mean_phi * r.level, slope)
    per = (1.0 / w0, 1.0 / p.norm, 1.0 / p.slope_norm)
    norm = _remainder(t.bent_norm, t.bent, t.bent, per)
    bent = r.bend - p.centroid * (2.0 * r.lever - p.centroid * r.shape)
    pulled = _remainder(bent, t.bent, model, per)
    if norm > _DEPENDENT * t.bent_norm:
        energy += pulled * pulled / norm
        count += 1.0
        shared = _remainder(t.shared, t.bent, t.square, per) / norm
    norm = _remainder(t.square_norm, t.square, t.square, per) - shared * shared * norm
    if norm > _DEPENDENT * t.square_norm:
        along = _remainder(r.square, t.square, model, per) - shared * pulled
        energy += along * along / norm
        count += 1.0
    return energy, count


@inlined
def _describe_bend(t: _TestShapes, p: Point, w0: float, free: float, row: Any) -> None:
    """Write the effect of a bent signal on the fit, relative to the amplitude.

    Parabolas about different ranges differ by shapes of the model only: the background is the
    same, and the extinction is converted to the middle of the section.
    """
    level, shape, slope = t.bent
    across = slope / p.slope_norm
    row.background_bend = free * (level / w0 - shape / p.norm * p.mean_phi - across * p.mean_slope)
    row.extinction_bend = across + 0.5 - p.centroid


@inlined
def judge_residuals(s: Scratch, p: Point, sums: Sums, noise_spacing: int, row: Any) -> None:
    """Write the tests of the fit in units of the scaled noise, and the effect of a bent signal.

    A spacing of 0 stands for a known variance.
    """
    w0, free = sums.weight, sums.free
    _describe_bend(_test_shapes(p, free), p, w0, free, row)
    row.misfit = p.residuals.energy
    row.largest = math.sqrt(largest_energy(s))
    # The test shapes are orthogonal to the background even where it is given.
    full = fit_linear(
        p.tau, p.level, p.b, p.shapes, p.residuals,
        Sums(sums.bins, w0, sums.place, sums.value, sums.square, 1.0),
    )  # fmt: skip
    row.trend, row.trend_count = _trend(_test_shapes(full, 1.0), full, p.residuals, w0)
    row.second_differences, row.difference_count = 0.0, 0.0
    if noise_spacing > 0:
        row.second_differences, row.difference_count = _second_differences(s, noise_spacing)
