"""Settings of laser, optics and detectors of simulated lidars."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from lidarops.campaign.simulation_base import BinWidth, NotNegative
from lidarops.settings import SettingsModel, quantity


class PhotonCounter(SettingsModel):
    """Photon-counting output of a detector; its dead time is a fact of the campaign."""

    discriminator_level: int = quantity(8, unit="1", ge=1, le=63, description="Licel level")
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
        # Below half a step, rounding does not average out over shots. The simulation covers this
        # down to 0.02 steps, where its Fourier series ends.
        if self.noise < 0.02 * self.step:
            raise ValueError(
                f"noise of {self.noise:g} mV is less than 0.02 digitiser steps"
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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.day < self.night:
            raise ValueError("day must be at least night")
        return self


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
        photons = self.energy * wavelength * 1e-9 / (6.62607015e-34 * 299_792_458.0)
        return photons * self.efficiency * self.area * 299_792_458.0 / 2.0 * 1e-6 / 1e6 * 1e-6


class RamanLines(SettingsModel):
    """Vibrational Raman lines that a detector receives, instead of elastic light."""

    gas: Literal["nitrogen", "water_vapour"] = Field(description="that scatters the light")
    laser: int = quantity(unit="nm", ge=200, le=3000, description="wavelength of the laser")
    surface_mixing_ratio: float = quantity(
        0.01, unit="kg kg-1", gt=0, le=0.05, description="of water vapour at the origin"
    )
    scale_height: float = quantity(
        2000.0, unit="m", ge=100, le=20_000, description="of the mixing ratio"
    )


class Detector(SettingsModel):
    """Detector of one wavelength with an analog recorder, a photon counter or both."""

    wavelength: int = quantity(unit="nm", ge=200, le=3000, description="as in the headers")
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
    bins: int | None = quantity(
        None, unit="1", ge=16, le=16_384, description="by default those of the acquisition"
    )
    bin_width: BinWidth | None = quantity(
        None, unit="m", description="by default that of the acquisition"
    )

    @property
    def label(self) -> str:
        """Wavelength and polarisation as in channel names, such as ``532o``."""
        return f"{self.wavelength}{self.polarisation}"

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
    jitter: float = quantity(
        0.0, unit="1", ge=0, le=0.3, description="relative standard deviation from file to file"
    )
    shot_jitter: float = quantity(
        0.0, unit="1", ge=0, le=0.5, description="relative standard deviation from shot to shot"
    )


class Pulse(SettingsModel):
    """Shape of the laser pulse in time; time zero is its centroid."""

    shape: Literal["rectangle", "gaussian", "exponential"] = Field(
        default="gaussian", description="course of the power"
    )
    width: float = quantity(
        unit="s", gt=0, le=1e-5, description="full width at half maximum; decay time of exponential"
    )
