"""Averages of profiles in xarray over intervals of the clock, for profiles that come in chunks.

`ClockAverage` averages all profiles, `ScreenedAverage` leaves out outlying parts of the intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, frozen
from lidarops.retrieve.signal.averaging import (
    Averages,
    PartCells,
    RunningMean,
    cells_of_parts,
    join_bits,
    outlying_parts,
    tail_of_cells,
)
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH, DEAD_TIME_ERROR
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_PROFILES_IN_CACHE: Final = 32
"""Profiles averaged together; they fit the processor cache."""
MEANS_TOGETHER: Final = 16
"""Means that are completed together, so that their sums take little memory."""
_MISSING: Final = np.int32(Quality.INPUT_MISSING)

_AVERAGES: Final = ("values", "variance", "shared_variance")
Shared = Callable[[npt.NDArray[np.datetime64]], Array]
Units = dict[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class PartSums:
    """Sums of the parts of one interval, from which its mean follows."""

    sums: RunningMean
    lengths: RunningMean
    quality: Flags
    """(part, range), without INPUT_MISSING."""
    profiles: Flags
    """(part,), their numbers."""
    shots: Flags
    units: Units
    """Attributes of power, variance and range."""


class ClockAverage:
    """Means of profiles over intervals of the clock (UTC), weighted by their shots.

    Profiles come in chunks, which do not change a bit of the result. Means are held until they are
    taken.

    Parameters
    ----------
    geometry : xr.Dataset
        ``time`` and ``time_bnds`` of all profiles, ascending.
    distance : (range,) float
        m.
    seconds : float
        Length of an interval; it must divide a day.
    shots : xr.DataArray, (time,)
        Of all profiles.
    shared_variance : callable, optional
        Returns the part of ``variance`` that neighbouring profiles have in common at given
        times, (time, range), such as that of a dark signal. It does not average down.
    parts : int, optional
        Greatest number of parts of an interval. It is then cut into parts of consecutive profiles,
        as equal in number as can be, and `completed_parts` gives their sums.

    Raises
    ------
    RetrievalInputError
        Where `seconds` does not divide a day.
    """

    def __init__(
        self,
        geometry: xr.Dataset,
        distance: Array,
        *,
        seconds: float,
        shots: xr.DataArray,
        shared_variance: Shared | None = None,
        parts: int | None = None,
    ) -> None:
        if not 0 < seconds <= 86400 or 86400 % seconds:
            raise RetrievalInputError(
                f"is {seconds:g} s",
                field="average",
                remedy="give seconds that divide a day: 600, 1800, 3600",
            )
        bounds, times = geometry["time_bnds"].to_numpy(), geometry["time"].to_numpy()
        length = np.timedelta64(round(seconds * 1e9), "ns")
        interval = (times - np.datetime64("1970-01-01")) // length
        first = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
        self._starts, self._stops = bounds[first, 0], np.maximum.reduceat(bounds[:, 1], first)
        self._middles = self._starts + (self._stops - self._starts) // 2
        counts = np.diff(first, append=interval.size)
        pieces = np.minimum(parts or 1, counts)
        within = np.arange(interval.size) - np.repeat(first, counts)
        part = within * np.repeat(pieces, counts) // np.repeat(counts, counts)
        self._groups = np.append(0, np.cumsum(pieces))
        self._group = np.repeat(self._groups[:-1], counts) + part
        self._weights = shots.to_numpy().astype(np.float64)
        begins = np.flatnonzero(np.diff(self._group, prepend=-1))
        self._profiles = np.diff(begins, append=interval.size).astype(np.int32)
        self._shots = np.add.reduceat(shots.to_numpy(), begins).astype(np.int32)
        self._shared_variance = shared_variance
        self._distance = distance
        self._added = 0
        self._together = 1 if parts else MEANS_TOGETHER
        self._edges = np.append(first[:: self._together], interval.size)
        self._completed: list[xr.Dataset] = []
        self._parts: list[PartSums] | None = [] if parts else None
        self._begin(0)

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return xr.Dataset(coords=self.times_of(slice(None)))

    @property
    def left(self) -> int:
        """Number of profiles to the end of the means that are completed next; 0 after the last."""
        following = np.searchsorted(self._edges, self._added, side="right")
        return 0 if following == self._edges.size else int(self._edges[following]) - self._added

    def times_of(self, means: slice) -> dict[str, Any]:
        """Return ``time`` and ``time_bnds`` of some means."""
        bounds = np.stack([self._starts[means], self._stops[means]], axis=-1)
        return {"time": self._middles[means], "time_bnds": (("time", "nv"), bounds)}

    def _begin(self, number: int) -> None:
        """Begin the means that are completed together."""
        self._open = slice(number, min(number + self._together, self._middles.size))
        first, past = self._groups[[self._open.start, self._open.stop]]
        self._first_group = int(first)
        shape = int(past - first), self._distance.size
        self._sums, self._bits = RunningMean(shape), np.zeros(shape, dtype=np.int32)
        self._lengths = RunningMean((shape[0], 1))
        shared, times = self._shared_variance, self._middles[self._open]
        self._shared = None if shared is None or not times.size else shared(times)

    def add(self, conditioned: xr.Dataset, rows: slice = slice(None)) -> None:
        """Add the next profiles, from `lidarops.retrieve.signal.labeled.condition`."""
        names = ("power", "variance", "quality", CORRELATION_LENGTH)
        arrays = [conditioned[name].to_numpy()[rows] for name in names]
        units = {name: dict(conditioned[name].attrs) for name in ("power", "variance", "range")}
        first, count = 0, len(arrays[0])
        while first < count:
            left = self.left
            past = min(first + _PROFILES_IN_CACHE, count, first + left)
            self._add(*(array[first:past] for array in arrays))
            if past - first == left:
                self._complete(units)
                self._begin(self._open.stop)
            first = past

    def _add(
        self, power: Array, variance: Array, quality: npt.NDArray[np.int32], length: Array
    ) -> None:
        profiles = slice(self._added, self._added + len(power))
        group = self._group[profiles] - self._first_group
        # Parts share the variance of their mean.
        mean = group if self._parts is None else np.zeros_like(group)
        common = None if self._shared is None else self._shared[mean]
        self._sums.add(
            power,
            variance if common is None else np.maximum(variance - common, 0.0),
            groups=group,
            weights=self._weights[profiles],
            shared_variance=0.0 if common is None else common,
        )
        weights = self._weights[profiles]
        self._lengths.add(length[:, np.newaxis], 0.0, groups=group, weights=weights)
        join_bits(frozen(quality), frozen(group), int(~_MISSING), self._bits)
        self._added += len(power)

    def _complete(self, units: Units) -> None:
        """Keep what is complete."""
        groups = slice(self._first_group, self._first_group + len(self._bits))
        profiles, shots = self._profiles[groups], self._shots[groups]
        if self._parts is not None:
            self._parts.append(
                PartSums(self._sums, self._lengths, self._bits, profiles, shots, units)
            )
            return
        length = self._lengths.averages().values[:, 0]
        means = self._sums.averages(), self._bits, length, profiles, shots
        self._completed.append(self.labeled(self._open, *means, units))

    def completed_parts(self) -> Iterator[PartSums]:
        """Yield the sums of the parts of the intervals that are complete, and forget them."""
        sums = list(self._parts or ())
        if self._parts is not None:
            self._parts.clear()
        yield from sums

    def completed(self) -> Iterator[xr.Dataset]:
        """Yield the means that all their profiles were added to, in batches, and forget them.

        Yields
        ------
        xr.Dataset
            ``power``, ``variance`` (of the mean, with the shared part) and ``quality`` over (time,
            range), ``noise_correlation_length`` (mean), ``shots`` (sum), ``profiles`` (number) over
            time. ``time`` is the middle of
            ``time_bnds``, which span the profiles of the interval. Intervals without a profile are
            omitted. A mean has all quality bits of its profiles, but INPUT_MISSING only if no
            profile has data.
        """
        batches, self._completed = self._completed, []
        yield from batches

    def result(self) -> xr.Dataset:
        """Return the means of all profiles, as `completed` yields them."""
        return joined(self.completed())

    def labeled(
        self,
        means: slice,
        values: Averages,
        quality: Flags,
        length: Array,
        profiles: Flags,
        shots: Flags,
        units: Units,
    ) -> xr.Dataset:
        """Return means with their coordinates, as `completed` yields them.

        Parameters
        ----------
        means : slice
            Their numbers.
        values : Averages
        quality : (time, range) int32
            Without INPUT_MISSING.
        length, profiles, shots : (time,)
        units : dict of dict
            Attributes of power, variance and range.
        """
        missing = np.where(np.isfinite(values.values), np.int32(0), _MISSING)
        plane = ("time", "range")
        return xr.Dataset(
            {
                # A copy, because these are part of the sums, which are four times as large.
                "power": (plane, values.values.copy(), units["power"]),
                "variance": (plane, values.variance + values.shared_variance, units["variance"]),
                "quality": (plane, quality | missing),
                # Without a shot it is not known, and neither is the mean.
                CORRELATION_LENGTH: ("time", np.nan_to_num(length, nan=1.0), {"units": "1"}),
                "profiles": ("time", profiles),
                "shots": ("time", shots),
            },
            coords={**self.times_of(means), "range": ("range", self._distance, units["range"])},
        )


def joined(batches: Iterator[xr.Dataset]) -> xr.Dataset:
    """Return the batches of `ClockAverage.completed` as one Dataset."""
    whole: xr.Dataset = xr.concat(
        list(batches), dim="time", data_vars="minimal", coords="minimal", join="override"
    )
    return whole


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


class ScreenedAverage:
    """Means of profiles over intervals of the clock, without outlying parts.

    The profiles of an interval are divided into at most `THRESHOLDS.most_parts` parts, and those
    that are outlying in any record are left out of all (`lidarops.retrieve.signal.averaging`).
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
        self._open: list[tuple[dict[str, Any], ...]] = []
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
        self,
        record: Record,
        numbers: slice,
        means: Sequence[dict[str, Any]],
        units: dict[str, Any],
    ) -> xr.Dataset:
        of = {name: np.stack([mean[name] for mean in means]) for name in means[0]}
        averages = Averages(*(of[name][:, 0] for name in _AVERAGES))
        labeled = record.means.labeled(
            numbers, averages, of["quality"], of["length"], of["profiles"], of["shots"], units
        )
        along = ("time", "part", "cell")
        cells = {"bins": self._bins, "first_range": self._first_range}
        return labeled.assign(
            part_power=(along, of["part_power"], cells),
            part_variance=(along, of["part_variance"]),
            part_quantum=(along[:2], of["part_quantum"]),
            part_profiles=(along[:2], of["part_profiles"]),
            profiles_left_out=("time", of["left_out"]),
        )


def _mean(sums: PartSums, cells: PartCells, kept: Booleans) -> dict[str, Any]:
    """Return the mean of the parts that are kept, and their cells: NaN in those that are not."""
    parts = THRESHOLDS.most_parts
    shape = parts, cells.power.shape[1]
    power, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    quantum, of_parts = np.zeros(parts), np.zeros(parts, dtype=np.int32)
    places = np.flatnonzero(kept)
    power[places], variance[places] = cells.power[places], cells.variance[places]
    quantum[places], of_parts[places] = cells.quantum[places], sums.profiles[places]
    averages = sums.sums.joined(kept)
    quality = sums.quality if kept.all() else sums.quality[kept]
    return {
        **{name: getattr(averages, name) for name in _AVERAGES},
        "quality": np.bitwise_or.reduce(quality, axis=0),
        "length": float(sums.lengths.joined(kept).values[0, 0]),
        "profiles": np.int32(sums.profiles[kept].sum()),
        "shots": np.int32(sums.shots[kept].sum()),
        "left_out": np.int32(sums.profiles[~kept].sum()),
        "part_power": power,
        "part_variance": variance,
        "part_quantum": quantum,
        "part_profiles": of_parts,
    }
