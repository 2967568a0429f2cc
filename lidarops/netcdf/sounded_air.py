"""Geographic position of the air along a slant beam."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EQUATOR: Final = 6_378_137.0
"""m, semi-major axis of WGS 84."""
_FLATTENING: Final = 1.0 / 298.257223563
_ECCENTRICITY: Final = _FLATTENING * (2.0 - _FLATTENING)
"""Square of the first eccentricity."""


def beam_positions(
    latitude: float, longitude: float, altitude: float, ahead: Array, azimuth: Array, up: Array
) -> tuple[Array, Array]:
    r"""Return latitude and longitude of points on a straight beam.

    .. math:: x = x_0 + E (s \sin a,\; s \cos a,\; u)^T

    in Cartesian coordinates of the Earth, with the matrix E of the directions east, north and up
    at the station, horizontal distance s and height u of the point, and azimuth a; then converted
    to geodetic latitude by Bowring's formula, with an error below 1 mm.

    Parameters
    ----------
    latitude, longitude : float
        Position of the station, degree.
    altitude : float
        Altitude of the station, m; the geoid is taken as the ellipsoid.
    ahead : ndarray
        Horizontal distance from the station, in its tangent plane, m.
    azimuth : ndarray
        degree, clockwise from north; broadcast against `ahead`.
    up : ndarray
        Distance above the tangent plane of the station, m; broadcast against `ahead`.

    Returns
    -------
    latitude, longitude : ndarray
        degree; longitude from -180 to 180.
    """
    lat, lon, direction = np.deg2rad(latitude), np.deg2rad(longitude), np.deg2rad(azimuth)
    east, north = ahead * np.sin(direction), ahead * np.cos(direction)
    curvature = EQUATOR / np.sqrt(1.0 - _ECCENTRICITY * np.sin(lat) ** 2)
    # Relative to the meridian of the station, so that the longitude difference is small.
    outward = (curvature + altitude) * np.cos(lat) - north * np.sin(lat) + up * np.cos(lat)
    axis = (
        (curvature * (1.0 - _ECCENTRICITY) + altitude) * np.sin(lat)
        + north * np.cos(lat)
        + up * np.sin(lat)
    )
    across = np.hypot(outward, east)
    polar = EQUATOR * (1.0 - _FLATTENING)
    reduced = np.arctan2(axis * EQUATOR, across * polar)
    second = _ECCENTRICITY / (1.0 - _ECCENTRICITY)
    geodetic = np.arctan2(
        axis + second * polar * np.sin(reduced) ** 3,
        across - _ECCENTRICITY * EQUATOR * np.cos(reduced) ** 3,
    )
    turned = np.rad2deg(lon + np.arctan2(east, outward))
    return np.rad2deg(geodetic), (turned + 180.0) % 360.0 - 180.0
