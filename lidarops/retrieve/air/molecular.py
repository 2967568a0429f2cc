"""Number density and Rayleigh scattering of the molecular atmosphere.

Pressure, temperature and humidity are those of the US Standard Atmosphere 1976, which is dry, or of
a sounding; Rayleigh scattering follows from the number density.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarops.errors import RetrievalInputError

Array = NDArray[np.float64]

BOLTZMANN_CONSTANT: Final = 1.380649e-23
"""J K-1, exact (SI)."""

SEA_LEVEL_PRESSURE: Final = 101_325.0
"""Pa (`us1976`)."""

LOWEST: Final = -5_000.0
"""m, lower end of the standard atmosphere as implemented here."""

HIGHEST: Final = 84_000.0
"""m. Above, the molar mass of air decreases and the formula no longer holds."""

CARBON_DIOXIDE: Final = 360e-6
"""Mole fraction of the fit of `bodhaine1999`; 420 ppm raise the cross section by 3e-5."""

# Constants of `us1976`: they define the standard; do not update them.
_GRAVITY: Final = 9.80665
_MOLAR_MASS: Final = 0.0289644
_GAS_CONSTANT: Final = 8.31432
_EARTH_RADIUS: Final = 6_356_766.0
_BASE: Final = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])  # geopotential m
_LAPSE: Final = np.array([-6.5e-3, 0.0, 1.0e-3, 2.8e-3, 0.0, -2.8e-3, -2.0e-3])  # K m-1
_BASE_TEMPERATURE: Final = np.concatenate(
    [[288.15], 288.15 + np.cumsum(np.diff(_BASE) * _LAPSE[:-1])]
)

_MOLECULES: Final = 2.546899e25
"""m-3 at 288.15 K and 1013.25 hPa, the conditions of the refractive index (`bodhaine1999`)."""

VAPOUR_SCATTERING: Final = 0.71
"""Scattering of a molecule of water vapour over that of a molecule of dry air: its refractivity
(`ciddor1996`, equation 3) makes 0.74 to 0.76, its King factor is 1. From 355 to 1064 nm it is 0.70
to 0.73, so that the density of humid air that scatters is off by less than 1e-3."""
_VAPOUR_MASS: Final = 0.622
"""Molar mass of water over that of dry air."""

_COLDEST: Final = 120.0
_WARMEST: Final = 350.0
"""K; no air below 84 km is colder or warmer."""

_ZERO_CELSIUS: Final = 273.15
"""K."""
_SLACK_AT_THE_SURFACE: Final = 1.25
"""Largest ratio of a pressure to that of the standard atmosphere: weather changes the pressure at
the ground by a tenth."""
_SLACK_ALOFT: Final = 2.0
"""The same in the stratosphere, where it changes by half."""
_IMBALANCE: Final = 0.1
"""Largest deviation of levels from hydrostatic balance, as a share of their altitude."""
_ROUNDING_OF_PRESSURE: Final = 200.0
"""m that are added to it: soundings round pressure to 0.1 hPa, a large share of low pressures."""
_UNITS_OF_ALTITUDE: Final[Mapping[str, float]] = {"km": 1000.0, "feet": 0.3048}
"""Metres of the units that altitudes may be in by mistake."""
_ROUGHLY: Final = 0.2
"""Relative deviation within which a ratio of altitudes tells their unit."""
_SURFACE: Final = 9_000.0
"""m, highest ground at which a profile may begin."""


def _pressure_ratio(layer: NDArray[np.intp], rise: Array) -> Array:
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


def us_standard(altitude: ArrayLike) -> tuple[Array, Array]:
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
    if not np.all((z >= LOWEST) & (z <= HIGHEST)):
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


def altitude_of(height: ArrayLike, latitude: float) -> Array:
    r"""Return the altitude above mean sea level, m, of a geopotential height.

    Parameters
    ----------
    height : array_like, m
        Geopotential over 9.80665 m s-2.
    latitude : float, degree

    Notes
    -----
    :math:`z = r H / (r g / g_0 - H)` with gravity :math:`g` and radius :math:`r` of the ellipsoid
    at the latitude. Without the latitude, densities at 10 km would be off by 0.4 % at the equator.

    References
    ----------
    `mahoney2001`, equations 17, 20 and 23.
    """
    square = float(np.sin(np.radians(latitude)) ** 2)
    gravity = 9.7803253359 * (1.0 + 1.931853e-3 * square) / np.sqrt(1.0 - 6.69438e-3 * square)
    radius = 6_378_137.0 / (1.006803 - 0.006706 * square)
    values = np.asarray(height, dtype=np.float64)
    return np.asarray(radius * values / (radius * gravity / _GRAVITY - values))


def thickness(pressure: Array, temperature: Array) -> Array:
    """Return the geopotential height above the first level, m, of levels by falling pressure.

    By the hydrostatic equation of dry air, from Pa and K.
    """
    mean = (temperature[1:] + temperature[:-1]) / 2.0
    rise = -_GAS_CONSTANT / (_MOLAR_MASS * _GRAVITY) * mean * np.diff(np.log(pressure))
    return np.concatenate([[0.0], np.cumsum(rise)])


def vapour_share(
    pressure: Array,
    temperature: Array,
    *,
    dew_point: Array | None = None,
    specific_humidity: Array | None = None,
    mixing_ratio: Array | None = None,
    relative_humidity: Array | None = None,
) -> Array:
    """Return the mole fraction of water vapour, by the first humidity that is given.

    Parameters
    ----------
    pressure : (level,) float, Pa
    temperature, dew_point : (level,) float, K
    specific_humidity, mixing_ratio : (level,) float, kg kg-1
    relative_humidity : (level,) float, 1
        Over water.

    Returns
    -------
    (level,) float
        From 0 to 0.1; NaN where no humidity is given.

    References
    ----------
    `alduchov1996`, equation 21, for the pressure of saturation.
    """
    if dew_point is not None:
        share = _saturation(dew_point) / pressure
    elif specific_humidity is not None:
        share = specific_humidity / (_VAPOUR_MASS + (1.0 - _VAPOUR_MASS) * specific_humidity)
    elif mixing_ratio is not None:
        share = mixing_ratio / (_VAPOUR_MASS + mixing_ratio)
    elif relative_humidity is not None:
        share = relative_humidity * _saturation(temperature) / pressure
    else:
        share = np.full(pressure.shape, np.nan)
    return np.asarray(np.clip(share, 0.0, 0.1))


def _saturation(temperature: Array) -> Array:
    celsius = np.maximum(temperature - _ZERO_CELSIUS, -100.0)
    return np.asarray(610.94 * np.exp(17.625 * celsius / (celsius + 243.04)))


def number_density(pressure: Array, temperature: Array) -> Array:
    """Return the number density of an ideal gas, m-3, from Pa and K."""
    return pressure / (BOLTZMANN_CONSTANT * temperature)


def _wave_number_squared(wavelength: ArrayLike) -> Array:
    micrometres = np.asarray(wavelength, dtype=np.float64) * 1e6
    if not np.all((micrometres >= 0.23) & (micrometres <= 4.0)):
        raise RetrievalInputError(
            "the refractive index of air is known from 0.23 to 4 micrometres",
            field="wavelength",
            remedy="give metres: 532e-9, not 532",
        )
    return micrometres**-2.0


def _refractivity(s2: Array) -> Array:
    """Return n - 1 of dry air at 288.15 K and 1013.25 hPa (`bodhaine1999`, 17 to 19)."""
    at_300_ppm = 1e-8 * (8060.51 + 2480990.0 / (132.274 - s2) + 17455.7 / (39.32957 - s2))
    return at_300_ppm * (1.0 + 0.54 * (CARBON_DIOXIDE - 300e-6))


def king_factor(wavelength: ArrayLike) -> Array:
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
    weighted_sum = 78.084 * nitrogen + 20.946 * oxygen + 0.934 * 1.00 + dioxide * 1.15
    return np.asarray(weighted_sum / (78.084 + 20.946 + 0.934 + dioxide))


def rayleigh_cross_section(wavelength: ArrayLike) -> Array:
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


def molecular_lidar_ratio(wavelength: ArrayLike) -> Array:
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


@dataclass(frozen=True, slots=True, eq=False)
class MolecularProfile:
    """Pressure and temperature of the air over altitude, with its molecular scattering.

    Between levels the logarithm of pressure and the temperature are linear in altitude. Beyond the
    levels they are those of the US Standard Atmosphere, scaled to the last level. Above 84 km the
    number density is 0: less than 1e-5 of that at the ground remains.

    Raises
    ------
    RetrievalInputError
        Where the levels are not those of air: altitude not ascending or in km or feet, pressure
        in hPa, temperature in Celsius, or a deviation from hydrostatic balance of more than a
        tenth.
    """

    altitude: Array
    """m above mean sea level, ascending."""
    pressure: Array
    """Pa."""
    temperature: Array
    """K."""
    standard: bool = False
    """Whether it is the US Standard Atmosphere, not a sounding."""
    water_vapour: Array | None = None
    """Mole fraction; None for dry air."""

    def __post_init__(self) -> None:
        names = ("altitude", "pressure", "temperature", "water_vapour")
        given = [name for name in names if getattr(self, name) is not None]
        for name in given:
            object.__setattr__(self, name, _levels(name, getattr(self, name)))
        for name in given[1:]:
            if getattr(self, name).size != self.altitude.size:
                raise RetrievalInputError(
                    f"has {getattr(self, name).size} levels, altitude has {self.altitude.size}",
                    field=name,
                )
        _check_altitude(self.altitude)
        _check_temperature(self.temperature)
        _check_pressure(self.altitude, self.pressure)
        _check_balance(self.altitude, self.pressure, self.temperature)

    @classmethod
    def us_standard(cls) -> Self:
        """Return the US Standard Atmosphere 1976.

        Levels are every 100 m and where the lapse rate changes, which interpolates the number
        density to 6e-6.
        """
        layer_bases = _EARTH_RADIUS * _BASE / (_EARTH_RADIUS - _BASE)
        altitude = np.union1d(np.linspace(LOWEST, HIGHEST, 891), layer_bases)
        return cls(altitude, *us_standard(altitude), standard=True)

    @classmethod
    def from_profile(
        cls,
        altitude: ArrayLike,
        pressure: ArrayLike,
        temperature: ArrayLike,
        *,
        pressure_unit: str | None = None,
        water_vapour: ArrayLike | None = None,
    ) -> Self:
        """Return the profile of a sounding or a model.

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, ascending.
        pressure : array_like
        temperature : array_like, K
        pressure_unit : {"Pa", "hPa"}, optional
            Detected from the lowest level where not given: near 1013 it is hPa, near 101300 Pa.
            A given unit must agree with it.
        water_vapour : array_like, 1, optional
            Mole fraction.

        Raises
        ------
        RetrievalInputError
            Where the lowest pressure is neither near that of the standard atmosphere in Pa nor
            in hPa, or the levels are not those of air.
        """
        z, p = _levels("altitude", altitude), _levels("pressure", pressure)
        _check_altitude(z)
        scale = _UNITS[_unit(float(z[0]), float(p[0]), pressure_unit)]
        share = None if water_vapour is None else _levels("water_vapour", water_vapour)
        return cls(z, p * scale, _levels("temperature", temperature), water_vapour=share)

    def mixed(self, other: Self, share: float) -> Self:
        """Return the air between two profiles, such as of two times.

        The logarithm of pressure, temperature and humidity are linear in the share, at the levels
        of both. Humidity that only one of them states is that one's.

        Parameters
        ----------
        other : MolecularProfile
        share : float
            Of the other profile, 0 to 1.
        """
        altitude = np.union1d(self.altitude, other.altitude)
        (low, cold), (high, warm) = self.at(altitude), other.at(altitude)
        humid = [one for one in (self, other) if one.water_vapour is not None]
        vapour = None
        if humid:
            first, last = humid[0].vapour(altitude), humid[-1].vapour(altitude)
            vapour = (1.0 - share) * first + share * last
        return type(self)(
            altitude,
            np.exp((1.0 - share) * np.log(low) + share * np.log(high)),
            (1.0 - share) * cold + share * warm,
            water_vapour=vapour,
        )

    def vapour(self, altitude: ArrayLike) -> Array:
        """Return the mole fraction of water vapour; 0 above the levels.

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, any shape.
        """
        z = np.asarray(altitude, dtype=np.float64)
        if self.water_vapour is None:
            return np.zeros(z.shape)
        return np.asarray(np.interp(z, self.altitude, self.water_vapour, right=0.0))

    def at(self, altitude: ArrayLike) -> tuple[Array, Array]:
        """Return pressure (Pa) and temperature (K).

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, any shape, -5 to 84 km.

        Raises
        ------
        RetrievalInputError
            Outside -5 to 84 km.
        """
        z = np.asarray(altitude, dtype=np.float64)
        pressure = np.exp(np.interp(z, self.altitude, np.log(self.pressure)))
        temperature = np.interp(z, self.altitude, self.temperature)
        inside = (z >= self.altitude[0]) & (z <= self.altitude[-1])
        if np.all(inside):
            return np.asarray(pressure), np.asarray(temperature)
        standard = us_standard(z)
        ends = us_standard(np.clip(z, self.altitude[0], self.altitude[-1]))
        return (
            np.where(inside, pressure, pressure * (standard[0] / ends[0])),
            np.where(inside, temperature, temperature * (standard[1] / ends[1])),
        )

    def number_density(self, altitude: ArrayLike) -> Array:
        """Return the number density of molecules, m-3; 0 above 84 km.

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, any shape.
        """
        z = np.asarray(altitude, dtype=np.float64)
        below = number_density(*self.at(np.minimum(z, HIGHEST)))
        return np.asarray(np.where(z <= HIGHEST, below, 0.0))

    def dry_density(self, altitude: ArrayLike) -> Array:
        """Return the number density of the molecules of dry air, m-3; as `number_density`."""
        return self.number_density(altitude) * (1.0 - self.vapour(altitude))

    def extinction(self, altitude: ArrayLike, wavelength: float) -> Array:
        """Return the extinction by molecules, m-1.

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, any shape.
        wavelength : float, m
        """
        scattering = 1.0 - (1.0 - VAPOUR_SCATTERING) * self.vapour(altitude)
        return self.number_density(altitude) * scattering * rayleigh_cross_section(wavelength)

    def backscatter(self, altitude: ArrayLike, wavelength: float) -> Array:
        """Return the backscatter by molecules, m-1 sr-1.

        Parameters
        ----------
        altitude : array_like, m
            Above mean sea level, any shape.
        wavelength : float, m
        """
        return self.extinction(altitude, wavelength) / molecular_lidar_ratio(wavelength)


_UNITS: Final = {"Pa": 1.0, "hPa": 100.0}


def _levels(field: str, values: ArrayLike) -> Array:
    try:
        levels = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise RetrievalInputError("is not an array of numbers", field=field) from None
    if levels.ndim != 1 or levels.size < 2:
        raise RetrievalInputError("needs at least 2 levels on one axis", field=field)
    if not np.all(np.isfinite(levels)):
        raise RetrievalInputError(
            "has values that are not finite", field=field, remedy="remove such levels"
        )
    levels.setflags(write=False)
    return levels


def _check_altitude(altitude: Array) -> None:
    if not np.all(np.diff(altitude) > 0.0):
        raise RetrievalInputError("is not ascending", field="altitude", remedy="sort the levels")
    if altitude[0] < LOWEST or altitude[-1] > HIGHEST:
        raise RetrievalInputError(
            f"reaches from {altitude[0]:g} to {altitude[-1]:g} m",
            field="altitude",
            remedy="give metres above mean sea level, -5 to 84 km",
        )


def _check_temperature(temperature: Array) -> None:
    low, high = float(temperature.min()), float(temperature.max())
    if low >= _COLDEST and high <= _WARMEST:
        return
    celsius = low >= _COLDEST - _ZERO_CELSIUS and high <= _WARMEST - _ZERO_CELSIUS
    raise RetrievalInputError(
        f"reaches from {low:g} to {high:g}, which is not air in K",
        field="temperature",
        remedy="this looks like Celsius: add 273.15" if celsius else "give K",
    )


def _unit(altitude: float, pressure: float, named: str | None) -> str:
    """Return the unit of a pressure, from its size at an altitude."""
    if named is not None and named not in _UNITS:
        raise RetrievalInputError(
            f"is {named!r}", field="pressure_unit", remedy=f"choose one of {', '.join(_UNITS)}"
        )
    slack = _SLACK_AT_THE_SURFACE if altitude <= _SURFACE else _SLACK_ALOFT
    standard = float(us_standard(altitude)[0])
    for unit, scale in _UNITS.items():
        if standard / slack <= pressure * scale <= standard * slack:
            if named is None or named == unit:
                return unit
            raise RetrievalInputError(
                f"{pressure:g} at {altitude:g} m is {unit}, not {named}", field="pressure_unit"
            )
    raise RetrievalInputError(
        f"{pressure:g} at {altitude:g} m is neither Pa nor hPa: the standard atmosphere has"
        f" {standard:.0f} Pa there",
        field="pressure",
        remedy="check the unit of pressure, and that altitude is m above mean sea level",
    )


def _check_pressure(altitude: Array, pressure: Array) -> None:
    if not (pressure[-1] > 0.0 and np.all(np.diff(pressure) < 0.0)):
        raise RetrievalInputError("must be positive and decrease with altitude", field="pressure")
    if _unit(float(altitude[0]), float(pressure[0]), None) != "Pa":
        raise RetrievalInputError(
            f"{pressure[0]:g} at {altitude[0]:g} m is hPa",
            field="pressure",
            remedy="multiply by 100, or use from_profile",
        )


def _check_balance(altitude: Array, pressure: Array, temperature: Array) -> None:
    """Reject levels that are not in hydrostatic balance with pressure and temperature."""
    expected = thickness(pressure, temperature)[1:]
    rise = altitude[1:] - altitude[0]
    wrong = np.abs(expected - rise) > _IMBALANCE * expected + _ROUNDING_OF_PRESSURE
    if not np.any(wrong):
        return
    level = int(np.argmax(wrong))
    ratio = float(expected[-1] / rise[-1])
    remedy = "check the units of altitude, pressure and temperature"
    for unit, metres in _UNITS_OF_ALTITUDE.items():
        if abs(ratio / metres - 1.0) < _ROUGHLY:
            remedy = f"this looks like {unit}: give m"
    raise RetrievalInputError(
        f"is {rise[level]:.0f} m from the lowest level to level {level + 1}, but pressure and"
        f" temperature make it {expected[level]:.0f} m",
        field="altitude",
        remedy=remedy,
    )
