"""Product kind ``raman``: extinction, backscatter and lidar ratio, from Raman signals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, Self

from pydantic import Field, model_validator

from lidarops.constants import FIXED, STEEPEST
from lidarops.kinds import Kind
from lidarops.settings import (
    ChannelProduct,
    Metres,
    PartOfDay,
    ReferenceSettings,
    average_interval,
    background_method,
    located_error,
    quantity,
    signal_to_noise_limit,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders


class RamanReferenceSettings(ReferenceSettings):
    """Limits of the reference window of Raman signals, which are weak: higher up and wider."""

    lowest: Metres = quantity(
        6000.0, unit="m", description="least height of the window above the station"
    )
    width: float = quantity(2000.0, unit="m", ge=100, le=20_000, description="of the window")


class RamanProductSettings(ChannelProduct):
    """The ``raman`` product: extinction, backscatter and lidar ratio without an assumed one."""

    channels: list[str] = Field(
        min_length=1, description="elastic channels, each with its Raman channel under nitrogen"
    )
    nitrogen: dict[str, str] = Field(
        description="elastic channel -> channel of the vibrational Raman lines of nitrogen, such as"
        " photon_355o: photon_387o"
    )
    water_vapour: dict[str, str] = Field(
        default={},
        description="elastic channel -> channel of the Raman lines of water vapour, whose facts"
        " give water_vapour_calibration",
    )
    average: PartOfDay = average_interval()
    cell: float = quantity(
        60.0, unit="m", ge=3, le=1000, description="length of the bins of values"
    )
    highest: Metres = quantity(15_000.0, unit="m", description="farthest range")
    background: Literal["known_shape", "tail_mean"] = background_method()
    reference: RamanReferenceSettings = RamanReferenceSettings()
    angstrom_exponent: float = quantity(
        1.2,
        unit="1",
        ge=-1,
        le=4,
        description="of particle extinction, elastic to Raman wavelength",
    )
    angstrom_standard_error: float = quantity(
        0.5, unit="1", ge=0, le=3, description="of angstrom_exponent"
    )
    molecular_relative_error: float = quantity(
        0.01, unit="1", ge=0, le=1, description="standard error of the density of the air, relative"
    )
    molecular_slope_error: float | None = quantity(
        None,
        unit="m-1",
        ge=0,
        le=1e-3,
        description="standard error of the derivative of the logarithm of the density of the air"
        " over height; by default 1.6e-5 of the standard atmosphere, 2e-6 of a molecular_profile",
    )
    overlap_relative_error: float = quantity(
        0.1, unit="1", ge=0, le=1, description="standard error of 1 - overlap, relative"
    )
    filter_width: float | None = quantity(
        None,
        unit="m",
        gt=1e-11,
        lt=1e-7,
        description="full width at half maximum of the filters of nitrogen; by default, all lines"
        " pass at all temperatures",
    )
    least_signal_to_noise: float = signal_to_noise_limit()

    @model_validator(mode="after")
    def _has_raman_channels(self) -> Self:
        for name in self.channels:
            if name not in self.nitrogen:
                raise located_error(f"names no Raman channel of {name}", "nitrogen")
        return self

    @model_validator(mode="after")
    def _reaches_a_reference_window(self) -> Self:
        least = self.reference.lowest + self.reference.width
        if self.highest < least:
            raise located_error(
                f"{self.highest:g} m is below the end of the lowest reference window,"
                f" {least:g} m: give {least:g} m or more, or a smaller reference.lowest",
                "highest",
            )
        return self

    def companions(self, channel: str) -> tuple[str, ...]:
        """Return the Raman channels of an elastic channel."""
        pairs = (self.nitrogen, self.water_vapour)
        return tuple(pair[channel] for pair in pairs if channel in pair)


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty without a nitrogen channel or a steep beam."""
    pairs = headers.nitrogen_channels
    if not pairs or headers.zenith_span > FIXED or headers.zenith_angle > STEEPEST:
        return ()
    return (
        "# ? Needs dark nights: use it if these were measured at night.",
        "# raman:",
        f"#   channels: [{', '.join(pairs)}]",
        f"#   nitrogen: {{{', '.join(f'{elastic}: {raman}' for elastic, raman in pairs.items())}}}",
    )


KIND: Final = Kind(
    name="raman",
    title="Extinction and lidar ratio of Raman signals",
    package=__name__,
    settings=RamanProductSettings,
    rank=45,
    expects_usable=False,
    draft=_section,
)
