"""Settings of a simulation in a campaign file.

They describe what the simulator invents: the air in front of each lidar, and the signal strength,
background light and noise of its detectors. Known properties of an instrument (dead time, zenith
angle, full overlap, trigger delay) come from the `facts` of the campaign that are valid at the
time of a file, so truth and retrieval use the same facts.
"""

from __future__ import annotations

import math
from datetime import datetime, timedelta
from typing import Self

from pydantic import Field, model_validator

from lidarops.campaign.simulated_air import AtmosphereSettings, Instant
from lidarops.campaign.simulated_instrument import (
    Acquisition,
    Damage,
    DamageKind,
    Detector,
    LaserDrift,
    Pointing,
    Pulse,
    RandomDamage,
)
from lidarops.constants import SPEED_OF_LIGHT
from lidarops.settings import SettingsModel, located_error, quantity

_DAMAGE_OF_OUTPUT = {
    "photon": {DamageKind.DEAD_PHOTON},
    "analog": {DamageKind.GLITCH, DamageKind.SATURATION},
}


class InstrumentSimulation(SettingsModel):
    """Simulation of one lidar."""

    atmosphere: AtmosphereSettings | None = Field(
        default=None, description="its own atmosphere; by default that of the simulation"
    )
    scan: Pointing | None = Field(
        default=None, description="sequence of zenith angles; by default the pointing of the facts"
    )
    acquisition: Acquisition = Acquisition()
    detectors: list[Detector] = Field(
        min_length=1, description="one for each wavelength and polarisation"
    )
    damage: tuple[Damage, ...] = Field(default=(), description="files to damage, by their index")
    random_damage: RandomDamage | None = None
    pulse: Pulse | None = Field(
        default=None, description="shape of the laser pulse in time; by default infinitely short"
    )
    laser: LaserDrift = LaserDrift()

    @model_validator(mode="after")
    def _unique(self) -> Self:
        labels = [detector.label for detector in self.detectors]
        if len(set(labels)) < len(labels):
            raise ValueError(f"two detectors share wavelength and polarisation: {labels}")
        indices = [damage.index for damage in self.damage]
        if len(set(indices)) < len(indices):
            raise ValueError("damage lists an index twice: a file can be damaged in one way only")
        return self

    @model_validator(mode="after")
    def _damage_fits_detectors(self) -> Self:
        kinds = {damage.kind for damage in self.damage}
        if self.random_damage is not None:
            kinds |= set(self.random_damage.kinds)
        for output, damaging in _DAMAGE_OF_OUTPUT.items():
            if kinds & damaging and not any(getattr(d, output) for d in self.detectors):
                names = ", ".join(sorted(kinds & damaging))
                raise ValueError(f"damage of kind {names} needs a detector with {output!r}")
        return self

    @model_validator(mode="after")
    def _fits_32_bits(self) -> Self:
        shots = [self.acquisition.shots, *(c.shots or 0 for c in self.acquisition.changes)]
        for recorder in (detector.analog for detector in self.detectors):
            if recorder and max(shots) * 2**recorder.adc_bits > 2**31:
                raise ValueError(
                    f"{max(shots)} shots of {recorder.adc_bits} bits do not fit into"
                    " the 32 bits of a raw file: use fewer shots"
                )
        return self

    @model_validator(mode="after")
    def _pulse_is_short(self) -> Self:
        shortest = min(
            (detector.bins or self.acquisition.bins)
            * (detector.bin_width or self.acquisition.bin_width)
            for detector in self.detectors
        )
        length = 0.0 if self.pulse is None else 0.5 * SPEED_OF_LIGHT * self.pulse.width
        if self.pulse is not None and length > 0.1 * shortest:
            raise ValueError(
                f"pulse.width of {self.pulse.width:g} s is {length:.0f} m of range, more than a"
                f" tenth of the recorded {shortest:g} m: give the width in seconds (8e-9), or more"
                " bins"
            )
        return self


class TruthSettings(SettingsModel):
    """Resolution of the true profiles along the beams."""

    cells: int | None = quantity(
        None,
        unit="1",
        ge=0,
        le=2048,
        description="number of range cells of equal length, with one mean each; by"
        " default cells of 30 m up to 12 km and longer ones beyond",
    )
    profiles: int = quantity(
        512,
        unit="1",
        ge=1,
        le=100_000,
        description="largest number of profiles per instrument, evenly spread in time",
    )


class SimulationSettings(SettingsModel):
    """Settings of a simulated campaign."""

    seed: int = quantity(unit="1", ge=0, lt=2**63, description="of all random numbers")
    start: Instant = Field(description="of the first file")
    duration: float = quantity(
        unit="s", gt=0, le=366 * 86400.0 * 30, description="within which all files end"
    )
    atmosphere: AtmosphereSettings | None = Field(
        default=None, description="shared by the instruments that have none of their own"
    )
    origin: str | None = Field(
        default=None,
        description="station at the origin of the shared atmosphere; by default the first of the"
        " campaign",
    )
    fast: bool = Field(
        default=False,
        description="whether noise is drawn in a fast, approximate way, for large archives",
    )
    truth: TruthSettings = TruthSettings()
    instruments: dict[str, InstrumentSimulation] = Field(
        min_length=1, description="by the keys of instruments of the campaign"
    )

    @model_validator(mode="after")
    def _has_files_and_air(self) -> Self:
        for key, instrument in self.instruments.items():
            files, place = self.files(key), ("instruments", key)
            if not files:
                problem = (
                    f"no file fits into {self.duration:g} s:"
                    " make the campaign longer or the files shorter"
                )
                raise located_error(problem, *place)
            for damage in instrument.damage:
                if damage.index >= files:
                    problem = (
                        f"damage at index {damage.index}, but the files have indices 0 to"
                        f" {files - 1}"
                    )
                    raise located_error(problem, *place, "damage")
            if instrument.atmosphere is None and self.atmosphere is None:
                problem = "has no atmosphere: give it one, or give simulation.atmosphere for all"
                raise located_error(problem, *place)
        return self

    def air_of(self, key: str) -> AtmosphereSettings:
        """Return the atmosphere of an instrument."""
        return self.instruments[key].atmosphere or self.atmosphere or AtmosphereSettings()

    def files(self, key: str) -> int:
        """Return the number of signal files of an instrument; all end within the campaign."""
        acquisition = self.instruments[key].acquisition
        return int((self.duration - acquisition.duration) // acquisition.interval) + 1

    def start_of(self, key: str, index: int) -> datetime:
        """Return when the signal file `index` of an instrument starts."""
        return self.start + timedelta(seconds=index * self.instruments[key].acquisition.interval)

    def start_of_dark(self, key: str, index: int) -> datetime:
        """Return when the dark file `index` starts.

        Dark files follow one another. The first half ends at the start of the campaign; the
        others begin at its end, rounded up to a whole second.
        """
        acquisition = self.instruments[key].acquisition
        before = (acquisition.dark_files + 1) // 2
        offset = (index - before) * acquisition.duration
        if index >= before:
            offset += math.ceil(self.duration)
        return self.start + timedelta(seconds=offset)
