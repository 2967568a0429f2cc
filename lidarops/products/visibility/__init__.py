"""Product kind ``visibility``: extinction and visibility where beams of lidars cross."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from lidarops.kinds import Kind
from lidarops.settings import (
    BackgroundRange,
    NetworkProduct,
    PartOfDay,
    VisibilitySettings,
    located_error,
    nearest,
    quantity,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders

NAME: Final = "visibility"
PriorName = Literal["block", "none"]
MultiplierValue = Annotated[float, Field(ge=0, le=1)] | Literal["chosen"]


_MOST_AVERAGES: Final = 500
"""Averages of a block, whose memory and time grow with the square and the cube of their number."""


class VisibilityProductSettings(NetworkProduct):
    """The ``visibility`` product: extinction and visibility where beams of lidars cross."""

    average: PartOfDay = Field(
        default=timedelta(minutes=10), description="interval over which signals are averaged"
    )
    block: PartOfDay = Field(
        default=timedelta(hours=6), description="interval of averages that are one field"
    )
    prior: PriorName = Field(
        default="block",
        description="block: the averages of a block are one field that changes slowly; none: each"
        " average is solved alone",
    )
    multiplier: MultiplierValue | None = quantity(
        None,
        unit="1",
        description="lambda of Drabenko et al., 0 to 1 or chosen: solve one triangle of beams at"
        " each crossing instead of all beams together",
    )
    visibility: VisibilitySettings = VisibilitySettings()
    tolerance: float = quantity(
        15.0, unit="m", gt=0, le=1000, description="largest distance of beams at a crossing"
    )
    smallest_angle: float = quantity(
        2.0, unit="degree", gt=0, lt=90, description="least angle between beams at a crossing"
    )
    farthest: float | None = quantity(
        None, unit="m", ge=10, description="largest range used; by default the last bin"
    )
    exponent: float = quantity(
        1.0,
        unit="1",
        ge=0.1,
        le=10,
        description="m in backscatter proportional to extinction^(1/m)",
    )
    exponents: dict[str, Annotated[float, Field(ge=0.1, le=10)]] = quantity(
        {}, unit="1", description="exponent of instruments that differ"
    )
    exponent_relative_error: float = quantity(
        0.1, unit="1", ge=0, le=0.5, description="relative error of the exponent"
    )
    lidar_ratio_relative_error: float = quantity(
        0.07,
        unit="1",
        ge=0,
        le=0.5,
        description="relative error of the lidar ratio of a crossing against the others,"
        " from aerosol mixtures and humidity",
    )
    overlap_relative_error: float = quantity(
        0.003,
        unit="1",
        ge=0,
        le=0.5,
        description="relative error of the overlap at the nearest crossing of a beam",
    )
    background_range: BackgroundRange | None = quantity(
        None, unit="m", description="by default the last tenth of the bins"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.block % self.average:
            raise ValueError("block must be a multiple of average")
        if self.block > _MOST_AVERAGES * self.average:
            raise ValueError(f"block must hold at most {_MOST_AVERAGES} averages")
        if self.multiplier is not None and "prior" in self.model_fields_set:
            raise located_error("is not used with a multiplier: leave one of them out", "prior")
        return self

    def check_members(self, instruments: Sequence[str]) -> None:
        """Raise ValueError where `exponents` names an instrument that is not in the network."""
        unknown = sorted(set(self.exponents) - set(instruments))
        if unknown:
            raise located_error(
                f"not in instruments; {nearest(unknown[0], instruments)}known instruments:"
                f" {', '.join(instruments)}",
                "exponents",
                unknown[0],
            )

    def exponent_of(self, instrument: str) -> float:
        """Return the exponent m of the beams of an instrument."""
        return self.exponents.get(instrument, self.exponent)


def _section(members: Sequence[InstrumentHeaders]) -> tuple[str, ...]:
    """Return the lines of the section; empty where the members share no elastic channel."""
    first, *others = (member.elastic_channels for member in members)
    shared = [name for name in first if all(name in other for other in others)]
    return (f"visibility: {{channel: {shared[0]}, average: 10min}}",) if shared else ()


KIND: Final = Kind(
    name=NAME,
    title="Visibility",
    package=__name__,
    settings=VisibilityProductSettings,
    rank=10,
    draft=_section,
)
