"""Slant paths of a scan: length of each beam over the vertical path, and its direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.constants import EFFECTIVE_RADIUS
from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans, Integers, widest_azimuth_gap
from lidarops.retrieve.common.inputs import real_array
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UPRIGHT: Final = 1e-9
"""Horizontal distance over altitude up to which a beam is vertical and has no azimuth."""
_OPPOSITE: Final = 1e-6
"""radian, rounding by which the gap between opposite azimuths may exceed half a turn."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The beams of a scan on an altitude grid."""

    path: Array
    """(angle, altitude): slant over vertical path; NaN for beams that are not used."""
    east: Array
    """(angle, altitude): horizontal distance over altitude, component along azimuth 90 degree."""
    north: Array
    """(angle, altitude): the same along azimuth 0."""
    azimuth: Array
    """(angle,) radian; a beam with a negative zenith angle points opposite to its azimuth."""
    usable: Booleans
    """(angle,): false for beams less than 3 degrees above the horizon."""

    @property
    def tilted_azimuths(self) -> Array:
        """Azimuths of the usable beams that are not vertical, radian."""
        tilted = np.abs(self.east[:, 0]) + np.abs(self.north[:, 0]) > _UPRIGHT
        return self.azimuth[self.usable & tilted]


def make_scan(
    zenith_angle: npt.ArrayLike, altitude: npt.ArrayLike, azimuth: npt.ArrayLike | None = None
) -> Scan:
    r"""Return the slant paths of a scan.

    Up to 75 degrees :math:`x = \sec\theta`; beyond, the mean path of a refracted beam through a
    spherical atmosphere with constant extinction,

    .. math:: x(z) = \left[\sqrt{R^2\cos^2\theta + 2Rz + z^2} - R\cos\theta\right] / z .

    Parameters
    ----------
    zenith_angle : (angle,) float
        degree, -90 to 90; a beam with a negative angle points opposite to its azimuth.
    altitude : (altitude,) float
        m above the lidar, ascending.
    azimuth : (angle,) float, optional
        degree; 0 if not given.

    Returns
    -------
    Scan
        Beams with x > 19.2 at any altitude, or with a missing angle, are not usable.

    Raises
    ------
    RetrievalInputError
        For angles beyond the horizon, or altitudes that are not positive and ascending.
    """
    angle = _angles(zenith_angle, "zenith_angle")
    if np.any(np.abs(angle) > 90.0):
        raise RetrievalInputError(
            "has angles below the horizon", field="zenith_angle", remedy="give -90 to 90 degree"
        )
    heading = np.zeros_like(angle) if azimuth is None else _angles(azimuth, "azimuth")
    if heading.shape != angle.shape:
        raise RetrievalInputError(
            f"has the shape {heading.shape}, zenith_angle {angle.shape}",
            field="azimuth",
            remedy="give one value per angle",
        )
    height = altitude_grid(altitude, 0.0)
    return _scan(slant_path(np.abs(angle), height), angle, heading)


def rising_beams(zenith_angle: Array, altitude: Array) -> Integers:
    """Return the indices of the beams that point upwards and are usable at all altitudes.

    Parameters
    ----------
    zenith_angle : (angle,) float
        degree, 0 to 180.
    altitude : (altitude,) float
        m above the lidar, ascending.
    """
    upward = np.flatnonzero(zenith_angle < 90.0)
    return upward[make_scan(zenith_angle[upward], altitude).usable] if upward.size else upward


def slant_path(angle: Array, altitude: Array) -> Array:
    """Return slant over vertical path, as in `make_scan`, (angle, altitude); inf at the horizon."""
    cosine = np.cos(np.radians(angle))[:, np.newaxis]
    with np.errstate(divide="ignore"):
        secant = np.where(cosine > 1e-12, 1.0 / cosine, np.inf)
    # The textbook form subtracts two numbers of the size of the Earth's radius; this form keeps
    # the digits.
    root = np.sqrt(
        (EFFECTIVE_RADIUS * cosine) ** 2 + (2.0 * EFFECTIVE_RADIUS + altitude) * altitude
    )
    spherical = (2.0 * EFFECTIVE_RADIUS + altitude) / (root + EFFECTIVE_RADIUS * cosine)
    steep = angle[:, np.newaxis] <= THRESHOLDS.spherical_beyond
    return np.asarray(np.where(steep, secant, spherical), dtype=np.float64)


def surrounds_zenith(azimuth: Array) -> bool:
    """Return whether beams point to all sides, so that a horizontal gradient can be estimated.

    No half turn is free of beams: the zero vector lies inside the convex hull of their directions.

    Parameters
    ----------
    azimuth : (angle,) float
        radian; only of beams that are not vertical.
    """
    return widest_azimuth_gap(azimuth) <= np.pi + _OPPOSITE


def altitude_grid(altitude: npt.ArrayLike, station_altitude: float) -> Array:
    """Validate an altitude axis (m) and return the heights above the station.

    Raises
    ------
    RetrievalInputError
        For an axis that is not one-dimensional, finite, above the station and strictly ascending.
    """
    grid = real_array(altitude, "altitude").astype(np.float64)
    if grid.ndim != 1 or grid.size == 0:
        raise RetrievalInputError(
            f"has the shape {grid.shape}", field="altitude", remedy="give a list of values in m"
        )
    if not np.isfinite(station_altitude):
        raise RetrievalInputError(f"is {station_altitude}", field="station_altitude")
    height = grid - station_altitude
    if not np.all(np.isfinite(grid)) or height[0] <= 0 or np.any(np.diff(grid) <= 0):
        raise RetrievalInputError(
            f"is not finite, strictly ascending and above the lidar at {station_altitude:g} m",
            field="altitude",
            remedy="give m, and the altitude of the lidar as station_altitude",
        )
    return np.ascontiguousarray(height)


def _scan(path: Array, angle: Array, heading: Array) -> Scan:
    with np.errstate(invalid="ignore"):
        usable = np.all(
            np.isfinite(path) & (path <= THRESHOLDS.longest_path), axis=1
        ) & np.isfinite(heading)
    azimuth = np.radians(np.where(angle < 0, heading + 180.0, heading))
    path = np.where(usable[:, np.newaxis], path, np.nan)
    reach = path * np.sin(np.radians(np.abs(angle)))[:, np.newaxis]
    east, north = np.sin(azimuth)[:, np.newaxis], np.cos(azimuth)[:, np.newaxis]
    return Scan(path, reach * east, reach * north, azimuth, usable)


def _angles(values: npt.ArrayLike, name: str) -> Array:
    angles = real_array(values, name).astype(np.float64)
    if angles.ndim != 1 or angles.size == 0:
        raise RetrievalInputError(
            f"has the shape {angles.shape}", field=name, remedy="give one value in degree per angle"
        )
    return angles
