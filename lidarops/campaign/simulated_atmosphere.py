"""Settings of the atmosphere of a simulation.

Extinction of particles is in m-1 at 532 nm. Heights are in metres above the ground at the
origin, positions in metres east and north of it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Self

from pydantic import Field, model_validator

from lidarops.campaign.simulation_base import (
    Azimuth,
    DiurnalCourse,
    Extinction,
    Length,
    Metres,
    NotNegative,
    Period,
)
from lidarops.settings import SettingsModel, quantity


class Aerosol(SettingsModel):
    """Optical properties of an aerosol type."""

    lidar_ratio: float = quantity(
        50.0, unit="sr", ge=5, le=150, description="extinction over backscatter"
    )
    angstrom_exponent: float = quantity(1.3, unit="1", ge=-1, le=4, description="of extinction")


class BoundaryLayer(SettingsModel):
    """Aerosol, well mixed from the ground to a top that varies over the day."""

    aerosol: Aerosol = Aerosol()
    extinction: float = quantity(1.0e-4, unit="m-1", ge=0, le=0.1, description="at 532 nm")
    height: DiurnalCourse = quantity(
        DiurnalCourse(minimum=500.0, maximum=1600.0, hour_of_maximum=14.0),
        unit="m",
        description="above the ground",
    )
    entrainment_depth: float = quantity(
        100.0,
        unit="m",
        gt=0,
        le=2000,
        description="scale of the gradual decrease at the top",
    )


class Layer(Period):
    """Elevated layer of Gaussian shape that exists for a period."""

    name: str = Field(description="your word for the layer")
    aerosol: Aerosol = Aerosol()
    extinction: float = quantity(unit="m-1", gt=0, le=1.0, description="at 532 nm at the centre")
    height: float = quantity(
        unit="m", gt=0, le=30_000, description="above the ground, of the centre"
    )
    depth: float = quantity(
        unit="m", gt=0, le=10_000, description="standard deviation of the Gaussian"
    )


class Cloud(Period):
    """Layer of constant extinction between a sharp base and top that exists for a period."""

    name: str = Field(default="cloud", description="your word for the cloud")
    extinction: float = quantity(
        unit="m-1", gt=0, le=1.0, description="the same at every wavelength"
    )
    base: float = quantity(unit="m", ge=0, le=30_000, description="above the ground")
    top: float = quantity(unit="m", gt=0, le=30_000, description="above the ground")
    lidar_ratio: float = quantity(
        18.8, unit="sr", ge=5, le=150, description="18.8 for water clouds"
    )

    @model_validator(mode="after")
    def _upright(self) -> Self:
        if self.top <= self.base:
            raise ValueError("top must be higher than base")
        return self


class Gradient(SettingsModel):
    """Aerosol with a horizontal gradient.

    The extinction is that at the origin times exp(distance / scale) towards `azimuth`.
    """

    aerosol: Aerosol = Aerosol()
    extinction: float = quantity(unit="m-1", gt=0, le=1.0, description="at 532 nm, at the origin")
    azimuth: Azimuth = quantity(90.0, unit="degree", description="direction of increase")
    scale: Length = quantity(unit="m", description="distance of an increase by a factor of e")
    top: Length = quantity(1e5, unit="m", description="above the ground")


class Plume(SettingsModel):
    """Gaussian cloud of aerosol that drifts with the wind."""

    aerosol: Aerosol = Aerosol()
    extinction: float = quantity(unit="m-1", gt=0, le=1.0, description="at 532 nm, at the centre")
    east: Metres = quantity(0.0, unit="m", description="of the centre at the start")
    north: Metres = quantity(0.0, unit="m", description="of the centre at the start")
    height: NotNegative = quantity(0.0, unit="m", description="above the ground, of the centre")
    horizontal_depth: Length = quantity(unit="m", description="standard deviation")
    vertical_depth: Length = quantity(unit="m", description="standard deviation")
    wind_east: float = quantity(
        0.0, unit="m s-1", ge=-100, le=100, description="wind towards the east"
    )
    wind_north: float = quantity(
        0.0, unit="m s-1", ge=-100, le=100, description="wind towards the north"
    )


class Turbulence(SettingsModel):
    """Log-normal random factor on the aerosol that drifts with the wind."""

    deviation: float = quantity(
        unit="1", gt=0, le=3, description="standard deviation of the logarithm"
    )
    horizontal_length: Length = quantity(unit="m", description="correlation length")
    vertical_length: Length = quantity(unit="m", description="correlation length")
    wind_east: float = quantity(
        0.0, unit="m s-1", ge=-100, le=100, description="wind towards the east"
    )
    wind_north: float = quantity(
        0.0, unit="m s-1", ge=-100, le=100, description="wind towards the north"
    )


class Profile(SettingsModel):
    """Aerosol extinction at given heights, linear between them and zero above the last."""

    aerosol: Aerosol = Aerosol()
    height: list[NotNegative] = quantity(
        unit="m", min_length=2, description="above the ground, ascending"
    )
    extinction: list[Extinction] = quantity(unit="m-1", min_length=2, description="at 532 nm")

    @model_validator(mode="after")
    def _ascends(self) -> Self:
        if len(self.height) != len(self.extinction):
            raise ValueError("height and extinction need equal numbers of values")
        if any(upper <= lower for lower, upper in pairwise(self.height)):
            raise ValueError("height must ascend")
        return self


class Sounding(SettingsModel):
    """Pressure and temperature of the air, in place of the US Standard Atmosphere."""

    altitude: list[float] = quantity(
        unit="m", min_length=2, description="above mean sea level, ascending"
    )
    pressure: list[float] = quantity(unit="Pa", min_length=2, description="at the altitudes")
    temperature: list[float] = quantity(unit="K", min_length=2, description="at the altitudes")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not len(self.altitude) == len(self.pressure) == len(self.temperature):
            raise ValueError("altitude, pressure and temperature need equal numbers of values")
        if any(upper <= lower for lower, upper in pairwise(self.altitude)):
            raise ValueError("altitude must ascend")
        if not all(1e-3 <= p <= 1.2e5 for p in self.pressure):
            raise ValueError("pressure is in Pa: 101325, not 1013.25")
        if not all(100 <= t <= 350 for t in self.temperature):
            raise ValueError("temperature is in K: 288.15, not 15")
        return self


class Homogeneous(SettingsModel):
    """Aerosol that is the same everywhere and varies over the day."""

    aerosol: Aerosol = Aerosol()
    extinction: DiurnalCourse = quantity(unit="m-1", description="at 532 nm")
    molecules_constant: bool = Field(
        default=False,
        description="whether molecules have the density of the origin at any height, which makes"
        " the air homogeneous",
    )

    @model_validator(mode="after")
    def _is_air(self) -> Self:
        if self.extinction.maximum > 1.0:
            raise ValueError("extinction is in m-1: 1e-4 m-1 is 0.1 km-1")
        return self


class AtmosphereSettings(SettingsModel):
    """Atmosphere: molecules, and the sum of all aerosol and clouds given here."""

    homogeneous: Homogeneous | None = None
    boundary_layer: BoundaryLayer | None = None
    layers: tuple[Layer, ...] = ()
    clouds: tuple[Cloud, ...] = ()
    gradients: tuple[Gradient, ...] = ()
    plumes: tuple[Plume, ...] = ()
    profiles: tuple[Profile, ...] = ()
    turbulence: Turbulence | None = None
    sounding: Sounding | None = None
