"""Averages of profiles in xarray over intervals of the clock, for any chunks of dask."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import dask.array as da
import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.signal import averaging

_BATCH: Final = 256
"""Profiles per task, unless one mean needs more."""
_PROFILES_IN_CACHE: Final = 32
"""Profiles averaged together, unless one mean needs more; they fit the processor cache."""

Shared = Callable[[npt.NDArray[np.datetime64]], npt.NDArray[np.float64]]

_Block = npt.NDArray[Any]


def clock_average(
    conditioned: xr.Dataset,
    *,
    seconds: float,
    shots: xr.DataArray,
    shared_variance: Shared | None = None,
) -> xr.Dataset:
    """Return means of profiles over intervals of the clock (UTC), weighted by their shots.

    Parameters
    ----------
    conditioned : xr.Dataset
        ``power``, ``variance`` and ``quality`` over (time, range), from
        `lidarops.retrieve.signal.labeled.condition`, with the coordinates ``time`` and
        ``time_bnds``; ascending in time. May be dask-backed, with any chunks.
    seconds : float
        Length of an interval; it must divide a day.
    shots : xr.DataArray, (time,)
    shared_variance : callable, optional
        Returns the part of ``variance`` that neighbouring profiles have in common at given
        times, (time, range), such as that of a dark signal. It does not average down.

    Returns
    -------
    xr.Dataset
        ``power``, ``variance`` (of the mean, with the shared part) and ``quality`` over (time,
        range), ``shots`` (sum), ``profiles`` (number) over time. ``time`` is the middle of
        ``time_bnds``, which span the profiles of the interval. Chunks do not change a bit of the
        result. Intervals without a profile are omitted. A mean has all quality bits of its
        profiles, but INPUT_MISSING only if no profile has data.

    Raises
    ------
    RetrievalInputError
        Where `seconds` does not divide a day.
    """
    if not 0 < seconds <= 86400 or 86400 % seconds:
        raise RetrievalInputError(
            f"is {seconds:g} s",
            field="average",
            remedy="give seconds that divide a day: 600, 1800, 3600",
        )
    bounds = conditioned["time_bnds"].to_numpy()
    times = conditioned["time"].to_numpy()
    interval = (times - np.datetime64("1970-01-01")) // np.timedelta64(round(seconds * 1e9), "ns")
    first = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
    past = np.append(first[1:], interval.size)
    starts, stops = bounds[first, 0], np.maximum.reduceat(bounds[:, 1], first)
    middles = starts + (stops - starts) // 2
    shared = None if shared_variance is None else shared_variance(middles)
    packed = _packed(conditioned, shots.to_numpy().astype(np.float64), shared, first, past)
    result = xr.Dataset(
        {
            "power": (("time", "range"), packed[:, 0]),
            "variance": (("time", "range"), packed[:, 1]),
            "quality": (("time", "range"), packed[:, 2].astype(np.int32)),
            "profiles": ("time", np.diff(first, append=interval.size).astype(np.int32)),
            "shots": ("time", np.add.reduceat(shots.to_numpy(), first).astype(np.int32)),
        },
        coords={
            "time": middles,
            "time_bnds": (("time", "nv"), np.stack([starts, stops], axis=-1)),
            "range": conditioned["range"],
        },
    )
    for name in ("power", "variance"):
        result[name].attrs = dict(conditioned[name].attrs)
    return result


def _batches(first: npt.NDArray[np.intp], past: npt.NDArray[np.intp]) -> Iterator[tuple[int, int]]:
    """Yield runs of whole intervals of about `_BATCH` profiles, as (first, past)."""
    low = 0
    for high in range(1, first.size + 1):
        if high == first.size or past[high] - first[low] > _BATCH:
            yield low, high
            low = high


def _packed(
    conditioned: xr.Dataset,
    weights: npt.NDArray[np.float64],
    shared: npt.NDArray[np.float64] | None,
    first: npt.NDArray[np.intp],
    past: npt.NDArray[np.intp],
) -> da.Array:
    """Return power, variance and quality bits of the means in one array, (interval, 3, range).

    A common array from inputs with equal chunks lets dask compute the inputs only once.
    """
    batches = list(_batches(first, past))
    profiles = tuple(int(past[high - 1] - first[low]) for low, high in batches)
    intervals = tuple(high - low for low, high in batches)
    bins = conditioned.sizes["range"]
    group = np.repeat(np.arange(first.size), past - first)
    if shared is None:
        shared = np.zeros((first.size, bins))
    arrays = [
        da.asarray(conditioned[name].data).rechunk((profiles, (bins,)))  # type: ignore[no-untyped-call]
        for name in ("power", "variance", "quality")
    ]
    columns = [da.from_array(column, chunks=(profiles,)) for column in (weights, group)]  # type: ignore[no-untyped-call]
    rows = da.from_array(shared, chunks=(intervals, (bins,)))  # type: ignore[no-untyped-call]
    packed: da.Array = da.blockwise(  # type: ignore[no-untyped-call]
        _averaged,
        "tpr",
        *(argument for array in arrays for argument in (array, "tr")),
        *(argument for column in columns for argument in (column, "t")),
        rows,
        "tr",
        new_axes={"p": 3},
        adjust_chunks={"t": intervals},
        align_arrays=False,
        dtype=np.float64,
    )
    return packed


def _averaged(
    power: _Block,
    variance: _Block,
    quality: _Block,
    weights: npt.NDArray[np.float64],
    group: npt.NDArray[np.intp],
    shared: npt.NDArray[np.float64],
) -> _Block:
    ends = np.flatnonzero(np.diff(group, append=group[-1] + 1)) + 1
    pieces = []
    first, low = 0, 0
    for high, end in enumerate(map(int, ends), start=1):
        # Average in pieces of whole intervals that fit the cache.
        if high == ends.size or ends[high] - first > _PROFILES_IN_CACHE:
            rows = slice(first, end)
            pieces.append(
                _averaged_piece(
                    power[rows],
                    variance[rows],
                    quality[rows],
                    weights[rows],
                    group[rows] - group[first],
                    shared[low:high],
                )
            )
            first, low = end, high
    return np.concatenate(pieces)


def _averaged_piece(
    power: _Block,
    variance: _Block,
    quality: _Block,
    weights: npt.NDArray[np.float64],
    interval: npt.NDArray[np.intp],
    shared: npt.NDArray[np.float64],
) -> _Block:
    common = shared[interval]
    means = averaging.time_mean(
        power,
        np.maximum(variance - common, 0.0),
        groups=interval,
        weights=weights,
        shared_variance=common,
        axis=0,
    )
    first = np.flatnonzero(np.diff(interval, prepend=-1))
    missing = np.int32(Quality.INPUT_MISSING)
    bits = np.bitwise_or.reduceat(quality & ~missing, first, axis=0)
    bits[~np.isfinite(means.values)] |= missing
    return np.stack([means.values, means.variance + means.shared_variance, bits], axis=1)
