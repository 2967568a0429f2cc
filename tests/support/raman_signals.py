"""Raman and elastic signals of a known atmosphere, by an own forward model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings
from lidarops.retrieve.raman.signals import (
    AirColumn,
    Cells,
    ChannelSignal,
    make_cells,
)

Array = npt.NDArray[np.float64]

LASER, RAMAN = 354.7e-9, 386.7e-9


def along(values: Array, step: float) -> Array:
    """Return the integral from the lidar to the middle of each bin."""
    return np.cumsum(values) * step - 0.5 * values * step


@dataclass(frozen=True)
class Sky:
    """A particle profile over a standard atmosphere, with counts of both signals."""

    range: Array
    extinction: Array
    backscatter: Array
    raman: Array
    """Mean counts without background."""
    elastic: Array
    air: AirColumn
    cells: Cells
    settings: RamanSettings

    @property
    def ratio(self) -> float:
        """Particle extinction at the Raman wavelength over that at the laser's."""
        return self.air.particle_ratio(self.settings.angstrom_exponent)

    @property
    def quality(self) -> npt.NDArray[np.int32]:
        """Bits of the cells of one profile: partial overlap where the overlap is not known."""
        partial = np.isnan(self.cells.split(self.air.overlap)).any(axis=-1)
        return np.where(partial, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))[np.newaxis]

    def signal(self, counts: Array, sky: float = 0.0) -> ChannelSignal:
        """Return counts (profile, bin) with a known background as a signal."""
        rows = len(counts)
        mean = np.maximum(counts.mean(axis=0), 1e-3)
        return ChannelSignal(
            counts - sky,
            np.broadcast_to(mean, counts.shape),
            np.full(rows, sky),
            np.zeros(rows),
            np.zeros((1, counts.shape[1])),
            np.ones(rows),
        )


def make_sky(
    extinction: Array,
    step: float,
    light: float,
    *,
    lidar_ratio: float = 50.0,
    exponent: float = 1.2,
    cell: float = 60.0,
    full_overlap: float = 300.0,
    window: tuple[float, float, float] = (7000.0, 12_000.0, 5000.0),
    brightness: float = 3.0,
) -> Sky:
    """Return a sky of bins of `step` m; `light` is the mean count of the Raman bin at 1 km.

    `brightness` is that of the elastic bin over it.
    """
    r = step * (np.arange(extinction.size) + 0.5)
    molecules = MolecularProfile.us_standard()
    ratio = (LASER / RAMAN) ** exponent
    backscatter = molecules.backscatter(r, LASER)
    depth, raman_depth = (along(molecules.extinction(r, x), step) for x in (LASER, RAMAN))
    density, particles = molecules.number_density(r), along(extinction, step)
    seen = np.minimum(r / max(full_overlap, step), 1.0) ** 2
    raman = seen * density / r**2 * np.exp(-depth - raman_depth - (1.0 + ratio) * particles)
    total = backscatter + extinction / lidar_ratio
    elastic = seen * total / r**2 * np.exp(-2.0 * depth - 2.0 * particles)
    known = np.where(r >= full_overlap, 1.0, np.nan)
    low, high, width = window
    at = int(np.searchsorted(r, 1000.0))
    return Sky(
        r,
        extinction,
        extinction / lidar_ratio,
        light * raman / raman[at],
        brightness * light * elastic / elastic[at],
        AirColumn(r, backscatter, depth, raman_depth, density, known, LASER, RAMAN),
        make_cells(r, r[-1] + step, cell),
        RamanSettings(
            highest=high,
            reference=RamanReference(lowest=low, highest=high, width=width, relative_error=0.0),
            angstrom_exponent=exponent,
            angstrom_standard_error=0.0,
            molecular_relative_error=0.0,
            overlap_relative_error=0.0,
            full_overlap_error=0.0,
        ),
    )


def mean_over(profile: Array, step: float, middle: Array, length: Array) -> Array:
    """Return means of a profile of bins over lengths around heights, within the profile."""
    whole = np.concatenate([[0.0], np.cumsum(profile)]) * step
    edges = step * np.arange(profile.size + 1)
    low, high = np.maximum(middle - 0.5 * length, 0.0), np.minimum(middle + 0.5 * length, edges[-1])
    return (np.interp(high, edges, whole) - np.interp(low, edges, whole)) / (high - low)


def sliding_line(signal, variance, step, ratio, cells):
    """Return extinction and standard error by lines through the logarithm of `cells` cells.

    The classical method (`ansmann1990`, `pappalardo2004`); NaN within half a window of the ends.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(signal > 0.0, -np.log(signal), np.nan)
        weight = signal**2 / variance
    z = step * (np.arange(cells) - cells // 2)
    value, error = np.full((2, signal.size), np.nan)
    for middle in range(cells // 2, signal.size - cells // 2):
        window = slice(middle - cells // 2, middle + cells // 2 + 1)
        w, y = weight[window], depth[window]
        away = z - (w * z).sum() / w.sum()
        spread = (w * away**2).sum()
        value[middle] = (w * away * y).sum() / spread
        error[middle] = np.sqrt(1.0 / spread)
    return value / (1.0 + ratio), error / (1.0 + ratio)
