"""Means of profiles in xarray without the parts of their intervals that are outlying."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.flags import WITHHELD
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.signal.averaging import Averages
from lidarops.retrieve.signal.labeled import DEAD_TIME_ERROR
from lidarops.retrieve.signal.labeled_averaging import MEANS_TOGETHER, ClockAverage, PartSums
from lidarops.retrieve.signal.screening import (
    PartCells,
    cells_of_parts,
    outlying_parts,
    tail_of_cells,
)
from lidarops.retrieve.signal.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True)
class Record:
    """Means of one record of the light, in the making."""

    means: ClockAverage
    """With `THRESHOLDS.most_parts` parts."""
    range: Array
    """m."""
    lag: int = 0
    """Bins by which the record lags behind the last of its channels."""


@dataclass(frozen=True, slots=True)
class Screening:
    """What makes a part of a mean outlying."""

    contrast: float
    """Factor by which the light of a cell may differ from part to part."""
    highest: float
    """m along the beam, to which parts are compared: beyond, single bursts of counts, of which real
    night files have some, would cost a part of the mean and change nothing that is retrieved."""


@dataclass(frozen=True, slots=True)
class _Mean:
    """One mean of one record, and its parts."""

    values: Averages
    quality: npt.NDArray[np.int32]
    length: Array
    profiles: npt.NDArray[np.int32]
    shots: npt.NDArray[np.int32]
    left_out: int
    cells: PartCells
    """(part, cell), NaN in parts that are left out or do not exist."""
    of_parts: npt.NDArray[np.int32]
    """(part,): number of profiles, 0 in those."""


class ScreenedAverage:
    """Means of profiles over intervals of the clock, without outlying parts.

    The profiles of an interval are divided into at most `THRESHOLDS.most_parts` parts, and those
    that are outlying in any record are left out of all (`lidarops.retrieve.signal.screening`).
    Chunks of profiles do not change a bit of the result.

    Parameters
    ----------
    records : sequence of Record
        Of one channel or several, two of each that is glued, with bins of equal width.
    screening : Screening
    """

    def __init__(self, records: Sequence[Record], screening: Screening) -> None:
        self._records, self._screening = records, screening
        distance = records[0].range
        self._step = float(np.median(np.diff(distance))) if distance.size > 1 else 1.0
        self._bins = max(round(THRESHOLDS.cell_length / self._step), 1)
        self._first = int(np.searchsorted(records[-1].range, 0.0, side="right"))
        self._first_range = float(records[-1].range[0]) + self._first * self._step
        self._past = min(record.range.size for record in records)
        self._open: list[tuple[_Mean, ...]] = []
        self._units: tuple[dict[str, Any], ...] = ()
        self._number, self._total = 0, self.times.sizes["time"]
        self._completed: list[tuple[xr.Dataset, ...]] = []

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return self._records[-1].means.times

    def add(self, conditioned: Sequence[xr.Dataset]) -> None:
        """Add the next profiles of each record (`ClockAverage.add`)."""
        first, count = 0, conditioned[0].sizes["time"]
        while first < count:
            # One interval at a time, because the sums of its parts are large.
            past = min(first + self._records[0].means.left, count)
            for record, profiles in zip(self._records, conditioned, strict=True):
                record.means.add(profiles, slice(first, past))
            sums = (record.means.completed_parts() for record in self._records)
            for parts in zip(*sums, strict=True):
                self._complete(parts)
            first = past

    def completed(self) -> Iterator[tuple[xr.Dataset, ...]]:
        """Yield the means that are complete, in batches, of each record; and forget them.

        They are as those of `ClockAverage.completed`, with these variables more: ``part_power``
        (background subtracted) and ``part_variance`` over (time, part, cell) of parts that are in
        the mean, means over cells of ``bins`` (attribute) bins from the first range above zero of
        the last record on (``first_range``), NaN where missing; ``part_quantum`` (the power of a
        count in a cell, 0 for analog records) and ``part_profiles`` over (time, part), the numbers
        of their profiles, and ``profiles_left_out`` over time. ``profiles`` and ``shots`` are those
        in the mean.
        """
        batches, self._completed = self._completed, []
        yield from batches

    def _complete(self, parts: tuple[PartSums, ...]) -> None:
        cells = [
            self._cells(record, sums) for record, sums in zip(self._records, parts, strict=True)
        ]
        compared = slice(int(self._screening.highest / (self._bins * self._step)))
        left_out = np.logical_or.reduce(
            [
                outlying_parts(of_record, compared, contrast=self._screening.contrast)
                for of_record in cells
            ]
        )
        means = (_mean(sums, c, ~left_out) for sums, c in zip(parts, cells, strict=True))
        self._open.append(tuple(means))
        self._units = tuple(sums.units for sums in parts)
        done = self._number + len(self._open)
        if len(self._open) == MEANS_TOGETHER or done == self._total:
            numbers = slice(self._number, done)
            batch = zip(self._records, zip(*self._open, strict=True), self._units, strict=True)
            self._completed.append(
                tuple(self._labeled(record, numbers, of, units) for record, of, units in batch)
            )
            self._number, self._open = done, []

    def _cells(self, record: Record, sums: PartSums) -> PartCells:
        """Return the signal of parts without background, (part, cell), and its variance."""
        usable = (sums.quality & np.int32(WITHHELD)) == 0
        lag = record.lag
        power, variance = cells_of_parts(
            sums.sums.sums, usable, self._first + lag, self._past + lag, self._bins
        )
        totals, weighted = sums.lengths.sums[:2]
        variance *= np.where(totals > 0.0, weighted / np.maximum(totals, 1.0), 1.0)
        sky, error = tail_of_cells(power, variance)
        power -= sky
        variance += error**2
        return PartCells(power, variance, self._quantum(sums) / self._bins)

    def _quantum(self, sums: PartSums) -> Array:
        """Return the power of a count in a bin of each part; 0 for analog records."""
        if DEAD_TIME_ERROR not in sums.units["power"]:
            return np.zeros(sums.shots.size)
        return LICEL_RANGE_PER_MICROSECOND / (np.maximum(sums.shots, 1) * self._step)

    def _labeled(
        self, record: Record, numbers: slice, means: Sequence[_Mean], units: dict[str, Any]
    ) -> xr.Dataset:
        values = (mean.values for mean in means)
        rows = zip(
            *((v.values, v.variance, v.shared_variance, v.count) for v in values), strict=True
        )
        averages = Averages(*(np.concatenate(row) for row in rows))
        quality = np.stack([mean.quality for mean in means])
        length = np.array([float(mean.length) for mean in means])
        profiles, shots, left_out = (
            np.array([getattr(mean, name) for mean in means], dtype=np.int32)
            for name in ("profiles", "shots", "left_out")
        )
        labeled = record.means.labeled(numbers, averages, quality, length, profiles, shots, units)
        along = ("time", "part", "cell")
        power, variance = (
            np.stack([getattr(mean.cells, name) for mean in means])
            for name in ("power", "variance")
        )
        return labeled.assign(
            part_power=(along, power, {"bins": self._bins, "first_range": self._first_range}),
            part_variance=(along, variance),
            part_quantum=(along[:2], np.stack([mean.cells.quantum for mean in means])),
            part_profiles=(("time", "part"), np.stack([mean.of_parts for mean in means])),
            profiles_left_out=("time", left_out),
        )


def _mean(sums: PartSums, cells: PartCells, kept: Booleans) -> _Mean:
    """Return the mean of the parts that are kept."""
    parts = THRESHOLDS.most_parts
    shape = parts, cells.power.shape[1]
    power, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    quantum, of_parts = np.zeros(parts), np.zeros(parts, dtype=np.int32)
    shown = np.flatnonzero(kept)
    power[shown], variance[shown] = cells.power[shown], cells.variance[shown]
    quantum[shown], of_parts[shown] = cells.quantum[shown], sums.profiles[shown]
    return _Mean(
        values=sums.sums.joined(kept),
        quality=np.bitwise_or.reduce(sums.quality if kept.all() else sums.quality[kept], axis=0),
        length=sums.lengths.joined(kept).values[0, 0],
        profiles=sums.profiles[kept].sum(),
        shots=sums.shots[kept].sum(),
        left_out=int(sums.profiles[~kept].sum()),
        cells=PartCells(power, variance, quantum),
        of_parts=of_parts,
    )
