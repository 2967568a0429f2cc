"""Water-vapour mixing ratio from the Raman signals of water vapour and nitrogen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.raman.backscatter import inverse_mean
from lidarops.retrieve.raman.retrieval import CellSignal

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MixingRatio:
    """Mass of water vapour over that of dry air, (cell,)."""

    value: Array
    random: Array
    """Standard error by noise and background."""
    systematic: Array
    """Standard error by calibration and dead time."""


def mixing_ratio(
    water: CellSignal,
    nitrogen: CellSignal,
    fit: tuple[Array, Array],
    partial: npt.NDArray[np.bool_],
    *,
    constant: float,
    constant_standard_error: float,
    ratios: tuple[float, float, float],
) -> MixingRatio:
    r"""Return the mixing ratio, with the calibration constant of both channels.

    .. math:: w = C \frac{y_W}{e^{-\theta}} e^{(\kappa_W - \kappa) \tau_p}

    Signals are over those of clean air with equal shares of both gases, so that the transmission of
    air is corrected. The nitrogen signal is the smooth one; in partial overlap, that of the cell,
    so that the overlap cancels.

    Parameters
    ----------
    water, nitrogen : CellSignal
        Over the signals of air at their wavelengths.
    fit : ((cell,) float, (cell,) float)
        Fitted optical depth of the nitrogen signal, up to a constant, and its error by noise.
    partial : (cell,) bool
        Cells without full overlap.
    constant, constant_standard_error : float
        Calibration constant, kg kg-1 per ratio of the signals.
    ratios : (float, float, float)
        Particle extinction at the wavelengths of the laser, of nitrogen and of water vapour, over
        that at the laser's.

    References
    ----------
    `whiteman2003`.
    """
    _, of_nitrogen, of_water = ratios
    depth, error = fit
    nearest = float(depth[np.flatnonzero(np.isfinite(depth))[:1]].sum())
    particles = (depth - nearest) / (1.0 + of_nitrogen)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = nitrogen.variance / nitrogen.value**2
    level = np.where(partial, nitrogen.value, np.exp(-depth))
    square = np.where(partial, own, error**2)
    factor = constant * inverse_mean(level, square)
    factor *= np.exp((of_water - of_nitrogen) * particles)
    value = factor * water.value
    noise = factor**2 * (water.variance + water.background**2) + value**2 * square
    relative = constant_standard_error / constant
    systematic = np.hypot(value * relative, factor * water.dead_time)
    return MixingRatio(value, np.sqrt(noise), systematic)
