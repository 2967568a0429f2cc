"""The key ``atmosphere``: sources of pressure, temperature and humidity of the air."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

from pydantic import Field

from lidarops.settings import Interval, Patterns, SettingsModel, quantity

_Age = Annotated[Interval, Field(ge=timedelta(0), le=timedelta(days=31))]


class AtmosphereReading(SettingsModel):
    """What the files of a source do not state themselves."""

    columns: list[str] = Field(
        default=[],
        description="of CSV files without a title line: names with units, such as altitude [m],"
        " pressure [hPa], temperature [K]; any other name for a column that is not used",
    )
    name_time: str = Field(
        default="",
        pattern=r"^$|%[Yy]",
        description="where the time stands in the names of files that state none, in UTC, by the"
        " codes of strptime: sonde_%Y%m%d%H.csv",
    )
    latitude: float | None = quantity(
        None, unit="degree", ge=-90, le=90, description="north, of files that state no place"
    )
    longitude: float | None = quantity(
        None, unit="degree", ge=-180, le=180, description="east, of files that state no place"
    )
    relative_error: float | None = quantity(
        None,
        unit="1",
        ge=0,
        le=0.2,
        description="standard error of the density of the air at the time of a profile, relative;"
        " 0.003 if none, and what the distance in time adds comes on top",
    )


class AtmosphereSource(AtmosphereReading):
    """Files of one origin: soundings, or profiles of a model."""

    files: Patterns = Field(
        min_length=1,
        description="patterns of paths below the folder of the campaign file, as of raw files",
    )
    greatest_age: _Age = Field(
        default=timedelta(hours=12),
        description="from the middle of a scene to the time of a profile, before or after it",
    )
    greatest_distance: float = quantity(
        200_000.0,
        unit="m",
        ge=0,
        le=2e7,
        description="from the station to the place of a profile",
    )
