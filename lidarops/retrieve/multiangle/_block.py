"""One block of a scan: its samples, inhomogeneity of the air, and the fit at each altitude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle._samples import take_logarithms
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_FIRST_GUESS: Final = 0.03**2
"""Variance of the inhomogeneity with which the first fit is weighted; the estimate does not depend
on it, but for its noise."""
_FEW: Final = 16
"""Profiles of a long block from which the first of two estimates is made."""


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
