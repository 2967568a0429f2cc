"""Weights against outliers: among the beams at an altitude, and among the estimates of a profile.

Among beams, the start is the repeated median over pairs of beams (`siegel1982`), which withstands
up to half of the beams being wrong, then the pair with which most other beams agree. Tukey's
bisquare of studentised residuals follows, in two passes.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_GAUSS: Final = 1.4826
"""Standard deviation over median absolute deviation of normal deviates."""
USUAL_WEIGHT: Final = 1.0 - 2.0 / THRESHOLDS.bisquare**2 + 3.0 / THRESHOLDS.bisquare**4
"""Mean of the bisquare for normal deviates, by which weights of estimates are normalised."""


def clean_moments(width: float) -> tuple[float, float]:
    """Return the factors by which the bisquare changes chi2 and information of normal residuals.

    Returns
    -------
    of_chi2, of_information : float
        Ratios of the weighted sum of squares to the sum of weights, and of the reciprocal
        variance of the estimate to the sum of weights, to first order for unit variance.
    """
    a = 1.0 / width**2
    weight = 1.0 - 2.0 * a + 3.0 * a**2
    square = 1.0 - 6.0 * a + 15.0 * a**2
    psi = 1.0 - 12.0 * a + 90.0 * a**2 - 420.0 * a**3 + 945.0 * a**4
    return square / weight, square**2 / psi / weight


@compiled
def _median(values: Array, count: int) -> float:
    """Return the median of the first `count` values and sort these (insertion: they are few)."""
    for i in range(1, count):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    half = count // 2
    return float(values[half] if count % 2 else 0.5 * (values[half - 1] + values[half]))


@compiled
def _repeated_median(
    y: Array, x: Array, count: int, closest: float, work: Array, slopes: Array
) -> tuple[float, float]:
    """Return slope and intercept of the line through the first points; NaN if undefined."""
    medians = 0
    for i in range(count):
        pairs = 0
        for j in range(count):
            if abs(x[j] - x[i]) > closest:
                work[pairs] = (y[j] - y[i]) / (x[j] - x[i])
                pairs += 1
        if pairs > 0:
            slopes[medians] = _median(work, pairs)
            medians += 1
    if medians == 0:
        return np.nan, np.nan
    slope = _median(slopes, medians)
    for i in range(count):
        work[i] = y[i] - slope * x[i]
    return slope, _median(work, count)


@compiled
def start_residuals(y: Array, noise: Array, x: Array, residuals: Array) -> None:
    """Fill the residuals from the lines of repeated medians.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
        Logarithms and their variances; 0 and inf where there is no sample.
    x : (angle, altitude) float
        Slant path.
    residuals : (profile, angle, altitude) float
        Output; NaN where there is no sample, or fewer than 4 beams.
    """
    profiles, angles, altitudes = y.shape
    ys, xs, work, slopes = np.empty(angles), np.empty(angles), np.empty(angles), np.empty(angles)
    for t in range(profiles):
        for k in range(altitudes):
            count = 0
            low, high = np.inf, -np.inf
            for a in range(angles):
                residuals[t, a, k] = np.nan
                if noise[t, a, k] < np.inf:
                    ys[count], xs[count] = y[t, a, k], x[a, k]
                    low, high = min(low, x[a, k]), max(high, x[a, k])
                    count += 1
            if count < THRESHOLDS.fewest_beams or not high > low:
                continue
            slope, level = _repeated_median(
                ys, xs, count, THRESHOLDS.closest_paths * (high - low), work, slopes
            )
            for a in range(angles):
                if noise[t, a, k] < np.inf:
                    residuals[t, a, k] = y[t, a, k] - level - slope * x[a, k]


@compiled
def _agreement(
    y: Array, x: Array, per_width: Array, tilts: Array, levels: Array, totals: Array
) -> None:
    """Fill the sums of (1 - square)^3 of Tukey's bounded squares about some lines.

    The lines stand side by side, so that each sum has one order. Left to the compiler (`summing`),
    last digits depended on what was compiled before, although all was inlined.
    """
    totals[:] = 0.0
    for i in range(y.size):
        for k in range(tilts.size):
            share = ((y[i] - levels[k] - tilts[k] * x[i]) * per_width[i]) ** 2
            within = max(1.0 - share, 0.0)
            totals[k] += within * within * within


@compiled
def _best_pair(y: Array, x: Array, per_width: Array) -> tuple[float, float]:
    """Return slope and level of the best of the zero line and the lines through two beams."""
    tilts, levels, totals = np.zeros(y.size), np.zeros(y.size), np.zeros(y.size)
    _agreement(y, x, per_width, tilts[:1], levels[:1], totals[:1])
    best, slope, level = totals[0], 0.0, 0.0
    closest = THRESHOLDS.closest_paths * (np.max(x) - np.min(x))
    for i in range(y.size):
        lines = 0
        for j in range(i):
            if abs(x[i] - x[j]) > closest:
                tilts[lines] = (y[i] - y[j]) / (x[i] - x[j])
                levels[lines] = y[i] - tilts[lines] * x[i]
                lines += 1
        _agreement(y, x, per_width, tilts[:lines], levels[:lines], totals[:lines])
        for k in range(lines):
            if totals[k] > best:
                best, slope, level = totals[k], tilts[k], levels[k]
    return slope, level


@compiled
def pair_residuals(
    y: Array, noise: Array, x: Array, inhomogeneity: Array, residuals: Array
) -> None:
    """Replace residuals by those from the line through the pair with which most beams agree.

    A small error of the repeated median grows along the slant path and is large at long paths. Of
    that line and the lines through all pairs of beams, this takes the one with the least sum of
    squares bounded at the expected deviation.

    Parameters
    ----------
    y, noise : (profile, angle, altitude) float
        Logarithms and their variances; 0 and inf where there is no sample.
    x : (angle, altitude) float
        Slant path.
    inhomogeneity : (altitude,) float
        Variance on top of the noise.
    residuals : (profile, angle, altitude) float
        From repeated medians; NaN where there is no sample, or fewer than 4 beams.
    """
    profiles, angles, altitudes = y.shape
    beams = np.empty(angles, np.int64)
    all_y, all_x, all_per_width = np.empty(angles), np.empty(angles), np.empty(angles)
    for t in range(profiles):
        for k in range(altitudes):
            count = 0
            for a in range(angles):
                if not math.isnan(residuals[t, a, k]):
                    beams[count] = a
                    all_y[count], all_x[count] = residuals[t, a, k], x[a, k]
                    spread = math.sqrt(noise[t, a, k] + inhomogeneity[k])
                    all_per_width[count] = 1.0 / (THRESHOLDS.start_width * spread)
                    count += 1
            if count == 0:
                continue
            ys, xs = all_y[:count], all_x[:count]
            slope, level = _best_pair(ys, xs, all_per_width[:count])
            for i in range(count):
                residuals[t, beams[i], k] -= level + slope * xs[i]


def median_variance(residuals: Array, noise: Array) -> tuple[Array, Array]:
    """Return the variance from median residuals, less that of the noise, at each altitude.

    Parameters
    ----------
    residuals, noise : (profile, angle, altitude) float

    Returns
    -------
    variance, samples : (altitude,) float
        0 where there is no sample, and the number of samples.
    """
    on = ~np.isnan(residuals)
    samples = on.sum(axis=(0, 1)).astype(np.float64)
    unknowns = 2.0 * on.any(axis=1).sum(axis=0)
    variance = np.zeros_like(samples)
    for k in np.flatnonzero(samples > unknowns):
        scale = _GAUSS * np.median(np.abs(residuals[..., k][on[..., k]]))
        spread = scale**2 * samples[k] / (samples[k] - unknowns[k])
        variance[k] = max(spread - np.median(noise[..., k][on[..., k]]), 0.0)
    return variance, samples


def bisquare(
    residuals: Array, leverages: Array, noise: Array, inhomogeneity: Array, width: float
) -> Array:
    """Return the bisquare of the studentised residuals; 1 where it would leave too few beams.

    Parameters
    ----------
    residuals, leverages, noise : (profile, angle, altitude) float
    inhomogeneity : (altitude,) float
    width : float
        Standard errors at or above which the weight is 0.

    Returns
    -------
    (profile, angle, altitude) float
    """
    free = 1.0 - np.minimum(leverages, 1.0 - 1e-9)
    share = _studentised(residuals, free, noise, inhomogeneity) ** 2 / width**2
    keep = np.where(np.isnan(residuals), 1.0, (1.0 - np.minimum(share, 1.0)) ** 2)
    kept = ((keep > THRESHOLDS.kept_weight) & ~np.isnan(residuals)).sum(axis=1, keepdims=True)
    return np.asarray(np.where(kept < THRESHOLDS.fewest_kept, 1.0, keep))


def _studentised(residuals: Array, free: Array, noise: Array, inhomogeneity: Array) -> Array:
    """Return residuals over their standard errors.

    Where detector noise dominates, a logarithm is skewed; the relative residual is used there.
    """
    relative = np.expm1(np.minimum(residuals, 700.0))
    size = np.where(noise > inhomogeneity, relative, residuals)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(size / np.sqrt((noise + inhomogeneity) * free))


def largest_residual(
    residuals: Array, leverages: Array, noise: Array, inhomogeneity: Array
) -> tuple[float, int]:
    """Return the largest studentised residual, in a unit that outliers do not inflate.

    Samples less than 10 times their noise count only where inhomogeneity exceeds the noise:
    otherwise their noise is not known well enough to judge rare deviations.

    Parameters
    ----------
    residuals, leverages, noise : (profile, angle, altitude) float
    inhomogeneity : (altitude,) float

    Returns
    -------
    largest : float
        0 if there is no residual.
    count : int
        Number of residuals.
    """
    free = 1.0 - leverages
    used = (free > 1e-9) & (noise < np.maximum(THRESHOLDS.clear_variance, inhomogeneity))
    sizes = np.abs(_studentised(residuals, free, noise, inhomogeneity)[used])
    if sizes.size == 0:
        return 0.0, 0
    stride = max(residuals.size // THRESHOLDS.median_of, 1)
    unit = _GAUSS * float(np.median(sizes[::stride]))
    largest = float(sizes.max())
    return (largest / min(unit, 1.0) if unit > 0.0 else largest), sizes.size


# Estimates of a profile, before and after the first solution ------------------------------------


@compiled
def _jumps(depth: Array, information: Array, known: Integers, count: int) -> bool:
    for i in range(1, count):
        k, before = known[i], known[i - 1]
        variance = 1.0 / information[k] + 1.0 / information[before]
        if (depth[k] - depth[before]) ** 2 > THRESHOLDS.jump * THRESHOLDS.jump * variance:
            return True
    return False


@compiled
def screen_outliers(estimates: Array, information: Array) -> Array:
    """Return the information with less weight for estimates that are far from their neighbours.

    Estimates are compared with the median of a symmetric window, which is the middle value of any
    rising profile, however steep or curved. Without this screening, the first solution would
    follow gross outliers as if they were structure, and no residual would show them.

    Parameters
    ----------
    estimates, information : (profile, altitude) float64
        Information 0 where there is no estimate.

    Returns
    -------
    (profile, altitude) float64
    """
    profiles, altitudes = estimates.shape
    out = information.copy()
    known = np.empty(altitudes, dtype=np.int64)
    window = np.empty(2 * THRESHOLDS.half_window + 1)
    for t in range(profiles):
        count = 0
        for k in range(altitudes):
            if information[t, k] > 0.0:
                known[count] = k
                count += 1
        if not _jumps(estimates[t], information[t], known, count):
            continue
        for i in range(count):
            half = min(THRESHOLDS.half_window, i, count - 1 - i)
            for j in range(2 * half + 1):
                window[j] = estimates[t, known[i - half + j]]
            middle = np.median(window[: 2 * half + 1])
            k = known[i]
            variance = (1.0 + 0.5 * np.pi / (2 * half + 1)) / information[t, k]
            width = THRESHOLDS.bisquare * THRESHOLDS.bisquare * variance
            square = (estimates[t, k] - middle) ** 2 / width
            if square > 1.0:
                out[t, k] *= max(THRESHOLDS.least_kept / square, THRESHOLDS.smallest_kept)
    return out


def downweight_outliers(
    estimates: Array, information: Array, share: Array, depth: Array, variance: Array
) -> Array | None:
    """Return the information with less weight for outlying estimates; None if there is none.

    Parameters
    ----------
    estimates, information : (profile, altitude) float64
    share : (profile, altitude) float64
        Share of the variance that is correlated along altitude.
    depth, variance : (profile, altitude) float64
        The solution.
    """
    used = information > 0.0
    total = 1.0 / np.where(used, information, 1.0)
    # The fit follows an isolated estimate, whose residual is then too small to judge it.
    left = np.maximum(total - variance, THRESHOLDS.least_kept * total)
    # The three-band precision describes the noise at low frequencies: the solution absorbs the
    # correlated noise, not the rest.
    left = np.maximum(left, (1.0 - share) * total)
    deviation = np.where(used, np.abs(estimates - depth) / np.sqrt(left), 0.0)
    if not np.any(deviation > THRESHOLDS.outlying_estimate):
        return None
    square = (deviation / THRESHOLDS.bisquare) ** 2
    weight = (1.0 - np.minimum(square, 1.0)) ** 2 / USUAL_WEIGHT
    # The influence of an estimate stays bounded, however far off it is.
    tail = np.maximum(THRESHOLDS.least_kept / np.maximum(square, 1.0), THRESHOLDS.smallest_kept)
    return reduce_information(information, information * np.maximum(weight, tail))


def reduce_information(information: Array, reduced: Array) -> Array:
    """Return the reduced information, but the whole one if most of a profile would lose weight."""
    kept = (reduced > THRESHOLDS.majority * information).sum(axis=1)
    most = kept >= THRESHOLDS.majority * (information > 0.0).sum(axis=1)
    result: Array = np.where(most[:, np.newaxis], reduced, information)
    return result
