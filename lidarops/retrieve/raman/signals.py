"""Signals and air along the beam, and signals over those of clean air in cells."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.raman.cells import Cells
from lidarops.retrieve.raman.depth_fit import SignalNoise
from lidarops.retrieve.raman.thresholds import THRESHOLDS


def _nothing() -> Array:
    return np.zeros((1, 1))


@dataclass(frozen=True, slots=True)
class ChannelSignal:
    """Signals of a channel, without background, not corrected for overlap or range."""

    power: Array
    """(profile, bin), any unit; NaN where missing."""
    variance: Array
    """(profile, bin): of a bin, times the correlation length of noise."""
    background: Array
    """(profile,)"""
    background_standard_error: Array
    """(profile,)"""
    dead_time_error: Array
    """(profile or 1, bin): change with one standard error of the dead time."""
    counts_per_power: Array | None = None
    """(profile,): for photon counting, whose variance then follows from the fitted counts."""
    baseline_error: Array = field(default_factory=_nothing)
    """(profile or 1, bin): change with one standard error of the analog baseline."""


@dataclass(frozen=True, slots=True)
class AirColumn:
    """Clean air along the beam, (bin,)."""

    range: Array
    """m."""
    backscatter: Array
    """m-1 sr-1, at the laser wavelength."""
    depth: Array
    """Molecular optical depth from the lidar, at the laser wavelength."""
    raman_depth: Array
    """The same at the Raman wavelength."""
    density: Array
    """Number density of the Raman scatterers times the share of their lines that is measured; any
    unit."""
    overlap: Array
    """Common to both signals; NaN where it is not known."""

    @property
    def elastic_shape(self) -> Array:
        """Elastic signal of air for a backscatter of 1."""
        return np.asarray(self.known_overlap * np.exp(-2.0 * self.depth) / self.range**2)

    @property
    def raman_shape(self) -> Array:
        """Raman signal of clean air."""
        density = self.density / self.density.max()
        both = np.exp(-self.depth - self.raman_depth)
        return np.asarray(self.known_overlap * density * both / self.range**2)

    @property
    def known_overlap(self) -> Array:
        """Overlap, 1 where it is not known."""
        return np.where(np.isnan(self.overlap), 1.0, self.overlap)

    def in_cells(self, cells: Cells) -> AirColumn:
        """Return the means of cells, with the known overlap."""
        profiles = (self.range, self.backscatter, self.depth, self.raman_depth, self.density)
        return AirColumn(*(cells.mean(values) for values in (*profiles, self.known_overlap)))


@dataclass(frozen=True, slots=True)
class CellSignal:
    """A signal over that of clean air in cells, of one profile."""

    value: Array
    """(cell,): NaN where there are no data."""
    variance: Array
    noise: SignalNoise
    background: Array
    """(cell,): change of the value with one standard error of the background."""
    dead_time: Array
    """(cell,): change of the value with one standard error of the dead time."""
    baseline: Array = field(default_factory=lambda: _nothing()[0])
    """(cell,): change of the value with one standard error of the analog baseline."""

    def relative(self, change: Array, level: Array) -> Array:
        """Return a change relative to a level, 0 where there are no data."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(change / level, posinf=0.0, neginf=0.0)


def cell_signals(signal: ChannelSignal, shape: Array, cells: Cells) -> list[CellSignal]:
    """Return the signals of all profiles over that of clean air in cells.

    Their noise is a function of their mean.
    """
    known = np.isfinite(signal.power) & np.isfinite(signal.variance)
    power = np.where(known, signal.power, np.nan)
    bins = np.maximum(cells.known(power), 1.0)
    variance = cells.mean(np.where(known, signal.variance / shape**2, np.nan)) / bins
    inverse = np.where(known, 1.0 / shape, np.nan)
    level = cells.mean(inverse)
    value = cells.mean(power / shape)
    missing = np.isnan(value)
    if signal.counts_per_power is None:
        per_signal, fixed = np.zeros(value.shape), np.where(np.isnan(variance), np.inf, variance)
    else:
        counts = signal.counts_per_power[:, np.newaxis]
        sky = np.maximum(signal.background, 0.0)[:, np.newaxis]
        per_signal = level / (bins * counts)
        fixed = sky * cells.mean(inverse**2) / (bins * counts)
        many = np.nan_to_num(value / per_signal) > THRESHOLDS.many_counts
        expected = np.where(many, per_signal * value + fixed, 1.0)
        excess = np.where(many, np.maximum(variance / expected, 1.0), 1.0)
        per_signal = np.where(missing, 0.0, per_signal * excess)
        fixed = np.where(missing, np.inf, fixed * excess)
    background = level * np.nan_to_num(signal.background_standard_error)[:, np.newaxis]
    dead_time, baseline = (
        cells.mean(error * inverse) for error in (signal.dead_time_error, signal.baseline_error)
    )
    columns = value, variance, per_signal, fixed, background, dead_time, baseline
    return [
        CellSignal(v, s, SignalNoise(p, f), *changes)
        for v, s, p, f, *changes in zip(*columns, strict=True)
    ]
