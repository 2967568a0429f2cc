"""Averages of profiles in xarray over intervals of the clock, for profiles that come in chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.signal.averaging import RunningMean
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH

_PROFILES_IN_CACHE: Final = 32
"""Profiles averaged together; they fit the processor cache."""
MEANS_TOGETHER: Final = 16
"""Means that are completed together, so that their sums take little memory."""
_MISSING: Final = np.int32(Quality.INPUT_MISSING)

Shared = Callable[[npt.NDArray[np.datetime64]], npt.NDArray[np.float64]]
Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.intp]


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
        self._counts = np.diff(first, append=interval.size)
        self._group = np.repeat(np.arange(first.size), self._counts)
        self._weights = shots.to_numpy().astype(np.float64)
        self._shots = np.add.reduceat(shots.to_numpy(), first).astype(np.int32)
        self._shared_variance = shared_variance
        self._distance = distance
        self._added = 0
        self._edges = np.append(first[::MEANS_TOGETHER], interval.size)
        self._completed: list[xr.Dataset] = []
        self._begin(0)

    @property
    def times(self) -> xr.Dataset:
        """``time`` and ``time_bnds`` of all means."""
        return xr.Dataset(coords=self._times(slice(None)))

    def _times(self, means: slice) -> dict[str, Any]:
        bounds = np.stack([self._starts[means], self._stops[means]], axis=-1)
        return {"time": self._middles[means], "time_bnds": (("time", "nv"), bounds)}

    def _begin(self, number: int) -> None:
        """Begin the means that are completed together."""
        self._open = slice(number, number + MEANS_TOGETHER)
        times = self._middles[self._open]
        shape = times.size, self._distance.size
        self._sums, self._bits = RunningMean(shape), np.zeros(shape, dtype=np.int32)
        self._lengths = RunningMean((times.size, 1))
        shared = self._shared_variance
        self._shared = None if shared is None or not times.size else shared(times)

    def add(self, conditioned: xr.Dataset) -> None:
        """Add the next profiles, from `lidarops.retrieve.signal.labeled.condition`."""
        names = ("power", "variance", "quality", CORRELATION_LENGTH)
        arrays = [conditioned[name].to_numpy() for name in names]
        units = {name: dict(conditioned[name].attrs) for name in ("power", "variance", "range")}
        first, count = 0, len(arrays[0])
        while first < count:
            left = self._edges[np.searchsorted(self._edges, self._added, side="right")]
            past = min(first + _PROFILES_IN_CACHE, count, first + int(left) - self._added)
            self._add(*(array[first:past] for array in arrays))
            if self._added == left:
                self._completed.append(self._means(units))
                self._begin(self._open.stop)
            first = past

    def _add(
        self, power: Array, variance: Array, quality: npt.NDArray[np.int32], length: Array
    ) -> None:
        profiles = slice(self._added, self._added + len(power))
        group = self._group[profiles] - self._open.start
        common = None if self._shared is None else self._shared[group]
        self._sums.add(
            power,
            variance if common is None else np.maximum(variance - common, 0.0),
            groups=group,
            weights=self._weights[profiles],
            shared_variance=0.0 if common is None else common,
        )
        weights = self._weights[profiles]
        self._lengths.add(length[:, np.newaxis], 0.0, groups=group, weights=weights)
        first = np.flatnonzero(np.diff(group, prepend=-1))
        self._bits[group[first]] |= np.bitwise_or.reduceat(quality & ~_MISSING, first, axis=0)
        self._added += len(power)

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

    def _means(self, units: dict[str, dict[str, Any]]) -> xr.Dataset:
        means, length = self._sums.averages(), self._lengths.averages().values[:, 0]
        self._bits[~np.isfinite(means.values)] |= _MISSING
        plane = ("time", "range")
        return xr.Dataset(
            {
                # A copy, because these are part of the sums, which are four times as large.
                "power": (plane, means.values.copy(), units["power"]),
                "variance": (plane, means.variance + means.shared_variance, units["variance"]),
                "quality": (plane, self._bits),
                # Without a shot it is not known, and neither is the mean.
                CORRELATION_LENGTH: ("time", np.nan_to_num(length, nan=1.0), {"units": "1"}),
                "profiles": ("time", self._counts[self._open].astype(np.int32)),
                "shots": ("time", self._shots[self._open]),
            },
            coords={
                **self._times(self._open),
                "range": ("range", self._distance, units["range"]),
            },
        )


def joined(batches: Iterator[xr.Dataset]) -> xr.Dataset:
    """Return the batches of `ClockAverage.completed` as one Dataset."""
    whole: xr.Dataset = xr.concat(
        list(batches), dim="time", data_vars="minimal", coords="minimal", join="override"
    )
    return whole
