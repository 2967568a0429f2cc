"""Photon counts: what they must be, and the variance that their mean profile gives."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs

Array = npt.NDArray[np.float64]

ENOUGH_COUNTS: Final = 1000.0
"""Counts that tell a variance to 3 percent."""
WIDEST: Final = 7
"""Bins to either side over which a mean profile is averaged at most."""


def checked_shots(
    power: inputs.Floats, shots: npt.ArrayLike | None, leading: tuple[int, ...]
) -> Array:
    """Return the shots of each profile of counts, (profile or 1,).

    Raises
    ------
    RetrievalInputError
        Where counts are negative or shots not positive.
    """
    if np.any(power < 0):
        raise RetrievalInputError(
            "holds negative counts",
            field="power",
            remedy="give counts before any background is subtracted, or statistics='gauss'",
        )
    values = inputs.profile_values(1.0 if shots is None else shots, "shots", leading)
    if values is None or np.any(values <= 0):
        raise RetrievalInputError("is not positive", field="shots")
    return values


def mean_profile_variance(power: npt.ArrayLike, shots: npt.ArrayLike) -> Array:
    """See `lidarops.retrieve.homogeneous.path_fit.mean_profile_variance`."""
    counts = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if counts.ndim == 0:
        raise RetrievalInputError(
            "is a single number", field="power", remedy="the last axis of power is range"
        )
    leading = counts.shape[:-1]
    rows = counts.reshape(-1, counts.shape[-1])
    of_profile = checked_shots(rows, shots, leading)
    weight = np.where(np.isfinite(rows), of_profile[:, np.newaxis], 0.0)
    shots_of_bin = weight.sum(axis=0)
    counts_of_bin = np.where(weight > 0, rows * weight, 0.0).sum(axis=0)
    mean = _averaged(counts_of_bin, shots_of_bin)
    if of_profile.size == 1:
        shared: Array = mean / of_profile[0]
        return shared
    own: Array = mean / of_profile[:, np.newaxis]
    return own.reshape(counts.shape)


def _averaged(counts: Array, shots: Array) -> Array:
    """Average counts per shot along range, as far as it takes to hold `ENOUGH_COUNTS`."""
    mean = np.full(counts.size, np.nan)
    open_ = np.ones(counts.size, dtype=bool)
    total_counts = np.concatenate([[0.0], np.cumsum(counts)])
    total_shots = np.concatenate([[0.0], np.cumsum(shots)])
    bins = np.arange(counts.size)
    for half in range(WIDEST + 1):
        low, high = np.maximum(bins - half, 0), np.minimum(bins + half + 1, counts.size)
        held = total_counts[high] - total_counts[low]
        spread = total_shots[high] - total_shots[low]
        with np.errstate(invalid="ignore", divide="ignore"):
            # Half a count at least: where none was seen, the variance is small, not zero.
            mean = np.where(open_, np.maximum(held, 0.5) / spread, mean)
        open_ &= held < ENOUGH_COUNTS
    return np.where(shots > 0, mean, np.nan)
