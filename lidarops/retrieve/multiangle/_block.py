"""One block of a scan: its samples, inhomogeneity of the air, and the fit at each altitude.

Samples are logarithms of signals without the bias by noise, up to where beams end. The selection
of a sample does not depend on its own value: where the signal is weak, dropping low samples and
keeping high ones would be the largest error of all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle.altitude_correlation import windowed
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_FIRST_GUESS: Final = 0.03**2
"""Variance of the inhomogeneity with which the first fit is weighted; the estimate does not depend
on it, but for its noise."""
_STEPS: Final = 2
"""Fits from which the inhomogeneity is estimated."""
_TYPICAL: Final = 32
"""Most profiles from which what a block has in common is estimated: every n-th."""
_LARGEST_RATIO: Final = 1.0 / COMMON.significant**2
"""Largest variance over squared signal for which the moments of the logarithm are corrected, whose
series diverges for larger ones, and of samples in methods without weights: with 1.5 standard
errors, their optical depths are a fifth less exact (`benchmarks.accuracy`)."""
_LEAST_NOISE: Final = 1e-12
"""Variance over squared signal where the stated variance is smaller, such as 0."""
_FARTHEST: Final = 3.0
"""Standard deviations by which the expected signal may differ from the sample."""
_PAD: Final = 2
"""Altitudes without data at either end of a row."""
_DEPENDENT: Final = 1e-8
"""Squared length of the shorter axis of horizontal distances, over that of the longer one, up to
which beams lie in one vertical plane."""


@dataclass(frozen=True, slots=True)
class BeamBlock:
    """Logarithms of one block of profiles, and the geometry of its beams."""

    logarithm: Array
    """(profile, angle, altitude); 0 where there is no sample."""
    noise: Array
    """Their variances; inf where there is no sample."""
    columns: Array
    """(column, angle, altitude), finite: ones, slant path, and horizontal distance over altitude
    along the axes of the scan, the longer one first; one if beams lie in one vertical plane."""
    alive: Indices
    """(profile, altitude): number of beams not yet lost in noise."""
    sides: bool
    """Whether beams point to all sides, so that horizontal gradients are fitted."""
    needed: int
    """Beams that an altitude needs to be within the reach."""
    dead_time_change: Array | None = None
    """(profile, angle, altitude): of the signal, with one standard error of the dead time."""

    @property
    def path(self) -> Array:
        """Slant path, (angle, altitude)."""
        return np.asarray(self.columns[1])

    @property
    def axes(self) -> Array:
        """Distances along the axes, (axis, angle, altitude)."""
        return np.asarray(self.columns[2:])

    def typical(self) -> BeamBlock:
        """Return the profiles from which what a block has in common is estimated."""
        every = typical_profiles(self.noise)
        return replace(
            self, logarithm=self.logarithm[every], noise=self.noise[every], alive=self.alive[every]
        )


@dataclass(frozen=True, slots=True)
class Regression:
    """Result of the fit at each altitude."""

    table: Array
    """(profile, column, altitude), columns of `lidarops.retrieve.multiangle._kano_hamilton`."""
    inhomogeneity: Array
    """(altitude,): variance of the logarithms on top of the noise."""
    freedom: Array
    """(altitude,): residual degrees of freedom of `inhomogeneity`; 0 where none."""
    residual: Array
    """(profile, angle, altitude): of the logarithms; NaN where there is no sample or fit."""
    leverage: Array
    """(profile, angle, altitude): diagonal of the hat matrix."""

    def column(self, number: int) -> Array:
        """Return one column as (profile, altitude)."""
        return self.table[:, number]

    def within(self, beams: BeamBlock) -> Booleans:
        """Return where the beams that are needed are alive and give an optical depth."""
        return np.asarray((beams.alive >= beams.needed) & np.isfinite(self.column(kh.TAU)))

    @property
    def shared(self) -> Array:
        """Covariance of errors of unit variance at an altitude and the next by equal air.

        (profile, altitude - 1); that by air with the correlation r is r times as large.
        """
        scatter = np.sqrt(self.inhomogeneity)
        both = self.column(kh.SHARED)[:, :-1] * scatter[:-1] * scatter[1:]
        return np.asarray(np.clip(both, -1.0, 1.0))


def every_nth(profiles: int) -> slice:
    """Return every n-th profile, so that at most 32 are left."""
    return slice(None, None, max(-(-profiles // _TYPICAL), 1))


def typical_profiles(noise: Array) -> Indices:
    """Return every n-th of the profiles with more than two beams, in which residuals show the air.

    Of all where there are few, or none of these. `noise` is that of `BeamBlock`.
    """
    shown = (noise < np.inf).sum(axis=1, dtype=np.int32).max(axis=1) > 2
    every = np.flatnonzero(shown | ~shown.any() | (len(noise) <= _TYPICAL))
    return every[every_nth(every.size)]


def make_beam_block(
    signal: Array, variance: Array, scan: Scan, dead_time_change: Array | None = None
) -> BeamBlock:
    """Return logarithms and geometry of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float; one variance may be that of all profiles
    scan : Scan
    dead_time_change : (profile, angle, altitude) float, optional
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.log(signal)
    noise = np.empty(signal.shape)
    alive = np.zeros((len(signal), signal.shape[-1]), dtype=np.int64)
    take_logarithms(signal, variance, scan.usable, logarithm, noise, alive)
    distances = np.stack([np.nan_to_num(scan.east), np.nan_to_num(scan.north)])
    return BeamBlock(
        logarithm,
        noise,
        fit_columns(np.nan_to_num(scan.path, nan=1.0), distances),
        alive,
        surrounds_zenith(scan.tilted_azimuths),
        min(3, max(int(scan.usable.sum()), 2)),
        dead_time_change,
    )


def fit_columns(path: Array, distances: Array) -> Array:
    """Return the columns of a fit, see `BeamBlock`.

    Parameters
    ----------
    path : (angle, altitude) float
    distances : (2, angle, altitude) float
        To the east and north.
    """
    lengths, axes = np.linalg.eigh(np.einsum("iak,jak->ij", distances, distances))
    longest = axes.T[::-1][: 1 + int(lengths[0] > _DEPENDENT * lengths[1])]
    return np.concatenate(
        [[np.ones_like(path), path], np.einsum("ij,jak->iak", longest, distances)]
    )


def regress(beams: BeamBlock, inhomogeneity: float | None) -> Regression:
    """Fit every altitude of one block.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated from the residuals
        of the typical profiles if not given.
    """
    altitudes = beams.noise.shape[2]
    if inhomogeneity is not None:
        return refit(beams, np.full(altitudes, inhomogeneity**2), np.zeros(altitudes))
    variance, freedom = np.full(altitudes, _FIRST_GUESS), np.zeros(altitudes)
    some = beams.typical()
    for _ in range(_STEPS):
        variance, freedom = _dersimonian_laird(refit(some, variance, freedom))
    return refit(beams, variance, freedom)


def refit(
    beams: BeamBlock,
    inhomogeneity: Array,
    freedom: Array,
    most_added: float = THRESHOLDS.gradient_variance,
) -> Regression:
    """Fit with a given variance of the inhomogeneity and its degrees of freedom.

    A gradient is fitted where that adds at most a multiple of the variance of the optical depth.
    """
    centre = beams.columns.mean(axis=1)
    centre[0] = 0.0
    design = (beams.columns - centre[:, np.newaxis]).swapaxes(0, 1).copy()
    logarithm, noise = (np.ascontiguousarray(part) for part in (beams.logarithm, beams.noise))
    residual, leverage = np.empty(noise.shape), np.empty(noise.shape)
    table = np.empty((len(noise), kh.COLUMNS, noise.shape[2]))
    kh.fit_levels(
        logarithm, noise, inhomogeneity, design, centre, most_added if beams.sides else -1.0,
        table, residual, leverage,
    )  # fmt: skip
    return Regression(table, inhomogeneity, freedom, residual, leverage)


def _dersimonian_laird(fit: Regression) -> tuple[Array, Array]:
    """Return the variance of the inhomogeneity, formula 4 of the page, and its degrees of freedom.

    Pooled over the block and a window of altitudes (`dersimonian1986`).
    """
    before, freedom = fit.inhomogeneity, pooled_freedom(fit)
    trace = fit.column(kh.TRACE).sum(axis=0)
    excess = (fit.column(kh.CHI2) - fit.column(kh.FREEDOM)).sum(axis=0)
    whole, total = windowed(trace), windowed(before * trace + excess)
    known = whole > 0.0
    if not np.any(known):
        return np.zeros_like(before), freedom
    variance = np.maximum(total[known] / whole[known], 0.0)
    altitudes = np.arange(before.size)
    return np.interp(altitudes, altitudes[known], variance), freedom


def pooled_freedom(fit: Regression) -> Array:
    """Return the residual degrees of freedom in the window around each altitude, (altitude,)."""
    return windowed(fit.column(kh.FREEDOM).sum(axis=0))


def student_factor(freedom: Array) -> Array:
    """Return the factor by which few degrees of freedom widen a standard error."""
    nu = np.maximum(freedom, THRESHOLDS.fewest_freedom)
    return np.where(freedom > 0, np.sqrt(nu / (nu - 2.0)), 1.0)


def strong_samples(beams: BeamBlock) -> BeamBlock:
    """Return only the samples that methods without weights can use."""
    strong = beams.noise < _LARGEST_RATIO
    return replace(beams, noise=np.where(strong, beams.noise, np.inf))


def end_beams(beams: BeamBlock) -> BeamBlock:
    """Return only the beams with the shortest and the longest path at every altitude."""
    beams = strong_samples(beams)
    on = beams.noise < np.inf
    shortest = np.where(on, beams.path, np.inf)
    longest = np.where(on, beams.path, -np.inf)
    number = np.arange(beams.path.shape[0])[:, np.newaxis]
    ends = (number == shortest.argmin(axis=1)[:, np.newaxis]) | (
        number == longest.argmax(axis=1)[:, np.newaxis]
    )
    noise = np.where(on & ends, beams.noise, np.inf)
    return replace(beams, noise=noise, sides=False, needed=2)


@compiled
def _clean(signal: Array, variance: Array, row: Array) -> None:
    """Fill signal, variance and 1 at altitudes with data, zeros elsewhere."""
    values, spread, count = row[0], row[1], row[2]
    for k in range(signal.size):
        on = abs(signal[k]) < HUGE and 0.0 <= variance[k] < HUGE
        values[k + _PAD] = signal[k] if on else 0.0
        spread[k + _PAD] = variance[k] if on else 0.0
        count[k + _PAD] = 1.0 if on else 0.0


@compiled
def _fill_sums(row: Array, sums: Array) -> None:
    """Fill the sums over the altitudes from two below to two above each."""
    for i in range(row.shape[0]):
        total, values = sums[i], row[i]
        for k in range(total.size):
            total[k] = values[k] + values[k + 1] + values[k + 2] + values[k + 3] + values[k + 4]


@compiled
def _end(sums: Array) -> int:
    """Return the first altitude of a beam from which the signal is lost in noise."""
    altitudes = sums.shape[1]
    # The window begins at the altitude, and is moved inside the grid.
    last = max(altitudes - 1 - _PAD, (altitudes - 1) // 2)
    for j in range(min(_PAD, last), last + 1):
        least = THRESHOLDS.lowest_snr**2 * sums[1, j] * sums[2, j]
        if sums[2, j] > 0.0 and not (sums[0, j] > 0.0 and sums[0, j] * sums[0, j] > least):
            return max(j - _PAD, 0)
    return int(altitudes)


@compiled
def take_logarithms(
    signal: Array, variance: Array, usable: Booleans, logarithm: Array, noise: Array, alive: Indices
) -> None:
    """Correct the logarithms of range-corrected signals for the bias caused by noise.

    Formula 3 of ``docs/algorithms/multiangle.md``; the expectation of the signal is the mean of
    two altitudes on either side, moved towards a sample that is farther than noise explains.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float; one variance may be that of all profiles
    usable : (angle,) bool
    logarithm : (profile, angle, altitude) float64
        Corrected; 0 where there is no sample.
    noise : (profile, angle, altitude) float64
        Output: variances of the logarithms; inf where there is no sample.
    alive : (profile, altitude) int
        Increased by the number of beams that are not yet lost in noise.
    """
    count, angles, altitudes = signal.shape
    row, sums = np.zeros((3, altitudes + 2 * _PAD)), np.empty((3, altitudes))
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[min(t, len(variance) - 1), a], row)
            _fill_sums(row, sums)
            end = _end(sums) if usable[a] else 0
            alive[t, :end] += 1
            y, v = logarithm[t, a], noise[t, a]
            for k in range(altitudes):
                own, spread = row[0, k + _PAD], row[1, k + _PAD]
                around, others = sums[0, k] - own, sums[2, k] - row[2, k + _PAD]
                spread = (sums[1, k] - spread) / others if others > 0.0 else spread
                slack = _FARTHEST * np.sqrt(spread)
                mean = around / others if around > 0.0 else own
                guess = min(max(mean, own - slack), own + slack)
                # Where the signal stands out, as in a cloud, it has more counts, and more noise.
                ratio = max(spread * max(guess / mean, 1.0) / (guess * guess), _LEAST_NOISE)
                known = min(ratio, _LARGEST_RATIO)
                on = k < end and own > 0.0
                v[k] = ratio * (1.0 + 2.5 * known) if on else np.inf
                y[k] = y[k] + known * (0.5 + 0.75 * known) if on else 0.0
