"""Variance of photon counts, from the mean profile of a block."""

from __future__ import annotations

import numpy as np


def mean_profile_variance(power, shots=1.0):
    """Return the variance of mean counts per shot, (profile, range), from the mean of all profiles.

    The mean is averaged along range until it holds 1000 counts, at most over 15 bins. Weights from
    a profile's own counts favour the bins that happen to be low, and bias a fit.
    """
    rows = np.atleast_2d(np.asarray(power, dtype=np.float64))
    weight = np.broadcast_to(np.reshape(shots, (-1, 1)), rows.shape)
    held, spread = ((w * weight).sum(axis=0) for w in (rows, np.ones_like(rows)))
    counts, total = (np.append(0.0, np.cumsum(values)) for values in (held, spread))
    mean, few = np.full(held.size, np.nan), np.ones(held.size, dtype=bool)
    bins = np.arange(held.size)
    for half in range(8):
        low, high = np.maximum(bins - half, 0), np.minimum(bins + half + 1, held.size)
        inside = counts[high] - counts[low]
        # Without any count, the variance is small, not zero.
        mean = np.where(few, np.maximum(inside, 0.5) / (total[high] - total[low]), mean)
        few &= inside < 1000.0
    return (mean / np.reshape(shots, (-1, 1))).reshape(np.shape(power) if np.ndim(shots) else -1)
