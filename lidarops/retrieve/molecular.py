"""The molecules of the air: pressure, temperature, number density and Rayleigh scattering.

The US Standard Atmosphere 1976, or a sounding in its place, with the scattering of dry air
after `bodhaine1999`. Retrievals and simulations share it, so that both see the same molecules.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.errors import RetrievalInputError

Array = NDArray[np.float64]

BOLTZMANN_CONSTANT: Final = 1.380649e-23
"""J K-1, exact (SI)."""

SEA_LEVEL_PRESSURE: Final = 101_325.0
"""Pa (`us1976`)."""

HIGHEST: Final = 84_000.0
"""m. Above, the mean molar mass of air falls and the formula here no longer holds."""

# The constants of `us1976`: they define the standard and are not to be modernised.
_GRAVITY: Final = 9.80665
_MOLAR_MASS: Final = 0.0289644
_GAS_CONSTANT: Final = 8.31432
_EARTH_RADIUS: Final = 6_356_766.0
_BASE: Final = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])  # geopotential m
_LAPSE: Final = np.array([-6.5e-3, 0.0, 1.0e-3, 2.8e-3, 0.0, -2.8e-3, -2.0e-3])  # K m-1
_BASE_TEMPERATURE: Final = np.concatenate(
    [[288.15], 288.15 + np.cumsum(np.diff(_BASE) * _LAPSE[:-1])]
)

CARBON_DIOXIDE: Final = 360e-6
"""Mole fraction of the fit of `bodhaine1999`; 420 ppm raise the cross section by 3e-5."""

_MOLECULES: Final = 2.546899e25
"""m-3 at 288.15 K and 1013.25 hPa, where the refractive index holds (`bodhaine1999`)."""


def _pressure_ratio(layer: NDArray[np.intp], rise: NDArray[np.float64]) -> NDArray[np.float64]:
    base, lapse = _BASE_TEMPERATURE[layer], _LAPSE[layer]
    scale = _GRAVITY * _MOLAR_MASS / _GAS_CONSTANT
    isothermal = lapse == 0.0
    slope = np.where(isothermal, 1.0, lapse)
    return np.where(
        isothermal,
        np.exp(-scale * rise / base),
        np.power(base / (base + slope * rise), scale / slope),
    )


_BASE_PRESSURE: Final = SEA_LEVEL_PRESSURE * np.concatenate(
    [[1.0], np.cumprod(_pressure_ratio(np.arange(_BASE.size - 1), np.diff(_BASE)))]
)


def us_standard(altitude: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r"""Return pressure and temperature of the US Standard Atmosphere 1976.

    Parameters
    ----------
    altitude : array_like, m
        Geometric altitude above mean sea level, any shape, -5 to 84 km.

    Returns
    -------
    pressure : ndarray, Pa
    temperature : ndarray, K

    Raises
    ------
    RetrievalInputError
        If an altitude is not finite or lies outside the standard.

    Notes
    -----
    Geopotential height :math:`H = r_0 z / (r_0 + z)`; in layers of constant lapse rate
    :math:`L_b` the hydrostatic equation gives
    :math:`p = p_b (T_b / (T_b + L_b (H - H_b)))^{g_0 M_0 / (R^* L_b)}`.

    References
    ----------
    `us1976`, equations 18, 23, 33a and 33b.
    """
    z = np.asarray(altitude, dtype=np.float64)
    if not np.all((z >= -5000.0) & (z <= HIGHEST)):
        raise RetrievalInputError(
            "the US Standard Atmosphere is defined here from -5 to 84 km",
            field="altitude",
            remedy="give metres above mean sea level",
        )
    height = _EARTH_RADIUS * z / (_EARTH_RADIUS + z)
    layer = np.maximum(np.searchsorted(_BASE, height, side="right") - 1, 0)
    rise = height - _BASE[layer]
    pressure = _BASE_PRESSURE[layer] * _pressure_ratio(layer, rise)
    return pressure, _BASE_TEMPERATURE[layer] + _LAPSE[layer] * rise


def number_density(
    pressure: NDArray[np.float64], temperature: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the molecules in a volume of ideal gas, m-3, from Pa and K."""
    return pressure / (BOLTZMANN_CONSTANT * temperature)


def _wave_number_squared(wavelength: ArrayLike) -> NDArray[np.float64]:
    micrometres = np.asarray(wavelength, dtype=np.float64) * 1e6
    if not np.all((micrometres >= 0.23) & (micrometres <= 4.0)):
        raise RetrievalInputError(
            "the refractive index of air is known from 0.23 to 4 micrometres",
            field="wavelength",
            remedy="give metres: 532e-9, not 532",
        )
    return micrometres**-2.0


def _refractivity(s2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return n - 1 of dry air at 288.15 K and 1013.25 hPa (`bodhaine1999`, 17 to 19)."""
    at_300_ppm = 1e-8 * (8060.51 + 2480990.0 / (132.274 - s2) + 17455.7 / (39.32957 - s2))
    return at_300_ppm * (1.0 + 0.54 * (CARBON_DIOXIDE - 300e-6))


def king_factor(wavelength: ArrayLike) -> NDArray[np.float64]:
    """Return the King correction of dry air for depolarisation, 1.

    Parameters
    ----------
    wavelength : array_like, m

    References
    ----------
    `bodhaine1999`, equations 5, 6 and 23.
    """
    s2 = _wave_number_squared(wavelength)
    nitrogen = 1.034 + 3.17e-4 * s2
    oxygen = 1.096 + 1.385e-3 * s2 + 1.448e-4 * s2**2
    dioxide = 100.0 * CARBON_DIOXIDE
    parts = 78.084 * nitrogen + 20.946 * oxygen + 0.934 * 1.00 + dioxide * 1.15
    return np.asarray(parts / (78.084 + 20.946 + 0.934 + dioxide))


def rayleigh_cross_section(wavelength: ArrayLike) -> NDArray[np.float64]:
    r"""Return the total scattering cross section of a molecule of dry air, m2.

    Parameters
    ----------
    wavelength : array_like, m

    Raises
    ------
    RetrievalInputError
        If a wavelength is outside 0.23 to 4 micrometres.

    Notes
    -----
    .. math:: \sigma = \frac{24 \pi^3 (n^2 - 1)^2}{\lambda^4 N^2 (n^2 + 2)^2} F_K

    References
    ----------
    `bodhaine1999`, equation 2; the King factor :math:`F_K` is `king_factor`.
    """
    index2 = (1.0 + _refractivity(_wave_number_squared(wavelength))) ** 2
    lorentz = ((index2 - 1.0) / (index2 + 2.0)) ** 2
    length = np.asarray(wavelength, dtype=np.float64)
    return np.asarray(
        24.0 * np.pi**3 * lorentz / (length**4 * _MOLECULES**2) * king_factor(wavelength)
    )


def molecular_lidar_ratio(wavelength: ArrayLike) -> NDArray[np.float64]:
    r"""Return extinction over backscatter of air, sr: near 8 pi / 3.

    Parameters
    ----------
    wavelength : array_like, m

    Notes
    -----
    With the depolarisation :math:`\rho = 6 (F_K - 1) / (3 + 7 F_K)` and
    :math:`\gamma = \rho / (2 - \rho)` the phase function gives
    :math:`S = \frac{8 \pi}{3} \frac{1 + 2 \gamma}{1 + \gamma}`: the whole spectrum of
    molecular scattering, rotational Raman lines included.

    References
    ----------
    `bucholtz1995`, equations 10 to 12.
    """
    factor = king_factor(wavelength)
    rho = 6.0 * (factor - 1.0) / (3.0 + 7.0 * factor)
    gamma = rho / (2.0 - rho)
    return np.asarray(8.0 * np.pi / 3.0 * (1.0 + 2.0 * gamma) / (1.0 + gamma))


def molecular_extinction(altitude: ArrayLike, wavelength: float) -> NDArray[np.float64]:
    """Return the extinction by molecules of the US Standard Atmosphere, m-1.

    Parameters
    ----------
    altitude : array_like, m
        Above mean sea level.
    wavelength : float, m
    """
    return number_density(*us_standard(altitude)) * rayleigh_cross_section(wavelength)
