"""Where the sun stands, and how bright the sky is for it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Final

from lidarops.constants import SPEED_OF_LIGHT
from lidarops.simulate import _checks
from lidarops.simulate._checks import SimulationInputError

_TWILIGHT_AT_HORIZON: Final = 0.02
_DEGREES_PER_DECADE: Final = 3.0
_LOWEST: Final = 8.0
"""degree. Below, a plane atmosphere is no sky; from there on brightness follows the twilight."""
_SUN_TEMPERATURE: Final = 5772.0
_SUN_SOLID_ANGLE: Final = 6.794e-5
_PLANCK: Final = 6.62607015e-34
_BOLTZMANN: Final = 1.380649e-23
_ASYMMETRY: Final = 0.65


def solar_elevation(moment: datetime, latitude: float, longitude: float) -> float:
    r"""Return the elevation of the sun above the horizon, degree, right to half a degree.

    Parameters
    ----------
    moment : datetime
        With time zone.
    latitude, longitude : float, degree
        North and east positive.

    Raises
    ------
    SimulationInputError
        Where the time has no zone, or the place is not on Earth.

    Notes
    -----
    :math:`\sin h = \sin\phi \sin\delta + \cos\phi \cos\delta \cos H` with the declination
    :math:`\delta` and the equation of time, which is in the hour angle H, as Fourier series of
    the day of the year. Refraction is left out.

    References
    ----------
    `spencer1971`.
    """
    if moment.utcoffset() is None:
        raise SimulationInputError(
            f"of {moment} has no time zone", field="moment", remedy="add tzinfo=UTC"
        )
    _checks.between("latitude", latitude, -90.0, 90.0, "degree")
    _checks.between("longitude", longitude, -360.0, 360.0, "degree")
    utc = moment.astimezone(UTC)
    hours = utc.hour + utc.minute / 60.0 + utc.second / 3600.0
    days = utc.timetuple().tm_yday - 1 + (hours - 12.0) / 24.0
    year = 2.0 * math.pi * days / 365.25
    declination = _series(
        year, 0.006918, (-0.399912, -0.006758, -0.002697), (0.070257, 0.000907, 0.00148)
    )
    equation = _series(year, 0.000075, (0.001868, -0.014615), (-0.032077, -0.040849))
    hour_angle = math.radians(15.0 * (hours - 12.0) + longitude) + equation
    phi = math.radians(latitude)
    sine = math.sin(phi) * math.sin(declination)
    sine += math.cos(phi) * math.cos(declination) * math.cos(hour_angle)
    return math.degrees(math.asin(max(-1.0, min(1.0, sine))))


def _series(
    angle: float, mean: float, cosines: tuple[float, ...], sines: tuple[float, ...]
) -> float:
    total = mean
    for order, (even, odd) in enumerate(zip(cosines, sines, strict=True), start=1):
        total += even * math.cos(order * angle) + odd * math.sin(order * angle)
    return total


def sky_brightness(elevation: float) -> float:
    """Return the brightness of the clear sky, as a fraction of that with the sun at the zenith.

    By day it follows the sine of the solar elevation (degree); in twilight it falls by a decade
    every 3 degrees, about as measured between sunset and the end of nautical twilight.
    """
    day = math.sin(math.radians(max(elevation, 0.0))) + _TWILIGHT_AT_HORIZON
    night: float = 10.0 ** (min(elevation, 0.0) / _DEGREES_PER_DECADE)
    return day / (1.0 + _TWILIGHT_AT_HORIZON) * night


def sky_radiance(elevation: float, wavelength: float, aerosol_optical_depth: float = 0.1) -> float:
    r"""Return the spectral radiance of the clear sky at the zenith, W m-2 sr-1 m-1.

    Parameters
    ----------
    elevation : float, degree
        Of the sun.
    wavelength : float, m
    aerosol_optical_depth : float, 1
        At the wavelength.

    Notes
    -----
    Light scattered once by a plane atmosphere of air and aerosol,

    .. math:: L = \frac{F \bar p(\Theta)}{4 \pi} \frac{\mu}{1 - \mu}
              \left(e^{-\tau} - e^{-\tau / \mu}\right)

    with the sine mu of the elevation, the Sun as a black body of 5772 K for F, the Rayleigh
    optical depth of `hansen1974` and a Henyey-Greenstein phase function. Light scattered more
    often, and by the ground, adds up to as much again; below 8 degrees the radiance follows
    `sky_brightness`. It is good to a factor of 3: what a background costs, not what it is.
    """
    _checks.wavelength_in_metres("wavelength", wavelength)
    _checks.between("elevation", elevation, -90.0, 90.0, "degree")
    _checks.not_negative("aerosol_optical_depth", aerosol_optical_depth)
    high = max(elevation, _LOWEST)
    scattered = _scattered_once(math.sin(math.radians(high)), wavelength, aerosol_optical_depth)
    return scattered * sky_brightness(elevation) / sky_brightness(high)


def _scattered_once(mu: float, wavelength: float, aerosol: float) -> float:
    square = 1.0e-12 / wavelength**2  # micrometres-2
    air = 0.008569 * square**2 * (1.0 + 0.0113 * square + 0.00013 * square**2)
    # The zenith is seen under the zenith angle of the sun, whose cosine is mu.
    rayleigh = 0.75 * (1.0 + mu**2)
    henyey: float = (1.0 - _ASYMMETRY**2) / (1.0 + _ASYMMETRY**2 - 2.0 * _ASYMMETRY * mu) ** 1.5
    depth = air + aerosol
    # mu / (1 - mu) (exp(-tau) - exp(-tau / mu)) without a quotient of zeros at the zenith.
    beyond = depth * (1.0 / mu - 1.0)
    layer = depth * math.exp(-depth) * (-math.expm1(-beyond) / beyond if beyond > 0.0 else 1.0)
    return _sun(wavelength) * (rayleigh * air + henyey * aerosol) / depth * layer / (4.0 * math.pi)


def _sun(wavelength: float) -> float:
    """Return the spectral irradiance of a black Sun above the atmosphere, W m-2 m-1."""
    exponent: float = _PLANCK * SPEED_OF_LIGHT / (wavelength * _BOLTZMANN * _SUN_TEMPERATURE)
    strength = 2.0 * _PLANCK * SPEED_OF_LIGHT**2 / wavelength**5
    return strength / math.expm1(exponent) * _SUN_SOLID_ANGLE
