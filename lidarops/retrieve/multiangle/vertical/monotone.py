"""Compiled projection on profiles that never decrease."""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def project(profiles: Array) -> Array:
    """Return the nearest profiles that start at 0 or above and never decrease.

    Neighbours out of order are pooled to their mean until none is left (pool adjacent violators,
    `ayer1955`). Negative means then become 0, which is the least-squares projection under both
    conditions. The result has no negative extinction, but means over many profiles are biased high
    where the signal is weak; those of the profiles themselves are not.

    Parameters
    ----------
    profiles : (profile, altitude) float64
        NaN is skipped and stays.

    Returns
    -------
    (profile, altitude) float64
    """
    out = np.full(profiles.shape, np.nan)
    altitudes = profiles.shape[1]
    mean, count = np.empty(altitudes), np.empty(altitudes, dtype=np.int64)
    for t in range(profiles.shape[0]):
        pools = 0
        for k in range(altitudes):
            if np.isnan(profiles[t, k]):
                continue
            mean[pools], count[pools] = profiles[t, k], 1
            while pools > 0 and mean[pools - 1] >= mean[pools]:
                merged = count[pools - 1] + count[pools]
                mean[pools - 1] += (mean[pools] - mean[pools - 1]) * count[pools] / merged
                count[pools - 1] = merged
                pools -= 1
            pools += 1
        pool, left = -1, 0
        for k in range(altitudes):
            if np.isnan(profiles[t, k]):
                continue
            if left == 0:
                pool += 1
                left = count[pool]
            out[t, k] = max(mean[pool], 0.0)
            left -= 1
    return out
