"""Types of arrays of retrievals, tests and medians of values, and azimuths of several beams."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.compiled_code import compiled

Array = npt.NDArray[np.float64]
Block = npt.NDArray[Any]
Singles = npt.NDArray[np.float32]
Floats = Singles | Array
Booleans = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.int32]
"""Quality bits."""
Codes = npt.NDArray[np.uint8]
_Array = TypeVar("_Array", bound=Block)

HUGE: Final = 1e300
"""Magnitude from which a value counts as missing: a quick test for infinity and NaN."""


def frozen(values: _Array) -> _Array:
    """Return a contiguous read-only view; copy only where necessary.

    Numba treats writable and read-only arrays as different types, and would compile a function
    again for every combination of them.
    """
    view: Any = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view  # type: ignore[no-any-return]


@compiled
def usable(power: float, variance: float) -> bool:
    """Return whether a power and its variance are finite, and the variance not negative."""
    return abs(power) < HUGE and 0.0 <= variance < HUGE


def root_sum_square(parts: Iterable[Array]) -> Array:
    """Return the root of the sum of squares; NaN where any part is NaN."""
    return np.asarray(np.sqrt(sum(part**2 for part in parts)))


def median(values: Array, known: Booleans) -> Array:
    """Return medians over profiles of the known values; NaN where there is none."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    number, columns = known.sum(axis=0), np.arange(values.shape[1])
    ordered = np.sort(np.where(known, values, np.inf), axis=0)
    low, high = (ordered[place, columns] for place in (np.maximum(number - 1, 0) // 2, number // 2))
    return np.where(number > 0, 0.5 * (low + high), np.nan)


def widest_azimuth_gap(azimuth: Array) -> float:
    """Return the widest range of azimuths without a beam, radian.

    Parameters
    ----------
    azimuth : (angle,) float
        radian; only of beams that are not vertical.
    """
    if azimuth.size == 0:
        return 2.0 * np.pi
    ordered = np.sort(np.mod(azimuth, 2.0 * np.pi))
    return float(np.max(np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))))
