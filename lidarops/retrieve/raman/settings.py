"""What a Raman retrieval assumes, as the campaign states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from lidarops.settings import Metres, ReferenceSettings, background_method, quantity


class RamanReference(ReferenceSettings):
    """Limits of the reference window of Raman signals, which are weak: higher up and wider."""

    lowest: Metres = quantity(
        6000.0, unit="m", description="least height of the window above the station"
    )
    width: float = quantity(2000.0, unit="m", ge=100, le=20_000, description="of the window")


_REFERENCE: Final = RamanReference()


@dataclass(frozen=True, kw_only=True)
class RamanSettings:
    """What is assumed, with standard errors; heights are above the station."""

    cell: Annotated[
        float, quantity(unit="m", ge=3, le=1000, description="length of the bins of values")
    ] = 60.0
    highest: Annotated[Metres, quantity(unit="m", description="greatest height of values")] = (
        15_000.0
    )
    background: Annotated[Literal["known_shape", "tail_mean"], background_method()] = "known_shape"
    reference: RamanReference = _REFERENCE
    angstrom_exponent: Annotated[
        float,
        quantity(
            unit="1",
            ge=-1,
            le=4,
            description="of particle extinction, elastic to Raman wavelength",
        ),
    ] = 1.2
    angstrom_standard_error: Annotated[
        float, quantity(unit="1", ge=0, le=3, description="of angstrom_exponent")
    ] = 0.5
    molecular_relative_error: Annotated[
        float,
        quantity(
            unit="1",
            ge=0,
            le=1,
            description="standard error of the density of the air, relative; does not count where"
            " the campaign gives atmosphere: that of its source and age does",
        ),
    ] = 0.01
    molecular_slope_error: Annotated[
        float | None,
        quantity(
            unit="m-1",
            ge=0,
            le=1e-3,
            description="standard error of the derivative of the logarithm of the density of the"
            " air over height; by default 1.6e-5 of the standard atmosphere, 2e-6 of a"
            " molecular_profile, that of source and age of atmosphere",
        ),
    ] = None
    overlap_relative_error: Annotated[
        float, quantity(unit="1", ge=0, le=1, description="standard error of 1 - overlap, relative")
    ] = 0.1
    full_overlap_error: Annotated[
        float,
        quantity(
            unit="1",
            ge=0,
            le=1,
            description="standard error of the overlap where it is stated to be full, without an"
            " overlap_profile",
        ),
    ] = 0.02
    filter_width: Annotated[
        float | None,
        quantity(
            unit="m",
            gt=1e-11,
            lt=1e-7,
            description="full width at half maximum of the filters of nitrogen; by default, all"
            " lines pass at all temperatures",
        ),
    ] = None

    @property
    def known_shape(self) -> bool:
        """Whether the background is fitted with the shape of clean air."""
        return self.background == "known_shape"
