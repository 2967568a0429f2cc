"""Product kind ``elastic``: backscatter and extinction of aerosol, from a lidar ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final, Literal

from pydantic import Field

from lidarops.kinds import Kind
from lidarops.settings import (
    ChannelProduct,
    PartOfDay,
    ReferenceSettings,
    SettingsModel,
    average_interval,
    background_method,
    quantity,
    signal_to_noise_limit,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders


class ElasticAssumptions(SettingsModel):
    """What the inversion assumes, as the campaign states it."""

    lidar_ratio: Annotated[float, Field(ge=1, le=200)] = quantity(
        50.0, unit="sr", description="of particles, extinction over backscatter, at all heights"
    )
    lidar_ratio_standard_error: float = quantity(
        10.0, unit="sr", ge=0, le=100, description="of lidar_ratio"
    )
    molecular_relative_error: float = quantity(
        0.01,
        unit="1",
        ge=0,
        le=1,
        description="standard error of the density of the air, relative; does not count where the"
        " campaign gives atmosphere: that of its source and age does",
    )
    least_signal_to_noise: float = signal_to_noise_limit()


class ElasticSettings(ChannelProduct, ElasticAssumptions):
    """The ``elastic`` product: backscatter and extinction of aerosol, from a lidar ratio."""

    channels: list[str] = Field(
        min_length=1,
        description="glued_532o is glued from analog_532o and photon_532o of the files",
    )
    average: PartOfDay = average_interval()
    background: Literal["known_shape", "tail_mean"] = background_method()
    reference: ReferenceSettings = ReferenceSettings()


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where no fixed beam reaches clean air."""
    candidates = [name for names in headers.candidates for name in names]
    if not candidates or not headers.reaches_clean_air:
        return ()
    look = headers.look
    left_out = [
        f"# {name}: no usable value in {look.files} files ({look.reasons[name]})"
        for name in (candidates if look else ())
        if look and name in look.reasons
    ]
    channels = ", ".join(headers.joined_channels)
    if not channels:
        return ("# elastic: with a lidar ratio, of", *left_out)
    return (
        "elastic:",
        *(f"  {line}" for line in left_out),
        f"  channels: [{channels}]",
        "  lidar_ratio: 50  # ? sr, of the particles: about 25 (sea salt) to 75 (smoke)",
        "  lidar_ratio_standard_error: 15  # ? sr",
        "  average: 30min",
    )


KIND: Final = Kind(
    name="elastic",
    title="Backscatter of elastic profiles",
    package=__name__,
    settings=ElasticSettings,
    rank=40,
    draft=_section,
)
