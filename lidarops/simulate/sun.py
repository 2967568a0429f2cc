"""Elevation of the sun, and brightness of the clear sky."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Final

from lidarops.simulate import _checks
from lidarops.simulate._checks import SimulationInputError

_TWILIGHT_AT_HORIZON: Final = 0.02
"""Brightness with the sun at the horizon, relative to the zenith."""
_DEGREES_PER_DECADE: Final = 3.0
"""Depression of the sun in which the sky darkens tenfold."""


def solar_elevation(moment: datetime, latitude: float, longitude: float) -> float:
    r"""Return the elevation of the sun above the horizon, degree, to within half a degree.

    Parameters
    ----------
    moment : datetime
        With time zone.
    latitude, longitude : float, degree
        North and east positive.

    Raises
    ------
    SimulationInputError
        If the time has no zone, or the place is not on Earth.

    Notes
    -----
    :math:`\sin h = \sin\phi \sin\delta + \cos\phi \cos\delta \cos H` with the declination
    :math:`\delta` and the equation of time, part of the hour angle H, as Fourier series of the
    day of the year. Refraction is neglected.

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
    """Return the brightness of the clear sky relative to that with the sun at the zenith.

    By day it follows the sine of the solar elevation (degree). In twilight it falls by a decade
    every 3 degrees, about as measured between sunset and the end of nautical twilight.
    """
    day = math.sin(math.radians(max(elevation, 0.0))) + _TWILIGHT_AT_HORIZON
    night: float = 10.0 ** (min(elevation, 0.0) / _DEGREES_PER_DECADE)
    return day / (1.0 + _TWILIGHT_AT_HORIZON) * night
