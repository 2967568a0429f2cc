"""What a campaign file says of its simulation.

Only what the simulator invents is written here: the scene in front of each lidar and the
strength, light and noise of its detectors. What a person knows of an instrument (dead time,
zenith angle, full overlap, trigger delay) is taken from the `facts` of the campaign that are
valid at the moment of a file, so that truth and retrieval can only differ by a wrong fact.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def _utc(value: datetime) -> datetime:
    return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def _whole_seconds(value: datetime) -> datetime:
    if value.microsecond:
        raise ValueError("must be a whole second: the headers of raw files hold no fractions")
    return value


Instant = Annotated[datetime, AfterValidator(_utc), AfterValidator(_whole_seconds)]
NotNegative = Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)]
Hour = Annotated[float, Field(ge=0, lt=24, allow_inf_nan=False)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class DamageKind(StrEnum):
    """What is wrong with a simulated file."""

    TRUNCATED = "truncated"
    EMPTY = "empty"
    GARBAGE = "garbage"
    NEGATIVE_BINS = "negative_bins"
    IMPOSSIBLE_POSITION = "impossible_position"
    FOREIGN = "foreign"
    NO_FINAL_NEWLINE = "no_final_newline"

    @property
    def refused(self) -> bool:
        """Whether a correct reader must refuse the file; the others are harmless oddities."""
        return self is not DamageKind.NO_FINAL_NEWLINE


class Damage(_Model):
    """One file to be damaged."""

    kind: DamageKind
    index: int = Field(ge=0, description="which signal file of the instrument, from 0")


class Acquisition(_Model):
    """How an instrument takes its files."""

    interval: float = Field(default=300.0, ge=1, le=86400, description="s from start to start")
    shots: int = Field(default=600, ge=1, le=999_999, description="laser shots in a file")
    repetition_rate: float = Field(default=10.0, gt=0, le=10_000, description="Hz")
    bins: int = Field(default=2000, ge=16, le=16_384)
    bin_width: float = Field(default=7.5, ge=0.5, le=150, description="m")
    dark_files: int = Field(
        default=0,
        ge=0,
        le=100,
        description="with the telescope covered: one half before the first file, one half after",
    )

    @property
    def duration(self) -> float:
        """Duration of a file, s."""
        return self.shots / self.repetition_rate

    @model_validator(mode="after")
    def _headers_can_say_it(self) -> Self:
        if self.interval % 1 or self.duration % 1:
            raise ValueError(
                "interval and shots / repetition_rate must be whole seconds: the headers of raw"
                f" files hold no fractions, and a file here lasts {self.duration:g} s"
            )
        if self.repetition_rate % 1:
            raise ValueError("repetition_rate must be a whole number of Hz, as in the headers")
        if self.duration > self.interval:
            raise ValueError(
                f"a file lasts {self.duration:g} s, longer than the interval of"
                f" {self.interval:g} s: take fewer shots or a longer interval"
            )
        return self


class PhotonCounter(_Model):
    """The photon-counting output of a detector. Its dead time is a fact of the campaign."""

    discriminator_level: int = Field(default=8, ge=1, le=63, description="Licel level")


class AnalogRecorder(_Model):
    """The analog output of a detector."""

    gain: float = Field(gt=0, le=100, description="mV per MHz of photoelectrons")
    excess_noise: float = Field(
        default=1.2,
        ge=1,
        le=10,
        description="variance of the charge over that of equal pulses: 1 + relative variance",
    )
    noise: float = Field(
        gt=0, le=1000, description="electronic noise of one sample of one shot, mV"
    )
    dark_offset: NotNegative = Field(description="mV, without any light")
    adc_range: float = Field(default=500.0, gt=0, le=10_000, description="mV at full scale")
    adc_bits: int = Field(default=12, ge=8, le=16)

    @property
    def step(self) -> float:
        """Least significant bit of the digitiser, mV."""
        return self.adc_range / 2.0**self.adc_bits

    @model_validator(mode="after")
    def _noise_dithers(self) -> Self:
        # The sum over shots is drawn from its mean and variance. Rounding leaves the mean of
        # one shot alone only when noise spreads it over neighbouring steps; at half a step the
        # mean is off by at most exp(-2 pi^2 / 4) / pi = 0.0023 steps.
        if self.noise < 0.5 * self.step:
            raise ValueError(
                f"noise of {self.noise:g} mV is less than half a digitiser step"
                f" ({self.step:g} mV): quantisation would not average out over shots"
            )
        if self.dark_offset < 6 * self.noise:
            raise ValueError(
                f"dark_offset of {self.dark_offset:g} mV is less than 6 times the noise: the"
                " digitiser would clip noise at zero"
            )
        return self


class Background(_Model):
    """Sky light on a detector."""

    night: NotNegative = Field(description="MHz of photoelectrons")
    day: NotNegative = Field(description="MHz of photoelectrons with the sun at the zenith")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.day < self.night:
            raise ValueError("day must not be darker than night")
        return self


class Detector(_Model):
    """One detector: one wavelength, read by an analog recorder, a photon counter or both."""

    wavelength: int = Field(ge=200, le=3000, description="nm, as in the headers")
    polarisation: Literal["o", "p", "s"] = "o"
    high_voltage: int = Field(default=800, ge=0, le=9999, description="V")
    signal_rate: float = Field(
        gt=0,
        le=1e5,
        description="MHz of photoelectrons from a backscatter coefficient of 1e-6 m-1 sr-1 at a"
        " range of 1 km, with full overlap and without extinction",
    )
    background: Background
    photon: PhotonCounter | None = None
    analog: AnalogRecorder | None = None

    @property
    def label(self) -> str:
        """Wavelength and polarisation as in channel names, such as ``532o``."""
        return f"{self.wavelength}{self.polarisation}"

    @property
    def system_constant(self) -> float:
        """K of P = K O(R) beta R^-2 T^2, in MHz m3 sr."""
        return self.signal_rate * 1.0e3**2 / 1.0e-6

    @model_validator(mode="after")
    def _is_read(self) -> Self:
        if self.photon is None and self.analog is None:
            raise ValueError("needs 'photon', 'analog' or both, else nobody reads it")
        return self


class DiurnalCourse(_Model):
    """A quantity that follows the hour of the day (UTC) as a cosine."""

    minimum: NotNegative
    maximum: NotNegative
    hour_of_maximum: Hour = 5.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.maximum < self.minimum:
            raise ValueError("maximum must not be less than minimum")
        return self


class Aerosol(_Model):
    """Optical properties that aerosol keeps."""

    lidar_ratio: float = Field(default=50.0, ge=5, le=150, description="sr")
    angstrom_exponent: float = Field(default=1.3, ge=-1, le=4, description="of extinction")


class _Instrument(_Model):
    acquisition: Acquisition = Acquisition()
    detectors: list[Detector] = Field(min_length=1)
    damage: list[Damage] = []

    @model_validator(mode="after")
    def _told_apart(self) -> Self:
        labels = [detector.label for detector in self.detectors]
        if len(set(labels)) < len(labels):
            raise ValueError(f"two detectors share wavelength and polarisation: {labels}")
        indices = [damage.index for damage in self.damage]
        if len(set(indices)) < len(indices):
            raise ValueError("a file can be damaged in one way only: give each index once")
        return self

    @model_validator(mode="after")
    def _fits_32_bits(self) -> Self:
        for recorder in (detector.analog for detector in self.detectors):
            if recorder and self.acquisition.shots * 2**recorder.adc_bits > 2**31:
                raise ValueError(
                    f"{self.acquisition.shots} shots of {recorder.adc_bits} bits do not fit into"
                    " the 32 bits of a raw file: take fewer shots"
                )
        return self


class HorizontalPath(_Instrument):
    """A lidar that looks along a homogeneous path."""

    kind: Literal["horizontal"]
    aerosol: Aerosol = Aerosol()
    aerosol_extinction: DiurnalCourse = Field(description="m-1 at 532 nm")

    @model_validator(mode="after")
    def _is_air(self) -> Self:
        if self.aerosol_extinction.maximum > 1.0:
            raise ValueError("aerosol_extinction is in m-1: 1e-4 is 0.1 per km")
        return self

    @model_validator(mode="after")
    def _one_extinction(self) -> Self:
        wavelengths = {detector.wavelength for detector in self.detectors}
        if len(wavelengths) > 1:
            raise ValueError(
                f"detectors at {sorted(wavelengths)} nm: a homogeneous path has one extinction a"
                " file, so its detectors need one wavelength; give other wavelengths their own"
                " instrument"
            )
        return self


class BoundaryLayer(_Model):
    """Aerosol that is well mixed from the ground to a top that follows the sun."""

    aerosol: Aerosol = Aerosol()
    extinction: NotNegative = Field(default=1.0e-4, le=0.1, description="m-1 at 532 nm")
    height: DiurnalCourse = DiurnalCourse(minimum=500.0, maximum=1600.0, hour_of_maximum=14.0)
    """m above the ground"""
    entrainment_depth: float = Field(default=100.0, gt=0, le=2000, description="m")


class Layer(_Model):
    """An elevated layer of Gaussian shape, present for part of the time."""

    name: str
    aerosol: Aerosol = Aerosol()
    extinction: float = Field(gt=0, le=1.0, description="m-1 at 532 nm at the centre")
    height: float = Field(gt=0, le=30_000, description="m above the ground, of the centre")
    depth: float = Field(gt=0, le=10_000, description="m, standard deviation of the Gaussian")
    start: Instant
    stop: Instant

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.stop <= self.start:
            raise ValueError("stop must be later than start")
        return self


class VerticalColumn(_Instrument):
    """A lidar that looks through a layered atmosphere."""

    kind: Literal["vertical"]
    boundary_layer: BoundaryLayer = BoundaryLayer()
    layers: list[Layer] = []


SimulatedInstrument = Annotated[HorizontalPath | VerticalColumn, Field(discriminator="kind")]


class SimulationSettings(_Model):
    """Settings of a simulated campaign."""

    seed: int = Field(ge=0, lt=2**63)
    start: Instant
    duration: float = Field(gt=0, le=366 * 86400.0, description="s")
    instruments: dict[str, SimulatedInstrument] = Field(min_length=1)

    @model_validator(mode="after")
    def _damage_exists(self) -> Self:
        for key, instrument in self.instruments.items():
            files = self.files(key)
            if not files:
                raise ValueError(
                    f"instruments.{key}: no file fits into {self.duration:g} s:"
                    " make the campaign longer or the files shorter"
                )
            for damage in instrument.damage:
                if damage.index >= files:
                    raise ValueError(
                        f"instruments.{key}: damage at index {damage.index}, but the files are"
                        f" 0 to {files - 1}"
                    )
        return self

    def files(self, key: str) -> int:
        """Return the number of signal files of an instrument: those that end in time."""
        acquisition = self.instruments[key].acquisition
        return int((self.duration - acquisition.duration) // acquisition.interval) + 1

    def start_of(self, key: str, index: int) -> datetime:
        """Return when the signal file `index` of an instrument starts."""
        return self.start + timedelta(seconds=index * self.instruments[key].acquisition.interval)

    def start_of_dark(self, key: str, index: int) -> datetime:
        """Return when the dark file `index` starts.

        One after another, the first half up to the start of the campaign, the others from its
        end (rounded up to a whole second).
        """
        acquisition = self.instruments[key].acquisition
        before = (acquisition.dark_files + 1) // 2
        offset = (index - before) * acquisition.duration
        if index >= before:
            offset += math.ceil(self.duration)
        return self.start + timedelta(seconds=offset)
