"""Clouds in the cells of a Raman retrieval."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.cells import Cells

States = npt.NDArray[np.int8]


def state_of_cells(state: States, cells: Cells, unknown: int) -> States:
    """Return the largest state of the bins of each cell; unknown where that of all bins is.

    Parameters
    ----------
    state : (..., bin) int8
    cells : Cells
    unknown : int
        The largest state, which does not count beside another.
    """
    parts = cells.split(state)
    known = np.where(parts == unknown, np.int8(-1), parts).max(axis=-1)
    return np.where(known < 0, np.int8(unknown), known).astype(np.int8)


def largest_of_cells(values: Array, cells: Cells) -> Array:
    """Return the largest finite value of the bins of each cell; NaN where there is none."""
    largest = np.nan_to_num(cells.split(values), nan=-np.inf).max(axis=-1)
    return np.where(np.isneginf(largest), np.nan, largest)


def touched(mask: Booleans, resolution: Array, step: float) -> Booleans:
    """Return the cells in whose values a marked cell takes part.

    Parameters
    ----------
    mask : (profile, cell) bool
    resolution : (profile, cell) float
        m, length over which a value is a mean; NaN for the cell itself.
    step : float
        m, length of a cell.
    """
    count = mask.shape[-1]
    half = np.ceil(np.maximum(np.nan_to_num(resolution) / step - 1.0, 0.0) / 2.0).astype(np.intp)
    number = np.arange(count)
    first, stop = np.maximum(number - half, 0), np.minimum(number + half + 1, count)
    sums = np.zeros((len(mask), count + 1), dtype=np.intp)
    np.cumsum(mask, axis=-1, out=sums[:, 1:])
    inside = np.take_along_axis(sums, stop, axis=-1) - np.take_along_axis(sums, first, axis=-1)
    return np.asarray(inside > 0)
