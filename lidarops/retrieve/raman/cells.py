"""Cells of several bins, which the Raman retrieval solves for, and clouds in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Cells:
    """Equal numbers of neighbouring bins."""

    first: int
    """First bin of the first cell."""
    bins: int
    """Bins of a cell."""
    range: Array
    """m, middle of each cell."""
    step: float
    """m."""

    @property
    def stop(self) -> int:
        """First bin beyond the last cell."""
        return self.first + self.bins * self.range.size

    def split(self, values: npt.NDArray[T]) -> npt.NDArray[T]:
        """Return (..., bin) values as (..., cell, bin of the cell)."""
        inside = values[..., self.first : self.stop]
        return inside.reshape(*inside.shape[:-1], self.range.size, self.bins)

    def mean(self, values: Array) -> Array:
        """Return the mean of each cell over its bins that are finite, NaN where there is none."""
        parts = self.split(values)
        known = np.isfinite(parts)
        count = known.sum(axis=-1)
        total = np.where(known, parts, 0.0).sum(axis=-1)
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))

    def known(self, values: Array) -> Array:
        """Return the number of finite bins of each cell."""
        return np.asarray(np.isfinite(self.split(values)).sum(axis=-1).astype(np.float64))


def make_cells(range: Array, highest: float, length: float) -> Cells:  # noqa: A002
    """Return the cells of about `length` m from the first bin with a positive range to `highest` m.

    Parameters
    ----------
    range : (bin,) float
        m, ascending and uniform.
    highest, length : float
        m.

    Raises
    ------
    RetrievalInputError
        If the range holds fewer than 2 cells.
    """
    width = float(np.median(np.diff(range)))
    bins = max(1, round(length / width))
    first = int(np.searchsorted(range, 0.0, side="right"))
    count = (int(np.searchsorted(range, highest, side="right")) - first) // bins
    if count < 2:
        raise RetrievalInputError(
            f"holds fewer than 2 cells of {bins * width:g} m below {highest:g} m", field="range"
        )
    inside = range[first : first + count * bins].reshape(count, bins)
    return Cells(first, bins, inside.mean(axis=1), bins * width)


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
