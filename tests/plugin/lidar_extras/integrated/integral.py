"""Integrate range-corrected signals over windows of range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_extras.integrated.flags import IntegratedQuality
from lidarops.flags import Quality

Floats = NDArray[np.float64]
Bits = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Integrals:
    """Integrals of (power - background) r^2 / overlap over a window, of each profile."""

    values: Floats
    """(time,), in m3 times the unit of power; NaN where a bin is."""
    standard_errors: Floats
    """(time,)."""
    flags: Bits
    """(time,)."""


@dataclass(frozen=True, slots=True)
class Window:
    """The bins of a window of range."""

    inside: NDArray[np.bool_]
    """Which bins have their centre in the window."""
    weights: Floats
    """m3; range squared times the width of a bin, over the overlap, of the bins inside."""
    flag: int
    """Bits of the window itself."""

    @classmethod
    def of(cls, centres: Floats, overlap: Floats, limits: tuple[float, float]) -> Window:
        """Return the bins between two limits.

        Parameters
        ----------
        centres : ndarray, (range,)
            m, of bins of one width.
        overlap : ndarray, (range,)
            NaN where it is not known.
        limits : (float, float)
            m.
        """
        near, far = limits
        width = centres[1] - centres[0]
        inside = (near <= centres) & (centres < far)
        weights = centres[inside] ** 2 * width / overlap[inside]
        cut = near < centres[0] - width / 2 or far > centres[-1] + width / 2
        flag = int(IntegratedQuality.WINDOW_CUT) if cut else 0
        unknown = np.isnan(weights).any()
        return cls(inside, weights, flag | (int(Quality.INCOMPLETE_OVERLAP) if unknown else 0))

    def integrals(
        self, power: Floats, variance: Floats, background: tuple[Floats, Floats], quality: Bits
    ) -> Integrals:
        """Return the integrals of profiles.

        The noise of the bins is independent; the error of the background is common to them.

        Parameters
        ----------
        power, variance, quality : ndarray, (time, range)
        background : two ndarrays, (time,)
            With its standard error.
        """
        level, error = (part[:, np.newaxis] for part in background)
        signal = power[:, self.inside] - level
        noise = (variance[:, self.inside] * self.weights**2).sum(axis=1)
        common = (error * self.weights).sum(axis=1)
        bits = np.bitwise_or.reduce(quality[:, self.inside], axis=1)
        return Integrals(
            (signal * self.weights).sum(axis=1), np.sqrt(noise + common**2), bits | self.flag
        )
