"""Simulated lidars: laser, optics, detectors, acquisition, pointing and damage of files.

The simulation works with these settings as they stand in a campaign file.
"""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from lidarops.campaign.simulated_air import Azimuth, Instant, NotNegative, Period
from lidarops.constants import PLANCK, SPEED_OF_LIGHT
from lidarops.records import DetectionMode
from lidarops.settings import SettingsModel, ordered, quantity

if TYPE_CHECKING:
    import numpy as np

DialectName = Literal["licel", "manaus", "saopaulo", "pilar", "golmud", "raymetrics_scan"]

LEAST_NOISE: Final = 0.02
"""Digitiser steps. Below half a step, rounding does not average out over shots; less noise than
this would need more harmonics of it than double precision resolves."""


def _four_characters(value: float) -> float:
    written = f"{value:.2f}"[:4] if value < 100 else f"{value:04.0f}"
    if abs(float(written) - value) > 1e-12 * value:
        raise ValueError(
            f"{value:g} does not fit into the four characters of a raw header, such as 7.5 or 3.75"
        )
    return value


BinWidth = Annotated[float, Field(ge=0.5, le=150), AfterValidator(_four_characters)]
"""m."""


def _bins(default: int | None, description: str) -> Any:
    return quantity(default, unit="1", ge=16, le=16_384, description=description)


def _shots(default: int | None, description: str) -> Any:
    return quantity(default, unit="1", ge=1, le=999_999, description=description)


def _wavelength(description: str) -> Any:
    return quantity(unit="nm", ge=200, le=3000, description=description)


def _spread(most: float, description: str) -> Any:
    return quantity(0.0, unit="1", ge=0, le=most, description=description)


class PhotonCounter(SettingsModel):
    """Photon-counting output of a detector; its dead time is a fact of the campaign."""

    paralyzable: bool = Field(
        default=False, description="whether a lost photon prolongs the dead time"
    )


class AnalogRecorder(SettingsModel):
    """Analog output of a detector."""

    gain: float = quantity(unit="mV MHz-1", gt=0, le=100, description="per rate of photoelectrons")
    excess_noise: float = quantity(
        1.2,
        unit="1",
        ge=1,
        le=10,
        description="mean square of the charge of a photoelectron over the square of its mean",
    )
    noise: float = quantity(
        unit="mV", gt=0, le=1000, description="electronic noise of one sample of one shot"
    )
    dark_offset: NotNegative = quantity(unit="mV", description="without light")
    dark_drift: float = quantity(
        0.0, unit="mV h-1", ge=-100, le=100, description="drift of the dark offset"
    )
    adc_range: float = quantity(
        500.0, unit="mV", ge=1, le=10_000, description="signal at full scale"
    )
    adc_bits: int = quantity(12, unit="1", ge=8, le=16, description="of the digitiser")

    @property
    def step(self) -> float:
        """Least significant bit of the digitiser, mV."""
        return self.adc_range / 2.0**self.adc_bits

    @model_validator(mode="after")
    def _noise_dithers(self) -> Self:
        if self.noise < LEAST_NOISE * self.step:
            raise ValueError(
                f"noise of {self.noise:g} mV is less than {LEAST_NOISE:g} digitiser steps"
                f" of {self.step:g} mV: no recorder has so little noise"
            )
        if self.dark_offset < 6 * self.noise:
            raise ValueError(
                f"dark_offset of {self.dark_offset:g} mV is less than 6 times the noise: the"
                " digitiser would clip noise at zero"
            )
        return self


class Background(SettingsModel):
    """Sky background on a detector."""

    night: NotNegative = quantity(unit="MHz", description="of photoelectrons")
    day: NotNegative = quantity(
        unit="MHz", description="of photoelectrons with the sun at the zenith"
    )

    _ordered = ordered("night", "day", "day must be at least night", may_be_equal=True)


class Optics(SettingsModel):
    """Laser and telescope, which determine the strength of a signal."""

    energy: float = quantity(unit="J", gt=0, le=100, description="of one pulse")
    area: float = quantity(unit="m2", gt=0, le=1000, description="of the telescope")
    efficiency: float = quantity(
        unit="1", gt=0, le=1, description="photoelectrons per photon entering the telescope"
    )

    def signal_rate(self, wavelength: float) -> float:
        r"""Return the rate of photoelectrons from a backscatter of 1e-6 m-1 sr-1 at 1 km, MHz.

        Notes
        -----
        :math:`(E \lambda / h c) \eta A (c / 2) \beta R^{-2}` (`vasylkivskyi2009`, 23).
        """
        photons = self.energy * wavelength * 1e-9 / (PLANCK * SPEED_OF_LIGHT)
        return photons * self.efficiency * self.area * SPEED_OF_LIGHT / 2.0 * 1e-6 / 1e6 * 1e-6


class RamanLines(SettingsModel):
    """Vibrational Raman lines that a detector receives, instead of elastic light."""

    gas: Literal["nitrogen", "water_vapour"] = Field(description="that scatters the light")
    laser: int = _wavelength("wavelength of the laser")
    surface_mixing_ratio: float = quantity(
        0.01, unit="kg kg-1", gt=0, le=0.05, description="of water vapour at the origin"
    )


class Detector(SettingsModel):
    """Detector of one wavelength with an analog recorder, a photon counter or both."""

    wavelength: int = _wavelength("as in the headers")
    polarisation: Literal["o", "p", "s"] = Field(
        default="o", description="as in the headers: o none, p parallel, s perpendicular"
    )
    high_voltage: int = quantity(
        800, unit="V", ge=0, le=9999, description="of the photomultiplier, as in the headers"
    )
    signal_rate: float | None = quantity(
        None,
        unit="MHz",
        gt=0,
        le=1e5,
        allow_inf_nan=False,
        description="of photoelectrons from a backscatter coefficient of 1e-6 m-1 sr-1 at"
        " a range of 1 km, with full overlap and without extinction",
    )
    optics: Optics | None = Field(default=None, description="alternative to signal_rate")
    raman: RamanLines | None = Field(default=None, description="by default, light is elastic")
    background: Background
    photon: PhotonCounter | None = None
    analog: AnalogRecorder | None = None
    bins: int | None = _bins(None, "by default those of the acquisition")
    bin_width: BinWidth | None = quantity(
        None, unit="m", description="by default that of the acquisition"
    )

    @property
    def label(self) -> str:
        """Wavelength and polarisation as in channel names, such as ``532o``."""
        return f"{self.wavelength}{self.polarisation}"

    @property
    def recorders(self) -> dict[str, AnalogRecorder | PhotonCounter]:
        """Its recorders by the names of their channels, in the order of the datasets in a file."""
        outputs = {DetectionMode.ANALOG: self.analog, DetectionMode.PHOTON: self.photon}
        return {f"{mode}_{self.label}": output for mode, output in outputs.items() if output}

    @property
    def strength(self) -> float:
        """Signal rate, MHz: as given, or computed from the optics."""
        if self.optics is not None:
            return self.optics.signal_rate(self.wavelength)
        return self.signal_rate or math.nan

    @property
    def system_constant(self) -> float:
        """K of P = K O(R) beta R^-2 T^2, MHz m3 sr."""
        return self.strength * 1.0e3**2 / 1.0e-6

    @model_validator(mode="after")
    def _has_output(self) -> Self:
        if self.photon is None and self.analog is None:
            raise ValueError("needs 'photon', 'analog' or both: without them it has no output")
        if (self.signal_rate is None) == (self.optics is None):
            raise ValueError("give either signal_rate or optics")
        return self


class LaserDrift(SettingsModel):
    """Changes of the laser energy: drift, and jitter from file to file and shot to shot."""

    per_hour: float = quantity(
        0.0, unit="h-1", ge=-0.5, le=0.5, description="relative change of the energy in an hour"
    )
    jitter: float = _spread(0.3, "relative standard deviation from file to file")
    shot_jitter: float = _spread(0.5, "relative standard deviation from shot to shot")

    def energy(self, hours: float, shots: int, random: np.random.Generator) -> float:
        """Draw the mean pulse energy of a file, relative to the nominal energy.

        Parameters
        ----------
        hours : float, h
            Since the start of the campaign.
        shots : int
            Shots in the file.
        random : numpy.random.Generator

        Notes
        -----
        A stronger shot is stronger in all its bins. The jitter of shots is therefore one factor
        for the file, with the standard deviation of the mean over its shots.
        """
        spread = math.sqrt(self.jitter**2 + self.shot_jitter**2 / max(shots, 1))
        jitter = spread * random.standard_normal() if spread > 0.0 else 0.0
        return max((1.0 + self.per_hour * hours) * (1.0 + jitter), 0.0)


class Pulse(SettingsModel):
    """Shape of the laser pulse in time; time zero is its centroid."""

    shape: Literal["rectangle", "gaussian", "exponential"] = Field(
        default="gaussian", description="course of the power"
    )
    width: float = quantity(
        unit="s", gt=0, le=1e-5, description="full width at half maximum; decay time of exponential"
    )


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
    """Kind of damage of a simulated file, with its correct handling by the processing."""

    handling: Handling

    def __new__(cls, value: str, handling: Handling = Handling.KEEP) -> Self:
        """Return a kind with its handling."""
        kind = str.__new__(cls, value)
        kind._value_ = value
        kind.handling = handling
        return kind

    TRUNCATED = "truncated", Handling.REFUSE
    EMPTY = "empty", Handling.REFUSE
    GARBAGE = "garbage", Handling.REFUSE
    NEGATIVE_BINS = "negative_bins", Handling.REFUSE
    TOO_MANY_BINS = "too_many_bins", Handling.REFUSE
    IMPOSSIBLE_POSITION = "impossible_position", Handling.REFUSE
    FOREIGN = "foreign", Handling.REFUSE
    SURPLUS = "surplus", Handling.REFUSE
    NO_FINAL_NEWLINE = "no_final_newline"
    GLITCH = "glitch", Handling.FLAG
    DEAD_PHOTON = "dead_photon", Handling.FLAG
    LONG_SITE = "long_site"
    BLANK_SITE = "blank_site"
    ZENITH_MINUS_90 = "zenith_minus_90"
    WIDE_LINE = "wide_line"
    DECIMAL_COMMA = "decimal_comma"
    SATURATION = "saturation", Handling.FLAG
    ZERO_SHOTS = "zero_shots", Handling.FLAG
    RENAMED = "renamed"
    ZERO_VOLTAGE = "zero_voltage"
    LARGEST_INTEGER = "largest_integer", Handling.FLAG
    DUPLICATE = "duplicate", Handling.SET_ASIDE
    STOP_BEFORE_START = "stop_before_start"
    STALE_POINTING = "stale_pointing", Handling.REFUSE


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
    bins: int | None = _bins(None, "range bins; by default as before")
    bin_width: BinWidth | None = quantity(
        None, unit="m", description="length of a bin; by default as before"
    )
    shots: int | None = _shots(None, "laser shots in a file; by default as before")


class Acquisition(SettingsModel):
    """How an instrument records its files."""

    interval: float = quantity(300.0, unit="s", ge=1, le=86400, description="from start to start")
    shots: int = _shots(600, "laser shots in a file")
    repetition_rate: float = quantity(
        10.0, unit="Hz", gt=0, le=10_000, description="laser shots per second"
    )
    bins: int = _bins(2000, "range bins of a profile")
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
        if self.interval % 1 or self.repetition_rate % 1:
            raise ValueError(
                "interval (s) and repetition_rate (Hz) must be whole numbers, as in the headers"
            )
        recordings: list[Acquisition] = [self, *(self.at(change.at) for change in self.changes)]
        for recorded in recordings:
            lasts = f"a file of {recorded.shots} shots lasts {recorded.duration:g} s"
            if recorded.duration % 1 and not self.states_no_duration:
                raise ValueError(
                    "shots / repetition_rate must be whole seconds: the headers of raw files hold"
                    f" no fractions, and {lasts}"
                )
            if recorded.duration > self.interval:
                raise ValueError(
                    f"{lasts}, longer than the interval of {self.interval:g} s: use fewer shots or"
                    " a longer interval"
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
