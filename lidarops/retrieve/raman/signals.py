"""Signals and air along the beam, and in cells of several bins."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.depth_fit import SignalNoise
from lidarops.retrieve.raman.scattering import particle_ratio
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
    wavelength: float
    """m, of the laser."""
    raman_wavelength: float
    """m."""
    stretch: float = 1.0
    """m along the beam per m of height."""
    slope_error: float = 0.0
    """m-1, standard error of the derivative of the logarithm of the density along the beam."""

    def particle_ratio(self, exponent: float) -> float:
        """Return particle extinction at the Raman wavelength over that at the laser's."""
        return particle_ratio(exponent, self.wavelength, self.raman_wavelength)

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
        return replace(
            self,
            range=cells.mean(self.range),
            backscatter=cells.mean(self.backscatter),
            depth=cells.mean(self.depth),
            raman_depth=cells.mean(self.raman_depth),
            density=cells.mean(self.density),
            overlap=cells.mean(self.known_overlap),
        )


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


T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Cells:
    """Equal numbers of neighbouring bins."""

    first: int
    """First bin of the first cell."""
    bins: int
    """Bins of a cell."""
    range: Array
    """m, middle of each cell."""
    step: float
    """m."""

    @property
    def stop(self) -> int:
        """First bin beyond the last cell."""
        return self.first + self.bins * self.range.size

    def split(self, values: npt.NDArray[T]) -> npt.NDArray[T]:
        """Return (..., bin) values as (..., cell, bin of the cell)."""
        inside = values[..., self.first : self.stop]
        return inside.reshape(*inside.shape[:-1], self.range.size, self.bins)

    def mean(self, values: Array) -> Array:
        """Return the mean of each cell over its bins that are finite, NaN where there is none."""
        parts = self.split(values)
        known = np.isfinite(parts)
        count = known.sum(axis=-1)
        total = np.where(known, parts, 0.0).sum(axis=-1)
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))

    def known(self, values: Array) -> Array:
        """Return the number of finite bins of each cell."""
        return np.asarray(np.isfinite(self.split(values)).sum(axis=-1).astype(np.float64))


def make_cells(range: Array, highest: float, length: float) -> Cells:  # noqa: A002
    """Return the cells of about `length` m from the first bin with a positive range to `highest` m.

    Parameters
    ----------
    range : (bin,) float
        m, ascending and uniform.
    highest, length : float
        m.

    Raises
    ------
    RetrievalInputError
        If the range holds fewer than 2 cells.
    """
    width = float(np.median(np.diff(range)))
    bins = max(1, round(length / width))
    first = int(np.searchsorted(range, 0.0, side="right"))
    count = (int(np.searchsorted(range, highest, side="right")) - first) // bins
    if count < 2:
        raise RetrievalInputError(
            f"holds fewer than 2 cells of {bins * width:g} m below {highest:g} m", field="range"
        )
    inside = range[first : first + count * bins].reshape(count, bins)
    return Cells(first, bins, inside.mean(axis=1), bins * width)


States = npt.NDArray[np.int8]


def state_of_cells(state: States, cells: Cells, unknown: int) -> States:
    """Return the largest state of the bins of each cell; unknown where that of all bins is.

    Parameters
    ----------
    state : (..., bin) int8
    cells : Cells
    unknown : int
        The largest state, which does not count beside another.
    """
    parts = cells.split(state)
    known = np.where(parts == unknown, np.int8(-1), parts).max(axis=-1)
    return np.where(known < 0, np.int8(unknown), known).astype(np.int8)


def largest_of_cells(values: Array, cells: Cells) -> Array:
    """Return the largest finite value of the bins of each cell; NaN where there is none."""
    largest = np.nan_to_num(cells.split(values), nan=-np.inf).max(axis=-1)
    return np.where(np.isneginf(largest), np.nan, largest)


def touched(mask: Booleans, resolution: Array, step: float) -> Booleans:
    """Return the cells in whose values a marked cell takes part.

    A mean begins at the first cell with extinction where it would reach before it.

    Parameters
    ----------
    mask : (profile, cell) bool
    resolution : (profile, cell) float
        m, length over which extinction is a mean; NaN where there is none, for the cell itself.
    step : float
        m, length of a cell.
    """
    count = mask.shape[-1]
    half = np.ceil(np.maximum(np.nan_to_num(resolution) / step - 1.0, 0.0) / 2.0).astype(np.intp)
    number, nearest = np.arange(count), np.isfinite(resolution).argmax(axis=-1)[:, np.newaxis]
    first = np.maximum(number - half, np.minimum(number, nearest))
    stop = np.minimum(first + 2 * half + 1, count)
    sums = np.pad(np.cumsum(mask, axis=-1), ((0, 0), (1, 0)))
    until, before = (np.take_along_axis(sums, at, axis=-1) for at in (stop, first))
    return np.asarray(until > before)
