"""One block of a scan: its samples, inhomogeneity of the air, and the fit at each altitude.

Samples are logarithms of signals without the bias by noise, up to where beams end. The selection
of a sample does not depend on its own value: where the signal is weak, dropping low samples and
keeping high ones would be the largest error of all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_FIRST_GUESS: Final = 0.03**2
"""Variance of the inhomogeneity with which the first fit is weighted; the estimate does not depend
on it, but for its noise."""
_FEW: Final = 16
"""Profiles of a long block from which the first of two estimates is made."""
_AROUND: Final = 3
"""Windows ahead that make the window around an altitude."""
_LARGEST_RATIO: Final = 1.0 / THRESHOLDS.lowest_snr**2
"""Largest variance over squared signal for which the moments of the logarithm are corrected: their
series diverges for larger ones."""
_LEAST_NOISE: Final = 1e-6
"""Noise over signal where the stated variance is smaller, such as 0."""
_FARTHEST: Final = 3.0
"""Standard deviations by which the expected signal may differ from the sample."""
_PAD: Final = 2
"""Altitudes without data at either end of a row."""


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
    alive = np.empty((len(signal), signal.shape[-1]), dtype=np.int64)
    take_logarithms(signal, variance, scan.usable, logarithm, noise, alive)
    return BeamBlock(
        logarithm,
        noise,
        np.stack(
            [np.nan_to_num(scan.east), np.nan_to_num(scan.north), np.nan_to_num(scan.path, nan=1.0)]
        ),
        alive,
        surrounds_zenith(scan.tilted_azimuths),
        min(3, max(int(scan.usable.sum()), 2)),
        dead_time_change,
    )


def regress(beams: BeamBlock, inhomogeneity: float | None) -> Regression:
    """Fit every altitude of one block.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated from the residuals
        of a first fit if not given.
    """
    altitudes = beams.noise.shape[2]
    if inhomogeneity is not None:
        return refit(beams, np.full(altitudes, inhomogeneity**2), np.zeros(altitudes))
    variance, freedom = np.full(altitudes, _FIRST_GUESS), np.zeros(altitudes)
    nothing = np.empty((0, *beams.noise.shape[1:]))
    # The first step, which only gives the weights of the second, needs few profiles.
    for every in (max(len(beams.noise) // _FEW, 1), 1):
        table = _table(beams, variance, nothing, nothing, every)
        variance, freedom = _dersimonian_laird(table, variance)
    return refit(beams, variance, freedom)


def refit(beams: BeamBlock, inhomogeneity: Array, freedom: Array) -> Regression:
    """Fit with a given variance of the inhomogeneity and its degrees of freedom."""
    residual, leverage = np.empty(beams.noise.shape), np.empty(beams.noise.shape)
    table = _table(beams, inhomogeneity, residual, leverage)
    return Regression(table, inhomogeneity, freedom, residual, leverage)


def _table(
    beams: BeamBlock, variance: Array, residual: Array, leverage: Array, every: int = 1
) -> Array:
    """Return the fit of every n-th profile, and fill residuals and leverages if they have rows."""
    logarithm, noise = (
        np.ascontiguousarray(values[::every]) for values in (beams.logarithm, beams.noise)
    )
    table = np.empty((len(noise), kh.COLUMNS, noise.shape[2]))
    kh.fit_levels(logarithm, noise, variance, beams.design, beams.sides, table, residual, leverage)
    return table


def _dersimonian_laird(table: Array, before: Array) -> tuple[Array, Array]:
    """Return the variance of the inhomogeneity, formula 4 of the page, and its degrees of freedom.

    Pooled over the block and a window of altitudes (`dersimonian1986`).
    """
    freedom = windowed(table[:, kh.FREEDOM].sum(axis=0))
    trace = table[:, kh.TRACE].sum(axis=0)
    excess = (table[:, kh.CHI2] - table[:, kh.FREEDOM]).sum(axis=0)
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
def _window_sums(row: Array, size: int, step: int, sums: Array) -> int:
    """Fill the sums of every `step`-th value of windows, and return the number of windows."""
    starts = row.shape[1] - (size - 1) * step
    for i in range(row.shape[0]):
        total = sums[i, :starts]
        total[:] = 0.0
        for shift in range(0, size * step, step):
            values = row[i, shift : shift + starts]
            for k in range(starts):
                total[k] += values[k]
    return int(starts)


@compiled
def _first_loss(sums: Array, windows: int, before: int, altitudes: int, lowest: float) -> int:
    """Return the first altitude where the mean signal of the window is below `lowest` times noise.

    The window begins `before` altitudes below, and is moved inside the grid.
    """
    for k in range(altitudes):
        j = max(min(k - before, windows - 1), 0)
        lost = not sums[0, j] > lowest * math.sqrt(sums[1, j] * sums[2, j])
        if lost and sums[2, j] > 0.0:
            return k
    return int(altitudes)


@compiled
def _end(row: Array, ahead: Array, around: Array) -> int:
    """Return the first altitude of a beam that is lost in noise."""
    altitudes, size = row.shape[1], THRESHOLDS.ahead
    windows = _window_sums(row, min(size, altitudes), 1, ahead)
    end = _first_loss(ahead, windows, 0, altitudes, THRESHOLDS.swallowed_snr)
    if altitudes < _AROUND * size:
        windows = _window_sums(row, altitudes, 1, around)
    else:
        windows = _window_sums(ahead[:, :windows], _AROUND, size, around)
    before = _AROUND * size // 2
    return min(end, _first_loss(around, windows, before, altitudes, THRESHOLDS.lowest_snr))


@compiled
def _neighbours(row: Array, levels: Array, roots: Array) -> None:
    """Fill the means of pairs of neighbours that have data, 0 where not positive, and the roots."""
    for j in range(levels.size):
        total = row[0, j] + row[0, j + 1]
        levels[j] = total / (row[2, j] + row[2, j + 1]) if total > 0.0 else 0.0
        roots[j] = math.sqrt(levels[j])


@compiled
def _ratios(row: Array, levels: Array, roots: Array, ratio: Array) -> None:
    """Fill the variances over the squares of the signals expected from the neighbours.

    The geometric mean of both sides is exact for an exponential decay.
    """
    for k in range(ratio.size):
        own, spread = row[0, k + _PAD], math.sqrt(row[1, k + _PAD])
        guess = roots[k] * roots[k + 3]
        guess = guess if guess > 0.0 else max(levels[k], levels[k + 3])
        slack = _FARTHEST * spread
        guess = own if guess == 0.0 else min(max(guess, own - slack), own + slack)
        relative = max(spread / guess, _LEAST_NOISE)
        ratio[k] = relative * relative


@compiled
def take_logarithms(
    signal: Array, variance: Array, usable: Booleans, logarithm: Array, noise: Array, alive: Indices
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
    alive : (profile, altitude) int
        Output: number of beams that are not yet lost in noise.
    """
    count, angles, altitudes = signal.shape
    row, ratio = np.zeros((3, altitudes + 2 * _PAD)), np.empty(altitudes)
    ahead, around = np.empty((3, altitudes)), np.empty((3, altitudes))
    levels, roots = np.empty(altitudes + 3), np.empty(altitudes + 3)
    inside = row[:, _PAD : altitudes + _PAD]
    alive[:] = 0
    for t in range(count):
        for a in range(angles):
            _clean(signal[t, a], variance[t, a], row)
            end = _end(inside, ahead, around) if usable[a] else 0
            alive[t, :end] += 1
            _neighbours(row, levels, roots)
            _ratios(row, levels, roots, ratio)
            for k in range(altitudes):
                logarithm[t, a, k] = 0.0
                noise[t, a, k] = np.inf
                if k < end and inside[0, k] > 0.0:
                    known = min(ratio[k], _LARGEST_RATIO)
                    noise[t, a, k] = ratio[k] * (1.0 + 2.5 * known)
                    logarithm[t, a, k] = math.log(inside[0, k]) + known * (0.5 + 0.75 * known)
