"""Azimuths of several beams, which lie on a circle."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.common.arrays import Array


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
