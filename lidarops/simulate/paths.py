"""What a simulated beam passes through: extinction and backscatter at a moment of time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from lidarops.simulate.scattering import molecular_extinction, molecular_lidar_ratio
from lidarops.simulate.settings import (
    Aerosol,
    DiurnalCourse,
    HorizontalPath,
    SimulatedInstrument,
    VerticalColumn,
)

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH: Final = 532e-9
"""m, at which the settings give the extinction of aerosol."""


@dataclass(frozen=True, slots=True)
class Path:
    """Optical properties along a beam."""

    extinction: Array
    """m-1, by molecules and particles, at the bin centres."""
    backscatter: Array
    """m-1 sr-1, by molecules and particles, at the bin centres."""
    homogeneous: bool
    """Whether both are the same at every range."""


def diurnal(course: DiurnalCourse, moment: datetime) -> float:
    """Return the value of a diurnal course: a cosine with its maximum at a given hour (UTC)."""
    midnight = moment.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    hours = (moment - midnight) / timedelta(hours=1)
    phase = math.cos(2.0 * math.pi * (hours - course.hour_of_maximum) / 24.0)
    return course.minimum + (course.maximum - course.minimum) * 0.5 * (1.0 + phase)


def path_at(
    scenery: SimulatedInstrument,
    *,
    moment: datetime,
    wavelength: float,
    distance: Array,
    zenith_angle: float,
    station_altitude: float,
) -> Path:
    """Return what a beam passes through at a moment.

    Parameters
    ----------
    scenery : HorizontalPath or VerticalColumn
    moment : datetime
        With time zone.
    wavelength : float, m
    distance : ndarray, m, shape (bins,)
        Range of the bin centres; bins before the lidar (negative) see what the first one sees.
    zenith_angle : float, degree
        Of the beam, 0 = up. A homogeneous path is taken at the altitude of the station.
    station_altitude : float, m
        Above mean sea level.

    Notes
    -----
    Molecules: US Standard Atmosphere and Rayleigh scattering. The curvature of the Earth is
    left out.
    """
    if isinstance(scenery, HorizontalPath):
        height = np.zeros_like(distance)
        particles = [(scenery.aerosol, np.full_like(distance, _uniform(scenery, moment)))]
    else:
        height = np.maximum(distance, 0.0) * math.cos(math.radians(zenith_angle))
        particles = _layers(scenery, moment, height)
    molecular = molecular_extinction(station_altitude + height, wavelength)
    extinction = molecular.copy()
    backscatter = molecular / molecular_lidar_ratio(wavelength)
    for aerosol, at_reference in particles:
        part = at_reference * _spectral(aerosol, wavelength)
        extinction += part
        backscatter += part / aerosol.lidar_ratio
    return Path(extinction, backscatter, isinstance(scenery, HorizontalPath))


def _uniform(scenery: HorizontalPath, moment: datetime) -> float:
    return diurnal(scenery.aerosol_extinction, moment)


def _spectral(aerosol: Aerosol, wavelength: float) -> float:
    return float((wavelength / REFERENCE_WAVELENGTH) ** -aerosol.angstrom_exponent)


def _layers(
    scenery: VerticalColumn, moment: datetime, height: Array
) -> list[tuple[Aerosol, Array]]:
    mixed = scenery.boundary_layer
    top = diurnal(mixed.height, moment)
    particles = [
        (mixed.aerosol, mixed.extinction * expit((top - height) / mixed.entrainment_depth))
    ]
    particles += [
        (
            layer.aerosol,
            layer.extinction * np.exp(-0.5 * ((height - layer.height) / layer.depth) ** 2),
        )
        for layer in scenery.layers
        if layer.start <= moment < layer.stop
    ]
    return particles
