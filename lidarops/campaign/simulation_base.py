"""Value types of the simulation settings."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from lidarops import settings
from lidarops.settings import SettingsModel, quantity


def _whole_seconds(value: datetime) -> datetime:
    if value.microsecond:
        raise ValueError("must be a whole second: headers of raw files hold no fractions")
    return value


def _laser_era(value: datetime) -> datetime:
    if not 1960 <= value.year <= 2200:
        raise ValueError("is outside of the age of lasers: give a year from 1960 to 2200")
    return value


def _four_characters(value: float) -> float:
    written = f"{value:.2f}"[:4] if value < 100 else f"{value:04.0f}"
    if abs(float(written) - value) > 1e-12 * value:
        raise ValueError(
            f"{value:g} does not fit into the four characters of a raw header, such as 7.5 or 3.75"
        )
    return value


Instant = Annotated[settings.Instant, AfterValidator(_whole_seconds), AfterValidator(_laser_era)]
BinWidth = Annotated[float, Field(ge=0.5, le=150), AfterValidator(_four_characters)]
"""m."""
NotNegative = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)]
Hour = Annotated[float, Field(ge=0, lt=24, allow_inf_nan=False)]
Extinction = Annotated[float, Field(ge=0, le=1.0, allow_inf_nan=False)]
"""m-1. A cloud has 0.1; the limit of 1 (1000 per km) catches values given in km-1."""
Length = Annotated[float, Field(gt=0, le=1e7, allow_inf_nan=False)]
Azimuth = Annotated[float, Field(ge=0, lt=360, allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]


class Period(SettingsModel):
    """Time interval from `start` to `stop`, without `stop`."""

    start: Instant = Field(description="first time of the period")
    stop: Instant = Field(description="end of the period, not included")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.stop <= self.start:
            raise ValueError("stop must be later than start")
        return self

    def overlaps(self, start: datetime, stop: datetime) -> bool:
        """Return whether the interval from `start` to `stop` overlaps the period."""
        return start < self.stop and stop > self.start


class DiurnalCourse(SettingsModel):
    """A quantity that varies with the hour of the day (UTC) as a cosine."""

    # The unit of both is that of the field that holds the course.
    minimum: NotNegative = Field(description="least value, in the unit of the quantity")
    maximum: NotNegative = Field(description="largest value, in the unit of the quantity")
    hour_of_maximum: Hour = quantity(5.0, unit="h", description="UTC, when the value is largest")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.maximum < self.minimum:
            raise ValueError("maximum must not be less than minimum")
        return self
