"""Averages of profiles in xarray over intervals of the clock, for profiles that come in chunks.

`IntervalSums` sums the profiles of one record of the light, `ClockAverage` makes means of them, and
leaves out outlying parts of the intervals where it is to screen them.
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
from lidarops.retrieve.common.arrays import Array, Booleans, Flags
from lidarops.retrieve.signal.averaging import (
    PartCells,
    RunningMean,
    cells_of_parts,
    outlying_parts,
    tail_of_cells,
)
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH, DEAD_TIME_ERROR, SKY
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_PROFILES_IN_CACHE: Final = 32
"""Profiles averaged together; they fit the processor cache."""
MEANS_TOGETHER: Final = 16
"""Means that are completed together, so that their sums take little memory."""
_MISSING: Final = np.int32(Quality.INPUT_MISSING)
_DARK: Final = np.int32(Quality.NO_SIGNAL)

Shared = Callable[[npt.NDArray[np.datetime64]], Array]
Units = dict[str, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class PartSums:
    """Sums of the parts of one interval, from which its mean follows."""

    sums: RunningMean
    lengths: RunningMean
    """Of the noise, and of the background that bins before the pulse give."""
    quality: Flags
    """(part, range), without INPUT_MISSING, and NO_SIGNAL only where no profile has shots."""
    profiles: Flags
    """(part,), their numbers, without those that have no shots."""
    shots: Flags
    units: Units
    """Attributes of power, variance and range."""


class IntervalSums:
    """Sums of the profiles of a record over intervals of the clock (UTC), weighted by their shots.

    Profiles come in chunks, which do not change a bit of the result.

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
    parts : int
        Greatest number of parts of consecutive profiles, as equal in number as can be, into which
        an interval is cut. Means of a single part are those of the profiles to the last bit.
    lag : int
        Bins by which the record lags behind the last one of its channels.

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
        parts: int = 1,
        lag: int = 0,
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
        pieces = np.minimum(parts, counts)
        within = np.arange(interval.size) - np.repeat(first, counts)
        part = within * np.repeat(pieces, counts) // np.repeat(counts, counts)
        self._groups = np.append(0, np.cumsum(pieces))
        self._group = np.repeat(self._groups[:-1], counts) + part
        self._weights = shots.to_numpy().astype(np.float64)
        begins = np.flatnonzero(np.diff(self._group, prepend=-1))
        self._profiles = np.add.reduceat((self._weights > 0.0).astype(np.int32), begins)
        self._shots = np.add.reduceat(shots.to_numpy(), begins).astype(np.int32)
        self._shared_variance = shared_variance
        self.range, self.lag = distance, lag
        self.counts = counts.astype(np.int32)
        """Numbers of all profiles of each interval."""
        self._added = 0
        self._edges = np.append(first, interval.size)
        self._complete: list[PartSums] = []
        self._begin(0)

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return xr.Dataset(coords=self.times_of(slice(None)))

    @property
    def left(self) -> int:
        """Number of profiles to the end of the open interval; 0 after the last."""
        following = np.searchsorted(self._edges, self._added, side="right")
        return 0 if following == self._edges.size else int(self._edges[following]) - self._added

    def times_of(self, means: slice) -> dict[str, Any]:
        """Return ``time`` and ``time_bnds`` of some means."""
        bounds = np.stack([self._starts[means], self._stops[means]], axis=-1)
        return {"time": self._middles[means], "time_bnds": (("time", "nv"), bounds)}

    def _begin(self, number: int) -> None:
        """Begin an interval."""
        self._open, groups = number, self._groups[number : number + 2]
        self._first_group, shape = int(groups[0]), (int(np.ptp(groups)), self.range.size)
        self._sums, self._bits = RunningMean(shape), np.zeros(shape, dtype=np.int32)
        self._lengths = RunningMean((shape[0], 2))
        shared, times = self._shared_variance, self._middles[number : number + 1]
        self._shared = None if shared is None or not times.size else shared(times)

    def add(self, conditioned: xr.Dataset, rows: slice = slice(None)) -> None:
        """Add the next profiles, from `lidarops.retrieve.signal.labeled.condition`."""
        names = ("power", "variance", "quality", CORRELATION_LENGTH)
        arrays = [conditioned[name].to_numpy()[rows] for name in names]
        # Without bins before the pulse, this is not used.
        sky = (
            conditioned[SKY].to_numpy()[rows]
            if SKY in conditioned
            else np.zeros((len(arrays[0]), 2))
        )
        arrays.append(sky)
        stated = [name for name in ("power", "variance", "range", SKY) if name in conditioned]
        units = {name: dict(conditioned[name].attrs) for name in stated}
        first, count = 0, len(arrays[0])
        while first < count:
            left = self.left
            past = min(first + _PROFILES_IN_CACHE, count, first + left)
            self._add(*(array[first:past] for array in arrays))
            if past - first == left:
                groups = slice(self._first_group, self._first_group + len(self._bits))
                numbers = self._profiles[groups], self._shots[groups]
                self._bits &= ~_DARK if numbers[0].any() else -1
                self._complete.append(
                    PartSums(self._sums, self._lengths, self._bits, *numbers, units)
                )
                self._begin(self._open + 1)
            first = past

    def _add(
        self,
        power: Array,
        variance: Array,
        quality: npt.NDArray[np.int32],
        length: Array,
        sky: Array,
    ) -> None:
        profiles = slice(self._added, self._added + len(power))
        group, weights = self._group[profiles] - self._first_group, self._weights[profiles]
        # Parts share the variance of their mean.
        common = self._shared
        self._sums.add(
            power,
            variance if common is None else np.maximum(variance - common, 0.0),
            groups=group,
            weights=weights,
            shared_variance=0.0 if common is None else common,
        )
        scalars, errors = np.insert(sky, 0, length, axis=1), np.insert(sky[:, 1:], 0, 0.0, axis=1)
        self._lengths.add(scalars[:, :2], errors, groups=group, weights=weights)
        for number, bits in zip(group, quality, strict=True):
            self._bits[number] |= bits & ~_MISSING
        self._added += len(power)

    def completed(self) -> Iterator[PartSums]:
        """Yield the sums of the intervals that are complete, and forget them."""
        sums, self._complete = self._complete, []
        yield from sums


def joined(batches: Iterator[xr.Dataset]) -> xr.Dataset:
    """Return batches of means as one Dataset."""
    whole: xr.Dataset = xr.concat(
        list(batches), dim="time", data_vars="minimal", coords="minimal", join="override"
    )
    return whole


@dataclass(frozen=True, slots=True)
class Screening:
    """What makes a part of a mean outlying."""

    contrast: float
    """Factor by which the light of a cell may differ from part to part."""
    highest: float
    """m along the beam, to which parts are compared: beyond, single bursts of counts, of which real
    night files have some, would cost a part of the mean and change nothing that is retrieved."""


class ClockAverage:
    """Means of profiles over intervals of the clock.

    With a screening, the parts that are outlying in any record are left out of all
    (`lidarops.retrieve.signal.averaging`). Chunks of profiles do not change a bit of the result.

    Parameters
    ----------
    records : sequence of IntervalSums
        Of one channel or several, two of each that is glued, with bins of equal width; with a
        screening, of `THRESHOLDS.most_parts` parts.
    screening : Screening, optional
    """

    def __init__(self, records: Sequence[IntervalSums], screening: Screening | None = None) -> None:
        self._records, self._screening = records, screening
        distance = records[0].range
        self._step = float(np.median(np.diff(distance))) if distance.size > 1 else 1.0
        self._bins = max(round(THRESHOLDS.cell_length / self._step), 1)
        self._first = int(np.searchsorted(records[-1].range, 0.0, side="right"))
        self._first_range = float(records[-1].range[0]) + self._first * self._step
        self._past = min(record.range.size for record in records)
        self._open: list[tuple[dict[str, Any], ...]] = []
        self._number, self._total = 0, self.times.sizes["time"]
        self._completed: list[tuple[xr.Dataset, ...]] = []

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return self._records[-1].times

    def add(self, conditioned: Sequence[xr.Dataset]) -> None:
        """Add the next profiles of each record (`IntervalSums.add`)."""
        first, count = 0, conditioned[0].sizes["time"]
        while first < count:
            # One interval at a time, because the sums of its parts are large.
            past = min(first + self._records[0].left, count)
            for record, profiles in zip(self._records, conditioned, strict=True):
                record.add(profiles, slice(first, past))
            for parts in zip(*(record.completed() for record in self._records), strict=True):
                self._complete(parts)
            first = past

    def completed(self) -> Iterator[tuple[xr.Dataset, ...]]:
        """Yield the means that all their profiles were added to, in batches; and forget them.

        Yields
        ------
        xr.Dataset of each record
            ``power``, ``variance`` (of the mean, with the shared part) and ``quality`` over (time,
            range), ``noise_correlation_length`` (mean), ``shots`` (sum), ``profiles`` (number) over
            time. ``time`` is the middle of
            ``time_bnds``, which span the profiles of the interval. Intervals without a profile are
            omitted. A mean has all quality bits of its profiles, but INPUT_MISSING only if no
            profile has data, and NO_SIGNAL only if none has light: profiles without shots, as those
            without light have none, are not in it.

            With a screening also ``part_power`` (background subtracted) and ``part_variance`` over
            (time, part, cell) of parts that are in the mean, means over cells of ``bins``
            (attribute) bins from the first range above zero of the last record on
            (``first_range``), NaN where missing; ``part_quantum`` (the power of a count in a cell,
            0 for analog records) and ``part_profiles`` over (time, part), the numbers of their
            profiles, and ``profiles_left_out`` over time. ``profiles`` and ``shots`` are those in
            the mean.
        """
        batches, self._completed = self._completed, []
        yield from batches

    def _complete(self, parts: tuple[PartSums, ...]) -> None:
        if self._screening is None:
            means = (_mean(sums, np.ones(len(sums.quality), np.bool_)) for sums in parts)
        else:
            cells = [
                self._cells(record, sums) for record, sums in zip(self._records, parts, strict=True)
            ]
            compared = slice(int(self._screening.highest / (self._bins * self._step)))
            contrast = self._screening.contrast
            outlying = [outlying_parts(one, compared, contrast=contrast) for one in cells]
            kept = ~np.logical_or.reduce(outlying)
            means = (
                _mean(sums, kept) | _parts(sums, of_cells, kept)
                for sums, of_cells in zip(parts, cells, strict=True)
            )
        self._open.append(tuple(means))
        done = self._number + len(self._open)
        if len(self._open) == MEANS_TOGETHER or done == self._total:
            numbers = slice(self._number, done)
            batch = zip(self._records, zip(*self._open, strict=True), parts, strict=True)
            self._completed.append(
                tuple(self._labeled(record, numbers, of, sums.units) for record, of, sums in batch)
            )
            self._number, self._open = done, []

    def _cells(self, record: IntervalSums, sums: PartSums) -> PartCells:
        """Return the signal of parts without background, (part, cell), and its variance."""
        usable = (sums.quality & np.int32(WITHHELD)) == 0
        lag = record.lag
        power, variance = cells_of_parts(
            sums.sums.sums, usable, self._first + lag, self._past + lag, self._bins
        )
        totals, weighted = sums.lengths.sums[:2, :, :1]
        variance *= np.where(totals > 0.0, weighted / np.maximum(totals, 1.0), 1.0)
        sky, error = tail_of_cells(power, variance)
        power -= sky
        variance += error**2
        # The power of a count in a bin; 0 for analog records.
        counts = LICEL_RANGE_PER_MICROSECOND if DEAD_TIME_ERROR in sums.units["power"] else 0.0
        quantum = counts / (np.maximum(sums.shots, 1) * self._step)
        return PartCells(power, variance, quantum / self._bins)

    def _labeled(
        self, record: IntervalSums, numbers: slice, means: Sequence[dict[str, Any]], units: Units
    ) -> xr.Dataset:
        """Return means of a record with their coordinates, as `completed` yields them."""
        of = {name: np.stack([mean[name] for mean in means]) for name in means[0]}
        missing = np.where(np.isfinite(of["power"]), np.int32(0), _MISSING)
        plane, cells = ("time", "range"), ("time", "part", "cell")
        labeled = xr.Dataset(
            {
                "power": (plane, of["power"], units["power"]),
                "variance": (plane, of["variance"], units["variance"]),
                "quality": (plane, of["quality"] | missing),
                # Without a shot it is not known, and neither is the mean.
                CORRELATION_LENGTH: ("time", np.nan_to_num(of["length"], nan=1.0), {"units": "1"}),
                "profiles": ("time", of["profiles"]),
                "shots": ("time", of["shots"]),
            },
            coords={**record.times_of(numbers), "range": ("range", record.range, units["range"])},
        )
        if SKY in units:
            labeled[SKY] = ("time", "sky_part"), of[SKY]
        if self._screening is None:
            return labeled
        parts = [name for name in of if name.startswith("part_")]
        labeled = labeled.assign({name: (cells[: of[name].ndim], of[name]) for name in parts})
        labeled["part_power"].attrs = {"bins": self._bins, "first_range": self._first_range}
        left_out = record.counts[numbers] - of["profiles"]
        return labeled.assign(profiles_left_out=("time", left_out))


def _mean(sums: PartSums, kept: Booleans) -> dict[str, Any]:
    """Return the mean of the parts that are kept."""
    averages, scalars = sums.sums.joined(kept), sums.lengths.joined(kept)
    quality = sums.quality if kept.all() else sums.quality[kept]
    return {
        "power": averages.values[0],
        "variance": (averages.variance + averages.shared_variance)[0],
        "quality": np.bitwise_or.reduce(quality, axis=0),
        "length": float(scalars.values[0, 0]),
        SKY: np.array([scalars.values[0, 1], scalars.variance[0, 1]]),
        "profiles": np.int32(sums.profiles[kept].sum()),
        "shots": np.int32(sums.shots[kept].sum()),
    }


def _parts(sums: PartSums, cells: PartCells, kept: Booleans) -> dict[str, Any]:
    """Return the cells of the parts of a mean: NaN in those that are not kept."""
    parts = THRESHOLDS.most_parts
    shape = parts, cells.power.shape[1]
    power, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    quantum, of_parts = np.zeros(parts), np.zeros(parts, dtype=np.int32)
    places = np.flatnonzero(kept)
    power[places], variance[places] = cells.power[places], cells.variance[places]
    quantum[places], of_parts[places] = cells.quantum[places], sums.profiles[places]
    return {
        "part_power": power,
        "part_variance": variance,
        "part_quantum": quantum,
        "part_profiles": of_parts,
    }
