"""Base of all settings that a person writes, and the types of their values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    model_validator,
)


def _utc(value: datetime) -> datetime:
    return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def _as_list(value: Any) -> Any:
    """Return a single text as a list."""
    return [value] if isinstance(value, str) else value


def _clean_pattern(value: str) -> str:
    if value.startswith(("/", "~")) or ".." in value.split("/"):
        raise ValueError(f"{value!r} must be a relative path without '..'")
    return value


def as_interval(value: Any) -> Any:
    """Return an interval for a text such as 6h or 30min; leave other values as they are."""
    if isinstance(value, str) and value != "day":
        units = {"s": 1, "min": 60, "h": 3600, "d": 86400}
        number = value.rstrip("abcdefghijklmnopqrstuvwxyz ")
        unit = value[len(number) :].strip()
        if unit in units:
            try:
                return timedelta(seconds=float(number) * units[unit])
            except OverflowError as error:
                raise ValueError(f"{value!r} is too long an interval") from error
    return value


Instant = Annotated[datetime, AfterValidator(_utc)]
Patterns = Annotated[
    list[Annotated[str, AfterValidator(_clean_pattern)]], BeforeValidator(_as_list), Field()
]
Inside = Annotated[str, AfterValidator(_clean_pattern)]
"""Path below the folder of the campaign file, relative to it."""
IDENTIFIER = r"^[A-Za-z0-9][A-Za-z0-9-]*$"
Identifier = Annotated[str, Field(pattern=IDENTIFIER, max_length=40)]
Metres = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class SettingsModel(BaseModel):
    """Base of the models: frozen, and without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _divides_day(interval: timedelta) -> timedelta:
    seconds = interval.total_seconds()
    if seconds < 1 or 86400 % seconds:
        raise ValueError("must be at least 1 s and divide a day: 5min, 30min, 2h")
    return interval


PartOfDay = Annotated[timedelta, BeforeValidator(as_interval), AfterValidator(_divides_day)]


class ChannelProduct(SettingsModel):
    """Base of the settings of a kind of product that is made of one channel."""

    channels: list[str] | Literal["all"]
    """Names of channels; ``all`` means every channel of the files, without glued ones."""

    @property
    def named(self) -> list[str]:
        """The channels that are requested by name."""
        return [] if self.channels == "all" else list(self.channels)

    def covers(self, channel: str, *, of_files: bool) -> bool:
        """Return whether a channel is requested; `of_files` says whether the files hold it."""
        return (of_files and self.channels == "all") or channel in self.named


class NetworkProduct(SettingsModel):
    """Base of the settings of a kind of product that is made of a network of instruments."""

    channel: str = Field(description="channel of all instruments, such as photon_532o, glued_532o")

    def check_members(self, instruments: Sequence[str]) -> None:
        """Raise ValueError where the settings do not fit the instruments of the network."""


class VisibilitySettings(SettingsModel):
    """Definition of visibility: contrast, and conversion of extinction to 550 nm."""

    contrast: Annotated[float, Field(gt=0, lt=1)] | Literal["paper"] = Field(
        default=0.05,
        description="threshold: 0.05 (meteorological optical range), 0.02 (Koschmieder), or"
        " 'paper': exp(-3), the rounded constant of the multi-position papers",
    )
    law: Literal["none", "angstrom", "kruse"] = Field(
        default="none",
        description="conversion of extinction from the wavelength of the lidar to 550 nm; none"
        " keeps the wavelength of the lidar",
    )
    angstrom_exponent: float | None = Field(default=None, ge=-1, le=5)
    exponent_standard_error: float = Field(
        default=0.0, ge=0, le=5, description="standard error of the exponent of the law"
    )

    @model_validator(mode="after")
    def _has_its_exponent(self) -> Self:
        if (self.angstrom_exponent is not None) != (self.law == "angstrom"):
            raise ValueError("angstrom_exponent is required with law: angstrom, and only there")
        if self.law == "none" and self.exponent_standard_error:
            raise ValueError("exponent_standard_error needs a law: angstrom or kruse")
        return self

    @property
    def threshold(self) -> float:
        """The contrast as a number."""
        return math.exp(-3.0) if self.contrast == "paper" else self.contrast
