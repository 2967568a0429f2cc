"""What a campaign file says of its simulation.

Only what the simulator invents is written here: the scene in front of each lidar and the
strength, light and noise of its detectors. What a person knows of an instrument (dead time,
zenith angle, full overlap, trigger delay) is taken from the `facts` of the campaign that are
valid at the moment of a file, so that truth and retrieval can only differ by a wrong fact.
"""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidarops.campaign.simulated_atmosphere import (
    Aerosol,
    AtmosphereSettings,
    BoundaryLayer,
    Homogeneous,
    Layer,
)
from lidarops.campaign.simulated_files import (
    Acquisition,
    Damage,
    DamageKind,
    Handling,
    Pointing,
    RandomDamage,
)
from lidarops.campaign.simulated_instrument import (
    AnalogRecorder,
    Background,
    Detector,
    LaserDrift,
    Optics,
    PhotonCounter,
    Pulse,
)
from lidarops.campaign.simulation_base import DiurnalCourse, Instant, SimulationModel

__all__ = [
    "Acquisition",
    "Aerosol",
    "AnalogRecorder",
    "AtmosphereSettings",
    "Background",
    "BoundaryLayer",
    "Damage",
    "DamageKind",
    "Detector",
    "DiurnalCourse",
    "Handling",
    "HorizontalPath",
    "LaserDrift",
    "Layer",
    "Lidar",
    "Optics",
    "PhotonCounter",
    "Pointing",
    "Pulse",
    "RandomDamage",
    "SimulatedInstrument",
    "SimulationSettings",
    "TruthSettings",
    "VerticalColumn",
]


_NEEDED = {
    "photon": {DamageKind.DEAD_PHOTON},
    "analog": {DamageKind.GLITCH, DamageKind.SATURATION},
}


class _Instrument(SimulationModel):
    acquisition: Acquisition = Acquisition()
    detectors: list[Detector] = Field(min_length=1)
    damage: tuple[Damage, ...] = ()
    random_damage: RandomDamage | None = None
    pulse: Pulse | None = None
    laser: LaserDrift = LaserDrift()

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
    def _can_be_damaged(self) -> Self:
        kinds = {damage.kind for damage in self.damage}
        if self.random_damage is not None:
            kinds |= set(self.random_damage.kinds)
        for output, needing in _NEEDED.items():
            if kinds & needing and not any(getattr(d, output) for d in self.detectors):
                names = ", ".join(sorted(kinds & needing))
                raise ValueError(f"damage of kind {names} needs a detector with {output!r}")
        return self

    @model_validator(mode="after")
    def _fits_32_bits(self) -> Self:
        shots = [self.acquisition.shots, *(c.shots or 0 for c in self.acquisition.changes)]
        for recorder in (detector.analog for detector in self.detectors):
            if recorder and max(shots) * 2**recorder.adc_bits > 2**31:
                raise ValueError(
                    f"{max(shots)} shots of {recorder.adc_bits} bits do not fit into"
                    " the 32 bits of a raw file: take fewer shots"
                )
        return self

    @model_validator(mode="after")
    def _pulse_is_short(self) -> Self:
        # c / 2 times the length of the pulse, against what the recorder sees.
        shortest = min(
            (detector.bins or self.acquisition.bins)
            * (detector.bin_width or self.acquisition.bin_width)
            for detector in self.detectors
        )
        if self.pulse is not None and 149_896_229.0 * self.pulse.width > 0.1 * shortest:
            raise ValueError(
                f"pulse.width of {self.pulse.width:g} s is {149_896_229.0 * self.pulse.width:.0f} m"
                f" of range, more than a tenth of the {shortest:g} m that are recorded: give"
                " seconds (8e-9), or more bins"
            )
        return self

    @property
    def air(self) -> AtmosphereSettings | None:
        """What it looks at; None for what all look at."""
        return None

    @property
    def pointing(self) -> Pointing | None:
        """Where it looks; None where the facts of the campaign say it."""
        return None


class HorizontalPath(_Instrument):
    """A lidar that looks along a homogeneous path."""

    kind: Literal["horizontal"]
    aerosol: Aerosol = Aerosol()
    aerosol_extinction: DiurnalCourse = Field(description="m-1 at 532 nm")

    @property
    def air(self) -> AtmosphereSettings:
        """The homogeneous path."""
        path = Homogeneous(
            aerosol=self.aerosol, extinction=self.aerosol_extinction, molecules_constant=True
        )
        return AtmosphereSettings(homogeneous=path)

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


class VerticalColumn(_Instrument):
    """A lidar that looks through a layered atmosphere."""

    kind: Literal["vertical"]
    boundary_layer: BoundaryLayer = BoundaryLayer()
    layers: tuple[Layer, ...] = ()

    @property
    def air(self) -> AtmosphereSettings:
        """The layers."""
        return AtmosphereSettings(boundary_layer=self.boundary_layer, layers=self.layers)


class Lidar(_Instrument):
    """A lidar that looks anywhere, into air of its own or the air that all share."""

    kind: Literal["lidar"]
    atmosphere: AtmosphereSettings | None = Field(
        default=None, description="of its own; that of the simulation where not given"
    )
    scan: Pointing | None = Field(
        default=None, description="zenith angles in turn; as the facts say where not given"
    )

    @property
    def air(self) -> AtmosphereSettings | None:
        """What it looks at; None for what all look at."""
        return self.atmosphere

    @property
    def pointing(self) -> Pointing | None:
        """Where it looks; None where the facts of the campaign say it."""
        return self.scan


SimulatedInstrument = Annotated[
    HorizontalPath | VerticalColumn | Lidar, Field(discriminator="kind")
]


class TruthSettings(SimulationModel):
    """How much is told of the air on the beams."""

    cells: int | None = Field(
        default=None,
        ge=0,
        le=2048,
        description="of range, equally long, in each of which the truth is a mean; where not given"
        " 30 m long up to 12 km, and longer beyond",
    )
    profiles: int = Field(
        default=512, ge=1, le=100_000, description="at most, of each instrument, evenly spread"
    )


class SimulationSettings(SimulationModel):
    """Settings of a simulated campaign."""

    seed: int = Field(ge=0, lt=2**63)
    start: Instant
    duration: float = Field(gt=0, le=366 * 86400.0 * 30, description="s")
    atmosphere: AtmosphereSettings | None = Field(
        default=None, description="that instruments of kind 'lidar' share"
    )
    origin: str | None = Field(
        default=None,
        description="station from which the shared air is described; the first of the campaign",
    )
    fast: bool = Field(
        default=False, description="whether noise is drawn in a fast way, for tests of big archives"
    )
    truth: TruthSettings = TruthSettings()
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

    @model_validator(mode="after")
    def _air_exists(self) -> Self:
        for key in self.instruments:
            if self.instruments[key].air is None and self.atmosphere is None:
                raise ValueError(
                    f"instruments.{key}: has no atmosphere: give one to it, or"
                    " simulation.atmosphere to all"
                )
        return self

    def air_of(self, key: str) -> AtmosphereSettings:
        """Return what an instrument looks at."""
        return self.instruments[key].air or self.atmosphere or AtmosphereSettings()

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
