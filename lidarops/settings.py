"""Base of all settings that a person writes, and the types of their values."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError, PydanticUndefined

NO_UNIT: Final = "1"
"""Unit of a pure number or count."""
_LEAST_RANGE: Final = 10.0
"""m; bins of lidars are 3.75 to 15 m long, and nothing is known within the first."""
_LEAST_BACKGROUND: Final = 60.0
"""m; 16 bins of 3.75 m, whose mean is known within a quarter of the noise of a bin."""
IDENTIFIER: Final = r"^[A-Za-z0-9][A-Za-z0-9-]*$"


def quantity(
    default: Any = PydanticUndefined,
    *,
    unit: str,
    description: str = "",
    **limits: Any,
) -> Any:
    """Return the field of a number, or of numbers, that have a unit.

    Error messages and the JSON schema take the unit from the key ``unit`` of its schema.

    Parameters
    ----------
    default : object, optional
        By default the field is required.
    unit : str
        Such as ``m-1``; `NO_UNIT` for a pure number or count.
    description : str, optional
        Meaning, without the unit.
    **limits
        Bounds and lengths, as of `pydantic.Field`.
    """
    shown = "" if unit == NO_UNIT else f"[{unit}]"
    text = " ".join(part for part in (description, shown) if part)
    return Field(default, description=text or None, json_schema_extra={"unit": unit}, **limits)


def unit_of(model: type, key: str) -> str:
    """Return the unit of a field; empty for pure numbers, texts and keys without a field."""
    fields = TypeAdapter(model).json_schema()["properties"]
    unit = fields.get(key, {}).get("unit", NO_UNIT)
    return "" if unit == NO_UNIT else str(unit)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a question for the nearest known name, with a space behind it, or an empty text.

    Case, hyphens and underscores do not count.
    """
    plain = {_plain(choice): choice for choice in known}
    near = difflib.get_close_matches(_plain(name), plain, n=1)
    return f"did you mean {plain[near[0]]!r}? " if near else ""


def _plain(name: str) -> str:
    return name.lower().replace("-", "_").replace(" ", "_")


def located_error(problem: str, *keys: str | int) -> PydanticCustomError:
    """Return an error for a validator of a model to raise, at keys below the model."""
    return PydanticCustomError("located", "{problem}", {"problem": problem, "keys": keys})


def _written_date(value: Any) -> Any:
    # Pydantic would read a year as seconds since 1970.
    if isinstance(value, int | float) or (isinstance(value, str) and value.isdecimal()):
        raise ValueError("must be a time such as 2024-09-21T12:00:00Z, or a date")
    return value


def _utc(value: datetime) -> datetime:
    return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def _clean_pattern(value: str) -> str:
    if value.startswith(("/", "~")) or ".." in value.split("/"):
        raise ValueError(
            f"{value!r} must be a relative path without '..': put the file into the folder of the"
            " campaign file, or below it"
        )
    return value


def _words(patterns: list[str]) -> list[str]:
    """Return patterns with each choice in braces written out, as a shell does: a{b,c} as ab, ac."""
    words: list[str] = []
    for pattern in patterns:
        # Between [ and ], a brace stands for itself.
        braces = re.search(r"(?<!\[)\{([^{},]*(?:,[^{},]*)+)\}", pattern)
        if braces is None:
            words.append(pattern)
        else:
            begin, end = pattern[: braces.start()], pattern[braces.end() :]
            words += _words([f"{begin}{word}{end}" for word in braces[1].split(",")])
    return list(dict.fromkeys(words))


def as_interval(value: Any) -> Any:
    """Return an interval for a text such as 6h or 30min; leave other values as they are."""
    if isinstance(value, str) and value != "day":
        units = {"s": 1, "min": 60, "h": 3600, "d": 86400}
        units |= {"second": 1, "minute": 60, "hour": 3600, "day": 86400}
        number = value.rstrip("abcdefghijklmnopqrstuvwxyz ")
        unit = value[len(number) :].strip()
        unit = unit if unit in units else unit.removesuffix("s")
        if unit in units:
            try:
                return timedelta(seconds=float(number) * units[unit])
            except OverflowError as error:
                raise ValueError(f"{value!r} is too long an interval") from error
    return value


def _no_kilometres(value: float) -> float:
    if 0 < value < _LEAST_RANGE:
        raise ValueError(
            f"must be 0, or at least {_LEAST_RANGE:g} m, not {value:g} m: is it in km?"
        )
    return value


Instant = Annotated[
    datetime,
    BeforeValidator(_written_date),
    AfterValidator(_utc),
    # Without the format date-time, because a date alone is accepted too.
    WithJsonSchema({"type": "string", "words": "a time such as 2024-09-21T12:00:00Z"}),
]
Interval = Annotated[
    timedelta,
    BeforeValidator(as_interval),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "words": "an interval such as 30min, 6h or 1d"},
                {"type": "number", "unit": "s"},
            ]
        }
    ),
]
Inside = Annotated[str, AfterValidator(_clean_pattern)]
"""Path below the folder of the campaign file, relative to it."""
Patterns = Annotated[
    list[Inside],
    BeforeValidator(
        lambda given: [given] if isinstance(given, str) else given,
        json_schema_input_type=str | list[str],
    ),
    AfterValidator(_words),
]
"""Patterns of paths below the archive, as of a shell; `campaign.path_patterns` reads each."""
Identifier = Annotated[
    str,
    Field(
        pattern=IDENTIFIER,
        max_length=40,
        json_schema_extra={
            "words": "letters, digits and hyphens that begin with a letter or a digit, at most 40"
        },
    ),
]
Metres = Annotated[
    float, Field(ge=0, le=150_000, allow_inf_nan=False), AfterValidator(_no_kilometres)
]
"""Range or height: 0, or at least `_LEAST_RANGE`."""


def _wide_enough(limits: tuple[float, float]) -> tuple[float, float]:
    first, last = limits
    if first >= last:
        raise ValueError("must end farther than it starts")
    if last - first < _LEAST_BACKGROUND:
        raise ValueError(
            f"must span at least {_LEAST_BACKGROUND:g} m, not {last - first:g} m: is it in km?"
        )
    return limits


BackgroundRange = Annotated[tuple[Metres, Metres], AfterValidator(_wide_enough)]
"""Near and far end of the bins that give the background."""


class SettingsModel(BaseModel):
    """Base of the models: frozen, and without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def taken_from(cls, other: BaseModel, **given: Any) -> Self:
        """Return settings with given values, and those of another model for all other fields."""
        names = (cls.model_fields.keys() - given.keys()) & type(other).model_fields.keys()
        return cls(**given, **{name: getattr(other, name) for name in names})


def ordered(low: str, high: str, problem: str, *, may_be_equal: bool = False) -> Any:
    """Return a validator of a model: the value of field `high` exceeds that of `low`."""

    def check(model: SettingsModel) -> SettingsModel:
        first, last = getattr(model, low), getattr(model, high)
        if last < first or (last == first and not may_be_equal):
            raise ValueError(problem)
        return model

    return model_validator(mode="after")(check)


def _divides_day(interval: timedelta) -> timedelta:
    seconds = interval.total_seconds()
    if seconds < 1 or 86400 % seconds:
        raise ValueError("must be at least 1 s and divide a day: 5min, 30min, 2h")
    return interval


PartOfDay = Annotated[Interval, AfterValidator(_divides_day)]


def signal_to_noise_limit() -> Any:
    """Return the field ``least_signal_to_noise`` of a kind of product."""
    return quantity(
        1.0,
        unit=NO_UNIT,
        ge=0,
        le=100,
        description="values smaller than this times their error by noise, dead time and baseline"
        " have the bit low_signal_to_noise, of severity care; 0 for none",
    )


def background_method() -> Any:
    """Return the field ``background`` of a kind of product that knows the shape of its signal."""
    return Field(
        default="known_shape",
        description="known_shape fits background and a signal of clean air to the far range;"
        " tail_mean is the mean of the last tenth of the bins",
    )


def average_interval() -> Any:
    """Return the field ``average`` of a kind of product of vertical profiles."""
    return Field(
        default=timedelta(minutes=30), description="interval over which signals are averaged"
    )


class ChannelProduct(SettingsModel):
    """Base of the settings of a kind of product that is made of one channel."""

    channels: list[str] | Literal["all"] = Field(
        description="names of channels; all means every channel of the files, without glued ones"
    )

    @cached_property
    def named(self) -> list[str]:
        """The channels that are requested by name."""
        return [] if self.channels == "all" else list(self.channels)

    def companions(self, channel: str) -> tuple[str, ...]:  # noqa: ARG002 - most need none
        """Return the other channels that the product of a channel is made of."""
        return ()

    def covers(self, channel: str, *, of_files: bool) -> bool:
        """Return whether a channel is requested; `of_files` says whether the files hold it."""
        return (of_files and self.channels == "all") or channel in self.named


class MonthProduct(ChannelProduct):
    """Base of the settings of a kind of product that is made of other products of a month."""


class NetworkProduct(SettingsModel):
    """Base of the settings of a kind of product that is made of a network of instruments."""

    channel: str = Field(description="channel of all instruments, such as photon_532o, glued_532o")

    def check_members(self, instruments: Sequence[str]) -> None:
        """Raise ValueError where the settings do not fit the instruments of the network."""


class VisibilitySettings(SettingsModel):
    """Definition of visibility: contrast, and conversion of extinction to 550 nm."""

    contrast: Annotated[float, Field(gt=0, lt=1)] | Literal["paper"] = quantity(
        0.05,
        unit="1",
        description="threshold: 0.05 (meteorological optical range), 0.02 (Koschmieder),"
        " or 'paper': exp(-3), the rounded constant of the multi-position"
        " papers",
    )
    law: Literal["none", "angstrom", "kruse"] = Field(
        default="none",
        description="conversion of extinction from the wavelength of the lidar to 550 nm; none"
        " keeps the wavelength of the lidar",
    )
    angstrom_exponent: float | None = quantity(
        None, unit="1", ge=-1, le=5, description="of extinction, for law: angstrom"
    )
    exponent_standard_error: float = quantity(
        0.0, unit="1", ge=0, le=5, description="standard error of the exponent of the law"
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

    @property
    def resolved(self) -> Self:
        """The same definition, with the contrast as a number."""
        return self.model_copy(update={"contrast": self.threshold})


class ReferenceSettings(SettingsModel):
    """Limits of the reference window, and the scattering ratio there."""

    lowest: Metres = quantity(
        3000.0, unit="m", description="least height of the window above the station"
    )
    highest: Metres = quantity(
        12_000.0, unit="m", description="largest height of the window above the station"
    )
    width: float = quantity(1000.0, unit="m", ge=100, le=20_000, description="of the window")
    scattering_ratio: float = quantity(
        1.0,
        unit="1",
        ge=1,
        le=10,
        description="backscatter of all over that of molecules in the window; 1 for clean air",
    )
    relative_error: float = quantity(
        0.02, unit="1", ge=0, le=1, description="standard error of the scattering ratio, relative"
    )

    @model_validator(mode="after")
    def _holds_a_window(self) -> Self:
        if self.highest - self.lowest < self.width:
            raise ValueError("highest must be at least width above lowest")
        return self

    def along(self, stretch: float) -> Self:
        """Return the limits along a beam that is `stretch` m long per m of height."""
        limits = ("lowest", "highest", "width")
        return self.model_copy(update={name: getattr(self, name) * stretch for name in limits})
