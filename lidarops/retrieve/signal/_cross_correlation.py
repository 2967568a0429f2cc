"""Compiled correlation of the noise of two signals at many lags."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


# Inlined by force: a reassociated sum as a symbol of its own has other bits fresh than cached.
@numba.njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    forceinline=True,
    fastmath={"reassoc", "contract", "nsz"},
)
def _product(first: Any, second: Any) -> float:
    total = 0.0
    for i in range(second.size):
        total += first[i] * second[i]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_products(
    first: Array,
    second: Array,
    reach: int,
    edges: npt.NDArray[np.intp],
    sums: Array,
) -> None:
    """Add the products of `second` and of `first` shifted by each lag, by parts of the range.

    Parameters
    ----------
    first, second : (channel, time, bin) float64
    reach : int
        Largest lag to either side, in bins.
    edges : (part + 1,) int
        Bins of `second` where the parts begin and end, at least `reach` from both ends.
    sums : (channel, part, lag) float64
        The sums to which the products are added.
    """
    for c in range(first.shape[0]):
        for t in range(first.shape[1]):
            x, y = first[c, t], second[c, t]
            for p in range(edges.size - 1):
                segment = y[edges[p] : edges[p + 1]]
                for j in range(2 * reach + 1):
                    start = edges[p] + j - reach
                    sums[c, p, j] += _product(x[start : start + segment.size], segment)
