"""One block of a scan: its samples, inhomogeneity of the air, and the fit at each altitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle import robust_weights
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

Ends = npt.NDArray[np.int32]

_LARGEST_RATIO: Final = 1.0 / THRESHOLDS.lowest_snr**2
"""Largest variance over squared signal for which the moments of the logarithm are corrected."""


@dataclass(frozen=True, slots=True)
class BeamBlock:
    """Logarithms of one block of profiles, and the geometry of its beams."""

    logarithm: Array
    """(profile, angle, altitude); 0 where there is no sample."""
    noise: Array
    """Their variances; inf where there is no sample."""
    design: Array
    """(3, angle, altitude), finite: horizontal distance over altitude, eastward and northward, and
    slant path."""
    alive: Indices
    """(profile, altitude): number of beams not yet lost in noise."""
    sides: bool
    """Whether beams point to all sides."""
    needed: int
    """Beams that an altitude needs to be within the reach."""
    gaps: Booleans
    """(profile,): whether samples are missing between others."""
    dead_time_change: Array | None = None
    """(profile, angle, altitude): of the signal, with one standard error of the dead time."""

    @property
    def path(self) -> Array:
        """Slant path, (angle, altitude)."""
        return np.asarray(self.design[2])


@dataclass(frozen=True, slots=True)
class Regression:
    """Result of the fit at each altitude."""

    table: Array
    """(profile, column, altitude), columns of `lidarops.retrieve.multiangle._kano_hamilton`."""
    inhomogeneity: Array
    """(altitude,): variance of the logarithms on top of the noise."""
    freedom: Array
    """(altitude,): residual degrees of freedom of `inhomogeneity`; 0 where none."""
    keep: Array
    """(profile, angle or 0, altitude): factors of the weights."""
    robust: bool
    """Whether the robust passes ran."""
    residual: Array
    """(profile, angle, altitude): of the logarithms; NaN where there is no sample or fit."""
    leverage: Array
    """(profile, angle, altitude): diagonal of the hat matrix."""

    def column(self, number: int) -> Array:
        """Return one column as (profile, altitude)."""
        return self.table[:, number]


def make_beam_block(
    signal: Array, variance: Array, scan: Scan, dead_time_change: Array | None = None
) -> BeamBlock:
    """Return logarithms and geometry of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    scan : Scan
    dead_time_change : (profile, angle, altitude) float, optional
    """
    logarithm = np.empty(signal.shape)
    noise = np.empty(signal.shape)
    ends = np.empty(signal.shape[:2], dtype=np.int32)
    take_logarithms(signal, variance, scan.usable, logarithm, noise, ends)
    altitudes = np.arange(signal.shape[-1])
    alive = (ends[:, :, np.newaxis] > altitudes).sum(axis=1)
    return BeamBlock(
        logarithm,
        noise,
        np.stack(
            [np.nan_to_num(scan.east), np.nan_to_num(scan.north), np.nan_to_num(scan.path, nan=1.0)]
        ),
        alive,
        surrounds_zenith(scan.tilted_azimuths),
        min(3, max(int(scan.usable.sum()), 2)),
        profiles_with_gaps(noise < np.inf, signal, variance),
        dead_time_change,
    )


def regress(beams: BeamBlock, *, inhomogeneity: float | None, robust: bool) -> Regression:
    """Fit every altitude of one block.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated from the residuals
        if not given.
    robust : bool
        Whether to give outliers less weight, if the block has any.
    """
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    plain = _fit(beams, keep, inhomogeneity, (1.0, 1.0))
    if not robust or not _has_outliers(beams, plain):
        return plain
    return _fit_robustly(beams, inhomogeneity)


def weights_of(beams: BeamBlock, fit: Regression) -> Array:
    """Return the weights of the fit as (profile, angle, altitude)."""
    weights = 1.0 / (beams.noise + fit.inhomogeneity)
    return weights * fit.keep if fit.keep.shape[1] > 0 else weights


def kept_information(beams: BeamBlock, fit: Regression) -> Array:
    """Return the information left by outliers and gaps over that of all beams, (profile, altitude).

    An altitude that lost a beam has the same noise in common with other altitudes, and more noise
    of its own.
    """
    noise = _without_gaps(beams.noise)
    if noise is beams.noise and not fit.robust:
        return np.ones((beams.noise.shape[0], beams.noise.shape[2]))
    kept = _squares_of_path(beams, weights_of(beams, fit))
    whole = _squares_of_path(beams, 1.0 / (noise + fit.inhomogeneity))
    return np.where(whole > 0.0, np.minimum(kept / np.where(whole > 0.0, whole, 1.0), 1.0), 1.0)


def _without_gaps(noise: Array) -> Array:
    """Return variances with gaps filled: the geometric mean of the samples below and above."""
    there = noise < np.inf
    if not np.any(there[..., 1:] & ~there[..., :-1]):
        return noise
    altitudes = np.arange(noise.shape[-1])
    below = np.maximum.accumulate(np.where(there, altitudes, -1), axis=-1)
    above = np.where(there, altitudes, altitudes.size)[..., ::-1]
    above = np.minimum.accumulate(above, axis=-1)[..., ::-1]
    ends = np.maximum(below, 0), np.minimum(above, altitudes.size - 1)
    first, last = (np.sqrt(np.take_along_axis(noise, end, axis=-1)) for end in ends)
    between = (below >= 0) & (above < altitudes.size)
    return np.where(there, noise, np.where(between, first * last, np.inf))


def _squares_of_path(beams: BeamBlock, weights: Array) -> Array:
    whole = weights.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.einsum("tak,ak->tk", weights, beams.path) / whole
        square = np.einsum("tak,ak->tk", weights, beams.path**2) - whole * centre**2
    squares: Array = np.nan_to_num(square)
    return squares


def residual_scale(beams: BeamBlock, fit: Regression) -> Array:
    """Return the scale that makes residuals of two altitudes as correlated as their errors.

    The shape is (profile, altitude). The bisquare makes residuals smaller; and if other beams are
    left out, other components of the errors remain in the residuals.
    """
    shape = (beams.noise.shape[0], beams.noise.shape[2])
    if not fit.robust:
        return np.ones(shape)
    of_chi2 = robust_weights.clean_moments(THRESHOLDS.pass_width)[0]
    count = np.count_nonzero(beams.noise < np.inf, axis=1) - 2.0 - fit.column(kh.SIDES)
    expected = fit.column(kh.EXPECTED)
    known = expected > 0.0
    ratio = np.where(known, count / np.where(known, expected, 1.0), 1.0)
    scale: Array = np.sqrt(np.maximum(ratio, 1.0) / of_chi2)
    return scale


def _fit(
    beams: BeamBlock, keep: Array, inhomogeneity: float | None, moments: tuple[float, float]
) -> Regression:
    """Estimate the inhomogeneity in two steps from a first guess, and fit with it."""
    if inhomogeneity is not None:
        return _fit_known(beams, keep, np.full(keep.shape[2], inhomogeneity**2), moments[1])
    variance, nothing = (
        np.full(keep.shape[2], THRESHOLDS.first_guess),
        np.empty((0, *beams.noise.shape[1:])),
    )
    for _ in range(2):
        table = _table(beams, keep, variance, nothing, nothing)
        variance, freedom = _dersimonian_laird(table, variance, moments[0])
    return replace(_fit_known(beams, keep, variance, moments[1]), freedom=freedom)


def _fit_known(beams: BeamBlock, keep: Array, variance: Array, of_information: float) -> Regression:
    residual, leverage = np.empty(beams.noise.shape), np.empty(beams.noise.shape)
    table = _table(beams, keep, variance, residual, leverage)
    table[:, kh.INFORMATION] *= of_information
    freedom = np.zeros_like(variance)
    return Regression(table, variance, freedom, keep, keep.shape[1] > 0, residual, leverage)


def _table(
    beams: BeamBlock, keep: Array, variance: Array, residual: Array, leverage: Array
) -> Array:
    """Return the fit of every altitude; residuals and leverages are filled if they have rows."""
    table = np.empty((beams.noise.shape[0], kh.COLUMNS, beams.noise.shape[2]))
    kh.fit_levels(
        beams.logarithm, beams.noise, keep, variance, beams.design, beams.sides, table,
        residual, leverage,
    )  # fmt: skip
    return table


def _dersimonian_laird(table: Array, before: Array, of_chi2: float) -> tuple[Array, Array]:
    """Return the variance of the inhomogeneity, formula 4 of the page, and its degrees of freedom.

    Pooled over the block and a window of altitudes (`dersimonian1986`).
    """
    freedom = windowed(table[:, kh.FREEDOM].sum(axis=0))
    trace = table[:, kh.TRACE].sum(axis=0)
    excess = (table[:, kh.CHI2] / of_chi2 - table[:, kh.EXPECTED]).sum(axis=0)
    whole, total = windowed(trace), windowed(before * trace + excess)
    known = whole > 0.0
    if not np.any(known):
        return np.zeros_like(before), freedom
    variance = np.maximum(total[known] / whole[known], 0.0)
    altitudes = np.arange(before.size)
    return np.interp(altitudes, altitudes[known], variance), freedom


def windowed(values: Array) -> Array:
    """Return sums over the window around each altitude, cut at the ends of the grid."""
    half = THRESHOLDS.pooled // 2
    padded = np.pad(values, half)
    return np.asarray(sliding_window_view(padded, 2 * half + 1).sum(axis=1))


def pooled_freedom(fit: Regression) -> Array:
    """Return the residual degrees of freedom in the window around each altitude, (altitude,)."""
    return windowed(fit.column(kh.FREEDOM).sum(axis=0))


def student_factor(freedom: Array) -> Array:
    """Return the factor by which few degrees of freedom widen a standard error."""
    nu = np.maximum(freedom, THRESHOLDS.fewest_freedom)
    return np.where(freedom > 0, np.sqrt(nu / (nu - 2.0)), 1.0)


def _has_outliers(beams: BeamBlock, fit: Regression) -> bool:
    if np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0) < THRESHOLDS.fewest_beams:
        return False
    largest, count = robust_weights.largest_residual(
        fit.residual, fit.leverage, beams.noise, fit.inhomogeneity
    )
    return largest > outlier_limit(count)


def outlier_limit(count: int) -> float:
    """Return the limit, in standard errors, that chance exceeds in 1 percent of blocks."""
    return max(
        THRESHOLDS.outlying_residual, -float(ndtri(0.5 * THRESHOLDS.false_alarm / max(count, 1)))
    )


def _fit_robustly(beams: BeamBlock, inhomogeneity: float | None) -> Regression:
    y, noise, path = beams.logarithm, beams.noise, beams.path
    residual, leverage = np.empty(noise.shape), np.zeros(noise.shape)
    robust_weights.start_residuals(y, noise, path, residual)
    if inhomogeneity is None:
        variance, samples = robust_weights.median_variance(residual, noise)
        variance = windowed(variance * samples) / np.maximum(windowed(samples), 1.0)
    else:
        variance = np.full(noise.shape[2], inhomogeneity**2)
    robust_weights.pair_residuals(y, noise, path, variance, residual)
    for width in (THRESHOLDS.start_width, THRESHOLDS.pass_width, THRESHOLDS.pass_width):
        keep = robust_weights.bisquare(residual, leverage, noise, variance, width)
        fit = _fit(beams, keep, inhomogeneity, robust_weights.clean_moments(width))
        residual, leverage, variance = fit.residual, fit.leverage, fit.inhomogeneity
    return fit


def end_beams(beams: BeamBlock) -> BeamBlock:
    """Return only the beams with the shortest and the longest path at every altitude."""
    on = beams.noise < np.inf
    shortest = np.where(on, beams.path, np.inf)
    longest = np.where(on, beams.path, -np.inf)
    number = np.arange(beams.path.shape[0])[:, np.newaxis]
    ends = (number == shortest.argmin(axis=1)[:, np.newaxis]) | (
        number == longest.argmax(axis=1)[:, np.newaxis]
    )
    noise = np.where(on & ends, beams.noise, np.inf)
    return replace(beams, noise=noise, sides=False, needed=2)


def refit(beams: BeamBlock, inhomogeneity: Array, freedom: Array) -> Regression:
    """Fit with a given inhomogeneity and its degrees of freedom."""
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    fit = _fit_known(beams, keep, inhomogeneity, 1.0)
    return replace(fit, freedom=freedom)


# Samples --------------------------------------------------------------------------------------
#
# The selection of a sample does not depend on its own value: where the signal is weak, dropping low
# samples and keeping high ones would be the largest error of all.


@compiled
def _clean(signal: Array, variance: Array, row: Array) -> None:
    """Fill signal, variance and 1 at altitudes with data, zeros elsewhere."""
    values, spread, count = row[0], row[1], row[2]
    for k in range(signal.size):
        on = abs(signal[k]) < HUGE and 0.0 <= variance[k] < HUGE
        values[k] = signal[k] if on else 0.0
        spread[k] = variance[k] if on else 0.0
        count[k] = 1.0 if on else 0.0


@compiled
def _window_sums(row: Array, size: int, sums: Array) -> None:
    """Fill the sums of rows over windows, by the altitude at which a window starts."""
    starts = row.shape[1] - size + 1
    for i in range(row.shape[0]):
        total = sums[i, :starts]
        total[:] = 0.0
        for shift in range(size):
            values = row[i, shift : shift + starts]
            for k in range(starts):
                total[k] += values[k]


@compiled
def _first_loss(row: Array, before: int, size: int, lowest: float, sums: Array) -> int:
    """Return the first altitude where the mean signal of the window is below `lowest` times noise.

    The window begins `before` altitudes below, and is moved inside the grid.
    """
    altitudes = row.shape[1]
    size = min(size, altitudes)
    _window_sums(row, size, sums)
    for k in range(altitudes):
        j = max(min(k - before, altitudes - size), 0)
        lost = not sums[0, j] > lowest * math.sqrt(sums[1, j] * sums[2, j])
        if lost and sums[2, j] > 0.0:
            return k
    return int(altitudes)


@compiled
def _levels(row: Array, levels: Array, roots: Array) -> None:
    """Fill the means of neighbours and their square roots, 0 where not positive.

    Entry k is the mean of the two altitudes below k, entry k + 3 that of the two above, of those
    that exist and have data.
    """
    altitudes = row.shape[1]
    for j in range(altitudes + 3):
        total = count = 0.0
        if 2 <= j <= altitudes + 1:
            total, count = total + row[0, j - 2], count + row[2, j - 2]
        if 1 <= j <= altitudes:
            total, count = total + row[0, j - 1], count + row[2, j - 1]
        levels[j] = total / count if total > 0.0 else 0.0
        roots[j] = math.sqrt(levels[j])


@compiled
def _expected(row: Array, levels: Array, roots: Array, k: int) -> float:
    """Return the signal expected from the neighbours, within 3 standard deviations of the sample.

    The geometric mean of both sides is exact for an exponential decay.
    """
    guess = roots[k] * roots[k + 3]
    if guess == 0.0:
        guess = max(levels[k], levels[k + 3])
    own = float(row[0, k])
    slack = THRESHOLDS.farthest_expected * math.sqrt(row[1, k])
    return own if guess == 0.0 else min(max(guess, own - slack), own + slack)


@compiled
def take_logarithms(
    signal: Array, variance: Array, usable: Booleans, logarithm: Array, noise: Array, ends: Ends
) -> None:
    """Take the logarithms of range-corrected signals without the bias caused by noise.

    Formula 3 of ``docs/algorithms/multiangle.md``; the expectation of the signal is estimated from
    neighbouring altitudes.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    usable : (angle,) bool
    logarithm, noise : (profile, angle, altitude) float64
        Outputs: the logarithms and their variances; 0 and inf where there is no sample.
    ends : (profile, angle) int32
        Output: the first altitude of each beam that is lost in noise; the number of altitudes if
        none is.
    """
    count, angles, altitudes = signal.shape
    row, sums = np.empty((3, altitudes)), np.empty((3, altitudes))
    levels, roots = np.empty(altitudes + 3), np.empty(altitudes + 3)
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[t, a], row)
            end = 0
            if usable[a]:
                end = _first_loss(row, 0, THRESHOLDS.ahead, THRESHOLDS.swallowed_snr, sums)
                around, lowest = THRESHOLDS.around, THRESHOLDS.lowest_snr
                end = min(end, _first_loss(row, around // 2, around, lowest, sums))
            ends[t, a] = end
            _levels(row, levels, roots)
            for k in range(altitudes):
                logarithm[t, a, k] = 0.0
                noise[t, a, k] = np.inf
                if k < end and row[0, k] > 0.0:
                    ratio = (
                        max(
                            math.sqrt(row[1, k]) / _expected(row, levels, roots, k),
                            THRESHOLDS.least_noise,
                        )
                        ** 2
                    )
                    # The series of the moments of the logarithm diverges for larger ratios.
                    known = min(ratio, _LARGEST_RATIO)
                    noise[t, a, k] = ratio * (1.0 + 2.5 * known)
                    logarithm[t, a, k] = math.log(row[0, k]) + known * (0.5 + 0.75 * known)


def profiles_with_gaps(used: Booleans, signal: Array, variance: Array) -> Booleans:
    """Return which profiles miss samples between others of the same beam.

    A weak signal that noise made negative is not used, but does not count as missing.

    Parameters
    ----------
    used : (profile, beam, altitude) bool
        Samples that are used.
    signal, variance : (profile, beam, altitude) float
        NaN where missing.

    Returns
    -------
    (profile,) bool
    """
    gaps: Booleans = np.any(used[..., 1:] & ~used[..., :-1], axis=(1, 2))
    rows = np.flatnonzero(gaps)
    if rows.size:
        below = np.logical_or.accumulate(used[rows], axis=-1)
        above = np.logical_or.accumulate(used[rows, :, ::-1], axis=-1)[..., ::-1]
        measured = np.isfinite(signal[rows]) & np.isfinite(variance[rows])
        gaps[rows] = np.any(below & above & ~measured, axis=(1, 2))
    return gaps
