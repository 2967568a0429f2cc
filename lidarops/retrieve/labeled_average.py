"""Averages over time of labelled profiles: blocks of the clock, never of dask."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import dask.array as da
import numpy as np
import numpy.typing as npt
import xarray as xr
from dask.delayed import delayed

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve import averaging

_BATCH: Final = 256
"""Profiles that one task averages, unless one mean takes more."""

Shared = Callable[[npt.NDArray[np.datetime64]], npt.NDArray[np.float64]]

_Block = npt.NDArray[Any]


def clock_average(
    conditioned: xr.Dataset,
    *,
    seconds: float,
    shots: xr.DataArray,
    shared_variance: Shared | None = None,
) -> xr.Dataset:
    """Average profiles over intervals of the clock (UTC), weighted by their shots.

    Parameters
    ----------
    conditioned : xr.Dataset
        ``power``, ``variance`` and ``quality`` over (time, range), from
        `lidarops.retrieve.labeled_signal.condition`, with the coordinates ``time`` and
        ``time_bnds``; rising in time. May be dask-backed, chunked in any way.
    seconds : float
        Length of an interval; it divides a day.
    shots : xr.DataArray, (time,)
    shared_variance : callable, optional
        Gives the part of ``variance`` that neighbouring profiles have in common at times, (time,
        range), as that of a dark signal: it does not average down.

    Returns
    -------
    xr.Dataset
        ``power``, ``variance`` (of the mean, with the shared part) and ``quality`` over (time,
        range), ``shots`` (sum), ``profiles`` (number) over time, with ``time`` in the middle of
        ``time_bnds``, which span the profiles of the interval; the same to the last bit for
        any chunking. Intervals without a profile are left out. A mean carries every bit of its
        profiles, but INPUT_MISSING only where none is left.

    Raises
    ------
    RetrievalInputError
        Where `seconds` does not divide a day.
    """
    if not 0 < seconds <= 86400 or 86400 % seconds:
        raise RetrievalInputError(
            f"is {seconds:g} s", field="average", remedy="give a part of a day: 600, 1800, 3600"
        )
    bounds = conditioned["time_bnds"].to_numpy()
    moments = conditioned["time"].to_numpy()
    interval = (moments - np.datetime64("1970-01-01")) // np.timedelta64(round(seconds * 1e9), "ns")
    first = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
    weights = shots.to_numpy().astype(np.float64)
    past = np.append(first[1:], interval.size)
    starts, stops = bounds[first, 0], np.maximum.reduceat(bounds[:, 1], first)
    middles = starts + (stops - starts) // 2
    shared = None if shared_variance is None else shared_variance(middles)
    parts = [
        _part(
            conditioned,
            weights,
            None if shared is None else shared[low:high],
            first[low:high],
            int(past[high - 1]),
        )
        for low, high in _batches(first, past)
    ]
    names = ("power", "variance", "quality", "profiles")
    dims = (("time", "range"), ("time", "range"), ("time", "range"), ("time",))
    arrays = [da.concatenate([part[i] for part in parts]) for i in range(len(names))]  # type: ignore[no-untyped-call]
    result = xr.Dataset(
        {
            **{n: (d, a) for n, d, a in zip(names, dims, arrays, strict=True)},
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
    """Give runs of whole intervals of about `_BATCH` profiles."""
    low = 0
    for high in range(1, first.size + 1):
        if high == first.size or past[high] - first[low] > _BATCH:
            yield low, high
            low = high


def _part(
    conditioned: xr.Dataset,
    weights: npt.NDArray[np.float64],
    shared: npt.NDArray[np.float64] | None,
    first: npt.NDArray[np.intp],
    past: int,
) -> tuple[da.Array, ...]:
    start = int(first[0])
    inside = slice(start, past)
    blocks = [conditioned[name].isel(time=inside).data for name in ("power", "variance", "quality")]
    group = np.repeat(np.arange(first.size), np.diff(np.append(first, past)))
    whole = delayed(_averaged, nout=4, pure=True)(*blocks, weights[inside], shared, group)
    shape = (first.size, conditioned.sizes["range"])
    return tuple(
        da.from_delayed(  # type: ignore[no-untyped-call]
            piece, shape=shape[: 1 if index == 3 else 2], dtype=dtype
        )
        for index, (piece, dtype) in enumerate(
            zip(whole, (np.float64, np.float64, np.int32, np.int32), strict=True)
        )
    )


def _averaged(
    power: _Block,
    variance: _Block,
    quality: _Block,
    weights: npt.NDArray[np.float64],
    shared: npt.NDArray[np.float64] | None,
    group: npt.NDArray[np.intp],
) -> tuple[_Block, _Block, _Block, _Block]:
    if shared is not None:
        shared = shared[group]
        variance = np.maximum(variance - shared, 0.0)
    means = averaging.mean(
        power, variance, groups=group, weights=weights, shared_variance=shared, axis=0
    )
    first = np.flatnonzero(np.diff(group, prepend=-1))
    missing = np.int32(Quality.INPUT_MISSING)
    bits = np.bitwise_or.reduceat(quality & ~missing, first, axis=0)
    bits[~np.isfinite(means.values)] |= missing
    profiles = np.bincount(group).astype(np.int32)
    return means.values, means.variance + means.shared_variance, bits, profiles
