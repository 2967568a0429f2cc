"""Water-vapour mixing ratio from the Raman signals of water vapour and nitrogen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.raman.backscatter import inverse_mean
from lidarops.retrieve.raman.errors import Quotient
from lidarops.retrieve.raman.scattering import particle_ratio
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.raman.signals import CellSignal


def particle_transmission(
    settings: RamanSettings, laser: float, raman: float, wavelength: float
) -> tuple[float, float]:
    r"""Return the transmission of particles at the nitrogen line over that of water vapour.

    That is the exponent of its logarithm per fitted optical depth,
    :math:`(\kappa_W - \kappa) / (1 + \kappa)`, and its standard error by the Ångström exponent.

    Parameters
    ----------
    settings : RamanSettings
    laser, raman, wavelength : float
        m, of the laser, and of the channels of nitrogen and of water vapour.
    """
    nitrogen = particle_ratio(settings.angstrom_exponent, laser, raman)
    water = particle_ratio(settings.angstrom_exponent, laser, wavelength)
    exponent = (water - nitrogen) / (1.0 + nitrogen)
    of_nitrogen = nitrogen * np.log(laser / raman)
    of_water = water * np.log(laser / wavelength)
    slope = (of_water - of_nitrogen - exponent * of_nitrogen) / (1.0 + nitrogen)
    return exponent, float(abs(slope)) * settings.angstrom_standard_error


def mixing_ratio(
    water: CellSignal,
    nitrogen: CellSignal,
    fit: tuple[Array, Array],
    partial: Booleans,
    *,
    constant: float,
    particles: tuple[float, float],
    relative_errors: Sequence[Array | float],
) -> Quotient:
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
    constant : float
        Calibration constant, kg kg-1 per ratio of the signals.
    particles : (float, float)
        From `particle_transmission`.
    relative_errors : sequence of float or (cell,) float
        Relative standard errors of the constant and of what else all profiles share.

    References
    ----------
    `whiteman2003`.
    """
    depth, error = fit
    nearest = float(depth[np.flatnonzero(np.isfinite(depth))[:1]].sum())
    beyond = depth - nearest
    with np.errstate(divide="ignore", invalid="ignore"):
        own = nitrogen.variance / nitrogen.value**2
    level = np.where(partial, nitrogen.value, np.exp(-depth))
    square = np.where(partial, own, error**2)
    factor = constant * inverse_mean(level, square)
    exponent, spread = particles
    factor *= np.exp(exponent * beyond)
    value = factor * water.value
    background, dead_time, baseline = (
        nitrogen.relative(change, level)
        for change in (nitrogen.background, nitrogen.dead_time, nitrogen.baseline)
    )
    noise = factor**2 * (water.variance + water.background**2)
    noise += value**2 * (square + background**2)
    shared = dead_time**2 + baseline**2 + (spread * beyond) ** 2
    shared += sum(np.square(relative) for relative in relative_errors)
    systematic = np.sqrt(value**2 * shared + factor**2 * (water.dead_time**2 + water.baseline**2))
    return Quotient(value, np.sqrt(noise), systematic)
