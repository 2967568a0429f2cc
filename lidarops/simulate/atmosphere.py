"""The clear atmosphere: pressure, temperature and molecules of the US Standard Atmosphere 1976."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.errors import RetrievalInputError

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
