"""Settings of the product ``elastic`` in a campaign file."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lidarops.settings import (
    ChannelProduct,
    Metres,
    PartOfDay,
    SettingsModel,
    quantity,
    signal_to_noise_limit,
)


class ReferenceSettings(SettingsModel):
    """Limits of the reference window, and the scattering ratio there."""

    lowest: Metres = quantity(3000.0, unit="m", description="above the station")
    highest: Metres = quantity(12_000.0, unit="m", description="above the station")
    width: float = quantity(1000.0, unit="m", ge=100, le=20_000)
    scattering_ratio: float = quantity(1.0, unit="1", ge=1, le=10)
    relative_error: float = quantity(
        0.02, unit="1", ge=0, le=1, description="standard error of the scattering ratio, relative"
    )

    @model_validator(mode="after")
    def _holds_a_window(self) -> Self:
        if self.highest - self.lowest < self.width:
            raise ValueError("highest must be at least width above lowest")
        return self


class ElasticSettings(ChannelProduct):
    """The ``elastic`` product: backscatter and extinction of aerosol, from a lidar ratio."""

    channels: list[str] = Field(
        min_length=1,
        description="glued_532o is glued from analog_532o and photon_532o of the files",
    )
    lidar_ratio: Annotated[float, Field(ge=1, le=200)] = quantity(50.0, unit="sr")
    lidar_ratio_standard_error: float = quantity(10.0, unit="sr", ge=0, le=100)
    average: PartOfDay = timedelta(minutes=30)
    background: Literal["known_shape", "tail_mean"] = "known_shape"
    reference: ReferenceSettings = ReferenceSettings()
    molecular_relative_error: float = quantity(
        0.01, unit="1", ge=0, le=1, description="standard error of the density of the air, relative"
    )
    least_signal_to_noise: float = signal_to_noise_limit()
