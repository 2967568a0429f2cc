"""Projection on profiles that never decrease."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.common.arrays import Array


def project(profiles: Array) -> Array:
    """Return the nearest profiles that start at 0 or above and never decrease.

    Isotonic regression (`ayer1955`), of which negative values then become 0: the least-squares
    projection under both conditions. The result has no negative extinction, but means over many
    profiles are biased high where the signal is weak; those of the profiles themselves are not.

    Parameters
    ----------
    profiles : (profile, altitude) float64
        NaN is skipped and stays.

    Returns
    -------
    (profile, altitude) float64
    """
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - loads many other modules

    out = np.full(profiles.shape, np.nan)
    for row, rising in zip(profiles, out, strict=True):
        known = ~np.isnan(row)
        if known.any():
            rising[known] = np.maximum(isotonic_regression(row[known]).x, 0.0)
    return out
