"""Variance of photon counts, from the mean profile of a block."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array


def mean_profile_variance(power: npt.ArrayLike, shots: npt.ArrayLike = 1.0) -> Array:
    """Return the variance of photon counts, from the mean profile of a block.

    Weights from a profile's own counts favour the bins that happen to be low, and bias the fit.
    Weights from the mean profile of a block with the same shape do not.

    The mean profile is averaged along range only until it holds 1000 counts, at most over 15
    bins, so that steep strong signals keep their shape. Choose the block once and pass the result
    with every part of it: no solver pools profiles, since results would then depend on how an
    archive is cut.

    Parameters
    ----------
    power : (..., range) float
        Mean counts per shot. Bins that are not finite are skipped.
    shots : (...) float
        Number of shots of which each profile is the mean count.

    Returns
    -------
    (..., range) float
        Variance of `power`: the mean profile over the number of shots; (range,) for one number
        of shots. NaN where no profile has a finite value.

    Raises
    ------
    RetrievalInputError
        Where counts are negative or shots not positive.
    """
    counts = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if counts.ndim == 0:
        raise RetrievalInputError(
            "is a single number", field="power", remedy="the last axis of power is range"
        )
    leading = counts.shape[:-1]
    rows = counts.reshape(-1, counts.shape[-1])
    if np.any(rows < 0):
        raise RetrievalInputError(
            "holds negative counts",
            field="power",
            remedy="give counts before any background is subtracted",
        )
    profile_shots = inputs.profile_values(shots, "shots", leading)
    if profile_shots is None or np.any(profile_shots <= 0):
        raise RetrievalInputError("is not positive", field="shots")
    weight = np.where(np.isfinite(rows), profile_shots[:, np.newaxis], 0.0)
    bin_shots = weight.sum(axis=0)
    bin_counts = np.where(weight > 0, rows * weight, 0.0).sum(axis=0)
    mean = _averaged(bin_counts, bin_shots)
    if profile_shots.size == 1:
        shared: Array = mean / profile_shots[0]
        return shared
    variance: Array = mean / profile_shots[:, np.newaxis]
    return variance.reshape(counts.shape)


def _averaged(counts: Array, shots: Array) -> Array:
    """Average counts per shot along range until they hold `Thresholds.enough_counts`."""
    mean = np.full(counts.size, np.nan)
    too_few = np.ones(counts.size, dtype=bool)
    total_counts = np.concatenate([[0.0], np.cumsum(counts)])
    total_shots = np.concatenate([[0.0], np.cumsum(shots)])
    bins = np.arange(counts.size)
    for half in range(THRESHOLDS.widest + 1):
        low, high = np.maximum(bins - half, 0), np.minimum(bins + half + 1, counts.size)
        held = total_counts[high] - total_counts[low]
        spread = total_shots[high] - total_shots[low]
        with np.errstate(invalid="ignore", divide="ignore"):
            # At least half a count: without any count, the variance is small, not zero.
            mean = np.where(too_few, np.maximum(held, 0.5) / spread, mean)
        too_few &= held < THRESHOLDS.enough_counts
    return np.where(shots > 0, mean, np.nan)
