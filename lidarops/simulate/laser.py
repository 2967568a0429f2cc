"""Energy of the laser pulses of one file."""

from __future__ import annotations

from math import sqrt

import numpy as np

from lidarops.campaign.simulation import LaserDrift


def laser_energy(drift: LaserDrift, hours: float, shots: int, random: np.random.Generator) -> float:
    """Draw the mean pulse energy of a file, relative to the nominal energy.

    Parameters
    ----------
    drift : LaserDrift
    hours : float, h
        Since the start of the campaign.
    shots : int
        Shots in the file.
    random : numpy.random.Generator

    Notes
    -----
    A stronger shot is stronger in all its bins. The jitter of shots is therefore one factor for
    the file, with the standard deviation of the mean over its shots.
    """
    spread = sqrt(drift.jitter**2 + drift.shot_jitter**2 / max(shots, 1))
    jitter = spread * random.standard_normal() if spread > 0.0 else 0.0
    return max((1.0 + drift.per_hour * hours) * (1.0 + jitter), 0.0)
