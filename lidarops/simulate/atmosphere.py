"""The air of a simulation, as a campaign file describes it, along a beam."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from lidarops.campaign.simulated_atmosphere import Gradient, Plume, Sounding, Turbulence
from lidarops.campaign.simulation import Aerosol, AtmosphereSettings, DiurnalCourse
from lidarops.retrieve.air.molecular import (
    HIGHEST,
    LOWEST,
    MolecularProfile,
    molecular_lidar_ratio,
    number_density,
    rayleigh_cross_section,
    us_standard,
)

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH: Final = 532e-9
"""m, at which the settings give the extinction of aerosol."""

_MODES: Final = 256
"""Plane waves that make up the turbulence."""


class Beam(NamedTuple):
    """A straight line from a lidar."""

    east: float
    """m from the origin of the air."""
    north: float
    height: float
    """m above the ground of the origin."""
    zenith_angle: float
    """degree, 0 = up."""
    azimuth: float
    """degree, clockwise from north."""


@dataclass(frozen=True, slots=True)
class Path:
    """Optical properties along a beam."""

    extinction: Array
    """m-1, by molecules and particles, at the bin centres."""
    backscatter: Array
    """m-1 sr-1, by molecules and particles, at the bin centres."""

    @property
    def homogeneous(self) -> bool:
        """Whether both are the same at every range, but for rounding."""
        return all(
            float(np.ptp(values)) <= 1e-9 * float(values[0])
            for values in (self.extinction, self.backscatter)
        )


class _Points(NamedTuple):
    east: Array
    north: Array
    height: Array


def diurnal(course: DiurnalCourse, moment: datetime) -> float:
    """Return the value of a diurnal course: a cosine with its maximum at a given hour (UTC)."""
    midnight = moment.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    hours = (moment - midnight) / timedelta(hours=1)
    phase = math.cos(2.0 * math.pi * (hours - course.hour_of_maximum) / 24.0)
    return course.minimum + (course.maximum - course.minimum) * 0.5 * (1.0 + phase)


class Air:
    """What simulated lidars look at.

    Parameters
    ----------
    settings : AtmosphereSettings
    altitude : float, m
        Of the ground of the origin above mean sea level.
    start : datetime
        From which plumes and turbulence drift.
    seed : int
        Of the turbulence.

    Notes
    -----
    The Earth is flat here, and refraction is left out. Extinction and backscatter add up the
    molecules (US Standard Atmosphere, or the sounding and the standard scaled to meet its ends)
    and everything that the settings name; turbulence multiplies all particles but clouds.
    """

    def __init__(
        self, settings: AtmosphereSettings, *, altitude: float, start: datetime, seed: int
    ) -> None:
        self._settings = settings
        self._altitude = altitude
        self._start = start
        self._sounding = None if settings.sounding is None else _profile(settings.sounding)
        self._eddies = None if settings.turbulence is None else Eddies(settings.turbulence, seed)

    def state(self, moment: datetime) -> tuple[object, ...]:
        """Return what the air depends on at a moment: equal states are the same air."""
        told = self._settings
        courses = (told.homogeneous and told.homogeneous.extinction) or None
        heights = (told.boundary_layer and told.boundary_layer.height) or None
        moving = told.plumes or told.turbulence
        return (
            None if courses is None else diurnal(courses, moment),
            None if heights is None else diurnal(heights, moment),
            tuple(layer.start <= moment < layer.stop for layer in told.layers),
            tuple(cloud.start <= moment < cloud.stop for cloud in told.clouds),
            moment if moving else None,
        )

    def along(self, beam: Beam, distance: Array, moment: datetime, wavelength: float) -> Path:
        """Return what a beam passes through.

        Parameters
        ----------
        beam : Beam
        distance : ndarray, m, shape (bins,)
            From the lidar; points before it (negative) see what it sees itself.
        moment : datetime
            With time zone.
        wavelength : float, m
        """
        points = _points(beam, np.maximum(distance, 0.0))
        molecular = self.molecules(points.height, wavelength)
        extinction = molecular.copy()
        backscatter = molecular / molecular_lidar_ratio(wavelength)
        factor = 1.0 if self._eddies is None else self._eddies.at(points, self._seconds(moment))
        for aerosol, at_reference in self._particles(points, moment):
            part = factor * at_reference * _spectral(aerosol, wavelength)
            extinction += part
            backscatter += part / aerosol.lidar_ratio
        for cloud in self._settings.clouds:
            if cloud.start <= moment < cloud.stop:
                inside = (points.height >= cloud.base) & (points.height < cloud.top)
                extinction += inside * cloud.extinction
                backscatter += inside * (cloud.extinction / cloud.lidar_ratio)
        return Path(extinction, backscatter)

    def molecules(self, height: Array, wavelength: float) -> Array:
        """Return the extinction by molecules at heights above the ground, m-1."""
        constant = self._settings.homogeneous is not None and (
            self._settings.homogeneous.molecules_constant
        )
        altitude = self._altitude + (np.zeros_like(height) if constant else height)
        if self._sounding is not None:
            density = self._sounding.number_density(altitude)
        else:
            inside = np.clip(altitude, LOWEST, HIGHEST)
            density = number_density(*us_standard(inside)) * (altitude <= HIGHEST)
        return density * rayleigh_cross_section(wavelength)

    def _seconds(self, moment: datetime) -> float:
        return (moment - self._start).total_seconds()

    def _particles(self, points: _Points, moment: datetime) -> Iterator[tuple[Aerosol, Array]]:
        told = self._settings
        if told.homogeneous is not None:
            everywhere = np.full_like(points.height, diurnal(told.homogeneous.extinction, moment))
            yield told.homogeneous.aerosol, everywhere
        if told.boundary_layer is not None:
            mixed = told.boundary_layer
            rise = (diurnal(mixed.height, moment) - points.height) / mixed.entrainment_depth
            yield mixed.aerosol, mixed.extinction * expit(rise)
        for layer in told.layers:
            if layer.start <= moment < layer.stop:
                rise = (points.height - layer.height) / layer.depth
                yield layer.aerosol, layer.extinction * np.exp(-0.5 * rise**2)
        for profile in told.profiles:
            values = np.interp(points.height, profile.height, profile.extinction, right=0.0)
            yield profile.aerosol, values
        for gradient in told.gradients:
            yield gradient.aerosol, _sloping(gradient, points)
        for plume in told.plumes:
            yield plume.aerosol, _carried(plume, points, self._seconds(moment))


class Eddies:
    r"""A log-normal random field of mean 1, carried by the wind.

    Parameters
    ----------
    settings : Turbulence
    seed : int

    Notes
    -----
    :math:`\exp(s g - s^2 / 2)` with :math:`g = \sqrt{2 / M} \sum_m \cos(k_m x + \phi_m)`: plane
    waves of random phase, whose wave numbers are normal with standard deviation 1 / L, so that
    the correlation of g is :math:`\exp(-x^2 / 2 L^2)` in every direction. It needs no grid, and
    any lidar that looks at the same place and time sees the same air.
    """

    def __init__(self, settings: Turbulence, seed: int) -> None:
        self._settings = settings
        random = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, 0xEDD1E5])))
        lengths = np.array(
            [settings.horizontal_length, settings.horizontal_length, settings.vertical_length]
        )
        self._wave_numbers = random.standard_normal((_MODES, 3)) / lengths
        self._phases = random.uniform(0.0, 2.0 * np.pi, _MODES)

    def at(self, points: _Points, seconds: float) -> Array:
        """Return the factor at points, `seconds` after the start."""
        told = self._settings
        total = np.zeros_like(points.height)
        east = points.east - told.wind_east * seconds
        north = points.north - told.wind_north * seconds
        for (k_east, k_north, k_up), phase in zip(self._wave_numbers, self._phases, strict=True):
            total += np.cos(k_east * east + k_north * north + k_up * points.height + phase)
        normal = math.sqrt(2.0 / _MODES) * total
        factor: Array = np.exp(told.deviation * normal - 0.5 * told.deviation**2)
        return factor


def _points(beam: Beam, distance: Array) -> _Points:
    zenith, azimuth = math.radians(beam.zenith_angle), math.radians(beam.azimuth)
    # Exactly level, so that a horizontal beam stays in one layer at any range.
    rise = 0.0 if beam.zenith_angle == 90.0 else math.cos(zenith)
    level = math.sin(zenith) * distance
    return _Points(
        beam.east + level * math.sin(azimuth),
        beam.north + level * math.cos(azimuth),
        beam.height + rise * distance,
    )


def _spectral(aerosol: Aerosol, wavelength: float) -> float:
    return float((wavelength / REFERENCE_WAVELENGTH) ** -aerosol.angstrom_exponent)


def _sloping(gradient: Gradient, points: _Points) -> Array:
    azimuth = math.radians(gradient.azimuth)
    along = points.east * math.sin(azimuth) + points.north * math.cos(azimuth)
    # Cut at a thousandfold, far beyond what is meant, so that nothing overflows.
    growth = np.exp(np.minimum(along / gradient.scale, math.log(1e3)))
    values: Array = gradient.extinction * growth * (points.height <= gradient.top)
    return values


def _carried(plume: Plume, points: _Points, seconds: float) -> Array:
    east = (points.east - plume.east - plume.wind_east * seconds) / plume.horizontal_depth
    north = (points.north - plume.north - plume.wind_north * seconds) / plume.horizontal_depth
    rise = (points.height - plume.height) / plume.vertical_depth
    values: Array = plume.extinction * np.exp(-0.5 * (east**2 + north**2 + rise**2))
    return values


def _profile(sounding: Sounding) -> MolecularProfile:
    return MolecularProfile(
        np.array(sounding.altitude), np.array(sounding.pressure), np.array(sounding.temperature)
    )
