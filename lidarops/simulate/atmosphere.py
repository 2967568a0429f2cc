"""The air that a campaign file describes, along a beam, and the brightness of the clear sky."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from lidarops.campaign.simulated_air import (
    Aerosol,
    AtmosphereSettings,
    Gradient,
    Plume,
    Turbulence,
)
from lidarops.campaign.simulated_instrument import RamanLines
from lidarops.constants import EFFECTIVE_RADIUS
from lidarops.retrieve.air.molecular import (
    HIGHEST,
    LOWEST,
    MolecularProfile,
    molecular_lidar_ratio,
    number_density,
    rayleigh_cross_section,
    us_standard,
)
from lidarops.retrieve.raman.scattering import MASS_RATIO, NITROGEN_SHARE
from lidarops.simulate.signal import SimulationInputError, check_between

Array = NDArray[np.float64]

REFERENCE_WAVELENGTH: Final = 532e-9
"""m, wavelength of the extinction of aerosol in the settings."""

_RAMAN_CROSS_SECTION: Final = 2.8e-34
"""m2 sr-1, of the vibrational Raman lines of nitrogen at `_RAMAN_WAVELENGTH` (`wandinger2005`)."""
_RAMAN_WAVELENGTH: Final = 355e-9
"""m."""
_WATER_OVER_NITROGEN: Final = 2.5
"""Cross section of the lines of water vapour over that of nitrogen (`whiteman2003`)."""
_SCALE_HEIGHT: Final = 2000.0
"""m, in which the mixing ratio of water vapour falls to 1/e."""
_ENTRAINMENT_DEPTH: Final = 100.0
"""m, scale of the gradual decrease at the top of the boundary layer."""
_MODES: Final = 256
"""Number of plane waves in the turbulence."""
_TWILIGHT_AT_HORIZON: Final = 0.02
"""Brightness with the sun at the horizon, relative to the zenith."""
_DEGREES_PER_DECADE: Final = 3.0
"""Depression of the sun in which the sky darkens tenfold."""
_CONTRAST: Final = 10.0
"""Least light of the brightest sky over that of the darkest one that are day and night."""
_DUSK: Final = -5.0
"""degree; elevation of the sun at which the sky has the middle of the light of day and night."""


class Beam(NamedTuple):
    """Line of sight of a lidar."""

    east: float
    """m from the origin."""
    north: float
    height: float
    """m above the ground at the origin."""
    zenith_angle: float
    """degree, 0 = up."""
    azimuth: float
    """degree, clockwise from north."""


@dataclass(frozen=True, slots=True)
class BeamPath:
    """Optical properties along a beam."""

    extinction: Array
    """m-1, by molecules and particles, at the bin centres."""
    backscatter: Array
    """m-1 sr-1, by molecules and particles, at the bin centres."""

    @property
    def homogeneous(self) -> bool:
        """Whether both are the same at every range, except for rounding."""
        return all(
            float(np.ptp(values)) <= 1e-9 * float(values[0])
            for values in (self.extinction, self.backscatter)
        )


class _Points(NamedTuple):
    east: Array
    north: Array
    height: Array


class Air:
    """The atmosphere of simulated lidars.

    Parameters
    ----------
    settings : AtmosphereSettings
    altitude : float, m
        Of the ground at the origin, above mean sea level.
    start : datetime
        When the drift of plumes and turbulence begins.
    seed : int
        Of the turbulence.

    Notes
    -----
    The air is stratified over the curved Earth, and refraction bends beams (`EFFECTIVE_RADIUS`),
    but for horizontal ones. Horizontal distances are those of a flat Earth. Extinction and
    backscatter are the sums over molecules (US Standard Atmosphere; or a sounding, continued by the
    standard scaled to meet its ends) and all particles in the settings. Turbulence multiplies all
    particles except clouds.
    """

    def __init__(
        self, settings: AtmosphereSettings, *, altitude: float, start: datetime, seed: int
    ) -> None:
        self._settings = settings
        self._altitude = altitude
        self._start = start
        self._sounding: MolecularProfile | None = None
        if (given := settings.sounding) is not None:
            self._sounding = MolecularProfile(
                np.array(given.altitude), np.array(given.pressure), np.array(given.temperature)
            )
        self._eddies = None if settings.turbulence is None else _Eddies(settings.turbulence, seed)

    def state(self, moment: datetime) -> tuple[object, ...]:
        """Return what the air depends on at a moment; equal states mean the same air."""
        air = self._settings
        extinction = (air.homogeneous and air.homogeneous.extinction) or None
        height = (air.boundary_layer and air.boundary_layer.height) or None
        moving = air.plumes or air.turbulence
        return (
            None if extinction is None else extinction.at(moment),
            None if height is None else height.at(moment),
            tuple(layer.holds(moment) for layer in air.layers),
            tuple(cloud.holds(moment) for cloud in air.clouds),
            moment if moving else None,
        )

    def along(self, beam: Beam, distance: Array, moment: datetime, wavelength: float) -> BeamPath:
        """Return extinction and backscatter along a beam.

        Parameters
        ----------
        beam : Beam
        distance : ndarray, m, shape (bins,)
            From the lidar; negative distances get the air at the lidar.
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
            spectral = (wavelength / REFERENCE_WAVELENGTH) ** -aerosol.angstrom_exponent
            particles = factor * at_reference * spectral
            extinction += particles
            backscatter += particles / aerosol.lidar_ratio
        for cloud in self._settings.clouds:
            if cloud.holds(moment):
                inside = (points.height >= cloud.base) & (points.height < cloud.top)
                extinction += inside * cloud.extinction
                backscatter += inside * (cloud.extinction / cloud.lidar_ratio)
        return BeamPath(extinction, backscatter)

    def raman_along(self, beam: Beam, distance: Array, lines: RamanLines) -> Array:
        """Return the Raman backscatter along a beam, m-1 sr-1.

        Parameters
        ----------
        beam : Beam
        distance : ndarray, m, shape (bins,)
        lines : RamanLines
        """
        height = _points(beam, np.maximum(distance, 0.0)).height
        cross_section = _RAMAN_CROSS_SECTION * (_RAMAN_WAVELENGTH / (lines.laser * 1e-9)) ** 4
        density = self._density(height)
        if lines.gas == "nitrogen":
            return np.asarray(NITROGEN_SHARE * density * cross_section)
        ratio = lines.surface_mixing_ratio * np.exp(-np.maximum(height, 0.0) / _SCALE_HEIGHT)
        return np.asarray(ratio / MASS_RATIO * density * _WATER_OVER_NITROGEN * cross_section)

    def molecules(self, height: Array, wavelength: float) -> Array:
        """Return the molecular extinction at heights above the ground, m-1."""
        return self._density(height) * rayleigh_cross_section(wavelength)

    def _density(self, height: Array) -> Array:
        """Return the number density of air at heights above the ground, m-3."""
        constant = self._settings.homogeneous is not None and (
            self._settings.homogeneous.molecules_constant
        )
        altitude = self._altitude + (np.zeros_like(height) if constant else height)
        if self._sounding is not None:
            return self._sounding.number_density(altitude)
        inside = np.clip(altitude, LOWEST, HIGHEST)
        return np.asarray(number_density(*us_standard(inside)) * (altitude <= HIGHEST))

    def _seconds(self, moment: datetime) -> float:
        return (moment - self._start).total_seconds()

    def _particles(self, points: _Points, moment: datetime) -> Iterator[tuple[Aerosol, Array]]:
        air = self._settings
        if air.homogeneous is not None:
            everywhere = np.full_like(points.height, air.homogeneous.extinction.at(moment))
            yield air.homogeneous.aerosol, everywhere
        if air.boundary_layer is not None:
            layer = air.boundary_layer
            rise = (layer.height.at(moment) - points.height) / _ENTRAINMENT_DEPTH
            yield layer.aerosol, layer.extinction * expit(rise)
        for elevated in air.layers:
            if elevated.holds(moment):
                rise = (points.height - elevated.height) / elevated.depth
                yield elevated.aerosol, elevated.extinction * np.exp(-0.5 * rise**2)
        for profile in air.profiles:
            values = np.interp(points.height, profile.height, profile.extinction, right=0.0)
            yield profile.aerosol, values
        for gradient in air.gradients:
            yield gradient.aerosol, _gradient_extinction(gradient, points)
        for plume in air.plumes:
            yield plume.aerosol, _plume_extinction(plume, points, self._seconds(moment))


class _Eddies:
    r"""Turbulence: a log-normal random field of mean 1 that drifts with the wind.

    Notes
    -----
    :math:`\exp(s g - s^2 / 2)` with :math:`g = \sqrt{2 / M} \sum_m \cos(k_m x + \phi_m)`: plane
    waves of random phase with normally distributed wave numbers of standard deviation 1 / L. The
    correlation of g is therefore :math:`\exp(-x^2 / 2 L^2)` in every direction. No grid is
    needed, and all lidars see the same air at the same place and time.
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
        settings = self._settings
        total = np.zeros_like(points.height)
        east = points.east - settings.wind_east * seconds
        north = points.north - settings.wind_north * seconds
        for (k_east, k_north, k_up), phase in zip(self._wave_numbers, self._phases, strict=True):
            total += np.cos(k_east * east + k_north * north + k_up * points.height + phase)
        normal = math.sqrt(2.0 / _MODES) * total
        factor: Array = np.exp(settings.deviation * normal - 0.5 * settings.deviation**2)
        return factor


def _points(beam: Beam, distance: Array) -> _Points:
    zenith, azimuth = math.radians(beam.zenith_angle), math.radians(beam.azimuth)
    level = math.sin(zenith) * distance
    # A horizontal beam stays in its layer at any range: homogeneous paths are exactly that.
    climb = np.zeros_like(distance)
    if beam.zenith_angle != 90.0:
        climb = math.cos(zenith) * distance + level**2 / (2.0 * EFFECTIVE_RADIUS)
    return _Points(
        beam.east + level * math.sin(azimuth),
        beam.north + level * math.cos(azimuth),
        beam.height + climb,
    )


def _gradient_extinction(gradient: Gradient, points: _Points) -> Array:
    azimuth = math.radians(gradient.azimuth)
    along = points.east * math.sin(azimuth) + points.north * math.cos(azimuth)
    # Growth is cut at a factor of 1000, far above any real gradient, against overflow.
    growth = np.exp(np.minimum(along / gradient.scale, math.log(1e3)))
    values: Array = gradient.extinction * growth * (points.height <= gradient.top)
    return values


def _plume_extinction(plume: Plume, points: _Points, seconds: float) -> Array:
    east = (points.east - plume.east - plume.wind_east * seconds) / plume.horizontal_depth
    north = (points.north - plume.north - plume.wind_north * seconds) / plume.horizontal_depth
    rise = (points.height - plume.height) / plume.vertical_depth
    values: Array = plume.extinction * np.exp(-0.5 * (east**2 + north**2 + rise**2))
    return values


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
    check_between("latitude", latitude, -90.0, 90.0, "degree")
    check_between("longitude", longitude, -360.0, 360.0, "degree")
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


def clock_of_sky(
    sky: Array, moments: Sequence[datetime], latitude: float, longitude: float
) -> tuple[float, float] | None:
    """Return the clocks minus UTC that the light of the sky fits, h; None where UTC fits, or none.

    The sky is bright where the sun stands above -5 degree. Files that are on the other side of the
    middle between the brightest and the darkest contradict a clock. One may be an error.

    Parameters
    ----------
    sky : (time,) float
        Light without that of the laser, above 0, in any unit.
    moments : sequence of datetime
        By the clock of the files.
    latitude, longitude : float
        degree.
    """
    if sky.max() < _CONTRAST * sky.min():
        return None
    bright = sky > math.sqrt(sky.max() * sky.min())
    utc = [moment.replace(tzinfo=UTC) for moment in moments]
    wrong = {}
    for half in range(-24, 25):
        back = timedelta(hours=half / 2.0)
        day = [solar_elevation(moment - back, latitude, longitude) > _DUSK for moment in utc]
        wrong[half / 2.0] = int(np.sum(bright != np.array(day)))
    fit = [hours for hours, files in wrong.items() if files <= min(wrong.values()) + 1]
    return None if 0.0 in fit else (min(fit), max(fit))
