"""Settings of simulated raw files: acquisition, pointing, header dialect and damage."""

from __future__ import annotations

from datetime import datetime, timedelta
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidarops.campaign.simulation_base import (
    Azimuth,
    BinWidth,
    Instant,
    Period,
)
from lidarops.settings import SettingsModel, quantity

DialectName = Literal["licel", "manaus", "saopaulo", "pilar", "golmud", "raymetrics_scan"]


class Handling(StrEnum):
    """Correct handling of a raw file by the processing."""

    KEEP = "keep"
    """Use it: it is odd, but valid."""
    FLAG = "flag"
    """Use it, and flag the affected values."""
    SET_ASIDE = "set_aside"
    """Use one of two files with the same content."""
    REFUSE = "refuse"
    """Refuse it, with the reason."""


class DamageKind(StrEnum):
    """Kind of damage of a simulated file."""

    TRUNCATED = "truncated"
    EMPTY = "empty"
    GARBAGE = "garbage"
    NEGATIVE_BINS = "negative_bins"
    TOO_MANY_BINS = "too_many_bins"
    IMPOSSIBLE_POSITION = "impossible_position"
    FOREIGN = "foreign"
    SURPLUS = "surplus"
    NO_FINAL_NEWLINE = "no_final_newline"
    GLITCH = "glitch"
    DEAD_PHOTON = "dead_photon"
    LONG_SITE = "long_site"
    BLANK_SITE = "blank_site"
    ZENITH_MINUS_90 = "zenith_minus_90"
    WIDE_LINE = "wide_line"
    DECIMAL_COMMA = "decimal_comma"
    SATURATION = "saturation"
    ZERO_SHOTS = "zero_shots"
    RENAMED = "renamed"
    ZERO_VOLTAGE = "zero_voltage"
    LARGEST_INTEGER = "largest_integer"
    DUPLICATE = "duplicate"
    STOP_BEFORE_START = "stop_before_start"
    STALE_POINTING = "stale_pointing"

    @property
    def handling(self) -> Handling:
        """Correct handling of the file by the processing."""
        return _HANDLING.get(self, Handling.KEEP)

    @property
    def refused(self) -> bool:
        """Whether a correct reader must refuse the file."""
        return self.handling is Handling.REFUSE


_HANDLING = {
    **dict.fromkeys(
        (
            DamageKind.TRUNCATED,
            DamageKind.EMPTY,
            DamageKind.GARBAGE,
            DamageKind.NEGATIVE_BINS,
            DamageKind.TOO_MANY_BINS,
            DamageKind.IMPOSSIBLE_POSITION,
            DamageKind.FOREIGN,
            DamageKind.SURPLUS,
            DamageKind.STALE_POINTING,
        ),
        Handling.REFUSE,
    ),
    **dict.fromkeys(
        (
            DamageKind.GLITCH,
            DamageKind.DEAD_PHOTON,
            DamageKind.SATURATION,
            DamageKind.ZERO_SHOTS,
            DamageKind.LARGEST_INTEGER,
        ),
        Handling.FLAG,
    ),
    DamageKind.DUPLICATE: Handling.SET_ASIDE,
}


class Damage(SettingsModel):
    """Damage of one file."""

    kind: DamageKind = Field(description="what is wrong with the file")
    index: int = quantity(
        unit="1", ge=0, description="index of the signal file of the instrument, from 0"
    )


class RandomDamage(SettingsModel):
    """Damage of files that the seed of the simulation selects."""

    fraction: float = quantity(unit="1", gt=0, le=1, description="share of the signal files")
    kinds: list[DamageKind] = Field(
        min_length=1, description="what can be wrong, drawn with equal chances"
    )


class Pointing(SettingsModel):
    """Pointing of the beam: zenith angles of one cycle, one per file, repeated."""

    zenith_angles: list[Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)]] = quantity(
        unit="degree", min_length=1, description="0 = up"
    )
    azimuth: Azimuth = quantity(0.0, unit="degree", description="clockwise from north")
    further_azimuths: list[Azimuth] = quantity(
        [], unit="degree", description="at which the zenith angles are repeated in one cycle"
    )
    two_sided: bool = Field(
        default=False,
        description="whether the scan starts on the other side of the zenith (azimuth + 180) and"
        " crosses it",
    )

    @model_validator(mode="after")
    def _fits_headers(self) -> Self:
        azimuths = [self.azimuth, *self.further_azimuths]
        if any(round(value, 1) != value for value in (*self.zenith_angles, *azimuths)):
            raise ValueError("zenith_angles and azimuths must have one decimal, as in the headers")
        if len(set(azimuths)) < len(azimuths):
            raise ValueError("an azimuth occurs twice in one cycle")
        if self.two_sided and self.further_azimuths:
            raise ValueError("two_sided and further_azimuths are given together; give one of them")
        if len(set(self.zenith_angles)) < len(self.zenith_angles):
            raise ValueError("a zenith angle occurs twice in one cycle")
        return self

    def cycle(self) -> tuple[tuple[float, float], ...]:
        """Return zenith angle and azimuth of every file of one cycle, degree."""
        this_side = [(zenith, self.azimuth) for zenith in self.zenith_angles]
        if not self.two_sided:
            azimuths = (self.azimuth, *self.further_azimuths)
            return tuple((zenith, at) for at in azimuths for zenith in self.zenith_angles)
        opposite = round((self.azimuth + 180.0) % 360.0, 1)
        tilted = sorted((zenith for zenith in self.zenith_angles if zenith % 180.0), reverse=True)
        return (*((zenith, opposite) for zenith in tilted), *sorted(this_side))


class ClockJump(SettingsModel):
    """From a given time on, the clock of the computer has this error."""

    at: Instant = Field(description="true time")
    offset: int = quantity(unit="s", ge=-86400, le=86400, description="clock minus true time")


class Change(SettingsModel):
    """From a given time on, files have other bins or shots."""

    at: Instant = Field(description="when the change happens")
    bins: int | None = quantity(
        None, unit="1", ge=16, le=16_384, description="range bins; by default as before"
    )
    bin_width: BinWidth | None = quantity(
        None, unit="m", description="length of a bin; by default as before"
    )
    shots: int | None = quantity(
        None, unit="1", ge=1, le=999_999, description="laser shots in a file; by default as before"
    )


class Acquisition(SettingsModel):
    """How an instrument records its files."""

    interval: float = quantity(300.0, unit="s", ge=1, le=86400, description="from start to start")
    shots: int = quantity(600, unit="1", ge=1, le=999_999, description="laser shots in a file")
    repetition_rate: float = quantity(
        10.0, unit="Hz", gt=0, le=10_000, description="laser shots per second"
    )
    bins: int = quantity(2000, unit="1", ge=16, le=16_384, description="range bins of a profile")
    bin_width: BinWidth = quantity(7.5, unit="m", description="length of a bin")
    dark_files: int = quantity(
        0,
        unit="1",
        ge=0,
        le=100,
        description="files with a covered telescope: half before the first signal file, half after",
    )
    dialect: DialectName = Field(default="licel", description="header dialect")
    signs_lost: bool = Field(
        default=False, description="whether headers lack the minus signs of the position"
    )
    gaps: tuple[Period, ...] = Field(default=(), description="periods without measurement")
    clock: tuple[ClockJump, ...] = Field(default=(), description="jumps of the clock, in order")
    changes: tuple[Change, ...] = Field(
        default=(), description="changes of bins and shots, in order"
    )

    @property
    def states_no_duration(self) -> bool:
        """Whether headers state the start as the stop."""
        return self.dialect == "raymetrics_scan"

    @property
    def duration(self) -> float:
        """Duration of a file, s; 101 shots at 10 Hz count as 10 s, from first to last shot."""
        rate = self.repetition_rate
        is_counted_whole = self.shots % rate == 1 and not self.states_no_duration
        return (self.shots - 1) / rate if is_counted_whole else self.shots / rate

    @model_validator(mode="after")
    def _fits_headers(self) -> Self:
        if self.interval % 1 or (self.duration % 1 and not self.states_no_duration):
            raise ValueError(
                "interval and shots / repetition_rate must be whole seconds: the headers of raw"
                f" files hold no fractions, and a file lasts {self.duration:g} s"
            )
        if self.repetition_rate % 1:
            raise ValueError("repetition_rate must be a whole number of Hz, as in the headers")
        if self.duration > self.interval:
            raise ValueError(
                f"a file lasts {self.duration:g} s, longer than the interval of"
                f" {self.interval:g} s: use fewer shots or a longer interval"
            )
        return self

    @model_validator(mode="after")
    def _ascends_in_time(self) -> Self:
        for name, times in (
            ("clock", [jump.at for jump in self.clock]),
            ("changes", [change.at for change in self.changes]),
        ):
            if times != sorted(set(times)):
                raise ValueError(f"the times of {name} must ascend")
        if len(self.clock) > 99:
            raise ValueError("clock has more than 99 jumps, more than file names can number")
        return self

    @model_validator(mode="after")
    def _changes_are_possible(self) -> Self:
        for change in self.changes:
            changed = self.at(change.at)
            whole = changed.duration % 1 == 0 or self.states_no_duration
            if not whole or changed.duration > self.interval:
                raise ValueError(
                    f"with the change at {change.at:%Y-%m-%d %H:%M} a file lasts"
                    f" {changed.duration:g} s: it must be a whole number, at most the interval"
                )
        return self

    def at(self, moment: datetime) -> Acquisition:
        """Return the settings that hold for a file that starts at `moment`."""
        changes = {
            name: value
            for change in self.changes
            if change.at <= moment
            for name in ("bins", "bin_width", "shots")
            if (value := getattr(change, name)) is not None
        }
        return self.model_copy(update=changes) if changes else self

    def clock_error(self, moment: datetime) -> tuple[int, timedelta]:
        """Return the number of jumps of the clock up to `moment`, and clock minus true time."""
        past = [jump.offset for jump in self.clock if jump.at <= moment]
        return len(past), timedelta(seconds=past[-1] if past else 0)

    def is_missing(self, start: datetime) -> bool:
        """Return whether a file that would start at `start` falls into a gap."""
        stop = start + timedelta(seconds=self.at(start).duration)
        return any(gap.overlaps(start, stop) for gap in self.gaps)
