"""Find the bins of the sections of a range grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.homogeneous._problem import Array

FEWEST_BINS: Final = 4
"""Fewest bins of a section; with fewer, there are no more values than unknowns."""


def section_bins(sections: Sequence[tuple[float, float]] | None, range_: Array) -> list[slice]:
    """Return the bins of each section; all bins for None.

    Parameters
    ----------
    sections : sequence of (float, float)
        m; a section holds the bins with near <= R < far.
    range_ : (bin,) float
        m, ascending.

    Raises
    ------
    RetrievalInputError
        Where these are not pairs of ascending ranges, or a section has fewer than 4 bins.
    """
    if sections is None:
        return [slice(0, range_.size)]
    edges = np.asarray(sections, dtype=np.float64)
    if edges.ndim != 2 or edges.shape[1] != 2 or not np.all(edges[:, 0] < edges[:, 1]):
        raise RetrievalInputError(
            f"is {sections!r}", field="sections", remedy="give pairs (near, far) in m, near first"
        )
    return [_bins(near, far, range_) for near, far in edges]


def _bins(near: float, far: float, range_: Array) -> slice:
    first, last = (int(k) for k in np.searchsorted(range_, (near, far), side="left"))
    if last - first < FEWEST_BINS:
        raise RetrievalInputError(
            f"[{near:g}, {far:g}] m holds {last - first} bins of the range grid, which reaches"
            f" from {range_[0]:g} to {range_[-1]:g} m",
            field="sections",
            remedy=f"choose sections that hold at least {FEWEST_BINS}, better 50, bins",
        )
    return slice(first, last)
