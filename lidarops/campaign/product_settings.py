"""Settings of products in a campaign file, one model a kind, and the types of their values."""

from __future__ import annotations

import math
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


class SignalSettings(SettingsModel):
    """The ``signal`` product: background-subtracted, range-corrected signals."""

    channels: list[str] | Literal["all"] = "all"
    background_range: tuple[Metres, Metres] | None = Field(
        default=None, description="m; by default the last tenth of the bins"
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.background_range and self.background_range[0] >= self.background_range[1]:
            raise ValueError("background_range must end farther than it starts")
        return self


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


class HomogeneousSettings(SettingsModel):
    """The ``homogeneous`` product: background, amplitude and extinction of range sections."""

    channels: list[str] = Field(min_length=1)
    sections: list[tuple[Metres, Metres]] = Field(min_length=1, description="m")
    method: Literal["auto", "direct", "cubic"] = "auto"
    visibility: VisibilitySettings | None = Field(
        default=None, description="if given, adds visibility along the sections"
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        for near, far in self.sections:
            if far <= near:
                raise ValueError(f"section [{near}, {far}] must end farther than it starts")
        return self


class ReferenceSettings(SettingsModel):
    """Limits of the reference window, and the scattering ratio there."""

    lowest: Metres = Field(default=3000.0, description="m above the station")
    highest: Metres = Field(default=12_000.0, description="m above the station")
    width: float = Field(default=1000.0, ge=100, le=20_000, description="m")
    scattering_ratio: float = Field(default=1.0, ge=1, le=10)
    relative_error: float = Field(
        default=0.02, ge=0, le=1, description="standard error of the scattering ratio, relative"
    )

    @model_validator(mode="after")
    def _holds_a_window(self) -> Self:
        if self.highest - self.lowest < self.width:
            raise ValueError("highest must be at least width above lowest")
        return self


class ElasticSettings(SettingsModel):
    """The ``elastic`` product: backscatter and extinction of aerosol, from a lidar ratio."""

    channels: list[str] = Field(
        min_length=1,
        description="glued_532o is glued from analog_532o and photon_532o of the files",
    )
    lidar_ratio: Annotated[float, Field(ge=1, le=200)] = Field(default=50.0, description="sr")
    lidar_ratio_standard_error: float = Field(default=10.0, ge=0, le=100, description="sr")
    average: PartOfDay = timedelta(minutes=30)
    background: Literal["known_shape", "tail_mean"] = "known_shape"
    reference: ReferenceSettings = ReferenceSettings()
    molecular_relative_error: float = Field(
        default=0.01, ge=0, le=1, description="standard error of the density of the air, relative"
    )


class MultiAngleSettings(SettingsModel):
    """The ``multiangle`` product: optical depth and extinction from scans over zenith angle."""

    channels: list[str] = Field(min_length=1)
    highest: Metres = Field(default=6000.0, description="m above the station")
    step: float = Field(default=60.0, ge=5, le=1000, description="m, between altitudes")
    method: Literal["auto", "joint", "kano_hamilton", "two_angle", "mld", "mld_prior"] = "auto"
    layers: list[tuple[float, float]] = Field(
        default=[],
        description="m above the station: bottom and top of layers whose optical depth is written",
    )
    largest_gradient: float = Field(
        default=5e-5,
        ge=0,
        le=1e-2,
        description="m-1, largest horizontal gradient of ln(backscatter) included in the error",
    )

    @model_validator(mode="after")
    def _holds_altitudes(self) -> Self:
        if self.highest < 10 * self.step:
            raise ValueError("highest must be at least 10 times step")
        for low, high in self.layers:
            if not 0 <= low <= high - self.step or high > self.highest:
                raise ValueError("layers must be at least one step deep, between 0 and highest")
        return self


class Products(SettingsModel):
    """The requested products of an instrument, with their settings."""

    signal: SignalSettings | None = None
    homogeneous: HomogeneousSettings | None = None
    elastic: ElasticSettings | None = None
    multiangle: MultiAngleSettings | None = None


class NetworkVisibilitySettings(SettingsModel):
    """The ``visibility`` product: extinction and visibility where beams of lidars cross."""

    channel: str = Field(description="channel of all instruments, such as photon_532o, glued_532o")
    average: PartOfDay = Field(
        default=timedelta(minutes=10), description="interval over which signals are averaged"
    )
    block: PartOfDay = Field(
        default=timedelta(hours=6), description="interval of averages that share one mean field"
    )
    method: Literal["network", "cycle", "multiplier", "unbiased", "slope", "klett"] = "network"
    prior: Literal["block", "none"] = "block"
    visibility: VisibilitySettings = VisibilitySettings()
    tolerance: float = Field(
        default=15.0, gt=0, le=1000, description="m, largest distance of beams at a crossing"
    )
    smallest_angle: float = Field(default=2.0, gt=0, lt=90, description="degree between beams")
    farthest: float | None = Field(
        default=None, gt=0, description="m, largest range used; by default the last bin"
    )
    exponent: float = Field(
        default=1.0, ge=0.1, le=10, description="m in backscatter ~ extinction^(1/m)"
    )
    exponents: dict[str, Annotated[float, Field(ge=0.1, le=10)]] = Field(
        default={}, description="exponent of instruments that differ"
    )
    exponent_relative_error: float = Field(default=0.1, ge=0, le=0.5)
    lidar_ratio_relative_error: float = Field(
        default=0.02,
        ge=0,
        le=0.5,
        description="relative error of the lidar ratio of a crossing against the others, from"
        " aerosol mixtures and humidity",
    )
    overlap_relative_error: float = Field(
        default=0.003,
        ge=0,
        le=0.5,
        description="relative error of the overlap at the nearest crossing of a beam",
    )
    background_range: tuple[Metres, Metres] | None = Field(
        default=None, description="m; by default the last tenth of the bins"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.block % self.average:
            raise ValueError("block must be a multiple of average")
        if self.background_range and self.background_range[0] >= self.background_range[1]:
            raise ValueError("background_range must end farther than it starts")
        return self

    def exponent_of(self, instrument: str) -> float:
        """Return the exponent m of the beams of an instrument."""
        return self.exponents.get(instrument, self.exponent)
