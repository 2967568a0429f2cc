"""Product kind ``multiangle``: optical depth and extinction from scans over zenith angle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, Self

from pydantic import Field, model_validator

from lidarops.constants import LEAST_SPREAD
from lidarops.kinds import CommonQuantity, Kind
from lidarops.settings import (
    ChannelProduct,
    Metres,
    SettingsModel,
    background_method,
    located_error,
    quantity,
    signal_to_noise_limit,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders

Method = Literal["auto", "joint", "kano_hamilton", "two_angle", "mld", "mld_prior"]


class ScanSettings(SettingsModel):
    """What the retrieval assumes, as the campaign states it."""

    highest: Metres = quantity(6000.0, unit="m", description="highest altitude above the station")
    step: float = quantity(60.0, unit="m", ge=5, le=1000, description="distance of altitudes")
    method: Method = Field(
        default="auto",
        description="two_angle uses the shortest and the longest path; kano_hamilton a regression"
        " at each altitude; joint then one smooth profile through all altitudes; mld a regularised"
        " derivative along the path; mld_prior the same on the difference from the altitude below."
        " auto is two_angle for two beams, joint for more",
    )
    regularisation: float | None = quantity(
        None,
        unit="1",
        ge=0,
        le=1e6,
        description="strength of the penalty of mld and mld_prior; by default the largest with"
        " residuals not larger than the noise, at each altitude",
    )
    layers: list[tuple[float, float]] = quantity(
        [],
        unit="m",
        description="above the station: bottom and top of layers whose optical depth is written",
    )
    largest_gradient: float = quantity(
        5e-5,
        unit="m-1",
        ge=0,
        le=1e-2,
        description="largest horizontal gradient of ln(backscatter) included in the error",
    )

    least_signal_to_noise: float = signal_to_noise_limit()

    @model_validator(mode="after")
    def _holds_altitudes(self) -> Self:
        if self.highest < 10 * self.step:
            raise ValueError("highest must be at least 10 times step")
        if self.regularisation is not None and not self.method.startswith("mld"):
            raise located_error("is used by the methods mld and mld_prior only", "regularisation")
        for low, high in self.layers:
            if not 0 <= low <= high - self.step or high > self.highest:
                raise ValueError("layers must be at least one step deep, between 0 and highest")
        return self


class MultiAngleSettings(ChannelProduct, ScanSettings):
    """The ``multiangle`` product: optical depth and extinction from scans over zenith angle."""

    channels: list[str] = Field(min_length=1, description="names of channels, such as photon_532o")
    background: Literal["known_shape", "tail_mean"] = background_method()


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where the beam does not scan."""
    channels = ", ".join(headers.scanned_channels)
    if not channels or headers.zenith_span < LEAST_SPREAD:
        return ()
    return (
        "multiangle:",
        "  # all elastic channels, which test each other; leave out what has no usable detector",
        f"  channels: [{channels}]",
        "  highest: 3000  # ? m above the station, where signals end",
    )


KIND: Final = Kind(
    name="multiangle",
    title="Optical depth and extinction of scans",
    package=__name__,
    settings=MultiAngleSettings,
    rank=30,
    common=CommonQuantity(
        "vertical_optical_depth",
        "altitude",
        errors_of_channel=(
            "vertical_optical_depth_dead_time_error",
            "vertical_optical_depth_baseline_error",
        ),
        errors_of_air=("vertical_optical_depth_gradient_error",),
        parts_of_air=("vertical_optical_depth_error_air",),
    ),
    draft=_section,
)
