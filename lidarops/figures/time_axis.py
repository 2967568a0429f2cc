"""Times of profiles for figures: positions on an axis, UTC, columns, and pauses of measurement."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Times = NDArray[np.datetime64]
Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

TIME_BOUNDS: Final = "time_bnds"
_GAP: Final = 2.5
"""An interval between profiles of more than this many usual intervals is a gap."""
_TOUCHING: Final = 10.0
"""Columns touch across a pause of at most this many of their profiles that is no gap: one minute
measured in every ten is shown as one area, but not five seconds in an hour."""
_DAY: Final = np.timedelta64(1, "D")
_EPOCH: Final = np.datetime64(0, "ns")


def days(time: Times) -> Floats:
    """Return times as days since 1970, the positions on axes of time."""
    return np.asarray((time - _EPOCH) / _DAY)


def segments(time: Times) -> list[slice]:
    """Split sorted times at gaps.

    Parameters
    ----------
    time : ndarray of datetime64, shape (n,)
        Middles of profiles, rising.

    Returns
    -------
    list of slice
        One per stretch without a gap, in order; empty for no times.
    """
    if time.size == 0:
        return []
    cuts = 1 + np.flatnonzero(np.diff(time) > _GAP * usual_step(time))
    edges = [0, *(int(cut) for cut in cuts), time.size]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def usual_step(time: Times) -> np.timedelta64:
    """Return the median interval of sorted times; one minute if there is none."""
    steps = np.diff(time.astype("datetime64[ns]").astype(np.int64))
    steps = steps[steps > 0]
    return np.timedelta64(int(np.median(steps)) if steps.size else 60_000_000_000, "ns")


def profile_bounds(product: xr.Dataset) -> tuple[Times, Times]:
    """Return start and end of each profile; without bounds half the usual step around its time."""
    if TIME_BOUNDS in product.variables:
        bounds = product.variables[TIME_BOUNDS].values.astype("datetime64[ns]")
        return bounds[:, 0], bounds[:, 1]
    time = product.variables["time"].values.astype("datetime64[ns]")
    half = usual_step(np.sort(time)) / 2
    return np.asarray(time - half), np.asarray(time + half)


def column_starts(start: Times, stop: Times, size: int) -> Indices:
    """Return the first profile of each column of `size` profiles; none extends across a gap."""
    stretches = segments(start + (stop - start) / 2)
    return np.concatenate([np.arange(s.start, s.stop, size) for s in stretches])


def column_edges(start: Times, stop: Times, columns: Indices) -> tuple[Times, Times]:
    """Return the edges of columns; they touch where the pause between them is short and no gap."""
    last = np.append(columns[1:], start.size) - 1
    left, right = start[columns], stop[last]
    length = np.median(stop - start)
    pause = left[1:] - right[:-1]
    gaps = [stretch.start for stretch in segments(start + (stop - start) / 2)]
    touching = np.flatnonzero((np.abs(pause) <= _TOUCHING * length) & ~np.isin(columns[1:], gaps))
    middle = right[touching] + pause[touching] / 2
    left[touching + 1], right[touching] = middle, middle
    return left, right
