"""The air of a simulation, and the values that all parts of a simulation are made of.

Extinction of particles is in m-1 at 532 nm. Heights are in metres above the ground at the
origin, positions in metres east and north of it.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from math import cos, pi
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticUndefined

from lidarops import settings
from lidarops.settings import SettingsModel, ordered, quantity


def _fits_headers(value: datetime) -> datetime:
    if value.microsecond:
        raise ValueError("must be a whole second: headers of raw files hold no fractions")
    if not 1960 <= value.year <= 2200:
        raise ValueError("is outside of the age of lasers: give a year from 1960 to 2200")
    return value


Instant = Annotated[settings.Instant, AfterValidator(_fits_headers)]
NotNegative = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)]
Azimuth = Annotated[float, Field(ge=0, lt=360, allow_inf_nan=False)]


def lidar_ratio(default: float, description: str) -> Any:
    """Return the field of a lidar ratio."""
    return quantity(default, unit="sr", ge=5, le=150, description=description)


def extinction_maximum(description: str) -> Any:
    """Return the field of the largest extinction of particles.

    A cloud has 0.1 m-1; the limit of 1 (1000 per km) catches values in km-1.
    """
    return quantity(unit="m-1", gt=0, le=1.0, description=description)


def length(description: str, default: Any = PydanticUndefined) -> Any:
    """Return the field of a length."""
    return quantity(default, unit="m", gt=0, le=1e7, allow_inf_nan=False, description=description)


def position(description: str) -> Any:
    """Return the field of a coordinate east or north of the origin."""
    return quantity(0.0, unit="m", ge=-1e6, le=1e6, allow_inf_nan=False, description=description)


def wind(towards: str) -> Any:
    """Return the field of a component of the wind."""
    return quantity(0.0, unit="m s-1", ge=-100, le=100, description=f"wind towards the {towards}")


class Period(SettingsModel):
    """Time interval from `start` to `stop`, without `stop`."""

    start: Instant = Field(description="first time of the period")
    stop: Instant = Field(description="end of the period, not included")

    _ordered = ordered("start", "stop", "stop must be later than start")

    def overlaps(self, start: datetime, stop: datetime) -> bool:
        """Return whether the interval from `start` to `stop` overlaps the period."""
        return start < self.stop and stop > self.start

    def holds(self, moment: datetime) -> bool:
        """Return whether a moment lies in the period."""
        return self.start <= moment < self.stop


class DiurnalCourse(SettingsModel):
    """A quantity that varies with the hour of the day (UTC) as a cosine."""

    # The unit of both is that of the field that holds the course.
    minimum: NotNegative = Field(description="least value, in the unit of the quantity")
    maximum: NotNegative = Field(description="largest value, in the unit of the quantity")
    hour_of_maximum: float = quantity(
        5.0, unit="h", ge=0, lt=24, allow_inf_nan=False, description="UTC, when it is largest"
    )

    _ordered = ordered(
        "minimum", "maximum", "maximum must not be less than minimum", may_be_equal=True
    )

    def at(self, moment: datetime) -> float:
        """Return the value at a time."""
        midnight = moment.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
        hours = (moment - midnight) / timedelta(hours=1)
        phase = cos(2.0 * pi * (hours - self.hour_of_maximum) / 24.0)
        return self.minimum + (self.maximum - self.minimum) * 0.5 * (1.0 + phase)


def _is_air(course: DiurnalCourse) -> DiurnalCourse:
    if course.maximum > 1.0:
        raise ValueError("extinction is in m-1: 1e-4 m-1 is 0.1 km-1")
    return course


DiurnalExtinction = Annotated[DiurnalCourse, AfterValidator(_is_air)]
"""m-1."""


class Aerosol(SettingsModel):
    """Optical properties of an aerosol type."""

    lidar_ratio: float = lidar_ratio(50.0, "extinction over backscatter")
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


class Layer(Period):
    """Elevated layer of Gaussian shape that exists for a period."""

    name: str = Field(description="your word for the layer")
    aerosol: Aerosol = Aerosol()
    extinction: float = extinction_maximum("at 532 nm at the centre")
    height: float = quantity(
        unit="m", gt=0, le=30_000, description="above the ground, of the centre"
    )
    depth: float = quantity(
        unit="m", gt=0, le=10_000, description="standard deviation of the Gaussian"
    )


class Cloud(Period):
    """Layer of constant extinction between a sharp base and top that exists for a period."""

    name: str = Field(default="cloud", description="your word for the cloud")
    extinction: float = extinction_maximum("the same at every wavelength")
    base: float = quantity(unit="m", ge=0, le=30_000, description="above the ground")
    top: float = quantity(unit="m", gt=0, le=30_000, description="above the ground")
    lidar_ratio: float = lidar_ratio(18.8, "18.8 for water clouds")

    _upright = ordered("base", "top", "top must be higher than base")


class Gradient(SettingsModel):
    """Aerosol with a horizontal gradient.

    The extinction is that at the origin times exp(distance / scale) towards `azimuth`.
    """

    aerosol: Aerosol = Aerosol()
    extinction: float = extinction_maximum("at 532 nm, at the origin")
    azimuth: Azimuth = quantity(90.0, unit="degree", description="direction of increase")
    scale: float = length("distance of an increase by a factor of e")
    top: float = length("above the ground", 1e5)


class Plume(SettingsModel):
    """Gaussian cloud of aerosol that drifts with the wind."""

    aerosol: Aerosol = Aerosol()
    extinction: float = extinction_maximum("at 532 nm, at the centre")
    east: float = position("of the centre at the start")
    north: float = position("of the centre at the start")
    height: NotNegative = quantity(0.0, unit="m", description="above the ground, of the centre")
    horizontal_depth: float = length("standard deviation")
    vertical_depth: float = length("standard deviation")
    wind_east: float = wind("east")
    wind_north: float = wind("north")


class Turbulence(SettingsModel):
    """Log-normal random factor on the aerosol that drifts with the wind."""

    deviation: float = quantity(
        unit="1", gt=0, le=3, description="standard deviation of the logarithm"
    )
    horizontal_length: float = length("correlation length")
    vertical_length: float = length("correlation length")
    wind_east: float = wind("east")
    wind_north: float = wind("north")


class _Columns(SettingsModel):
    """Lists of equal length, of which the first ascends."""

    @model_validator(mode="after")
    def _equal_and_ascending(self) -> Self:
        columns = {n: v for n in type(self).model_fields if isinstance(v := getattr(self, n), list)}
        name, grid = next(iter(columns.items()))
        if len({len(values) for values in columns.values()}) > 1:
            raise ValueError(f"{', '.join(columns)} need equal numbers of values")
        if any(upper <= lower for lower, upper in pairwise(grid)):
            raise ValueError(f"{name} must ascend")
        return self


class Profile(_Columns):
    """Aerosol extinction at given heights, linear between them and zero above the last."""

    aerosol: Aerosol = Aerosol()
    height: list[NotNegative] = quantity(
        unit="m", min_length=2, description="above the ground, ascending"
    )
    extinction: list[Annotated[float, Field(ge=0, le=1.0, allow_inf_nan=False)]] = quantity(
        unit="m-1", min_length=2, description="at 532 nm"
    )


class Sounding(_Columns):
    """Pressure and temperature of the air, in place of the US Standard Atmosphere."""

    altitude: list[float] = quantity(
        unit="m", min_length=2, description="above mean sea level, ascending"
    )
    pressure: list[float] = quantity(unit="Pa", min_length=2, description="at the altitudes")
    temperature: list[float] = quantity(unit="K", min_length=2, description="at the altitudes")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not all(1e-3 <= p <= 1.2e5 for p in self.pressure):
            raise ValueError("pressure is in Pa: 101325, not 1013.25")
        if not all(100 <= t <= 350 for t in self.temperature):
            raise ValueError("temperature is in K: 288.15, not 15")
        return self


class Homogeneous(SettingsModel):
    """Aerosol that is the same everywhere and varies over the day."""

    aerosol: Aerosol = Aerosol()
    extinction: DiurnalExtinction = quantity(unit="m-1", description="at 532 nm")
    molecules_constant: bool = Field(
        default=False,
        description="whether molecules have the density of the origin at any height, which makes"
        " the air homogeneous",
    )


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
