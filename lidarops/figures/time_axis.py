"""Times of profiles for figures: positions on an axis, UTC, and where measurements pause."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.datetime64]
Floats = NDArray[np.float64]

_GAP: Final = 2.5
"""An interval between profiles of more than this many usual intervals is a gap."""
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
