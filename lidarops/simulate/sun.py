"""Where the sun stands, and how bright the sky is for it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Final

_TWILIGHT_AT_HORIZON: Final = 0.02
_DEGREES_PER_DECADE: Final = 3.0


def solar_elevation(moment: datetime, latitude: float, longitude: float) -> float:
    r"""Return the elevation of the sun above the horizon, degree.

    Parameters
    ----------
    moment : datetime
        With time zone.
    latitude, longitude : float, degree
        North and east positive.

    Notes
    -----
    :math:`\sin h = \sin\phi \sin\delta + \cos\phi \cos\delta \cos H` with the declination
    :math:`\delta = -23.44° \cos(2 \pi (d + 10) / 365.24)`, where d counts days from the start
    of the year, and the hour angle H of the mean sun. The equation of time (up to 17 minutes)
    and refraction are left out: sky light here needs no more than 4 degrees.
    """
    utc = moment.astimezone(UTC)
    hours = utc.hour + utc.minute / 60.0 + utc.second / 3600.0
    days = utc.timetuple().tm_yday - 1 + hours / 24.0
    declination = -math.radians(23.44) * math.cos(2.0 * math.pi * (days + 10.0) / 365.24)
    hour_angle = math.radians(15.0 * (hours - 12.0) + longitude)
    phi = math.radians(latitude)
    sine = math.sin(phi) * math.sin(declination)
    sine += math.cos(phi) * math.cos(declination) * math.cos(hour_angle)
    return math.degrees(math.asin(max(-1.0, min(1.0, sine))))


def sky_brightness(elevation: float) -> float:
    """Return the brightness of the clear sky, as a fraction of that with the sun at the zenith.

    By day it follows the sine of the solar elevation (degree); in twilight it falls by a decade
    every 3 degrees, about as measured between sunset and the end of nautical twilight.
    """
    day = math.sin(math.radians(max(elevation, 0.0))) + _TWILIGHT_AT_HORIZON
    night: float = 10.0 ** (min(elevation, 0.0) / _DEGREES_PER_DECADE)
    return day / (1.0 + _TWILIGHT_AT_HORIZON) * night
