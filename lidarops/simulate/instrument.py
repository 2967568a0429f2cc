"""From light to raw counts: laser, photoelectrons, photon counters and digitisers.

Both outputs of a detector are driven by the same photoelectrons, bin by bin, so that their
noise is correlated as in a real instrument, also where they start at different times.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from lidarops.simulate import _checks
from lidarops.simulate.analog import (
    Digitiser,
    Recorder,
    digitise,
    digitise_fast,
    sample_moments,
    slow_baseline,
    sum_voltage,
)
from lidarops.simulate.counting import count_fast, count_photons, count_rate, counter_moments
from lidarops.simulate.photoelectrons import (
    BRIGHTEST,
    Array,
    Counts,
    Photoelectrons,
    release,
    seen_from,
)

__all__ = [
    "BRIGHTEST",
    "Array",
    "Counts",
    "Digitiser",
    "Laser",
    "Photoelectrons",
    "Recorder",
    "count_fast",
    "count_photons",
    "count_rate",
    "counter_moments",
    "digitise",
    "digitise_fast",
    "release",
    "sample_moments",
    "seen_from",
    "slow_baseline",
    "sum_voltage",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Laser:
    """How the energy of a laser changes."""

    per_hour: float = 0.0
    """Relative change in an hour."""
    file_jitter: float = 0.0
    """Relative standard deviation from file to file."""
    shot_jitter: float = 0.0
    """Relative standard deviation from shot to shot."""

    def __post_init__(self) -> None:
        _checks.between("per_hour", self.per_hour, -1.0, 1.0)
        _checks.between("file_jitter", self.file_jitter, 0.0, 0.5)
        _checks.between("shot_jitter", self.shot_jitter, 0.0, 0.5)

    def energy(self, hours: float, shots: int, random: np.random.Generator) -> float:
        """Return the mean energy of the shots of a file, relative to the nominal one.

        Notes
        -----
        A shot that is stronger is so in all its bins, so that the jitter of shots is one factor
        for the file, with the standard deviation of the mean over its shots.
        """
        _checks.between("hours", hours, -1e6, 1e6, "h")
        _checks.not_negative("shots", shots)
        spread = sqrt(self.file_jitter**2 + self.shot_jitter**2 / max(shots, 1))
        jitter = spread * random.standard_normal() if spread > 0.0 else 0.0
        return max((1.0 + self.per_hour * hours) * (1.0 + jitter), 0.0)
